"""Reads the index of a whole MCAP file: place, first and last log time of its chunks, without unpacking them."""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Header

from drivers.mcap_records import HEAD, MAGIC, MAX_RECORD_BYTES, PARSE_ERRORS, McapFile, Segment, stream

_DATA_END = HEAD.size + 4
_FOOTER = HEAD.size + 20
_READ_BYTES = 1 << 20


def read_index(recording: McapFile, library: str) -> list[tuple[int, int, Segment]] | None:
    """Read channels and schemas of a file, and return smallest and largest log time (ns) and place of each chunk.

    None where that is not to be relied on: another `library` wrote the file, or the checksum of the data section or of the
    index is absent or wrong.  It does not mean that the file is damaged: read it through.
    """
    try:
        with recording.path.open("rb") as file:
            summary = _summary(file, recording.path.stat().st_size, library)
            return None if summary is None else _chunks(recording, summary)
    except (OSError, *PARSE_ERRORS):
        return None


def _summary(file: BinaryIO, size: int, library: str) -> bytes | None:
    """Read footer, summary and header of a file of `size` bytes, and verify library and checksums."""
    file.seek(size - len(MAGIC) - _FOOTER)
    tail = file.read()
    footer = Footer.read(stream(tail[HEAD.size : _FOOTER]))
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
    opcode, length = HEAD.unpack(file.read(HEAD.size))
    header = Header.read(stream(file.read(min(length, 1 << 16))))
    return summary if opcode == Opcode.HEADER and header.library == library else None


def _data_is_whole(file: BinaryIO, length: int) -> bool:
    """Test whether the checksum of the data section, which is `length` bytes long, is present and right."""
    file.seek(0)
    crc, left = 0, length
    while left > 0:
        piece = file.read(min(left, _READ_BYTES))
        crc, left = zlib.crc32(piece, crc), left - len(piece)
    opcode, stated, expected = struct.unpack("<BQI", file.read(_DATA_END))
    return bool(opcode == Opcode.DATA_END and stated == 4 and expected == crc)


def _chunks(recording: McapFile, summary: bytes) -> list[tuple[int, int, Segment]]:
    """List the chunks of a summary section, and give the recording its channels and schemas, unless a record is unreadable."""
    defined = McapFile(recording.path)
    chunks: list[tuple[int, int, Segment]] = []
    position = 0
    while position < len(summary):
        opcode, length = HEAD.unpack_from(summary, position)
        body = summary[position + HEAD.size : position + HEAD.size + length]
        position += HEAD.size + length
        if opcode == Opcode.CHUNK_INDEX:
            chunk = ChunkIndex.read(stream(body))
            place = Segment(chunk.chunk_start_offset, chunk.chunk_length, True)
            chunks.append((chunk.message_start_time, chunk.message_end_time, place))
        else:
            defined.define(opcode, body)
    recording.channels |= defined.channels
    recording.schemas |= defined.schemas
    return chunks
