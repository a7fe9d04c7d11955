"""Faults of the DVL itself: messages that no one DVL measures, a faulty beam, spikes; a right DVL has none."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.checks.beam_faults import N_EFFECTS, BeamFault, beam_warning, most_significant
from dvl_calib_ros.calibration.checks.dvl_self_consistency import DvlStream
from dvl_calib_ros.calibration.numerics.block_covariance import TimeBlocks
from dvl_calib_ros.calibration.streams.outliers import without_spikes
from dvl_calib_ros.verdict.kinds import Severity


def measured(rng, seconds=300.0, hz=5.0, noise=0.01, wave=0.1, speed=1.5):
    """Velocity (N, 3) m/s in waves, with turns."""
    times = np.arange(0.0, seconds, 1.0 / hz)
    ahead = speed + wave * np.sin(times * 1.1)
    true = np.column_stack([ahead, 0.15 * np.sin(times / 9.0), wave * np.sin(times * 1.3 + 1.0)])
    return true + rng.normal(0.0, noise, true.shape)


def said(velocity, block=50):
    stream = DvlStream()
    for start in range(0, len(velocity), block):
        stream.add(velocity[start : start + block])
    return stream.contradiction()


@pytest.mark.parametrize("hz", [2.0, 5.0, 25.0])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01, 0.05])
@pytest.mark.parametrize("wave", [0.0, 0.1, 0.6])
def test_one_dvl_is_one_dvl(rng, hz, noise, wave):
    assert said(measured(rng, hz=hz, noise=noise, wave=wave)) is None


def test_two_on_one_topic_are_told_by_the_messages_going_to_and_fro(rng):
    one, other = measured(rng), measured(rng, speed=1.2)
    both = np.stack([one, other], axis=1).reshape(-1, 3)
    assert said(both).code == "DVL_TWO_ON_TOPIC"


@pytest.mark.parametrize("step", [0.1, 0.25])
@pytest.mark.parametrize("way", [np.round, np.trunc])
def test_rounding_by_a_decimetre_per_second_is_named_and_by_a_centimetre_is_not(rng, step, way):
    velocity = measured(rng, noise=0.005, wave=0.02)
    found = said(way(velocity / step) * step)
    assert found.code == "DVL_ROUNDED" and found.numbers["step"] == pytest.approx(step)
    assert said(way(velocity / 0.01) * 0.01) is None


def test_an_axis_of_zeros_beside_a_measured_one_is_none(rng):
    velocity = measured(rng)
    velocity[:, 2] = 0.0
    found = said(velocity)
    assert found.code == "DVL_AXIS_DEAD" and found.numbers == {"axes": "z"}
    flat = measured(rng, noise=0.0)  # of a simulator without noise, in the plane
    flat[:, 2] = 0.0
    assert said(flat) is None


def test_few_samples_say_nothing(rng):
    velocity = measured(rng, seconds=20.0)
    velocity[:, 2] = 0.0
    assert said(velocity) is None and said(velocity[:3]) is None


# ---------------------------------------------------------------------- a beam


@pytest.mark.parametrize(
    ("share", "off", "severities"), [(0.041, 0.025, []), (0.043, 0.025, [Severity.REJECT]), (0.047, 0.013, [])]
)
def test_a_significant_beam_whose_error_matters_rejects_the_calibration(share, off, severities):
    """Eight of twelve recordings with a beam that reads 6 % too much were accepted."""
    found = beam_warning(BeamFault(share, 0.01, 135.0, off), 0.01)
    assert [each.severity for each in found] == severities


def test_lasting_noise_makes_a_beam_less_significant():
    """A right survey was rejected for a beam of 21 %, as its residual lasted for a minute."""
    n, information = 20 + N_EFFECTS, 400.0

    def found(noise: float) -> BeamFault:
        blocks = TimeBlocks()
        for each in 8 * (-1.0, 1.0):
            vector = np.zeros((1, n))
            vector[0, 21] = information * (0.1 + noise * each)
            blocks.add(information * np.eye(n)[None], vector, 1.0)
        beam = most_significant(blocks, np.eye(20), np.zeros(20), np.array([1.0, 0.0, 0.0]))
        assert beam is not None
        return beam

    white, lasting = found(0.0), found(0.3)
    assert white.share == pytest.approx(0.1) and white.std == pytest.approx((16.0 * information) ** -0.5, rel=0.01)
    assert lasting.share == pytest.approx(0.1) and lasting.std > 0.3 / 4.0


def test_a_scale_that_grows_with_speed_is_no_beam():
    """A scale of 8 % per m/s was named as a beam of 41 %."""
    n = 20 + N_EFFECTS
    blocks, vector = TimeBlocks(), np.zeros((1, n))
    vector[0, 21], vector[0, -1] = 3.0, 4.0
    blocks.add(np.eye(n)[None], vector, 1.0)
    assert most_significant(blocks, np.eye(20), np.zeros(20), np.array([1.0, 0.0, 0.0])) is None


# ---------------------------------------------------------------------- spikes


def stream(n=100, noise=0.01, seed=0):
    """A vehicle that speeds up and turns, (n, 3) m/s at 5 Hz."""
    time = np.arange(n) / 5.0
    rng = np.random.default_rng(seed)
    smooth = np.column_stack([1.5 + 0.3 * np.tanh(time - 8.0), 0.3 * np.sin(0.5 * time), 0.05 * np.sin(time)])
    return smooth + rng.normal(0, noise, smooth.shape)


@pytest.mark.parametrize("at", [[40], [40, 41], [10, 40, 70], [0], [1], [98], [99], [0, 50, 99]])
def test_spikes_go_and_nothing_else(at):
    values = stream()
    values[at] += np.array([1.5, -1.0, 0.8])
    kept = without_spikes(values, smallest=0.01, also_at_ends=True)
    np.testing.assert_array_equal(np.flatnonzero(~kept), at)


def test_noise_and_manoeuvres_stay():
    assert all(without_spikes(stream(seed=seed), smallest=0.01, also_at_ends=True).all() for seed in range(50))


def test_the_edges_of_a_gap_stay():
    values = stream(200)
    with_gap = np.delete(values, slice(60, 140), axis=0)
    assert without_spikes(with_gap, smallest=0.01, also_at_ends=True).all()


def test_of_few_samples_all_stay():
    assert without_spikes(np.array([[0.0], [5.0], [0.0]])).all()
    assert without_spikes(np.zeros((0, 3))).all()
