"""The calibrator as its users see it: what it does with order, frames, gaps, garbage and switches."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from conftest import searched
from hypothesis import example, given
from hypothesis import strategies as st
from runs import (
    ONE_HERTZ,
    SECOND,
    START_NS,
    MatchedRun,
    altered,
    calibrate,
    feed,
    make_samples,
    only,
    pushed,
    shifted,
    variant,
    without,
)

from dvl_calib_ros.calibration.assessment.model_selection import Evidence, Selection
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.checks.data_warnings import recording_warnings
from dvl_calib_ros.calibration.filters import filter_bank
from dvl_calib_ros.calibration.models import BY_VELOCITY, LINEAR_MODELS, MODELS
from dvl_calib_ros.calibration.models.parameters import SCHEMA, ParameterError, Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.calibration.streams.aligner import counts_by_use

PHI, SCALE = (2e-5, -3e-5, 4e-5), 3e-5
EXACT = MatchedRun(phi=PHI, scale=SCALE)
NOISY = MatchedRun(phi=(0.02, -0.03, 0.04), scale=0.004, dvl_std=0.01, gnss_std=0.1, gnss_phase=7, seconds=60)
# the matched run holds its depth exactly, which would pass for a receiver without a vertical velocity
WIDE = Parameters(initial_std_misalignment=1.0, initial_std_scale=0.5, gnss_aided_std=1e-3, gnss_axes="xyz")
SPARSE = variant(NOISY, **ONE_HERTZ)  # for what is tried sample by sample
AIDED = [name for name in BY_VELOCITY if MODELS[name].aided]


def with_m1(samples, parameters=WIDE) -> Calibrator:
    """With this model alone, where it is what a test looks at: all of them cost four times as much."""
    return calibrate(samples, parameters, models=("M1",))


def assert_same(a: Calibrator, b: Calibrator, atol=0.0, names=BY_VELOCITY):
    for name in names:
        np.testing.assert_allclose(a.state(name).x, b.state(name).x, rtol=0, atol=atol)
        np.testing.assert_allclose(a.state(name).p, b.state(name).p, rtol=0, atol=atol)
    assert a.selection.segments == b.selection.segments


# ---------------------------------------------------------------- what comes out


@pytest.mark.parametrize("names", [("M1",), ("unaided",), ("full",), ("M3", "M7")], ids=" ".join)
def test_a_model_without_the_others_is_what_it_is_among_them(names, one_by_one):
    samples = make_samples(variant(NOISY, seconds=30))
    alone = calibrate(samples, models=names, verified=True)
    assert (
        [*alone.result().estimates]
        == [*alone.result().verifications]
        == [name for name in BY_VELOCITY if name in names]
    )
    for name in names:
        np.testing.assert_allclose(alone.state(name).x, one_by_one.state(name).x, rtol=0, atol=1e-12)
        np.testing.assert_allclose(alone.state(name).p, one_by_one.state(name).p, rtol=0, atol=1e-12)
    assert alone.counts == one_by_one.counts


def test_what_no_model_needs_any_more_is_forgotten():
    samples = make_samples(variant(NOISY, seconds=600, dvl_every=100, gnss_every=100))
    alone, all_of_them = calibrate(samples, models=("M1",)), calibrate(samples)
    for one, other in ((each.reference, each.imu) for each in (alone._aligner, all_of_them._aligner)):
        assert one.size - one.begin < 300 and other.size - other.begin < 6000
    assert alone._aligner.rows.size <= all_of_them._aligner.rows.size


@pytest.mark.parametrize(
    ("frame", "mounting"),
    [
        (VelocityFrame.BODY, (0.1, -0.2, 0.8)),
        (VelocityFrame.ENU, (0, 0, 0)),
        (VelocityFrame.ENU, (0.1, -0.2, 0.8)),
        (VelocityFrame.NED, (np.pi, 0, 0.3)),
    ],
)
def test_gnss_models_recover_the_errors_from_a_reference_in_any_frame(frame, mounting):
    run = variant(EXACT, frame=frame, mounting_rpy=mounting, imu_every=1)
    names = ("M1", "M3")
    calibrator = calibrate(make_samples(run), WIDE.replace(mounting_rpy=mounting), models=names)
    for name in names:
        np.testing.assert_allclose(calibrator.state(name).x, [*PHI, SCALE], atol=2e-7)


def test_a_lever_arm_is_compensated_with_the_angular_velocity():
    run = variant(EXACT, lever_arm=(2.0, -0.5, 1.0), imu_every=1)
    bent = with_m1(make_samples(run), WIDE)
    straight = with_m1(make_samples(run), WIDE.replace(lever_arm=run.lever_arm))
    np.testing.assert_allclose(straight.state("M1").x, [*PHI, SCALE], atol=1e-7)
    assert np.abs(bent.state("M1").x - [*PHI, SCALE]).max() > 1e-3
    unknown = with_m1(only(make_samples(run), DvlSample, ReferenceSample), WIDE.replace(lever_arm=run.lever_arm))
    assert unknown.counts["dvl"]["lever_arm_uncompensated"] == unknown.counts["dvl"]["usable"]


@pytest.mark.parametrize("late_s", [3.4, -3.4])
def test_streams_late_by_seconds_are_paired_once_that_is_said_even_beyond_the_latency(late_s):
    samples = make_samples(EXACT)
    names = {DvlSample: "dvl_time_offset", ReferenceSample: "reference_time_offset", ImuSample: "imu_time_offset"}
    expected = with_m1(samples, WIDE)
    for kind, name in names.items():
        right = with_m1(shifted(samples, round(late_s * 1e9), kind), WIDE.replace(**{name: late_s}))
        assert right.counts["pairing"] == expected.counts["pairing"], name
        np.testing.assert_allclose(right.state("M1").x, expected.state("M1").x, atol=1e-9)


@pytest.mark.parametrize("frame", [VelocityFrame.ENU, VelocityFrame.NED])
def test_an_earth_fixed_error_of_the_reference_is_taken_off_in_its_own_frame(frame):
    added = (0.3, -0.2, 0.0) if frame is VelocityFrame.ENU else (-0.2, 0.3, 0.0)
    run = variant(EXACT, frame=frame, imu_every=1)
    off = pushed(make_samples(run), ReferenceSample, lambda _: added)
    expected = with_m1(make_samples(run), WIDE)
    right = with_m1(off, WIDE.replace(reference_velocity_offset=(0.3, -0.2)))
    np.testing.assert_allclose(right.state("M1").x, expected.state("M1").x, atol=1e-9)
    assert np.abs(with_m1(off, WIDE).state("M1").x - expected.state("M1").x).max() > 1e-3


def test_a_dvl_clock_that_drifts_and_jumps_is_put_right():
    samples = make_samples(EXACT)
    first_ns = next(sample.stamp_ns for sample in samples if isinstance(sample, DvlSample))
    jump_at_ns = first_ns + 30_000_000_000

    def stamped(sample):
        if not isinstance(sample, DvlSample):
            return sample
        # the drift is a share of what the clock itself shows, the jump with it
        jump_ns = 700_000_000 * (sample.stamp_ns >= jump_at_ns)
        return sample._replace(stamp_ns=first_ns + round((sample.stamp_ns - first_ns + jump_ns) / (1.0 - 1e-3)))

    clock = {"dvl_clock_drift": 1e-3, "dvl_time_jump": 0.7, "dvl_time_jump_at": 1e-9 * jump_at_ns}
    wrong = with_m1(list(map(stamped, samples)), WIDE)
    right = with_m1(list(map(stamped, samples)), WIDE.replace(**clock))
    error, error_as_stamped = (np.abs(each.state("M1").x - [*PHI, SCALE]).max() for each in (right, wrong))
    assert error < 1e-7 and error_as_stamped > 10.0 * error, (error, error_as_stamped)


def test_message_covariances_are_turned_into_the_dvl_frame_and_added():
    run = variant(NOISY, gnss_phase=0, mounting_rpy=(0, 0, np.pi / 2))
    own, gnss = np.diag([1e-4, 2e-4, 3e-4]), np.diag([0.01, 0.04, 0.09])
    samples = altered(altered(make_samples(run), DvlSample, covariance=own), ReferenceSample, covariance=gnss)
    parameters = Parameters(mounting_rpy=run.mounting_rpy, gate_probability=0.0)
    calibrator = with_m1(samples, parameters)
    t = parameters.rotation_dvl_from_body
    weight = np.linalg.inv(t @ gnss @ t.T + own)  # = diag(0.04, 0.01, 0.09) + own

    def row(velocity, reference):
        g = t @ reference
        return np.column_stack([[0, g[2], -g[1]], [-g[2], 0, g[0]], [g[1], -g[0], 0], -g]), g - velocity

    assert_least_squares(calibrator, samples, weight, row)


def assert_least_squares(calibrator: Calibrator, samples, weight, row):
    """M1 is that of weighted least squares with the prior. row: velocity and reference -> H, z."""
    information, right = np.diag([1 / 0.05**2] * 3 + [1 / 0.006**2]), np.zeros(4)
    references = {s.stamp_ns: s.velocity for s in only(samples, ReferenceSample)}
    for sample in only(samples, DvlSample):
        if sample.stamp_ns in references:
            h, z = row(np.array(sample.velocity), np.array(references[sample.stamp_ns]))
            information += h.T @ weight @ h
            right += h.T @ weight @ z
    np.testing.assert_allclose(calibrator.state("M1").x, np.linalg.solve(information, right), atol=1e-12)
    np.testing.assert_allclose(calibrator.state("M1").p, np.linalg.inv(information), atol=1e-12)


def test_a_covariance_is_used_only_where_it_is_given_and_wanted():
    samples = make_samples(NOISY)
    claimed = altered(samples, ReferenceSample, covariance=np.eye(3) * 1e-4)
    ignored = calibrate(claimed, Parameters(use_message_covariance=False, gate_probability=0))
    plain = calibrate(samples, Parameters(gate_probability=0))
    assert_same(ignored, plain)
    assert calibrate(claimed, Parameters(gate_probability=0)).state("M1").p[2, 2] < 0.1 * plain.state("M1").p[2, 2]


# ---------------------------------------------------------------- order, blocks, switching


@searched(12)
@given(seed=st.integers(0, 2**32 - 1), frame=st.sampled_from(list(VelocityFrame)))
def test_the_order_in_which_topics_arrive_does_not_matter(seed, frame):
    """Each topic in its own order, but lagging the others by up to 0.9 s: the same to the last bit."""
    run = variant(NOISY, frame=frame, seconds=30)
    parameters = Parameters(lever_arm=(1.0, 0.0, 0.5), gnss_hysteresis=1.0)
    samples = without(make_samples(run), ReferenceSample, lambda at: 10 < at < 18)
    expected = calibrate(samples, parameters)
    source = random.Random(seed)
    lag = {kind: source.uniform(0, 0.9) for kind in (DvlSample, ReferenceSample, ImuSample)}
    jitter = {kind: 0.0 for kind in lag}
    arrivals = []
    for sample in samples:
        kind = type(sample)
        arrival = sample.stamp_ns / SECOND + lag[kind] * source.random()
        jitter[kind] = max(jitter[kind], arrival)  # a topic keeps its own order
        arrivals.append((jitter[kind], len(arrivals), sample))
    shuffled = calibrate([sample for _, _, sample in sorted(arrivals)], parameters)
    assert_same(shuffled, expected)
    assert shuffled.counts["pairing"] == expected.counts["pairing"]


@pytest.fixture(scope="module")
def one_by_one():
    return calibrate(make_samples(variant(NOISY, seconds=30)), block_size=1)


def test_switching_models_at_any_time_equals_having_run_that_model_from_the_start():
    samples = make_samples(SPARSE)
    switched = Calibrator(Parameters(model="M1"))
    source = random.Random(4)
    for at, sample in enumerate(samples):
        feed(switched, [sample])
        if at % 50 == 0:
            name = source.choice(BY_VELOCITY)
            switched.set_parameters(switched.parameters.replace(model=name))
            from_start = calibrate(samples[: at + 1], Parameters(model=name), block_size=1)
            assert switched.selected == from_start.selected == name
            np.testing.assert_array_equal(switched.estimate().state, from_start.estimate().state)
            np.testing.assert_array_equal(switched.estimate().covariance, from_start.estimate().covariance)


def test_auto_keeps_the_calibration_by_the_reference_when_the_reference_ends():
    """A vehicle that dives lost its scale, and roll, to the model without a reference."""
    run = variant(NOISY, seconds=100, gnss_phase=0)
    dive = without(make_samples(run), ReferenceSample, lambda at: at > 60)
    calibrator = calibrate(dive)
    assert [segment.model for segment in calibrator.selection.segments] == ["unaided", "full"]
    assert calibrator.result().selected_because.numbers["why"].code == "CALIBRATION_KEPT"
    for block_size in (1, 30):
        assert calibrate(dive, block_size=block_size).selection.segments == calibrator.selection.segments


def test_auto_does_not_keep_a_calibration_that_is_known_no_longer():
    selection, stamps_ns = Selection(), SECOND * np.arange(1, 11)
    selection.take(3 * SECOND, Evidence(is_known=True))
    selection.take(6 * SECOND, Evidence())
    selection.update(stamps_ns, np.zeros(10, dtype=bool), Parameters())
    assert [(each.from_ns // SECOND, each.model) for each in selection.segments] == [
        (1, "unaided"), (3, "full"), (6, "unaided")
    ]  # fmt: skip


def test_auto_does_not_keep_what_few_references_tell():
    """Five seconds of a noisy receiver are no calibration, so the model without a reference is back in the dive."""
    run = variant(NOISY, seconds=100, gnss_phase=0, gnss_std=1.0)
    dive = without(make_samples(run), ReferenceSample, lambda at: at > 5)
    assert [segment.model for segment in calibrate(dive).selection.segments] == ["unaided", "full", "unaided"]


@pytest.mark.parametrize(
    ("given", "expected"), [({}, ("M7", "M3")), ({"gnss_model": "M4", "gnss_free_model": "M5"}, ("M5", "M4"))]
)
def test_iac_is_the_published_selection_with_timeout_and_hysteresis(given, expected):
    run = variant(NOISY, seconds=100, gnss_phase=0)
    outage = without(make_samples(run), ReferenceSample, lambda at: 40 <= at < 60)
    auto, iac = (calibrate(outage, Parameters(model=model, **given)) for model in ("auto", "iac"))
    assert [segment.model for segment in iac.selection.segments] == [*expected, *expected]
    at = [(segment.from_ns - START_NS) / SECOND for segment in iac.selection.segments]
    # lost 2 s after 39.8 s (the first sample beyond is at 42.0), then 3 s of hysteresis; back 3 s after 60 s
    np.testing.assert_allclose(at, [0.0, 3.0, 45.0, 63.0], atol=1e-6)
    assert iac.result().selected_because.sentence == "iac: GNSS is available"
    for name in BY_VELOCITY:  # what is selected changes no estimate
        np.testing.assert_array_equal(iac.state(name).x, auto.state(name).x)


def test_a_flapping_receiver_does_not_flap_the_output():
    run = variant(NOISY, seconds=100, gnss_phase=0)
    flapping = without(make_samples(run), ReferenceSample, lambda at: at % 8 < 5)
    segments = calibrate(flapping, Parameters(gnss_hysteresis=6.0)).selection.segments
    assert [segment.model for segment in segments] == ["unaided", "full"]


# ---------------------------------------------------------------- pairing


def test_dvl_samples_without_a_reference_around_them_are_counted_as_unpaired():
    samples = make_samples(variant(NOISY, seconds=30, gnss_phase=0))
    calibrator = calibrate(without(samples, ReferenceSample, lambda at: 10 < at < 20))
    pairing = calibrator.counts["pairing"]
    assert pairing["unpaired"] == 49  # 10.2 .. 19.8 at 5 Hz
    assert pairing["paired"] == calibrator.estimate("M1").used + calibrator.estimate("M1").gated == 101
    assert calibrator.estimate("M7").used == 150


def test_an_earth_frame_reference_without_attitude_is_not_used_and_counted():
    calibrator = calibrate(only(make_samples(variant(NOISY, frame=VelocityFrame.ENU)), DvlSample, ReferenceSample))
    counts = calibrator.counts
    assert counts["pairing"]["paired"] == 0
    assert counts["pairing"]["without_attitude"] > 280
    assert calibrator.estimate("M3").used == 0
    assert calibrator.selected == "unaided"


def test_a_fast_dvl_does_not_make_more_of_a_slow_reference_than_there_is():
    """20 DVL samples share the noise of each GNSS sample: σ must be that of the GNSS samples, not 4.5 times smaller."""
    slow = calibrate(make_samples(variant(NOISY, seconds=150, dvl_every=100, gnss_every=100, gnss_phase=0)))
    fast = calibrate(make_samples(variant(NOISY, seconds=150, dvl_every=5, gnss_every=100, gnss_phase=0)))
    assert fast.estimate("M3").used == pytest.approx(20 * slow.estimate("M3").used, rel=0.05)
    np.testing.assert_allclose(fast.estimate("M3").std, slow.estimate("M3").std, rtol=0.05)


# ---------------------------------------------------------------- what is not used


BAD = [
    DvlSample(START_NS + 1, (float("nan"), 0.0, 0.0)),
    DvlSample(START_NS + 2, (1.0, float("inf"), 0.0)),
    DvlSample(START_NS + 3, (1.0, 0.0, 0.0), np.diag([1e-4, -1.0, 1e-4])),
    DvlSample(START_NS + 4, (1.0, 0.0, 0.0), np.full((3, 3), np.nan)),
    DvlSample(START_NS + 5, (11.0, 0.0, 0.0)),
    DvlSample(START_NS + 6, (1.0, 0.0, 0.0), np.ones((3, 3))),
    DvlSample(START_NS + 7, (1e308, 1e308, 0.0)),
]


def test_invalid_samples_are_dropped_counted_and_without_effect():
    samples = make_samples(NOISY)
    spoiled = calibrate([*BAD, ImuSample(samples[0].stamp_ns, (np.nan,) * 4, (np.nan,) * 3), *samples], block_size=1)
    assert_same(spoiled, calibrate(samples, block_size=1))
    assert spoiled.counts["dvl"]["invalid"] == len(BAD)
    assert spoiled.counts["imu"]["invalid"] == 1


@pytest.mark.parametrize("variance", [0.0, 1e-310, 5e-324])
def test_a_zero_or_denormal_covariance_means_not_given(variance):
    samples = make_samples(NOISY)
    zero = altered(samples, (DvlSample, ReferenceSample), covariance=np.eye(3) * variance)
    assert_same(calibrate(zero), calibrate(samples))


def test_slow_samples_are_not_used():
    run = variant(NOISY, trajectory="box", seconds=200)
    calibrator = calibrate(make_samples(run), Parameters(min_speed=1.2))
    counts = calibrator.counts["dvl"]
    assert 0 < counts["slow"] < counts["accepted"]
    assert calibrator.estimate("M7").used == counts["usable"]


def test_samples_in_turns_are_not_used_and_none_without_a_turn_rate():
    samples = make_samples(NOISY)
    gated = calibrate(samples, Parameters(max_turn_rate=0.05)).counts["dvl"]
    assert 0 < gated["turning"] < gated["accepted"]
    blind = calibrate(only(samples, DvlSample, ReferenceSample), Parameters(max_turn_rate=0.05)).counts["dvl"]
    # the last ones are still waiting for an IMU that may only be late
    assert blind["no_turn_rate"] + blind["awaiting_imu"] == blind["accepted"] > 0


def test_an_outlier_is_gated_and_changes_nothing():
    samples = make_samples(NOISY)
    position = next(i for i, s in enumerate(samples) if i > 500 and isinstance(s, ReferenceSample))
    spoiled = [*samples]
    spoiled[position] = samples[position]._replace(velocity=(-3.0, 4.0, 1.0))
    hit, clean = calibrate(spoiled), calibrate(samples)
    for name in AIDED:
        assert hit.estimate(name).gated >= clean.estimate(name).gated + 1
        assert np.abs(hit.state(name).x - clean.state(name).x).max() < 0.3 * clean.estimate(name).std.max()


@searched(20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 50]))
def test_at_any_time_each_dvl_sample_that_came_is_in_one_place(seed, block_size):
    source, restarted = random.Random(seed), []
    calibrator = Calibrator(
        Parameters(max_turn_rate=source.choice([0.0, 0.5]), lever_arm=source.choice([(0.0,) * 3, (1.0, 0.0, 0.0)])),
        block_size=block_size,
        on_restart=lambda: restarted.append(True),
    )
    at, sent, steps = START_NS, 0, [SECOND // 5] * 12 + [0, -SECOND, 3 * SECOND, 10**12, -(10**12)]

    def where(name: str) -> dict[str, int]:
        estimate = calibrator.estimate(name)
        given = calibrator.n_given(name)
        return counts_by_use(calibrator.counts, MODELS[name].needs, given, estimate.used, estimate.gated)

    for _ in range(400):
        at += source.choice(steps)
        velocity = (source.choice([1.5, 1.5, 1.2, 0.0, float("nan")]), source.choice([0.1, 0.0, 2.0]), 0.0)
        kind, restarted[:] = source.randrange(7), []
        if kind == 0:
            calibrator.refuse("dvl", "wrong_frame")
        elif kind < 4:
            calibrator.feed_dvl(DvlSample(at, velocity))
        elif kind < 6:
            frame = source.choice([VelocityFrame.BODY, VelocityFrame.BODY, VelocityFrame.ENU])
            calibrator.feed_reference(ReferenceSample(at, velocity, None, frame))
        else:
            calibrator.feed_imu(ImuSample(at, (0.0, 0.0, 0.0, 1.0), source.choice([None, (0.0, 0.0, 0.1)])))
        sent += kind < 4
        sent = 2 if restarted else sent  # the two that showed it
        for name in source.sample([model.name for model in LINEAR_MODELS], 2):
            found = where(name)
            assert sum(found.values()) == sent and min(found.values()) >= 0
    # what can still come has come: nothing waits but for a sample that confirms the last one's stamp
    for step in range(1, 30):
        calibrator.feed_dvl(DvlSample(at + step * SECOND, (1.5 + 0.01 * step, 0.0, 0.0)))
        calibrator.feed_reference(ReferenceSample(at + step * SECOND, (1.5, 0.0, 0.0)))
        calibrator.feed_imu(ImuSample(at + step * SECOND, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.1)))
    for name in ("M1", "M3", "M7", "unaided"):
        found = where(name)
        assert found["gathered"] == 0 and found["waiting"] <= 1, (name, found)


# ---------------------------------------------------------------- restarts


@pytest.mark.parametrize("leader", [DvlSample, ReferenceSample, ImuSample])
def test_a_bag_that_loops_starts_the_calibration_anew_whichever_topic_jumps_first(leader):
    samples = make_samples(variant(NOISY, frame=VelocityFrame.ENU))
    told: list[str] = []
    looped = calibrate(samples, on_event=told.append)
    first = [s for s in samples if isinstance(s, leader)][:3]  # they arrive before the others' first
    feed(looped, first + [s for s in samples if s not in first])
    assert looped.counts["calibration"]["restarts"] == 1
    assert "starts anew" in told[0]
    expected = calibrate(first + [s for s in samples if s not in first])
    # of the first block of `full` streams that had not gone back yet lack a sample or two
    assert_same(looped, expected, atol=1e-12, names=[name for name in BY_VELOCITY if name != "full"])
    off = looped.state("full").x - expected.state("full").x
    assert np.all(np.abs(off) < 0.5 * np.sqrt(np.diag(expected.state("full").p)))


def test_reset_forgets_everything():
    samples = make_samples(NOISY)
    calibrator = calibrate(samples)
    calibrator.reset()
    assert_same(calibrator, Calibrator(Parameters()))
    assert_same(feed(calibrator, samples), calibrate(samples))


@pytest.mark.parametrize("kinds", [(DvlSample,), (DvlSample, ReferenceSample)])
def test_rows_that_nobody_will_have_are_not_kept_for_models_of_streams_that_do_not_come(kinds):
    """Without an IMU the node grew by half a kilobyte with each sample, for a model that waited for attitudes."""
    run = variant(NOISY, seconds=1200.0, frame=VelocityFrame.BODY, imu_every=0)
    calibrator = calibrate(only(make_samples(run), *kinds), block_size=512)
    assert calibrator.counts["dvl"]["accepted"] > 5000
    rows = calibrator._aligner.rows
    assert rows.size - rows.begin < 3000


def test_rows_of_a_fast_dvl_do_not_wait_for_the_headings_to_be_judged():
    """Once in ten seconds they are, which at 1000 Hz was 5 MB."""
    samples = [DvlSample(START_NS + i * 1_000_000, (1.5, 0.1, 0.0)) for i in range(9_500)]
    calibrator = feed(Calibrator(Parameters(), block_size=512), samples)
    assert calibrator.counts["dvl"]["accepted"] == len(samples)
    assert calibrator._aligner.rows.size - calibrator._aligner.rows.begin < 4000


# ---------------------------------------------------------------- priors


def test_an_initial_window_gives_m5_and_m6_the_mean_of_the_dvls_own_sway_and_heave():
    samples = make_samples(variant(NOISY, trajectory="straight"))
    calibrator = calibrate(samples, Parameters(prior_source="initial_window", prior_window=10.0))
    first = np.array([s.velocity for s in only(samples, DvlSample)[:50]])
    np.testing.assert_allclose(calibrator._aligner.partners.prior.sway_heave, first.mean(axis=0)[1:], atol=1e-12)
    assert calibrator.estimate("M5").used + calibrator.estimate("M5").gated == 250
    assert calibrator.estimate("M7").used == 300
    given_it = calibrate(
        only(samples, DvlSample)[50:],
        Parameters(prior_source="fixed", prior_sway_heave=tuple(calibrator._aligner.partners.prior.sway_heave)),
    )
    np.testing.assert_allclose(calibrator.state("M5").x, given_it.state("M5").x, atol=1e-12)


def test_process_noise_lets_old_samples_fade():
    fixed = calibrate(make_samples(NOISY))
    walking = calibrate(make_samples(NOISY), Parameters(process_std_misalignment=1e-3, process_std_scale=1e-4))
    assert (walking.estimate("M1").std > fixed.estimate("M1").std).all()


# ---------------------------------------------------------------- convergence


def test_a_straight_run_does_not_show_roll_and_the_operator_is_told_what_to_fly():
    entries = calibrate(make_samples(variant(NOISY, trajectory="straight"))).estimate("M3").observability
    roll, pitch, yaw, _ = entries
    assert (roll.observed, pitch.observed, yaw.observed) == (False, True, True)
    assert "turns" in roll.missing and not yaw.missing


def test_a_dvl_at_45_degrees_lacks_roll_not_pitch_on_a_straight_leg():
    run = variant(NOISY, trajectory="straight", mounting_rpy=(0, 0, np.pi / 4))
    estimate = calibrate(make_samples(run), Parameters(mounting_rpy=run.mounting_rpy)).estimate("M3")
    assert [entry.axis for entry in estimate.observability] == ["roll", "roll", "yaw", "scale"]
    assert [entry.observed for entry in estimate.observability[:3]] == [False, False, True]


def test_convergence_goes_from_collecting_over_coarse_to_fine():
    samples = make_samples(variant(NOISY, trajectory="straight", seconds=150, gnss_std=0.02))
    parameters = Parameters(gnss_aided_std=0.02, target_drift=4.0)
    calibrator = Calibrator(parameters, block_size=64)
    seen = [calibrator.estimate("M3").convergence.value]
    for start in range(0, len(samples), 50):
        feed(calibrator, samples[start : start + 50])
        state = calibrator.estimate("M3").convergence.value
        if state != seen[-1]:
            seen.append(state)
    assert seen == ["collecting", "coarse", "fine"]


def test_what_other_topics_still_bring_from_before_a_restart_is_not_paired_with_what_comes_after():
    samples = make_samples(variant(NOISY, frame=VelocityFrame.ENU))
    first = only(samples, DvlSample)[:3]
    rest = [s for s in samples if s not in first]
    late = only(samples[-60:], ReferenceSample, ImuSample)
    looped = calibrate([s for s in samples if s not in late] + first + late + rest)
    assert_same(looped, calibrate(first + rest), atol=1e-12)
    counts = looped.counts
    assert counts["reference"]["before_restart"] + counts["imu"]["before_restart"] == len(late)


# ---------------------------------------------------------------- faults of one stream


def test_a_reference_whose_clock_is_far_ahead_does_not_cost_the_attitude():
    """It would say of every DVL sample that nothing can come for it any more, however late the IMU is."""
    samples = make_samples(variant(NOISY, gnss_phase=0))
    imu_last = sorted(samples, key=lambda s: (s.stamp_ns, isinstance(s, ImuSample)))
    ahead = shifted(imu_last, 3600 * SECOND, ReferenceSample)
    assert_same(calibrate(ahead), calibrate(only(samples, DvlSample, ImuSample)))


def test_a_velocity_repeated_more_than_max_repeats_times_is_not_used():
    samples = make_samples(NOISY)
    dvl = only(samples, DvlSample)
    held = {s.stamp_ns for s in dvl[100:120]}
    frozen = altered(samples, DvlSample, velocity=lambda s: (dvl[99] if s.stamp_ns in held else s).velocity)
    assert calibrate(frozen).counts["dvl"]["repeated"] == 20
    counts = calibrate(frozen, Parameters(max_repeats=2)).counts["dvl"]
    assert (counts["repeated"], counts["frozen"], counts["usable"]) == (20, 18, len(dvl) - 18)


def test_a_dropout_is_longer_than_a_second_and_than_the_rate_explains():
    every_2_s = make_samples(variant(NOISY, dvl_every=200))
    assert calibrate(every_2_s).counts["dvl"]["dropouts"] == 0
    assert calibrate(without(make_samples(NOISY), DvlSample, lambda at: 10 < at < 11)).counts["dvl"]["dropouts"] == 0
    calibrator = calibrate(without(make_samples(NOISY), DvlSample, lambda at: 10 < at < 11.1))
    assert calibrator.counts["dvl"]["dropouts"] == 1
    assert calibrator.longest_dropout_ns == 1_200_000_000


# ---------------------------------------------------------------- axes that the reference does not measure


def with_vertical(samples, value, covariance=None):
    """The samples with another vertical velocity of the reference."""
    return [
        s._replace(velocity=(*s.velocity[:2], value(i)), covariance=covariance) if isinstance(s, ReferenceSample) else s
        for i, s in enumerate(samples)
    ]


HORIZONTAL = np.diag([0.01, 0.01, -1.0])


@pytest.mark.parametrize("frame", VelocityFrame)
def test_what_a_reference_says_of_an_axis_that_it_does_not_measure_changes_nothing(frame):
    samples = make_samples(variant(NOISY, frame=frame, imu_every=4))
    found = []
    for value, variance in ((lambda i: 0.0, -1.0), (lambda i: 5.0 * np.sin(i), 1e6), (lambda i: -3.0, 1e300)):
        calibrator = calibrate(with_vertical(samples, value, np.diag([0.01, 0.01, variance])), verified=True)
        found.append(calibrator)
        assert calibrator.estimate("M1").used > 250
    for other in found[1:]:
        assert_same(found[0], other, atol=1e-13)
        for name in AIDED:
            one, two = found[0].verification(name).held_out, other.verification(name).held_out
            assert one.corrected == pytest.approx(two.corrected, rel=1e-9)


def test_the_axes_that_are_measured_give_the_information_that_two_rows_have():
    """M1 in the body frame, mounted straight: weighted least squares on the horizontal rows alone."""
    samples = with_vertical(make_samples(variant(NOISY, gnss_phase=0)), lambda i: 0.3, HORIZONTAL)
    calibrator = calibrate(samples, Parameters(gate_probability=0.0))

    def row(velocity, reference):
        (x, y, _), z = reference, velocity[2]  # the best that is known of it
        return np.array([[0.0, -z, y, -x], [z, 0.0, -x, -y]]), reference[:2] - velocity[:2]

    assert_least_squares(calibrator, samples, np.eye(2) / (0.01 + 0.025**2), row)


def test_a_vertical_velocity_of_exactly_zero_does_not_count_until_one_is_not():
    samples = make_samples(NOISY)
    level = with_vertical(samples, lambda _: 0.0)
    auto = calibrate(level)
    assert_same(auto, calibrate(level, Parameters(gnss_axes="xy")))
    assert auto.estimate("M1").std[1] > 3.0 * calibrate(level, Parameters(gnss_axes="xyz")).estimate("M1").std[1]
    later = with_vertical(samples, lambda i: 0.0 if i < 700 else 0.01)
    assert calibrate(later).estimate("M1").std[1] < 0.5 * auto.estimate("M1").std[1]


# ---------------------------------------------------------------- no number may kill


@st.composite
def covariances(draw) -> np.ndarray | None:
    """Definite with deviations of 1e-9 .. 1e9 m/s and any correlation, mostly; else any nine numbers, or none."""
    kind = draw(st.sampled_from(["definite", "definite", "definite", "any", "none"]))
    if kind == "none":
        return None
    if kind == "any":
        return np.array(draw(st.lists(st.floats(), min_size=9, max_size=9))).reshape(3, 3)
    below = np.tril(np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))).reshape(3, 3), -1)
    root = below + np.eye(3) * draw(st.sampled_from([1.0, 1e-3, 1e-6]))
    root *= (np.array(draw(st.tuples(*[st.sampled_from([1e-9, 1e-6, 1e-3, 0.1, 1.0, 30.0, 1e9])] * 3))))[:, None]
    return root @ root.T


@st.composite
def settings_inside_their_bounds(draw) -> dict:
    """Some parameters, each anywhere inside its bounds, often on one."""
    values = {}
    for name in draw(st.lists(st.sampled_from(sorted(SCHEMA)), max_size=8, unique=True)):
        spec = SCHEMA[name]
        number = st.sampled_from([spec.low, spec.high]) | st.floats(spec.low or 0.0, spec.high or 0.0)
        if spec.choices:
            values[name] = draw(st.sampled_from(spec.choices))
        elif spec.kind == "bool":
            values[name] = draw(st.booleans())
        elif spec.kind == "double":
            values[name] = draw(number)
        elif spec.kind == "double_array":
            values[name] = tuple(draw(number) for _ in range(spec.length))
    return values


INDEFINITE = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@example({"gate_probability": 3.7e-233}, [], VelocityFrame.BODY, 1)
@example({}, [(DvlSample, 2, INDEFINITE)], VelocityFrame.ENU, 64)
@example({}, [(ReferenceSample, 2, 0.1 * INDEFINITE)], VelocityFrame.BODY, 1)
@example(
    {}, [(DvlSample, 2, np.diag([np.inf, 1.0, 1.0])), (ReferenceSample, 2, 0.5 * INDEFINITE)], VelocityFrame.NED, 7
)
@example(  # roll hardly bound by the prior nor shown: Newton's method ran away
    {"gnss_aided_std": 1e-4, "motion_std": 1e-4, "initial_std_misalignment": 1.0}, [], VelocityFrame.BODY, 64
)
@example(  # references that say of every axis that they do not measure it
    {"gnss_axes": "xy"}, [(ReferenceSample, 2, np.diag([1000.0, 1000.0, 0.0]))], VelocityFrame.BODY, 1
)
@searched(40)
@given(
    given_values=settings_inside_their_bounds(),
    claimed=st.lists(
        st.tuples(st.sampled_from([DvlSample, ReferenceSample]), st.integers(2, 40), covariances()), max_size=3
    ),
    frame=st.sampled_from(VelocityFrame),
    block_size=st.sampled_from([1, 7, 64]),
)
def test_any_parameters_inside_their_bounds_with_any_covariances_leave_every_state_finite_and_every_variance_positive(
    given_values, claimed, frame, block_size
):
    try:
        parameters = Parameters(**given_values)
    except ParameterError:  # two that do not go together
        return
    samples = make_samples(variant(NOISY, frame=frame, imu_every=1, seconds=12))
    for kind, every, covariance in claimed:
        spoilt = {id(sample) for sample in only(samples, kind)[::every]}
        samples = [sample._replace(covariance=covariance) if id(sample) in spoilt else sample for sample in samples]
    try:
        calibrator = calibrate(samples, parameters, block_size=block_size, verified=True)
    except ParameterError:  # a prior that needs a recording
        assert parameters.prior_source == "reference"
        return
    check_finite(calibrator)
    for name in BY_VELOCITY:
        assert np.linalg.eigvalsh(calibrator.state(name).p)[0] > 0.0, name
    if not given_values:  # what is no covariance is kept out, and not left to the gate or the last guard
        assert not any(name.endswith("restarted") for name in calibrator.counts["calibration"])
        for kind, _, covariance in claimed[-1:]:
            if covariance is not None and is_indefinite(covariance):
                assert calibrator.counts["dvl" if kind is DvlSample else "reference"]["invalid"] > 0


def is_indefinite(covariance: np.ndarray) -> bool:
    """Of measured variances that are given, and by far not definite."""
    variances = np.diag(covariance)
    given = np.isfinite(covariance).all() and variances.min() > 1e-9 and variances.max() < 1e3
    return given and np.linalg.eigvalsh(covariance + covariance.T)[0] < -1e-6 * variances.max()


def test_a_model_whose_numbers_run_away_goes_on_from_its_last_good_state_and_is_counted(monkeypatch):
    samples = make_samples(NOISY)
    calibrator = calibrate(samples[:900])
    before, used = calibrator.state("M1"), calibrator.estimate("M1").used
    linearise = MODELS["M1"].linearise
    monkeypatch.setitem(
        MODELS["M1"].__dict__, "linearise", lambda seen: tuple(np.nan * each for each in linearise(seen))
    )
    feed(calibrator, samples[900:1000])
    calibrator.estimate("M1")
    monkeypatch.undo()
    counts = calibrator.counts["calibration"]
    assert counts["M1 restarted"] > 0
    restarted = {"model": "M1", "count": counts["M1 restarted"]}
    assert [each.numbers for each in recording_warnings(calibrator.counts) if each.code == "MODEL_RESTARTED"] == [
        restarted
    ]
    np.testing.assert_array_equal(calibrator.state("M1").x, before.x)
    feed(calibrator, samples[1000:])
    assert calibrator.estimate("M1").used > used
    check_finite(calibrator)


@pytest.mark.parametrize(
    "poison",
    [lambda x, p: (np.nan * x, p), lambda x, p: (x, np.inf * p), lambda x, p: (x, -p)],
    ids=["no number", "no bound", "variances below zero"],
)
def test_a_state_that_no_solver_objects_to_and_is_none_is_not_gone_on_from(poison, monkeypatch):
    samples = make_samples(NOISY)
    calibrator = calibrate(samples[:900])
    before = {name: calibrator.state(name).x for name in ("M1", "M3")}
    filtered = filter_bank._filtered

    def poisoned(*given):
        after = filtered(*given)
        x, p = poison(after.x, after.p)
        return replace(after, x=x, p=p)

    monkeypatch.setattr(filter_bank, "_filtered", poisoned)
    feed(calibrator, samples[900:1000])
    for name, x in before.items():
        np.testing.assert_array_equal(calibrator.state(name).x, x)
        assert calibrator.counts["calibration"][f"{name} restarted"] > 0
    monkeypatch.undo()
    feed(calibrator, samples[1000:])
    assert np.abs(calibrator.state("M1").x - before["M1"]).max() > 0.0
    check_finite(calibrator)


def check_finite(calibrator: Calibrator):
    for name, estimate in calibrator.result().estimates.items():
        assert np.isfinite(estimate.state).all() and np.isfinite(estimate.covariance).all(), name
        assert (np.diag(estimate.covariance) > 0.0).all(), name


def test_what_a_sample_before_the_first_of_the_imu_lacks_is_no_warning():
    """22 of 30 sound recordings warned of one sample without turn rates."""
    counts = Calibrator(Parameters()).counts
    for lacking, codes in ((1, []), (12, ["REFERENCE_NO_ATTITUDE", "LEVER_ARM_NOT_COMPENSATED"])):
        counts["dvl"] |= {"received": 1000, "accepted": 1000, "usable": 1000, "lever_arm_uncompensated": lacking}
        counts["pairing"]["without_attitude"] = lacking
        assert [each.code for each in recording_warnings(counts) if each.code != "DVL_NO_REFERENCE"] == codes
