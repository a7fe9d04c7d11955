"""Calibrate with recordings, examine, compare, diagnose and simulate them, and evaluate the models."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from dataclasses import replace as with_values
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration.models import BY_VELOCITY
from ..calibration.models.parameters import Parameters
from ..diagnosis.answer.results import Diagnosis
from ..discovery.discover import discover
from ..discovery.discovery import Discovery, Given
from ..errors import InputError
from ..examination.examine import Examination, examine, judged_replay, rejection
from ..recordings.recording import Recording, open_recording
from ..simulation.scenario import Scenario, write_bag
from ..simulation.trajectories import TRAJECTORIES, Waves
from .calibrated import Calibration

if TYPE_CHECKING:
    from ..bags.writer import Compression, Storage
    from ..calibration.comparison.mounting_change import Comparison
    from ..evaluation.cross_check import CrossCheck
    from ..evaluation.results import Evaluation
    from ..fleet_catalogue.update import Fleet
    from ..unpaired.results import UnpairedComparison
    from ..unpaired.simulator_rounds import ClosedGap

StrPath = str | os.PathLike[str]
Bags = StrPath | Sequence[StrPath]


def path_of(given: StrPath) -> Path:
    """Return a path as such. Raises InputError for anything else."""
    try:
        return Path(given)
    except TypeError:
        raise InputError(f"expected a path, not {type(given).__name__}; save a result first, name its file") from None


def as_path(given: StrPath | None) -> Path | None:
    """Return a path as such, or None. Raises InputError for anything else."""
    return None if given is None else path_of(given)


def storage_and_compression(storage: str, compression: str) -> tuple[Storage, Compression]:
    """Check storage and compression of a new bag. Raises InputError."""
    from ..bags.writer import Compression, Storage

    try:
        return Storage(storage), Compression(compression)
    except ValueError as error:
        known = (", ".join(each.value for each in kind) for kind in (Storage, Compression))
        raise InputError("{}; storage is one of {}; compression is one of {}".format(error, *known)) from None


def as_paths(bags: Bags) -> list[Path]:
    """Return one or several recordings as paths. Raises InputError for none, or for anything else."""
    try:
        found = [Path(bags)] if isinstance(bags, str | os.PathLike) else [Path(bag) for bag in bags]
    except TypeError:
        raise InputError(f"bags={bags!r}: expected the path of a bag, or a list of paths") from None
    if not found:
        raise InputError("no bag is named; name one at least")
    return found


def parameters_from(params: StrPath | None, given: Mapping[str, Any]) -> tuple[Parameters, frozenset[str]]:
    """Merge the parameters of a file and of a call; also return the names that either sets."""
    from ..files.parameter_files import given_parameters, load_parameters

    path = as_path(params)
    return load_parameters(path).replace(**given), given_parameters(path) | frozenset(given)


def discovered_in(
    paths: list[Path],
    topics: tuple[str | None, str | None, str | None],
    params: StrPath | None,
    given: Mapping[str, Any],
) -> tuple[Recording, Discovery]:
    """Open recordings and discover their topics, mounting and frames, except those that the call names."""
    parameters, names = parameters_from(params, given)
    dvl, gnss, imu = topics
    recording = open_recording(paths, None, parameters)
    return recording, discover(recording, parameters, Given(dvl, gnss, imu, names))


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
        return against(real, simulated, rounds, as_path(keep))
    if rounds is not None or keep is not None:
        raise InputError("rounds, keep: only with simulator")
    from ..diagnosis.diagnose import diagnose as run

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
        Fields of `Scenario` instead, such as ``seconds=120.0, trajectory="free"``. A misaligned DVL is
        ``errors=DvlErrors(misalignment_rpy=(0.0, 0.0, 0.05))``, with DvlErrors of dvl_calib_ros.simulation.sensors.

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

    if scenario is not None and scenario_fields:
        raise InputError("simulate: give a scenario or fields of one, not both")
    target, made = path_of(bag), scenario or _scenario(scenario_fields)
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
        if value is not None and (name == "seconds" or name.endswith(("_rate", "_std"))):
            least = {"seconds": 1.0, "dvl_rate": 0.01}.get(name, 0.0)  # s, Hz
            if not isinstance(value, int | float) or not value >= least:
                raise InputError(f"simulate: {name}={value!r}; expected a number from {least:g} on")
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


def replay(
    bags: Bags,
    *,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    history: bool = True,
    merge: bool = False,
    **parameters: Any,
) -> Calibration:
    """Calibrate with recorded bags, as ``dvl-calib replay``.

    Parameters
    ----------
    bags
        A rosbag2 folder, a .mcap, .db3 or (ROS 1) .bag file, or several of them, which are read as one.
    dvl_topic, gnss_topic, imu_topic
        Topics; by default found by type, name and content. gnss_topic, imu_topic: "none" ignores the sensor.
    params
        A ROS 2 parameter file.
    history
        Keep the estimates over time, for `Calibration.plot`, `to_pandas` and `report`.
    merge
        Calibrate several bags together even if the mounting moved between them.
    **parameters
        Any of the node's parameters, in SI units, such as ``mounting_rpy=(0, 0, 0.785)``.

    Returns
    -------
    Calibration
        ``mounting`` with σ, ``verdict`` with its reasons, and `Calibration.correct`, ``save``, ``plot``, ``report``.

    Raises
    ------
    InputError, ParameterError
        For a file that is no bag or has no DVL, and for an unknown or invalid parameter.

    References
    ----------
    The models M1 to M7 are by Yampolsky and Klein, Information-Aided DVL Calibration; see the page Models.
    """
    paths = as_paths(bags)
    recording, discovery = discovered_in(paths, (dvl_topic, gnss_topic, imu_topic), params, parameters)
    replayed = judged_replay(recording, discovery, merge=merge, with_history=history)
    return Calibration(replayed, discovery.with_mounting(replayed.result.parameters["mounting_rpy"]), tuple(paths))


def compare(
    *results: StrPath | Calibration,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    **parameters: Any,
) -> Comparison:
    """Compare calibrations of one DVL to detect a moved mounting, as ``dvl-calib compare``.

    Parameters
    ----------
    *results
        Two or more result files, bags, or return values of `replay`. A bag is calibrated first.
    dvl_topic, gnss_topic, imu_topic
        Topics of bags, see `replay`.
    params
        Parameters of bags, see `replay`.
    **parameters
        Parameters of bags, see `replay`.

    Returns
    -------
    Comparison
        ``word``: same, suspicious or moved, with the differences; `calibration.comparison` has its `reasons`.

    Raises
    ------
    InputError
        For a result that is no result file, has no sample, repeats another, or shares no quantity with the others.
    """
    from ..bag_replay.checked_replay import calibrated
    from ..bag_replay.replay import extrinsics_of_replay
    from ..bags.files import is_bag
    from ..calibration.comparison.mounting_change import check_distinct
    from ..calibration.comparison.mounting_change import compare as run
    from ..files.mounting import load_extrinsics

    found = []
    for given, name in zip(results, _names(results), strict=True):
        if isinstance(given, Calibration):
            extrinsics = extrinsics_of_replay(given.replayed, name)
            if extrinsics is None:
                raise InputError(f"{name}: none of its samples could be used to calibrate; leave it out")
            found.append(extrinsics)
        elif is_bag(Path(given)):
            topics = (dvl_topic, gnss_topic, imu_topic)
            recording, discovery = discovered_in([Path(given)], topics, params, parameters)
            found.append(calibrated(recording, discovery.parameters, discovery.topics, name).extrinsics)
        else:
            found.append(load_extrinsics(Path(given), name))
    check_distinct(found)
    return run(found)


def _names(results: Sequence[StrPath | Calibration]) -> list[str]:
    """Return the names of files and bags without folders if they are unique, else their paths. Raises InputError."""
    paths = [list(each.bags) if isinstance(each, Calibration) else [path_of(each)] for each in results]
    short = [", ".join(path.name or str(path) for path in of_one) for of_one in paths]
    return short if len(set(short)) == len(short) else [", ".join(map(str, of_one)) for of_one in paths]


def fleet(
    places: Bags,
    out: StrPath,
    *,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    vehicle_from: str | None = None,
    jobs: int = 0,
    dask: str = "",
    **parameters: Any,
) -> Fleet:
    """Calibrate all recordings in the given places into a catalogue, as ``dvl-calib fleet``.

    Parameters
    ----------
    places
        Folders, files, or URLs that fsspec opens, such as ``s3://bucket/dives``; one or several.
    out
        Folder of the catalogue; its unchanged recordings are skipped.
    dvl_topic, gnss_topic, imu_topic
        See `replay`; for all recordings.
    params
        See `replay`.
    vehicle_from
        Regular expression whose first group in a recording's path is the vehicle; by default the first folder below a
        place.
    jobs
        Number of processes; 0: one per core, 1: no other process.
    dask
        Address of a Dask scheduler to use instead.
    **parameters
        See `replay`.

    Returns
    -------
    Fleet
        ``vehicles`` with the moves of each mounting, ``persons``: the recordings that need a person's decision; ``out``
        has ``rows/*.parquet`` and ``index.html``.

    Raises
    ------
    InputError, ParameterError
        For a place without recordings, a catalogue that cannot be written, and a missing pyarrow. A faulty recording
        raises nothing: its row has the error.
    """
    from ..fleet_catalogue.update import run_fleet
    from ..parallel import Workers
    from ..present.page import write_report

    merged, names = parameters_from(params, parameters)
    places_as_text = [str(each) for each in ([places] if isinstance(places, str | os.PathLike) else places)]
    given = Given(dvl_topic, gnss_topic, imu_topic, names)
    found = run_fleet(places_as_text, path_of(out), merged, given, Workers(jobs, dask), vehicle_from)
    write_report(found.page, found)
    return found


def doctor(
    bags: Bags,
    *,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    **parameters: Any,
) -> Examination:
    """Examine recordings for content, faults and fitness for calibration, as ``dvl-calib doctor``.

    Parameters
    ----------
    bags
        See `replay`.
    dvl_topic, gnss_topic, imu_topic
        See `replay`.
    params
        See `replay`.
    **parameters
        See `replay`.

    Returns
    -------
    Examination
        ``verdict``: yes, partly or no; ``findings``; ``shown``: what the motion makes observable, with expected σ.

    Raises
    ------
    InputError, ParameterError
        See `replay`.
    """
    merged, names = parameters_from(params, parameters)
    return examine(as_paths(bags), merged, Given(dvl_topic, gnss_topic, imu_topic, names))
