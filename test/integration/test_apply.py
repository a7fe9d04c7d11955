"""A saved calibration in URDF, TF and robot_localization: what is meant is written, and nothing else."""

from __future__ import annotations

import heapq
import math
import re
import shlex
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import room_for
from io_fixtures import replayed, run, selected_alone, write_bag
from scipy.spatial.transform import Rotation
from yaml_text import parsed, written

import dvl_calib_ros as dc
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.own import DELAY, LEVER_ARM
from dvl_calib_ros.calibration.numerics.error_model import distort
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import printable
from dvl_calib_ros.files.mounting import load_calibrated_mounting, scale_advice
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.files.result_file import load_initial_calibration, result_document, result_text
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.scenario import write_bag as write_scenario
from dvl_calib_ros.simulation.sensors import DvlErrors

DVL_AT = (0.622423073, -0.0147556543, 0.238813905)  # in the URDF
MOUNTING = (0.1, -0.2, 0.7)
CHAIN = (0.3, 0.2, -1.1)  # of the frame that carries the DVL, in the body
ODD = """<?xml version='1.0' encoding='UTF-8'?>\r
<robot name="auv" xmlns:xacro="http://www.ros.org/wiki/xacro">\r
  <!-- <joint name="dvl_joint" type="fixed"><origin rpy="9 9 9"/></joint> > é -->
\t<link name="base_link"/><link   name="frame"/><link name="dvl_link"><visual><origin rpy="1 2 3"/></visual></link>
  <joint name="frame_joint" type="fixed">
    <parent link="base_link"/><child link="frame"/><origin rpy="{chain}" xyz="0.5 0 -0.1"/>
  </joint>
  <joint type='fixed' name='dvl_joint'><calibration note="rpy='1 1 1' > 0"/>
    <origin
        {rpy}   xyz='0 0.2 0.3' />
    <parent link="frame"/><child link="dvl_link"/></joint>
  <transmission name="t"><joint name="dvl_joint"/></transmission>
</robot>
"""


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A bag and its calibration."""
    bag = tmp_path_factory.mktemp("apply") / "bag"
    errors = DvlErrors((0.02, -0.03, 0.05), (0.004,) * 3, beam_std=0.002)
    scenario = Scenario("box", 120.0, imu_rate=20, errors=errors, mounting_rpy=MOUNTING, gnss_std=0.01)
    write_scenario(scenario, bag, Storage.MCAP, Compression.NONE)
    return bag, replayed(bag, mounting_rpy=MOUNTING, dvl_position="told", reference_position=DVL_AT).result


@pytest.fixture(scope="module")
def saved_text(result) -> str:
    return selected_alone(result[1])


@pytest.fixture
def saved(tmp_path, saved_text) -> Path:
    (tmp_path / "result.yaml").write_text(saved_text)
    return tmp_path / "result.yaml"


def change(path: Path, result, turned: bool = False, **changes) -> Path:
    """The result file with other values at the top of its document."""
    path.write_text(result_text({**result_document(result, turned=turned), **changes}))
    return path


def corrected(saved: Path) -> Rotation:
    return Rotation.from_euler("xyz", parsed(saved.read_text())["mounting"]["corrected_rpy"])


def words(values) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def robot(path: Path, text: str = ODD, mounting=MOUNTING) -> Path:
    """A URDF whose DVL is mounted so in the body, by way of a frame that is turned itself."""
    local = (Rotation.from_euler("xyz", CHAIN).inv() * Rotation.from_euler("xyz", mounting)).as_euler("xyz")
    path.write_bytes(text.format(chain=words(CHAIN), rpy=f"rpy = '{words(local)}'").encode())
    return path


def mounted(path: Path) -> Rotation:
    """Rotation of the DVL in the body by an oracle's reading of a URDF."""
    joints = ElementTree.parse(path).getroot().findall("joint")
    turns = {joint.get("name"): joint.find("origin").get("rpy") for joint in joints}
    chain = [
        Rotation.from_euler("xyz", [float(w) for w in turns[name].split()]) for name in ("frame_joint", "dvl_joint")
    ]
    return chain[0] * chain[1]


def apply(*arguments) -> int:
    return main(["apply", *map(str, arguments)])


def refused(capsys, *arguments) -> str:
    assert apply(*arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def difference(a: Rotation, b: Rotation) -> float:
    return float((a.inv() * b).magnitude())


# ---------------------------------------------------------------- URDF


def test_the_urdf_has_the_corrected_mounting_and_every_other_byte_as_before(tmp_path, saved, capsys):
    urdf = robot(tmp_path / "robot.urdf")
    before = urdf.read_bytes()
    assert difference(mounted(urdf), corrected(saved)) > math.radians(1.0)
    assert apply(saved, "--urdf", urdf) == 0
    assert difference(mounted(urdf), corrected(saved)) < 1e-8
    spans = [re.search(rb"rpy = '([^']*)'", content).span(1) for content in (before, urdf.read_bytes())]
    (first, last), (_, new_last) = spans
    assert before[:first] == urdf.read_bytes()[:first]
    assert before[last:] == urdf.read_bytes()[new_last:]
    after = urdf.read_bytes()
    assert apply(saved, "--urdf", urdf) == 0 and "already up to date" in capsys.readouterr().out
    assert (urdf.read_bytes(), (tmp_path / "robot.urdf.bak").read_bytes()) == (after, before)


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ("", '<joint type="fixed" name="j"><origin xyz="0 0 0" rpy="{}"/><parent'),
        ("<origin/>", '<origin rpy="{}"/>'),
        ("<origin xyz='1 2 3' />", "<origin xyz='1 2 3' rpy=\"{}\"/>"),
        ('<origin rpy="0 0 0"></origin>', '<origin rpy="{}"></origin>'),
        ("<origin\n\trpy='0  0\n0'\n/>", "<origin\n\trpy='{}'\n/>"),
    ],
)
def test_an_origin_may_be_written_in_any_way(tmp_path, result, origin, expected):
    _, found = result
    document = result_document(found)
    rpy = words(Rotation.from_euler("xyz", document["mounting"]["corrected_rpy"]).as_euler("xyz"))
    joint = f'<joint type="fixed" name="j"><parent link="base_link"/>{origin}<child link="dvl_link"/></joint>'
    urdf = tmp_path / "r.urdf"
    urdf.write_text(f"\ufeff<robot>{joint}</robot>")
    assert apply(change(tmp_path / "r.yaml", found), "--urdf", urdf, "--force", "--keep-position") == 0
    text = urdf.read_text()
    written = [float(word) for word in re.search(r"rpy=['\"]([^'\"]*)", text)[1].split()]
    assert written == pytest.approx([float(word) for word in rpy.split()], abs=1e-8)
    assert expected.format(" ".join(f"{value:.9g}" for value in written)) in text
    assert ElementTree.fromstring(text.removeprefix("\ufeff")).tag == "robot"


def test_a_urdf_whose_dvl_is_elsewhere_than_was_told_is_refused(tmp_path, result, capsys):
    """The same joint of another vehicle, or of yesterday's: a lever arm that is taken for granted must not be two."""
    parameters = result[1].parameters | {"reference_position": [0.9, 0.0, 0.2]}
    path = change(tmp_path / "r.yaml", replace(result[1], parameters=parameters))
    urdf = robot(tmp_path / "robot.urdf")
    before = urdf.read_bytes()
    assert "has the DVL at 0.622423073 -0.0147556543 0.238813905" in (said := refused(capsys, path, "--urdf", urdf))
    assert "began with 0.9 0 0.2 and found 0.9 0 0.2; --keep-position" in said and urdf.read_bytes() == before
    assert apply(path, "--urdf", urdf, "--keep-position") == 0


@pytest.mark.parametrize("key, value", [("lever_arm", [0.5, 0.0, 0.0]), ("position", [0.5, 0.0, 0.0])])
def test_a_result_that_says_two_lever_arms_is_refused(tmp_path, result, capsys, key, value):
    mounting = result_document(result[1])["mounting"] | {key: value}
    path = change(tmp_path / "r.yaml", result[1], mounting=mounting)
    assert "does not follow from its states; was it changed by hand" in refused(
        capsys, path, "--launch", tmp_path / "l"
    )
    path = change(tmp_path / "r.yaml", result[1], mounting=mounting | {key: "x"})
    assert "damaged, or of another version" in refused(capsys, path, "--launch", tmp_path / "l")


def test_a_result_of_two_frames_is_refused(tmp_path, result, capsys):
    found = replace(result[1], parameters=result[1].parameters | {"dvl_frame": "dvl_a"})
    mounting = result_document(found)["mounting"] | {"child_frame_id": "dvl_b"}
    path = change(tmp_path / "r.yaml", found, mounting=mounting)
    assert "mounting is for frame 'dvl_b', parameters for 'dvl_a'" in refused(capsys, path, "--launch", tmp_path / "l")


def test_a_calibration_that_starts_from_the_applied_urdf_finds_nothing_more(tmp_path, result, saved, capsys):
    bag, found = result
    urdf, parameters = robot(tmp_path / "robot.urdf"), tmp_path / "vehicle.yaml"
    assert apply(saved, "--urdf", urdf) == 0
    capsys.readouterr()
    assert main(["parameters", "--urdf", str(urdf)]) == 0
    parameters.write_text(capsys.readouterr().out)
    assert load_parameters(parameters).base_frame == "base_link"
    again = replayed(bag, mounting_rpy=load_parameters(parameters).mounting_rpy).result
    assert np.linalg.norm(found.estimate.misalignment) > 0.05
    assert np.linalg.norm(again.estimate.misalignment) < 0.003
    text = parameters.read_text().replace("# lever_arm", "lever_arm")
    parameters.write_text(text)
    frame = Rotation.from_euler("xyz", CHAIN).apply([0.0, 0.2, 0.3])
    assert load_parameters(parameters).lever_arm == pytest.approx(np.array([0.5, 0.0, -0.1]) + frame, abs=1e-8)


@pytest.mark.parametrize("urdf_has", ["the calibrated axes", "the driver's own frame"])
def test_of_a_driver_that_points_down_the_urdf_keeps_its_axes_and_the_transform_is_the_drivers(
    tmp_path, result, capsys, urdf_has
):
    saved = change(tmp_path / "result.yaml", result[1], turned=True)
    flip = Rotation.from_euler("x", math.pi)
    axes = flip if urdf_has == "the driver's own frame" else Rotation.identity()
    path = robot(tmp_path / "robot.urdf", mounting=(Rotation.from_euler("xyz", MOUNTING) * axes).as_euler("xyz"))
    assert apply(saved, "--urdf", path) == 0
    assert difference(mounted(path), corrected(saved) * axes) < 1e-8  # nine digits are written
    line = parsed(saved.read_text())["mounting"]["static_transform_publisher"]
    assert line in capsys.readouterr().out
    given = shlex.split(line)
    quaternion = [float(given[given.index(f"--q{axis}") + 1]) for axis in "xyzw"]
    assert difference(Rotation.from_quat(quaternion), corrected(saved) * flip) < 1e-8


def test_a_urdf_of_another_mounting_is_refused_unless_forced(tmp_path, saved, capsys):
    urdf = robot(tmp_path / "robot.urdf", mounting=(0.1, -0.2, 0.9))
    before = urdf.read_bytes()
    error = refused(capsys, saved, "--urdf", urdf)
    assert "0.1 -0.2 0.9" in error and "0.1 -0.2 0.7" in error and "--force" in error
    assert urdf.read_bytes() == before
    assert apply(saved, "--urdf", urdf, "--force") == 0
    assert difference(mounted(urdf), corrected(saved)) < 1e-8


def test_another_file_leaves_the_urdf_as_it_is_and_without_a_lever_arm_the_position(tmp_path, saved):
    urdf = robot(tmp_path / "robot.urdf")
    before = urdf.read_bytes()
    assert apply(saved, "--urdf", urdf, "-o", tmp_path / "new.urdf") == 0
    assert urdf.read_bytes() == before and not (tmp_path / "robot.urdf.bak").exists()
    np.testing.assert_array_equal(place(tmp_path / "new.urdf"), place(urdf))
    assert difference(mounted(tmp_path / "new.urdf"), corrected(saved)) < 1e-8


@pytest.mark.parametrize(
    ("change_text", "said"),
    [
        (("type='fixed'", "type='revolute'"), "joint dvl_joint between base_link and the DVL is revolute"),
        (('<link   name="frame"/>', '<xacro:dvl parent="frame"/>'), "r.urdf:4: holds xacro macros (xacro:dvl)"),
        (("xyz='0 0.2 0.3'", "xyz='0 ${y} 0.3'"), "holds a xacro expression"),
        (("xyz='0 0.2 0.3'", "xyz='0 0.2'"), "is not three numbers"),
        (('<parent link="frame"/>', '<parent link="dvl_link"/>'), "joint dvl_joint is its own ancestor"),
        (('<child link="dvl_link"/>', '<child link="dvl"/>'), "no joint above link 'dvl_link'; name the DVL's joint"),
        (
            ('<parent link="base_link"/>', '<parent link="hull"/>'),
            "no joint above link 'hull'; joint dvl_joint does not",
        ),
        (("<robot ", "<!DOCTYPE robot><robot "), "document type declaration"),
        (("</robot>", ""), "not valid XML"),
        (("encoding='UTF-8'", "encoding='klingon'"), "not valid XML: unknown encoding: klingon"),
        (("encoding='UTF-8'", "encoding='utf-7'"), "not valid XML: multi-byte encodings"),
        (("<robot ", "<sdf "), "not a URDF"),
    ],
)
def test_what_cannot_be_edited_is_refused_in_one_line_and_left_alone(tmp_path, saved, capsys, change_text, said):
    urdf = robot(tmp_path / "r.urdf")
    text = urdf.read_bytes().decode().replace(*change_text)
    if "sdf" in change_text[1]:
        text = text.replace("</robot>", "</sdf>")
    urdf.write_bytes(text.encode())
    assert said in refused(capsys, saved, "--urdf", urdf, "--launch", tmp_path / "l.xml")
    assert urdf.read_bytes() == text.encode()
    assert not (tmp_path / "l.xml").exists()


def test_a_joint_is_found_by_name_and_a_wrong_name_lists_those_there_are(tmp_path, saved, capsys):
    urdf = robot(tmp_path / "r.urdf", ODD.replace('"dvl_link"', '"a50"'))
    assert "its fixed joints: frame_joint, dvl_joint" in refused(capsys, saved, "--urdf", urdf, "--joint", "dvl")
    assert apply(saved, "--urdf", urdf, "--joint", "dvl_joint") == 0
    assert difference(mounted(urdf), corrected(saved)) < 1e-8


# ---------------------------------------------------------------- TF, fusion


def test_the_launch_file_publishes_the_corrected_mounting(tmp_path, saved):
    assert apply(saved, "--launch", tmp_path / "tf.launch.xml") == 0
    node = ElementTree.parse(tmp_path / "tf.launch.xml").getroot().find("node")
    assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
    arguments = shlex.split(node.get("args"))
    given = dict(zip(arguments[::2], arguments[1::2], strict=True))
    quaternion = [float(given[f"--{name}"]) for name in ("qx", "qy", "qz", "qw")]
    assert difference(Rotation.from_quat(quaternion), corrected(saved)) < 1e-8
    assert (given["--frame-id"], given["--child-frame-id"]) == ("base_link", "dvl_link")


def test_a_frame_name_from_a_bag_cannot_make_a_launch_file_run_something(tmp_path, result, capsys):
    document = result_document(result[1], "$(command touch)")
    path = change(tmp_path / "r.yaml", result[1], mounting=document["mounting"])
    assert "cannot be used in a launch file" in refused(capsys, path, "--launch", tmp_path / "l.xml")
    assert not (tmp_path / "l.xml").exists()


@pytest.mark.parametrize("name", ["DVL A50", "dvl/'é'", "a\u2028b: c\n# d"])
def test_a_frame_of_any_name_that_was_saved_is_taken_by_what_reads_it(tmp_path, result, name):
    """A50s are 'DVL A50' to some drivers: what is calibrated with that name can be used."""
    path = change(tmp_path / "r.yaml", result[1], mounting=result_document(result[1], name)["mounting"])
    assert apply(path, "--launch", tmp_path / "l.xml", "--fusion", tmp_path / "fusion.yaml") == 0
    arguments = shlex.split(ElementTree.parse(tmp_path / "l.xml").getroot().find("node").get("args"))
    assert arguments[arguments.index("--child-frame-id") + 1] == printable(name)
    assert load_parameters(tmp_path / "fusion.yaml").model == result[1].selected


def test_the_fusion_file_makes_the_node_publish_what_was_calibrated(tmp_path, saved, result):
    target = tmp_path / "fusion.yaml"
    assert apply(saved, "--fusion", target) == 0
    content = parsed(target.read_text())
    localization = content["ekf_filter_node"]["ros__parameters"]
    assert [i for i, used in enumerate(localization["twist0_config"]) if used] == [6, 7, 8]
    assert len(localization["twist0_config"]) == 15 and localization["twist0"] == "/dvl_calibration/calibrated_twist"
    parameters = load_parameters(target)  # our node's part, as the node reads it
    assert parameters.result_file == ""
    initial = load_initial_calibration(Path(parameters.initial_calibration), parameters.mounting_rpy)
    estimate = Calibrator(parameters, initial=initial).estimate()
    selected = result[1].estimate
    kept = np.arange(6)  # beside them a constant error of the reference, which is of the day
    np.testing.assert_allclose(estimate.state[kept], selected.state[kept], rtol=1e-9)
    np.testing.assert_allclose(estimate.covariance[:6, :6], selected.covariance[:6, :6], rtol=1e-9)
    np.testing.assert_allclose(estimate.recording_std[:6], selected.recording_std[:6], rtol=1e-9)


def test_the_advised_speed_of_sound_takes_the_scale_error_out(saved):
    calibrated = load_calibrated_mounting(saved)
    factor = float(re.search(r"sound by ([\d.]+)", scale_advice(calibrated))[1])
    t = calibrated.parameters.rotation_dvl_from_body
    ahead = np.array([2.0, 0.0, 0.0])
    measured = distort(ahead, np.zeros(3), calibrated.scale, t)
    assert abs(measured @ t[:, 0] / 2.0 - 1.0) > 1e-3
    assert factor * measured @ t[:, 0] == pytest.approx(2.0, abs=2e-5)


# ---------------------------------------------------------------- verdict, files, rollback


def test_a_rejected_calibration_is_applied_only_by_force_and_says_so(tmp_path, result, capsys):
    verification = {"verdict": "reject", "reasons": ["the misalignment is 6.0°"], "held_out": None}
    path = change(tmp_path / "r.yaml", result[1], verification=verification)
    error = refused(capsys, path, "--launch", tmp_path / "l.xml")
    assert "its verdict is reject: the misalignment is 6.0°" in error and "--force" in error
    assert apply(path) == 0  # only shows
    assert apply(path, "--launch", tmp_path / "l.xml", "--force") == 0
    assert "verdict is reject" in capsys.readouterr().err
    assert (tmp_path / "l.xml").exists()


def test_a_calibration_that_has_seen_nothing_is_not_applied(tmp_path, capsys):
    samples = [
        sample._replace(velocity=(0.0, 0.0, 0.0)) if hasattr(sample, "velocity") else sample for sample in run(5.0)
    ]
    nothing = replayed(write_bag(tmp_path / "bag", samples)).result
    path = change(tmp_path / "r.yaml", nothing)
    assert "collecting" in refused(capsys, path, "--launch", tmp_path / "l.xml")


def test_what_the_data_has_not_shown_or_verified_is_said(tmp_path, saved, capsys):
    assert apply(saved) == 0
    assert "its convergence is coarse" in capsys.readouterr().err
    document = parsed(saved.read_text())
    del document["verification"]  # as the node writes it
    saved.write_text(written(document))
    assert apply(saved) == 0
    assert "not verified on held-out data" in capsys.readouterr().err
    write_scenario(Scenario("straight", 30.0, imu_rate=20), tmp_path / "bag", Storage.MCAP, Compression.NONE)
    assert apply(change(tmp_path / "straight.yaml", replayed(tmp_path / "bag").result)) == 0
    assert "phi_x (roll) was not observable in the data" in capsys.readouterr().err


def test_rollback_brings_every_file_back_and_a_second_one_undoes_that(tmp_path, saved, capsys):
    urdf, launch = robot(tmp_path / "robot.urdf"), tmp_path / "l.xml"
    launch.write_text("mine")
    files = ["--urdf", urdf, "--launch", launch]
    before = [path.read_bytes() for path in (urdf, launch)]
    assert apply(saved, *files) == 0
    after = [path.read_bytes() for path in (urdf, launch)]
    assert apply("--rollback", *files) == 0
    assert [path.read_bytes() for path in (urdf, launch)] == before != after
    assert apply("--rollback", *files) == 0
    assert [path.read_bytes() for path in (urdf, launch)] == after


@pytest.mark.parametrize("room", [100, 500, 2000])
def test_on_a_full_disk_all_files_are_as_before_or_all_are_written(tmp_path, saved, capsys, room):
    """A URDF that is turned beside parameters that are not turns the DVL twice, or not at all."""
    urdf, params, fusion = robot(tmp_path / "robot.urdf"), tmp_path / "p.yaml", tmp_path / "f.yaml"
    params.write_text("/**:\n  ros__parameters:\n    min_speed: 0.2\n" + "# a long story\n" * 300)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with room_for(room + len(before["robot.urdf"])):
        assert apply(saved, "--urdf", urdf, "--params", params, "--fusion", fusion) == 2
    shown, error = capsys.readouterr()
    assert "p.yaml: could not be written" in error and "free some space" in error and "written" not in shown
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_rollback_touches_nothing_when_one_file_has_no_backup(tmp_path, saved, capsys):
    urdf = robot(tmp_path / "robot.urdf")
    assert apply(saved, "--urdf", urdf, "--fusion", tmp_path / "f.yaml") == 0
    after = urdf.read_bytes()
    capsys.readouterr()
    assert "f.yaml.bak: cannot be read" in refused(
        capsys, "--rollback", "--urdf", urdf, "--fusion", tmp_path / "f.yaml"
    )
    assert urdf.read_bytes() == after


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--urdf", "r.urdf"], "name a result file"),
        (["missing.yaml"], "missing.yaml: no such result file"),
        (["result.yaml", "--fusion", "result.yaml"], "would write over the input result.yaml"),
        (["result.yaml", "--fusion", "x", "--launch", "x"], "a name of its own"),
        (["result.yaml", "--urdf", "missing.urdf"], "missing.urdf: no such URDF"),
        (["result.yaml", "-o", "x"], "need --urdf"),
        (["result.yaml", "--joint", "x"], "need --urdf"),
        (["result.yaml", "--launch", "missing/x"], "missing does not exist; create it"),
        (["--rollback"], "name the files again"),
    ],
)
def test_bad_options_are_refused_in_one_line(saved, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(saved.parent)
    assert said in refused(capsys, *arguments)
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


@pytest.mark.parametrize(
    "damage",
    [
        {"model": "M99"},
        {"model": []},
        {"mounting": None},
        {"mounting": {"corrected_rpy": [0, 0, 0], "frame_id": "a", "child_frame_id": "b"}},
        {"mounting": {"corrected_rpy": [0, "x"], "frame_id": "a", "child_frame_id": "b"}},
        {"parameters": {"min_speed": -1}},
        {"parameters": []},
        {"verification": {"verdict": "splendid", "reasons": []}},
        {"verification": {"verdict": "reject", "reasons": []}},
        {"verification": []},
        {"models": {"full": 3}},
    ],
)
def test_a_damaged_result_is_refused(tmp_path, result, capsys, damage):
    assert "r.yaml" in refused(capsys, change(tmp_path / "r.yaml", result[1], **damage))


# ---------------------------------------------------------------- lever arm and delay


@pytest.fixture(scope="module")
def displaced(tmp_path_factory):
    """A bag of a DVL that is turned, off the reference point and late, and what a calibration makes of it as it is."""
    bag = tmp_path_factory.mktemp("displaced") / "bag"
    scenario = Scenario(
        "figure8", 160.0, imu_rate=20, errors=DvlErrors((0.0, 0.01, 0.03), beam_std=0.005), gnss_std=0.02,
        effects=(injection("lever_arm:x_m=-1.2,y_m=0.3,z_m=-0.2"), injection("dvl_time_offset:seconds=0.6")),
    )  # fmt: skip
    write_scenario(scenario, bag, Storage.MCAP, Compression.NONE)
    return bag, replayed(bag, dvl_position="from_reference").result


def test_what_a_bare_bag_shows_is_applied_as_parameters_and_nothing_is_left(tmp_path, displaced, capsys):
    bag, found = displaced
    saved, parameters = change(tmp_path / "result.yaml", found), tmp_path / "vehicle.yaml"
    assert found.selected == "full"
    parameters.write_text("/**:\n  ros__parameters:\n    # by hand\n    mounting_rpy: [0.0, 0.0, 0.0]\n")
    before = parameters.read_bytes()
    assert apply(saved, "--params", parameters) == 0
    assert "s late against the IMU's in this recording" in capsys.readouterr().out
    written = load_parameters(parameters)
    mounting = parsed(saved.read_text())["mounting"]
    assert written.dvl_time_offset == pytest.approx(mounting["dvl_time_offset"], abs=1e-8)
    assert written.lever_arm == pytest.approx(mounting["lever_arm"], abs=1e-8)
    assert "# by hand" in parameters.read_text()
    again = replayed(bag, **{name: getattr(written, name) for name in ("mounting_rpy", "lever_arm", "dvl_time_offset")})
    assert again.result.selected == "full"
    rest = again.result.estimates["full"]
    assert (
        np.linalg.norm(found.estimate.lever_arm((0.0, 0.0, 0.0))[:2]) > 1.0
        and abs(found.estimate.dvl_time_offset(0.0)) > 0.5
    )
    beyond = [*range(*LEVER_ARM.indices(len(rest.state))), DELAY]
    assert np.all(np.abs(rest.state[beyond]) < np.minimum(2.0 * rest.std[beyond], [0.03, 0.03, 0.1, 0.03]))
    assert np.linalg.norm(again.result.estimate.misalignment[1:]) < 0.003
    # once more changes nothing, and the way back leads to what was there
    assert apply(saved, "--params", parameters) == 0
    assert "already up to date" in capsys.readouterr().out
    assert apply("--rollback", "--params", parameters) == 0
    assert parameters.read_bytes() == before


def test_a_parameter_file_is_made_where_there_is_none_and_refused_where_it_says_another_thing(
    tmp_path, displaced, capsys
):
    saved, parameters = change(tmp_path / "result.yaml", displaced[1]), tmp_path / "vehicle.yaml"
    assert apply(saved, "--params", parameters) == 0
    assert load_parameters(parameters).lever_arm[0] == pytest.approx(-1.2, abs=0.05)
    parameters.write_text("/**: {ros__parameters: {dvl_time_offset: 0.1}}\n")
    capsys.readouterr()
    assert "dvl_time_offset to 0.1" in refused(capsys, saved, "--params", parameters)
    assert apply(saved, "--params", parameters, "--force") == 0
    assert load_parameters(parameters).dvl_time_offset == pytest.approx(0.6, abs=0.05)
    parameters.write_text(f"/**: {{ros__parameters: {{initial_calibration: {saved}}}}}\n")
    capsys.readouterr()
    assert "initial_calibration" in refused(capsys, saved, "--params", parameters, "--force")


def place(path: Path) -> np.ndarray:
    """Position of the DVL in the body by an oracle's reading of a URDF."""
    joints = {each.get("name"): each.find("origin") for each in ElementTree.parse(path).getroot().findall("joint")}
    at = {name: [float(word) for word in origin.get("xyz").split()] for name, origin in joints.items()}
    turn = Rotation.from_euler("xyz", [float(word) for word in joints["frame_joint"].get("rpy").split()])
    return np.array(at["frame_joint"]) + turn.apply(at["dvl_joint"])


def test_the_joint_is_moved_to_the_lever_arm_that_was_found(tmp_path, displaced, capsys):
    saved, urdf = change(tmp_path / "result.yaml", displaced[1]), robot(tmp_path / "robot.urdf", mounting=(0, 0, 0))
    frame = Rotation.from_euler("xyz", CHAIN)
    at_reference = words(frame.inv().apply([-0.5, 0.0, 0.1]))
    before = urdf.read_bytes().replace(b"0 0.2 0.3", at_reference.encode())
    urdf.write_bytes(before)
    np.testing.assert_allclose(place(urdf), 0.0, atol=1e-9)
    assert apply(saved, "--urdf", urdf) == 0
    found = parsed(saved.read_text())["mounting"]["lever_arm"]
    np.testing.assert_allclose(place(urdf), found, atol=1e-8)
    assert difference(mounted(urdf), corrected(saved)) < 1e-8
    after = urdf.read_bytes()
    assert apply(saved, "--urdf", urdf) == 0
    assert urdf.read_bytes() == after
    assert apply("--rollback", "--urdf", urdf) == 0
    assert urdf.read_bytes() == before


def test_python_and_the_terminal_paste_the_origin_that_apply_writes(tmp_path, displaced, capsys):
    bag, _ = displaced
    saved = tmp_path / "result.yaml"
    assert main(["replay", str(bag), "-p", "dvl_position:=from_reference", "--save", str(saved)]) == 0
    mounting = dc.replay(bag, dvl_position="from_reference").mounting
    assert mounting.urdf in capsys.readouterr().out
    document = parsed(saved.read_text())["mounting"]
    np.testing.assert_allclose(mounting.xyz_m, document["lever_arm"], atol=1e-12)
    np.testing.assert_allclose(mounting.position_m, document["position"], atol=1e-12)
    assert mounting.xyz_m[0] == pytest.approx(-1.2, abs=4.0 * mounting.xyz_std_m[0]) and mounting.xyz_std_m[0] < 0.1
    assert mounting.time_offset_s == document["dvl_time_offset"] == pytest.approx(0.6, abs=0.05)
    assert mounting.time_offset_std_s == document["dvl_time_offset_std"]
    pasted = ElementTree.fromstring(mounting.urdf)
    np.testing.assert_allclose([float(word) for word in pasted.get("xyz").split()], document["lever_arm"], atol=1e-3)
    turned = Rotation.from_euler("xyz", [float(word) for word in pasted.get("rpy").split()])
    assert difference(turned, Rotation.from_euler("xyz", document["corrected_rpy"])) < 2e-6


def test_of_a_driver_that_is_forward_right_down_both_origins_are_said(tmp_path, capsys):
    samples = simulate(Scenario("figure8", 60.0, mounting_rpy=(math.pi, 0.0, 0.0)))
    ordered = heapq.merge(samples.imu, samples.gnss, samples.dvl, key=lambda sample: sample.stamp_ns)
    bag, saved = write_bag(tmp_path / "bag", tuple(ordered)), tmp_path / "result.yaml"
    assert main(["replay", str(bag), "-p", "dvl_axes:=frd", "-p", "dvl_position:=told", "--save", str(saved)]) == 0
    out = capsys.readouterr().out
    ours, drivers = [
        Rotation.from_euler("xyz", [float(word) for word in rpy.split()])
        for rpy in re.findall(r'<origin xyz="[^"]*" rpy="([^"]*)"/>', out)
    ]
    assert "(forward-left-up axes)" in out and "of the driver: forward-right-down)" in out
    document = parsed(saved.read_text())["mounting"]
    assert difference(ours, Rotation.from_euler("xyz", document["corrected_rpy"])) < 2e-6
    words_of = re.search(
        r"--qx (\S+) --qy (\S+) --qz (\S+) --qw (\S+)", document["static_transform_publisher"]
    ).groups()
    assert difference(drivers, Rotation.from_quat([float(word) for word in words_of])) < 2e-6


def test_a_urdf_with_another_position_is_moved_by_force_only_or_turned_alone(tmp_path, displaced, capsys):
    saved, urdf = change(tmp_path / "result.yaml", displaced[1]), robot(tmp_path / "robot.urdf", mounting=(0, 0, 0))
    there = place(urdf)
    error = refused(capsys, saved, "--urdf", urdf)
    assert "began with 0 0 0" in error and "--keep-position" in error
    assert apply(saved, "--urdf", urdf, "--keep-position") == 0
    np.testing.assert_allclose(place(urdf), there, atol=1e-12)
    assert difference(mounted(urdf), corrected(saved)) < 1e-8
    assert apply(saved, "--urdf", urdf, "--force") == 0
    np.testing.assert_allclose(place(urdf), parsed(saved.read_text())["mounting"]["lever_arm"], atol=1e-8)
