"""Warnings about data, configuration and network: code, sentence, meaning and remedy.

/diagnostics, the notes of a replay and the table in docs/troubleshooting.md use these entries. A new warning needs an
entry here and a call of `finding` in the code that detects it.
"""

from __future__ import annotations

from .kinds import error, on_page, warning

FINDINGS = (
    # no data
    error(
        "DVL_NO_MESSAGE",
        "no DVL message yet",
        means="Nothing has come on the DVL's topic: driver off, cable, another topic or domain.",
        remedy="check the sensor, its driver and the topic {topic} (ros2 topic hz), remap it, compare ROS_DOMAIN_ID",
    ),
    warning(
        "TOPICS_FOUND",
        "{own} had no publisher; found and used instead: {found}",
        means="They may be another vehicle's.",
        remedy="remap the topics to these names or the right ones, or set discover to false",
    ),
    error(
        "DVL_SILENT",
        "no usable DVL message for {seconds:.0f} s",
        means="Another finding may name the cause.",
        remedy="check the sensor, its driver and the topic {topic}",
    ),
    warning(
        "IMU_SILENT",
        "no usable IMU message for {seconds:.0f} s",
        means="Models that need attitude or angular velocity learn nothing.",
        remedy="check the IMU's driver and the topic {topic}",
    ),
    warning(
        "DVL_NONE_USABLE",
        "none of {count} DVL messages can be used: {reasons}",
        remedy="look the reasons up in docs/reference.md#drivers",
    ),
    # clocks and stamps
    warning(
        "CLOCKS_DIFFER",
        "{stream} stamps are {seconds:.0f} s {side} the {other}'s and cannot be paired",
        remedy="set both clocks by the same source (PTP, NTP or GNSS)",
    ),
    warning(
        "CLOCK_TAKEN_OFF",
        "{clock}; this is now subtracted ({parameter}: {value:g}), and the calibration has restarted",
        remedy="correct that clock, or set this value as a parameter, which is then kept",
    ),
    warning(
        "DVL_NO_REFERENCE",
        "no DVL sample has a reference velocity at its time, though both arrive",
        means="Usually the DVL has its own clock.",
        remedy="compare the header stamps of both; a DVL with its own clock must be synchronised (NTP)",
    ),
    warning(
        "CLOCK_WENT_BACK",
        "DVL stamps jumped and the calibration restarted",
        means="A clock was set back, a bag looped, or the first stamp was a week early.",
        remedy="set clocks before the node is started",
    ),
    warning(
        "STAMP_MISSING",
        "{stream}: messages without a header stamp, the time of reception is used",
        means="`header.stamp` is zero, and a message is received later than it was measured.",
        remedy="let the driver fill header.stamp",
    ),
    warning(
        "STAMPS_MISSING_IN_BAG",
        "{count} messages had no header stamp, the time at which they were recorded is used",
        remedy="let the driver fill header.stamp",
    ),
    warning(
        "STAMPS_FAR",
        "{topic}: {count} of {total} messages are set aside: {how} {when} UTC, too far from the others",
        means="The clock of a computer was not set, for instance without a clock battery.",
        remedy=(
            "set clocks before recording (a clock battery, NTP, PTP or GNSS); to use those messages, cut the recording"
        ),
    ),
    warning(
        "STAMP_STRAY",
        "{count} {stream} samples have stamps more than max_time_jump from their neighbours'; they are not used",
        means="Single stamps are wrong. A jump is accepted if the next sample confirms it.",
        remedy="check the clock of the driver",
    ),
    warning(
        "SAMPLES_BEFORE_RESTART",
        "{count} {stream} samples are from before the restart (clock set back, or bag looped); they are not used",
        remedy="nothing, unless clocks are set during a run",
    ),
    warning(
        "SAMPLES_LATE",
        "{count} {stream} samples arrived too late for their DVL samples and are not used",
        remedy="raise max_latency; if a bag is played at ten times its speed, to ten times the value",
    ),
    warning(
        "MODEL_RESTARTED",
        "{model}: the filter diverged {count} times and went on from its last good state",
        means="Data and parameters contradict each other, for instance a wrong mounting with the gate switched off.",
        remedy="check mounting_rpy and lever_arm, and do not switch the gate off (gate_probability 0 or 1)",
    ),
    # two publishers, wrong types, quality of service
    warning(
        "STAMP_REPEATED",
        "{count} {stream} samples repeat the stamp of the one before; they are not used",
        means="There are two publishers on one topic, or the driver sends twice.",
        remedy="stop the second publisher (ros2 topic info -v)",
    ),
    warning(
        "STAMP_OUT_OF_ORDER",
        "{count} {stream} samples are older than the one before; they are not used",
        means="There are two publishers on one topic, or a clock was set back by less than `max_time_jump`.",
        remedy="stop the second publisher (ros2 topic info -v), set clocks before the run",
    ),
    warning(
        "TOPIC_SEVERAL_PUBLISHERS",
        "{topic}: {count} publishers ({names}), where one is expected",
        means="Two drivers run, or a bag is played next to the driver: their samples mix.",
        remedy="stop the others",
    ),
    warning(
        "TOPIC_OTHER_TYPE",
        "{topic}: {name} publishes {type} instead of {expected}; its messages are not received",
        means="The remedy in the warning names the parameter to set.",
        remedy="{remedy}",
    ),
    warning(
        "TOPIC_QOS",
        "{topic}: the QoS of {name} is incompatible; its messages are not received ({reason})",
        means="The publisher offers less reliability or durability than the node requests.",
        remedy="set the publisher's durability to volatile; either reliability works",
    ),
    warning(
        "OUTPUT_QOS",
        "{topic}: {name} requests an incompatible QoS and receives nothing ({reason})",
        remedy="change the QoS of the subscriber",
    ),
    warning(
        "SECOND_NODE",
        "{topic}: {count} publishers ({names})",
        means="Two calibration nodes run, or a bag with recorded estimates is played.",
        remedy="stop the second node, or give one a namespace (--ros-args -r __ns:=/port) and its own result_file",
    ),
    warning(
        "TF_TWICE",
        "another node publishes a transform to {frame!r}, in addition to publish_tf",
        means="Usually it is robot_state_publisher, with the nominal mounting.",
        remedy="turn publish_tf off, and write the calibration into the URDF instead (dvl-calib apply --urdf)",
    ),
    warning(
        "POSITION_UNKNOWN",
        "publish_tf is set, but no transform is published: the positions of reference point and DVL in {base} are "
        "unknown",
        remedy=(
            "set reference_position, and dvl_position to from_reference; or publish the transform of the reference's "
            "frame"
        ),
    ),
    warning(
        "TF_NOT_THERE",
        "publish_tf is set, but tf2_ros is not installed; ~/mounting is published, a transform is not",
        remedy="install ros-$ROS_DISTRO-tf2-ros-py, and source its setup.bash",
    ),
    # frames
    warning(
        "DVL_FRAME",
        "dvl: a message has frame_id {frame_id!r} where {expected!r} is expected; it is not used",
        means="The message's frame is not the configured one, or it is the body's.",
        remedy=(
            "let the driver publish in the DVL's own frame, or set parameter dvl_frame to {frame_id!r} if that is "
            "its name"
        ),
    ),
    warning(
        "DVL_TURNED_TWICE",
        "dvl: data in frame {frame_id!r} are turned from forward-right-down to forward-left-up, and mounting_rpy "
        "turns the DVL upside down as well",
        means="Both together are right only for a DVL that looks up.",
        remedy="if mounting_rpy describes a frame whose z points down, set dvl_axes to flu",
    ),
    warning(
        "REFERENCE_FRAME",
        "reference not used: its frame_id {frame_id!r} is neither {base} nor an earth frame",
        means="Earth frames are enu, map, odom, world and ned. `discover` chooses by the data after a turn.",
        remedy="set gnss_frame to body, enu or ned",
    ),
    warning(
        "REFERENCE_NO_ATTITUDE",
        "{count} DVL samples have an earth-frame reference but no attitude; the models with GNSS cannot use them",
        remedy="check that the IMU topic has messages with an orientation; or publish the reference in the body frame",
    ),
    warning(
        "IMU_FRAME",
        "imu: data is in frame {frame_id!r}; it is taken as the orientation and angular velocity of {base}",
        remedy="if the IMU is mounted rotated, give its orientation in parameter imu_rpy",
    ),
    # messages that cannot be used
    warning(
        "MESSAGE_UNDECODABLE",
        "{stream}: a message could not be decoded ({reason}); it is skipped",
        means="The message is truncated, or of another version of its package.",
        remedy="rebuild the driver's messages; ros2 bag convert where the package is installed",
    ),
    warning(
        "SAMPLES_INVALID",
        "{count} {stream} samples are invalid (not finite, above max_speed, or with an impossible covariance); they "
        "are not used",
        remedy="check the sensor, its bottom lock or fix, and its driver",
    ),
    warning(
        "DVL_REFUSED",
        "{count} DVL messages are not used: {reason}",
        means="The driver marks the velocity as not valid ([rules](reference.md#drivers)).",
        remedy="{remedy}",
    ),
    warning(
        "DVL_DROPOUTS",
        "the DVL dropped out {count} times",
        remedy="check its power, cable and bottom lock (altitude, speed)",
    ),
    warning(
        "PROCESS_PAUSED",
        "this process was not running for {seconds:.0f} s",
        means="The node was stopped, or the machine slept or was overloaded.",
        remedy="let it run in the background (bg), keep the machine awake, give it more of a core",
    ),
    warning(
        "DVL_FROZEN",
        "{count} DVL samples repeat one velocity more than max_repeats times; they are not used",
        remedy="restart the driver",
    ),
    warning(
        "DVL_REPEATS",
        "{count} DVL samples repeat the previous velocity exactly; they are used",
        means="Only a simulated velocity without noise repeats exactly.",
        remedy="if the driver repeats its last velocity without a new measurement, set max_repeats",
    ),
    # GNSS
    warning(
        "GNSS_OUTAGE",
        "no GNSS for {seconds:.0f} s: {model} still corrects with its last estimate, but learns nothing more",
        remedy="if the vehicle has not dived, check the receiver and the topic {topic}",
    ),
    warning(
        "GNSS_OUTAGE_WITHOUT",
        "no GNSS for {seconds:.0f} s: {model} continues, but learns nothing that needs GNSS, such as the scale",
        remedy="surface, or check the receiver and the topic {topic}",
    ),
    warning(
        "GNSS_LOSSES",
        "GNSS was lost {count} times",
        means="The antenna was under water or shaded.",
        remedy="check its antenna; if models switch to and fro, raise gnss_hysteresis",
    ),
    warning(
        "BAG_NO_IMU",
        "no IMU in the bag: {what}",
        remedy="record sensor_msgs/Imu with an orientation, or name its topic: --imu-topic",
    ),
    warning(
        "BAG_NO_GNSS",
        "no topic {topic!r} in the bag: only the models without GNSS can run",
        remedy="if there is one under another name, set --gnss-topic",
    ),
    warning(
        "BAG_NO_DEFINITION",
        "the bag has no definition of {type} (recorded before ROS 2 Iron?); the definition built into this program is "
        "used",
        remedy="if it cannot be decoded, run ros2 bag convert to MCAP where the package is installed",
    ),
    # motion and configuration
    warning(
        "NO_TURN_RATE",
        "{count} samples are not used: max_turn_rate is set, and they have no angular velocity",
        remedy="check the IMU topic, or set max_turn_rate to 0",
    ),
    warning(
        "LEVER_ARM_NOT_COMPENSATED",
        "lever_arm is not compensated in {count} samples: no angular velocity",
        remedy="check the IMU topic, or set max_turn_rate so that turns are left out",
    ),
    warning("ALL_SLOW", "every sample is slower than min_speed, nothing is learnt", remedy="drive, at 1 m/s or more"),
    warning(
        "SAMPLES_GATED",
        "{model}: the gate rejects {gated} of {given} samples",
        remedy="check mounting_rpy and the frames: with them, does a vehicle that drives ahead have positive speed?",
    ),
    error(
        "CONFIGURATION_WRONG",
        "the data contradict the configuration: {says}",
        remedy="correct the configuration and start again",
    ),
    warning(
        "HEADING_DEVIATION",
        "the heading error changes with the heading: {rms:.1f}° ± {std:.1f}° rms, {most:+.1f}° at {most_at:.0f}° and "
        "{least:+.1f}° at {least_at:.0f}°; that is {cost:.0f} m of drift per km",
        means="A compass deviates with the heading, a gyro drifts.",
        remedy="calibrate the compass{first}, or average the deviation out on opposite headings and a box",
    ),
    warning(
        "HEADING_DRIFTS",
        "the heading error changes by {degrees:+.1f}° ± {std:.1f}° from start to end, so the yaw is uncertain by "
        "{off:.1f}°",
        means="A gyro or a heading without a compass drifts.",
        remedy="let the heading settle, or aid it with a compass or GNSS",
    ),
    warning(
        "IMU_LEVEL",
        "the IMU's orientation is a heading alone (roll and pitch are 0 in every message), so the DVL's roll and pitch "
        "are not known",
        remedy="record an IMU that gives roll and pitch",
    ),
    warning(
        "TILT_NOT_FOLLOWED",
        "the DVL's velocity does not follow the vehicle's {axis}: {share:.1f} ± {std:.1f} times the {axis} is missing, "
        "which looks like {off:.1f}° of mounting",
        means="Factor 1: the driver levels the velocity. 2 or -2: wrong sign of an IMU angle or a DVL axis.",
        remedy="have the driver send the velocity in the DVL's own axes; check the sign of the IMU's roll and pitch",
    ),
    warning(
        "TILT_NOT_SHOWN",
        "the vehicle hardly tilts, so the data cannot show whether the DVL's driver levels its velocity; if it does, "
        "the {axis} of the mounting is wrong by {lean:.1f}°",
        remedy="look into the driver's settings, or record in waves or with dives",
    ),
    warning(
        "ONE_SPEED",
        "at about one speed a constant error of the DVL looks like yaw, pitch or scale: {off:g} m/s like "
        "{degrees:.1f}° or {percent:.1f} %; σ includes an error of dvl_bias_std",
        remedy="drive at two speeds, one twice the other; set dvl_bias_std to the DVL's accuracy, if you know it",
    ),
    warning(
        "DVL_BIAS",
        "the DVL has the same velocity error at every speed, {axes} mm/s in the body, which "
        "looks like {degrees:.1f}° of misalignment at the usual speed",
        means="The cause is a bias of the electronics, a rounding, or water that moves in the DVL's shell.",
        remedy="subtract the bias in the driver, or have the DVL serviced",
    ),
    warning(
        "BEAM_OFF",
        "one beam of the DVL is off by {percent:.0f} ± {std:.0f} %: the beam {azimuth:.0f}° to port of its x axis "
        "reads low, or the opposite beam high",
        means="A transducer is fouled, damaged or behind bubbles. Roll and yaw of the mounting are then wrong.",
        remedy="look at that transducer; a DVL that gives beam velocities can solve without it",
    ),
    warning(
        "BED_MOVES",
        "moving bed: over ground the reference is {millimetres:.0f} mm/s faster than the DVL towards {course:.0f}°, "
        "on every heading",
        means="The DVL tracks moving sediment or a layer of water.",
        remedy="calibrate where the bed is still; to estimate the bed's velocity: -p reference_offset_std:={std:g}",
    ),
    warning(
        "VELOCITY_SMOOTHED",
        "the {name} is smoothed over {seconds:.1f} s",
        means="A smoothed velocity is late in turns, which looks like roll, lever arm and delay.",
        remedy="record the velocity before it is filtered",
    ),
    warning(
        "CIRCULAR_REFERENCE",
        "the reference holds the DVL's own noise of the last {seconds:.1f} s: a filter computed it from this DVL",
        remedy="use the velocity or positions of GNSS alone",
    ),
    warning(
        "LEVER_ARM_CONTRADICTED",
        "the lever arm in the data differs from the configured one: {axes}",
        means="The position is wrong, or the IMU's heading, turn rate or clock. The configured arm is kept.",
        remedy=(
            "measure the positions of DVL and reference point (lever_arm, reference_position), then check the IMU's "
            "axes and clock"
        ),
    ),
    warning(
        "CLOCK_OR_ARM",
        "at one speed a delayed reference looks like a lever arm, and in a steady turn like a yaw: {metres:.1f} m, "
        "{degrees:.1f}° and {seconds:.1f} s of delay cannot be distinguished; σ includes them",
        remedy="drive turns to both sides at two speeds",
    ),
    warning(
        "CLOCK_ON_TURN",
        "in a steady turn a delayed reference or IMU looks like a yaw: {degrees:.1f}° cannot be distinguished; σ "
        "includes it",
        remedy="drive turns to both sides, or a straight leg",
    ),
    warning(
        "ONE_HEADING",
        "on one heading a constant error of reference or DVL looks like yaw, pitch or scale: {off:g} m/s like "
        "{degrees:.1f}° or {percent:.1f} %; σ includes the reference's constant error",
        remedy=(
            "drive the opposite heading as well, at two speeds; or set reference_offset_std to the reference's "
            "accuracy (σ includes four times that)"
        ),
    ),
    warning(
        "INNOVATIONS_LARGE",
        "{model}: innovations are larger than R and P allow (mean NIS {nis:.1f}, at most {limit:.1f}), σ is too small",
        remedy="raise gnss_aided_std or gnss_free_std, or find the effect with dvl-calib diagnose",
    ),
    warning(
        "PRIOR_HOLDS_ERROR",
        "prior_source initial_window: the mean of the DVL's own first seconds already holds the misalignment, so M5 "
        "and M6 gain nothing over no calibration",
        remedy="prefer prior_source fixed",
    ),
    warning(
        "INITIAL_CONTRADICTED",
        "the data contradict initial_calibration {file}: the mounting has moved {difference} since; it is not used",
        remedy="inspect the mounting; if it is right, save this result and start from that",
    ),
    warning(
        "RESULT_WORSE",
        "{path} is kept, because it is better ({before}); the newer result ({now}) is {beside}",
        remedy="to use the newer result anyway, rename the kept file, or call ~/save_anyway",
    ),
    warning(
        "RESULT_NOT_SAVED",
        "the result was not saved: {reason}",
        means="The previous file is untouched.",
        remedy="free space, or set result_file elsewhere and call ~/save",
    ),
)


# Faults of a recording that the doctor finds: code, sentence, meaning and remedy.

DOCTOR = on_page(
    "troubleshooting.md#what-the-doctor-finds",
    warning(
        "DOCTOR_STAMP_ZERO",
        "{topic}: {share:.0%} of the messages have no stamp",
        remedy="let the driver fill header.stamp with the time of measurement",
    ),
    warning(
        "DOCTOR_STAMP_RECEPTION",
        "{topic}: stamps look like times of reception: they jitter by {jitter_ms:.0f} ms about {period_ms:.0f} ms",
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
        "DOCTOR_APART",
        "{topic} and {other}: only {share:.0%} of the DVL's messages have a reference within seconds of their stamps",
        remedy="record both together; if they were, check the clocks, or the times of both imported files",
    ),
    warning(
        "DOCTOR_REPEATED_STAMP",
        "{topic}: {share:.0%} of the stamps repeat the one before",
        means="There are two publishers, or the driver sends twice.",
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
        remedy="let the driver send nothing without a measurement, or mark the velocity invalid; zeros are not used",
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
        "{topic}: exactly zero along {axes} in every message: not measured",
        means="A receiver that sends course and speed only measures no vertical velocity.",
        remedy="record a velocity of all three axes (a DVL's, or a receiver's own) if pitch matters",
    ),
    warning(
        "DOCTOR_NOT_FINITE",
        "{topic}: {share:.0%} of the velocities are not finite",
        remedy="check bottom lock or fix at that time; such velocities are not used",
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
        remedy="let the driver convert to m/s; check the beam angle and the beam order of the DVL as well",
    ),
    error(
        "DOCTOR_DISAGREE",
        "DVL and reference do not agree in any frames: {left:.0%} of the speed stays unexplained",
        means="The heading is wrong, clocks differ by seconds, or the data are another vehicle's or in water track.",
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
