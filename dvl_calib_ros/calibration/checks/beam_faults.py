"""Test for one beam of the DVL that reads low or high, on the residual of `full`.

The velocity is the least-squares solution of four beams. A beam that reads low by a share s changes it by -s E v, with
E = (solution of that beam) (its direction)ᵀ. Misalignment and scale are parts of E that `full` estimates. The symmetric
off-diagonal part is no mounting. v is the mean of the velocities before and after a sample, because the sample's own
noise is in the residual. A scale that grows with speed looks similar; the more significant one is taken.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..models.own import BIAS
from ..numerics.block_covariance import TimeBlocks, inflations
from ..numerics.frames import Array
from ..numerics.tests import Z_95_PERCENT, Z_FIFTY_TESTS, chance_of, chi2_isf

# Angle of the beams from the DVL's z axis (rad; 20° to 30° in use), and their azimuths from its x axis to port.
BEAM_ANGLE, AZIMUTHS_DEG = math.radians(30.0), (45, 135, 225, 315, 0, 90, 180, 270)
# Significance of the best of these beams, σ (Bonferroni).
Z_BEST_BEAM = math.sqrt(chi2_isf(chance_of(Z_FIFTY_TESTS) / len(AZIMUTHS_DEG), 1.0))
# Prior σ of the nuisances: the scale of z, and the DVL's bias (m/s), which at one speed looks like a beam.
Z_SCALE_STD, BIAS_STD = 1.0, 0.1


def _beams() -> Array:
    """Return E (8, 3, 3) of each beam."""
    flat, down = math.sin(BEAM_ANGLE), math.cos(BEAM_ANGLE)  # parts of a beam's direction
    along = np.radians(AZIMUTHS_DEG)
    beams = np.column_stack([flat * np.cos(along), flat * np.sin(along), np.full(len(along), -down)])
    return np.asarray((beams / [2.0 * flat**2, 2.0 * flat**2, 4.0 * down**2])[:, :, None] * beams[:, None])


BEAMS: Array = _beams()
N_EFFECTS = len(BEAMS) + 2


def effect_velocities(v: Array) -> Array:
    """Return the velocities (N, 3, `N_EFFECTS`) that a DVL with velocities v (N, 3) has too much by each effect.

    These are the scale of z, each beam by its whole velocity, and a scale that grows with speed, by 1 per m/s.
    """
    velocities = np.zeros((len(v), 3, N_EFFECTS))
    velocities[:, 2, 0] = v[:, 2]
    velocities[:, :, 1:-1] = -np.einsum("kij,nj->nik", BEAMS, v)
    velocities[:, :, -1] = np.linalg.norm(v, axis=1)[:, None] * v
    return velocities


class BeamFault(NamedTuple):
    """Most significant beam.

    share, std: missing share of its velocity, and σ.
    azimuth_deg: of the beam, from the DVL's x axis to port.
    off: resulting error of the mean velocity, as a share of the speed.
    """

    share: float
    std: float
    azimuth_deg: float
    off: float

    @property
    def least(self) -> float:
        """Return the lower limit of `off`, for a beam that is better by `Z_95_PERCENT` σ."""
        return self.off * (1.0 - Z_95_PERCENT * self.std / self.share)


def most_significant(blocks: TimeBlocks, information: Array, vector: Array, mean: Array) -> BeamFault | None:
    """Return the most significant beam; None if a scale that grows with speed is more significant.

    Each beam is fitted with the states, a DVL bias and the scale of z. Its σ includes the scatter of the blocks.

    Parameters
    ----------
    blocks: normal equations of n states, then of `effect_velocities`.
    information, vector: (n, n), (n,) prior of the states.
    mean: (3,) m/s, mean velocity in the DVL.
    """
    n_states, covariance = len(vector), np.linalg.inv(information)
    prior_mean = covariance @ vector
    covariance[BIAS, BIAS] += BIAS_STD**2 * np.eye(3)
    # information of the states, the scale of z, the beam; without a vertical reference nothing else holds the scale
    prior = np.diag([*np.zeros(n_states), Z_SCALE_STD**-2.0, 0.0])
    prior[:n_states, :n_states] = np.linalg.inv(covariance)
    prior_vector = np.append(prior[:n_states, :n_states] @ prior_mean, [0.0, 0.0])
    all_blocks, candidates = blocks.of(0), []
    for effect in range(1, N_EFFECTS):
        equations = all_blocks.part(np.append(np.arange(n_states + 1), n_states + effect))
        if equations.total[-1, -1] <= 0.0:
            continue
        posterior = np.linalg.inv(prior + equations.total)
        x = posterior @ (equations.vector.sum(axis=0) + prior_vector)
        inflation = float(inflations([equations], x[None], posterior[None])[0, -1])
        candidates.append((float(x[-1]), math.sqrt(posterior[-1, -1]) * inflation, effect))
    no_beam = (0.0, 1.0, N_EFFECTS - 1)
    share, std, effect = max(candidates, key=lambda fault: abs(fault[0]) / fault[1], default=no_beam)
    if effect == N_EFFECTS - 1:  # the scale that grows with speed
        return None
    beam = effect - 1
    relative = abs(share) * float(np.linalg.norm(BEAMS[beam] @ mean)) / max(float(np.linalg.norm(mean)), 1e-6)
    return BeamFault(abs(share), std, (AZIMUTHS_DEG[beam] + 180.0 * (share < 0.0)) % 360.0, relative)


def beam_warning(fault: BeamFault | None, accepted: float) -> list[Reason]:
    """Return the reason against a calibration by a faulty beam; its roll and yaw are wrong by several σ.

    accepted: error of the velocity ahead, as a share of the speed, up to which a beam is not reported.
    """
    if fault is None or fault.share < Z_BEST_BEAM * fault.std or fault.least < accepted:
        return []
    percent, std = 100.0 * fault.share, 100.0 * fault.std
    return [finding("BEAM_OFF", percent=percent, std=std, azimuth=fault.azimuth_deg).weighed(Severity.REJECT)]
