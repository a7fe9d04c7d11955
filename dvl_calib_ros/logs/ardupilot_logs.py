"""Logs of ArduPilot: DataFlash (.BIN) of the autopilot and telemetry (.tlog) of a ground station.

Both have the autopilot's inputs from the DVL (VISO, VISION_POSITION_DELTA: displacement, forward-right-down) and the
GNSS receiver (GPS, GPS_RAW_INT; not the output of the autopilot's filter, which uses the DVL), and its attitude (ATT,
ATTITUDE). Names and units follow ArduPilot's log messages and MAVLink's common messages. pymavlink reads the files.
Telemetry is stamped on arrival.
"""

from __future__ import annotations

import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.numerics.frames import FLU_FROM_FRD, Array, over_ground
from ..calibration.numerics.samples import DvlSample, ReferenceSample, VelocityFrame
from ..errors import InputError
from .dvl_log import DvlLog, imu_samples

# a 3-D fix
_FIX = 3
# longer intervals are in µs: ArduPilot's own messages use both units
_LONGEST_S = 5.0


def is_dataflash(start: bytes) -> bool:
    """Return whether these bytes begin a DataFlash log."""
    return start.startswith(b"\xa3\x95")


def is_telemetry(start: bytes) -> bool:
    """Return whether these bytes begin with two messages of MAVLink, each behind its 8 bytes of time."""
    marker, length, flags = (start[8:11] + bytes(3))[:3]
    head = {0xFE: 8, 0xFD: 12 + 13 * (flags & 1)}.get(marker)
    return head is not None and start[16 + head + length : 17 + head + length] in (b"\xfe", b"\xfd")


def read_ardupilot_log(path: Path, start: bytes) -> DvlLog:
    """Read the log that begins with `start`. Raises InputError if pymavlink is not installed, or the log has no DVL.

    pymavlink's own choice of a reader is by name: it runs a file in a folder `bin`, and connects to `udp:`.
    """
    try:
        from pymavlink import DFReader, mavutil
    except ImportError as error:
        raise InputError(f"{path}: is read by pymavlink; pip install 'dvl_calib_ros[ardupilot]'") from error

    class Dataflash(DFReader.DFReader_binary):  # type: ignore[misc]
        """pymavlink's reader, which reads a message of no length, by a damaged table of formats, for ever."""

        offset: int

        def _parse_next(self) -> Any:
            before, message = self.offset, super()._parse_next()
            while message is not None and self.offset <= before:
                self.offset = before = before + 1
                message = super()._parse_next()
            return message

    read = _VehicleMessages()
    wanted = list(_TAKERS)
    try:
        with _silenced():
            log = (Dataflash if is_dataflash(start) else mavutil.mavmmaplog)(str(path))
            with closing(log):
                while (message := log.recv_match(type=wanted)) is not None:
                    read.take(message)
    except Exception as error:  # pymavlink's errors on damaged logs have no common class
        if not read.moved:
            raise InputError(f"{path}: cannot be read as a log of ArduPilot ({error})") from error
        read.left_out["behind damage"] += 1
    return read.finished()


@contextmanager
def _silenced() -> Iterator[None]:
    """Discard printed output: pymavlink, and its indexer in C, print a line for each damaged byte."""
    kept = os.dup(2)
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        sys.stderr.flush()
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


class _VehicleMessages:
    """Messages of one vehicle so far."""

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self.moved: list[tuple[int, list[float]]] = []  # stamp, velocity forward-right-down
        self.fixes: list[tuple[int, list[float]]] = []  # stamp, velocity north-east-down
        self.turned: list[tuple[int, list[float]]] = []  # stamp, roll, pitch, yaw
        self._vehicle: int | None = None

    def take(self, message: Any) -> None:
        """Add a message, unless it is another vehicle's."""
        source = getattr(message, "get_srcSystem", lambda: 0)()
        if self._vehicle is None:
            self._vehicle = source
        if source != self._vehicle:
            self.left_out["of another vehicle"] += 1
            return
        stamp_ns = round(message._timestamp * 1e9)
        if not 0 < stamp_ns < 2**31 * 1_000_000_000:
            self.left_out["without a time"] += 1
            return
        _TAKERS[message.get_type()](self, stamp_ns, message)

    def _delta(self, stamp_ns: int, metres: Array, seconds: float, is_good: bool) -> None:
        """Add the mean velocity over a displacement (m) in a time (s), stamped at its middle."""
        if not (is_good and seconds > 0.0 and np.isfinite(metres).all()):
            self.left_out["without bottom lock"] += 1
            return
        # the mean over the interval belongs to its middle
        self.moved.append((stamp_ns - round(0.5e9 * seconds), (metres / seconds).tolist()))

    def viso(self, stamp_ns: int, m: Any) -> None:
        seconds = m.dt if m.dt < _LONGEST_S else 1e-6 * m.dt
        self._delta(stamp_ns, np.array([m.PosDX, m.PosDY, m.PosDZ]), seconds, m.conf > 0.0)

    def vision_position_delta(self, stamp_ns: int, m: Any) -> None:
        self._delta(stamp_ns, np.array(m.position_delta), 1e-6 * m.time_delta_usec, m.confidence > 0.0)

    def gps(self, stamp_ns: int, m: Any) -> None:
        if getattr(m, "I", 0) == 0:
            self._fix(stamp_ns, m.Status, m.Spd, m.GCrs, m.VZ)

    def gps_raw_int(self, stamp_ns: int, m: Any) -> None:
        """Add a velocity of MAVLink's GPS_RAW_INT, unless it is marked as unknown."""
        if m.vel == 65535 or m.cog == 65535:
            self.left_out["without a velocity of GNSS"] += 1
            return
        self._fix(stamp_ns, m.fix_type, 0.01 * m.vel, 0.01 * m.cog, 0.0)  # no vertical velocity, marked by exactly 0

    def _fix(self, stamp_ns: int, status: int, speed: float, course_deg: float, down: float) -> None:
        """Add a GNSS velocity, north-east-down, from speed (m/s), course (°) and velocity down (m/s)."""
        if status < _FIX or not math.isfinite(speed + course_deg + down):
            self.left_out["without a fix"] += 1
            return
        east, north, _ = over_ground(speed, math.radians(course_deg)).tolist()
        self.fixes.append((stamp_ns, [north, east, down]))

    def att(self, stamp_ns: int, m: Any) -> None:
        self.turned.append((stamp_ns, [math.radians(angle) for angle in (m.Roll, m.Pitch, m.Yaw)]))

    def attitude(self, stamp_ns: int, m: Any) -> None:
        self.turned.append((stamp_ns, [m.roll, m.pitch, m.yaw]))

    def finished(self) -> DvlLog:
        """Return the samples in order of time."""
        samples = [DvlSample(at, _tuple(FLU_FROM_FRD @ np.array(frd)), None) for at, frd in self.moved]
        references = [ReferenceSample(at, _tuple(ned), None, VelocityFrame.NED) for at, ned in _in_order(self.fixes)]
        turned = _in_order(self.turned)
        attitudes = imu_samples([at for at, _ in turned], np.array([row for _, row in turned]).reshape(-1, 3))
        return DvlLog(samples, self.left_out, references, attitudes)


def _in_order(rows: list[tuple[int, list[float]]]) -> list[tuple[int, list[float]]]:
    return sorted({at: (at, row) for at, row in rows if np.isfinite(row).all()}.values())


def _tuple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z


_TAKERS = {
    "VISO": _VehicleMessages.viso,
    "VISION_POSITION_DELTA": _VehicleMessages.vision_position_delta,
    "GPS": _VehicleMessages.gps,
    "GPS_RAW_INT": _VehicleMessages.gps_raw_int,
    "ATT": _VehicleMessages.att,
    "ATTITUDE": _VehicleMessages.attitude,
}
