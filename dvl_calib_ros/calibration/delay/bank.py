"""G2's filter: a bank of delays side by side, each with a linear least-squares fit of everything else.

A delay of seconds is no small error: no linearisation about zero finds it. Each of K hypotheses holds the information
(Λ, Λx) of G1's states, lever arm and of how much more than its own the delay is; its evidence says how well it
explains the data. What is published is the mixture of all, moment-matched: on a straight run no hypothesis is better
than another, and the delay's standard deviation stays that of the prior.

Noise that is larger than claimed, or correlated, would make evidence and covariance overconfident: evidence is
divided by the best hypothesis' own mean squared innovation, and standard deviations grow to what blocks of time
show (honesty.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..correction_parameters import PriorOnErrors, to_correction
from ..folds import FOLDS
from ..frames import Array
from ..kalman import GaussianState
from ..samples import Index, Mask
from ..time_blocks import TimeBlocks
from .rows import BEYOND, DELAY, DELAYS_S, N_STATE, DelayedRows

# Each hypothesis believes its own delay to this, s: neighbours overlap, so together they hold any delay between them.
CELL_STD_S = 0.2
# A gate compares with the innovations of so many of the newest samples, once there are ENOUGH.
RECENT, ENOUGH = 256, 20
# Median of chi-square with three degrees of freedom.
MEDIAN_NIS = 2.366
# Hypotheses with a smaller share of the best one's probability are left out of the mixture.
SMALLEST_SHARE = 1e-9
# A state is shown by the data if these alone, with priors of all else wider by this, have halved its prior σ.
WIDER, SHOWN_SHARE = 100.0, 0.5


class Hypotheses(NamedTuple):
    """State (K, n) and covariance (K, n, n), on ψ and κ, with the last state relative to the hypothesis' own delay.

    misfit: (K,) zᵀR⁻¹z that is left, prior included. log_evidence: (K,), of the data as claimed.
    """

    x: Array
    p: Array
    misfit: Array
    log_evidence: Array


@dataclass(frozen=True)
class Posterior:
    """What the bank says.

    state: x (n,), P (n, n) of G2's states. shown: (n,) which of them the data alone shows. level: mean squared
    innovation of the best hypothesis over what the noise claims, at least 1. inflation: (n,) by how much its standard
    deviations were raised above the filter's own.
    """

    state: GaussianState
    shown: Mask
    level: float
    inflation: Array


class DelayBank:
    """Accumulates rows; asks for nothing else. prior: x (n,), P (n, n) of G2's states."""

    def __init__(
        self, prior: GaussianState, unknown_std: Array, gate: float, process_rate: Array | None, verified: bool
    ) -> None:
        """unknown_std: (n,) of a prior without any calibration before it.

        gate: largest νᵀS⁻¹ν that is used, times the level. process_rate: Q per second (n, n), None for none."""
        self.prior = prior
        self._unknown_std = unknown_std
        self._gate = gate
        self._process_rate = process_rate
        self._errors = _around_each_delay(prior)
        held = to_correction(prior)
        self._start = _around_each_delay(held)
        inverse = np.linalg.inv(self._start.p)
        self._information = inverse.copy()
        self._vector = (inverse @ self._start.x[..., None])[..., 0]
        self._square = np.einsum("ki,ki->k", self._vector, self._start.x)
        self._log_det = np.zeros(len(DELAYS_S))
        self._regressor_noise = np.zeros(4)
        self._recent: list[float] = []
        self.used = self.gated = 0
        self._nis_sum = 0.0
        self.blocks = TimeBlocks()
        self._folds: tuple[Array, Array] | None = None
        if verified:
            k = len(DELAYS_S)
            self._folds = np.zeros((FOLDS, k, N_STATE, N_STATE)), np.zeros((FOLDS, k, N_STATE))
        # of a delay's deviation from the prior's mean
        variance = prior.p[DELAY, DELAY] + CELL_STD_S**2
        self._log_prior = -0.5 * (DELAYS_S - prior.x[DELAY]) ** 2 / variance

    @property
    def mean_nis(self) -> float:
        """Mean νᵀS⁻¹ν of the samples used, against the hypothesis that explained each best; nan if none."""
        return self._nis_sum / self.used if self.used else float("nan")

    def add(self, rows: DelayedRows, folds: NDArray[np.int64], seconds: float) -> None:
        """Take the rows of a block of time. folds: (J,) of each row. seconds: its length."""
        if self._process_rate is not None:
            self._drift(seconds)
        if not len(rows):
            return
        use = self._gated(rows)
        before = np.linalg.slogdet(self._information)[1]
        total, total_vector = np.zeros_like(self._information), np.zeros_like(self._vector)
        square, by_fold = np.zeros_like(self._square), []
        for fold in np.unique(folds[use]):  # also where nobody verifies: sums in one order are the same to the last bit
            told = _told(rows, use & (folds == fold))
            by_fold.append((fold, told))
            total += told[0]
            total_vector += told[1]
            square += told[2]
        if not (np.isfinite(total).all() and np.isfinite(total_vector).all() and np.isfinite(square).all()):
            return  # it goes on as before these rows
        self._square += square
        self._information += total
        self._regressor_noise += rows.weight[use] @ rows.regressor_noise[use]
        self._vector += total_vector
        self._log_det += np.linalg.slogdet(self._information)[1] - before
        self.blocks.add(total, total_vector, float(rows.weight[use].sum()))
        if self._folds is not None:
            for fold, (information, vector, _) in by_fold:
                self._folds[0][fold] += information
                self._folds[1][fold] += vector

    def _drift(self, seconds: float) -> None:
        """Random walk over so many seconds: P grows, x stays, and so does the misfit."""
        assert self._process_rate is not None
        found = self._solve()
        p = found.p + self._process_rate * seconds
        self._information = np.linalg.inv(p)
        self._vector = (self._information @ found.x[..., None])[..., 0]
        self._square = found.misfit + np.einsum("ki,ki->k", self._vector, found.x)

    def _gated(self, rows: DelayedRows) -> Mask:
        """Which rows are used (J,): those that any hypothesis explains, by the level of recent innovations.

        A wrong hypothesis must not throw out what contradicts it, so all use the same samples; a lever arm that is not
        known yet is in S.
        """
        found = self._solve()
        innovation = rows.z - np.matmul(rows.h, found.x[None, :, :, None])[..., 0]
        root = np.linalg.cholesky(found.p)
        spread = rows.h @ root
        s = spread @ spread.swapaxes(-1, -2) + np.linalg.inv(rows.information)[:, None]
        nis = np.einsum("jki,jki->jk", innovation, np.linalg.solve(s, innovation[..., None])[..., 0]).min(axis=1)
        use = np.ones(len(rows), dtype=bool)
        if len(self._recent) >= ENOUGH:
            level = max(1.0, float(np.median(self._recent)) / MEDIAN_NIS)
            use = nis <= self._gate * level
        self._recent = (self._recent + nis.tolist())[-RECENT:]
        self.used += int(use.sum())
        self.gated += int((~use).sum())
        self._nis_sum += float(nis[use].sum())
        return use

    def _solve(self, without: int | None = None) -> Hypotheses:
        information, vector = self._information, self._vector
        if without is not None:
            assert self._folds is not None
            information, vector = information - self._folds[0][without], vector - self._folds[1][without]
        p = np.linalg.inv(information)
        p = 0.5 * (p + p.swapaxes(1, 2))
        x = (p @ vector[..., None])[..., 0]
        misfit = self._square - np.einsum("ki,ki->k", x, vector)
        return Hypotheses(x, p, misfit, -0.5 * (misfit + self._log_det))

    def _level(self, found: Hypotheses, best: int) -> float:
        freedom = 3.0 * self.blocks.weight - N_STATE
        return max(1.0, float(found.misfit[best]) / freedom) if freedom > 0.0 else 1.0

    def posterior(self) -> Posterior:
        """The mixture of all hypotheses, as of now."""
        found = self._solve()
        # a first level from the best as claimed; tempering does not change which that is but for the prior
        level = self._level(found, int(np.argmax(found.log_evidence)))
        log_share = found.log_evidence / level + self._log_prior
        best = int(np.argmax(log_share))
        state = self._mixture(found, log_share)
        inflation = self.blocks.inflation(best, found.x[best], found.p[best]) if self._process_rate is None else None
        inflation = np.ones(N_STATE) if inflation is None else inflation
        shown = self._shown(best, inflation)
        x, p = state.x, state.p * inflation[:, None] * inflation
        for index in range(*BEYOND.indices(N_STATE)):
            if not shown[index]:  # claimed nothing of
                x[index] = self.prior.x[index]
                p[index] = p[:, index] = 0.0
                p[index, index] = self.prior.p[index, index]
        return Posterior(GaussianState(x, p), shown, level, inflation)

    def without_fold(self, fold: int) -> GaussianState:
        """The state had the bank not seen a fold, the delay's probabilities being those of all data."""
        found = self._solve()
        level = self._level(found, int(np.argmax(found.log_evidence)))
        return self._mixture(self._solve(fold), found.log_evidence / level + self._log_prior)

    def _mixture(self, found: Hypotheses, log_share: Array) -> GaussianState:
        share = np.exp(log_share - log_share.max())
        share[share < SMALLEST_SHARE] = 0.0
        kept = np.flatnonzero(share)
        share = share[kept] / share[kept].sum()
        to_errors = PriorOnErrors(_at(self._start, kept), _at(self._errors, kept)).to_errors
        x, p = to_errors(GaussianState(found.x[kept], found.p[kept]))
        x[:, DELAY] += DELAYS_S[kept]
        mean = share @ x
        apart = x - mean
        covariance = np.einsum("k,kij->ij", share, p) + np.einsum("k,ki,kj->ij", share, apart, apart)
        return GaussianState(mean, covariance)

    def _shown(self, best: int, inflation: Array) -> Mask:
        """Which states (n,) the data show even if everything else were known much worse than the prior says."""
        prior_std = np.sqrt(np.diag(self.prior.p))
        known_before = prior_std <= SHOWN_SHARE * self._unknown_std
        data = self._information[best] - np.linalg.inv(self._start.p[best])
        # what noise of regressors seems to tell is told by nothing
        share = np.ones(N_STATE)
        share[BEYOND] = np.clip(1.0 - self._regressor_noise / np.maximum(np.diag(data)[BEYOND], 1e-300), 0.0, 1.0)
        data = data * np.sqrt(share)[:, None] * np.sqrt(share)
        wide = np.diag((WIDER * self._unknown_std) ** -2)
        std = np.sqrt(np.diag(np.linalg.inv(data + wide))) * inflation
        shown: Mask = (std <= SHOWN_SHARE * self._unknown_std) | known_before
        return shown


def _told(rows: DelayedRows, use: Mask) -> tuple[Array, Array, Array]:
    """What some rows tell each hypothesis: HᵀWH (K, n, n), HᵀWz (K, n), zᵀWz (K,)."""
    z, h = rows.z[use], rows.h[use]
    weighted = rows.information[use] * rows.weight[use, None, None]
    k = len(DELAYS_S)
    flat_h = h.transpose(1, 0, 2, 3).reshape(k, -1, N_STATE)
    flat_wh = (weighted[:, None] @ h).transpose(1, 3, 0, 2).reshape(k, N_STATE, -1)
    flat_z = z.transpose(1, 0, 2).reshape(k, -1)
    flat_wz = (weighted[:, None] @ z[..., None])[..., 0].transpose(1, 0, 2).reshape(k, -1)
    vector = (flat_wh @ flat_z[..., None])[..., 0]
    return flat_wh @ flat_h, vector, np.einsum("ki,ki->k", flat_wz, flat_z)


def _at(states: GaussianState, index: Index) -> GaussianState:
    return GaussianState(states.x[index], states.p[index])


def _around_each_delay(prior: GaussianState) -> GaussianState:
    """The prior of each hypothesis, x (K, n), P (K, n, n): as if the delay had been measured to be its own.

    So the mixture of all is the prior, and each is linear where it stands.
    """
    gain = prior.p[:, DELAY] / (prior.p[DELAY, DELAY] + CELL_STD_S**2)
    p = prior.p - np.outer(gain, prior.p[DELAY])
    x = prior.x + (DELAYS_S - prior.x[DELAY])[:, None] * gain
    x[:, DELAY] -= DELAYS_S
    return GaussianState(x, np.broadcast_to(p, (len(DELAYS_S), *p.shape)).copy())
