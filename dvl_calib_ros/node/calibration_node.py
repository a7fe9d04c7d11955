"""The node ``dvl_calibration``: topics, parameters, services and diagnostics around a `Calibrator`."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from ..calibration.calibrator import Calibrator
from ..calibration.checks.speed_of_sound import Water
from ..calibration.models import MODELS, Model
from ..calibration.models.parameters import SCHEMA, ParameterError, Parameters
from ..calibration.numerics import kalman
from ..calibration.numerics.kalman import GaussianState
from ..calibration.numerics.samples import DvlSample, VelocityFrame
from ..calibration.results.results import Correction, lever_arm, mounting_pose
from ..calibration.streams.position_velocities import check_model
from ..discovery.gravity import believed_heading
from ..discovery.transforms import Frames, placement
from ..disk.atomic import check_writable
from ..errors import InputError
from ..files.output_paths import check_outputs
from ..files.parameter_files import NODE_NAME, changed_parameters
from ..files.result_file import (
    KeptError,
    check_in_folder,
    load_initial_calibration,
    result_document,
    result_text,
    save_result,
    save_unless_worse,
)
from ..messages.decode import RESTAMP_ALL, frame_name, heading_variance
from ..messages.live_feed import MessageFeed
from ..recordings.topics import Topics
from ..standard_streams import say
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding
from .diagnostics import (
    RECENT_S,
    GravitySeen,
    LateClocks,
    Pauses,
    RecentCounts,
    Silence,
    diagnose,
    input_problems,
    output_problems,
    steady_s,
    twin_problems,
)
from .live_discovery import Discovering
from .message_queue import QUEUE, Arrived, in_order_of_arrival, take
from .message_types import empty_twist, fill_errors, set_stamp, velocity_class
from .operator_card import Card
from .services import LATCHED, AnsweringNode, declare_parameters
from .status import status_name
from .transforms import MountingOutput, Transforms, WaterHeard

# The selected model is updated with every sample, because its estimate is published. The others are updated in blocks
# of this number of samples, or when their estimate is requested.
BLOCK_SIZE = 512


class CalibrationNode(AnsweringNode):
    """The calibration node; docs/operate.md lists its topics, services and parameters.

    Raises ParameterError or InputError for a configuration that cannot run. parameter_files: files of the node's start.
    """

    def __init__(self, parameter_files: Sequence[Path] = (), **node_options: Any) -> None:
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True, **node_options)
        named = set(self.get_parameters_by_prefix(""))
        parameters = declare_parameters(self, parameter_files)
        self._parameter_files = parameter_files
        classes = _message_classes(parameters)
        self._result_folder = Path(parameters.result_file).absolute().parent if parameters.result_file else Path.cwd()
        self._check_result_file(parameters.result_file)
        initial = None
        if parameters.initial_calibration:
            initial = load_initial_calibration(Path(parameters.initial_calibration), parameters.mounting_rpy)
        if parameters.prior_source == "initial_window":
            self.warn(str(finding("PRIOR_HOLDS_ERROR")))
        kalman.prepare()
        self._worker = ThreadPoolExecutor(1, "g2")
        self._initial = initial
        self._start(parameters, initial)
        # a saved calibration belongs to the mounting that it was saved with
        self._transforms = Transforms(self) if parameters.use_transforms and initial is None else None
        self._transforms_tried: tuple[int, tuple[str, str, str]] = (0, ("", "", ""))
        self._given = frozenset(changed_parameters(parameters))
        self._awaits_heading_std = "heading_deviation_std" not in self._given
        self._late_clocks, self._gravity = LateClocks(named), GravitySeen()
        # used for every DVL message, and constant at run time
        self._unaided_noise = np.eye(3) * parameters.gnss_free_std**2
        self._correction: Correction | None = None
        self._corrected_by = ""
        self._published = self._mounting_published = self._iac_published = ("", 0)
        self._pauses = Pauses(steady_s())
        self._save_problem: Reason | None = None
        self._logged: set[str] = set()  # codes of findings

        self._estimate, self._corrected = empty_twist(), empty_twist()
        self._corrected.header.frame_id = self._calibrator.parameters.base_frame
        self._estimate_publisher = self._publisher(TwistWithCovarianceStamped, "~/estimate", LATCHED)
        self._iac_publisher = self._publisher(TwistWithCovarianceStamped, "~/iac/estimate", LATCHED)
        self._mounting_publisher = self._publisher(PoseWithCovarianceStamped, "~/mounting", LATCHED)
        self._mounting = MountingOutput(self, self._mounting_publisher, parameters.publish_tf, self.warn)
        self._corrected_publisher = self._publisher(TwistWithCovarianceStamped, "~/calibrated_twist", 100)
        self._diagnostics_publisher = self._publisher(DiagnosticArray, "/diagnostics", 10)
        self._inputs: dict[str, Any] = {}
        self._adapted = self._feed.decoder.adapted
        self._feed_from: Mapping[str, Callable[[Any, int], Any]] = {
            "dvl/twist": self._feed_dvl,
            "gnss/twist": lambda message, received_ns: self._feed.reference(message, received_ns),
            "imu/data": self._feed_imu,
        }
        # the node's own name of an input -> the discovered topic
        self._found_names: dict[str, str] = {}
        self._found: list[Reason] = []
        for own, message_type in classes.items():
            self._subscribe(message_type, own)
        topics = {own: subscription.topic_name for own, subscription in self._inputs.items()}
        used = topics | {"~/calibrated_twist": self._corrected_publisher.topic_name}
        for first, second in combinations(used, 2):  # a DVL agrees with itself at any mounting
            if used[first] == used[second]:
                raise InputError(f"{first} and {second} are both {used[first]}; remap each to its own sensor's topic")
        now_s = self._pauses.running_s(steady_s())
        self._silence, self._recent, self._card = Silence(now_s, topics), RecentCounts(), Card(now_s)
        space = self.get_namespace().rstrip("/")
        self._remapped = {own for own, topic in topics.items() if topic != f"{space}/{own}"}
        given = self._given if initial is None else {*self._given, "mounting_rpy"}
        self._discovering = Discovering(self, parameters, given, self._worker) if parameters.discover else None
        self._water_heard = WaterHeard(self, parameters.discover)
        self._water: Water | None = None
        self._newest_dvl: Any = None
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/save", self._on_save)
        self.create_service(Trigger, "~/save_anyway", partial(self._on_save, save=save_result))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        # steady: diagnostics continue while simulated time stands still or jumps
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))
        in_use = changed_parameters(self._calibrator.parameters).items()
        changed = ", ".join(f"{name}: {value}" for name, value in in_use)
        self.info(f"model {parameters.model}; parameters not at their default: {changed or 'none'}")

    def _named_topics(self, *, has_dvl: bool) -> dict[str, str | None]:
        """Return the topics that a search must keep, by role: remapped ones and, next to a DVL, published ones."""
        topics = {role: (own, self._inputs[own].topic_name) for role, own in vars(Topics()).items()}
        return {
            role: topic if own in self._remapped or (has_dvl and self.count_publishers(topic)) else None
            for role, (own, topic) in topics.items()
        }

    def _discover(self) -> None:
        """Search while the DVL has no publisher or the reference's frame is unknown, and start with what was found."""
        searching, decoder, dvl = self._discovering, self._feed.decoder, self._inputs["dvl/twist"].topic_name
        if searching is None:
            return
        has_dvl = bool(
            "dvl/twist" in self._remapped or self.count_publishers(dvl) or self._calibrator.counts["dvl"]["received"]
        )
        if has_dvl and (decoder.frame_of_reference is not None or "reference frame" not in decoder.problems):
            searching.close()
            return
        try:
            discovery = searching.step(self._named_topics(has_dvl=has_dvl))
        except InputError as error:
            self.warn(f"{error}; topics are not searched")
            searching.close()
            self._discovering = None
            return
        if discovery is None:
            return
        self._discovering = None
        parameters = discovery.parameters
        self._found = [] if has_dvl else [finding("TOPICS_FOUND", own=dvl, found=discovery.found[0])]
        for sentence in discovery.found[1:]:
            self.info(sentence)
        for topics_found in self._found:
            self.warn(str(topics_found))
        for doubt in discovery.doubts:
            self.warn(doubt)
        present, classes = dict(self.get_topic_names_and_types()), _message_classes(parameters)
        names = zip(classes, vars(discovery.topics).values(), strict=True)
        self._found_names = {name_used: name for name_used, name in names if name in present}
        for name_used in self._found_names:
            old = self._inputs[name_used]
            self._subscribe(classes[name_used], name_used)
            self.destroy_subscription(old)
        self._start(parameters, self._initial)
        self._adapted = self._feed.decoder.adapted
        self._awaits_heading_std = self._awaits_heading_std and "heading_deviation_std" not in discovery.values
        now_s = self._pauses.running_s(steady_s())
        subscribed = {name_used: subscription.topic_name for name_used, subscription in self._inputs.items()}
        self._silence, self._recent, self._card = Silence(now_s, subscribed), RecentCounts(), Card(now_s)
        self._correction, self._mounting_published = None, ("", 0)

    def _start(
        self, parameters: Parameters, initial: Mapping[str, GaussianState] | None, feed: MessageFeed | None = None
    ) -> None:
        """Start a calibration with these parameters. feed: its earlier messages are fed again."""
        self._calibrator = Calibrator(
            parameters, initial=initial, block_size=BLOCK_SIZE, on_event=self.warn, worker=self._worker
        )
        self._feed = feed or MessageFeed(self._calibrator, self.warn)
        self._feed.begin_again(self._calibrator)
        self._lever_arm: Sequence[float] | None = parameters.lever_arm if any(parameters.lever_arm) else None

    def _update_mounting(self, message: Any) -> None:
        """Restart the calibration if new transforms change the mounting, lever arm or orientation of the IMU.

        message: the DVL message that is fed next.
        """
        if self._transforms is None or not self._transforms.n_messages:
            return
        decoder = self._feed.decoder
        _, reference, imu = decoder.frame_ids
        dvl = decoder.dvl_frame or frame_name(decoder.dvl_type.frame_id(message))
        placement_key = (self._transforms.n_messages, (dvl, reference, imu))
        if placement_key == self._transforms_tried:
            return
        self._transforms_tried = placement_key
        in_body = decoder.frame_of_reference is VelocityFrame.BODY
        frames = Frames(dvl, reference, imu, decoder.dvl_type.points_down, in_body)
        parameters = self._calibrator.parameters
        found = placement(self._transforms.tree(), frames, parameters, self._given)
        if found is None or parameters.replace(**found.values) == parameters:
            return
        positions = {name: at for name, at in found.values.items() if name in ("dvl_position", "reference_position")}
        if parameters.replace(**found.values) == parameters.replace(**positions):  # these change no estimate
            self._calibrator.set_parameters(parameters.replace(**positions))
            return
        self.info(f"{found.said}; the calibration starts with it (set use_transforms to false to ignore it)")
        self._restart(parameters.replace(**found.values))

    def _restart(self, parameters: Parameters, feed: MessageFeed | None = None) -> None:
        """Restart as `_start`, without the previous initial calibration and published values."""
        self._start(parameters, None, feed)
        self._corrected.header.frame_id = self._calibrator.parameters.base_frame
        self._recent, self._correction = RecentCounts(), None
        self._mounting_published = self._iac_published = ("", 0)

    def _publisher(self, message_type: type, topic: str, qos: QoSProfile | int) -> Any:
        # every event callback is one more entity that the executor checks for every message
        events = PublisherEventCallbacks(use_default_callbacks=False)
        return self.create_publisher(message_type, topic, qos, event_callbacks=events)

    # ------------------------------------------------------------------ input

    def _subscribe(
        self, message_type: type, topic: str, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE
    ) -> None:
        """Subscribe reliably, and change to best effort if a best-effort publisher appears."""

        def resubscribe() -> None:
            self.info(f"{topic}: a publisher is best effort; subscribing as best effort")
            old = self._inputs[topic]
            self.deliver()  # messages waiting in the old subscription would be lost
            self._subscribe(message_type, topic, ReliabilityPolicy.BEST_EFFORT)
            self.destroy_subscription(old)

        name, on_message = self._found_names.get(topic, topic), partial(self._on_message, topic)
        self._inputs[topic] = self.subscribe(message_type, name, on_message, QUEUE, resubscribe, reliability)

    def _on_message(self, topic: str, message: Any, info: Mapping[str, int]) -> None:
        self._deliver({topic: Arrived.of(message, info)})

    @property
    def inputs(self) -> Sequence[Subscription]:
        """Subscriptions to the sensors' messages."""
        return list(self._inputs.values())

    def deliver(self, ready: Collection[Subscription] | None = None) -> None:
        """Feed all waiting messages. ready: the only subscriptions with waiting messages, if known."""
        inputs = self._inputs.items()
        self._deliver({}, None if ready is None else [topic for topic, subscription in inputs if subscription in ready])

    def _deliver(self, taken: Mapping[str, Arrived], ready: Collection[str] | None = None) -> None:
        """Feed the messages taken, by topic, and all waiting ones."""
        for topic, message in in_order_of_arrival(self._inputs, take, taken, ready=ready):
            if (adapted := self._adapted.get(topic)) is not None:
                message = adapted(message)
            self._feed_from[topic](message, self._received_ns(message))
            self._publish_if_updated()

    def _received_ns(self, message: Any) -> int:
        """Return the time of reception if the message's stamp is not used, else 0, without a clock call."""
        stamp = message.header.stamp
        believed = self._calibrator.parameters.restamp != RESTAMP_ALL
        return 0 if believed and (stamp.sec or stamp.nanosec) else self.get_clock().now().nanoseconds

    def _feed_dvl(self, message: Any, received_ns: int) -> None:
        """Feed a DVL message, and publish its corrected velocity."""
        self._update_mounting(message)
        self._subtract_clock_offsets()
        self._newest_dvl = message
        sample = self._feed.dvl(message, received_ns)
        if sample is not None:
            self._publish_corrected(sample)

    def _feed_imu(self, message: Any, received_ns: int) -> None:
        """Feed an IMU message, also to the check of gravity."""
        if self._awaits_heading_std:
            self._use_claimed_heading_std(message)
        self._gravity.add(message)
        self._feed.imu(message, received_ns)

    def _use_claimed_heading_std(self, message: Any) -> None:
        """Restart with the heading accuracy in the first IMU message that states one, as a replay does."""
        reported = math.sqrt(heading_variance(message.orientation_covariance))
        if math.isnan(reported):
            return
        self._awaits_heading_std = False
        std = believed_heading(reported)
        if std is not None:
            self._start(self._calibrator.parameters.replace(heading_deviation_std=std), self._initial, self._feed)

    # ------------------------------------------------------------------ output

    def _publish_if_updated(self) -> None:
        name = self._calibrator.selected
        if self._published != (name, self._calibrator.n_given(name)):
            self._publish_estimate()

    def _publish_estimate(self) -> None:
        """Publish the errors estimated by the selected model, and use them for the following samples."""
        calibrator = self._calibrator
        model = MODELS[calibrator.selected]
        self._published = (model.name, calibrator.n_given(model.name))
        state = calibrator.published(model.name)
        self._set_correction(model, state)
        fill_errors(self._estimate, model, state, calibrator.last_ns, self._feed.decoder.dvl_frame)
        self._estimate_publisher.publish(self._estimate)

    def _publish_iac(self) -> None:
        """Publish the model that the paper's criterion (IAC) selects, with its filter covariance."""
        calibrator = self._calibrator
        name = calibrator.selection.iac_model(calibrator.parameters)
        state_of = (name, calibrator.n_given(name))
        if state_of != self._iac_published and calibrator.last_ns is not None:
            self._iac_published = state_of
            message, state = empty_twist(), calibrator.state(name)
            fill_errors(message, MODELS[name], state, calibrator.last_ns, self._feed.decoder.dvl_frame)
            self._iac_publisher.publish(message)

    def _set_correction(self, model: Model, state: GaussianState) -> Correction:
        """Set and return the correction for the following samples."""
        parameters = self._calibrator.parameters
        self._correction = Correction(model, state, parameters.rotation_dvl_from_body)
        self._corrected_by = model.name
        arm = lever_arm(model, state, parameters.lever_arm)
        self._lever_arm = arm if any(arm) else None
        return self._correction

    def _publish_corrected(self, sample: DvlSample) -> None:
        """Publish the velocity corrected by the selected model, at the reference point if the lever arm is known."""
        calibrator = self._calibrator
        name = calibrator.selected
        correction = self._correction
        if correction is None or self._corrected_by != name:
            correction = self._set_correction(MODELS[name], calibrator.published(name))
        noise = self._unaided_noise if sample.covariance is None else sample.covariance
        velocity, covariance = correction.apply(np.array(sample.velocity), noise)
        if self._lever_arm is not None:
            rate = calibrator.latest_angular_velocity(sample.stamp_ns)
            if rate is not None:
                velocity = velocity - np.cross(rate, self._lever_arm)
        message = self._corrected
        set_stamp(message.header.stamp, sample.stamp_ns)
        linear = message.twist.twist.linear
        linear.x, linear.y, linear.z = velocity.tolist()
        message.twist.covariance.reshape(6, 6)[:3, :3] = covariance
        self._corrected_publisher.publish(message)

    def _publish_mounting(self, *, again: bool = False) -> None:
        """Publish the mounting, at most once a second; ~/estimate has every sample. again: also if it is as before."""
        calibrator = self._calibrator
        model = MODELS[calibrator.selected]
        state_of = (model.name, calibrator.n_given(model.name))
        if calibrator.last_ns is None or (state_of == self._mounting_published and not again):
            return
        # A subscriber would use the mounting of a wrong configuration. Waiting messages are not examined, so check
        # every time.
        if calibrator.suggestion_so_far or any(doubt.severity is Severity.REJECT for doubt in calibrator.doubts_so_far):
            return
        self._mounting_published = state_of
        stamp = Time()
        set_stamp(stamp, calibrator.last_ns)
        parameters, decoder = calibrator.parameters, self._feed.decoder
        pose = mounting_pose(model, calibrator.next_recording(model.name), parameters, decoder.turns_dvl)
        self._mounting.publish(pose, stamp, parameters.base_frame, decoder.dvl_frame or "dvl_link", self._transforms)

    def _subtract_clock_offsets(self) -> None:
        """Restart with the discovered clock offsets subtracted, once two estimates agree."""
        calibrator = self._calibrator
        parameters = self._late_clocks.parameters(calibrator.registration_so_far, calibrator.parameters)
        if parameters is not None:
            self.warn(" ".join(map(str, self._late_clocks.found)))
            self._restart(parameters, self._feed)
        if self._late_clocks.is_final and not self._awaits_heading_std:
            self._feed.kept.forget()

    def _publish_diagnostics(self) -> None:
        """Publish estimate, problems and progress; also rediscovers topics and publishes the mounting."""
        self._discover()
        self._publish_mounting()
        self._publish_iac()
        decoder = self._feed.decoder
        problems = [*self._found, *decoder.problems.values(), *self._topic_problems(), *self._late_clocks.found]
        problems += self._gravity.problems(self._inputs["imu/data"].topic_name, self._calibrator.parameters)
        problems += self._mounting.problems(decoder.dvl_frame or "dvl_link", self._transforms)
        subscribed = [subscription.topic_name for subscription in self._inputs.values()]
        dvl = (self._inputs["dvl/twist"].topic_name, decoder.dvl_type.name, self._newest_dvl)
        self._water, self._newest_dvl = self._water_heard.update(subscribed, dvl), None
        problems += [self._save_problem] if self._save_problem else []
        now_s = self._pauses.running_s(steady_s())
        status = diagnose(
            self._calibrator, decoder.dvl_type, problems, self._silence, self._recent, now_s,
            self._pauses.within(RECENT_S), self._card, self._water,
        )  # fmt: skip
        status.name = status_name(self.get_fully_qualified_name())
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(message)
        for each in status.values:
            if each.key.startswith("finding ") and (code := each.value.rpartition("[")[2]) not in self._logged:
                self._logged.add(code)
                self.warn(each.value)

    def _topic_problems(self) -> list[Reason]:
        """Return the problems with publishers and subscribers of all topics."""
        type_parameters = {"dvl/twist": "dvl_type", "gnss/twist": "gnss_type"}
        problems: list[Reason] = []
        for topic, subscription in self._inputs.items():
            problems += input_problems(self, subscription, type_parameters.get(topic))
        for publisher in (self._estimate_publisher, self._corrected_publisher, self._mounting_publisher):
            problems += output_problems(self, publisher)
        return problems + twin_problems(self, self._estimate_publisher)

    # ------------------------------------------------------------------ services, parameters

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget all samples and restart from the parameters' prior."""
        self._calibrator.reset()
        self._feed.forget()
        self._gravity = GravitySeen()
        self._pauses.forget()
        self._recent, self._card = RecentCounts(), Card(self._pauses.running_s(steady_s()))
        self._correction, self._mounting_published = None, ("", 0)
        self._publish_estimate()
        response.success, response.message = True, "all samples forgotten"
        return response

    def _on_save(
        self, request: Trigger.Request, response: Trigger.Response, save: Callable[..., None] = save_unless_worse
    ) -> Trigger.Response:
        """Save the result when the service is called, unless the saved one is better."""
        path = self._calibrator.parameters.result_file
        if not path:
            response.message = "parameter result_file is not set: dvl-calib param set result_file FILE"
            return response
        try:
            self._save(Path(path), save)
        except InputError as error:
            response.message = str(error)
            if not isinstance(error, KeptError):
                self.error(response.message)
        else:
            response.success, response.message = True, f"saved to {path}"
        return response

    def _save(self, path: Path, save: Callable[..., None] = save_unless_worse) -> None:
        """Save the result and publish the mounting. Raises InputError, after noting it for /diagnostics."""
        self._save_problem = None
        try:
            with self._calibrator.settled():  # what is published is what is saved
                save(path, self._result_document(), round(self._calibrator.parameters.result_backups))
                self._publish_mounting(again=True)
        except InputError as error:
            if not isinstance(error, KeptError):
                self._save_problem = finding("RESULT_NOT_SAVED", reason=error)
            raise

    def _result_document(self) -> dict[str, Any]:
        decoder = self._feed.decoder
        frame = decoder.dvl_frame or "dvl_link"
        return result_document(self._calibrator.result(), frame, decoder.turns_dvl, self._water)

    def _check_result_file(self, name: str) -> None:
        if name:
            check_writable(Path(name))
            check_outputs({"result_file": Path(name)}, self._parameter_files)

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse changed parameters that are invalid, or a result file that cannot be written."""
        try:
            changed = self._changed_parameters(parameters)
            check_model(changed)
            if changed.result_file != self._calibrator.parameters.result_file and changed.result_file:
                check_in_folder(Path(changed.result_file), self._result_folder)
                self._check_result_file(changed.result_file)
        except (ParameterError, InputError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Use changed parameters, and publish the estimate if they select another model."""
        before = self._calibrator.selected
        self._calibrator.set_parameters(self._changed_parameters(parameters))
        self._feed.decoder.parameters = self._calibrator.parameters
        if self._calibrator.selected != before:
            self.info(f"running {self._calibrator.selected} instead of {before}")
            self._publish_estimate()

    def _changed_parameters(self, parameters: list[Parameter]) -> Parameters:
        return self._calibrator.parameters.replace(
            **{parameter.name: parameter.value for parameter in parameters if parameter.name in SCHEMA}
        )

    # ------------------------------------------------------------------ end

    def finish(self) -> bool:
        """Save the result if a file is configured; print it if that fails, so that it is not lost.

        Returns whether the file has the complete result.
        """
        path = self._calibrator.parameters.result_file
        if not path:
            return True
        try:
            self._save(Path(path))
            say(f"calibration_node: saved to {path}")
        except KeptError as error:
            say(f"calibration_node: {error}")
        except InputError as error:
            result = result_text(self._result_document())
            for line in (f"calibration_node: {error}. The result follows.", *result.splitlines()):
                say(line)
            return False
        return True

    def destroy_node(self) -> None:
        """Leave ROS, and stop the thread that solves the full model's blocks."""
        if self._discovering is not None:
            self._discovering.close()
        self._worker.shutdown(cancel_futures=True)
        super().destroy_node()


def _message_classes(parameters: Parameters) -> dict[str, type]:
    """Return the message class of each input, by the node's own name of its topic. Raises InputError."""
    return {
        Topics.dvl: velocity_class("dvl_type", parameters.dvl_type, parameters.dvl_fields),
        Topics.gnss: velocity_class("gnss_type", parameters.gnss_type),
        Topics.imu: Imu,
    }
