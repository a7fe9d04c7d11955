"""Messages read as columns are what rosbags makes of each, whatever their definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import searched
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import JAZZY
from rosbags.interfaces import MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_typestore

from dvl_calib_ros.bags.channels import Definition, typestore
from dvl_calib_ros.bags.columns import MessageColumns, NoLayoutError, layout_of

NUMBERS = (
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    "float32",
    "float64",
    "byte",
    "char",
)
SEPARATOR = "=" * 80 + "\n"
Values = np.random.Generator


@st.composite
def definitions(draw: st.DrawFn) -> str:
    """A type with nested types of any fields but sequences, up to three levels deep."""
    parts = []
    for level in range(draw(st.integers(0, 3)), -1, -1):
        below = [f"a/T{level + 1}"] if parts else []
        kinds = st.sampled_from([*NUMBERS, "bool", "string", *below])
        lines = []
        for number in range(draw(st.integers(1, 5))):
            size = draw(st.sampled_from(["", "", "", "[1]", "[3]"]))
            lines.append(f"{draw(kinds)}{size} f{number}\n")
        parts.append((f"{SEPARATOR}MSG: a/T{level}\n" if level else "") + "".join(lines))
    return "".join(reversed(parts))


def items(messages: list[bytes]) -> Any:
    """Messages of one length as an array of them."""
    return np.frombuffer(b"".join(messages), dtype=("V", len(messages[0])))


def made(store: Any, msgtype: str, rng: Values, length: int) -> Any:
    """A message of random values, with strings of a length."""
    return store.types[msgtype](
        *(value(store, description, rng, length) for _, description in store.get_msgdef(msgtype).fields)
    )


def value(store: Any, description: Any, rng: Values, length: int) -> Any:
    kind, what = description
    if kind == Nodetype.NAME:
        return made(store, what, rng, length)
    if kind == Nodetype.ARRAY:
        of, size = what
        values = [value(store, of, rng, length) for _ in range(size)]
        is_number = of[0] == Nodetype.BASE and of[1][0] != "string"
        return np.array(values, dtype=numpy_type(of[1][0])) if is_number else values
    name = what[0]
    if name == "string":
        return "".join(map(chr, rng.integers(32, 127, length)))
    if name == "bool":
        return bool(rng.integers(2))
    return np.frombuffer(rng.bytes(8), dtype=numpy_type(name))[0].item()


def numpy_type(name: str) -> Any:
    return np.dtype({"bool": "?", "byte": "i1", "char": "u1"}.get(name, name))


def leaves(message: Any, path: str = "") -> dict[str, Any]:
    """Path -> value, of a message as rosbags has it."""
    if hasattr(message, "__dataclass_fields__"):
        found = {}
        for name in message.__dataclass_fields__:
            if name != "__msgtype__":
                found |= leaves(getattr(message, name), f"{path}.{name}" if path else name)
        return found
    if isinstance(message, list):
        found = {}
        for number, each in enumerate(message):
            found |= leaves(each, f"{path}[{number}]")
        return found
    if isinstance(message, np.ndarray) and message.dtype == bool:
        return {f"{path}[{number}]": each for number, each in enumerate(message.tolist())}
    return {path: message}


@searched(150)
@given(definitions(), st.integers(0, 2**32 - 1), st.booleans(), st.integers(0, 9))
def test_columns_hold_what_rosbags_reads_of_each_message(text, seed, is_little, length):
    store = typestore(Definition(MessageDefinitionFormat.MSG, text), "a/msg/T")
    rng = np.random.default_rng(seed)
    messages = [
        bytes(store.serialize_cdr(made(store, "a/msg/T", rng, length), "a/msg/T", little_endian=is_little))
        for _ in range(5)
    ]
    layout = layout_of(store, "a/msg/T", messages[0])
    rows = layout.view(items(messages))
    assert layout.shared(rows).all()
    for row, data in zip(rows, messages, strict=True):
        for path, expected in leaves(store.deserialize_cdr(data, "a/msg/T")).items():
            if isinstance(expected, str):
                found = row[path].tobytes().decode() if length else ""
                assert found == expected
            else:
                found = row[path] != 0 if path in layout.flags else row[path]
                assert np.array_equal(found, expected, equal_nan=isinstance(expected, float | np.ndarray))
    whole = MessageColumns(layout, rows)
    assert len(whole) == len(whole.part(slice(0, 5))) == 5


@searched(60)
@given(definitions(), st.integers(0, 2**32 - 1), st.integers(0, 9), st.integers(0, 9))
def test_a_message_with_strings_of_other_lengths_is_never_taken_for_one_of_the_layout(text, seed, length, other):
    store = typestore(Definition(MessageDefinitionFormat.MSG, text), "a/msg/T")
    rng = np.random.default_rng(seed)
    first, second = (
        bytes(store.serialize_cdr(made(store, "a/msg/T", rng, each), "a/msg/T")) for each in (length, other)
    )
    layout = layout_of(store, "a/msg/T", first)
    if layout.lengths and length != other and len(first) == len(second):
        assert layout.shared(layout.view(items([first, second]))).tolist() == [True, False]


def test_every_type_of_ros_without_sequences_has_a_layout():
    store = get_typestore(Stores.ROS2_JAZZY)
    rng = np.random.default_rng(1)
    n = 0
    for msgtype in store.fielddefs:
        if "/msg/" not in msgtype or "equence" in str(nested(store, msgtype)) or "float128" in msgtype:
            continue
        layout_of(store, msgtype, bytes(store.serialize_cdr(made(store, msgtype, rng, 4), msgtype)))
        n += 1
    assert n > 80


def nested(store: Any, msgtype: str) -> list[Any]:
    """All field descriptions in a type."""
    found = []
    for _, (kind, what) in store.get_msgdef(msgtype).fields:
        found.append("sequence" if kind == Nodetype.SEQUENCE else "")
        inner = what[0] if kind == Nodetype.ARRAY else (kind, what)
        if inner[0] == Nodetype.NAME:
            found += nested(store, inner[1])
    return found


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data[:-5], lambda data: data + bytes(4), lambda data: b"\0\2" + data[2:],
        lambda data: data[:12] + b"\xff\xff\xff\x7f" + data[16:], lambda data: data[:12] + bytes(4) + data[16:],
        lambda data: data.replace(b"base_link\0", b"base_link\1"), lambda data: data.replace(b"base", b"b\xffse"),
        lambda data: data[:2], lambda data: b"",
    ],
)  # fmt: skip
def test_a_message_that_rosbags_refuses_or_that_is_not_ascii_has_no_layout_and_is_not_taken_for_one(change):
    imu = made(JAZZY, "sensor_msgs/msg/Imu", np.random.default_rng(1), 9)
    imu.header.frame_id = "base_link"
    sound = bytes(JAZZY.serialize_cdr(imu, "sensor_msgs/msg/Imu"))
    damaged = change(sound)
    assert damaged != sound
    with pytest.raises(NoLayoutError):
        layout_of(JAZZY, "sensor_msgs/msg/Imu", damaged)
    layout = layout_of(JAZZY, "sensor_msgs/msg/Imu", sound)
    if len(damaged) == len(sound):
        assert layout.shared(layout.view(items([sound, damaged]))).tolist() == [True, False]


def test_a_field_that_is_none_is_an_attribute_error_as_of_a_message():
    imu = made(JAZZY, "sensor_msgs/msg/Imu", np.random.default_rng(1), 9)
    data = bytes(JAZZY.serialize_cdr(imu, "sensor_msgs/msg/Imu"))
    columns = MessageColumns(layout := layout_of(JAZZY, "sensor_msgs/msg/Imu", data), layout.view(items([data])))
    assert columns.orientation.x.shape == (1,)
    with pytest.raises(AttributeError, match=r"orientation\.q"):
        _ = columns.orientation.q
