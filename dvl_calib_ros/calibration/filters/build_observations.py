"""Observations of models from aligned samples: rotations, lever arm, noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ..models import Needs
from ..models.base import Assumptions, Observations, Unmeasured
from ..models.parameters import Parameters
from ..numerics.frames import ENU_FROM_NED, Array, rotation_from_quaternion, skew
from ..numerics.samples import AXIS_BITS, FRAME_CODES, AlignedBlock, Codes, Mask, VelocityFrame
from .state_history import Numbers

_BODY, _NED = FRAME_CODES[VelocityFrame.BODY], FRAME_CODES[VelocityFrame.NED]
# Attitude (4) and angular velocity (3) of rows that have none
_UNKNOWN = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
# Mask of the rows of a block that meet each need
ROWS_WITH: Mapping[Needs, Callable[[AlignedBlock], Mask]] = {
    Needs.NOTHING: lambda block: block.usable,
    Needs.ATTITUDE: lambda block: block.oriented,
    Needs.ATTITUDE_IF_KNOWN: lambda block: block.usable,
    Needs.REFERENCE: lambda block: block.paired,
}


class Observer:
    """Builder of `Observations` with the constants of the parameters."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._assumptions = Assumptions(*(getattr(parameters, name) for name in Assumptions._fields))
        self._lever_arm = skew(parameters.lever_arm) if any(parameters.lever_arm) else None
        self._aided_noise: Array = np.eye(3)[None] * parameters.gnss_aided_std**2
        self._unaided_noise: Array = np.eye(3)[None] * parameters.gnss_free_std**2

    def observe(self, block: AlignedBlock, needs: Needs, sway_heave: Array) -> Observations:
        """Return the observations of rows that meet these needs. sway_heave: (2,) m/s, prior of M5 and M6."""
        lever = None
        if self._lever_arm is not None:
            lever = np.nan_to_num(block.attitude[:, 4:]) @ self._lever_arm  # ω×l; zero where ω is unknown
        rotation_dvl_from_body = self._parameters.rotation_dvl_from_body
        mounting_and_prior = (rotation_dvl_from_body, sway_heave)
        interval = 1e-9 * block.interval_ns
        if needs is not Needs.REFERENCE:
            attitude = None if needs is Needs.NOTHING else np.where(block.oriented[:, None], block.attitude, _UNKNOWN)
            return Observations(
                block.velocity_dvl, None, lever, *mounting_and_prior, self._unaided_noise,
                None if attitude is None else rotation_from_quaternion(attitude[:, :4]),
                None if attitude is None else attitude[:, 4:], interval, assumptions=self._assumptions,
                oriented=None if attitude is None else block.oriented,
            )  # fmt: skip
        rotation, earth_in_body = _reference_in_body(block)
        reference = block.reference[:, :3]
        unmeasured = None
        if block.unmeasured.any():
            axes = (block.unmeasured[:, None] & AXIS_BITS) != 0
            from_body = np.broadcast_to(np.eye(3), (len(block), 3, 3)) if rotation is None else rotation.swapaxes(1, 2)
            unmeasured = Unmeasured(axes, from_body)
            expected = block.velocity_dvl @ rotation_dvl_from_body
            expected = expected if lever is None else expected - lever
            reference = np.where(axes, np.einsum("nij,nj->ni", from_body, expected), reference)
        return Observations(
            block.velocity_dvl,
            reference if rotation is None else np.einsum("nij,nj->ni", rotation, reference),
            lever,
            *mounting_and_prior,
            self._paired_noise(block, rotation),
            interval=interval,
            assumptions=self._assumptions,
            unmeasured=unmeasured,
            earth_in_body=earth_in_body,
        )

    def _paired_noise(self, block: AlignedBlock, rotation_body_from_reference: Array | None) -> Array:
        """Return R of the aided models (N or 1, 3, 3): T R_gnss Tᵀ + R_dvl where the messages give them."""
        reference = block.reference[:, 3:].reshape(-1, 3, 3)
        is_given = ~np.isnan(reference[:, 0, 0])
        if not self._parameters.use_message_covariance or not is_given.any():
            return self._aided_noise
        rotation = self._parameters.rotation_dvl_from_body
        rotation = rotation if rotation_body_from_reference is None else rotation @ rotation_body_from_reference
        dvl_noise = np.where(np.isnan(block.covariance), self._unaided_noise, block.covariance)
        noise: Array = rotation @ reference @ np.swapaxes(rotation, -1, -2) + dvl_noise
        return noise if is_given.all() else np.where(is_given[:, None, None], noise, self._aided_noise)


def _reference_in_body(block: AlignedBlock) -> tuple[Array | None, Array | None]:
    """Return rotation_body_from_reference (N, 3, 3), and `Observations.earth_in_body` (N, 3, 2).

    None, None if all references are in the body frame.
    """
    frames: Codes = block.frames
    if not frames.any():  # 0 is the body frame
        return None, None
    enu_from_body = np.where((frames == _BODY)[:, None], (0.0, 0.0, 0.0, 1.0), block.attitude[:, :4])
    body_from_enu = rotation_from_quaternion(enu_from_body * (-1.0, -1.0, -1.0, 1.0))
    earth_in_body = body_from_enu[:, :, :2] * (frames != _BODY)[:, None, None]
    is_ned = (frames == _NED)[:, None, None]
    if not is_ned.any():
        return body_from_enu, earth_in_body
    return np.where(is_ned, body_from_enu @ ENU_FROM_NED, body_from_enu), earth_in_body


class RowsSeen(NamedTuple):
    """Rows first .. decided - 1 that meet the needs of some models, with their numbers.

    observations: None if no row meets them.
    """

    first: int
    decided: int
    block: AlignedBlock
    numbers: Numbers
    observations: Observations | None


def own_copy(block: AlignedBlock) -> AlignedBlock:
    """Return a copy that is independent of later additions."""
    return block.part(np.arange(len(block)))
