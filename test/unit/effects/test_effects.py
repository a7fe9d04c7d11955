"""Every effect against what geometry says of it on simple motions, written down here a second time."""

from __future__ import annotations

import configparser
import math
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from conftest import ROOT
from documentation import section

from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.effects import registry
from dvl_calib_ros.effects.base import ActsOn, Effect, EffectInput, EffectNeeds
from dvl_calib_ros.effects.registry import EFFECTS, NOISE_EFFECTS, OWN, effect_table
from dvl_calib_ros.effects.timing import lag_error
from dvl_calib_ros.errors import InputError

# A vehicle that circles to port at SPEED with RATE, from heading east; its DVL looks to port (mounted at yaw 90°)
SPEED, RATE, HEADING_0 = 1.5, 0.15, 0.4
TIME = np.arange(0.0, 60.0, 0.05)
YAW = HEADING_0 + RATE * TIME
FULL_TURN_LATER = TIME > 20.0  # filters have settled there


def circle(roll: float = 0.0, pitch: float = 0.0, acceleration: float = 0.0) -> EffectInput:
    """Constant turn; velocity ahead, growing with the acceleration."""
    ahead = SPEED + acceleration * TIME
    attitude = rotation_from_rpy(np.column_stack([0 * TIME + roll, 0 * TIME + pitch, YAW]))
    return EffectInput(
        TIME,
        np.column_stack([ahead, 0 * TIME, 0 * TIME]),
        rotation_from_rpy((0.0, 0.0, np.pi / 2)).T,
        attitude,
        np.broadcast_to([0.0, 0.0, RATE], (len(TIME), 3)),
    )


def steady(x=0.0, y=0.0, z=0.0):
    return np.column_stack(np.broadcast_arrays(x, y, z, 0 * TIME)[:3])


LATE, LAG, COS = 0.3, 0.5, 0.03
FILTERED = SPEED / (1 + 1j * RATE * LAG)  # of a vector that turns, low-passed; real part ahead, imaginary to port
HOURS = TIME / 3600.0
# name -> motion, values, trace where it is to be compared. The DVL's x is to port, its y astern: T v = (0, -SPEED, 0)
CASES = {
    "lever_arm": (circle(), {"x_m": 0.4, "y_m": -0.2, "z_m": 1.0}, steady(0.2 * RATE, 0.4 * RATE)),
    "sideslip": (circle(), {"coefficient_s": -0.2}, steady(0, -0.2 * RATE * SPEED)),
    "tilt_coupling": (
        circle(roll=0.1, pitch=0.05),
        {"x_per_pitch": 1.0, "y_per_roll": 2.0, "z_per_pitch": 3.0, "z_per_roll": -1.0},
        steady(0.05, 0.2, 0.15 - 0.1),
    ),
    "dvl_time_offset": (circle(acceleration=0.01), {"seconds": LATE}, steady(-0.01 * LATE)),
    "reference_time_offset": (
        circle(),
        {"seconds": LATE},
        steady(SPEED * (1 - np.cos(RATE * LATE)), SPEED * np.sin(RATE * LATE)),
    ),
    # an attitude that is too old turns the reference too little, as one that is too new turns it too much
    "attitude_time_offset": (
        circle(),
        {"seconds": LATE},
        steady(SPEED * (1 - np.cos(RATE * LATE)), -SPEED * np.sin(RATE * LATE)),
    ),
    "time_offset_jump": (
        circle(acceleration=0.01),
        {"seconds": LATE, "at_s": 40.0, "again_seconds": 2.0 * LATE, "again_at_s": 50.0},
        (np.where(TIME >= 40.0, 1.0, 0.0) + np.where(TIME >= 50.0, 2.0, 0.0))[:, None] * steady(-0.01 * LATE),
    ),
    "clock_drift": (circle(acceleration=0.01), {"seconds_per_hour": 20.0}, steady(-0.01 * 20.0 * HOURS)),
    "mounting_moved": (circle(), {"x_rad": 1e-3, "z_rad": 2e-3}, steady(0, 2e-3 * SPEED, -1e-3 * SPEED)),
    "sound_speed_moved": (circle(), {"ratio": 0.01}, steady(0.01 * SPEED)),
    "reference_lag": (circle(), {"time_constant_s": LAG}, steady(SPEED - FILTERED.real, -FILTERED.imag)),
    # x to port, y astern
    "velocity_bias": (circle(), {"x_mps": 0.1, "y_mps": 0.2, "z_mps": 0.3}, steady(-0.2, 0.1, 0.3)),
    "quadratic_scale": (circle(), {"coefficient_s_per_m": 0.01}, steady(0.01 * SPEED**2)),
    "scale_drift": (circle(), {"rate_per_hour": 0.5}, steady(0.5 * HOURS * SPEED)),
    "sound_speed_layer": (
        replace(circle(), depth_below_start=0.5 * TIME),
        {"ratio_per_m": 1e-3},
        steady(5e-4 * TIME * SPEED),
    ),
    # φ × (0, -u, 0) = (φz u, 0, -φx u) on the DVL's axes; its x is to port
    "misalignment_drift": (
        circle(),
        {"x_rad_per_hour": 0.04, "y_rad_per_hour": 0.2, "z_rad_per_hour": 0.08},
        steady(0, 0.08 * HOURS * SPEED, -0.04 * HOURS * SPEED),
    ),
    "mount_flexure": (
        circle(),
        {"x_rad_per_mps": 5e-4, "y_rad_per_mps": 2.5e-3, "z_rad_per_mps": 1e-3},
        steady(0, 1e-3 * SPEED**2, -5e-4 * SPEED**2),
    ),
    # S (0, -u, 0) = (-xy u, 0, -yz u)
    "axis_nonorthogonality": (
        circle(),
        {"xy_rad": 0.01, "xz_rad": 0.05, "yz_rad": 0.02},
        steady(0, -0.01 * SPEED, -0.02 * SPEED),
    ),
    "water_lock": (
        circle(),
        {"east_mps": 0.3, "north_mps": 0.1, "from_s": 30.0, "to_s": 45.0},
        np.where((TIME >= 30.0) & (TIME < 45.0), 1.0, 0.0)[:, None]
        * steady(0.3 * np.cos(YAW) + 0.1 * np.sin(YAW), 0.1 * np.cos(YAW) - 0.3 * np.sin(YAW)),
    ),
    # the recorded heading is too far to port, so the reference seems to come from starboard
    "heading_error": (
        circle(),
        {"sin_rad": 0.0, "cos_rad": COS},
        steady(SPEED * (1 - np.cos(COS * np.cos(YAW))), SPEED * np.sin(COS * np.cos(YAW))),
    ),
}
OWN_EFFECTS = {kind.name: kind() for kind in OWN if issubclass(kind, Effect)}
OWN_NOISE = {kind.name: kind() for kind in OWN if not issubclass(kind, Effect)}


def some_motion() -> EffectInput:
    """All axes moving, samples unevenly spaced."""
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0.05, 0.6, 200))
    angles = np.column_stack([0.1 * np.sin(time), 0.1 * np.cos(0.7 * time), 0.3 * time])
    velocity = np.column_stack([1.5 + 0.3 * np.sin(0.4 * time), 0.2 * np.cos(time), 0.1 * np.sin(2 * time)])
    rates = np.column_stack([0.1 * np.cos(time), -0.07 * np.sin(0.7 * time), np.full_like(time, 0.3)])
    mounting = rotation_from_rpy((0.1, -0.2, 0.7)).T
    depth = 3.0 * np.sin(0.05 * time)
    return EffectInput(time, velocity, mounting, rotation_from_rpy(angles), rates, depth_below_start=depth)


def typical(effect, factor=1.0):
    values = {p.name: factor * p.typical if math.isfinite(p.typical) else p.typical for p in effect.parameters}
    return effect.defaults | values


# ------------------------------------------------------------------ what an effect is


@pytest.mark.parametrize("name", OWN_EFFECTS)
def test_the_trace_has_sign_and_size_that_geometry_gives_it(name):
    motion, values, expected = CASES[name]
    effect = EFFECTS[name]
    trace = effect.trace(motion, effect.defaults | values)
    np.testing.assert_allclose(trace[FULL_TURN_LATER], expected[FULL_TURN_LATER], atol=3e-5)
    assert np.abs(expected[FULL_TURN_LATER]).max() > 1e-3, "too small a case to tell"


@pytest.mark.parametrize("name", OWN_EFFECTS)
def test_an_effect_at_its_defaults_does_nothing_at_all(name):
    assert not EFFECTS[name].trace(some_motion(), EFFECTS[name].defaults).any()


@pytest.mark.parametrize("name", OWN_EFFECTS)
def test_the_trace_is_linear_in_the_parameters_that_are_called_linear(name, rng):
    effect, motion = EFFECTS[name], some_motion()
    linear = [parameter.name for parameter in effect.parameters if parameter.linear]
    first, second = (typical(effect) | {n: rng.normal() for n in linear} for _ in range(2))
    both = first | {n: 2.0 * first[n] - 3.0 * second[n] for n in linear}
    if linear:
        expected = 2.0 * effect.trace(motion, first) - 3.0 * effect.trace(motion, second)
        np.testing.assert_allclose(effect.trace(motion, both), expected, atol=1e-12)
    assert effect.linear == (len(linear) == len(effect.parameters))


@pytest.mark.parametrize("name", [name for name in OWN_EFFECTS if EFFECTS[name].acts_on in (ActsOn.MOTION, ActsOn.DVL)])
def test_a_trace_says_whether_it_depends_on_the_velocity(name):
    effect, motion = EFFECTS[name], some_motion()
    faster = replace(motion, velocity_body=1.3 * motion.velocity_body + 0.1)
    traces = [effect.trace(each, typical(effect)) for each in (motion, faster)]
    assert np.array_equal(*traces) is not effect.of_velocity


@pytest.mark.parametrize("name", OWN_EFFECTS)
def test_an_effect_works_without_what_it_does_not_need_and_refuses_without_what_it_does(name):
    effect = EFFECTS[name]
    lacking = {
        EffectNeeds.ATTITUDE: "rotation_enu_from_body",
        EffectNeeds.ANGULAR_VELOCITY: "angular_velocity",
        EffectNeeds.DEPTH: "depth_below_start",
    }
    unneeded = {field: None for need, field in lacking.items() if need not in effect.needs}
    trace = effect.trace(replace(some_motion(), **unneeded), typical(effect))
    assert trace.shape == (200, 3) and np.isfinite(trace).all() and trace.any()
    for need in effect.needs:
        with pytest.raises(ValueError, match="needs"):
            effect.trace(replace(some_motion(), **{lacking[need]: None}), typical(effect))


def test_every_effect_describes_itself():
    names = {**OWN_EFFECTS, **OWN_NOISE}
    assert len(OWN_EFFECTS) == 20 and len(OWN_NOISE) == 4
    for effect in names.values():
        assert effect.summary and set(effect.confounded_with) <= set(names), effect.name
        assert effect.name in OWN_NOISE or effect.manoeuvre, effect.name
        for p in effect.parameters:
            assert p.low <= p.default <= p.high and p.low <= p.typical <= p.high and p.unit and p.description


# ------------------------------------------------------------------ time


def test_a_parameter_is_said_in_words_and_without_its_unit():
    said = {
        f"{effect.name} {parameter.name}": parameter.display_name
        for effect in (*EFFECTS.values(), *NOISE_EFFECTS.values())
        for parameter in effect.parameters
    }
    assert len(said) > 40 and not [name for name, words in said.items() if "_" in words]
    assert said["clock_drift seconds_per_hour"] == "" and said["heading_error sin_rad"] == "sin"
    assert said["tilt_coupling x_per_pitch"] == "x per pitch" and said["sound_speed_moved ratio"] == "ratio"


def test_a_late_body_frame_reference_is_an_early_dvl():
    motion = replace(some_motion(), reference_frame=VelocityFrame.BODY)
    late, early = (
        EFFECTS[name].trace(motion, {"seconds": 0.3}) for name in ("reference_time_offset", "dvl_time_offset")
    )
    np.testing.assert_allclose(late, -early, atol=1e-15)


def test_a_delay_follows_waves_sampled_at_1_hz():
    time = np.arange(0.0, 120.0)
    waves = np.sin(2 * np.pi * time / 6.0)[:, None] * [1.0, 0.5, 0.2]
    motion = EffectInput(time, waves, np.eye(3))
    for late in (-0.4, 0.1, 0.5):
        expected = np.sin(2 * np.pi * (time - late) / 6.0)[:, None] * [1.0, 0.5, 0.2] - waves
        trace = EFFECTS["dvl_time_offset"].trace(motion, {"seconds": late})
        assert np.abs(trace - expected)[3:-3].max() < 0.06  # straight lines would be off by 0.13


@pytest.mark.parametrize("time_constant", [0.02, 0.7, 40.0])
@pytest.mark.spread(1)
def test_the_lag_is_that_of_the_differential_equation_at_uneven_times(rng, time_constant):
    time = np.cumsum(rng.uniform(0.05, 1.0, 80))
    values = rng.normal(size=(80, 3))
    slopes = np.gradient(values, time, axis=0)
    fine = np.unique(np.concatenate([time, np.linspace(time[0], time[-1], 200_000)]))
    slope = np.column_stack([np.interp(fine, time, column) for column in slopes.T])
    error, at_samples = np.zeros(3), []
    for i in range(len(fine)):  # de/dt = -e / T - slope, exact for the mean slope of each small step
        if i:
            settled = -time_constant * 0.5 * (slope[i] + slope[i - 1])
            error = settled + (error - settled) * np.exp(-(fine[i] - fine[i - 1]) / time_constant)
        at_samples.append(error)
    expected = np.array(at_samples)[np.searchsorted(fine, time)]
    np.testing.assert_allclose(lag_error(time, values, time_constant), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "values"),
    [("misalignment_drift", {"x_rad_per_hour": 1.0, "z_rad_per_hour": 2.0}), ("mount_flexure", {"z_rad_per_mps": 0.2})],
)
def test_a_mounting_that_turns_far_leaves_the_speed_as_it_is(name, values):
    motion = circle()
    effect = EFFECTS[name]
    turned = motion.velocity_body + effect.trace(motion, effect.defaults | values)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), motion.speed, rtol=1e-12)


def test_one_sample_has_neither_delay_nor_lag():
    motion = EffectInput(np.zeros(1), np.ones((1, 3)), np.eye(3))
    for name, values in (("dvl_time_offset", {"seconds": 0.3}), ("reference_lag", {"time_constant_s": 0.3})):
        assert not EFFECTS[name].trace(motion, values).any()


# ------------------------------------------------------------------ noise


@pytest.mark.parametrize("name", OWN_NOISE)
def test_noise_at_its_defaults_leaves_every_sample_as_it_is(name, rng):
    velocity = rng.normal(size=(200, 3))
    effect = NOISE_EFFECTS[name]
    assert (effect.disturb(velocity, some_motion(), effect.defaults, rng) == velocity).all()


def disturbed(name, rng, n=20_000, **values):
    """What it makes of a constant velocity, less that; samples at 5 Hz, turning at 0.3 rad/s, 2 m/s."""
    effect = NOISE_EFFECTS[name]
    still = np.tile([2.0, 0.0, 0.0], (n, 1))
    motion = EffectInput(0.2 * np.arange(n), still, np.eye(3), None, np.tile([0.0, 0.0, -0.3], (n, 1)))
    return effect.disturb(still, motion, effect.defaults | values, rng) - still


def test_outliers_hit_the_share_of_samples_with_the_size_given(rng):
    added = disturbed("outliers", rng, share=0.05, std_mps=0.5)
    hit = added.any(axis=1)
    assert 0.045 < hit.mean() < 0.055
    assert 0.48 < added[hit].std() < 0.52


def test_stale_samples_repeat_the_last_fresh_one(rng):
    velocity = rng.normal(size=(10_000, 3))
    effect = NOISE_EFFECTS["stale_samples"]
    motion = EffectInput(np.arange(10_000.0), velocity, np.eye(3))
    out = effect.disturb(velocity, motion, {"share": 0.3}, rng)
    repeats = (out[1:] == out[:-1]).all(axis=1)
    assert 0.28 < repeats.mean() < 0.32
    assert (out[1:][~repeats] == velocity[1:][~repeats]).all()


def test_noise_grows_with_speed_and_turn_rate(rng):
    added = disturbed("noise_inflation", rng, std_mps=0.1, per_speed=0.05, per_turn_rate_m=1.0)
    assert abs(added.std() / (0.1 + 0.05 * 2.0 + 1.0 * 0.3) - 1.0) < 0.02


def test_coloured_noise_has_the_size_and_the_correlation_time_given(rng):
    added = disturbed("coloured_reference_noise", rng, n=200_000, std_mps=0.1, correlation_time_s=2.0)
    assert abs(added.std() / 0.1 - 1.0) < 0.03
    correlation = (added[10:] * added[:-10]).mean() / added.var()  # 2 s apart
    assert abs(correlation - np.exp(-1.0)) < 0.03


# ------------------------------------------------------------------ registry and plug-ins


PLUGIN = ROOT / "test" / "effect_plugin"


@pytest.mark.slow
def test_the_example_of_an_own_effect_is_found_once_its_package_is_installed(tmp_path):
    """Installed means: its module and its metadata are on the path, as pip puts them there."""
    project = configparser.ConfigParser()
    project.read(PLUGIN / "pyproject.toml")
    points = {
        name: value.strip('"') for name, value in project[f'project.entry-points."{registry.ENTRY_POINTS}"'].items()
    }
    installed = tmp_path / "thruster_wash-0.1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: thruster-wash\nVersion: 0.1.0\n")
    lines = [f"[{registry.ENTRY_POINTS}]", *(f"{name} = {value}" for name, value in points.items())]
    (installed / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "thruster_wash.py").write_text((PLUGIN / "thruster_wash.py").read_text())
    script = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; "
    script += "from dvl_calib_ros.cli.main import main; sys.exit(main(sys.argv[1:]))"

    def run(*arguments):
        return subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True)

    assert r"| `thruster_wash` | a surge error in turns to either side: coefficient · \|ω_z\| |" in (
        run("parameters", "--effects").stdout
    )
    effect = ["--effect", "thruster_wash:coefficient_m=0.5"]
    done = run("simulate", str(tmp_path / "bag"), "--duration", "20", *effect)
    assert done.returncode == 0 and (tmp_path / "bag").is_dir(), done.stderr


class Nameless(Effect):
    """Forgot all about itself."""

    def trace(self, motion, values):
        return motion.velocity_body


class Impostor(OWN[0]):
    """Has the name of an own effect."""


class LateByNothing(Effect):
    """Says that it acts on a clock, which nobody would ask of an effect that is no ClockEffect."""

    name = "late_by_nothing"
    summary = manoeuvre = "none"
    parameters = ()
    acts_on = ActsOn.DVL_CLOCK

    def trace(self, motion, values):
        return motion.velocity_body


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("test_effects:LateByNothing", "acts_on is ActsOn.MOTION or ActsOn.DVL or ActsOn.REFERENCE for a"),
        ("no_such_module:Effect", "No module named 'no_such_module'"),
        ("math:pi", "math:pi is no subclass of Effect or NoiseEffect"),
        ("dvl_calib_ros.effects.base:Effect", "TypeError"),
        ("test_effects:Nameless", "has no attribute 'name'"),
        ("test_effects:Impostor", "there is an effect 'lever_arm' already"),
    ],
)
def test_a_broken_plug_in_is_named_in_one_line(monkeypatch, value, said):
    broken = EntryPoint("mine", value, registry.ENTRY_POINTS)
    monkeypatch.setattr(registry, "entry_points", lambda group: [broken])
    registry.all_effects.cache_clear()
    with pytest.raises(InputError) as caught:
        list(registry.Registry(Effect))
    registry.all_effects.cache_clear()
    assert "'mine'" in str(caught.value) and said in str(caught.value) and "\n" not in str(caught.value)


def own_rows() -> list[str]:
    """Of the table, without plug-ins that are installed here."""
    return [row for row in effect_table().splitlines()[2:] if row.split("`")[1] in {**OWN_EFFECTS, **OWN_NOISE}]


def test_the_readme_lists_the_effects():
    assert section("effects").splitlines()[2:] == own_rows(), "take it from: dvl-calib parameters --effects"


@pytest.mark.parametrize("name", sorted(name for name, (_, values, *_) in CASES.items() if len(values) > 1))
def test_an_effect_without_some_of_its_parameters_does_what_it_does_with_those_at_their_defaults(name):
    """Misaligned axes went through their parameters, and failed where two were left out."""
    motion, values, *_ = CASES[name]
    first, *others = EFFECTS[name].parameters
    part = EFFECTS[name].without({each.name for each in others})
    assert part.parameters == (first,)
    whole = EFFECTS[name].trace(motion, {**EFFECTS[name].defaults, first.name: values[first.name]})
    np.testing.assert_array_equal(part.trace(motion, {first.name: values[first.name]}), whole)
