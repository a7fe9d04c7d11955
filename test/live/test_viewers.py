"""The layouts for Foxglove and PlotJuggler: every path in them is in what the node publishes, as a number or a word."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from conftest import ROOT
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped
from ros import NODE, World, until

from dvl_calib_ros.node.status import status_name

FOXGLOVE = ROOT / "config" / "foxglove_layout.json"
PLOTJUGGLER = ROOT / "config" / "plotjuggler_layout.xml"
WORDS = {"model": "full", "convergence": "collecting", "gnss": "GNSS is available"}


def twist(stamp: int, frame_id: str, *velocity: float) -> TwistWithCovarianceStamped:
    message = TwistWithCovarianceStamped()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    message.header.frame_id = frame_id
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = velocity
    return message


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    """Topic -> a message that the real node has published with GNSS."""
    world = World()
    topics = {"/diagnostics": DiagnosticArray}
    topics |= {f"/{NODE}/{name}": TwistWithCovarianceStamped for name in ("estimate", "calibrated_twist")}
    try:
        with world.calibration_node("max_latency:=60.0"):  # 20 s of samples are sent at once
            received = {topic: world.received(kind, topic, 100) for topic, kind in topics.items()}
            dvl, gnss = (
                world.node.create_publisher(TwistWithCovarianceStamped, f"{name}/twist", 1000)
                for name in ("dvl", "gnss")
            )
            until(
                lambda: dvl.get_subscription_count() == gnss.get_subscription_count() == 1, "the node's subscriptions"
            )
            for i in range(100):
                stamp = 1_000_000_000_000 + 200_000_000 * i
                gnss.publish(twist(stamp, "base_link", 1.5, 0.1 * (i % 7), 0.0))
                dvl.publish(twist(stamp, "dvl_link", 1.51, 0.1 * (i % 7) + 0.05, 0.02))
            until(lambda: "model full" in state(received["/diagnostics"]), "diagnostics with GNSS")
            until(lambda: all(received.values()), "a message on every topic")
            return {topic: messages[-1] for topic, messages in received.items()}
    finally:
        world.close()


def state(messages: list[DiagnosticArray]) -> str:
    return " ".join(f"{item.key} {item.value}" for message in messages[-1:] for item in message.status[0].values)


# ---------------------------------------------------------------- Foxglove

STEP = re.compile(r"""\.(?P<field>\w+) | \[:\] | \{(?P<key>\w+)=="(?P<value>[^"]*)"\} | \.@(?P<function>\w+)$""", re.X)


def foxglove_values(path: str, published: dict[str, Any]) -> list[Any]:
    """What a Foxglove message path selects: fields, [:] for all of an array, {field=="text"}, a function at the end."""
    topic = re.match(r"[\w/]+", path)[0]
    found, at = [published[topic]], len(topic)
    while at < len(path):
        step = STEP.match(path, at)
        assert step, f"{path[at:]!r} in {path}"
        at = step.end()
        if step["field"]:
            found = [getattr(each, step["field"]) for each in found]
        elif step["key"]:
            found = [each for each in found if getattr(each, step["key"]) == step["value"]]
        elif step["function"]:
            assert step["function"] == "rad2deg"
        else:
            found = [item for each in found for item in each]
    return found


def foxglove_panels(kind: str) -> dict[str, Any]:
    panels = json.loads(FOXGLOVE.read_text())["configById"]
    return {name: panel for name, panel in panels.items() if name.startswith(f"{kind}!")}


def test_every_path_that_foxglove_plots_is_one_number_in_what_the_node_publishes(published):
    paths = [path["value"] for panel in foxglove_panels("Plot").values() for path in panel["paths"]]
    assert len(paths) > 10
    for path in paths:
        (value,) = foxglove_values(path, published)
        float(value)


def test_foxglove_shows_model_convergence_and_gnss_as_words(published):
    (panel,) = foxglove_panels("StateTransitions").values()
    shown = [foxglove_values(path["value"], published) for path in panel["paths"]]
    assert shown == [[word] for word in WORDS.values()]


def test_the_diagnostics_panel_of_foxglove_selects_the_nodes_status(published):
    (panel,) = foxglove_panels("DiagnosticStatusPanel").values()
    (status,) = published[panel["topicToRender"]].status
    assert (panel["selectedHardwareId"], panel["selectedName"]) == (status.hardware_id, status.name)
    assert status.name == status_name(NODE)


def test_foxglove_shows_every_panel_once():
    def leaves(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
            return
        assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
        yield from (*leaves(node["first"]), *leaves(node["second"]))

    document = json.loads(FOXGLOVE.read_text())
    assert sorted(leaves(document["layout"])) == sorted(document["configById"])


# ---------------------------------------------------------------- PlotJuggler


def plotjuggler_series(published: dict[str, Any]) -> set[str]:
    """Names of the series that PlotJuggler makes of numbers: fields by slashes; diagnostics by hardware, name, key."""
    names = set()
    for topic, message in published.items():
        if isinstance(message, DiagnosticArray):
            for status in message.status:
                prefix = f"{topic}/{status.hardware_id}/{status.name}"
                names |= {f"{prefix}/{item.key}" for item in status.values if is_number(item.value)}
        else:
            names |= {f"{topic}/twist/twist/{part}/{axis}" for part in ("linear", "angular") for axis in "xyz"}
    return names


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@pytest.mark.slow
def test_every_curve_of_plotjuggler_is_a_series_of_numbers_that_the_node_publishes(published):
    curves = [curve.get("name") for curve in ElementTree.parse(PLOTJUGGLER).iter("curve")]
    assert len(curves) > 10
    assert set(curves) - plotjuggler_series(published) == set()


def test_the_splitters_of_plotjuggler_have_the_sizes_of_what_they_hold():
    for splitter in ElementTree.parse(PLOTJUGGLER).iter("DockSplitter"):
        assert len(splitter) == int(splitter.get("count")) == len(splitter.get("sizes").split(";"))
