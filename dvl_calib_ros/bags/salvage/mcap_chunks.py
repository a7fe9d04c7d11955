"""Chunks of MCAP files, unpacked as far as they are sound: what is unpacked is bounded, and checked.

A chunk whose checksum does not match gives nothing: some of it is wrong, and nothing says which.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from mcap.records import ChunkIndex

from ..raw_file import Hole, holes_in
from .damage import LARGEST_RECORD, DamagedError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, unpacked size, CRC, length of the compression's name
_LONGEST_CHUNK_HEAD = _CHUNK_HEAD.size + len("zstd") + 8
SMALL_PIECE = 16


class ChunkHead(NamedTuple):
    """What stands before a chunk's records; size: of that itself, after the record's opcode and length."""

    unpacked_size: int
    checksum: int
    compression: str
    size: int
    packed_size: int

    @classmethod
    def of_index(cls, index: ChunkIndex) -> ChunkHead:
        """As the index at the end of the file has it, which knows no checksum."""
        size = _CHUNK_HEAD.size + len(index.compression.encode()) + 8
        return cls(index.uncompressed_size, 0, index.compression, size, index.compressed_size)


class Chunk(NamedTuple):
    """records: what could be unpacked. damage: '' if that is all. is_believed: nothing says that they are wrong.

    holes: what in the records is not their content, because the disk cannot read it.
    """

    records: bytes
    damage: str
    is_believed: bool
    end: int
    holes: Sequence[Hole] = ()


def chunk_head(file: BinaryIO, at: int) -> ChunkHead:
    """The head of the chunk whose record is at `at`; DamagedError if there is none."""
    start = at + RECORD_HEAD.size
    file.seek(start)
    head = file.read(_LONGEST_CHUNK_HEAD)
    try:
        _, _, unpacked_size, checksum, name_length = _CHUNK_HEAD.unpack_from(head)
        end_of_name = _CHUNK_HEAD.size + name_length
        (packed_size,) = struct.unpack_from("<Q", head, end_of_name)
        compression = head[_CHUNK_HEAD.size : end_of_name].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError(f"the head of the chunk at byte {at} is cut off or damaged") from error
    if compression not in _DECOMPRESS:
        raise DamagedError(f"the chunk at byte {at} has unknown compression {compression!r}")
    if holes_in(file, at, start + end_of_name + 8):
        raise DamagedError(f"the head of the chunk at byte {at} cannot be read from the disk")
    return ChunkHead(unpacked_size, checksum, compression, end_of_name + 8, packed_size)


def is_chunk(file: BinaryIO, at: int, length: int) -> bool:
    """Whether a record is a chunk in all but its opcode."""
    with suppress(DamagedError):
        head = chunk_head(file, at)
        return head.size + head.packed_size == length and 0 < head.unpacked_size <= LARGEST_RECORD
    return False


def open_chunk(file: BinaryIO, at: int, length: int, size: int, index: ChunkIndex | None = None) -> Chunk:
    """Unpack a chunk. Its length is there twice: of the two, either may be what is damaged.

    index: what the end of the file says of it, to be used instead of a head that the disk cannot read.
    """
    if index is not None and index.compression in _DECOMPRESS:
        head = ChunkHead.of_index(index)
        length = head.size + head.packed_size
    else:
        head = chunk_head(file, at)
    lengths = [each for each in (head.packed_size, length - head.size) if 0 <= each <= LARGEST_RECORD]
    if not lengths or head.unpacked_size > LARGEST_RECORD:
        raise DamagedError(f"the chunk at byte {at} claims more than {LARGEST_RECORD} bytes")
    start = at + RECORD_HEAD.size + head.size
    chunk = _unpack_chunk(file, at, start, head, lengths[0], size)
    if chunk.damage and lengths[1:] and lengths[1] != lengths[0]:
        other = _unpack_chunk(file, at, start, head, lengths[1], size)
        return chunk if other.damage else other
    return chunk


def _unpack_chunk(file: BinaryIO, at: int, start: int, head: ChunkHead, packed_size: int, size: int) -> Chunk:
    file.seek(start)
    packed = file.read(packed_size)
    is_cut = len(packed) < packed_size
    end = min(start + packed_size, size)
    if holes := [(first - start, last - start) for first, last in holes_in(file, start, start + len(packed))]:
        lost = sum(last - first for first, last in holes)
        damage = f"{lost} bytes of the chunk at byte {at} cannot be read from the disk"
        if head.compression:  # nothing can be unpacked behind what is missing
            return Chunk(_DECOMPRESS[head.compression](packed[: holes[0][0]], head.unpacked_size), damage, True, end)
        return Chunk(packed, damage, True, end, holes)
    records = _DECOMPRESS[head.compression](packed, head.unpacked_size)
    damage = ""
    if is_cut:
        damage = f"the chunk at byte {at} is cut off"
    elif head.checksum and crc32(records) != head.checksum:
        damage = f"the checksum of the chunk at byte {at} does not match"
    elif len(records) != head.unpacked_size:
        damage = f"the chunk at byte {at} is damaged"
    return Chunk(records, damage, is_cut or not head.checksum or not damage, end)


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    return _unpack_start(zstd.ZstdDecompressor, packed, size)


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    import lz4.frame

    return _unpack_start(lz4.frame.LZ4FrameDecompressor, packed, size)


_DECOMPRESS: Mapping[str, Callable[[bytes, int], bytes]] = {
    "": lambda packed, _: packed,
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
}


def _unpack_start(new: Callable[[], Any], packed: bytes, size: int) -> bytes:
    """What a decompressor makes of `packed`, up to the damage, and no more than `size` bytes and one.

    A decompressor that meets damage withholds all that the call would have returned. So what is damaged is fed again
    in small pieces, for the damage to cost what comes after it and not what comes before.
    """
    with suppress(zstd.ZstdError, RuntimeError, EOFError):  # sound, as nearly all are: nothing is copied
        decompressor = new()
        whole: bytes = decompressor.decompress(packed, max_length=size + 1)
        if decompressor.eof and not decompressor.unused_data:
            return whole
    output = bytearray()
    for piece in (len(packed) or 1, SMALL_PIECE):
        decompressor, output = new(), bytearray()
        try:
            for start in range(0, len(packed), piece):
                fed = packed[start : start + piece]
                while fed and len(output) <= size:
                    output += decompressor.decompress(fed, max_length=size + 1 - len(output))
                    fed = decompressor.unused_data if decompressor.eof else b""
                    decompressor = new() if fed else decompressor
            break
        except (zstd.ZstdError, RuntimeError, EOFError):  # RuntimeError: lz4's
            continue
    return bytes(output)
