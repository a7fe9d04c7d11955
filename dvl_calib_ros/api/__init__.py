"""What a command does a function does; it gives a dataclass.

    import dvl_calib_ros as dc
    run = dc.replay("my_bag")
    run.mounting
    run.plot()

Angles are in degrees and lengths in metres where a name says so, else SI. Wrong files, topics and values are
`InputError`, wrong parameters `ParameterError`: one sentence each, with the remedy. (Long, because it is a table of
functions with their documentation.)
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace as with_values
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration.models import BY_VELOCITY
from ..calibration.models.parameter_spec import ParameterError
from ..calibration.models.parameters import Parameters
from ..diagnosis.answer.results import Diagnosis
from ..discovery.discover import Discovery, Given, discover
from ..errors import InputError
from ..examination.examine import Examination
from ..recordings.recording import Recording, open_recording
from ..simulation.scenario import Scenario
from ..verdict.answering import Answering
from .calibrated import Calibration, Mounting
from .output import framed, printed

if TYPE_CHECKING:
    from ..bags.recover import Recovered
    from ..bags.writer import Compression, Storage
    from ..calibration.comparison.mounting_change import Comparison
    from ..evaluation.cross_check import CrossCheck
    from ..evaluation.results import Evaluation
    from ..files.apply import Applied
    from ..fleet_catalogue.update import Fleet
    from ..instruments.settings import InstrumentSettings
    from ..logs.trajectories import Imported
    from ..simulator_export.writer import Export
    from ..unpaired.results import UnpairedComparison
    from ..unpaired.simulator_rounds import ClosedGap

__all__ = [
    "Calibration",
    "InputError",
    "Mounting",
    "ParameterError",
    "Parameters",
    "Scenario",
    "apply",
    "compare",
    "diagnose",
    "doctor",
    "evaluate",
    "export",
    "fleet",
    "import_files",
    "instrument_settings",
    "replay",
    "report",
    "salvage",
    "simulate",
]
Answering.laid_out = printed
Answering.framed = framed
StrPath = str | os.PathLike[str]
Bags = StrPath | Sequence[StrPath]


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
    """Calibrate with recorded bags, as ``dvl-calib replay`` does.

    Parameters
    ----------
    bags
        A rosbag2 folder, a .mcap or .db3 file, or several of them, which are read as one.
    dvl_topic, gnss_topic, imu_topic
        Topics; found by type, name and content where not named. gnss_topic, imu_topic: "none" does without.
    params
        A ROS 2 parameter file.
    history
        Keep the run over time, for `Calibration.plot`, `to_pandas` and `report`.
    merge
        Take several bags together even if the mounting moved between them.
    **parameters
        Any of the node's parameters, in SI units, such as ``mounting_rpy=(0, 0, 0.785)``.

    Returns
    -------
    Calibration
        ``mounting`` with σ, ``verdict`` with its reasons, and `Calibration.correct`, ``save``, ``plot``, ``report``.

    Raises
    ------
    InputError, ParameterError
        For what is no bag, has no DVL, or cannot be a parameter.

    References
    ----------
    The models M1 to M7 are those of Yampolsky and Klein, Information-Aided DVL Calibration; see the page Models.
    """
    from ..bag_replay.checked_replay import checked_replay

    paths = _paths(bags)
    recording, discovery = _discovered(paths, (dvl_topic, gnss_topic, imu_topic), params, parameters)
    replayed = checked_replay(
        recording,
        discovery.parameters,
        discovery.topics,
        merge=merge,
        with_history=history,
        mounting_is_guessed=bool(discovery.mounting_because),
    )
    return Calibration(replayed, discovery.with_mounting(replayed.result.parameters["mounting_rpy"]), tuple(paths))


def compare(
    *results: StrPath | Calibration,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    **parameters: Any,
) -> Comparison:
    """Compare calibrations of one DVL, as ``dvl-calib compare``: has the mounting moved?

    Parameters
    ----------
    *results
        Result files, bags, or what `replay` gave; two or more. A bag is calibrated first.
    dvl_topic, gnss_topic, imu_topic
        Of bags, as of `replay`.
    params
        Of bags, as of `replay`.
    **parameters
        Of bags, as of `replay`.

    Returns
    -------
    Comparison
        ``word``: same, suspicious or moved, and all behind it; `calibration.comparison_words` has its `reasons`.

    Raises
    ------
    InputError
        For what is no result file, holds no sample, is one of the others, or has nothing in common with them.
    """
    from ..bag_replay.checked_replay import calibrated
    from ..bag_replay.replay import extrinsics_of_replay
    from ..bags.files import is_bag
    from ..calibration.comparison.mounting_change import check_distinct
    from ..calibration.comparison.mounting_change import compare as run
    from ..files.mounting import load_extrinsics

    found = []
    for given in results:
        if isinstance(given, Calibration):
            name = ", ".join(map(str, given.bags))
            extrinsics = extrinsics_of_replay(given.replayed, name)
            if extrinsics is None:
                raise InputError(f"{name}: no sample of it could be used to calibrate; leave it out")
            found.append(extrinsics)
        elif is_bag(Path(given)):
            topics = (dvl_topic, gnss_topic, imu_topic)
            recording, discovery = _discovered([Path(given)], topics, params, parameters)
            found.append(calibrated(recording, discovery.parameters, discovery.topics, str(given)).extrinsics)
        else:
            found.append(load_extrinsics(Path(given), str(given)))
    check_distinct(found)
    return run(found)


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
    """Calibrate all recordings below some places into a catalogue, as ``dvl-calib fleet``.

    Parameters
    ----------
    places
        Folders, files, or URLs that fsspec opens, such as ``s3://bucket/dives``; one or several.
    out
        Folder of the catalogue; what is done there and unchanged is not done again.
    dvl_topic, gnss_topic, imu_topic
        As of `replay`, for all recordings.
    params
        As of `replay`.
    vehicle_from
        A regular expression whose first group in a recording's path is the vehicle; by default the first folder below
        a place.
    jobs
        Processes; 0: one per core, 1: this one.
    dask
        Address of a Dask scheduler to work on instead.
    **parameters
        As of `replay`.

    Returns
    -------
    Fleet
        ``vehicles`` with where each mounting moved, ``persons``: the recordings that need one; ``out`` has
        ``rows/*.parquet`` and ``index.html``.

    Raises
    ------
    InputError, ParameterError
        For a place that is none or holds no recording, for a catalogue that cannot be written, and without pyarrow.
        What is wrong with a recording is its row.
    """
    from ..fleet_catalogue.update import run_fleet
    from ..parallel import Workers
    from ..present.page import write_report

    merged, names = _parameters(params, parameters)
    asked = [str(each) for each in ([places] if isinstance(places, str | os.PathLike) else places)]
    given = Given(dvl_topic, gnss_topic, imu_topic, names)
    found = run_fleet(asked, Path(out), merged, given, Workers(jobs, dask), vehicle_from)
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
    """Say what is in recordings, what is wrong with them, and whether they can calibrate, as ``dvl-calib doctor``.

    Parameters
    ----------
    bags
        As of `replay`.
    dvl_topic, gnss_topic, imu_topic
        As of `replay`.
    params
        As of `replay`.
    **parameters
        As of `replay`.

    Returns
    -------
    Examination
        ``verdict``: yes, partly or no; ``findings``, and what the motion ``shown`` is good for, with σ to expect.

    Raises
    ------
    InputError, ParameterError
        As `replay`.
    """
    from ..examination.examine import examine

    merged, names = _parameters(params, parameters)
    return examine(_paths(bags), merged, Given(dvl_topic, gnss_topic, imu_topic, names))


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
    """Find what a simulation lacks beside recorded bags of one vehicle, as ``dvl-calib diagnose``.

    Parameters
    ----------
    bags
        As of `replay`.
    simulator
        Bags of a simulator, from any motion, with its true velocity: what its DVL lacks is then said instead.
    rounds
        With simulator: so many times at most its DVL is put right, simulated on its motion and compared again, 1 .. 9.
    keep
        With rounds: a folder, which must not exist, that keeps each round's DVL (round_1.json, for `export`) and bag.
    dvl_topic, gnss_topic, imu_topic
        As of `replay`.
    params
        As of `replay`.
    **parameters
        As of `replay`.

    Returns
    -------
    Diagnosis, UnpairedComparison or ClosedGap
        ``verdict``, ``effects`` with 95 % intervals, ``noise``, and what could not be told. The second with simulator;
        the third, with rounds, has one for each of its ``rounds`` and says which is ``best``.

    Raises
    ------
    InputError, ParameterError
        As `replay`.
    """
    topics = (dvl_topic, gnss_topic, imu_topic)
    sides = [
        _discovered(_paths(each), topics, params, {"min_speed": 0.0} | parameters)
        for each in ([bags] if simulator is None else [bags, simulator])
    ]
    if simulator is not None:
        from ..unpaired.both_sides import RecordedSide
        from ..unpaired.simulator_rounds import against

        real, made = (RecordedSide(recording, found.parameters, found.topics) for recording, found in sides)
        return against(real, made, rounds, None if keep is None else Path(keep))
    if rounds is not None or keep is not None:
        raise InputError("rounds, keep: only with simulator")
    from ..diagnosis.diagnose import diagnose as run

    ((recording, discovery),) = sides
    return run(recording, discovery.diagnosed, discovery.topics)


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
        What to simulate; by default ten minutes along a box.
    effects
        By name, each with its parameters, such as ``{"lever_arm": {"x_m": 0.5}}``.
    **scenario_fields
        Fields of `Scenario` instead, such as ``seconds=120.0, trajectory="free"``.

    Returns
    -------
    Path
        The bag.

    Raises
    ------
    InputError
        If the bag exists, or cannot be written; for an effect or parameter that there is not.
    """
    from ..bags.writer import Compression, Storage
    from ..simulation.injection import injection_of
    from ..simulation.scenario import write_bag

    if scenario is not None and scenario_fields:
        raise InputError("simulate: give a scenario or fields of one, not both")
    target, made = Path(bag), scenario or Scenario(**scenario_fields)
    if effects is not None:
        if not isinstance(effects, Mapping):
            raise InputError("simulate: effects are by name, such as {'lever_arm': {'x_m': 0.5}}")
        made = with_values(made, effects=tuple(injection_of(name, given) for name, given in effects.items()))
    write_bag(made, target, Storage.MCAP, Compression.NONE, with_truth=True)
    return target


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
        A folder of trajectories for the published procedure, None for the project's own trajectories, or two bags and
        more, of which each calibrates and all others verify.
    models
        Names; all by default.
    dvl_topic, gnss_topic, imu_topic
        Of bags; those of `dvl-calib simulate` where not named.
    **parameters
        Any of the node's parameters, in SI units.

    Returns
    -------
    Evaluation or CrossCheck
        Velocity errors by model and set of trajectories; of bags, by the bag that calibrated and the one that verified.

    Raises
    ------
    InputError, ParameterError
        For trajectories or bags that cannot be read, and for a model or parameter that there is not.

    References
    ----------
    Avg.VRMSE and the procedure are those of Yampolsky and Klein; see the page Evaluation.
    """
    from ..evaluation.cross_check import cross_check
    from ..evaluation.validation_study import DEFAULTS, EVALUATED
    from ..evaluation.validation_study import evaluate as run
    from ..parallel import Workers
    from ..recordings.topics import Topics

    found = [] if paths is None else _paths(paths)
    named = {"dvl": dvl_topic, "gnss": gnss_topic, "imu": imu_topic}
    topics = Topics(**{stream: topic for stream, topic in named.items() if topic is not None})
    known = BY_VELOCITY if len(found) > 1 else EVALUATED
    names = known if models is None else tuple(models)
    for name in names:
        if name not in known:
            raise InputError(f"models: {name!r} is none of {', '.join(known)}")
    if len(found) > 1:
        return cross_check(found, Parameters.from_mapping(parameters), names, topics, Workers())
    return run(found[0] if found else None, Parameters.from_mapping({**DEFAULTS, **parameters}), models=names)


def salvage(bags: Bags, output: StrPath, *, storage: str = "mcap", compression: str = "none") -> Recovered:
    """Write all that can be read of damaged recordings into a new bag, as ``dvl-calib salvage``.

    Parameters
    ----------
    bags
        As of `replay`.
    output
        Folder to write; must not exist.
    storage, compression
        mcap or sqlite3; none, chunk (MCAP's own), message or file.

    Returns
    -------
    Recovered
        ``counts`` of messages by topic, and ``notes`` of what was lost.

    Raises
    ------
    InputError
        For what is no bag or holds no message, and if the new one cannot be written.
    """
    from ..bags.recover import recover

    return recover(_paths(bags), Path(output), *_form(storage, compression))


def import_files(
    dvl: StrPath,
    output: StrPath,
    *,
    gnss: StrPath | None = None,
    attitude: StrPath | None = None,
    frame: str = "frd",
    gnss_frame: str = "frd",
    dvl_std: float = 0.0,
    gnss_std: float = 0.0,
    start: float = 1_600_000_000.0,
    storage: str = "mcap",
    compression: str = "none",
) -> dict[Path, Imported]:
    """Turn trajectories (CSV, NPY) or the log of a DVL into a bag, as ``dvl-calib import``.

    Parameters
    ----------
    dvl
        A file of time and velocity (m/s), a log of the DVL, or a folder of recordings.
    output
        Bag to write; for a folder the folder of bags.
    gnss, attitude
        Files of the reference's velocity, and of roll, pitch, yaw or heading.
    frame, gnss_frame
        Of the velocities: frd or flu; of the reference also enu or ned.
    dvl_std, gnss_std
        Standard deviations to write as covariance, m/s; 0: none.
    start
        Stamp of time 0, s since 1970.
    storage, compression
        As of `salvage`.

    Returns
    -------
    dict
        Of each bag written: ``counts`` of messages by topic, and ``notes`` of what was left out.

    Raises
    ------
    InputError
        Naming file and row; then nothing is written.
    """
    from ..logs.trajectories import ImportOptions
    from ..logs.trajectories import import_files as run

    options = ImportOptions(frame, gnss_frame, dvl_std, gnss_std, start, *_form(storage, compression))
    return run(Path(dvl), _path(gnss), _path(attitude), Path(output), options)


def apply(
    result: StrPath,
    *,
    urdf: StrPath | None = None,
    joint: str | None = None,
    output: StrPath | None = None,
    keep_position: bool = False,
    params: StrPath | None = None,
    launch: StrPath | None = None,
    fusion: StrPath | None = None,
    force: bool = False,
    dry_run: bool = False,
) -> Applied:
    """Write a saved calibration into the files that a vehicle is configured by, as ``dvl-calib apply``.

    All are written or none; the one before is kept beside each.

    Parameters
    ----------
    result
        Result file, as `Calibration.save` writes it.
    urdf
        URDF whose joint of the DVL is turned and moved.
    joint
        Name of that joint, where the DVL's frame does not tell.
    output
        URDF to write instead.
    keep_position
        Leave the joint's position as it is.
    params, launch, fusion
        Parameter file of the node, launch file with a static transform, parameters of robot_localization.
    force
        Also what is rejected, not converged, or of another mounting.
    dry_run
        Write nothing; ``changes`` is what would change.

    Returns
    -------
    Applied
        Files ``written`` and ``unchanged``, where the one before is (``kept``), and ``notes``.

    Raises
    ------
    InputError
        For what is no result file, must not be applied, or cannot be written.
    """
    from ..files.apply import Targets, write_calibration
    from ..files.mounting import load_calibrated_mounting

    targets = Targets(_path(urdf), _path(output), joint, keep_position, _path(params), _path(launch), _path(fusion))
    return write_calibration(load_calibrated_mounting(Path(result)), targets, force, dry_run)


def instrument_settings(
    result: StrPath, instrument: str, now: Mapping[str, float] | None = None, *, force: bool = False
) -> InstrumentSettings:
    """What to set in the instrument itself for its data to come out corrected, as ``dvl-calib apply --instrument``.

    Parameters
    ----------
    result
        Result file, as `Calibration.save` writes it.
    instrument
        ``"waterlinked"``, ``"cerulean"`` or ``"ardupilot"``.
    now
        What it was set to when the data were recorded, by the setting's name; else as it is delivered.
    force
        Also of a calibration that is rejected or not converged.

    Returns
    -------
    InstrumentSettings
        Each setting with old and new value, the ``text`` to type or load, the ``document`` that it follows, and in
        ``notes`` what the instrument cannot be told.

    Raises
    ------
    InputError
        For another instrument or setting, what it cannot be set to, or what must not be applied.
    """
    from ..files.mounting import load_calibrated_mounting
    from ..instruments.settings import instrument_settings as settings_of

    return settings_of(load_calibrated_mounting(Path(result)), instrument, now, force)


def export(simulator: str, source: StrPath, output: StrPath) -> Export:
    """Write what was found of a DVL as the settings of another simulator, as ``dvl-calib export``.

    Parameters
    ----------
    simulator
        Such as ``"gazebo"``.
    source
        What ``report(diagnosis, "found.json")`` wrote; or a result or parameter file.
    output
        File to write; what the simulator cannot represent is beside it, as FILE.missing.json.

    Returns
    -------
    Export
        ``settings``, and what is ``missing`` in the simulator with the error that it makes.

    Raises
    ------
    InputError
        For another simulator, a source that is none of these, or a file that cannot be written.
    """
    from ..simulator_export.registry import write_settings

    return write_settings(simulator, Path(source), Path(output))


def report(
    result: Calibration | Comparison | Examination | Diagnosis | UnpairedComparison | Evaluation | CrossCheck,
    path: StrPath,
) -> Path:
    """Write a result as a page (HTML), or with all its figures as JSON where the path ends in .json.

    They are what ``--report`` and ``--json`` of the commands write.

    Parameters
    ----------
    result
        What a function of this module returned.
    path
        File to write: .html, .json, and of a `Comparison` .png as well.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If the file cannot be written, or a page needs what was not kept or is not installed.
    """
    from .output import write

    target = Path(path)
    write(result, target)
    return target


def _path(given: StrPath | None) -> Path | None:
    return None if given is None else Path(given)


def _form(storage: str, compression: str) -> tuple[Storage, Compression]:
    """Of a bag to write. Raises InputError."""
    from ..bags.writer import Compression, Storage

    try:
        return Storage(storage), Compression(compression)
    except ValueError as error:
        known = (", ".join(each.value for each in kind) for kind in (Storage, Compression))
        raise InputError("{}; storage is one of {}; compression of {}".format(error, *known)) from None


def _paths(bags: Bags) -> list[Path]:
    found = [Path(bags)] if isinstance(bags, str | os.PathLike) else [Path(bag) for bag in bags]
    if not found:
        raise InputError("no bag is named; name one at least")
    return found


def _parameters(params: StrPath | None, given: Mapping[str, Any]) -> tuple[Parameters, frozenset[str]]:
    """Parameters of a file and of a call, and the names that either sets."""
    from ..files.parameter_files import given_parameters, load_parameters

    path = None if params is None else Path(params)
    return load_parameters(path).replace(**given), given_parameters(path) | frozenset(given)


def _discovered(
    paths: list[Path],
    topics: tuple[str | None, str | None, str | None],
    params: StrPath | None,
    given: Mapping[str, Any],
) -> tuple[Recording, Discovery]:
    parameters, names = _parameters(params, given)
    dvl, gnss, imu = topics
    recording = open_recording(paths, None, parameters)
    return recording, discover(recording, parameters, Given(dvl, gnss, imu, names))
