"""Speed and memory: what `python -m benchmarks` measured, by it or by a run of before that it wrote to a file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from dvl_calib_ros.errors import InputError

from .registry import CHEAP, ROOT, Found, measurement

# What is run where there is no file; the node, its latency and the soak take minutes and a quiet machine
QUICK = ("batch", "replay", "commands", "--quick")
COLUMNS = ("what", "ours", "peer", "ratio", "target")
_taken: list[Path] = []


def take(path: Path) -> None:
    """Use a file of `python -m benchmarks --json` instead of running it."""
    _taken[:] = [path]


@measurement(
    cost=CHEAP,
    command="python -m benchmarks --json FILE",
    # as `python -m benchmarks --against`; of each only the ratio to its peer is compared
    tolerances={"ratio.*": "50%"},
    partial=True,
)
def benchmarks(folder: Path) -> Found:
    """The table of benchmarks, and each ratio by the part and the place of its line."""
    path = _taken[0] if _taken else folder / "benchmarks.json"
    if not _taken:
        command = [sys.executable, "-m", "benchmarks", *QUICK, "--json", str(path)]
        subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        before, after = document["load"]
        rows, found = [], dict[str, Any]()
        for part, measured in document["parts"].items():
            for each in measured["measurements"]:
                rows.append(
                    f"| {each['what']} | {each['ours']} | {each['peer']} | {each['ratio']} | {each['target']} |"
                )
                found[f"ratio.{part}.{each['what']}"] = float(each["ratio_value"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path}: is not of `python -m benchmarks --json` ({error!r}); make it with that") from error
    found["rows"] = "\n".join(rows)
    found["at"] = f"commit {document['commit']}, load {before:.1f} at the beginning and {after:.1f} at the end"
    return found
