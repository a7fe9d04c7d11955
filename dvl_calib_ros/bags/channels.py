"""Channels of a recording, and the message definitions that they bring along.

rosbags generates a class and its decoder from a definition and runs the code. What a definition decides in that code is
names, numbers and values of constants; here names must be plain, numbers bounded, and constants are left out.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from typing import Any, NamedTuple

from rosbags.interfaces import MessageDefinitionFormat, Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

FORMATS = {
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
# What damaged bytes, or a definition that does not fit them, make rosbags' generated decoders raise
DECODING = (SerdeError, struct.error, ValueError, LookupError, OverflowError, RecursionError)


class Channel(NamedTuple):
    """Messages of one topic, type and definition; a recording can hold two of one topic."""

    topic: str
    msgtype: str
    definition: Definition | None = None


class DecodingError(Exception):
    """A message that cannot be decoded, and why."""


def definition_of(encoding: str, text: str) -> Definition:
    """A definition as recordings name its format."""
    return Definition(FORMATS.get(encoding, MessageDefinitionFormat.NONE), text, encoding == "ros1msg")


class Decoder:
    """Decodes the messages of any channels.

    known: type -> definitions of it that are about, the likeliest first, for recordings that bring none.
    """

    def __init__(self, known: Mapping[str, Sequence[str]] | None = None) -> None:
        self._known = known or {}
        self._stores: dict[Channel, list[Typestore] | DefinitionError] = {}
        self._by_definition: dict[tuple[str, Definition | None], list[Typestore]] = {}

    def lacks_definition(self, channel: Channel) -> bool:
        """Whether a channel is of a type that ROS does not bring, and does not say how it is laid out."""
        return channel.msgtype in self._known and is_empty(channel.definition)

    def typestore(self, channel: Channel) -> Typestore | None:
        """The one that decodes all of a channel's messages; None if that is not known (yet)."""
        with suppress(DefinitionError):
            stores = self._typestores(channel)
            return stores[0] if len(stores) == 1 else None
        return None

    def __call__(self, channel: Channel, data: bytes) -> Any:
        """A message, by the definition of its channel, else by those known. Raises DecodingError."""
        try:
            stores = self._typestores(channel)
            for store in stores[:-1]:  # of several versions, the one that a message fits from beginning to end
                with suppress(*DECODING):
                    message = store.deserialize_cdr(data, channel.msgtype)
                    self._stores[channel] = [store]
                    return message
            return _decoded(stores[-1], data, channel.msgtype)
        except (SerdeError, DefinitionError) as error:
            raise DecodingError(str(error)) from error
        except DECODING as error:
            raise DecodingError(f"{type(error).__name__}: {error}") from error

    def _typestores(self, channel: Channel) -> list[Typestore]:
        stores = self._stores.get(channel)
        if stores is None:
            try:
                stores = self._made(channel)
            except DefinitionError as error:  # once, not for every message
                stores = error
            self._stores[channel] = stores
        if isinstance(stores, DefinitionError):
            raise stores
        return stores

    def _made(self, channel: Channel) -> list[Typestore]:
        _, msgtype, definition = channel
        key = (msgtype, definition)
        if key not in self._by_definition:
            texts = self._known.get(msgtype, ()) if is_empty(definition) else ()
            stores = [known_typestore(msgtype, text) for text in texts] or [typestore(definition, msgtype)]
            self._by_definition[key] = stores
        return self._by_definition[key]


def _decoded(store: Typestore, data: bytes, msgtype: str) -> Any:
    """Decode a message; some recorders pad it with zeros to a multiple of 4 or 8 bytes, which rosbags refuses."""
    if data[:2] not in PLAIN_CDR:
        raise SerdeError(f"it begins with {data[:2].hex(' ') or 'nothing'}, plain CDR with 00 00 or 00 01")
    try:
        return store.deserialize_cdr(data, msgtype)
    except KeyError as error:
        raise DefinitionError(f"the definition of {msgtype} lacks that of {error.args[0]}") from error
    except SerdeError as error:
        if _TOO_LONG not in str(error):
            raise
        for padding in (4, 8):
            if not any(data[-padding:]):
                with suppress(SerdeError):
                    return store.deserialize_cdr(data[:-padding], msgtype)
        raise DefinitionError(f"it is longer than a {msgtype}; its definition may be of another version") from error


# What rosbags says of a message with more bytes behind its end than the three of padding that it takes
_TOO_LONG = "size mismatch"
# Big-endian and little-endian
PLAIN_CDR = (b"\0\0", b"\0\1")

# Of the definitions that ROS ships the longest has 9 kB, with all that is nested in it, and the largest array 48.
LONGEST_DEFINITION = 1 << 18
LARGEST_ARRAYS = 1 << 16
# Types made of definitions that are kept: making them takes longer than reading a minute, and recordings are alike.
KEPT = 32
_FIELD = re.compile(r"[A-Za-z]\w*", re.ASCII)
_TYPE = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
# rosbags evaluates the constants of IDL: a shift can take all memory, and nested brackets for ever to parse
_EXPENSIVE_IDL = re.compile(r"<<|\(\s*\(\s*\(")
SEPARATOR = "=" * 80 + "\n"


class Definition(NamedTuple):
    """The text of a message definition. is_ros1: whether its messages are laid out as ROS 1 does (ros1.py)."""

    format: MessageDefinitionFormat
    text: str
    is_ros1: bool = False


class DefinitionError(Exception):
    """A definition that cannot be used."""


def is_empty(definition: Definition | None) -> bool:
    """Whether a recording does not say how messages are laid out; those of before ROS 2 Iron do not."""
    return definition is None or definition.format is MessageDefinitionFormat.NONE or not definition.text.strip()


@lru_cache(maxsize=KEPT)
def known_typestore(msgtype: str, text: str) -> Typestore:
    """Jazzy's types and one that a definition is known of, in MSG format."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, msgtype))
    return store


@lru_cache(maxsize=KEPT)
def typestore(definition: Definition | None, msgtype: str) -> Typestore:
    """Types for a message: from its definition, or Jazzy's if that is empty. Raises DefinitionError."""
    if definition is None or is_empty(definition):
        return get_typestore(Stores.ROS2_JAZZY)
    try:
        return _typestore(definition, msgtype)
    except DefinitionError:
        raise
    except Exception as error:
        # The parser raises all sorts of things on what is damaged; one that parses nothing at all is not damage.
        _typestore(_SOUND[definition.format], "a/msg/B")
        raise DefinitionError(f"the definition of {msgtype} is damaged ({type(error).__name__})") from error


def _typestore(definition: Definition, msgtype: str) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    store.register(_harmless(_parsed(definition, msgtype)))
    return store


_SOUND = {
    MessageDefinitionFormat.MSG: Definition(MessageDefinitionFormat.MSG, "int32 a\nfloat64[9] b\n"),
    MessageDefinitionFormat.IDL: Definition(
        MessageDefinitionFormat.IDL, "module a { module msg { struct B { long x; }; }; };"
    ),
}


def _parsed(definition: Definition, msgtype: str) -> dict[str, Any]:
    if len(definition.text) > LONGEST_DEFINITION:
        raise DefinitionError(f"the definition of {msgtype} has {len(definition.text)} characters")
    if definition.format is MessageDefinitionFormat.MSG:
        return dict(get_types_from_msg(definition.text, msgtype))
    if _EXPENSIVE_IDL.search(definition.text):
        raise DefinitionError(f"the definition of {msgtype} has constants that are computed")
    types: dict[str, Any] = {}
    for part in definition.text.split(SEPARATOR):
        idl = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if idl.strip():
            types.update(get_types_from_idl(idl))
    return types


def _harmless(types: dict[str, Any]) -> dict[str, Any]:
    """The types without their constants. Raises DefinitionError for what no driver defines."""
    arrays = 0
    for name, (_, fields) in types.items():
        for field, (kind, description) in fields:
            if not _TYPE.fullmatch(name) or not _FIELD.fullmatch(field):
                raise DefinitionError(f"{name!r} or its field {field!r} is no name")
            if kind == Nodetype.ARRAY:  # decoders have a line of code for each element
                arrays += description[1]
    if arrays > LARGEST_ARRAYS:
        raise DefinitionError(f"arrays of {arrays} elements")
    _check_finite(types)
    return {name: ([], fields) for name, (_, fields) in types.items()}


def _check_finite(types: dict[str, Any]) -> None:
    """Raise DefinitionError for a type that contains itself."""
    inner = {name: {_named(description) for _, description in fields} for name, (_, fields) in types.items()}
    try:
        TopologicalSorter(inner).prepare()
    except CycleError as error:
        raise DefinitionError(f"the definition of {min(error.args[1])} contains itself") from error


def _named(description: Any) -> str:
    """Return the type that a field holds, or holds many of; '' for numbers and strings."""
    kind, what = description
    while kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, what = what[0]
    return str(what) if kind == Nodetype.NAME else ""
