"""Blocks of time of filters that go on sample by sample, and what they say: σ, heading and bias."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from .block_terms import BlockTerms, TermsOfBlock, all_told, with_terms
from .heading_states import HeadingEvidence, HeadingStates, heading_states
from .numerics.block_covariance import TimeBlocks
from .numerics.frames import Array
from .numerics.kalman import GaussianState
from .numerics.samples import Index, Stamps

_NO_CUTS = np.zeros(0, dtype=np.intp)


class BlockScatter:
    """`TimeBlocks` of K filters without process noise, told by their states where one block ends and the next begins.

    What a block told is the difference of the information after and before it. What they say is as of the end of the
    last block, so it depends on stamps alone.
    """

    def __init__(self, x: Array, p: Array, seconds: float, terms: BlockTerms | None, std: Array) -> None:
        """Start from states x (K, n), P (K, n, n).

        seconds: length of a block. terms: None for filters that heading and bias are not looked for by. std: (9,) of
        `heading_states.prior_std`.
        """
        self._blocks = TimeBlocks()
        self._length_ns = round(seconds * 1e9)
        self._terms, self._std = terms, std
        self._up = np.zeros(x.shape[-1]) if terms is None else terms.up
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
