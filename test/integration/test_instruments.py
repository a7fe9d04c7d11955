"""A saved calibration as settings of the instrument: data that it would give with them need no further correction."""

from __future__ import annotations

import json
import math
import socket
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from io_fixtures import replayed, selected_alone

import dvl_calib_ros as dc
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.numerics.frames import FLU_FROM_FRD, rotation_from_rpy, rpy_from_rotation
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.mounting import load_calibrated_mounting
from dvl_calib_ros.instruments.settings import instrument_settings
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

DEGREE = math.pi / 180.0


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A calibration of a DVL with yaw and scale off."""
    folder = tmp_path_factory.mktemp("instruments")
    errors = DvlErrors((0.0, 0.0, 0.03), (0.006,) * 3, beam_std=0.002)
    write_bag(
        Scenario("box", 120.0, imu_rate=20, errors=errors, gnss_std=0.01),
        folder / "bag",
        Storage.MCAP,
        Compression.NONE,
    )
    (folder / "result.yaml").write_text(selected_alone(replayed(folder / "bag").result))
    return folder / "result.yaml"


def found(saved: Path, told_rpy, misaligned: np.ndarray, **changes):
    """The calibration of another mounting, found to be misaligned (3, 3) in the DVL's own calibrated axes."""
    calibrated = load_calibrated_mounting(saved)
    parameters = calibrated.parameters.replace(mounting_rpy=tuple(float(each) for each in told_rpy))
    rotation = parameters.rotation_dvl_from_body.T @ misaligned
    changed = {"objections": (), **changes}
    return replace(calibrated, parameters=parameters, rotation_body_from_dvl=rotation, **changed)


def about_z(angle: float) -> np.ndarray:
    return rotation_from_rpy(np.array([0.0, 0.0, angle]))


@pytest.mark.parametrize("told_rpy", [(0, 0, 0), (0, 0, math.pi / 4), (math.pi, 0, 0), (math.pi, 0, -0.7)])
@pytest.mark.parametrize("now_deg", [0.0, 20.0, 355.0])
def test_with_the_new_offset_the_told_mounting_is_right(saved, told_rpy, now_deg):
    is_down = abs(told_rpy[0]) > 1.0
    wrong = rotation_from_rpy(np.array([0.01, -0.02, 0.05]))
    calibrated = found(saved, told_rpy, wrong)
    chosen = instrument_settings(calibrated, "waterlinked", {"mounting_rotation_offset": now_deg})
    new = chosen.settings[0].new
    assert 0.0 <= new < 360.0
    # what the DVL measures in its own axes, z down, and gives out turned clockwise by its setting
    flip = np.eye(3) if is_down else FLU_FROM_FRD
    body_from_sensor = calibrated.rotation_body_from_dvl @ flip @ about_z(now_deg * DEGREE)
    body_from_new_output = body_from_sensor @ about_z(-new * DEGREE) @ flip
    told = calibrated.parameters.rotation_dvl_from_body.T
    left = rpy_from_rotation(told.T @ body_from_new_output)
    assert abs(left[2]) < 5e-4  # two digits are written, and yaw of a tilted one
    np.testing.assert_allclose(np.abs(left[:2]), [0.01, 0.02], atol=1.5e-3)
    (note,) = (each for each in chosen.notes if "mounting_rpy" in each)
    written = np.array([float(word.strip("()")) for word in note.rpartition("mounting_rpy ")[2].split()])
    np.testing.assert_allclose(rotation_from_rpy(written), body_from_new_output, atol=2e-4)


def test_the_scale_is_taken_out_at_its_cause(saved):
    calibrated = load_calibrated_mounting(saved)
    too_much = 1.0 + calibrated.scale_ahead
    assert too_much == pytest.approx(1.006, abs=1e-3)
    chosen = instrument_settings(calibrated, "waterlinked", {"speed_of_sound": 1500.0})
    assert chosen.settings[1].new == pytest.approx(1500.0 / too_much, abs=0.01)
    assert json.loads(chosen.text)["parameters"]["speed_of_sound"] == chosen.settings[1].new
    cerulean = instrument_settings(calibrated, "cerulean", {"velocity_adjustment": 1.01, "roll": 2.0})
    assert cerulean.settings[1].new == pytest.approx(1.01 / too_much, abs=1e-5)
    roll, pitch, yaw = map(float, cerulean.text.splitlines()[0].removeprefix("SET-SENSOR-ORIENTATION").split(","))
    assert (roll, pitch) == (2.0, 0.0) and yaw == pytest.approx(-math.degrees(0.03), abs=0.2)
    untold = instrument_settings(calibrated, "waterlinked")
    assert str(untold.settings[0]).startswith("mounting_rotation_offset: 0 (as delivered) -> ")
    assert [each.name for each in untold.settings] == ["mounting_rotation_offset"]
    assert any(f"times {1.0 / too_much:.5f}" in each for each in untold.notes)


def test_an_autopilot_takes_place_quarter_turns_and_delay(saved):
    calibrated = found(saved, (0.0, 0.0, -math.pi / 2), about_z(0.03), position=(0.4, -0.1, -0.2), dvl_time_offset=0.12)
    chosen = instrument_settings(calibrated, "ardupilot")
    assert chosen.text == "VISO_POS_X,0.4\nVISO_POS_Y,0.1\nVISO_POS_Z,0.2\nVISO_ORIENT,2\nVISO_DELAY_MS,120\n"
    assert any("-1.72° of yaw" in each for each in chosen.notes)
    early = instrument_settings(replace(calibrated, dvl_time_offset=-0.1, position=None), "ardupilot")
    assert [each.name for each in early.settings] == ["VISO_ORIENT"]
    with pytest.raises(InputError, match="quarter turns"):
        instrument_settings(found(saved, (0.0, 0.0, math.pi / 4), np.eye(3)), "ardupilot")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--instrument", "sonardyne"], "one of waterlinked, cerulean, ardupilot"),
        (["--instrument", "waterlinked", "--now", "colour=1"], "no setting 'colour'"),
        (["--instrument", "waterlinked", "--now", "speed_of_sound=fast"], "NAME=VALUE"),
        (["--instrument", "waterlinked", "--now", "speed_of_sound=nan"], "1000 to 2000"),
        (["--instrument", "waterlinked", "--now", "speed_of_sound=150"], "1000 to 2000"),
        (["--instrument", "waterlinked", "--now", "speed_of_sound=1001"], "is the current setting right?"),
        (["--instrument", "waterlinked", "--now", "mounting_rotation_offset=-5"], "0 to 360"),
        (["--instrument", "cerulean", "--now", "velocity_adjustment=0"], "0.8 to 1.25"),
        (["--instrument", "cerulean", "--now", "roll=1000"], "-360 to 360"),
        (["--instrument", "ardupilot", "--now", "VISO_DELAY_MS=900"], "0 to 250"),
        (["--instrument", "waterlinked", "--launch", "tf.launch.xml"], "corrected twice"),
        (["--instrument", "cerulean", "--send", "192.0.2.1"], "--send is for waterlinked"),
        (["--instrument", "ardupilot", "--send", "host"], "--send is for waterlinked"),
        (["--now", "speed_of_sound=1500"], "need --instrument"),
    ],
)
def test_what_cannot_be_set_is_said_in_one_line(saved, arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["apply", str(saved), *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert says in error and len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_rejected_calibration_is_no_setting_unless_forced(saved):
    rejected = found(saved, (0.0, 0.0, 0.0), np.eye(3), objections=("its verdict is reject",))
    with pytest.raises(InputError, match="--force"):
        instrument_settings(rejected, "waterlinked")
    assert instrument_settings(rejected, "waterlinked", force=True).settings


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


class WaterLinked:
    """A DVL that answers over TCP as the protocol says, with reports in between."""

    def __init__(
        self, config: dict[str, float], *, whole: bool = False, refuses: bool = False, family=socket.AF_INET,
        between: bytes = b"no json", why: object = "not now", closes: str = "",
    ) -> None:  # fmt: skip
        self.config, self._whole, self._refuses = dict(config), whole, refuses
        self._between, self._why, self._closes = between, why, closes
        host, written = ("::1", "[::1]") if family == socket.AF_INET6 else ("127.0.0.1",) * 2
        self._server = socket.create_server((host, 0), family=family)
        self.address = f"{written}:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._server.accept()
        before = dict(self.config)
        with connection, connection.makefile("rwb") as stream:
            for line in stream:
                asked = json.loads(line)
                answer = {"response_to": asked["command"], "success": True, "error_message": "", "type": "response"}
                if asked["command"] == "set_config" and self._refuses:
                    answer |= {"success": False, "error_message": self._why}
                elif asked["command"] == "set_config":
                    wanted = asked["parameters"]
                    self.config |= {name: round(value) if self._whole else value for name, value in wanted.items()}
                    if self._closes == "at once":
                        return
                elif self.config != before and self._closes == "when it is read":
                    return
                else:
                    answer["result"] = self.config
                between = b'{"type": "velocity", "vx": 0.1}\n' + self._between
                stream.write(between + b"\n" + json.dumps(answer).encode() + b"\n")
                stream.flush()

    def ended(self) -> dict[str, float]:
        self._thread.join(10.0)
        self._server.close()
        return self.config


NOW = {"mounting_rotation_offset": 20.0, "speed_of_sound": 1480.0}


def send(saved, dvl, *more, now=NOW) -> int:
    told = [word for name, value in now.items() for word in ("--now", f"{name}={value}")]
    return main(["apply", str(saved), "--instrument", "waterlinked", "--send", dvl.address, *told, *more])


def test_what_is_sent_is_read_back_and_is_sent_once(saved, capsys):
    dvl = WaterLinked({**NOW, "acoustic_enabled": True})
    assert send(saved, dvl) == 0
    kept, calibrated = dvl.ended(), load_calibrated_mounting(saved)
    offset, speed = 20.0 - math.degrees(calibrated.rpy[2]), 1480.0 / (1.0 + calibrated.scale_ahead)
    assert kept["mounting_rotation_offset"] == pytest.approx(offset, abs=0.02)
    assert kept["speed_of_sound"] == pytest.approx(speed, abs=0.01) and kept["acoustic_enabled"] is True
    said = capsys.readouterr().out
    assert "mounting_rotation_offset: 20 ->" in said and "set, and read back" in said
    again = WaterLinked(kept)  # the same line once more turns nothing twice
    assert send(saved, again) == 0 and again.ended() == kept
    assert "already up to date" in capsys.readouterr().out


def test_nothing_is_sent_to_a_dvl_that_is_set_otherwise_in_a_dry_run_or_to_one_that_is_not_told(saved, capsys):
    dvl = WaterLinked(NOW)
    assert send(saved, dvl, "--dry-run") == 0
    assert dvl.ended() == NOW and "would be set" in capsys.readouterr().out
    turned = WaterLinked({**NOW, "mounting_rotation_offset": 0.0})
    assert send(saved, turned) == 2 and turned.ended()["mounting_rotation_offset"] == 0.0
    assert "is 0.0, and was 20.0 when the data were recorded" in capsys.readouterr().err
    assert send(saved, turned, now={"speed_of_sound": 1480.0}) == 2
    assert "--now mounting_rotation_offset=..." in capsys.readouterr().err


@pytest.mark.skipif(not has_ipv6(), reason="no IPv6 here")
def test_a_dvl_is_found_by_an_ipv6_address_in_brackets(saved, capsys):
    dvl = WaterLinked(NOW, family=socket.AF_INET6)
    assert send(saved, dvl, "--dry-run") == 0
    assert dvl.ended() == NOW and f"{dvl.address}: would be set" in capsys.readouterr().out


def test_a_dvl_that_refuses_rounds_or_is_not_there_is_said(saved, capsys):
    refusing = WaterLinked(NOW, refuses=True)
    assert send(saved, refusing) == 2 and refusing.ended() == NOW
    assert "refuses set_config (not now)" in capsys.readouterr().err
    rounding = WaterLinked(NOW, whole=True)
    assert send(saved, rounding) == 2 and rounding.ended() != NOW
    assert "look at the DVL's own page" in capsys.readouterr().err
    assert send(saved, refusing) == 2
    assert "is the DVL on" in capsys.readouterr().err
    for address in ("host:port", "::1", "[::1]:70000", "[::1", ":16171"):
        refusing.address = address
        assert send(saved, refusing) == 2
        assert "is not HOST or HOST:PORT" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["a..b", ".local", "a" * 64, f"{'b' * 64}.local:16171", "\udcff", "ä" * 63])
def test_a_host_that_is_no_name_is_said_in_one_line(saved, address, capsys):
    dvl = WaterLinked(NOW)
    dvl.address = address
    assert send(saved, dvl) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("dvl-calib apply: --send ") and "is no name that a host can have" in error


@pytest.mark.parametrize("between", [b"[" * 100_000, b'{"a":' * 20_000 + b"1" + b"}" * 20_000, b"9" * 5000, b"\xff"])
def test_what_is_no_answer_is_passed_over(saved, between):
    dvl = WaterLinked(NOW, between=between)
    assert send(saved, dvl) == 0 and dvl.ended() != NOW


@pytest.mark.parametrize("held", [10**400, None, True, "20", [[20.0]], math.nan, -math.inf], ids=lambda _: "")
def test_a_setting_that_is_no_number_is_not_taken_for_one(saved, held, capsys):
    dvl = WaterLinked({**NOW, "mounting_rotation_offset": held})
    assert send(saved, dvl) == 2
    assert "when the data were recorded" in capsys.readouterr().err
    dvl.ended()


def test_a_dvl_that_refuses_without_a_sentence_is_said(saved, capsys):
    nested: list[object] = []
    for _ in range(500):
        nested = [nested]
    for why, said in ((nested, "(no reason given)"), ("x" * 100_000, f"({'x' * 200})"), ("\x1b[2J", "(\\x1b[2J)")):
        dvl = WaterLinked(NOW, refuses=True, why=why)
        assert send(saved, dvl) == 2
        assert said in capsys.readouterr().err and dvl.ended() == NOW


@pytest.mark.parametrize("closes", ["at once", "when it is read"])
def test_a_connection_that_ends_after_the_dvl_may_have_been_set_is_said(saved, closes, capsys):
    dvl = WaterLinked(NOW, closes=closes)
    assert send(saved, dvl) == 2
    error, kept = capsys.readouterr().err, dvl.ended()
    assert "the DVL may be set or not; repeat the command" in error and kept != NOW
    again = WaterLinked(kept)  # which the same line then tells
    assert send(saved, again) == 0 and again.ended() == kept
    assert "already up to date" in capsys.readouterr().out


def test_a_dry_run_shows_what_files_would_change_and_changes_none(saved, tmp_path, capsys):
    params, settings = tmp_path / "vehicle.yaml", tmp_path / "dvl.json"
    main(["apply", str(saved), "--params", str(params), "--dry-run"])
    assert "+    mounting_rpy: [" in capsys.readouterr().out and not params.exists()
    assert dc.apply(saved, params=params).written == (params,)
    before = params.read_bytes()
    params.write_bytes(before.replace(b"mounting_rpy: [", b"mounting_rpy: [0.0, 0.0, 0.0] # ["))
    would = dc.apply(saved, params=params, dry_run=True)
    assert would.written == (params,) and "-    mounting_rpy: [0.0, 0.0, 0.0]" in would.changes
    assert params.read_bytes() != before
    main(["apply", str(saved), "--instrument", "waterlinked", "--settings", str(settings), "--dry-run"])
    assert not settings.exists()
    main(["apply", str(saved), "--instrument", "waterlinked", "--settings", str(settings)])
    assert settings.read_text() == dc.instrument_settings(saved, "waterlinked").text
