"""Whatever a recording, a file or an instrument calls itself, it steers no terminal and turns no line around."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from command_line import unfit
from conftest import few
from fleet_fixtures import write_dive
from io_fixtures import rewrite, run
from report_fixtures import drawn

import dvl_calib_ros as dc
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.errors import as_cell
from dvl_calib_ros.evaluation import documents
from dvl_calib_ros.files.result_file import result_text
from dvl_calib_ros.fleet_catalogue.recording_entry import Entry
from dvl_calib_ros.fleet_catalogue.update import Catalogue, CataloguePart

# Clears the screen, sets the title, turns what follows around, begins a line that looks like one of ours, ends a style
EVIL = "x\x1b[2J\x1b]0;y\x07\u202ey\x9b2J\r\nnote: forged[/red][bold]<b>"
SEEN = "x\\x1b[2J\\x1b]0;y\\x07\\u202ey\\x9b2J\\r\\nnote: forged[/red][bold]<b>"
FILE = EVIL.replace("/", "")


def said(capsys, *arguments, codes=(0, 1, 2, 3, 4)) -> str:
    """What a command says, which must be fit for a terminal."""
    try:
        code = main([str(each) for each in arguments])
    except SystemExit as stop:
        code = stop.code
    output = capsys.readouterr()
    text = output.out + output.err
    assert code in codes, text
    assert not unfit(text)
    assert "\nnote: forged" not in text
    return text


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """A recording whose DVL and IMU are in frames of this name, in a folder of it."""

    def change(topic, message):
        message.header.frame_id = EVIL if topic != "gnss/twist" else "map"
        return message

    return rewrite(tmp_path_factory.mktemp("outside") / FILE, change, run(40.0))


@pytest.fixture(scope="module")
def result(bag, tmp_path_factory) -> Path:
    """With the selected model alone: to read the others is most of the time of a command."""
    path = tmp_path_factory.mktemp("result") / f"{FILE}.yaml"
    assert main(["replay", str(bag), "-p", "gnss_frame:=enu", "-p", "dvl_position:=told", "--save", str(path)]) == 0
    content = load_yaml(path, "result file")
    content["models"] = {content["model"]: content["models"][content["model"]]}
    path.write_text(result_text(content))
    return path


def with_each_text(value) -> Iterator[object]:
    """Documents that differ from this in one text each."""
    if isinstance(value, str):
        yield f"{value}{EVIL}"
    elif isinstance(value, dict):
        for name, each in value.items():
            yield from ({**value, name: other} for other in with_each_text(each))
    elif isinstance(value, list):
        for at, each in enumerate(value):
            yield from ([*value[:at], other, *value[at + 1 :]] for other in with_each_text(each))


@pytest.mark.slow
def test_names_of_a_recording(bag, result, tmp_path, capsys, monkeypatch):
    drawn(monkeypatch)
    monkeypatch.chdir(tmp_path)
    page = tmp_path / f"{FILE}.html"
    assert SEEN in said(capsys, "doctor", bag, "--report", page, "--json", "doctor.json", codes=(0, 1))
    pages = [page.read_text()]
    enu = ("-p", "gnss_frame:=enu")
    said(capsys, "replay", bag, *enu, "--report", page, "--save", f"{FILE}.yaml", "--models", "all", codes=(0,))
    pages.append(page.read_text())
    assert SEEN.replace("/", "") in said(capsys, "salvage", bag, "-o", FILE, codes=(0,))
    said(capsys, "compare", bag, result, *enu, "--report", page)
    pages.append(page.read_text())
    said(capsys, "fleet", bag.parent, "--out", FILE + "out", "--jobs", "1", *enu, codes=(0,))
    pages.append((tmp_path / f"{FILE}out" / "index.html").read_text())
    for text in pages:
        assert not unfit(text)
    assert not unfit(repr(dc.replay(bag, gnss_frame="enu", history=False)) + repr(dc.doctor(bag)))


def test_names_of_topics_and_of_what_is_not_there(bag, tmp_path, capsys):
    topic = said(capsys, "replay", bag, "--dvl-topic", EVIL, codes=(2,))
    assert "\\x1b[2J" in topic
    commands = "replay doctor salvage diagnose evaluate play import apply compare fleet"
    for command in commands.split():
        said(capsys, command, tmp_path / FILE, "--" + EVIL, codes=(2,))
        said(capsys, command, tmp_path / FILE, codes=(2,))
    for option in (f"{EVIL}:=1", f"model:={EVIL}", f"min_speed:={EVIL}", f"initial_calibration:={EVIL}"):
        assert "\\x1b[2J" in said(capsys, "replay", bag, "-p", option, codes=(2,))


@pytest.mark.parametrize("command", few(["apply", "compare", "export"], ("compare", "export")))
def test_texts_of_a_result_file(result, command, tmp_path, capsys):
    content = load_yaml(result, "result file")
    path = tmp_path / f"{FILE}.yaml"
    more = {"apply": (), "compare": (result,), "export": ("-o", tmp_path / f"{FILE}.sdf")}[command]
    texts = [*with_each_text({name: each for name, each in content.items() if name != "models"})]
    assert len(texts) > 30
    for changed in texts[:: 1 if command == "apply" else 12]:  # one function prints for all commands
        path.write_text(result_text({**changed, "models": content["models"]}))
        said(capsys, command, *(["gazebo"] if command == "export" else []), path, *more)


def test_texts_that_apply_shows(result, tmp_path, capsys):
    text = said(capsys, "apply", result, "--force")
    assert SEEN in text
    for name in ("waterlinked", "cerulean", "ardupilot"):
        said(capsys, "apply", result, "--force", "--instrument", name, "--settings", tmp_path / FILE)
    outputs = [("--launch", "l"), ("--fusion", "f"), ("--params", "p")]
    for option, name in outputs:
        path = tmp_path / f"{FILE}{name}"
        for more in (("--dry-run",), ()):
            said(capsys, "apply", result, "--force", option, path, *more, codes=(0,))
        said(capsys, "apply", "--rollback", option, path)
        written = path.read_text()
        assert not unfit(written)
    said(capsys, "apply", result, "--instrument", EVIL, codes=(2,))
    said(capsys, "apply", result, "--instrument", "waterlinked", "--now", f"{EVIL}=1", codes=(2,))
    said(capsys, "apply", result, "--instrument", "waterlinked", "--now", f"speed_of_sound={EVIL}", codes=(2,))


URDF = """<robot name="r"><link name="base_link"/><link name="dvl_link"/><joint name="j" type="fixed">
<parent link="base_link"/><child link="dvl_link"/><origin xyz="0 0 0" rpy="0 0 0"/></joint></robot>"""


@pytest.mark.parametrize("at", range(len(re.findall(r'"[^"]*"', URDF))))
def test_texts_of_a_urdf(result, at, tmp_path, capsys):
    """XML holds no ESC; what turns a line around it may hold, and ends of lines and C1 by number."""
    evil = "&#10;note: forged\u202e&#x9b;[/red]"
    names = [*re.finditer(r'"[^"]*"', URDF)]
    path = tmp_path / f"{FILE}.urdf"
    path.write_text(URDF[: names[at].start() + 1] + evil + URDF[names[at].start() + 1 :])
    said(capsys, "parameters", "--urdf", path)
    said(capsys, "parameters", "--urdf", path, "--joint", EVIL, "--base-frame", EVIL)
    said(capsys, "apply", result, "--urdf", path, "--force", "--dry-run")
    said(capsys, "apply", result, "--urdf", path, "--joint", "\nnote: forged\u202e\x9b[/red]j", "--force", "--dry-run")


def test_texts_of_a_parameter_file(bag, tmp_path, capsys):
    path = tmp_path / f"{FILE}.yaml"
    for values in ({EVIL: 1}, {"model": EVIL}, {"base_frame": EVIL}, {"dvl_frame": EVIL}, {"min_speed": EVIL}):
        path.write_text(yaml.dump({"/**": {"ros__parameters": values}}))
        said(capsys, "replay", bag, "--params", path)


DIAGNOSIS = {
    "verdict": "known",
    "effects": [{"name": "lever_arm", "equivalent_to": ["sideslip"], "parameters": {"x_m": {"value": -1.35}}}],
    "noise": [{"name": "outliers", "parameters": {"share": {"value": 0.01}}}],
    "calibration": {name: {axis: {"value": 0.01} for axis in "xyz"} for name in ("phi_rad", "delta_k")},
    "dvl": {
        "mounting_rpy": [0.0, 0.0, 0.7], "lever_arm_m": [-0.5, 0.0, 0.1], "time_offset_s": 0.1, "clock_drift": 0.0,
        "rate_hz": 5.0, "noise_std_mps": [0.01, 0.01, 0.003], "speed_mps": [1.4, 0.1, 0.1],
        "sizes_mps": {"misalignment": 0.05, "scale": 0.007, "lever_arm": 0.1, "dvl_time_offset": 0.08},
    },
}  # fmt: skip


def test_texts_of_a_diagnosis(tmp_path, capsys):
    path = tmp_path / f"{FILE}.json"
    path.write_text(json.dumps(DIAGNOSIS))
    said(capsys, "export", "gazebo", path, "-o", tmp_path / f"{FILE}.sdf", codes=(0,))
    for changed in with_each_text(DIAGNOSIS):
        path.write_text(json.dumps(changed))
        said(capsys, "export", "gazebo", path, "-o", tmp_path / f"{FILE}.sdf")


@pytest.mark.slow
def test_texts_of_a_diagnosed_recording(tmp_path, capsys):
    """The shortest that is diagnosed, from a file of this name."""
    bag = write_dive(tmp_path / FILE, 0)
    assert SEEN.replace("/", "") in said(capsys, "diagnose", bag, "--json", tmp_path / f"{FILE}.json", codes=(0, 1))


# ------------------------------------------------------------------ cells of spreadsheets


SPREADSHEET = {
    **{each: f"'{each}" for each in ("=", "+", "-", "@", " -", "\uff1d")},
    **{"\t=": "\\t=", "a\r=": "a\\r=", "\n@": "\\n@", "\u00a0=": "\\xa0=", "\ufeff=": "\\ufeff="},
}


@pytest.mark.parametrize("first", SPREADSHEET)
def test_a_text_that_a_spreadsheet_would_run_is_quoted_and_a_number_is_not(first, tmp_path, monkeypatch):
    formula, cell = (f"{each}cmd|'/c calc'!A1" for each in (first, SPREADSHEET[first]))
    assert as_cell(formula) == cell and as_cell(-1.5) == -1.5 and as_cell("-") == "'-" and as_cell("a=1") == "a=1"
    monkeypatch.setattr(documents, "_csv_rows", lambda _: [(formula, "T01", -1.5)])
    (_, row) = csv.reader(io.StringIO(documents.evaluation_csv(None)))
    assert row == [cell, "T01", "-1.5"]
    parquet = pytest.importorskip("pyarrow.parquet")
    catalogue = Catalogue(tmp_path / "out")
    entry = Entry([{"recording": "/dives/one", "parameter": "yaw", "value": -1.5, "error": formula}])
    catalogue.write(CataloguePart("/dives/one", formula, "", None), entry)
    (path,) = catalogue.rows.iterdir()
    (row,) = parquet.read_table(path).to_pylist()
    assert (row["vehicle"], row["error"], row["value"]) == (cell, cell, -1.5)
    (part,) = catalogue.parts()
    assert part.vehicle == formula
    catalogue.rename(part, "-auv")
    (row,) = parquet.read_table(path).to_pylist()
    assert row["vehicle"] == "'-auv" and row["error"] == cell
