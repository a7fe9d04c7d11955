"""The result of a calibration as a YAML file, protected against replacement by a worse one and against damage."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..calibration.checks.speed_of_sound import Water, water_document
from ..calibration.comparison.mounting_change import MOVED
from ..calibration.filters.cross_validation import with_states_of
from ..calibration.filters.filter_setup import prior
from ..calibration.filters.observability import Convergence
from ..calibration.models import MODELS
from ..calibration.models.parameters import FLU, FRD, SCHEMA, Parameters
from ..calibration.numerics.frames import (
    FLU_FROM_FRD,
    Array,
    quaternion_from_rotation,
    rotation_from_rpy,
    rpy_from_rotation,
    turn_between,
)
from ..calibration.numerics.kalman import GaussianState
from ..calibration.numerics.tests import chi2_sf
from ..calibration.results.held_out_verification import verification_document
from ..calibration.results.mounting_quantities import LATE, Quantity, quantities
from ..calibration.results.results import (
    Estimate,
    Result,
    corrected_rpy,
    mounting_pose,
    position_in_body,
    scale_and_delay,
)
from ..disk.atomic import own_stream, save_bytes
from ..disk.text_files import load_yaml
from ..errors import InputError, printable
from ..verdict.kinds import Severity
from ..verdict.reasons import finding
from ..version import __version__
from .urdf import origin_tag

_ANY_FORMAT = "dvl_calib_ros result"
FORMAT = f"{_ANY_FORMAT} 1"
# last entry of a result file, announced at its start, to detect a truncated copy
_END = "complete"
_PUBLISHER = "ros2 run tf2_ros static_transform_publisher"


def estimate_document(estimate: Estimate) -> dict[str, Any]:
    """Return one model's estimate as plain data; full precision, in the order of the state."""
    return {
        "state_names": list(estimate.state_names),
        "state": estimate.state.tolist(),
        "covariance": estimate.covariance.tolist(),
        "covariance_of_recording": estimate.recording_covariance.tolist(),
        "covariance_of_filter": estimate.filter_covariance.tolist(),
        "by_dvl_bias": estimate.of_bias.columns.tolist(),
        "used": estimate.used,
        "gated": estimate.gated,
        "convergence": estimate.convergence.value,
    }


def result_document(
    result: Result, dvl_frame: str = "dvl_link", turned: bool = False, water: Water | None = None
) -> dict[str, Any]:
    """Return a result as plain data for the result file, the most important values first and the matrices last.

    water: its properties, if known. turned: the driver's data are forward-right-down and were converted. The mounting
    belongs to the forward-left-up axes, as mounting_rpy; the transform belongs to dvl_frame itself, for users of the
    driver's unconverted data.
    """
    estimate = result.estimate
    parameters = result.parameters
    nominal = rotation_from_rpy(parameters["mounting_rpy"])
    corrected = estimate.rotation_body_from_dvl(nominal.T)
    of_frame = corrected @ FLU_FROM_FRD if turned else corrected
    verification = result.verifications.get(result.selected)
    parent, child = parameters["base_frame"], parameters["dvl_frame"] or dvl_frame
    model, state = MODELS[estimate.model], GaussianState(estimate.state, estimate.covariance)
    checked = Parameters.from_mapping(parameters)
    position = position_in_body(model, state, checked)
    scale_delay = scale_and_delay(model, state, checked)
    arguments = None if position is None else static_transform_arguments(position, of_frame, parent, child)
    return {
        "format": FORMAT,
        "software": f"dvl_calib_ros {__version__}",
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "ends_with": _END,
        "model": result.selected,
        "used": estimate.used,
        "gated": estimate.gated,
        "convergence": estimate.convergence.value,
        "found": _Lines(_found_quantities(result)),
        "mounting": {
            "static_transform_publisher": None if arguments is None else f"{_PUBLISHER} {arguments}",
            "urdf_origin": origin_tag(position, rpy_from_rotation(of_frame)),
            "frame_id": parent,
            "child_frame_id": child,
            "dvl_data_axes": FRD if turned else FLU,
            "nominal_rpy": list(parameters["mounting_rpy"]),
            "corrected_rpy": corrected_rpy(estimate.misalignment, checked).tolist(),
            "corrected_quaternion_xyzw": list(quaternion_from_rotation(corrected)),
            "scale_error_xyz": estimate.scale.tolist(),
            "lever_arm": estimate.lever_arm(parameters["lever_arm"]).tolist(),
            "position": None if position is None else list(position),
            "scale_error_ahead": scale_delay.scale,
            "scale_error_ahead_std": scale_delay.scale_std,
            "dvl_time_offset": scale_delay.time_offset,
            "dvl_time_offset_std": scale_delay.time_offset_std,
            "pose_covariance": mounting_pose(model, state, checked, turned).covariance.tolist(),
        },
        **({} if verification is None else {"verification": verification_document(verification)}),
        **({"suggestion": result.suggestion.sentence} if result.suggestion else {}),
        **({"doubts": [doubt.as_dict() for doubt in result.doubts]} if result.doubts else {}),
        "time_span": {"first_ns": result.first_ns, "last_ns": result.last_ns},
        "selected": [{"from_ns": segment.from_ns, "model": segment.model} for segment in result.segments],
        **days_document(result),
        "counts": {name: dict(counts) for name, counts in result.counts.items()},
        **({} if water is None else {"water": water_document(water)}),
        "parameters": dict(parameters),
        "std": _std_in_words(estimate, estimate.std),
        "std_of_recording": _std_in_words(estimate, estimate.recording_std),
        "std_by_filter": _std_in_words(estimate, estimate.filter_std),
        "models": {name: estimate_document(estimate) for name, estimate in result.estimates.items()},
        _END: True,
    }


def days_document(result: Result) -> dict[str, Any]:
    """Return the values per day, in order, if there are several: the mounting has the delay of the last day."""
    if not result.own_days:
        return {}
    return {
        "days": [
            {
                "name": day.name,
                "first_ns": day.first_ns,
                "dvl_time_offset": day.dvl_time_offset,
                "dvl_time_offset_std": day.dvl_time_offset_std,
                "dvl_time_offset_shown": day.shown,
                "reference_velocity_offset": list(day.reference_offset),
                "reference_velocity_offset_std": list(day.reference_offset_std),
            }
            for day in result.own_days
        ]
    }


def _found_quantities(result: Result) -> dict[str, str]:
    """Return each quantity with its σ, and which configured values the model does not estimate."""
    found = {quantity.name: _in_words(quantity) for quantity in quantities(result)}
    configured = {"lever arm": result.parameters["lever_arm"], LATE: [result.parameters["dvl_time_offset"]]}
    for (name, values), unit in zip(configured.items(), ("m", "s"), strict=True):
        if not any(quantity.startswith(name) for quantity in found):
            found[name] = f"{' '.join(f'{value + 0.0:g}' for value in values)} {unit} as configured, not estimated"
    return found


def _in_words(quantity: Quantity) -> str:
    unit = quantity.unit.strip().replace("°", "deg")  # ASCII, because the node prints a result that it cannot save
    remark = "" if quantity.shown else " (not observable in this data)"
    return f"{quantity.value:.2f} +- {quantity.std:.2f} {unit}{remark}"


def _std_in_words(estimate: Estimate, stds: Array) -> dict[str, str]:
    """Return 1 σ of each state with its unit, by the state's name."""
    units = {"phi": (math.degrees(1.0), "deg"), "delta": (100.0, "%")}
    known = {spec.name: (1.0, spec.unit) for spec in MODELS[estimate.model].nuisance}
    words = {}
    for name, std in zip(estimate.state_names, stds.tolist(), strict=True):
        factor, unit = known.get(name) or units[name.partition("_")[0]]
        words[name] = f"{factor * std:.4f} {unit}".rstrip()
    return words


def static_transform_arguments(position: Any, rotation: Array, parent: str, child: str) -> str:
    """Return arguments of tf2's static_transform_publisher: position (3,) m and rotation (3, 3) of child in parent."""
    values = (*position, *quaternion_from_rotation(rotation))
    numbers = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True)
    arguments = " ".join(f"--{name} {value:.9g}" for name, value in numbers)
    parent, child = (shlex.quote(printable(name)) for name in (parent, child))  # a bag may have any frame name
    frames = f"--frame-id {parent} --child-frame-id {child}"
    return f"{arguments} {frames}"


class _Lines(dict[str, str]):
    """Mapping with one line per entry in YAML."""


# the same output, four times faster
_Base: Any = yaml.CSafeDumper if yaml.__with_libyaml__ else yaml.SafeDumper


class _Dumper(_Base):  # type: ignore[misc]  # its own, for the representer
    pass


_Dumper.add_representer(
    _Lines, lambda dumper, lines: dumper.represent_mapping("tag:yaml.org,2002:map", lines.items(), flow_style=False)
)


def result_text(document: Mapping[str, Any]) -> str:
    """Return a result document as YAML, with a quantity, a command or a row of a matrix on one line."""
    return str(yaml.dump(dict(document), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=1 << 20))


def check_in_folder(path: Path, folder: Path) -> None:
    """Raise InputError unless a result file is a .yaml file in this folder.

    This is for names set at run time: permission to set a parameter must not include writing to any file.
    """
    if path.suffix != ".yaml" or Path(os.path.realpath(path)).parent != Path(os.path.realpath(folder)):
        raise InputError(
            f"{path}: a running node accepts only a .yaml file in {folder}; name other files when it starts"
        )


def save_result(path: Path, document: Mapping[str, Any], n_backups: int = 1) -> None:
    """Write a result atomically, unless it is empty and the existing file is not.

    Parameters
    ----------
    path: The result file.
    document: From `result_document`.
    n_backups: Number of previous results to keep: the last one, and the best and newest of those before it. A result
        that
        was continued, for example by a save every minute, is replaced by its continuation.

    Raises
    ------
    KeptError: If no sample was used, and the existing file may have some.
    InputError: If it cannot be written.
    """
    # os.path.exists: save_bytes reports an unreadable place, such as a disk that has gone
    if not document["used"] and os.path.exists(path) and own_stream(path) is None:
        before = _ResultValue.of_file(path)
        if before is None or before.used:
            holds = "is no result file" if before is None else f"holds a result of {before.used} samples"
            raise KeptError(f"no sample was used, so there is nothing to save: {path}, which {holds}, is kept")
    save_bytes(path, result_text(document).encode(), partial(_backups_to_keep, _ResultValue.of(document), n_backups))


class KeptError(InputError):
    """The previous result is kept, because the newer one is empty or worse."""


def save_unless_worse(path: Path, document: Mapping[str, Any], n_backups: int = 1) -> None:
    """Write a result as `save_result`, or next to a better one of the same mounting. Raises KeptError then."""
    better = _better(path, document) if document["used"] and own_stream(path) is None else None
    if better is None:
        return save_result(path, document, n_backups)
    newer = path.with_name(f"{path.stem}.newer{path.suffix}")
    save_result(newer, document, n_backups)
    before, now = _quality_in_words(better), _quality_in_words(document)
    raise KeptError(str(finding("RESULT_WORSE", path=path, beside=newer, before=before, now=now)))


def _better(path: Path, document: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the result in a file if it is of the same mounting and better; None otherwise.

    Better means a better verdict or, for equal verdicts and consistent angles, a smaller σ in another run. If the DVL
    has moved, the older σ does not count.
    """
    try:
        before: Any = load_yaml(path, "result file")
        old_rank, new_rank = _QUALITIES.index(_quality(before)), _QUALITIES.index(_quality(document))
        old, new = before["mounting"], document["mounting"]
        p_old, p_new = _covariance_of_angles(old), _covariance_of_angles(new)
        old_rotation, new_rotation = rotation_from_rpy(old["corrected_rpy"]), rotation_from_rpy(new["corrected_rpy"])
        same = all(old[name] == new[name] for name in ("nominal_rpy", "frame_id", "child_frame_id"))
        continued = _ResultValue.of(before).continued_by(_ResultValue.of(document))
        both = np.flatnonzero((np.diag(p_old) > 0.0) & (np.diag(p_new) > 0.0))
        turn, p = turn_between(old_rotation, new_rotation)[both], (p_old + p_new)[np.ix_(both, both)]
        moved = bool(len(both)) and chi2_sf(float(turn @ np.linalg.solve(p, turn)), len(both)) < MOVED
    except (InputError, OSError, LookupError, TypeError, ValueError, OverflowError):
        return None  # no result file, or a damaged one
    if not same or old_rank < new_rank or not before["used"]:
        return None
    if old_rank > new_rank:
        return before
    return before if not continued and not moved and _angle_spread(p_new) > _angle_spread(p_old) else None


def _covariance_of_angles(mounting: Mapping[str, Any]) -> Array:
    return np.array(mounting["pose_covariance"], dtype=float)[3:, 3:]


def _angle_spread(covariance: Array) -> tuple[int, float]:
    """Return the number of angles that are not estimated, and the sum of variances (rad²) of the others."""
    variances = np.diag(covariance)
    return int((variances <= 0.0).sum()), float(variances[variances > 0.0].sum())


# from the least informative to the best
_QUALITIES = ("collecting", "reject", "not verified", "marginal", "accept")


def _quality(document: Mapping[str, Any]) -> str:
    """Return the verdict of a result; no observable angle and rejecting warnings take precedence."""
    if document["convergence"] == Convergence.COLLECTING.value:
        return "collecting"
    if any(doubt["severity"] == Severity.REJECT.value for doubt in document.get("doubts", ())):
        return Severity.REJECT.value
    return str(document["verification"]["verdict"]) if "verification" in document else "not verified"


def _quality_in_words(document: Mapping[str, Any]) -> str:
    sigma = math.degrees(math.sqrt(_angle_spread(_covariance_of_angles(document["mounting"]))[1]))
    return f"{_quality(document)}, ±{sigma:.2f}° of {document['used']} samples"


@dataclass(frozen=True)
class _ResultValue:
    """Value of a result, to decide whether to keep it. convergence: 0 collecting .. 2 fine."""

    used: int
    convergence: int
    first_ns: int | None

    @staticmethod
    def of(document: Mapping[str, Any]) -> _ResultValue:
        rank = [state.value for state in Convergence].index(document["convergence"])
        return _ResultValue(int(document["used"]), rank, document["time_span"]["first_ns"])

    @staticmethod
    def of_file(path: Path) -> _ResultValue | None:
        """Return None if it is no result file, or a damaged one."""
        try:
            content: Any = load_yaml(path, "result file")
            return _ResultValue.of(content) if content["format"] == FORMAT else None
        except (InputError, OSError, KeyError, TypeError, ValueError, OverflowError):
            return None

    def continued_by(self, other: _ResultValue) -> bool:
        """Return whether the other is a later result of the same run."""
        return self.first_ns == other.first_ns and self.used <= other.used


def _backups_to_keep(new: _ResultValue, n_backups: int, before: Sequence[Path]) -> list[Path]:
    """Select the previous files, newest first, to keep: the first, then by convergence, newer ones first."""
    worth = {path: _ResultValue.of_file(path) for path in before}
    kept: list[Path] = []
    for path in before:
        current = worth[path]
        if current is not None and (not current.used or (path != before[0] and current.continued_by(new))):
            continue
        kept.append(path)
        new = current or new
    newest, older = kept[:1], kept[1:]
    older.sort(key=lambda path: -1 if (current := worth[path]) is None else current.convergence, reverse=True)  # stable
    best = older[: n_backups - len(newest)]
    return [*newest, *(path for path in before if path in best)]


def load_initial_calibration(path: Path, mounting_rpy: Sequence[float] | None = None) -> dict[str, GaussianState]:
    """Return states and covariances of a result file to start with, by model. Raises InputError for a faulty file.

    States that do not carry over to another recording (`Nuisance.handed_on`) get their prior. mounting_rpy: the nominal
    mounting to continue with; it must equal the file's, to which its angles are relative.
    """
    content, known = load_result(path, of_recording=True)
    _check_mounting(path, content, mounting_rpy)
    start = {name: (MODELS[name].not_handed_on, prior(MODELS[name], Parameters())) for name in known}
    return {name: with_states_of(state, start[name][1], start[name][0]) for name, state in known.items()}


def load_result(path: Path, of_recording: bool = False) -> tuple[dict[str, Any], dict[str, GaussianState]]:
    """Return a result file's document, and its states and covariances by model. Raises InputError.

    of_recording: covariances of the recording, without the variation between recordings.
    """
    content = load_yaml(path, "result file")
    known_as = content.get("format") if isinstance(content, dict) else None
    if known_as != FORMAT:
        if str(known_as).startswith(_ANY_FORMAT):
            raise InputError(f"{path}: {known_as!r} needs another version of this software, not {FORMAT!r}")
        raise InputError(f"{path}: not a result file of this software (no 'format: {FORMAT}')")
    models = content.get("models")
    if not isinstance(models, dict) or not models:
        raise InputError(f"{path}: damaged, it holds no models")
    if content.get(_END) is not True:
        raise InputError(f"{path}: damaged, its end is missing")
    known = {
        name: _gaussian(f"{path}: models: {name}", name, saved, of_recording)
        for name, saved in models.items()
        if name in MODELS
    }
    if not known:
        raise InputError(f"{path}: none of its models {', '.join(map(str, models))} is one of {', '.join(MODELS)}")
    _check_says_one_thing(path, content)
    if isinstance(parameters := content.get("parameters"), dict):
        for name in ("gnss_model", "gnss_free_model"):  # in 0.1.0 of auto, now of iac alone
            if name in parameters and parameters[name] not in SCHEMA[name].choices:
                parameters[name] = SCHEMA[name].default
    return content, known


def _check_says_one_thing(path: Path, content: Mapping[str, Any]) -> None:
    """Raise InputError if repeated values differ: a user who edits the file does not know which one is read."""
    try:
        selected = content["models"][content["model"]]
        places = [(name, content[name], selected[name]) for name in selected if name in content]
        places.append(("mounting", content["mounting"]["nominal_rpy"], content["parameters"]["mounting_rpy"]))
    except (LookupError, TypeError):  # the reader reports missing entries
        return
    for name, one, other in places:
        if one != other:
            raise InputError(f"{path}: its {name} has two different values; was it changed by hand? save it again")


def _check_mounting(path: Path, content: Mapping[str, Any], mounting_rpy: Sequence[float] | None) -> None:
    """Raise InputError if a saved result is relative to another nominal mounting (rad)."""
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


def _gaussian(where: str, name: str, saved: Any, of_recording: bool) -> GaussianState:
    """Return a saved state with one of its two covariances, both checked. Raises InputError."""
    keys = ("covariance", "covariance_of_recording")
    published, recorded = (_with_covariance(where, name, saved, key) for key in keys)
    return recorded if of_recording else published


def _with_covariance(where: str, name: str, saved: Any, key: str) -> GaussianState:
    """Return a saved state with the covariance of this key, both checked. Raises InputError."""
    model = MODELS[name]
    try:
        x = np.array(saved["state"], dtype=float)
        p = np.array(saved[key], dtype=float)
        names = tuple(saved["state_names"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: damaged ({type(error).__name__}: {error})") from error
    if names != model.state_names or x.shape != (model.n_state,) or p.shape != (model.n_state, model.n_state):
        raise InputError(f"{where}: states {names} are not the model's, {model.state_names}")
    if not np.isfinite(x).all() or not np.isfinite(p).all() or not np.allclose(p, p.T, rtol=1e-9, atol=0.0):
        raise InputError(f"{where}: state or covariance is not finite, or the covariance not symmetric")
    if np.linalg.eigvalsh(p)[0] <= 0.0:
        raise InputError(f"{where}: covariance is not positive definite")
    return GaussianState(x, p)
