"""Each command reads the bytes of each recording once."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from command_line import fail, succeed
from io_fixtures import run, storage_file, write_bag
from report_fixtures import drawn

from dvl_calib_ros.bags import sources
from dvl_calib_ros.bags.sources import Source
from dvl_calib_ros.calibration.registration import registration


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("opened")
    later = [each._replace(stamp_ns=each.stamp_ns + 10**12) for each in run(60.0)]
    found = {"BAG": write_bag(folder / "one", run(60.0)), "OTHER": write_bag(folder / "other", later, "sqlite3")}
    cut = folder / "cut.mcap"
    content = storage_file(found["BAG"]).read_bytes()
    cut.write_bytes(content[: -len(content) // 10] + bytes(100))
    return found | {"CUT": cut}


@pytest.fixture
def passes(monkeypatch) -> Counter[str]:
    """How often each file was opened, and read from beginning to end."""
    counted: Counter[str] = Counter()
    opened = sources.open_source

    def counting(path, *arguments, **options):
        source = opened(path, *arguments, **options)
        counted[f"opened {source.path.name}"] += 1
        read = source.batches

        def batches(topics):
            counted[f"read {source.path.name}"] += 1
            return read(topics)

        return Source(source.path, source.counts, source.span_ns, batches, source.damage_noted)

    monkeypatch.setattr("dvl_calib_ros.bags.reader.open_source", counting)
    return counted


@pytest.fixture
def registered(monkeypatch) -> Counter[str]:
    """How often discovery and calibration registered a recording."""
    counted: Counter[str] = Counter()

    def counting(name):
        def register(*arguments):
            counted[name] += 1
            return registration.register(*arguments)

        return register

    for name in (
        "discovery.discovery",
        "calibration.estimators.registration_schedule",
        "diagnosis.search.initial_guess",
    ):
        monkeypatch.setattr(f"dvl_calib_ros.{name}.register", counting(name))
    return counted


# Of a command, how often discovery and calibration register, beside what a calibration does by its own samples
REGISTERED = {
    "doctor BAG OTHER": (2, 4), "replay BAG OTHER": (2, 4), "compare BAG OTHER": (2, 2), "diagnose BAG OTHER": (2, 4),
}  # fmt: skip


@pytest.mark.spread(2)
@pytest.mark.parametrize(
    "words",
    [
        "doctor CUT", "doctor BAG OTHER", "replay BAG OTHER", "replay CUT",
        "replay BAG -p prior_source:=reference", "replay BAG --report REPORT", "diagnose BAG OTHER",
        "diagnose BAG --simulator OTHER", "compare BAG OTHER", "evaluate BAG OTHER --models M3 --jobs 1",
        "simulate NEW --duration 20 --motion-of BAG",
    ],
)  # fmt: skip
def test_a_command_opens_reads_and_registers_each_recording_once(
    words, bags, passes, registered, tmp_path, capsys, monkeypatch
):
    drawn(monkeypatch)  # they are looked at elsewhere
    named = bags | {"REPORT": tmp_path / "report.html", "NEW": tmp_path / "new"}
    command, *arguments = words.split()
    succeed(capsys, command, *(named.get(word, word) for word in arguments))
    files = {name: bags[name] if bags[name].is_file() else storage_file(bags[name]) for name in bags}
    expected = {
        f"{what} {files[name].name}": 1 for name in files if name in words.split() for what in ("opened", "read")
    }
    assert passes == expected
    if words in REGISTERED:
        discovery, calibration = REGISTERED[words]
        assert +registered == Counter(
            {"discovery.discovery": discovery, "calibration.estimators.registration_schedule": calibration}
        )


@pytest.mark.slow
def test_a_replay_from_an_initial_calibration_reads_once_though_it_runs_twice(bags, passes, tmp_path, capsys):
    saved = tmp_path / "saved.yaml"
    succeed(capsys, "replay", bags["BAG"], "--save", saved)
    passes.clear()
    succeed(capsys, "replay", bags["OTHER"], "-p", f"initial_calibration:={saved}")
    assert set(passes.values()) == {1}


def test_what_is_wrong_with_the_last_is_said_before_the_first_is_read(bags, passes, tmp_path, capsys):
    assert "no such file" in fail(capsys, "replay", bags["BAG"], tmp_path / "none")
    assert not any(what.startswith("read") for what in passes)
