"""The command ``dvl-calib``: exit codes, one-line errors, files and JSON for machines."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from conftest import ROOT
from io_fixtures import estimates, raw, run, write_bag
from yaml_text import parsed

from dvl_calib_ros import __version__
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.models import BY_VELOCITY, MODELS
from dvl_calib_ros.cli.commands import COMMANDS
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.messages.drivers import TWIST_TYPE


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("cli") / "bag", run())


def shell(*arguments, **environment) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, env={**os.environ, **environment})


# ------------------------------------------------------------------ usage


@pytest.mark.parametrize(
    ("missing", "arguments"),
    [
        ("rosbags", ["replay", "bags/harbour_box"]),
        ("mcap", ["simulate", "new_bag"]),
        ("scipy", ["diagnose", "bags/harbour_box"]),
    ],
)
def test_a_python_package_that_is_not_there_is_named_in_one_line(missing, arguments):
    """As on a ROS machine, where colcon installs the package without others."""
    start = "from dvl_calib_ros.cli.main import main; sys.exit(main(sys.argv[1:]))"
    script = f"import sys; sys.modules[{missing!r}] = None; {start}"
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, cwd=ROOT)
    said = (
        f"dvl-calib {arguments[0]}: needs the Python package {missing}, which is not installed; pip install {missing}\n"
    )
    assert (done.returncode, done.stderr) == (2, said)
    assert not (ROOT / "new_bag").exists()


@pytest.mark.parametrize("command", [None, *(command.name for command in COMMANDS)])
def test_every_command_has_help_with_an_example(capsys, command):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"] if command else ["--help"])
    assert stop.value.code == 0
    assert f"example: dvl-calib {command or ''}".strip() in capsys.readouterr().out


# The package and its entry, in which nothing can look after an interrupt yet, and what the entry imports
ENTRY = ("", ".version", ".cli", ".cli.main")
PARTS = (*ENTRY, ".standard_streams", ".cli.command_line", ".cli.commands")


@pytest.mark.parametrize("at", ["argparse", *(f"dvl_calib_ros{part}" for part in PARTS if part not in ENTRY)])
def test_an_interrupt_while_the_first_modules_are_imported_is_one_line(at):
    interrupting = f"""import sys
class Finder:
    def find_spec(self, name, *_):
        if name == {at!r}:
            sys.meta_path.remove(self)
            raise KeyboardInterrupt
sys.meta_path.insert(0, Finder())
from dvl_calib_ros.cli.main import main
sys.exit(main(["replay", "bag"]))"""
    done = subprocess.run([sys.executable, "-c", interrupting], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "dvl-calib replay: interrupted\n")


@pytest.mark.parametrize("words", [("replay", ""), ("doctor", "bag", "--json", ""), ("apply", "")])
def test_an_empty_argument_is_not_taken_for_the_folder_that_this_runs_in(capsys, monkeypatch, words):
    monkeypatch.chdir(ROOT / "bags" / "straight_leg")  # a bag
    assert "the name of a file or folder is empty" in fail(capsys, *words)


def test_the_help_comes_at_once_since_it_imports_next_to_nothing():
    """Of ours the entry and the table of commands, and of others the standard library: what else there is, a bare
    interpreter has as well (an editable install brings some).
    """
    shown = "print(*sorted(sys.modules))"
    helping = "from dvl_calib_ros.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass"
    bare, helped = (
        set(done.stdout.splitlines()[-1].split())
        for script in (shown, f"{helping}\n{shown}")
        if (done := subprocess.run([sys.executable, "-c", f"import sys\n{script}"], capture_output=True, text=True))
    )
    imported = {name for name in helped - bare if name.partition(".")[0] not in sys.stdlib_module_names}
    assert imported == {f"dvl_calib_ros{part}" for part in PARTS}
    slow = {"subprocess", "tempfile", "json", "asyncio", "inspect", "dataclasses", "importlib.metadata"}
    assert not slow & (helped - bare)


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"dvl-calib {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "required: command"),
        (["replya"], "invalid choice: 'replya'"),
        (["replay"], "dvl-calib replay: the following arguments are required: BAG"),
        (
            ["replay", "x", "--model", "M3", "--unknown"],
            "unrecognized arguments: --unknown; see dvl-calib replay --help",
        ),
        (["simulate", "x", "--seed", "one"], "--seed: invalid int value: 'one'"),
        (["simulate", "x", "--trajectory", "maze"], "--trajectory: invalid choice: 'maze'"),
        (["import", "x.csv"], "required: -o/--output"),
    ],
)
def test_bad_usage_is_one_line_that_points_to_the_help(capsys, arguments, expected):
    error = fail(capsys, *arguments)
    assert expected in error and "--help" in error


def completed(tmp_path, typed: str) -> list[str]:
    """What the shell is offered for a line that is being typed."""
    answer = tmp_path / "answer"
    asked = {
        "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_SHELL": "bash", "COMP_LINE": typed,
        "COMP_POINT": str(len(typed)), "_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "COMP_TYPE": "9",
    }  # fmt: skip
    assert shell(**asked).returncode == 0
    return [word.strip() for word in answer.read_text().split("\n")]


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("dvl-calib re", ["replay"]),
        ("dvl-calib replay --dvl-t", ["--dvl-topic"]),
        ("dvl-calib replay bag -p min_s", ["min_speed:="]),
        ("dvl-calib replay bag -p gnss_free_model:=M5", ["gnss_free_model:=M5"]),
        ("dvl-calib simulate bag --storage m", ["mcap"]),
    ],
)
def test_the_shell_completes_commands_options_choices_and_parameters(tmp_path, typed, expected):
    pytest.importorskip("argcomplete", reason="shell completion is optional: pip install argcomplete")
    assert completed(tmp_path, typed) == expected


# ------------------------------------------------------------------ replay


@pytest.fixture(scope="module")
def document(bag, tmp_path_factory) -> dict:
    target = tmp_path_factory.mktemp("json") / "out.json"
    assert main(["replay", str(bag), "--json", str(target)]) == 0

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(target.read_text(), parse_constant=refuse)


def test_replay_json_has_the_documented_structure(document, bag):
    assert set(document) == {
        "models", "verification", "selected", "counts", "parameters", "version", "dvl", "findings",
        "discovery", "recordings", "navigation",
    }  # fmt: skip
    assert document["recordings"] is None  # of one there is nothing to compare
    assert document["dvl"] == {"type": TWIST_TYPE, "turned_from_frd": False}
    assert set(document["verification"]) == set(BY_VELOCITY)
    assert tuple(document["models"]) == BY_VELOCITY
    for name, model in ((name, MODELS[name]) for name in BY_VELOCITY):
        entry = document["models"][name]
        covariances = {"by_dvl_bias", "covariance", "covariance_of_recording", "covariance_of_filter"}
        assert set(entry) == {"state_names", "state", *covariances, "used", "gated", "convergence"}
        scales, nuisance = [scale for scale, _ in model.scale_axes], [state.name for state in model.nuisance]
        assert entry["state_names"] == ["phi_x", "phi_y", "phi_z", *scales, *nuisance]
        assert [*entry["state"], *np.ravel(entry["covariance"])] == pytest.approx(
            estimates(bag)[name], rel=1e-9, abs=1e-12
        )
        assert entry["convergence"] in ("collecting", "coarse", "fine")
    assert document["models"]["M3"]["state_names"][3:] == ["delta_k"]
    assert document["models"]["M4"]["state_names"][3:] == ["delta_k_x"]
    assert document["version"] == __version__
    assert document["parameters"]["gnss_model"] == "M3"


def test_the_selected_segments_follow_each_other_from_the_first_sample_to_the_last(document):
    segments = document["selected"]
    assert [segment["model"] for segment in segments] == ["unaided", "full"]
    assert segments[0]["from_s"] == 0.0
    assert segments[0]["to_s"] == segments[1]["from_s"] == pytest.approx(3.0, abs=0.5)
    assert segments[-1]["to_s"] == pytest.approx(40.0, abs=0.5)


def test_only_the_models_asked_for_are_shown(capsys, bag, tmp_path):
    out, _ = succeed(capsys, "replay", bag, "--models", "M7, M3,M3", "--json", tmp_path / "o.json")
    assert list(json.loads((tmp_path / "o.json").read_text())["models"]) == ["M7", "M3"]
    assert "M3" in out and "M4" not in out


@pytest.mark.parametrize(
    ("models", "name"), [("M3,M9", "'M9'"), ("m3", "'m3'"), ("", "at least one"), (",", "at least one")]
)
def test_a_model_that_is_none_is_named_with_those_there_are(capsys, bag, models, name):
    error = fail(capsys, "replay", bag, "--models", models)
    assert name in error and f"{', '.join(MODELS)}, or all" in error


def test_replay_says_what_was_configured_what_it_is_now_and_the_change_within_80_columns(capsys, tmp_path):
    bag = write_bag(tmp_path / "bag", run())
    assert main(["replay", str(bag), "-p", "mounting_rpy:=[0,0,0.3]"]) == 1
    assert "Not to be used" in capsys.readouterr().out
    assert main(["replay", str(bag), "-p", "mounting_rpy:=[-180deg,0,0]"]) == 0  # this motion shows no roll
    roll = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("  roll"))
    assert -190.0 < float(roll.split()[2][:-1]) < -170.0
    assert main(["replay", str(bag)]) == 0
    lines = capsys.readouterr().out.splitlines()
    at = next(i for i, line in enumerate(lines) if line.split() == ["configured", "corrected", "change", "±1σ"])
    assert all(len(line) <= 80 for line in lines[at : at + 10])
    yaw = next(line for line in lines[at:] if line.startswith("  yaw"))
    assert yaw.split()[1:4:2] == ["0.00°", f"{float(yaw.split()[2][:-1]):+.2f}°"]
    assert any(line.startswith("A straight kilometre of dead reckoning ends ") for line in lines)
    assert main(["replay", str(tmp_path / "none")]) == 2


def test_replay_shows_estimates_and_counts_and_keeps_warnings_apart(capsys, bag):
    out, errors = succeed(capsys, "replay", bag, bag, "-v", "-p", "prior_source:=initial_window")
    assert "200 duplicate" in out and "Model: full" in out
    assert errors.startswith("warning: prior_source initial_window")


def test_replay_saves_a_result_file_that_replay_starts_from(capsys, bag, tmp_path):
    succeed(capsys, "replay", bag, "--save", tmp_path / "r.yaml")
    assert parsed((tmp_path / "r.yaml").read_text())["model"] == "full"
    saved = f"initial_calibration:={tmp_path / 'r.yaml'}"
    succeed(capsys, "replay", bag, "-p", saved, "--json", tmp_path / "o.json")
    again = json.loads((tmp_path / "o.json").read_text())["models"]["M3"]
    assert again["covariance"][2][2] == pytest.approx(estimates(bag)["M3"][4 + 10] / 2, rel=0.1)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--save", "missing/r.yaml"], "missing does not exist; create it"),
        (["--json", "."], "is a folder"),
        (["--params", "nowhere.yaml"], "nowhere.yaml: no such ROS 2 parameter file"),
        (["-p", "min_speed:=-1"], "min_speed: -1 is outside"),
    ],
)
def test_bad_options_of_replay_are_refused_in_one_line(capsys, bag, tmp_path, monkeypatch, options, expected):
    monkeypatch.chdir(tmp_path)
    assert expected in fail(capsys, "replay", bag, *options)
    assert os.listdir(tmp_path) == []


def test_a_terminal_that_cannot_show_greek_gets_the_numbers_all_the_same(bag):
    done = shell("replay", bag, PYTHONIOENCODING="ascii", PYTHONUTF8="0", LC_ALL="C")
    assert done.returncode == 0 and b"model full" in done.stdout and b"Traceback" not in done.stderr


def test_a_reader_that_closes_the_pipe_early_is_no_error(bag):
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", "replay", str(bag)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


# ------------------------------------------------------------------ simulate


def test_the_same_options_and_seed_give_the_same_messages_and_another_seed_does_not(capsys, tmp_path):
    options = ["--duration", 8, "--misalignment", 1, -2, 3, "--scale", 0.5, "--gnss-outage", 2, 4]
    for name, seed, storage in (("a", 1, "mcap"), ("b", 1, "sqlite3"), ("c", 2, "mcap")):
        out, _ = succeed(capsys, "simulate", tmp_path / name, *options, "--seed", seed, "--storage", storage)
        assert out == f"wrote {tmp_path / name}\n"
    assert raw(tmp_path / "a") == raw(tmp_path / "b") != raw(tmp_path / "c")
    with BagReader([tmp_path / "a"]) as bag:
        assert bag.message_counts == {"dvl/twist": 40, "gnss/twist": 30, "imu/data": 160}


def test_a_rate_of_0_leaves_a_sensor_out(capsys, tmp_path):
    succeed(capsys, "simulate", tmp_path / "bag", "--duration", 5, "--gnss-rate", 0, "--imu-rate", 0)
    with BagReader([tmp_path / "bag"]) as bag:
        assert bag.message_counts == {"dvl/twist": 25}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--duration", "0"], "--duration: 0 is outside 1 .. 100000"),
        (["--duration", "nan"], "--duration: nan"),
        (["--duration", "1e9"], "--duration"),
        (["--dvl-rate", "0"], "--dvl-rate: 0 is outside"),
        (["--dvl-rate", "5e-324"], "--dvl-rate"),
        (["--gnss-rate", "-1"], "--gnss-rate: -1"),
        (["--imu-rate", "200"], "--imu-rate: 200 is outside 0.01 .. 100"),
        (["--dvl-topic", "/a50/velocity"], "--dvl-topic needs --live"),
        (["--speed", "2"], "--speed needs --live"),
        (["--seed", "-1"], "--seed: -1"),
        (["--misalignment", "1", "nan", "0"], "--misalignment: nan"),
        (["--mounting-rpy", "0", "0", "inf"], "--mounting-rpy: inf"),
        (["--scale", "1", "2"], "--scale: give one number for all axes, or three"),
        (["--scale", "-100"], "--scale: -100"),
        (["--beam-std", "nan"], "--beam-std: nan"),
        (["--gnss-std", "-0.1"], "--gnss-std: -0.1"),
        (["--gnss-outage", "5", "2"], "--gnss-outage: 5 is not before 2"),
        (["--storage", "sqlite3", "--compression", "chunk"], "compression chunk is MCAP's"),
    ],
)
def test_bad_options_of_simulate_are_refused_and_nothing_is_written(capsys, tmp_path, options, expected):
    assert expected in fail(capsys, "simulate", tmp_path / "bag", *options)
    assert not (tmp_path / "bag").exists()


def test_simulate_never_overwrites(capsys, tmp_path):
    assert "exists already" in fail(capsys, "simulate", tmp_path)
    (tmp_path / "file").touch()
    assert "is not writable" in fail(capsys, "simulate", tmp_path / "file" / "bag", "--duration", 1)


# ------------------------------------------------------------------ import


@pytest.fixture
def trajectory(tmp_path) -> Path:
    rows = [[0.2 * i, 1.5, 0.1 * np.sin(i), 0.0] for i in range(50)]
    np.save(tmp_path / "T_dvl.npy", rows)
    return tmp_path / "T_dvl.npy"


def test_import_writes_a_bag_that_replay_reads(capsys, tmp_path, trajectory):
    out, _ = succeed(capsys, "import", trajectory, "--gnss", trajectory, "-o", tmp_path / "bag")
    assert out == f"{tmp_path / 'bag'}: 50 dvl/twist, 50 gnss/twist\n"
    out, _ = succeed(capsys, "replay", tmp_path / "bag", "-v")
    assert "49 with a reference" in out or "50 with a reference" in out


def test_import_of_a_folder_writes_a_bag_per_recording(capsys, tmp_path, trajectory):
    out, _ = succeed(capsys, "import", trajectory.parent, "-o", tmp_path / "out", "--storage", "sqlite3")
    assert out == f"{tmp_path / 'out' / 'T'}: 50 dvl/twist\n"
    assert (tmp_path / "out" / "T" / "T.db3").is_file()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--start", "nan"], "--start"),
        (["--start", "1e12"], "--start"),
        (["--start", "2147483647"], "is not in 1970 .. 2038"),
        (["--dvl-std", "-1"], "--dvl-std: -1"),
        (["--gnss", "missing.csv"], "missing.csv: no such file"),
        (["--attitude", "T_dvl.txt"], "T_dvl.txt: no such file"),
        (["--storage", "sqlite3", "--compression", "chunk"], "compression chunk is MCAP's"),
    ],
)
def test_bad_options_of_import_are_refused_and_nothing_is_written(capsys, tmp_path, trajectory, options, expected):
    assert expected in fail(capsys, "import", trajectory, "-o", tmp_path / "bag", *options)
    assert not (tmp_path / "bag").exists()


def test_files_for_a_folder_of_recordings_are_refused(capsys, tmp_path, trajectory):
    assert "found by their names" in fail(capsys, "import", tmp_path, "--gnss", trajectory, "-o", tmp_path / "bag")
