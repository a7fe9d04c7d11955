"""The result file: exact, never lost to a worse one, never believed blindly."""

from __future__ import annotations

import math
import os
import shlex
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import estimates, replayed, run, steady_run, write_bag
from scipy.spatial.transform import Rotation
from yaml_text import parsed, written

from dvl_calib_ros.calibration.comparison.mounting_change import Difference
from dvl_calib_ros.calibration.models import BY_VELOCITY, MODELS
from dvl_calib_ros.calibration.models.own import REFERENCE_DELAY_STD_S
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.error_model import corrected_mounting
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import ImuSample
from dvl_calib_ros.calibration.results.mounting_quantities import quantities
from dvl_calib_ros.calibration.results.results import Result
from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.mounting import load_extrinsics
from dvl_calib_ros.files.result_file import (
    KeptError,
    load_initial_calibration,
    load_result,
    result_document,
    result_text,
    save_result,
    save_unless_worse,
)

MOUNTING = (0.1, -0.2, 0.7)


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("result") / "bag", run())


@pytest.fixture(scope="module")
def result(bag) -> Result:
    return replayed(
        bag, mounting_rpy=MOUNTING, lever_arm=(1.0, 0.0, -0.5), dvl_position="told", gate_probability=0.0, model="full"
    ).result


@pytest.fixture
def saved(tmp_path, result) -> Path:
    save_text(tmp_path / "result.yaml", result_text(result_document(result)))
    return tmp_path / "result.yaml"


def test_a_configured_value_that_the_model_does_not_estimate_says_so(bag):
    run = replayed(bag, lever_arm=(1.0, 0.0, -0.5), dvl_position="from_reference", model="M3")
    text = result_text(result_document(run.result))
    assert "  lever arm: 1 0 -0.5 m as configured, not estimated\n" in text
    assert "  DVL late against IMU: 0 s as configured, not estimated\n" in text


def test_every_model_comes_back_bit_for_bit(saved, result):
    _, loaded = load_result(saved)
    assert tuple(loaded) == BY_VELOCITY
    for name, estimate in result.estimates.items():
        assert loaded[name].x.tobytes() == estimate.state.tobytes()
        assert loaded[name].p.tobytes() == np.ascontiguousarray(estimate.covariance).tobytes()


def test_a_file_whose_parameters_name_the_models_of_auto_is_read(saved, result):
    """As version 0.1.0 wrote it."""
    text = saved.read_text()
    assert "gnss_model: M3" in text
    saved.write_text(
        text.replace("gnss_model: M3", "gnss_model: full").replace("gnss_free_model: M7", "gnss_free_model: F1")
    )
    assert load_extrinsics(saved, "a").model == "full"
    assert load_result(saved)[0]["parameters"]["gnss_model"] == "M3"


def test_what_is_of_the_day_is_not_gone_on_with_and_all_else_is(saved, result):
    loaded = load_initial_calibration(saved, MOUNTING)
    for name, estimate in result.estimates.items():
        x, p = estimate.state.copy(), estimate.recording_covariance.copy()
        if name == "full":  # the delay and the constant error of the reference
            of_day = [16, 17, 18, 19]
            x[of_day] = p[of_day] = p[:, of_day] = 0.0
            p[of_day, of_day] = Parameters().reference_offset_std ** 2
            p[16, 16] = REFERENCE_DELAY_STD_S**2
        np.testing.assert_array_equal(loaded[name].x, x)
        np.testing.assert_array_equal(loaded[name].p, p)


@pytest.fixture(scope="module")
def of_biased(bag) -> Result:
    return replayed(bag, model="full", dvl_bias_std=0.01).result


def test_what_a_bias_of_the_dvl_makes_comes_back_and_two_files_of_one_dvl_share_it(of_biased, tmp_path):
    path = tmp_path / "result.yaml"
    save_text(path, result_text(result_document(of_biased, dvl_frame="dvl_a50")))
    found = load_extrinsics(path, "monday")
    assert found.dvl == "dvl_a50, flu"
    yaw_by_across = found.by_bias[2, 1]  # at about 1 m/s
    assert 0.002 < abs(yaw_by_across) < 0.012
    again = Difference.between(found, replace(found, name="tuesday"))
    other = Difference.between(found, replace(found, dvl="dvl_port, flu"))
    assert other.covariance[2, 2] - again.covariance[2, 2] > 1.9 * yaw_by_across**2


def test_a_file_that_claims_too_much_of_a_bias_is_refused(of_biased, tmp_path):
    path, document = tmp_path / "result.yaml", result_document(of_biased)
    for each in document["models"].values():
        each["by_dvl_bias"] = (10.0 * np.array(each["by_dvl_bias"])).tolist()
    save_text(path, result_text(document))
    with pytest.raises(InputError, match="damaged, its by_dvl_bias is more than its covariance"):
        load_extrinsics(path, "a")
    document["models"]["full"]["by_dvl_bias"] = [[1.0, 2.0]]
    save_text(path, result_text(document))
    with pytest.raises(InputError, match="damaged, or of another version"):
        load_extrinsics(path, "a")


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_any_double_comes_back_bit_for_bit(values):
    assert parsed(result_text({"state": values}))["state"] == values


def test_the_corrected_mounting_as_quaternion_rpy_and_command_line_agree_with_the_estimate(saved, result):
    mounting = parsed(saved.read_text())["mounting"]
    expected = corrected_mounting(result.estimate.misalignment, rotation_from_rpy(MOUNTING).T)
    quaternion = mounting["corrected_quaternion_xyzw"]
    assert Rotation.from_quat(quaternion).as_matrix() == pytest.approx(expected, abs=1e-12)
    assert Rotation.from_euler("xyz", mounting["corrected_rpy"]).as_matrix() == pytest.approx(expected, abs=1e-12)
    words = shlex.split(mounting["static_transform_publisher"])
    given = {key: float(words[words.index(f"--{key}") + 1]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw")}
    assert list(given.values()) == pytest.approx([1.0, 0.0, -0.5, *quaternion], abs=1e-8)
    assert words[-4:] == ["--frame-id", "base_link", "--child-frame-id", "dvl_link"]
    assert mounting["nominal_rpy"] == list(MOUNTING)


def test_the_file_says_what_a_user_asks_of_it(saved, result):
    content = parsed(saved.read_text())
    assert content["model"] == result.selected
    own = content["models"][result.selected]
    assert own["state"] == result.estimate.state.tolist()
    assert own["state_names"] == list(MODELS[result.selected].state_names)
    assert content["time_span"] == {"first_ns": result.first_ns, "last_ns": result.last_ns}
    assert content["counts"]["dvl"]["accepted"] > 0
    assert content["parameters"]["mounting_rpy"] == list(MOUNTING)
    assert content["software"].startswith("dvl_calib_ros ")
    sigma = math.degrees(result.estimate.std[2])
    assert content["std"]["phi_z"] == f"{sigma:.4f} deg"


def test_who_opens_the_file_sees_mounting_sigma_and_the_lines_to_paste_at_once(saved, result):
    lines = saved.read_text().splitlines()[:30]
    head = "\n".join(lines)
    for each in quantities(result):
        assert f"{each.name}: {each.value:.2f} +- {each.std:.2f} " in head
    assert "static_transform_publisher --x 1 " in head.replace("\n    ", " ") and '<origin xyz="1 0 -0.5" rpy="' in head
    assert "covariance" not in head.partition("pose_covariance")[0] and list(parsed(saved.read_text()))[-2] == "models"


# ---------------------------------------------------------------------- a good result is never lost


def document(used: int, convergence: str = "coarse", first_ns: int | None = 0) -> dict:
    """As much of a result's document as its worth is told from."""
    head = {"format": "dvl_calib_ros result 1", "used": used, "convergence": convergence}
    return {**head, "time_span": {"first_ns": first_ns}}


def uses(folder: Path) -> list[int]:
    """Samples used in the file and its backups, from the newest."""
    names = sorted(os.listdir(folder), key=lambda name: (len(name), name))
    return [parsed((folder / name).read_text())["used"] for name in names]


def test_a_result_of_no_sample_replaces_nothing_that_holds_something(tmp_path, saved, result):
    before = saved.read_bytes()
    empty = {**result_document(result), "used": 0}
    for _ in range(3):
        with pytest.raises(KeptError, match=rf"no sample was used.*of {result.estimate.used} samples, is kept"):
            save_result(saved, empty, 3)
    notes = tmp_path / "notes.yaml"
    notes.write_text("not a result")
    with pytest.raises(KeptError, match="is no result file, is kept"):
        save_result(notes, empty, 3)
    assert saved.read_bytes() == before and notes.read_text() == "not a result"
    assert sorted(os.listdir(tmp_path)) == ["notes.yaml", "result.yaml"]


@pytest.mark.parametrize("used", [0, 3])
def test_where_the_disk_has_gone_the_error_is_one_that_the_node_knows_and_prints_the_result_after(tmp_path, used):
    """A name too long stands in for it: the system's answer to every question is an error."""
    with pytest.raises(InputError, match="could not be written"):
        save_result(tmp_path / ("x" * 300 + ".yaml"), document(used, "collecting"))


def judged(
    result, verdict: str, wider: float = 1.0, turned_deg: float = 0.0, first_ns: int = 5, without=(), **also
) -> dict:
    """A document with this verdict, σ so many times as large, and a yaw that differs by so much."""
    whole = result_document(result)
    mounting = dict(whole["mounting"])
    roll, pitch, yaw = mounting["corrected_rpy"]
    mounting["pose_covariance"] = (wider**2 * np.array(mounting["pose_covariance"])).tolist()
    mounting["corrected_rpy"] = [roll, pitch, yaw + math.radians(turned_deg)]
    for axis in without:  # as of a model that does not estimate it
        mounting["pose_covariance"][3 + axis] = [0.0] * 6
        mounting["pose_covariance"][3 + axis][3 + axis] = -1.0
    head = {
        "convergence": "coarse",
        "verification": {"verdict": verdict, "reasons": ["so"]},
        "time_span": {"first_ns": first_ns, "last_ns": 9},
    }
    return {**whole, **head, "mounting": mounting, **also}


WORSE = {
    "rejected": {"verdict": "reject", "wider": 0.5},
    "rejected, of another angle": {"verdict": "reject", "turned_deg": 60.0},
    "doubted": {"verdict": "accept", "wider": 0.5, "doubts": [{"severity": "reject", "says": "no"}]},
    "without any angle": {"verdict": "accept", "wider": 0.5, "convergence": "collecting"},
    "marginal": {"verdict": "marginal"},
    "less sure": {"verdict": "accept", "wider": 2.0},
    "of a model without roll": {"verdict": "accept", "wider": 0.5, "without": (0,)},
    "of a model without any angle": {"verdict": "accept", "wider": 0.5, "without": (0, 1, 2)},
    "marginal, of the same run later on": {"verdict": "marginal", "first_ns": 1},
}
AS_GOOD = {
    "surer": {"verdict": "accept", "wider": 0.5},
    "less sure, of the same run later on": {"verdict": "accept", "wider": 1.1, "first_ns": 1},
    "of a DVL that has moved": {"verdict": "accept", "wider": 1.1, "turned_deg": 60.0},
}


@pytest.mark.parametrize("worse", WORSE)
def test_a_worse_result_does_not_replace_a_better_one_of_the_same_mounting(tmp_path, result, worse):
    path = tmp_path / "r.yaml"
    save_unless_worse(path, judged(result, "accept", first_ns=1))
    better = path.read_bytes()
    with pytest.raises(KeptError, match=r"r.yaml is kept.*\(accept, ±.*samples\).*r.newer.yaml.*RESULT_WORSE"):
        save_unless_worse(path, judged(result, **WORSE[worse]))
    assert path.read_bytes() == better
    assert parsed((tmp_path / "r.newer.yaml").read_text())["verification"]["verdict"] == WORSE[worse]["verdict"]


@pytest.mark.parametrize("as_good", AS_GOOD)
def test_a_result_that_is_as_good_replaces_the_one_before(tmp_path, result, as_good):
    path = tmp_path / "r.yaml"
    for verdict in ("reject", "marginal", "accept"):
        save_unless_worse(path, judged(result, verdict, wider=1.0 if verdict == "accept" else 0.1, first_ns=1))
    save_unless_worse(path, judged(result, **AS_GOOD[as_good]))
    assert sorted(os.listdir(tmp_path)) == ["r.yaml", "r.yaml.bak"]
    kept, expected = parsed(path.read_text()), judged(result, **AS_GOOD[as_good])
    assert all(kept[name] == expected[name] for name in ("mounting", "time_span", "verification"))


def test_a_result_of_another_configured_mounting_or_over_no_result_is_saved(tmp_path, result):
    path = tmp_path / "r.yaml"
    path.write_text("damaged: [")
    save_unless_worse(path, judged(result, "accept"))
    turned = judged(result, "reject", first_ns=7)
    turned["mounting"] = {**turned["mounting"], "nominal_rpy": [0.0, 0.0, 1.0]}
    save_unless_worse(path, turned)
    assert parsed(path.read_text())["verification"]["verdict"] == "reject"


def test_an_empty_result_is_written_where_nothing_is_and_makes_room_without_a_trace(tmp_path):
    path = tmp_path / "r.yaml"
    for used, left in ((0, [0]), (0, [0]), (7, [7]), (8, [8, 7])):
        save_result(path, document(used, "collecting", None if used == 0 else used), 3)
        assert uses(tmp_path) == left


SAVED = {  # samples used, convergence and run of each save, the backups that are asked for, and what is left
    "one run, every minute, after a good one": (
        [(9000, "fine", 1), *((used, "collecting", 2) for used in range(1, 50))], 3, [49, 48, 9000],
    ),
    "many runs": (
        [(1, "fine", 1), (2, "fine", 2), (3, "coarse", 3), (4, "fine", 4), (5, "collecting", 5), (6, "coarse", 6),
         (7, "collecting", 7)], 3, [7, 6, 4, 2],
    ),
    "as good ones": ([(used, "fine", used) for used in range(1, 6)], 4, [5, 4, 3, 2, 1]),
}  # fmt: skip


@pytest.mark.parametrize("runs", SAVED)
def test_of_many_runs_the_best_converged_are_kept_and_of_these_the_newest(tmp_path, runs):
    saves, n_backups, left = SAVED[runs]
    for used, convergence, first_ns in saves:
        save_result(tmp_path / "r.yaml", document(used, convergence, first_ns), n_backups)
    assert uses(tmp_path) == left
    save_result(tmp_path / "r.yaml", document(8, "fine", first_ns=8), 1)
    assert uses(tmp_path)[0] == 8 and len(uses(tmp_path)) == 2  # where fewer are asked for the others go


RUNS = st.lists(st.tuples(st.integers(0, 50), st.sampled_from(["collecting", "coarse", "fine"])), max_size=12)


@given(runs=RUNS, n_backups=st.integers(2, 4))
def test_whatever_runs_follow_each_other_the_last_fine_one_is_kept(tmp_path_factory, runs, n_backups):
    folder = tmp_path_factory.mktemp("runs")
    last_fine = None
    for number, (used, convergence) in enumerate(runs):
        with suppress(KeptError):
            save_result(folder / "r.yaml", document(used, convergence, first_ns=number), n_backups)
            last_fine = used if used and convergence == "fine" else last_fine
        assert last_fine is None or last_fine in uses(folder)
        assert len(uses(folder)) <= n_backups + 1


def test_a_backup_that_is_no_result_file_any_more_is_the_first_to_go(tmp_path):
    path = tmp_path / "r.yaml"
    for used in range(1, 4):
        save_result(path, document(used, "collecting", first_ns=used), 3)
    (tmp_path / "r.yaml.bak").write_text("damaged: [")
    for used in range(4, 6):
        save_result(path, document(used, "collecting", first_ns=used), 3)
    assert uses(tmp_path) == [5, 4, 3, 1]


# ---------------------------------------------------------------------- what is read


def change(path: Path, edit) -> Path:
    content = parsed(path.read_text())
    edit(content)
    path.write_text(written(content))
    return path


DAMAGE = {
    "newer format": (lambda c: c.update(format="dvl_calib_ros result 2"), "another version of this software"),
    "top only": (lambda c: c.update(gated=7000), "its gated has two different values"),
    "top of before": (lambda c: c.update(state=[0.5]), "its state has two different values"),
    "below only": (lambda c: c["models"][c["model"]].update(used=7), "its used has two different values"),
    "nominal only": (lambda c: c["parameters"].update(mounting_rpy=[0.0, 0.0, 0.1]), "mounting has two different"),
    "foreign format": (lambda c: c.update(format="other 2"), "not a result file of this software"),
    "no models": (lambda c: c.pop("models"), "holds no models"),
    "models a list": (lambda c: c.update(models=[1]), "holds no models"),
    "unknown models": (lambda c: c.update(models={"M99": {}}), "none of its models M99"),
    "state gone": (lambda c: c["models"]["M3"].pop("state"), "models: M3: damaged"),
    "state short": (lambda c: c["models"]["M3"]["state"].pop(), "are not the model's"),
    "state text": (lambda c: c["models"]["M3"].update(state="abcd"), "models: M3: damaged"),
    "state nan": (lambda c: c["models"]["M3"]["state"].__setitem__(0, math.nan), "not finite"),
    "state huge": (lambda c: c["models"]["M3"]["state"].__setitem__(0, 10**400), "models: M3: damaged"),
    "other names": (lambda c: c["models"]["M3"].update(state_names=["a", "b", "c", "d"]), "not the model's"),
    "covariance ragged": (lambda c: c["models"]["M3"]["covariance"][0].pop(), "models: M3: damaged"),
    "covariance crooked": (lambda c: c["models"]["M3"]["covariance"][0].__setitem__(1, 9.0), "not symmetric"),
    "covariance negative": (lambda c: c["models"]["M3"].update(covariance=(-np.eye(4)).tolist()), "positive definite"),
    "covariance flat": (lambda c: c["models"]["M3"].update(covariance=np.zeros((4, 4)).tolist()), "positive definite"),
    "model a number": (lambda c: c["models"].update(M3=3), "models: M3: damaged"),
    "mounting gone": (lambda c: c.pop("mounting"), "no mounting"),
    "mounting other": (
        lambda c: c["mounting"].update(nominal_rpy=[0, 0, 0.7]) or c["parameters"].update(mounting_rpy=[0, 0, 0.7]),
        "set the same",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_or_foreign_file_is_refused_with_its_name_and_the_reason(saved, what):
    edit, expected = DAMAGE[what]
    with pytest.raises(InputError) as caught:
        load_initial_calibration(change(saved, edit), MOUNTING)
    assert str(caught.value).startswith(f"{saved}: ") and expected in str(caught.value)


def test_a_file_of_which_the_end_was_cut_off_anywhere_is_refused(saved):
    """Also in its parameters, of which those that are missing would be taken for not changed."""
    lines = saved.read_text().splitlines(keepends=True)
    for at in {*range(len(lines) - 1, len(lines) - 46, -3), *range(0, len(lines), len(lines) // 5)}:
        for cut in ("".join(lines[:at]), "".join(lines[:at]) + lines[at][: len(lines[at]) // 2]):
            saved.write_text(cut)
            with pytest.raises(InputError, match=r"result\.yaml: "):
                load_initial_calibration(saved)


def test_files_that_are_no_result_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such result file"):
        load_initial_calibration(tmp_path / "missing.yaml")
    (tmp_path / "garbage.yaml").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="no result file"):
        load_initial_calibration(tmp_path / "garbage.yaml")


def test_a_filter_continued_from_a_file_ends_as_if_both_had_been_one(tmp_path):
    # without turn rates an unknown lever arm would be in sigma, and so in the prior of the second
    run = steady_run(400)
    samples = [each for one in run for each in (one, ImuSample(one.stamp_ns, None, (0.0, 0.0, 0.0)))]
    whole = estimates(write_bag(tmp_path / "whole", samples))
    first = replayed(write_bag(tmp_path / "first", samples[:800])).result
    save_text(tmp_path / "first.yaml", result_text(result_document(first)))
    second = write_bag(tmp_path / "second", samples[800:])
    continued = estimates(second, initial_calibration=str(tmp_path / "first.yaml"))
    for name, expected in whole.items():
        if MODELS[name].estimator:  # works in whole blocks, and each run has a rest
            continue
        # the motion's news is shared with the sample before, which the first of a run has not (unaided)
        exact = not MODELS[name].motion_is_noise
        tolerance = {"rel": 1e-9, "abs": 1e-12} if exact else {"rel": 5e-3, "abs": 3e-4}
        assert continued[name] == pytest.approx(expected, **tolerance)
    assert estimates(second)["M3"] != pytest.approx(whole["M3"], rel=1e-3)


def test_a_run_is_not_continued_with_another_mounting(tmp_path, bag, saved):
    with pytest.raises(InputError, match="relative to mounting_rpy"):
        replayed(bag, initial_calibration=str(saved))
