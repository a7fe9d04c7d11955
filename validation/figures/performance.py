"""Speed and memory: what `python -m benchmarks` measured, by it or by a run of before that it wrote to a file."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from dvl_calib_ros.errors import InputError

from .registry import CHEAP, ROOT, Found, measurement

# What is run where there is no file; the node, its latency and the soak take minutes and a quiet machine
QUICK = ("batch", "replay", "commands", "--quick")
COLUMNS = ("what", "ours", "peer", "ratio", "target")
_taken: list[Path] = []


def take(paths: Sequence[Path]) -> None:
    """Use files of `python -m benchmarks --json`, of different parts, instead of running it."""
    _taken[:] = paths


@measurement(
    cost=CHEAP,
    command="python -m benchmarks --json FILE",
    # as `python -m benchmarks --against`; of each only the ratio to its peer is compared
    tolerances={"ratio.*": "100%"},
    partial=True,
)
def benchmarks(folder: Path) -> Found:
    """The table of benchmarks, and each ratio by its part and its line."""
    paths = _taken or [folder / "benchmarks.json"]
    if not _taken:
        command = [sys.executable, "-m", "benchmarks", *QUICK, "--json", str(paths[0])]
        subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    rows, made, found = list[str](), list[str](), dict[str, float | str]()
    for path in paths:
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            for part, measured in document["parts"].items():
                for each in measured["measurements"]:
                    rows.append("| " + " | ".join(each[column] for column in COLUMNS) + " |")
                    found[f"ratio.{part}.{each['what']}"] = float(each["ratio_value"])
            before, after = document["load"]
            load = f"load {before:.1f} before and {after:.1f} after"
            made.append(f"{', '.join(document['parts'])} at commit {document['commit']}, {load}")
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise InputError(
                f"{path}: is not of `python -m benchmarks --json` ({error!r}); make it with that"
            ) from error
    return {**found, "rows": "\n".join(rows), "at": "; ".join(made)}
