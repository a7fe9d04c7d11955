"""Models and estimators of other packages: one entry, or one class beside it, and nothing here changes."""

from __future__ import annotations

import configparser
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dvl_calib_ros.calibration.estimators.estimator import kind_of
from dvl_calib_ros.calibration.models import MODELS, plugins
from dvl_calib_ros.calibration.models.parameters import ParameterError

ROOT = Path(__file__).parents[3]
PLUGIN = ROOT / "test" / "model_plugin"
CALIBRATE = f"""
import json, sys
sys.path[:0] = [sys.argv[1], {str(ROOT)!r}, {str(ROOT / "test")!r}]
from runs import MatchedRun, calibrate, make_samples
from dvl_calib_ros.calibration.models import LINEAR_MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
run = MatchedRun("box", 120.0, phi=(0.0, 0.02, -0.03), gnss_std=0.02, dvl_std=0.005)
samples = make_samples(run)
both = [calibrate(samples, block_size=size, verified=True) for size in (1, 400)]
one, other = (each.result().estimates for each in both)
print(json.dumps({{
    "states": {{name: each.state.tolist() for name, each in one.items()}},
    "by_blocks": {{name: each.state.tolist() for name, each in other.items()}},
    "std": {{name: each.std.tolist() for name, each in one.items()}},
    "used": {{name: each.used for name, each in one.items()}},
    "verdicts": {{name: each.verdict.value for name, each in both[0].result().verifications.items()}},
    "linear": [each.name for each in LINEAR_MODELS],
    "choice": Parameters(model="W1").model,
    "selected": both[0].selected,
}}))
"""


def installed(folder: Path, points: dict[str, str]) -> Path:
    """Installed means: modules and metadata are on the path, as pip puts them there."""
    metadata = folder / "own_models-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: own-models\nVersion: 0.1.0\n")
    lines = [f"[{plugins.ENTRY_POINTS}]", *(f"{name} = {value}" for name, value in points.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    for module in PLUGIN.glob("*.py"):
        (folder / module.name).write_text(module.read_text())
    return folder


def run(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script, str(folder)], capture_output=True, text=True)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    project = configparser.ConfigParser()
    project.optionxform = str
    project.read(PLUGIN / "pyproject.toml")
    section = project[f'project.entry-points."{plugins.ENTRY_POINTS}"']
    points = {name: value.strip('"') for name, value in section.items()}
    done = run(CALIBRATE, installed(tmp_path_factory.mktemp("site"), points))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_linear_model_of_another_package_is_one_entry(calibrated):
    assert "W1" in calibrated["linear"] and calibrated["choice"] == "W1"
    assert calibrated["states"]["W1"] == pytest.approx([0.0, 0.02, -0.03], abs=0.005)
    assert calibrated["states"]["W1"] == pytest.approx(calibrated["by_blocks"]["W1"], abs=1e-12)
    assert calibrated["used"]["W1"] == calibrated["used"]["M1"]
    assert calibrated["verdicts"]["W1"] == "accept"


def test_an_estimator_of_another_package_is_one_class_beside_its_entry(calibrated):
    assert "Y1" not in calibrated["linear"]
    *mounting, rise = calibrated["states"]["Y1"]
    assert not any(mounting)
    assert rise == pytest.approx(-0.02 * 1.0, abs=0.05) and rise != 0.0  # pitch times speed, which it knows nothing of
    assert calibrated["states"]["Y1"] == pytest.approx(calibrated["by_blocks"]["Y1"], abs=1e-12)
    assert calibrated["std"]["Y1"][-1] < 0.01
    assert calibrated["verdicts"]["Y1"] == "reject"
    assert calibrated["selected"] == "full"  # what another package brings is never taken by itself


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("no_such_module:W1", "No module named 'no_such_module'"),
        ("math:pi", "math:pi is no Model"),
        ("dvl_calib_ros.calibration.models.published:PUBLISHED", "is no Model"),
        ("dvl_calib_ros.calibration.models.own:FULL", "there is a model 'full' already"),
    ],
)
def test_a_broken_one_is_named_in_one_line_and_the_others_are_there(monkeypatch, value, said):
    monkeypatch.setattr(plugins, "_points", lambda: [("mine", value)])
    models, problems = plugins.plugged_models(MODELS)
    assert not models and len(problems) == 1
    assert "'mine'" in problems[0] and said in problems[0] and "\n" not in problems[0]


def test_a_replay_with_a_broken_one_says_so_in_one_line(tmp_path):
    script = f"import sys; sys.path[:0] = [sys.argv[1], {str(ROOT)!r}]; from dvl_calib_ros.cli.main import main; "
    script += f"sys.exit(main(['replay', {str(ROOT / 'bags' / 'straight_leg')!r}]))"
    done = run(script, installed(tmp_path, {"mine": "no_such_module:W1"}))
    assert done.returncode == 2
    assert "'mine' of an installed package: cannot be used" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("value", "said"),
    [("no_such_module:It", "No module named"), ("math:pi", "is no subclass of Estimator"), ("math", "AttributeError")],
)
def test_an_estimator_that_cannot_be_used_is_named_when_it_is_wanted(value, said):
    refuses = kind_of(replace(MODELS["full"], name="Z1", estimator=value))
    with pytest.raises(ParameterError, match=f"model Z1: its estimator {value} cannot be used .*{said}"):
        refuses(None)


def test_nothing_is_asked_of_the_installed_packages_where_none_brings_a_model():
    script = f"import sys; sys.path[:0] = [{str(ROOT)!r}]; import dvl_calib_ros.calibration.models; "
    script += "print('importlib.metadata' in sys.modules)"
    assert run(script, Path()).stdout.strip() == "False"
