"""The result of a calibration as a YAML file: never torn when written, never believed blindly when read."""

from __future__ import annotations

import errno
import math
import os
import shlex
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .. import __version__
from ..calibration.frames import FLU_FROM_FRD, quaternion_from_rotation, rotation_from_rpy, rpy_from_rotation
from ..calibration.kalman import GaussianState
from ..calibration.models import MODELS
from ..calibration.parameters import FLU, FRD
from ..calibration.results import Estimate, Result
from ..calibration.verification import verification_document
from ..errors import InputError, printable
from .yaml_files import load_yaml

FORMAT = "dvl_calib_ros result 1"


def estimate_document(estimate: Estimate) -> dict[str, Any]:
    """One model's estimate as plain data; full precision, in the order of the state."""
    return {
        "state_names": list(estimate.state_names),
        "state": estimate.state.tolist(),
        "covariance": estimate.covariance.tolist(),
        "used": estimate.used,
        "gated": estimate.gated,
        "convergence": estimate.convergence.value,
    }


def result_document(result: Result, dvl_frame: str = "dvl_link", turned: bool = False) -> dict[str, Any]:
    """A result as plain data for the result file.

    turned: the driver's data are forward-right-down and were turned. The mounting is that of the forward-left-up axes,
    as mounting_rpy is; the transform is that of dvl_frame itself, for those who use the driver's data as they come.
    """
    estimate = result.estimate
    parameters = result.parameters
    nominal = rotation_from_rpy(parameters["mounting_rpy"])
    corrected = estimate.rotation_body_from_dvl(nominal.T)
    rpy, quaternion = rpy_from_rotation(corrected), quaternion_from_rotation(corrected)
    to_frame = quaternion_from_rotation(corrected @ FLU_FROM_FRD) if turned else quaternion
    verification = result.verifications.get(result.selected)
    parent, child = parameters["base_frame"], parameters["dvl_frame"] or dvl_frame
    return {
        "format": FORMAT,
        "software": f"dvl_calib_ros {__version__}",
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "model": result.selected,
        **estimate_document(estimate),
        "std": _std_in_words(estimate),
        **({} if verification is None else {"verification": verification_document(verification)}),
        "time_span": {"first_ns": result.first_ns, "last_ns": result.last_ns},
        "selected": [{"from_ns": segment.from_ns, "model": segment.model} for segment in result.segments],
        "mounting": {
            "nominal_rpy": list(parameters["mounting_rpy"]),
            "corrected_rpy": rpy.tolist(),
            "corrected_quaternion_xyzw": list(quaternion),
            "scale_error_xyz": estimate.scale.tolist(),
            "dvl_data_axes": FRD if turned else FLU,
            "frame_id": parent,
            "child_frame_id": child,
            "static_transform_publisher": _static_transform_publisher(parameters["lever_arm"], to_frame, parent, child),
        },
        "models": {name: estimate_document(each) for name, each in result.estimates.items()},
        "counts": {name: dict(counts) for name, counts in result.counts.items()},
        "parameters": dict(parameters),
    }


def _std_in_words(estimate: Estimate) -> dict[str, str]:
    units = {"phi": (math.degrees(1.0), "deg"), "delta": (100.0, "%")}
    known = {each.name: (1.0, each.unit) for each in MODELS[estimate.model].nuisance}
    words = {}
    for name, std in zip(estimate.state_names, estimate.std.tolist(), strict=True):
        factor, unit = known.get(name) or units[name.partition("_")[0]]
        words[name] = f"{factor * std:.4f} {unit}".rstrip()
    return words


def _static_transform_publisher(position: Any, quaternion: Any, parent: str, child: str) -> str:
    return (
        f"ros2 run tf2_ros static_transform_publisher {static_transform_arguments(position, quaternion, parent, child)}"
    )


def static_transform_arguments(position: Any, quaternion: Any, parent: str, child: str) -> str:
    """Arguments of tf2's static_transform_publisher: position (3,) m and quaternion (x, y, z, w) of child in parent."""
    numbers = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*position, *quaternion), strict=True)
    arguments = " ".join(f"--{name} {value:.9g}" for name, value in numbers)
    parent, child = (shlex.quote(printable(name)) for name in (parent, child))  # a bag may name any frame
    frames = f"--frame-id {parent} --child-frame-id {child}"
    return f"{arguments} {frames}"


def result_text(document: Mapping[str, Any]) -> str:
    """A result document as YAML."""
    return yaml.safe_dump(dict(document), sort_keys=False, default_flow_style=None, width=120)


def check_in_folder(path: Path, folder: Path) -> None:
    """Raise InputError unless a result file is a .yaml file in this folder.

    For what is named at run time: whoever can set a parameter must not be able to write wherever the node can.
    """
    if path.suffix != ".yaml" or Path(os.path.realpath(path)).parent != Path(os.path.realpath(folder)):
        raise InputError(f"{path}: at run time only a .yaml file in {folder} can be named; name others at the start")


def check_writable(path: Path) -> None:
    """Raise InputError if a result file could not be written there, before anything is collected for it."""
    folder = _target(path).parent
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it, such as {path / 'calibration.yaml'}")
    if not folder.is_dir():
        raise InputError(f"{path}: the folder {folder} does not exist; create it or name another")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{path}: the folder {folder} is not writable ({error.strerror}); name another") from error


def save_text(path: Path, text: str) -> None:
    """Write a text as `save_bytes` does."""
    save_bytes(path, text.encode())


def save_bytes(path: Path, content: bytes) -> None:
    """Write a file so that it is always the old or the new one, whole; the old one is kept as ``.bak``.

    Raises InputError; then the old file is untouched.
    """
    target = _target(path)
    temporary = backup = ""
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=".dvl_calib.", suffix=".tmp")
        with os.fdopen(handle, "wb") as file:
            os.fchmod(file.fileno(), 0o644)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            backup = _second_name(target, f"{temporary}.bak")
        os.replace(temporary, target)
        temporary = ""
        if backup:
            os.replace(backup, backup_of(target))
            backup = ""
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "free some space, or name a file on another disk" if full else "name another place"
        raise InputError(f"{path}: could not be written ({error.strerror}); {remedy}") from error
    finally:
        for left in filter(None, (temporary, backup)):
            with suppress(OSError):
                os.unlink(left)
    with suppress(OSError):  # the file is there; not every file system can sync a folder
        _sync_folder(target.parent)


def backup_of(path: Path) -> Path:
    """Where the file is that `save_bytes` last replaced; beside what a link points to."""
    target = Path(os.path.realpath(path))
    return target.with_name(f"{target.name}.bak")


def _target(path: Path) -> Path:
    """Where a file is written: a link stays a link. One that another user has laid there raises InputError."""
    if path.is_symlink() and path.lstat().st_uid not in (0, os.geteuid()):
        raise InputError(f"{path}: is a link that another user has made; name another file")
    return Path(os.path.realpath(path))


def _second_name(path: Path, name: str) -> str:
    """Make the file known under this name, too."""
    try:
        os.link(path, name)
    except OSError:  # a file system without hard links
        shutil.copy2(path, name)
    return name


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def load_initial_calibration(path: Path, mounting_rpy: Sequence[float] | None = None) -> dict[str, GaussianState]:
    """States and covariances of a result file, by model name. Raises InputError naming what is wrong in it.

    mounting_rpy: the nominal mounting to go on with. The file's angles are relative to its own, which must be that.
    """
    content, known = load_result(path)
    _check_mounting(path, content, mounting_rpy)
    return known


def load_result(path: Path) -> tuple[dict[str, Any], dict[str, GaussianState]]:
    """A result file's document, and its states and covariances by model name. Raises InputError."""
    content = load_yaml(path, "result file")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: not a result file of this software (no 'format: {FORMAT}')")
    models = content.get("models")
    if not isinstance(models, dict) or not models:
        raise InputError(f"{path}: damaged, it holds no models")
    if "parameters" not in content:  # the last that is written
        raise InputError(f"{path}: damaged, its end is missing")
    known = {
        name: _gaussian(f"{path}: models: {name}", name, saved) for name, saved in models.items() if name in MODELS
    }
    if not known:
        raise InputError(f"{path}: none of its models {', '.join(map(str, models))} is one of {', '.join(MODELS)}")
    return content, known


def _check_mounting(path: Path, content: Mapping[str, Any], mounting_rpy: Sequence[float] | None) -> None:
    if mounting_rpy is None:
        return
    try:
        saved = [float(angle) for angle in content["mounting"]["nominal_rpy"]]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: damaged, it holds no mounting: nominal_rpy") from error
    if len(saved) != 3 or not np.allclose(saved, mounting_rpy, rtol=0.0, atol=1e-9):
        raise InputError(
            f"{path}: its angles are relative to mounting_rpy {saved}, but mounting_rpy is {list(mounting_rpy)}; set "
            "the same, or start without initial_calibration"
        )


def _gaussian(where: str, name: str, saved: Any) -> GaussianState:
    model = MODELS[name]
    try:
        x = np.array(saved["state"], dtype=float)
        p = np.array(saved["covariance"], dtype=float)
        names = tuple(saved["state_names"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: damaged ({type(error).__name__}: {error})") from error
    if names != model.state_names or x.shape != (model.n_state,) or p.shape != (model.n_state, model.n_state):
        raise InputError(f"{where}: states {names} are not those of the model, {model.state_names}")
    if not np.isfinite(x).all() or not np.isfinite(p).all() or not np.allclose(p, p.T, rtol=1e-9, atol=0.0):
        raise InputError(f"{where}: state or covariance is not finite, or the covariance not symmetric")
    if np.linalg.eigvalsh(p)[0] <= 0.0:
        raise InputError(f"{where}: covariance is not positive definite")
    return GaussianState(x, p)
