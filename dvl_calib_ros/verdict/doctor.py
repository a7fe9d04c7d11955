"""Faults of a recording that the doctor finds: code, sentence, meaning and remedy."""

from __future__ import annotations

from .kinds import error, on_page, warning

DOCTOR = on_page(
    "troubleshooting.md#what-the-doctor-finds",
    warning(
        "DOCTOR_STAMP_ZERO",
        "{topic}: {share:.0%} of the messages have no stamp",
        remedy="let the driver fill header.stamp with the time of measurement",
    ),
    warning(
        "DOCTOR_STAMP_RECEPTION",
        "{topic}: stamps jitter with the reception ({jitter_ms:.0f} ms about {period_ms:.0f} ms), not with the sensor",
        remedy="let the driver take the sensor's own time; then dvl-calib diagnose BAG estimates the remaining delay",
    ),
    warning(
        "DOCTOR_STAMP_BACK",
        "{topic}: stamps go back {count} times, by up to {seconds:.1f} s",
        means="A clock was set, two publishers share the topic, or the bag looped.",
        remedy="set clocks before the recording; one publisher per topic",
    ),
    error(
        "DOCTOR_STAMP_JUMP",
        "{topic}: stamps jump ahead by {seconds:.1f} s while recording went on",
        remedy="set clocks before the recording, or cut the recording there",
    ),
    error(
        "DOCTOR_CLOCKS",
        "{topic}: stamps are {seconds:.2f} s {side} those of {other}",
        remedy="synchronise clocks (PTP, NTP or GNSS); for this bag: {here}",
    ),
    error(
        "DOCTOR_APART",
        "{topic} and {other}: only {share:.0%} of the DVL's messages have a reference within seconds of their stamps",
        remedy="record both together; if they were, check the clocks, and for import the times of both files",
    ),
    warning(
        "DOCTOR_REPEATED_STAMP",
        "{topic}: {share:.0%} of the stamps repeat the one before",
        means="Two publishers, or a driver that sends twice.",
        remedy="stop the second publisher (ros2 topic info -v {topic})",
    ),
    error(
        "DOCTOR_STANDING_STAMP",
        "{topic}: {share:.0%} of the stamps repeat the one before, so hardly a message can be used",
        remedy="let the driver stamp every message with its time of measurement",
    ),
    error("DOCTOR_TOO_FEW", "{topic}: {count} messages are too few", remedy="record all topics for some minutes"),
    warning(
        "DOCTOR_UNDECODABLE",
        "{topic}: {count} of {total} messages cannot be decoded: {reason}",
        remedy="rebuild the driver's messages, or record with ros2 bag record",
    ),
    warning(
        "DOCTOR_GAPS",
        "{topic}: silent for {seconds:.1f} s in all (gaps: {count}), the longest at {at_s:.0f} s",
        remedy="check power, cable, bottom lock and fix at that time",
    ),
    warning(
        "DOCTOR_ZEROS",
        "{topic}: {share:.0%} of the velocities are exactly zero",
        remedy="let the driver send nothing, or mark it invalid; these are not used",
    ),
    warning(
        "DOCTOR_REFUSED",
        "{topic}: {share:.0%} of the messages are refused: {reason}",
        means="The message marks itself as not valid.",
        remedy="{remedy}",
    ),
    warning(
        "DOCTOR_FROZEN",
        "{topic}: {share:.0%} of the velocities repeat the one before exactly",
        remedy="let the driver send new measurements only; -p max_repeats:=1 skips the repeats",
    ),
    warning(
        "DOCTOR_COVARIANCE",
        "{topic}: claims a noise of {claimed:.3g} m/s in every message, the data show {shown:.3g} m/s",
        means="The driver sends a constant, and weights and σ follow it.",
        remedy="let the driver send the sensor's figure; for this bag: -p use_message_covariance:=false",
    ),
    warning(
        "DOCTOR_AXIS",
        "{topic}: {axes} is exactly zero in every message: not measured",
        means="Course and speed have no vertical.",
        remedy="use a receiver's own velocity (three axes) if pitch matters",
    ),
    warning(
        "DOCTOR_NOT_FINITE",
        "{topic}: {share:.0%} of the velocities are not finite",
        remedy="check lock or fix at that time; these are not used",
    ),
    error(
        "DOCTOR_NO_ORIENTATION",
        "{topic}: no orientation ({why})",
        remedy="record the IMU's or INS's filtered topic, or a reference in the body frame",
    ),
    warning(
        "DOCTOR_NO_IMU",
        "no IMU in the bag: {what}",
        remedy="record sensor_msgs/Imu with an orientation, or name its topic: --imu-topic",
    ),
    error(
        "DOCTOR_NO_IMU_EARTH",
        "no IMU in the bag: the reference is not in the body's frame, so it cannot be compared with the DVL",
        remedy="record sensor_msgs/Imu with an orientation, or name its topic: --imu-topic",
    ),
    error(
        "DOCTOR_UNITS",
        "DVL and reference differ by a factor of {factor:.4g}{guess}",
        remedy="let its driver convert to m/s",
    ),
    error(
        "DOCTOR_DISAGREE",
        "DVL and reference do not agree in any frames: {left:.0%} of the speed stays unexplained",
        means="A wrong heading, clocks that differ by seconds, another vehicle's data, or water track.",
        remedy="check the IMU's heading (yaw 0 is east and counts to the left), the stamps, and the DVL's bottom lock",
    ),
    warning("DOCTOR_FRAMES", "{says}", remedy="check frames and transforms"),
    warning(
        "DOCTOR_SLOW_REFERENCE",
        "{topic}: {rate_hz:.2g} Hz is too slow for turns",
        remedy="set the receiver to 1 Hz or more, better 5 Hz",
    ),
    error(
        "DOCTOR_NOT_MOVING",
        "{topic}: the vehicle does not move faster than min_speed ({min_speed:g} m/s)",
        remedy="record a run at 0.5 m/s or more",
    ),
)
