"""Half-real cases of the trial: real motion, faults as large as at sea, clocks, no vertical, several recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from yaml_text import parsed

from validation.trial import generator, recorded
from validation.trial.cases import draw
from validation.trial.generator import VERTICALS, Noise
from validation.trial.half_real import HORIZONTAL, MIN_DISTANCE, MIN_Q
from validation.trial.plan import Case, Family
from validation.trial.recorded import recordings_folder
from validation.trial.strength import Yardstick
from validation.trial.truth import Category
from validation.trial.vehicle import dvl_stamps, in_recording

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("snapir_ins")]

KIND = "snapir"


def case(category=Category.PAIR, name="", family=Family.HALF_REAL, number=0, q=0.0) -> Case:
    return Case(category, KIND, name, q, number=number, family=family)


def samples_of(drawn, number=0):
    """(stamps s, values) of DVL, reference and inertial unit, without noise."""
    clean = replace(drawn, scene=replace(drawn.scene, beam_std=0.0, gnss_std=0.0))
    dvl, gnss, imu = generator._samples(clean, number, Noise(np.random.default_rng(0)), 0)
    seconds = [np.array([s.stamp_ns for s in each]) * 1e-9 for each in (dvl, gnss, imu)]
    return (
        (seconds[0], np.array([s.velocity for s in dvl])),
        (seconds[1], np.array([s.velocity for s in gnss])),
        (seconds[2], Rotation.from_quat([s.orientation for s in imu]), np.array([s.angular_velocity for s in imu])),
    )


def find(wanted, category=Category.PAIR, family=Family.HALF_REAL, name="", seeds=range(40)):
    """The first of some draws of a case that is as wanted."""
    for seed in seeds:
        drawn = draw(case(category, name, family), seed)
        if wanted(drawn):
            return drawn
    raise AssertionError("no draw is as wanted")


@pytest.fixture
def no_imu_noise(monkeypatch):
    monkeypatch.setattr(generator, "IMU_ATTITUDE_STD", 0.0)
    monkeypatch.setattr(generator, "IMU_RATE_STD", 0.0)


def test_a_user_who_knows_the_truth_can_undo_it_from_the_bag_alone(no_imu_noise):
    """Lever arm at the time of measurement, then the delay: by other means than the generator's, to 3 mm/s."""
    drawn = find(lambda d: set(d.faults) == {"lever_arm", "dvl_time_offset"} and d.scene.dvl_rate == 5.0)
    (late, measured), (gnss_time, enu), (imu_time, attitude, rates) = samples_of(drawn)
    vehicle, arm = drawn.scene.vehicle, np.array(list(drawn.faults["lever_arm"].values()))
    at = late - drawn.faults["dvl_time_offset"]["seconds"]
    inside = (at > max(gnss_time[0], imu_time[0]) + 5.0) & (at < min(gnss_time[-1], imu_time[-1]) - 5.0)
    at = at[inside]
    turned = Rotation.from_euler("xyz", CubicSpline(imu_time, np.unwrap(attitude.as_euler("xyz"), axis=0))(at))
    body = turned.apply(CubicSpline(gnss_time, enu)(at), inverse=True) + np.cross(CubicSpline(imu_time, rates)(at), arm)
    nominal = Rotation.from_euler("xyz", vehicle.mounting_rpy).inv().apply(body)
    ideal = Rotation.from_rotvec(vehicle.misalignment).apply(nominal)
    scale = np.sum(ideal * measured[inside], axis=0) / np.sum(ideal**2, axis=0)
    assert np.abs(scale - 1.0).max() < 0.03
    assert np.sqrt(np.mean((ideal * scale - measured[inside]) ** 2)) < 0.003
    assert drawn.truth.before_mps > 0.02  # what it was before


def test_a_clock_stamps_with_offset_jump_and_drift():
    times = np.arange(10.0, 20.0)
    faults = {
        "dvl_time_offset": {"seconds": 1.5},
        "time_offset_jump": {"seconds": 0.5, "at_s": 4.0},
        "clock_drift": {"seconds_per_hour": 36.0},
    }
    since = times - 10.0
    stamps = dvl_stamps(times, faults)
    # an hour of the clock's own has 36 s too many
    assert np.allclose(stamps - 0.5 * (since >= 4.0) - 11.5, since / (1.0 - 0.01))


def test_a_clock_that_steps_back_leaves_stamps_in_order():
    drawn = find(
        lambda d: d.faults["time_offset_jump"]["seconds"] < -1.1, category=Category.SINGLE, name="time_offset_jump"
    )
    (stamps, _), _, _ = samples_of(drawn)
    assert (np.diff(stamps) > 0.0).all()
    assert len(stamps) < len(drawn.scene.dvl_times(drawn.scene.motions[0]))


def test_late_attitude_is_the_attitude_of_before(no_imu_noise):
    drawn = find(lambda d: d.scene.imu_rate >= 5.0, category=Category.SINGLE, name="attitude_time_offset")
    late = drawn.faults["attitude_time_offset"]["seconds"]
    _, _, (time, attitude, _) = samples_of(drawn)
    true = drawn.scene.motions[0].at(time - late).attitude
    assert np.abs((true.inv() * attitude).magnitude()).max() < 1e-9


def test_every_fault_at_sea_is_strong_beside_the_others_and_apart_from_every_rival():
    for number in range(2):
        drawn = draw(case(Category.TRIPLE, number=number), 11)
        truth = drawn.truth
        assert len(truth.faults) == 3 and min(truth.q.values()) >= MIN_Q
        assert min(truth.distances.values()) >= MIN_DISTANCE
        assert not truth.distances.keys() & truth.faults.keys()
        # the truth said is all that there is to say; less of it leaves more
        yardstick = Yardstick(drawn.scene)
        assert yardstick.error_mps(drawn.faults, drawn.faults) < 1e-9
        for name in drawn.faults:
            assert yardstick.error_mps(drawn.faults, {k: v for k, v in drawn.faults.items() if k != name}) > 1e-4


@pytest.mark.parametrize("number", range(len(HORIZONTAL)))
def test_a_horizontal_reference_shows_it_as_drivers_do_and_is_else_its_twin(number, tmp_path):
    horizontal = case(Category.SINGLE, "dvl_time_offset", Family.HORIZONTAL, number)
    drawn, twin = draw(horizontal, 3), draw(horizontal.twin, 3)
    assert drawn.faults == twin.faults and drawn.truth.twin == twin.truth.id != drawn.truth.id
    dvl, gnss, _ = generator._samples(drawn, 0, Noise(np.random.default_rng(1)), 0)
    dvl_twin, gnss_twin, _ = generator._samples(twin, 0, Noise(np.random.default_rng(1)), 0)
    assert [s.velocity for s in dvl] == [s.velocity for s in dvl_twin]
    assert [s.velocity[:2] for s in gnss] == [s.velocity[:2] for s in gnss_twin]
    assert all(s.velocity[2] == 0.0 for s in gnss)
    shown = HORIZONTAL[number]
    if shown == "zero_without_covariance":
        assert gnss[0].covariance is None
    else:
        variance = VERTICALS[shown]
        assert gnss[0].covariance[2, 2] == (drawn.scene.gnss_std**2 if variance is None else variance)


def test_recordings_of_a_vehicle_have_a_delay_a_day_and_a_mounting_that_moved_once():
    drawn = draw(case(Category.TRIPLE, "mounting_moved", Family.SEVERAL), 1)
    n, moved = len(drawn.scene.motions), drawn.faults["mounting_moved"]
    days = [in_recording(drawn.faults, number) for number in range(n)]
    assert len({each["dvl_time_offset"]["seconds"] for each in days}) == n >= 2
    assert len({tuple(each["lever_arm"].values()) for each in days}) == 1
    assert [("mounting_moved" in each) for each in days] == [k >= moved["from_recording"] for k in range(n)]
    assert 1 <= moved["from_recording"] < n


def test_recordings_of_a_day_each_are_as_many_bags_on_as_many_days(tmp_path):
    recorded_case = generator.record(case(Category.NULL, family=Family.SEVERAL), 2, tmp_path / "case")
    metadata = [parsed((bag / "metadata.yaml").read_text()) for bag in recorded_case.bags]
    starts = [each["rosbag2_bagfile_information"]["starting_time"]["nanoseconds_since_epoch"] for each in metadata]
    assert len(starts) == len(recorded_case.drawn.scene.motions) >= 2
    assert np.allclose(np.diff(starts) * 1e-9, 86400.0, atol=5.0)


def test_rates_differenced_as_imported_are_those_of_half_a_sample_later(no_imu_noise):
    drawn = find(lambda d: d.scene.rates_differenced, category=Category.NULL)
    _, _, (time, attitude, rates) = samples_of(drawn)
    turned = Rotation.concatenate([attitude[k] * Rotation.from_rotvec(rates[k]) for k in range(len(time) - 1)])
    assert np.abs((turned.inv() * attitude[1:]).magnitude()).max() < 1e-9


def test_a_displaced_dvl_has_what_its_name_says_beside_a_long_arm_and_a_horizontal_reference():
    displaced = Case(Category.TRIPLE, KIND, "lag+late+leaps", number=1, family=Family.DISPLACED)
    drawn = draw(displaced, 0)
    assert {"lever_arm", "reference_lag", "time_offset_jump"} < set(drawn.faults) and len(drawn.faults) == 4
    assert 0.5 <= np.linalg.norm(list(drawn.faults["lever_arm"].values())) <= 3.5
    assert drawn.scene.vertical in HORIZONTAL and min(drawn.truth.distances.values()) >= MIN_DISTANCE
    leap = drawn.faults["time_offset_jump"]
    times = np.array([0.0, leap["at_s"] + 1.0, leap["again_at_s"] + 1.0])
    late = dvl_stamps(times, {"time_offset_jump": leap}) - times
    assert late == pytest.approx([0.0, leap["seconds"], leap["seconds"] + leap["again_seconds"]])


@pytest.mark.parametrize("name", recorded.BY_BOAT)
def test_a_boat_never_goes_as_fast_as_a_sample_that_is_none(name):
    """One of 592 is 27 m/s ahead, aside and up: smoothed, a boat of 0.85 m/s went at 13 m/s for three seconds."""
    if not recorded.has_boat(recordings_folder()):
        pytest.skip("no recordings of the boat")
    motion = recorded.by_boat(name)
    assert motion.at(np.arange(0.0, motion.seconds)).speed.max() < 1.5
