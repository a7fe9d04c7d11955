"""Recordings, results and settings in other forms: salvage, import, apply, export, report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..diagnosis.answer.results import Diagnosis
from ..examination.examine import Examination
from .arguments import Bags, StrPath, as_path, as_paths, storage_and_compression
from .calibrated import Calibration

if TYPE_CHECKING:
    from ..bags.recover import Recovered
    from ..calibration.comparison.mounting_change import Comparison
    from ..evaluation.cross_check import CrossCheck
    from ..evaluation.results import Evaluation
    from ..files.apply import Applied
    from ..instruments.settings import InstrumentSettings
    from ..logs.trajectories import Imported
    from ..simulator_export.writer import Export
    from ..unpaired.results import UnpairedComparison


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

    return recover(as_paths(bags), Path(output), *storage_and_compression(storage, compression))


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
    columns: str = "",
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
    columns
        Columns of the DVL's file, where it is a table of another layout: ``"time=t,vx=u,vy=v,vz=w,valid=lock"``.
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

    options = ImportOptions(
        frame, gnss_frame, dvl_std, gnss_std, start, columns, *storage_and_compression(storage, compression)
    )
    return run(Path(dvl), as_path(gnss), as_path(attitude), Path(output), options)


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

    targets = Targets(
        as_path(urdf), as_path(output), joint, keep_position, as_path(params), as_path(launch), as_path(fusion)
    )
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
    from .reports import write

    target = Path(path)
    write(result, target)
    return target
