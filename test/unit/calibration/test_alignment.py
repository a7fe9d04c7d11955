"""The alignment: one by one and in columns, cut anywhere, whatever comes in whatever order."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from conftest import searched
from hypothesis import example, given
from hypothesis import strategies as st
from runs import SECOND, START_NS, feed

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import FRAMES, AlignedBlock, Covariances, Stream, Streams, sample_block

# Absolutely, and of σ: where the gate rejects most of what comes, the last bit has grown to 1.3e-9 of σ.
STATES_EQUAL, OF_SIGMA = 1e-12, 1e-8


# ---------------------------------------------------------------- hostile data


def garbage(rng: np.random.Generator, values, share):
    """Values of which some are what no sensor should send."""
    bad = rng.choice([np.nan, np.inf, -np.inf, 1e308, 1e6, 0.0, -0.0], values.shape)
    return np.where(rng.random(values.shape) < share, bad, values)


def stamps_of(rng: np.random.Generator, n, interval_s, unruly):
    """Stamps that mostly go on; unruly: share of those that repeat, go back, leap or restart."""
    steps = np.full(n, interval_s * SECOND)
    leaps = rng.choice([0.0, -0.3, 3.0, 7.0, 40.0, -40.0, 1e8], n) * SECOND
    stray = rng.random(n) < 0.3
    leap = np.where(rng.random(n) < unruly, leaps, 0.0)
    return (START_NS + np.cumsum(steps + np.where(stray, 0.0, leap)) + np.where(stray, leap, 0.0)).astype(np.int64)


def covariances(rng: np.random.Generator, n):
    kinds = np.array([np.eye(3) * v for v in (1e-4, 0.04, 0.0, -1.0, np.nan, 1e-310, 1e308)])
    kinds[3] = np.diag([0.01, 0.02, -1.0])
    kinds = np.concatenate([kinds, [np.diag([0.01, 0.01, 1e5]), np.diag([1e4, 0.01, 0.02])]])
    return Covariances(kinds, np.where(rng.random(n) < 0.1, rng.integers(-1, len(kinds), n), rng.integers(-1, 2)))


def hostile_streams(seed, unruly, lag_s, seconds=30.0) -> Streams:
    """Three streams at rates of their own, each in its own order, lagging the others by up to lag_s."""
    rng = np.random.default_rng(seed)
    blocks = []
    for stream in Stream:
        interval_s = rng.choice([0.05, 0.2, 1.0, 3.0]) if rng.random() < 0.9 else 1e3
        n = max(1, round(seconds / interval_s))
        stamps = stamps_of(rng, n, interval_s, unruly * rng.random()) + rng.integers(0, SECOND // 20) * rng.integers(
            0, 2
        )
        arrival = np.maximum.accumulate(START_NS + np.arange(n) * interval_s * SECOND)
        arrival = np.maximum.accumulate(arrival + rng.random(n) * lag_s * SECOND * rng.random())
        if stream is Stream.IMU:
            values = rng.normal([0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0], [*[0.5] * 4, *[0.1] * 3], (n, 7))
            values[:, :4] /= np.linalg.norm(values[:, :4], axis=1)[:, None]
        else:
            values = rng.normal([1.0, 0.1, 0.0], 0.2, (n, 3))
            values[rng.random(n) < 0.3] = [1.2, 0.0, 0.0]  # driver hangs
            if rng.random() < 0.3:
                values[: n // 2, 2] = 0.0
        values = garbage(rng, values, rng.choice([0.0, 0.02]))
        frames = np.full(n, rng.integers(0, len(FRAMES)), dtype=np.uint8)
        frames = np.where(rng.random(n) < rng.choice([0.0, 0.05]), rng.integers(0, len(FRAMES), n), frames)
        blocks.append(
            (stream, stamps, values, covariances(rng, n), frames.astype(np.uint8), arrival, rng.random(n) < 0.03)
        )
    order = np.argsort(np.concatenate([each[5] for each in blocks]), kind="stable")
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    made, first = [], 0
    for stream, stamps, values, covariance, frames, arrival, refused in blocks:
        made.append(
            sample_block(
                stream, stamps, values, covariance=covariance, frames=frames, refused=refused.astype(np.uint8),
                arrival=place[first : first + len(arrival)], reasons=("no_bottom",),
            )
        )  # fmt: skip
        first += len(arrival)
    return Streams(*made)


def pieces(streams: Streams, size: int):
    """The streams in stretches of so many messages."""
    n = sum(map(len, streams))
    for start in range(0, n, size):
        yield Streams(*(b.part((b.arrival >= start) & (b.arrival < start + size)) for b in streams))


def fed(calibrator, streams: Streams, size: int | None):
    """One by one (None), or in stretches."""
    if size is None:
        for stream, row in streams.in_order():
            if isinstance(row, str):
                calibrator.refuse(stream.value, row)
            else:
                feed(calibrator, [row])
    else:
        for piece in pieces(streams, size):
            calibrator.feed(piece)
    return calibrator


class Kept:
    """Collects aligned rows; after a restart anew."""

    def __init__(self):
        self.blocks: list[AlignedBlock] = []

    def __call__(self, block: AlignedBlock):
        self.blocks.append(block)

    def column(self, name):
        return np.concatenate([getattr(block, name) for block in self.blocks])


def check_same(one: Calibrator, one_rows: Kept, other: Calibrator, other_rows: Kept):
    a, b = one.counts, other.counts
    assert a == b, {(g, k): (v, b[g].get(k)) for g in a for k, v in a[g].items() if v != b[g].get(k)}
    assert one.selection.segments == other.selection.segments
    assert (one.first_ns, one.last_ns, one.newest_ns) == (other.first_ns, other.last_ns, other.newest_ns)
    assert one.longest_dropout_ns == other.longest_dropout_ns
    assert bool(one_rows.blocks) == bool(other_rows.blocks)
    for each in fields(AlignedBlock) if one_rows.blocks else ():
        a, b = one_rows.column(each.name), other_rows.column(each.name)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12, equal_nan=True, err_msg=each.name)
    for name in MODELS:
        a, b = one.estimate(name), other.estimate(name)
        assert (a.used, a.gated) == (b.used, b.gated), name
        std = np.sqrt(np.diag(b.covariance))
        assert (np.abs(a.state - b.state) <= STATES_EQUAL + OF_SIGMA * std).all(), (name, a.state - b.state)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=OF_SIGMA, atol=STATES_EQUAL, err_msg=name)


def test_what_others_say_at_a_row_is_where_it_lies_between_their_samples():
    at = START_NS + np.array([0, 1, 2, 3, 4]) * SECOND
    rows_ns = START_NS + np.array([SECOND // 4, SECOND, 2 * SECOND + 3 * SECOND // 4])
    reference = np.column_stack([1.0 + np.arange(5.0) ** 2, np.zeros(5), np.zeros(5)])
    yaw = 0.1 * np.arange(5.0)
    imu = np.column_stack([np.zeros(5), np.zeros(5), np.sin(yaw / 2), np.cos(yaw / 2), *[np.zeros(5)] * 2, 2.0 * yaw])
    streams = Streams(
        sample_block(Stream.DVL, rows_ns, np.array([[1.5, 0.1, 0.0]] * 3) + 0.01 * np.arange(3)[:, None]),
        sample_block(Stream.REFERENCE, at, reference),
        sample_block(Stream.IMU, at, imu),
    ).arriving_by_stamp()
    for size in (None, 1, 100):
        rows = Kept()
        parameters = Parameters(gnss_timeout=2.0, imu_timeout=2.0)
        fed(Calibrator(parameters, on_rows=rows, block_size=1), streams, size).finish()
        np.testing.assert_allclose(rows.column("reference")[:, 0], [1.25, 2.0, 5.0 + 0.75 * 5.0], rtol=1e-12)
        attitude = rows.column("attitude")
        np.testing.assert_allclose(2.0 * np.arctan2(attitude[:, 2], attitude[:, 3]), [0.025, 0.1, 0.275], rtol=1e-9)
        np.testing.assert_allclose(attitude[:, 6], [0.05, 0.2, 0.55], rtol=1e-12)


OPTIONS = (
    {},
    {"max_turn_rate": 0.1, "lever_arm": (1.0, -0.5, 0.3)},
    {"max_repeats": 1.0, "max_latency": 0.1, "min_speed": 0.9},
    {"prior_source": "initial_window", "dvl_time_offset": 0.4, "gnss_axes": "xy", "imu_timeout": 0.3},
    {"gnss_timeout": 0.5, "imu_time_offset": 0.1, "dvl_clock_drift": 0.001, "max_time_jump": 30.0},
)


@searched(30)
@given(
    seed=st.integers(0, 2**32 - 1),
    unruly=st.sampled_from([0.0, 0.01, 0.2]),
    lag_s=st.sampled_from([0.0, 0.9, 5.0, 60.0]),
    size=st.sampled_from([1, 7, 70, 512, 10_000]),
    options=st.sampled_from(OPTIONS),
)
@example(seed=3844923, unruly=0.0, lag_s=60.0, size=70, options={})  # an IMU that runs away from a DVL which lags
@example(
    seed=3844923, unruly=0.01, lag_s=60.0, size=10_000, options={}
)  # stamps leap by years, full still needs before
@example(seed=2416835433, unruly=0.01, lag_s=0.9, size=1, options=OPTIONS[4])
@example(seed=33890, unruly=0.01, lag_s=0.9, size=512, options={})  # a reference's stamps go back
def test_columns_cut_anywhere_give_what_one_by_one_gives(seed, unruly, lag_s, size, options):
    streams, parameters = hostile_streams(seed, unruly, lag_s), Parameters(gnss_hysteresis=1.0, **options)
    found = []
    for cut, block_size in ((None, 1), (size, 64)):
        rows = Kept()
        calibrator = fed(
            Calibrator(parameters, on_rows=rows, on_restart=rows.blocks.clear, block_size=block_size), streams, cut
        )
        calibrator.finish()
        found += [calibrator, rows]
    check_same(*found)
