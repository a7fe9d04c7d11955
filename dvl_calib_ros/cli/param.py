"""List, read and set the parameters of a running calibration node, also where ros2 param is not installed.

A value is checked as for -p: ``dvl-calib param set target_drift 3.5``.
"""

from __future__ import annotations

import argparse
from typing import Any

from ..errors import InputError
from ..standard_streams import show
from . import common

# Time limits, s, to find the node and for each answer. The middleware may lose an answer, so a request is repeated.
FOUND_WITHIN_S, ANSWERED_WITHIN_S, TRIES = 10.0, 3.0, 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("what", choices=["list", "get", "set"])
    parser.add_argument("name", nargs="?", metavar="NAME")
    parser.add_argument("value", nargs="?", metavar="VALUE")
    parser.add_argument("--node", metavar="NAME", help="full name of the node, if it was given another")


def run(arguments: argparse.Namespace) -> None:
    """Send a request to the node and print the answer. Raises InputError if it refuses or there is no node."""
    from ..calibration.models.parameters import SCHEMA
    from ..files.parameter_files import NODE_NAME, as_yaml, load_parameters

    what, name, value = arguments.what, arguments.name, arguments.value
    if (name is None, value is None) != (what == "list", what != "set"):
        raise InputError("give: list, get NAME, or set NAME VALUE")
    if name is not None and name not in SCHEMA:
        load_parameters(None, [f"{name}:=0"])  # raises InputError with the nearest name
    if what == "set" and SCHEMA[name].read_only:
        raise InputError(f"{name}: a running node does not change it; start the node with -p {name}:={value}")
    new = load_parameters(None, [f"{name}:={value}"]).as_dict()[name] if what == "set" else None
    with common.ros_node("param", "dvl_calib_param") as (node, _):
        from rclpy.parameter import Parameter, parameter_value_to_python
        from rclpy.parameter_client import AsyncParameterClient

        full_name = f"/{(arguments.node or NODE_NAME).strip('/')}"
        client = AsyncParameterClient(node, full_name)
        if not client.wait_for_services(FOUND_WITHIN_S):
            raise InputError(
                f"no node {full_name} within {FOUND_WITHIN_S:.0f} s; is it running, with this ROS_DOMAIN_ID? --node "
                "names another"
            )
        if what == "set":
            (result,) = _request(node, full_name, client.set_parameters, [Parameter(name, value=new)]).results
            if not result.successful:
                raise InputError(f"{name}: {result.reason}")
        names = list(SCHEMA) if name is None else [name]
        for each, found in zip(names, _request(node, full_name, client.get_parameters, names).values, strict=True):
            found = parameter_value_to_python(found)
            fixed = "  # only at the start" if SCHEMA[each].read_only else ""
            show(f"{each}: {as_yaml(list(found) if hasattr(found, 'tolist') else found)}{fixed}")


def _request(node: Any, name: str, ask: Any, about: Any) -> Any:
    """Send a request until the node answers. Raises InputError after `TRIES`."""
    import rclpy

    for _ in range(TRIES):
        future = ask(about)
        rclpy.spin_until_future_complete(node, future, timeout_sec=ANSWERED_WITHIN_S)
        if future.done():
            return future.result()
    raise InputError(f"{name} does not answer; is it busy?")
