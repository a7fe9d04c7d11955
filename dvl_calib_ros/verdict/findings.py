"""What can be wrong with data, configuration and network: every warning with its code, its meaning and its remedy.

/diagnostics, the notes of a replay and the table in docs/troubleshooting.md are made from it, so a warning is an entry
here and a call of `finding` where it is noticed.
"""

from __future__ import annotations

from .kinds import Kind, Severity

FINDINGS = (
    # no data
    Kind(
        "DVL_NO_MESSAGE",
        "no DVL message yet",
        "Nothing has come on the DVL's topic since the start: driver off, cable, another topic or another domain.",
        "check the sensor, its driver and the topic {topic} (ros2 topic hz), remap it, compare ROS_DOMAIN_ID",
        Severity.ERROR,
    ),
    Kind(
        "TOPICS_FOUND",
        "nobody published {own}; found and used instead: {found}",
        "Topics were chosen by type and content, as a replay chooses them (parameter discover). With several vehicles "
        "on one ROS domain they may be another's.",
        "remap the topics to these names if they are right, else to the right ones, or set discover to false",
    ),
    Kind(
        "DVL_SILENT",
        "no usable DVL message for {seconds:.0f} s",
        "Messages came and have stopped, or every one of them is refused (the other findings say why).",
        "check the sensor, its driver and the topic {topic}",
        Severity.ERROR,
    ),
    Kind(
        "IMU_SILENT",
        "no usable IMU message for {seconds:.0f} s",
        "Models that need attitude or angular velocity learn nothing meanwhile.",
        "check the IMU's driver and the topic {topic}",
    ),
    Kind(
        "DVL_NONE_USABLE",
        "none of {count} DVL messages can be used: {reasons}",
        "Every message is refused for the reasons listed, which are the counters of /diagnostics and replay.",
        "look the reasons up in the table of drivers (docs/bags_and_drivers.md)",
    ),
    # clocks and stamps
    Kind(
        "CLOCKS_DIFFER",
        "{stream} stamps are {seconds:.0f} s {side} the {other}'s and cannot be paired",
        "The two drivers stamp by different clocks.",
        "set both clocks by the same source (PTP, NTP or GNSS)",
    ),
    Kind(
        "CLOCK_TAKEN_OFF",
        "{clock}: taken off ({parameter}: {value:g}); the calibration began anew with it",
        "Two looks at velocities and turns agreed on it. What came before is used again, if that was no more than a "
        "quarter of an hour.",
        "set that clock right, or give what was found as a parameter, which then stands",
    ),
    Kind(
        "DVL_NO_REFERENCE",
        "no DVL sample has a reference velocity at its time, though both come",
        "Their stamps never come within gnss_timeout of each other, usually because the DVL stamps by its own clock.",
        "compare the header stamps of both; a DVL that stamps with a clock of its own must be synchronised (NTP)",
    ),
    Kind(
        "CLOCK_WENT_BACK",
        "DVL stamps jumped and the calibration started anew",
        "A clock was set back, a bag looped, or the first stamp alone was more than a week early. What was learnt "
        "before is gone.",
        "set clocks before the node is started",
    ),
    Kind(
        "STAMP_MISSING",
        "{stream}: messages without a header stamp, the time of reception is used",
        "header.stamp is zero. The time of reception is late by the transport, which costs accuracy in turns.",
        "let the driver fill header.stamp",
    ),
    Kind(
        "STAMPS_MISSING_IN_BAG",
        "{count} messages had no header stamp, the time at which they were recorded is used",
        "As STAMP_MISSING, counted over a whole bag.",
        "let the driver fill header.stamp",
    ),
    Kind(
        "STAMPS_FAR",
        "{topic}: {count} of {total} messages are set aside: {how} {when} UTC, absurdly far from the others",
        "A computer without a clock battery that began in 1970, or a broken stamp. Set aside is what is more than a "
        "year away, of less than a tenth of a topic's messages what is more than a week away, and a log time that "
        "contradicts both the message's stamp and the other log times.",
        "set clocks before recording (a clock battery, NTP, PTP or GNSS); to use those messages, cut the recording",
    ),
    Kind(
        "STAMP_STRAY",
        "{count} {stream} samples are more than max_time_jump from their neighbours in time; they are not used",
        "Single stamps that are far off. A jump that the next sample confirms is followed instead.",
        "check the clock of the driver",
    ),
    Kind(
        "SAMPLES_BEFORE_RESTART",
        "{count} {stream} samples were from before the clock was set back or the bag looped; they are not used",
        "They belong to the run that ended there.",
        "nothing, unless clocks are set during a run",
    ),
    Kind(
        "SAMPLES_LATE",
        "{count} {stream} samples came after a DVL sample had gone on without them; they are not used",
        "The topic lags the DVL's by more than max_latency.",
        "raise max_latency, in proportion when a bag is played faster than recorded",
    ),
    Kind(
        "MODEL_RESTARTED",
        "{model}: the filter diverged {count} times and went on from its last good state",
        "Data and parameters contradict each other so much that the filter's arithmetic fails, as with no gate and a "
        "mounting that is turned round.",
        "check mounting_rpy and lever_arm, and leave gate_probability on",
    ),
    # two publishers, wrong types, quality of service
    Kind(
        "STAMP_REPEATED",
        "{count} {stream} samples repeat the stamp of the one before; they are not used",
        "Two publishers of one topic (often a bag played beside the driver), or a driver that sends twice.",
        "stop the second publisher (ros2 topic info -v)",
    ),
    Kind(
        "STAMP_OUT_OF_ORDER",
        "{count} {stream} samples are older than the one before; they are not used",
        "Two publishers of one topic, or a clock that was set back by less than max_time_jump.",
        "stop the second publisher (ros2 topic info -v), set clocks before the run",
    ),
    Kind(
        "TOPIC_SEVERAL_PUBLISHERS",
        "{topic}: {count} publishers ({names}), where one is expected",
        "Two drivers, or a bag beside the driver. Their samples mix.",
        "stop the others",
    ),
    Kind(
        "TOPIC_OTHER_TYPE",
        "{topic}: {name} publishes {type}, where {expected} is expected, and is not heard",
        "ROS 2 connects only publishers and subscribers of the same message type.",
        "{remedy}",
    ),
    Kind(
        "TOPIC_QOS",
        "{topic}: the QoS of {name} is incompatible, it is not heard ({reason})",
        "The publisher offers less than the node asks for, or something else.",
        "set the publisher's durability to volatile, its reliability to either",
    ),
    Kind(
        "OUTPUT_QOS",
        "{topic}: {name} asks for an incompatible QoS and does not hear it ({reason})",
        "The subscriber asks for more than the node offers.",
        "change the QoS of the subscriber",
    ),
    Kind(
        "SECOND_NODE",
        "{topic}: {count} publishers ({names})",
        "Two calibration nodes, or a bag with recorded estimates: estimates mix, and result files replace each other.",
        "stop the second calibration node or the bag that plays a recorded one, or give one a namespace "
        "(--ros-args -r __ns:=/port) and its own result_file",
    ),
    Kind(
        "TF_TWICE",
        "another node publishes a transform to {frame!r}, beside publish_tf",
        "Usually the robot_state_publisher with the nominal mounting. Which of the two a listener has is chance.",
        "turn publish_tf off, and write the calibration into the URDF instead (dvl-calib apply --urdf)",
    ),
    Kind(
        "POSITION_UNKNOWN",
        "publish_tf is set, but the position of the reference point in {base} is unknown, and so is the DVL's; no "
        "transform is published",
        "The lever arm is the DVL's position from the reference point (an antenna, an INS), not from base_frame.",
        "set reference_position, and dvl_position to from_reference; or publish the transform of the reference's frame",
    ),
    Kind(
        "TF_NOT_THERE",
        "publish_tf is set, but tf2_ros is not installed; ~/mounting is published, a transform is not",
        "ROS from PyPI has no tf2_ros; a ROS installation has.",
        "install ros-$ROS_DISTRO-tf2-ros-py, and source its setup.bash",
    ),
    # frames
    Kind(
        "DVL_FRAME",
        "dvl: a message has frame_id {frame_id!r} where {expected!r} is expected; it is not used",
        "The velocity is in another frame than the node was told, or already turned into the body.",
        "let the driver publish in the DVL's own frame, or set parameter dvl_frame to {frame_id!r} if that is its name",
    ),
    Kind(
        "DVL_TURNED_TWICE",
        "dvl: data in frame {frame_id!r} are turned from forward-right-down to forward-left-up, and mounting_rpy "
        "turns the DVL upside down as well",
        "Right only for a DVL that looks up. Otherwise the roll of 180° is counted twice.",
        "if mounting_rpy is that of a frame whose z points down, set dvl_axes to flu, which takes the data as they are",
    ),
    Kind(
        "REFERENCE_FRAME",
        "reference: frame_id {frame_id!r} says neither body ({base}) nor earth ({earth}); its messages are not used",
        "A velocity can only be compared when its frame is known.",
        "set parameter gnss_frame to body, enu or ned",
    ),
    Kind(
        "REFERENCE_NO_ATTITUDE",
        "{count} DVL samples have an earth-frame reference but no attitude; the models with GNSS cannot use them",
        "A velocity in ENU or NED needs the IMU's orientation to be turned into the body. Live, a machine that is too "
        "busy lets the IMU lag.",
        "check the IMU topic, and that it gives an orientation; or publish the reference in the body frame",
    ),
    Kind(
        "IMU_FRAME",
        "imu: data is in frame {frame_id!r}; it is taken as the orientation and angular velocity of {base}",
        "If the IMU is mounted turned, attitude and turn rates are wrong by that.",
        "if the IMU is mounted turned, give its orientation in parameter imu_rpy",
    ),
    # messages that cannot be used
    Kind(
        "MESSAGE_UNDECODABLE",
        "{stream}: a message could not be decoded ({reason}); it is skipped",
        "Truncated, or of another version of its message package.",
        "rebuild the driver's messages; ros2 bag convert where the package is installed",
    ),
    Kind(
        "SAMPLES_INVALID",
        "{count} {stream} samples are invalid (not finite, above max_speed, or with an impossible covariance); they "
        "are not used",
        "No bottom lock or no fix, or a driver that fills fields wrongly.",
        "check the sensor, its bottom lock or fix, and its driver",
    ),
    Kind(
        "DVL_REFUSED",
        "{count} DVL messages are not used: {reason}",
        "The driver itself says that the velocity is not valid (rules in docs/bags_and_drivers.md).",
        "{remedy}",
    ),
    Kind(
        "DVL_DROPOUTS",
        "the DVL dropped out {count} times",
        "Gaps in its samples: no bottom lock, power or cable.",
        "check its power, cable and bottom lock (altitude, speed)",
    ),
    Kind(
        "PROCESS_PAUSED",
        "this process was not running for {seconds:.0f} s",
        "It was stopped (Ctrl-Z, SIGSTOP), or the machine slept or was overloaded. What came meanwhile may be lost; a "
        "gap in the DVL's samples is then no fault of the DVL.",
        "let it run in the background (bg), keep the machine awake, give it more of a core",
    ),
    Kind(
        "DVL_FROZEN",
        "{count} DVL samples repeat one velocity more than max_repeats times; they are not used",
        "The driver hangs and sends its last velocity again.",
        "restart the driver",
    ),
    Kind(
        "DVL_REPEATS",
        "{count} DVL samples repeat the velocity before exactly and are used",
        "A measured velocity never repeats to the last bit. A simulated one without noise does.",
        "if its driver hangs, set max_repeats",
    ),
    # GNSS
    Kind(
        "GNSS_OUTAGE",
        "no GNSS for {seconds:.0f} s: correcting goes on with what {model} has learnt, learning does not",
        "References came and have stopped, or every one of them is refused. The selected model needs them.",
        "surface, check the receiver and the topic {topic}, or select a model without GNSS (gnss_free_model)",
    ),
    Kind(
        "GNSS_OUTAGE_WITHOUT",
        "no GNSS for {seconds:.0f} s: {model} goes on without it, what needs GNSS, as the scale, learns nothing",
        "References came and have stopped, or every one of them is refused. Models that need them keep what they know.",
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
        "Attitude turns a velocity over ground into the body; turn rates take out what a lever arm adds in turns.",
        "record the IMU's topic (sensor_msgs/Imu, with orientation) beside the DVL, or name it: --imu-topic",
    ),
    Kind(
        "BAG_NO_GNSS",
        "no topic {topic!r} in the bag: only the models without GNSS can run",
        "No reference velocity under this name.",
        "if there is one under another name, set --gnss-topic",
    ),
    Kind(
        "BAG_NO_DEFINITION",
        "the bag does not say how {type} is laid out (recorded before ROS 2 Iron?); it is read as the definitions "
        "known here say",
        "SQLite bags of older ROS 2 hold no message definitions.",
        "if it cannot be decoded, run ros2 bag convert to MCAP where the package is installed",
    ),
    # motion and configuration
    Kind(
        "NO_TURN_RATE",
        "{count} samples have no angular velocity for max_turn_rate and are not used",
        "max_turn_rate is set, and no IMU tells the turn rate.",
        "check the IMU topic, or set max_turn_rate to 0",
    ),
    Kind(
        "LEVER_ARM_NOT_COMPENSATED",
        "lever_arm is not compensated in {count} samples: no angular velocity",
        "lever_arm is set, and no IMU tells the turn rate, so these samples are wrong by lever arm times turn rate.",
        "check the IMU topic, or set max_turn_rate so that turns are left out",
    ),
    Kind(
        "ALL_SLOW",
        "every sample is slower than min_speed, nothing is learnt",
        "The vehicle stands or drifts. An angle cannot be seen without motion.",
        "drive, at 1 m/s or more",
    ),
    Kind(
        "SAMPLES_GATED",
        "{model}: {gated} of {given} samples are gated",
        "So many innovations are impossible that the configuration is more likely wrong than the data.",
        "check mounting_rpy and the frames before believing it: does the vehicle drive ahead in the DVL's x?",
    ),
    Kind(
        "CONFIGURATION_WRONG",
        "the data contradict the configuration: {says}",
        "The reference is not in the frame, or the DVL not mounted, as the parameters say: another frame or a rotation "
        "by a large angle fits the samples, gated ones with them, much better.",
        "correct the configuration and start again",
        Severity.ERROR,
    ),
    Kind(
        "HEADING_DEVIATION",
        "the heading error changes {course}: {rms:.1f}° ± {std:.1f}° rms, {most:+.1f}° at {most_at:.0f}° and "
        "{least:+.1f}° at {least_at:.0f}°; it costs {cost:.0f} m per km",
        "A compass deviates with the heading, a gyro drifts; no mounting does either. The DVL's yaw is found against "
        "the IMU's heading, so the yaw includes the mean of that error over the headings driven.",
        "{first}calibrate the compass, or drive opposite headings and a box, over which it averages out",
    ),
    Kind(
        "IMU_LEVEL",
        "the IMU's orientation is a heading alone (roll and pitch are 0 in every message), so the DVL's roll and pitch "
        "are not known",
        "What the vehicle is trimmed by looks like a mounting of the DVL, and the same IMU will not take it off again.",
        "record an IMU that gives roll and pitch",
    ),
    Kind(
        "TILT_NOT_FOLLOWED",
        "the DVL's velocity does not follow the vehicle's {axis}: {share:.1f} ± {std:.1f} times the {axis} is left, "
        "which looks like {off:.1f}° of mounting",
        "1: the driver has turned the velocity into a level frame. 2 or -2: the IMU's angle, or an axis of the DVL, "
        "has the other sign. Either way the mean of the angle over the run looks like a mounting.",
        "have the driver send the velocity in the DVL's own axes; check the sign of the IMU's roll and pitch",
    ),
    Kind(
        "TILT_NOT_SHOWN",
        "the vehicle hardly tilts, so nothing shows whether the DVL's driver levels its velocity: if it does, the "
        "vehicle's mean {axis} is in the mounting ({lean:.1f}° of {axis})",
        "A levelled velocity and one in the DVL's own axes differ by the tilt alone; its mean over a run looks like a "
        "mounting.",
        "look into the driver's settings, or record in waves or with dives",
    ),
    Kind(
        "ONE_SPEED",
        "at about one speed a constant error of the DVL looks like yaw, pitch or scale: {off:g} m/s would be "
        "{degrees:.1f}° or {percent:.1f} %; σ includes what dvl_bias_std says of it",
        "A bias turns with the vehicle as a mounting does, and only another speed tells one from the other.",
        "drive at two speeds, one twice the other; set dvl_bias_std, if you know the DVL's",
    ),
    Kind(
        "DVL_BIAS",
        "the DVL is off by the same velocity at every speed, {axes} mm/s in the body, which "
        "looks like {degrees:.1f}° of mounting at the usual speed",
        "A bias of the DVL's electronics, a rounding, or water that moves in its shell. At one speed nothing tells it "
        "from a mounting.",
        "take the bias off in the driver, or have the DVL serviced",
    ),
    Kind(
        "BED_MOVES",
        "moving bed: over ground the reference is {millimetres:.0f} mm/s faster than the DVL towards {course:.0f}°, "
        "on every heading",
        "The bottom track follows sediment that moves, or the water's layer; a reference is hardly ever so far off. "
        "Dead reckoning drifts by as much there.",
        "calibrate where the bed is still; to estimate that velocity as well: -p reference_offset_std:={std:g}",
    ),
    Kind(
        "VELOCITY_SMOOTHED",
        "the {name} is smoothed over {seconds:.1f} s",
        "A filter that follows late cuts corners: in turns its velocity is that of another motion, of which the "
        "calibration makes a roll, a lever arm and a delay.",
        "record the velocity before it is filtered",
    ),
    Kind(
        "CIRCULAR_REFERENCE",
        "the reference follows the DVL's own noise for {seconds:.1f} s: a filter made it from this DVL",
        "No two instruments share noise. A navigation filter that takes the DVL in takes its mounting in as well, so "
        "its velocity shows no error of it, or that of an earlier calibration.",
        "take a reference that has not seen the DVL: velocity or positions of GNSS alone",
    ),
    Kind(
        "FILTER_FINDS_NOTHING",
        "the reference lags by {late:.1f} s, is smoothed over as long, and shows no error of the DVL: a filter may "
        "have made it from this DVL",
        "A filter that takes the DVL in shows none, whatever the mounting is; nor does a smooth instrument of its own "
        "where the DVL is well mounted. These data do not tell them apart.",
        "take a reference that has not seen the DVL: velocity or positions of GNSS alone",
    ),
    Kind(
        "LEVER_ARM_CONTRADICTED",
        "the data show another lever arm than the one that was given: {axes}",
        "The place that was given is wrong, or something else is that looks like it: heading, turn rates or clock of "
        "the IMU, DVL velocities that are not in its own axes, an antenna elsewhere. The place that was given is kept.",
        "measure where DVL and reference point are (lever_arm, reference_position), then check the IMU's axes, clock",
    ),
    Kind(
        "CLOCK_OR_ARM",
        "at one speed a late reference looks like a lever arm, and in a steady turn like a yaw: {metres:.1f} m, "
        "{degrees:.1f}° and {seconds:.1f} s of delay cannot be told apart; σ includes them",
        "An attitude of another time turns the velocity like a lever arm of speed times delay would. Only turns at "
        "two speeds, to both sides, tell them apart. A reference is taken to be in "
        "time to 0.5 s.",
        "drive turns to both sides at two speeds",
    ),
    Kind(
        "CLOCK_ON_TURN",
        "in a steady turn a late reference or IMU looks like a yaw: {degrees:.1f}° cannot be told apart; σ includes it",
        "The velocity of another time points elsewhere, always by the same angle. A reference is taken to be in time "
        "to 0.5 s.",
        "drive turns to both sides, or a straight leg",
    ),
    Kind(
        "REFERENCE_OFFSET",
        "the reference has a constant error of {millimetres:.0f} mm/s towards {course:.0f}°{where}",
        "A constant error of an inertial navigation, or a current where the DVL tracks the water. full estimates "
        "it, so it does not harm them; errors and drift against this reference include it.",
        "judge the drift by another reference",
    ),
    Kind(
        "ONE_HEADING",
        "on one heading a constant error of reference or DVL looks like yaw, pitch or scale: {off:g} m/s would be "
        "{degrees:.1f}° or {percent:.1f} %; σ includes that of the reference",
        "A constant error of the DVL turns with the vehicle; one of the reference, or a current, does not. On one "
        "heading at one speed neither differs from a mounting.",
        "drive the opposite heading as well, at two speeds; or set reference_offset_std to how good the reference is "
        "(σ includes four times that)",
    ),
    Kind(
        "INNOVATIONS_LARGE",
        "{model}: innovations are larger than R and P allow (mean NIS {nis:.1f}, at most {limit:.1f}), σ is too small",
        "Noise above what is assumed, or an effect that the model does not have.",
        "raise gnss_aided_std or gnss_free_std, or ask dvl-calib diagnose what effect it is",
    ),
    Kind(
        "PRIOR_HOLDS_ERROR",
        "prior_source initial_window: the mean of the DVL's own first seconds already holds the misalignment, so M5 "
        "and M6 gain nothing over no calibration",
        "The prior of sway and heave is taken from the sensor that is to be calibrated.",
        "prefer prior_source fixed",
    ),
    Kind(
        "INITIAL_CONTRADICTED",
        "the data contradict initial_calibration {file}: the mounting has moved {difference} since, so it is left out",
        "What is begun with would be blended with what these data show, into the mounting of neither.",
        "inspect the mounting; if it is right, save this result and start from that",
    ),
    Kind(
        "RESULT_WORSE",
        "{path} is kept, which is better ({before}); the newer result ({now}) is {beside}",
        "A worse verdict, or a larger σ of another run, of the same mounting replaces nothing unasked.",
        "to use the newer all the same, rename it, or call ~/save_anyway",
    ),
    Kind(
        "RESULT_NOT_SAVED",
        "the result was not saved: {reason}",
        "Full disk, a folder that is gone, or no permission. The file before is untouched.",
        "free space, or set result_file elsewhere and call ~/save",
    ),
)
