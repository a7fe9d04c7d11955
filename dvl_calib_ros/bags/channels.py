"""Channels of a recording, and their embedded message definitions.

rosbags generates a class and its decoder from a definition and runs that code. A definition contributes names, numbers
and constants to it. Here names must be plain, numbers are bounded, and constants are removed.
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
# exceptions of rosbags' generated decoders for damaged bytes or an unsuitable definition
DECODING = (SerdeError, struct.error, ValueError, LookupError, OverflowError, RecursionError)


class Channel(NamedTuple):
    """Messages of one topic, type and definition; a recording can have two for one topic."""

    topic: str
    msgtype: str
    definition: Definition | None = None


class DecodingError(Exception):
    """A message cannot be decoded; the text says why."""


def definition_of(encoding: str, text: str) -> Definition:
    """Return a definition by a recording's name of its format."""
    return Definition(FORMATS.get(encoding, MessageDefinitionFormat.NONE), text, encoding == "ros1msg")


class Decoder:
    """Decoder of messages of any channel.

    known: type -> known versions of its definition, the most likely first, for recordings without.
    """

    def __init__(self, known: Mapping[str, Sequence[str]] | None = None) -> None:
        self._known = known or {}
        self._stores: dict[Channel, list[Typestore] | DefinitionError] = {}
        self._by_definition: dict[tuple[str, Definition | None], list[Typestore]] = {}

    def lacks_definition(self, channel: Channel) -> bool:
        """Return whether a channel's type is neither in ROS nor defined in the recording."""
        return channel.msgtype in self._known and is_empty(channel.definition)

    def typestore(self, channel: Channel) -> Typestore | None:
        """Return the type store that decodes all of a channel's messages; None if unknown so far."""
        with suppress(DefinitionError):
            stores = self._typestores(channel)
            return stores[0] if len(stores) == 1 else None
        return None

    def __call__(self, channel: Channel, data: bytes) -> Any:
        """Decode a message by its channel's definition, else by the known ones. Raises DecodingError."""
        try:
            stores = self._typestores(channel)
            for store in stores[:-1]:  # of several versions, use the one that fits a message completely
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
        """Return the type stores of a channel, cached. Raises DefinitionError."""
        stores = self._stores.get(channel)
        if stores is None:
            try:
                stores = self._make_typestores(channel)
            except DefinitionError as error:  # raise the stored error for every message, without parsing again
                stores = error
            self._stores[channel] = stores
        if isinstance(stores, DefinitionError):
            raise stores
        return stores

    def _make_typestores(self, channel: Channel) -> list[Typestore]:
        """Build the type stores of a channel: from its definition, or from all known ones of its type."""
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
        raise SerdeError(f"it begins with {data[:2].hex(' ') or 'nothing'}, but plain CDR begins with 00 00 or 00 01")
    try:
        return store.deserialize_cdr(data, msgtype)
    except KeyError as error:
        raise DefinitionError(f"the definition of {msgtype} lacks the definition of {error.args[0]}") from error
    except SerdeError as error:
        if _TOO_LONG not in str(error):
            raise
        for padding in (4, 8):
            if not any(data[-padding:]):
                with suppress(SerdeError):
                    return store.deserialize_cdr(data[:-padding], msgtype)
        raise DefinitionError(f"it is longer than a {msgtype}; its definition may be of another version") from error


# rosbags' text for a message with more than three bytes of padding
_TOO_LONG = "size mismatch"
# big-endian and little-endian
PLAIN_CDR = (b"\0\0", b"\0\1")

# the longest definition in ROS has 9 kB, including nested ones, and the largest array 48 elements
LONGEST_DEFINITION = 1 << 18
LARGEST_ARRAY = 1 << 16
# a decoder has a line of code per field and array element, and is compiled in 0.3 ms per line
MOST_VALUES = 1 << 13
# number of cached type stores: making one takes longer than reading a minute, and recordings share them
KEPT = 32
_FIELD = re.compile(r"[A-Za-z]\w*", re.ASCII)
_TYPE = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
# rosbags evaluates constants of IDL: a shift can take all memory, and nested brackets can parse for ever
_EXPENSIVE_IDL = re.compile(r"<<|\(\s*\(\s*\(")
SEPARATOR = "=" * 80 + "\n"


class Definition(NamedTuple):
    """Text of a message definition. is_ros1: whether its messages have ROS 1's layout (sources.py)."""

    format: MessageDefinitionFormat
    text: str
    is_ros1: bool = False


class DefinitionError(Exception):
    """A definition cannot be used."""


def is_empty(definition: Definition | None) -> bool:
    """Return whether a recording lacks the message definition, as before ROS 2 Iron."""
    return definition is None or definition.format is MessageDefinitionFormat.NONE or not definition.text.strip()


@lru_cache(maxsize=KEPT)
def known_typestore(msgtype: str, text: str) -> Typestore:
    """Return Jazzy's types and one with a known definition, in MSG format."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, msgtype))
    return store


@lru_cache(maxsize=KEPT)
def typestore(definition: Definition | None, msgtype: str) -> Typestore:
    """Return types for a message: from its definition, or Jazzy's if it is empty. Raises DefinitionError."""
    if definition is None or is_empty(definition):
        return get_typestore(Stores.ROS2_JAZZY)
    try:
        return _typestore(definition, msgtype)
    except DefinitionError:
        raise
    except Exception as error:
        # The parser raises many types for damaged text. If it fails on a sound definition too, this is no damage.
        _typestore(_SOUND[definition.format], "a/msg/B")
        raise DefinitionError(f"the definition of {msgtype} is damaged ({type(error).__name__})") from error


def _typestore(definition: Definition, msgtype: str) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    store.register(_without_constants(_parsed(definition, msgtype)))
    return store


_SOUND = {
    MessageDefinitionFormat.MSG: Definition(MessageDefinitionFormat.MSG, "int32 a\nfloat64[9] b\n"),
    MessageDefinitionFormat.IDL: Definition(
        MessageDefinitionFormat.IDL, "module a { module msg { struct B { long x; }; }; };"
    ),
}


def _parsed(definition: Definition, msgtype: str) -> dict[str, Any]:
    """Parse a definition (MSG or IDL). Raises DefinitionError for one too expensive to parse."""
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


def _without_constants(types: dict[str, Any]) -> dict[str, Any]:
    """Remove the constants from message types. Raises DefinitionError for an invalid name or array size."""
    for name, (_, fields) in types.items():
        for field, (kind, description) in fields:
            if not _TYPE.fullmatch(name) or not _FIELD.fullmatch(field):
                raise DefinitionError(f"{name!r} or its field {field!r} is no name")
            # no elements take no bytes: a sequence of such messages would be decoded for ever
            if kind == Nodetype.ARRAY and not 0 < description[1] <= LARGEST_ARRAY:
                raise DefinitionError(f"{field} is an array of {description[1]} elements")
    _check_finite(types)
    return {name: ([], fields) for name, (_, fields) in types.items()}


def _check_finite(types: dict[str, Any]) -> None:
    """Raise DefinitionError for a type that contains itself, or too many fields; a sequence counts as one element."""
    inner = {name: {_message_type_of(description) for _, description in fields} for name, (_, fields) in types.items()}
    try:
        order = [*TopologicalSorter(inner).static_order()]
    except CycleError as error:
        raise DefinitionError(f"the definition of {min(error.args[1])} contains itself") from error
    sizes: dict[str, int] = {}
    for name in order:
        _, fields = types.get(name, ((), ()))
        sizes[name] = max(1, sum(_n_values(description, sizes) for _, description in fields))
        if sizes[name] > MOST_VALUES:
            raise DefinitionError(f"the definition of {name} unfolds to more than {MOST_VALUES} fields")


def _n_values(description: Any, sizes: Mapping[str, int]) -> int:
    """Return the number of values that are decoded for a field; numbers of an array are decoded at once."""
    kind, detail = description
    size = sizes[_message_type_of(description)]
    if kind != Nodetype.ARRAY:
        return size
    (element, element_what), n_elements = detail
    is_number = element == Nodetype.BASE and element_what[0] not in ("string", "wstring")
    return size if is_number else size * int(n_elements)


def _message_type_of(description: Any) -> str:
    """Return the message type of a field or of its elements; '' for numbers and strings."""
    kind, detail = description
    while kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, detail = detail[0]
    return str(detail) if kind == Nodetype.NAME else ""
