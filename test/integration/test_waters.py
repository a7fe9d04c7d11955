"""Temperature, salinity and speed of sound of a recording, from its messages to the report."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from conftest import ROOT
from io_fixtures import write_bag
from log_fixtures import nortek, pd0
from water_fixtures import SALINITY, TEMPERATURE, USED, dive, with_water

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.checks.speed_of_sound import speed_of_sound
from dvl_calib_ros.files.mounting import load_calibrated_mounting
from dvl_calib_ros.instruments.settings import instrument_settings
from dvl_calib_ros.messages.water_properties import OfWater, water_of
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics

SCHEMA = json.loads((ROOT / "docs" / "json_schema.json").read_text())["$defs"]["replay"]
# At one speed a bias is in the scale's σ.
UNBIASED = ("-p", "dvl_bias_std:=0.0")


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return with_water(tmp_path_factory.mktemp("waters") / "bag")


def test_a_replay_says_the_scale_in_its_cause_and_what_to_set(bag, tmp_path, capsys):
    said, _ = succeed(capsys, "replay", bag, *UNBIASED, "--json", tmp_path / "out.json")
    told = " ".join(said.split())
    assert (
        f"the DVL used a speed of sound of {USED:.1f} m/s; water of 12.1 °C (dvl/temperature) and 35.0 PSU has 149"
        in told
    )
    assert "That explains the scale: set the speed of sound to 149" in told
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["water"]["dvl_speed_of_sound"] == pytest.approx(USED)
    assert written["water"].keys() == SCHEMA["properties"]["water"]["properties"].keys()


@pytest.mark.slow
def test_an_unknown_salinity_is_said_as_a_range(tmp_path, capsys):
    bag = with_water(tmp_path / "bag", salinity=float("nan"))
    said, _ = succeed(capsys, "replay", bag, *UNBIASED)
    told = " ".join(said.split())
    assert "and unknown salinity (0 to 40 PSU)" in told and "if the salinity is" in told


@pytest.mark.slow
def test_a_recording_without_water_says_nothing(tmp_path):
    imu, gnss, dvl = dive()
    bag = write_bag(tmp_path / "bag", sorted((*imu, *gnss, *dvl), key=lambda sample: sample.stamp_ns))
    run = dc.replay(bag, history=False)
    assert run.replayed.water is None and "water" not in run.document()


@pytest.fixture(scope="module")
def saved(bag, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "result.yaml"
    dc.replay(bag, history=False, dvl_bias_std=0.0).save(path)
    return path


def applied(capsys, saved: Path, *options: str) -> str:
    said, _ = succeed(capsys, "apply", saved, "--force", "--instrument", *options)
    return " ".join(said.split())


@pytest.mark.slow
def test_apply_takes_the_speed_of_sound_that_the_recording_says_was_used(saved, capsys):
    said = applied(capsys, saved, "waterlinked", "--now", "mounting_rotation_offset=0")
    new = re.search(rf"speed_of_sound: {int(USED)}[.\d]* \(as recorded\) -> ([\d.]+) m/s", said)
    assert abs(float(new[1]) - speed_of_sound(TEMPERATURE, SALINITY)) < 5.0
    assert "note: Scale +1." in said and "That explains the scale: set the speed of sound to 149" in said
    assert "not both" not in said
    said = applied(capsys, saved, "cerulean")
    assert "SET-VELOCITY-ADJUSTMENT 0.98" in said and "That explains the scale" in said
    assert "velocity_adjustment corrects the scale: set it or the speed of sound, not both" in said
    shown, _ = succeed(capsys, "apply", saved, "--force")
    assert "water: Scale +1." in " ".join(shown.split())
    told = fail(capsys, "apply", saved, "--force", "--instrument", "waterlinked", "--now", "speed_of_sound=1450")
    assert f"the recording says that the DVL used {USED:.1f} m/s" in told


def test_of_a_dvl_whose_setting_nobody_knows_apply_sets_the_speed_of_sound_of_the_water(saved):
    calibrated = load_calibrated_mounting(saved)
    water = dataclasses.replace(calibrated.water, used=math.nan)
    chosen = instrument_settings(dataclasses.replace(calibrated, water=water), "waterlinked", force=True)
    (sound,) = (each for each in chosen.settings if each.name == "speed_of_sound")
    assert sound.now is None and sound.new == pytest.approx(speed_of_sound(TEMPERATURE, SALINITY), abs=0.1)
    assert any("the water's, ±" in each and "--now speed_of_sound=1500" in each for each in chosen.notes)
    fresh_or_salt = dataclasses.replace(water, salinity=math.nan)
    chosen = instrument_settings(dataclasses.replace(calibrated, water=fresh_or_salt), "waterlinked", force=True)
    assert [each.name for each in chosen.settings] == ["mounting_rotation_offset"]


def test_a_result_whose_water_is_no_water_is_refused(saved, tmp_path, capsys):
    damaged = tmp_path / "result.yaml"
    damaged.write_text(saved.read_text().replace("salinity: 35.0", "salinity: salt"))
    assert "damaged" in fail(capsys, "apply", damaged, "--force")


def test_several_recordings_have_one_water(bag):
    water = open_recording([bag, bag]).water(Topics())
    assert (water.temperature, water.salinity, water.used) == pytest.approx((TEMPERATURE, SALINITY, USED))


def told(ensemble: bytes, sensors: int) -> bytes:
    """An ensemble of `pd0` with EC 1500 m/s, ES 35, ET 12.1 °C, the last two from these sensors."""
    body = bytearray(ensemble[:-2])
    fixed, _, variable = struct.unpack_from("<3H", body, 6)
    body[fixed + 30 : fixed + 32] = bytes([sensors, 0x3F])
    struct.pack_into("<H", body, variable + 14, 1500)
    struct.pack_into("<Hh", body, variable + 24, 35, 1210)
    return bytes(body) + struct.pack("<H", sum(body) & 0xFFFF)


def pd0_with(sensors: int) -> Callable[[int], bytes]:
    return lambda i: told(pd0(i, 4500 + 10 * i, 200, -300), sensors)


@pytest.mark.parametrize(
    ("name", "packet", "readings", "temperature", "salinity"),
    [
        ("dive.pd0", pd0_with(0x7D), 4, 12.1, np.nan),
        ("dive.pd0", pd0_with(0x7F), 4, 12.1, 35.0),
        ("dive.pd0", pd0_with(0x3C), 4, np.nan, np.nan),
        ("dive.ad2cp", lambda i: nortek(i, (1.5, 0.1, 0.0, 0.0)), 5, 8.0, np.nan),
    ],
    ids=["pd0", "pd0 with a conductivity", "pd0 without a thermometer", "nortek"],
)
def test_a_log_tells_what_it_measured_and_what_it_counted_with(
    name, packet, readings, temperature, salinity, tmp_path, capsys
):
    """A salinity or temperature that somebody typed in is none that the water has."""
    (tmp_path / name).write_bytes(b"".join(packet(i) for i in range(40)))
    said, _ = succeed(capsys, "import", tmp_path / name, "-o", tmp_path / "bag")
    assert f"{readings} readings of the water" in said
    water = open_recording([tmp_path / "bag"]).water(Topics())
    found = (water.temperature, water.salinity, water.used)
    assert found == pytest.approx((temperature, salinity, 1500.0), nan_ok=True)
    assert water.source == ("" if np.isnan(temperature) else "dvl/temperature")


def reading(topic: str, value: float, kind: str = "temperature") -> OfWater:
    return OfWater(topic, kind, np.array([value]))


@pytest.mark.parametrize(
    ("topics", "source"),
    [
        ({"/temperature": 12.0}, "/temperature"),
        ({"/imu/temperature": 35.0, "/sea_water/temperature": 12.0}, "/sea_water/temperature"),
        ({"/imu/temperature": 35.0}, None),
        ({"/one/temperature": 12.0, "/two/temperature": 12.0}, None),
        ({"/ctd/temperature": 12.0, "/dvl/temperature": 12.4}, "/ctd/temperature"),
        ({"/ctd/temperature": 12.0, "/dvl/temperature": 19.0}, None),
        ({"/water/temperature": 285.0}, None),
    ],
)
def test_a_thermometer_counts_that_is_in_the_water(topics, source):
    water = water_of([reading(topic, value) for topic, value in topics.items()], "/dvl")
    assert (None if water is None else water.source) == source


def test_a_speed_of_sound_that_follows_the_water_is_no_setting():
    steady = OfWater("/dvl/sound_speed", "used", np.array([1500.0, 1500.4]))
    assert water_of([steady], "/dvl").used == pytest.approx(1500.2)
    assert water_of([steady._replace(values=np.array([1500.0, 1506.0]))], "/dvl") is None


def test_pressure_is_a_depth_below_the_surface():
    readings = [reading("/temperature", 10.0), reading("/pressure", 101_325.0 + 1025.0 * 9.81 * 50.0, "pressure")]
    assert water_of(readings, "/dvl").depth == pytest.approx(50.0)
    assert water_of([*readings[:1], reading("/pressure", 99_000.0, "pressure")], "/dvl").depth == 0.0
