"""Conversion of recordings, results and settings: salvage, import, apply, export, report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..calibration.comparison.mounting_change import Comparison
from ..diagnosis.answer.results import Diagnosis
from ..disk.text_files import write_json
from ..errors import InputError, needing_page
from ..examination.examine import Examination
from .analyse import Bags, StrPath, as_path, as_paths, path_of, storage_and_compression
from .calibrated import Calibration

if TYPE_CHECKING:
    from ..bags.writer import Recovered
    from ..evaluation.cross_check import CrossCheck
    from ..evaluation.results import Evaluation
    from ..files.mounting import Applied
    from ..instruments.settings import InstrumentSettings
    from ..logs.trajectories import Imported
    from ..simulator_export.simulators import Export
    from ..unpaired.results import UnpairedComparison


def salvage(bags: Bags, output: StrPath, *, storage: str = "mcap", compression: str = "none") -> Recovered:
    """Copy the readable messages of damaged recordings into a new bag, as ``dvl-calib salvage``.

    Parameters
    ----------
    bags
        See `replay`.
    output
        Folder to write; must not exist.
    storage, compression
        mcap or sqlite3; none, chunk (MCAP's own), message or file.

    Returns
    -------
    Recovered
        ``counts`` of messages by topic, and ``notes`` on the losses.

    Raises
    ------
    InputError
        For a path that is no bag or holds no message, and if the new bag cannot be written.
    """
    from ..bags.writer import recover

    return recover(as_paths(bags), path_of(output), *storage_and_compression(storage, compression))


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
        Files of the reference velocity, and of roll, pitch, yaw or heading.
    frame, gnss_frame
        Axes of the velocities: frd or flu; of the reference also enu or ned.
    dvl_std, gnss_std
        Standard deviations to write as covariance, m/s; 0: none.
    start
        Stamp of time 0, s since 1970.
    columns
        Columns of a DVL table with another layout: ``"time=t,vx=u,vy=v,vz=w,valid=lock"``.
    storage, compression
        See `salvage`.

    Returns
    -------
    dict
        Bag -> ``counts`` of messages by topic, and ``notes`` on omitted data.

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
    return run(path_of(dvl), as_path(gnss), as_path(attitude), path_of(output), options)


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
    """Write a saved calibration into a vehicle's configuration files, as ``dvl-calib apply``.

    Either all files are written or none; each previous file is kept next to the new one.

    Parameters
    ----------
    result
        Result file of `Calibration.save`.
    urdf
        URDF in which to rotate and move the DVL's joint.
    joint
        Name of that joint; by default found by the DVL's frame.
    output
        URDF to write instead.
    keep_position
        Keep the joint's position.
    params, launch, fusion
        Parameter file of the node, launch file with a static transform, parameters of robot_localization.
    force
        Also apply a calibration that is rejected, not converged, or found with another mounting.
    dry_run
        Write nothing; ``changes`` has the planned changes.

    Returns
    -------
    Applied
        Files ``written`` and ``unchanged``, paths of the previous ones (``kept``), and ``notes``.

    Raises
    ------
    InputError
        For a file that is no result, a calibration that must not be applied, or a file that cannot be written.
    """
    from ..files.mounting import Targets, load_calibrated_mounting, write_calibration

    targets = Targets(
        as_path(urdf), as_path(output), joint, keep_position, as_path(params), as_path(launch), as_path(fusion)
    )
    return write_calibration(load_calibrated_mounting(path_of(result)), targets, force, dry_run)


def instrument_settings(
    result: StrPath, instrument: str, now: Mapping[str, float] | None = None, *, force: bool = False
) -> InstrumentSettings:
    """Compute the instrument's own settings that correct its data, as ``dvl-calib apply --instrument``.

    Parameters
    ----------
    result
        Result file of `Calibration.save`.
    instrument
        ``"waterlinked"``, ``"cerulean"`` or ``"ardupilot"``.
    now
        Settings during the recording, by name; by default the factory settings.
    force
        Also for a calibration that is rejected or not converged.

    Returns
    -------
    InstrumentSettings
        Each setting with old and new value, the ``text`` to type or load, the vendor ``document`` that describes it,
        and in ``notes`` the corrections that the instrument has no setting for.

    Raises
    ------
    InputError
        For an unknown instrument or setting, a value out of range, or a calibration that must not be applied.
    """
    from ..files.mounting import load_calibrated_mounting
    from ..instruments.settings import instrument_settings as settings_of

    return settings_of(load_calibrated_mounting(path_of(result)), instrument, now, force)


def export(simulator: str, source: StrPath, output: StrPath) -> Export:
    """Write a diagnosed DVL as the settings of another simulator, as ``dvl-calib export``.

    Parameters
    ----------
    simulator
        Name, such as ``"gazebo"``.
    source
        A diagnosis as written by ``report(diagnosis, "found.json")``, or a result or parameter file.
    output
        File to write; FILE.missing.json next to it lists what the simulator cannot represent.

    Returns
    -------
    Export
        ``settings``, and the effects ``missing`` in the simulator with the resulting error.

    Raises
    ------
    InputError
        For an unknown simulator, another kind of source, or a file that cannot be written.
    """
    from ..simulator_export.simulators import write_settings

    return write_settings(simulator, path_of(source), path_of(output))


def report(
    result: Calibration | Comparison | Examination | Diagnosis | UnpairedComparison | Evaluation | CrossCheck,
    path: StrPath,
) -> Path:
    """Write a result as a page (HTML), or with all its numbers as JSON if the path ends in .json.

    The commands write the same files with ``--report`` and ``--json``.

    Parameters
    ----------
    result
        Return value of a function of this module.
    path
        File to write: .html, .json, and for a `Comparison` also .png.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If the file cannot be written, or the page needs a missing history or library.
    """
    from ..present.result_documents import PLAIN_DATA

    target, kind = path_of(path), type(result)
    if not isinstance(result, Calibration) and kind not in PLAIN_DATA:
        raise InputError(
            f"a {kind.__name__} is no result; give what replay, compare, doctor, diagnose or evaluate gave"
        )
    if target.suffix.lower() == ".json":
        write_json(target, result.document() if isinstance(result, Calibration) else PLAIN_DATA[kind](result))
    elif isinstance(result, Calibration):
        result.report(target)
    else:
        with needing_page(f"{target}: a page"):
            from ..present import page
        page.write_report(target, result)
    return target
