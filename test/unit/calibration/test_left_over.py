"""What is left of the velocity follows nothing where all is right; a levelled, biased or smoothed velocity is named."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dvl_calib_ros.calibration.checks.residual_tests import (
    confused_with_bias_std,
    moving_bed,
    residual_trend,
    residual_warnings,
)
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.verdict.kinds import Severity

STEP_S = 0.2


class Vehicle:
    """Legs and turns to both sides at three speeds, in waves, trimmed; what it is and what is measured of it."""

    def __init__(self, rng, seconds=500.0, trim_deg=2.0, wave_deg=1.5, speeds=(0.8, 1.2, 1.6), heave=0.03):
        self.time = np.arange(0.0, seconds, STEP_S)
        leg = (self.time // 50.0).astype(int)
        turning = np.where(self.time % 50.0 > 36.0, np.where(leg % 4 < 2, 1.0, -1.0) * 0.11, 0.0)
        self.yaw_rate = smoothed(turning, 1.0)
        yaw = np.cumsum(self.yaw_rate) * STEP_S
        wave = math.radians(wave_deg)
        self.roll = wave * np.sin(self.time * 1.1)
        self.pitch = math.radians(trim_deg) + wave * np.sin(self.time * 0.9 + 1.0)
        self.turns = np.array([rotation_from_rpy(each) for each in zip(self.roll, self.pitch, yaw, strict=True)])
        self.level = np.array([rotation_from_rpy((0.0, 0.0, each)) for each in yaw])
        ahead = smoothed(np.array(speeds)[leg % 3], 2.0)
        along = np.column_stack([ahead, -0.3 * self.yaw_rate * ahead, heave * np.sin(self.time * 0.9)])
        self.earth = np.einsum("nij,nj->ni", self.level, along)
        self.body = np.einsum("nji,nj->ni", self.turns, self.earth)
        self.rates = np.zeros((len(self.time), 3))
        self.rates[:, 2] = self.yaw_rate
        self.noise = rng.normal(0.0, 0.03, self.body.shape), rng.normal(0.0, 0.01, self.body.shape)

    def found(self, dvl=None, reference=None, turns=None, interval_s=0.0, kept=slice(None)):
        """By a DVL (N, 3) in the body, a reference (N, 3) in the earth and an IMU; what is not given is right.

        kept: samples that came.
        """
        turns = self.turns if turns is None else turns
        seen = (self.earth if reference is None else reference) + self.noise[0]
        body = np.einsum("nji,nj->ni", turns, seen)
        error = body - (self.body if dvl is None else dvl) - self.noise[1]
        # the calibration takes off what looks like a mounting
        moving = body - error
        lean = np.cross(moving, np.eye(3)[:, None]).transpose(1, 2, 0)
        x = np.linalg.lstsq(lean.reshape(-1, 3), error.reshape(-1), rcond=None)[0]
        left = error - lean @ x
        return residual_trend(self.time[kept], turns[kept], body[kept], left[kept], self.rates[kept], interval_s)


def smoothed(values, seconds):
    """By a filter that follows late."""
    kept, share = np.array(values, dtype=float), STEP_S / (STEP_S + seconds)
    for at in range(1, len(kept)):
        kept[at] = kept[at - 1] + share * (values[at] - kept[at - 1])
    return kept


@pytest.mark.parametrize("wave_deg", [0.0, 0.2, 1.5, 5.0])
@pytest.mark.parametrize("speeds", [(0.8, 1.2, 1.6), (1.2, 1.2, 1.2)])
def test_where_all_is_right_only_what_does_not_show_is_said(rng, wave_deg, speeds):
    found = residual_warnings(Vehicle(rng, wave_deg=wave_deg, speeds=speeds).found())
    assert [each.code for each in found] == ["TILT_NOT_SHOWN"] * (wave_deg < 1.0)
    assert all(each.severity is Severity.WARNING for each in found)


def test_on_a_calm_vehicle_it_is_said_that_its_trim_may_be_in_the_mounting(rng):
    """Levelled or not, the DVL's velocity is the same where nothing tilts: a trim of 3 degrees was a pitch of 3."""
    vehicle = Vehicle(rng, trim_deg=3.0, wave_deg=0.1)
    levelled = np.einsum("nji,nj->ni", vehicle.level, vehicle.earth)
    for dvl in (levelled, None):
        (said,) = residual_warnings(vehicle.found(dvl=dvl))
        assert said.severity is Severity.WARNING and said.code == "TILT_NOT_SHOWN" and "by 3.0°" in said.says
    assert residual_warnings(Vehicle(rng, trim_deg=0.2, wave_deg=0.1).found()) == []


@pytest.mark.parametrize(("trim_deg", "word"), [(0.0, Severity.MARGINAL), (3.0, Severity.REJECT)])
def test_a_velocity_that_its_driver_has_levelled_does_not_turn_with_the_pitch(rng, trim_deg, word):
    vehicle = Vehicle(rng, trim_deg=trim_deg)
    levelled = np.einsum("nji,nj->ni", vehicle.level, vehicle.earth)
    found = vehicle.found(dvl=levelled)
    assert found.tilt[1] == pytest.approx(1.0, abs=0.2)
    (said,) = residual_warnings(found)
    assert said.severity is word and said.code == "TILT_NOT_FOLLOWED" and said.numbers["axis"] == "pitch"


def test_a_pitch_of_the_other_sign_is_no_answer_whatever_the_trim(rng):
    vehicle = Vehicle(rng, trim_deg=0.0)
    yaw = np.arctan2(vehicle.turns[:, 1, 0], vehicle.turns[:, 0, 0])
    turned = [rotation_from_rpy(each) for each in zip(vehicle.roll, -vehicle.pitch, yaw, strict=True)]
    (said,) = residual_warnings(vehicle.found(turns=np.array(turned)))
    assert said.severity is Severity.REJECT and said.code == "TILT_NOT_FOLLOWED"


@pytest.mark.parametrize(
    ("drift_deg", "word"), [(4.0, Severity.MARGINAL), (0.7, Severity.WARNING), (-3.0, Severity.MARGINAL)]
)
def test_a_heading_that_drifts_leaves_the_yaw_open(rng, drift_deg, word):
    vehicle = Vehicle(rng)
    drift = np.radians(drift_deg) * vehicle.time / vehicle.time[-1]
    turns = [rotation_from_rpy((0.0, 0.0, each)) for each in drift] @ vehicle.turns
    found = vehicle.found(turns=turns)
    assert math.degrees(found.turned) == pytest.approx(drift_deg, abs=0.4)
    (said,) = residual_warnings(found)
    assert said.code == "HEADING_DRIFTS" and said.severity is word
    covered = residual_warnings(found, mounting_std=(0.0, math.radians(2.0), 0.0))
    assert [each.severity for each in covered] == [Severity.WARNING]


def estimate_with(east: float, north: float) -> SimpleNamespace:
    own = {"reference_east": east, "reference_north": north}
    return SimpleNamespace(state_names=tuple(own), state_of=own.__getitem__)


@pytest.mark.parametrize("bed", [(0.1, 0.066), (-0.4, 0.3), (0.0, 0.1)])
@pytest.mark.parametrize("speeds", [(0.8, 1.2, 1.6), (1.2, 1.2, 1.2)])
def test_a_bed_that_moves_is_named_with_its_velocity(rng, bed, speeds):
    vehicle = Vehicle(rng, speeds=speeds)
    over_ground = np.einsum("nji,nj->ni", vehicle.turns, np.broadcast_to((*bed, 0.0), vehicle.body.shape))
    found = vehicle.found(dvl=vehicle.body - over_ground)
    size = math.hypot(*bed)
    assert np.linalg.norm(found.over_ground - bed) < 0.25 * size
    said = moving_bed(found, estimate_with(0.0, 0.0))
    assert said.code == "BED_MOVES" and said.severity is Severity.REJECT
    assert said.numbers["millimetres"] == pytest.approx(1000.0 * size, rel=0.2)
    assert moving_bed(found, estimate_with(0.8 * bed[0], 0.8 * bed[1])).severity is Severity.MARGINAL


def test_a_velocity_over_ground_that_the_residual_lacks_is_no_bed():
    """On one heading a bias and an error of the reference make up for each other: 54 ± 3 mm/s of 20 that were left."""
    for seed in range(4):
        vehicle = Vehicle(np.random.default_rng(seed))
        vehicle.yaw_rate = 0.1 * vehicle.yaw_rate
        yaw = np.cumsum(vehicle.yaw_rate) * STEP_S
        back = np.array([rotation_from_rpy((0.0, 0.0, each)) for each in yaw]) @ vehicle.level.swapaxes(1, 2)
        vehicle.turns, vehicle.earth = back @ vehicle.turns, np.einsum("nij,nj->ni", back, vehicle.earth)
        biased = vehicle.found(dvl=vehicle.body + np.array([0.06, 0.0, 0.0]))
        assert moving_bed(biased, estimate_with(0.0, 0.0)) is None


def test_what_turns_with_the_vehicle_is_no_bed(rng):
    """A bias, a levelled velocity, a heading that is off by headings, and a reference that is off by 20 mm/s."""
    vehicle = Vehicle(rng)
    yaw = np.arctan2(vehicle.turns[:, 1, 0], vehicle.turns[:, 0, 0])
    off = [rotation_from_rpy((0.0, 0.0, 0.15 * math.sin(each))) for each in yaw]
    for found in (
        vehicle.found(),
        vehicle.found(dvl=vehicle.body + np.array([0.05, -0.05, 0.0])),
        vehicle.found(dvl=np.einsum("nji,nj->ni", vehicle.level, vehicle.earth)),
        vehicle.found(turns=np.array(off) @ vehicle.turns),
        vehicle.found(reference=vehicle.earth + np.array([0.02, 0.0, 0.0])),
    ):
        assert moving_bed(found, estimate_with(0.0, 0.0)) is None


def test_a_bias_is_named_from_the_level_of_a_recordings_tests(rng):
    """27 ± 7 mm/s, which were 1.4 degrees of yaw at 0.2, were accepted."""
    found = Vehicle(rng).found()
    for bias, words in ((0.02, []), (0.04, []), (0.041, [Severity.REJECT])):
        said = residual_warnings(found, bias=estimated((0.0, bias, 0.0), 0.0067))
        assert [each.severity for each in said if each.code == "DVL_BIAS"] == words


def estimated(bias, std: float) -> GaussianState:
    return GaussianState(np.array(bias), std**2 * np.eye(3))


def test_at_one_speed_a_bias_is_not_shown(rng):
    found = Vehicle(rng).found()
    for std, codes in ((0.007, []), (0.009, ["ONE_SPEED"])):
        assert [each.code for each in residual_warnings(found, bias=estimated(np.zeros(3), std))] == codes


@pytest.mark.slow
def test_few_turns_show_a_filter_no_more_surely_than_few_can():
    """Of six legs smoothing by nothing was found at 2.9 σ, from which on a filter is believed."""
    found = [Vehicle(np.random.default_rng(seed), seconds=250.0, wave_deg=0.1).found() for seed in range(60)]
    assert max(abs(each.smoothed) / each.smoothed_std for each in found) < 2.4
    assert np.std([each.smoothed / each.smoothed_std for each in found]) > 0.5


@pytest.mark.parametrize(("axis", "word"), [(0, Severity.REJECT), (1, Severity.MARGINAL), (2, Severity.REJECT)])
def test_a_bias_that_sigma_of_its_own_axis_holds_is_said_and_no_reject(rng, axis, word):
    """28 ± 2 mm/s ahead, beside a scale of 1.7 ± 1.5 %, were a reject."""
    bias = np.zeros(3)
    bias[axis] = 0.028
    found, biased = Vehicle(rng).found()._replace(speed=1.6), estimated(bias, 0.002)
    along = [0.002, 0.0146, 0.002]
    (said,) = [each for each in residual_warnings(found, mounting_std=along, bias=biased) if each.code == "DVL_BIAS"]
    assert said.severity is word
    (said,) = [each for each in residual_warnings(found, bias=biased) if each.code == "DVL_BIAS"]
    assert said.severity is Severity.REJECT


def test_what_a_bias_looks_like_is_by_the_axes_of_the_body():
    """Of a DVL at 90 degrees a turn about its own x is a pitch of the body."""
    names = MODELS["full"].state_names
    p = np.zeros((len(names), len(names)))
    p[0, 0], p[2, 2] = 0.01**2, 0.02**2
    estimate: Any = SimpleNamespace(model="full", recording_covariance=p)
    turned = confused_with_bias_std(estimate, Parameters(mounting_rpy=(0.0, 0.0, math.pi / 2.0)))
    assert turned == pytest.approx([0.0, 0.02, 0.01], abs=1e-12)
    assert confused_with_bias_std(estimate, Parameters()) == pytest.approx([0.0, 0.02, 0.0], abs=1e-12)


def test_a_reference_that_is_smoothed_is_named_with_how_long(rng):
    vehicle = Vehicle(rng)
    slow = smoothed(vehicle.earth, 1.5)
    in_time = np.column_stack([np.interp(vehicle.time + 1.5, vehicle.time, column) for column in slow.T])
    found = vehicle.found(reference=in_time)
    (said,) = residual_warnings(found)
    assert said.severity is Severity.REJECT and said.code == "VELOCITY_SMOOTHED" and said.numbers["name"] == "reference"
    (said,) = residual_warnings(found, of_positions=True)
    assert said.severity is Severity.MARGINAL and said.code == "VELOCITY_SMOOTHED"


def test_an_attitude_without_tilt_and_a_short_run_say_nothing(rng):
    vehicle = Vehicle(rng, speeds=(1.0, 1.0, 1.0))
    found = vehicle.found(turns=vehicle.level)
    assert np.isinf(found.tilt_std).all() and math.isinf(found.smoothed_std)
    assert Vehicle(rng, seconds=60.0).found() is None and residual_warnings(None) == []


@pytest.mark.parametrize("seconds", [0.4, 1.0])
def test_a_reference_that_follows_the_noise_of_the_dvl_is_made_from_it(rng, seconds):
    vehicle = Vehicle(rng)
    kept = smoothed(vehicle.noise[1], seconds)  # by a filter that an IMU carries over the vehicle's own motion
    vehicle.noise = 0.3 * vehicle.noise[0], vehicle.noise[1]
    found = vehicle.found(reference=vehicle.earth + np.einsum("nij,nj->ni", vehicle.turns, kept))
    assert found.circular > 0.0
    (said,) = residual_warnings(found)
    assert said.severity is Severity.REJECT and said.code == "CIRCULAR_REFERENCE"


def test_a_reference_that_moves_by_more_than_the_noise_of_the_dvl_is_no_filter_of_it(rng):
    """A boat's reference followed 2.5 times what a quiet DVL's neighbours left of waves; a filter keeps less than 1."""
    vehicle = Vehicle(rng)
    kept = 3.0 * smoothed(vehicle.noise[1], 1.0) / STEP_S
    vehicle.noise = 0.3 * vehicle.noise[0], vehicle.noise[1]
    found = vehicle.found(reference=vehicle.earth + np.einsum("nij,nj->ni", vehicle.turns, kept))
    assert "CIRCULAR_REFERENCE" not in [each.code for each in residual_warnings(found)]


def made_by_a_filter(vehicle):
    """A reference that is the DVL smoothed over 0.5 s; that it is late has been taken off."""
    seen = vehicle.earth + np.einsum("nij,nj->ni", vehicle.turns, vehicle.noise[1])
    kept = smoothed(seen, 0.5)
    return vehicle.found(
        reference=np.column_stack([np.interp(vehicle.time + 0.5, vehicle.time, each) for each in kept.T])
    )


@pytest.mark.parametrize("seed", range(2))
def test_a_filter_of_the_dvl_is_named_where_its_lag_was_taken_for_a_late_clock(seed):
    found = made_by_a_filter(Vehicle(np.random.default_rng(seed)))
    (said,) = residual_warnings(found)
    assert said.severity is Severity.REJECT and said.code == "CIRCULAR_REFERENCE"


@pytest.mark.parametrize(("smoothed", "codes"), [(0.13, ["CIRCULAR_REFERENCE"]), (0.11, []), (-0.13, [])])
def test_smoothing_and_noise_that_is_passed_on_show_a_filter_together(rng, smoothed, codes):
    """Legs with a filter of 0.5 s and 5 cm/s of noise: followed by 4.4 σ, smoothed by 2.2, and accepted."""
    found = Vehicle(rng).found()._replace(circular=0.13, circular_std=0.03, smoothed=smoothed, smoothed_std=0.06)
    assert [each.code for each in residual_warnings(found)] == codes


@pytest.mark.parametrize("seed", range(0, 8, 4))
def test_noise_of_their_own_is_not_followed(seed):
    rng = np.random.default_rng(seed)
    vehicle = Vehicle(rng, wave_deg=3.0)
    lasting = smoothed(rng.normal(0.0, 0.2, vehicle.body.shape), 10.0)
    vehicle.noise = 0.3 * vehicle.noise[0] + lasting, vehicle.noise[1]
    found = vehicle.found()
    assert found.circular < 4.5 * found.circular_std


@pytest.mark.parametrize("seed", range(3, 6))
def test_few_samples_without_a_gap_nearby_show_no_filter(seed):
    """With a fifth of the samples lost hardly one has all its neighbours: a few were 4 to 11 sigma."""
    rng = np.random.default_rng(seed)
    vehicle = Vehicle(rng)
    found = vehicle.found(kept=np.flatnonzero(rng.random(len(vehicle.time)) > 0.2))
    assert abs(found.circular) <= 3.5 * found.circular_std


@pytest.mark.parametrize("seed", range(2))
def test_what_a_mean_of_noise_leaves_of_waves_is_no_filter_of_the_dvl(seed):
    """What the samples around do not foretell of waves holds their noise: 4.7 to 6.2 σ of nothing."""
    vehicle = Vehicle(np.random.default_rng(seed), wave_deg=0.5)
    at = vehicle.time[:, None] * [0.65, 0.48, 0.65, 0.48] + [1.0, 2.0, 2.6, 0.5]
    surge, sway, heave, more = np.sin(at).T
    along = np.column_stack([0.1 * surge, 0.08 * sway, 0.25 * heave + 0.12 * more])
    vehicle.earth += np.einsum("nij,nj->ni", vehicle.level, along)
    vehicle.body = np.einsum("nji,nj->ni", vehicle.turns, vehicle.earth)
    vehicle.noise = 0.3 * vehicle.noise[0], 3.0 * vehicle.noise[1]
    found = vehicle.found()
    assert found.circular < 2.4 * found.circular_std


@pytest.mark.parametrize("interval_s", [0.4, 1.0])
def test_waves_between_samples_of_a_slow_reference_do_not_make_it_a_smoothed_one(rng, interval_s):
    """Line by line between samples 1 s apart is 0.4 s of smoothing; surge in waves made that 0.7 s, and a reject."""
    vehicle = Vehicle(rng)
    surge = 0.2 * np.sin(vehicle.time * 0.9)[:, None] * vehicle.level[:, :, 0]
    vehicle.earth += surge
    vehicle.body = np.einsum("nji,nj->ni", vehicle.turns, vehicle.earth)
    at = vehicle.time[:: round(interval_s / STEP_S)]
    read = vehicle.earth[:: round(interval_s / STEP_S)]
    between = np.column_stack([np.interp(vehicle.time, at, each) for each in read.T])
    assert vehicle.found(reference=between).smoothed == pytest.approx(interval_s**2 / 12.0, abs=0.03)
    found = vehicle.found(reference=between, interval_s=interval_s)
    assert found.smoothed == pytest.approx(0.0, abs=0.03)
    assert "VELOCITY_SMOOTHED" not in {each.code for each in residual_warnings(found)}
    assert math.isinf(found.circular_std)  # a line between samples follows the motion before as a filter does


def test_waves_between_samples_of_a_slow_reference_are_no_tilt_that_is_not_followed():
    """A line between samples 1 s apart leaves as much of the heave of waves as half a degree of tilt makes of speed."""
    vehicle = Vehicle(np.random.default_rng(3), wave_deg=0.5)
    vehicle.noise = 0.0 * vehicle.noise[0], vehicle.noise[1]
    vehicle.earth += 0.3 * np.outer(np.sin(vehicle.time * 0.9 + 1.0), [0.0, 0.0, 1.0])
    vehicle.body = np.einsum("nji,nj->ni", vehicle.turns, vehicle.earth)
    between = np.column_stack([np.interp(vehicle.time, vehicle.time[::5], each) for each in vehicle.earth[::5].T])
    assert residual_warnings(vehicle.found(reference=between)) == []
    assert residual_warnings(vehicle.found(reference=between, interval_s=1.0)) == []
