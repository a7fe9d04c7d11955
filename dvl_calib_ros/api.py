"""The library's public interface: what the commands do, as functions that give dataclasses.

    import dvl_calib_ros as dc
    run = dc.replay("my_bag")
    run.mounting
    run.plot()

Angles in degrees and lengths in metres where a name says so, else SI. Errors of files, topics and values are
`InputError`, of parameters `ParameterError`, each one sentence with the remedy. (Long, because it is a table of
functions with their documentation.)
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .calibration.frames import Array, rpy_from_rotation
from .calibration.models import MODELS
from .calibration.mounting_pose import rpy_std
from .calibration.observability import scale_std_ahead
from .calibration.parameters import ParameterError, Parameters
from .diagnosis.results import Diagnosis
from .discovery.discover import Discovery, Given, discover
from .errors import InputError
from .examination.examine import Examination
from .recordings.recording import Recording, open_recording
from .replay.replay import Replayed
from .simulation.scenario import Scenario
from .verdict.reasons import Reason

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from .calibration.comparison import Comparison
    from .evaluation.bags import CrossCheck
    from .evaluation.results import Evaluation
    from .unpaired.results import UnpairedComparison

__all__ = [
    "Calibration",
    "InputError",
    "Mounting",
    "ParameterError",
    "Parameters",
    "Scenario",
    "compare",
    "diagnose",
    "doctor",
    "evaluate",
    "replay",
    "simulate",
]
StrPath = str | os.PathLike[str]
Bags = StrPath | Sequence[StrPath]


@dataclass(frozen=True)
class Mounting:
    """How the DVL is mounted, as it was calibrated.

    Parameters
    ----------
    rpy_deg
        Corrected roll, pitch, yaw of the DVL in the body, degrees, as in a URDF origin (fixed axes X, Y, Z).
    std_deg
        Their standard deviations (1σ), degrees.
    nominal_rpy_deg
        What the calibration began with.
    xyz_m, xyz_std_m
        Lever arm: position of the DVL from the reference point, body frame, m, as it was found, else as it was given;
        its standard deviations, nan where the model has no lever arm.
    position_m
        The DVL in the body, m; None where nothing says where the reference point is.
    time_offset_s, time_offset_std_s
        By how much the DVL's stamps are late, s, likewise; of several recordings in the last one (`Result.delays`).
    scale_percent, scale_std_percent
        How much too long a motion ahead is measured; nan where the model has no scale.
    base_frame, dvl_frame
        Names of the frames.
    """

    rpy_deg: tuple[float, float, float]
    std_deg: tuple[float, float, float]
    nominal_rpy_deg: tuple[float, float, float]
    xyz_m: tuple[float, float, float]
    xyz_std_m: tuple[float, float, float]
    time_offset_s: float
    time_offset_std_s: float
    scale_percent: float
    scale_std_percent: float
    base_frame: str
    dvl_frame: str
    position_m: tuple[float, float, float] | None = None

    @property
    def urdf(self) -> str:
        """The origin of the DVL's joint, to paste into a URDF: of forward-left-up axes, as `mounting_rpy` is."""
        from .files.urdf import origin_tag

        return origin_tag(self.position_m, np.radians(self.rpy_deg))

    def __str__(self) -> str:
        angles = (
            f"{name} {angle:.2f}° ± {std:.2f}°"
            for name, angle, std in zip(("roll", "pitch", "yaw"), self.rpy_deg, self.std_deg, strict=True)
        )
        return f"{self.dvl_frame} in {self.base_frame}: {', '.join(angles)}"

    __repr__ = __str__


@dataclass(frozen=True)
class Calibration:
    """What a replay gives.

    Parameters
    ----------
    replayed
        All of it: every model's estimate, counts, verification, history.
    discovery
        What was found in the bags, and with which topics and parameters they were replayed.
    bags
        Where the bags are.
    """

    replayed: Replayed = field(repr=False)
    discovery: Discovery = field(repr=False)
    bags: tuple[Path, ...]

    def __repr__(self) -> str:
        return f"{self.verdict} ({self.model}): {self.mounting}"

    @property
    def model(self) -> str:
        """Name of the model that was selected."""
        return self.replayed.result.selected

    @property
    def verdict(self) -> str:
        """What the held-out data say: accept, marginal or reject."""
        return self.replayed.result.verifications[self.model].verdict.value

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why, in sentences, the decisive one first."""
        return self.replayed.result.verifications[self.model].reasons

    @property
    def found(self) -> tuple[str, ...]:
        """What was found in the bags, in sentences."""
        return self.discovery.found

    @property
    def findings(self) -> tuple[Reason, ...]:
        """What is wrong with the data, each with its code and remedy."""
        return self.replayed.findings

    @property
    def mounting(self) -> Mounting:
        """The corrected mounting with its standard deviations."""
        result = self.replayed.result
        estimate = result.estimate
        parameters = Parameters.from_mapping(result.parameters)
        rotation = parameters.rotation_dvl_from_body
        scale = scale_std_ahead(MODELS[estimate.model], estimate.covariance, parameters)
        arm_std = estimate.std_of("lever_arm_x", "lever_arm_y", "lever_arm_z")
        offset_std = estimate.std_of("time_offset")
        return Mounting(
            _triple(np.degrees(rpy_from_rotation(estimate.rotation_body_from_dvl(rotation)))),
            _triple(np.degrees(rpy_std(estimate.misalignment, estimate.covariance, parameters))),
            _triple(np.degrees(parameters.mounting_rpy)),
            _triple(estimate.lever_arm(parameters.lever_arm)),
            _triple(np.full(3, math.nan) if arm_std is None else arm_std),
            estimate.dvl_time_offset(parameters.dvl_time_offset),
            math.nan if offset_std is None else float(offset_std[0]),
            100.0 * float(rotation[:, 0] ** 2 @ estimate.scale) if len(scale) else math.nan,
            100.0 * float(scale[0]) if len(scale) else math.nan,
            parameters.base_frame,
            self.replayed.dvl_frame,
            result.position_in_body,
        )

    def correct(self, velocity_dvl: Array, angular_velocity: Array | None = None) -> Array:
        """Measured velocities (..., 3) m/s, forward-left-up axes of the DVL, to corrected ones in the body.

        With angular_velocity, (..., 3) rad/s in the body, they are those of the reference point, by the lever arm that
        was found; without, of the place where the DVL is. They are of ``mounting.time_offset_s`` before their stamps.
        """
        rotation = self.discovery.parameters.rotation_dvl_from_body
        velocity = self.replayed.result.estimate.corrected_velocity(np.asarray(velocity_dvl, dtype=float), rotation)
        if angular_velocity is None:
            return velocity
        return velocity - np.cross(np.asarray(angular_velocity, dtype=float), self.mounting.xyz_m)

    def to_pandas(self) -> pandas.DataFrame:
        """The selected model over time: time in s since the first DVL sample, states in SI with their σ as *_std.

        Raises InputError without pandas, or if the replay kept no history.
        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise InputError("to_pandas needs the Python package pandas; pip install pandas") from None
        history = self.replayed.history
        if history is None:
            raise InputError("this replay kept no history; replay with history=True")
        model, estimate = history.models[self.model], self.replayed.result.estimate
        first_ns = self.replayed.result.first_ns or 0
        columns: dict[str, Array] = {"time_s": 1e-9 * (history.stamps_ns - first_ns)}
        for index, name in enumerate(estimate.state_names):
            columns[name], columns[f"{name}_std"] = model.state[:, index], model.std[:, index]
        return pandas.DataFrame(columns)

    def plot(self) -> Figure:
        """The mounting over time with its ±1σ, and the velocity error before and after, as a matplotlib Figure."""
        from .report.calibration_figure import calibration_figure

        if self.replayed.history is None:
            raise InputError("this replay kept no history; replay with history=True")
        return calibration_figure(self.replayed)

    def save(self, path: StrPath) -> Path:
        """Write the result file (YAML), from which the node and `dvl-calib apply` go on. Raises InputError."""
        from .files.result_file import result_document, save_result

        target = Path(path)
        document = result_document(self.replayed.result, self.replayed.dvl_frame, self.replayed.turned)
        save_result(target, document, round(self.discovery.parameters.result_backups))
        return target

    def report(self, path: StrPath) -> Path:
        """Write the report (HTML) with pictures. Raises InputError."""
        from .report import write_replay_report

        target = Path(path)
        write_replay_report(target, self.replayed, self.bags, list(MODELS))
        return target


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

    Raises
    ------
    InputError, ParameterError
        For what is no bag, has no DVL, or cannot be a parameter.
    """
    from .replay.checked import checked_replay

    paths = _paths(bags)
    recording, discovery = _discovered(paths, (dvl_topic, gnss_topic, imu_topic), params, parameters)
    replayed = checked_replay(recording, discovery.parameters, discovery.topics, merge=merge, with_history=history)
    return Calibration(replayed, discovery, tuple(paths))


def compare(*results: StrPath | Calibration) -> Comparison:
    """Compare calibrations of one DVL, as ``dvl-calib compare``: has the mounting moved?

    Parameters
    ----------
    *results
        Result files, bags, or what `replay` gave; two or more. A bag is calibrated first.

    Returns
    -------
    Comparison
        ``word``: same, suspicious or moved, and all that is behind it; `calibration.comparison` has its `sentences`.

    Raises
    ------
    InputError
        For what is no result file, holds no sample, is one of the others, or has nothing in common with them.
    """
    from .bags.files import is_bag
    from .calibration.comparison import check_distinct
    from .calibration.comparison import compare as run
    from .files.extrinsics import load_extrinsics
    from .replay.replay import extrinsics_of_replay

    found = []
    for given in results:
        if not isinstance(given, Calibration) and not is_bag(Path(given)):
            found.append(load_extrinsics(Path(given), str(given)))
            continue
        each = given if isinstance(given, Calibration) else replay(given, history=False)
        name = ", ".join(map(str, each.bags))
        extrinsics = extrinsics_of_replay(each.replayed, name)
        if extrinsics is None:
            raise InputError(f"{name}: no sample of it could be used to calibrate; leave it out")
        found.append(extrinsics)
    check_distinct(found)
    return run(found)


def doctor(
    bags: Bags,
    *,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    **parameters: Any,
) -> Examination:
    """Say what is in recordings, what is wrong with them, and whether they can calibrate; arguments as `replay`."""
    from .examination.examine import examine

    merged, names = _parameters(params, parameters)
    return examine(_paths(bags), merged, Given(dvl_topic, gnss_topic, imu_topic, names))


def diagnose(
    bags: Bags,
    *,
    simulator: Bags | None = None,
    dvl_topic: str | None = None,
    gnss_topic: str | None = None,
    imu_topic: str | None = None,
    params: StrPath | None = None,
    **parameters: Any,
) -> Diagnosis | UnpairedComparison:
    """Find what a simulation lacks beside recorded bags of one vehicle, as ``dvl-calib diagnose``.

    Parameters
    ----------
    bags, dvl_topic, gnss_topic, imu_topic, params, **parameters
        As of `replay`.
    simulator
        Bags of a simulator, from any motion, with its true velocity: what its DVL lacks is then said instead.

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
        from .unpaired.compare import compare as against
        from .unpaired.logs import Source

        real, made = (Source(recording, found.parameters, found.topics) for recording, found in sides)
        return against(real, made)
    from .diagnosis.diagnose import diagnose as run

    ((recording, discovery),) = sides
    return run(recording, discovery.parameters, discovery.topics)


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

    Raises
    ------
    InputError
        If the bag exists, or cannot be written; for an effect or parameter that there is not.
    """
    from .bags.writer import Compression, Storage
    from .simulation.injection import injection_of
    from .simulation.scenario import write_bag

    if scenario is not None and scenario_fields:
        raise InputError("simulate: give a scenario or fields of one, not both")
    target, made = Path(bag), scenario or Scenario(**scenario_fields)
    if effects is not None:
        made = replace(made, effects=tuple(injection_of(name, given) for name, given in effects.items()))
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
    """
    from .evaluation.bags import cross_check
    from .evaluation.evaluate import DEFAULTS, EVALUATED
    from .evaluation.evaluate import evaluate as run
    from .parallel import Workers
    from .recordings.topics import Topics

    found = [] if paths is None else _paths(paths)
    named = {"dvl": dvl_topic, "gnss": gnss_topic, "imu": imu_topic}
    topics = Topics(**{stream: topic for stream, topic in named.items() if topic is not None})
    known = tuple(MODELS) if len(found) > 1 else EVALUATED
    names = known if models is None else tuple(models)
    for name in names:
        if name not in known:
            raise InputError(f"models: {name!r} is none of {', '.join(known)}")
    if len(found) > 1:
        return cross_check(found, Parameters.from_mapping(parameters), names, topics, Workers())
    return run(found[0] if found else None, Parameters.from_mapping({**DEFAULTS, **parameters}), models=names)


def _paths(bags: Bags) -> list[Path]:
    return [Path(bags)] if isinstance(bags, str | os.PathLike) else [Path(bag) for bag in bags]


def _parameters(params: StrPath | None, given: Mapping[str, Any]) -> tuple[Parameters, frozenset[str]]:
    """Parameters of a file and of a call, and the names that either sets."""
    from .files.parameter_files import given_parameters, load_parameters

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


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (values + 0.0).tolist()
    return x, y, z
