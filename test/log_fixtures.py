"""Small logs of instruments and vehicles, written as these write them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

# 2021-11-29 12:31:11 UTC
START_S = 1_638_189_071


def telemetry(path: Path, *, other: bool = False) -> Path:
    """As a ground station writes it, by pymavlink's own packing."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    packers = [mavlink.MAVLink(None, srcSystem=each) for each in ((1, 2) if other else (1,))]
    with path.open("wb") as file:
        for i in range(40):
            boot_ms, us = 100 * i, round((START_S + 0.1 * i) * 1e6)
            for mav in packers:
                sure = 90.0 if i % 8 else 0.0
                messages = [
                    mav.attitude_encode(boot_ms, 0.1, -0.05, 0.5 + 0.01 * i, 0.0, 0.0, 0.1),
                    mav.vision_position_delta_encode(us, 100_000, [0.0, 0.0, 0.0], [0.15, 0.02, -0.01], sure),
                ]
                if i % 2 == 0:
                    fix = 3 if i else 1
                    messages.append(mav.gps_raw_int_encode(us, fix, 0, 0, 0, 100, 100, 150, 9000, 10))
                for message in messages:
                    file.write(struct.pack(">Q", us) + message.pack(mav))
    return path


def dataflash(path: Path) -> Path:
    """As the autopilot writes it: a table of formats, and rows by them."""
    formats = {
        "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
        "GPS": (129, "QBBIHBcLLefffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
        "ATT": (130, "Qccccff", "TimeUS,Roll,Pitch,Yaw,DesYaw,ErrRP,ErrYaw"),
        "VISO": (131, "Qffffffff", "TimeUS,dt,AngDX,AngDY,AngDZ,PosDX,PosDY,PosDZ,conf"),
    }
    codes = {"L": "i", "c": "h", "e": "i", "n": "4s", "N": "16s", "Z": "64s"}  # the others are struct's
    packed = {name: "<" + "".join(codes.get(each, each) for each in form) for name, (_, form, _) in formats.items()}
    rows = bytearray()

    def row(name: str, *values) -> None:
        rows.extend(b"\xa3\x95" + bytes([formats[name][0]]) + struct.pack(packed[name], *values))

    for name, (number, form, columns) in formats.items():
        length = 3 + struct.calcsize(packed[name])
        row("FMT", number, length, name.encode(), form.encode(), columns.encode())
    week_ms = (START_S - 315964800 + 18) * 1000
    for i in range(40):
        us, ms = 5_000_000 + 100_000 * i, week_ms + 100 * i
        if i % 2 == 0:
            week, rest = divmod(ms, 7 * 86_400_000)
            row("GPS", us, 0, 3, rest, week, 12, 80, 0, 0, 0, 1.5, 90.0, 0.02, 1)
        row("ATT", us, 573, -286, 2865 + 57 * i, 0, 0.0, 0.0)
        row("VISO", us, 0.1 if i < 20 else 100_000.0, 0.0, 0.0, 0.0, 0.15, 0.02, -0.01, 90.0 if i % 8 else 0.0)
    path.write_bytes(bytes(rows))
    return path


def ensemble(
    millimetres: Sequence[int],
    hundredths: int,
    axes: int = 2,
    checksum: int = 0,
    *,
    configuration: tuple[int, int] = (0, 0),
    flags: int = 0,
    attitude: tuple[int, int, int] = (0, 0, 0),
    length: int = 65,
    alignment: int = 0,
    nmea: Sequence[bytes] = (),
) -> bytes:
    """A PD0 ensemble with fixed leader, variable leader and bottom track, by the format's table of bytes.

    hundredths: of a second, since 10:30:15. attitude: heading, pitch, roll, 0.01 degrees, as is alignment (EA).
    nmea: what `general_nmea` gives.
    """
    fixed, variable, bottom = bytearray(59), bytearray(65), bytearray(81)
    fixed[4:6] = bytes(configuration)
    fixed[25] = axes << 3 | flags
    struct.pack_into("<h", fixed, 26, alignment)
    minute, rest = divmod(1500 + hundredths, 6000)
    struct.pack_into("<H", variable, 0, 0x0080)
    variable[4:11] = bytes([25, 11, 21, 10, 30 + minute, rest // 100, rest % 100])
    struct.pack_into("<H2h", variable, 18, *attitude)
    struct.pack_into("<H", bottom, 0, 0x0600)
    struct.pack_into(f"<{len(millimetres)}h", bottom, 24, *millimetres)
    # of the leaders and bottom track the variable leader last, as `length` cuts it off
    parts = [bytes(fixed), bytes(bottom), bytes(variable[:length]), *nmea]
    offsets, at = [], 6 + 2 * len(parts)
    for part in parts:
        offsets.append(at)
        at += len(part)
    body = b"\x7f\x7f" + struct.pack(f"<HBB{len(parts)}H", at, 0, len(parts), *offsets) + b"".join(parts)
    return body + struct.pack("<H", (sum(body) + checksum) & 0xFFFF)


def pd0(i: int, heading: int, pitch: int, roll: int, nmea: Sequence[bytes] = ()) -> bytes:
    """An ensemble of each 0.1 s."""
    return ensemble((10, -1500, 0, 0), 10 * i, attitude=(heading, pitch, roll), nmea=nmea)


def nortek(
    i: int,
    velocity: Sequence[float],
    late: float = 0.0,
    status: int = 0xFFFFF,
    fom: float = 0.004,
    identity: int = 0x1B,
) -> bytes:
    """A record of each 0.125 s of bottom track, by the tables of Nortek's guide. velocity: X, Y, Z1, Z2."""
    seconds, fraction = divmod(1250 * i, 10_000)
    leader = struct.pack(
        "<BBI6BHHII3f", 1, 46, 123456, 125, 10, 21, 10, 30, 15 + seconds, fraction, 4, 0, status, 1500.0, 8.0, 2.0
    )
    by_axis = struct.pack("<20f", *velocity, *[fom] * 4, *[late] * 4, *[0.1] * 4, *[0.02] * 4)
    data = leader + struct.pack("<24f", *range(24)) + by_axis
    header = struct.pack("<BBBBHH", 0xA5, 10, identity, 0x10, len(data), _nortek_checksum(data))
    return header + struct.pack("<H", _nortek_checksum(header)) + data


def _nortek_checksum(data: bytes) -> int:
    value = 0xB58C
    for at in range(0, len(data) - 1, 2):
        value += data[at] | data[at + 1] << 8
    return (value + (data[-1] << 8) * (len(data) % 2)) & 0xFFFF


def general_nmea(specific: int, body: bytes, delta: float) -> bytes:
    """Data of ID 2022h, by the tables of bytes in RDI's guides."""
    return struct.pack("<HHHd", 0x2022, specific, len(body), delta) + body


def sentence(text: str) -> bytes:
    """NMEA with its checksum, as received."""
    checksum = 0
    for character in text:
        checksum ^= ord(character)
    return f"${text}*{checksum:02X}\r\n".encode()


def rmc(second: float, knots: str, course: str, status: str = "A") -> str:
    text = f"GNRMC,1231{second:05.2f},{status},5321.68,N,00630.34,W,{knots},{course},291121,,,A"
    return sentence(text).decode().strip()
