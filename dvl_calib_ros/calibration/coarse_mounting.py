"""What configuration the data fit, where the one given is grossly wrong.

The calibration is linear about the nominal mounting; a mounting wrong by 45 degrees, or a reference that is not in the
frame it is said to be in, shows only as samples that are gated. Which rotation C fits Σ|g - C v|² best has a closed
solution at any angle (Wahba's problem, by singular values: Markley, "Attitude determination using vector observations",
1988), so it is found for the reference velocity g as if it were in the body, in ENU and in NED, and what fits is said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .frames import ENU_FROM_NED, FLU_FROM_FRD, Array, rpy_from_rotation
from .samples import VelocityFrame

# A configuration is wrong from here on: what is left of the motion, as a share of its square, is that of 10 degrees.
WRONG_FROM = math.sin(math.radians(10.0)) ** 2
# What is said to fit leaves less than this share, and less than a quarter of what the configuration given leaves.
FITS_BELOW, BETTER_BY = 0.05, 0.25
# A rotation this near another is that one, rad: what is left is misalignment, for the calibration to find.
SAME_WITHIN = math.radians(12.0)
# Of the sum of squares that the nominal mounting is given: turns about the direction of travel do not show, and stay.
NOMINAL_SHARE = 1e-3
# Fewer samples fit anything.
ENOUGH = 20
_FRAMES = (VelocityFrame.BODY, VelocityFrame.ENU, VelocityFrame.NED)


class Suggestion(NamedTuple):
    """What fits, in words, and as parameters; misfit: share of the motion's square that it leaves."""

    says: str
    parameters: Mapping[str, object]
    misfit: float


class CoarseFits:
    """Sums over samples, from which any rotation of any frame can be judged. Memory is constant."""

    def __init__(self, rotation_dvl_from_body: Array) -> None:
        """rotation_dvl_from_body: (3, 3) nominal."""
        self._nominal = rotation_dvl_from_body.T
        self._gv = np.zeros((len(_FRAMES), 3, 3))
        self._gg = np.zeros(len(_FRAMES))
        self._vv = np.zeros(len(_FRAMES))
        self._count = np.zeros(len(_FRAMES), dtype=np.int64)
        self._declared = np.zeros(len(_FRAMES), dtype=np.int64)

    def add(
        self, declared: VelocityFrame, reference: Array, rotation_enu_from_body: Array | None, velocity: Array
    ) -> None:
        """Add N samples of one frame.

        reference: (N, 3) m/s as the messages have it, said to be in the frame `declared`. rotation_enu_from_body:
        (N, 3, 3), None where there is no attitude. velocity: (N, 3) m/s at the same times, DVL frame.
        """
        self._declared[_FRAMES.index(declared)] += len(reference)
        for index, frame in enumerate(_FRAMES):
            g = reference
            if frame is not VelocityFrame.BODY:
                if rotation_enu_from_body is None:
                    continue
                enu = reference @ ENU_FROM_NED.T if frame is VelocityFrame.NED else reference
                g = np.einsum("nji,nj->ni", rotation_enu_from_body, enu)
            self._gv[index] += g.T @ velocity
            self._gg[index] += np.sum(g * g)
            self._vv[index] += np.sum(velocity * velocity)
            self._count[index] += len(g)

    def suggestion(self) -> Suggestion | None:
        """What fits much better than what is configured; None if nothing does, or the configuration fits."""
        declared = int(np.argmax(self._declared))
        if self._count[declared] < ENOUGH:
            return None
        given = self._misfit(declared, self._nominal)
        if given < WRONG_FROM:
            return None
        rotations = [self._rotation(index) for index in range(len(_FRAMES))]
        misfits = [
            self._misfit(index, rotation) if self._count[index] >= ENOUGH else math.inf
            for index, rotation in enumerate(rotations)
        ]
        misfits[declared] *= 0.5  # of two that fit alike the frame given is the likelier
        best = int(np.argmin(misfits))
        misfit = self._misfit(best, rotations[best])
        if misfit > FITS_BELOW or misfit > BETTER_BY * given:
            return None
        return self._named(declared, best, rotations[best], misfit)

    def _rotation(self, index: int) -> Array:
        """``rotation_body_from_dvl`` (3, 3) that fits best."""
        towards = self._gv[index] + NOMINAL_SHARE * math.sqrt(self._gg[index] * self._vv[index]) * self._nominal
        u, _, vt = np.linalg.svd(towards)
        rotation: Array = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        return rotation

    def _misfit(self, index: int, rotation: Array) -> float:
        """Σ|g - C v|² / Σ|g|²."""
        squares = self._gg[index] + self._vv[index] - 2.0 * float(np.sum(rotation * self._gv[index]))
        return float(squares / self._gg[index]) if self._gg[index] > 0.0 else math.inf

    def _named(self, declared: int, best: int, rotation: Array, misfit: float) -> Suggestion:
        frame = _FRAMES[best].value
        same_frame = best == declared
        about = [] if same_frame else [f"the reference looks like {frame.upper() if best else 'the body frame'}"]
        parameters: dict[str, object] = {} if same_frame else {"gnss_frame": frame}
        earth = best != 0 and declared != 0
        if _angle(rotation, self._nominal) < SAME_WITHIN:
            pass  # the frame explains it
        elif not same_frame and earth and _angle(rotation, FLU_FROM_FRD @ self._nominal) < SAME_WITHIN:
            about, parameters = ["the IMU's orientation looks like NED, forward-right-down"], {"imu_frame": "ned"}
        elif _angle(rotation, self._nominal @ FLU_FROM_FRD) < SAME_WITHIN:
            about.append("the DVL's axes look forward-right-down")
            parameters["dvl_axes"] = "frd"
        else:
            rpy = [round(float(angle), 3) + 0.0 for angle in rpy_from_rotation(rotation)]
            about.append(f"the data fit mounting_rpy {' '.join(f'{angle:g}' for angle in rpy)}")
            parameters["mounting_rpy"] = rpy
        remedy = ", ".join(f"{name}: {value}" for name, value in parameters.items())
        return Suggestion(f"{' and '.join(about)} ({remedy})", parameters, misfit)


def _angle(a: Array, b: Array) -> float:
    """Angle of the rotation between two rotations (3, 3), rad."""
    return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(a.T @ b)) - 1.0))))
