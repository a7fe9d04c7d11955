"""By how much the heading is off, as it changes with the heading and with time: states beside those of the mounting.

Yaw is found against the IMU's heading. A constant error of that is harmless, as the same IMU navigates; one that
changes is not: a compass deviates by one and two cycles of the heading, a gyro drifts. The error δ turns a reference in
an earth frame as a misalignment about the body's vertical u does, so with Λ_b, y_b what a block of time told of the
states and t_b the terms of its heading, the block tells of them and of the coefficients d of δ = tᵀd together

    | Λ_b          Λ_b u tᵀ    |   | y_b       |
    | t (Λ_b u)ᵀ   uᵀΛ_b u t tᵀ |   | uᵀy_b t   |

No row has a column more; blocks of time have (time_blocks.py). On one heading δ and yaw are the same to the data, and
σ of yaw holds both; on reciprocal headings one cycle of it averages out. How large coefficients are is said by
`heading_deviation_std`, until headings show it to be more or less (empirical Bayes).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .frames import Array, product
from .kalman import GaussianState
from .samples import Index, Mask, Stamps
from .time_blocks import BlocksOfOne, TimeBlocks, inflations

# Terms of a block: sine and cosine of its heading and of twice that, time (s), and one, where references are of the
# earth, else zeros.
N_TERMS = 6
# Prior σ of the coefficients, of heading_deviation_std: one cycle, two cycles, and a drift from first to last.
_SHARE = np.array([1.0, 1.0, 0.7, 0.7, 1.0])
N_COEFFICIENTS = len(_SHARE)
# A compass deviates with the heading, a gyro drifts: what one of them shows says nothing of the other.
_CYCLES, _DRIFT = np.arange(N_COEFFICIENTS) < 4, np.arange(N_COEFFICIENTS) == 4
# How large they may be instead of what the parameter says, which is the root of their mean square, and how likely each
# is: a factor of 4 is one σ of its logarithm. Most headings are better than it, a few are much worse.
_WIDTH = np.log(4.0)
_LOGS: Array = np.arange(-6.0, 3.5, 0.35)
_LOG_LIKELY: Array = -0.5 * (_LOGS / _WIDTH + _WIDTH) ** 2
_FACTORS: Array = np.exp(_LOGS) / np.sqrt(np.exp(_LOG_LIKELY) @ np.exp(2.0 * _LOGS) / np.exp(_LOG_LIKELY).sum())
# A block with less than this of another's information has none: rounding left it.
NOTHING = 1e-9
# A constant of any size, rad.
_ANY = 1.0
# A drift is one from so long on, s.
_SHORTEST_S = 60.0


def heading_terms(earth_in_body: Array, weight: Array, seconds: float) -> Array:
    """Terms (6,) of a block: means over references, `Observations.earth_in_body` (N, 3, 2), weight (N,)."""
    ahead = earth_in_body[:, 0]
    length = np.sqrt((ahead * ahead).sum(axis=1))
    share = np.where(length > 0.0, weight, 0.0) / max(float(weight.sum()), 1e-300)
    east, north = (ahead / np.where(length > 0.0, length, 1.0)[:, None]).T
    one = share.sum()
    return np.array(
        [share @ north, share @ east, 2.0 * (share @ (north * east)), share @ (east**2 - north**2), seconds * one, one]
    )


class BlockTerms:
    """Terms of blocks of time that end where they are said to, from samples in order."""

    def __init__(self) -> None:
        self._epoch_ns: int | None = None
        self._waiting: list[tuple[Stamps, Array]] = []

    def add(self, stamps_ns: Stamps, earth_in_body: Array | None) -> None:
        """Take N samples: stamps (N,), `Observations.earth_in_body` (N, 3, 2)."""
        if self._epoch_ns is None:
            self._epoch_ns = int(stamps_ns[0])
        earth = np.zeros((len(stamps_ns), 3, 2)) if earth_in_body is None else earth_in_body
        self._waiting.append((stamps_ns, earth))

    def upto(self, cuts: Index) -> Array:
        """Terms (E, 6) of the blocks that end after so many (E,) of the samples taken last; zeros without any."""
        *before, (stamps_ns, earth) = self._waiting
        parts = [slice(first, end) for first, end in pairwise([0, *cuts.tolist(), len(stamps_ns)])]
        blocks = [[(stamps_ns[part], earth[part])] for part in parts]
        blocks[0] = [*before, *blocks[0]]
        self._waiting = blocks.pop()
        return np.array([self._terms(block) for block in blocks])

    def rest(self) -> Array:
        """Terms (6,) of the block that ends with the last sample taken."""
        block, self._waiting = self._waiting, []
        return self._terms(block)

    def _terms(self, block: list[tuple[Stamps, Array]]) -> Array:
        if not sum(len(stamps_ns) for stamps_ns, _ in block):
            return np.zeros(N_TERMS)
        assert self._epoch_ns is not None
        stamps_ns, earth = (np.concatenate(each) for each in zip(*block, strict=True))
        seconds = 1e-9 * float((stamps_ns - self._epoch_ns).mean())
        return heading_terms(earth, np.ones(len(earth)), seconds)


def upwards(rotation_dvl_from_body: Array, n: int) -> Array:
    """Of n states, the misalignment first, those that turn about the body's vertical: u (n,)."""
    u = np.zeros(n)
    u[:3] = rotation_dvl_from_body[:, 2]
    return u


def with_terms(information: Array, vector: Array, terms: Array, up: Array) -> tuple[Array, Array]:
    """What a block told of K times n states, Λ (K, n, n) and y (K, n), with what it tells of the terms beside them."""
    k, n = vector.shape
    both, y = np.empty((k, n + N_TERMS, n + N_TERMS)), np.empty((k, n + N_TERMS))
    turned = information @ up
    both[:, :n, :n] = information
    both[:, :n, n:] = turned[:, :, None] * terms
    both[:, n:, :n] = both[:, :n, n:].swapaxes(1, 2)
    both[:, n:, n:] = (turned @ up)[:, None, None] * np.outer(terms, terms)
    y[:, :n] = vector
    y[:, n:] = (vector @ up)[:, None] * terms
    return both, y


def all_told(information: Array, vector: Array, blocks: TimeBlocks) -> tuple[Array, Array]:
    """All that is known of K times n states, Λ (K, n, n) and y (K, n), with what blocks tell of the terms."""
    if not blocks.count:
        return with_terms(information, vector, np.zeros(N_TERMS), np.zeros(vector.shape[1]))
    n = vector.shape[1]
    both, y = (each.copy() for each in blocks.total)
    both[:, :n, :n], y[:, :n] = information, vector
    return both, y


class HeadingStates(NamedTuple):
    """What the data say of it, and what that makes of M hypotheses of n states.

    coefficients: x (5,), P (5, 5), of the hypothesis that says how large it is: of sine and cosine of the yaw and of
    twice the yaw, rad, and of time, rad/s; None where no reference is turned by a heading. shift (M, n), more
    (M, n, n): to be added to x and P. drifted: rad², to be added to the variance of yaw, as nobody knows when a heading
    that drifts was right. inflation: (n,) by how much σ of that hypothesis has to grow then, as of `TimeBlocks`.
    """

    coefficients: GaussianState | None
    shift: Array
    more: Array
    drifted: float
    inflation: Array


class HeadingEvidence(NamedTuple):
    """M hypotheses as they stood once: x (M, n), P (M, n, n) without a deviation, and what blocks of time told of them.

    best: place of the one that says how large it is. information (M, n + 6, n + 6), vector (M, n + 6): of all blocks
    `with_terms`. blocks: those of the best one.
    """

    states: GaussianState
    best: int
    information: Array
    vector: Array
    blocks: BlocksOfOne

    @staticmethod
    def of(blocks: TimeBlocks, states: GaussianState, numbers: Index, best: int) -> HeadingEvidence:
        """Of hypotheses with these numbers (M,) in the blocks, as of now."""
        information, vector = blocks.total
        some = numbers if blocks.count else numbers[:0]
        return HeadingEvidence(states, best, information[some], vector[some], blocks.of(int(numbers[best])))

    @property
    def has_terms(self) -> bool:
        """Whether there are blocks, and these are `with_terms`."""
        return self.vector.shape[1] > self.states.x.shape[1]


def heading_states(seen: Sequence[HeadingEvidence], std: float) -> list[HeadingStates]:
    """The deviation each time; none where blocks are without terms, which say no more than `inflation`.

    std: rad, `heading_deviation_std`.
    """
    found: dict[int, HeadingStates] = {}
    with_them = [number for number, each in enumerate(seen) if each.has_terms]
    if with_them:
        deviations = [_Deviation.of(seen[number]) for number in with_them]
        sound = [place for place, each in enumerate(deviations) if _is_definite(each.information, std)]
        states = _deviating([deviations[place] for place in sound], std) if sound else []
        found = {with_them[place]: each for place, each in zip(sound, states, strict=True)}
    return [found[number] if number in found else _none(each) for number, each in enumerate(seen)]


def _none(seen: HeadingEvidence) -> HeadingStates:
    """Of blocks without terms; and numbers that ran away say nothing of the heading."""
    m, n = seen.states.x.shape
    factor: Array = np.ones(n)
    if not seen.has_terms and len(seen.blocks.vector):
        best = slice(seen.best, seen.best + 1)
        factor = inflations([seen.blocks], seen.states.x[best], seen.states.p[best])[0]
    return HeadingStates(None, np.zeros((m, n)), np.zeros((m, n, n)), 0.0, factor)


class _Deviation(NamedTuple):
    """What M hypotheses know of the coefficients. onto: (5, 6), from terms to coefficients. turned: (M, 5, n), by how
    much the states turn them. information (M, 5, 5), scores (M, 5): theirs, whatever the states are."""

    seen: HeadingEvidence
    onto: Array
    turned: Array
    information: Array
    scores: Array

    @staticmethod
    def of(seen: HeadingEvidence) -> _Deviation:
        """By what was seen."""
        x, p = seen.states
        n, told = x.shape[1], seen.information
        onto = _onto_coefficients(told[seen.best, n:, n:], seen.blocks.information[:, -1, -2:])
        beside = onto @ told[:, n:, :n]
        turned = beside @ p
        own = onto @ told[:, n:, n:] @ onto.T - turned @ beside.swapaxes(1, 2)
        return _Deviation(seen, onto, turned, own, seen.vector[:, n:] @ onto.T - product(beside, x))


def _deviating(each: Sequence[_Deviation], std: float) -> list[HeadingStates]:
    """S times the deviation."""
    sizes = np.array([len(one.scores) for one in each])
    owner, ends = np.repeat(np.arange(len(each)), sizes), np.cumsum(sizes)
    best = ends - sizes + [one.seen.best for one in each]
    turned, own, scores, told, vector = (
        np.concatenate(parts)
        for parts in zip(
            *((one.turned, one.information, one.scores, one.seen.information, one.seen.vector) for one in each),
            strict=True,
        )
    )
    x, p = (
        np.stack(parts) for parts in zip(*((s.states.x[s.best], s.states.p[s.best]) for s, *_ in each), strict=True)
    )
    onto = np.stack([one.onto for one in each])
    n, of_best = x.shape[1], told[best]
    to_terms = np.zeros((len(each), n + N_TERMS, n + N_COEFFICIENTS))
    to_terms[:, :n, :n] = np.eye(n)
    to_terms[:, n:, n:] = onto.swapaxes(1, 2)

    def deviating(root: Array, at: Index) -> tuple[Array, Array, Array, Array]:
        """Coefficients, their covariance, shift and more of some hypotheses, where their prior has σ root (S, 5)."""
        std_of = root[owner[at]]
        spread = np.eye(N_COEFFICIENTS) + std_of[:, :, None] * own[at] * std_of[:, None]
        p = std_of[:, :, None] * np.linalg.inv(spread) * std_of[:, None]
        x = product(p, scores[at])
        across = turned[at].swapaxes(1, 2)
        more = across @ (p @ turned[at])
        return x, 0.5 * (p + p.swapaxes(1, 2)), -product(across, x), 0.5 * (more + more.swapaxes(1, 2))

    def inflation(root: Array) -> tuple[Array, Array, Array]:
        """Of the best ones: coefficients, their covariance, and by how much σ (S, n + 5) of states and them grow."""
        found, own_p, shift, more = deviating(root, best)
        both = np.empty((len(each), n + N_COEFFICIENTS, n + N_COEFFICIENTS))
        across = -turned[best].swapaxes(1, 2) @ own_p
        both[:, :n, :n], both[:, :n, n:], both[:, n:, :n], both[:, n:, n:] = (
            p + more,
            across,
            across.swapaxes(1, 2),
            own_p,
        )
        at = product(to_terms, np.concatenate([x + shift, found], axis=1))
        variance = np.diagonal(both, axis1=1, axis2=2)
        return found, own_p, inflations([s.blocks for s, *_ in each], at, both @ to_terms.swapaxes(1, 2), variance)

    # what is left where it may be of any size is noise, and whatever else: the evidence is worth as much less
    root: Array = np.broadcast_to(_FACTORS[-1] * std * _SHARE, (len(each), N_COEFFICIENTS))
    _, _, factor = inflation(root)
    level = (factor[:, n:] ** 2).mean(axis=1)
    # and a constant beside, of any size: a yaw that its own prior does not expect is no deviation for that
    free = np.concatenate([onto, np.broadcast_to(np.eye(N_TERMS)[-1:], (len(each), 1, N_TERMS))], axis=1)
    across = free.swapaxes(1, 2)
    beside = free @ of_best[:, n:, :n]
    own_free = free @ of_best[:, n:, n:] @ across - beside @ p @ beside.swapaxes(1, 2)
    scores_free = product(free, vector[best, n:]) - product(beside, x)
    root = np.broadcast_to(std * _SHARE, (len(each), N_COEFFICIENTS))
    for which in (_CYCLES, _DRIFT):
        size = _size(own_free / level[:, None, None], scores_free / level[:, None], root, which)
        root = np.where(which, size[:, None], 1.0) * root
    found, own_p, factor = inflation(root)
    _, _, shift, more = deviating(root, np.arange(len(owner)))
    states = []
    for number, (end, size) in enumerate(zip(ends.tolist(), sizes.tolist(), strict=True)):
        at = slice(end - size, end)
        one, p_one = found[number], own_p[number]
        # at any time of the recording, as far as data show
        is_turned = bool(of_best[number, -1, -1] > 0.0)
        drifted = (one[-1] ** 2 + p_one[-1, -1]) / 12.0 if is_turned else 0.0
        in_time = np.append(np.ones(N_COEFFICIENTS - 1), onto[number, -1, -2])
        of_one = GaussianState(one * in_time, p_one * np.outer(in_time, in_time)).raised(factor[number, n:])
        states.append(
            HeadingStates(of_one if is_turned else None, shift[at], more[at], float(drifted), factor[number, :n])
        )
    return states


def _is_definite(information: Array, std: float) -> bool:
    """Whether information (M, 5, 5) on the coefficients is that, rounding aside."""
    widest = _FACTORS[-1] * std * _SHARE
    try:
        np.linalg.cholesky(np.eye(N_COEFFICIENTS) + widest[:, None] * information * widest)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(information).all())


def _onto_coefficients(square: Array, times: Array) -> Array:
    """(5, 6): from sums over the terms to those over coefficients, whose drift has no mean and ends with 1.

    square: (6, 6) of the terms. times: (B, 2) of blocks, information of yaw times its time (s), and that information.
    """
    onto = np.zeros((N_COEFFICIENTS, N_TERMS))
    onto[: N_TERMS - 2, : N_TERMS - 2] = np.eye(N_TERMS - 2)
    told = times[times[:, 1] > NOTHING * times[:, 1].max()]
    if len(told):
        at = told[:, 0] / told[:, 1]
        span = max(float(at[-1] - at[0]), _SHORTEST_S)
        onto[-1, -2:] = 1.0 / span, -square[-1, -2] / square[-1, -1] / span
    return onto


def _size(information: Array, scores: Array, root: Array, which: Mask) -> Array:
    """How many times larger (S,) the prior σ root (S, 5) of some coefficients is, by the evidence: root mean square.

    information (S, 6, 6), scores (S, 6): of the coefficients and a constant, without their prior. which: (5,).
    """
    factors = np.where(which, _FACTORS[:, None], 1.0)
    roots = np.full((len(root), *factors.shape[:1], N_COEFFICIENTS + 1), _ANY)
    roots[..., :-1] = factors * root[:, None]
    spread = np.eye(N_COEFFICIENTS + 1) + roots[..., None] * information[:, None] * roots[..., None, :]
    about = roots * scores[:, None]
    explained = (about * np.linalg.solve(spread, about[..., None])[..., 0]).sum(axis=2)
    likely = 0.5 * (explained - np.linalg.slogdet(spread)[1]) + _LOG_LIKELY
    share = np.exp(likely - likely.max(axis=1, keepdims=True))
    # not by `@`, which sums in another order for one than for several
    size: Array = np.sqrt((share * _FACTORS**2).sum(axis=1) / share.sum(axis=1))
    return size
