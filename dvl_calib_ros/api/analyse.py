"""Diagnose recordings, simulate them, and run the published validation."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from dataclasses import replace as with_values
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration.models import BY_VELOCITY
from ..calibration.models.parameters import Parameters
from ..diagnosis.answer.results import Diagnosis
from ..discovery.discovery import Given
from ..errors import InputError
from ..simulation.scenario import Scenario
from ..simulation.trajectories import TRAJECTORIES, Waves
from .arguments import Bags, StrPath, as_paths, discovered_in

if TYPE_CHECKING:
    from ..evaluation.cross_check import CrossCheck
    from ..evaluation.results import Evaluation
    from ..unpaired.results import UnpairedComparison
    from ..unpaired.simulator_rounds import ClosedGap


def diagnose(
    bags: Bags,
    *,
    simulator: Bags | None = None,
    rounds: int | None = None,
    keep: StrPath | None = None,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    **parameters: Any,
) -> Diagnosis | UnpairedComparison | ClosedGap:
    """Find the unmodelled DVL errors of one vehicle's recorded bags, as ``dvl-calib diagnose``.

    Parameters
    ----------
    bags
        See `replay`.
    simulator
        Bags of a simulator with its true velocity, from any motion: compare its DVL with the recorded one instead.
    rounds
        With simulator: improve its DVL, simulate its motion again and compare, up to this number of times, 1 .. 9.
    keep
        With rounds: new folder for the DVL (round_1.json, for `export`) and the bag of each round.
    dvl_topic, gnss_topic, imu_topic
        See `replay`.
    params
        See `replay`.
    **parameters
        See `replay`.

    Returns
    -------
    Diagnosis, UnpairedComparison or ClosedGap
        ``verdict``, ``effects`` with 95 % intervals, ``noise``, and the effects that were not observable. With
        simulator the second type; with rounds the third: one comparison per round (``rounds``), and the ``best``.

    Raises
    ------
    InputError, ParameterError
        See `replay`.
    """
    topics = (dvl_topic, gnss_topic, imu_topic)
    slow = {"min_speed": 0.0} | parameters
    if simulator is not None:
        from ..unpaired.both_sides import RecordedSide
        from ..unpaired.simulator_rounds import against

        sides = [discovered_in(as_paths(each), topics, params, slow) for each in (bags, simulator)]
        real, simulated = (RecordedSide(recording, found.parameters, found.topics) for recording, found in sides)
        return against(real, simulated, rounds, None if keep is None else Path(keep))
    if rounds is not None or keep is not None:
        raise InputError("rounds, keep: only with simulator")
    from ..diagnosis.diagnose import diagnose as run
    from ..examination.examine import rejection

    recording, discovery = discovered_in(as_paths(bags), topics, params, parameters)
    diagnosis = run(recording, discovery.diagnosed.replace(min_speed=slow["min_speed"]), discovery.topics)
    return diagnosis.led_by(rejection(recording, discovery))


def simulate(
    bag: StrPath,
    scenario: Scenario | None = None,
    *,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    **scenario_fields: Any,
) -> Path:
    """Write a simulated bag, as ``dvl-calib simulate``.

    Parameters
    ----------
    bag
        Folder to write; must not exist.
    scenario
        Motion, sensors and errors to simulate; by default ten minutes along a box.
    effects
        Effects by name, each with its parameters, such as ``{"lever_arm": {"x_m": 0.5}}``.
    **scenario_fields
        Fields of `Scenario` instead, such as ``seconds=120.0, trajectory="free"``.

    Returns
    -------
    Path
        The bag.

    Raises
    ------
    InputError
        If the bag exists or cannot be written, or an effect, parameter or field is unknown.
    """
    from ..bags.writer import Compression, Storage
    from ..simulation.injection import injection_of
    from ..simulation.scenario import write_bag

    if scenario is not None and scenario_fields:
        raise InputError("simulate: give a scenario or fields of one, not both")
    target, made = Path(bag), scenario or _scenario(scenario_fields)
    if effects is not None:
        if not isinstance(effects, Mapping):
            raise InputError("simulate: give effects by name, such as {'lever_arm': {'x_m': 0.5}}")
        made = with_values(made, effects=tuple(injection_of(name, given) for name, given in effects.items()))
    write_bag(made, target, Storage.MCAP, Compression.NONE, with_truth=True)
    return target


def _scenario(given: Mapping[str, Any]) -> Scenario:
    """Build a scenario from its fields. Raises InputError for an unknown field or an invalid value."""
    known = [each.name for each in fields(Scenario)]
    for name, value in given.items():
        if name not in known:
            similar = ["seconds"] if name == "duration" else difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {similar[0]!r}?" if similar else f"there are {', '.join(known)}"
            raise InputError(f"simulate: no such field {name!r}, {hint}")
        if name == "waves" and value is not None and not isinstance(value, Waves):
            raise InputError(f"simulate: waves={value!r}; expected Waves(height=0.5, period=6.0) (m, s)")
        if name == "trajectory" and value not in TRAJECTORIES:
            raise InputError(f"simulate: trajectory={value!r}; there are {', '.join(TRAJECTORIES)}")
        if (name == "seconds" or name.endswith(("_rate", "_std"))) and not isinstance(value, int | float | None):
            raise InputError(f"simulate: {name}={value!r}; expected a number")
    return Scenario(**given)


def evaluate(
    paths: Bags | None = None,
    *,
    models: Sequence[str] | None = None,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    **parameters: Any,
) -> Evaluation | CrossCheck:
    """Evaluate the models, as ``dvl-calib evaluate``.

    Parameters
    ----------
    paths
        A folder of trajectories for the published procedure, None for simulated trajectories, or at least two bags:
        each calibrates, all others verify.
    models
        Names; all by default.
    dvl_topic, gnss_topic, imu_topic
        Topics of bags, see `replay`.
    **parameters
        Any of the node's parameters, in SI units.

    Returns
    -------
    Evaluation or CrossCheck
        ``verdict``: better, not_better or not_known; velocity errors by model and set of trajectories, for bags by
        calibrating and verifying bag.

    Raises
    ------
    InputError, ParameterError
        For unreadable trajectories or bags, and for an unknown model or parameter.

    References
    ----------
    Avg.VRMSE and the procedure are by Yampolsky and Klein; see the page Evaluation.
    """
    from ..evaluation.cross_check import cross_check
    from ..evaluation.validation_study import DEFAULTS, EVALUATED
    from ..evaluation.validation_study import evaluate as run
    from ..parallel import Workers

    found = [] if paths is None else as_paths(paths)
    default = BY_VELOCITY if len(found) > 1 else EVALUATED
    names = default if models is None else tuple(models)
    for name in names:
        if name not in BY_VELOCITY:
            raise InputError(f"models: {name!r} is none of {', '.join(BY_VELOCITY)}")
    if len(found) > 1:
        given = Given(dvl_topic, gnss_topic, imu_topic, frozenset(parameters))
        return cross_check(found, Parameters.from_mapping(parameters), names, given, Workers())
    return run(found[0] if found else None, Parameters.from_mapping({**DEFAULTS, **parameters}), models=names)
