"""Coverage-guided fuzzing with atheris (Python 3.11, `pip install atheris`); see README.md beside this file.

python test/fuzz/run.py                       every target, 10^6 inputs in all
python test/fuzz/run.py mcap --inputs 50000   one target
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
# of all inputs; the slow readers get less
SHARES = {
    "message": 0.27, "mcap_records": 0.25, "override": 0.1, "urdf": 0.1, "sqlite_pages": 0.06, "trajectory": 0.05,
    "parameters": 0.03, "result_file": 0.03, "mcap": 0.03, "flips": 0.03, "definition": 0.02, "metadata": 0.02,
    "sqlite": 0.01, "names": 0.02, "settings": 0.01, "columns": 0.005, "log_times": 0.005, "live": 0.005, "part": 0.01,
    "stamps": 0.002, "log": 0.03,
}  # fmt: skip
LIMITS = (
    "-timeout=20",
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


def fuzz_apart(name: str, inputs: int, corpus: Path) -> bool:
    """Fuzz one target in a process of its own, from its seeds and what was kept; True if nothing was found."""
    from targets import TARGETS

    folder = corpus / name
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(TARGETS[name].seeds()):
        (folder / f"seed_{number}").write_bytes(seed)
    kept = HERE / "found" / name
    folders = [str(folder), *([str(kept)] if kept.is_dir() else [])]
    command = [sys.executable, __file__, name, "--", *folders, f"-runs={inputs}", *LIMITS]
    command += [f"-artifact_prefix={corpus}/{name}-"]
    log = corpus / f"{name}.log"
    with log.open("w") as errors:
        code = subprocess.run(command, stderr=errors, env=_environment(), check=False).returncode
    text = log.read_text(errors="replace")
    tried = re.findall(r"^(?:#|stat::number_of_executed_units: )(\d+)", text, re.MULTILINE)
    rate = re.findall(r"^stat::average_exec_per_sec:\s+(\d+)", text, re.MULTILINE)
    found = sorted(corpus.glob(f"{name}-*"))
    outcome = f"FOUND {', '.join(map(str, found))}" if found else "nothing found"
    if code < 0:  # libFuzzer tells of crashes; this is what it could not
        outcome += f", KILLED by signal {-code}"
    print(f"{name}: {max(map(int, tried), default=0)} inputs, {' '.join(rate) or '?'} per s, {outcome}", flush=True)
    return not found and code >= 0


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
    parser.add_argument("--inputs", type=int, default=1_000_000, help="of all targets together")
    parser.add_argument("--corpus", type=Path, default=Path("fuzz_corpus"), help="folder; default: %(default)s")
    arguments = parser.parse_args()
    os.nice(max(0, 15 - os.nice(0)))
    from targets import TARGETS

    names = arguments.targets or [name for name in SHARES if name in TARGETS]  # without ROS 2 no live node
    total = sum(SHARES[name] for name in names)
    clean = [fuzz_apart(name, round(arguments.inputs * SHARES[name] / total), arguments.corpus) for name in names]
    return 0 if all(clean) else 1


if __name__ == "__main__":
    sys.exit(main())
