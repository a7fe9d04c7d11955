"""The answer of a replay, first and short: what to do with it, the mounting to paste, and what to type next."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ..discovery.discover import Discovery
    from ..replay.replay import Replayed
    from ..verdict.reasons import Reason

# What the verdict's word asks of the reader, and its colour.
VERDICTS = {
    "accept": ("Use this calibration.", "green"),
    "marginal": ("Use this calibration with care:", "yellow"),
    "reject": ("Do not use this calibration:", "red"),
}


def shown_findings(replayed: Replayed, discovery: Discovery, models: Sequence[str]) -> list[Reason]:
    """Findings worth a warning: none of models that were not asked for, none that discovery has settled."""
    other = [f"{name}: " for name in replayed.result.estimates if name not in models]
    settled = {"BAG_NO_GNSS", "BAG_NO_IMU"} | ({"IMU_FRAME"} if discovery.knows_imu else set())
    return [
        found
        for found in replayed.findings
        if found.code not in settled and not any(found.says.startswith(prefix) for prefix in other)
    ]


def print_answer(out: Console, replayed: Replayed) -> None:
    """One paragraph, one table, the mounting in the form to paste."""
    from rich.markup import escape

    from ..calibration.samples import VelocityFrame
    from ..verdict.kinds import Severity

    result = replayed.result
    for found in replayed.findings:
        if found.code == "BAG_NO_IMU":
            out.print(f"[bold]{escape(_capital(found.says))}.[/]")
    verification = result.verifications[result.selected]
    advice, colour = VERDICTS[verification.verdict.value]
    reasons = "; ".join(each.sentence for each in verification.reasons)
    text = f"{advice} {_capital(reasons) if advice.endswith('.') else reasons}."
    out.print(f"[bold {colour}]{verification.verdict.value}[/]: {escape(text)}")
    if verification.mounting is not None:
        out.print(escape(f"{_capital(verification.mounting.sentence)}."))
    out.print()
    rejected = verification.verdict is Severity.REJECT
    out.print(f"[dim]Not to be used: {escape(_headline(replayed))}[/]" if rejected else escape(_headline(replayed)))
    out.print(_table(replayed), style="dim" if rejected else None)
    if replayed.reference_frame in (VelocityFrame.ENU, VelocityFrame.NED):
        out.print(
            "Angles are against the IMU's own: a constant error of its heading is in the yaw, one of its level in roll "
            "and pitch, and both are harmless with that IMU."
        )
    _print_navigation(out, replayed)
    for sentence in _not_shown(replayed):
        out.print(escape(sentence), soft_wrap=False)
    if not rejected:
        out.print(f"\nURDF  {escape(_origin(replayed))}", soft_wrap=True)
    else:
        out.print()


def _headline(replayed: Replayed) -> str:
    """By how much the mounting is off, by which model, from how much data."""
    import numpy as np

    from ..calibration.parameters import Parameters

    result = replayed.result
    parameters = Parameters.from_mapping(result.parameters)
    turn = parameters.rotation_dvl_from_body @ result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    angle = math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(turn)) - 1.0)))))
    seconds = 1e-9 * ((result.last_ns or 0) - (result.first_ns or 0)) - replayed.pause_s
    return (
        f"The DVL is turned by {angle:.2f}° from its nominal place in {parameters.base_frame} (model "
        f"{result.selected}, {result.estimate.used} samples used of {seconds:.0f} s):"
    )


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _table(replayed: Replayed) -> Table:
    """Nominal and corrected mounting, and what was found beside, with their standard deviations."""
    from rich import box
    from rich.table import Table

    from ..calibration.quantities import quantities

    table = Table(box=box.SIMPLE_HEAD)
    for column in ("", "nominal", "corrected", "±1σ"):
        table.add_column(column, justify="right", no_wrap=True)
    for each in quantities(replayed.result):
        corrected = each.in_unit(each.value, signed=each.unit != "°")
        mark = "" if each.shown else " ?"
        table.add_row(each.name, each.in_unit(each.nominal), corrected, f"{each.in_unit(each.std)}{mark}")
    return table


def _print_navigation(out: Console, replayed: Replayed) -> None:
    """What the calibration is worth in dead reckoning, and on a terminal a map of it."""
    from rich.markup import escape

    from ..replay.navigation import in_words
    from .terminal_map import terminal_map

    navigation = replayed.navigation
    if navigation is None:
        return
    for sentence in in_words(navigation):
        out.print(escape(sentence), soft_wrap=False)
    if out.is_terminal and navigation.on_a_map:
        out.print(terminal_map(navigation, out.width))


def _not_shown(replayed: Replayed) -> list[str]:
    """What the recording does not show, and the manoeuvre that would; one sentence per cause."""
    causes: dict[str, list[str]] = {}
    for entry in replayed.result.estimate.observability:
        if entry.missing:
            causes.setdefault(entry.missing, []).append(entry.axis)
    return [
        f"? {' and '.join(dict.fromkeys(axes))}: not shown by this recording; it needs {missing}"
        for missing, axes in causes.items()
    ]


def _origin(replayed: Replayed) -> str:
    """The corrected mounting as a URDF joint's origin; for a driver of forward-right-down data with both axes."""
    from ..calibration.frames import FLU_FROM_FRD, rpy_from_rotation
    from ..calibration.parameters import Parameters
    from ..files.urdf import origin_tag

    result = replayed.result
    parameters = Parameters.from_mapping(result.parameters)
    rotation = result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    arm = result.position_in_body
    tag = origin_tag(arm, rpy_from_rotation(rotation))
    if not replayed.turned:
        return tag
    own = origin_tag(arm, rpy_from_rotation(rotation @ FLU_FROM_FRD))
    return f"{tag}  (forward-left-up axes)\n      {own}  ({replayed.dvl_frame} of the driver: forward-right-down)"


def next_commands(
    replayed: Replayed, bags: Sequence[Path], saved: Path | None, options: Sequence[str], doubts: bool
) -> list[str]:
    """What to type next, in order. options: of this run, which the next needs as well."""
    named = " ".join(shlex.quote(str(bag)) for bag in bags)
    given = "".join(f" {shlex.quote(option)}" for option in options)
    verdict = replayed.result.verifications[replayed.result.selected].verdict.value
    if verdict == "reject" and replayed.recordings is not None and replayed.recordings.moved:
        return [f"dvl-calib compare {named}{given}", f"dvl-calib doctor {named}"]
    if verdict == "reject":
        return [f"dvl-calib doctor {named}", f"dvl-calib diagnose {named}{given}"]
    if saved is None:
        return [f"dvl-calib replay {named}{given} --save calibration.yaml"]
    commands = [f"dvl-calib apply {shlex.quote(str(saved))} --urdf robot.urdf"]
    return commands + ([f"dvl-calib doctor {named}"] if doubts else [])
