"""Demonstrate the package on a shipped bag.

Starts the real node in its own process and plays a bag with a GNSS outage to it over DDS (on this machine only, on its
own ROS domain). Shows the estimates converge and switches a model by the parameter service. Then replays the same bag
offline and prints both results next to the truth. Last, it diagnoses errors that a simulator would lack.
"""

from __future__ import annotations

import argparse
import os
import random
import socket
import subprocess
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, needing_ros
from . import common
from .watch import node_command

if TYPE_CHECKING:
    from ..calibration.results.results import Result

BAG = "harbour_box"
# simulated errors of the bag, see bags/README.md
MISALIGNMENT_DEG = (1.0, -1.5, 3.0)
SCALE_PERCENT = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--speed", type=float, default=20.0, help="times real time; default: %(default)g")
    common.add_report_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Play the demo bag into a live node and compare its result with an offline replay.

    Return 0 if both agree, else 1.
    """
    from ..bag_replay.replay import replay
    from ..calibration.models import MODELS
    from ..files.parameter_files import load_parameters
    from ..present.replay import replayed

    if not 0.1 <= arguments.speed <= 1000.0:
        raise InputError("--speed: give a number in 0.1 .. 1000")
    bag = common.share_folder() / "bags" / BAG
    common.check_outputs(arguments, "report", also_read=[bag])
    os.environ.update(private_domain())
    with needing_ros("demo"):
        import rclpy
    out = common.console()
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "live.yaml"
        log = (Path(folder) / "node.log").open("w+")
        latency = _latency(arguments.speed)
        command = node_command(["--ros-args", "-p", f"result_file:={saved}", "-p", latency])
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        ) as process:
            rclpy.init()
            try:
                _show_live(out, bag, arguments.speed)
            finally:
                rclpy.try_shutdown()
                process.communicate(timeout=30)  # the node ends when its standard input is closed
        if not saved.exists():
            log.seek(0)
            raise InputError(f"the node did not save a result; its log: {log.read()[-2000:]}")
        offline = replay([bag], load_parameters(None, [latency]), with_history=arguments.report is not None)
        agree = _compare(out, saved, offline.result)
    _show_diagnosis(out, bag)
    if arguments.report is not None:
        common.write_page(arguments.report, replayed(offline, [bag], list(MODELS)))
        out.print(f"The replay's report is in {arguments.report}.")
    return 0 if agree else 1


def _latency(speed: float) -> str:
    """Return max_latency for a bag played at `speed` times real time: one second of real time, in stamps.

    Up to three seconds at low speed, because a busy machine stalls that long; at most 20 s, to show the outage while it
    lasts.
    """
    return f"max_latency:={max(min(speed, 600.0), min(3.0 * speed, 20.0), 1.0):.1f}"


def _show_live(out: Any, bag: Path, speed: float) -> None:
    """Play the bag to the node and show its estimates live."""
    from rich.live import Live

    from ..demo.player import Watcher

    watcher = Watcher([bag], _truth())
    out.print(f"[bold]1. Live[/]: node and player are two processes, ROS domain {os.environ['ROS_DOMAIN_ID']}")
    out.print(f"   playing {bag} at {speed:g} times real time, GNSS drops out on the way")
    out.print()
    with Live(console=out, refresh_per_second=5, get_renderable=watcher.render, transient=False) as live:
        watcher.run(speed, switch_at_s=470.0, switch_to="M4", back_at_s=500.0)
        live.refresh()
    out.print()
    out.print("This was its last message. As the node ends, it uses the samples that still wait, and saves.")


def _truth() -> dict[str, float]:
    """Return the true errors of the bag: φ in degrees, δk in per cent (see bags/README.md)."""
    import math

    from ..simulation.sensors import DvlErrors, equivalent_error_terms

    roll, pitch, yaw = map(math.radians, MISALIGNMENT_DEG)
    errors = DvlErrors((roll, pitch, yaw), (0.01 * SCALE_PERCENT,) * 3)
    misalignment, scale = equivalent_error_terms(errors)
    angles = dict(zip(("phi_x", "phi_y", "phi_z"), map(math.degrees, misalignment), strict=True))
    return angles | {"delta_k": 100.0 * scale[0]}


def _compare(out: Any, saved: Path, offline: Result) -> bool:
    """Print live and replayed estimates; return whether they agree to rounding."""
    import numpy as np

    from ..files.result_file import load_result
    from ..present.document import Table
    from ..present.replay import estimate_table
    from ..present.terminal import rich_table

    out.print("[bold]2. Offline[/]: the same bag through `dvl-calib replay`")
    content, live = load_result(saved)
    found = estimate_table(offline, list(offline.estimates))
    truth = ("truth", *(f"{value:+.2f}" for value in _truth().values()))
    of_these = [row[: len(truth)] for row in found.rows]  # only the columns that have a truth
    out.print(rich_table(Table(found.head[: len(truth)], [truth, *of_these])))
    worst = max(
        float(np.abs(live_value - replay_value).max())
        for name, estimate in offline.estimates.items()
        for live_value, replay_value in ((live[name].x, estimate.state), (live[name].p, estimate.covariance))
    )
    start_ns = offline.first_ns or 0
    switches = ", ".join(f"{(at - start_ns) * 1e-9:.1f} s {name}" for at, name in offline.segments)
    out.print(
        f"The node ended on {content['model']}, the replay on {offline.selected}; auto selected, by stamp: {switches}."
    )
    verdict = "agree" if worst < 1e-12 else "[red]DIFFER[/] (if the machine is too busy to keep up: --speed 5)"
    out.print(f"Live and offline {verdict}: the largest difference in any state or covariance is {worst:.1e}.")
    return worst < 1e-12


def _show_diagnosis(out: Any, bag: Path) -> None:
    """Diagnose the bag and print verdict and effects."""
    from ..calibration.models.parameters import Parameters
    from ..diagnosis.diagnose import diagnose

    out.print()
    out.print("[bold]3. Diagnosis[/]: errors in this bag that a simulator would lack, `dvl-calib diagnose`")
    out.print()
    diagnosis = diagnose([bag], Parameters(min_speed=0.0))
    out.print(f"[bold]{diagnosis.verdict.value}[/]: {diagnosis.sentence}", soft_wrap=True)


# DDS Interoperability Wire Protocol 2.5 (RTPS), section 9.6.2: port of the first participant's discovery traffic
PORT_BASE, DOMAIN_GAIN, FIRST_PARTICIPANT = 7400, 250, 10
# higher domains use the ports that systems give to outgoing connections
DOMAINS = range(1, 101)
# Domain -> socket that reserves it: only one socket of this host can have its name, and the name is free again when the
# process ends.
_taken: dict[int, socket.socket] = {}


def private_domain() -> dict[str, str]:
    """Return environment variables for processes on a free domain that is heard on this host only."""
    return {"ROS_DOMAIN_ID": str(take_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def take_domain() -> int:
    """Reserve a random free ROS domain without a participant on this host.

    It stays reserved until `give_back` or the end of this process. Raises InputError if there is none.
    """
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        if _claim_domain(domain):
            if not _has_participant(domain):
                return domain
            give_back(domain)
    raise InputError(
        f"every ROS domain from {DOMAINS[0]} to {DOMAINS[-1]} has a participant on this host; end some of them"
    )


def give_back(domain: int) -> None:
    """Release a domain that this process reserved."""
    _taken.pop(domain).close()


def _claim_domain(domain: int) -> bool:
    """Claim a ROS domain for this process; return whether it was free."""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0dvl_calib_ros/domain/{domain}")
    except OSError:
        claim.close()
        return False
    _taken[domain] = claim
    return True


def _has_participant(domain: int) -> bool:
    """Return whether a DDS participant on this host already uses a ROS domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", PORT_BASE + DOMAIN_GAIN * domain + FIRST_PARTICIPANT))
        except OSError:
            return True
    return False
