"""Faults of sensors, clocks, drivers, disks and neighbours, injected into the live node over real DDS.

After each the estimates are those of a replay of the same messages (1e-12) and, where the fault can be kept out, those
of the run without it; the counters add up; /diagnostics names the fault and a remedy.
"""

from __future__ import annotations

import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped
from live_fixtures import LATCHED, Live, Offline, Sent, assert_agree, assert_counts_add_up, received, sent
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros import NODE, World, until
from std_srvs.srv import Trigger

from dvl_calib_ros.calibration.models import BY_VELOCITY
from dvl_calib_ros.calibration.models.parameters import SCHEMA, Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.files.result_file import load_initial_calibration
from dvl_calib_ros.node.diagnostics import PAUSE_S
from dvl_calib_ros.simulation.scenario import START_NS, Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors, equivalent_error_terms

pytestmark = pytest.mark.faults

SECOND = 1_000_000_000
HOUR_S = 3600.0
TRIES = 3  # of a machine that is busy for seconds now and then
END_OF_TIME_NS = (2**31 - 2) * SECOND
NAN, INF = math.nan, math.inf
# Sent as fast as possible: on a machine that stalls, one topic may lag another by all of a run; max_latency is longer,
# and `full` waits for it, so a filter's result is saved.
ERRORS = DvlErrors((0.02, -0.03, 0.05), (0.005,) * 3, beam_std=0.005)
RUN = Scenario(
    trajectory="figure8", seconds=40, dvl_rate=5, gnss_rate=5, imu_rate=5, gnss_std=0.02, errors=ERRORS
)  # fmt: skip
GIVEN = {"max_latency": 60.0, "model": "iac"}
PARAMETERS = Parameters(**GIVEN)


def simulated() -> list[Any]:
    run = simulate(RUN)
    return sorted([*run.imu, *run.gnss, *run.dvl], key=lambda sample: sample.stamp_ns)


CLEAN = simulated()


@pytest.fixture(scope="module")
def shared_node(tmp_path_factory):
    """One node for all the tests that reset it first: starting one takes longer than they do."""
    saved = tmp_path_factory.mktemp("faults") / "result.yaml"
    world = World()
    with world.calibration_node(*(f"{k}:={v}" for k, v in GIVEN.items()), f"result_file:={saved}") as process:
        yield Live(world, process, saved)
    assert process.returncode == 0 and "Traceback" not in process.output, process.output
    world.close()


@pytest.fixture
def node(shared_node):
    shared_node.reset()
    return shared_node


# ---------------------------------------------------------------- what can be done to a run


def seconds(sample: Any) -> float:
    return 1e-9 * (sample.stamp_ns - START_NS)


def between(from_s: float, to_s: float, run: Sequence[Any] = CLEAN) -> list[Any]:
    return [sample for sample in run if from_s <= seconds(sample) < to_s]


def only(kind: type, run: Sequence[Any] = CLEAN) -> list[Any]:
    return [sample for sample in run if isinstance(sample, kind)]


def without(kind: type, from_s: float, to_s: float, run: Sequence[Any] = CLEAN) -> list[Any]:
    return [sample for sample in run if not (isinstance(sample, kind) and from_s <= seconds(sample) < to_s)]


def later(run: Sequence[Any], by_s: float) -> list[Any]:
    return [sample._replace(stamp_ns=sample.stamp_ns + round(by_s * SECOND)) for sample in run]


def with_extra(every: int, make: Callable[[Any, int], Sequence[Any]]) -> list[Any]:
    """The clean run, and what `make` makes of every so many-th sample of each kind, and its number, after it."""
    run, counts = [], Counter[type]()
    for sample in CLEAN:
        run.append(sample)
        kind = type(sample)
        counts[kind] += 1
        if counts[kind] % every == 0:
            run += make(sample, counts[kind] // every)
    return run


SPOILT_TWISTS = [
    {"velocity": (NAN, 0.0, 0.0)}, {"velocity": (1.0, INF, 0.0)}, {"velocity": (1.0, 0.0, -INF)},
    {"velocity": (1e308, 1e308, 1e308)}, {"velocity": (1.0, 11.0, 0.0)},
    {"covariance": np.full((3, 3), NAN)}, {"covariance": np.diag([1e-4, -0.5, 1e-4])},  # -1: not measured
    {"covariance": np.diag([INF, 1.0, 1.0])}, {"covariance": np.ones((3, 3))},
]  # fmt: skip
SPOILT_QUATERNIONS = [(NAN, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0), (INF, 0.0, 0.0, 0.0), (5e-324, 0.0, 0.0, 0.0)]


def invalid(sample: Any, number: int) -> list[Any]:
    spoilt: dict[str, Any] = SPOILT_TWISTS[number % len(SPOILT_TWISTS)]
    if isinstance(sample, ImuSample):
        orientation = SPOILT_QUATERNIONS[number % len(SPOILT_QUATERNIONS)]
        spoilt = {"orientation": orientation, "angular_velocity": (NAN, 0.0, INF)}
    return [sample._replace(stamp_ns=sample.stamp_ns + 1, **spoilt)]


def denormal() -> list[Any]:
    """Variances that no sensor can claim."""
    return [s if isinstance(s, ImuSample) else s._replace(covariance=np.eye(3) * 5e-324) for s in CLEAN]


def not_given() -> list[Any]:
    return [s if isinstance(s, ImuSample) else s._replace(covariance=None) for s in CLEAN]


def stray(sample: Any, number: int) -> list[Any]:
    """From 1970, from an hour ago, from in an hour, from the end of time."""
    hour = round(HOUR_S * SECOND)
    stamps = [1, sample.stamp_ns - hour, sample.stamp_ns + hour, END_OF_TIME_NS]
    return [sample._replace(stamp_ns=stamps[number % len(stamps)])]


def frozen(from_s: float, to_s: float) -> list[Any]:
    """A DVL whose driver repeats its last velocity with new stamps."""
    last = next(s for s in reversed(between(0, from_s)) if isinstance(s, DvlSample))
    is_frozen = lambda s: isinstance(s, DvlSample) and from_s <= seconds(s) < to_s  # noqa: E731
    return [s._replace(velocity=last.velocity) if is_frozen(s) else s for s in CLEAN]


def other_instrument(sample: Any, number: int) -> list[Any]:
    """Another driver on the same topics, which says so by its frame."""
    if isinstance(sample, ImuSample):
        return []
    frame = "base_link" if isinstance(sample, DvlSample) else "gps_antenna"
    return [sent(sample._replace(stamp_ns=sample.stamp_ns + 1, velocity=(0.5, -1.0, 0.2)), frame)]


def again(sample: Any, number: int) -> list[Any]:
    return [sample]


# ---------------------------------------------------------------- messages and clocks


ONLY_DVL = only(DvlSample)
AFTER_5_S = between(5, 40)


@dataclass(frozen=True)
class Fault:
    """A faulty run, what /diagnostics says of it (None: it is no fault), and counters (stream, counter).

    parts: of samples or messages; each is sent when the node has dealt with the one before. without: the run without
    the fault, where it must leave no trace in the estimates. Else the truth, a misalignment of degrees, must be found.
    """

    named: str | None
    parts: Sequence[Sequence[Any]]
    without: Sequence[Any] | None = None
    counted: dict[tuple[str, str], int] = field(default_factory=dict)


FAULTS = {
    "the DVL drops out for 1 s": Fault(
        "DVL dropped out 1 times", [without(DvlSample, 20, 21)], counted={("dvl", "dropouts"): 1}
    ),
    "the DVL drops out for 20 s": Fault(
        "DVL dropped out 1 times", [between(0, 10), without(DvlSample, 0, 30, between(10, 30)), between(30, 40)],
        counted={("dvl", "dropouts"): 1},
    ),
    "everything drops out for 10 min": Fault(
        "DVL dropped out 1 times", [between(0, 20), later(between(20, 40), 600)],
        counted={("dvl", "dropouts"): 1, ("dvl", "accepted"): 200},
    ),
    "GNSS flaps": Fault(
        "GNSS was lost 3 times", [[s for s in CLEAN if not (isinstance(s, ReferenceSample) and seconds(s) % 10 >= 5)]]
    ),
    "invalid values": Fault(
        "DVL samples are invalid", [with_extra(20, invalid)], CLEAN,
        counted={("dvl", "invalid"): 10, ("reference", "invalid"): 10, ("imu", "invalid"): 10},
    ),
    "denormal variances": Fault(None, [denormal()], not_given()),
    "every message comes again": Fault(
        "[STAMP_REPEATED]", [with_extra(1, again)], CLEAN, counted={("dvl", "duplicate"): 200}
    ),
    "the DVL repeats itself for 10 s": Fault(
        "set max_repeats", [frozen(20, 30)], counted={("dvl", "repeated"): 50, ("dvl", "frozen"): 0}
    ),
    "single stamps from anywhere in time": Fault(
        "check the clock of the driver", [with_extra(39, stray)], CLEAN,
        counted={("dvl", "stray"): 5, ("reference", "stray"): 5, ("imu", "stray"): 5},
    ),
    "all clocks are set forward by years": Fault(
        "DVL dropped out", [later(between(0, 5), -1.7e9), between(5, 40)], counted={("dvl", "accepted"): 200}
    ),
    # that of the DVL first, whose first two samples show it
    "all clocks are set back by an hour": Fault(
        "[CLOCK_WENT_BACK]",
        [later(between(0, 5), HOUR_S), ONLY_DVL[25:27], [s for s in AFTER_5_S if s not in ONLY_DVL[:27]]],
        AFTER_5_S, counted={("calibration", "restarts"): 1, ("dvl", "accepted"): 175},
    ),
    "all clocks are set back by 3 s": Fault(
        "[STAMP_OUT_OF_ORDER]", [later(between(0, 20), 3), between(20, 40)],
        counted={("dvl", "out_of_order"): 14, ("dvl", "duplicate"): 1},
    ),
    "the clock of GNSS is an hour ahead": Fault(
        "GNSS stamps are 3600 s ahead",
        [[later([s], HOUR_S)[0] if isinstance(s, ReferenceSample) else s for s in CLEAN]],
        without(ReferenceSample, 0, 40), counted={("pairing", "paired"): 0},
    ),
    "the IMU stops": Fault(
        # what comes much later tells that no IMU can be waited for any more
        "[REFERENCE_NO_ATTITUDE]", [without(ImuSample, 15, 40), later(without(ImuSample, 0, 40, between(39, 40)), 100)]
    ),
    "another instrument on the same topics": Fault("'base_link'", [with_extra(10, other_instrument)], CLEAN),
}  # fmt: skip


def as_messages(part: Sequence[Any]) -> list[Sent]:
    return [each if isinstance(each, Sent) else sent(each) for each in part]


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_survived_counted_and_named(name, node):
    fault = FAULTS[name]
    for _ in range(TRIES):
        since = len(node.diagnostics)
        assert_survived(fault, node)
        if fault.named is None:
            return
        # it may have been said while data still came; of a sensor nothing is said where the machine was too busy to run
        # the node for seconds
        said = (fault.named, "PROCESS_PAUSED")
        until(lambda since=since, said=said: any(node.has_said(words, since) for words in said), f"one of {said}")
        if node.has_said(fault.named, since):
            return
        node.reset()
    pytest.fail(f"this machine is too busy: the node was never told of {name} without a pause")


def assert_survived(fault: Fault, node: Live) -> None:
    """Estimates and counts are those of a replay, and what they are to be."""
    replay = Offline(PARAMETERS)
    for part in map(as_messages, fault.parts):
        node.publish(part)
        saved = node.when_like(replay.feed(part))
    assert_agree(saved, replay.calibrator.result())
    assert_counts_add_up(saved["counts"], saved["models"])
    for (stream, counter), expected in fault.counted.items():
        assert saved["counts"][stream][counter] == expected
    if fault.without is not None:
        clean = Offline(PARAMETERS).feed(as_messages(fault.without)).calibrator
        for model in BY_VELOCITY:
            expected = clean.result().estimates[model].state
            np.testing.assert_allclose(saved["models"][model]["state"], expected, rtol=0, atol=1e-12)
    else:
        assert_near_truth(saved)


def assert_near_truth(saved: dict) -> None:
    """Pitch and yaw; roll takes more than 40 s."""
    truth, _ = equivalent_error_terms(ERRORS)
    _, pitch, yaw = np.abs(saved["models"]["M3"]["state"][:3] - truth)
    assert max(pitch, yaw) < math.radians(0.5)


def test_silent_streams_are_named_while_others_go_on_and_no_more_when_they_are_back(node):
    node.publish(as_messages(between(0, 10)))
    node.publish(as_messages(only(ReferenceSample, between(10, 25))))
    status = node.wait_until_it_says("no usable DVL message for")
    assert status.level == DiagnosticStatus.ERROR and "check the sensor" in status.message
    node.wait_until_it_says("no usable IMU message for")
    node.publish(as_messages(between(25, 40)))
    status = node.wait_until_it_says("DVL dropped out 1 times")
    assert status.level == DiagnosticStatus.WARN and "no usable" not in status.message


def test_a_node_that_was_stopped_says_so_and_does_not_lay_the_gap_to_the_dvl(node):
    node.publish(as_messages(between(0, 10)))
    node.when_heard(Offline(PARAMETERS).feed(as_messages(between(0, 10))))
    node.process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(PAUSE_S + 2.0)
    finally:
        node.process.send_signal(signal.SIGCONT)
    messages = as_messages(later(between(10, 40), 60))
    node.publish(messages)
    node.when_heard(Offline(PARAMETERS).feed([*as_messages(between(0, 10)), *messages]))
    status = node.wait_until_it_says("this process was not running for")
    assert "PROCESS_PAUSED" in status.message
    assert "DVL dropped out" not in status.message and "no usable DVL message" not in status.message
    assert {each.key: each.value for each in status.values}["dvl dropouts"] == "1"


def test_a_hanging_dvl_is_kept_out_once_max_repeats_is_set(node):
    assert node.world.set_parameter("max_repeats", 3.0).successful
    try:
        messages = as_messages(frozen(20, 30))
        replay = Offline(PARAMETERS.replace(max_repeats=3.0)).feed(messages)
        node.publish(messages)
        saved = node.when_like(replay)
    finally:
        node.world.set_parameter("max_repeats", 0.0)
    assert_agree(saved, replay.calibrator.result())
    assert_counts_add_up(saved["counts"], saved["models"])
    assert saved["counts"]["dvl"]["frozen"] == 47
    node.wait_until_it_says("repeat one velocity more than max_repeats times")


# ---------------------------------------------------------------- neighbours


def test_publishers_and_subscribers_that_do_not_fit_are_named_with_what_is_wrong(node):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=node.world.domain)
    neighbour = rclpy.create_node("neighbour", namespace="hull", context=context)
    neighbour.create_publisher(TwistWithCovarianceStamped, "/dvl/twist", 10)
    neighbour.create_publisher(TwistStamped, "/gnss/twist", 10)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    neighbour.create_subscription(TwistWithCovarianceStamped, f"/{NODE}/calibrated_twist", print, latched)
    try:
        message = node.wait_until_it_says("calibrated_twist: /hull/neighbour requests an incompatible QoS").message
        assert "/dvl/twist: 2 publishers (" in message and "/hull/neighbour), where one is expected" in message
        assert "/gnss/twist: /hull/neighbour publishes geometry_msgs/msg/TwistStamped instead of" in message
    finally:
        neighbour.destroy_node()
        rclpy.shutdown(context=context)


def test_a_second_node_is_named_by_both_until_it_ends(node):
    words = f"/{NODE}/estimate: 2 publishers (/{NODE}, /{NODE}); stop the second node"
    with node.world.calibration_node():
        node.wait_until_it_says(words)
        both = lambda: all(words in each.status[0].message for each in node.diagnostics[-2:])  # noqa: E731
        until(both, "two nodes to say it in turn")
    until(lambda: words not in node.status().message, "/diagnostics without it")


def test_a_best_effort_publisher_that_comes_later_is_heard_and_the_reliable_one_loses_nothing(node):
    profile = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    first, second = as_messages(between(0, 20)), as_messages(between(20, 40))
    replay = Offline(PARAMETERS).feed(first)
    node.publish(first)
    node.when_like(replay)
    other = node.world.node.create_publisher(TwistWithCovarianceStamped, "gnss/twist", profile)
    try:
        until(lambda: other.get_subscription_count() == 1, "the node to hear the best-effort publisher")
        node.publish(second)
        assert_agree(node.when_like(replay.feed(second)), replay.calibrator.result())
    finally:
        node.world.node.destroy_publisher(other)


def test_a_storm_of_parameters_good_and_bad_costs_no_sample_and_ends_where_it_should(node):
    messages, names = as_messages(CLEAN), [*BY_VELOCITY, "M9"]
    asked, refused = [], []
    for number in range(0, len(messages), 6):
        node.publish(messages[number : number + 6])
        asked.append(names[number // 6 % len(names)])
        answer = node.world.set_parameter("model", asked[-1])
        refused += [] if answer.successful else [answer.reason]
    assert node.world.set_parameter("model", "iac").successful  # before anything fails: other tests share this node
    assert asked.count("M9") > 5 and len(refused) == asked.count("M9") and all("'M9'" in reason for reason in refused)
    replay = Offline(PARAMETERS).feed(messages)
    saved, expected = node.when_like(replay), replay.calibrator.result()
    for name in BY_VELOCITY:
        np.testing.assert_allclose(saved["models"][name]["state"], expected.estimates[name].state, rtol=0, atol=1e-12)
    assert saved["counts"] == expected.counts and saved["model"] == "M3"


def parameter_values() -> list[ParameterValue]:
    """Of every type that there is, one that there is not, and none."""
    kind = ParameterType
    return [
        *(ParameterValue(type=kind.PARAMETER_BOOL, bool_value=each) for each in (False, True)),
        *(ParameterValue(type=kind.PARAMETER_INTEGER, integer_value=each) for each in (0, -1, 2**63 - 1)),
        *(ParameterValue(type=kind.PARAMETER_DOUBLE, double_value=each) for each in (0.0, -1e308, 5e-324, NAN, INF)),
        *(
            ParameterValue(type=kind.PARAMETER_STRING, string_value=each)
            for each in ("", "x\x1b", "/x/y.yaml", "é" * 300)
        ),
        *(ParameterValue(type=kind.PARAMETER_DOUBLE_ARRAY, double_array_value=each) for each in ([], [NAN] * 3, [0.1])),
        ParameterValue(type=kind.PARAMETER_BYTE_ARRAY, byte_array_value=[b"a"]),
        ParameterValue(type=kind.PARAMETER_BOOL_ARRAY, bool_array_value=[True] * 3),
        ParameterValue(type=kind.PARAMETER_INTEGER_ARRAY, integer_array_value=[1, 2, 3]),
        ParameterValue(type=kind.PARAMETER_STRING_ARRAY, string_array_value=["a"]),
        ParameterValue(type=kind.PARAMETER_NOT_SET),
        ParameterValue(type=77),  # of a later ROS
    ]


def test_values_of_every_type_for_every_parameter_end_no_node_and_cost_no_sample(node):
    names, values = [*SCHEMA, "use_sim_time", "missing", ""], parameter_values()
    before = {name: node.world.parameter(name) for name in SCHEMA if not SCHEMA[name].read_only}
    messages = as_messages(CLEAN)
    per_name = math.ceil(len(messages) / len(names))
    for number, name in enumerate(names):
        node.publish(messages[number * per_name : (number + 1) * per_name])
        parameters = [ParameterMessage(name=name, value=value) for value in values]
        known = SetParameters.Request(parameters=parameters[:-1])
        results = node.world.call(SetParameters, f"{NODE}/set_parameters", known).results
        assert len(results) == len(parameters) - 1 and all(each.successful or each.reason for each in results)
        unknown = SetParameters.Request(parameters=parameters[-1:])
        assert node.world.call(SetParameters, f"{NODE}/set_parameters", unknown).results == []
        together = SetParametersAtomically.Request(parameters=parameters)
        assert not node.world.call(
            SetParametersAtomically, f"{NODE}/set_parameters_atomically", together
        ).result.successful
        if name in SCHEMA and SCHEMA[name].read_only:
            assert not any(each.successful for each in results)
    for name, value in before.items():
        assert node.world.set_parameter(name, value).successful
    replay = Offline(PARAMETERS).feed(messages)
    saved = node.when_like(replay)
    assert received(saved["counts"]) == received(replay.calibrator.counts)
    assert all(np.isfinite(each["state"]).all() for each in saved["models"].values())


SUBSCRIBER = """
import rclpy
from geometry_msgs.msg import TwistWithCovarianceStamped as Twist
from rclpy.qos import QoSProfile, DurabilityPolicy
rclpy.init()
node = rclpy.create_node("subscriber")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(Twist, "dvl_calibration/estimate", lambda m: print(m.header.stamp.sec, flush=True), latched)
node.create_subscription(Twist, "dvl_calibration/calibrated_twist", lambda _: None, 10)
rclpy.spin(node)
"""


def test_subscribers_that_hang_die_and_come_back_cost_nothing_and_get_the_estimate(node):
    first, second = as_messages(between(0, 20)), as_messages(between(20, 40))
    replay = Offline(PARAMETERS).feed(first)
    node.publish(first)
    node.when_like(replay)
    environment = os.environ | {"ROS_DOMAIN_ID": str(node.world.domain)}
    command = [sys.executable, "-c", SUBSCRIBER]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert int(process.stdout.readline()) == START_NS // SECOND + 19  # the latched one, from before it was there
        process.send_signal(signal.SIGSTOP)
        node.publish(second)
        saved = node.when_like(replay.feed(second))
        process.kill()
    assert_agree(saved, replay.calibrator.result())
    got = node.world.received(TwistWithCovarianceStamped, f"{NODE}/estimate", LATCHED)
    until(lambda: got, "the latched estimate")
    terms = got[-1].twist.twist.angular
    np.testing.assert_array_equal([terms.x, terms.y, terms.z], saved["models"]["M3"]["state"][:3])


# ---------------------------------------------------------------- disk and power


def test_a_full_disk_is_said_and_leaves_the_old_file_and_the_next_save_succeeds(node):
    """The kernel's limit on a file's size stands in for the disk: the same call fails half-way through the write."""
    node.publish(as_messages(between(0, 20)))
    before = node.when_like(Offline(PARAMETERS).feed(as_messages(between(0, 20))))
    limit, unlimited = (4096, resource.RLIM_INFINITY), (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, limit)
    try:
        answer = node.world.call(Trigger, f"{NODE}/save")
        assert not answer.success and "free some space" in answer.message
        node.wait_until_it_says("the result was not saved: ")
    finally:
        resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, unlimited)
    assert load_yaml(node.result_file, "result file") == before
    assert [path.name for path in node.result_file.parent.iterdir() if path.name.startswith(".")] == []
    node.saved()
    assert "not saved" not in node.status().message


def test_a_result_file_whose_folder_goes_comes_back_or_becomes_something_else_costs_no_result(tmp_path):
    """A disk is pulled out during the run, and another one is there in its place."""
    folder = tmp_path / "disk"
    folder.mkdir()
    file, messages = folder / "result.yaml", as_messages(between(0, 20))
    world = World()
    with world.calibration_node("max_latency:=60.0", "model:=iac", f"result_file:={file}") as process:
        node = Live(world, process, file)
        node.publish(messages)
        node.when_like(Offline(PARAMETERS).feed(messages))
        for change in (
            lambda: shutil.rmtree(folder),
            folder.touch,
            lambda: (folder.unlink(), file.mkdir(parents=True)),
        ):
            change()
            answer = world.call(Trigger, f"{NODE}/save")
            assert not answer.success and str(file) in answer.message
            node.wait_until_it_says("the result was not saved: ")
        file.rmdir()
        assert node.saved()["used"] and os.listdir(folder) == ["result.yaml"]
        shutil.rmtree(folder)
    assert process.returncode == 1 and "Traceback" not in process.output
    printed = process.output.partition("The result follows.\n")[2]
    file.parent.mkdir()
    file.write_text(printed)
    assert len(load_initial_calibration(file)) == len(BY_VELOCITY)
    world.close()


# Runs the node, which kills itself, as a power cut would, at one of the calls that writing a file is made of.
DIES_WHILE_SAVING = """
import os, signal, sys
place, count = sys.argv[1], int(sys.argv[2])
real, calls = getattr(os, place), []
def dying(*arguments, **options):
    calls.append(place)
    if len(calls) == count:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments, **options)
setattr(os, place, dying)
from dvl_calib_ros.node.main import main
main(sys.argv[3:])
"""


def test_a_node_killed_while_saving_leaves_a_whole_file_that_the_next_one_starts_from(tmp_path):
    file = tmp_path / "result.yaml"
    first, second, third = (as_messages(between(a, b)) for a, b in ((0, 10), (10, 20), (20, 40)))
    # Of a save after the first: the file's and the folder's fsync, and the renaming of the file and of its backup.
    with dying_node(file, "fsync", 3) as node:
        node.publish(first)
        old = node.when_like(Offline(PARAMETERS).feed(first))
        node.publish(second)
        node.save_and_die()
    assert load_yaml(file, "result file") == old
    initial = load_initial_calibration(file)
    with dying_node(file, "replace", 2, f"initial_calibration:={file}") as node:
        replay = Offline(PARAMETERS, initial).feed(third)
        node.publish(third)
        node.when_heard(replay)
        node.save_and_die()
    assert_agree(load_yaml(file, "result file"), replay.calibrator.result())


@contextmanager
def dying_node(file: Path, place: str, count: int, *arguments: str):
    world = World()
    given = (*(f"{k}:={v}" for k, v in GIVEN.items()), f"result_file:={file}", *arguments)
    with world.calibration_node(*given, entry=("-c", DIES_WHILE_SAVING, place, str(count))) as process:
        yield Live(world, process, file)
    world.close()
    assert process.returncode == -signal.SIGKILL


def test_the_demo_waits_for_a_node_that_falls_behind_so_that_live_and_offline_agree():
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", "demo", "--speed", "1000"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Live and offline agree" in done.stdout, done.stdout + done.stderr
