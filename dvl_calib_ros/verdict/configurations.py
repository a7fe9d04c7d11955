"""Reasons: conventions that fit the data better than the configured ones, and guesses of discovery."""

from __future__ import annotations

from .kinds import accept, marginal, on_page, reject

CONFIGURATIONS = on_page(
    "troubleshooting.md#what-the-data-fit-instead",
    # the DVL
    reject(
        "DVL_TWO_ON_TOPIC",
        "two DVLs publish on one topic: the velocity alternates between two values",
        remedy="record one DVL per topic",
    ),
    reject(
        "DVL_ROUNDED",
        "the DVL's velocity is rounded to {step:.2g} m/s, too coarse to find a mounting",
        remedy="let the driver send all digits",
    ),
    reject(
        "DVL_AXIS_DEAD",
        "the DVL measures nothing along {axes} (exactly 0 in every message)",
        remedy="check the driver's fields",
    ),
    reject(
        "DVL_TURNS_WITH_HEADING",
        "the DVL's velocity turns with the heading, as a velocity in the earth's frame does",
        means="The driver has rotated the velocity into ENU or NED.",
        remedy="let the driver send the velocity in the DVL's own axes",
    ),
    reject(
        "DVL_AXES_TURNED",
        "the DVL's axes look turned over: y and z point the other way",
        means="The driver sends forward-right-down for forward-left-up, or the reverse.",
        remedy="set {parameter} to {value}",
    ),
    reject(
        "DVL_LEFT_HANDED",
        "the DVL's axes look left-handed: {axis} points the other way{alike}",
        remedy=(
            "negate {axis} in the DVL's driver; for z, check the sign of the reference's vertical velocity as well"
        ),
    ),
    reject(
        "DVL_SIDE_INVERTED",
        "the DVL's y points the other way: in turns the speed ahead shows {slope:.1f} ± {std:.1f} times the current "
        "that y shows",
        means=(
            "The DVL's axes are left-handed, or forward-right-down for forward-left-up, or the heading counts the "
            "other way."
        ),
        remedy="negate y in the DVL's driver; if z points the other way as well, set dvl_axes to {axes}",
    ),
    marginal(
        "DVL_SIGN_OPEN",
        "without a reference the sign of the DVL's {axis} is not observable: negated, {effect}",
        remedy=(
            "is the DVL's {axis} positive when the vehicle moves {way}? If so, set dvl_axes to {axes}; if not, negate "
            "it in the DVL's driver{also}"
        ),
    ),
    reject(
        "DVL_AXIS_SCALED",
        "the DVL's {axis} is {factor:.2g} times its true value, and its {other} is not",
        means="The beam angles or the beam matrix in the driver are wrong.",
        remedy="check the beam angle and the beam order in the DVL's driver",
    ),
    reject(
        "MOUNTING_FITS",
        "the data fit mounting_rpy {roll:.3g} {pitch:.3g} {yaw:.3g}",
        remedy="set mounting_rpy to [{roll:.4g}, {pitch:.4g}, {yaw:.4g}]",
    ),
    # the reference
    reject("REFERENCE_LOOKS", "the reference looks like {name}", remedy="set gnss_frame to {frame}"),
    reject(
        "REFERENCE_OR_IMU_NED",
        "the reference looks like {name} (gnss_frame: {frame}), or the IMU's orientation looks like NED (imu_frame: "
        "ned); only sway distinguishes them",
        remedy="check both drivers",
    ),
    reject(
        "REFERENCE_HOLDS_DVL",
        "a filter made the reference from this DVL: the reference holds {percent:.0f} % of the DVL's own noise",
        remedy="use the velocity of GNSS alone",
    ),
    # the IMU
    reject(
        "IMU_LOOKS_NED",
        "the IMU's orientation looks like {name}",
        remedy="set imu_frame to {frame} and imu_rpy to {rpy}",
    ),
    reject(
        "IMU_NO_RATES",
        "the IMU sends no angular velocity (exactly 0 in every message) while its orientation turns",
        remedy="let the IMU's driver fill angular_velocity",
    ),
    reject(
        "IMU_CONTRADICTS",
        "the IMU's orientation and its angular velocity contradict each other; the data fit {found}",
        remedy="correct the IMU's driver",
    ),
    reject(
        "IMU_CONTRADICTS_EITHER",
        "the IMU's orientation and its angular velocity contradict each other; the data fit {found}, or {other}",
        remedy="correct the IMU's driver",
    ),
    # which conventions
    reject(
        "HEADING_CLOCKWISE",
        "a heading that turns against the angular velocity about z, as a compass counts it (clockwise)",
        means="An ENU yaw is 0 at east and grows counter-clockwise.",
    ),
    reject("RATES_NEGATED", "an angular velocity of the other sign"),
    reject(
        "IMU_AXES_MIXED",
        "an attitude and an angular velocity in different axes: one forward-left-up, the other forward-right-down",
    ),
    reject(
        "RATES_EXCHANGED",
        "exchanged axes: where the attitude turns about x, y, z, the angular velocity is about {axes}",
    ),
    reject("RATES_DEGREES", "an angular velocity in degrees per second"),
    reject(
        "RATES_SCALED",
        "an angular velocity that is {times:.2g} times as large",
        means="The driver does not send rad/s, or its scale is wrong.",
    ),
    reject("RATES_IN_EARTH", "an angular velocity about the axes of the earth ({frame}), not of the body"),
    reject(
        "ATTITUDE_INVERTED",
        "an inverted attitude (a quaternion from earth to body axes)",
        means="The quaternion has to rotate the body into the earth.",
    ),
    reject(
        "RATES_TURNED",
        "an angular velocity whose axes are rotated by {degrees:.0f}° from the attitude's",
        means="Two instruments share one message, or only one of them is corrected for its mounting.",
    ),
    # gravity; alone it rejects no calibration, as no calibration uses the acceleration
    accept(
        "GRAVITY_SIGN",
        "{topic}: the IMU's acceleration at rest points down, so its sign is wrong",
        remedy="correct the IMU's driver",
    ),
    accept(
        "GRAVITY_UPSIDE_DOWN",
        "{topic}: gravity is upside down in the {where}",
        means="The IMU is upside down, or axes and orientation follow two conventions.",
        remedy="set {parameter} to {value}",
    ),
    accept(
        "GRAVITY_FITS_INVERTED",
        "{topic}: the IMU's orientation looks inverted: gravity is {given:.1f}° from up, and {inverted:.1f}° with the "
        "quaternion inverted",
        remedy="correct the IMU's driver",
    ),
    accept(
        "GRAVITY_LEANS",
        "{topic}: gravity is {degrees:.0f}° from up by the IMU's own orientation",
        remedy="check the IMU's mounting in its driver",
    ),
    accept(
        "GRAVITY_IN_G",
        "{topic}: the IMU's acceleration at rest is 1 g and not 9.81 m/s²",
        means="Check the angular velocity too.",
        remedy="let the driver send SI units",
    ),
    accept(
        "GRAVITY_SIZE",
        "{topic}: the IMU's acceleration at rest is {size:.3g} m/s², which is not gravity",
        means="Gravity is subtracted, or the units are wrong.",
        remedy="let the driver send the acceleration with gravity, in m/s²",
    ),
    # clocks
    reject(
        "CLOCK_OFF",
        "{whose} stamps are {seconds:.3f} ± {std:.3f} s {way} against {against}",
        means="The offset is estimated from velocities and turns.",
    ),
    reject(
        "CLOCK_LATE",
        "{whose} stamps are {seconds:.2f} s {way}; the other clocks agree",
        remedy="set {parameter} to {offset:g}",
    ),
    reject(
        "CLOCKS_LATE",
        "against the IMU the reference's stamps are {seconds:.2f} s {way}, and the DVL's {dvl_seconds:.2f} s {dvl_way}",
        means="A calibration estimates the DVL's delay.",
        remedy="set {parameter} to {offset:g}",
    ),
    reject(
        "CLOCKS_NOT_TOLD_APART",
        "the stamps of DVL and reference differ by {seconds:.2f} ± {std:.2f} s; it is unknown whose clock is wrong",
        remedy="synchronise the clocks, or drive turns at two speeds",
    ),
    reject(
        "CLOCK_DRIFTS",
        "{whose} clock drifts by {ppm:.0f} ± {std:.0f} ppm against the others",
        remedy="synchronise the clocks",
    ),
    reject(
        "CLOCK_DRIFTS_DVL",
        "the DVL's clock drifts by {ppm:.0f} ± {std:.0f} ppm against the others",
        remedy="synchronise the clocks, or set dvl_clock_drift to {drift:.2g}",
    ),
    reject(
        "CLOCK_LEAPS",
        "{whose} clock steps {way} by {seconds:.2f} ± {std:.2f} s after {at:.0f} s",
        remedy="cut the recording there, and calibrate with either part",
    ),
    reject(
        "CLOCK_FAR",
        "{whose} stamps are about {seconds:.0f} s {way} than {others}; up to {limit:.0f} s can be estimated and "
        "subtracted",
        remedy="set that clock; use the recording times for this bag: --restamp log",
    ),
    # declarations of a recording
    accept(
        "DVL_FRAME_NOT_OWN",
        "{topic}: the DVL's messages carry frame {frame!r} and not one of the DVL's own; the data are used unchanged",
        means="The driver may have rotated the velocity into that frame.",
        remedy="check the driver's settings",
    ),
    reject(
        "BODY_OR_EARTH",
        "DVL and reference agree in the body frame, but would agree as well if both were in the earth's frame",
        means="Without an attitude that changes, both fit.",
        remedy="set gnss_frame",
    ),
    accept(
        "REFERENCE_FRAME_OTHER",
        "{topic}: frame {frame!r} says {declared}, but DVL and reference agree only as {taken}, which is used",
        means="A configured gnss_frame is used without a check.",
        remedy="correct the frame in the reference's driver",
    ),
    reject(
        "MOUNTING_CONTRADICTED",
        "DVL and reference do not agree with the mounting {given}; they do with {found}",
        means="A heading without its magnetic declination (setting EB of an RDI) looks the same.",
        remedy="{first}try -p mounting_rpy:={option}{also}",
    ),
    reject(
        "TRAVELS_SIDEWAYS",
        "with the mounting {given} the vehicle travels sideways; it goes ahead with {found}",
        means="A yaw or an axis has the wrong sign, or the vehicle drifts.",
        remedy="try -p mounting_rpy:={option}{also}",
    ),
    reject(
        "TRAVELS_ASTERN",
        "with the mounting {given} the vehicle travels astern; it goes ahead with {found}",
        means="A vehicle that was driven astern gives the same data. A mounting set with -p is used without a check.",
        remedy="try -p mounting_rpy:={option}{also}; if the vehicle did drive astern, record it driving ahead",
    ),
    marginal(
        "FRAMES_AMBIGUOUS",
        "the data fit {taken} and {other} equally well; the first is used",
        remedy="is {what} {axes}? If so, set {parameter} to {value}; if not, set it to {first}",
    ),
    reject("TWO_CONTRADICTIONS", "{one}; {other}"),
)


DISCOVERIES = on_page(
    "troubleshooting.md#what-discovery-notes",
    accept(
        "SECOND_DVL",
        "two DVLs: {topic} ({frame}) is calibrated here, not {other} ({other_frame}); calibrate that with --dvl-topic "
        "{other}",
    ),
    accept("TOPIC_DOES_NOT_MOVE", "{topic} does not move; not taken as a reference"),
    accept(
        "TOPIC_FROM_DVL",
        "{topic} looks as if it was computed from the DVL; not taken as a reference",
        means="The topic equals the DVL's velocity, or is named after the DVL.",
    ),
    accept(
        "TOPIC_DERIVED",
        "{topic} may be a filter's output that uses the DVL; not taken as a reference. If it does not use the DVL: "
        "--gnss-topic {topic}",
        means="The name says that a filter made it.",
    ),
    accept(
        "SEVERAL_REFERENCES",
        "{topic} is taken as the reference, not {others}; --gnss-topic names another",
        means="Satellite navigation is preferred, then a simulator's truth, then an INS.",
    ),
    accept("FRAME_NOT_IN_TREE", "no transform for the DVL's frame {frame!r}; using frame {other!r} instead"),
    accept("REFERENCE_FRAME_NOT_TOLD", "{topic}: its frame is unknown, and not observable without an IMU"),
    accept(
        "MOUNTING_GUESSED",
        "mounting {mounting}, {why}: nothing in the bag says how the DVL is mounted (-p mounting_rpy:={option}){also}",
        means="The mounting is estimated from the data, and rounded to a quarter turn where that fits.",
    ),
    accept(
        "TRANSFORM_NOT_ROTATION",
        "/tf_static: the transform of {frame!r} is not a rotation; not used",
        means="The quaternion does not have length 1.",
    ),
    accept("URDF_NOT_READ", "{reason}; not used"),
)
