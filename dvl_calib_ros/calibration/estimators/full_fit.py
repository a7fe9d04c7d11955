"""Joint least-squares fit of `full`: takes blocks of time, returns states with covariance.

The method is in docs/models.md, "full: all unknowns in one fit". Blocks are linearised about one point and added to a
chain (slow_errors.py), so each further block costs one step. The point is renewed when a day's number of blocks reaches
a power of two, or when the estimate has moved away from it. Both depend on the blocks only, so live and replay agree.

Shapes: C points of the prior of the slow errors, A combinations of priors, n states of [vehicle, each day].
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ..assessment.dead_reckoning import SlowNoise
from ..checks.beam_faults import N_EFFECTS, BeamFault, most_significant
from ..filters.cross_validation import FOLDS, HeldOutError
from ..models.own import DELAY, FULL, HEADING, LEVER_ARM, N_STATE, PHI, REFERENCE_DELAY, REFERENCE_ERROR, SCALE
from ..models.parameters import Parameters
from ..numerics.block_covariance import BLOCK_S, TimeBlocks
from ..numerics.frames import Array, product
from ..numerics.kalman import GaussianState, covariance_of
from ..numerics.robust import MEDIAN_DISTANCE, ROUNDING_MPS
from ..numerics.samples import Index
from ..results.results import TAPE_STD_M
from .full_delay_search import DelaySums
from .full_forward_model import CONSTANT, FitBlock, bias_by_data, predicted, with_bias_in_mounting
from .full_held_out import INSTRUMENT_ERRORS, HeldOutSums
from .section_rows import (
    GATE_SQUARE,
    CondensedSection,
    ReferenceCounts,
    SectionRows,
    beam_fault_grams,
    masked_median,
    section_starts,
    usual_square,
)
from .slow_errors import Chain, Eliminated, Priors, SlowErrors, gram_of, normal_points, scatter

OF_DAY = FULL.of_day
LINEARISED = np.r_[PHI, SCALE, LEVER_ARM, DELAY, REFERENCE_DELAY]  # states that are not linear
OF_VEHICLE = np.delete(np.arange(N_STATE), OF_DAY)
# The point of linearisation is renewed when an angle, scale, lever arm or delay has moved by this number of σ.
RELINEARISED_FROM = 1.0
# Gauss-Newton steps at a renewal: at most MAX_STEPS, or until a step is below LAST_STEP σ.
MAX_STEPS, LAST_STEP = 8, 0.3
# Blocks whose streams are kept (40 minutes), because a node's memory must not grow. Older ones contribute a fixed sum,
# and registration uses at most the rows of a third of them.
KEPT_BLOCKS = 240
# Points of the slow errors' prior for the numerical integration.
N_POINTS = 16
# The points are re-centred when the data move them by RECENTRED_FROM σ of the prior, at most MAX_RECENTRED times.
RECENTRED_FROM, MAX_RECENTRED = 0.7, 4
# Prior probability of each exception: a wrong configured lever arm, a vehicle that sinks or rises by its trim, one that
# dives, and a large vertical error of the reference.
P_EXCEPTION = 0.1
# A vehicle at the surface or at constant depth ends at the height at which it began, within LEVEL_M (tide, waves) and
# its own excursions; else it sinks or rises by its trim (σ TRIM_STD_MPS), or dives (σ DIVE_STD_MPS).
LEVEL_M, TRIM_STD_MPS, DIVE_STD_MPS = 1.0, 0.02, 0.3
# σ of a large vertical reference error (an antenna's model), m/s, instead of `reference_offset_std`.
OFFSET_STD_MPS = 0.05
# Degrees of freedom needed to estimate the noise of bins.
MIN_DOF = 6
# Squared residual of three axes, in variances, beyond which a row is an outlier.
OUTLIER_SQUARE = 4.0 * GATE_SQUARE
# A section is rejected if its median differs from the others' by GROSS of their σ and by GROSS_MPS (m/s): no slow error
# is so large.
GROSS, GROSS_MPS = 10.0, 0.5
_UNIT_POINTS: Array = normal_points(5, N_POINTS)


@dataclass
class _Day:
    """Blocks of one day (recordings with one DVL delay), and their normal equations about the point of linearisation.

    count: number of blocks so far.
    delays: search of the DVL's delay.
    sections: of the blocks whose streams are kept.
    before: chains of older blocks, with all sections and without each fold. older: their counts.
    chain: of all blocks.
    white: (3,) variance of a bin of weight one.
    single: (3,) variance of a row about its section's median.
    level, level_std: (3,) m/s, median and scatter of the sections' medians.
    """

    blocks: list[FitBlock] = field(default_factory=list)
    count: int = 0
    delays: DelaySums = field(default_factory=DelaySums)
    sections: list[CondensedSection] = field(default_factory=list)
    before: list[Chain] | None = None
    older: ReferenceCounts = field(default_factory=ReferenceCounts)
    chain: Chain | None = None
    begin_s: float = math.nan
    end_s: float = math.nan
    white: Array = field(default_factory=lambda: np.full(3, math.nan))
    single: Array = field(default_factory=lambda: np.full(3, math.nan))
    level: Array = field(default_factory=lambda: np.zeros(3))
    level_std: Array = field(default_factory=lambda: np.full(3, math.inf))


class _PriorPoints(NamedTuple):
    """Points of the slow errors' prior: slow errors (C, 7), and scales of the heading deviation (C,).

    log_weight: (C,) log importance weights.
    """

    slow: SlowErrors
    deviation: Array
    log_weight: Array


class _PriorInformation(NamedTuple):
    """Information of the prior (C, n, n), its product with the state (C, n), and -log determinant (C,)."""

    information: Array
    vector: Array
    log_det: Array


class _Climb(NamedTuple):
    """Mean velocity upwards of a day by its DVL.

    at: (20,) indices of its states.
    row: (21,) derivatives by these, and m/s at zero states.
    std: m/s, of a vehicle that is level.
    """

    at: Index
    row: Array
    std: float


class _Hypotheses(NamedTuple):
    """A combinations of priors and B vertical paths of the vehicle, at C points of the slow errors, over n states.

    information: (A, C, n, n), its product with the state (A, C, n), and -log determinant (A, C).
    log_odds: (A, B) of each combination and path.
    climb_mps: (B,) m/s, σ of a day's mean climb.
    """

    information: Array
    vector: Array
    log_det: Array
    log_odds: Array
    climb_mps: Array


class JointEstimate(NamedTuple):
    """Estimate from all blocks. state: x, P of [vehicle, each day]. weights: (C,) of the slow errors' prior points."""

    state: GaussianState
    weights: Array


class JointFit:
    """Joint fit of blocks in order of time, one day after the other."""

    def __init__(self, parameters: Parameters, prior: GaussianState, unknown: GaussianState) -> None:
        """Start from priors.

        prior: x (20,), P (20, 20) of the states on the first day. unknown: prior of the per-day states on further days.
        """
        self._parameters, self._prior, self._unknown = parameters, prior, unknown
        self._arm_is_given = any(parameters.lever_arm)
        self._days = [_Day()]
        self._x = prior.x.copy()  # vehicle and days
        self._linear = self._x.copy()  # the point of linearisation
        self._centre: Array = np.zeros(_UNIT_POINTS.shape[1])
        self._points = self._points_about_centre()
        self._known: dict[tuple[int | None, int | None, bool, int], _Hypotheses] = {}
        self._fitted: JointEstimate | None = None
        self._without: tuple[JointEstimate | None, list[list[GaussianState]]] | None = None

    def _points_about_centre(self) -> _PriorPoints:
        """Return the points of the prior, shifted by `_centre`."""
        at = _UNIT_POINTS + self._centre
        return _PriorPoints(*Priors().at(at), 0.5 * ((_UNIT_POINTS**2).sum(axis=1) - (at**2).sum(axis=1)))

    def _recentre(self) -> None:
        """Move the prior points to the data's estimate of the slow errors, and add up all sections again."""
        assert self._fitted is not None
        if any(day.before is not None for day in self._days):  # blocks without streams are summed at these points
            return
        for _ in range(MAX_RECENTRED):
            moved = self._fitted.weights @ _UNIT_POINTS
            if np.abs(moved).max() < RECENTRED_FROM:
                return
            self._centre = self._centre + moved
            self._points = self._points_about_centre()
            self._known.clear()
            for day in self._days:
                if day.sections:
                    day.chain = Chain.begun(self._points.slow)
                    for section in day.sections:
                        day.chain = day.chain.after(section.gram, section.seconds, self._points.slow)
            self._solve()

    def add(self, block: FitBlock) -> None:
        """Take the next block. Raise numpy.linalg.LinAlgError and keep the earlier fit if numbers diverge."""
        day = self._days[-1]
        state = self._x.copy(), self._fitted
        kept = [(day, replace(day, blocks=[*day.blocks], sections=[*day.sections])) for day in self._days]
        try:
            self._add(day, block)
            assert self._fitted is not None
            if not all(np.isfinite(value).all() for value in self._fitted.state):
                raise np.linalg.LinAlgError("the fit diverged")
        except np.linalg.LinAlgError:
            self._x, self._fitted = state
            self._days = [before for _, before in kept]
            raise

    def _add(self, day: _Day, block: FitBlock) -> None:
        """Add a block to its day. Linearise all again if their number is a power of two, or if the estimate moved."""
        day.blocks.append(block)
        day.count += 1
        self._forget()
        if day.count & (day.count - 1) == 0:
            self._renew()
            return
        x = self._linear[self._of_day(len(self._days) - 1)]
        self._add_parts(day, self._parts([block], x), x)
        self._solve()
        if self._is_far():
            self._renew()

    def end_day(self) -> None:
        """Begin a new day with its own per-day states."""
        self._days.append(_Day())
        prior = self._unknown.x[OF_DAY]
        self._x, self._linear = np.append(self._x, prior), np.append(self._linear, prior)
        if self._fitted is not None:
            x, p = self._fitted.state
            more = np.zeros((len(x) + len(OF_DAY),) * 2)
            more[: len(x), : len(x)] = p
            more[len(x) :, len(x) :] = self._unknown.p[np.ix_(OF_DAY, OF_DAY)]
            self._fitted = self._fitted._replace(state=GaussianState(self._x.copy(), more))

    @property
    def counts(self) -> ReferenceCounts:
        """Numbers of references used and gated, and the squared residuals of those used, in variances of three axes."""
        return ReferenceCounts.total(self._counts())

    def _counts(self) -> Iterator[ReferenceCounts]:
        """Yield the counts of dropped blocks and of all sections."""
        for day in self._days:
            yield day.older
            yield from (section.counts for section in day.sections)

    @property
    def has_data(self) -> bool:
        """Return whether any reference was used."""
        return self._fitted is not None and any(counts.used for counts in self._counts())

    @property
    def states(self) -> list[GaussianState]:
        """States (20,) of every day from all blocks; empty before the first block."""
        if self._fitted is None or not self.has_data:
            return []
        return self._by_day(self._fitted.state)

    @property
    def slow_noise(self) -> SlowNoise | None:
        """Slow errors as estimated, the mean of their posterior; None before the first block."""
        if self._fitted is None or not self.has_data:
            return None
        weights, slow = self._fitted.weights, self._points.slow
        horizontal, *_, heading, _ = np.sqrt(weights @ slow.std**2).tolist()
        return SlowNoise(horizontal, heading, float(weights @ slow.memory_s[:, 0]))

    def _by_day(self, state: GaussianState) -> list[GaussianState]:
        """Return the states (20,) of each day from a state of [vehicle, each day]."""
        days = map(self._of_day, range(len(self._days)))
        return [with_bias_in_mounting(state.x[at], state.p[np.ix_(at, at)]) for at in days]

    def _of_day(self, number: int) -> Index:
        """Return the indices of one day's states (20,) among all states."""
        at = np.arange(N_STATE)
        at[OF_DAY] = len(OF_VEHICLE) + len(OF_DAY) * number + np.arange(len(OF_DAY))
        return at

    def _is_far(self) -> bool:
        """Return whether the estimate has moved away from the point of linearisation."""
        assert self._fitted is not None
        moved = np.abs(self._x - self._linear) > RELINEARISED_FROM * np.sqrt(np.diag(self._fitted.state.p))
        return any(moved[self._of_day(number)][LINEARISED].any() for number in range(len(self._days)))

    # ------------------------------------------------------------------ linearisation

    def _renew(self) -> None:
        """Run Gauss-Newton from the newest estimate over all blocks whose streams are kept."""
        day, place = self._days[-1], self._of_day(len(self._days) - 1)[DELAY]
        day.delays = day.delays.after(day.blocks, self._parameters)
        self._x[place] = day.delays.better(float(self._x[place]))
        last = np.zeros_like(self._x)
        for _ in range(MAX_STEPS):
            self._linearise()
            before = self._x.copy()
            self._solve()
            self._recentre()
            assert self._fitted is not None
            state = self._fitted.state
            step = (self._x - before) / np.sqrt(np.diag(state.p))
            if np.abs(step).max() < LAST_STEP:
                break
            # acceleration columns reduced for noise make steps too long: halve a step that turns back
            self._x, last = 0.5 * (before + self._x) if step @ last < 0.0 else self._x, step
        self._x = state.x.copy()

    def _forget(self) -> None:
        """Fix the contribution of the oldest blocks, and drop their streams."""
        n = sum(len(day.blocks) for day in self._days)
        for day in self._days:
            while n > KEPT_BLOCKS and day.blocks:
                block = day.blocks.pop(0)
                n -= 1
                slow = self._points.slow
                before = [*(day.before or [Chain.begun(slow)] * (1 + FOLDS))]
                while day.sections and day.begin_s < block.end_s - 1e-6:
                    section = day.sections.pop(0)
                    day.begin_s += section.seconds
                    day.older = ReferenceCounts.total((day.older, section.counts))
                    for index, chain in enumerate(before):  # with all folds, then without each
                        gram = None if index - 1 == section.fold else section.gram
                        before[index] = chain.after(gram, section.seconds, slow)
                day.before = before

    def _linearise(self) -> None:
        """Linearise all blocks about the newest estimate."""
        self._linear = self._x.copy()
        for number, day in enumerate(self._days):
            x = self._linear[self._of_day(number)]
            parts = self._parts(day.blocks, x)
            day.sections, day.chain = [], None if day.before is None else day.before[0]
            day.end_s = day.begin_s
            self._measure_noise(day, parts)
            self._add_parts(day, parts, x)

    def _parts(self, blocks: Sequence[FitBlock], x: Array) -> list[SectionRows]:
        """Return the sections of blocks, linearised about a state x (20,) of their day."""
        sections = []
        for block, rows in zip(blocks, predicted(blocks, x, self._parameters), strict=True):
            starts = section_starts(block)
            bounds = [*starts, block.end_s + 1e-9]
            no_parts = [None] * len(starts)
            parts = no_parts if rows is None else rows.parts(np.searchsorted(rows.times, bounds).tolist())
            sections += [SectionRows(from_s, part, block) for from_s, part in zip(starts, parts, strict=True)]
        return sections

    def _measure_noise(self, day: _Day, parts: Sequence[SectionRows]) -> None:
        """Estimate a day's noise from the scatter of its sections; see the fields of `_Day`.

        single: variance of rows about their section's median. white: variance of bins about a line per section.
        level, level_std: median of the sections' medians and their scatter, by which gross sections are rejected.
        """
        residuals = [part.residual for part in parts if part.rows is not None]
        if not residuals:
            return
        levels = np.array([part.level for part in parts if part.rows is not None])
        day.level = masked_median(levels)
        day.level_std = np.maximum(masked_median(np.abs(levels - day.level)) / MEDIAN_DISTANCE, GROSS_MPS / GROSS)
        day.single = np.maximum(usual_square(np.concatenate(residuals)), ROUNDING_MPS**2)
        scatters = [scatter(part.bins(day.single)) for part in parts if part.rows is not None]
        total, freedom = (np.sum(sums, axis=0) for sums in zip(*scatters, strict=True))
        white = np.maximum(total / np.maximum(freedom, 1.0), ROUNDING_MPS**2)
        day.white = np.where(freedom < MIN_DOF, day.single, white)

    def _add_parts(self, day: _Day, parts: Sequence[SectionRows], x: Array) -> None:
        """Add sections to their day's chain. x: (20,) point of linearisation."""
        for part in parts:
            if day.chain is None:
                day.chain = Chain.begun(self._points.slow)
                day.begin_s = day.end_s = part.from_s
            if part.from_s > day.end_s + 1e-6:
                self._append(day, CondensedSection(part.from_s - day.end_s, None, -1))
            gram, fold, counts = None, -1, ReferenceCounts()
            is_gross = part.rows is not None and bool((np.abs(part.level - day.level) > GROSS * day.level_std).any())
            if is_gross and part.rows is not None:
                counts = ReferenceCounts(gated=len(part.rows.times))
            elif part.rows is not None and np.isfinite(day.white).all():
                misfit = part.misfit(day.single)
                good = misfit <= OUTLIER_SQUARE
                used = int(np.count_nonzero(good))
                counts = ReferenceCounts(used, len(good) - used, float(misfit[good].sum()))
                bins = part.bins(day.single)
                gram, fold = gram_of(bins, day.white, x, part.slope_variance), int(bins.fold[len(bins.fold) // 2])
            self._append(day, CondensedSection(BLOCK_S, gram, fold, None if gram is None else part.up(x), counts))

    def _append(self, day: _Day, section: CondensedSection) -> None:
        """Append a section to the chain of its day."""
        assert day.chain is not None
        day.sections.append(section)
        day.chain = day.chain.after(section.gram, section.seconds, self._points.slow)
        day.end_s += section.seconds

    # ------------------------------------------------------------------ solution

    def _solve(self) -> None:
        """Solve for the states of all days from their chains."""
        ended = [None if day.chain is None else day.chain.ended() for day in self._days]
        self._fitted = self._mixture(ended, slice(None), self._climbs())
        self._x = self._fitted.state.x.copy()

    @property
    def _likeliest(self) -> slice:
        """Likeliest point of the slow errors."""
        assert self._fitted is not None
        likeliest = int(np.argmax(self._fitted.weights))
        return slice(likeliest, likeliest + 1)

    def without_folds(self) -> list[list[GaussianState]]:
        """Return, per fold, the states (20,) of every day from all other folds, computed once per estimate."""
        if self._without is None or self._without[0] is not self._fitted:
            ended, states = [self._ended_without_folds(day) for day in self._days], []
            for fold in range(FOLDS):
                without = [state and state.part(slice(fold, fold + 1)) for state in ended]
                states.append(self._by_day(self._mixture(without, self._likeliest, self._climbs(fold)).state))
            self._without = self._fitted, states
        return self._without[1]

    def _ended_without_folds(self, day: _Day) -> Eliminated | None:
        """Return the information of a day without each fold, as FOLDS points; None for a day without sections."""
        if day.chain is None:
            return None
        likeliest, folds = self._points.slow.part(self._likeliest), np.arange(FOLDS)
        slow = SlowErrors(*(np.repeat(values, FOLDS, axis=0) for values in likeliest))
        chain = Chain.begun(slow)
        if day.before is not None:
            older = [chain.part(self._likeliest) for chain in day.before[1:]]
            chain = Chain(*map(np.concatenate, zip(*older, strict=True)))
        for section in day.sections:
            gram = None if section.gram is None else section.gram * (folds != section.fold)[:, None, None]
            chain = chain.after(gram, section.seconds, slow)
        return chain.ended()

    def held_out_error(self) -> HeldOutError | None:
        """Return the velocity error on references, each by states fitted without its fold; None if too few.

        The correction holds mounting, scale, lever arm and delays, but no errors of the instruments. The predicted
        error holds those, white and slow noise as estimated, and the covariance of the states.
        """
        if not self.has_data:
            return None
        slow = self._points.slow.part(self._likeliest)
        slow_variance, memory_s = slow.std[0, :CONSTANT] ** 2, float(slow.memory_s[0, 0])
        sums, seconds = HeldOutSums(), 0.0
        for day in self._days:
            for block in day.blocks:
                sums.add_claimed(block)
        for fold, states in enumerate(self.without_folds()):
            for day, state in zip(self._days, states, strict=True):
                published = state.x.copy()
                published[INSTRUMENT_ERRORS] = 0.0
                blocks = [block for block in day.blocks if (block.fold == fold).any()]
                uncorrected = predicted(blocks, np.zeros(N_STATE), self._parameters)
                corrected = predicted(blocks, published, self._parameters)
                for block, before, after in zip(blocks, uncorrected, corrected, strict=True):
                    if before is None or after is None:
                        continue
                    sums.add(before, after, fold, state, day.single, slow_variance)
                    seconds += (block.end_s - block.from_s) * float(np.mean(block.fold == fold))
        return sums.error(seconds, memory_s)

    @property
    def dvl_bias(self) -> GaussianState | None:
        """Return the DVL's bias, see `bias_by_data`; None before the first block."""
        return None if self._fitted is None or not self.has_data else bias_by_data(self._fitted.state, self._prior)

    def beam_fault(self) -> BeamFault | None:
        """Return the most significant fault of one beam, by the residual of the blocks whose streams are kept."""
        if not self.has_data:
            return None
        points, k = self._likeliest, N_EFFECTS
        prior = self._prior_information(points, math.inf, 0.0)
        n = len(prior.vector[0]) + k
        blocks, velocity, effects = TimeBlocks(), [], np.arange(n - k, n)
        for number, day in enumerate(self._days):
            if not np.isfinite(day.white).all():
                continue
            x = self._x[self._of_day(number)]
            at = np.append(self._of_day(number), effects)
            parts = [part for part in self._parts(day.blocks, x) if part.rows is not None]
            velocity += [part.rows.dvl for part in parts if part.rows is not None]
            for gram in beam_fault_grams(parts, x, day.single, day.white, self._points.slow.part(points)):
                information, vector = np.zeros((1, n, n)), np.zeros((1, n))
                information[0][np.ix_(at, at)], vector[0, at] = gram[:-1, :-1], gram[:-1, -1]
                blocks.add(information, vector, 1.0)
        if not velocity:
            return None
        mean_velocity = np.concatenate(velocity).mean(axis=0)
        return most_significant(blocks, prior.information[0], prior.vector[0], mean_velocity)

    def _climbs(self, without: int = -1) -> list[_Climb]:
        """Return the mean climb of every day whose vertical velocity is measured. without: fold that is held out."""
        climbs = []
        for number, day in enumerate(self._days):
            rows = [section.up for section in day.sections if section.up is not None and section.fold != without]
            if len(rows) > 1:
                at, up = self._of_day(number), np.array(rows)
                velocity = up[:, :-1] @ self._x[at] + up[:, -1]
                path = BLOCK_S * np.cumsum(velocity - velocity.mean())
                std = (LEVEL_M + float(np.ptp(path))) / (BLOCK_S * len(up))
                climbs.append(_Climb(at, up.mean(axis=0), min(std, DIVE_STD_MPS)))
        return climbs

    def _mixture(self, ended: Sequence[Eliminated | None], points: slice, climbs: Sequence[_Climb]) -> JointEstimate:
        """Return mean and covariance over points of the slow errors and over the hypotheses of the priors.

        ended: information of each day without slow errors. climbs: measured as zero, within their σ.
        """
        known = self._hypotheses(points, bool(climbs))
        information, vector = known.information.copy(), known.vector.copy()
        deviance = known.log_det.copy()  # -2 log evidence
        for number, day in enumerate(ended):
            if day is not None:
                at = self._of_day(number)
                information[:, :, at[:, None], at] += day.gram[:, :N_STATE, :N_STATE]
                vector[:, :, at] += day.gram[:, :N_STATE, N_STATE]
                deviance += day.gram[:, N_STATE, N_STATE] + day.log_determinant
        covariance = covariance_of(information, known.information)
        x = product(covariance, vector)
        deviance += np.linalg.slogdet(information)[1] - (x * vector).sum(axis=-1)
        # Kalman update by the climbs
        h = np.zeros((len(climbs), x.shape[-1]))
        for row, climb in zip(h, climbs, strict=True):
            row[climb.at] = climb.row[:-1]
        climbing = x @ h.T + [climb.row[-1] for climb in climbs]
        along = covariance @ h.T
        std = np.maximum([climb.std for climb in climbs], known.climb_mps[:, None])
        innovation = (h @ along)[:, None] + (std[:, None, :, None] ** 2 * np.eye(len(h)))
        inverse = np.linalg.inv(innovation)
        by_climb = product(inverse, climbing[:, None])
        by_path = deviance[:, None] + (climbing[:, None] * by_climb).sum(axis=-1) + np.linalg.slogdet(innovation)[1]
        x = x[:, None] - product(along[:, None], by_climb)
        evidence = known.log_odds[:, :, None] + self._points.log_weight[points] - 0.5 * by_path
        weights = np.exp(evidence - evidence.max())
        weights /= weights.sum()
        mean = np.tensordot(weights, x, 3)
        spread = (x - mean).reshape(-1, len(mean))
        p = np.tensordot(weights.sum(axis=1), covariance) + (spread.T * weights.ravel()) @ spread
        of_climb = along @ (weights[..., None, None] * inverse).sum(axis=1)
        p -= np.tensordot(of_climb, along, ((0, 1, 3), (0, 1, 3)))
        return JointEstimate(GaussianState(mean, 0.5 * (p + p.T)), weights.sum(axis=(0, 1)))

    def _hypotheses(self, points: slice, seen_climbing: bool) -> _Hypotheses:
        """Return the hypotheses of the priors, computed once per set of points and number of days.

        These are a right and a wrong configured lever arm, a small and a large vertical error of the reference, and a
        level, a slowly sinking and a diving vehicle. seen_climbing: whether any day shows its vertical velocity.
        """
        key = points.start, points.stop, seen_climbing, len(self._days)
        if key not in self._known:
            arms = {TAPE_STD_M: 1.0 - P_EXCEPTION, math.inf: P_EXCEPTION} if self._arm_is_given else {math.inf: 1.0}
            offsets = {0.0: 1.0 - P_EXCEPTION, OFFSET_STD_MPS: P_EXCEPTION} if seen_climbing else {0.0: 1.0}
            climbs = {TRIM_STD_MPS: P_EXCEPTION, DIVE_STD_MPS: P_EXCEPTION} if seen_climbing else {}
            paths = {0.0: 1.0 - sum(climbs.values()), **climbs}
            cases = list(itertools.product(arms, offsets))
            priors = [self._prior_information(points, arm, offset) for arm, offset in cases]
            information, vector, log_det = (np.stack(parts) for parts in zip(*priors, strict=True))
            case_odds = np.array([arms[arm] * offsets[offset] for arm, offset in cases])
            log_odds = np.log(case_odds[:, None] * np.array([*paths.values()]))
            self._known[key] = _Hypotheses(information, vector, log_det, log_odds, np.array([*paths]))
        return self._known[key]

    def _prior_information(self, points: slice, tape_std: float, offset_std: float) -> _PriorInformation:
        """Return the information of the prior of [vehicle, each day].

        tape_std: σ (m) of a configured lever arm; inf for `initial_std_lever_arm`. offset_std: σ (m/s) of the vertical
        reference error; 0 for `reference_offset_std`.
        """
        deviation = self._points.deviation[points]
        n = len(OF_VEHICLE) + len(OF_DAY) * len(self._days)
        information, vector = np.zeros((len(deviation), n, n)), np.zeros((len(deviation), n))
        for number in range(len(self._days)):
            at = self._of_day(number)
            day_information, day_vector = (self._prior if number == 0 else self._unknown).information
            new = OF_DAY if number else np.arange(N_STATE)  # the first day also holds the states of the vehicle
            information[:, at[new][:, None], at[new]] += day_information[np.ix_(new, new)]
            vector[:, at[new]] += day_vector[new]
        scale = np.ones((len(deviation), n))
        scale[:, HEADING] = 1.0 / deviation[:, None]
        if offset_std:
            upwards = [int(self._of_day(number)[REFERENCE_ERROR][-1]) for number in range(len(self._days))]
            scale[:, upwards] = min(1.0, self._parameters.reference_offset_std / offset_std)
        if self._arm_is_given:
            scale[:, LEVER_ARM] = np.maximum(np.sqrt(np.diag(self._prior.p)[LEVER_ARM]) / tape_std, 1.0)
        information *= scale[:, :, None] * scale[:, None]
        return _PriorInformation(information, vector * scale, -2.0 * np.log(scale).sum(axis=1))
