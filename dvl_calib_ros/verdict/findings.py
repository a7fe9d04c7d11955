"""Warnings about data, configuration and network: code, sentence, meaning and remedy.

/diagnostics, the notes of a replay and the table in docs/troubleshooting.md use these entries. A new warning needs an
entry here and a call of `finding` in the code that detects it.
"""

from __future__ import annotations

from .kinds import Kind, Severity

FINDINGS = (
    # no data
    Kind(
        "DVL_NO_MESSAGE",
        "no DVL message yet",
        "Nothing has come on the DVL's topic: driver off, cable, another topic or domain.",
        "check the sensor, its driver and the topic {topic} (ros2 topic hz), remap it, compare ROS_DOMAIN_ID",
        Severity.ERROR,
    ),
    Kind(
        "TOPICS_FOUND",
        "{own} had no publisher; found and used instead: {found}",
        "They may be another vehicle's.",
        "remap the topics to these names or the right ones, or set discover to false",
    ),
    Kind(
        "DVL_SILENT",
        "no usable DVL message for {seconds:.0f} s",
        "Other findings can say why.",
        "check the sensor, its driver and the topic {topic}",
        Severity.ERROR,
    ),
    Kind(
        "IMU_SILENT",
        "no usable IMU message for {seconds:.0f} s",
        "Models that need attitude or angular velocity learn nothing.",
        "check the IMU's driver and the topic {topic}",
    ),
    Kind(
        "DVL_NONE_USABLE",
        "none of {count} DVL messages can be used: {reasons}",
        "",
        "look the reasons up in docs/reference.md#drivers",
    ),
    # clocks and stamps
    Kind(
        "CLOCKS_DIFFER",
        "{stream} stamps are {seconds:.0f} s {side} the {other}'s and cannot be paired",
        "",
        "set both clocks by the same source (PTP, NTP or GNSS)",
    ),
    Kind(
        "CLOCK_TAKEN_OFF",
        "{clock}: subtracted ({parameter}: {value:g}); the calibration restarted with it",
        "",
        "correct that clock, or set this value as a parameter, which is then kept",
    ),
    Kind(
        "DVL_NO_REFERENCE",
        "no DVL sample has a reference velocity at its time, though both come",
        "Usually the DVL has its own clock.",
        "compare the header stamps of both; a DVL with its own clock must be synchronised (NTP)",
    ),
    Kind(
        "CLOCK_WENT_BACK",
        "DVL stamps jumped and the calibration restarted",
        "A clock was set back, a bag looped, or the first stamp was a week early.",
        "set clocks before the node is started",
    ),
    Kind(
        "STAMP_MISSING",
        "{stream}: messages without a header stamp, the time of reception is used",
        "`header.stamp` is zero; the time of reception is late.",
        "let the driver fill header.stamp",
    ),
    Kind(
        "STAMPS_MISSING_IN_BAG",
        "{count} messages had no header stamp, the time at which they were recorded is used",
        "",
        "let the driver fill header.stamp",
    ),
    Kind(
        "STAMPS_FAR",
        "{topic}: {count} of {total} messages are set aside: {how} {when} UTC, absurdly far from the others",
        "A computer without a clock battery.",
        "set clocks before recording (a clock battery, NTP, PTP or GNSS); to use those messages, cut the recording",
    ),
    Kind(
        "STAMP_STRAY",
        "{count} {stream} samples have stamps more than max_time_jump from their neighbours'; they are not used",
        "Single stamps are wrong. A jump that the next sample confirms is followed.",
        "check the clock of the driver",
    ),
    Kind(
        "SAMPLES_BEFORE_RESTART",
        "{count} {stream} samples were from before the clock was set back or the bag looped; they are not used",
        "",
        "nothing, unless clocks are set during a run",
    ),
    Kind(
        "SAMPLES_LATE",
        "{count} {stream} samples came after the DVL sample that they belong to had been used; they are not used",
        "",
        "raise max_latency, in proportion when a bag is played faster than recorded",
    ),
    Kind(
        "MODEL_RESTARTED",
        "{model}: the filter diverged {count} times and went on from its last good state",
        "Data and parameters contradict each other, for instance a wrong mounting without a gate.",
        "check mounting_rpy and lever_arm, and leave gate_probability on",
    ),
    # two publishers, wrong types, quality of service
    Kind(
        "STAMP_REPEATED",
        "{count} {stream} samples repeat the stamp of the one before; they are not used",
        "Two publishers on one topic, or a driver that sends twice.",
        "stop the second publisher (ros2 topic info -v)",
    ),
    Kind(
        "STAMP_OUT_OF_ORDER",
        "{count} {stream} samples are older than the one before; they are not used",
        "Two publishers on one topic, or a clock set back by less than `max_time_jump`.",
        "stop the second publisher (ros2 topic info -v), set clocks before the run",
    ),
    Kind(
        "TOPIC_SEVERAL_PUBLISHERS",
        "{topic}: {count} publishers ({names}), where one is expected",
        "Two drivers, or a bag next to the driver: samples mix.",
        "stop the others",
    ),
    Kind(
        "TOPIC_OTHER_TYPE",
        "{topic}: {name} publishes {type}, where {expected} is expected, and is not heard",
        "The warning names the parameter.",
        "{remedy}",
    ),
    Kind(
        "TOPIC_QOS",
        "{topic}: the QoS of {name} is incompatible, it is not heard ({reason})",
        "The publisher offers less than the node asks for.",
        "set the publisher's durability to volatile, its reliability to either",
    ),
    Kind(
        "OUTPUT_QOS",
        "{topic}: {name} asks for an incompatible QoS and does not hear it ({reason})",
        "",
        "change the QoS of the subscriber",
    ),
    Kind(
        "SECOND_NODE",
        "{topic}: {count} publishers ({names})",
        "Two calibration nodes, or a bag with recorded estimates.",
        "stop the second node, or give one a namespace (--ros-args -r __ns:=/port) and its own result_file",
    ),
    Kind(
        "TF_TWICE",
        "another node publishes a transform to {frame!r}, in addition to publish_tf",
        "Usually robot_state_publisher with the nominal mounting.",
        "turn publish_tf off, and write the calibration into the URDF instead (dvl-calib apply --urdf)",
    ),
    Kind(
        "POSITION_UNKNOWN",
        "publish_tf is set, but the position of the reference point in {base} is unknown, and so is the DVL's; no "
        "transform is published",
        "",
        "set reference_position, and dvl_position to from_reference; or publish the transform of the reference's frame",
    ),
    Kind(
        "TF_NOT_THERE",
        "publish_tf is set, but tf2_ros is not installed; ~/mounting is published, a transform is not",
        "",
        "install ros-$ROS_DISTRO-tf2-ros-py, and source its setup.bash",
    ),
    # frames
    Kind(
        "DVL_FRAME",
        "dvl: a message has frame_id {frame_id!r} where {expected!r} is expected; it is not used",
        "Another frame than configured, or the body's.",
        "let the driver publish in the DVL's own frame, or set parameter dvl_frame to {frame_id!r} if that is its name",
    ),
    Kind(
        "DVL_TURNED_TWICE",
        "dvl: data in frame {frame_id!r} are turned from forward-right-down to forward-left-up, and mounting_rpy "
        "turns the DVL upside down as well",
        "Right only for a DVL that looks up.",
        "if mounting_rpy describes a frame whose z points down, set dvl_axes to flu",
    ),
    Kind(
        "REFERENCE_FRAME",
        "reference not used: its frame_id {frame_id!r} is neither {base} nor an earth frame",
        "Earth frames are enu, map, odom, world and ned.",
        "set gnss_frame to body, enu or ned",
    ),
    Kind(
        "REFERENCE_NO_ATTITUDE",
        "{count} DVL samples have an earth-frame reference but no attitude; the models with GNSS cannot use them",
        "",
        "check that the IMU topic has messages with an orientation; or publish the reference in the body frame",
    ),
    Kind(
        "IMU_FRAME",
        "imu: data is in frame {frame_id!r}; it is taken as the orientation and angular velocity of {base}",
        "",
        "if the IMU is mounted rotated, give its orientation in parameter imu_rpy",
    ),
    # messages that cannot be used
    Kind(
        "MESSAGE_UNDECODABLE",
        "{stream}: a message could not be decoded ({reason}); it is skipped",
        "Truncated, or of another version of its package.",
        "rebuild the driver's messages; ros2 bag convert where the package is installed",
    ),
    Kind(
        "SAMPLES_INVALID",
        "{count} {stream} samples are invalid (not finite, above max_speed, or with an impossible covariance); they "
        "are not used",
        "",
        "check the sensor, its bottom lock or fix, and its driver",
    ),
    Kind(
        "DVL_REFUSED",
        "{count} DVL messages are not used: {reason}",
        "The driver marks the velocity as not valid ([rules](reference.md#drivers)).",
        "{remedy}",
    ),
    Kind(
        "DVL_DROPOUTS",
        "the DVL dropped out {count} times",
        "",
        "check its power, cable and bottom lock (altitude, speed)",
    ),
    Kind(
        "PROCESS_PAUSED",
        "this process was not running for {seconds:.0f} s",
        "The node was stopped, or the machine slept or was overloaded.",
        "let it run in the background (bg), keep the machine awake, give it more of a core",
    ),
    Kind(
        "DVL_FROZEN",
        "{count} DVL samples repeat one velocity more than max_repeats times; they are not used",
        "",
        "restart the driver",
    ),
    Kind(
        "DVL_REPEATS",
        "{count} DVL samples repeat the velocity before exactly and are used",
        "Only a simulated velocity without noise repeats exactly.",
        "if its driver hangs, set max_repeats",
    ),
    # GNSS
    Kind(
        "GNSS_OUTAGE",
        "no GNSS for {seconds:.0f} s: {model} still corrects with its last estimate, but learns nothing more",
        "",
        "surface, check the receiver and the topic {topic}, or select a model without GNSS (gnss_free_model)",
    ),
    Kind(
        "GNSS_OUTAGE_WITHOUT",
        "no GNSS for {seconds:.0f} s: {model} continues, but learns nothing that needs GNSS, such as the scale",
        "",
        "surface, or check the receiver and the topic {topic}",
    ),
    Kind(
        "GNSS_LOSSES",
        "GNSS was lost {count} times",
        "Antenna under water or shaded.",
        "check its antenna; if models switch to and fro, raise gnss_hysteresis",
    ),
    Kind(
        "BAG_NO_IMU",
        "no IMU in the bag: {what}",
        "",
        "record sensor_msgs/Imu with an orientation, or name its topic: --imu-topic",
    ),
    Kind(
        "BAG_NO_GNSS",
        "no topic {topic!r} in the bag: only the models without GNSS can run",
        "",
        "if there is one under another name, set --gnss-topic",
    ),
    Kind(
        "BAG_NO_DEFINITION",
        "the bag does not say how {type} is laid out (recorded before ROS 2 Iron?); it is read by the definitions "
        "known here",
        "",
        "if it cannot be decoded, run ros2 bag convert to MCAP where the package is installed",
    ),
    # motion and configuration
    Kind(
        "NO_TURN_RATE",
        "{count} samples have no angular velocity for max_turn_rate and are not used",
        "",
        "check the IMU topic, or set max_turn_rate to 0",
    ),
    Kind(
        "LEVER_ARM_NOT_COMPENSATED",
        "lever_arm is not compensated in {count} samples: no angular velocity",
        "",
        "check the IMU topic, or set max_turn_rate so that turns are left out",
    ),
    Kind(
        "ALL_SLOW",
        "every sample is slower than min_speed, nothing is learnt",
        "",
        "drive, at 1 m/s or more",
    ),
    Kind(
        "SAMPLES_GATED",
        "{model}: {gated} of {given} samples are gated",
        "",
        "check mounting_rpy and the frames before believing it: does the vehicle drive ahead in the DVL's x?",
    ),
    Kind(
        "CONFIGURATION_WRONG",
        "the data contradict the configuration: {says}",
        "",
        "correct the configuration and start again",
        Severity.ERROR,
    ),
    Kind(
        "HEADING_DEVIATION",
        "the heading error changes with the heading: {rms:.1f}° ± {std:.1f}° rms, {most:+.1f}° at {most_at:.0f}° and "
        "{least:+.1f}° at {least_at:.0f}°; it costs {cost:.0f} m per km",
        "A compass deviates with the heading, a gyro drifts.",
        "{first}calibrate the compass, or drive opposite headings and a box, over which it averages out",
    ),
    Kind(
        "HEADING_DRIFTS",
        "the heading error changes by {degrees:+.1f}° ± {std:.1f}° from start to end, so the yaw is uncertain by "
        "{off:.1f}°",
        "A gyro or a heading without a compass drifts.",
        "let the heading settle, or aid it with a compass or GNSS",
    ),
    Kind(
        "IMU_LEVEL",
        "the IMU's orientation is a heading alone (roll and pitch are 0 in every message), so the DVL's roll and pitch "
        "are not known",
        "",
        "record an IMU that gives roll and pitch",
    ),
    Kind(
        "TILT_NOT_FOLLOWED",
        "the DVL's velocity does not follow the vehicle's {axis}: {share:.1f} ± {std:.1f} times the {axis} remains, "
        "which looks like {off:.1f}° of mounting",
        "Factor 1: the driver levels the velocity. 2 or -2: wrong sign of an IMU angle or a DVL axis.",
        "have the driver send the velocity in the DVL's own axes; check the sign of the IMU's roll and pitch",
    ),
    Kind(
        "TILT_NOT_SHOWN",
        "the vehicle hardly tilts, so nothing shows whether the DVL's driver levels its velocity: if it does, the "
        "vehicle's mean {axis} is in the mounting ({lean:.1f}° of {axis})",
        "",
        "look into the driver's settings, or record in waves or with dives",
    ),
    Kind(
        "ONE_SPEED",
        "at about one speed a constant error of the DVL looks like yaw, pitch or scale: {off:g} m/s would be "
        "{degrees:.1f}° or {percent:.1f} %; σ includes what dvl_bias_std says of it",
        "",
        "drive at two speeds, one twice the other; set dvl_bias_std, if you know the DVL's",
    ),
    Kind(
        "DVL_BIAS",
        "the DVL has the same velocity error at every speed, {axes} mm/s in the body, which "
        "looks like {degrees:.1f}° of mounting at the usual speed",
        "A bias of the DVL's electronics, a rounding, or water that moves in its shell.",
        "subtract the bias in the driver, or have the DVL serviced",
    ),
    Kind(
        "BEAM_OFF",
        "one beam of the DVL is off by {percent:.0f} ± {std:.0f} %: that at {azimuth:.0f}° from its x axis to port "
        "reads low, or the opposite one high",
        "A fouled or damaged transducer, or bubbles before it; roll and yaw of the mounting are then wrong.",
        "look at that transducer; a DVL that gives beam velocities can solve without it",
    ),
    Kind(
        "BED_MOVES",
        "moving bed: over ground the reference is {millimetres:.0f} mm/s faster than the DVL towards {course:.0f}°, "
        "on every heading",
        "Bottom track follows moving sediment or the water's layer.",
        "calibrate where the bed is still; to estimate that velocity as well: -p reference_offset_std:={std:g}",
    ),
    Kind(
        "VELOCITY_SMOOTHED",
        "the {name} is smoothed over {seconds:.1f} s",
        "A smoothed velocity is late in turns, which looks like roll, lever arm and delay.",
        "record the velocity before it is filtered",
    ),
    Kind(
        "CIRCULAR_REFERENCE",
        "the reference follows the DVL's own noise for {seconds:.1f} s: a filter made it from this DVL",
        "",
        "use the velocity or positions of GNSS alone",
    ),
    Kind(
        "FILTER_FINDS_NOTHING",
        "the reference lags by {late:.1f} s, is smoothed over as long, and shows no error of the DVL: a filter may "
        "have made it from this DVL",
        "",
        "use the velocity or positions of GNSS alone",
    ),
    Kind(
        "LEVER_ARM_CONTRADICTED",
        "the data show another lever arm than the configured one: {axes}",
        "Wrong position, or an IMU heading, turn rate or clock that looks like one. The configured arm is kept.",
        "measure the positions of DVL and reference point (lever_arm, reference_position), then check the IMU's axes, "
        "clock",
    ),
    Kind(
        "CLOCK_OR_ARM",
        "at one speed a delayed reference looks like a lever arm, and in a steady turn like a yaw: {metres:.1f} m, "
        "{degrees:.1f}° and {seconds:.1f} s of delay cannot be distinguished; σ includes them",
        "",
        "drive turns to both sides at two speeds",
    ),
    Kind(
        "CLOCK_ON_TURN",
        "in a steady turn a delayed reference or IMU looks like a yaw: {degrees:.1f}° cannot be distinguished; σ "
        "includes it",
        "",
        "drive turns to both sides, or a straight leg",
    ),
    Kind(
        "REFERENCE_OFFSET",
        "the reference has a constant error of {millimetres:.0f} mm/s towards {course:.0f}°{where}",
        "A constant error of an inertial navigation, or a current in water track. `full` estimates it.",
        "judge the drift by another reference",
    ),
    Kind(
        "ONE_HEADING",
        "on one heading a constant error of reference or DVL looks like yaw, pitch or scale: {off:g} m/s would be "
        "{degrees:.1f}° or {percent:.1f} %; σ includes that of the reference",
        "",
        "drive the opposite heading as well, at two speeds; or set reference_offset_std to the reference's accuracy "
        "(σ includes four times that)",
    ),
    Kind(
        "INNOVATIONS_LARGE",
        "{model}: innovations are larger than R and P allow (mean NIS {nis:.1f}, at most {limit:.1f}), σ is too small",
        "",
        "raise gnss_aided_std or gnss_free_std, or find the effect with dvl-calib diagnose",
    ),
    Kind(
        "PRIOR_HOLDS_ERROR",
        "prior_source initial_window: the mean of the DVL's own first seconds already holds the misalignment, so M5 "
        "and M6 gain nothing over no calibration",
        "",
        "prefer prior_source fixed",
    ),
    Kind(
        "INITIAL_CONTRADICTED",
        "the data contradict initial_calibration {file}: the mounting has moved {difference} since, so it is left out",
        "",
        "inspect the mounting; if it is right, save this result and start from that",
    ),
    Kind(
        "RESULT_WORSE",
        "{path} is kept, which is better ({before}); the newer result ({now}) is {beside}",
        "",
        "to use the newer all the same, rename it, or call ~/save_anyway",
    ),
    Kind(
        "RESULT_NOT_SAVED",
        "the result was not saved: {reason}",
        "The previous file is untouched.",
        "free space, or set result_file elsewhere and call ~/save",
    ),
)
