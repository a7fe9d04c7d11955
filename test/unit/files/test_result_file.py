"""The result file: exact, never torn, never believed blindly."""

from __future__ import annotations

import errno
import math
import os
import shlex
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import estimates, replayed, run, steady_run, write_bag
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.error_model import corrected_mounting
from dvl_calib_ros.calibration.frames import rotation_from_rpy
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.results import Result
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.result_file import (
    check_writable,
    load_initial_calibration,
    result_document,
    result_text,
    save_text,
)

MOUNTING = (0.1, -0.2, 0.7)


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("result") / "bag", run())


@pytest.fixture(scope="module")
def result(bag) -> Result:
    return replayed(bag, mounting_rpy=MOUNTING, lever_arm=(1.0, 0.0, -0.5), gate_probability=0.0).result


@pytest.fixture
def saved(tmp_path, result) -> Path:
    save_text(tmp_path / "result.yaml", result_text(result_document(result)))
    return tmp_path / "result.yaml"


def test_every_model_comes_back_bit_for_bit(saved, result):
    loaded = load_initial_calibration(saved, MOUNTING)
    assert list(loaded) == list(MODELS)
    for name, estimate in result.estimates.items():
        assert loaded[name].x.tobytes() == estimate.state.tobytes()
        assert loaded[name].p.tobytes() == np.ascontiguousarray(estimate.covariance).tobytes()


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_any_double_comes_back_bit_for_bit(values):
    assert yaml.safe_load(result_text({"state": values}))["state"] == values


def test_the_corrected_mounting_as_quaternion_rpy_and_command_line_agree_with_the_estimate(saved, result):
    mounting = yaml.safe_load(saved.read_text())["mounting"]
    expected = corrected_mounting(result.estimate.misalignment, rotation_from_rpy(MOUNTING).T)
    quaternion = mounting["corrected_quaternion_xyzw"]
    assert Rotation.from_quat(quaternion).as_matrix() == pytest.approx(expected, abs=1e-12)
    assert Rotation.from_euler("xyz", mounting["corrected_rpy"]).as_matrix() == pytest.approx(expected, abs=1e-12)
    words = shlex.split(mounting["static_transform_publisher"])
    given = {key: float(words[words.index(f"--{key}") + 1]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw")}
    assert list(given.values()) == pytest.approx([1.0, 0.0, -0.5, *quaternion], abs=1e-8)
    assert words[-4:] == ["--frame-id", "base_link", "--child-frame-id", "dvl_link"]
    assert mounting["nominal_rpy"] == list(MOUNTING)


def test_a_frame_name_from_a_bag_cannot_smuggle_a_command_into_the_line_to_paste(result):
    line = result_document(result, "dvl; rm -rf $HOME")["mounting"]["static_transform_publisher"]
    assert shlex.split(line)[-1] == "dvl; rm -rf $HOME"


def test_the_file_says_what_a_user_asks_of_it(saved, result):
    content = yaml.safe_load(saved.read_text())
    assert content["model"] == result.selected
    assert content["state"] == result.estimate.state.tolist()
    assert content["state_names"] == list(MODELS[result.selected].state_names)
    assert content["time_span"] == {"first_ns": result.first_ns, "last_ns": result.last_ns}
    assert content["counts"]["dvl"]["accepted"] > 0
    assert content["parameters"]["mounting_rpy"] == list(MOUNTING)
    assert content["software"].startswith("dvl_calib_ros ")
    sigma = math.degrees(result.estimate.std[2])
    assert content["std"]["phi_z"] == f"{sigma:.4f} deg"


def _disk_is_full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_the_file_before_is_kept_as_bak_even_when_the_next_save_fails(tmp_path, monkeypatch):
    path = tmp_path / "result.yaml"
    for text in ("one", "two", "three"):
        save_text(path, text)
    monkeypatch.setattr(os, "fsync", _disk_is_full)
    with pytest.raises(InputError):
        save_text(path, "four")
    assert path.read_text() == "three"
    assert (tmp_path / "result.yaml.bak").read_text() == "two"
    assert sorted(os.listdir(tmp_path)) == ["result.yaml", "result.yaml.bak"]


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "link.yaml").symlink_to(tmp_path / "data" / "result.yaml")
    save_text(tmp_path / "link.yaml", "text")
    assert (tmp_path / "link.yaml").is_symlink()
    assert (tmp_path / "data" / "result.yaml").read_text() == "text"


@pytest.mark.parametrize("function", ["fsync", "replace", "fdopen", "fchmod", "link"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EACCES])
def test_a_failure_while_saving_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, function, code):
    path = tmp_path / "result.yaml"
    path.write_text("old")

    def fail(*_args, **_options):
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(os, function, fail)
        if function == "link":
            patch.setattr("shutil.copy2", fail)
        with pytest.raises(InputError, match=os.strerror(code)) as caught:
            save_text(path, "new")
    assert ("free some space" in str(caught.value)) == (code == errno.ENOSPC)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.yaml"]


def test_a_file_system_that_cannot_sync_folders_or_link_files_is_no_failure(tmp_path, monkeypatch):
    sync = os.fsync

    def only_files(handle):
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(handle)

    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "fsync", only_files)
    monkeypatch.setattr(os, "link", no_links)
    save_text(tmp_path / "result.yaml", "one")
    save_text(tmp_path / "result.yaml", "two")
    assert (tmp_path / "result.yaml").read_text() == "two"
    assert (tmp_path / "result.yaml.bak").read_text() == "one"


def test_an_interrupted_save_leaves_no_temporary_file(tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_text(tmp_path / "result.yaml", "text")
    assert os.listdir(tmp_path) == []


def test_a_disk_that_is_really_full_is_said(tmp_path):
    """A file size limit makes write() itself fail, as a full disk does."""
    script = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from dvl_calib_ros.files.result_file import save_text\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "save_text(Path(sys.argv[1]), 'x' * 100_000)"
    )
    path = tmp_path / "result.yaml"
    path.write_text("old")
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True)
    assert "InputError" in done.stderr and "File too large" in done.stderr
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["result.yaml"]


def test_where_no_file_can_be_is_said_before_anything_is_collected(tmp_path):
    (tmp_path / "file").touch()
    for path, expected in (
        (tmp_path, "is a folder; name a file in it"),
        (tmp_path / "missing" / "r.yaml", "does not exist; create it"),
        (tmp_path / "file" / "r.yaml", "does not exist; create it"),
    ):
        with pytest.raises(InputError, match=expected):
            check_writable(path)
        with pytest.raises(InputError, match="could not be written"):
            save_text(path, "text")
    check_writable(tmp_path / "new.yaml")
    assert os.listdir(tmp_path) == ["file"]


def change(path: Path, edit) -> Path:
    content = yaml.safe_load(path.read_text())
    edit(content)
    path.write_text(yaml.safe_dump(content))
    return path


DAMAGE = {
    "foreign format": (lambda c: c.update(format="other 2"), "not a result file of this software"),
    "no models": (lambda c: c.pop("models"), "holds no models"),
    "models a list": (lambda c: c.update(models=[1]), "holds no models"),
    "unknown models": (lambda c: c.update(models={"M99": {}}), "none of its models M99"),
    "state gone": (lambda c: c["models"]["M3"].pop("state"), "models: M3: damaged"),
    "state short": (lambda c: c["models"]["M3"]["state"].pop(), "are not those of the model"),
    "state text": (lambda c: c["models"]["M3"].update(state="abcd"), "models: M3: damaged"),
    "state nan": (lambda c: c["models"]["M3"]["state"].__setitem__(0, math.nan), "not finite"),
    "state huge": (lambda c: c["models"]["M3"]["state"].__setitem__(0, 10**400), "models: M3: damaged"),
    "other names": (lambda c: c["models"]["M3"].update(state_names=["a", "b", "c", "d"]), "not those of the model"),
    "covariance ragged": (lambda c: c["models"]["M3"]["covariance"][0].pop(), "models: M3: damaged"),
    "covariance crooked": (lambda c: c["models"]["M3"]["covariance"][0].__setitem__(1, 9.0), "not symmetric"),
    "covariance negative": (lambda c: c["models"]["M3"].update(covariance=(-np.eye(4)).tolist()), "positive definite"),
    "covariance flat": (lambda c: c["models"]["M3"].update(covariance=np.zeros((4, 4)).tolist()), "positive definite"),
    "model a number": (lambda c: c["models"].update(M3=3), "models: M3: damaged"),
    "mounting gone": (lambda c: c.pop("mounting"), "no mounting"),
    "mounting other": (lambda c: c["mounting"].update(nominal_rpy=[0.0, 0.0, 0.7]), "set the same"),
}  # fmt: skip


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_or_foreign_file_is_refused_with_its_name_and_the_reason(saved, what):
    edit, expected = DAMAGE[what]
    with pytest.raises(InputError) as caught:
        load_initial_calibration(change(saved, edit), MOUNTING)
    assert str(caught.value).startswith(f"{saved}: ") and expected in str(caught.value)


@pytest.mark.parametrize("part", [0.0, 0.1, 0.3, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.9, 0.99])
def test_a_torn_file_is_refused_unless_all_its_models_are_whole(saved, result, part):
    text = saved.read_text()
    models_end = text.index("counts:")
    saved.write_text(text[: int(part * len(text))])
    if part * len(text) < models_end:
        with pytest.raises(InputError, match=r"result\.yaml: "):
            load_initial_calibration(saved)
    else:
        with suppress(InputError):
            assert [*load_initial_calibration(saved)["M7"].x] == [*result.estimates["M7"].state]


def test_files_that_are_no_result_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such result file"):
        load_initial_calibration(tmp_path / "missing.yaml")
    (tmp_path / "garbage.yaml").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="no result file"):
        load_initial_calibration(tmp_path / "garbage.yaml")


def test_a_run_continued_from_a_file_ends_as_if_both_had_been_one(tmp_path):
    samples = steady_run(400)
    whole = estimates(write_bag(tmp_path / "whole", samples))
    first = replayed(write_bag(tmp_path / "first", samples[:400])).result
    save_text(tmp_path / "first.yaml", result_text(result_document(first)))
    second = write_bag(tmp_path / "second", samples[400:])
    continued = estimates(second, initial_calibration=str(tmp_path / "first.yaml"))
    for name, expected in whole.items():
        # G1's prior is on errors that its linear filter does not hold, so a cut costs it the second order; the motion's
        # news is shared with the sample before, which the first of a run has not (F1, A1)
        exact = not (MODELS[name].in_correction_parameters or MODELS[name].motion_is_noise)
        tolerance = {"rel": 1e-9, "abs": 1e-12} if exact else {"rel": 5e-3, "abs": 3e-4}
        assert continued[name] == pytest.approx(expected, **tolerance)
    assert estimates(second)["M3"] != pytest.approx(whole["M3"], rel=1e-3)


def test_a_run_is_not_continued_with_another_mounting(tmp_path, bag, saved):
    with pytest.raises(InputError, match="relative to mounting_rpy"):
        replayed(bag, initial_calibration=str(saved))
