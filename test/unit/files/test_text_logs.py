"""Text of instruments, and tables of any layout by a map of columns, become bags with the velocities that they hold."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from log_fixtures import sentence

from dvl_calib_ros.bags.reader import BagReader

BEGIN = datetime(2024, 5, 3, 9, 0, 0, 250_000, tzinfo=timezone.utc)
# forward, starboard, down
VELOCITIES = [(1.5, 0.1, -0.02), (1.4, -0.2, 0.01), (1.6, 0.0, 0.03)]
MOMENTS = [BEGIN + timedelta(seconds=0.25 * number) for number in range(len(VELOCITIES))]
STAMPS_NS = [int(at.replace(microsecond=0).timestamp()) * 10**9 + at.microsecond * 1000 for at in MOMENTS]


def nmea(text: str) -> str:
    return sentence(text).decode()


def pd6(at: datetime, forward: float, starboard: float, down: float, status: str = "A") -> str:
    x, y, z = (round(1000 * each) for each in (starboard, forward, -down))
    time = f"{at:%y%m%d%H%M%S}{at.microsecond // 10_000:02d}"
    tilt, water = f":SA, {x / 100:+.2f}, +0.59, 67.08", f":TS,{time},35.0,+15.0,0.5,1500.0,0"
    return f"{tilt}\r\n{water}\r\n:BI,{x:+6d},{y:+6d},{z:+6d},+2,{status}\r\n"


def pnorbt(at: datetime, forward: float, starboard: float, down: float) -> str:
    time = f"{at:%H%M%S}.{at.microsecond // 100:04d}"
    beam = nmea(f"PNORBT1,BEAM=1,DATE={at:%m%d%y},TIME={time},DT1=0.0,DT2=0.0,BV=0.1,FOM=0.005,DIST=12.3,WD=12.0")
    return beam + nmea(f"PNORBT4,0.00,0.00,{forward:.4f},{starboard:.4f},0.005,{down:.4f},{down:.4f},0.005,0.005,12")


def pnorbt7(at: datetime, forward: float, starboard: float, down: float) -> str:
    return nmea(f"PNORBT7,{at.timestamp():.4f},0.0,0.0,{forward},{starboard},{down},0.005,12,12,12,12")


def dvpdl(at: datetime, forward: float, starboard: float, down: float) -> str:
    since_boot_us = (at - BEGIN).total_seconds() * 1e6 + 125_000  # the middle of the interval is the moment
    x, y, z = (0.25 * each for each in (forward, starboard, down))
    return nmea(f"DVPDL,{since_boot_us:.0f},250000,0.0,0.0,0.0,{x:.5f},{y:.5f},{z:.5f},95")


def row(at: datetime, *velocity: float) -> str:
    return f"{at:%m/%d/%Y};{at:%H:%M:%S}.{at.microsecond // 10_000:02d};a;1;{';'.join(map(str, velocity))}\n"


def imported(path: Path) -> tuple[list[int], np.ndarray]:
    """Stamps, and velocities forward-left-up."""
    with BagReader([path]) as bag:
        messages = [message for _, _, message, _ in bag.messages(["dvl/twist"])]
    linear = [message.twist.twist.linear for message in messages]
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in messages]
    return stamps, np.array([(each.x, each.y, each.z) for each in linear])


TEXTS = {"pd6": pd6, "pnorbt": pnorbt, "pnorbt7": pnorbt7, "dvpdl": dvpdl}


@pytest.mark.parametrize("kind", TEXTS)
def test_velocities_and_times_of_an_instruments_text(tmp_path, capsys, kind):
    text = "".join(TEXTS[kind](at, *each) for at, each in zip(MOMENTS, VELOCITIES, strict=True))
    (tmp_path / "dvl.txt").write_text(text, newline="")
    succeed(capsys, "import", tmp_path / "dvl.txt", "-o", tmp_path / "bag")
    stamps, velocities = imported(tmp_path / "bag")
    np.testing.assert_allclose(velocities, np.array(VELOCITIES) * [1, -1, -1], atol=1.1e-3 if kind == "pd6" else 1e-4)
    late = np.subtract(stamps, 1_000_000_000 if kind == "dvpdl" else STAMPS_NS[0])
    np.testing.assert_allclose(late, [0, 250_000_000, 500_000_000], atol=100_000)


def test_text_without_lock_or_with_a_wrong_checksum_is_counted(tmp_path, capsys):
    lines = [pd6(MOMENTS[0], *VELOCITIES[0]), pd6(MOMENTS[1], *VELOCITIES[1], "V"), pd6(MOMENTS[2], 32.767, 0, 0)]
    (tmp_path / "dvl.txt").write_text("".join(lines))
    assert "2 reports without bottom lock" in succeed(capsys, "import", tmp_path / "dvl.txt", "-o", tmp_path / "bag")[0]
    wrong = pnorbt7(MOMENTS[1], *VELOCITIES[1]).replace("0.005", "0.006")
    (tmp_path / "nortek.txt").write_text(pnorbt7(MOMENTS[0], *VELOCITIES[0]) + wrong)
    said, _ = succeed(capsys, "import", tmp_path / "nortek.txt", "-o", tmp_path / "other")
    assert "1 reports with a wrong checksum" in said


TABLES = {
    "date and time of day": (
        "Date;Time;name;ok;Vx (m/s);Vy (m/s);Vz (m/s)\n",
        "time=Date+Time,vx=vx,vy=Vy (m/s),vz=vz",
        row,
    ),
    "ISO 8601": (
        "when,vx,vy,vz\n",
        "time=when,vx=vx,vy=vy,vz=vz",
        lambda at, *each: f"{at:%Y-%m-%dT%H:%M:%S}.{at.microsecond // 10_000}Z,{','.join(map(str, each))}\n",
    ),
    "seconds, no header": (
        "",
        "time=2,vx=3,vy=4,vz=5",
        lambda at, *each: f"x\t{at.timestamp():.3f}\t" + "\t".join(map(str, each)) + "\n",
    ),
}


@pytest.mark.parametrize("kind", TABLES)
def test_a_table_by_its_columns(tmp_path, capsys, kind):
    header, columns, line = TABLES[kind]
    table = header + "".join(line(at, *each) for at, each in zip(MOMENTS, VELOCITIES, strict=True))
    (tmp_path / "log.csv").write_text(table)
    succeed(capsys, "import", tmp_path / "log.csv", "-o", tmp_path / "bag", "--columns", columns)
    stamps, velocities = imported(tmp_path / "bag")
    np.testing.assert_allclose(velocities, np.array(VELOCITIES) * [1, -1, -1], atol=1e-12)
    np.testing.assert_allclose(np.subtract(stamps, STAMPS_NS), 0, atol=1000)


def test_rows_that_are_not_valid_are_left_out(tmp_path, capsys):
    (tmp_path / "log.csv").write_text("t,a,b,c,lock\n0,1,0,0,1\n1,1,0,0,0\n2,1,0,x,1\n3,1,0,0,true\n")
    said, _ = succeed(
        capsys, "import", tmp_path / "log.csv", "-o", tmp_path / "bag", "--columns", "time=t,vx=a,vy=b,vz=c,valid=lock"
    )
    assert "1 reports not valid" in said and "1 reports without a time or a velocity" in said
    assert len(imported(tmp_path / "bag")[0]) == 2


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ("time=t,vx=a,vy=b,vz=q", "no column 'q'; there are t, a, b, c, lock"),
        ("time=t,vx=a", "vy is missing; write time=NAME,vx=NAME"),
        ("time=t,vx=a,vy=b", "vz is missing, and two velocities show no mounting: import the DVL's own log"),
        ("time=t,vx=a,vy=b,vz=c,speed=a", "'speed' is none of time, vx, vy, vz, valid"),
        ("time=lock,vx=lock,vy=lock,vz=lock", "no row with time and velocity"),
    ],
)
def test_a_map_that_does_not_fit_is_named(tmp_path, capsys, columns, expected):
    (tmp_path / "log.csv").write_text("t,a,b,c,lock\n0,1,0,0,yes\n")
    assert expected in fail(capsys, "import", tmp_path / "log.csv", "-o", tmp_path / "bag", "--columns", columns)


def test_a_table_of_more_columns_names_the_option(tmp_path, capsys):
    (tmp_path / "log.csv").write_text("t,a,b,c,lock\n0,1,0,0,yes\n")
    assert "--columns time=NAME" in fail(capsys, "import", tmp_path / "log.csv", "-o", tmp_path / "bag")
