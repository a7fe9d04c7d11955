"""Logs of an autopilot, a DVL's own attitude and a receiver's NMEA become the bag that they recorded."""

from __future__ import annotations

import math
import os
import struct
from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from log_fixtures import START_S, dataflash, general_nmea, nortek, pd0, rmc, sentence, telemetry

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.numerics.frames import rotation_from_quaternion
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.logs.dvl_logs import is_dvl_log, read_dvl_log
from dvl_calib_ros.logs.text_logs import read_rmc
from dvl_calib_ros.logs.trajectories import ImportOptions, import_files

KNOT = 1852.0 / 3600.0


@pytest.mark.spread(1)
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


@pytest.mark.parametrize("name", ["dive", "dive.csv", "bin/dive.log2", "udp:dive"])
@pytest.mark.parametrize("write", [telemetry, dataflash])
def test_a_log_of_the_autopilot_is_known_by_its_content_whatever_its_name(write, name, tmp_path, monkeypatch):
    pytest.importorskip("pymavlink", reason="needs the extra ardupilot")
    (tmp_path / "bin").mkdir()
    monkeypatch.chdir(tmp_path)
    import_files(write(Path(name)), None, None, tmp_path / "bag", ImportOptions())
    with BagReader([tmp_path / "bag"]) as bag:
        counts = Counter(channel.topic for _, channel, _ in bag.raw_messages(bag.topics))
    assert counts["dvl/twist"] == 35 and counts["imu/data"] == 40


@pytest.mark.parametrize("suffix", ["", ".BIN", ".csv", ".npy"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
@pytest.mark.parametrize("role", ["dvl", "--gnss", "--attitude", "--columns"])
def test_a_pipe_or_a_folder_of_any_name_does_not_hang_an_import(role, make, suffix, tmp_path, capsys):
    make(path := tmp_path / f"pipe{suffix}")
    table = tmp_path / "one_dvl.csv"
    table.write_text("t,x,y,z\n" + "".join(f"{i},1,0,0\n" for i in range(9)))
    arguments = {"dvl": (path,), "--columns": (path, "--columns", "time=t,vx=x,vy=y,vz=z")}.get(
        role, (table, role, path)
    )
    assert "pipe" in fail(capsys, "import", *arguments, "-o", tmp_path / "bag")


def test_of_a_telemetry_log_one_vehicle_is_read(tmp_path):
    pytest.importorskip("pymavlink", reason="needs the extra ardupilot")
    log = read_dvl_log(telemetry(tmp_path / "two.tlog", other=True))
    assert len(log.samples) == 35 and log.left_out["of another vehicle"] == 100


def test_a_message_of_no_length_is_not_read_for_ever(tmp_path):
    pytest.importorskip("pymavlink", reason="needs the extra ardupilot")
    path = dataflash(tmp_path / "dive.BIN")
    content = path.read_bytes()
    nothing = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 200, 0, b"ZERO", b"", b"") + b"\xa3\x95\xc8" * 3
    path.write_bytes(content[: 4 * 89] + nothing + content[4 * 89 :])
    with pytest.raises(InputError, match="no velocity that can be used"):
        read_dvl_log(path)


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


def winriver(path: Path, kinds: Sequence[str], sign: float = -1.0) -> Path:
    """Ensembles of 0.1 s with a receiver's 4 Hz: 2 m/s to the east, later north, and a heading of 45° and on.

    sign: a sentence's time is that of its ensemble and so many times the difference.
    """
    messages: dict[int, list[bytes]] = {}
    for n in range(80):
        at = 0.25 * n + 0.013
        i = math.ceil(10.0 * at - 1e-9)
        delta = sign * (at - 0.1 * i)
        course, knots = (90.0, 2.0 / KNOT) if n < 40 else (0.0, 2.0 / KNOT)
        metres = min(at, 10.0) * 2.0, max(at - 10.0, 0.0) * 2.0
        latitude, longitude = 53.0 + metres[1] / 111_300.0, 6.0 + metres[0] / 67_130.0
        minutes = 60.0 * (latitude - 53.0), 60.0 * (longitude - 6.0)
        known = {
            "204": sentence(f"GPGGA,103015.0,53{minutes[0]:09.6f},N,006{minutes[1]:09.6f},E,4,9,0.9,1,M,1,M,,"),
            "104": b"$GPGGA\0" + struct.pack("<10sdcdcB", b"103015.0", latitude, b"N", longitude, b"E", 4) + bytes(22),
            "205": sentence(f"GPVTG,{course},T,,M,{knots:.5f},N,{1.852 * knots:.3f},K,D"),
            "105": b"$GPVTG\0" + struct.pack("<fcfcfcfc", course, b"T", 0.0, b"M", knots, b"N", 1.852 * knots, b"K"),
            "101": b"$GPVTG".ljust(10, b"\0") + struct.pack("<fcfcf", course, b"T", 0.0, b"M", knots) + b"N",
            "207": sentence(f"HEHDT,{45.0 + 0.5 * n:.2f},T"),
            "107": b"$HEHDT\0" + struct.pack("<dc", 45.0 + 0.5 * n, b"T"),
        }
        messages.setdefault(i, []).extend(general_nmea(int(kind), known[kind], delta) for kind in kinds)
    path.write_bytes(b"".join(pd0(i, 1000 + i, 200, -300, messages.get(i, ())) for i in range(205)))
    return path


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("kinds", [("204", "205", "207"), ("104", "105", "107"), ("101",), ("204",), ("104",)])
def test_the_nmea_in_pd0_is_reference_and_heading(kinds, sign, tmp_path):
    log = read_dvl_log(winriver(tmp_path / "dive.PD0", kinds, sign))
    assert len(log.samples) == 205 and not log.left_out
    start_ns = log.samples[0].stamp_ns
    seconds = np.array([each.stamp_ns - start_ns for each in log.references]) * 1e-9
    velocities = np.array([each.velocity for each in log.references])
    steady = np.abs(seconds - 10.0) > 0.8
    expected = np.where((seconds < 10.0)[:, None], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0])
    np.testing.assert_allclose(velocities[steady], expected[steady], atol=0.02)
    assert len(seconds) >= 75 and np.ptp(np.diff(seconds)) < 1e-6  # as evenly as they came
    if "VTG" not in kinds and kinds[0][-1] == "5":
        np.testing.assert_allclose(seconds[0], 0.013, atol=1e-6)
    headings = [rotation_from_quaternion(each.orientation) for each in log.attitudes]
    north = [90.0 - math.degrees(math.atan2(each[1, 0], each[0, 0])) for each in headings]
    if "207" in kinds or "107" in kinds:
        np.testing.assert_allclose(north, 45.0 + 0.5 * np.arange(80), atol=0.02)
        assert math.degrees(math.asin(headings[9][2, 0])) == pytest.approx(2.0, abs=0.01)
        assert "HDT" in log.notes[0]
    else:
        assert len(north) == 205 and "DVL's own sensors" in log.notes[0]


def test_nmea_in_pd0_that_says_nothing_is_left_out_and_the_velocity_kept(tmp_path):
    spoilt = [
        general_nmea(205, sentence("GPVTG,,T,,M,9.0,N,,K,N"), 0.0),
        general_nmea(205, sentence("GPVTG,90.0,T,,M,2.0,N,,K,D").replace(b"90", b"80"), 0.0),
        general_nmea(204, sentence("GPGGA,103015.0,,,,,0,0,,,M,,M,,"), 0.0),
        general_nmea(105, b"$GPVTG\0" + bytes(3), 0.0),
        general_nmea(107, b"$HEHDT\0" + struct.pack("<d", math.nan), 0.0),
        general_nmea(205, sentence("GPVTG,90.0,T,,M,2.0,N,,K,D"), math.nan),
    ]
    far = general_nmea(205, sentence("GPVTG,90.0,T,,M,2.0,N,,K,D"), 3600.0)
    other = general_nmea(206, sentence("SDDBT,9.0,f,3.0,M,1.0,F"), 0.0)
    (tmp_path / "dive.PD0").write_bytes(b"".join(pd0(i, 100 * i, 0, 0, [*spoilt, far, other]) for i in range(5)))
    log = read_dvl_log(tmp_path / "dive.PD0")
    assert len(log.samples) == 5 and not log.references
    assert log.left_out == {
        "with NMEA that is damaged or empty": 5 * len(spoilt),
        "with NMEA an hour or more from the ensemble": 5,
    }


def test_bottom_track_of_nortek_is_a_velocity_at_its_echo(tmp_path, capsys):
    path = tmp_path / "dive.ad2cp"
    configuration = nortek(0, (9.0,) * 4, identity=0xA0)  # another record before
    path.write_bytes(
        configuration + b"\xa5\x0a" + b"".join(nortek(i, (1.5, 0.2, -0.03, -0.01), 0.01) for i in range(8))
        + nortek(8, (1.5, 0.2, -0.03, -32.768), status=0xFFFFF & ~(1 << 15))
        + nortek(9, (-32.768,) * 4) + nortek(10, (1.5, 0.2, 0.0, 0.0), status=0xFFFFF & ~(1 << 12))
        + nortek(11, (9.0,) * 4)[:-1] + b"\0" + nortek(12, (1.6, 0.0, 0.0, 0.0), fom=0.0) + nortek(13, (9.0,) * 4)[:-60]
    )  # fmt: skip
    assert is_dvl_log(path)
    log = read_dvl_log(path)
    assert log.left_out == {"without bottom lock": 2, "damaged": 2}
    expected = [(1.5, -0.2, 0.02)] * 8 + [(1.5, -0.2, 0.03), (1.6, 0.0, 0.0)]
    np.testing.assert_allclose([each.velocity for each in log.samples], expected, atol=1e-7)
    first_ns = round(datetime(2025, 11, 21, 10, 30, 15, tzinfo=timezone.utc).timestamp()) * 1_000_000_000
    at = [each.stamp_ns - first_ns for each in log.samples]
    np.testing.assert_allclose(at, [125e6 * i + 10e6 for i in range(8)] + [1e9, 1.5e9], atol=10)
    np.testing.assert_allclose(log.samples[0].covariance, 0.004**2 * np.eye(3), atol=1e-9)
    assert log.samples[-1].covariance is None
    succeed(capsys, "import", path, "-o", tmp_path / "bag")
    path.write_bytes(configuration)
    assert not is_dvl_log(path)


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
