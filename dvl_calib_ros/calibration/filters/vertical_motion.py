"""Vertical motion: the constraint that a vehicle does not heave in the mean, and its height of late.

Heave of a moment is a wave, and sway goes with it: the same water moves both, so what is small in every sample still
bends the roll. Over many waves both average out, as no vehicle leaves the surface or its depth. So the row is that of
means over a block of time,

    0 = mean(g_z) - h + noise,  of variance σ² for a block of 20 s, and inversely to its length for a shorter one,

with a constant h (trim) as a state. σ² is learnt with the states, by expectation maximisation: it is the scatter of
the rows about what they are expected to be, together with `motion_std`² as if that had been seen in PSEUDO_BLOCKS
blocks. It is never below that: in turns a vehicle heaves in proportion to its sway, which is a roll to all rows alike
and scatters by nothing. So all rows weigh what is known of them now, and a filter with a variance fixed at each row
would not do: what is kept are sums, joined with the filter's state when somebody asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..models.parameters import Parameters
from ..numerics.frames import Array, product
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, Mask, Stamps
from .cross_validation import FoldSums, folds_of
from .heading_bias import N_BIAS, N_TERMS

# Waves have periods of up to 20 s.
BLOCK_NS = 20_000_000_000
# A block is not continued after so long a pause.
PAUSE_NS = 5_000_000_000
# `motion_std` counts as much as so many blocks: after ten it is a sixth of what is known.
PSEUDO_BLOCKS = 2.0
# Always as many, whoever asks: each leaves a third of what is missing, or less.
STEPS = 10


class HeaveSums(NamedTuple):
    """Of rows m = (H, z) with weights w, the length of the block in 20 s, at most 1.

    told: Σ w m mᵀ (..., K, n+1, n+1), what they tell at σ² = 1. scatter: Σ w² m mᵀ, in which blocks count by their
    length. mean: Σ w (m, 1) (..., K, n+2), of the rows in `told`. weight: Σ w (..., 1).
    """

    told: Array
    scatter: Array
    mean: Array
    weight: Array

    @staticmethod
    def stacked(sums: Sequence[HeaveSums]) -> HeaveSums:
        """Along a new first axis."""
        return HeaveSums(*(np.stack(each) for each in zip(*sums, strict=True)))

    def with_terms(self, variance: Array | float, upwards: Array) -> tuple[Array, Array]:
        """What they tell of states and terms, Λ (K, n + 9, n + 9) and y (K, n + 9), as of `block_terms.with_terms`.

        A bias b of the DVL is -u·b in each z. variance: (K,) or one for all, of σ². upwards: u (3,) in the DVL's frame.
        """
        k, n = self.mean.shape[0], self.mean.shape[1] - 2
        both, y = np.zeros((k, n + N_TERMS, n + N_TERMS)), np.zeros((k, n + N_TERMS))
        of_bias = -self.mean[:, :, None] * upwards
        both[:, :n, :n], y[:, :n] = self.told[:, :n, :n], self.told[:, :n, n]
        both[:, :n, n : n + N_BIAS], y[:, n : n + N_BIAS] = of_bias[:, :n], of_bias[:, n]
        both[:, n : n + N_BIAS, :n] = of_bias[:, :n].swapaxes(1, 2)
        both[:, n : n + N_BIAS, n : n + N_BIAS] = -of_bias[:, n + 1, None] * upwards[:, None]
        of_one = np.broadcast_to(variance, (k,))
        return both / of_one[:, None, None], y / of_one[:, None]


# Places of what rows told among them.
_TOLD, _MEAN = 0, 2


class HeaveRows:
    """Takes samples in order of their stamps, for K hypotheses or models with n states, and makes rows of them.

    Sums are kept by folds: a row is of the fold of its last sample. It holds nothing of the reference, by which a fold
    is judged.
    """

    def __init__(self, k: int, n: int, parameters: Parameters) -> None:
        self._parameters = parameters
        size = k, n + 1, n + 1
        self._folds = FoldSums(size, size, (k, n + 2), (1,))  # of `HeaveSums`
        self._sum = np.zeros((k, n + 1))
        self._sums: dict[int | None, HeaveSums] = {}  # as asked for since the last change
        self._start()
        self._last_ns: int | None = None

    def _start(self) -> None:
        self._sums.clear()
        self._count, self._seconds = 0, 0.0
        self._sum = np.zeros_like(self._sum)

    def copy(self) -> HeaveRows:
        """The same, which goes its own way."""
        made = copy(self)
        made._folds, made._sums = self._folds.copy(), {}
        return made

    def starts(self, stamps_ns: Stamps) -> Index:
        """Which samples (of N) begin a block that is not the one before."""
        since = self._since(stamps_ns)
        other = (since > PAUSE_NS) | (stamps_ns // BLOCK_NS != (stamps_ns - since) // BLOCK_NS)
        return np.flatnonzero(other)

    def _since(self, stamps_ns: Stamps) -> Stamps:
        """(N,) ns since the sample before each; 0 for the very first."""
        since = np.empty_like(stamps_ns)
        since[0] = 0 if self._last_ns is None else int(stamps_ns[0]) - self._last_ns
        np.subtract(stamps_ns[1:], stamps_ns[:-1], out=since[1:])
        return since

    def add(self, stamps_ns: Stamps, rows: Array, used: Mask, ends: Sequence[int] = ()) -> list[HeaveSums]:
        """Add N samples of (H, z) (N, K, n+1), as far as they are used (N,).

        Returns the sums after the first `ends` (E ascending numbers) of them.
        """
        return self.add_sums(stamps_ns, lambda some: np.asarray(rows[some].sum(axis=0)), used, ends)

    def add_sums(
        self, stamps_ns: Stamps, summed: Callable[[Mask], Array], used: Mask, ends: Sequence[int] = ()
    ) -> list[HeaveSums]:
        """`add` where rows need not be known one by one. summed: the sum (K, n+1) of some (N,) of them."""
        if not len(stamps_ns):
            return [self.sums() for _ in ends]
        starts = set(self.starts(stamps_ns).tolist())
        seconds = self._since(stamps_ns) * 1e-9
        seconds[seconds > PAUSE_NS * 1e-9] = 0.0
        seconds *= used
        found = {0: self.sums()} if 0 in ends else {}
        cuts = sorted({0, len(stamps_ns), *starts, *ends})
        for start, end in pairwise(cuts):
            if start in starts:
                self.close()
            own = used
            if end - start < len(used):
                own = np.zeros_like(used)
                own[start:end] = used[start:end]
            self._count += int(np.count_nonzero(own))
            self._seconds += float(seconds[start:end].sum())
            self._sums.clear()
            self._sum = self._sum + summed(own)
            self._last_ns = int(stamps_ns[end - 1])
            if end in ends:
                found[end] = self.sums()
        return [found[end] for end in ends]

    def close(self) -> None:
        """End the block: what comes is another one's."""
        fold, row = self._open()
        if row is not None:
            self._folds.add(fold, *row)
        self._start()

    def _open(self) -> tuple[int, HeaveSums | None]:
        """The fold and the row of the block that is not ended; None where it has no sample."""
        if not self._count:
            return 0, None
        assert self._last_ns is not None
        mean = self._sum / self._count
        weight = min(self._seconds * 1e9 / BLOCK_NS, 1.0)
        told = weight * mean[:, :, None] * mean[:, None, :]
        return int(folds_of(np.array([self._last_ns]), self._parameters)[0]), HeaveSums(
            told, weight * told, weight * np.append(mean, np.ones((len(mean), 1)), axis=1), np.array([weight])
        )

    def sums(self, without: int | None = None) -> HeaveSums:
        """The rows so far, the one of the block that is not ended among them; without a fold, if one is named."""
        if without not in self._sums:
            fold, row = self._open()
            ended = self._folds.total if without is None else self._folds.without(without)
            if row is not None and fold != without:
                ended = tuple(each + more for each, more in zip(ended, row, strict=True))
            self._sums[without] = HeaveSums(*ended)
        return self._sums[without]

    def absorb(self) -> tuple[HeaveSums, Array]:
        """Give the caller the rows of ended blocks, who has them from now on; what they scatter by is kept.

        Returns the rows, and what they tell by folds (FOLDS, K, n+1, n+1).
        """
        self._sums.clear()
        rows = HeaveSums(*self._folds.total)
        self._folds.taken(_MEAN)
        return rows, self._folds.taken(_TOLD)


def with_heave(state: GaussianState, sums: HeaveSums, motion_std: float) -> tuple[GaussianState, Array]:
    """States x (..., K, n), P (..., K, n, n) with the rows of heave, and σ² (..., K) (m/s)² as learnt with them.

    motion_std: m/s. Raises numpy.linalg.LinAlgError where P is not positive definite.
    """
    x, p = state
    n = x.shape[-1]
    told, scatter = sums.told, sums.scatter
    # in coordinates in which P is 1 and what the rows tell is diagonal
    root = np.linalg.cholesky(p)
    share, turn = np.linalg.eigh(np.swapaxes(root, -1, -2) @ told[..., :n, :n] @ root)
    share = np.maximum(share, 0.0)
    axes = root @ turn
    across = np.swapaxes(axes, -1, -2)
    told_more = told[..., :n, n] - product(told[..., :n, :n], x)
    pull = product(across, told_more)
    # what rows are off by, squared: c - 2 b·t + t·A t, t being how far the state goes along the axes
    off = product(scatter[..., :n, :n], x)
    square = across @ scatter[..., :n, :n] @ axes
    slope = product(across, scatter[..., :n, n] - off)
    constant = scatter[..., n, n] + (x * (off - 2.0 * scatter[..., :n, n])).sum(axis=-1)
    spread = np.diagonal(square, axis1=-2, axis2=-1)
    variance = np.full(x.shape[:-1], motion_std**2)
    for _ in range(STEPS):
        share_left = 1.0 / (variance[..., None] + share)
        gone = pull * share_left
        misfit = np.maximum(constant + (gone * (product(square, gone) - 2.0 * slope)).sum(axis=-1), 0.0)
        unsure = variance * (spread * share_left).sum(axis=-1)
        before = variance
        variance = (PSEUDO_BLOCKS * motion_std**2 + misfit + unsure) / (PSEUDO_BLOCKS + sums.weight)
        variance = np.maximum(variance, motion_std**2)
        if (variance == before).all():  # as where nothing heaves
            break
    left = variance[..., None] / (variance[..., None] + share)
    found = x + product(axes, pull / (variance[..., None] + share))
    return GaussianState(found, (axes * left[..., None, :]) @ np.swapaxes(axes, -1, -2)), variance


# What was so long ago is forgotten, s: a pitch that is wrong by 3 degrees adds up to 10 m at 2 m/s, and stays there,
# where a model takes it for a part of its constant current.
MEMORY_S = 100.0
# Between samples further apart than this, s, nobody knows how far it rose or sank.
LONGEST_STEP_S = 5.0


class RelativeHeight:
    """Integrates the vertical velocity sample by sample, so that it does not matter in what blocks they come."""

    def __init__(self) -> None:
        self._height = 0.0
        self._last_ns: int | None = None

    def add(self, stamps_ns: Stamps, rising: Array) -> Array:
        """Heights (N,) m after further samples. rising: (N,) m/s, positive up."""
        height, last_ns = self._height, self._last_ns
        heights = np.empty(len(rising))
        for row, (stamp_ns, speed) in enumerate(zip(stamps_ns.tolist(), rising.tolist(), strict=True)):
            step_s = 0.0 if last_ns is None else 1e-9 * (stamp_ns - last_ns)
            left = math.exp(-step_s / MEMORY_S)
            height *= left
            if step_s <= LONGEST_STEP_S:
                height += speed * MEMORY_S * (1.0 - left)
            heights[row] = height
            last_ns = stamp_ns
        self._height, self._last_ns = height, last_ns
        return heights

    def end_day(self) -> None:
        """Forget all of it."""
        self._height, self._last_ns = 0.0, None
