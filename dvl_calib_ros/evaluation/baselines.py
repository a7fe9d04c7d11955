"""What was done before: the rotation between DVL and body by least squares on SO(3), beside the models.

Kinsey and Whitcomb, "In situ alignment calibration of attitude and Doppler sensors for precision underwater vehicle
navigation: theory and experiment" (2007), align displacements: what the DVL integrates to against positions. Troni and
Whitcomb, "New velocity-based algorithms for the in situ calibration of Doppler velocity log sensors" (2010), align
velocities. Either is the rotation C that minimises Σ |g_i - C v_i|², found by a singular value decomposition (Wahba's
problem). They estimate no scale, have no prior, and claim no σ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..calibration.frames import Array, nearest_rotation


def troni_whitcomb(time: Array, measured: Array, reference: Array) -> Array:
    """From velocities (..., N, 3) m/s."""
    return nearest_rotation(np.swapaxes(reference, -1, -2) @ measured)


def kinsey_whitcomb(time: Array, measured: Array, reference: Array) -> Array:
    """From displacements since the start: of velocities (..., N, 3) m/s, at times (N,) s.

    In the body frame, where the misalignment is constant; the reference's positions are its integrated velocity.
    """
    step = np.diff(time, prepend=time[:1])[:, None]
    return troni_whitcomb(time, np.cumsum(measured * step, axis=-2), np.cumsum(reference * step, axis=-2))


BASELINES: Mapping[str, Callable[[Array, Array, Array], Array]] = {
    "Kinsey-Whitcomb": kinsey_whitcomb,
    "Troni-Whitcomb": troni_whitcomb,
}
