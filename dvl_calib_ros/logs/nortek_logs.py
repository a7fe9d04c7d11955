"""Logs of Nortek's DVLs (DVL 300 to 1000; .ad2cp or captured from a port): bottom track of data format 21.

Nortek, "DVL Integrator's Guide": records with the ID 1Bh, X forward, Y starboard, Z down, m/s, stamped at the trigger;
the bottom echo comes the time DT1 later. Two pairs of beams measure Z separately.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from datetime import datetime, timezone

import numpy as np

from ..calibration.numerics.frames import FLU_FROM_FRD
from ..calibration.numerics.samples import DvlSample
from ..messages.encode import WaterReading

_SYNC, _BOTTOM_TRACK = 0xA5, 0x1B
# sync, size of the header, ID, family, size of the data, its checksum, the header's own
_HEADER = struct.Struct("<BBBBHHH")
_CHECKSUM_START = 0xB58C
# version, offset of data, serial, date and time, 100 µs, beams, error, status, sound speed, temperature, pressure
_LEADER = struct.Struct("<BBI6BHHII3f")
# six quantities by beam; then X, Y, Z1, Z2 of velocity, figure of merit, DT1
_BY_BEAM, _BY_AXIS = struct.Struct("<24f"), struct.Struct("<12f")
# status bits for valid velocities of X, Y, Z1, Z2
_VALID = (1 << 12, 1 << 13, 1 << 14, 1 << 15)
# a velocity that was not measured, m/s; upper limit of DT1, s
_BAD_VELOCITY, _LONGEST_DT_S = -32.0, 1.0


def is_nortek_log(start: bytes) -> bool:
    """Return whether a record of bottom track begins in the first bytes of a file."""
    return any(True for _ in _records(start))


def read_nortek_log(content: bytes) -> tuple[list[DvlSample], Counter[str], list[WaterReading]]:
    """Return samples (forward-left-up), the number of unusable records by reason, and water properties."""
    samples: list[DvlSample] = []
    waters: list[WaterReading] = []
    left_out: Counter[str] = Counter()
    for data in _records(content):
        if data is None:
            left_out["damaged"] += 1
            continue
        try:
            sample = _sample(data)
        except (struct.error, ValueError, OverflowError):
            left_out["damaged"] += 1
            continue
        if sample is None:
            left_out["without bottom lock"] += 1
        else:
            samples.append(sample)
            *_, used, temperature, _ = _LEADER.unpack_from(data)
            waters.append(WaterReading(sample.stamp_ns, used, temperature, math.nan))
    return samples, left_out, waters


def _records(content: bytes) -> Iterator[bytes | None]:
    """Yield the data of each bottom-track record with a sound header; None if damaged or cut off."""
    start = 0
    while (at := content.find(_SYNC, start)) >= 0:
        start = at + 1
        if at + _HEADER.size > len(content):
            return
        _, size, identity, _, length, checksum, own = _HEADER.unpack_from(content, at)
        if size != _HEADER.size or _sum(content[at : at + size - 2]) != own:
            continue
        data = content[at + size : at + size + length]
        if len(data) < length or _sum(data) != checksum:
            if identity == _BOTTOM_TRACK:
                yield None
            continue
        start = at + size + length
        if identity == _BOTTOM_TRACK:
            yield data


def _sum(data: bytes) -> int:
    """Return Nortek's checksum: the sum of 16-bit words, modulo 2^16; an odd last byte is the high byte of a word."""
    even = data[: len(data) & ~1]
    total = _CHECKSUM_START + sum(struct.unpack(f"<{len(even) // 2}H", even))
    return (total + (data[-1] << 8 if len(data) % 2 else 0)) & 0xFFFF


def _sample(data: bytes) -> DvlSample | None:
    """Return a record's velocity, with the mean of its valid vertical velocities; None without bottom lock."""
    _, _, _, year, month, day, hour, minute, second, fraction, _, _, status, *_ = _LEADER.unpack_from(data)
    values = np.array(_BY_AXIS.unpack_from(data, _LEADER.size + _BY_BEAM.size), dtype=float).reshape(3, 4)
    velocity, noise, delay = values
    valid = np.array([bool(status & bit) for bit in _VALID]) & np.isfinite(velocity) & (velocity > _BAD_VELOCITY)
    if not (valid[0] and valid[1] and valid[2:].any()):
        return None
    # as in C's struct tm: years since 1900, months from 0
    whole_second = datetime(1900 + year, month + 1, day, hour, minute, second, tzinfo=timezone.utc)
    dt = float(delay[:2].mean())
    stamp_ns = int(whole_second.timestamp()) * 1_000_000_000 + fraction * 100_000
    stamp_ns += round(1e9 * dt) if 0.0 <= dt < _LONGEST_DT_S else 0
    weights = valid[2:] / valid[2:].sum()
    vertical = float(np.where(valid[2:], velocity[2:], 0.0) @ weights)
    stds = [*noise[:2].tolist(), float(np.where(valid[2:], noise[2:], 0.0) @ weights)]
    covariance = np.diag(np.square(stds)) if all(math.isfinite(std) and std > 0.0 for std in stds) else None
    x, y, z = (FLU_FROM_FRD @ [velocity[0], velocity[1], vertical] + 0.0).tolist()
    return DvlSample(stamp_ns, (x, y, z), covariance)
