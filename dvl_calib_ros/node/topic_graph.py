"""Other nodes on the node's topics, and incompatibilities with them."""

from __future__ import annotations

from typing import Any

from rclpy.duration import Infinite
from rclpy.node import Node
from rclpy.qos import LivelinessPolicy, QoSCompatibility, QoSProfile, qos_check_compatible

from ..messages.drivers import TYPES_OF
from ..verdict.reasons import Reason, finding

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
