"""Error measures of a calibration, and the least-squares rotation on SO(3) as a baseline.

Kinsey and Whitcomb, "In situ alignment calibration of attitude and Doppler sensors for precision underwater vehicle
navigation: theory and experiment" (2007), align displacements: the integrated DVL against positions. Troni and
Whitcomb, "New velocity-based algorithms for the in situ calibration of Doppler velocity log sensors" (2010), align
velocities. Both compute the rotation C that minimises Σ |g_i - C v_i|² by a singular value decomposition (Wahba's
problem). They have no scale, no prior, and no σ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..calibration.numerics.distributions import normal_isf
from ..calibration.numerics.frames import Array, nearest_rotation
from .results import Coverage


def troni_whitcomb(time: Array, measured: Array, reference: Array) -> Array:
    """Fit the rotation to velocities (..., N, 3) m/s."""
    return nearest_rotation(np.swapaxes(reference, -1, -2) @ measured)


def kinsey_whitcomb(time: Array, measured: Array, reference: Array) -> Array:
    """Fit the rotation to displacements since the start, from velocities (..., N, 3) m/s at times (N,) s.

    This uses the body frame, in which the misalignment is constant; positions are the integrated reference velocity.
    """
    step = np.diff(time, prepend=time[:1])[:, None]
    return troni_whitcomb(time, np.cumsum(measured * step, axis=-2), np.cumsum(reference * step, axis=-2))


BASELINES: Mapping[str, Callable[[Array, Array, Array], Array]] = {
    "Kinsey-Whitcomb": kinsey_whitcomb,
    "Troni-Whitcomb": troni_whitcomb,
}


# two-sided intervals of a normal distribution
WITHIN_68, WITHIN_95 = (float(normal_isf(0.5 - 0.5 * share)) for share in (0.68, 0.95))


@dataclass(frozen=True)
class RunMoments:
    """Second moments of measured velocities v and true ones g of ... runs, sufficient for every VRMSE.

    They are for whole runs, many corrections, and a true velocity with all axes. `calibration.folds.Moments` sums by
      fold, with references that may lack axes.
    vv: E[v vᵀ] (..., 3, 3).
    gv: E[g vᵀ] (..., 3, 3).
    gg: E[gᵀg] (...,). (m/s)².
    """

    vv: Array
    gv: Array
    gg: Array

    @staticmethod
    def of(measured: Array, truth: Array) -> RunMoments:
        """Compute from measured (..., N, 3) and true (N, 3) velocities, m/s."""
        n = len(truth)
        transposed = np.swapaxes(measured, -1, -2)
        vv, vg = transposed @ measured / n, transposed @ truth / n
        gg = np.full(measured.shape[:-2], np.sum(truth * truth) / n)
        return RunMoments(vv, np.swapaxes(vg, -1, -2), gg)

    @staticmethod
    def stack(each: Sequence[RunMoments]) -> RunMoments:
        """Stack several runs along a new first axis."""
        return RunMoments(*(np.stack([getattr(one, name) for one in each]) for name in ("vv", "gv", "gg")))


def vrmse(moments: RunMoments, correction: Array) -> Array:
    """Return sqrt(E‖g - C v‖²) (...,) m/s of velocities corrected by matrices C (..., 3, 3); shapes broadcast.

    E‖g - C v‖² = E[gᵀg] - 2 tr(C E[g vᵀ]ᵀ) + tr(C E[v vᵀ] Cᵀ), so a correction costs a few products instead of a pass
    over the samples.
    """
    linear = 2.0 * moments.gv - correction @ moments.vv
    mean_square = moments.gg - np.sum(correction * linear, axis=(-2, -1))
    return np.sqrt(np.maximum(mean_square, 0.0))  # rounding may make a perfect correction negative


def heading_spread(rotation_enu_from_body: Array) -> float:
    """Return the circular standard deviation of the heading, rad, of attitudes (N, 3, 3)."""
    from scipy.stats import circstd

    forward = rotation_enu_from_body[:, :2, 0]
    return float(circstd(np.arctan2(forward[:, 1], forward[:, 0])))


def coverage(model: str, state_names: Sequence[str], errors: Array, std: Array) -> Coverage:
    """Return the coverage of errors (N, n), estimate - truth, by their claimed standard deviations (N, n)."""
    inside_68: NDArray[Any] = np.abs(errors) <= WITHIN_68 * std
    inside_95: NDArray[Any] = np.abs(errors) <= WITHIN_95 * std
    return Coverage(
        model=model,
        state_names=tuple(state_names),
        within_68=inside_68.mean(axis=0),
        within_95=inside_95.mean(axis=0),
        pooled_68=float(inside_68.mean()),
        pooled_95=float(inside_95.mean()),
        n_errors=len(errors),
        mean_error=errors.mean(axis=0),
        rms_error=np.sqrt((errors**2).mean(axis=0)),
        mean_std=std.mean(axis=0),
        normalised_rms=float(np.sqrt(np.mean((errors / std) ** 2))),
    )
