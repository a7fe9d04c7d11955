"""What the node logs, answers and says in /diagnostics is fit for a terminal, whatever names it is given."""

from __future__ import annotations

import pytest
from command_line import unfit

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros import until
from std_srvs.srv import Trigger
from test_node import Publisher, node_here, twist

EVIL = "x\x1b[2J\x1b]0;y\x07\u202ey\x9b2J\r\nnote: forged"


def test_what_the_node_says_of_names_from_outside_is_fit_for_a_terminal(world, tmp_path, capfd):
    folder = tmp_path / EVIL
    folder.mkdir()
    with node_here(world, result_file=str(folder / f"{EVIL}.yaml"), base_frame=EVIL) as node:
        said = world.received(DiagnosticArray, "/diagnostics")
        Publisher(world).send(*(twist(1.7e9 + 0.2 * i, frame=f"dvl{EVIL}") for i in range(30)))
        Publisher(world, "gnss/twist").send(*(twist(1.7e9 + 0.2 * i, frame=EVIL) for i in range(30)))
        until(lambda: node._calibrator.counts["dvl"]["received"] == 30, "the messages")
        answers = []
        for service in ("save", "save_anyway"):
            client = world.node.create_client(Trigger, f"/dvl_calibration/{service}")
            until(client.service_is_ready, service)
            future = client.call_async(Trigger.Request())
            until(future.done, service)
            answers.append(future.result().message)
        client = world.node.create_client(SetParameters, "/dvl_calibration/set_parameters")
        until(client.service_is_ready, "the parameter services")
        values = {EVIL: 1.0, "model": EVIL, "result_file": f"/{EVIL}/x"}
        request = SetParameters.Request()
        for name, value in values.items():
            request.parameters = [Parameter(name, value=value).to_parameter_msg()]
            future = client.call_async(request)
            until(future.done, name)
            answers += [each.reason for each in future.result().results]
        node.warn(EVIL), node.info(EVIL), node.error(EVIL)
        node._publish_diagnostics()
        until(lambda: len(said) >= 2, "diagnostics")
    assert len(answers) == 5 and all(answers) and any("\\x1b" in each for each in answers)
    for text in (*answers, *capfd.readouterr()):
        assert not unfit(text) and "\nnote: forged" not in text
    for array in said:
        for status in array.status:
            for text in (status.message, *(each.value for each in status.values)):
                assert not unfit(text) and "\n" not in text
