"""Peer (b): every set of at most two effects by nonlinear least squares, chosen by Bayes's information criterion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dvl_calib_ros.calibration.models.parameters import Parameters

from .answers import Document, Found, answer, chance_of_left, is_seeing, named, parameters_from, searched, times_of
from .search import Fitted, sizes_of

# Tuned on seed 9000 (README.md): how much better the criterion has to be for a further effect, how near another
# set may come and still be another answer, and what chance of being left by noise is none
CLAIM = 12.0
NEAR = 6.0
LEFT = 1e-6


def diagnose(paths: Sequence[Path], parameters: Parameters) -> Document:
    """The answer to bags of one vehicle. Raises InputError."""
    known = searched(tuple(paths), parameters)
    alone = known.alone
    best = min(known.sets, key=lambda each: each.bic + CLAIM * len(each.members))
    left = chance_of_left(known.search, best) < LEFT
    if best is alone:
        if left:
            return answer("unknown")
        return answer("no_gap" if is_seeing(known.search, alone) else "insufficient_excitation")
    sizes = sizes_of(best)
    seconds = known.search.model.seconds
    found = [
        Found(name, parameters_from(sizes, name) | times_of(best, name, seconds), rivals(best, known.sets, name))
        for name in by_strength(best)
    ]
    return named(found, left)


def rivals(best: Fitted, sets: Sequence[Fitted], name: str) -> list[str]:
    """What could stand in the place of an effect."""
    rest = {*best.effects} - {name}
    near = [each for each in sets if each.members and each is not best and each.bic < best.bic + NEAR]
    found: list[str] = []
    for each in near:
        others = {*each.effects} - rest
        if rest <= {*each.effects} and len(others) == 1 and others != {name}:
            found += others
    return found


def by_strength(fitted: Fitted) -> list[str]:
    """Names of a set, by the largest parameter over its standard deviation."""
    sizes = sizes_of(fitted)

    def strength(name: str) -> float:
        return max(abs(value) / max(std or 0.0, 1e-12) for value, std in parameters_from(sizes, name).values() if std)

    return sorted(fitted.effects, key=strength, reverse=True)
