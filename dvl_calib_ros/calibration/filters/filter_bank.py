"""The bank of linear filters: all models at once, with covariances by blocks of time.

So switching models by hand or automatically is a change of what is read, never of what is computed, and the state
after a switch is that of having run the model from the start. When a model is updated is a matter of speed alone:
those of one `Group` are stacked and updated together, by blocks of any length.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..models import Model, Needs
from ..models.base import Observations
from ..models.parameters import Parameters
from ..numerics import kalman
from ..numerics.block_covariance import TimeBlocks
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, Mask, Stamps
from .cross_validation import FOLDS, FoldInformation, Moments, folds_of, with_states_of
from .filter_setup import Assembler
from .heading_bias import (
    BiasCovariance,
    BlockTerms,
    HeadingEvidence,
    HeadingStates,
    TermsOfBlock,
    all_told,
    heading_states,
    prior_std,
    turns_of,
    with_terms,
)
from .state_history import Counts, Standing
from .vertical_motion import HeaveRows, HeaveSums, RelativeHeight, with_heave

Ends = Index
# Blocks by whose scatter σ is checked, s: as long as the noise of a vehicle's motion lasts.
BLOCK_S = 10.0

# From here on the vectorised batch is faster than the recursion.
BATCH_FROM = 24


class ModelCounts(NamedTuple):
    """What one model did with the samples given to it.

    mean_nis, mean_rows: νᵀS⁻¹ν (nan if none) and number of rows, means over those it used. restarted: how often its
    state was not finite, and it went on from before.
    """

    used: int
    gated: int
    mean_nis: float
    mean_rows: float
    restarted: int


def groups_of(
    models: Sequence[Model],
    parameters: Parameters,
    initial: Mapping[str, GaussianState] | None = None,
    verified: bool = False,
) -> tuple[Group, ...]:
    """The bank: all models, in groups of those that see the same and differ in z and H only.

    They start from the prior, or from `initial` for the models named there (shapes as the models' states). verified:
    keep what `Group.states_without_folds` needs.
    """
    alike: dict[object, list[Model]] = {}
    for model in models:
        of_day = tuple(model.of_day.tolist())
        rows = (model.n_state, model.n_measurement, model.noise, model.heave)
        kind = (model.needs, rows, model.motion_is_noise, model.uses_height, of_day)
        alike.setdefault(kind, []).append(model)
    return tuple(Group(group, parameters, initial, verified) for group in alike.values())


class Group:
    """K models that see the same and differ in z and H only.

    needs: of all of them. index: by name, which of the K. n_given: samples that they have had. next_row: kept here for
    who feeds them: number of the first row that they have not been asked to take. moments: of the samples that they
    were given, for verification by those with a reference; empty without.
    """

    def __init__(
        self,
        models: Sequence[Model],
        parameters: Parameters,
        initial: Mapping[str, GaussianState] | None,
        verified: bool,
    ) -> None:
        self._parameters = parameters
        self._assembler = Assembler(models, parameters, initial)
        self._folds = FoldInformation(self._assembler.start) if verified else None
        self.needs = models[0].needs
        self.moments = Moments()
        self.index = {model.name: k for k, model in enumerate(models)}
        self._x, self._p = self._assembler.start
        self._of_day = models[0].of_day
        still = self._assembler.process_rate is None
        # the paper's models are as they are published
        self._deviates = self.needs is Needs.REFERENCE and models[0].in_correction_parameters
        self._turns = turns_of(parameters.rotation_dvl_from_body, models[0].n_state)
        self._z = self._turns[:, 2]
        self._n_errors = models[0].n_errors
        self._scatter = self._new_scatter() if still else None
        self._heave = HeaveRows(len(models), models[0].n_state, parameters) if models[0].heave is not None else None
        self._height = RelativeHeight() if models[0].uses_height else None
        self._states: dict[str, GaussianState] = {}
        self._of_recording: dict[str, GaussianState] = {}
        self._sound: dict[str, GaussianState] = {}  # the last that could be published
        self._last_stamp_ns: int | None = None
        self.n_given = self.next_row = 0
        k = len(models)
        self._used = np.zeros(k, dtype=np.int64)
        self._gated = np.zeros(k, dtype=np.int64)
        self._nis_sum, self._rows_sum = np.zeros(k), np.zeros(k)
        self._restarted = np.zeros(k, dtype=np.int64)

    def _new_scatter(self) -> BlockScatter:
        """Blocks of time from now on."""
        terms = BlockTerms(self._turns, self._n_errors) if self._deviates else None
        std = prior_std(self._parameters.heading_deviation_std, self._parameters.dvl_bias_std)
        return BlockScatter(self._x, self._p, BLOCK_S, terms, std, self._parameters.up * self._z)

    def update(
        self, stamps_ns: Stamps, seen: Observations, weight: Array, prior_known: Mask, ends: Ends | None = None
    ) -> Standing | None:
        """Update by a block of N samples that have what the models need.

        weight, prior_known: (N,) as in `Assembler.measurements`. The states after `ends` samples (E), if given.
        """
        self.n_given += len(stamps_ns)
        if self._height is not None:
            seen = replace(seen, height=self._height.add(stamps_ns, seen.rising))
        data = self._assembler.measurements(seen, weight, prior_known)
        process = self._process_noise(stamps_ns)
        cuts = np.zeros(0, dtype=np.intp)
        if self._scatter is not None:
            cuts = self._scatter.cuts(stamps_ns, seen.earth_in_body, seen.velocity_dvl, seen.off)
        every, shown = _joined_ends(cuts, ends), _joined_ends(cuts[-1:], ends)
        if self._heave is None:
            after = self._after(data, process, every)
            self._x, self._p, states, known_at = after.x, after.p, after.at, every
            of_heave: list[tuple[HeaveSums, Array]] = []
        else:
            rows = self._assembler.heave_rows(seen)
            after, states, of_heave = self._with_heave(stamps_ns, rows, data, process, every, shown)
            known_at = shown
        if self._scatter is not None and len(cuts):
            assert every is not None and known_at is not None and after.at is not None and states is not None
            at, last = np.searchsorted(every, cuts), int(np.searchsorted(known_at, cuts[-1]))
            at_last = GaussianState(states.x[last], states.p[last])
            beside = None
            if of_heave:
                sums, variance = of_heave[last]
                beside = sums.with_terms(variance, self._z[:3])
            self._scatter.add(cuts, after.at.x[at], after.at.p[at], at_last, beside)
        self._states.clear()
        self._of_recording.clear()
        if self._folds is not None:
            folds = folds_of(stamps_ns, self._parameters)
            self._folds.add(folds, data, after.used)
            if self.needs is Needs.REFERENCE:
                self.moments.take(folds, seen)
        standing = None if ends is None or known_at is None else self._standing_at(after, states, ends, known_at)
        n_used = after.used.sum(axis=1)
        self._used += n_used
        self._gated += data.usable.sum(axis=1) - n_used
        self._nis_sum += np.einsum("kn,kn->k", after.used, after.nis)
        if seen.unmeasured is None:
            self._rows_sum += n_used * data.z.shape[2]
        else:
            self._rows_sum += (after.used * self._assembler.rows_left(seen.unmeasured)).sum(axis=1)
        return standing

    def end_day(self) -> None:
        """Go on with what belongs to the vehicle; what is of the day is to be found anew."""
        if not len(self._of_day):
            return
        if self._height is not None:
            self._height.end_day()
        before = GaussianState(self._x, self._p)
        after = with_states_of(before, self._assembler.prior, self._of_day)
        self._x, self._p = after
        if self._scatter is not None:
            try:
                self._scatter.end_day(before, after, self._of_day, *self._now_told())
            except np.linalg.LinAlgError:  # numbers that ran away: it looks at the new day alone
                self._scatter = self._new_scatter()
        if self._folds is not None:
            with suppress(np.linalg.LinAlgError):
                self._folds.end_day(self._assembler.prior, self._of_day)
        self._states.clear()
        self._of_recording.clear()

    def _with_heave(
        self,
        stamps_ns: Stamps,
        rows: Array,
        data: kalman.Measurements,
        process: Array | None,
        every: Ends | None,
        shown: Ends | None,
    ) -> tuple[kalman.Updated, GaussianState | None, list[tuple[HeaveSums, Array]]]:
        """Take a block, and its rows of heave.

        Returns the filter's states after `every` so many samples, with heave those after `shown`, some of these, and
        what rows there were then, with their variances (K,).
        """
        assert self._heave is not None
        n_samples = len(stamps_ns)
        # under a random walk what a row tells ages with the rest: it goes into the filter where its block ends
        starts = self._heave.starts(stamps_ns) if process is not None else np.zeros(0, dtype=np.intp)
        cuts = sorted({0, n_samples, *starts.tolist()})
        none = np.zeros(0, dtype=np.intp)
        wanted, with_rows = none if every is None else every, none if shown is None else shown
        parts, found = [], []
        told: list[tuple[HeaveSums, Array]] = []
        for start, end in pairwise(cuts):
            if start in starts:
                self._heave.close()
                self._absorb_heave()
            own, own_shown = (
                each[(each > start) & (each <= end) | (each == 0) & (start == 0)] - start
                for each in (wanted, with_rows)
            )
            at = slice(start, end)
            after = self._after(data.part(at), None if process is None else process[at], own if len(own) else None)
            sums = self._heave.add(stamps_ns[at], rows[at], after.used[0], own_shown.tolist())
            self._x, self._p = after.x, after.p
            parts.append(after)
            if after.at is not None and len(own_shown):
                places = np.searchsorted(own, own_shown)
                states = GaussianState(after.at.x[places], after.at.p[places])
                joined, variances = _joined(states, HeaveSums.stacked(sums), self._parameters.motion_std)
                found.append(joined)
                told += zip(sums, variances, strict=True)
        all_joined = GaussianState(*map(np.concatenate, zip(*found, strict=True))) if found else None
        return kalman.one_after_another(parts), all_joined, told

    def _absorb_heave(self) -> None:
        assert self._heave is not None
        sums, by_fold = self._heave.absorb()
        with suppress(np.linalg.LinAlgError):
            state, variance = with_heave(GaussianState(self._x, self._p), sums, self._parameters.motion_std)
            if _is_sound(*state):
                self._x, self._p = state
                if self._folds is not None:
                    self._folds.add_told(slice(None), by_fold / variance[:, None, None])

    def _after(self, data: kalman.Measurements, process: Array | None, ends: Ends | None) -> kalman.Updated:
        """The models updated; one whose numbers run away stays as it was before, and is counted."""
        try:
            after = _filtered(self._x, self._p, data, process, ends)
            if _is_sound(after.x, after.p):
                return after
        except np.linalg.LinAlgError:
            pass  # of one of them: each by itself
        return kalman.Updated.joined([self._after_alone(k, data, process, ends) for k in range(len(self._x))])

    def _after_alone(
        self, k: int, data: kalman.Measurements, process: Array | None, ends: Ends | None
    ) -> kalman.Updated:
        own = slice(k, k + 1)
        x, p, own_data = self._x[own], self._p[own], data.model(k)
        with suppress(np.linalg.LinAlgError):
            after = _filtered(x, p, own_data, None if process is None else process[:, own], ends)
            if _is_sound(after.x, after.p):
                return after
        self._restarted[k] += 1
        nothing = own_data.usable & False
        at = None if ends is None else GaussianState(np.stack([x] * len(ends)), np.stack([p] * len(ends)))
        return kalman.Updated(x, p, nothing, nothing.astype(float), at)

    def _standing_at(self, after: kalman.Updated, states: GaussianState | None, ends: Ends, every: Ends) -> Standing:
        """After `ends` samples; `every`: after which numbers of samples the states are known."""
        assert states is not None
        at = np.searchsorted(every, ends)
        used = np.cumsum(np.pad(after.used, ((0, 0), (1, 0))), axis=1)[:, ends].T
        nis = np.cumsum(np.pad(np.where(after.used, after.nis, 0.0), ((0, 0), (1, 0))), axis=1)[:, ends].T
        return Standing(states.x[at], states.p[at], self._used + used, self._nis_sum + nis)

    def standing(self, n: int) -> Standing:
        """The states as they are now, n times."""
        x, p = self._now()
        return Standing.joined([Standing(x[None], p[None], self._used[None], self._nis_sum[None])] * n)

    def _now(self) -> GaussianState:
        """The filter's states x (K, n), P (K, n, n), with heave where models have it."""
        state = GaussianState(self._x, self._p)
        return state if self._heave is None else _joined(state, self._heave.sums(), self._parameters.motion_std)[0]

    def _now_told(self) -> tuple[GaussianState, tuple[Array, Array] | None]:
        """`_now`, and what rows of heave told of it and terms, as of `HeaveSums.with_terms`."""
        if self._heave is None:
            return self._now(), None
        sums = self._heave.sums()
        state, variance = _joined(GaussianState(self._x, self._p), sums, self._parameters.motion_std)
        return state, sums.with_terms(variance, self._z[:3])

    def _process_noise(self, stamps_ns: Stamps) -> Array | None:
        rate = self._assembler.process_rate
        if rate is None:
            return None
        before_ns = stamps_ns[0] if self._last_stamp_ns is None else self._last_stamp_ns
        self._last_stamp_ns = int(stamps_ns[-1])
        return np.diff(stamps_ns, prepend=before_ns)[:, None, None, None] * 1e-9 * rate

    def state(self, name: str) -> GaussianState:
        """State and covariance of one model; not to be written to."""
        if name not in self._states:  # asked for more than once per sample, live
            self._states[name] = self._sound[name] = self._sound_state(name)
        return self._states[name]

    def of_recording(self, name: str) -> GaussianState:
        """`state` with what blocks of time say: of how the heading deviates, and how much larger σ is."""
        if self._scatter is None:
            return self.state(name)
        if name not in self._of_recording:
            found = self._scatter.found(self.index[name])
            state = self._sound_state(name, found.shift[0], found.more[0]) if found.more.any() else self.state(name)
            raised = state.raised(found.inflation).turned(self._z, found.drifted)
            self._of_recording[name] = found.of_bias.at(0).added_to(raised)
        return self._of_recording[name]

    def of_bias(self, name: str) -> BiasCovariance:
        """What a bias of the DVL makes of `of_recording`, by one model."""
        if self._scatter is None:
            return BiasCovariance.none(self._x.shape[1])
        return self._scatter.found(self.index[name]).of_bias.at(0)

    def heading_deviation(self, name: str) -> GaussianState | None:
        """Coefficients of how the heading deviates, as of `HeadingStates`, by one model; None where it has none."""
        return None if self._scatter is None else self._scatter.found(self.index[name]).coefficients

    def _sound_state(self, name: str, shift: Array | float = 0.0, more: Array | float = 0.0) -> GaussianState:
        """The state as it is to be published; the one before where the way from the filter's to it fails.

        shift (n,), more (n, n): what is added to x and P of the filter before.
        """
        index = self.index[name]
        x, p = self._now()
        found = self._published(index, x[index] + shift, p[index] + more)
        if found is not None:
            return found
        self._restarted[index] += 1
        return self._sound.get(name) or self._assembler.start_of(index)

    def _published(self, index: int, x: Array, p: Array) -> GaussianState | None:
        """A state (n,) of the filter as the model's; None if it has none that is finite."""
        with suppress(np.linalg.LinAlgError):
            state = self._assembler.state(index, x, p)
            if not self._assembler.models[index].in_correction_parameters or _is_sound(state.x, state.p):
                return state  # the filter's own has been looked at
        return None

    def counts_at(self, name: str, standing: Standing) -> tuple[Counts, Array]:
        """Samples that one model has used (E,) and the sum of νᵀS⁻¹ν over them (E,)."""
        index = self.index[name]
        return standing.used[:, index], standing.nis_sum[:, index]

    def states_at(self, name: str, standing: Standing) -> GaussianState:
        """States x (E, n) and covariances P (E, n, n) of one model, from those of all."""
        index = self.index[name]
        x, p = standing.x[:, index], standing.p[:, index]
        with suppress(np.linalg.LinAlgError):
            states = self._assembler.state(index, x, p)
            if _is_sound(states.x, states.p):
                return states
        singly = [self._published(index, *each) or self.state(name) for each in zip(x, p, strict=True)]
        return GaussianState(np.array([state.x for state in singly]), np.array([state.p for state in singly]))

    def states_without_folds(self, name: str) -> list[GaussianState]:
        """For every fold the state and covariance of one model had it not seen that fold."""
        assert self._folds is not None  # asked for when the bank was made
        index, found = self.index[name], []
        for fold in range(FOLDS):
            state = None
            with suppress(np.linalg.LinAlgError):
                without = self._folds.state(fold, index)
                if self._heave is not None:
                    sums = self._heave.sums(without=fold)
                    of_one = GaussianState(*(each[None] for each in without))
                    (x, p), _ = _joined(of_one, sums, self._parameters.motion_std)
                    without = GaussianState(x[index], p[index])
                state = self._published(index, *without)
            found.append(state or self.state(name))
        return found

    def counts(self, name: str) -> ModelCounts:
        """Samples used and gated by one model, and its mean normalised innovation squared."""
        index = self.index[name]
        used = int(self._used[index])
        model = self._assembler.models[index]
        return ModelCounts(
            used,
            int(self._gated[index]),
            float(self._nis_sum[index] / used) if used else float("nan"),
            float(self._rows_sum[index] / used) if used else float(model.n_measurement),
            int(self._restarted[index]),
        )


def _joined_ends(cuts: Ends, ends: Ends | None) -> Ends | None:
    """Numbers of samples of both, ascending; None without any."""
    return ends if not len(cuts) else np.array(sorted({*cuts.tolist(), *([] if ends is None else ends.tolist())}))


def _joined(state: GaussianState, sums: HeaveSums, motion_std: float) -> tuple[GaussianState, Array]:
    """`with_heave`; where numbers have run away they are as they are, and rows tell nothing (σ² is infinite)."""
    with suppress(np.linalg.LinAlgError):
        found, variance = with_heave(state, sums, motion_std)
        if _is_sound(*found):
            return found, variance
    return state, np.full(state.x.shape[:-1], math.inf)


def _filtered(
    x: Array, p: Array, data: kalman.Measurements, process: Array | None, ends: Ends | None
) -> kalman.Updated:
    if process is None and data.z.shape[1] >= BATCH_FROM:
        return kalman.batch(x, p, data, ends)
    return kalman.recursion(x, p, data, process, ends)


def _is_sound(x: Array, p: Array) -> bool:
    """Whether all of states x (..., n), P (..., n, n) are finite, with variances above zero."""
    flat_x, flat_p = x.ravel(), p.ravel()
    finite = math.isfinite(float(flat_x @ flat_x) + float(flat_p @ flat_p))  # nan and inf stay in sums
    n = p.shape[-1]
    # of few numbers, as live, in a third of the time of numpy's
    return finite and min(p.reshape(-1, n * n)[:, :: n + 1].ravel().tolist()) > 0.0


_NO_CUTS = np.zeros(0, dtype=np.intp)


class BlockScatter:
    """`TimeBlocks` of K filters without process noise, told by their states where one block ends and the next begins.

    What a block told is the difference of the information after and before it. What they say is as of the end of the
    last block, so it depends on stamps alone.
    """

    def __init__(self, x: Array, p: Array, seconds: float, terms: BlockTerms | None, std: Array, up: Array) -> None:
        """Start from states x (K, n), P (K, n, n).

        seconds: length of a block. terms: None for filters that heading and bias are not looked for by. std: (9,) of
        `heading_states.prior_std`. up: (n,) as of `heading_states`.
        """
        self._blocks = TimeBlocks()
        self._length_ns = round(seconds * 1e9)
        self._terms, self._std, self._up = terms, std, up
        self._beside: tuple[Array, Array] | None = None
        self._last: int | None = None
        self._state = GaussianState(x, p)
        self._told = self._state.information
        self._found: dict[int, HeadingStates] = {}

    def cuts(self, stamps_ns: Stamps, earth_in_body: Array | None, velocity_dvl: Array, off: Array) -> Index:
        """Take N samples (N,) as of `BlockTerms.add`.

        Returns numbers (E,) of those after which a new block begins.
        """
        if self._terms is not None:
            self._terms.add(stamps_ns, earth_in_body, velocity_dvl, off)
        first, last = int(stamps_ns[0]) // self._length_ns, int(stamps_ns[-1]) // self._length_ns
        if first == last == (first if self._last is None else self._last):  # as nearly always live
            self._last = last
            return _NO_CUTS
        blocks = stamps_ns // self._length_ns
        before = blocks[0] if self._last is None else self._last
        self._last = int(blocks[-1])
        return np.flatnonzero(np.diff(blocks, prepend=before))

    def add(self, cuts: Index, x: Array, p: Array, last: GaussianState, beside: tuple[Array, Array] | None) -> None:
        """Take the states at the cuts, x (E, K, n), P (E, K, n, n).

        last: x (K, n), P (K, n, n) at the last of them with all that is known beside what blocks are judged by, which
        told Λ (K, n + 9, n + 9) and y (K, n + 9) of states and terms.
        """
        terms: Sequence[TermsOfBlock | None] = [None] * len(cuts) if self._terms is None else self._terms.upto(cuts)
        self._add(terms, x, p, last, beside)

    def _add(
        self,
        terms: Iterable[TermsOfBlock | None],
        x: Array,
        p: Array,
        last: GaussianState,
        beside: tuple[Array, Array] | None,
    ) -> None:
        for own, now in zip(terms, _informations(x, p), strict=True):
            if now is None:
                continue
            told = now[0] - self._told[0], now[1] - self._told[1]
            information, vector = told if own is None else with_terms(*told, own)
            self._blocks.add(information, vector, 1.0)
            self._told = now
        self._state, self._beside = last, beside
        self._found.clear()

    def end_day(
        self,
        before: GaussianState,
        after: GaussianState,
        of_day: Index,
        last: GaussianState,
        beside: tuple[Array, Array] | None,
    ) -> None:
        """Go on with states `after` the end of a day, x (K, n), P (K, n, n), from those `before`. of_day: which (u,) of
        them were of the day. last, beside: of those `after`, as in `add`."""
        self._add([None if self._terms is None else self._terms.rest()], before.x[None], before.p[None], last, beside)
        known = self._told if self._terms is None else all_told(*self._told, self._blocks)
        self._blocks.end_day(of_day, *known, np.arange(len(before.x)))
        self._told = after.information
        self._last = None
        self._found.clear()

    def found(self, index: int) -> HeadingStates:
        """What blocks say of one filter: by how much σ has to grow, and what is to be added for the deviation."""
        if index not in self._found:
            of_one = GaussianState(*(each[index : index + 1] for each in self._state))
            beside = None
            if self._terms is not None and self._beside is not None:
                beside = self._beside[0][index : index + 1], self._beside[1][index : index + 1]
            seen = HeadingEvidence.of(self._blocks, of_one, np.array([index]), 0, beside)
            self._found[index] = heading_states([seen], self._std, self._up)[0]
        return self._found[index]


def _informations(x: Array, p: Array) -> Iterator[tuple[Array, Array] | None]:
    """Of E states x (K, n), P (K, n, n); None of those whose numbers ran away: the filter goes on from before them."""
    try:
        yield from zip(*GaussianState(x, p).information, strict=True)
        return
    except np.linalg.LinAlgError:
        pass
    for each in zip(x, p, strict=True):
        try:
            yield GaussianState(*each).information
        except np.linalg.LinAlgError:
            yield None
