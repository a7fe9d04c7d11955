"""What `simulate` puts into a bag: motions, effects exactly as they are, noise beside them, truth on request."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from command_line import fail, succeed
from conftest import ROOT
from io_fixtures import raw, storage_file, write_bag
from mcap.reader import make_reader

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.numerics.error_model import distort
from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NED, rotation_from_quaternion, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import ImuSample, VelocityFrame
from dvl_calib_ros.effects.base import ActsOn, ClockEffect, Effect, EffectInput, Injection, depth_of
from dvl_calib_ros.effects.registry import EFFECTS, OWN
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.recorded_motion import MotionSource, recorded_motion
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors, ImuErrors
from dvl_calib_ros.simulation.trajectories import FREE_SPEEDS_MPS, TRAJECTORIES, Waves, add_waves, make_motion

BAGS = ROOT / "bags"
QUIET = {"gnss_std": 0.0, "seconds": 60.0, "mounting_rpy": (0.1, -0.2, 0.7), "trajectory": "figure8"}
OWN_EFFECTS = [kind.name for kind in OWN if issubclass(kind, Effect)]


def velocities(samples) -> np.ndarray:
    return np.array([sample.velocity for sample in samples])


def times(samples) -> np.ndarray:
    return np.array([1e-9 * (sample.stamp_ns - 1_760_000_000_000_000_000) for sample in samples])


def effects(*texts):
    return tuple(injection(text) for text in texts)


def typical(name) -> Injection:
    values = {p.name: p.typical for p in EFFECTS[name].parameters if math.isfinite(p.typical)}
    if name == "sound_speed_layer":  # a vehicle at the surface hardly changes its depth
        values = {"ratio_per_m": EFFECTS[name].parameters[0].high}
    return Injection(EFFECTS[name], EFFECTS[name].defaults | values)


def true_motion(scenario: Scenario) -> EffectInput:
    motion = make_motion(scenario.trajectory, scenario.seconds, 100.0)
    mounting = rotation_from_rpy(scenario.mounting_rpy).T
    return EffectInput(
        motion.time, motion.velocity_body, mounting, motion.rotation_enu_from_body, motion.angular_velocity,
        depth_below_start=depth_of(motion.time, motion.upwards),
    )  # fmt: skip


# ------------------------------------------------------------------ effects


@pytest.mark.parametrize("name", [name for name in OWN_EFFECTS if not isinstance(EFFECTS[name], ClockEffect)])
def test_a_noise_free_run_with_an_effect_differs_by_that_effect_alone(name):
    plain, given = Scenario(**QUIET), typical(name)
    before, after = simulate(plain), simulate(Scenario(**QUIET, effects=(given,)))
    motion = true_motion(plain)
    trace = given.effect.trace(motion, given.values)
    on_reference = given.effect.acts_on is ActsOn.REFERENCE
    added = (
        np.einsum("nij,nj->ni", motion.attitude, -trace) if on_reference else trace @ motion.rotation_dvl_from_body.T
    )
    changed, unchanged = ("gnss", "dvl") if on_reference else ("dvl", "gnss")
    at = times(getattr(after, changed))
    expected = np.column_stack([np.interp(at, motion.time, column) for column in added.T])
    difference = velocities(getattr(after, changed)) - velocities(getattr(before, changed))
    np.testing.assert_allclose(difference, expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-4
    assert getattr(before, unchanged) == getattr(after, unchanged) and before.imu == after.imu


@pytest.mark.parametrize(
    ("text", "stream"),
    [
        ("dvl_time_offset:seconds=0.3", "dvl"), ("clock_drift:seconds_per_hour=30", "dvl"),
        ("time_offset_jump:seconds=2.5,at_s=20", "dvl"), ("reference_time_offset:seconds=-0.7", "gnss"),
        ("attitude_time_offset:seconds=0.2", "imu"),
    ],
)  # fmt: skip
def test_a_clock_that_is_wrong_changes_nothing_but_the_stamps_of_its_stream(text, stream):
    before, after = simulate(Scenario(**QUIET)), simulate(Scenario(**QUIET, effects=effects(text)))
    for name in ("dvl", "gnss", "imu"):
        plain, late = getattr(before, name), getattr(after, name)
        assert [sample[1:] for sample in plain] == [sample[1:] for sample in late]
        assert (plain == late) == (name != stream)
    given = effects(text)[0]
    at = times(getattr(before, stream))
    np.testing.assert_allclose(times(getattr(after, stream)) - at, given.effect.late(at, given.values), atol=1e-6)


def test_a_late_dvl_with_a_lever_arm_was_moved_when_it_measured():
    """The order of physics: lever arm at the time of measurement, then the stamp; they do not add up at one stamp."""
    both = simulate(Scenario(**QUIET, effects=effects("lever_arm:x_m=-1.9", "dvl_time_offset:seconds=1.4")))
    alone = simulate(Scenario(**QUIET, effects=effects("lever_arm:x_m=-1.9")))
    np.testing.assert_array_equal(velocities(both.dvl), velocities(alone.dvl))
    np.testing.assert_allclose(times(both.dvl), times(alone.dvl) + 1.4, atol=1e-6)


def test_what_the_dvl_makes_of_its_velocity_it_makes_of_that_which_the_lever_arm_gives_it():
    texts = ["lever_arm:x_m=-1.9,y_m=3", "quadratic_scale:coefficient_s_per_m=0.1"]
    scenario = Scenario(**QUIET, effects=effects(*texts))
    motion = true_motion(scenario)
    at_dvl = motion.velocity_body + np.cross(motion.angular_velocity, [-1.9, 3.0, 0.0])
    expected = at_dvl * (1.0 + 0.1 * np.linalg.norm(at_dvl, axis=1)[:, None]) @ motion.rotation_dvl_from_body.T
    np.testing.assert_allclose(velocities(simulate(scenario).dvl), expected[::20][: len(times(simulate(scenario).dvl))])


def test_misalignment_and_scale_turn_what_moves_the_dvl_but_not_what_the_dvl_adds():
    errors = DvlErrors((0.05, -0.1, 0.2), (0.02, 0.01, -0.03))
    scenario = {**QUIET, "errors": errors}
    before = simulate(Scenario(**scenario))
    lever, bias = (
        simulate(Scenario(**scenario, effects=effects(text)))
        for text in ("lever_arm:x_m=1,y_m=-2,z_m=0.5", "velocity_bias:x_mps=0.1,z_mps=-0.2")
    )
    motion = true_motion(Scenario(**scenario))
    every = slice(None, None, 20)  # DVL samples of the motion's
    moved = np.cross(motion.angular_velocity, [1.0, -2.0, 0.5])[every][: len(before.dvl)]
    turned = moved @ (rotation_from_rpy(errors.misalignment_rpy).T @ motion.rotation_dvl_from_body).T
    difference = velocities(lever.dvl) - velocities(before.dvl)
    np.testing.assert_allclose(difference, turned * (1.0 + np.array(errors.scale)), atol=1e-12)
    np.testing.assert_allclose(
        velocities(bias.dvl) - velocities(before.dvl), np.tile([0.1, 0.0, -0.2], (len(before.dvl), 1)), atol=1e-12
    )


def test_effects_add_up_and_may_be_given_twice():
    texts = ["water_lock:east_mps=0.2,to_s=20", "water_lock:north_mps=0.1,from_s=30", "lever_arm:x_m=1"]
    before = velocities(simulate(Scenario(**QUIET)).dvl)
    alone = [velocities(simulate(Scenario(**QUIET, effects=effects(text))).dvl) - before for text in texts]
    together = velocities(simulate(Scenario(**QUIET, effects=effects(*texts))).dvl) - before
    np.testing.assert_allclose(together, sum(alone), atol=1e-12)


def test_noise_effects_leave_the_noise_of_everything_else_as_it_was():
    options = {"seconds": 30.0, "errors": DvlErrors(beam_std=0.01), "imu_errors": ImuErrors(0.01, 0.01)}
    before = simulate(Scenario(**options))
    after = simulate(Scenario(**options, effects=effects("coloured_reference_noise:std_mps=0.2", "lever_arm:x_m=1")))
    alone = simulate(Scenario(**options, effects=effects("lever_arm:x_m=1")))
    assert (velocities(after.dvl) == velocities(alone.dvl)).all() and after.imu == before.imu
    assert (velocities(after.gnss) != velocities(before.gnss)).all()
    hit = simulate(Scenario(**options, effects=effects("outliers:share=0.2")))
    differs = [a.velocity != b.velocity for a, b in zip(before.dvl, hit.dvl, strict=True)]
    assert 0.1 < np.mean(differs) < 0.3 and (velocities(hit.gnss) == velocities(before.gnss)).all()


# ------------------------------------------------------------------ sensors


def test_beam_biases_come_out_as_a_velocity_of_the_least_squares_kind(capsys, tmp_path):
    """Fore beams high and aft beams low by b is b / sin 20° cos 45° ahead: Janus geometry by hand."""
    quiet = ["--duration", 5, "--beam-std", 0, "--gnss-rate", 0, "--imu-rate", 0]
    succeed(capsys, "simulate", tmp_path / "plain", *quiet)
    succeed(capsys, "simulate", tmp_path / "biased", *quiet, "--beam-bias", 0.01, -0.01, -0.01, 0.01)
    difference = dvl_velocities(tmp_path / "biased") - dvl_velocities(tmp_path / "plain")
    ahead = 0.01 / (math.sin(math.radians(20)) * math.cos(math.radians(45)))
    np.testing.assert_allclose(difference, np.tile([ahead, 0.0, 0.0], (25, 1)), atol=1e-12)


def dvl_velocities(bag) -> np.ndarray:
    with BagReader([bag]) as reader:
        linear = [message.twist.twist.linear for _, _, message, _ in reader.messages(["dvl/twist"])]
    return np.array([[v.x, v.y, v.z] for v in linear])


def test_an_imu_is_as_noisy_and_as_biased_as_asked_for():
    errors = ImuErrors(attitude_std=0.02, gyro_std=0.03, gyro_bias=(0.1, -0.2, 0.3))
    options = {"seconds": 100.0, "imu_rate": 50.0}
    clean, noisy = (simulate(Scenario(**options, imu_errors=e)).imu for e in (ImuErrors(), errors))
    rates = np.array([n.angular_velocity for n in noisy]) - np.array([c.angular_velocity for c in clean])
    np.testing.assert_allclose(rates.mean(axis=0), errors.gyro_bias, atol=0.003)
    np.testing.assert_allclose(rates.std(axis=0), errors.gyro_std, rtol=0.05)
    before, after = (rotation_from_quaternion([s.orientation for s in samples]) for samples in (clean, noisy))
    turns = np.swapaxes(before, 1, 2) @ after
    np.testing.assert_allclose(turns[:, [2, 0, 1], [1, 2, 0]].std(axis=0), errors.attitude_std, rtol=0.05)


# ------------------------------------------------------------------ motions


def assert_consistent(motion):
    """Angular velocity is the derivative of attitude, but for the steps in which a turn sets in."""
    before, after = motion.rotation_enu_from_body[:-2], motion.rotation_enu_from_body[2:]
    turn = np.swapaxes(before, 1, 2) @ after
    skew_part = 0.5 * (turn - np.swapaxes(turn, 1, 2)) / (motion.time[2:] - motion.time[:-2])[:, None, None]
    derived = skew_part[:, [2, 0, 1], [1, 2, 0]]
    assert np.sqrt(((motion.angular_velocity[1:-1] - derived) ** 2).mean(axis=0)).max() < 1e-3


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@pytest.mark.parametrize("waves", [None, Waves(1.0, 7.0)])
def test_the_angular_velocity_of_a_motion_is_the_derivative_of_its_attitude(trajectory, waves, rng):
    motion = make_motion(trajectory, 60.0, 100.0, rng)
    motion = add_waves(motion, waves, rng) if waves else motion
    assert_consistent(motion)


def test_free_manoeuvres_are_others_with_another_seed_and_the_same_with_the_same():
    runs = [simulate(Scenario(trajectory="free", seconds=60.0, seed=seed)).dvl for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]
    motion = make_motion("free", 600.0, 10.0, np.random.default_rng(5))
    low, high = FREE_SPEEDS_MPS
    assert low <= motion.velocity_body[:, 0].min() < 0.9 and 1.9 < motion.velocity_body[:, 0].max() <= high
    assert motion.angular_velocity[:, 2].min() < -0.1 and motion.angular_velocity[:, 2].max() > 0.1


def test_waves_lift_the_vehicle_by_their_significant_height_at_their_period():
    still = make_motion("straight", 2000.0, 10.0)
    flat = type(still)(
        still.time, 0 * still.velocity_body, np.tile(np.eye(3), (20_000, 1, 1)), 0 * still.angular_velocity
    )
    motion = add_waves(flat, Waves(1.2, 8.0), np.random.default_rng(1))
    upwards = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, motion.velocity_body)[:, 2]
    elevation = np.cumsum(upwards) * 0.1
    assert abs(4.0 * (elevation - elevation.mean()).std() / 1.2 - 1.0) < 0.05
    spectrum = np.abs(np.fft.rfft(elevation - elevation.mean()))
    assert abs(np.fft.rfftfreq(20_000, 0.1)[spectrum.argmax()] * 8.0 - 1.0) < 0.2


# ------------------------------------------------------------------ the motion of a bag


@pytest.fixture(scope="module")
def source():
    """A noise-free run to take the motion from."""
    return simulate(Scenario(trajectory="figure8", seconds=60.0, gnss_std=0.0, gnss_rate=10.0))


def written(folder, samples, name="source"):
    return write_bag(folder / name, sorted(samples, key=lambda sample: sample.stamp_ns))


@pytest.mark.parametrize("frame", VelocityFrame)
def test_the_motion_of_a_bag_is_the_motion_that_made_it(tmp_path, source, frame):
    truth = make_motion("figure8", 60.0, 100.0)
    gnss = source.gnss
    if frame is VelocityFrame.NED:
        gnss = [s._replace(velocity=tuple(ENU_FROM_NED @ s.velocity), frame=frame) for s in gnss]
    elif frame is VelocityFrame.BODY:
        options = {"trajectory": "figure8", "seconds": 60.0, "gnss_std": 0.0, "gnss_rate": 10.0}
        gnss = simulate(Scenario(**options, gnss_frame=frame)).gnss
    motion = recorded_motion(MotionSource(written(tmp_path, [*gnss, *source.imu]), smoothing=0.0), 100.0)
    first = round(100 * 0.037)  # GNSS begins that much later, on the motion's grid up to 3 ms
    part = slice(first, first + len(motion.time))
    np.testing.assert_allclose(motion.velocity_body, truth.velocity_body[part], atol=5e-3)
    np.testing.assert_allclose(motion.rotation_enu_from_body, truth.rotation_enu_from_body[part], atol=2e-3)
    np.testing.assert_allclose(motion.angular_velocity, truth.angular_velocity[part], atol=1e-2)
    assert_consistent(motion)
    assert 59.0 < motion.time[-1] < 60.0


def test_smoothing_takes_the_receivers_noise_off_the_motion_and_leaves_turns_their_speed(tmp_path):
    run = simulate(Scenario(trajectory="figure8", seconds=100.0, gnss_std=0.1))
    bag = written(tmp_path, [*run.gnss, *run.imu])
    truth = make_motion("figure8", 101.0, 100.0).velocity_body[4:]
    error = {}
    for smoothing in (0.0, 1.0):
        motion = recorded_motion(MotionSource(bag, smoothing=smoothing), 100.0)
        error[smoothing] = motion.velocity_body - truth[: len(motion.time)]
    assert error[1.0].std() < 0.5 * error[0.0].std()
    assert np.abs(error[1.0].mean(axis=0)).max() < 0.01


def test_a_bag_with_an_outage_gives_its_longest_stretch(tmp_path, source):
    gnss = [s for s, t in zip(source.gnss, times(source.gnss), strict=True) if not 10.0 < t < 25.0]
    bag = written(tmp_path, [*gnss, *source.imu])
    assert abs(recorded_motion(MotionSource(bag), 100.0).time[-1] - 34.9) < 0.2
    assert abs(recorded_motion(MotionSource(bag), 100.0, seconds=12.0).time[-1] - 11.99) < 1e-9


def test_sensors_are_simulated_anew_on_the_motion_of_a_bag(capsys, tmp_path, source):
    bag = written(tmp_path, [*source.gnss, *source.imu])
    options = ["--motion-of", bag, "--beam-std", 0, "--gnss-std", 0, "--dvl-rate", 8, "--scale", 1]
    succeed(capsys, "simulate", tmp_path / "again", *options, "--effect", "velocity_bias:y_mps=0.2")
    with BagReader([tmp_path / "again"]) as reader:
        assert reader.message_counts["dvl/twist"] == pytest.approx(8 * 59.8, abs=2)
    mean = dvl_velocities(tmp_path / "again").mean(axis=0)
    truth = make_motion("figure8", 60.0, 100.0).velocity_body.mean(axis=0)
    np.testing.assert_allclose(mean, 1.01 * truth + [0.0, 0.2, 0.0], atol=0.01)


def without_attitude(samples):
    return [s._replace(orientation=None) for s in samples if isinstance(s, ImuSample)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda run: run.gnss,
            "no topic 'imu/data' of sensor_msgs/msg/Imu; set --motion-topics. The bag has: gnss/twist",
        ),
        (lambda run: run.imu, "no topic 'gnss/twist'"),
        (lambda run: [*run.gnss, *without_attitude(run.imu)], "imu/data holds 0 usable samples"),
        (lambda run: [*run.gnss[:50], *run.imu], "for 4.9 s without a gap"),
        (lambda run: [*run.gnss[:250], *run.imu[700:]], "for 0.0 s without a gap"),
        (lambda run: [*run.gnss[::50], *run.imu], "for 0.0 s without a gap of 2.5 s"),
        (lambda run: [s._replace(velocity=(np.nan,) * 3) for s in run.gnss] + run.imu, "gnss/twist holds 0 usable"),
    ],
)
def test_a_bag_without_a_motion_is_refused_saying_what_it_lacks(tmp_path, source, change, said):
    bag = written(tmp_path, change(source))
    with pytest.raises(InputError) as caught:
        recorded_motion(MotionSource(bag), 100.0)
    assert str(bag) in str(caught.value) and said in str(caught.value) and "\n" not in str(caught.value)


# ------------------------------------------------------------------ truth


def attachments(bag) -> dict[str, bytes]:
    with storage_file(bag).open("rb") as file:
        return {attachment.name: attachment.data for attachment in make_reader(file).iter_attachments()}


OPTIONS = ["--duration", 10, "--misalignment", 1, -2, 3, "--scale", 0.5, "--seed", 3]


def test_the_truth_is_attached_on_request_and_changes_nothing_else(capsys, tmp_path):
    texts = ["--effect", "lever_arm:x_m=0.3", "--effect", "water_lock:east_mps=0.1,from_s=4"]
    options = [*OPTIONS, *texts, "--compression", "chunk"]
    succeed(capsys, "simulate", tmp_path / "without", *options)
    succeed(capsys, "simulate", tmp_path / "with", *options, "--truth")
    assert raw(tmp_path / "with") == raw(tmp_path / "without")
    assert attachments(tmp_path / "without") == {}
    truth = json.loads(attachments(tmp_path / "with")["truth.json"])
    assert truth["effects"] == [
        {"name": "lever_arm", "parameters": {"x_m": 0.3, "y_m": 0.0, "z_m": 0.0}},
        {"name": "water_lock", "parameters": {"east_mps": 0.1, "north_mps": 0.0, "from_s": 4.0, "to_s": None}},
    ]
    assert truth["seed"] == 3 and truth["trajectory"] == "box" and truth["errors"]["scale"] == [0.005] * 3
    motion = make_motion("box", 10.0, 10.0).velocity_body
    turned = motion @ rotation_from_rpy(truth["errors"]["misalignment_rpy"]) * 1.005
    as_calibrated = distort(motion, np.array(truth["phi_rad"]), np.array(truth["delta_k"]), np.eye(3))
    np.testing.assert_allclose(as_calibrated, turned, atol=2e-3)


@pytest.mark.parametrize("options", [["--storage", "sqlite3"], ["--compression", "file"]])
def test_truth_is_refused_where_it_cannot_be_attached(capsys, tmp_path, options):
    said = fail(capsys, "simulate", tmp_path / "bag", "--duration", 5, "--truth", *options)
    assert "only MCAP holds attachments" in said and not (tmp_path / "bag").exists()


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("levr_arm:x_m=1", "no such effect, did you mean 'lever_arm'?"),
        ("", "with one of lever_arm, dvl_time_offset"),
        ("lever_arm", "without parameters does nothing; give some of x_m (m), y_m (m), z_m (m)"),
        ("dvl_time_offset:second=1", "no parameter 'second', did you mean 'seconds'?; it has seconds (s)"),
        ("lever_arm:0.3", "'0.3' is no PARAMETER=VALUE; it has x_m (m)"),
        ("lever_arm:x_m=30cm", "x_m: '30cm' is no number; give it in m, without the unit"),
        ("lever_arm:x_m=", "x_m: '' is no number"),
        ("lever_arm:x_m=nan", "x_m: nan is outside -20 .. 20 m"),
        ("reference_lag:time_constant_s=-1", "time_constant_s: -1 is outside 0 .. 5 s"),
        ("lever_arm:x_m=1,x_m=2", "x_m is given twice"),
    ],
)
def test_a_wrong_effect_is_refused_with_what_there_is(capsys, tmp_path, text, said):
    assert said in fail(capsys, "simulate", tmp_path / "bag", "--duration", 5, "--effect", text)
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--waves", 20, 6], "--waves: give a height of 0 .. 10 m"),
        (["--beam-bias", 0, 0, 0, "inf"], "--beam-bias: inf"),
        (["--attitude-std", -1], "--attitude-std: -1"),
        (["--motion-of", "missing", "--trajectory", "free"], "not allowed with argument"),
        (
            ["--motion-of", BAGS / "harbour_box", "--motion-topics", "imu/data", "gnss/twist"],
            "no topic 'imu/data' of geom",
        ),
    ],
)
def test_bad_motions_and_sensors_are_refused(capsys, tmp_path, options, said):
    assert said in fail(capsys, "simulate", tmp_path / "bag", *options)
    assert not (tmp_path / "bag").exists()
