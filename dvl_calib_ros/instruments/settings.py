"""Conversion of a saved calibration to settings of the instrument itself, or of the autopilot that reads it.

The settings correct the error at its source, so the mounting in URDF and parameters stays unchanged, except for errors
that the instrument has no setting for. Each entry names the document that its settings follow.
"""

from __future__ import annotations

import json
import math
import re
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..calibration.numerics.frames import (
    FLU_FROM_FRD,
    Array,
    quaternion_from_rotation,
    rotation_from_rpy,
    rpy_from_rotation,
)
from ..errors import InputError, printable
from ..files.mounting import POSITION_UNKNOWN, CalibratedMounting
from ..files.urdf import numbers

# smallest remaining angle that is reported, rad
REPORTED_FROM_RAD = math.radians(0.05)
# an autopilot's orientation is a multiple of a quarter turn, within this tolerance (rad)
QUARTER, NEAR_QUARTER = 0.5 * math.pi, math.radians(20.0)
# origin of a setting that was not given
AS_DELIVERED, AS_RECORDED = "as delivered", "as recorded"
SPEED_OF_SOUND = "speed_of_sound"
# tolerance for a given speed of sound (m/s), which may be rounded
SAME_SPEED = 1.0
# range of an autopilot's delay, ms
DELAY_MS = (0, 250)


@dataclass(frozen=True)
class Setting:
    """One setting of an instrument. now: None if unknown. now_by: origin of a value that was not given."""

    name: str
    now: float | None
    new: float
    unit: str = ""
    now_by: str = ""

    def __str__(self) -> str:
        before = "unknown" if self.now is None else f"{self.now:g}" + (f" ({self.now_by})" if self.now_by else "")
        return f"{self.name}: {before} -> {self.new:g} {self.unit}".rstrip()


@dataclass(frozen=True)
class InstrumentSettings:
    """Settings of an instrument. text: to type, send, or load from a file. notes: remaining errors, in sentences."""

    instrument: str
    document: str
    settings: tuple[Setting, ...]
    text: str
    notes: tuple[str, ...]


class Range(NamedTuple):
    """Range of a setting and its factory value; None if that varies."""

    least: float
    most: float
    delivered: float | None = None


@dataclass(frozen=True)
class Instrument:
    """A kind of instrument. document: its source. ranges: of its settings.

    settings: function from a calibration and the current settings, as far as known, to new settings, text and notes.
    """

    document: str
    ranges: Mapping[str, Range]
    settings: Callable[[CalibratedMounting, Mapping[str, float]], tuple[list[Setting], str, list[str]]]


def instrument_settings(
    calibrated: CalibratedMounting, name: str, now: Mapping[str, float] | None = None, force: bool = False
) -> InstrumentSettings:
    """Return the settings that correct the data; `now`: settings when the data were recorded.

    Raises InputError for an unknown instrument or setting, a value out of range, or a rejected calibration, unless
    force is set.
    """
    if name not in INSTRUMENTS:
        raise InputError(f"instrument {name!r} is not known; one of {', '.join(INSTRUMENTS)}")
    calibrated.check_applicable(force)
    instrument, given = INSTRUMENTS[name], dict(now or {})
    for key, value in given.items():
        if key not in instrument.ranges:
            raise InputError(f"{name} has no setting {key!r}; one of {', '.join(instrument.ranges)}")
        holds = instrument.ranges[key]
        if not holds.least <= value <= holds.most:
            raise InputError(
                f"{name}: {key}={value:g} is out of range, {holds.least:g} to {holds.most:g}; give the "
                "setting when the data were recorded"
            )
    delivered = {key: holds.delivered for key, holds in instrument.ranges.items() if holds.delivered is not None}
    recorded = _recorded_sound(calibrated, instrument, given)
    settings, text, notes = instrument.settings(calibrated, {**delivered, **recorded, **given})
    if calibrated.cause_of_scale is not None:
        notes.append(printable(calibrated.cause_of_scale.sentence))
    for setting in settings:
        holds = instrument.ranges[setting.name]
        if not holds.least <= setting.new <= holds.most:
            raise InputError(
                f"{setting.name} would be {setting.new:g}, out of range {holds.least:g} to {holds.most:g}; is the "
                "current setting right?"
            )
    origins = {**dict.fromkeys(delivered, AS_DELIVERED), **dict.fromkeys(recorded, AS_RECORDED)}
    marked = [replace(each, now_by="" if each.name in given else origins.get(each.name, "")) for each in settings]
    return InstrumentSettings(name, instrument.document, tuple(marked), text, tuple(notes))


def _recorded_sound(
    calibrated: CalibratedMounting, instrument: Instrument, now: Mapping[str, float]
) -> dict[str, float]:
    """Return the speed of sound used in the recording. Raises InputError if another was given."""
    used = math.nan if calibrated.water is None else calibrated.water.used
    holds = instrument.ranges.get(SPEED_OF_SOUND)
    if holds is None or not holds.least <= used <= holds.most:
        return {}
    if abs(now.get(SPEED_OF_SOUND, used) - used) > SAME_SPEED:
        raise InputError(
            f"{SPEED_OF_SOUND}={now[SPEED_OF_SOUND]:g}: the recording says that the DVL used {used:.1f} m/s; leave "
            "this setting out, or calibrate with a recording that used it"
        )
    return {SPEED_OF_SOUND: round(used, 2)}


def _water_linked(calibrated: CalibratedMounting, now: Mapping[str, float]) -> tuple[list[Setting], str, list[str]]:
    """Return settings, command to send and notes for a Water Linked DVL."""
    offset, swing = _heading(calibrated, now["mounting_rotation_offset"])
    angle = Setting("mounting_rotation_offset", now["mounting_rotation_offset"], round(offset % 360.0, 2) % 360.0, "°")
    sound, of_sound = _speed_of_sound(calibrated, now.get(SPEED_OF_SOUND))
    settings, notes = [angle, *sound], [*_residual_notes(calibrated, swing), *_delay(calibrated), *of_sound]
    command = {"command": "set_config", "parameters": {setting.name: setting.new for setting in settings}}
    return settings, json.dumps(command) + "\n", notes


def _speed_of_sound(calibrated: CalibratedMounting, now: float | None) -> tuple[list[Setting], list[str]]:
    """Return the speed of sound that corrects the scale; for an unknown setting the water's own, if recorded."""
    factor, scale = calibrated.speed_of_sound_factor, f"{100.0 * calibrated.scale_ahead:+.2f} %"
    if calibrated.model.scale_axes and now is not None:
        new = round(factor * now, 2)
        note = f"scale {scale}: equals a speed of sound error of {now - new:+.1f} m/s. It changes with the water"
        return [Setting(SPEED_OF_SOUND, now, new, "m/s")], [note]
    water = calibrated.water
    if water is not None and water.speed is not None and not math.isnan(water.salinity):
        middle, half = 0.5 * (water.speed.most + water.speed.least), 0.5 * (water.speed.most - water.speed.least)
        why = (
            "because the calibration has no scale"
            if now is not None
            else f"because the DVL's setting is unknown; if you know it, give --now {SPEED_OF_SOUND}=1500"
        )
        note = f"{SPEED_OF_SOUND}: the water's, ±{half:.1f} m/s, {why}"
        return [Setting(SPEED_OF_SOUND, now, round(middle, 1), "m/s")], [note]
    if not calibrated.model.scale_axes:
        return [], []
    note = (
        f"{SPEED_OF_SOUND}: times {factor:.5f}; give its setting (--now {SPEED_OF_SOUND}=1500), for m/s. A wrong "
        "speed of sound causes this: correct the settings of temperature and salinity first"
    )
    return [], [note]


def _cerulean(calibrated: CalibratedMounting, now: Mapping[str, float]) -> tuple[list[Setting], str, list[str]]:
    """Return settings, commands and notes for a Cerulean DVL."""
    heading, swing = _heading(calibrated, now["heading"])
    settings = [Setting("heading", now["heading"], round(math.remainder(heading, 360.0), 2), "°")]
    lines = [f"SET-SENSOR-ORIENTATION {now['roll']:g}, {now['pitch']:g}, {settings[0].new:g}"]
    notes = [*_residual_notes(calibrated, swing), *_delay(calibrated)]
    if calibrated.model.scale_axes:
        new = round(calibrated.speed_of_sound_factor * now["velocity_adjustment"], 5)
        settings.append(Setting("velocity_adjustment", now["velocity_adjustment"], new))
        lines.append(f"SET-VELOCITY-ADJUSTMENT {new:g}")
        if calibrated.cause_of_scale is not None:
            notes.append("velocity_adjustment corrects the scale: set it or the speed of sound, not both")
    return settings, "\n".join(lines) + "\n", notes


def _ardupilot(calibrated: CalibratedMounting, now: Mapping[str, float]) -> tuple[list[Setting], str, list[str]]:
    """Return settings, parameter file and notes for ArduPilot. Raises InputError if not near a quarter turn."""
    settings, notes = [], []
    if calibrated.position is None:
        notes.append(f"VISO_POS_X, _Y, _Z are not set: {POSITION_UNKNOWN}")
    else:
        for axis, value in zip("XYZ", FLU_FROM_FRD @ np.array(calibrated.position), strict=True):
            name = f"VISO_POS_{axis}"
            settings.append(Setting(name, now.get(name), round(float(value) + 0.0, 3), "m"))
        notes.append(f"VISO_POS is from {calibrated.base_frame}: move it, if the autopilot's origin is elsewhere")
    rotation = calibrated.rotation_body_from_dvl
    clockwise = -math.atan2(rotation[1, 0], rotation[0, 0])
    quarters = round(clockwise / QUARTER)
    error = math.remainder(clockwise - quarters * QUARTER, 2.0 * math.pi)
    if abs(error) > NEAR_QUARTER:
        raise InputError(
            f"ardupilot: the DVL is rotated by {math.degrees(clockwise):+.1f}° (clockwise), and VISO_ORIENT has only "
            "quarter turns; set the rest in the DVL itself (--instrument waterlinked or cerulean)"
        )
    settings.append(Setting("VISO_ORIENT", now.get("VISO_ORIENT"), float(quarters % 4 * 2)))
    if abs(error) > REPORTED_FROM_RAD:
        notes.append(
            f"{math.degrees(error):+.2f}° of yaw (clockwise) remain: VISO_ORIENT has only quarter turns. Set them in "
            "the DVL itself (--instrument waterlinked or cerulean)"
        )
    delay = round(1000.0 * calibrated.dvl_time_offset)
    if DELAY_MS[0] <= delay <= DELAY_MS[1]:
        settings.append(Setting("VISO_DELAY_MS", now.get("VISO_DELAY_MS"), float(delay), "ms"))
    else:
        notes.append(
            f"VISO_DELAY_MS allows {DELAY_MS[0]} to {DELAY_MS[1]} ms, and the DVL's stamps are {delay} ms late: "
            "correct its clock"
        )
    if calibrated.model.scale_axes:
        notes.append(f"the DVL's scale, {100.0 * calibrated.scale_ahead:+.2f} %, is its own to set")
    return settings, "".join(f"{setting.name},{setting.new:g}\n" for setting in settings), notes


def _heading(calibrated: CalibratedMounting, now_deg: float) -> tuple[float, Array]:
    """Return the clockwise angle, degrees, to set, and the remaining rotation (3, 3), forward-right-down.

    The angle is from the vehicle's forward axis to the DVL's, and corrects the error found relative to the configured
    mounting.
    """
    configured = calibrated.parameters.rotation_dvl_from_body
    found = configured @ calibrated.rotation_body_from_dvl
    if not _is_down(calibrated):
        found = FLU_FROM_FRD @ found @ FLU_FROM_FRD
    rotation = found @ rotation_from_rpy(np.array([0.0, 0.0, math.radians(now_deg)]))
    *_, z, w = quaternion_from_rotation(rotation)
    angle = 2.0 * math.atan2(z, w)  # the rotation about the DVL's z axis; the rest is about a horizontal one
    return math.degrees(angle), rotation @ rotation_from_rpy(np.array([0.0, 0.0, -angle]))


def _is_down(calibrated: CalibratedMounting) -> bool:
    """Return whether the calibrated axes are a downward-looking DVL's own, forward-right-down."""
    return bool(calibrated.parameters.rotation_dvl_from_body[2, 2] < 0.0)


def _residual_notes(calibrated: CalibratedMounting, swing: Array) -> list[str]:
    """Return notes on roll and pitch, which the instrument cannot correct; swing: (3, 3) left after its heading."""
    roll_pitch = np.abs(rpy_from_rotation(swing)[:2])
    notes = ["URDF and parameters stay unchanged: do not write this result into them as well"]
    if roll_pitch.max() <= REPORTED_FROM_RAD:
        return notes
    axes = swing if _is_down(calibrated) else FLU_FROM_FRD @ swing @ FLU_FROM_FRD
    mounting = calibrated.parameters.rotation_dvl_from_body.T @ axes
    of_frame = mounting @ FLU_FROM_FRD if calibrated.turned else mounting
    degrees = ", ".join(f"{math.degrees(angle):.2f}°" for angle in roll_pitch)
    return [
        *notes,
        f"roll and pitch ({degrees}) are no setting of the instrument: with it set, give the URDF rpy="
        f'"{numbers(rpy_from_rotation(of_frame))}" (mounting_rpy {numbers(rpy_from_rotation(mounting))})',
    ]


def _delay(calibrated: CalibratedMounting) -> list[str]:
    """Return a note on a DVL delay, for which the instrument has no setting."""
    delay_s = calibrated.dvl_time_offset
    return (
        [f"the DVL's stamps are {delay_s:+.3f} s late against the IMU's, for which the instrument has no setting"]
        if delay_s
        else []
    )


INSTRUMENTS: Mapping[str, Instrument] = {
    "waterlinked": Instrument(
        "Water Linked DVL protocol, JSON over TCP, set_config; axes: vehicle frame (docs.waterlinked.com/dvl)",
        {"mounting_rotation_offset": Range(0.0, 360.0, 0.0), SPEED_OF_SOUND: Range(1000.0, 2000.0)},
        _water_linked,
    ),
    "cerulean": Instrument(
        "Cerulean Sonar, commands accepted by the DVL-75 and the Tracker 650 (docs.ceruleansonar.com)",
        {
            **dict.fromkeys(("heading", "roll", "pitch"), Range(-360.0, 360.0, 0.0)),
            "velocity_adjustment": Range(0.8, 1.25, 1.0),
        },
        _cerulean,
    ),
    "ardupilot": Instrument(
        "ArduPilot's complete parameter list, VISO_ (ardupilot.org/sub)",
        {
            **dict.fromkeys(("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"), Range(-5.0, 5.0)),
            "VISO_ORIENT": Range(0.0, 25.0),
            "VISO_DELAY_MS": Range(*DELAY_MS),
        },
        _ardupilot,
    ),
}


# Configuration of a Water Linked DVL over TCP by its protocol (get_config, set_config).

PORT = 16171
ADDRESS = re.compile(r"(?:\[(?P<ipv6>[0-9A-Fa-f:.%\w]+)\]|(?P<host>[^:\[\]]+))(?::(?P<port>\d{1,5}))?", re.ASCII)
# a DVL without an answer within this time, s, is not there; a longer line, bytes, is no report
PATIENCE_S, LONGEST_LINE = 10.0, 1 << 20
# characters shown of the reason for a refusal
LONGEST_REASON = 200
# Resolution of a setting: two decimals. Firmware before 2.2.1 has whole degrees and m/s, and must be set by hand.
AS_SET = 0.0051


def configure(address: str, settings: Sequence[Setting], dry_run: bool = False) -> bool:
    """Send new settings and read them back; send nothing if dry_run. Return whether they were already set.

    address: HOST or HOST:PORT, an IPv6 address in brackets. Raises InputError if there is no answer or a refusal, or if
    another value is read back. Also if the current settings are not the recording's: the calibration is relative to
    these.
    """
    parts = ADDRESS.fullmatch(address)
    port = int(parts["port"] or PORT) if parts is not None else 0
    if parts is None or not 0 < port < 65536:
        raise InputError(f"--send {address}: is not HOST or HOST:PORT (IPv6 in brackets: [::1])")
    is_sent = False
    try:
        with socket.create_connection((parts["ipv6"] or parts["host"], port), timeout=PATIENCE_S) as connection:
            dvl = _Dvl(connection, address)
            before = dvl.ask({"command": "get_config"})
            if all(_is_set_to(before, setting.name, setting.new) for setting in settings):
                return True
            for each in settings:
                if each.now is None or not _is_set_to(before, each.name, each.now):
                    raise InputError(
                        f"{address}: {each.name} is {_number(before, each.name)}, and was {each.now} when the "
                        "data were recorded (--now), which the calibration is relative to; record again, or set "
                        "it yourself"
                    )
            if dry_run:
                return False
            is_sent = True
            dvl.ask({"command": "set_config", "parameters": {setting.name: setting.new for setting in settings}})
            after = dvl.ask({"command": "get_config"})
    except UnicodeError as error:
        raise InputError(f"--send {address}: is no name that a host can have; give its name or address") from error
    except OSError as error:
        why = error.strerror or "no answer"
        if is_sent:
            raise InputError(
                f"{address}: {why} after set_config was sent, so the DVL may be set or not; repeat the command, "
                "which first reads the current settings"
            ) from error
        raise InputError(f"{address}: {why}; is the DVL on, and the address right?") from error
    for setting in settings:
        if not _is_set_to(after, setting.name, setting.new):
            raise InputError(
                f"{address}: {setting.name} was set to {setting.new:g} and is {_number(after, setting.name)}; "
                "look at the DVL's own page"
            )
    return False


def _number(config: Any, name: str) -> float | str:
    """Return the number that a DVL has under a name."""
    held = config.get(name) if isinstance(config, dict) else None
    return held if isinstance(held, float) else "no number"


def _is_set_to(config: Any, name: str, value: float) -> bool:
    held = _number(config, name)
    return isinstance(held, float) and abs(held - value) <= AS_SET


class _Dvl:
    """A connection on which reports come between the answers."""

    def __init__(self, connection: socket.socket, address: str) -> None:
        self._connection, self._address, self._pending = connection, address, b""

    def ask(self, command: dict[str, Any]) -> Any:
        """Return the result of a command. Raises InputError if it is refused, OSError if no answer comes."""
        self._connection.sendall(json.dumps(command).encode() + b"\n")
        until = time.monotonic() + PATIENCE_S
        while True:
            line = self._read_line(until)
            try:
                answer = json.loads(line, parse_int=float)  # as float, because an integer may be too long to parse
            except (ValueError, RecursionError):
                continue
            if not isinstance(answer, dict) or answer.get("response_to") != command["command"]:
                continue
            if answer.get("success") is not True:
                message = answer.get("error_message")
                why = message[:LONGEST_REASON] if message and isinstance(message, str) else "no reason given"
                raise InputError(f"{self._address}: refuses {command['command']} ({why})")
            return answer.get("result")

    def _read_line(self, until: float) -> bytes:
        """Return the next line from the instrument. Raises TimeoutError at the monotonic time `until`."""
        while b"\n" not in self._pending:
            remaining = until - time.monotonic()
            if remaining <= 0.0 or len(self._pending) > LONGEST_LINE:
                raise TimeoutError("no answer")
            self._connection.settimeout(remaining)
            got = self._connection.recv(1 << 16)
            if not got:
                raise ConnectionResetError(0, "it closed the connection")
            self._pending += got
        line, _, self._pending = self._pending.partition(b"\n")
        return line
