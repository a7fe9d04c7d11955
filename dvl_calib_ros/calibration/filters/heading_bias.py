"""Heading deviation and DVL bias as nuisance parameters, estimated from blocks of time.

Yaw is found against the IMU's heading. A constant error of that is harmless, as the same IMU navigates; one that
changes is not: a compass deviates by one and two cycles of the heading, a gyro drifts. A DVL has a bias, which at one
speed is a misalignment and a scale, and at another another. What blocks of time tell of their coefficients is told with
what they tell of the mounting (heading_bias.py). On one heading a deviation and yaw are the same to the data, as are at
one speed a bias and roll, pitch or yaw and scale: σ of these holds both. On reciprocal headings one cycle of a
deviation averages out; several speeds show a bias. How large coefficients of the heading are is said by
`heading_deviation_std`, until headings show it to be more or less (empirical Bayes); of the bias by `dvl_bias_std`.

A constant error of the heading is in the yaw, but for what it turns about the earth's vertical and a yaw does not: a
vehicle that leans into its turns, where alone it has sway, has it in the vertical velocity, where it would be a roll.
So it is a state beside the yaw, of which it holds nothing.

Coefficients of the heading are taken off the states, as a heading that deviates does so whatever is done with the
result. The bias is considered, and not taken off: nobody takes a bias off velocities, and a mounting without it would
be worse at the speeds driven than one with it.

A block of time told Λ_b, y_b of the states. An error δ of the heading turns a reference in an earth frame as a
misalignment about the earth's vertical does, which leans as the vehicle does: one that leans into its turns, where
alone it has sway, would take what that makes of the vertical velocity for a roll. A bias b of the DVL is to velocities
v that are nearly one another's the same as a misalignment v × b / |v|² and a scale v·b / |v|²: large where it is slow,
small where it is fast. So what either does in a block is what states x = U_b d do, with d the coefficients of the terms
and U_b (n, 9) of that block: three of the bias, six of the heading. The block tells of states and coefficients together

    | Λ_b       Λ_b U_b     |   | y_b      |
    | U_bᵀ Λ_b  U_bᵀ Λ_b U_b |   | U_bᵀ y_b |

With a bias free, speeds alone say what is scale; and where they do not change, noise of the DVL's own mean of a block
does, with as much of it in the error: it would be a scale of 1 and a bias of -v. It pulls y of the bias by
-w n² / v, w being the information that velocities of the block are known with and n² the squares of what noise of three
axes leaves of its mean; that is taken off.

A DVL has one bias, on one day as on the next. Estimates of two recordings are then off together: of a bias b of σ_b
along each axis by columns_1 b / σ_b and columns_2 b / σ_b, as far as their own speeds did not show it. Their difference
has the variance P_1 + P_2 - columns_1 columns_2ᵀ - columns_2 columns_1ᵀ, which at one speed is without the bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..numerics.block_covariance import BlocksOfOne, TimeBlocks, inflations
from ..numerics.frames import Array, cross, product, skew
from ..numerics.kalman import GaussianState
from ..numerics.robust import median
from ..numerics.samples import Index, Mask, Stamps

# Terms of a block: three axes of a bias of the DVL; sine and cosine of its heading and of twice that, time (s), and
# one, where references are of the earth, else zeros.
N_BIAS, N_TERMS = 3, 9
# Mean square of velocities that are not zero, (m/s)²; what is so many times further off than usual is an outlier.
LEAST, OUTLYING = 1e-12, 5.0
# A turn about the velocity itself shows by this share of its square, which noise of a hundredth of it makes.
LEAST_SHOWN = 1e-4


def turns_of(rotation_dvl_from_body: Array, n: int) -> Array:
    """Of n states, the misalignment first, those that turn about each axis of the body: (n, 3)."""
    turns = np.zeros((n, 3))
    turns[:3] = rotation_dvl_from_body
    return turns


class TermsOfBlock(NamedTuple):
    """Of a block. of_states: U (..., n, 9). pull: (..., 3), what noise takes of y of the bias for each unit of
    information on the yaw. up: (n,), the states that turn about the body's vertical, the last of `turns_of`."""

    of_states: Array
    pull: Array
    up: Array

    @staticmethod
    def none(up: Array) -> TermsOfBlock:
        """Of a block that has none."""
        return TermsOfBlock(np.zeros((len(up), N_TERMS)), np.zeros(N_BIAS), up)


def block_terms(
    earth_in_body: Array, velocity_dvl: Array, off: Array, weight: Array, seconds: float, turns: Array, n_errors: int
) -> TermsOfBlock:
    """Those of a block of N references: `Observations.earth_in_body` (N, 3, 2); velocity of the DVL, and reference less
    that, (..., N, 3) m/s in the DVL's frame; weight (N,), and its time (s). turns: (n, 3) as of `turns_of`. n_errors:
    of the n, misalignment and scales.
    """
    # not by what is an outlier, which no filter takes
    size = np.abs(off - median(off.swapaxes(0, -2))[..., None, :]).sum(axis=-1)
    share = weight * (size <= OUTLYING * median(size.swapaxes(0, -1))[..., None])
    share /= np.maximum(share.sum(axis=-1, keepdims=True), LEAST)
    mean, off_mean = (_mean(share, each) for each in (velocity_dvl, off))
    square = np.maximum(_mean(share, velocity_dvl * velocity_dvl).sum(axis=-1), LEAST)
    # samples that are added and taken off in turn hold as much noise as their mean; that of the DVL is in both
    in_turn = share * np.where(np.arange(share.shape[-1]) % 2, -1.0, 1.0)
    moved, off_moved = velocity_dvl - mean[..., None, :], off - off_mean[..., None, :]
    noise = -(_mean(in_turn, moved) * _mean(in_turn, off_moved)).sum(axis=-1)
    by_square = mean / square[..., None]
    terms = np.zeros((*mean.shape[:-1], len(turns), N_TERMS))
    terms[..., :3, :N_BIAS], terms[..., 3:n_errors, :N_BIAS] = skew(by_square), by_square[..., None, :]
    terms[..., :3, N_BIAS:] = _heading_terms(earth_in_body, velocity_dvl, weight, seconds, turns[:3])
    return TermsOfBlock(terms, (noise / square)[..., None] * by_square, turns[:, 2])


def _mean(share: Array, values: Array) -> Array:
    """Of values (..., N, 3) with shares (..., N)."""
    found: Array = (share[..., None, :] @ values)[..., 0, :]
    return found


def _heading_terms(
    earth_in_body: Array, velocity_dvl: Array, weight: Array, seconds: float, dvl_from_body: Array
) -> Array:
    """(..., 3, 6), the misalignment that is to the velocities of a block, in least squares, what each term is.

    That is the mean of the axis about which a term turns, as far as the velocities show one; where sway and lean come
    and go together, as in turns, it is what the one makes of the other.
    """
    ahead = earth_in_body[:, 0]
    length = np.sqrt((ahead * ahead).sum(axis=1))
    share = np.where(length > 0.0, weight, 0.0) / max(float(weight.sum()), 1e-300)
    east, north = (ahead / np.where(length > 0.0, length, 1.0)[:, None]).T
    one = np.ones(len(share))
    of_term = np.column_stack([north, east, 2.0 * north * east, east**2 - north**2, seconds * one, one])
    vertical = cross(earth_in_body[:, :, 0], earth_in_body[:, :, 1]) @ dvl_from_body.T
    each = share[:, None] * of_term
    turned = vertical.T @ each
    # of v × u the least squares misalignment: [Σ |v|² I - v vᵀ]⁻¹ Σ (|v|² u - v vᵀ u)
    square = (velocity_dvl * velocity_dvl).sum(axis=-1)
    along = (velocity_dvl * vertical).sum(axis=-1)
    across = velocity_dvl.swapaxes(-1, -2)
    found = (square[..., None, :] * vertical.T - across * along[..., None, :]) @ each
    total = (square @ share)[..., None, None]
    known = total * (1.0 + LEAST_SHOWN) * np.eye(3) - (across * share) @ velocity_dvl
    return np.asarray(np.linalg.solve(known + LEAST * np.eye(3), found + (LEAST_SHOWN * total + LEAST) * turned))


class BlockTerms:
    """Terms of blocks of time that end where they are said to, from samples in order."""

    def __init__(self, turns: Array, n_errors: int) -> None:
        """turns, n_errors: as in `block_terms`."""
        self._turns, self._n_errors = turns, n_errors
        self.up: Array = turns[:, 2]
        self._epoch_ns: int | None = None
        self._waiting: list[tuple[Stamps, Array, Array, Array]] = []

    def add(self, stamps_ns: Stamps, earth_in_body: Array | None, velocity_dvl: Array, off: Array) -> None:
        """Take N samples with stamps (N,), the rest as in `block_terms`."""
        if self._epoch_ns is None:
            self._epoch_ns = int(stamps_ns[0])
        earth = np.zeros((len(stamps_ns), 3, 2)) if earth_in_body is None else earth_in_body
        self._waiting.append((stamps_ns, earth, velocity_dvl, off))

    def upto(self, cuts: Index) -> list[TermsOfBlock]:
        """Terms of the E blocks that end after so many (E,) of the samples taken last; zeros without any."""
        *before, (stamps_ns, earth, velocity, off) = self._waiting
        parts = [slice(first, end) for first, end in pairwise([0, *cuts.tolist(), len(stamps_ns)])]
        blocks = [[(stamps_ns[part], earth[part], velocity[part], off[part])] for part in parts]
        blocks[0] = [*before, *blocks[0]]
        self._waiting = blocks.pop()
        return [self._terms(block) for block in blocks]

    def rest(self) -> TermsOfBlock:
        """Terms of the block that ends with the last sample taken."""
        block, self._waiting = self._waiting, []
        return self._terms(block)

    def _terms(self, block: list[tuple[Stamps, Array, Array, Array]]) -> TermsOfBlock:
        if not sum(len(stamps_ns) for stamps_ns, *_ in block):
            return TermsOfBlock.none(self.up)
        assert self._epoch_ns is not None
        stamps_ns, earth, velocity, off = (np.concatenate(each) for each in zip(*block, strict=True))
        seconds = 1e-9 * float((stamps_ns - self._epoch_ns).mean())
        return block_terms(earth, velocity, off, np.ones(len(earth)), seconds, self._turns, self._n_errors)


def with_terms(information: Array, vector: Array, terms: TermsOfBlock) -> tuple[Array, Array]:
    """What a block told of K times n states, Λ (K, n, n) and y (K, n), with what it tells of its terms."""
    k, n = vector.shape
    both, y = np.empty((k, n + N_TERMS, n + N_TERMS)), np.empty((k, n + N_TERMS))
    turned = information @ terms.of_states
    across = terms.of_states.swapaxes(-1, -2)
    both[:, :n, :n] = information
    both[:, :n, n:] = turned
    both[:, n:, :n] = turned.swapaxes(1, 2)
    both[:, n:, n:] = across @ turned
    y[:, :n] = vector
    y[:, n:] = product(across, vector)
    y[:, n : n + N_BIAS] += ((information @ terms.up) @ terms.up)[:, None] * terms.pull
    return both, y


def all_told(
    information: Array, vector: Array, blocks: TimeBlocks, beside: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """All that is known of K times n states, Λ (K, n, n) and y (K, n), with what blocks tell of the terms.

    beside: what else tells of them, as of `with_terms`.
    """
    n = vector.shape[1]
    if not blocks.count:
        return with_terms(information, vector, TermsOfBlock.none(np.zeros(n)))
    both, y = (each.copy() for each in blocks.total)
    if beside is not None:
        both, y = both + beside[0], y + beside[1]
    both[:, :n, :n], y[:, :n] = information, vector
    return both, y


# Prior σ of the coefficients of the heading, of heading_deviation_std: one cycle, two cycles, and a drift from first to
# last.
_SHARE = np.array([1.0, 1.0, 0.7, 0.7, 1.0])
N_HEADING = len(_SHARE)
# Of a constant error, rad, which no other coefficient says anything of: a magnetic declination that nobody has set.
_CONSTANT_STD = 0.05
# Those of the bias come first, then the constant.
N_BEFORE = N_BIAS + 1
N_COEFFICIENTS = N_BEFORE + N_HEADING
# A compass deviates with the heading, a gyro drifts: what one of them shows says nothing of the other.
_DRIFT = np.arange(N_COEFFICIENTS) == N_COEFFICIENTS - 1
_BIAS = np.arange(N_COEFFICIENTS) < N_BIAS
_CONSTANT = np.arange(N_COEFFICIENTS) == N_BIAS
_CYCLES = ~_BIAS & ~_CONSTANT & ~_DRIFT
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


class HeadingStates(NamedTuple):
    """What the data say of it, and what that makes of M hypotheses of n states.

    coefficients: x (5,), P (5, 5), of the hypothesis that says how large it is: of sine and cosine of the yaw and of
    twice the yaw, rad, and of time, rad/s; None where no reference is turned by a heading. shift (M, n), more
    (M, n, n): to be added to x and P. of_bias: of M times n states, its covariance to be added to P when σ has grown.
    drifted: rad², to be added to the variance of yaw, as nobody knows when a heading that drifts was right. inflation:
    (n,) by how much σ of that hypothesis has to grow then, as of `TimeBlocks`.
    """

    coefficients: GaussianState | None
    shift: Array
    more: Array
    of_bias: BiasCovariance
    drifted: float
    inflation: Array


class HeadingEvidence(NamedTuple):
    """M hypotheses as they stood once: x (M, n), P (M, n, n) without a deviation, and what blocks of time told of them.

    best: place of the one that says how large it is. information (M, n + 9, n + 9), vector (M, n + 9): of all blocks
    `with_terms`, and of rows of heave. blocks: those of the best one.
    """

    states: GaussianState
    best: int
    information: Array
    vector: Array
    blocks: BlocksOfOne

    @staticmethod
    def of(
        blocks: TimeBlocks,
        states: GaussianState,
        numbers: Index,
        best: int,
        beside: tuple[Array, Array] | None = None,
    ) -> HeadingEvidence:
        """Of hypotheses with these numbers (M,) in the blocks, as of now.

        beside: Λ (M, n + 9, n + 9) and y (M, n + 9), what else was told of states and terms, of no block.
        """
        information, vector = blocks.total
        some = numbers if blocks.count else numbers[:0]
        told, y = information[some], vector[some]
        if beside is not None and blocks.count:
            told, y = told + beside[0], y + beside[1]
        return HeadingEvidence(states, best, told, y, blocks.of(int(numbers[best])))

    @property
    def has_terms(self) -> bool:
        """Whether there are blocks, and these are `with_terms`."""
        return self.vector.shape[1] > self.states.x.shape[1]


def prior_std(heading: float, bias: float) -> Array:
    """Prior σ of the coefficients (9,), by `heading_deviation_std` (rad) and `dvl_bias_std` (m/s)."""
    bias = bias if bias > LEAST else 0.0  # whose square is a number
    return np.concatenate([np.full(N_BIAS, bias), [_CONSTANT_STD if heading else 0.0], heading * _SHARE])


def heading_states(seen: Sequence[HeadingEvidence], std: Array, up: Array) -> list[HeadingStates]:
    """The deviation each time; none where blocks are without terms, which say no more than `inflation`.

    std: (9,) of `prior_std`. up: (n,) states that turn about the vertical, upwards.
    """
    found: dict[int, HeadingStates] = {}
    with_them = [number for number, each in enumerate(seen) if each.has_terms]
    if with_them:
        sound = {}
        for number in with_them:
            with suppress(np.linalg.LinAlgError):  # numbers that ran away
                deviation = _Deviation.of(seen[number], up)
                if _is_definite(deviation.information, std):
                    sound[number] = deviation
        states = _deviating([*sound.values()], std) if sound else []
        found = dict(zip(sound, states, strict=True))
    return [found[number] if number in found else _none(each) for number, each in enumerate(seen)]


def _none(seen: HeadingEvidence) -> HeadingStates:
    """Of blocks without terms; and numbers that ran away say nothing of the heading."""
    m, n = seen.states.x.shape
    factor: Array = np.ones(n)
    if not seen.has_terms and len(seen.blocks.vector):
        best = slice(seen.best, seen.best + 1)
        factor = inflations([seen.blocks], seen.states.x[best], seen.states.p[best])[0]
    return HeadingStates(None, np.zeros((m, n)), np.zeros((m, n, n)), BiasCovariance.none(m, n), 0.0, factor)


class _Deviation(NamedTuple):
    """What M hypotheses know of the coefficients. onto: (9, n + 9), from states and terms to coefficients. turned:
    (M, 9, n), by how much the states turn them. information (M, 9, 9), scores (M, 9): theirs, whatever the states are.
    """

    seen: HeadingEvidence
    onto: Array
    turned: Array
    information: Array
    scores: Array

    @staticmethod
    def of(seen: HeadingEvidence, up: Array) -> _Deviation:
        """By what was seen. up: (n,) as of `heading_states`."""
        x, p = seen.states
        n, told = x.shape[1], seen.information
        onto = np.zeros((N_COEFFICIENTS, n + N_TERMS))
        onto[:, n:] = _onto_coefficients(told[seen.best, n:, n:], seen.blocks.information[:, -1, -2:])
        if told[seen.best, -1, -1] > 0.0:  # a reference in the body turns with no heading
            onto[_CONSTANT, :n] = -up
        beside, both = onto @ told[:, :, :n], onto @ told @ onto.T
        across, of_terms = beside.swapaxes(1, 2), seen.vector @ onto.T
        turned = beside @ p
        return _Deviation(seen, onto, turned, both - turned @ across, of_terms - product(beside, x))


def _deviating(each: Sequence[_Deviation], std: Array) -> list[HeadingStates]:
    """S times the deviation."""
    sizes = np.array([len(one.scores) for one in each])
    owner, ends = np.repeat(np.arange(len(each)), sizes), np.cumsum(sizes)
    best = ends - sizes + [one.seen.best for one in each]
    turned, own, scores = (np.concatenate(parts) for parts in zip(*(one[2:] for one in each), strict=True))
    told, vector = (
        np.concatenate(parts) for parts in zip(*((one.seen.information, one.seen.vector) for one in each), strict=True)
    )
    x, p = (
        np.stack(parts) for parts in zip(*((s.states.x[s.best], s.states.p[s.best]) for s, *_ in each), strict=True)
    )
    onto = np.stack([one.onto for one in each])
    n, of_best = x.shape[1], told[best]
    to_terms = np.zeros((len(each), n + N_TERMS, n + N_COEFFICIENTS))
    to_terms[:, :n, :n] = np.eye(n)
    to_terms[:, :, n:] = onto.swapaxes(1, 2)

    as_claimed: Array = np.ones((len(each), N_COEFFICIENTS))

    def deviating(root: Array, level: Array, at: Index) -> tuple[GaussianState, GaussianState]:
        """Coefficients, and what they add to the states, of some hypotheses.

        Their prior has σ root (S, 9), and what data say of them has a variance so many times what it claims (S, 9).
        """
        std_of, share = root[owner[at]], 1.0 / level[owner[at]]
        worth = np.sqrt(share)
        known = worth[:, :, None] * own[at] * worth[:, None]
        spread = np.eye(N_COEFFICIENTS) + std_of[:, :, None] * known * std_of[:, None]
        p = std_of[:, :, None] * np.linalg.inv(spread) * std_of[:, None]
        x = product(p, share * scores[at])
        across = turned[at].swapaxes(1, 2)
        of_states = GaussianState(-product(across, x), _symmetric(across @ (p @ turned[at])))
        return GaussianState(x, _symmetric(p)), of_states

    def inflation(root: Array) -> tuple[GaussianState, Array]:
        """Of the best ones: coefficients, and by how much σ (S, n + 9) of states and them grow."""
        found, (shift, more) = deviating(root, as_claimed, best)
        # by how much what a block tells of states and terms moves coefficients and states
        moved = found.p @ (onto - np.concatenate([turned[best], np.zeros((*turned[best].shape[:2], N_TERMS))], axis=2))
        of_states = np.concatenate([p, np.zeros((*p.shape[:2], N_TERMS))], axis=2) - turned[best].swapaxes(1, 2) @ moved
        at = product(to_terms, np.concatenate([x + shift, found.x], axis=1))
        variance = np.concatenate([np.diagonal(of, axis1=1, axis2=2) for of in (p + more, found.p)], axis=1)
        gain = np.concatenate([of_states, moved], axis=1)
        return found, inflations([s.blocks for s, *_ in each], at, gain, variance)

    # what is left where it may be of any size is noise, and whatever else: the evidence is worth as much less
    def level_of(which: Mask, std: Array) -> Array:
        widest = np.where(which, _FACTORS[-1], 1.0) * std * as_claimed
        return np.asarray((inflation(widest)[1][:, n:][:, which] ** 2).mean(axis=1))

    without_bias = np.where(_BIAS, 0.0, std)
    level = level_of(_CYCLES | _DRIFT, without_bias)
    # and a constant beside, of any size: a yaw that its own prior does not expect is no deviation for that
    constant = np.broadcast_to(np.eye(n + N_TERMS)[-1:], (len(each), 1, n + N_TERMS))
    free = np.concatenate([onto, constant], axis=1)
    beside = free @ of_best[:, :, :n]
    own_free = free @ of_best @ free.swapaxes(1, 2) - beside @ p @ beside.swapaxes(1, 2)
    scores_free = product(free, vector[best]) - product(beside, x)
    root = without_bias * as_claimed
    for which in (_CYCLES, _DRIFT):
        size = _size(own_free / level[:, None, None], scores_free / level[:, None], root, which)
        root = np.where(which, size[:, None], 1.0) * root
    found, factor = inflation(root)
    every = np.arange(len(owner))
    shift, more = deviating(root, as_claimed, every)[1]
    of_bias = BiasCovariance.none(*shift.shape)
    if std[_BIAS].any():
        # of the heading its size goes by the level, and σ grows with what is left; a bias is known before to what it is
        worth = np.where(_BIAS, level_of(_BIAS, std)[:, None], 1.0)
        of_all = deviating(np.where(_BIAS, std, root), worth, every)[0]
        bias, p_bias = of_all.x[:, :N_BIAS], of_all.p[:, :N_BIAS, :N_BIAS]
        off = turned.swapaxes(1, 2) @ of_all.p[:, :, :N_BIAS] @ np.linalg.inv(p_bias)
        # it is as large as its prior and the data leave it, and is left in the states with all that the data show of it
        of_bias = BiasCovariance(off @ _root(p_bias + bias[:, :, None] * bias[:, None]))
    states = []
    for number, (end, size) in enumerate(zip(ends.tolist(), sizes.tolist(), strict=True)):
        at = slice(end - size, end)
        one, p_one = found.x[number, N_BEFORE:], found.p[number, N_BEFORE:, N_BEFORE:]
        # at any time of the recording, as far as data show
        is_turned = bool(of_best[number, -1, -1] > 0.0)
        drifted = (one[-1] ** 2 + p_one[-1, -1]) / 12.0 if is_turned else 0.0
        in_time = np.append(np.ones(N_HEADING - 1), onto[number, -1, -2])
        of_one = GaussianState(one * in_time, p_one * np.outer(in_time, in_time)).raised(factor[number, n + N_BEFORE :])
        states.append(
            HeadingStates(
                of_one if is_turned else None,
                shift[at],
                more[at],
                of_bias.at(at),
                float(drifted),
                factor[number, :n],
            )
        )
    return states


def _root(p: Array) -> Array:
    """Symmetric root of (M, k, k)."""
    values, vectors = np.linalg.eigh(p)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None] @ vectors.swapaxes(1, 2))


def _symmetric(p: Array) -> Array:
    return 0.5 * (p + p.swapaxes(1, 2))


def _is_definite(information: Array, std: Array) -> bool:
    """Whether information (M, 9, 9) on the coefficients is that, rounding aside."""
    widest = _FACTORS[-1] * std
    try:
        np.linalg.cholesky(np.eye(N_COEFFICIENTS) + widest[:, None] * information * widest)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(information).all())


def _onto_coefficients(square: Array, times: Array) -> Array:
    """(9, 9): from sums over the terms to those over coefficients, whose drift has no mean and ends with 1.

    square: (9, 9) of the terms. times: (B, 2) of blocks, information of yaw times its time (s), and that information.
    """
    onto = np.zeros((N_COEFFICIENTS, N_TERMS))
    onto[_BIAS, :N_BIAS] = np.eye(N_BIAS)
    onto[_CYCLES, N_BIAS:-2] = np.eye(N_HEADING - 1)
    onto[_CONSTANT, -1] = 1.0
    told = times[times[:, 1] > NOTHING * times[:, 1].max()]
    if len(told):
        at = told[:, 0] / told[:, 1]
        span = max(float(at[-1] - at[0]), _SHORTEST_S)
        onto[-1, -2:] = 1.0 / span, -square[-1, -2] / square[-1, -1] / span
    return onto


def _size(information: Array, scores: Array, root: Array, which: Mask) -> Array:
    """How many times larger (S,) the prior σ root (S, 9) of some coefficients is, by the evidence: root mean square.

    information (S, 10, 10), scores (S, 10): of the coefficients and a constant, without their prior. which: (9,).
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


class BiasCovariance(NamedTuple):
    """Of states (..., n).

    columns: (..., n, 3), by how much states are off where the DVL is off by one σ along each of its axes: of its prior
    (`dvl_bias_std`) at one speed, of what is left of it where speeds show it.
    """

    columns: Array

    @property
    def covariance(self) -> Array:
        """(..., n, n), the part of P that would not be, were there no bias."""
        return np.asarray(self.columns @ self.columns.swapaxes(-1, -2))

    @staticmethod
    def none(*shape: int) -> BiasCovariance:
        """Of states (..., n) = shape that no bias reaches."""
        return BiasCovariance(np.zeros((*shape, 3)))

    def at(self, index: int | slice) -> BiasCovariance:
        """Of some of several."""
        return BiasCovariance(self.columns[index])

    def where(self, known: Mask) -> BiasCovariance:
        """Of those states (n,) alone that are known from data."""
        return BiasCovariance(np.where(known[:, None], self.columns, 0.0))

    def added_to(self, state: GaussianState) -> GaussianState:
        """The state x (n,), P (n, n) of a DVL that may be off so far."""
        return GaussianState(state.x, state.p + self.covariance) if self.columns.any() else state
