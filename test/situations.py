"""Recordings of situations that users have reported, each with its fault and without it.

The vehicles are those of `stacks`: the DVL is misaligned by `MISALIGNMENT`, and sits at `LEVER_ARM`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import cache, partial, wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_fixtures import ensemble, general_nmea, sentence
from scipy.spatial.transform import Rotation
from stacks import FIX, GNSS_STD, IMU, LEVER_ARM, ODOMETRY, TWIST, Sample, Told, motion, true_mounting

import dvl_calib_ros
from dvl_calib_ros.api import analyse
from dvl_calib_ros.calibration.numerics.frames import Array
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.examination import examine
from dvl_calib_ros.simulation.trajectories import Motion, make_motion

DVL, REFERENCE = "/dvl/velocity", "/gnss/velocity"
KNOTS_PER_MPS = 1.0 / 0.514444
# The surface before and after a dive, s.
SURFACE_S = 60.0
INSTRUMENT_AXES, TILTS_USED = 1, 0b111  # EX of an ensemble
SHIP_MPS, BED_MPS = 0.03, (0.10, 0.066, 0.0)


def sound(told: Told, reference: bool = True, yaw: float = 0.0, said_yaw: float = 0.0) -> None:
    """Tell of a vehicle with nothing wrong but a yaw (rad) of the DVL that its transform says otherwise."""
    told.dvl(DVL, TWIST, "dvl_link", (0.0, 0.0, yaw))
    told.imu("/imu/data", "base_link")
    if reference:
        told.reference(REFERENCE, TWIST, "enu", "enu")
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, said_yaw), LEVER_ARM))


def meaningless_covariances(told: Told, wrong: bool) -> None:
    """A driver that fills its covariance with random numbers up to 1 (m/s)²."""
    sound(told)
    for message in told.said(DVL):
        if wrong:
            message.twist.covariance[[0, 7, 14]] = told.rng.random(3)


def one_axis_negated(told: Told, wrong: bool) -> None:
    """A driver whose z has the wrong sign."""
    sound(told)
    for message in told.said(DVL):
        if wrong:
            message.twist.twist.linear.z *= -1.0


def attitude_inverted(told: Told, wrong: bool) -> None:
    """An IMU driver whose quaternions are from the world to the body."""
    sound(told)
    for message in told.said(IMU):
        if wrong:
            message.orientation.w *= -1.0


def astern_by_its_transform(told: Told, wrong: bool) -> None:
    """A DVL that is turned about, without a transform that says so, and nothing to compare with."""
    sound(told, reference=False, yaw=math.pi)


def yaw_other_than_said(yaw_deg: float, said_deg: float = 0.0) -> Callable[[Path, bool], Path]:
    """Write of a DVL at a yaw that its transform says otherwise."""

    def tell(told: Told, wrong: bool) -> None:
        sound(told, yaw=math.radians(yaw_deg), said_yaw=math.radians(said_deg))

    return told_by(tell)


def stamps_a_minute_and_a_half_ahead(told: Told, wrong: bool) -> None:
    """A DVL whose stamps are too far from the others to be estimated, but arrived with them."""
    sound(told)
    for message in told.said(DVL):
        message.header.stamp.sec += 90


def beam_low(told: Told, by: float) -> None:
    """Lower the reading of one of four beams at 30 degrees by a share."""
    around = np.radians([45.0, 135.0, 225.0, 315.0])
    beams = np.column_stack([0.5 * np.cos(around), 0.5 * np.sin(around), np.full(4, -math.sqrt(0.75))])
    solved = np.linalg.pinv(beams)
    for message in told.said(DVL):
        v = message.twist.twist.linear
        v.x, v.y, v.z = (solved @ (beams @ [v.x, v.y, v.z] * [1.0, 1.0 - by, 1.0, 1.0])).tolist()


def one_beam_low(told: Told, wrong: bool) -> None:
    """One beam reads 15 % low."""
    sound(told)
    beam_low(told, 0.15 * wrong)


def one_beam_low_at_5_degrees(told: Told, wrong: bool) -> None:
    """One beam reads 10 % low, of a DVL whose yaw of 5 degrees nothing says."""
    sound(told, yaw=math.radians(5.0))
    beam_low(told, 0.1 * wrong)


def quaternion_components_mixed_up(told: Told, wrong: bool) -> None:
    """An IMU driver that writes w, y, z, w in place of x, y, z, w."""
    sound(told)
    for message in told.said(IMU):
        if wrong:
            q = message.orientation
            q.x, q.y, q.z = q.w, q.y, q.z


def reference_of_a_filter(told: Told, wrong: bool) -> None:
    """An INS whose velocity is nine tenths this DVL's, with the nominal mounting; else it has not seen the DVL."""
    m, held = told.motion, np.zeros(3)
    for i, stamp in told.every(5.0):
        measured = told.dvl_velocity(i, (0.0, 0.0, 0.0))
        covariance = 1e-4 * np.eye(3)
        told.say(stamp, DVL, TWIST, told.make.velocity(TWIST, Sample(stamp, measured, covariance), "dvl_link"))
        own = m.velocity_body[i] + told.rng.normal(0.0, GNSS_STD, 3)
        held = held + 0.5 * (0.9 * measured + 0.1 * own - held)
        message = told.make.velocity(ODOMETRY, Sample(stamp, held if wrong else own, covariance), "base_link")
        told.say(stamp + 4_000_000, "/ins/odom", ODOMETRY, message)
    told.imu("/imu/data", "base_link")
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))


def wrong_transform_without_reference(told: Told, wrong: bool) -> None:
    """A transform with the yaw of a DVL at 135 degrees the wrong way round, and nothing to compare with."""
    yaw = math.radians(-135.0)
    sound(told, reference=False, yaw=yaw, said_yaw=-yaw if wrong else yaw)


def earth_axes_without_reference(told: Told, wrong: bool) -> None:
    """A driver that turns the velocity into east, north, up."""
    sound(told, reference=False)
    velocities = [message.twist.twist.linear for message in told.said(DVL)]
    for (i, _), v in zip(told.every(5.0), velocities, strict=True):
        if wrong:
            v.x, v.y, v.z = (told.motion.rotation_enu_from_body[i] @ [v.x, v.y, v.z]).tolist()


def axes_of_the_driver_without_reference(change: Callable[[Any], None], yaw: float) -> Callable[[Told, bool], None]:
    """Return the telling of a driver that changes a velocity, of a DVL at a yaw (rad) that its transform says."""

    def tell(told: Told, wrong: bool) -> None:
        sound(told, reference=False, yaw=yaw, said_yaw=yaw)
        for message in told.said(DVL):
            if wrong:
                change(message.twist.twist.linear)

    return tell


def negate_y(v: Any) -> None:
    v.y *= -1.0


def swap_x_and_y(v: Any) -> None:
    v.x, v.y = v.y, v.x


def stamps_an_hour_ahead(told: Told, wrong: bool) -> None:
    """A DVL whose stamps are by a clock in another time zone."""
    sound(told)
    for message in told.said(DVL):
        message.header.stamp.sec += 3600


def antenna_on_a_mast(told: Told, wrong: bool) -> None:
    """RTK positions of an antenna 2 m up that swings with the waves; all is told right."""
    antenna, m = (-0.6, 0.0, 2.0), told.motion
    swing = np.radians([7.0, 3.0]) * np.sin(2.0 * np.pi * m.time[:, None] / [3.3, 4.1])
    yaw = Rotation.from_matrix(m.rotation_enu_from_body).as_euler("ZYX")[:, 0]
    attitude = Rotation.from_euler("ZYX", np.column_stack([yaw, swing[:, 1], swing[:, 0]]))
    rates = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(m.time)[:, None]
    told.motion = replace(
        m, rotation_enu_from_body=attitude.as_matrix(), angular_velocity=np.vstack([rates, rates[-1:]])
    )
    sound(told, reference=False)
    told.fixes("/gps/fix", "gps_link", 5.0, 0.01, antenna)
    told.tf_static(told.transform("base_link", "gps_link", (0.0, 0.0, 0.0), antenna))


def fixes_around_a_dive(told: Told, wrong: bool) -> None:
    """Satellite fixes of a minute before a dive and of a minute after it, half of them without the DVL."""
    sound(told, reference=False)
    told.fixes("/gps/fix", "gps_link", 1.0, 0.3)
    told.tf_static(told.transform("base_link", "gps_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.2)))
    begin, end = told.rows[0][0] + 1e9 * SURFACE_S, told.rows[0][0] + 1e9 * (told.motion.time[-1] - SURFACE_S)
    told.rows = [row for row in told.rows if row[2] != FIX or not begin < row[0] < end]
    half = 0.5e9 * SURFACE_S  # the DVL has the bottom later, and is off before the end
    told.rows = [row for row in told.rows if row[1] != DVL or begin - half < row[0] < end + half]


def ensembles(path: Path, yaw_deg: float = 0.0, bed_mps: Array | None = None) -> Path:
    """Import RDI ensembles with sentences of a ship's receiver and gyro; the ship is the body.

    yaw_deg: of the DVL, which its setting EA says. bed_mps: (3,) east, north, up, of what its beams track.
    """
    m, rng, written = long_motion(), np.random.default_rng(6), bytearray()
    body_from_dvl = true_mounting((0.0, 0.0, math.radians(yaw_deg)))
    bed = np.zeros(3) if bed_mps is None else bed_mps
    for i in range(0, len(m.time), 50):
        enu_from_body = m.rotation_enu_from_body[i]
        own = enu_from_body @ body_from_dvl
        ahead, left, up = own.T @ (enu_from_body @ m.velocity_body[i] - bed) + rng.normal(0.0, 0.01, 3)
        pitch, roll = math.asin(own[2, 0]), math.atan2(own[2, 1], own[2, 2])
        tilt = math.degrees(math.atan(math.tan(pitch) / math.cos(roll)))
        heading = math.degrees(math.atan2(enu_from_body[0, 0], enu_from_body[1, 0])) % 360.0
        east, north, _ = enu_from_body @ m.velocity_body[i] + rng.normal(0.0, SHIP_MPS, 3)
        course, knots = math.degrees(math.atan2(east, north)) % 360.0, math.hypot(east, north) * KNOTS_PER_MPS
        written += ensemble(
            [round(-1000.0 * each) for each in (-left, ahead, up)] + [3], i, INSTRUMENT_AXES, flags=TILTS_USED,
            attitude=(round(100.0 * heading) % 36000, round(100.0 * tilt), round(100.0 * math.degrees(roll))),
            alignment=round(-100.0 * yaw_deg),
            nmea=[
                general_nmea(105, sentence(f"GPVTG,{course:.2f},T,,M,{knots:.3f},N,,K"), 0.0),
                general_nmea(107, sentence(f"GPHDT,{heading:.2f},T"), 0.0),
            ],
        )  # fmt: skip
    return imported(path, bytes(written))


def lines(path: Path) -> Path:
    """Import the lines of text (PD6) that a DVL with a compass writes."""
    told, written = Told(motion=five_minutes()), ""
    ypr = np.degrees(Rotation.from_matrix(told.motion.rotation_enu_from_body).as_euler("ZYX"))
    for i, stamp in told.every(4.0):
        at = datetime.fromtimestamp(1e-9 * stamp, timezone.utc)
        ahead, left, up = (1000.0 * told.dvl_velocity(i, (0.0, 0.0, 0.0))).tolist()
        yaw, pitch, roll = ypr[i].tolist()
        written += f":SA,{-pitch:+6.2f},{roll:+6.2f},{(90.0 - yaw) % 360.0:6.2f}\r\n"
        written += f":TS,{at:%y%m%d%H%M%S}{at.microsecond // 10_000:02d},35.0,+15.0,0.5,1500.0,0\r\n"
        written += f":BI,{-left:+6.0f},{ahead:+6.0f},{up:+6.0f},+2,A\r\n"
    return imported(path, written.encode())


def imported(path: Path, log: bytes) -> Path:
    source = path.with_suffix(".log")
    source.write_bytes(log)
    (bag,) = dvl_calib_ros.import_files(source, output=path)
    return bag


@cache
def long_motion(seconds: float = 420.0) -> Motion:
    return make_motion("free", seconds, 100.0, np.random.default_rng(12))


five_minutes = partial(long_motion, 300.0)


@dataclass(frozen=True)
class Situation:
    """A recording with its right answer.

    write: makes the bag, with or without its fault. cause: code of the first reason against it; none: the recording is
    usable. remedy: of the first reason, a part; with an option: this is typed, else it is done before recording.
    yaw_deg: of the DVL. verdicts: that are right of a usable recording.
    """

    write: Callable[[Path, bool], Path]
    cause: str = ""
    remedy: str = ""
    yaw_deg: float = 0.0
    verdicts: tuple[str, ...] = ("accept",)


def told_by(tell: Callable[[Told, bool], None], of: Callable[[], Motion] = motion) -> Callable[[Path, bool], Path]:
    def write(path: Path, wrong: bool) -> Path:
        told = Told(motion=of())
        tell(told, wrong)
        return told.write(path)

    return write


def contradicts(doctor: str, replay: str) -> bool:
    """Return whether doctor says yes where replay rejects, or no where replay is usable."""
    return doctor == ("yes" if replay == "reject" else "no")


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that computes once what all three commands ask with the same parameters."""
    kept: dict[str, Any] = {}

    @wraps(function)
    def kept_or_new(recording: Any, *given: Any, **named: Any) -> Any:
        key = repr((given, named))
        if key not in kept:
            try:
                kept[key] = function(recording, *given, **named)
            except InputError as error:
                kept[key] = error
        if isinstance(kept[key], InputError):
            raise kept[key]
        return kept[key]

    return kept_or_new


def ask_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on, of one recording, compute once what its commands ask with the same parameters."""
    for name in ("discover", "checked_replay"):
        original = getattr(examine, name)
        monkeypatch.setattr(examine, name, once(getattr(original, "__wrapped__", original)))
    monkeypatch.setattr(analyse, "discover", examine.discover)


NOISY = "accept", "marginal"  # speed over ground is noisy, and without a reference nothing is verified
SITUATIONS = {
    "meaningless covariances": Situation(told_by(meaningless_covariances)),
    "one axis negated": Situation(
        told_by(one_axis_negated, five_minutes), "DVL_LEFT_HANDED", "negate z in the DVL's driver"
    ),
    "one beam low": Situation(told_by(one_beam_low, five_minutes), "BEAM_OFF", "135° to port"),
    "one beam low, which looks like a misalignment": Situation(
        told_by(one_beam_low_at_5_degrees, long_motion), "BEAM_OFF", "180° to port", yaw_deg=5.0, verdicts=("reject",)
    ),
    "quaternion components mixed up": Situation(
        told_by(quaternion_components_mixed_up), "GRAVITY_LEANS", "check the IMU's mounting in its driver"
    ),
    "reference of a filter": Situation(
        told_by(reference_of_a_filter), "REFERENCE_HOLDS_DVL", "use the velocity of GNSS alone"
    ),
    "wrong transform without reference": Situation(
        told_by(wrong_transform_without_reference),
        "TRAVELS_SIDEWAYS",
        "try -p mounting_rpy:=[0deg,0deg,-135deg]",
        yaw_deg=-135.0,
        verdicts=NOISY,
    ),
    "large misalignment": Situation(
        yaw_other_than_said(7.0), "MISALIGNMENT_LARGE", "-p mounting_rpy:=[", yaw_deg=7.0, verdicts=NOISY
    ),
    "wrong transform": Situation(
        yaw_other_than_said(-135.0, 135.0),
        "MOUNTING_CONTRADICTED",
        "-p mounting_rpy:=[0deg,0deg,-135deg]",
        yaw_deg=-135.0,
    ),
    "yaw that no drawing has": Situation(
        yaw_other_than_said(37.0),
        "MOUNTING_CONTRADICTED",
        ": try -p mounting_rpy:=[0deg,0deg,",
        yaw_deg=37.0,
        verdicts=NOISY,
    ),
    "earth axes without reference": Situation(
        told_by(earth_axes_without_reference),
        "DVL_TURNS_WITH_HEADING",
        "let the driver send the velocity in the DVL's own axes",
        verdicts=NOISY,
    ),
    "negated axis at 45 degrees without reference": Situation(
        told_by(axes_of_the_driver_without_reference(negate_y, math.radians(45.0))),
        "TRAVELS_SIDEWAYS",
        "or, if that mounting is right, negate y in the DVL's driver",
        yaw_deg=45.0,
        verdicts=NOISY,
    ),
    "swapped axes without reference": Situation(
        told_by(axes_of_the_driver_without_reference(swap_x_and_y, 0.0)),
        "TRAVELS_SIDEWAYS",
        "or, if that mounting is right, swap x and y in the DVL's driver",
        verdicts=NOISY,
    ),
    "attitude inverted": Situation(
        told_by(attitude_inverted, five_minutes), "GRAVITY_FITS_INVERTED", "correct the IMU's driver"
    ),
    "astern without reference": Situation(
        told_by(astern_by_its_transform),
        "TRAVELS_ASTERN",
        "try -p mounting_rpy:=[0deg,0deg,",
        yaw_deg=180.0,
        verdicts=NOISY,
    ),
    "stamps a minute and a half ahead": Situation(
        told_by(stamps_a_minute_and_a_half_ahead, five_minutes), "CLOCK_FAR", "--restamp log"
    ),
    "stamps an hour ahead": Situation(told_by(stamps_an_hour_ahead), "CLOCKS_APART", "--restamp log"),
    "alignment of an RDI": Situation(lambda path, _: ensembles(path, -45.0), yaw_deg=-45.0, verdicts=NOISY),
    "moving bed": Situation(
        lambda path, wrong: ensembles(path, bed_mps=np.array(BED_MPS) * wrong),
        "BED_MOVES",
        "121 mm/s faster than the DVL towards 56°",
        verdicts=NOISY,
    ),
    "text of a DVL": Situation(lambda path, _: lines(path), verdicts=NOISY),
    "antenna on a mast": Situation(told_by(antenna_on_a_mast, five_minutes), verdicts=NOISY),
    "fixes around a dive": Situation(told_by(fixes_around_a_dive, five_minutes), verdicts=NOISY),
}
