from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvl_calib_ros.calibration.streams.stream_order import Order, Sequencer, Track

SECOND = 1_000_000_000


class Sample(NamedTuple):
    stamp_ns: int


def admit_all(seconds, max_jump=10.0):
    sequencer: Sequencer[Sample] = Sequencer(round(max_jump * SECOND))
    orders, through = [], []
    for at in seconds:
        order, admitted = sequencer.admit(Sample(round(at * SECOND)))
        orders.append(order)
        through += [sample.stamp_ns / SECOND for sample in admitted]
    return orders, through, sequencer


def test_duplicates_and_late_samples_are_told_apart_and_dropped():
    orders, through, _ = admit_all([1, 2, 2, 1.5, 3])
    assert orders == [Order.NEXT, Order.NEXT, Order.DUPLICATE, Order.OUT_OF_ORDER, Order.NEXT]
    assert through == [1, 2, 3]


@pytest.mark.parametrize("stray", [-1e5, 1e9])
def test_one_wrong_stamp_is_dropped_and_the_timeline_goes_on(stray):
    _, through, sequencer = admit_all([1, 2, stray, 3, 4])
    assert through == [1, 2, 3, 4]
    assert sequencer.stray == 1


def test_a_gap_is_believed_with_the_second_sample_after_it_and_loses_none():
    orders, through, _ = admit_all([1, 2, 600, 601, 602])
    assert orders[2:] == [Order.HELD, Order.CONFIRMED_GAP, Order.NEXT]
    assert through == [1, 2, 600, 601, 602]


def test_time_that_goes_back_and_stays_there_is_a_restart():
    orders, through, _ = admit_all([100, 101, 1, 2, 3])
    assert orders[2:] == [Order.HELD, Order.CONFIRMED_RESTART, Order.NEXT]
    assert through == [100, 101, 1, 2, 3]


@given(st.lists(st.integers(-50, 50).map(lambda x: x * 1.7), max_size=60))
def test_every_sample_is_let_through_dropped_or_held_and_order_is_kept_between_restarts(seconds):
    orders, through, sequencer = admit_all(seconds)
    dropped = sum(order in (Order.DUPLICATE, Order.OUT_OF_ORDER) for order in orders)
    assert len(through) + dropped + sequencer.stray + (sequencer.held is not None) == len(seconds)
    restarts = sum(order is Order.CONFIRMED_RESTART for order in orders)
    assert sum(b <= a for a, b in pairwise(through)) == restarts


def track(*seconds, gap=2.0, latency=1.0):
    made = Track(round(gap * SECOND), round(latency * SECOND), 10 * SECOND)
    for at in seconds:
        made.stamps_ns[made.extend(1)] = round(at * SECOND)
        made.forget_old()
    return made


def bracket(made, at):
    found = made.bracket(round(at * SECOND))
    if found is None:
        return None
    before, after = (made.stamps_ns[slot] / SECOND for slot in found[:2])
    return (None if found.before < 0 else before), after, found.fraction


def test_a_time_between_two_samples_is_bracketed_by_them():
    assert bracket(track(1, 2, 3), 2.25) == (2, 3, 0.25)


def test_a_time_at_a_sample_needs_no_other():
    assert bracket(track(2), 2) == (None, 2, 1.0)
    assert bracket(track(1, 2), 2) == (1, 2, 1.0)


@pytest.mark.parametrize("at", [0.5, 3.1, 10])
def test_nothing_is_extrapolated(at):
    assert bracket(track(1, 2, 3), at) is None


def test_a_gap_that_is_too_long_is_not_interpolated_across():
    assert bracket(track(1, 3.01), 2) is None
    assert bracket(track(1, 3), 2) == (1, 3, 0.5)


def test_a_sample_waits_for_its_partner_no_longer_than_it_can_still_come():
    made = track(10)
    seconds = lambda at, horizon: made.decided(round(at * SECOND), round(horizon * SECOND))  # noqa: E731
    assert seconds(9.5, 9.5)  # the partner's stream is past it
    assert not seconds(10.5, 12.9)  # one at 12.0 would still bracket it, and may be a second late
    assert seconds(10.5, 13.0)
    assert not seconds(20, 20.9)  # only one at 20 exactly could, a second late
    assert seconds(20, 21)


def test_without_any_partner_only_the_latency_is_waited_for():
    assert not track().decided(0, SECOND - 1)
    assert track().decided(0, SECOND)


def test_the_past_is_forgotten_so_that_memory_stays_flat():
    made = track(*(0.01 * i for i in range(20000)))
    assert len(made.stamps_ns) < 5000
    assert bracket(made, 199.985) is not None
