"""Coverage-guided fuzzing with atheris (Python 3.11, `pip install atheris`); see README.md beside this file.

python test/fuzz/run.py                     every target, an hour in all
python test/fuzz/run.py mcap --minutes 10   one target
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

HERE = Path(__file__).resolve().parent
ROUND_S = 60  # a process of libFuzzer at most: what it keeps of coverage grows without bound
ENDING_S = 90  # more than the time limit of an input: a process may wait for a library's threads after its last line
LAST_LINE = "stat::peak_rss_mb"
LIMITS = (
    "-timeout=60",
    "-report_slow_units=60",  # instrumented, niced and beside other work, a diagnosis takes ten times its own time
    "-rss_limit_mb=1500",
    "-malloc_limit_mb=1000",
    "-print_final_stats=1",
    "-max_len=16384",
    "-close_fd_mask=1",
)


def fuzz(name: str, arguments: list[str]) -> None:
    """Fuzz one target in this process, by libFuzzer's arguments."""
    import atheris

    with atheris.instrument_imports(include=["dvl_calib_ros", "rosbags.typesys"]):
        from targets import TARGETS

    TARGETS[name].run(b"")  # what is made once, such as a node, takes none of the first input's time
    atheris.Setup([sys.argv[0], *arguments], TARGETS[name].run)
    atheris.Fuzz()


def fuzz_apart(name: str, seconds: int, corpus: Path) -> bool:
    """Fuzz one target in a process of its own, from its seeds and what was kept; True if nothing was found."""
    from targets import TARGETS

    folder = corpus / name
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(TARGETS[name].seeds()):
        (folder / f"seed_{number}").write_bytes(seed)
    kept = HERE / "found" / name
    folders = [str(folder), *([str(kept)] if kept.is_dir() else [])]
    command = [sys.executable, __file__, name, "--", *folders, *LIMITS, f"-artifact_prefix={corpus}/{name}-"]
    log = corpus / f"{name}.log"
    end = time.monotonic() + seconds
    inputs, code, found = 0, 0, []
    while not found and code >= 0 and (left := round(end - time.monotonic())) > 0:
        with log.open("w") as errors:
            timed = [*command, f"-max_total_time={min(ROUND_S, left)}"]
            code = _run(timed, errors, min(ROUND_S, left) + ENDING_S)
        text = log.read_text(errors="replace")
        code = 0 if code < 0 and LAST_LINE in text else code
        tried = re.findall(r"^(?:#|stat::number_of_executed_units: )(\d+)", text, re.MULTILINE)
        inputs += max(map(int, tried), default=0)
        found = sorted(corpus.glob(f"{name}-*"))
    outcome = f"FOUND {', '.join(map(str, found))}" if found else "nothing found"
    if code < 0:  # libFuzzer tells of crashes; this is what it could not
        outcome += f", KILLED by signal {-code}"
    print(f"{name}: {inputs} inputs in {seconds} s, {outcome}", flush=True)
    return not found and code >= 0


def _run(command: list[str], errors: IO[str], seconds: float) -> int:
    """Return the exit code of a process that is killed after so many seconds."""
    with subprocess.Popen(command, stderr=errors, env=_environment()) as process:
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()


def _environment() -> dict[str, str]:
    root = str(HERE.parents[1])
    before = os.environ.get("PYTHONPATH", "")
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [root, str(HERE.parent), str(HERE), before]))}


def main() -> int:
    """Run what was asked for."""
    sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent), str(HERE)]
    if "--" in sys.argv:
        at = sys.argv.index("--")
        fuzz(sys.argv[1], sys.argv[at + 1 :])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="default: all")
    parser.add_argument("--minutes", type=float, default=60.0, help="of all targets together, in equal parts")
    parser.add_argument("--corpus", type=Path, default=Path("fuzz_corpus"), help="folder; default: %(default)s")
    arguments = parser.parse_args()
    os.nice(max(0, 15 - os.nice(0)))
    from targets import TARGETS

    names = arguments.targets or sorted(TARGETS)
    seconds = round(60.0 * arguments.minutes / len(names))
    clean = [fuzz_apart(name, seconds, arguments.corpus) for name in names]
    return 0 if all(clean) else 1


if __name__ == "__main__":
    sys.exit(main())
