"""Description of a DVL for all writers, from a diagnosis, a calibration's result file or a parameter file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import rotation_from_rpy, rpy_from_rotation
from ..disk.text_files import read_file
from ..effects.base import ActsOn, AnyEffect
from ..effects.registry import EFFECTS, NOISE_EFFECTS
from ..errors import InputError
from ..files.mounting import POSITION_UNKNOWN, load_calibrated_mounting
from ..files.parameter_files import load_parameters
from ..files.result_file import FORMAT

Three = tuple[float, float, float]
# effects with their own number in a description, for which simulators may have settings; all others are `others`
GIVEN_AS_NUMBERS = ("lever_arm", "velocity_bias")
_OF_THE_REFERENCE = (ActsOn.REFERENCE, ActsOn.REFERENCE_CLOCK, ActsOn.ATTITUDE_CLOCK)
# a diagnosis has about 10 kB; a much larger file is none, and is not read
LARGEST_FILE = 1 << 24
RESULT, PARAMETERS = "result", "parameters"
# name of the residual of a diagnosis whose verdict is `unknown`
NOT_EXPLAINED = "not_explained"


@dataclass(frozen=True)
class Other:
    """A diagnosed effect without its own number in the description.

    size: rms, m/s, of its effect; None if unknown.
    of_the_reference: it affects the reference or the attitude, not the DVL.
    of_another_day: difference of a recording from the first one, which is described.
    """

    name: str
    parameters: Mapping[str, float]
    size: float | None = None
    of_the_reference: bool = False
    of_another_day: bool = False


@dataclass(frozen=True)
class DvlDescription:
    """Description of a DVL: SI, forward-left-up.

    mounting_rpy: (3,) rad, `dvl_link` in the body as a URDF origin, misalignment included.
    lever_arm: (3,) m, of the DVL from the reference point, body frame.
    scale: (3,) errors δk, and velocity_bias: (3,) m/s, of its axes.
    noise_std: (3,) m/s, of its axes.
    rate_hz: None if unknown.
    speed: (3,) m/s, rms along its axes.
    others: other effects.
    source: file of origin.
    ambiguous: sets of indistinguishable effects, of which the first is used.
    doubts: warnings, in sentences.

    Raises InputError for numbers that are not finite, or a rate or noise that is not positive.
    """

    source: str
    mounting_rpy: Three
    lever_arm: Three = (0.0, 0.0, 0.0)
    scale: Three = (0.0, 0.0, 0.0)
    velocity_bias: Three = (0.0, 0.0, 0.0)
    noise_std: Three | None = None
    rate_hz: float | None = None
    speed: Three | None = None
    others: tuple[Other, ...] = ()
    ambiguous: tuple[tuple[str, ...], ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def ambiguities(self) -> tuple[str, ...]:
        """A sentence on each set of indistinguishable effects."""
        return tuple(f"the data could not distinguish {', '.join(each)}; {each[0]} is used" for each in self.ambiguous)

    def __post_init__(self) -> None:
        vectors = (self.mounting_rpy, self.lever_arm, self.scale, self.velocity_bias, self.noise_std or ())
        if not all(math.isfinite(value) for vector in vectors for value in vector):
            raise InputError(f"{self.source}: holds numbers that are not finite; diagnose again")
        if self.rate_hz is not None and not 0.0 < self.rate_hz < math.inf:
            raise InputError(f"{self.source}: rate_hz is {self.rate_hz:g}, which is impossible; diagnose again")
        if any(std < 0.0 for std in self.noise_std or ()):
            raise InputError(f"{self.source}: a standard deviation is negative, which is impossible; diagnose again")


def load_description(path: Path, sample: int | None = None) -> DvlDescription:
    """Load from a diagnosis (JSON), a result file or a parameter file (YAML). Raises InputError.

    sample: number of the draw of `diagnose --samples` to take, from 0; None: the estimate.
    """
    document = _document(path)
    samples = document.get("samples") if isinstance(document, dict) else None
    samples = samples if isinstance(samples, list) else []
    if sample is not None and not 0 <= sample < len(samples):
        raise InputError(f"{path}: no sample {sample}; it has {len(samples)}, numbered from 0 (see diagnose --samples)")
    if isinstance(document, str):
        return _of_result(path) if document == RESULT else _of_parameters(path)
    if not isinstance(document, dict) or "effects" not in document or "calibration" not in document:
        raise InputError(f"{path}: no diagnosis; give what dvl-calib diagnose --json writes, or a result file")
    if "dvl" not in document:
        raise InputError(
            f"{path}: holds no mounting, rate and noise of the DVL: nothing could be compared, or an older version "
            "wrote it; diagnose again (--json)"
        )
    try:
        return _of_diagnosis(path, document if sample is None else document | samples[sample])
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: damaged diagnosis ({type(error).__name__}: {error}); diagnose again") from error


def _document(path: Path) -> Any:
    """Return the content of a JSON file, or the kind of another file: RESULT or PARAMETERS. Raises InputError."""
    try:
        text = read_file(path, "diagnosis", LARGEST_FILE).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text; give what dvl-calib diagnose --json writes") from error
    if text.lstrip().startswith("{"):
        try:
            return json.loads(text, parse_float=_finite, parse_constant=_finite)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: no valid JSON ({error}); diagnose again") from error
    for kind, mark in ((RESULT, f"format: {FORMAT}"), (PARAMETERS, "ros__parameters")):
        if mark in text:
            return kind
    raise InputError(
        f"{path}: neither a diagnosis (JSON) nor a result or parameter file (YAML); see dvl-calib diagnose --json"
    )


def _finite(word: str) -> float:
    """Parse a number of JSON, which must be finite; no limit is written as null."""
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"{word} is not finite")
    return number


def _of_diagnosis(path: Path, document: Mapping[str, Any]) -> DvlDescription:
    """Describe the DVL by the calibration and effects of a diagnosis."""
    dvl, sizes = document["dvl"], {name: float(size) for name, size in document["dvl"]["sizes_mps"].items()}
    found = {effect["name"]: _values(effect["parameters"]) for effect in document["effects"]}
    arm = found.get("lever_arm", {})
    bias = found.get("velocity_bias", {})
    phi, scale = (_values(document["calibration"][name]) for name in ("phi_rad", "delta_k"))
    rotation = Rotation.from_rotvec([phi.get(axis, 0.0) for axis in "xyz"]).as_matrix()
    body_from_dvl = rotation_from_rpy(_three(dvl["mounting_rpy"])) @ rotation.T
    return DvlDescription(
        source=str(path),
        mounting_rpy=_three(rpy_from_rotation(body_from_dvl)),
        lever_arm=_three(
            [known + arm.get(f"{axis}_m", 0.0) for axis, known in zip("xyz", dvl["lever_arm_m"], strict=True)]
        ),
        scale=_three([scale.get(axis, 0.0) for axis in "xyz"]),
        velocity_bias=_three([bias.get(f"{axis}_mps", 0.0) for axis in "xyz"]),
        noise_std=_three(dvl["noise_std_mps"]),
        rate_hz=float(dvl["rate_hz"]),
        speed=_three(dvl["speed_mps"]),
        others=_others(document, found, sizes),
        ambiguous=tuple(
            (effect["name"], *effect["equivalent_to"]) for effect in document["effects"] if effect.get("equivalent_to")
        ),
    )


def _others(
    document: Mapping[str, Any], effects: Mapping[str, Mapping[str, float]], sizes: Mapping[str, float]
) -> tuple[Other, ...]:
    """Return effects and noise without number of their own in a description, with their sizes."""
    systematic = {name: dict(values) for name, values in effects.items() if name not in GIVEN_AS_NUMBERS}
    dvl = document["dvl"]
    for name, parameter, before in (
        ("dvl_time_offset", "seconds", dvl["time_offset_s"]),
        ("clock_drift", "seconds_per_hour", 3600.0 * dvl["clock_drift"]),
    ):
        if before:
            systematic.setdefault(name, {parameter: 0.0})[parameter] += before
    others = [
        Other(
            name, values, sizes.get(name), _is_of_reference(name), name in EFFECTS and EFFECTS[name].relative_to_first
        )
        for name, values in systematic.items()
    ]
    if document.get("verdict") == "unknown":
        others.append(Other(NOT_EXPLAINED, {}, float(document["gap"]["not_explained_mps"])))
    noise = [Other(entry["name"], _values(entry["parameters"])) for entry in document.get("noise", [])]
    return (
        *others,
        *(Other(entry.name, entry.parameters, sizes.get(entry.name), _is_of_reference(entry.name)) for entry in noise),
    )


def _is_of_reference(name: str) -> bool:
    effect: AnyEffect | None = EFFECTS.get(name) or NOISE_EFFECTS.get(name)
    return effect is not None and effect.acts_on in _OF_THE_REFERENCE


def _values(parameters: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of a diagnosis' parameters; null means no limit."""
    values = {name: parameter["value"] for name, parameter in parameters.items()}
    return {name: math.inf if value is None else float(value) for name, value in values.items()}


def _three(values: Sequence[float] | Any) -> Three:
    x, y, z = map(float, values)
    return x, y, z


def _of_result(path: Path) -> DvlDescription:
    """Describe the DVL by a calibration result. Raises InputError if it must not be used."""
    calibrated = load_calibrated_mounting(path)
    if calibrated.objections:
        raise InputError(f"{path}: {'; '.join(calibrated.objections)}: there is nothing to export")
    delay = calibrated.dvl_time_offset
    return DvlDescription(
        source=str(path),
        mounting_rpy=_three(rpy_from_rotation(calibrated.rotation_body_from_dvl)),
        lever_arm=_three(calibrated.position or (0.0, 0.0, 0.0)),
        scale=_three(calibrated.scale),
        others=(Other("dvl_time_offset", {"seconds": delay}),) if delay else (),
        doubts=(
            *calibrated.objections,
            *calibrated.doubts,
            *([] if calibrated.position is not None else [f"{POSITION_UNKNOWN}; the DVL is put at 0 0 0"]),
        ),
    )


def _of_parameters(path: Path) -> DvlDescription:
    """Build from the parameters that compensate effects, as written by diagnose --apply."""
    parameters = load_parameters(path, [])
    east, north = parameters.reference_velocity_offset
    effects: dict[str, dict[str, float]] = {
        "dvl_time_offset": {"seconds": parameters.dvl_time_offset},
        "clock_drift": {"seconds_per_hour": 3600.0 * parameters.dvl_clock_drift},
        "reference_time_offset": {"seconds": parameters.reference_time_offset},
        "attitude_time_offset": {"seconds": parameters.imu_time_offset},
        "water_lock": {"east_mps": -east, "north_mps": -north},
    }
    return DvlDescription(
        source=str(path),
        mounting_rpy=_three(parameters.mounting_rpy),
        lever_arm=_three(parameters.lever_arm),
        others=tuple(
            Other(name, values, None, _is_of_reference(name))
            for name, values in effects.items()
            if any(values.values())
        ),
    )
