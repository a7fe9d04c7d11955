"""The noise as the diagnosis takes it: claims of single samples, spikes of slow streams, colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.calibration.registration.unregistrable_clocks import lag
from dvl_calib_ros.diagnosis.answer.results import DiagnosisVerdict
from dvl_calib_ros.diagnosis.diagnose import diagnose_recordings
from dvl_calib_ros.diagnosis.fit.selection_criteria import blocks_of
from dvl_calib_ros.diagnosis.model.claimed_noise import exponents, relative_std
from dvl_calib_ros.diagnosis.model.forward_model import make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import no_effect
from dvl_calib_ros.diagnosis.model.recorded_streams import RecordedStreams, make_recording
from dvl_calib_ros.diagnosis.model.settings import SETTINGS
from dvl_calib_ros.diagnosis.model.stream_curve import Curve
from dvl_calib_ros.diagnosis.model.time_grid import Offsets
from dvl_calib_ros.diagnosis.noise import noise_level
from dvl_calib_ros.diagnosis.noise.noise_level import log_reported
from dvl_calib_ros.diagnosis.noise.noise_model import Arma, Noise, white_noise
from dvl_calib_ros.diagnosis.search.effect_selection import without_slow_outliers
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

CLAIMS = (DiagnosisVerdict.KNOWN, DiagnosisVerdict.AMBIGUOUS, DiagnosisVerdict.UNKNOWN)
# A receiver that floats for a third of the run, m/s
FIXED, FLOATING, FROM_S, TO_S = 0.03, 0.3, 120.0, 250.0
Streams = dict[str, tuple[np.ndarray, np.ndarray]]


def streams(*effects: str, seed: int = 1, trajectory: str = "free", seconds: float = 400.0, **changes) -> Streams:
    """Of a run whose reference has next to no noise."""
    rates = {"dvl_rate": 2.5, "gnss_rate": 2.5, "imu_rate": 10.0, "gnss_std": 1e-6} | changes
    errors = DvlErrors((0.02, -0.02, 0.03), (0.005,) * 3, beam_std=0.003)
    given = Scenario(
        trajectory, seconds=seconds, seed=seed, errors=errors, effects=tuple(map(injection, effects)), **rates
    )
    run = simulate(given)
    first_ns = run.dvl[0].stamp_ns

    def stream(samples, field):
        time = np.array([1e-9 * (sample.stamp_ns - first_ns) for sample in samples])
        order = np.argsort(time)
        return time[order], np.array([getattr(sample, field) for sample in samples])[order]

    return {
        "dvl": stream(run.dvl, "velocity"),
        "reference": stream(run.gnss, "velocity"),
        "attitude": stream(run.imu, "orientation"),
        "rates": stream(run.imu, "angular_velocity"),
    }


def floating(given: Streams, seed: int = 1) -> tuple[Streams, np.ndarray]:
    """The same with a reference as loud as a standard deviation (N, 3), and that."""
    time, velocity = given["reference"]
    std = np.where((time > FROM_S) & (time < TO_S), FLOATING, FIXED)[:, None] * np.ones(3)
    noise = std * np.random.default_rng(1000 + seed).standard_normal(std.shape)
    return given | {"reference": (time, velocity + noise)}, std


def recorded(given: Streams, std: np.ndarray | None = None) -> RecordedStreams:
    dvl_std = None if std is None else np.full((len(given["dvl"][0]), 3), 0.004)
    return make_recording("run", frame=VelocityFrame.ENU, dvl_std=dvl_std, reference_std=std, **given)


def claimed_otherwise(std: np.ndarray) -> dict[str, np.ndarray | None]:
    rng = np.random.default_rng(5)
    return {
        "random": 0.03 * np.exp(rng.standard_normal((len(std), 1))) * np.ones(3),
        "nothing": None,
    }


# ------------------------------------------------------------------ claims of single samples


@pytest.mark.slow
def test_a_reference_that_says_when_it_is_noisy_is_worth_what_the_best_weights_make_of_it():
    given, std = floating(streams("lever_arm:x_m=0.4"))
    diagnosis = diagnose_recordings([recorded(given, std)], Parameters())
    assert [effect.name for effect in diagnosis.effects] == ["lever_arm"]
    _, low, high = diagnosis.effects[0].parameters["x_m"]
    assert low < 0.4 < high
    problem, fit = diagnosis.selection.fitter.problem, diagnosis.selection.fit
    true = np.stack(
        [np.interp(problem.grids[0].stamps, given["reference"][0], column) ** 2 for column in std.T], axis=1
    )
    true = np.sqrt(problem.grids[0].averaged(true) / problem.grids[0].per_bin)
    white = (fit.columns / true[:, :, None]).reshape(-1, fit.columns.shape[2])
    prior = np.diag([1e2] * 3 + [2.5e3] * 3 + [0.0] * 3)
    best = np.sqrt(np.diag(np.linalg.inv(white.T @ white + prior)))
    own = np.sqrt(np.diag(fit.covariance(blocks_of(problem))))
    assert own[6] == pytest.approx(best[6], rel=0.15)
    assert np.all(own[:6] < 1.4 * best[:6])
    finding = {each.name: each.parameters for each in diagnosis.noise}["reported_covariance"]
    assert finding["reference_exponent"][0] == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_an_effect_is_found_by_what_samples_claim_that_is_not_without():
    given, std = floating(streams("lever_arm:x_m=0.12", seed=3, trajectory="figure8"), seed=3)
    with_claims, without = (diagnose_recordings([recorded(given, each)], Parameters()) for each in (std, None))
    assert [effect.name for effect in with_claims.effects] == ["lever_arm"]
    assert [effect.name for effect in without.effects] != ["lever_arm"]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "trajectory"), [(20, "free"), (21, "box")])
def test_noise_that_is_louder_for_a_while_and_says_so_is_no_effect(seed, trajectory):
    given, std = floating(streams(seed=seed, trajectory=trajectory), seed)
    assert diagnose_recordings([recorded(given, std)], Parameters()).verdict not in CLAIMS


@pytest.mark.slow
@pytest.mark.parametrize("what", ["random", "nothing"])
def test_claims_that_say_nothing_change_nothing(what):
    given = streams(seed=4)
    time, velocity = given["reference"]
    noise = 0.05 * np.random.default_rng(4).standard_normal(velocity.shape)
    given["reference"] = time, velocity + noise
    usual = recorded(given, np.full_like(velocity, 0.05))
    other = recorded(given, claimed_otherwise(np.full_like(velocity, 0.05))[what])
    one, two = (diagnose_recordings([each], Parameters()).selection.fit for each in (usual, other))
    assert one.hypothesis.phi == pytest.approx(two.hypothesis.phi, abs=1e-9)
    assert one.noise.level == pytest.approx(two.noise.level)


def test_the_exponent_of_a_claim_is_found_whatever_the_noise_is_in_all():
    rng = np.random.default_rng(0)
    claims = np.repeat(rng.normal(0.0, 0.7, (100, 1)), 10, axis=0) * np.ones((1, 3))
    stretch = np.arange(1000) // 25
    for exponent in (0.0, 0.5, 1.0, 2.0):
        values = 0.02 * np.exp(exponent * claims) * rng.standard_normal(claims.shape)
        found = exponents(["reference"], claims[:, :, None], values, stretch)
        assert found.exponents[0] == pytest.approx(exponent, abs=4.0 * found.stds[0])
        assert bool(found.is_significant[0]) == (exponent > 0.0)
        relative = relative_std(claims[:, :, None], values, ["reference"], stretch)
        assert np.std(np.log(relative) - exponent * (claims - claims.mean(axis=0))) < 0.1


def test_claims_of_the_earths_axes_are_turned_into_the_frame_of_the_noise():
    time = np.arange(0.0, 100.0, 0.2)
    east = np.column_stack([1.0 + 0.2 * np.sin(0.3 * time), 0.1 * np.cos(0.2 * time), 0.05 * np.sin(time)])
    std = np.where(time[:, None] < 50.0, [0.1, 0.02, 0.05], [0.2, 0.04, 0.1])
    heading = Rotation.from_euler("z", np.full((len(time), 1), np.pi / 2))  # ahead is north
    run = make_recording(
        "run", (time, heading.inv().apply(east)), (time, east), attitude=(time, heading.as_quat()),
        reference_std=std, dvl_std=np.full((len(time), 3), 0.01),
    )  # fmt: skip
    problem = make_problem([run], np.eye(3), np.zeros(3), [Offsets()])
    seen = problem.all_seen(no_effect())
    for rotation, order in ((None, [1, 0, 2]), (problem.earth_from_compared, [0, 1, 2])):
        names, claims = log_reported(problem, seen, rotation)
        assert names == ("reference",)
        early = problem.time < 49.0
        expected = np.log(np.array([0.1, 0.02, 0.05])[order])
        assert claims[early, :, 0] == pytest.approx(np.tile(expected, (int(early.sum()), 1)), abs=1e-6)


def test_a_stream_that_says_when_it_is_loud_has_no_spikes_then():
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 400.0, 0.2)
    std = np.where(time > 270.0, 0.5, 0.02)[:, None] * np.ones(3)
    velocity = std * rng.standard_normal(std.shape)
    dvl = (time, 0.01 * rng.standard_normal(std.shape))
    said, silent = (make_recording("run", dvl, (time, velocity), reference_std=each) for each in (std, None))
    assert len(said.reference.time) == len(time)
    assert len(silent.reference.time) < len(time) - 100


def test_a_noisy_stretch_is_no_reason_to_refuse_clocks_that_agree():
    """At a lag of one lap it lies outside what overlaps."""
    time, rng = np.arange(0.0, 500.0, 0.5), np.random.default_rng(0)
    course = np.exp(2j * np.sin(2.0 * np.pi * time / 200.0)) + 0.005 * rng.standard_normal(len(time))
    noisy = course + np.where(time < 150.0, 1.0, 0.005) * rng.standard_normal(len(time))
    late, is_far = lag(course, 0.0, noisy, 0.0)
    assert not is_far and abs(late) <= 1.0


# ------------------------------------------------------------------ spikes of slow streams


def spiked(given: Streams, every: int) -> tuple[Streams, np.ndarray]:
    """DVL samples off by metres per second, now and then two side by side; which."""
    time, velocity = given["dvl"]
    rng = np.random.default_rng(3)
    wild = np.zeros(len(time), dtype=bool)
    wild[10 : len(time) - 10 : every] = True
    wild[11] = True
    return given | {"dvl": (time, velocity + wild[:, None] * rng.choice([-1.5, 1.5], velocity.shape))}, wild


def slow(*effects: str) -> Streams:
    given = streams(*effects, seconds=600.0, trajectory="lawnmower", dvl_rate=1.0, gnss_rate=5.0, seed=2)
    time, velocity = given["reference"]
    return given | {"reference": (time, velocity + 0.03 * np.random.default_rng(2).standard_normal(velocity.shape))}


@pytest.mark.slow
def test_wild_samples_at_1_hz_are_left_out_and_make_no_effect():
    given, wild = spiked(slow(), 100)
    diagnosis = diagnose_recordings([recorded(given)], Parameters())
    assert diagnosis.verdict not in CLAIMS
    kept = diagnosis.selection.fitter.problem.recordings[0]
    assert not np.isin(given["dvl"][0][wild], kept.dvl.time).any()
    assert kept.spikes == int(wild.sum())
    assert "outliers" in [each.name for each in diagnosis.noise]


@pytest.mark.slow
def test_what_turns_do_to_a_dvl_at_1_hz_is_no_spike():
    given = slow("lever_arm:x_m=-1.9,y_m=0.5")
    diagnosis = diagnose_recordings([recorded(given)], Parameters())
    assert [effect.name for effect in diagnosis.effects] == ["lever_arm"]
    assert diagnosis.selection.fitter.problem.recordings[0].spikes == 0


def test_a_sample_that_only_its_neighbours_contradict_is_kept():
    """Both streams show it: the vehicle did that."""
    time = np.arange(0.0, 300.0, 1.0)
    velocity = np.column_stack([1.0 + 0.3 * np.sin(0.02 * time), 0.1 * np.cos(0.03 * time), 0.0 * time])
    velocity = velocity + 0.005 * np.random.default_rng(1).standard_normal(velocity.shape)
    jerked = velocity.copy()
    jerked[150] += [0.5, 0.5, 0.0]
    problem, wild = (
        make_problem(
            [make_recording("run", (time, jerked), (time, reference), frame=VelocityFrame.BODY)],
            np.eye(3), np.zeros(3), [Offsets()],
        )
        for reference in (jerked, velocity)
    )  # fmt: skip
    assert without_slow_outliers(problem, no_effect()) is None
    (kept,) = without_slow_outliers(wild, no_effect())
    assert sorted(set(time) - set(kept.dvl.time)) == [150.0]


# ------------------------------------------------------------------ colour


@pytest.mark.slow
def test_white_noise_of_two_streams_is_not_called_coloured_for_how_they_are_compared():
    given = streams(seconds=300.0, dvl_rate=5.0, gnss_rate=5.0, seed=7)
    rng = np.random.default_rng(7)
    for stream, std in (("dvl", [0.03, 0.03, 0.008]), ("reference", [0.02, 0.02, 0.02])):
        time, velocity = given[stream]
        given[stream] = time, velocity + np.array(std) * rng.standard_normal(velocity.shape)
    diagnosis = diagnose_recordings([recorded(given)], Parameters())
    assert "coloured_reference_noise" not in [each.name for each in diagnosis.noise]


@pytest.mark.slow
def test_noise_with_a_memory_is_still_called_coloured():
    given = streams(seconds=400.0, dvl_rate=5.0, gnss_rate=5.0, seed=8)
    time, velocity = given["reference"]
    slow_noise, rng = np.zeros_like(velocity), np.random.default_rng(8)
    for i in range(1, len(time)):
        slow_noise[i] = 0.95 * slow_noise[i - 1] + 0.03 * np.sqrt(1 - 0.95**2) * rng.standard_normal(3)
    diagnosis = diagnose_recordings([recorded(given | {"reference": (time, velocity + slow_noise)})], Parameters())
    assert "coloured_reference_noise" in [each.name for each in diagnosis.noise]
    assert diagnosis.selection.fit.noise.is_coloured


def test_of_two_spikes_with_a_good_sample_between_the_spikes_are_left_out():
    time = np.arange(0.0, 100.0, 0.2)
    velocity = np.column_stack([1.0 + 0.3 * np.sin(0.1 * time), 0.2 * np.cos(0.2 * time), 0.0 * time])
    velocity = velocity + 0.01 * np.random.default_rng(1).standard_normal(velocity.shape)
    velocity[[100, 102, 300]] += [[-1.0, 0.9, -0.9], [-0.2, 0.1, -1.0], [1.0, 0.0, 0.0]]
    kept = Curve(time, velocity).without_spikes().time
    assert sorted(set(time) - set(kept)) == pytest.approx(time[[100, 102, 300]])


def test_a_few_quiet_rows_at_a_rare_speed_call_for_no_level(monkeypatch):
    """Four of 95 means, quiet by chance, made what they are all that counts, and noise of them a finding."""
    speed = np.full(95, 2.0) + 0.1 * np.sin(np.arange(95.0))
    speed[40:44] = [1.4, 1.2, 1.0, 0.9]
    innovations = np.random.default_rng(1).standard_normal((95, 2))
    innovations[40:44] *= 0.1
    monkeypatch.setattr(noise_level, "covariates", lambda *_: {"speed": speed})
    assert noise_level.fit_level(None, (), innovations).p > SETTINGS.robust_level
    monkeypatch.setattr(noise_level, "covariates", lambda *_: {"speed": np.where(speed < 1.5, speed, 2.0)})
    assert noise_level.fit_level(None, (), innovations).p > SETTINGS.robust_level
    monkeypatch.setattr(noise_level, "covariates", lambda *_: {"speed": np.linspace(1.0, 2.0, 95)})
    grown = innovations * np.exp(3.0 * np.linspace(0.0, 1.0, 95))[:, None]
    assert noise_level.fit_level(None, (), grown).p < SETTINGS.robust_level


@pytest.mark.parametrize(("keep", "low"), [(0.0, 0.95), (0.5, 0.85)])
def test_noise_keeps_the_colour_of_what_a_fit_has_taken_in(keep, low):
    """What effects leave of noise with a memory looks white: a third of its slow part was gone, and in what was left a
    current was sure to 8 σ that came and went."""
    rng, m = np.random.default_rng(3), 185
    slow = np.cos(np.pi * np.outer(np.linspace(0.0, 1.0, m), np.arange(20)))
    columns, std = np.concatenate([slow, rng.standard_normal((m, 5))], axis=1)[:, None, :], np.full(25, 10.0)
    true = Arma(np.array([keep] if keep else []), 0.0, 0.01, float(1.0 / np.sqrt(1.0 - keep**2)))
    drawn = replace(white_noise(np.ones((m, 1)), (slice(0, m),), None, 2.0), axes=(true,))
    restricted, plain = [], []
    for _ in range(40):
        series = drawn.unwhiten(rng.standard_normal(m))
        noise = white_noise(series, drawn.segments, None, 2.0)
        for _ in range(2):
            white = noise.whiten(columns)
            left = series - columns @ np.linalg.lstsq(white, noise.whiten(series), rcond=None)[0]
            for _ in range(2):
                noise = noise.refitted(left, absorbed=noise.absorbed_by(columns, std))
        restricted.append(_at_rest(noise) / _at_rest(drawn))
        plain.append(_at_rest(noise.refitted(left)) / _at_rest(drawn))
    assert low < np.median(restricted) < 1.1
    assert np.median(plain) < 0.96 * np.median(restricted)
    assert not keep or np.median(plain) < 0.7


@pytest.mark.slow
def test_the_mean_of_slow_noise_is_inside_the_interval_of_what_its_memory_may_be():
    """Five memories long, a series says little of its memory: by the best one 75 % of means were inside."""
    rng, n, keep = np.random.default_rng(3), 300, float(np.exp(-1.0 / 60.0))
    white = white_noise(np.ones((n, 3)), (slice(0, n),), None)
    slow = replace(white, axes=(Arma(np.array([keep]), 0.0, 0.02 * np.sqrt(1 - keep**2), (1 - keep**2) ** -0.5),) * 3)
    columns, std, inside = np.tile(np.eye(3), (n, 1, 1)), np.full(3, 1e3), []
    for _ in range(50):
        series = slow.unwhiten(rng.standard_normal(3 * n)) + rng.normal(0.0, 0.01, (n, 3))
        noise, left = replace(white, memory=float(np.exp(-0.01))), series - series.mean(axis=0)
        for _ in range(3):
            noise = noise.refitted(left, absorbed=noise.absorbed_by(columns, std))
        drawn = noise.drawn(left, noise.absorbed_by(columns, std), 100, rng)
        inside.append(np.abs(series.mean(axis=0)) < 1.96 * np.std([each.mean(axis=0) for each in drawn], axis=0))
    assert np.mean(inside) > 0.88


def _at_rest(noise):
    """Root of the spectrum at the frequency 0."""
    (arma,) = noise.axes
    return arma.std * (1.0 + arma.ma) / (1.0 - sum(arma.ar))


def test_what_lies_about_a_lost_sample_of_a_slow_stream_is_not_compared():
    """Between two samples that are two seconds apart a vehicle heaves as it likes: seven of 206 rows were four times as
    loud, and followed the roll."""
    given = streams(seconds=120.0, dvl_rate=1.0, gnss_rate=1.0)
    time, velocity = given["reference"]
    lost = np.isin(np.arange(len(time)), [30, 31, 70])

    def stamps(*reference):
        streams = recorded(given | {"reference": reference})
        return make_problem([streams], np.eye(3), np.zeros(3), [Offsets()]).grids[0].stamps

    whole, less = stamps(time, velocity), stamps(time[~lost], velocity[~lost])
    assert len(whole) >= 100 and 1 <= len(whole) - len(less) <= 6
    assert all(np.abs(less - at).min() > 0.5 for at in time[lost])
    # of a fast stream its neighbours tell it
    fast = streams(seconds=120.0, dvl_rate=5.0, gnss_rate=5.0)
    assert Curve(*fast["dvl"]).part(np.arange(len(fast["dvl"][0])) != 100).is_complete_at(fast["dvl"][0][5:-5]).all()


@pytest.mark.parametrize("delay_s", [0.0, 0.4])
def test_a_slow_dvl_on_a_rolling_vehicle_is_interpolated_in_the_earths_frame(delay_s):
    """In waves of 3.3 s it rolls and pitches between two samples at 1 Hz; its velocity over ground hardly changes."""
    mounting, arm = Rotation.from_euler("xyz", [0.1, -0.2, 0.8]).as_matrix(), np.array([-0.6, 0.2, -0.3])
    every_second, between, turn = np.arange(0.0, 200.0), np.arange(2.5, 197.0), 1e-3

    def attitude(time):
        wave = 2.0 * np.pi * time / 3.3
        return Rotation.from_euler("ZYX", np.column_stack([0.01 * time, 0.1 * np.sin(wave), 0.2 * np.cos(wave)]))

    def rates(time):
        return (attitude(time - turn).inv() * attitude(time + turn)).as_rotvec() / (2.0 * turn)

    def earth(time):
        return np.column_stack([1.5 + 0.002 * time, 0.3 * np.cos(0.05 * time), 0.0 * time])

    def dvl(time):
        return (attitude(time).inv().apply(earth(time)) + np.cross(rates(time), arm)) @ mounting.T

    time = np.arange(-1.0, 201.0, 0.1)
    recording = make_recording(
        "waves",
        (every_second + delay_s, dvl(every_second)),
        (every_second, earth(every_second)),
        attitude=(time, attitude(time).as_quat()),
        rates=(time, rates(time)),
    )
    curve = make_problem([recording], mounting, arm, [Offsets(delay_s)]).recordings[0].dvl
    of_curve = curve(between + delay_s), curve.smooth(between + delay_s)
    assert np.abs(of_curve - dvl(between)).max() < 0.005
    ahead, behind = dvl(between + 0.01), dvl(between - 0.01)
    assert np.abs(curve.derivative(between + delay_s) - (ahead - behind) / 0.02).max() < 0.03


def test_of_a_fit_that_is_far_off_nothing_is_taken_for_an_outlier(rng):
    """All of a lopsided axis was one, divided by the share of none: a null with heavy tails broke the diagnosis."""
    residual = 0.01 * rng.standard_normal((200, 2)) + [0.0, 0.2]
    residual[7, 0] = 0.5
    robust = white_noise(residual, (slice(0, 200),), None).robust(residual)
    np.testing.assert_allclose(robust[:, 1], residual[:, 1])
    assert np.abs(robust[:, 0]).max() < 0.04


def test_an_outlier_does_not_shift_the_level_of_slow_noise():
    """Its innovation was winsorised, those after it were not: a current that comes and goes, by heavy tails alone."""
    rng, n = np.random.default_rng(4), 400
    arma = Arma(np.array([0.95]), -0.75, 1.0, float(np.sqrt(1.0 + 0.2**2 / (1.0 - 0.95**2))))
    noise = Noise((slice(0, n),), None, np.ones((n, 1)), (arma,))
    sound = noise.unwhiten(rng.standard_normal(n))
    hit = sound.copy()
    hit[200] += 60.0
    column = noise.whiten(np.ones((n, 1)) * (np.arange(n) >= 195)[:, None])

    def step(series):
        return float(column @ noise.whiten(series) / (column @ column))

    assert abs(step(noise.robust(hit)) - step(noise.robust(sound))) < 0.15 * abs(step(hit) - step(sound))
    deviations = arma.deviations(sound[:, 0], noise.segments)
    assert np.std(deviations[5:-5]) == pytest.approx(1.0, rel=0.15)


def test_an_event_is_whitened_from_the_bins_about_it_alone(rng):
    arma = Arma(np.array([0.95]), -0.6, 0.02, 1.5)
    noise = Noise((slice(0, 150), slice(150, 400)), None, rng.uniform(0.5, 2.0, (400, 3)), (arma,) * 3)
    event, about = np.zeros((400, 3)), slice(139, 164 + noise.memory_samples)
    event[140:164] = rng.normal(size=(24, 3))
    whole = noise.whiten(event).reshape(400, 3)
    np.testing.assert_allclose(noise.part(about).whiten(event[about]).reshape(-1, 3), whole[about], atol=1e-9)
    assert about.stop < 250
    np.testing.assert_allclose(whole[about.stop :], 0.0, atol=1e-9)


def test_a_sample_with_an_absurd_claim_does_not_decide_alone():
    """It had five million times the weight of the others."""
    rng = np.random.default_rng(0)
    true = np.exp(rng.normal(0.0, 1.0, (900, 1)))
    claims = np.repeat(np.log(true), 3, axis=1)[:, :, None]
    claims[6] -= 9.0
    level = relative_std(claims, rng.normal(size=(900, 3)) * true, ["dvl"], np.arange(900) // 20)
    assert np.ptp(level) > 0.0 and level.min() >= np.exp(-4.0)
