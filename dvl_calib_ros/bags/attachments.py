"""Attachments of MCAP recordings, which rosbags does not write."""

from __future__ import annotations

import os
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer


def attach(path: Path, name: str, media_type: str, data: bytes, compressed: bool) -> None:
    """Add an attachment to an MCAP file, which is written anew beside itself and then replaced."""
    new = path.with_name(f"{path.name}.tmp")
    with path.open("rb") as source, new.open("xb") as target:
        reader = make_reader(source)
        header = reader.get_header()
        writer = Writer(target, compression=CompressionType.ZSTD if compressed else CompressionType.NONE)
        writer.start(header.profile, header.library)
        channels: dict[int, int] = {}
        start_ns = 0
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if schema is not None and channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            start_ns = start_ns or message.log_time
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.add_attachment(start_ns, start_ns, name, media_type, data)
        writer.finish()  # type: ignore[no-untyped-call]
    os.replace(new, path)
