"""The blind trials of the diagnosis: minutes to hours, so a part of each that is bounded in cases."""

from __future__ import annotations

import re
from pathlib import Path

from .registry import LONG, Found, measurement, snapir_ins, validation

# rows without a goal; how well the reported error after compensation holds is kept all the same
_WITHOUT_GOAL = re.compile(r"\n\| (?!error after said)[^|\n]*\|  \|[^\n]*")
CASES, PAIRS, SECOND, SEED = 120, 30, 48, 20261122


@measurement(cost=LONG, command=f"python -m validation trial --cases {CASES} --seed {SEED} --page FILE", tolerances={})
def trial(folder: Path) -> Found:
    """The first tables of the page that the trial writes: by family, by strength."""
    snapir_ins()  # real motion is a half of it
    page = folder / "page.md"
    validation("trial", "--cases", CASES, "--seed", SEED, "--out", folder / "trial", "--page", page)
    parts = re.split(r"^\*\*(.*?)\*\*$", page.read_text(), flags=re.MULTILINE)
    tables = dict(zip(parts[1::2], parts[2::2], strict=True))
    kept = [f"**{title}**\n\n{text.strip()}" for title, text in tables.items() if title.startswith("Blind trial")]
    return {"tables": _shortened("\n\n".join(kept))}


def _shortened(tables: str) -> str:
    """Leave out figures without a goal, and by family what all families together have."""
    together, split, by_family = re.sub(_WITHOUT_GOAL, "", tables).partition("\n\n**Blind trial: simulated**")
    return together + split + re.sub(r"\n\| unknown called unknown[^\n]*", "", by_family)


@measurement(cost=LONG, command=f"python -m validation trial --pairs {PAIRS} --seed {SEED}", tolerances={})
def pairs(folder: Path) -> Found:
    """How often the comparison with a simulator is right: the table that the trial of pairs writes."""
    validation("trial", "--pairs", PAIRS, "--seed", SEED, "--out", folder / "pairs")
    lines = (folder / "pairs" / "pairs.txt").read_text().splitlines()
    return {"table": "\n".join(line for line in lines if line.endswith(" right") or "wanted" in line)}


@measurement(cost=LONG, command=f"python -m validation second_trial --count {SECOND} --seed {SEED}", tolerances={})
def second_trial(folder: Path) -> Found:
    """The shares that the trial with the second generator prints."""
    printed = validation("second_trial", "--count", SECOND, "--seed", SEED).splitlines()
    return {"table": "\n".join(line for line in printed if "bounds" in line)}
