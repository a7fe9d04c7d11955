"""G2's filter: a bank of delays side by side, each with a linear least-squares fit of everything else.

A delay of seconds is no small error: no linearisation about zero finds it. Each of K hypotheses holds the information
(Λ, Λx) of G1's states, lever arm and of how much more than its own the delay is; its evidence says how well it
explains the data. What is published is the mixture of all, moment-matched: on a straight run no hypothesis is better
than another, and the delay's standard deviation stays that of the prior.

Noise that is larger than claimed, or correlated, would make evidence and covariance overconfident: evidence is
divided by the best hypothesis' own mean squared innovation, and standard deviations grow to what blocks of time
show (time_blocks.py). (Long, because what a hypothesis knows, of heave and over the end of a day, is one thing.)
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..correction_parameters import PriorOnErrors, to_correction
from ..folds import FOLDS, FoldSums, folds_of, with_states_of
from ..frames import Array
from ..heading_states import HeadingStates, all_told, heading_states, heading_terms, upwards, with_terms
from ..heave import HeaveRows, HeaveSums, with_heave
from ..kalman import GaussianState, distance_squared
from ..parameters import Parameters
from ..robust import median
from ..samples import Index, Mask, Stamps
from ..time_blocks import TimeBlocks
from .rows import BEYOND, DELAY, DELAYS_S, LEVER_ARM, N_STATE, OF_DAY, OF_DELAY, OF_NONE, DelayedRows

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


_BEYOND: Index = np.arange(N_STATE)[BEYOND]
# Columns of what rows hold for each delay, and the states that they say anything of.
_MOVING: Index = np.append(OF_DELAY, N_STATE)
_SHOWN_BY_ROWS: Index = np.concatenate([OF_NONE, OF_DELAY])


class Hypotheses(NamedTuple):
    """State (K, n) and covariance (K, n, n), on ψ and κ, with the last state relative to the hypothesis' own delay.

    misfit: (K,) zᵀR⁻¹z that is left, prior included. log_evidence: (K,), of the data as claimed. information, vector:
    Λ (K, n, n) and Λx (K, n).
    """

    x: Array
    p: Array
    misfit: Array
    log_evidence: Array
    information: Array
    vector: Array


class Found(NamedTuple):
    """What is known at some time: the likely hypotheses x (M, n), P (M, n, n), on ψ and κ, the numbers kept (M,) of
    their delays, and the share (M,) of each; shown, inflation and heading as of `Posterior`;
    drifted as of `HeadingStates`."""

    likely: GaussianState
    kept: Index
    share: Array
    shown: Mask
    inflation: Array
    heading: GaussianState | None
    drifted: float


@dataclass(frozen=True)
class Posterior:
    """What the bank says.

    state: x (n,), P (n, n) of G2's states. shown: (n,) which of them the data alone shows. inflation: (n,) by how much
    its standard deviations were raised above the filter's own. turned: (3,) by how much 1 m of lever arm along the
    axis that matters most turns each misalignment, rad; by_lever_arm: (3,) variance of each that comes with what is not
    known of the lever arm, in variances without. heading: coefficients of its deviation, as of `HeadingStates`.
    """

    state: GaussianState
    shown: Mask
    inflation: Array
    turned: Array
    by_lever_arm: Array
    heading: GaussianState | None


class _Ended(NamedTuple):
    """A day that is over.

    known: of all, and without each fold, the state as the filter has it, x (n,), P (n, n). shown: (n,) which of the
    states the data showed. inflation: (n,) by how much σ was to be raised.
    """

    known: list[GaussianState]
    shown: Mask
    inflation: Array


class DayState(NamedTuple):
    """G2's states on one day, x (n,), P (n, n), by all data; and which (n,) of them are shown."""

    state: GaussianState
    shown: Mask


class DelayBank:
    """Accumulates rows; asks for nothing else. prior: x (n,), P (n, n) of G2's states."""

    def __init__(
        self,
        prior: GaussianState,
        unknown: GaussianState,
        gate: float,
        process_rate: Array | None,
        verified: bool,
        parameters: Parameters,
    ) -> None:
        """unknown: a prior without any calibration before it, which is that of another day's own states, too.

        gate: largest νᵀS⁻¹ν that is used, times the level. process_rate: Q per second (n, n), None for none."""
        self.prior = prior
        self._unknown = unknown
        self._unknown_std = np.sqrt(np.diag(unknown.p))
        self._gate = gate
        self._process_rate = process_rate
        self._solved: Hypotheses | None = None
        self._begin_day()
        self._information, self._vector = self._start.information
        self._ended: list[_Ended] = []
        self._square = np.einsum("ki,ki->k", self._vector, self._start.x)
        self._log_det = np.linalg.slogdet(self._information)[1]
        self._parameters = parameters
        self._heave = HeaveRows(len(DELAYS_S), N_STATE, parameters)
        self._heave_variance = parameters.motion_std**2
        self._regressor_noise = np.zeros(4)
        self._recent: list[float] = []
        self.used = self.gated = 0
        self._nis_sum = 0.0
        self.blocks = TimeBlocks()
        self._up = upwards(parameters.rotation_dvl_from_body, N_STATE)
        self._epoch_ns: int | None = None  # of the first row
        k = len(DELAYS_S)
        self._folds = FoldSums((k, N_STATE, N_STATE), (k, N_STATE)) if verified else None

    def _begin_day(self) -> None:
        """What hypotheses start from by the prior alone, of the errors and as the filter has it."""
        prior = self.prior
        self._start = _around_each_delay(to_correction(prior))
        self._prior_on_errors = PriorOnErrors(self._start, _around_each_delay(prior))
        # of a delay's deviation from the prior's mean
        variance = prior.p[DELAY, DELAY] + CELL_STD_S**2
        self._log_prior = -0.5 * (DELAYS_S - prior.x[DELAY]) ** 2 / variance

    def end_day(self) -> None:
        """Go on with what belongs to the vehicle; delay and constant error of the reference are to be found anew.

        Raises numpy.linalg.LinAlgError, and is as before, where numbers have run away.
        """
        found, log_share = self._shares()
        best = int(np.argmax(log_share))
        inflation = self._inflation(best, found)
        shown = self._shown(best, inflation)
        folds = [None] if self._folds is None else [None, *range(FOLDS)]
        known = [self._held(self._solve(fold), log_share) for fold in folds]
        begins = [_around_each_delay(with_states_of(each, self._unknown, OF_DAY)).information for each in known]
        total = all_told(found.information, found.vector, self.blocks)
        source = np.full(len(DELAYS_S), best)
        # what can fail has not, and from here on all changes together
        self.blocks.end_day(OF_DAY, *total, source)
        self._ended.append(_Ended(known, shown, inflation))
        self._heave.close()
        self._heave.absorb()  # its rows are in what is known
        self._heave.learn_from(source)
        self.prior = with_states_of(self.prior, self._unknown, OF_DAY)
        self._begin_day()
        self._information, self._vector = begins[0]
        if self._folds is not None:
            self._folds.clear()
            for fold, (information, vector) in enumerate(begins[1:]):
                self._folds.add(fold, self._information - information, self._vector - vector)
        x = np.linalg.solve(self._information, self._vector[..., None])[..., 0]
        self._square = found.misfit[best] + np.einsum("ki,ki->k", self._vector, x)
        self._log_det = np.linalg.slogdet(self._information)[1]
        self._regressor_noise[-1] = 0.0
        self._solved = None

    @property
    def mean_nis(self) -> float:
        """Mean νᵀS⁻¹ν of the samples used, against the hypothesis that explained each best; nan if none."""
        return self._nis_sum / self.used if self.used else float("nan")

    def add(self, rows: DelayedRows, stamps_ns: Stamps, seconds: float) -> Mask:
        """Take the rows of a block of time; which (J,) of them it used. stamps_ns: (J,) of each row. seconds: of it."""
        if self._process_rate is not None:
            self._absorb_heave()
            self._drift(seconds)
        if not len(rows):
            return np.zeros(0, dtype=bool)
        use = self._gated(rows)
        folds = folds_of(stamps_ns, self._parameters)
        # by folds also where nobody verifies: sums in one order are the same to the last bit
        by_fold = [(fold, _told(rows, use & (folds == fold))) for fold in sorted(set(folds[use].tolist()))]
        nothing = np.zeros_like(self._information), np.zeros_like(self._vector), np.zeros_like(self._square)
        (total, total_vector, square), *others = (told for _, told in by_fold) if by_fold else (nothing,)
        for information, vector, one in others:
            total, total_vector, square = total + information, total_vector + vector, square + one
        if not (np.isfinite(total).all() and np.isfinite(total_vector).all() and np.isfinite(square).all()):
            return np.zeros(len(rows), dtype=bool)  # it goes on as before these rows
        self._solved = None
        self._square += square
        self._information += total
        self._regressor_noise += rows.weight[use] @ rows.regressor_noise[use]
        self._vector += total_vector
        weight = rows.weight * use
        self.blocks.add(*self._with_terms(total, total_vector, rows, weight, stamps_ns), float(weight.sum()))
        self._heave.add_sums(stamps_ns, rows.heave, use)
        self._learn_heave()
        if self._folds is not None:
            for fold, (information, vector, _) in by_fold:
                self._folds.add(fold, information, vector)
        return use

    def _with_terms(
        self, information: Array, vector: Array, rows: DelayedRows, weight: Array, stamps_ns: Stamps
    ) -> tuple[Array, Array]:
        """What rows of this weight (J,) and with these stamps (J,) told, with what it says of the heading's error."""
        if self._epoch_ns is None:
            self._epoch_ns = int(stamps_ns[0])
        seconds = 1e-9 * float((stamps_ns - self._epoch_ns).mean())
        return with_terms(information, vector, heading_terms(rows.motion.earth, weight, seconds), self._up)

    def misfits(self, rows: DelayedRows) -> tuple[Array, Array]:
        """What all hypotheses would make of further rows, nothing being changed.

        Returns by how much the rows raise zᵀR⁻¹z of each (K,), and the logarithm (K,) of how likely each then is.
        """
        found = self._solve()
        level = self._level(found, int(np.argmax(found.log_evidence)))
        told, told_vector, square = _told(rows, np.ones(len(rows), dtype=bool))
        information, vector = found.information + told, found.vector + told_vector
        x = np.linalg.solve(information, vector[..., None])[..., 0]
        raised = square + np.einsum("ki,ki->k", found.x, found.vector) - np.einsum("ki,ki->k", x, vector)
        log_det = np.linalg.slogdet(information)[1] - np.linalg.slogdet(found.information)[1]
        return raised, (found.log_evidence - 0.5 * (raised + log_det)) / level + self._log_prior

    def _learn_heave(self) -> None:
        """One variance for all hypotheses, that of the best: else a wrong one would excuse itself by its own."""
        best = [int(np.argmax(self._shares()[1]))]
        p = np.linalg.inv(self._information[best])
        x = (p @ self._vector[best][..., None])[..., 0]
        sums = self._heave.sums()
        own = HeaveSums(sums.told[best], sums.scatter[best], sums.weight)
        with suppress(np.linalg.LinAlgError):  # numbers that run away: what was learnt before is kept
            _, variance = with_heave(GaussianState(x, 0.5 * (p + p.swapaxes(1, 2))), own, self._parameters.motion_std)
            if np.isfinite(variance[0]) and variance[0] != self._heave_variance:
                self._heave_variance = float(variance[0])
                self._solved = None

    def _absorb_heave(self) -> None:
        """Under a random walk what a row tells ages with the rest."""
        sums, by_fold = self._heave.absorb()
        told = sums.told / self._heave_variance
        if self._folds is not None:
            of_all = slice(None)
            weighed = by_fold / self._heave_variance
            self._folds.add(of_all, weighed[..., :N_STATE, :N_STATE], weighed[..., :N_STATE, N_STATE])
        self._information += told[:, :N_STATE, :N_STATE]
        self._vector += told[:, :N_STATE, N_STATE]
        self._square += told[:, N_STATE, N_STATE]
        self._solved = None

    def _drift(self, seconds: float) -> None:
        """Random walk over so many seconds: P grows, x stays, and so does the misfit."""
        assert self._process_rate is not None
        p = np.linalg.inv(self._information)
        x = (p @ self._vector[..., None])[..., 0]
        misfit = self._square - np.einsum("ki,ki->k", x, self._vector)
        before = np.linalg.slogdet(self._information)[1]
        self._information = np.linalg.inv(p + self._process_rate * seconds)
        self._log_det += np.linalg.slogdet(self._information)[1] - before
        self._vector = (self._information @ x[..., None])[..., 0]
        self._square = misfit + np.einsum("ki,ki->k", self._vector, x)
        self._solved = None

    def _gated(self, rows: DelayedRows) -> Mask:
        """Which rows are used (J,): those that any hypothesis explains, by the level of recent innovations.

        A wrong hypothesis must not throw out what contradicts it, so all use the same samples; a lever arm that is not
        known yet is in S.
        """
        nis = _innovation_squared(self._solve(), rows).min(axis=0)
        use = np.ones(len(rows), dtype=bool)
        if len(self._recent) >= ENOUGH:
            level = max(1.0, float(median(np.array(self._recent))) / MEDIAN_NIS)
            use = nis <= self._gate * level
        self._recent = (self._recent + nis.tolist())[-RECENT:]
        self.used += int(use.sum())
        self.gated += int((~use).sum())
        self._nis_sum += float(nis[use].sum())
        return use

    def _solve(self, without: int | None = None) -> Hypotheses:
        """All hypotheses by what is known; remembered, but for those without a fold, until more is."""
        if without is None and self._solved is not None:
            return self._solved
        information, vector = self._information, self._vector
        if without is not None:
            assert self._folds is not None
            told, told_vector = self._folds.of(without)
            information, vector = information - told, vector - told_vector
        heave = self._heave.sums(without).told / self._heave_variance
        information, vector = information + heave[:, :N_STATE, :N_STATE], vector + heave[:, :N_STATE, N_STATE]
        log_det = np.linalg.slogdet(information)[1] - self._log_det
        p = np.linalg.inv(information)
        p = 0.5 * (p + p.swapaxes(1, 2))
        x = (p @ vector[..., None])[..., 0]
        misfit = self._square + heave[:, N_STATE, N_STATE] - np.einsum("ki,ki->k", x, vector)
        found = Hypotheses(x, p, misfit, -0.5 * (misfit + log_det), information, vector)
        if without is None:
            self._solved = found
        return found

    def _level(self, found: Hypotheses, best: int) -> float:
        freedom = 3.0 * self.blocks.weight - N_STATE
        return max(1.0, float(found.misfit[best]) / freedom) if freedom > 0.0 else 1.0

    def found(self) -> Found:
        """What is known as of now."""
        found, log_share = self._shares()
        best = int(np.argmax(log_share))
        kept, share = _likely(log_share)
        likely = GaussianState(found.x[kept], found.p[kept])
        if self._process_rate is not None:
            ones: Array = np.ones(N_STATE)
            return Found(likely, kept, share, self._shown(best, ones), ones, None, 0.0)
        deviation = self._deviation(likely, kept, int(np.searchsorted(kept, best)))
        likely = GaussianState(likely.x + deviation.shift, likely.p + deviation.more)
        shown = self._shown(best, deviation.inflation)
        return Found(likely, kept, share, shown, deviation.inflation, deviation.coefficients, deviation.drifted)

    def posteriors(self, found: Sequence[Found]) -> list[Posterior]:
        """The mixture of all hypotheses, as it was found on this day each time.

        Raises numpy.linalg.LinAlgError where one of them is a configuration so wrong that the errors have no small
        angles.
        """
        if not found:
            return []
        held = GaussianState(*(np.concatenate(each) for each in zip(*(each.likely for each in found), strict=True)))
        kept = np.concatenate([each.kept for each in found])
        errors = self._prior_on_errors.part(kept).to_errors(held)
        ends = np.cumsum([len(each.kept) for each in found])
        return [
            self._posterior(
                each, GaussianState(errors.x[end - len(each.kept) : end], errors.p[end - len(each.kept) : end])
            )
            for each, end in zip(found, ends.tolist(), strict=True)
        ]

    def _posterior(self, found: Found, errors: GaussianState) -> Posterior:
        state = _one(errors, found.kept, found.share)
        raised = state.raised(found.inflation).turned(self._up, found.drifted)
        p = state.p
        turns = np.linalg.solve(p[LEVER_ARM, LEVER_ARM], p[LEVER_ARM, :3])  # (lever arm, misalignment)
        by_lever_arm = (p[:3, LEVER_ARM] * turns.T).sum(axis=1)
        rest = np.maximum(np.diag(p)[:3] - by_lever_arm, 1e-12)
        turned = np.abs(turns).max(axis=0)
        # of what is not shown nothing is claimed
        claimed = with_states_of(raised, self.prior, _without(found.shown, _BEYOND))
        return Posterior(claimed, found.shown, found.inflation, turned, by_lever_arm / rest, found.heading)

    def days(self) -> list[DayState]:
        """What the states were on every day but this one, by all data so far, σ raised as it was at the day's end."""
        found, log_share = self._shares()
        states = self._on_days_before(self._mixture(found, log_share), self._held(found, log_share), 0)
        days = []
        for ended, (x, p) in zip(self._ended, states, strict=True):
            raised = GaussianState(x, p).raised(ended.inflation)
            claimed = with_states_of(raised, self._unknown, _without(ended.shown, OF_DAY))
            days.append(DayState(claimed, ended.shown))
        return days

    def without_folds(self) -> list[list[GaussianState]]:
        """For every fold the states of every day had the bank not seen it, delays being as likely as by all data.

        What all data do not show is taken to be as it was known before, for what is verified is what is published.
        """
        of_all, log_share = self._shares()
        best = int(np.argmax(log_share))
        shown = self._shown(best, self._inflation(best, of_all))
        nothing = np.zeros((N_STATE, N_STATE))
        known, unknown = GaussianState(self.prior.x, nothing), GaussianState(self._unknown.x, nothing)
        is_of_day = np.isin(np.arange(N_STATE), OF_DAY)
        folds = []
        for fold in range(FOLDS):
            found = self._solve(fold)
            last = self._mixture(found, log_share)
            before = self._on_days_before(last, self._held(found, log_share), 1 + fold) if self._ended else []
            states = [
                with_states_of(state, unknown, _without(np.where(is_of_day, ended.shown, shown), _BEYOND))
                for state, ended in zip(before, self._ended, strict=True)
            ]
            folds.append([*states, with_states_of(last, known, _without(shown, _BEYOND))])
        return folds

    def _on_days_before(self, last: GaussianState, held: GaussianState, fold: int) -> list[GaussianState]:
        """The states (n,) of days that are over, by what later ones say of the vehicle (Rauch, Tung, Striebel).

        last: of this day, in the errors; held: the same as the filter has it. fold: place in `_Ended.known`.
        """
        on = np.delete(np.arange(N_STATE), OF_DAY)
        states = []
        for ended in self._ended:
            x, p = ended.known[fold]
            gain = p[np.ix_(OF_DAY, on)] @ np.linalg.inv(p[np.ix_(on, on)])
            if self._process_rate is not None:  # what later days say of this one is then forgotten by and by
                gain = np.zeros_like(gain)
            of_day = x[OF_DAY] + gain @ (held.x[on] - x[on])
            gained = p[np.ix_(on, on)] - held.p[np.ix_(on, on)]
            left = GaussianState(last.x.copy(), last.p.copy())
            left.x[OF_DAY] = of_day
            cross = last.p[np.ix_(on, on)] @ gain.T
            left.p[np.ix_(on, OF_DAY)], left.p[np.ix_(OF_DAY, on)] = cross, cross.T
            left.p[np.ix_(OF_DAY, OF_DAY)] = p[np.ix_(OF_DAY, OF_DAY)] - gain @ gained @ gain.T
            states.append(left)
        return states

    def _shares(self) -> tuple[Hypotheses, Array]:
        """All hypotheses, and the logarithm (K,) of how likely each is."""
        found = self._solve()
        # a first level from the best as claimed; tempering does not change which that is but for the prior
        level = self._level(found, int(np.argmax(found.log_evidence)))
        return found, found.log_evidence / level + self._log_prior

    def _inflation(self, best: int, found: Hypotheses) -> Array:
        """By how much blocks of time raise σ of each state (n,)."""
        if self._process_rate is not None:
            return np.ones(N_STATE)
        of_one = np.array([best])
        return self._deviation(GaussianState(found.x[of_one], found.p[of_one]), of_one, 0).inflation

    def _deviation(self, states: GaussianState, numbers: Index, best: int) -> HeadingStates:
        """How the heading deviates by hypotheses x (M, n), P (M, n, n) with these numbers (M,); best: place of one."""
        return heading_states(self.blocks, states, numbers, best, self._parameters.heading_deviation_std)

    def _mixture(self, found: Hypotheses, log_share: Array) -> GaussianState:
        """All hypotheses as one, in the errors."""
        kept, share = _likely(log_share)
        errors = self._prior_on_errors.part(kept).to_errors(GaussianState(found.x[kept], found.p[kept]))
        return _one(errors, kept, share)

    def _held(self, found: Hypotheses, log_share: Array) -> GaussianState:
        """`_mixture` as the filter has the states."""
        kept, share = _likely(log_share)
        return _one(GaussianState(found.x[kept], found.p[kept]), kept, share)

    def _shown(self, best: int, inflation: Array) -> Mask:
        """Which states (n,) the data show even if everything else were known much worse than the prior says."""
        prior_std = np.sqrt(np.diag(self.prior.p))
        known_before = prior_std <= SHOWN_SHARE * self._unknown_std
        heave = self._heave.sums().told[best, :N_STATE, :N_STATE] / self._heave_variance
        data = self._information[best] + heave - np.linalg.inv(self._start.p[best])
        # what noise of regressors seems to tell is told by nothing
        share = np.ones(N_STATE)
        share[BEYOND] = np.clip(1.0 - self._regressor_noise / np.maximum(np.diag(data)[BEYOND], 1e-300), 0.0, 1.0)
        data = data * np.sqrt(share)[:, None] * np.sqrt(share)
        wide = np.diag((WIDER * self._unknown_std) ** -2)
        variance = np.diag(np.linalg.inv(data + wide))  # below zero where a random walk has taken more than data gave
        std = np.sqrt(np.where(variance > 0.0, variance, np.inf)) * inflation
        shown: Mask = (std <= SHOWN_SHARE * self._unknown_std) | known_before
        return shown


def _without(shown: Mask, of: Index) -> Index:
    """Those `of` the states that are not shown (n,)."""
    return of[~shown[of]]


def _told(rows: DelayedRows, use: Mask) -> tuple[Array, Array, Array]:
    """What some rows tell each hypothesis: HᵀWH (K, n, n), HᵀWz (K, n), zᵀWz (K,)."""
    some = rows if use.all() else rows.part(use)
    k = len(some.moving)
    moving, standing = some.moving.reshape(k, len(_MOVING), -1), some.standing.reshape(len(OF_NONE), -1)
    weight = np.concatenate([some.weight] * 3)
    weighted = moving * weight
    told = np.zeros((k, N_STATE + 1, N_STATE + 1))
    across = (weighted.reshape(-1, len(weight)) @ standing.T).reshape(k, len(_MOVING), len(OF_NONE))
    told[:, _MOVING[:, None], _MOVING] = weighted @ moving.swapaxes(1, 2)
    told[:, _MOVING[:, None], OF_NONE], told[:, OF_NONE[:, None], _MOVING] = across, across.swapaxes(1, 2)
    told[:, OF_NONE[:, None], OF_NONE] = (standing * weight) @ standing.T
    return told[:, :N_STATE, :N_STATE], told[:, :N_STATE, N_STATE], told[:, N_STATE, N_STATE]


def _innovation_squared(found: Hypotheses, rows: DelayedRows) -> Array:
    """νᵀS⁻¹ν (K, J) of rows, each by itself, with S = HPHᵀ + 1 and P = LLᵀ: HPHᵀ is the square of LᵀHᵀ."""
    k, _, _, n = rows.moving.shape
    h, z = rows.moving[:, :-1].reshape(k, len(OF_DELAY), 3 * n), rows.moving[:, -1]
    standing = rows.standing.reshape(len(OF_NONE), 3 * n)
    expected = found.x[:, None, OF_DELAY] @ h
    expected[:, 0] += found.x[:, OF_NONE] @ standing
    innovation = z - expected.reshape(z.shape)
    # what is the same for all delays first: then most of the root is none of its business
    low = np.linalg.cholesky(found.p[:, _SHOWN_BY_ROWS[:, None], _SHOWN_BY_ROWS]).swapaxes(1, 2)
    m = len(OF_NONE)
    spread = np.empty((k, len(_SHOWN_BY_ROWS), 3 * n))
    np.matmul(low[:, :, m:], h, out=spread)
    spread[:, :m] += (np.ascontiguousarray(low[:, :m, :m]).reshape(-1, m) @ standing).reshape(k, m, 3 * n)
    spread = spread.reshape(k, -1, 3, n)
    s = [
        [np.einsum("kaj,kaj->kj", spread[:, :, i], spread[:, :, j]) + float(i == j) for j in range(i + 1)]
        for i in range(3)
    ]
    return distance_squared(s, [*innovation.swapaxes(0, 1)])


def _likely(log_share: Array) -> tuple[Index, Array]:
    """Which hypotheses are in the mixture, and the share of each."""
    share = np.exp(log_share - log_share.max())
    share[share < SMALLEST_SHARE] = 0.0
    kept = np.flatnonzero(share)
    return kept, share[kept] / share[kept].sum()


def _one(states: GaussianState, kept: Index, share: Array) -> GaussianState:
    """Hypotheses x (M, n), P (M, n, n), by the numbers kept (M,) of their delays, as one; its delay is the whole."""
    x = states.x.copy()
    x[:, DELAY] += DELAYS_S[kept]
    mean = share @ x
    apart = x - mean
    p = np.einsum("k,kij->ij", share, states.p) + np.einsum("k,ki,kj->ij", share, apart, apart)
    return GaussianState(mean, 0.5 * (p + p.T))


def _around_each_delay(prior: GaussianState) -> GaussianState:
    """The prior of each hypothesis, x (K, n), P (K, n, n): as if the delay had been measured to be its own.

    So the mixture of all is the prior, and each is linear where it stands.
    """
    gain = prior.p[:, DELAY] / (prior.p[DELAY, DELAY] + CELL_STD_S**2)
    p = prior.p - np.outer(gain, prior.p[DELAY])
    x = prior.x + (DELAYS_S - prior.x[DELAY])[:, None] * gain
    x[:, DELAY] -= DELAYS_S
    return GaussianState(x, np.broadcast_to(p, (len(DELAYS_S), *p.shape)).copy())
