"""Text formats of DVLs: Teledyne's PD6, Nortek's PNORBT and Cerulean's DVPDL sentences.

PD6 (Pathfinder and Wayfinder guides): ``:TS`` time, ``:SA`` pitch, roll, heading, ``:BI`` the instrument's motion over
the bottom in mm/s, starboard, forward, up. PNORBT (Nortek, "DVL Integrator's Guide"): forward, starboard, down, stamped
by a preceding beam's sentence or by themselves. DVPDL (Cerulean, DVL-75 and Tracker 650): displacement forward,
starboard, down over an interval, stamped since boot, which is converted to time since 1970.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ..calibration.numerics.samples import DvlSample
from .dvl_log import DvlLog, imu_samples
from .pd0_nmea import checksum_of

_SECOND_NS = 1_000_000_000
_SENTENCE = re.compile(rb"\$((?:PNORBT|DVPDL)[^*\r\n]*)\*([0-9A-Fa-f]{2})")
_PD6 = re.compile(rb":(TS|SA|BI),([^:\r\n]*)")
# sentences with a velocity or its stamp
_BEAM_TIME, _VELOCITY, _STAMPED, _DISPLACEMENT = "PNORBT1", "PNORBT4", "PNORBT7", "DVPDL"
_FASTEST_MPS = 30.0  # instruments write ±32.767 without bottom lock


def is_pd6(content: bytes) -> bool:
    """Return whether there are bottom-track lines of PD6."""
    return {b"TS", b"BI"} <= {kind for kind, _ in _PD6.findall(content)}


def is_sentences(content: bytes) -> bool:
    """Return whether there is a sentence with a DVL's velocity."""
    return re.search(rb"\$(PNORBT[47]|DVPDL),", content) is not None


def read_pd6(path: Path, content: bytes) -> DvlLog:
    """Read PD6, with heading, pitch and roll from the DVL's own sensors."""
    samples: list[DvlSample] = []
    attitudes: dict[int, tuple[float, ...]] = {}
    left_out: Counter[str] = Counter()
    stamp_ns = 0
    tilt: tuple[float, ...] | None = None
    for kind, text in _PD6.findall(content):
        fields = text.decode("ascii", "replace").split(",")
        try:
            if kind == b"TS":
                second = datetime.strptime(fields[0][:12], "%y%m%d%H%M%S").replace(tzinfo=timezone.utc)
                stamp_ns = int(second.timestamp()) * _SECOND_NS + int(fields[0][12:14]) * 10_000_000
                if tilt is not None:  # the tilt precedes its time
                    attitudes[stamp_ns] = tilt
            elif kind == b"SA":
                pitch, roll, heading = (math.radians(float(field)) for field in fields[:3])
                tilt = roll, pitch, heading
            else:
                starboard, forward, up = (0.001 * float(field) for field in fields[:3])
                _add(samples, left_out, stamp_ns, (forward, -starboard, up), fields[4].strip() == "A")
        except (ValueError, IndexError):
            left_out["damaged"] += 1
    stamps = sorted(attitudes)
    rpy = np.array([attitudes[stamp] for stamp in stamps]).reshape(-1, 3)
    note = f"{path}: heading, pitch and roll are from the DVL's own sensors; give --attitude for another source"
    attitude = imu_samples(stamps, rpy) if len(rpy) and np.ptp(rpy, axis=0).any() else []
    return DvlLog(samples, left_out, (), attitude, (note,) if attitude else (), nominal_yaw=0.0 if attitude else None)


def read_sentences(_: Path, content: bytes) -> DvlLog:
    """Read sentences of Nortek or Cerulean; those with a wrong checksum are skipped."""
    samples: list[DvlSample] = []
    left_out: Counter[str] = Counter()
    beam_ns = 0
    for text, checksum in _SENTENCE.findall(content):
        name, *fields = text.decode("ascii", "replace").split(",")
        if checksum_of(text) != int(checksum, 16):
            left_out["with a wrong checksum"] += 1
            continue
        try:
            if name == _BEAM_TIME:
                named = dict(field.split("=") for field in fields)
                time, _, decimals = named["TIME"].partition(".")
                second = datetime.strptime(named["DATE"] + time, "%m%d%y%H%M%S").replace(tzinfo=timezone.utc)
                beam_ns = int(second.timestamp()) * _SECOND_NS + round(float(f"0.{decimals or 0}") * 1e9)
            elif name == _VELOCITY:
                x, y, _fom, z1, z2 = map(float, fields[2:7])
                _add(samples, left_out, beam_ns, (x, -y, -0.5 * (z1 + z2)))
            elif name == _STAMPED:
                x, y, z = map(float, fields[3:6])
                _add(samples, left_out, round(float(fields[0]) * 1e9), (x, -y, -z))
            elif name == _DISPLACEMENT:
                seconds = 1e-6 * float(fields[1])
                x, y, z = (float(field) / seconds for field in fields[5:8])
                # over the interval that ends at the stamp
                middle_ns = round(1e3 * float(fields[0]) - 0.5e9 * seconds)
                _add(samples, left_out, _SECOND_NS + middle_ns, (x, -y, -z), float(fields[8]) > 0.0)
        except (ValueError, KeyError, IndexError, ZeroDivisionError):
            left_out["damaged"] += 1
    return DvlLog(samples, left_out)


def _add(
    samples: list[DvlSample],
    left_out: Counter[str],
    stamp_ns: int,
    velocity: tuple[float, float, float],
    is_valid: bool = True,
) -> None:
    """Add a velocity (forward-left-up, m/s), or count the reason why it is invalid."""
    if not is_valid or not max(map(abs, velocity)) < _FASTEST_MPS:
        left_out["without bottom lock"] += 1
    elif stamp_ns <= 0:
        left_out["without a time"] += 1
    else:
        samples.append(DvlSample(stamp_ns, velocity, None))
