"""What was found of a DVL, in the files of other simulators, read back as those simulators would."""

from __future__ import annotations

import copy
import json
import math

import numpy as np
import pytest
from command_line import fail, room_for, succeed
from conftest import searched
from hypothesis import given
from hypothesis import strategies as st
from other_simulators import READERS, mt19937_doubles
from scipy.spatial.transform import Rotation
from yaml_text import parsed, written

from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.simulator_export.dvl_description import DvlDescription, Other, load_description
from dvl_calib_ros.simulator_export.simulators import SIMULATORS, export

STD = (0.0103, 0.0103, 0.00266)  # of beams 20 degrees from vertical with 5 mm/s each
FOUND = DvlDescription(
    source="diagnosis.json",
    mounting_rpy=(0.02, -0.03, 0.75),
    lever_arm=(-1.85, 0.4, -0.3),
    scale=(0.008, 0.006, 0.009),
    velocity_bias=(0.04, -0.01, 0.02),
    noise_std=STD,
    rate_hz=5.0,
    speed=(1.4, 0.1, 0.1),
    others=(Other("dvl_time_offset", {"seconds": 0.3}, 0.11),),
)
VELOCITY = np.array([[1.5, 0.1, -0.2], [-0.7, 0.3, 0.0], [2.0, 0.0, 0.1]])


def value(number: float) -> dict:
    return {"value": number, "ci95": [number - 1.0, number + 1.0]}


def values(**numbers: float) -> dict:
    return {name: value(number) for name, number in numbers.items()}


def document(**changes) -> dict:
    """A diagnosis as diagnose --json writes it, as far as it is read."""
    arm = {"name": "lever_arm", "equivalent_to": ["sideslip"], "parameters": values(x_m=-1.35, y_m=0.0, z_m=0.0)}
    late = {"name": "dvl_time_offset", "equivalent_to": [], "parameters": values(seconds=0.2)}
    return {
        "verdict": "known", "effects": [arm, late], "noise": [{"name": "outliers", "parameters": values(share=0.01)}],
        "calibration": {"phi_rad": values(x=0.01, y=-0.02, z=0.03), "delta_k": values(x=0.005, y=0.005, z=0.005)},
        "dvl": {
            "mounting_rpy": [0.0, 0.0, 0.7], "lever_arm_m": [-0.5, 0.0, 0.1], "time_offset_s": 0.1, "clock_drift": 0.0,
            "rate_hz": 5.0, "noise_std_mps": list(STD), "speed_mps": [1.4, 0.1, 0.1],
            "sizes_mps": {"misalignment": 0.05, "scale": 0.007, "lever_arm": 0.1, "dvl_time_offset": 0.08},
        },
        **changes,
    }  # fmt: skip


@pytest.fixture
def diagnosis(tmp_path):
    path = tmp_path / "diagnosis.json"
    path.write_text(json.dumps(document()))
    return path


def read_back(name: str, description: DvlDescription, path):
    exported = export(name, SIMULATORS[name], description)
    path.write_text(exported.settings.text)
    return exported, READERS[name](path)


@pytest.mark.parametrize("name", SIMULATORS)
def test_mounting_rate_and_noise_are_read_back_as_they_were_found(name, tmp_path):
    exported, dvl = read_back(name, FOUND, tmp_path / "file")
    np.testing.assert_allclose(dvl.rotation, Rotation.from_euler("xyz", FOUND.mounting_rpy).as_matrix(), atol=1e-8)
    assert dvl.rate == pytest.approx(5.0, rel=1e-8)
    np.testing.assert_allclose(np.linalg.norm(dvl.std), np.linalg.norm(STD), rtol=2e-3)
    if "noise" not in {each.name for each in exported.missing}:
        np.testing.assert_allclose(dvl.std, STD, rtol=5e-3)


@pytest.mark.parametrize("name", SIMULATORS)
def test_what_stays_of_scale_and_bias_is_what_the_simulator_measures_too_little(name, tmp_path):
    exported, dvl = read_back(name, FOUND, tmp_path / "file")
    quiet = np.random.Generator(np.random.PCG64(1))
    measured = np.mean([dvl.measure(VELOCITY, quiet) for _ in range(4000)], axis=0)
    wanted = VELOCITY * (1.0 + np.array(FOUND.scale)) + FOUND.velocity_bias
    left = {each.name for each in exported.missing}
    if name == "dvl-simulator":
        assert "velocity_bias" not in left
        np.testing.assert_allclose(measured[:, 0], wanted[:, 0], atol=6e-4)
    else:
        assert {"velocity_bias", "scale"} <= left
        np.testing.assert_allclose(measured, VELOCITY, atol=1e-3)


@searched(40)
@given(
    st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)),
    st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    st.sampled_from(list(SIMULATORS)),
)
def test_any_mounting_and_lever_arm_come_back(tmp_path_factory, rpy, lever_arm, name):
    path = tmp_path_factory.mktemp("any") / "file"
    _, dvl = read_back(name, DvlDescription("d.json", rpy, lever_arm, noise_std=STD, rate_hz=4.0), path)
    np.testing.assert_allclose(dvl.rotation, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-7)
    np.testing.assert_allclose(dvl.lever_arm, lever_arm, atol=1e-7)


def test_a_beam_angle_is_found_from_the_noise_where_beams_can_have_it(tmp_path):
    exported, _ = read_back("gazebo", FOUND, tmp_path / "file")
    assert exported.settings.found["tilt"] == pytest.approx(20.0, abs=0.1)
    alike = DvlDescription("d.json", (0.0, 0.0, 0.0), noise_std=(0.01, 0.01, 0.01), rate_hz=5.0)
    exported, dvl = read_back("gazebo", alike, tmp_path / "file")
    assert exported.settings.defaults["tilt"] == 30.0
    assert [each.name for each in exported.missing] == ["noise"]
    assert exported.missing[0].error == pytest.approx(math.sqrt(abs(0.01**2 - dvl.std[2] ** 2)), rel=1e-6)


@pytest.mark.parametrize("name", SIMULATORS)
def test_what_is_not_known_is_at_the_defaults_and_named_so(name, tmp_path):
    calibrated = DvlDescription("calibration.yaml", (0.0, 0.0, 0.1), (0.5, 0.0, 0.0))
    exported = export(name, SIMULATORS[name], calibrated)
    rates = {"update_rate", "rate", "Hz", "sample_time"}
    assert rates & set(exported.settings.defaults) and not rates & set(exported.settings.found)
    assert not set(exported.settings.defaults) & set(exported.settings.found)


def test_the_draws_of_dvl_simulator_are_those_of_cpp():
    """First words of std::mt19937(1): 1791095845, 4282876139, 3093770124, 4005303368 (the generator's own tests)."""
    assert mt19937_doubles(1, 2) == pytest.approx(
        [(1791095845 + 4282876139 * 2**32) / 2**64, (3093770124 + 4005303368 * 2**32) / 2**64], rel=1e-15
    )


# ---------------------------------------------------------------- the command


@pytest.mark.parametrize("name", SIMULATORS)
def test_the_command_writes_settings_and_beside_them_what_is_missing(name, diagnosis, tmp_path, capsys):
    out, _ = succeed(capsys, "export", name, diagnosis, "-o", tmp_path / "dvl.txt")
    dvl = READERS[name](tmp_path / "dvl.txt")
    turned = Rotation.from_euler("z", 0.7) * Rotation.from_rotvec([0.01, -0.02, 0.03]).inv()
    np.testing.assert_allclose(dvl.rotation, turned.as_matrix(), atol=1e-8)
    beside = json.loads((tmp_path / "dvl.txt.missing.json").read_text())
    missing = {each["name"]: each["error_mps"] for each in beside["missing"]}
    assert missing["dvl_time_offset"] == 0.08 and missing["outliers"] is None
    assert "seconds 0.3;" in next(each["says"] for each in beside["missing"] if each["name"] == "dvl_time_offset")
    assert any("sideslip" in remark for remark in beside["remarks"])
    assert "dvl_time_offset" in out and "80.0" in out
    assert beside["found"] and beside["defaults"]
    for default in beside["defaults"]:
        assert default in out
    np.testing.assert_allclose(dvl.lever_arm, [-1.85, 0.0, 0.1], atol=1e-8)


def test_what_no_effect_explains_is_said_to_stay(tmp_path, capsys):
    unknown = document(verdict="unknown", gap={"not_explained_mps": 0.0124})
    (tmp_path / "d.json").write_text(json.dumps(unknown))
    out, _ = succeed(capsys, "export", "stonefish", tmp_path / "d.json", "-o", tmp_path / "dvl.xml")
    assert "not_explained" in out and "12.4" in out
    _, errors = succeed(capsys, "simulate", tmp_path / "bag", "--duration", "10", "--diagnosis", tmp_path / "d.json")
    assert "not_explained" in errors


def test_a_source_with_two_hyphens_leaves_the_xml_well_formed(tmp_path, capsys):
    odd = tmp_path / "a--b-->.json"
    odd.write_text(json.dumps(document()))
    for name in ("gazebo", "stonefish"):
        succeed(capsys, "export", name, odd, "-o", tmp_path / name)
        READERS[name](tmp_path / name)


def test_a_result_file_of_a_calibration_is_exported_too(tmp_path, capsys):
    succeed(capsys, "simulate", tmp_path / "bag", "--trajectory", "box", "--duration", "120", "--gnss-std", "0.02",
            "--misalignment", "1", "-2", "3")  # fmt: skip
    succeed(capsys, "replay", tmp_path / "bag", "--save", tmp_path / "calibration.yaml", "-p", "lever_arm:=[0.1,0,0]",
            "-p", "dvl_position:=from_reference", "-p", "mounting_rpy:=[0.0,0.0,0.0]")  # fmt: skip
    succeed(capsys, "export", "stonefish", tmp_path / "calibration.yaml", "-o", tmp_path / "dvl.xml")
    dvl = READERS["stonefish"](tmp_path / "dvl.xml")
    saved = load_yaml(tmp_path / "calibration.yaml", "result file")["mounting"]
    np.testing.assert_allclose(dvl.rotation, Rotation.from_euler("xyz", saved["corrected_rpy"]).as_matrix(), atol=1e-8)
    np.testing.assert_allclose(dvl.lever_arm, saved["position"], atol=1e-8)
    assert saved["corrected_rpy"][2] == pytest.approx(math.radians(3.0), abs=0.01)
    beside = json.loads((tmp_path / "dvl.xml.missing.json").read_text())
    assert "rate" in beside["defaults"]


def test_a_parameter_file_is_exported_as_what_calibration_compensates(tmp_path, capsys):
    (tmp_path / "p.yaml").write_text(
        "/**: {ros__parameters: {lever_arm: [0.5, 0.0, -0.1], mounting_rpy: [0.0, 0.0, 0.3], dvl_time_offset: 0.4,"
        " reference_velocity_offset: [0.05, 0.0]}}\n"
    )
    succeed(capsys, "export", "holoocean", tmp_path / "p.yaml", "-o", tmp_path / "dvl.json")
    sensor = json.loads((tmp_path / "dvl.json").read_text())
    assert sensor["location"] == [0.5, 0.0, -0.1] and sensor["rotation"][2] == pytest.approx(math.degrees(0.3))
    beside = json.loads((tmp_path / "dvl.json.missing.json").read_text())
    assert {each["name"] for each in beside["missing"]} == {"dvl_time_offset", "water_lock"}
    succeed(capsys, "simulate", tmp_path / "bag", "--duration", "10", "--diagnosis", tmp_path / "p.yaml")


@pytest.mark.parametrize(
    "content, said",
    [
        ("{}", "no diagnosis"),
        ('{"effects": [], "calibration": {}}', "older version"),
        ('{"effects": [', "no valid JSON"),
        ("hello", "neither a diagnosis"),
        (json.dumps(document(dvl={"sizes_mps": {}})), "damaged"),
        (json.dumps(document(effects=[{"name": "lever_arm"}])), "damaged"),
        (json.dumps(document(dvl={**document()["dvl"], "rate_hz": 0.0})), "rate_hz is 0"),
        (json.dumps(document(dvl={**document()["dvl"], "lever_arm_m": [1e999, 0, 0]})), "Infinity is not finite"),
        (json.dumps(document(dvl={**document()["dvl"], "speed_mps": [0, math.nan, 0]})), "NaN is not finite"),
        (json.dumps(document(dvl={**document()["dvl"], "rate_hz": 5.5})).replace("5.5", "1e400"), "1e400 is not"),
        (json.dumps(document(dvl={**document()["dvl"], "rate_hz": 10**400})), "damaged"),
    ],
)
def test_what_is_no_diagnosis_is_refused_in_one_line_and_nothing_is_written(content, said, tmp_path, capsys):
    path = tmp_path / "d.json"
    path.write_text(content)
    assert said in fail(capsys, "export", "gazebo", path, "-o", tmp_path / "dvl.sdf")
    assert [each.name for each in tmp_path.iterdir()] == ["d.json"]


def test_a_result_file_that_is_rejected_damaged_or_changed_is_not_exported(tmp_path, capsys):
    bag, saved = tmp_path / "bag", tmp_path / "r.yaml"
    succeed(capsys, "simulate", bag, "--trajectory", "straight", "--duration", "20", "--misalignment", 0, 0, 9)
    succeed(capsys, "replay", bag, "--save", saved)
    content = parsed(saved.read_text())
    assert content["verification"]["verdict"] == "reject"
    assert "its verdict is reject" in fail(capsys, "export", "gazebo", saved, "-o", tmp_path / "dvl.sdf")
    assert not (tmp_path / "dvl.sdf").exists()
    for part, key, value, said in (
        ("mounting", "corrected_rpy", [0.0, 0.0, 45.0], "changed by hand"),  # degrees
        ("parameters", "lever_arm", [1300.0, 0.0, 0.0], "1300 is outside"),  # millimetres
        ("verification", "verdict", "splendid", "splendid"),
    ):
        changed = copy.deepcopy(content)
        changed[part][key] = value
        (tmp_path / "changed.yaml").write_text(written(changed, sort_keys=False))
        assert said in fail(capsys, "export", "gazebo", tmp_path / "changed.yaml", "-o", tmp_path / "other.sdf")


def test_on_a_full_disk_neither_settings_nor_what_they_lack_are_written(diagnosis, tmp_path, capsys):
    with room_for(700):  # enough for the settings
        error = fail(capsys, "export", "holoocean", diagnosis, "-o", tmp_path / "dvl.json")
    assert "dvl.json.missing.json" in error and "free some space" in error
    assert [each.name for each in tmp_path.iterdir()] == [diagnosis.name]


@pytest.mark.slow
def test_the_diagnosis_of_a_bag_says_what_the_export_needs(tmp_path, capsys):
    succeed(capsys, "simulate", tmp_path / "bag", "--trajectory", "free", "--duration", "200", "--gnss-std", "0.02",
            "--waves", "0.3", "5", "--scale", "0.8", "--effect", "lever_arm:x_m=1.5", "--seed", "2")  # fmt: skip
    given_before = ("-p", "mounting_rpy:=[0.0,0.0,0.0]", "-p", "lever_arm:=[0.5,0.0,0.0]")
    succeed(capsys, "diagnose", tmp_path / "bag", "--json", tmp_path / "d.json", *given_before)
    found = load_description(tmp_path / "d.json")
    assert found.lever_arm == pytest.approx((1.5, 0.0, 0.0), abs=0.1)
    assert found.rate_hz == pytest.approx(5.0)
    assert found.noise_std == pytest.approx((0.0103, 0.0103, 0.0027), rel=0.1)
    assert found.scale[0] == pytest.approx(0.008, abs=0.002)
    # ω × l of the whole lever arm, not only of what was found on top
    sizes = json.loads((tmp_path / "d.json").read_text())["dvl"]["sizes_mps"]
    assert 0.05 < sizes["lever_arm"] < 0.3
    assert sizes["scale"] == pytest.approx(0.008 * found.speed[0], rel=0.25)


def test_repeated_samples_have_a_size(tmp_path, capsys):
    succeed(capsys, "simulate", tmp_path / "bag", "--trajectory", "free", "--duration", "120", "--waves", "0.5", "4",
            "--effect", "stale_samples:share=0.1")  # fmt: skip
    succeed(capsys, "diagnose", tmp_path / "bag", "--json", tmp_path / "d.json", "-p", "mounting_rpy:=[0.0,0.0,0.0]")
    stale = next(each for each in load_description(tmp_path / "d.json").others if each.name == "stale_samples")
    # the velocity changes by some centimetres per second from sample to sample; a tenth of them is missed
    assert 0.005 < stale.size < 0.1


def test_a_recording_without_an_imu_is_diagnosed_and_exported_with_the_lever_arm_that_was_given(tmp_path, capsys):
    succeed(capsys, "simulate", tmp_path / "bag", "--trajectory", "free", "--duration", "120", "--gnss-frame", "body",
            "--imu-rate", "0")  # fmt: skip
    given_before = ("-p", "mounting_rpy:=[0.0,0.0,0.0]", "-p", "lever_arm:=[0.5,0.0,0.0]", "-p", "dvl_time_offset:=0.1")
    succeed(capsys, "diagnose", tmp_path / "bag", "--json", tmp_path / "d.json", *given_before)
    found = load_description(tmp_path / "d.json")
    sizes = json.loads((tmp_path / "d.json").read_text())["dvl"]["sizes_mps"]
    assert found.lever_arm == (0.5, 0.0, 0.0) and "lever_arm" not in sizes
    assert 0.0 < sizes["dvl_time_offset"] < 0.2
    assert {"seconds": pytest.approx(0.1, abs=0.12)} in [each.parameters for each in found.others]


@pytest.mark.slow
def test_several_recordings_are_exported_as_the_first_and_what_the_others_have_is_listed(tmp_path, capsys):
    common = ("--trajectory", "free", "--duration", "240", "--gnss-std", "0.02", "--waves", "0.3", "5")
    for day, (yaw, late) in enumerate((("3", "0.2"), ("6", "0.7")), start=1):
        succeed(capsys, "simulate", tmp_path / f"day{day}", *common, "--misalignment", "0", "0", yaw, "--seed", day,
                "--effect", f"dvl_time_offset:seconds={late}", "--effect", "lever_arm:x_m=1")  # fmt: skip
    bags = [tmp_path / "day1", tmp_path / "day2"]
    succeed(capsys, "diagnose", *bags, "--json", tmp_path / "d.json", "-p", "mounting_rpy:=[0.0,0.0,0.0]")
    succeed(capsys, "export", "gazebo", tmp_path / "d.json", "-o", tmp_path / "dvl.sdf")
    rotation = Rotation.from_matrix(READERS["gazebo"](tmp_path / "dvl.sdf").rotation)
    assert rotation.as_euler("xyz", degrees=True)[2] == pytest.approx(3.0, abs=0.5)
    beside = {each["name"]: each for each in json.loads((tmp_path / "dvl.sdf.missing.json").read_text())["missing"]}
    assert "another recording" in beside["mounting_moved"]["says"]
    assert beside["dvl_time_offset"]["error_mps"] > 0.05
