"""Terms of blocks of time: what changes with heading, time or velocity as no mounting does, told without a column more.

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
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .numerics.block_covariance import TimeBlocks
from .numerics.frames import Array, cross, product, skew
from .numerics.robust import median
from .numerics.samples import Index, Stamps

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
