"""Reading of unlisted DVL message types by a map of fields (parameter dvl_fields).

A map is ``velocity=vel.x,vel.y,vel.z,valid=lock``: keys, each with paths of fields. ``beams=LIST,DIRECTION,VELOCITY``,
the last two being fields of the list's elements, gives the velocity by least squares.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from operator import attrgetter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..calibration.numerics.frames import Array
from ..errors import InputError
from .drivers import CHECK_LOCK, ENOUGH_BEAMS, IMU_TYPE, VELOCITY_TYPES, Rule, VelocityType, add_type, forget, register

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


# rosbags' numbers of field kinds (`rosbags.interfaces.Nodetype`); a ROS machine need not have rosbags
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
# keys of a map, and allowed numbers of paths for each
_KEYS: Mapping[str, tuple[int, ...]] = {
    "velocity": (1, 3), "beams": (3,), "valid": (1, 2, 3, 4), "variance": (1, 3), "stamp": (1,), "frame": (1,)
}  # fmt: skip
_WRITTEN = frozenset({*VELOCITY_TYPES, IMU_TYPE})
# limit of fields named in an error
_NAMED = 30
# types registered by a map, and their maps
_MAPPED: dict[str, str] = {}
FieldMap = Mapping[str, tuple[str, ...]]


def field_map(text: str) -> FieldMap:
    """Return the paths of each key of a map. Raises InputError."""
    paths: dict[str, list[str]] = {}
    key = ""
    for part in text.split(","):
        name, is_key, path = part.rpartition("=")
        key = name.strip() if is_key else key
        if key not in _KEYS or not path.strip():
            raise InputError(
                f"dvl_fields: {part.strip()!r} of {text!r} is not KEY=FIELD, with a KEY of {', '.join(_KEYS)}; "
                "write velocity=vel.x,vel.y,vel.z,valid=lock"
            )
        paths.setdefault(key, []).append(path.strip())
    for key, counts in _KEYS.items():
        if key in paths and len(paths[key]) not in counts:
            expected = " or ".join(map(str, counts))
            raise InputError(f"dvl_fields: {key} names {len(paths[key])} fields, expected {expected}")
    if ("velocity" in paths) == ("beams" in paths):
        raise InputError(f"dvl_fields: {text!r} must name either velocity or beams")
    return {key: tuple(own) for key, own in paths.items()}


def may_be_mapped(msgtype: str) -> bool:
    """Return whether a map may apply to a type: listed types have their own reader."""
    return msgtype not in _WRITTEN


def forget_mapped(text: str) -> None:
    """Remove types registered by another map. text: `dvl_fields` of the map to keep, '' to remove all."""
    for name in [name for name, known in _MAPPED.items() if known != text]:
        forget(name)
        del _MAPPED[name]


def mapped_type(name: str, text: str) -> VelocityType:
    """Register and return the type of this name as read by a map, until `forget_mapped`. Raises InputError."""
    fields = field_map(text)
    _MAPPED[name] = text
    return register(
        VelocityType(
            name=name,
            sent_by="as dvl_fields says",
            velocity=attrgetter("velocity"),
            covariance=attrgetter("covariance"),
            covariance_says="as dvl_fields says",
            is_read_in_columns=False,
            rules=(Rule("flagged_invalid", "`valid` is false", lambda message, _: not message.valid, CHECK_LOCK),),
            adapted=_reader(fields),
        )
    )


def _reader(fields: FieldMap) -> Callable[[Any], Any]:
    """Return a function that gives a message the attribute names of the map's keys."""
    getters = {key: tuple(map(attrgetter, paths)) for key, paths in fields.items() if key != "beams"}

    def read(key: str, message: Any) -> list[Any]:
        return [getter(message) for getter in getters.get(key, ())]

    def adapted(message: Any) -> Any:
        """Return header, velocity, covariance and validity of a message by the map."""
        header = getattr(message, "header", None)
        stamp = _stamp(read("stamp", message) or ([header.stamp] if header is not None else [0.0]))
        frame = read("frame", message) or ([header.frame_id] if header is not None else [""])
        velocity = _of_beams(fields["beams"], message) if "beams" in fields else _xyz(read("velocity", message))
        variance = read("variance", message)
        return SimpleNamespace(
            header=SimpleNamespace(stamp=stamp, frame_id=str(frame[0])),
            velocity=SimpleNamespace(**dict(zip("xyz", velocity, strict=True))),
            covariance=_covariance(variance) if variance else None,
            valid=all(read("valid", message)) and all(map(math.isfinite, velocity)),
        )

    return adapted


def _xyz(values: Sequence[Any]) -> list[float]:
    """Return three numbers of a vector, an array, or separate fields; nan if there are not three."""
    if len(values) == 1:
        [vector] = values
        values = (vector.x, vector.y, vector.z) if hasattr(vector, "x") else vector
    return [*map(float, values)] if len(values) == 3 else [math.nan] * 3


def _of_beams(paths: Sequence[str], message: Any) -> list[float]:
    """Return the least-squares velocity from beam directions and velocities; nan from fewer than three."""
    beams, direction, speed = map(attrgetter, paths)
    rows = [(*_xyz([direction(beam)]), float(speed(beam))) for beam in beams(message)]
    table = np.array([row for row in rows if all(map(math.isfinite, row))]).reshape(-1, 4)
    if np.linalg.matrix_rank(table[:, :3]) < ENOUGH_BEAMS:
        return [math.nan] * 3
    return [*map(float, np.linalg.lstsq(table[:, :3], table[:, 3], rcond=None)[0])]


def _covariance(values: Sequence[Any]) -> Array | None:
    """Return (3, 3) (m/s)² from one variance, one per axis, a covariance of 9 numbers or a twist's of 36."""
    if hasattr(values[0], "x"):
        values = _xyz(values)
    flat = np.concatenate([np.ravel(np.asarray(value, dtype=float)) for value in values])
    if flat.size in (9, 36):
        side = math.isqrt(flat.size)
        return flat.reshape(side, side)[:3, :3]
    return np.diag(np.broadcast_to(flat, 3)) if flat.size in (1, 3) else None


def _stamp(values: Sequence[Any]) -> Any:
    """Return a stamp like a header's, from a stamp or from seconds since 1970."""
    [stamp] = values
    if hasattr(stamp, "sec"):
        return stamp
    seconds, nanoseconds = divmod(round(float(stamp) * 1e9) if math.isfinite(stamp) else 0, 1_000_000_000)
    return SimpleNamespace(sec=seconds, nanosec=nanoseconds)


Description = Any
"""rosbags' description of a field: its kind, then a type's name, a base type, or an array's element."""


class _Fields(NamedTuple):
    """Fields of message types."""

    store: Typestore

    def of(self, description: Description) -> dict[str, Description]:
        """Return a message's fields by name; empty for other descriptions."""
        kind, detail = description
        known = self.store.fielddefs.get(detail) if kind == NAME else None
        return {} if known is None else dict(known[1])

    def at(self, description: Description, path: str) -> Description | None:
        """Return the description at a path below a message; None if it does not exist."""
        for step in path.split("."):
            description = self.of(description).get(step)
            if description is None:
                return None
        return description

    def walk(self, description: Description, prefix: str = "") -> Iterator[tuple[str, Description]]:
        """Yield all paths below a message except the header's, with their descriptions."""
        for name, kind in self.of(description).items():
            if prefix or name != "header":
                yield prefix + name, kind
                yield from self.walk(kind, f"{prefix}{name}.")

    def is_number(self, description: Description) -> bool:
        kind, detail = description
        return bool(kind == BASE and detail[0] != "string")

    def is_array(self, description: Description) -> bool:
        kind, detail = description
        return kind in (ARRAY, SEQUENCE) and self.is_number(detail[0])

    def is_vector(self, description: Description) -> bool:
        fields = self.of(description)
        return "w" not in fields and all(name in fields and self.is_number(fields[name]) for name in "xyz")

    def element(self, description: Description) -> Description | None:
        """Return the element type of a list of messages; None for other descriptions."""
        kind, detail = description
        is_list = kind in (ARRAY, SEQUENCE) and detail[0][0] == NAME
        return detail[0] if is_list else None


def misfit(text: str, store: Typestore, msgtype: str) -> str:
    """Return an error text on the first unsuitable path of a map; '' if the map fits."""
    fields, root = _Fields(store), (NAME, msgtype)
    for key, paths in field_map(text).items():
        within: Description | None = root
        for place, path in enumerate(paths):
            found = fields.at(within, path)
            if found is None:
                return f"{msgtype} has no field {path!r}; it has {_listed(fields, within)}"
            if key == "beams":
                fits, expected = (
                    (fields.element(found) is not None, "a list of beams"), (_is_three(fields, found), "a vector"),
                    (fields.is_number(found), "a number"),
                )[place]  # fmt: skip
                within = fields.element(found) if place == 0 else within
            else:
                fits, expected = _fits(fields, key, found, len(paths))
            if not fits:
                return f"field {path!r} of {msgtype} is not {expected}, as {key} must be"
    return ""


def _fits(fields: _Fields, key: str, description: Description, count: int) -> tuple[bool, str]:
    """Return whether a field's kind is allowed for a key, and the name of the allowed kind."""
    if key == "frame":
        return description == (BASE, ("string", 0)), "text"
    if key == "stamp":
        return fields.is_number(description) or "nanosec" in fields.of(description), "a time, or seconds"
    if key == "variance" and count == 1:
        return fields.is_number(description) or _is_three(fields, description), "a number, a vector or an array"
    if key == "velocity" and count == 1:
        return _is_three(fields, description), "a vector"
    return fields.is_number(description), "a number"


def _is_three(fields: _Fields, description: Description) -> bool:
    return fields.is_vector(description) or fields.is_array(description)


def _listed(fields: _Fields, description: Description) -> str:
    names = [path for path, kind in fields.walk(description) if not fields.of(kind)]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return (", ".join(names[:_NAMED]) or "none but its header") + more


def suggested(store: Typestore, msgtype: str) -> str:
    """Return a map for the likely velocity in a type; '' if there is none."""
    fields = _Fields(store)
    below = dict(fields.walk((NAME, msgtype)))
    found = next(_velocities(fields, below), "")
    valid = [
        path
        for path, (kind, what) in below.items()
        if kind == BASE and what[0] == "bool" and re.search("valid|lock", path, re.I) and "beam" not in path
    ]
    return f"{found},valid={','.join(valid)}" if found.startswith("velocity") and 0 < len(valid) <= 4 else found


def _velocities(fields: _Fields, below: Mapping[str, Description]) -> Iterator[str]:
    """Yield maps of possible velocities, the most likely first."""
    named = {path: kind for path, kind in below.items() if re.search(r"vel|linear|(^|_|\.)v[xyz]$", path, re.I)}
    yield from (f"velocity={path}" for path, kind in named.items() if _is_three(fields, kind))
    for path, kind in named.items():
        y, z = (re.sub(r"(?<![a-uw-z])x(?![a-z])", axis, path) for axis in "yz")
        if y != path and fields.is_number(kind) and kind[1][0] != "bool" and y in below and z in below:
            yield f"velocity={path},{y},{z}"
    for path, kind in below.items():
        inner = dict(fields.walk(element)) if (element := fields.element(kind)) is not None else {}
        vectors = [name for name, inner_kind in inner.items() if fields.is_vector(inner_kind)]
        speeds = [name for name, inner_kind in inner.items() if "vel" in name and fields.is_number(inner_kind)]
        if vectors and speeds:
            yield f"beams={path},{vectors[0]},{speeds[0]}"


# Recognition of message types by their fields, for any package name.
# Forks and ports of a driver send its messages under their own package names: waterlinked_a50_ros_driver and
# dvl_a50_msgs equal dvl_msgs, stonefish_msgs and dave_interfaces equal uuv_sensor_ros_plugins_msgs.

# characteristic fields of a DVL's message, the most specific first -> the known type with the same layout
_ALIKE: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"header", "velocity", "velocity_valid", "fom", "altitude", "beams"}),
        "dvl_msgs/msg/DVL",
    ),
    (
        frozenset({"header", "velocity", "coordinate_mode", "velocity_mode", "velocity_covar", "num_good_beams"}),
        "ds_sensor_msgs/msg/Dvl",
    ),
    (
        frozenset(
            {"header", "velocity", "velocity_mode", "velocity_covar", "num_good_beams", "beam_velocities_valid",
             "altitude", "beam_ranges_valid", "range"}
        ),
        "marine_acoustic_msgs/msg/Dvl",
    ),
    (
        frozenset({"header", "velocity", "velocity_covariance", "altitude"}),
        "uuv_sensor_ros_plugins_msgs/msg/DVL",
    ),
)  # fmt: skip


def recognised(name: str, fields: Collection[str]) -> VelocityType | None:
    """Return the type of this name if known, else by its fields; None if they are not a DVL's.

    A recognised type is then also known by its name.
    """
    known = VELOCITY_TYPES.get(name)
    if known is not None:
        return known
    like = next((like for needed, like in _ALIKE if needed <= set(fields)), None)
    return None if like is None else add_type(name, like)
