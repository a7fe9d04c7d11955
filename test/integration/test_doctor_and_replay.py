"""On all cases of the shared folder `doctor` never says yes where `replay` rejects, nor no where `replay` is usable."""

from __future__ import annotations

import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import dvl_calib_ros as dc
from dvl_calib_ros.errors import InputError
from validation.stacks import shared_folder

CASES = shared_folder() / "cases"
SCRIPTS = [*CASES.glob("stacks.py"), *sorted(CASES.glob("axes/*.py")), *sorted(CASES.glob("public/*.py"))]
TRAPS = sorted(each for each in CASES.glob("traps/*.py") if each.stem not in ("helpers", "judge", "phys"))
# All 434 traps take half an hour: of each file the first is asked for, and of 16 stacks every fifth.
TRAPS_ASKED = (1,)
EVERY = {"stacks": 5}
BAGS = ".mcap", ".db3", ".bag"
REFUSED = "refused"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SCRIPTS, reason=f"no cases in {CASES}; name their folder's parent in DVL_CALIB_SHARED"),
]


def contradiction(name: str, bag: Path, **parameters: Any) -> list[str]:
    """Return what doctor and replay say of a bag if they contradict each other."""
    says = answer(lambda: dc.doctor(bag, **parameters).verdict)
    does = answer(lambda: dc.replay(bag, history=False, **parameters).verdict)
    is_usable = does in ("accept", "marginal")
    is_wrong = says in ("no", REFUSED) if is_usable else says == "yes"
    return [f"{name}: doctor {says}, replay {does}"] if is_wrong else []


def answer(ask: Callable[[], str]) -> str:
    try:
        return str(ask())
    except InputError:
        return REFUSED


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_on_a_shared_case(script, tmp_path):
    made = tmp_path / script.stem
    subprocess.run([sys.executable, script, made], check=True, capture_output=True)
    bags = sorted({each.parent for each in made.rglob("*") if each.suffix in BAGS})
    if not bags:
        (log,) = made.iterdir()
        bags = [*dc.import_files(log, output=tmp_path / "imported")]
    assert [said for bag in bags[:: EVERY.get(script.stem, 1)] for said in contradiction(bag.name, bag)] == []


class EnoughError(Exception):
    """All traps that are asked for were judged: the others of a file are not built."""


@pytest.mark.parametrize("script", TRAPS, ids=lambda script: script.stem)
def test_on_traps(script, tmp_path, monkeypatch):
    """The traps of a file are judged as it is run, by a function of the module `judge`."""
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script)])
    import judge

    wrong: list[str] = []
    number = 0

    def write(path: object, streams: Any, **more: Any) -> Callable[[], Path]:
        return lambda: written(tmp_path / "bag", streams, **more)

    def ask(
        name: str, streams: Any, bags: Callable[[], Path] | None = None, quiet: bool = False, **parameters: Any
    ) -> None:
        nonlocal number
        number += 1
        if number in TRAPS_ASKED:
            bag = (bags or write(name, streams))()
            wrong.extend(contradiction(name, bag, **parameters))
            shutil.rmtree(bag)
        if number == TRAPS_ASKED[-1]:
            raise EnoughError

    written = judge.write
    monkeypatch.setattr(judge, "write", write)
    monkeypatch.setattr(judge, "judge", ask)
    with pytest.raises(EnoughError):
        runpy.run_path(str(script))
    assert wrong == []
