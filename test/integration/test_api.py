"""The public interface: five lines of Python do what the commands do."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from command_line import in_fresh_process, succeed
from conftest import ROOT
from io_fixtures import run, write_bag
from report_fixtures import drawn

import dvl_calib_ros as dc
from dvl_calib_ros import api
from dvl_calib_ros.api import __all__ as PUBLIC  # noqa: N812
from dvl_calib_ros.cli.main import main

NOTEBOOK = ROOT / "examples" / "five_lines.ipynb"


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("api") / "bag", run())


@pytest.fixture(scope="module")
def later(tmp_path_factory) -> Path:
    return dc.simulate(tmp_path_factory.mktemp("later") / "later", seconds=90.0, seed=7)


@pytest.fixture(scope="module")
def ahead(tmp_path_factory) -> dc.Calibration:
    """Of a DVL that is 0.8 m ahead of the reference."""
    place = tmp_path_factory.mktemp("ahead") / "ahead"
    made = dc.simulate(place, seconds=240.0, effects={"lever_arm": {"x_m": 0.8}})
    return dc.replay(made, model="full", history=False)


@pytest.fixture(scope="module")
def calibration(bag) -> dc.Calibration:
    return dc.replay(bag)


def test_five_lines_give_the_mounting_and_a_picture(tmp_path, bag):
    script = f"""
        import dvl_calib_ros as dc
        run = dc.replay({str(bag)!r})
        print(run.mounting)
        run.plot().savefig({str(tmp_path / "run.png")!r})
        print(run.verdict)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("dvl_link in base_link: roll ")
    assert (tmp_path / "run.png").stat().st_size > 10_000


def test_replay_is_what_the_command_gives(calibration, bag, tmp_path, capsys):
    assert main(["replay", str(bag), "--json", str(tmp_path / "o.json")]) == 0
    document = json.loads((tmp_path / "o.json").read_text())
    state = calibration.replayed.result.estimates["M3"].state
    np.testing.assert_allclose(state, document["models"]["M3"]["state"], rtol=0, atol=1e-12)
    assert calibration.verdict == document["verification"][document["selected"][-1]["model"]]["verdict"]
    assert list(calibration.found) == document["discovery"]["found"]
    out, _ = succeed(capsys, "replay", bag)
    assert calibration.mounting.urdf in out


def test_a_corrected_velocity_is_in_the_body(calibration):
    rotation = np.array(calibration.replayed.result.estimate.rotation_body_from_dvl(np.eye(3)))
    np.testing.assert_allclose(calibration.correct([1.0, 0.0, 0.0]), rotation[:, 0], atol=0.02)


def test_a_corrected_velocity_of_a_turning_vehicle_is_that_of_the_reference_point(ahead):
    velocity = [[1.0, 0.0, 0.0], [0.5, 0.1, 0.0]]
    turning = ahead.correct(velocity, [[0.0, 0.0, 0.2], [0.0, 0.0, -0.1]]) - ahead.correct(velocity)
    x, y, _ = ahead.mounting.xyz_m
    np.testing.assert_allclose(turning, [[0.2 * y, -0.2 * x, 0.0], [-0.1 * y, 0.1 * x, 0.0]], atol=1e-12)


def test_the_run_over_time_is_a_data_frame_on_demand(calibration):
    frame = pytest.importorskip("pandas") and calibration.to_pandas()
    assert frame.index.name == "time_s" and list(frame.columns[:2]) == ["phi_x_rad", "phi_x_rad_std"]
    assert {"lever_arm_x_m", "time_offset_s_std", "delta_k_x"} <= set(frame.columns)
    assert frame["phi_z_rad_std"].iloc[-1] < frame["phi_z_rad_std"].iloc[0]


def test_a_user_finds_tables_by_short_names_with_units(calibration):
    pytest.importorskip("pandas")
    tables = calibration.tables()
    assert list(tables) == ["mounting", "held_out", "models", "streams"]
    yaw = tables["mounting"].loc["yaw"]
    assert yaw["corrected"] == calibration.mounting.rpy_deg[2] and yaw["unit"] == "°"
    assert yaw["change"] == pytest.approx(yaw["corrected"] - yaw["configured"])
    assert {"phi_z_deg", "phi_z_deg_std", "scale_x_percent"} <= set(tables["models"].columns)
    assert list(tables["held_out"].columns[1:4]) == ["uncorrected_mps", "corrected_mps", "predicted_mps"]


@pytest.mark.slow
def test_a_printed_mounting_has_no_powers_of_ten(bag):
    """A quaternion of /tf_static gives a pitch of 6e-33 rad, in which pandas printed every number of the column."""
    pytest.importorskip("pandas")
    run = dc.replay(bag, mounting_rpy=(0.1, 6e-33, 0.8), history=False)
    assert "e-" not in str(run.tables()["mounting"])


def test_the_mounting_is_printed_with_arm_and_delay_and_findings_are_of_the_selected_model(calibration):
    said = str(calibration.mounting)
    assert "lever arm x " in said and "DVL late against IMU " in said
    assert not any(each.says.startswith(("M1: ", "M7: ", "unaided: ")) for each in calibration.findings)


def test_values_that_no_data_support_are_marked_where_the_mounting_is_printed(bag):
    said = str(dc.replay(bag, model="M3", lever_arm=(1.0, 0.0, -0.5), history=False).mounting)
    assert "lever arm 1 0 -0.5 m as configured, not estimated" in said
    assert "DVL late against IMU 0 s as configured, not estimated" in said
    assert "roll" in said and "(not observable)" in said.partition("pitch")[0]


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda run, to: dc.replay(3), "bags=3: expected the path"),
        (lambda run, to: dc.compare(run, 5), "expected a path, not int"),
        (lambda run, to: dc.simulate(to, duration=30.0), "'seconds'"),
        (lambda run, to: dc.simulate(to, waves=0.3), "Waves(height="),
        (lambda run, to: dc.simulate(to, trajectory="foo"), "box"),
        (lambda run, to: dc.simulate(to, seconds="long"), "expected a number"),
        (lambda run, to: dc.simulate(to, seconds=0), "expected a number from 1 on"),
        (lambda run, to: dc.simulate(to, dvl_rate=-1.0), "expected a number from 0.01 on"),
        (lambda run, to: dc.apply(run), "expected a path, not Calibration; save a result first"),
        (lambda run, to: dc.instrument_settings(run, "waterlinked"), "expected a path, not"),
        (lambda run, to: dc.fleet("monday", to, jobs="two"), "jobs: 'two' is no number of processes"),
        (lambda run, to: dc.export("gazebo", run, to), "expected a path, not"),
        (lambda run, to: dc.report(run, to.with_suffix(".pdf")), "a page (HTML)"),
        (lambda run, to: run.correct([1.0, 2.0]), "expected (..., 3)"),
        (lambda run, to: run.correct("abc"), "velocity_dvl"),
        (lambda run, to: run.correct(np.zeros((2, 3)), np.zeros((4, 3))), "(4, 3); velocity_dvl has (2, 3)"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_refused_with_what_is_expected(calibration, tmp_path, call, expected):
    with pytest.raises(dc.InputError) as refused:
        call(calibration, tmp_path / "bag")
    assert expected in str(refused.value) and not (tmp_path / "bag").exists()


def test_without_history_what_needs_it_says_so(bag):
    without = dc.replay(bag, history=False)
    for what in (without.plot, without.to_pandas):
        with pytest.raises(dc.InputError, match=r"history=True|pandas"):
            what()


def test_the_other_functions_give_dataclasses(tmp_path, bag):
    made = dc.simulate(tmp_path / "made", seconds=60.0, trajectory="figure8")
    assert dc.doctor(made).verdict == "yes"
    checked = dc.evaluate([bag, made], models=["M3"], dvl_topic="dvl/twist", gnss_topic="gnss/twist")
    assert checked.models == ("M3",)
    assert repr(checked).startswith(f"{checked.verdict}: On the other bags, M3 leaves ")
    assert dc.replay([made], gnss_topic="none").model == "unaided"
    with pytest.raises(dc.InputError, match="none of"):
        dc.evaluate(models=["M9"])
    with pytest.raises(dc.InputError, match="no topic 'nowhere'"):
        dc.evaluate([bag, made], models=["M3"], gnss_topic="nowhere")
    with pytest.raises(dc.ParameterError, match="did you mean"):
        dc.replay(bag, min_spede=1.0)
    for nothing in (lambda: dc.replay([]), lambda: dc.salvage([], tmp_path / "none"), lambda: dc.doctor([])):
        with pytest.raises(dc.InputError, match="name one at least"):
            nothing()


@pytest.mark.slow
def test_bags_are_compared_as_result_files_are(calibration, later, tmp_path):
    saved = calibration.save(tmp_path / "before.yaml")
    found = dc.compare(saved, later)
    assert [each.name for each in found.calibrations] == ["before.yaml", "later"]
    (tmp_path / "again").mkdir()
    other = dc.replay(later, history=False).save(tmp_path / "again" / "before.yaml")
    again = dc.compare(saved, other)  # equal names: whole paths
    assert [each.name for each in again.calibrations] == [str(saved), str(other)]
    assert found.word in ("same", "suspicious", "moved")


@pytest.mark.slow
def test_the_picture_states_the_sigma_of_the_mounting():
    calibration = dc.replay(ROOT / "bags" / "harbour_box")  # of which the next recording's yaw is known half as well
    legend = [text.get_text() for text in calibration.plot().axes[0].get_legend().get_texts()]
    for name, std, said in zip(("roll", "pitch", "yaw"), calibration.mounting.std_deg, legend, strict=True):
        assert said.startswith(name) and said.endswith(f"± {std:.2f}°")


def test_results_print_as_their_answer_and_in_a_notebook_with_tables(bag, calibration, later, tmp_path):
    examined = dc.doctor(bag)
    assert str(examined).startswith(f"{examined.verdict}: ") and "yaw" in str(examined)
    compared = dc.compare(calibration.save(tmp_path / "saved.yaml"), later)
    assert str(compared).startswith(f"{compared.word}: ") and len(str(compared)) < 5000
    for each in (examined, compared, calibration):
        html = each._repr_html_()
        assert html.startswith("<div") and "<table" in html and "yaw" in html and "<script" not in html


def test_effects_are_simulated_by_name_and_a_wrong_one_is_told(ahead, tmp_path):
    assert ahead.mounting.xyz_m[0] == pytest.approx(0.8, abs=0.1)
    for wrong, message in (
        ({"lever_rm": {"x_m": 0.5}}, "did you mean 'lever_arm'"),
        ({"lever_arm": {"xm": 0.5}}, "did you mean 'x_m'"),
        ({"lever_arm": {"x_m": "far"}}, "is no number"),
        ({"lever_arm": {}}, "does nothing"),
        (["lever_arm"], "give effects by name"),
    ):
        with pytest.raises(dc.InputError, match=message):
            dc.simulate(tmp_path / "none", effects=wrong)
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_a_vehicle_is_diagnosed_against_a_simulator(tmp_path):
    real = dc.simulate(tmp_path / "real", seconds=200.0, seed=1, effects={"lever_arm": {"x_m": 1.0}})
    made = dc.simulate(tmp_path / "made", seconds=200.0, seed=2, trajectory="figure8")
    found = dc.diagnose(real, simulator=made)
    assert "lever_arm" in [each.name for each in found.effects] and found.verdict.value == "different"


def test_a_damaged_recording_is_salvaged_as_by_the_command(bag, tmp_path):
    recovered = dc.salvage(bag, tmp_path / "whole", storage="sqlite3")
    assert recovered.notes == () and min(recovered.counts.values()) > 100
    assert dc.replay(tmp_path / "whole", history=False).mounting == dc.replay(bag, history=False).mounting
    with pytest.raises(dc.InputError, match="exists already"):
        dc.salvage(bag, tmp_path / "whole")
    with pytest.raises(dc.InputError, match="storage is one of mcap, sqlite3"):
        dc.salvage(bag, tmp_path / "other", storage="paper")


def test_files_are_imported_as_by_the_command(tmp_path):
    dvl = tmp_path / "t_dvl.csv"
    dvl.write_text("".join(f"{0.2 * k},1.5,0.0,0.0\n" for k in range(100)))
    made = dc.import_files(dvl, tmp_path / "bag", gnss=dvl, start=1_700_000_000.0)
    assert made[tmp_path / "bag"].counts["dvl/twist"] == 100
    assert main(["import", str(dvl), "--gnss", str(dvl), "--start", "1700000000", "-o", str(tmp_path / "same")]) == 0
    assert dc.doctor(tmp_path / "bag").document()["verdict"] == dc.doctor(tmp_path / "same").document()["verdict"]
    for wrong, message in (
        ({"frame": "enu"}, "'enu' is none of frd, flu"),
        ({"start": -1.0}, "since 1970"),
        ({"attitude": dvl}, "in a folder they are found by their names"),
    ):
        with pytest.raises(dc.InputError, match=message):
            dc.import_files(tmp_path if "attitude" in wrong else dvl, tmp_path / "none", **wrong)


def test_what_was_found_is_exported_as_by_the_command(calibration, tmp_path, capsys):
    saved = calibration.save(tmp_path / "c.yaml")
    made = dc.export("gazebo", saved, tmp_path / "dvl.sdf")
    succeed(capsys, "export", "gazebo", saved, "-o", tmp_path / "same.sdf")
    assert (tmp_path / "dvl.sdf").read_text() == (tmp_path / "same.sdf").read_text() == made.settings.text
    assert (tmp_path / "dvl.sdf.missing.json").is_file()
    with pytest.raises(dc.InputError, match="none of gazebo"):
        dc.export("matlab", saved, tmp_path / "none")


@pytest.mark.slow
def test_results_become_pages_and_json(calibration, bag, tmp_path, capsys, monkeypatch):
    drawn(monkeypatch)
    assert dc.report(calibration, tmp_path / "r.html").read_text().startswith("<!DOCTYPE html>")
    both = ["--json", tmp_path / "command.json", "--report", tmp_path / "command.html"]  # which keeps the history, too
    succeed(capsys, "replay", bag, *both)
    dc.report(calibration, tmp_path / "r.json")
    assert json.loads((tmp_path / "r.json").read_text()) == json.loads((tmp_path / "command.json").read_text())
    examined = dc.doctor(bag)
    assert json.loads(dc.report(examined, tmp_path / "d.json").read_text())["verdict"] == "partly"
    checked = dc.evaluate([bag, dc.simulate(tmp_path / "made", seconds=60.0)], models=["M3"])
    dc.report(checked, tmp_path / "c.html")
    assert "This recording can calibrate a part of" in dc.report(examined, tmp_path / "d.html").read_text()
    with pytest.raises(dc.InputError, match="str is no result"):
        dc.report("yes", tmp_path / "x.html")


def test_a_calibration_is_applied_to_all_files_or_none(calibration, tmp_path):
    saved = calibration.save(tmp_path / "c.yaml")
    params, launch = tmp_path / "p.yaml", tmp_path / "l.xml"
    assert dc.apply(saved).written == ()
    assert dc.apply(saved, params=params).written == (params,)
    assert dc.apply(saved, params=params).unchanged == (params,)
    with pytest.raises(dc.InputError, match="no such URDF"):
        dc.apply(saved, urdf=tmp_path / "none.urdf", launch=launch)
    assert not launch.exists()
    with pytest.raises(dc.InputError, match="need --urdf"):
        dc.apply(saved, joint="dvl")


def test_the_package_imports_nothing_heavy_until_it_is_asked():
    assert in_fresh_process("import dvl_calib_ros", ["numpy", "rosbags", "matplotlib", "scipy"]) == []
    assert in_fresh_process("import dvl_calib_ros.api", ["matplotlib", "pandas", "rclpy"]) == []


def test_the_interface_is_what_the_package_says_it_is():
    assert dc.__all__ == PUBLIC
    for name in PUBLIC:
        assert callable(getattr(dc, name)) and getattr(dc, name).__doc__
    assert set(PUBLIC) <= set(dir(dc))
    # in whatever order subpackages are imported
    script = "import dvl_calib_ros.bag_replay.replay, dvl_calib_ros as dc; assert callable(dc.replay)"
    assert subprocess.run([sys.executable, "-c", script], cwd=ROOT).returncode == 0


@pytest.mark.slow
def test_the_notebook_runs_from_its_own_folder_and_its_stored_output_is_what_comes():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    stored, notebook = (nbformat.read(NOTEBOOK, as_version=4) for _ in range(2))
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in shown)
    for before, now in zip(stored.cells, notebook.cells, strict=True):
        kinds = [[sorted(each.get("data", {"text": 0})) for each in cell.get("outputs", [])] for cell in (before, now)]
        assert kinds[0] == kinds[1], now.source
    said = [cell.outputs[0].data["text/plain"] for cell in stored.cells if cell.source.endswith("run.mounting")]
    again = [cell.outputs[0].data["text/plain"] for cell in notebook.cells if cell.source.endswith("run.mounting")]
    assert said == again == [str(dc.replay(ROOT / "bags" / "harbour_box", history=False).mounting)]


FUNCTIONS = [each for each in (getattr(api, name) for name in PUBLIC) if inspect.isfunction(each)]
METHODS = [each for name, each in vars(dc.Calibration).items() if inspect.isfunction(each) and name[0] != "_"]


@pytest.mark.parametrize("function", [*FUNCTIONS, *METHODS], ids=lambda each: each.__qualname__)
def test_each_function_says_what_it_takes_gives_and_raises(function):
    """In sections of numpydoc, which the API page renders; every parameter by its name."""
    sections = re.split(r"\n(?=[A-Z][a-z]+\n-+\n)", inspect.getdoc(function) or "")
    texts = {section.partition("\n")[0]: section for section in sections}
    taken = [name for name in inspect.signature(function).parameters if name != "self"]
    assert "Returns" in texts and ("Parameters" in texts) is bool(taken)
    named = re.findall(r"[a-z]\w+", " ".join(re.findall(r"^\S.*$", texts.get("Parameters", ""), re.MULTILINE)))
    assert set(taken) <= set(named)
    assert "Raises" in texts or function.__name__ in ("correct", "document")
