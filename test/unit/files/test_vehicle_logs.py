"""Logs of an autopilot, a DVL's own attitude and a receiver's NMEA become the bag that they recorded."""

from __future__ import annotations

import math

import numpy as np
import pytest
from command_line import fail, succeed
from log_fixtures import START_S, dataflash, pd0, rmc, telemetry

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.frames import rotation_from_quaternion
from dvl_calib_ros.files.dvl_logs import is_dvl_log, read_dvl_log
from dvl_calib_ros.files.nmea import read_rmc

KNOT = 1852.0 / 3600.0


@pytest.mark.parametrize("write", [telemetry, dataflash])
def test_a_log_of_the_autopilot_is_dvl_gnss_and_attitude(write, tmp_path, capsys):
    pytest.importorskip("pymavlink", reason="needs the extra ardupilot")
    path = write(tmp_path / ("dive.tlog" if write is telemetry else "00000012.BIN"))
    assert is_dvl_log(path)
    log = read_dvl_log(path)
    assert len(log.samples) == 35 and log.left_out["without bottom lock"] == 5
    np.testing.assert_allclose([each.velocity for each in log.samples], [[1.5, -0.2, 0.1]] * 35, atol=1e-6)
    # the mean over its interval is of the middle of it
    assert log.samples[0].stamp_ns == pytest.approx((START_S + 0.05) * 1e9, abs=2e7)
    expected = [[0.0, 1.5, 0.0]] * 19 if write is telemetry else [[0.0, 1.5, 0.02]] * 20
    np.testing.assert_allclose([each.velocity for each in log.references], expected, atol=1e-6)
    assert len(log.attitudes) == 40
    rotation = rotation_from_quaternion(log.attitudes[0].orientation)
    heading = 0.5 * math.pi - math.atan2(rotation[1, 0], rotation[0, 0])
    assert heading == pytest.approx(0.5, abs=2e-3)
    assert log.attitudes[20].angular_velocity[2] == pytest.approx(-0.1, abs=0.02)  # to starboard, about up
    succeed(capsys, "import", path, "-o", tmp_path / "bag")
    with BagReader([tmp_path / "bag"]) as bag:
        assert {"/dvl/twist", "/gnss/twist", "/imu/data"} <= {f"/{name.strip('/')}" for name in bag.topics}


def test_of_a_telemetry_log_one_vehicle_is_read(tmp_path):
    pytest.importorskip("pymavlink", reason="needs the extra ardupilot")
    log = read_dvl_log(telemetry(tmp_path / "two.tlog", other=True))
    assert len(log.samples) == 35 and log.left_out["of another vehicle"] == 100


def test_a_cut_or_holed_log_gives_what_is_whole_without_a_word_of_each_byte(tmp_path, capfd):
    pytest.importorskip("pymavlink", reason="needs the extra ardupilot")
    whole = dataflash(tmp_path / "whole.BIN").read_bytes()
    cut, noise = tmp_path / "cut.BIN", tmp_path / "noise.BIN"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    assert 15 < len(read_dvl_log(cut).samples) < 30
    cut.write_bytes(whole[: len(whole) // 2] + b"\0" * 500 + whole[len(whole) // 2 :])
    assert len(read_dvl_log(cut).samples) >= 33 and capfd.readouterr() == ("", "")
    noise.write_bytes(whole[:2] + b"\0" * 4000)
    assert "no velocity that can be used" in fail(capfd, "import", noise, "-o", tmp_path / "bag")


def test_the_attitude_in_pd0_is_written_and_said_to_be_the_dvls_own(tmp_path, capsys):
    path = tmp_path / "dive.pd0"
    path.write_bytes(b"".join(pd0(i, 4500 + 10 * i, 200, -300) for i in range(20)))
    log = read_dvl_log(path)
    rotation = rotation_from_quaternion(log.attitudes[0].orientation)
    assert math.degrees(math.atan2(rotation[1, 0], rotation[0, 0])) == pytest.approx(45.0, abs=0.01)
    assert math.degrees(math.asin(rotation[2, 0])) == pytest.approx(2.0, abs=0.01)  # bow up
    assert math.degrees(math.atan2(rotation[2, 1], rotation[2, 2])) == pytest.approx(-3.0, abs=0.01)
    assert log.attitudes[9].angular_velocity[2] == pytest.approx(-math.radians(1.0), abs=1e-3)
    succeed(capsys, "import", path, "-o", tmp_path / "bag")
    path.write_bytes(b"".join(pd0(i, 0, 0, 0) for i in range(20)))
    assert not read_dvl_log(path).attitudes  # without a sensor


def test_rmc_sentences_are_horizontal_velocities_at_utc(tmp_path):
    lines = [
        "12:31:11.7 " + rmc(11.5, "3.0", "90.0"),
        rmc(12.5, "2.0", "180.0"),
        rmc(13.5, "0.0", ""),
        rmc(14.5, "2.0", ""),
        rmc(15.5, "1.0", "5.0", "V"),
        "$GNGGA,1*00",
        rmc(17.5, "1.0", "0.0").replace("N,", "S,"),
    ]
    (tmp_path / "nmea.log").write_text("\r\n".join(lines))
    notes: list[str] = []
    samples = read_rmc(tmp_path / "nmea.log", 0.1, notes)
    assert [each.stamp_ns for each in samples] == [START_S * 10**9 + round((i + 0.5) * 1e9) for i in range(3)]
    expected = [[3.0 * KNOT, 0.0, 0.0], [0.0, -2.0 * KNOT, 0.0], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose([each.velocity for each in samples], expected, atol=1e-9)
    assert samples[0].covariance[0][0] == pytest.approx(0.01)
    assert len(notes) == 2 and "1 RMC sentences have a wrong checksum" in notes[0] and "2 RMC" in notes[1]
