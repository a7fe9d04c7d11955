"""What rows tell each hypothesis of the delay, and how far they are from what it expects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..filters.vertical_motion import HeaveRows, HeaveSums
from ..models.own import DELAY, N_STATE
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState, distance_squared
from ..numerics.samples import Index, Mask
from .observation_rows import DELAYS_S, OF_DELAY, OF_NONE, DelayedRows
from .posterior_types import BlockRows, Hypotheses, Sums, Told

# Columns of what rows hold for each delay, and the states that they say anything of.
_MOVING: Index = np.append(OF_DELAY, N_STATE)
_SHOWN_BY_ROWS: Index = np.concatenate([OF_NONE, OF_DELAY])


def told_by(rows: DelayedRows, use: Mask) -> Array:
    """What some rows tell each hypothesis (K, n+1, n+1): the sums of HᵀWH, HᵀWz and zᵀWz."""
    some = rows if use.all() else rows.part(use)
    k = len(some.moving)
    weight = np.concatenate([some.weight] * 3)
    n = len(weight)
    moving, standing = some.moving.reshape(k, len(_MOVING), n), some.standing.reshape(len(OF_NONE), n)
    weighted = moving * weight
    told = np.zeros((k, N_STATE + 1, N_STATE + 1))
    across = (weighted.reshape(k * len(_MOVING), n) @ standing.T).reshape(k, len(_MOVING), len(OF_NONE))
    told[:, _MOVING[:, None], _MOVING] = weighted @ moving.swapaxes(1, 2)
    told[:, _MOVING[:, None], OF_NONE], told[:, OF_NONE[:, None], _MOVING] = across, across.swapaxes(1, 2)
    told[:, OF_NONE[:, None], OF_NONE] = (standing * weight) @ standing.T
    return told


def innovation_squared(found: GaussianState, rows: DelayedRows) -> Array:
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


# Each hypothesis believes its own delay to this, s: neighbours overlap, so together they hold any delay between them.
CELL_STD_S = 0.2
# Hypotheses with a smaller share of the best one's probability are left out of the mixture.
SMALLEST_SHARE = 1e-9


class ExpectingBank(Protocol):
    """The part of a bank of delays that `ExpectedBlocks` reads."""

    @property
    def heave(self) -> HeaveRows:
        """Rows of heave that the bank has."""

    @property
    def sums(self) -> Sums:
        """Sums of all blocks that the bank has."""

    @property
    def hypotheses(self) -> Hypotheses:
        """Hypotheses by these sums."""

    def told_by(self, block: BlockRows, use: Mask) -> Told:
        """Return the normal equations of the rows of a block that are used."""

    def gated_by(self, nis: Sequence[Array]) -> list[Mask]:
        """Return the rows of blocks that a gate lets pass."""

    def steps(self, start: Sums, told: Sequence[Told], heave: Sequence[HeaveSums]) -> list[tuple[Sums, Hypotheses]]:
        """Return sums and hypotheses after each of several blocks."""


class ExpectedBlocks:
    """What blocks of rows make of a bank, found before it takes them.

    Which rows are used depends on the state before their block, and that on which rows were used before. So all are
    expected to be used at first; the states by that say which are, and again, until nothing changes: every time one
    block more is settled, and nearly always all of them are.

    use (J,), nis (J,), told, steps: of each block. heave: rows of heave with theirs; rows: what they were by then.
    """

    def __init__(self, bank: ExpectingBank, blocks: Sequence[BlockRows]) -> None:
        self._bank, self._blocks = bank, blocks
        self.use: list[Mask] = [np.ones(len(each.rows), dtype=bool) for each in blocks]
        self.nis: list[Array] = [np.zeros(len(each.rows)) for each in blocks]
        self.steps: list[tuple[Sums, Hypotheses]] = []
        found: dict[int, Told] = {}
        settled, last = 0, len(blocks) - 1
        while True:
            for number in range(last):
                if number not in found:
                    found[number] = bank.told_by(blocks[number], self.use[number])
            self.told = [found[number] for number in range(last)]
            self.is_finite = all(each.is_finite for each in self.told)
            if not self.is_finite:
                return
            self.heave = bank.heave.copy() if last else bank.heave
            self.rows = [self._heave_after(number) for number in range(last)]
            # of the one that was settled last other rows are used than the time before
            first = max(settled - 1, 0)
            start = self.steps[first - 1][0] if first else bank.sums
            self.steps = self.steps[:first] + bank.steps(start, self.told[first:], self.rows[first:])
            for number in range(settled, last + 1):
                before = self.steps[number - 1][1] if number else bank.hypotheses
                state = GaussianState(before.x, before.p)
                self.nis[number] = innovation_squared(state, blocks[number].rows).min(axis=0)
            used = bank.gated_by(self.nis)
            wrong = [number for number in range(last + 1) if (used[number] != self.use[number]).any()]
            self.use = used
            if not wrong or wrong[0] == last:
                break
            settled = wrong[0] + 1
            for number in wrong:
                found.pop(number, None)
        self.told.append(bank.told_by(blocks[last], self.use[last]))
        self.is_finite = self.told[last].is_finite
        if self.is_finite:
            start = self.steps[-1][0] if last else bank.sums
            self.rows.append(self._heave_after(last))
            self.steps += bank.steps(start, self.told[last:], self.rows[last:])

    def _heave_after(self, number: int) -> HeaveSums:
        rows, stamps_ns, _ = self._blocks[number]
        self.heave.add_sums(stamps_ns, rows.heave, self.use[number])
        return self.heave.sums()


def conditioned(state: GaussianState, which: Index, values: Array) -> GaussianState:
    """A state x (n,), P (n, n) where some of it (u,) is known."""
    gain = np.linalg.solve(state.p[np.ix_(which, which)], state.p[which]).T
    return GaussianState(state.x + gain @ (values - state.x[which]), state.p - gain @ state.p[which])


def not_observed(shown: Mask, of: Index) -> Index:
    """Those `of` the states that are not shown (n,)."""
    return of[~shown[of]]


def likely_hypotheses(log_share: Array) -> tuple[Index, Array]:
    """Which hypotheses are in the mixture, and the share of each."""
    share = np.exp(log_share - log_share.max())
    share[share < SMALLEST_SHARE] = 0.0
    kept = np.flatnonzero(share)
    return kept, share[kept] / share[kept].sum()


def merged_mixture(states: GaussianState, delays_s: Array, share: Array) -> GaussianState:
    """Hypotheses x (M, n), P (M, n, n) with their delays (M,) as one; its delay is the whole."""
    x = states.x.copy()
    x[:, DELAY] += delays_s
    mean = share @ x
    apart = x - mean
    p = np.einsum("k,kij->ij", share, states.p) + np.einsum("k,ki,kj->ij", share, apart, apart)
    return GaussianState(mean, 0.5 * (p + p.T))


def prior_by_delay(prior: GaussianState) -> GaussianState:
    """The prior of each hypothesis, x (K, n), P (K, n, n): as if the delay had been measured to be its own.

    So the mixture of all is the prior, and each is linear where it stands.
    """
    gain = prior.p[:, DELAY] / (prior.p[DELAY, DELAY] + CELL_STD_S**2)
    p = prior.p - np.outer(gain, prior.p[DELAY])
    x = prior.x + (DELAYS_S - prior.x[DELAY])[:, None] * gain
    x[:, DELAY] -= DELAYS_S
    return GaussianState(x, np.broadcast_to(p, (len(DELAYS_S), *p.shape)).copy())
