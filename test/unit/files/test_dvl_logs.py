"""Logs as instruments write them become bags: the velocities, axes, times and gaps that they hold."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from log_fixtures import ensemble, nortek
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.logs.dvl_logs import is_dvl_log, read_dvl_log

START_US = 1_638_191_471_563_017
VELOCITIES = [(1.5, 0.1, -0.02), (1.4, -0.2, 0.01), (1.6, 0.0, 0.03)]


def report(i: int, velocity: Sequence[float], **changes) -> str:
    """As docs.waterlinked.com/dvl/dvl-json-protocol shows one."""
    vx, vy, vz = velocity
    return json.dumps(
        {
            "time": 106.4, "vx": vx, "vy": vy, "vz": vz, "fom": 0.01,
            "covariance": [[1e-4, 1e-5, 0.0], [1e-5, 2e-4, 0.0], [0.0, 0.0, 3e-4]], "altitude": 0.5,
            "transducers": [], "velocity_valid": True, "status": 0, "format": "json_v3.1", "type": "velocity",
            "time_of_validity": START_US + 100_000 * i, "time_of_transmission": START_US + 100_000 * i + 5000,
        } | changes
    )  # fmt: skip


def water_linked(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_water_linked_reports_are_turned_to_forward_left_up_and_stamped_by_their_validity(tmp_path):
    log = read_dvl_log(water_linked(tmp_path / "a50.log", *(report(i, v) for i, v in enumerate(VELOCITIES))))
    assert [sample.stamp_ns for sample in log.samples] == [1000 * (START_US + 100_000 * i) for i in range(3)]
    np.testing.assert_allclose([s.velocity for s in log.samples], np.array(VELOCITIES) * [1.0, -1.0, -1.0])
    np.testing.assert_allclose(log.samples[0].covariance[0], [1e-4, -1e-5, 0.0])
    assert not log.left_out


def test_reports_that_hold_no_velocity_are_left_out_and_counted(tmp_path):
    lines = (
        "2021-11-29 12:31:11 " + report(0, VELOCITIES[0]),  # a logger's own time before
        report(1, VELOCITIES[1], velocity_valid=False),
        '{"type": "position_local", "x": 1.0}',
        report(2, VELOCITIES[2])[:-9],
        report(0, VELOCITIES[2]),
        "not a report",
    )
    log = read_dvl_log(water_linked(tmp_path / "a50.log", *lines))
    assert len(log.samples) == 1
    assert log.left_out == {"without bottom lock": 1, "not valid JSON": 1, "of a time that was there already": 1}


def test_pd0_bottom_track_is_the_vehicles_motion_in_forward_left_up(tmp_path):
    path = tmp_path / "dive.pd0"
    # ship axes (starboard, forward, up) of the bottom past the DVL: the vehicle goes ahead and to port
    path.write_bytes(b"noise\x7f\x7f" + ensemble((200, -1500, 30), 25) + ensemble((0, -1600, 0), 50))
    log = read_dvl_log(path)
    np.testing.assert_allclose([s.velocity for s in log.samples], [(1.5, 0.2, -0.03), (1.6, 0.0, 0.0)])
    first = datetime(2025, 11, 21, 10, 30, 15, 250_000, tzinfo=timezone.utc)
    assert log.samples[0].stamp_ns == round(first.timestamp() * 100) * 10_000_000
    assert log.samples[1].stamp_ns - log.samples[0].stamp_ns == 250_000_000
    assert log.samples[0].covariance is None


def test_pd0_ensembles_with_a_wrong_checksum_or_without_lock_give_no_velocity(tmp_path):
    path = tmp_path / "dive.000"
    path.write_bytes(
        ensemble((0, -1000, 0), 1) + ensemble((0, -9000, 0), 2, checksum=1) + ensemble((-32768,) * 3, 3)
        + ensemble((0, -1100, 0), 4)[:-40]
    )  # fmt: skip
    log = read_dvl_log(path)
    assert [sample.velocity[0] for sample in log.samples] == [1.0]
    assert log.left_out == {"without bottom lock": 1}


def test_pd0_of_beams_is_resolved_by_their_angle(tmp_path):
    """Beams of 20° to starboard, port, astern and ahead, as RDI's booklet numbers their velocities."""
    out, up = np.sin(np.radians(20.0)), np.cos(np.radians(20.0))
    beams = np.array([[out, 0.0, up], [-out, 0.0, up], [0.0, -out, up], [0.0, out, up]])
    radial = np.round(beams @ [200.0, -1500.0, 30.0]).astype(int)
    (tmp_path / "dive.pd0").write_bytes(ensemble(radial, 25, axes=0, configuration=(8, 1)))
    (sample,) = read_dvl_log(tmp_path / "dive.pd0").samples
    np.testing.assert_allclose(sample.velocity, (1.5, 0.2, -0.03), atol=3e-3)
    (tmp_path / "dive.pd0").write_bytes(ensemble((*radial[:3], -32768), 25, axes=0) + ensemble(radial, 26, axes=2))
    assert read_dvl_log(tmp_path / "dive.pd0").left_out == {"without bottom lock": 1}


@pytest.mark.parametrize("tilts_used", [0, 4])
def test_pd0_in_earth_axes_is_turned_back_as_the_instrument_turned_it(tmp_path, tilts_used):
    heading, tilt, roll = 123.45, 8.0, -5.0
    pitch = np.degrees(np.arctan(np.tan(np.radians(tilt)) * np.cos(np.radians(roll)))) if tilts_used else 0.0
    turn = Rotation.from_euler("ZXY", [-heading, pitch, roll if tilts_used else 0.0], degrees=True)
    earth = np.round(turn.apply([200.0, -1500.0, 30.0])).astype(int)
    attitude = (round(100 * heading), round(100 * tilt), round(100 * roll))
    (tmp_path / "dive.pd0").write_bytes(ensemble((*earth, 0), 25, axes=3, flags=tilts_used, attitude=attitude))
    (sample,) = read_dvl_log(tmp_path / "dive.pd0").samples
    np.testing.assert_allclose(sample.velocity, (1.5, 0.2, -0.03), atol=2e-3)


@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("alignment", [47.0, -120.0, 180.0])
def test_pd0_with_an_aligned_heading_is_in_instrument_axes_and_tells_its_yaw(tmp_path, alignment, axes):
    """EA is how far clockwise of the ship's centre line beam 3 is; the ensemble's heading is the ship's."""
    heading, tilt, roll = 123.45, 8.0, -5.0
    pitch = np.degrees(np.arctan(np.tan(np.radians(tilt)) * np.cos(np.radians(roll))))
    in_earth = Rotation.from_euler("ZXY", [-heading - alignment, pitch, roll], degrees=True)
    in_ship = Rotation.from_euler("Z", -alignment, degrees=True)
    turn = {1: Rotation.identity(), 2: in_ship, 3: in_earth}[axes]
    given = (*np.round(turn.apply([200.0, -1500.0, 30.0])).astype(int), 0)
    attitude = (round(100 * heading), round(100 * tilt), round(100 * roll))
    (tmp_path / "dive.pd0").write_bytes(
        b"".join(
            ensemble(
                given, at, axes, flags=4, attitude=(attitude[0] + at, *attitude[1:]), alignment=round(100 * alignment)
            )
            for at in (0, 1)
        )
    )
    log = read_dvl_log(tmp_path / "dive.pd0")
    np.testing.assert_allclose(log.samples[0].velocity, (1.5, 0.2, -0.03), atol=2e-3)
    assert np.degrees(log.nominal_yaw) == pytest.approx(-alignment)
    assert f"EA (heading alignment) is {alignment:+.2f}°" in log.notes[-1]
    # of the ship, forward-left-up in east-north-up: the instrument's, turned back about its vertical
    rdi_from_flu = Rotation.from_euler("Z", 90.0, degrees=True)
    instrument_from_ship = Rotation.from_euler("Z", alignment, degrees=True)
    expected = in_earth * rdi_from_flu * instrument_from_ship
    found = Rotation.from_quat(log.attitudes[0].orientation)
    assert np.degrees((expected.inv() * found).magnitude()) < 0.01


def test_an_import_hands_on_the_nominal_yaw_and_no_place(tmp_path, capsys):
    log = tmp_path / "dive.pd0"
    log.write_bytes(b"".join(ensemble((0, -1500, 0), i, 1, alignment=4700) for i in range(20)))
    _, err = succeed(capsys, "import", log, "-o", tmp_path / "bag")
    assert "EA (heading alignment) is +47.00°" in " ".join(err.split())
    found = discover([tmp_path / "bag"], Parameters())
    np.testing.assert_allclose(found.values["mounting_rpy"], (0.0, 0.0, np.radians(-47.0)), atol=1e-6)
    assert "lever_arm" not in found.values and "dvl_position" not in found.values
    assert any("mounting 0° 0° -47°: dvl_link in base_link, from /robot_description" in each for each in found.found)


def test_a_dvl_with_its_own_compass_has_no_yaw_in_the_body_of_that_compass(tmp_path, capsys):
    """A magnetic declination of 12 degrees was found as a mounting of -12.0° ± 0.3."""
    log, attitudes = tmp_path / "dive.pd0", ((0, 0, 0), (4500, 100, -100))
    log.write_bytes(b"".join(ensemble((0, -1500, 0), i, 1, attitude=attitudes[i % 2]) for i in range(20)))
    assert read_dvl_log(log).nominal_yaw == 0.0
    succeed(capsys, "import", log, "-o", tmp_path / "bag")
    assert discover([tmp_path / "bag"], Parameters()).values["mounting_rpy"] == (0.0, 0.0, 0.0)
    without = tmp_path / "without.pd0"
    without.write_bytes(b"".join(ensemble((0, -1500, 0), i, 1) for i in range(20)))
    assert read_dvl_log(without).nominal_yaw is None


def test_an_ensemble_that_ends_before_its_heading_is_a_velocity_and_no_damage(tmp_path):
    (tmp_path / "dive.pd0").write_bytes(ensemble((0, -1000, 0), 1, length=16) + ensemble((0, -1000, 0), 2))
    log = read_dvl_log(tmp_path / "dive.pd0")
    assert len(log.samples) == 2 and not log.left_out


@pytest.mark.parametrize("content", [b"", b"time,vx\n0,1\n", b"\x7f\x7f\x00\x00", bytes(range(256)) * 40])
def test_what_is_no_log_is_not_taken_for_one(tmp_path, content):
    path = tmp_path / "file.bin"
    path.write_bytes(content)
    assert not is_dvl_log(path)


@pytest.mark.parametrize("nortek_first", [True, False])
def test_of_logs_of_two_instruments_in_one_file_one_is_read_and_the_other_named(tmp_path, nortek_first):
    parts = [b"".join(nortek(i, (1.5, 0.1, -0.02, -0.02)) for i in range(8)), ensemble((0, -1500, 0, 0), 5) * 2000]
    path = tmp_path / "both.log"
    path.write_bytes(b"".join(parts if nortek_first else reversed(parts)))
    log = read_dvl_log(path)
    assert len(log.samples) == 8
    (note,) = log.notes
    assert "holds RDI's ensembles as well as Nortek's records" in note


def test_import_writes_a_bag_of_either_log(tmp_path, capsys):
    a50 = water_linked(tmp_path / "a50.json", *(report(i, VELOCITIES[0]) for i in range(20)))
    rdi = tmp_path / "dive.pd0"
    rdi.write_bytes(b"".join(ensemble((0, -1500, 0), i) for i in range(20)) + ensemble((-32768,) * 3, 30))
    for log, said in ((a50, "20 dvl/twist"), (rdi, "20 dvl/twist, 1 reports without bottom lock, left out")):
        bag = tmp_path / f"bag_{log.stem}"
        out, _ = succeed(capsys, "import", log, "-o", bag)
        assert out == f"{bag}: {said}\n"
        with BagReader([bag]) as reader:
            velocities = [message.twist.twist.linear.x for _, _, message, _ in reader.messages(["dvl/twist"])]
        assert velocities == [1.5] * 20
    empty = water_linked(tmp_path / "empty.json", report(0, VELOCITIES[0], velocity_valid=False))
    assert "no velocity that can be used (1 without bottom lock)" in fail(
        capsys, "import", empty, "-o", tmp_path / "none"
    )


@pytest.mark.filterwarnings("error")
def test_numbers_that_are_none_are_damage_and_no_warning(tmp_path):
    lines = [report(i, v) for i, v in enumerate(VELOCITIES)]
    spoilt = [
        lines[0].replace("1.5", "9" * 100_000), lines[0].replace("1.5", "1e400"), lines[0].replace("1.5", "NaN"),
        report(0, VELOCITIES[0], covariance=[[float("inf")] * 3] * 3), report(0, VELOCITIES[0], covariance=[1.0]),
        report(0, VELOCITIES[0], time_of_validity=float("inf")), report(0, VELOCITIES[0], time_of_validity=10**30),
    ]  # fmt: skip
    log = read_dvl_log(water_linked(tmp_path / "a50.log", *lines, *spoilt))
    assert len(log.samples) == 3 and sum(log.left_out.values()) == len(spoilt)
