"""Mountings in a URDF: read from its fixed joints; one joint's origin is changed and all other bytes are kept."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from ..calibration.numerics.frames import Array, rotation_from_rpy, rpy_from_rotation
from ..disk.text_files import read_file
from ..errors import InputError

# files with embedded meshes have some MB
LARGEST_FILE = 1 << 26


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF. rpy: rad about fixed axes; ``parent_from_child`` is its rotation.

    tag: position of its start tag in the file. origin: position of its origin's (first byte, one past the last), None
    if missing.
    """

    name: str
    kind: str
    parent: str
    child: str
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]
    tag: tuple[int, int]
    origin: tuple[int, int] | None


@dataclass(frozen=True)
class UrdfMounting:
    """Mounting of the DVL in a URDF, by the fixed joints from the body to it.

    joint: the last one, the DVL's own.
    rotation_body_from_dvl (3, 3), rotation_body_from_parent (3, 3): of the joint's parent.
    position: m, in the body.
    """

    joint: Joint
    rotation_body_from_dvl: Array
    rotation_body_from_parent: Array
    position: Array


@dataclass(frozen=True)
class Urdf:
    """A URDF file. generated: whether xacro marked it as overwritten by its next run."""

    path: Path
    content: bytes
    joints: tuple[Joint, ...]
    generated: bool

    def mounting(self, base: str, dvl: str, joint: str | None = None) -> UrdfMounting:
        """Follow fixed joints from the DVL's link up to the body's. Raises InputError.

        base, dvl: frame ids, with or without a namespace before the link's name. joint: the DVL's own, if it is not the
        one above link `dvl`.
        """
        chain = [self._joint(joint) if joint is not None else self._joint_above(dvl)]
        while not _is_link(chain[0].parent, base):
            above = self._joint_above(chain[0].parent, f"; joint {chain[-1].name} does not lead to {base}")
            if above in chain:
                raise InputError(f"{self.path}: joint {above.name} is its own ancestor")
            chain.insert(0, above)
        for member in chain:
            if member.kind != "fixed":
                what = f"joint {member.name} between {base} and the DVL is {member.kind}"
                raise InputError(f"{self.path}: {what}; only fixed joints make a mounting")
        rotation, position = np.eye(3), np.zeros(3)
        for member in chain:
            parent = rotation
            position = position + rotation @ member.xyz
            rotation = rotation @ rotation_from_rpy(member.rpy)
        return UrdfMounting(chain[-1], rotation, parent, position)

    def _joint(self, name: str) -> Joint:
        """Return the joint of this name. Raises InputError unless there is exactly one."""
        found = [joint for joint in self.joints if joint.name == name]
        if len(found) != 1:
            many = "more than one" if found else "no"
            raise InputError(f"{self.path}: {many} joint {name!r}; {self._fixed_joints_text()}")
        return found[0]

    def _joint_above(self, link: str, why: str = "") -> Joint:
        """Return the joint whose child is this link. Raises InputError unless there is exactly one."""
        found = [joint for joint in self.joints if _is_link(joint.child, link)]
        if len(found) != 1:
            what = f"{'more than one' if found else 'no'} joint above link {link!r}{why}"
            raise InputError(f"{self.path}: {what}; name the DVL's joint with --joint; {self._fixed_joints_text()}")
        return found[0]

    def _fixed_joints_text(self) -> str:
        return "its fixed joints: " + (", ".join(each.name for each in self.joints if each.kind == "fixed") or "none")

    def moved(self, mounting: UrdfMounting, rotation_body_from_dvl: Array, position: Array | None = None) -> bytes:
        """Return the file with the DVL's joint changed to give this mounting (3, 3); all other bytes are kept.

        position: (3,) m of the DVL in the body; None keeps its joint's xyz.
        """
        joint, to_parent = mounting.joint, mounting.rotation_body_from_parent.T
        new = {"rpy": numbers(rpy_from_rotation(to_parent @ rotation_body_from_dvl)).encode()}
        if position is not None:
            new["xyz"] = numbers(joint.xyz + to_parent @ (position - mounting.position)).encode()
        if joint.origin is None:
            start = end = joint.tag[1]
            tag = b'<origin xyz="' + new.get("xyz", b"0 0 0") + b'" rpy="' + new["rpy"] + b'"/>'
        else:
            start, end = joint.origin
            tag = self.content[start:end]
            for name, text in new.items():
                tag = _with_attribute(tag, name, text)
        return self.content[:start] + tag + self.content[end:]


def numbers(values: Sequence[float] | Array) -> str:
    """Format numbers for a URDF attribute: nine digits, zero below 1e-12, no minus zero."""
    return " ".join(f"{round(float(value), 12) + 0.0:.9g}" for value in values)


def origin_tag(xyz: Sequence[float] | Array | None, rpy: Sequence[float] | Array) -> str:
    """Return a joint's origin to copy: xyz (3,) m to four digits, omitted if unknown; rpy (3,) rad to a microradian."""
    if xyz is None:
        return f'<origin rpy="{" ".join(f"{value + 0.0:.6f}" for value in rpy)}"/>'
    position = [float(f"{float(value):.4g}") for value in xyz]
    return f'<origin xyz="{numbers(position)}" rpy="{" ".join(f"{value + 0.0:.6f}" for value in rpy)}"/>'


def _is_link(link: str, frame: str) -> bool:
    """Return whether a frame id is a link's, with an optional namespace from robot_state_publisher."""
    return link == frame or link == frame.rsplit("/", 1)[-1]


def _with_attribute(tag: bytes, name: str, text: bytes) -> bytes:
    """Return a start tag with an attribute set, or added at the end."""
    found = re.compile(rb"(?<=\s)" + name.encode() + rb"""\s*=\s*("[^"]*"|'[^']*')""").search(tag)
    if found is not None:
        first, last = found.span(1)
        return tag[: first + 1] + text + tag[last - 1 :]
    end = len(tag) - (2 if tag.endswith(b"/>") else 1)
    return tag[:end].rstrip() + b" " + name.encode() + b'="' + text + b'"' + tag[end:]


def read_urdf(path: Path) -> Urdf:
    """Read a URDF's joints. Raises InputError if it is none, or has xacro macros."""
    content = read_file(path, "URDF", LARGEST_FILE)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: is UTF-16, which cannot be edited byte for byte; save it as UTF-8")
    return parse_urdf(path, content)


def parse_urdf(path: Path, content: bytes) -> Urdf:
    """Parse a URDF in memory as `read_urdf`; path: name in errors."""
    return _UrdfReader(path, content).read()


@dataclass
class _UrdfReader:
    """Walk through the elements of a URDF; only joints directly under the robot count."""

    path: Path
    content: bytes
    _open: list[str] = field(default_factory=list)
    _found: list[Joint] = field(default_factory=list)
    _joint: dict[str, dict[str, str]] = field(default_factory=dict)
    _spans: dict[str, tuple[int, int]] = field(default_factory=dict)
    _generated: bool = False

    def read(self) -> Urdf:
        """Parse the file. Raises InputError for invalid XML or unexpanded xacro."""
        self._parser = parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        parser.CommentHandler = self._comment
        try:
            parser.Parse(self.content, True)
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two are due to the encoding
            raise InputError(f"{self.path}: no URDF, not valid XML: {error}") from error
        return Urdf(self.path, self.content, tuple(self._found), self._generated)

    def _refuse_doctype(self, *_: object) -> None:
        raise InputError(f"{self.path}: has a document type declaration, which no URDF needs; remove it")

    def _comment(self, text: str) -> None:
        self._generated = self._generated or "autogenerated by xacro" in text

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        """Note the joints' elements and their byte ranges. Raises InputError for a file that is no URDF."""
        if name.startswith("xacro:"):
            raise InputError(
                f"{self.path}:{self._parser.CurrentLineNumber}: holds xacro macros ({name}); put the rpy that "
                "'dvl-calib apply RESULT' prints into them by hand, or expand them first: xacro FILE > robot.urdf"
            )
        if not self._open and name != "robot":
            raise InputError(f"{self.path}: not a URDF, its root is <{name}> and not <robot>")
        self._open.append(name)
        if self._open == ["robot", "joint"]:
            self._joint, self._spans = {"joint": attributes}, {"joint": self._span()}
        elif self._open[:2] == ["robot", "joint"] and len(self._open) == 3:
            self._joint.setdefault(name, attributes)
            self._spans.setdefault(name, self._span())

    def _end(self, name: str) -> None:
        if self._open == ["robot", "joint"]:
            self._found.append(self._finished_joint())
        self._open.pop()

    def _span(self) -> tuple[int, int]:
        """Return the bytes of the parser's current start tag."""
        start = self._parser.CurrentByteIndex
        found = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""").match(self.content, start)
        if found is None:
            raise InputError(f"{self.path}: its encoding cannot be edited byte for byte; save it as UTF-8")
        return found.span()

    def _finished_joint(self) -> Joint:
        """Return the joint whose element has just ended."""
        attributes, origin = self._joint["joint"], self._joint.get("origin", {})
        name = attributes.get("name", "")
        where = f"{self.path}: joint {name}"
        return Joint(
            name,
            attributes.get("type", ""),
            self._joint.get("parent", {}).get("link", ""),
            self._joint.get("child", {}).get("link", ""),
            _vector(where, "xyz", origin.get("xyz", "0 0 0")),
            _vector(where, "rpy", origin.get("rpy", "0 0 0")),
            self._spans["joint"],
            self._spans.get("origin"),
        )


def _vector(where: str, name: str, text: str) -> tuple[float, ...]:
    """Parse three numbers of an origin's attribute. Raises InputError."""
    if "$" in text:
        raise InputError(
            f"{where}: origin {name}={text!r} holds a xacro expression; expand it: xacro FILE > robot.urdf"
        )
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != 3 or not np.isfinite(values).all():
        raise InputError(f"{where}: origin {name}={text!r} is not three numbers")
    return values
