"""Recovery of damaged recordings into a new bag that every tool reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError
from .reader import BagReader
from .writer import BagWriter, Compression, Storage

PROGRESS_EVERY = 1000


class Recovered(NamedTuple):
    """Result of a recovery. counts: messages of each topic. notes: sentences on the losses."""

    counts: dict[str, int]
    notes: tuple[str, ...]


def recover(
    bags: Sequence[Path],
    output: Path,
    storage: Storage = Storage.MCAP,
    compression: Compression = Compression.NONE,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Recovered:
    """Write every readable message of every topic into a new bag. Raises InputError."""
    counts: Counter[str] = Counter()
    with BagReader(bags) as reader:
        topics, total = reader.topics, max(sum(reader.message_counts.values()), 1)
        if not topics:
            raise InputError(f"{', '.join(map(str, bags))}: there is no message in it; record it again")
        with BagWriter(output, storage, compression) as writer:
            for number, (log_ns, channel, data) in enumerate(reader.raw_messages(topics)):
                writer.raw(channel, log_ns, data)
                counts[channel.topic] += 1
                if number % PROGRESS_EVERY == 0:
                    on_progress(number / total)
        return Recovered(dict(sorted(counts.items())), tuple(reader.notes))
