"""A reference that a filter made from the DVL holds its noise; one of its own does not, whatever the vehicle does."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.checks.reference_independence import SharedNoise

SECONDS = 400.0


def motion(times, amplitude=0.05, period=6.0):
    """Velocity (N, 3) m/s of a vehicle in waves, with turns."""
    wave = amplitude * np.sin(2 * np.pi * times / period)
    return np.column_stack([1.5 + 0.3 * np.sin(times / 20.0) + wave, 0.2 * np.sin(times / 7.0), wave])


def streams(dvl_hz=5.0, reference_hz=5.0, dvl_std=0.01, reference_std=0.03, shared=0.0, late=0.0, seed=0, **waves):
    """DVL and reference, of which `shared` is the DVL's as a filter has interpolated it."""
    rng = np.random.default_rng(seed)
    times, reference_times = np.arange(0.0, SECONDS, 1.0 / dvl_hz), np.arange(0.03, SECONDS, 1.0 / reference_hz)
    dvl = motion(times, **waves) + rng.normal(0.0, dvl_std, (len(times), 3))
    own = motion(reference_times, **waves) + rng.normal(0.0, reference_std, (len(reference_times), 3))
    of_dvl = np.column_stack([np.interp(reference_times - late, times, column) for column in dvl.T])
    noise = rng.normal(0.0, 0.01, own.shape)
    return times, dvl, reference_times, shared * (of_dvl + noise) + (1.0 - shared) * own


def judged(times, dvl, reference_times, reference, block_s=10.0):
    found = SharedNoise()
    for start in np.arange(0.0, SECONDS, block_s):
        a = (times >= start) & (times < start + block_s)
        b = (reference_times >= start) & (reference_times < start + block_s)
        found.add(times[a], dvl[a], reference_times[b], reference[b])
    return found


@pytest.mark.parametrize("late", [0.0, 0.2, 0.8])
@pytest.mark.parametrize("rates", [(5.0, 5.0), (5.0, 10.0), (10.0, 5.0), (8.0, 8.0)])
def test_a_reference_that_the_dvl_went_into_is_told_by_its_noise(rates, late):
    found = judged(*streams(*rates, shared=1.0, late=late))
    assert 0.25 < found.share() < 1.05  # of what is interpolated between two samples, less
    assert found.contradiction().code == "REFERENCE_HOLDS_DVL"


@pytest.mark.parametrize("late", [0.0, 0.4])
@pytest.mark.parametrize("rates", [(5.0, 1.0), (8.0, 2.0), (25.0, 1.0)])
def test_a_slow_reference_is_told_by_the_noise_of_the_samples_beside_it(rates, late):
    assert judged(*streams(*rates, shared=1.0, late=late)).contradiction().code == "REFERENCE_HOLDS_DVL"


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("rates", [(5.0, 1.0), (8.0, 2.0), (25.0, 1.0)])
@pytest.mark.parametrize("waves", [{"amplitude": 0.3, "period": 4.0}, {"amplitude": 0.1, "period": 1.0}, {}])
def test_a_slow_instrument_of_its_own_shares_none(rates, waves, seed):
    found = judged(*streams(*rates, seed=seed, reference_std=0.003, dvl_std=0.005, **waves))
    assert found.contradiction() is None


def test_half_of_it_is_told_as_well():
    assert 0.25 < judged(*streams(shared=0.5)).share() < 0.6


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "rates", [(5.0, 5.0), (5.0, 10.0), (10.0, 5.0), (5.0, 1.0), (1.0, 5.0), (1.0, 1.0), (25.0, 5.0)]
)
def test_an_instrument_of_its_own_shares_none(rates, seed):
    assert judged(*streams(*rates, seed=seed)).contradiction() is None


@pytest.mark.parametrize("period", [0.5, 1.0, 2.0, 6.0])
@pytest.mark.parametrize("amplitude", [0.02, 0.5])
@pytest.mark.parametrize("reference_std", [0.003, 0.03])
def test_short_waves_that_both_measure_are_no_noise_that_both_have(period, amplitude, reference_std):
    found = judged(*streams(amplitude=amplitude, period=period, reference_std=reference_std, dvl_std=0.005))
    assert found.contradiction() is None


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("pushed", [0.003, 0.01, 0.05])
@pytest.mark.parametrize("dvl_std", [0.001, 0.003, 0.01])
def test_a_vehicle_that_is_pushed_anew_with_every_sample_is_no_noise_that_both_have(pushed, dvl_std, seed):
    rng = np.random.default_rng(100 + seed)
    fine = np.arange(0.0, SECONDS + 1.0, 0.01)
    walk = np.cumsum(rng.normal(0.0, pushed * np.sqrt(0.05), (len(fine), 3)), axis=0)
    times, reference_times = np.arange(0.0, SECONDS, 0.2), np.arange(0.03, SECONDS, 0.2)
    dvl, reference = (walk[np.rint(each / 0.01).astype(int)] for each in (times, reference_times))
    dvl = dvl + rng.normal(0.0, dvl_std, dvl.shape)
    assert (
        judged(times, dvl, reference_times, reference + rng.normal(0.0, 0.003, reference.shape)).contradiction() is None
    )


def test_without_noise_nothing_is_said():
    assert judged(*streams(dvl_std=0.0, reference_std=0.0)).contradiction() is None


def test_axes_that_are_not_measured_and_gaps_take_no_part():
    times, dvl, reference_times, reference = streams(shared=1.0)
    reference[:, 2] = np.nan
    kept = np.random.default_rng(1).random(len(times)) > 0.02
    assert judged(times[kept], dvl[kept], reference_times, reference).share() > 0.5


@pytest.mark.parametrize("tau", [0.5, 1.0])
def test_a_filter_that_smooths_is_told_by_what_it_passes_on(tau):
    times, dvl, reference_times, _ = streams()
    rng = np.random.default_rng(7)
    share = 0.2 / (0.2 + tau)
    kept = dvl.copy()
    for at in range(1, len(kept)):
        kept[at] = kept[at - 1] + share * (dvl[at] - kept[at - 1])
    reference = np.column_stack([np.interp(reference_times, times, column) for column in kept.T])
    found = judged(times, dvl, reference_times, reference + rng.normal(0.0, 0.003, reference.shape))
    assert found.contradiction().code == "REFERENCE_HOLDS_DVL"


@pytest.mark.parametrize("seed", range(1, 4))
def test_a_filter_that_weighs_the_dvl_as_much_as_a_noisy_receiver_is_told(seed):
    """Yaw 2.0° ± 0.4 for 4.0 was accepted."""
    times, dvl, _, _ = streams(seed=seed)
    own = motion(times) + np.random.default_rng(40 + seed).normal(0.0, 0.1, dvl.shape)
    kept = 0.5 * (dvl + own)
    for at in range(1, len(kept)):
        kept[at] = 0.5 * (kept[at - 1] + kept[at])
    assert judged(times, dvl, times + 0.004, kept).contradiction().code == "REFERENCE_HOLDS_DVL"
