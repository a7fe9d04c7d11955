"""Columns that grow at their end: how much room they take, and when."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.block_estimator import FullEstimator
from dvl_calib_ros.calibration.estimators.full_fit import KEPT_BLOCKS
from dvl_calib_ros.calibration.estimators.registration_schedule import ROWS_PER_BLOCK, KeptClocks
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ReferenceSample
from dvl_calib_ros.calibration.numerics.tables import RowTable, column
from dvl_calib_ros.calibration.results.thinned_recording import KEPT_EVERY_S, ThinnedBlock
from dvl_calib_ros.calibration.streams.interpolation import DvlColumns, ImuColumns, ReferenceColumns


class Numbers(RowTable):
    """One column."""

    IS_REUSED = True
    number: np.ndarray = column(np.int64)


class KeptNumbers(Numbers):
    """The same, of which others keep parts."""

    IS_REUSED = False


def filled(table: Numbers, n: int) -> Numbers:
    for number in range(table.end, table.end + n):
        table.number[table.extend(1)] = number
    return table


def test_what_holds_few_rows_goes_on_in_the_memory_that_it_has():
    table = filled(Numbers(), 128)
    memory = table.number
    for _ in range(20):
        table.forget_before(table.size - 10)
        filled(table, 50)
        held = table.number[table.begin : table.size]
        np.testing.assert_array_equal(held, np.arange(table.end - len(held), table.end))
        assert table.number is memory


def test_who_keeps_a_part_keeps_its_numbers_whatever_comes_later():
    table = filled(KeptNumbers(), 128)
    part = table.number[100:128]
    for _ in range(20):
        table.forget_before(table.size - 10)
        filled(table, 50)
    np.testing.assert_array_equal(part, np.arange(100, 128))


def test_rows_up_to_what_was_reserved_need_no_more_memory():
    table = filled(Numbers(), 100)
    table.reserve(3000)
    memory = table.number
    np.testing.assert_array_equal(memory[:100], np.arange(100))
    for _ in range(5):
        filled(table, 2900)
        table.forget_before(table.size - 100)
    assert table.number is memory


@pytest.mark.parametrize(("rate_hz", "until_s"), [(5, 80), pytest.param(200, 50, marks=pytest.mark.slow)])
def test_live_the_room_for_samples_is_taken_before_they_come(rate_hz, until_s):
    calibrator = Calibrator(Parameters())
    (keeper,) = (each for each in calibrator._further if isinstance(each, FullEstimator))

    def feed(from_s: int, to_s: int) -> None:
        for number in range(from_s * rate_hz, to_s * rate_hz):
            stamp_ns = number * 1_000_000_000 // rate_hz
            calibrator.feed_dvl(DvlSample(stamp_ns, (1.0, 0.0, 0.001 * (number % 7))))
            if number % (rate_hz // 5) == 0:
                calibrator.feed_reference(ReferenceSample(stamp_ns, (1.0, 0.01, 0.001 * (number % 5))))

    feed(0, 20)
    memory = keeper._dvl.velocity
    feed(20, until_s)
    assert keeper._dvl.base > 0 and keeper._dvl.velocity is memory


def test_what_is_registered_live_is_of_the_newest_blocks_in_memory_that_is_taken_at_once():
    clocks = KeptClocks(Parameters(), live=True)
    streams = clocks._seen._streams
    memory = [stream.times for stream in streams]
    n = ROWS_PER_BLOCK
    for number in range(2 * KEPT_BLOCKS + 20):
        times = 10.0 * number + KEPT_EVERY_S * np.arange(n)
        reference = ReferenceColumns(times, np.ones((n, 3)), np.ones((n, 1, 1)) * np.eye(3), times < 0.0, times > 0.0)
        kept = ThinnedBlock(
            DvlColumns(times, np.ones((n, 3))),
            np.eye(3),
            reference,
            ImuColumns(times, np.ones((n, 4)), np.ones((n, 3))),
        )
        clocks.add(kept, np.zeros(n, dtype=np.uint8), number)
        oldest = 10.0 * max(0, number + 1 - KEPT_BLOCKS)
        assert all(stream.times[stream.begin] == oldest for stream in streams)
    assert len(clocks._seen) == KEPT_BLOCKS
    assert all(stream.times is own for stream, own in zip(streams, memory, strict=True))
