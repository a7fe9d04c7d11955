"""How often, and for how long, the DVL sent nothing."""

from __future__ import annotations

import numpy as np

from ..numerics.samples import Stamps
from .clock_correction import SECOND_NS

# A DVL that sends nothing for so long, and for so many times its shortest interval, has dropped out.
DROPOUT_NS = SECOND_NS
DROPOUT_INTERVALS = 3
_NEVER_NS = 2**63 - 1


class Dropouts:
    """Those since the start or the last restart. longest_ns: of them."""

    def __init__(self) -> None:
        self.longest_ns = 0
        self._shortest_interval_ns = _NEVER_NS

    def add(self, interval_ns: Stamps) -> int:
        """Take the intervals (N,) between samples, in order; how many of them are dropouts."""
        if not len(interval_ns):
            return 0
        if interval_ns.max() <= DROPOUT_NS:
            self._shortest_interval_ns = min(self._shortest_interval_ns, int(interval_ns.min()))
            return 0
        shortest_ns = np.minimum(np.minimum.accumulate(interval_ns), self._shortest_interval_ns)
        self._shortest_interval_ns = int(shortest_ns[-1])
        dropouts = interval_ns[(interval_ns > DROPOUT_NS) & (interval_ns > DROPOUT_INTERVALS * shortest_ns)]
        if len(dropouts):
            self.longest_ns = max(self.longest_ns, int(dropouts.max()))
        return len(dropouts)
