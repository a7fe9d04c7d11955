"""What was measured as a file, and against one that was measured before: by ratios, which machines have in common."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from dvl_calib_ros.disk.atomic import save_bytes
from dvl_calib_ros.errors import InputError

from . import Measurement

# A ratio worse than its baseline by more than this has been made worse. Between quiet runs on a machine they move by a
# fifth, between machines by half.
WORSE = 2.0
_PACKAGES = ("dvl_calib_ros", "numpy", "scipy", "rosbags", "mcap", "filterpy")


class Part(NamedTuple):
    """What one part measured. failed: why it did not come to its end, in one line; None if it did."""

    measurements: Sequence[Measurement]
    failed: str | None = None


class Run(NamedTuple):
    """Parts by name, and the load of the machine (over a minute) at the beginning."""

    parts: dict[str, Part]
    load_at_start: float

    def save(self, path: Path) -> None:
        """Write all that is measured so far; the file is the old or the new one, whole. Raises InputError."""
        document = {
            "commit": _commit(),
            "load": [self.load_at_start, os.getloadavg()[0]],
            "versions": _versions(),
            "parts": {
                name: {"measurements": [each._asdict() for each in part.measurements], "failed": part.failed}
                for name, part in self.parts.items()
            },
        }
        text = json.dumps(document, indent=2, default=lambda number: number.item())  # parts compute with numpy
        save_bytes(path, f"{text}\n".encode(), keep=lambda _: ())


class Baseline:
    """Ratios of a file that `Run.save` wrote. commit: what they were measured of."""

    def __init__(self, path: Path) -> None:
        """Raises InputError for a file that is none."""
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            self.commit: str = document["commit"]
            self._ratios: dict[str, dict[str, float]] = {
                name: {each["what"]: float(each["ratio_value"]) for each in part["measurements"]}
                for name, part in document["parts"].items()
            }
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); make one with --json {path}") from error
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: is no baseline ({error!r}); make one with --json {path}") from error

    def worse(self, run: Run) -> Iterator[str]:
        """One line for each ratio that is worse than here by more than WORSE."""
        for name, part in run.parts.items():
            for each in part.measurements:
                before = self._ratios.get(name, {}).get(each.what)
                if before is None:
                    continue
                limit = before / WORSE if each.higher_is_better else before * WORSE
                is_worse = each.ratio_value < limit if each.higher_is_better else each.ratio_value > limit
                if is_worse or each.ratio_value != each.ratio_value:
                    yield f"{name}: {each.what}: baseline {before:.2f}, now {each.ratio_value:.2f}"

    def unknown(self, run: Run) -> Iterator[str]:
        """One line for each that is measured but not here, or that is here but was not measured."""
        for name, part in run.parts.items():
            if name not in self._ratios:
                yield f"{name}: not in the baseline"
                continue
            measured = {each.what for each in part.measurements}
            for what in [] if part.failed else sorted(self._ratios[name].keys() - measured):
                yield f"{name}: {what}: in the baseline, but not measured"
            for what in sorted(measured - self._ratios[name].keys()):
                yield f"{name}: {what}: not in the baseline"


def _commit() -> str:
    """What is measured, with -dirty where files were changed since; '' outside of a repository."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
