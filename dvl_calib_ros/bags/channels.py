"""Channels of a recording, and how their messages are decoded: by the definition that each brings along."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from .definitions import Definition, DefinitionError, is_empty, known_typestore, typestore

FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
# What damaged bytes, or a definition that does not fit them, make rosbags' generated decoders raise
_DECODING = (SerdeError, struct.error, ValueError, LookupError, OverflowError, RecursionError)


class Channel(NamedTuple):
    """Messages of one topic, type and definition; a recording can hold two of one topic."""

    topic: str
    msgtype: str
    definition: Definition | None = None


class DecodingError(Exception):
    """A message that cannot be decoded, and why."""


def definition_of(encoding: str, text: str) -> Definition:
    """A definition as recordings name its format."""
    return Definition(FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)


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
                with suppress(*_DECODING):
                    message = store.deserialize_cdr(data, channel.msgtype)
                    self._stores[channel] = [store]
                    return message
            return stores[-1].deserialize_cdr(data, channel.msgtype)
        except (SerdeError, DefinitionError) as error:
            raise DecodingError(str(error)) from error
        except _DECODING as error:
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
