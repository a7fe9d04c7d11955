"""The mounting in a result file in other forms: URDF, TF, robot_localization, a comparison."""

from __future__ import annotations

import difflib
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.checks.speed_of_sound import CauseOfScale, Water, cause_of_scale, water_of_document
from ..calibration.filters.observability import Convergence, observability
from ..calibration.models import MODELS, Model
from ..calibration.models.parameters import FRD, ParameterError, Parameters
from ..calibration.numerics.error_model import corrected_mounting
from ..calibration.numerics.frames import FLU_FROM_FRD, Array, rotation_from_rpy, rpy_from_rotation, turn_between
from ..calibration.numerics.kalman import GaussianState
from ..calibration.results.extrinsics import N_AXES, Extrinsics, dvl_in_words, extrinsics_of, rejection
from ..calibration.results.results import lever_arm, position_in_body, scale_and_delay
from ..disk.atomic import backup_of, own_stream, save_all
from ..errors import InputError, printable
from ..verdict.kinds import VERDICT_WORDS, Severity
from ..version import __version__
from .parameter_files import NODE_NAME, as_yaml, changed_parameters, load_parameters, new_file, with_parameters
from .result_file import load_result, static_transform_arguments
from .urdf import Urdf, UrdfMounting, numbers, read_urdf

# tolerance (rad) for the initial mounting, which may be written by hand with three digits
SAME_MOUNTING = 2e-3
# tolerance (m) for the initial position, which may be written by hand in centimetres
SAME_POSITION = 0.011
# smaller changes (rad and m) are not written: files have nine digits
ALREADY = 1e-7
POSITION_UNKNOWN = (
    "the DVL's position in the body is unknown, because the position of the reference point is: set dvl_position "
    "to from_reference, with reference_position, and calibrate again, or record the transform of the reference's frame"
)
FUSION_NODE = "ekf_filter_node"


@dataclass(frozen=True)
class CalibratedMounting:
    """The selected model's calibration in a result file.

    rotation_body_from_dvl (3, 3): corrected, of the calibrated forward-left-up axes.
    turned: whether the driver's data, in dvl_frame, are forward-right-down and were converted to them.
    position: (3,) m in the body, None if unknown.
    scale (3,): δk per DVL axis, 0 if not estimated.
    lever_arm (3,): m from the reference point, body frame, estimated or configured.
    dvl_time_offset: delay, s, estimated or configured.
    objections: reasons not to apply it.
    doubts: warnings when it is applied; both in sentences.
    water: its properties, and cause_of_scale: the scale explained by them; None if unknown.
    """

    path: Path
    model: Model
    parameters: Parameters
    base_frame: str
    dvl_frame: str
    rotation_body_from_dvl: Array
    scale: Array
    objections: tuple[str, ...]
    doubts: tuple[str, ...]
    turned: bool = False
    lever_arm: tuple[float, ...] = (0.0, 0.0, 0.0)
    dvl_time_offset: float = 0.0
    position: tuple[float, ...] | None = None
    water: Water | None = None
    cause_of_scale: CauseOfScale | None = None

    @property
    def lever_arm_found(self) -> bool:
        """Return whether the estimated lever arm replaces the configured one."""
        return self.lever_arm != self.parameters.lever_arm

    @property
    def compensating(self) -> dict[str, Any]:
        """Parameters that correct the errors found: mounting, and lever arm and delay if estimated."""
        rpy = rpy_from_rotation(self.rotation_body_from_dvl)
        values: dict[str, Any] = {"mounting_rpy": _rounded(rpy)}
        if self.lever_arm_found:
            values["lever_arm"] = _rounded(self.lever_arm)
        if self.dvl_time_offset != self.parameters.dvl_time_offset:
            values["dvl_time_offset"] = _rounded([self.dvl_time_offset])[0]
        return values

    @property
    def rotation_body_from_dvl_frame(self) -> Array:
        """Corrected mounting (3, 3) of dvl_frame itself, for users of the driver's unconverted data."""
        return self.rotation_body_from_dvl @ FLU_FROM_FRD if self.turned else self.rotation_body_from_dvl

    @property
    def rpy(self) -> Array:
        """Corrected mounting (3,) rad of dvl_frame, as in a URDF origin."""
        return rpy_from_rotation(self.rotation_body_from_dvl_frame)

    @property
    def scale_ahead(self) -> float:
        """Scale error of forward motion, positive if the DVL measures too much, as a share."""
        return float(self.parameters.rotation_dvl_from_body[:, 0] ** 2 @ self.scale)

    @property
    def speed_of_sound_factor(self) -> float:
        """Factor for the speed of sound, or another setting that scales velocities: 1 / (1 + δk) ahead."""
        return 1.0 / (1.0 + self.scale_ahead)

    def check_applicable(self, force: bool) -> None:
        """Raise InputError for a calibration with objections, unless force is set."""
        if self.objections and not force:
            raise InputError(f"{self.path}: {'; '.join(self.objections)}; to apply it anyway: --force")

    @property
    def static_transform(self) -> str:
        """Arguments of tf2's static_transform_publisher. Raises InputError if the position is unknown."""
        if self.position is None:
            raise InputError(f"{self.path}: {POSITION_UNKNOWN}")
        rotation = self.rotation_body_from_dvl_frame
        return static_transform_arguments(self.position, rotation, self.base_frame, self.dvl_frame)


def load_calibrated_mounting(path: Path) -> CalibratedMounting:
    """Read a result file. Raises InputError if it is none, is damaged, or was changed by hand."""
    content, states = load_result(path)
    try:
        model = MODELS[content["model"]]
        state = states[model.name]
        parameters = Parameters.from_mapping(content["parameters"])
        saved = rotation_from_rpy(np.array(content["mounting"]["corrected_rpy"], dtype=float).reshape(3))
        frames = (str(content["mounting"]["frame_id"]), str(content["mounting"]["child_frame_id"]))
        is_turned = content["mounting"].get("dvl_data_axes") == FRD
        in_result = {
            name: np.array(content["mounting"][name], dtype=float).reshape(3)
            for name in ("lever_arm", "position")
            if content["mounting"].get(name) is not None
        }
        convergence = Convergence(content["models"][model.name]["convergence"])
        objections, doubts = _objections_and_doubts(content.get("verification"), convergence)
        objections += _saved_warnings(content, Severity.REJECT)
        doubts += _saved_warnings(content, Severity.MARGINAL, Severity.WARNING)
        water = water_of_document(content["water"]) if "water" in content else None
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: damaged, or of another version ({type(error).__name__}: {error})") from error
    except ParameterError as error:
        raise InputError(f"{path}: parameters: {error}") from error
    errors = model.error_terms_from_state @ state.x
    rotation = corrected_mounting(errors[:3], parameters.rotation_dvl_from_body)
    arm, position = lever_arm(model, state, parameters.lever_arm), position_in_body(model, state, parameters)
    from_states = {"lever_arm": arm, "position": position}
    agree = all(
        np.allclose(in_result[name], from_states[name] or in_result[name], rtol=0.0, atol=1e-6) for name in in_result
    )
    if not (angle_between(rotation, saved) < 1e-6 and agree):
        raise InputError(f"{path}: its mounting does not follow from its states; was it changed by hand? save it again")
    if parameters.dvl_frame not in ("", frames[1]):
        raise InputError(
            f"{path}: mounting is for frame {frames[1]!r}, parameters for {parameters.dvl_frame!r}; save it again"
        )
    doubts += _unobservable_angles(model, state, parameters)
    delay = scale_and_delay(model, state, parameters).time_offset
    of_scale = None
    if water is not None:
        of_recording = load_result(path, of_recording=True)[1][model.name]
        of_scale = cause_of_scale(model, of_recording, parameters, water)
    return CalibratedMounting(
        path, model, parameters, *frames, rotation, errors[3:], objections, doubts, is_turned, arm, delay, position,
        water, of_scale,
    )  # fmt: skip


def _rounded(values: Sequence[float] | Array) -> list[float]:
    """Round to nine digits, so that a second write changes nothing."""
    return [float(f"{float(value):.9g}") + 0.0 for value in values]


def _objections_and_doubts(
    verification: Mapping[str, Any] | None, convergence: Convergence
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return objections and doubts from the verdict and the convergence in a result file."""
    objections, doubts = [], []
    if convergence is Convergence.COLLECTING:
        objections.append("no angle and no scale is observable in its data yet (collecting)")
    elif convergence is Convergence.COARSE:
        doubts.append("its convergence is coarse: the drift that it leaves open is above target_drift")
    if verification is None:
        doubts.append("it is not verified on held-out data; `dvl-calib replay` of a recording does that")
        return tuple(objections), tuple(doubts)
    verdict, reason = VERDICT_WORDS[verification["verdict"]], str(verification["reasons"][0])
    if verdict is not Severity.ACCEPT:
        (objections if verdict is Severity.REJECT else doubts).append(f"its verdict is {verdict.value}: {reason}")
    return tuple(objections), tuple(doubts)


def _saved_warnings(content: Mapping[str, Any], *severities: Severity) -> tuple[str, ...]:
    """Return the warnings of these severities that the node saved with its calibration."""
    wanted = {severity.value for severity in severities}
    return tuple(str(doubt["says"]) for doubt in content.get("doubts", ()) if doubt["severity"] in wanted)


def _unobservable_angles(model: Model, state: GaussianState, parameters: Parameters) -> tuple[str, ...]:
    """Return a sentence with 1 σ for each angle that was not observable."""
    entries = [entry for entry in observability(model, state.p, parameters)[:3] if not entry.observed]
    return tuple(
        f"{entry.name} ({entry.axis}) was not observable in the data, which leaves ±{math.degrees(entry.std):.1f}° (1σ)"
        for entry in entries
    )


def angle_between(a: Array, b: Array) -> float:
    """Return the angle between two rotations (3, 3), rad; exact for small ones."""
    return float(np.linalg.norm(turn_between(a, b)))


def calibrated_urdf(
    urdf: Urdf, mounting: UrdfMounting, calibrated: CalibratedMounting, force: bool = False, keep_position: bool = False
) -> bytes:
    """Return the URDF with the calibrated mounting, and position if estimated; unchanged if it has them already.

    Raises InputError if its mounting or position differs from the calibration's initial one, unless force is set.
    keep_position: keep the position.
    """
    current, corrected = mounting.rotation_body_from_dvl, calibrated.rotation_body_from_dvl
    initial = calibrated.parameters.rotation_dvl_from_body.T
    if calibrated.turned and current[:, 2] @ initial[:, 2] < 0.0:  # the URDF has the driver's own frame, z down
        corrected, initial = corrected @ FLU_FROM_FRD, initial @ FLU_FROM_FRD
    is_kept = keep_position or calibrated.position is None
    position = mounting.position if is_kept else np.array(calibrated.position)
    tolerance = ALREADY if calibrated.lever_arm_found else SAME_POSITION  # a configured position may be rounded
    is_placed = np.abs(mounting.position - position).max() < tolerance
    if angle_between(current, corrected) < ALREADY and is_placed:
        return urdf.content
    if angle_between(current, initial) > SAME_MOUNTING and angle_between(current, corrected) > ALREADY and not force:
        raise InputError(
            f"{urdf.path}: has the DVL at rpy {numbers(rpy_from_rotation(current))} in {calibrated.base_frame} (joint "
            f"{mounting.joint.name}), but {calibrated.path} began with mounting_rpy "
            f"{numbers(calibrated.parameters.mounting_rpy)}; calibrate with the URDF's mounting (dvl-calib parameters "
            "--urdf), or write the calibrated mounting anyway with --force"
        )
    began_at = np.array(calibrated.parameters.lever_arm) + calibrated.parameters.reference_position
    if not is_placed and np.abs(mounting.position - began_at).max() > SAME_POSITION and not force:
        found = f" and found {numbers(_rounded(position))}" if calibrated.lever_arm_found else ""
        raise InputError(
            f"{urdf.path}: has the DVL at {numbers(mounting.position)} in {calibrated.base_frame} (joint "
            f"{mounting.joint.name}), but {calibrated.path} began with {numbers(began_at)}{found}; --keep-position "
            "rotates the joint only, --force moves it there"
        )
    return urdf.moved(mounting, corrected, None if is_placed else position)


def calibrated_parameters(path: Path, calibrated: CalibratedMounting, force: bool = False) -> bytes:
    """Return a parameter file for the node that corrects the errors found, new or based on the existing file.

    Unless force is set, raises InputError if the file's mounting, lever arm or delay differs from the calibration's
    initial one. Also if it starts from a saved calibration, whose angles are relative to another mounting.
    """
    values = calibrated.compensating
    if not path.exists():
        parameters = calibrated.parameters.replace(result_file="", initial_calibration="")
        return new_file(parameters, values, _origin(calibrated))
    in_file, default = load_parameters(path), Parameters()
    if in_file.initial_calibration:
        raise InputError(
            f"{path}: sets initial_calibration, whose angles are relative to the previous mounting; remove it first"
        )
    for name, value in values.items():
        now, initial = getattr(in_file, name), getattr(calibrated.parameters, name)
        expected = [np.array(values) for values in (getattr(default, name), initial, value)]
        within = SAME_POSITION if name == "lever_arm" else SAME_MOUNTING
        if not any(np.allclose(now, allowed, rtol=0.0, atol=within) for allowed in expected) and not force:
            raise InputError(
                f"{path}: sets {name} to {as_yaml(in_file.as_dict()[name])}, but {calibrated.path} began with "
                f"{as_yaml(calibrated.parameters.as_dict()[name])}; calibrate with the file's value, or write "
                "the calibrated value anyway with --force"
            )
    return with_parameters(path, values)


def urdf_parameters(urdf: Urdf, base: str, dvl: str, joint: str | None = None) -> str:
    """Return a ROS 2 parameter file that starts a calibration from a URDF's mounting. Raises InputError."""
    mounting = urdf.mounting(base, dvl, joint)
    rpy = rpy_from_rotation(mounting.rotation_body_from_dvl)
    return f"""# Mounting of the DVL from {urdf.path.name!r}, joint {mounting.joint.name!r}.
/**:
  ros__parameters:
    base_frame: {as_yaml(base)}
    mounting_rpy: {as_yaml([float(word) for word in numbers(rpy).split()])}
    # if the reference velocity is that of {printable(base)}'s origin:
    # lever_arm: {as_yaml([float(word) for word in numbers(mounting.position).split()])}
"""


def launch_file(calibrated: CalibratedMounting) -> str:
    """Return a launch file (XML) that publishes the calibrated mounting as a static transform.

    Raises InputError if a frame's name would be evaluated in it.
    """
    from xml.sax.saxutils import quoteattr  # imports modules that read files over the net

    for frame in (calibrated.base_frame, calibrated.dvl_frame):
        if "$" in frame:
            raise InputError(
                f"{calibrated.path}: the frame {frame!r} cannot be used in a launch file, which would evaluate "
                "text after a $; rename it in the driver, or run static_transform_publisher yourself"
            )
    arguments = quoteattr(calibrated.static_transform)
    return f"""<launch>
  <!-- {_origin(calibrated)}. A transform has no scale. Do not add a robot_state_publisher with this joint. -->
  <node pkg="tf2_ros" exec="static_transform_publisher" name="dvl_mounting" args={arguments}/>
</launch>
"""


def _origin(calibrated: CalibratedMounting) -> str:
    name = re.sub(r"[^\w. ]", "_", calibrated.path.name)
    return f"dvl_calib_ros {__version__}, model {calibrated.model.name} of {name}"


def scale_advice(calibrated: CalibratedMounting) -> str:
    """Return a sentence on the scale error, which a transform cannot correct, and its remedy."""
    if not calibrated.model.scale_axes:
        return f"{calibrated.model.name} estimates no scale: a scale error of the DVL remains"
    error = calibrated.scale_ahead
    return (
        f"a transform has no scale: {100.0 * error:+.2f} % ahead stays in ({abs(1000.0 * error):.1f} m per km). Use "
        "~/calibrated_twist, which is corrected in both, or multiply the driver's speed of sound by "
        f"{calibrated.speed_of_sound_factor:.5f} (not with a phased array, which measures ahead without it)"
    )


def fusion_file(calibrated: CalibratedMounting) -> str:
    """Return one ROS 2 parameter file for robot_localization and for our node."""
    base, dvl, name = printable(calibrated.base_frame), printable(calibrated.dvl_frame), calibrated.model.name
    used = [index in (6, 7, 8) for index in range(15)]  # x y z, roll pitch yaw, vx vy vz, their rates, accelerations
    settings = {
        **{key: value for key, value in changed_parameters(calibrated.parameters).items() if key != "result_file"},
        "model": name,
        "initial_calibration": str(calibrated.path.resolve()),
    }
    learns = "only with GNSS; in a dive it does not change" if calibrated.model.aided else "on in the dive"
    return "\n".join(
        [
            *_comment(f"{_origin(calibrated)}: the DVL for robot_localization. Take A or B, never both."),
            *_comment(
                f"A. Corrected in misalignment and scale, in {base}, covariance of sensor and calibration together. "
                "Our node runs in the dive with the parameters below; its mounting_rpy is the one that the calibration "
                f"began with. {name} learns {learns}. It is the velocity of the point that lever_arm is measured from: "
                f"let that be the origin of {base}. The 0 of twist0 is any that is free."
            ),
            f"{FUSION_NODE}:",
            "  ros__parameters:",
            f"    twist0: /{NODE_NAME}/calibrated_twist",
            f"    twist0_config: {as_yaml(used)}",
            "    twist0_queue_size: 10",
            f"{NODE_NAME}:",
            "  ros__parameters:",
            *(f"    {key}: {as_yaml(value)}" for key, value in settings.items()),
            *_comment(
                f"B. The driver's own topic (a TwistWithCovarianceStamped), in frame {dvl}, rotated by TF (URDF or "
                "static transform, calibrated), which has the lever arm, too. Our node does not run. Corrected in "
                "misalignment only: "
                f"{scale_advice(calibrated)}. The covariance is the driver's, without the calibration's. As above, but:"
            ),
            "#   twist0: /dvl/twist",
            "",
        ]
    )


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, 118, initial_indent="# ", subsequent_indent="#   ", break_on_hyphens=False)


def load_extrinsics(path: Path, name: str) -> Extrinsics:
    """Return the selected model's calibration in a result file, called `name`.

    Raises InputError if it is no result file, is damaged, or has no sample.
    """
    calibrated = load_calibrated_mounting(path)
    content, states = load_result(path, of_recording=True)
    model = calibrated.model
    try:
        used = int(content["models"][model.name]["used"])
        span = content["time_span"]["first_ns"], content["time_span"]["last_ns"]
        first_ns, last_ns = (0, 0) if used == 0 else map(int, span)
        rejected = rejection(content.get("verification", {}).get("findings", ()))
        by_bias = np.array(content["models"][model.name]["by_dvl_bias"], dtype=float).reshape(model.n_state, N_AXES)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: damaged, or of another version ({type(error).__name__}: {error})") from error
    if not used:
        raise InputError(f"{path}: {model.name} used no sample, so it has no mounting; leave it out")
    remarks = list(calibrated.objections)
    if initial := calibrated.parameters.initial_calibration:
        remarks.append(
            f"it began with {initial}: with that, and with what else began so, it shares data, and differences come "
            "out smaller than they are"
        )
    state = states[model.name]
    if np.linalg.eigvalsh(state.p - by_bias @ by_bias.T)[0] <= 0.0 or not np.isfinite(by_bias).all():
        raise InputError(f"{path}: damaged, its by_dvl_bias is more than its covariance_of_recording")
    return extrinsics_of(
        name,
        model,
        state,
        calibrated.parameters,
        (first_ns, last_ns),
        used,
        remarks,
        dvl=dvl_in_words(calibrated.dvl_frame, calibrated.turned),
        by_bias=by_bias,
        rejected=rejected,
    )


@dataclass(frozen=True)
class Targets:
    """Files to write a calibration into; None for no file.

    urdf: its DVL joint is rotated and moved.
    output: URDF to write instead.
    joint: the DVL's joint; None: the one above the DVL's frame.
    keep_position: keep its xyz.
    params: parameter file of the node.
    launch: launch file (XML) with a static transform.
    fusion: parameters of robot_localization (YAML). Raises InputError for options that need a URDF without one.
    """

    urdf: Path | None = None
    output: Path | None = None
    joint: str | None = None
    keep_position: bool = False
    params: Path | None = None
    launch: Path | None = None
    fusion: Path | None = None

    def __post_init__(self) -> None:
        if self.urdf is None and (self.output is not None or self.joint is not None or self.keep_position):
            raise InputError("--output, --joint and --keep-position need --urdf")

    @property
    def paths(self) -> list[Path]:
        """Paths of the files to write."""
        urdf = self.output or self.urdf
        return [path for path in (urdf, self.params, self.launch, self.fusion) if path is not None]


@dataclass(frozen=True)
class Applied:
    """Result of applying a calibration.

    written: new or changed files, also planned ones.
    unchanged: files that already had the values.
    kept: path of each replaced file's backup.
    notes: remarks for users of the files.
    changes: planned changes of a dry run, as a unified diff.
    """

    written: tuple[Path, ...]
    unchanged: tuple[Path, ...]
    kept: dict[Path, Path]
    notes: tuple[str, ...]
    changes: str = ""


def write_calibration(
    calibrated: CalibratedMounting, targets: Targets, force: bool = False, dry_run: bool = False
) -> Applied:
    """Write a calibration into all files, or into none. Each previous file is kept as a backup.

    force: also for a calibration that is rejected, not converged, or found with another mounting. dry_run: write
    nothing, return the planned changes. Raises InputError.
    """
    if targets.paths:
        calibrated.check_applicable(force)
    contents, notes = _new_contents(calibrated, targets, force)
    existing = [path for path in contents if own_stream(path) is None and path.exists()]
    new = {path: content for path, content in contents.items() if path not in existing or path.read_bytes() != content}
    unchanged = tuple(path for path in contents if path not in new)
    if dry_run:
        before = {path: path.read_bytes() if path in existing else b"" for path in new}
        changes = "".join(_difference(path, before[path], content) for path, content in new.items())
        return Applied(tuple(new), unchanged, {}, tuple(notes), changes)
    save_all(new)  # a new URDF with old parameters would apply the rotation twice or not at all
    kept = {path: backup_of(path) for path in new if path in existing}
    return Applied(tuple(new), unchanged, kept, tuple(notes))


def _difference(path: Path, before: bytes, after: bytes) -> str:
    old, new = (text.decode(errors="replace").splitlines() for text in (before, after))
    lines = difflib.unified_diff(old, new, printable(str(path)), "would be", n=1, lineterm="")
    return "".join(f"{printable(line)}\n" for line in lines)


def _new_contents(calibrated: CalibratedMounting, targets: Targets, force: bool) -> tuple[dict[Path, bytes], list[str]]:
    """Return new contents by file, and notes."""
    contents: dict[Path, bytes] = {}
    notes = []
    if targets.urdf is not None:
        urdf = read_urdf(targets.urdf)
        mounting = urdf.mounting(calibrated.base_frame, calibrated.dvl_frame, targets.joint)
        contents[targets.output or targets.urdf] = calibrated_urdf(
            urdf, mounting, calibrated, force, targets.keep_position
        )
        if urdf.generated:
            notes.append(f"{targets.urdf} was generated by xacro, whose next run overwrites it: change its source, too")
    if targets.params is not None:
        contents[targets.params] = calibrated_parameters(targets.params, calibrated, force)
    if targets.launch is not None:
        contents[targets.launch] = launch_file(calibrated).encode()
    if targets.fusion is not None:
        contents[targets.fusion] = fusion_file(calibrated).encode()
    return contents, notes


def roll_back(targets: Targets) -> dict[Path, Path]:
    """Restore the backups; the replaced files become the backups. Return the backup of each file. Raises InputError."""
    if not targets.paths:
        raise InputError("--rollback: name the files again, with --urdf, --params, --launch or --fusion")
    before: dict[Path, bytes] = {}
    for path in targets.paths:
        backup = backup_of(path)
        try:
            before[path] = backup.read_bytes()
        except OSError as error:
            raise InputError(f"{backup}: cannot be read ({error.strerror}); there is nothing to go back to") from error
    save_all(before)  # the current files become the backups
    return {path: backup_of(path) for path in before}
