"""Clocks are compared by so many messages as are enough, however long a recording is."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.replay.clocks import MOST, _Spread


@pytest.mark.parametrize("sizes", [[10], [MOST, 1], [MOST + 1], [3, 4096, 7, 4096] * 40, [1] * 20_000])
def test_of_many_numbers_every_so_many_th_is_kept(sizes):
    spread, numbers, first = _Spread(), np.arange(sum(sizes)), 0
    for size in sizes:
        spread.add(numbers[first : first + size])
        first += size
    every = int(np.diff(spread.kept)[0])
    np.testing.assert_array_equal(spread.kept, numbers[::every])
    assert len(spread.kept) <= MOST and (every == 1 or len(spread.kept) >= MOST // 2)
