"""Course and speed over ground, and a compass: what `import` makes of recordings that are horizontal only."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.calibration.numerics.frames import rotation_from_quaternion
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.logs.trajectories import names_columns, read_course, read_heading


def test_course_and_speed_become_a_velocity_without_a_vertical(tmp_path):
    path = tmp_path / "run_gnss.csv"
    path.write_text(
        "t_s,speed_over_ground_mps,course_over_ground_deg_true,latitude_deg\n1,2,90,52\n2,2,180,52\n3,,0,52\n"
    )
    assert names_columns(path, "speed", "course")
    notes: list[str] = []
    samples = read_course(path, 0, 0.1, notes)
    np.testing.assert_allclose([sample.velocity for sample in samples], [[2, 0, 0], [0, -2, 0]], atol=1e-12)
    assert all(sample.velocity[2] == 0.0 and sample.frame is VelocityFrame.ENU for sample in samples)
    assert "1 of 3 rows" in notes[0]


@pytest.mark.parametrize(
    ("header", "speed"), [("t,course [deg],speed [knots]", 1852 / 3600), ("t,course_rad,speed", 1.0)]
)
def test_units_stand_in_the_names_of_the_columns(tmp_path, header, speed):
    path = tmp_path / "run_gnss.csv"
    path.write_text(f"{header}\n1,{90 if 'deg' in header else math.pi / 2},1\n2,0,1\n")
    first, second = read_course(path, 0, 0.0, [])
    np.testing.assert_allclose(first.velocity, (speed, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(second.velocity, (0.0, speed, 0.0), atol=1e-12)
    assert first.covariance is None


@pytest.mark.parametrize("tilt", [True, False])
def test_a_heading_counts_from_north_and_to_the_right(tmp_path, tilt):
    path = tmp_path / "run_attitude.csv"
    rows = [f"{t},{90 + 2 * t}" + (",3,-2" if tilt else "") for t in range(20)]
    path.write_text("t_s,heading_deg_true" + (",pitch_deg,roll_deg" if tilt else "") + "\n" + "\n".join(rows) + "\n")
    samples = read_heading(path, 0, [])
    ahead = rotation_from_quaternion(np.array(samples[0].orientation))[:, 0]
    pitch = math.radians(3.0) if tilt else 0.0
    np.testing.assert_allclose(ahead, [math.cos(pitch), 0.0, math.sin(pitch)], atol=1e-12)  # east, bow up
    assert samples[9].angular_velocity[2] == pytest.approx(-math.radians(2.0), abs=1e-3)  # turns right


def test_a_folder_of_a_boat_with_a_compass_is_imported(tmp_path, capsys):
    folder = tmp_path / "boat"
    folder.mkdir()
    times = range(1, 40)
    (folder / "a_dvl.csv").write_text(
        "t_s,x_forward_mps,y_left_mps,z_up_mps\n" + "".join(f"{t},1,0,0\n" for t in times)
    )
    (folder / "a_gnss.csv").write_text("t_s,speed_mps,course_deg\n" + "".join(f"{t},1,{2 * t}\n" for t in times))
    (folder / "a_attitude.csv").write_text("t_s,heading_deg\n" + "".join(f"{t},{2 * t}\n" for t in times))
    assert main(["import", str(folder), "-o", str(tmp_path / "bags"), "--frame", "flu"]) == 0
    assert "39 dvl/twist, 39 gnss/twist, 39 imu/data" in capsys.readouterr().out


@pytest.mark.parametrize(
    "content", ["t_s,speed,course\n", "t_s,speed,course\n2,1,0\n1,1,0\n", "t_s,speed,course\n1,1\n"]
)
def test_a_file_that_cannot_be_read_is_refused_by_name(tmp_path, content):
    path = tmp_path / "run_gnss.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=r"run_gnss\.csv"):
        read_course(path, 0, 0.0, [])
