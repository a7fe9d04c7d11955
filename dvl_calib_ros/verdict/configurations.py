"""Reasons: conventions that fit the data better than the configured ones, and guesses of discovery."""

from __future__ import annotations

from functools import partial

from .kinds import Kind, Severity

_Said = partial(Kind, page="troubleshooting.md#what-the-data-fit-instead", severity=Severity.REJECT)
CONFIGURATIONS = (
    # the DVL
    _Said(
        "DVL_TWO_ON_TOPIC",
        "two DVLs publish on one topic: the velocity alternates between two values",
        "",
        "record one DVL per topic",
    ),
    _Said(
        "DVL_ROUNDED",
        "the DVL's velocity is rounded to {step:.2g} m/s, too coarse to find a mounting",
        "",
        "let the driver send all digits",
    ),
    _Said(
        "DVL_AXIS_DEAD",
        "the DVL measures nothing along {axes} (exactly 0 in every message)",
        "",
        "check the driver's fields",
    ),
    _Said(
        "DVL_TURNS_WITH_HEADING",
        "the DVL's velocity turns with the heading, as a velocity in the earth's frame does",
        "The driver has rotated the velocity into ENU or NED.",
        "let the driver send the velocity in the DVL's own axes",
    ),
    _Said(
        "DVL_AXES_TURNED",
        "the DVL's axes look turned over: y and z point the other way",
        "Forward-right-down for forward-left-up, or the reverse.",
        "set dvl_axes to {axes}",
    ),
    _Said(
        "DVL_LEFT_HANDED",
        "the DVL's axes look left-handed: {axis} points the other way{alike}",
        "",
        "negate this axis in the DVL's driver; of z, check the sign of the reference's vertical velocity as well",
    ),
    _Said(
        "DVL_SIDE_INVERTED",
        "the DVL's y points the other way: in turns the speed ahead changes by {slope:.1f} ± {std:.1f} times what the "
        "current in the sway predicts",
        "Left-handed axes of the DVL, forward-right-down for forward-left-up, or a heading that counts the other way.",
        "negate y in the DVL's driver; if z points the other way as well, set dvl_axes to {axes}",
    ),
    _Said(
        "DVL_SIGN_OPEN",
        "without a reference the sign of the DVL's {axis} is not observable: negated, the {angle} changes by "
        "{degrees:.1f}°",
        "",
        "is the DVL's {axis} positive when the vehicle moves {way}? If not, negate it in the DVL's driver",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "DVL_AXIS_SCALED",
        "the DVL's {axis} is {factor:.2g} times its true value, and its x is not",
        "Wrong beam angles or beam matrix.",
        "check the beam angle and the beam order in the DVL's driver",
    ),
    _Said(
        "MOUNTING_FITS",
        "the data fit mounting_rpy {roll:.3g} {pitch:.3g} {yaw:.3g}",
        "",
        "set mounting_rpy to [{roll:.4g}, {pitch:.4g}, {yaw:.4g}]",
    ),
    # the reference
    _Said(
        "REFERENCE_LOOKS",
        "the reference looks like {name}",
        "",
        "set gnss_frame to {frame}",
    ),
    _Said(
        "REFERENCE_OR_IMU_NED",
        "the reference looks like {name} (gnss_frame: {frame}), or the IMU's orientation looks like NED (imu_frame: "
        "ned); only sway distinguishes them",
        "",
        "check both drivers",
    ),
    _Said(
        "REFERENCE_HOLDS_DVL",
        "a filter made the reference from this DVL: the reference holds {percent:.0f} % of the DVL's own noise",
        "",
        "use the velocity of GNSS alone",
    ),
    # the IMU
    _Said(
        "IMU_LOOKS_NED",
        "the IMU's orientation looks like NED, forward-right-down",
        "",
        "set imu_frame to ned and imu_rpy to [3.1416, 0, 0]",
    ),
    _Said(
        "IMU_NO_RATES",
        "the IMU sends no angular velocity (exactly 0 in every message) while its orientation turns",
        "",
        "let the IMU's driver fill angular_velocity",
    ),
    _Said(
        "IMU_CONTRADICTS",
        "the IMU's orientation and its angular velocity contradict each other; the data fit {found}",
        "",
        "correct the IMU's driver",
    ),
    _Said(
        "IMU_CONTRADICTS_EITHER",
        "the IMU's orientation and its angular velocity contradict each other; the data fit {found}, or {other}",
        "",
        "correct the IMU's driver",
    ),
    # which conventions
    _Said(
        "HEADING_CLOCKWISE",
        "a heading that turns against the angular velocity about z, as a compass counts it (clockwise)",
        "An ENU yaw is 0 at east and grows to the left.",
        "",
    ),
    _Said("RATES_NEGATED", "an angular velocity of the other sign", "", ""),
    _Said(
        "IMU_AXES_MIXED",
        "an attitude and an angular velocity in different axes: one forward-left-up, the other forward-right-down",
        "",
        "",
    ),
    _Said(
        "RATES_EXCHANGED",
        "exchanged axes: where the attitude turns about x, y, z, the angular velocity is about {axes}",
        "",
        "",
    ),
    _Said("RATES_DEGREES", "an angular velocity in degrees per second", "", ""),
    _Said(
        "RATES_SCALED",
        "an angular velocity that is {times:.2g} times as large",
        "Not in rad/s, or of a wrong scale.",
        "",
    ),
    _Said(
        "RATES_IN_EARTH",
        "an angular velocity about the axes of the earth ({frame}), not of the body",
        "",
        "",
    ),
    _Said(
        "ATTITUDE_INVERTED",
        "an inverted attitude (a quaternion from earth to body axes)",
        "The quaternion has to rotate the body into the earth.",
        "",
    ),
    _Said(
        "RATES_TURNED",
        "an angular velocity whose axes are rotated by {degrees:.0f}° from the attitude's",
        "Two instruments in one message, or one is corrected for its mounting alone.",
        "",
    ),
    # gravity
    _Said(
        "GRAVITY_SIGN",
        "{topic}: the IMU's acceleration at rest points down, as gravity with the other sign",
        "",
        "correct the IMU's driver",
    ),
    _Said(
        "GRAVITY_UPSIDE_DOWN",
        "{topic}: gravity is upside down in the {where}",
        "The IMU is upside down, or axes and orientation follow two conventions.",
        "set imu_rpy or imu_frame",
    ),
    _Said(
        "GRAVITY_FITS_INVERTED",
        "{topic}: the IMU's orientation looks inverted: gravity is {given:.1f}° from up, and {inverted:.1f}° with the "
        "quaternion inverted",
        "",
        "correct the IMU's driver",
    ),
    _Said(
        "GRAVITY_LEANS",
        "{topic}: gravity is {degrees:.0f}° from up by the IMU's own orientation",
        "",
        "check the IMU's mounting in its driver",
    ),
    _Said(
        "GRAVITY_IN_G",
        "{topic}: the IMU's acceleration at rest is 1 g and not 9.81 m/s²",
        "Check the angular velocity too.",
        "let the driver send SI units",
    ),
    _Said(
        "GRAVITY_SIZE",
        "{topic}: the IMU's acceleration at rest is {size:.3g} m/s², which is not gravity",
        "Gravity is subtracted, or the units are wrong.",
        "let the driver send the acceleration with gravity, in m/s²",
    ),
    # clocks
    _Said(
        "CLOCK_OFF",
        "{whose} stamps are {seconds:.2f} ± {std:.2f} s {way}",
        "Estimated from velocities and turns, against the IMU's clock.",
        "",
    ),
    _Said(
        "CLOCK_LATE",
        "{whose} stamps are {seconds:.2f} s {way}",
        "The other clocks agree.",
        "set {parameter} to {offset:g}",
    ),
    _Said(
        "CLOCKS_LATE",
        "the reference's stamps are {seconds:.2f} s {way}, and the DVL's {dvl_seconds:.2f} s {dvl_way}",
        "A calibration estimates the DVL's delay.",
        "set {parameter} to {offset:g}",
    ),
    _Said(
        "CLOCKS_NOT_TOLD_APART",
        "the stamps of DVL and reference differ by {seconds:.2f} ± {std:.2f} s; it is unknown whose clock is wrong",
        "",
        "set the clocks by one source, or drive turns at two speeds",
    ),
    _Said(
        "CLOCK_DRIFTS",
        "{whose} clock drifts by {ppm:.0f} ± {std:.0f} ppm against the others",
        "",
        "set the clocks by one source",
    ),
    _Said(
        "CLOCK_DRIFTS_DVL",
        "the DVL's clock drifts by {ppm:.0f} ± {std:.0f} ppm against the others",
        "",
        "set the clocks by one source, or dvl_clock_drift to {drift:.2g}",
    ),
    _Said(
        "CLOCK_LEAPS",
        "{whose} clock steps {way} by {seconds:.2f} ± {std:.2f} s after {at:.0f} s",
        "",
        "cut the recording there, and calibrate with either part",
    ),
    _Said(
        "CLOCK_FAR",
        "{whose} stamps are about {seconds:.0f} s {way} than {others}; up to {limit:.0f} s can be estimated and "
        "subtracted",
        "",
        "set that clock right; this recording: --restamp log (recording times)",
    ),
    # declarations of a recording
    _Said(
        "DVL_FRAME_NOT_OWN",
        "{topic}: the DVL's messages carry frame {frame!r} and not one of the DVL's own; the data are used unchanged",
        "The driver may have rotated the velocity into that frame.",
        "check the driver's settings",
    ),
    _Said(
        "BODY_OR_EARTH",
        "DVL and reference agree in the body frame, but would agree as well if both were in the earth's frame",
        "Without an attitude that changes, both fit.",
        "set gnss_frame",
    ),
    _Said(
        "REFERENCE_FRAME_OTHER",
        "{topic}: frame {frame!r} says {declared}, but DVL and reference agree only as {taken}, which is used",
        "",
        "-p gnss_frame:={declared} overrides this",
    ),
    _Said(
        "MOUNTING_CONTRADICTED",
        "DVL and reference do not agree with the mounting {given}; they do with {found}",
        "A heading without its magnetic declination (setting EB of an RDI) looks the same.",
        "try -p mounting_rpy:={option}",
    ),
    _Said(
        "TRAVELS_SIDEWAYS",
        "with the mounting {given} the vehicle travels sideways; it goes ahead with {found}",
        "A yaw of the wrong sign in the transform, or a vehicle that drifts.",
        "try -p mounting_rpy:={option}",
    ),
    _Said(
        "TRAVELS_ASTERN",
        "with the mounting {given} the vehicle travels astern; it goes ahead with {found}",
        "Without a reference a vehicle that drives astern looks like a DVL that points astern.",
        "try -p mounting_rpy:={option}; if the vehicle did drive astern, -p mounting_rpy:={confirmed}",
    ),
    _Said(
        "FRAMES_AMBIGUOUS",
        "the data fit {taken} and, as well, {other}; the first is taken",
        "Which side is port, and which axes has the reference?",
        "set the one that is right",
        severity=Severity.MARGINAL,
    ),
    _Said("TWO_CONTRADICTIONS", "{one}; {other}", "", ""),
)


_Discovered = partial(Kind, page="troubleshooting.md#what-discovery-notes", severity=Severity.ACCEPT)
DISCOVERIES = (
    _Discovered(
        "SECOND_DVL",
        "two DVLs: {topic} ({frame}) is calibrated here, not {other} ({other_frame}); calibrate that with --dvl-topic "
        "{other}",
        "",
        "",
    ),
    _Discovered(
        "TOPIC_DOES_NOT_MOVE",
        "{topic} does not move; not taken as a reference",
        "",
        "",
    ),
    _Discovered(
        "TOPIC_FROM_DVL",
        "{topic} looks as if it was computed from the DVL; not taken as a reference",
        "The topic equals the DVL's velocity, or is named after the DVL.",
        "",
    ),
    _Discovered(
        "TOPIC_DERIVED",
        "{topic} may be a filter's output that uses the DVL; not taken as a reference. If it does not use the DVL: "
        "--gnss-topic {topic}",
        "The name says that a filter made it.",
        "",
    ),
    _Discovered(
        "SEVERAL_REFERENCES",
        "{topic} is taken as the reference, not {others}; --gnss-topic names another",
        "Satellites go first, then a simulator's truth, then an INS.",
        "",
    ),
    _Discovered(
        "FRAME_NOT_IN_TREE",
        "no transform for the DVL's frame {frame!r}; using frame {other!r} instead",
        "",
        "",
    ),
    _Discovered(
        "REFERENCE_FRAME_NOT_TOLD",
        "{topic}: its frame is unknown, and without an IMU the data do not show it",
        "",
        "",
    ),
    _Discovered(
        "MOUNTING_GUESSED",
        "mounting {mounting}, {why}: nothing in the bag says how the DVL is mounted (-p mounting_rpy:={option}){also}",
        "Estimated from the data, rounded to a quarter turn where that fits.",
        "",
    ),
    _Discovered(
        "TRANSFORM_NOT_ROTATION",
        "/tf_static: the transform of {frame!r} is not a rotation; not used",
        "The quaternion does not have length 1.",
        "",
    ),
    _Discovered("URDF_NOT_READ", "{reason}; not used", "", ""),
)
