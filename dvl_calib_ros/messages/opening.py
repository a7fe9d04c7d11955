"""Recordings opened with all that is known of message types."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..bags.reader import BagReader
from .drivers import KNOWN_DEFINITIONS, VELOCITY_TYPES
from .recognised import recognised


def open_bags(paths: Sequence[Path]) -> BagReader:
    """A reader of recordings whose types are recognised. Raises InputError for what is no bag."""
    bag = BagReader(paths, KNOWN_DEFINITIONS)
    for topic, name in bag.topics.items():
        if name not in VELOCITY_TYPES:
            recognised(name, bag.fields_of(topic))
    return bag
