"""Calibrate with recordings: examine, replay, compare, fleets."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..discovery.discovery import Given
from ..errors import InputError
from ..examination.examine import Examination
from .arguments import Bags, StrPath, as_paths, discovered_in, parameters_from
from .calibrated import Calibration

if TYPE_CHECKING:
    from ..calibration.comparison.mounting_change import Comparison
    from ..fleet_catalogue.update import Fleet


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
    from ..examination.examine import judged_replay

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
    for each in results:
        if not isinstance(each, str | os.PathLike | Calibration):
            raise InputError(f"compare: {each!r}; expected result files, bags or return values of replay")
    paths = [list(each.bags) if isinstance(each, Calibration) else [Path(each)] for each in results]
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
    found = run_fleet(places_as_text, Path(out), merged, given, Workers(jobs, dask), vehicle_from)
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
    from ..examination.examine import examine

    merged, names = parameters_from(params, parameters)
    return examine(as_paths(bags), merged, Given(dvl_topic, gnss_topic, imu_topic, names))
