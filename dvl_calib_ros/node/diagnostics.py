"""Content of /diagnostics: the live checks, the faults of topics, and one status of the running calibration."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.duration import Infinite
from rclpy.node import Node
from rclpy.qos import LivelinessPolicy, QoSCompatibility, QoSProfile, qos_check_compatible

from ..calibration.calibrator import Calibrator
from ..calibration.checks.data_warnings import (
    consistency_warnings,
    gate_warnings,
    message_warnings,
    recording_warnings,
    reference_warnings,
)
from ..calibration.checks.speed_of_sound import CauseOfScale, Water, cause_of_scale
from ..calibration.models import MODELS
from ..calibration.models.base import Needs
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.kalman import GaussianState
from ..calibration.numerics.samples import Stream
from ..calibration.registration.clock_domains import arrival_offset
from ..calibration.registration.clock_drift_and_jumps import REPORTED_FROM_S
from ..calibration.registration.registration import OFFSETS, Registration
from ..calibration.results.results import Estimate, scale_and_delay
from ..calibration.streams.aligner import counts_by_use
from ..discovery.gravity import contradictions
from ..errors import printable
from ..messages.drivers import TYPES_OF, VelocityType
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding, of_consequence
from .operator_card import Card

# ROS 2's name of a node whose topic is discovered before the node
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"


def input_problems(node: Node, subscription: Any, type_parameter: str | None) -> list[Reason]:
    """Return the problems with the publishers of an input, with remedies.

    type_parameter: parameter that selects the topic's type, if there is one.
    """
    topic, kind = subscription.topic_name, _type_name(subscription.msg_type)
    publishers = node.get_publishers_info_by_topic(topic)
    problems = [
        finding(
            "TOPIC_OTHER_TYPE",
            topic=topic,
            name=_name(info),
            type=info.topic_type,
            expected=kind,
            remedy=_other_type_remedy(info.topic_type, type_parameter),
        )
        for info in publishers
        if info.topic_type != kind
    ]
    rightly_typed = [info for info in publishers if info.topic_type == kind]
    if len(rightly_typed) > 1:
        names = ", ".join(map(_name, rightly_typed))
        problems.append(finding("TOPIC_SEVERAL_PUBLISHERS", topic=topic, count=len(rightly_typed), names=names))
    for info in rightly_typed:
        reason = _incompatible(info.qos_profile, _in_full(subscription.qos_profile))
        if reason:
            problems.append(finding("TOPIC_QOS", topic=topic, name=_name(info), reason=reason))
    return problems


def _other_type_remedy(name: str, type_parameter: str | None) -> str:
    if type_parameter is None or name not in TYPES_OF[type_parameter]:
        return "remap one of the two, or convert"
    return f"set {type_parameter} to it, or remap one of the two"


def output_problems(node: Node, publisher: Any) -> list[Reason]:
    """Return the subscribers of an output that cannot receive it, with the reason."""
    problems = []
    for info in node.get_subscriptions_info_by_topic(publisher.topic_name):
        reason = _incompatible(_in_full(publisher.qos_profile), info.qos_profile)
        if reason:
            problems.append(finding("OUTPUT_QOS", topic=publisher.topic_name, name=_name(info), reason=reason))
    return problems


def twin_problems(node: Node, publisher: Any) -> list[Reason]:
    """Report other publishers of the node's own topic: their estimates mix, and their files replace each other."""
    publishers = node.get_publishers_info_by_topic(publisher.topic_name)
    if len(publishers) < 2:
        return []
    names = ", ".join(map(_name, publishers))
    return [finding("SECOND_NODE", topic=publisher.topic_name, count=len(publishers), names=names)]


def _incompatible(offered: QoSProfile, requested: QoSProfile) -> str | None:
    compatibility, reason = qos_check_compatible(offered, requested)
    return reason.removeprefix("ERROR: ").rstrip(";") if compatibility == QoSCompatibility.ERROR else None


def _in_full(own: QoSProfile) -> QoSProfile:
    """Return one of the node's profiles with its defaults filled in, for comparison with others'."""
    return QoSProfile(
        depth=1,
        reliability=own.reliability,
        durability=own.durability,
        deadline=Infinite,
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Infinite,
    )


def _name(info: Any) -> str:
    if info.node_name == UNKNOWN_NAME:  # discovered later than its topic
        return "unnamed node"
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _type_name(message_type: type) -> str:
    package, _, _ = message_type.__module__.split(".", 2)
    return f"{package}/msg/{message_type.__name__}"


# more than ten minutes of samples add nothing
MOST = 600


class GravitySeen:
    """Collector of gravity samples of the IMU, selected by stamps so that a replay selects the same."""

    def __init__(self) -> None:
        self._second = -1
        self._rows: list[tuple[float, ...]] = []

    def add(self, message: Any) -> None:
        """Add a sensor_msgs/Imu."""
        second = message.header.stamp.sec
        if second == self._second or len(self._rows) == MOST:
            return
        self._second = second
        q, a = message.orientation, message.linear_acceleration
        self._rows.append((q.x, q.y, q.z, q.w, a.x, a.y, a.z))

    def problems(self, topic: str, parameters: Parameters) -> list[Reason]:
        """Return the contradictions between gravity and the configured use of this topic."""
        rows = np.array(self._rows, dtype=float).reshape(-1, 7)
        return contradictions(topic, rows[:, :4], rows[:, 4:], parameters)


class LateClocks:
    """Clock offsets to subtract, once, if none was configured and two successive estimates agree.

    found: reasons for the subtraction. is_final: whether nothing more is subtracted.
    """

    def __init__(self, given: Collection[str]) -> None:
        """Set up. given: names of the parameters that the user set."""
        self.is_final = bool(OFFSETS.keys() & set(given))
        self._before: Registration | None = None
        self.found: list[Reason] = []

    def parameters(self, registration: Registration | None, parameters: Parameters) -> Parameters | None:
        """Return parameters with the offsets of the newest estimate for a restart, or None if nothing changes."""
        if self.is_final or registration is None or registration is self._before:
            return None
        before, self._before = self._before, registration
        corrections = registration.corrections
        if before is None or not corrections or not _are_alike(before.corrections, corrections):
            return None
        self.is_final = True
        offsets = {name: round(getattr(parameters, name) + seconds, 3) for name, seconds in corrections.items()}
        self.found = [
            finding("CLOCK_TAKEN_OFF", clock=registration.clock_reason(name), parameter=name, value=seconds)
            for name, seconds in offsets.items()
        ]
        return parameters.replace(**offsets)


def _are_alike(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    return one.keys() == other.keys() and all(abs(one[name] - other[name]) < REPORTED_FROM_S for name in other)


# A process that checks its clock every second and finds this much time gone was paused, s.
PAUSE_S = 5.0


def steady_s() -> float:
    """Return seconds of a clock that nobody sets and that runs while the machine sleeps, if it has one (Linux)."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Pauses:
    """Detector of pauses, to be called every second that the process runs. now_s: of `steady_s`."""

    def __init__(self, now_s: float) -> None:
        self._last_s = now_s
        self._paused_s = 0.0
        self._pauses: list[tuple[float, float]] = []

    def running_s(self, now_s: float) -> float:
        """Take a reading of the steady clock, detect a pause before it, and return the time (s) without pauses."""
        gone_s = now_s - self._last_s
        self._last_s = now_s
        if gone_s > PAUSE_S:
            self._paused_s += gone_s
            self._pauses.append((now_s - self._paused_s, gone_s))
        return now_s - self._paused_s

    def within(self, seconds: float) -> list[float]:
        """Return the lengths (s) of pauses that ended within the last `seconds` of running."""
        running_s = self._last_s - self._paused_s
        self._pauses = [pause for pause in self._pauses if running_s - pause[0] <= seconds]
        return [length for _, length in self._pauses]

    def forget(self) -> None:
        """Forget all pauses before now."""
        self._pauses.clear()


# A stream without a usable sample for this time is silent, s.
SILENCE_S = 5.0
# Counts that grew within this time give a warning, s; older ones are only counted.
RECENT_S = 60.0
_PIECES = 6

Counts = Mapping[str, Mapping[str, int]]
_NOT_TAKEN = {"invalid", "duplicate", "out_of_order", "stray", "held", "before_restart"}
_NAMED = {Stream.DVL: "DVL", Stream.REFERENCE: "GNSS", Stream.IMU: "IMU"}
# stream -> code of the finding when it is silent, and default topic
_SILENT = {
    "dvl": ("DVL_SILENT", "dvl/twist"),
    "reference": ("GNSS_OUTAGE", "gnss/twist"),
    "imu": ("IMU_SILENT", "imu/data"),
}
# Warnings that explain others come before them.
_CAUSES = {"REFERENCE_FRAME", "TOPIC_SEVERAL_PUBLISHERS"}
# A reference has an outage after this number of its mean intervals: positions may come every ten seconds.
OUTAGE_INTERVALS = 5.0


class RecentCounts:
    """Growth of counters within the last `RECENT_S`."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, Counts]] = deque(maxlen=_PIECES)

    def grown(self, counts: Counts, now_s: float) -> dict[str, dict[str, int]]:
        """Return the counters' growth. now_s: monotonic time."""
        if not self._past or now_s - self._past[-1][0] >= RECENT_S / _PIECES:
            self._past.append((now_s, counts))
        before = self._past[0][1] if len(self._past) == _PIECES else {}
        return {
            group: {
                # a counter below its previous value was reset
                name: count - previous if (previous := before.get(group, {}).get(name, 0)) <= count else count
                for name, count in tally.items()
            }
            for group, tally in counts.items()
        }


class _LastChange(NamedTuple):
    """Number of samples taken of a stream, time of its last change (s) and of the first sample (s).

    dvl_ns: newest stamp of the DVL at the last change.
    """

    taken: int
    since_s: float
    first_s: float
    dvl_ns: int | None

    @property
    def outage_from_s(self) -> float:
        """Silence after which a reference has an outage, s. A single sample has no interval."""
        mean_s = (self.since_s - self.first_s) / (self.taken - 1) if self.taken > 1 else self.taken * RECENT_S
        return max(SILENCE_S, OUTAGE_INTERVALS * mean_s)


class Silence:
    """Detector of silent streams, and of streams whose clock differs from the DVL's.

    It is called periodically, so it costs nothing per message. now_s: monotonic time. topics: the node's topic names
    after remapping.
    """

    def __init__(self, now_s: float, topics: Mapping[str, str]) -> None:
        self._topics = topics
        self._started_s = now_s
        self._seen: dict[str, _LastChange] = {}

    def faults(self, calibrator: Calibrator, counts: Counts, now_s: float) -> dict[str, Reason]:
        """Return the fault of each faulty stream. counts: the calibrator's current ones."""
        newest_ns = calibrator.newest_ns
        for stream in newest_ns:
            unused_counters = _NOT_TAKEN | calibrator.refusal_counters[stream]
            n_used = counts[stream]["received"] - sum(counts[stream].get(key, 0) for key in unused_counters)
            before = self._seen.get(stream)
            if before is None or before.taken != n_used:
                first_s = before.first_s if before and before.taken else now_s
                self._seen[stream] = _LastChange(n_used, now_s, first_s, newest_ns["dvl"])
        silent_s = {stream: now_s - seen.since_s for stream, seen in self._seen.items()}
        faults = {}
        for stream, (code, own_topic) in _SILENT.items():
            topic = self._topics.get(own_topic, own_topic)
            if not counts[stream]["received"]:
                if stream == "dvl" and now_s - self._started_s > SILENCE_S:
                    faults[stream] = finding("DVL_NO_MESSAGE", topic=topic)
            elif silent_s[stream] > (self._seen[stream].outage_from_s if stream == "reference" else SILENCE_S):
                model = MODELS[calibrator.selected]
                if stream == "reference" and model.needs is not Needs.REFERENCE:
                    code = "GNSS_OUTAGE_WITHOUT"
                faults[stream] = finding(code, seconds=silent_s[stream], topic=topic, model=model.name)
        active = {stream for stream in newest_ns if silent_s[stream] <= SILENCE_S}
        return faults | self._clock_faults(newest_ns, active, calibrator.parameters)

    def _clock_faults(
        self, newest_ns: Mapping[str, int | None], active: set[str], parameters: Parameters
    ) -> dict[str, Reason]:
        """Return the streams that receive samples with stamps far from the DVL's of the same moment."""
        if "dvl" not in active:
            return {}
        ahead = {Stream.DVL: 0.0} | {
            Stream(stream): 1e-9 * (ns - dvl_ns)
            for stream in active
            if (ns := newest_ns[stream]) is not None and (dvl_ns := self._seen[stream].dvl_ns) is not None
        }
        # the newest sample of a live stream may be some time old
        faults = {}
        for offset in arrival_offset(ahead, parameters, SILENCE_S):
            names = {"stream": _NAMED[offset.stream], "side": offset.side, "other": _NAMED[offset.other]}
            faults[offset.stream.value] = finding("CLOCKS_DIFFER", seconds=abs(offset.ahead), **names)
        return faults


def diagnose(
    calibrator: Calibrator,
    dvl_type: VelocityType,
    problems: Sequence[Reason],
    silence: Silence,
    recent: RecentCounts,
    now_s: float,
    pauses_s: Sequence[float] = (),
    card: Card | None = None,
    water: Water | None = None,
) -> DiagnosticStatus:
    """Return the status of the running calibration, still without a name.

    dvl_type: type of the DVL's messages.
    problems: further problems.
    now_s: steady clock.
    pauses_s: recent pauses of this process.
    card: further values for the operator.
    water: water properties, if known.
    """
    estimate, counts, selection = calibrator.estimate(), calibrator.counts, calibrator.selection
    growth = recent.grown(counts, now_s)
    # messages sent during a pause are lost here, so they are no dropouts of the DVL
    growth["dvl"]["dropouts"] -= min(growth["dvl"]["dropouts"], len(pauses_s))
    found = [finding("PROCESS_PAUSED", seconds=sum(pauses_s))] if pauses_s else []
    found += [*silence.faults(calibrator, counts, now_s).values(), *problems]
    found += [finding("CLOCK_WENT_BACK")] if growth["calibration"]["restarts"] else []
    found += message_warnings(growth) + recording_warnings(growth) + dvl_type.advice(growth["dvl"])
    found += gate_warnings(estimate) + consistency_warnings(estimate)
    found += reference_warnings(estimate)
    if suggestion := calibrator.suggestion_so_far:
        found.append(finding("CONFIGURATION_WRONG", says=suggestion))
    doubts = calibrator.doubts_so_far
    rejected = bool(suggestion) or any(doubt.severity is Severity.REJECT for doubt in doubts)
    verdict = Severity.REJECT if rejected else calibrator.verdict_so_far
    # a reason to reject in a replay is an error here
    found += [each.weighed(Severity.ERROR if each.severity is Severity.REJECT else Severity.WARNING) for each in doubts]
    if verdict is Severity.ACCEPT:
        found = of_consequence(found, calibrator.parameters.target_drift)
    if any(problem.code == "REFERENCE_FRAME" for problem in problems):  # the receiver works: its messages are refused
        found = [doubt for doubt in found if not doubt.code.startswith("GNSS_OUTAGE")]
    found.sort(key=lambda each: (each.severity is not Severity.ERROR, each.code not in _CAUSES))
    has_error = found and found[0].severity is Severity.ERROR
    level = DiagnosticStatus.ERROR if has_error else DiagnosticStatus.WARN if found else DiagnosticStatus.OK
    status = DiagnosticStatus(level=level, hardware_id="dvl")
    status.message = printable("; ".join(map(str, found))) or f"{estimate.model} {estimate.convergence.value}"
    values = {
        "model": estimate.model,
        "why": selection.reason(calibrator.parameters).sentence,
        "gnss": selection.gnss.reason.sentence,
        "model of the paper": f"{selection.iac_model(calibrator.parameters)} (iac: {selection.gnss.reason.sentence})",
        "gnss available": str(int(selection.gnss.available)),
        "convergence": estimate.convergence.value,
        "verdict": verdict.value,
        "usable": "no" if verdict is Severity.REJECT else "yes",
        **_estimate_values(estimate),
        **_scale_and_delay_values(estimate, calibrator.parameters),
        **_count_values(calibrator, estimate, counts),
        "dvl longest dropout [s]": f"{1e-9 * calibrator.longest_dropout_ns:.1f}",
        **_cause_values(cause_of_scale(MODELS[estimate.model], estimate.of_recording, calibrator.parameters, water)),
        **({} if card is None else card.values(calibrator, estimate, counts, now_s, rejected)),
    }
    for number, reason in enumerate(found, start=1):
        values[f"finding {number}"] = str(reason)
    status.values = [KeyValue(key=key, value=printable(str(value))) for key, value in values.items()]
    return status


def _estimate_values(estimate: Estimate) -> dict[str, str]:
    """Return value, σ and progress of each parameter, and the consistency (NIS), as text."""
    values = {}
    model, std = MODELS[estimate.model], estimate.std
    by_filter = dict(zip(estimate.state_names, estimate.filter_std.tolist(), strict=True))
    units = {spec.name: spec.unit for spec in model.nuisance}
    for entry in estimate.observability:
        name = entry.name
        index = estimate.state_names.index(name)
        value = estimate.state[index]
        factor, unit = (math.degrees(1.0), "deg") if name.startswith("phi") else (100.0, "%")
        if name in units:
            factor, unit = 1.0, units[name]
        values[f"{name} [{unit}]"] = f"{factor * value:.4f}"
        values[f"std {name} [{unit}]"] = f"{factor * std[index]:.4f}"
        values[f"filter std {name} [{unit}]"] = f"{factor * by_filter[name]:.4f}"
        values[f"progress {name} [%]"] = f"{100.0 * entry.progress:.1f}"
        values[f"observed {name}"] = "yes" if entry.observed else f"no ({entry.axis}); needs {entry.missing}"
    for index, nuisance in enumerate(model.nuisance, start=model.n_errors):
        if nuisance.name in model.shown_by:
            continue
        values[f"{nuisance.name} [{nuisance.unit}]"] = f"{estimate.state[index]:.4f}"
        values[f"std {nuisance.name} [{nuisance.unit}]"] = f"{std[index]:.4f}"
    low, high = estimate.nis_bounds
    rows = model.n_measurement
    values["mean NIS"] = f"{estimate.mean_nis:.3f} of {rows} (99 %: {low:.3f} .. {high:.3f})"
    # as bare numbers for plotters; 1 if the noise is as assumed
    values["NIS ratio"] = f"{estimate.mean_nis / rows:.4f}"
    values["NIS ratio low"], values["NIS ratio high"] = f"{low / rows:.4f}", f"{high / rows:.4f}"
    return values


def _scale_and_delay_values(estimate: Estimate, parameters: Parameters) -> dict[str, str]:
    """Return scale and delay, which ~/mounting cannot hold, as text; σ under "sigma ...", as "std ..." is of states."""
    state = GaussianState(estimate.state, estimate.covariance)
    scale_delay = scale_and_delay(MODELS[estimate.model], state, parameters)
    values = {"scale error ahead [%]": 100.0 * scale_delay.scale, "dvl_time_offset [s]": scale_delay.time_offset}
    stds = (None if scale_delay.scale_std is None else 100.0 * scale_delay.scale_std, scale_delay.time_offset_std)
    words = {name: f"{value:.4f}" for name, value in values.items()}
    for name, std in zip(values, stds, strict=True):
        words[f"sigma {name}"] = "not estimated" if std is None else f"{std:.4f}"
    return words


def _cause_values(cause: CauseOfScale | None) -> dict[str, str]:
    """Return the cause of the scale error and the speed of sound to set, as text."""
    if cause is None:
        return {}
    setting = "-" if math.isnan(cause.setting) else f"{cause.setting:.1f}"
    return {"cause of the scale": cause.sentence, "speed of sound": cause.brief, "speed of sound to set [m/s]": setting}


def _count_values(calibrator: Calibrator, estimate: Estimate, counts: Counts) -> dict[str, str]:
    """Return the counts of samples by use, and of messages by stream and reason, as text."""
    values, model = {"samples used": str(estimate.used), "samples gated": str(estimate.gated)}, MODELS[estimate.model]
    if not model.from_positions:  # these models use positions instead of DVL samples
        by_use = counts_by_use(counts, model.needs, calibrator.n_given(model.name), estimate.used, estimate.gated)
        values |= {f"samples {name}": str(count) for name, count in by_use.items()}
    return values | {f"{stream} {name}": str(n) for stream, tally in counts.items() for name, n in tally.items()}
