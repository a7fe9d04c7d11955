"""A simulation that follows a motion gives what a simulation of all of it gives; any DVL message can be filled."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import fail, succeed
from driver_fixtures import Maker

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample
from dvl_calib_ros.effects.base import NoiseEffect
from dvl_calib_ros.effects.registry import EFFECTS, NOISE_EFFECTS
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.messages.drivers import DVL_TYPES
from dvl_calib_ros.node.message_types import fill
from dvl_calib_ros.simulation.found_effects import with_dvl
from dvl_calib_ros.simulation.injection import Injection, injection
from dvl_calib_ros.simulation.live_simulation import Follower, MotionSample, in_order
from dvl_calib_ros.simulation.scenario import Scenario, motion_of, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.simulation.trajectories import Waves
from dvl_calib_ros.simulator_export.dvl_description import DvlDescription, Other

SCENARIO = Scenario(
    trajectory="free", seconds=16.0, seed=3, waves=Waves(0.3, 5.0), gnss_std=0.02, outages=((6.0, 8.0),),
    errors=DvlErrors((0.02, -0.03, 0.05), (0.005, 0.004, 0.003), (0.001, 0.0, 0.0, 0.0), beam_std=0.005),
    mounting_rpy=(0.0, 0.0, 0.4),
)  # fmt: skip


def with_effects(*effects: str, **changes) -> Scenario:
    return replace(SCENARIO, effects=tuple(map(injection, effects)), **changes)


def typical(name: str) -> Injection:
    effect = {**EFFECTS, **NOISE_EFFECTS}[name]
    bounded = {p.name: p.typical if np.isfinite(p.high) else p.default for p in effect.parameters}
    return Injection(effect, effect.defaults | bounded | ({"at_s": 8.0} if name == "time_offset_jump" else {}))


def followed(scenario: Scenario, every: int = 1) -> list:
    """What comes of handing on each so-many-th sample of the motion; and of a little more, for what is late."""
    follower = Follower(scenario)
    return [sample for moved in motion_samples(scenario)[::every] for sample in follower.add(moved)]


def motion_samples(scenario: Scenario) -> list[MotionSample]:
    m, _ = motion_of(scenario)
    columns = zip(m.time.tolist(), m.velocity_body, m.rotation_enu_from_body, m.angular_velocity, strict=True)
    return [MotionSample(*each) for each in columns]


def by_kind(samples) -> dict:
    kinds: dict = {}
    for sample in samples:
        kinds.setdefault(type(sample).__name__, []).append(sample)
    return kinds


def assert_same(live, whole, atol=1e-12) -> None:
    """Sample by sample, up to the last second of the run, whose late samples the motion has not reached."""
    live, whole = by_kind(live), by_kind(whole)
    assert set(live) == set(whole) == {"DvlSample", "ReferenceSample", "ImuSample"}
    for kind, wanted in whole.items():
        got = {sample.stamp_ns: sample for sample in live[kind]}
        last = wanted[0].stamp_ns + round(14e9)
        wanted = [sample for sample in wanted if sample.stamp_ns < last]
        assert [sample.stamp_ns for sample in live[kind] if sample.stamp_ns < last] == sorted(
            sample.stamp_ns for sample in wanted
        )
        for sample in wanted:
            for name in ("velocity", "orientation", "angular_velocity"):
                if hasattr(sample, name):
                    np.testing.assert_allclose(getattr(got[sample.stamp_ns], name), getattr(sample, name), 0, atol)


@pytest.mark.spread(8)
@pytest.mark.parametrize("name", [*EFFECTS, "stale_samples", "noise_inflation", "coloured_reference_noise"])
def test_following_a_motion_gives_what_simulating_all_of_it_gives(name):
    scenario = replace(SCENARIO, effects=(typical(name),))
    assert_same(followed(scenario), in_order(simulate(scenario)))


def test_samples_come_in_order_of_stamps_and_not_before_the_motion_has_reached_them():
    scenario = with_effects("dvl_time_offset:seconds=0.7", "reference_time_offset:seconds=-0.3", "lever_arm:x_m=1")
    follower, stamps = Follower(scenario), []
    for moved in motion_samples(scenario)[:1000]:
        dvl = [sample.stamp_ns for sample in follower.add(moved) if isinstance(sample, DvlSample)]
        assert all(stamp <= 1_760_000_000_000_000_000 + round(moved.time * 1e9) for stamp in dvl)
        stamps += dvl
    assert stamps == sorted(stamps) and len(stamps) > 40


def test_an_odometry_of_20_hz_is_enough_for_a_slow_motion():
    scenario = with_effects("lever_arm:x_m=0.5", waves=None)
    live, whole = (by_kind(each)["DvlSample"] for each in (followed(scenario, every=5), in_order(simulate(scenario))))
    differences = [np.subtract(a.velocity, b.velocity) for a, b in zip(live, whole, strict=False)]
    assert np.abs(differences).max() < 0.01


def test_across_a_gap_in_the_motion_nothing_is_measured():
    follower, out = Follower(SCENARIO), []
    for moved in motion_samples(SCENARIO):
        out += [] if 5.0 < moved.time < 10.0 else follower.add(moved)
    times = np.array([1e-9 * (s.stamp_ns - 1_760_000_000_000_000_000) for s in by_kind(out)["DvlSample"]])
    assert not ((times > 5.01) & (times < 9.99)).any() and (times > 10.0).sum() > 25


def test_stamps_begin_where_the_motion_does_and_time_must_go_on():
    follower = Follower(SCENARIO, start_ns=5_000_000_000)
    still = (np.zeros(3), np.eye(3), np.zeros(3))
    out = [sample for time in (0.0, 0.1, 0.2, 0.3) for sample in follower.add(MotionSample(time, *still))]
    assert out[0].stamp_ns == 5_000_000_000
    with pytest.raises(ValueError, match="does not come after"):
        follower.add(MotionSample(0.3, *still))


def test_noise_that_cannot_be_made_sample_by_sample_is_refused():
    class Plugged(NoiseEffect):
        name = "plugged"
        parameters = ()

        def disturb(self, velocity, motion, values, rng):
            return velocity

    with pytest.raises(InputError, match="plugged: cannot be made sample by sample"):
        Follower(replace(SCENARIO, effects=(Injection(Plugged(), {}),)))


def test_outliers_are_as_many_and_as_large_as_in_a_simulation_of_all():
    scenario = with_effects("outliers:share=0.2,std_mps=1", dvl_rate=50.0)
    clean = by_kind(followed(replace(scenario, effects=())))["DvlSample"]
    wild = by_kind(followed(scenario))["DvlSample"]
    added = np.array([np.subtract(a.velocity, b.velocity) for a, b in zip(wild, clean, strict=True)])
    hit = np.abs(added).max(axis=1) > 1e-6
    assert 0.15 < hit.mean() < 0.25 and 0.85 < added[hit].std() < 1.15


# ---------------------------------------------------------------- the DVL that was found


def test_the_dvl_that_was_found_is_the_one_that_is_simulated():
    found = DvlDescription(
        "d.json", (0.0, 0.1, 0.5), (1.0, 0.0, -0.2), (0.004, 0.005, 0.006), (0.03, 0.0, 0.0), (0.01, 0.01, 0.0026), 4.0,
        others=(Other("dvl_time_offset", {"seconds": 0.4}), Other("noise_inflation", {"factor": 1.3})),
    )  # fmt: skip
    scenario, left_out = with_dvl(with_effects("outliers:share=0.01"), found)
    assert left_out == ("noise_inflation",)
    assert (scenario.mounting_rpy, scenario.dvl_rate, scenario.errors.scale) == ((0.0, 0.1, 0.5), 4.0, found.scale)
    names = {each.effect.name: dict(each.values) for each in scenario.effects}
    assert names["lever_arm"] == {"x_m": 1.0, "y_m": 0.0, "z_m": -0.2}
    assert names["dvl_time_offset"] == {"seconds": 0.4} and "outliers" in names
    run = simulate(scenario)
    std = np.sqrt(np.diag(run.dvl[0].covariance))
    np.testing.assert_allclose(std[:2], 0.01, rtol=1e-6)


@pytest.mark.parametrize("others", [Other("dvl_time_offset", {"seconds": 99.0}), Other("no_such_effect", {"x": 1.0})])
def test_what_cannot_be_simulated_is_refused(others):
    with pytest.raises(InputError, match=r"d.json: "):
        with_dvl(SCENARIO, DvlDescription("d.json", (0.0, 0.0, 0.0), others=(others,)))


def test_a_bag_is_simulated_with_the_dvl_of_a_diagnosis(tmp_path, capsys):
    document = {
        "effects": [{"name": "dvl_time_offset", "equivalent_to": [], "parameters": {"seconds": {"value": 0.4}}}],
        "noise": [],
        "calibration": {"phi_rad": {"z": {"value": 0.05}}, "delta_k": {}},
        "dvl": {
            "mounting_rpy": [0, 0, 0], "lever_arm_m": [1.2, 0, 0], "time_offset_s": 0.0, "clock_drift": 0.0,
            "rate_hz": 4.0, "noise_std_mps": [0.01, 0.01, 0.003], "speed_mps": [1, 0, 0], "sizes_mps": {},
        },
    }  # fmt: skip
    (tmp_path / "d.json").write_text(json.dumps(document))
    succeed(capsys, "simulate", tmp_path / "bag", "--duration", 20, "--truth", "--diagnosis", tmp_path / "d.json")
    said = fail(capsys, "simulate", tmp_path / "b", "--diagnosis", tmp_path / "d.json", "--dvl-rate", 8)
    assert "--dvl-rate" in said and "omit one of the two" in said


@pytest.mark.parametrize(
    "options, said",
    [
        ([], "name a bag to write"),
        (["--follow", "odom"], "name a bag"),
        (["bag", "--live"], "writes no bag"),
        (["--live", "--truth"], "--truth"),
        (["--live", "--speed", "0"], "--speed"),
        (["--live", "--follow", "odom", "--waves", "1", "5"], "--waves"),
        (["--live", "--follow", "odom", "--trajectory", "free"], "--trajectory"),
        (["--live", "--dvl-type", "std_msgs/msg/String"], "--dvl-type std_msgs/msg/String"),
    ],
)
def test_live_options_that_do_not_go_together_are_refused_in_one_line(options, said, capsys):
    pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")
    assert said in fail(capsys, "simulate", *options)


# ---------------------------------------------------------------- messages


def empty(kind: str):
    """A message with the fields of a type, as its package would make it."""
    maker = Maker()
    still = DvlSample(0, np.zeros(3), np.zeros((3, 3)))
    if kind in maker.store.types:
        message = maker.velocity(kind, still)
    else:
        vector = SimpleNamespace(x=0.0, y=0.0, z=0.0)
        header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
        message = SimpleNamespace(header=header, velocity=vector, altitude=0.0)
        if kind.startswith("ds_sensor"):
            message.velocity_covar = np.zeros(9)
            message.velocity_mode = message.coordinate_mode = message.num_good_beams = 0
        else:
            message.velocity_covariance = np.zeros(9)
    for name in ("velocity_mode", "num_good_beams", "beam_velocities_valid", "velocity_valid"):
        if hasattr(message, name):
            setattr(message, name, 0)
    return message


@pytest.mark.parametrize("kind", DVL_TYPES)
def test_a_message_of_any_dvl_type_is_read_back_as_the_sample_that_filled_it(kind):
    covariance = np.diag([1e-4, 2e-4, 5e-5]) + 1e-6
    sample = DvlSample(1_760_000_000_123_456_789, (1.5, -0.2, 0.1), covariance)
    message = fill(empty(kind), DVL_TYPES[kind], sample)
    decoded = MessageDecoder(Parameters(dvl_type=kind)).dvl(message, 0)
    assert isinstance(decoded, DvlSample), decoded
    assert decoded.stamp_ns == sample.stamp_ns
    np.testing.assert_allclose(decoded.velocity, sample.velocity, rtol=0, atol=1e-15)
    if decoded.covariance is not None and "dvl_msgs" not in kind:
        np.testing.assert_allclose(decoded.covariance, covariance, rtol=1e-12)


def test_the_frame_of_the_velocity_is_the_dvls():
    message = fill(empty("nav_msgs/msg/Odometry"), DVL_TYPES["nav_msgs/msg/Odometry"], DvlSample(1, (1.0, 0.0, 0.0)))
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "dvl_link")
