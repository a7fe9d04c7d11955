"""G2's filter: a bank of delays side by side, each with a linear least-squares fit of everything else.

A delay of seconds is no small error: no linearisation about zero finds it. Each of K hypotheses holds the information
(Λ, Λx) of G1's states, lever arm and of how much more than its own the delay is; its evidence says how well it
explains the data. What is published is the mixture of all, moment-matched: on a straight run no hypothesis is better
than another, and the delay's standard deviation stays that of the prior.

Noise that is larger than claimed, or correlated, would make evidence and covariance overconfident: evidence is
divided by the best hypothesis' own mean squared innovation, and standard deviations grow to what blocks of time
show (block_covariance.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import reduce

import numpy as np

from ..filters.cross_validation import FOLDS, FoldInformation, folds_of, with_states_of
from ..filters.heading_bias import (
    BiasCovariance,
    HeadingEvidence,
    all_told,
    block_terms,
    heading_states,
    prior_std,
    turns_of,
    with_terms,
)
from ..filters.vertical_motion import HeaveRows, HeaveSums, with_heave
from ..models.own import BEYOND, DELAY, LEVER_ARM, N_ERRORS, N_STATE
from ..models.parameters import Parameters
from ..numerics.block_covariance import TimeBlocks
from ..numerics.error_model import PriorOnErrors, of_unseen_roll, to_correction
from ..numerics.frames import Array, product
from ..numerics.kalman import GaussianState
from ..numerics.robust import median
from ..numerics.samples import Index, Mask
from .normal_equations import (
    CELL_STD_S,
    ExpectedBlocks,
    conditioned,
    likely_hypotheses,
    merged_mixture,
    not_observed,
    prior_by_delay,
    told_by,
)
from .observation_rows import DELAYS_S, OF_DAY, STEP_S, STEPS, DelayedRows
from .posterior_types import After, BlockRows, DayState, Ended, Hypotheses, Known, Likely, Posterior, Sums, Told, parts

# A gate compares with the innovations of so many of the newest samples, once there are ENOUGH.
RECENT, ENOUGH = 256, 20
# Median of chi-square with three degrees of freedom.
MEDIAN_NIS = 2.366
# Hypotheses that are less likely by so much more, in logarithms, have lost for the rest of the day.
LOST = 100.0
# A state is shown by the data if these alone, with priors of all else wider by this, have halved its prior σ.
WIDER, SHOWN_SHARE = 100.0, 0.5


_BEYOND: Index = np.arange(N_STATE)[BEYOND]


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
        self._roll = of_unseen_roll(parameters.rotation_dvl_from_body)
        self._begin_day()
        information, vector = self._start.information
        self._ended: list[Ended] = []
        square = np.einsum("ki,ki->k", vector, self._start.x)
        self._sums = Sums(information, vector, square, 0.0, parameters.motion_std**2)
        self._log_det = np.linalg.slogdet(information)[1]
        self._parameters = parameters
        self._heave = HeaveRows(len(DELAYS_S), N_STATE, parameters)
        self._regressor_noise = np.zeros(4)
        self._recent: list[float] = []
        self.used = self.gated = 0
        self._nis_sum = 0.0
        self.blocks = TimeBlocks()
        self._turns = turns_of(parameters.rotation_dvl_from_body, N_STATE)
        self._z = self._turns[:, 2]
        self._up = parameters.up * self._z
        self._std_beside = prior_std(parameters.heading_deviation_std, parameters.dvl_bias_std)
        self._epoch_ns: int | None = None  # of the first row
        self._folds = FoldInformation(self._start) if verified else None

    def _begin_day(self) -> None:
        """What hypotheses start from by the prior alone, of the errors and as the filter has it."""
        prior = self.prior
        self.compared: Index = STEPS
        self._start = prior_by_delay(to_correction(prior, self._roll))
        self._prior_on_errors = PriorOnErrors(self._start, prior_by_delay(prior), self._roll)
        # of a delay's deviation from the prior's mean
        variance = prior.p[DELAY, DELAY] + CELL_STD_S**2
        self._log_prior = -0.5 * (DELAYS_S - prior.x[DELAY]) ** 2 / variance

    @property
    def delays_s(self) -> Array:
        """(K,) of the hypotheses that there are, by `compared`, their `STEPS`."""
        return self.compared * STEP_S

    def narrow(self) -> None:
        """Leave out hypotheses that have lost, but for those next to others.

        They are far from any part in the mixture (`SMALLEST_SHARE`), and samples that only they explain are outliers.
        What would bring one back on the same day is a clock that leaps, which registration looks for.
        """
        _, log_share = self._shares()
        left = np.flatnonzero(log_share > log_share.max() - LOST)
        kept = np.arange(max(left[0] - 1, 0), min(left[-1] + 2, len(log_share)))
        if len(kept) == len(log_share):
            return
        self.compared = self.compared[kept]
        self._start = GaussianState(self._start.x[kept], self._start.p[kept])
        self._prior_on_errors = self._prior_on_errors.part(kept)
        self._log_prior, self._log_det = self._log_prior[kept], self._log_det[kept]
        told, vector, square = (each[kept] for each in self._sums[:3])
        self._sums = self._sums._replace(information=told, vector=vector, square=square)
        self._heave.learn_from(kept)
        self.blocks.choose(kept)
        if self._folds is not None:
            self._folds.narrow(kept)
        self._solved = None

    def end_day(self) -> None:
        """Go on with what belongs to the vehicle; delay and constant error of the reference are to be found anew.

        Raises numpy.linalg.LinAlgError, and is as before, where numbers have run away.
        """
        found, log_share = self._shares()
        best = int(np.argmax(log_share))
        inflation, shown = self._shown_now(best, found)
        folds = [None] if self._folds is None else [None, *range(FOLDS)]
        known = [self._held(self._solve(fold), log_share) for fold in folds]
        begins = [prior_by_delay(with_states_of(each, self._unknown, OF_DAY)).information for each in known]
        total = all_told(found.information, found.vector, self.blocks, self._of_heave(slice(None)))
        source = np.full(len(DELAYS_S), best)
        # what can fail has not, and from here on all changes together
        self.blocks.end_day(OF_DAY, *total, source)
        self._ended.append(Ended(known, shown, inflation))
        self._heave.close()
        self._heave.absorb()  # its rows are in what is known
        self._heave.learn_from(source)
        self.prior = with_states_of(self.prior, self._unknown, OF_DAY)
        self._begin_day()
        before = self._sums
        if self._folds is not None:
            self._folds.begin(begins[1:])
        information, vector = begins[0]
        x = np.linalg.solve(information, vector[..., None])[..., 0]
        square = found.misfit[best] + np.einsum("ki,ki->k", vector, x)
        self._sums = before._replace(information=information, vector=vector, square=square)
        self._log_det = np.linalg.slogdet(information)[1]
        self._regressor_noise = np.append(self._regressor_noise[:-1], 0.0)
        self._solved = None

    @property
    def sums(self) -> Sums:
        """What the rows so far told."""
        return self._sums

    @property
    def heave(self) -> HeaveRows:
        """Rows of heave so far."""
        return self._heave

    @property
    def hypotheses(self) -> Hypotheses:
        """All of them, by what is known."""
        return self._solve()

    @property
    def mean_nis(self) -> float:
        """Mean νᵀS⁻¹ν of the samples used, against the hypothesis that explained each best; nan if none."""
        return self._nis_sum / self.used if self.used else float("nan")

    def add(self, blocks: Sequence[BlockRows]) -> list[After]:
        """Take the rows of blocks of time, in order, and say what is known after each.

        Many at once come to the same as one after the other: what they tell is summed up first.
        """
        if len(blocks) > 1:
            # what a row tells ages with each block under a random walk
            if self._process_rate is None and all(len(each.rows) for each in blocks):
                with suppress(np.linalg.LinAlgError):
                    return self._taken(blocks)
            return [self.add([each])[0] for each in blocks]
        if not blocks:
            return []
        if self._process_rate is not None:
            self._absorb_heave()
            self._drift(blocks[0].seconds)
        return self._taken(blocks) if len(blocks[0].rows) else [After(self.used, self.gated, self.mean_nis)]

    def _taken(self, blocks: Sequence[BlockRows]) -> list[After]:
        """`add`. Raises numpy.linalg.LinAlgError, and is as before, where numbers of several blocks run away."""
        expected = ExpectedBlocks(self, blocks)
        if not expected.is_finite:
            if len(blocks) > 1:
                raise np.linalg.LinAlgError("what a block tells is not finite")
            self._count(expected.nis[0], expected.use[0])  # it goes on as before these rows
            return [After(self.used, self.gated, self.mean_nis, self.known())]
        after = []
        taken = zip(blocks, expected.use, expected.nis, expected.told, expected.steps, strict=True)
        for number, ((rows, stamps_ns, _), use, nis, told, (sums, found)) in enumerate(taken):
            self._count(nis, use)
            self._sums, self._solved = sums, found
            self._regressor_noise = self._regressor_noise + rows.weight[use] @ rows.regressor_noise[use]
            weight = rows.weight * use
            if self._epoch_ns is None:
                self._epoch_ns = int(stamps_ns[0])
            seconds = 1e-9 * float((stamps_ns - self._epoch_ns).mean())
            velocity, off = rows.motion.velocities(rows.body_from_dvl)
            terms = block_terms(rows.motion.earth, velocity, off, weight, seconds, self._turns, N_ERRORS)
            information, vector, _ = told.parts
            self.blocks.add(*with_terms(information, vector, terms), told.weight)
            if self._folds is not None:
                for fold, of_fold in told.by_fold:
                    self._folds.add_told(fold, of_fold)
            after.append(After(self.used, self.gated, self.mean_nis, self.known(expected.rows[number])))
        self._heave = expected.heave
        return after

    def _count(self, nis: Array, use: Mask) -> None:
        self._recent = (self._recent + nis.tolist())[-RECENT:]
        self.used += int(use.sum())
        self.gated += int((~use).sum())
        self._nis_sum += float(nis[use].sum())

    def gated_by(self, nis: Sequence[Array]) -> list[Mask]:
        """Which rows of blocks to come are used, by their innovations (J,): not those that no hypothesis explains.

        A wrong hypothesis must not throw out what contradicts it, so all use the same samples; a lever arm that is not
        known yet is in S. The level is that of recent innovations.
        """
        recent, uses = self._recent, []
        for each in nis:
            use = np.ones(len(each), dtype=bool)
            if len(recent) >= ENOUGH:
                level = max(1.0, float(median(np.array(recent))) / MEDIAN_NIS)
                use = each <= self._gate * level
            recent = (recent + each.tolist())[-RECENT:]
            uses.append(use)
        return uses

    def told_by(self, block: BlockRows, use: Mask) -> Told:
        """What the rows of a block tell that are used (J,)."""
        folds = folds_of(block.stamps_ns, self._parameters)
        # by folds also where nobody verifies: sums in one order are the same to the last bit
        by_fold = [(fold, told_by(block.rows, use & (folds == fold))) for fold in sorted(set(folds[use].tolist()))]
        of_all: Array = reduce(np.add, (told for _, told in by_fold)) if by_fold else told_by(block.rows, use)
        return Told(of_all, float((block.rows.weight * use).sum()), by_fold)

    def steps(self, start: Sums, told: Sequence[Told], heave: Sequence[HeaveSums]) -> list[tuple[Sums, Hypotheses]]:
        """What is summed up, and all hypotheses by it, after each of some blocks. heave: rows of heave by then."""
        if not told:
            return []
        information, vector, square, weight = (
            np.add.accumulate(np.stack([np.asarray(first), *more]))[1:]
            for first, more in zip(
                start[:4], zip(*((*each.parts, each.weight) for each in told), strict=True), strict=True
            )
        )
        rows = HeaveSums.stacked(heave)

        def solved(variance: Array) -> Hypotheses:
            return self._hypotheses(information, vector, square, rows.told / variance[:, None, None, None])

        # one variance of heave for all hypotheses, that of the best: else a wrong one would excuse itself by its own
        before = np.full(len(told), start.heave_variance)
        best: Index | None = None
        while True:
            found = solved(before)
            newly_best = np.argmax(self._log_shares(found, weight), axis=1)
            if best is not None and (newly_best == best).all():
                break
            best = newly_best
            variance = self._learnt(information, vector, best, rows, before)
            of_block_before = np.append(before[:1], variance[:-1])
            if (of_block_before == before).all():
                break
            before = of_block_before
        if (variance != before).any():
            found = solved(variance)
        return [
            (Sums(told_by_then, y, z2, float(of), float(moves)), Hypotheses(*each))
            for told_by_then, y, z2, of, moves, each in zip(
                information, vector, square, weight, variance, zip(*found, strict=True), strict=True
            )
        ]

    def _learnt(self, information: Array, vector: Array, best: Index, heave: HeaveSums, before: Array) -> Array:
        """Variance (S,) of heave after S blocks, by the best hypothesis each time, which was `before`."""
        at = np.arange(len(best)), best
        p = np.linalg.inv(information[at])
        x = product(p, vector[at])
        own = HeaveSums(heave.told[at], heave.scatter[at], heave.mean[at], heave.weight[:, 0])
        try:
            _, variance = with_heave(GaussianState(x, 0.5 * (p + p.swapaxes(1, 2))), own, self._parameters.motion_std)
        except np.linalg.LinAlgError:
            if len(best) > 1:
                raise
            return before  # numbers that run away: what was learnt before is kept
        if len(best) > 1 and not np.isfinite(variance).all():
            raise np.linalg.LinAlgError("a variance of heave that is not finite")
        return np.where(np.isfinite(variance), variance, before)

    def misfits(self, rows: DelayedRows) -> tuple[Array, Array]:
        """What all hypotheses would make of further rows, nothing being changed.

        Returns by how much the rows raise zᵀR⁻¹z of each (K,), and the logarithm (K,) of how likely each then is.
        """
        found = self._solve()
        level = self._level(found, self._sums.weight)
        told, told_vector, square = parts(told_by(rows, np.ones(len(rows), dtype=bool)))
        information, vector = found.information + told, found.vector + told_vector
        x = np.linalg.solve(information, vector[..., None])[..., 0]
        raised = square + np.einsum("ki,ki->k", found.x, found.vector) - np.einsum("ki,ki->k", x, vector)
        log_det = np.linalg.slogdet(information)[1] - np.linalg.slogdet(found.information)[1]
        return raised, (found.log_evidence - 0.5 * (raised + log_det)) / level + self._log_prior

    def _absorb_heave(self) -> None:
        """Under a random walk what a row tells ages with the rest."""
        rows, by_fold = self._heave.absorb()
        sums, variance = self._sums, self._sums.heave_variance
        told = rows.told / variance
        if self._folds is not None:
            self._folds.add_told(slice(None), by_fold / variance)
        self._sums = sums._replace(
            information=sums.information + told[:, :N_STATE, :N_STATE],
            vector=sums.vector + told[:, :N_STATE, N_STATE],
            square=sums.square + told[:, N_STATE, N_STATE],
        )
        self._solved = None

    def _drift(self, seconds: float) -> None:
        """Random walk over so many seconds: P grows, x stays, and so does the misfit."""
        assert self._process_rate is not None
        sums = self._sums
        p = np.linalg.inv(sums.information)
        x = product(p, sums.vector)
        misfit = sums.square - np.einsum("ki,ki->k", x, sums.vector)
        before = np.linalg.slogdet(sums.information)[1]
        information = np.linalg.inv(p + self._process_rate * seconds)
        self._log_det += np.linalg.slogdet(information)[1] - before
        vector = product(information, x)
        square = misfit + np.einsum("ki,ki->k", vector, x)
        self._sums = sums._replace(information=information, vector=vector, square=square)
        self._solved = None

    def _solve(self, without: int | None = None) -> Hypotheses:
        """All hypotheses by what is known; remembered, but for those without a fold, until more is."""
        if without is None and self._solved is not None:
            return self._solved
        sums = self._sums
        information, vector = sums.information, sums.vector
        if without is not None:
            assert self._folds is not None
            information, vector = self._folds.without(without)
        heave = self._heave.sums(without).told / sums.heave_variance
        found = self._hypotheses(information, vector, sums.square, heave)
        if without is None:
            self._solved = found
        return found

    def _hypotheses(self, information: Array, vector: Array, square: Array, heave: Array) -> Hypotheses:
        """By Λ (..., K, n, n), Λx (..., K, n), zᵀR⁻¹z (..., K) of rows, and rows of heave (..., K, n+1, n+1)."""
        information, vector = information + heave[..., :N_STATE, :N_STATE], vector + heave[..., :N_STATE, N_STATE]
        log_det = np.linalg.slogdet(information)[1] - self._log_det
        p = np.linalg.inv(information)
        p = 0.5 * (p + p.swapaxes(-1, -2))
        x = product(p, vector)
        misfit = square + heave[..., N_STATE, N_STATE] - np.einsum("...i,...i->...", x, vector)
        return Hypotheses(x, p, misfit, -0.5 * (misfit + log_det), information, vector)

    def _level(self, found: Hypotheses, weight: Array | float) -> Array:
        """(...,) by how much more the best hypothesis misses the data than they claim. weight (...,): of the data."""
        best = np.argmax(found.log_evidence, axis=-1)
        misfit = np.take_along_axis(found.misfit, best[..., None], axis=-1)[..., 0]
        freedom = np.asarray(3.0 * weight - N_STATE)
        return np.where(freedom > 0.0, np.maximum(1.0, misfit / np.where(freedom > 0.0, freedom, 1.0)), 1.0)

    def _log_shares(self, found: Hypotheses, weight: Array | float) -> Array:
        """The logarithm (..., K) of how likely each hypothesis is."""
        # a first level from the best as claimed; tempering does not change which that is but for the prior
        shares: Array = found.log_evidence / self._level(found, weight)[..., None] + self._log_prior
        return shares

    def known(self, heave: HeaveSums | None = None) -> Known:
        """What is known as of now, to be `found`. heave: its rows by now, if not all that there are."""
        found, log_share = self._shares()
        best = int(np.argmax(log_share))
        kept, share = likely_hypotheses(log_share)
        likely = GaussianState(found.x[kept], found.p[kept])
        place = int(np.searchsorted(kept, best))
        seen = None if self._process_rate is not None else self._seen(likely, kept, place, heave)
        return Known(likely, kept, share, best, found.information[best], self._regressor_noise, seen)

    def _seen(
        self, states: GaussianState, numbers: Index, best: int, heave: HeaveSums | None = None
    ) -> HeadingEvidence:
        """By blocks of time and by heave, of some hypotheses (M,). heave: as in `known`."""
        return HeadingEvidence.of(self.blocks, states, numbers, best, self._of_heave(numbers, heave))

    def _of_heave(self, numbers: Index | slice, heave: HeaveSums | None = None) -> tuple[Array, Array]:
        """What rows of heave tell of some hypotheses (M,), as of `HeaveSums.with_terms`. heave: as in `known`."""
        sums = heave or self._heave.sums()
        some = sums._replace(told=sums.told[numbers], mean=sums.mean[numbers])
        return some.with_terms(self._sums.heave_variance, self._z[:3])

    def found(self, known: Sequence[Known]) -> list[Likely | None]:
        """What was known at times of this day, with what that makes of the heading; None where numbers ran away."""
        if not known:
            return []
        try:
            return [*self._found(known)]
        except np.linalg.LinAlgError:
            return [None] if len(known) == 1 else [self.found([each])[0] for each in known]

    def _found(self, known: Sequence[Known]) -> Iterator[Likely]:
        seen = [each.seen for each in known if each.seen is not None]
        deviations = heading_states(seen, self._std_beside, self._up)
        inflations: Array = np.ones((len(known), N_STATE))
        if deviations:
            inflations = np.stack([each.inflation for each in deviations])
        information, noise = (
            np.stack(each) for each in zip(*((k.information, k.regressor_noise) for k in known), strict=True)
        )
        shown = self._shown([each.best for each in known], information, noise, inflations)
        for number, each in enumerate(known):
            likely, heading, of_bias, drifted = each.likely, None, BiasCovariance.none(N_STATE), 0.0
            if deviations:
                heading, shift, more, of_each, drifted, _ = deviations[number]
                likely = GaussianState(likely.x + shift, likely.p + more)
                of_bias = of_each.mixed(each.share)
            yield Likely(likely, each.kept, each.share, shown[number], inflations[number], heading, of_bias, drifted)

    def posteriors(self, found: Sequence[Likely]) -> list[Posterior]:
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

    def _posterior(self, found: Likely, errors: GaussianState) -> Posterior:
        state = merged_mixture(errors, self.delays_s[found.kept], found.share)
        raised = state.raised(found.inflation).turned(self._z, found.drifted)
        p = state.p
        turns = np.linalg.solve(p[LEVER_ARM, LEVER_ARM], p[LEVER_ARM, :3])  # (lever arm, misalignment)
        by_lever_arm = (p[:3, LEVER_ARM] * turns.T).sum(axis=1)
        rest = np.maximum(np.diag(p)[:3] - by_lever_arm, 1e-12)
        turned = np.abs(turns).max(axis=0)
        # of what is not shown nothing is claimed
        unclaimed = not_observed(found.shown, _BEYOND)
        of_bias = found.of_bias.where(~np.isin(np.arange(N_STATE), unclaimed))
        claimed = with_states_of(raised, self.prior, unclaimed)
        return Posterior(claimed, found.shown, found.inflation, turned, by_lever_arm / rest, found.heading, of_bias)

    def days(self) -> list[DayState]:
        """What the states were on every day but this one, by all data so far, σ raised as it was at the day's end."""
        found, log_share = self._shares()
        states = self._on_days_before(self._mixture(found, log_share), self._held(found, log_share), 0)
        days = []
        for ended, (x, p) in zip(self._ended, states, strict=True):
            raised = GaussianState(x, p).raised(ended.inflation)
            claimed = with_states_of(raised, self._unknown, not_observed(ended.shown, OF_DAY))
            days.append(DayState(claimed, ended.shown))
        return days

    def without_folds(self) -> list[list[GaussianState]]:
        """For every fold the states of every day had the bank not seen it, delays being as likely as by all data.

        What all data do not show is taken to be as it was known before, for what is verified is what is published.
        """
        of_all, log_share = self._shares()
        best = int(np.argmax(log_share))
        _, shown = self._shown_now(best, of_all)
        nothing = np.zeros((N_STATE, N_STATE))
        known, unknown = GaussianState(self.prior.x, nothing), GaussianState(self._unknown.x, nothing)
        is_of_day = np.isin(np.arange(N_STATE), OF_DAY)
        folds = []
        for fold in range(FOLDS):
            found = self._solve(fold)
            last = self._mixture(found, log_share)
            before = self._on_days_before(last, self._held(found, log_share), 1 + fold) if self._ended else []
            states = [
                with_states_of(state, unknown, not_observed(np.where(is_of_day, ended.shown, shown), _BEYOND))
                for state, ended in zip(before, self._ended, strict=True)
            ]
            if not shown[BEYOND].any():  # and the rest by it, as of a model that takes lever arm and delay as known
                last = conditioned(last, _BEYOND, self.prior.x[BEYOND])
            folds.append([*states, with_states_of(last, known, not_observed(shown, _BEYOND))])
        return folds

    def _on_days_before(self, last: GaussianState, held: GaussianState, fold: int) -> list[GaussianState]:
        """The states (n,) of days that are over, by what later ones say of the vehicle (Rauch, Tung, Striebel).

        last: of this day, in the errors; held: the same as the filter has it. fold: place in `Ended.known`.
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
        return found, self._log_shares(found, self._sums.weight)

    def _inflation(self, best: int, found: Hypotheses) -> Array:
        """By how much blocks of time raise σ of each state (n,)."""
        if self._process_rate is not None:
            return np.ones(N_STATE)
        of_one = np.array([best])
        seen = self._seen(GaussianState(found.x[of_one], found.p[of_one]), of_one, 0)
        return heading_states([seen], self._std_beside, self._up)[0].inflation

    def _mixture(self, found: Hypotheses, log_share: Array) -> GaussianState:
        """All hypotheses as one, in the errors."""
        kept, share = likely_hypotheses(log_share)
        errors = self._prior_on_errors.part(kept).to_errors(GaussianState(found.x[kept], found.p[kept]))
        return merged_mixture(errors, self.delays_s[kept], share)

    def _held(self, found: Hypotheses, log_share: Array) -> GaussianState:
        """`_mixture` as the filter has the states."""
        kept, share = likely_hypotheses(log_share)
        return merged_mixture(GaussianState(found.x[kept], found.p[kept]), self.delays_s[kept], share)

    def _shown_now(self, best: int, found: Hypotheses) -> tuple[Array, Mask]:
        """By how much blocks of time raise σ of each state (n,), and which (n,) the data show."""
        inflation = self._inflation(best, found)
        return inflation, self._shown(
            [best], found.information[best][None], self._regressor_noise[None], inflation[None]
        )[0]

    def _shown(self, best: Sequence[int], information: Array, regressor_noise: Array, inflation: Array) -> Mask:
        """Which states (S, n) the data show even if everything else were known much worse than the prior says."""
        prior_std = np.sqrt(np.diag(self.prior.p))
        known_before = prior_std <= SHOWN_SHARE * self._unknown_std
        data = information - np.linalg.inv(self._start.p[best])
        # what noise of regressors seems to tell is told by nothing
        share: Array = np.ones(inflation.shape)
        told = np.maximum(np.diagonal(data, axis1=1, axis2=2)[:, BEYOND], 1e-300)
        share[:, BEYOND] = np.clip(1.0 - regressor_noise / told, 0.0, 1.0)
        data = data * np.sqrt(share)[:, :, None] * np.sqrt(share)[:, None]
        wide = np.diag((WIDER * self._unknown_std) ** -2)
        # below zero where a random walk has taken more than data gave
        variance = np.diagonal(np.linalg.inv(data + wide), axis1=1, axis2=2)
        std = np.sqrt(np.where(variance > 0.0, variance, np.inf)) * inflation
        shown: Mask = (std <= SHOWN_SHARE * self._unknown_std) | known_before
        return shown
