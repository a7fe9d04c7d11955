"""Bank of linear filters: all models in parallel, with covariances from time blocks.

Switching models changes only which state is read, so a selected model has run from the start. The models of one `Group`
are stacked and updated together, in blocks of any length.

Shapes: K models, N samples, E requested states, n states.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..models import Model, Needs
from ..models.base import Observations
from ..models.parameters import Parameters
from ..numerics import kalman
from ..numerics.block_covariance import BLOCK_NS, TimeBlocks
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, Mask, Stamps
from .cross_validation import FOLDS, FoldInformation, Moments, folds_of, with_states_of
from .filter_setup import Assembler
from .state_history import PastStates, Snapshot

# Memory of the integral, s: a pitch error of 3 degrees adds 10 m at 2 m/s, which looks like a constant current.
MEMORY_S = 100.0
# Longest gap that is integrated, s.
LONGEST_STEP_S = 5.0


class RelativeHeight:
    """Integrator of the vertical velocity, per sample, independent of the block size."""

    def __init__(self) -> None:
        self._height = 0.0
        self._last_ns: int | None = None

    def add(self, stamps_ns: Stamps, rising: Array) -> Array:
        """Add vertical velocities (N,) m/s, positive up. Return heights (N,) m."""
        height, last_ns = self._height, self._last_ns
        heights = np.empty(len(rising))
        for row, (stamp_ns, speed) in enumerate(zip(stamps_ns.tolist(), rising.tolist(), strict=True)):
            step_s = 0.0 if last_ns is None else 1e-9 * (stamp_ns - last_ns)
            decay = math.exp(-step_s / MEMORY_S)
            height *= decay
            if step_s <= LONGEST_STEP_S:
                height += speed * MEMORY_S * (1.0 - decay)
            heights[row] = height
            last_ns = stamp_ns
        self._height, self._last_ns = height, last_ns
        return heights

    def end_day(self) -> None:
        """Reset the height."""
        self._height, self._last_ns = 0.0, None


Ends = Index

# Number of samples from which the vectorised batch is faster than the recursion.
BATCH_FROM = 24


class ModelCounts(NamedTuple):
    """Sample counts of one model.

    mean_nis, mean_rows: means of νᵀS⁻¹ν (nan if none) and number of rows over the used samples. restarted: number of
    blocks skipped because the state was not finite.
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
    """Return all models in groups with equal observations that differ in z and H only.

    They start from the prior, or from `initial` by model name. verified: store what `Group.states_without_folds` needs.
    """
    by_kind: dict[object, list[Model]] = {}
    for model in models:
        of_day = tuple(model.of_day.tolist())
        rows = (model.n_state, model.n_measurement, model.noise)
        kind = (model.needs, rows, model.motion_is_noise, model.uses_height, of_day)
        by_kind.setdefault(kind, []).append(model)
    return tuple(Group(group, parameters, initial, verified) for group in by_kind.values())


class Group:
    """K models with equal observations that differ in z and H only.

    needs: common to all.
    index: number k by name.
    n_given: samples received.
    next_row: for the caller, number of the first row not yet passed.
    moments: of the samples, for the verification of models with a reference; else empty.
    """

    def __init__(
        self,
        models: Sequence[Model],
        parameters: Parameters,
        initial: Mapping[str, GaussianState] | None,
        verified: bool,
    ) -> None:
        """Start the filters from their priors.

        models: with equal needs, number of states and number of measured axes.
        initial: initial states by model name.
        verified: sum the information per fold for hold-out verification.
        """
        self._parameters = parameters
        self._assembler = Assembler(models, parameters, initial)
        self._folds = FoldInformation(self._assembler.start) if verified else None
        self.needs = models[0].needs
        self.moments = Moments()
        self.index = {model.name: k for k, model in enumerate(models)}
        self._x, self._p = self._assembler.start
        self._of_day = models[0].of_day
        still = self._assembler.process_rate is None
        self._scatter = BlockScatter(self._x, self._p) if still else None
        self._height = RelativeHeight() if models[0].uses_height else None
        self._states: dict[str, GaussianState] = {}
        self._of_recording: dict[str, GaussianState] = {}
        self._last_stamp_ns: int | None = None
        self.n_given = self.next_row = 0
        k = len(models)
        self._used = np.zeros(k, dtype=np.int64)
        self._gated = np.zeros(k, dtype=np.int64)
        self._nis_sum, self._rows_sum = np.zeros(k), np.zeros(k)
        self._restarted = np.zeros(k, dtype=np.int64)

    def update(
        self, stamps_ns: Stamps, observations: Observations, weight: Array, prior_known: Mask, ends: Ends | None = None
    ) -> Snapshot | None:
        """Update by a block of N samples that meet the needs. Return the states after `ends` samples (E), if given.

        weight, prior_known: (N,) as in `Assembler.measurements`.
        """
        self.n_given += len(stamps_ns)
        if self._height is not None:
            observations = replace(observations, height=self._height.add(stamps_ns, observations.rising))
        measurements = self._assembler.measurements(observations, weight, prior_known)
        process = self._process_noise(stamps_ns)
        cuts = np.zeros(0, dtype=np.intp)
        if self._scatter is not None:
            cuts = self._scatter.cuts(stamps_ns)
        all_ends = _joined_ends(cuts, ends)
        after = self._after(measurements, process, all_ends)
        self._x, self._p = after.x, after.p
        if self._scatter is not None and len(cuts):
            assert all_ends is not None and after.at is not None
            indices = np.searchsorted(all_ends, cuts)
            self._scatter.add(after.at.x[indices], after.at.p[indices])
        self._states.clear()
        self._of_recording.clear()
        if self._folds is not None:
            folds = folds_of(stamps_ns, self._parameters)
            self._folds.add(folds, measurements, after.used)
            if self.needs is Needs.REFERENCE:
                self.moments.take(folds, observations)
        snapshot = None if ends is None or all_ends is None else self._snapshot_at(after, ends, all_ends)
        n_used = after.used.sum(axis=1)
        self._used += n_used
        self._gated += measurements.usable.sum(axis=1) - n_used
        self._nis_sum += np.einsum("kn,kn->k", after.used, after.nis)
        if observations.unmeasured is None:
            self._rows_sum += n_used * measurements.z.shape[2]
        else:
            self._rows_sum += (after.used * self._assembler.rows_left(observations.unmeasured)).sum(axis=1)
        return snapshot

    def end_day(self) -> None:
        """Keep the states of the vehicle for the next recording, and reset those that differ per recording."""
        if not len(self._of_day):
            return
        if self._height is not None:
            self._height.end_day()
        before = GaussianState(self._x, self._p)
        after = with_states_of(before, self._assembler.prior, self._of_day)
        self._x, self._p = after
        if self._scatter is not None:
            try:
                self._scatter.end_day(before, after, self._of_day)
            except np.linalg.LinAlgError:  # singular: restart the scatter with this recording
                self._scatter = BlockScatter(self._x, self._p)
        if self._folds is not None:
            with suppress(np.linalg.LinAlgError):
                self._folds.end_day(self._assembler.prior, self._of_day)
        self._states.clear()
        self._of_recording.clear()

    def _after(self, data: kalman.Measurements, process: Array | None, ends: Ends | None) -> kalman.Updated:
        """Update the models. A model with non-finite numbers keeps its previous state and is counted.

        process: (N, K, n, n) covariance added before each sample, None for none.
        ends: numbers of samples after which the states are returned, too.
        """
        try:
            after = _filtered(self._x, self._p, data, process, ends)
            if _is_sound(after.x, after.p):
                return after
        except np.linalg.LinAlgError:
            pass  # one model failed: update each alone
        return kalman.Updated.joined([self._after_alone(k, data, process, ends) for k in range(len(self._x))])

    def _after_alone(
        self, k: int, data: kalman.Measurements, process: Array | None, ends: Ends | None
    ) -> kalman.Updated:
        """Update the k-th model; on non-finite numbers keep its state and count a restart."""
        only = slice(k, k + 1)
        x, p, measurements = self._x[only], self._p[only], data.model(k)
        with suppress(np.linalg.LinAlgError):
            after = _filtered(x, p, measurements, None if process is None else process[:, only], ends)
            if _is_sound(after.x, after.p):
                return after
        self._restarted[k] += 1
        unused = measurements.usable & False
        at = None if ends is None else GaussianState(np.stack([x] * len(ends)), np.stack([p] * len(ends)))
        return kalman.Updated(x, p, unused, unused.astype(float), at)

    def _snapshot_at(self, after: kalman.Updated, ends: Ends, all_ends: Ends) -> Snapshot:
        """Return the states after `ends` samples. all_ends: sample numbers with known states."""
        states = after.at
        assert states is not None
        indices = np.searchsorted(all_ends, ends)
        # sums with a leading zero: entry n is after n samples
        used = np.cumsum(np.pad(after.used, ((0, 0), (1, 0))), axis=1)[:, ends].T
        nis = np.cumsum(np.pad(np.where(after.used, after.nis, 0.0), ((0, 0), (1, 0))), axis=1)[:, ends].T
        return Snapshot(states.x[indices], states.p[indices], self._used + used, self._nis_sum + nis)

    def snapshot(self, n: int) -> Snapshot:
        """Return the present states, n times."""
        now = Snapshot(self._x[None], self._p[None], self._used[None], self._nis_sum[None])
        return Snapshot.joined([now] * n)

    def _process_noise(self, stamps_ns: Stamps) -> Array | None:
        """Return the process noise added before each sample, None without any."""
        rate = self._assembler.process_rate
        if rate is None:
            return None
        before_ns = stamps_ns[0] if self._last_stamp_ns is None else self._last_stamp_ns
        self._last_stamp_ns = int(stamps_ns[-1])
        return np.diff(stamps_ns, prepend=before_ns)[:, None, None, None] * 1e-9 * rate

    def state(self, name: str) -> GaussianState:
        """Return state and covariance of one model, read-only."""
        if name not in self._states:  # used several times per live sample
            index = self.index[name]
            self._states[name] = self._assembler.state(index, self._x[index], self._p[index])
        return self._states[name]

    def of_recording(self, name: str) -> GaussianState:
        """Return `state` with σ inflated by the scatter of time blocks."""
        if self._scatter is None:
            return self.state(name)
        if name not in self._of_recording:
            self._of_recording[name] = self.state(name).raised(self._scatter.inflation(self.index[name]))
        return self._of_recording[name]

    def states_at(self, name: str, snapshot: Snapshot) -> PastStates:
        """Return the states of one model after the E rows of a snapshot."""
        index = self.index[name]
        state = self._assembler.state(index, snapshot.x[:, index], snapshot.p[:, index])
        return PastStates(state, snapshot.used[:, index], snapshot.nis_sum[:, index])

    def states_without_folds(self, name: str) -> list[GaussianState]:
        """Return state and covariance of one model without each fold; with it if the rest is singular."""
        assert self._folds is not None  # the bank was made with verified=True
        index, found = self.index[name], []
        for fold in range(FOLDS):
            try:
                found.append(self._assembler.state(index, *self._folds.state(fold, index)))
            except np.linalg.LinAlgError:  # nothing but that fold determines a state
                found.append(self.state(name))
        return found

    def counts(self, name: str) -> ModelCounts:
        """Return samples used and gated by one model, and its mean normalised innovation squared."""
        index = self.index[name]
        used = int(self._used[index])
        model = self._assembler.models[index]
        return ModelCounts(
            used, int(self._gated[index]), float(self._nis_sum[index] / used) if used else float("nan"),
            float(self._rows_sum[index] / used) if used else float(model.n_measurement), int(self._restarted[index]),
        )  # fmt: skip


def _joined_ends(cuts: Ends, ends: Ends | None) -> Ends | None:
    """Return the sample numbers of both, ascending; None if there are none."""
    return ends if not len(cuts) else np.array(sorted({*cuts.tolist(), *([] if ends is None else ends.tolist())}))


def _filtered(
    x: Array, p: Array, data: kalman.Measurements, process: Array | None, ends: Ends | None
) -> kalman.Updated:
    """Filter the samples, in a batch if there are enough and no process noise."""
    if process is None and data.z.shape[1] >= BATCH_FROM:
        return kalman.batch(x, p, data, ends)
    return kalman.recursion(x, p, data, process, ends)


def _is_sound(x: Array, p: Array) -> bool:
    """Return whether states x (..., n), P (..., n, n) are finite, with positive variances."""
    flat_x, flat_p = x.ravel(), p.ravel()
    finite = math.isfinite(float(flat_x @ flat_x) + float(flat_p @ flat_p))  # nan and inf propagate through sums
    n = p.shape[-1]
    # for the few numbers of a live sample faster than numpy
    return finite and min(p.reshape(-1, n * n)[:, :: n + 1].ravel().tolist()) > 0.0


_NO_CUTS = np.zeros(0, dtype=np.intp)


class BlockScatter:
    """`TimeBlocks` of K filters without process noise, from their states at the block boundaries.

    The information of a block is the difference after and before it. Results hold at the end of the last block, so they
    depend on stamps alone.
    """

    def __init__(self, x: Array, p: Array) -> None:
        """Start from states x (K, n), P (K, n, n)."""
        self._blocks = TimeBlocks()
        self._last: int | None = None
        self._state = GaussianState(x, p)
        self._information = self._state.information
        self._found: dict[int, Array] = {}

    def cuts(self, stamps_ns: Stamps) -> Index:
        """Add stamps (N,). Return the sample numbers (E,) after which a new block begins."""
        first, last = int(stamps_ns[0]) // BLOCK_NS, int(stamps_ns[-1]) // BLOCK_NS
        if first == last == (first if self._last is None else self._last):
            self._last = last
            return _NO_CUTS
        blocks = stamps_ns // BLOCK_NS
        before = blocks[0] if self._last is None else self._last
        self._last = int(blocks[-1])
        return np.flatnonzero(np.diff(blocks, prepend=before))

    def add(self, x: Array, p: Array) -> None:
        """Add the states at the cuts, x (E, K, n), P (E, K, n, n)."""
        for matrix, vector in _informations(x, p):
            self._blocks.add(matrix - self._information[0], vector - self._information[1], 1.0)
            self._information = matrix, vector
        self._state = GaussianState(x[-1], p[-1])
        self._found.clear()

    def end_day(self, before: GaussianState, after: GaussianState, of_day: Index) -> None:
        """End a recording: continue with states `after`, x (K, n), P (K, n, n), from those `before`.

        of_day: indices (u,) of the states that differ per recording.
        """
        self.add(before.x[None], before.p[None])
        self._blocks.end_day(of_day, *self._information, np.arange(len(before.x)))
        self._information, self._state = after.information, after
        self._last = None

    def inflation(self, index: int) -> Array:
        """Return the inflation factor of σ (n,) of one filter."""
        if index not in self._found:
            self._found[index] = self._blocks.inflation(index, self._state.x[index], self._state.p[index])
        return self._found[index]


def _informations(x: Array, p: Array) -> Iterator[tuple[Array, Array]]:
    """Yield Λ (K, n, n) and Λx (K, n) of E states x (K, n), P (K, n, n), without singular ones."""
    try:
        yield from zip(*GaussianState(x, p).information, strict=True)
        return
    except np.linalg.LinAlgError:
        pass  # one is singular: invert each alone
    for state in zip(x, p, strict=True):
        with suppress(np.linalg.LinAlgError):
            yield GaussianState(*state).information
