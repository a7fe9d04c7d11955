"""Make the generated tables of README.md and docs/ and config/calibration.yaml anew: python .ci/tables.py."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OTHERS = ("models", "effects", "drivers", "findings", "doctor", "commands")
OPTIONS = {"parameters": (), **{name: (f"--{name}",) for name in OTHERS}}


def printed(*options: str) -> str:
    """What `dvl-calib parameters` prints."""
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", "parameters", *options]
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout


for name, options in OPTIONS.items():
    table = printed(*options)
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        old = page.read_text()
        marks = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        new = marks.sub(lambda found, table=table: found[1] + table + found[2], old)
        if new != old:
            page.write_text(new)
            print(f"{page.name}: {name}")
(ROOT / "config" / "calibration.yaml").write_text(printed("--yaml"))
