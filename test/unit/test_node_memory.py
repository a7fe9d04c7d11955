"""That the node gives memory back: in a process of its own, as what is asked for holds for all of it."""

from __future__ import annotations

import subprocess
import sys

_WORK = """
import numpy as np
from dvl_calib_ros.node.main import give_back_at_once

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096

asked = give_back_at_once()
assert asked
before, stays = resident(), []
np.ones(3_000_000)  # from here on glibc keeps what is smaller, unless told otherwise
for _ in range(200):
    held = [np.ones(100_000) for _ in range(10)]
    stays.append(bytes(3000))
    del held
print(resident() - before)
"""


def test_what_large_arrays_took_goes_back_whatever_small_ones_stay():
    done = subprocess.run([sys.executable, "-c", _WORK], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 2_000_000
