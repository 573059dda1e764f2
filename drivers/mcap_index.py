"""Reads the index of a whole MCAP file: place, first and last log time of its chunks, without unpacking them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema

from drivers.mcap_records import MAGIC, MAX_RECORD_BYTES, PARSE_ERRORS, Segment, stream

_HEAD = struct.Struct("<BQ")
_DATA_END = _HEAD.size + 4
_FOOTER = _HEAD.size + 20
_READ_BYTES = 1 << 20


class Index(NamedTuple):
    """Summary section of a file."""

    library: str
    """Name of the library that wrote the file."""
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    chunks: list[tuple[int, int, Segment]]
    """Smallest and largest log time (ns) and place of each chunk."""


def read_index(path: Path) -> Index | None:
    """Read the index of a file, if the checksums of the data section and of the index are present and right; else None.

    None does not mean that the file is damaged: read it through.
    """
    try:
        with path.open("rb") as file:
            return _read(file, path.stat().st_size)
    except (OSError, *PARSE_ERRORS):
        return None


def _read(file: BinaryIO, size: int) -> Index | None:
    """Read footer, summary and header of a file of `size` bytes, and verify the checksums."""
    file.seek(size - len(MAGIC) - _FOOTER)
    tail = file.read()
    footer = Footer.read(stream(tail[_HEAD.size : _FOOTER]))
    begin, length = footer.summary_start, size - len(MAGIC) - _FOOTER - footer.summary_start
    if (
        tail[_FOOTER:] != MAGIC
        or tail[0] != Opcode.FOOTER
        or not (0 < begin < size and 0 <= length <= MAX_RECORD_BYTES)
    ):
        return None
    file.seek(begin)
    summary = file.read(length)
    crc = zlib.crc32(tail[: _FOOTER - 4], zlib.crc32(summary))
    if footer.summary_crc != crc or not _data_is_whole(file, begin - _DATA_END):
        return None
    file.seek(len(MAGIC))
    opcode, length = _HEAD.unpack(file.read(_HEAD.size))
    header = Header.read(stream(file.read(min(length, 1 << 16))))
    index = Index(header.library, {}, {}, [])
    _parse_summary(index, summary)
    return index if opcode == Opcode.HEADER else None


def _data_is_whole(file: BinaryIO, length: int) -> bool:
    """Test whether the checksum of the data section, which is `length` bytes long, is present and right."""
    file.seek(0)
    crc, left = 0, length
    while left > 0:
        piece = file.read(min(left, _READ_BYTES))
        crc, left = zlib.crc32(piece, crc), left - len(piece)
    opcode, stated, expected = struct.unpack("<BQI", file.read(_DATA_END))
    return bool(opcode == Opcode.DATA_END and stated == 4 and expected == crc)


def _parse_summary(index: Index, summary: bytes) -> None:
    """Add the schemas, channels and chunks of a summary section to the index."""
    position = 0
    while position < len(summary):
        opcode, length = _HEAD.unpack_from(summary, position)
        body = summary[position + _HEAD.size : position + _HEAD.size + length]
        position += _HEAD.size + length
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream(body))
            index.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream(body))
            index.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            chunk = ChunkIndex.read(stream(body))
            place = Segment(chunk.chunk_start_offset, chunk.chunk_length, True)
            index.chunks.append((chunk.message_start_time, chunk.message_end_time, place))
