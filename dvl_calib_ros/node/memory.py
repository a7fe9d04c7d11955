"""Memory that goes back to the system once it is free.

What glibc learns from arrays that come and go is to keep their room, and small ones that stay then cut it into pieces:
a node's memory climbs for hours although it holds no more than at the start.
"""

from __future__ import annotations

import ctypes

# Of `mallopt` (3). Set, they stay what they are: glibc raises them otherwise with the largest array that is given back.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# Arrays of at least so many bytes have memory of their own: what comes with each message is smaller.
LARGE = 1 << 17


def give_back_at_once() -> bool:
    """Have large arrays be given back to the system when they are freed; False where that cannot be asked for."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # no glibc
        return False
    return all(mallopt(what, LARGE) for what in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))
