"""Published models M1-M7: Yampolsky and Klein, "Information-Aided DVL Calibration".

M1, M2 are its baselines; M3, M4 are IAC-G; M5-M7 are IAC-GF. All hold in any right-handed frame with x ahead.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ..numerics.frames import skew
from .base import SHOWN_WITH_GNSS, SHOWN_WITHOUT, Linearised, Model, Needs, Observations


def _gnss_aided(
    scale_axes: tuple[tuple[str, tuple[int, ...]], ...], heave_is_zero: bool, observed: Observations
) -> Linearised:
    """Linearise M1-M4: z = r - v, H = [r×, -r on the scaled axes]."""
    r, r_skew = observed.reference_without_heave if heave_is_zero else observed.reference
    h = np.zeros((len(r), 3, 3 + len(scale_axes)))
    h[:, :, :3] = r_skew
    for column, (_, axes) in enumerate(scale_axes, start=3):
        for axis in axes:
            h[:, axis, column] = -r[:, axis]
    return r - observed.velocity_dvl, h


def _m5(observed: Observations) -> Linearised:
    """Linearise M5: z = r - v, H = [r×], r = T (‖v‖, s, h)."""
    r = observed.speed_and_prior @ observed.rotation_dvl_from_body.T
    return r - observed.velocity_at_reference, skew(r)


def _m6(observed: Observations) -> Linearised:
    """Linearise M6: z = (‖v‖, s, h) - Tᵀv, H = Tᵀ[v×], body frame."""
    z = observed.speed_and_prior - observed.velocity_in_body
    return z, observed.body_from_measured


def _m7(observed: Observations) -> Linearised:
    """Linearise M7: z = ‖v‖ - (Tᵀv)_x, H = first row of Tᵀ[v×]."""
    z = observed.speed - observed.velocity_in_body[:, 0]
    return z[:, None], observed.body_from_measured[:, :1]


_ONE_SCALE = (("delta_k", (0, 1, 2)),)
_SCALE_X = (("delta_k_x", (0,)),)
_NOISY_REGRESSOR = "slow, or a noisy receiver: scale too small by"


def _aided(
    name: str, scale_axes: tuple[tuple[str, tuple[int, ...]], ...], heave_is_zero: bool, assumes: str, wrong_when: str
) -> Model:
    """Return a model with a reference velocity: misalignment, and one scale state per entry of scale_axes."""
    return Model(
        name,
        Needs.REFERENCE,
        3,
        partial(_gnss_aided, scale_axes, heave_is_zero),
        SHOWN_WITH_GNSS,
        assumes,
        wrong_when,
        scale_axes,
        vertical_from_reference=not heave_is_zero,
    )


PUBLISHED = (
    _aided(
        "M1", _ONE_SCALE, False,
        assumes="GNSS velocity in three axes; one scale error for all axes (published baseline)",
        wrong_when=f"{_NOISY_REGRESSOR} 3 σ²/‖v‖² (3 % at 2 m/s and 0.2 m/s)",
    ),
    _aided(
        "M2", _SCALE_X, False,
        assumes="GNSS velocity in three axes; scale error along x only (published baseline)",
        wrong_when=f"{_NOISY_REGRESSOR} σ²/‖v‖²; with the DVL's x far from the direction of travel",
    ),
    _aided(
        "M3", _ONE_SCALE, True,
        assumes="horizontal GNSS velocity, no heave; one scale error for all axes",
        wrong_when=f"heaving in waves or diving; {_NOISY_REGRESSOR} 2 σ²/‖v‖²",
    ),
    _aided(
        "M4", _SCALE_X, True,
        assumes="horizontal GNSS velocity, no heave; scale error along x only",
        wrong_when=f"heaving in waves or diving; {_NOISY_REGRESSOR} σ²/‖v‖²; with the DVL's x far from the travel",
    ),
    Model(
        "M5", Needs.NOTHING, 3, _m5, SHOWN_WITHOUT, needs_prior=True,
        assumes="no GNSS; the vehicle moves ahead at the measured speed with known, constant sway and heave",
        wrong_when="a current or turns make sway; prior sway and heave from the DVL itself already hold the error",
    ),
    Model(
        "M6", Needs.NOTHING, 3, _m6, SHOWN_WITHOUT, needs_prior=True,
        assumes="as M5, compared in the body frame with the measured velocity as regressor",
        wrong_when="as M5",
    ),
    Model(
        "M7", Needs.NOTHING, 1, _m7, SHOWN_WITHOUT,
        assumes="no GNSS, nothing else known: all the speed is ahead",
        wrong_when="a current or turns make sway; by construction it finds half the angle, and its σ is too small",
    ),
)  # fmt: skip
