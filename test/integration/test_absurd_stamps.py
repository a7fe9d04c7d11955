"""Doctor, replay and diagnose on recordings with absurd stamps: as on sound ones, in as little memory."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from io_fixtures import TOPICS, write_bag

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.simulation.scenario import START_NS, Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

S, DAY = 10**9, 86_400 * 10**9
IN_1970 = 5 * S
# All address space that the three commands may take, in one process: they take a quarter of a GiB without any stray
# stamp, most of it libraries, and a single stamp thirty days off took 0.7 GiB more.
MOST_BYTES = 900 << 20
NAMES = "doctor", "replay", "diagnose"
COMMANDS = """
import json, resource, sys
resource.setrlimit(resource.RLIMIT_DATA, (int(sys.argv[2]),) * 2)
from dvl_calib_ros.cli.main import main
for command in ("doctor", "replay", "diagnose"):
    print(f"== {command}", flush=True)
    code = main([command, sys.argv[1], "--json", f"{sys.argv[1]}.{command}.json"])
    sys.stdout.flush()
    assert code == 0 or (command, code) == ("diagnose", 1), (command, code)  # two minutes are too few for it
"""
Change = Callable[[str, int, int, int, int], tuple[int, int]]
"""Topic, log time, stamp, number of the message on its topic and how many there are -> log time and stamp."""


def one(topic: str, place: float, stamp: Callable[[int], int]) -> Change:
    """One stamp of a topic is another. place: of its message, as a share of them all."""
    return lambda of, log, own, i, n: (log, stamp(own) if of == topic and i == round(place * (n - 1)) else own)


def without_clock_battery(_: str, log: int, own: int, i: int, n: int) -> tuple[int, int]:
    back = START_NS - IN_1970 if log < START_NS + 20 * S else 0
    return log - back, own - back


# Of which the first is answered in a process of its own, with little memory
CASES: dict[str, tuple[Change, dict[str, int]]] = {
    "a span of 30 days": (one("gnss/twist", 0.0, lambda own: own - 30 * DAY), {"gnss/twist": 1}),
    "first 20 s in 1970": (without_clock_battery, {"dvl/twist": 100, "gnss/twist": 100, "imu/data": 200}),
    "DVL an hour ahead in the middle": (one("dvl/twist", 0.5, lambda own: own + 3600 * S), {}),
}


@pytest.fixture(scope="module")
def messages(tmp_path_factory) -> list[tuple[str, int, Any]]:
    """Topic, log time and message of a sound recording."""
    errors = DvlErrors((0.02, -0.03, 0.05), (0.004,) * 3, beam_std=0.01)
    samples = simulate(Scenario(seconds=120.0, errors=errors, imu_rate=10.0))
    path = tmp_path_factory.mktemp("far") / "sound"
    write_bag(path, sorted([*samples.imu, *samples.gnss, *samples.dvl], key=lambda sample: sample.stamp_ns))
    with BagReader([path]) as bag:
        return [(topic, log_ns, message) for topic, log_ns, message, _ in bag.messages(TOPICS)]


def changed(path: Path, messages: list[tuple[str, int, Any]], change: Change) -> Path:
    count = {topic: sum(of == topic for of, _, _ in messages) for topic in TOPICS}
    number = dict.fromkeys(TOPICS, 0)
    rows = []
    for topic, log_ns, message in messages:
        stamp = message.header.stamp
        own = stamp.sec, stamp.nanosec
        log_ns, at = change(topic, log_ns, own[0] * S + own[1], number[topic], count[topic])
        number[topic] += 1
        rows.append((log_ns, at, topic, message, own))
    with BagWriter(path) as bag:
        for log_ns, at, topic, message, own in sorted(rows, key=lambda row: row[0]):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(at, S)
            bag.message(topic, TOPICS[topic], log_ns, message)
            message.header.stamp.sec, message.header.stamp.nanosec = own
    return path


def answers_in_little_memory(bag: Path) -> tuple[str, str]:
    """What the commands print on either stream."""
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, str(bag), str(MOST_BYTES)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-1000:]
    return done.stdout, done.stderr


def answers(bag: Path, capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """The same in this process."""
    for command in NAMES:
        code = main([command, str(bag), "--json", f"{bag}.{command}.json"])
        assert code == (command == "diagnose"), command
    return capsys.readouterr()


def verdicts(found: dict[str, Any]) -> tuple[str, str, str]:
    replayed = found["replay"]
    model = replayed["selected"][-1]["model"]
    return found["doctor"]["verdict"], replayed["verification"][model]["verdict"], found["diagnose"]["verdict"]


@pytest.mark.spread(1)
@pytest.mark.parametrize("case", CASES)
def test_the_commands_say_what_they_say_without_it(tmp_path, messages, case, capsys):
    change, aside = CASES[case]
    bag = changed(tmp_path / "bag", messages, change)
    said = answers_in_little_memory(bag) if case == next(iter(CASES)) else answers(bag, capsys)
    printed = ["".join(each.split()) for each in said]
    found = {name: json.loads(Path(f"{bag}.{name}.json").read_text()) for name in NAMES}
    assert verdicts(found) == ("yes", "accept", "insufficient_excitation")  # as of the sound recording
    assert found["replay"]["counts"]["calibration"]["restarts"] == 0
    for topic, count in aside.items():
        words = f"{topic}: {count} of {sum(of == topic for of, *_ in messages)} messages are set aside:"
        assert sum(each.count("".join(words.split())) for each in printed) == 3, "one note of each command"
    if not aside:  # a stamp that is an hour off is in no other segment: it strays
        for command in ("doctor", "replay"):
            assert "STAMP_STRAY" in [each["code"] for each in found[command]["findings"]], command
