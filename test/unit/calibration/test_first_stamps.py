"""The core, fed sample by sample: a stamp of 1970 or 2038 costs no memory and leaves no trace in the estimates."""

from __future__ import annotations

import tracemalloc
from functools import cache

import numpy as np
import pytest
from io_fixtures import run

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
from dvl_calib_ros.calibration.streams.stream_order import Order, Sequencer

S, DAY = 10**9, 86_400 * 10**9
IN_1970, IN_2038 = 5 * S, 2_145_916_800 * S
SECONDS = 20.0


def fed(samples) -> tuple[Calibrator, int]:
    """A calibrator that had these samples, live, and the most memory that it took, bytes."""
    tracemalloc.start()
    calibrator = Calibrator(Parameters(), worker=AtOnce())
    take = {DvlSample: calibrator.feed_dvl, ReferenceSample: calibrator.feed_reference, ImuSample: calibrator.feed_imu}
    for sample in samples:
        take[type(sample)](sample)
    calibrator.finish()
    calibrator.result()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return calibrator, peak


@cache
def sound() -> tuple[Calibrator, int]:
    return fed(run(SECONDS))


@pytest.mark.spread(2)
@pytest.mark.parametrize(
    ("kind", "number", "stamp_ns"),
    [(DvlSample, 0, IN_1970), (DvlSample, 75, IN_2038), (ImuSample, 0, IN_1970), (ReferenceSample, 75, IN_2038)],
)
def test_one_stray_stamp_changes_nothing(kind, number, stamp_ns):
    samples = list(run(SECONDS))
    at = [index for index, sample in enumerate(samples) if isinstance(sample, kind)][number]
    samples.insert(at, samples[at]._replace(stamp_ns=stamp_ns))
    (calibrator, peak), (expected, usual) = fed(samples), sound()
    assert peak < 1.6 * usual  # while one calibration gives way to the next both have their room
    found, other = calibrator.result(), expected.result()
    assert found.selected == other.selected
    assert found.counts["dvl"]["accepted"] == other.counts["dvl"]["accepted"]
    for name, estimate in found.estimates.items():
        if found.counts["calibration"]["restarts"] and name == "full":  # a reference came before the restart
            off = np.abs(estimate.state - other.estimates[name].state)
            assert (off < 0.5 * estimate.std + 1e-9).all(), name
            continue
        np.testing.assert_array_equal(estimate.state, other.estimates[name].state, err_msg=name)
        np.testing.assert_array_equal(estimate.covariance, other.estimates[name].covariance, err_msg=name)


def order_of(stamps_ns, columns: bool) -> Order:
    """What the last stamp is after the others, which came one by one or as a column."""
    sequencer: Sequencer[DvlSample] = Sequencer(10 * S)
    samples = [DvlSample(stamp_ns, (1.0, 0.0, 0.0)) for stamp_ns in stamps_ns]
    if columns:
        sequencer.follow(np.array(stamps_ns[:-2]))
    else:
        for sample in samples[:-2]:
            assert sequencer.goes_on(sample.stamp_ns) or sequencer.admit(sample)[1]
    assert not sequencer.goes_on(stamps_ns[-2]) and sequencer.admit(samples[-2]) == (Order.HELD, ())
    return sequencer.admit(samples[-1])[0]


@pytest.mark.parametrize("columns", [True, False])
def test_only_a_first_stamp_alone_is_doubted_for_what_follows(columns):
    assert order_of([IN_1970, IN_2038, IN_2038 + 1], columns) is Order.CONFIRMED_RESTART
    assert order_of([0, 8 * DAY, 8 * DAY + 1], columns) is Order.CONFIRMED_RESTART
    # a pause after the first sample, and a clock that is set once it has told a while
    assert order_of([0, 6 * DAY, 6 * DAY + 1], columns) is Order.CONFIRMED_GAP
    assert order_of([IN_1970, IN_1970 + S, IN_2038, IN_2038 + 1], columns) is Order.CONFIRMED_GAP
