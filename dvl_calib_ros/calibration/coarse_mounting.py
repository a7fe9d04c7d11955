"""What configuration the data fit, where the one given is grossly wrong.

The calibration is linear about the nominal mounting; a mounting wrong by 45 degrees, or a reference that is not in the
frame it is said to be in, shows only as samples that are gated. Which rotation C fits Σ|g - C v|² best has a closed
solution at any angle (Wahba's problem, by singular values: Markley, "Attitude determination using vector observations",
1988), so it is found for the reference velocity g as if it were in the body, in ENU and in NED, and what fits is said.
All of it at several delays of the DVL's stamps: in waves, and in turns, a second too late looks like axes turned round.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .directions import Directions
from .frames import ENU_FROM_NED, FLU_FROM_FRD, Array, product, rotation_from_rpy, rpy_from_rotation, skew
from .samples import VelocityFrame

# A configuration is wrong from here on: what is left of the motion, as a share of its square, is that of 10 degrees.
WRONG_FROM = math.sin(math.radians(10.0)) ** 2
# What is said to fit leaves less than this share, and less than a quarter of what the configuration given leaves.
FITS_BELOW, BETTER_BY = 0.05, 0.25
# A rotation this near another is that one, rad: what is left is misalignment, for the calibration to find.
SAME_WITHIN = math.radians(12.0)
# Mountings are drawn with multiples of such an angle, rad, and one that is the same but for a misalignment is named.
DRAWN = math.pi / 4.0
# Axes turned round are the right ones if they leave so much less than those given with any lever arm: in chi-square,
# were all samples independent; of blocks of ten that are alike it is a tenth.
CLEARLY = 40.0
# Of the sum of squares that the nominal mounting is given: turns about the direction of travel do not show, and stay.
NOMINAL_SHARE = 1e-3
# What a lever arm is allowed to explain leaves a misalignment (rad) and a scale below these.
MISALIGNED, SCALED = math.radians(10.0), 0.1
# What is likely of a misalignment (rad), a scale and a lever arm (m). It decides what the motion does not: on a circle
# at one speed a lever arm looks like a turned DVL. It counts by 0.005 of the speed in every sample, which moves what is
# shown by a hundredth.
LIKELY: Array = np.array([0.05] * 3 + [0.02] + [1.0] * 3) / 0.005
# Fewer samples fit anything.
ENOUGH = 20
# By how much the DVL's stamps may be late, s: within G2's range, at a step that is short beside turns and waves.
DELAYS_S = np.linspace(-3.0, 3.0, 13)
_FRAMES = (VelocityFrame.BODY, VelocityFrame.ENU, VelocityFrame.NED)


class Suggestion(NamedTuple):
    """What fits, in words, and as parameters; misfit: share of the motion's square that it leaves."""

    says: str
    parameters: Mapping[str, object]
    misfit: float


class CoarseFits:
    """Sums over samples at each of `DELAYS_S`, from which any rotation of any frame can be judged. Constant memory."""

    def __init__(self, rotation_dvl_from_body: Array) -> None:
        """rotation_dvl_from_body: (3, 3) nominal."""
        self._nominal = rotation_dvl_from_body.T
        self._gv = np.zeros((len(_FRAMES), len(DELAYS_S), 3, 3))
        self._gg = np.zeros((len(_FRAMES), 1))
        self._vv = np.zeros((len(_FRAMES), len(DELAYS_S)))
        self._count = np.zeros(len(_FRAMES), dtype=np.int64)
        self._declared = np.zeros(len(_FRAMES), dtype=np.int64)
        self._directions = Directions()
        # of the axes given with a lever arm, and of those turned round without one
        self._fits = _AxesFit(self._nominal, True), _AxesFit(self._nominal @ FLU_FROM_FRD, False)

    def add(
        self,
        declared: VelocityFrame,
        reference: Array,
        rotation_enu_from_body: Array | None,
        velocity: Array,
        rates: Array | None = None,
    ) -> None:
        """Add N samples of one frame.

        reference: (N, 3) m/s as the messages have it, said to be in the frame `declared`. rotation_enu_from_body:
        (N, 3, 3), None where there is no attitude. velocity: (N, K, 3) m/s, DVL frame, as stamped later than those by
        each of `DELAYS_S`. rates: (N, 3) rad/s, body frame; None where they are not known.
        """
        self._declared[_FRAMES.index(declared)] += len(reference)
        if rotation_enu_from_body is not None:
            self._directions.add(velocity[:, len(DELAYS_S) // 2] @ self._nominal.T, rotation_enu_from_body)
        flat = velocity.reshape(len(velocity), -1)  # of all delays in one product
        squares = np.einsum("nka,nka->k", velocity, velocity)
        for index, frame in enumerate(_FRAMES):
            g = reference
            if frame is not VelocityFrame.BODY:
                if rotation_enu_from_body is None:
                    continue
                enu = reference @ ENU_FROM_NED.T if frame is VelocityFrame.NED else reference
                g = np.einsum("nji,nj->ni", rotation_enu_from_body, enu)
            if frame is declared and rates is not None:
                for fit in self._fits:
                    fit.add(g, velocity, rates)
            self._gv[index] += (g.T @ flat).reshape(3, len(DELAYS_S), 3).swapaxes(0, 1)
            self._gg[index] += np.sum(g * g)
            self._vv[index] += squares
            self._count[index] += len(g)

    def suggestion(self) -> Suggestion | None:
        """What fits much better than what is configured; None if nothing does, or the configuration fits."""
        declared = int(np.argmax(self._declared))
        if self._count[declared] < ENOUGH:
            return None
        given = float(self._misfits(declared, self._nominal).min())
        if self._directions.turn_with_heading:
            says = (
                "the DVL's velocities turn with the heading, as those in the earth's frame do (let its driver give "
                "them in its own axes)"
            )
            return Suggestion(says, {}, given)
        if given < WRONG_FROM or self._fits[0].left_by_little() < WRONG_FROM * self._gg[declared, 0]:
            return self._flipped(given)
        rotations = [self._rotations(index) for index in range(len(_FRAMES))]
        misfits = np.stack([self._misfits(index, each) for index, each in enumerate(rotations)])
        misfits[self._count < ENOUGH] = math.inf
        misfits[declared] *= 0.5  # of two that fit alike the frame given is the likelier
        best, delay = np.unravel_index(int(np.argmin(misfits)), misfits.shape)
        misfit = float(self._misfits(int(best), rotations[best])[delay])
        if misfit > FITS_BELOW or misfit > BETTER_BY * given:
            return None
        return self._named(declared, int(best), rotations[best][delay], misfit)

    def _flipped(self, misfit: float) -> Suggestion | None:
        """Whether y and z turned round explain more than the axes given do with any lever arm.

        A vehicle that swims ahead shows its axes only in the sway of turns and the heave of dives, which are small
        beside its speed; and at one speed the sway of a DVL that points down is that of one with a lever arm.
        """
        as_given, turned = (fit.left() for fit in self._fits)
        samples = self._fits[0].samples
        if samples < ENOUGH or 3.0 * samples * math.log(as_given / turned) < CLEARLY:
            return None
        return Suggestion("the DVL's axes look forward-right-down (dvl_axes: frd)", {"dvl_axes": "frd"}, misfit)

    def _rotations(self, index: int) -> Array:
        """``rotation_body_from_dvl`` (K, 3, 3) that fits best at each delay."""
        size = NOMINAL_SHARE * np.sqrt(self._gg[index] * self._vv[index])
        u, _, vt = np.linalg.svd(self._gv[index] + size[:, None, None] * self._nominal)
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        return np.asarray(u @ vt)

    def _misfits(self, index: int, rotation: Array) -> Array:
        """Σ|g - C v|² / Σ|g|² (K,) of one rotation (3, 3), or one for each delay (K, 3, 3)."""
        squares = self._gg[index] + self._vv[index] - 2.0 * np.sum(rotation * self._gv[index], axis=(1, 2))
        return np.asarray(squares / self._gg[index]) if self._gg[index] > 0.0 else np.full(len(squares), math.inf)

    def _named(self, declared: int, best: int, rotation: Array, misfit: float) -> Suggestion | None:
        frame = _FRAMES[best].value
        same_frame = best == declared
        as_given = _angle(rotation, self._nominal) < SAME_WITHIN
        if same_frame and as_given:  # a large misalignment, for the calibration to find
            return None
        about = [] if same_frame else [f"the reference looks like {frame.upper() if best else 'the body frame'}"]
        parameters: dict[str, object] = {} if same_frame else {"gnss_frame": frame}
        earth = best != 0 and declared != 0
        otherwise = ""
        if as_given:  # the frame explains it
            if earth and not same_frame and self._misfits(best, FLU_FROM_FRD @ self._nominal).min() < FITS_BELOW:
                otherwise = ", or the IMU's orientation looks like NED (imu_frame: ned): only sway tells these apart"
        elif not same_frame and earth and _angle(rotation, FLU_FROM_FRD @ self._nominal) < SAME_WITHIN:
            about, parameters = ["the IMU's orientation looks like NED, forward-right-down"], {"imu_frame": "ned"}
        elif _angle(rotation, self._nominal @ FLU_FROM_FRD) < SAME_WITHIN:
            about.append("the DVL's axes look forward-right-down")
            parameters["dvl_axes"] = "frd"
        else:
            rpy = [round(float(angle), 4) + 0.0 for angle in rpy_from_rotation(_as_drawn(rotation))]
            about.append(f"the data fit mounting_rpy {' '.join(f'{angle:.3g}' for angle in rpy)}")
            parameters["mounting_rpy"] = rpy
        remedy = ", ".join(f"{name}: {value}" for name, value in parameters.items())
        return Suggestion(f"{' and '.join(about)} ({remedy}){otherwise}", parameters, misfit)


class _AxesFit:
    """Least squares of a small turn, a scale and, if wanted, a lever arm, about a mounting taken for granted."""

    def __init__(self, rotation_body_from_dvl: Array, with_lever_arm: bool) -> None:
        self._rotation = rotation_body_from_dvl
        self._with_lever_arm = with_lever_arm
        n = 7 if with_lever_arm else 4
        self._normal, self._vector = np.zeros((len(DELAYS_S), n, n)), np.zeros((len(DELAYS_S), n))
        self._square, self._speed = np.zeros(len(DELAYS_S)), np.zeros(len(DELAYS_S))  # sums of squares, (m/s)²
        self.samples = 0

    def add(self, reference: Array, velocity: Array, rates: Array) -> None:
        """Add N samples: reference (N, 3) m/s and rates (N, 3) rad/s in the body, velocity (N, K, 3) m/s of the DVL."""
        known = np.isfinite(rates).all(axis=1)
        if not known.all():
            reference, velocity, rates = reference[known], velocity[known], rates[known]
        if not len(rates):
            return
        in_body = velocity @ self._rotation.T
        rest = reference[:, None] - in_body
        k, n = len(DELAYS_S), len(rates)
        h = np.empty((k, n, 3, self._vector.shape[1]))
        h[..., :3], h[..., 3] = skew(in_body).swapaxes(0, 1), in_body.swapaxes(0, 1)
        if self._with_lever_arm:
            h[..., 4:] = skew(rates)
        flat = h.reshape(k, 3 * n, -1)
        r = rest.swapaxes(0, 1).reshape(k, 3 * n, 1)
        turned = flat.swapaxes(1, 2)
        self._normal += turned @ flat
        self._vector += (turned @ r)[:, :, 0]
        self._square += np.einsum("kji,kji->k", r, r)
        self._speed += np.einsum("nka,nka->k", in_body, in_body)
        self.samples += n

    def left(self) -> float:
        """Sum of squares (m/s)² that is left at the best delay."""
        return float(self._solved()[1].min())

    def left_by_little(self) -> float:
        """The same of those delays at which turn and scale are those of a misalignment; infinite without any."""
        found, left = self._solved()
        little = (np.linalg.norm(found[:, :3], axis=1) < MISALIGNED) & (np.abs(found[:, 3]) < SCALED)
        return float(left[little].min(initial=math.inf)) if self.samples >= ENOUGH else math.inf

    def _solved(self) -> tuple[Array, Array]:
        """At each delay what fits best (K, 4 or 7), and the sum of squares that it leaves (K,)."""
        n = self._vector.shape[1]
        likely = np.maximum(self._speed, 1e-12)[:, None, None] * np.diag(LIKELY[:n] ** -2)
        found = np.linalg.solve(self._normal + likely, self._vector[:, :, None])[:, :, 0]
        left = self._square - ((2.0 * self._vector - product(self._normal, found)) * found).sum(axis=1)
        return found, np.maximum(left, 1e-12 * np.maximum(self._square, 1e-12))


def _as_drawn(rotation: Array) -> Array:
    """The rotation by multiples of `DRAWN` that a mounting (3, 3) is the same as; itself if it is of none."""
    drawn = rotation_from_rpy(np.round(rpy_from_rotation(rotation) / DRAWN) * DRAWN)
    return drawn if _angle(rotation, drawn) < SAME_WITHIN else rotation


def _angle(a: Array, b: Array) -> float:
    """Angle of the rotation between two rotations (3, 3), rad."""
    return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(a.T @ b)) - 1.0))))
