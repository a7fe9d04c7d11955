"""The table of effects in the documentation."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, groupby

from .base import AnyEffect
from .registry import EFFECTS, NOISE_EFFECTS


def effect_table() -> str:
    """Every effect with its parameters, in Markdown."""
    lines = ["| effect | is | parameters | needs | looks like |", "|---|---|---|---|---|"]
    lines += [_row(effect) for effect in chain(EFFECTS.values(), NOISE_EFFECTS.values())]
    return "\n".join(lines) + "\n"


def _row(effect: AnyEffect) -> str:
    by_unit = [
        f"{_codes(parameter.name for parameter in group)} {unit}"
        for unit, group in groupby(effect.parameters, lambda parameter: parameter.unit)
    ]
    summary = effect.summary.replace("|", "\\|")  # a bar would end the cell
    needs = ", ".join(sorted(need.value for need in effect.needs))
    return f"| `{effect.name}` | {summary} | {', '.join(by_unit)} | {needs} | {_codes(effect.confounded_with)} |"


def _codes(names: Iterable[str]) -> str:
    return " ".join(f"`{name}`" for name in names)
