"""The bytes of an MCAP file, checked: records, chunks, checksums, and what a crash leaves.

The walk is our own because the library's reader trusts every length field (a flipped bit makes it ask for
terabytes), gives nothing of a file without footer in time order, and leaves most checksums unread.
"""

from __future__ import annotations

import io
import stat
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from drivers.base import RecordingError, RecordingMissingError

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 1 << 28
"""Largest chunk (packed or unpacked) or message that is loaded; a lying length field asks for more."""
_RUN_BYTES = 1 << 18
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_KEPT = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
PARSE_ERRORS = (
    McapError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # lz4
    ValueError,  # UnicodeDecodeError among them
    EOFError,
    OverflowError,
    MemoryError,
)
"""Everything that the parsers below raise on bytes that are no MCAP."""


class Message(NamedTuple):
    """One message as it stands in the file."""

    channel_id: int
    log_time: int
    data: bytes


class Segment(NamedTuple):
    """Where a chunk's record, or a run of records outside chunks, lies in the file."""

    offset: int
    length: int
    is_chunk: bool


class _CutError(Exception):
    """The file ends inside a record."""


@dataclass
class McapFile:
    """One MCAP file: walk it once with `segments`, then `load` any segment again.

    Attributes
    ----------
    channels, schemas
        By id, complete after the walk.
    cut
        None, or why the walk ended early (crash, full disk); all before it is whole.
    """

    path: Path
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    cut: str | None = None
    _crc: int = 0
    _size: int = 0

    def segments(self) -> Iterator[tuple[Segment, list[Message]]]:
        """Every segment in file order with its messages, all lengths and checksums verified.

        Raises
        ------
        RecordingMissingError
            If the file cannot be opened.
        RecordingError
            If its bytes are damaged or no MCAP.
        """
        with self._open() as file:
            if file.read(len(MAGIC)) != MAGIC:
                what = "is empty" if not self._size else "is no MCAP file (wrong first bytes)"
                raise RecordingError(f"{self.path}: {what}; other formats: shm-monitor import")
            self._crc = zlib.crc32(MAGIC)
            file.seek(max(len(MAGIC), self._size - len(MAGIC)))
            closed = file.read() == MAGIC
            file.seek(len(MAGIC))
            try:
                yield from self._data_section(file, closed)
                self._summary_section(file)
            except _CutError as error:
                if closed:
                    raise self._damage(file.tell(), str(error)) from error
                self.cut = str(error)

    def load(self, segment: Segment) -> list[Message]:
        """The messages of a segment that the walk has given (same errors)."""
        with self._open() as file:
            file.seek(segment.offset)
            return self._parse(segment, file.read(segment.length))

    def demand(self) -> None:
        """See that the file can be opened (errors as `segments`)."""
        self._open().close()

    def schema_name(self, channel: Channel) -> str:
        """Name of a channel's schema, empty if it has none."""
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema else ""

    def _open(self) -> BinaryIO:
        try:
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait for ever
                raise RecordingMissingError(f"{self.path}: is no regular file; name a recording")
            self._size = status.st_size
            return self.path.open("rb")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise RecordingMissingError(f"{self.path}: cannot be opened: {reason}") from error

    def _damage(self, offset: int, what: object) -> RecordingError:
        return RecordingError(f"{self.path}: damaged at byte {offset}: {what}; use another copy of this file")

    def _take(self, file: BinaryIO, length: int) -> bytes:
        if length > self._size - file.tell():
            raise _CutError(f"the file ends inside a record at byte {self._size}")
        data = file.read(length)
        self._crc = zlib.crc32(data, self._crc)
        return data

    def _skip(self, file: BinaryIO, length: int) -> None:
        if length > self._size - file.tell():
            raise _CutError(f"the file ends inside a record at byte {self._size}")
        for start in range(0, length, _RUN_BYTES):
            self._take(file, min(_RUN_BYTES, length - start))

    def _data_section(self, file: BinaryIO, closed: bool) -> Iterator[tuple[Segment, list[Message]]]:
        run = bytearray()
        while True:
            offset, crc = file.tell(), self._crc
            try:
                if offset == self._size:
                    raise _CutError("the file has no footer")
                opcode, length = _HEAD.unpack(head := self._take(file, _HEAD.size))
                if opcode == 0:  # zeros: what a file system leaves of blocks that were never written
                    raise (
                        _CutError(f"unwritten bytes from {offset}") if not closed else self._damage(offset, "opcode 0")
                    )
                kept = opcode in _KEPT
                if (kept or opcode == Opcode.CHUNK) and length > min(MAX_RECORD_BYTES, self._size - file.tell()):
                    raise _CutError(f"the record at byte {offset} claims {length} bytes")
                body = self._take(file, length) if kept or opcode == Opcode.CHUNK else b""
            except _CutError:
                yield from self._run(offset, run)
                raise
            if kept:
                run += head + body
                if len(run) < _RUN_BYTES:
                    continue
                offset = file.tell()
            yield from self._run(offset, run)
            run.clear()
            if opcode == Opcode.CHUNK:
                segment = Segment(offset, _HEAD.size + length, True)
                try:
                    messages = self._parse(segment, head + body)
                except RecordingError:
                    # Zeros behind it, or at its end: it was being written when the machine stopped.
                    if closed or (file.read(_RUN_BYTES) or body[-16:]).strip(b"\0"):
                        raise
                    raise _CutError(f"the chunk at byte {offset} was written in part") from None
                yield segment, messages
            elif opcode == Opcode.DATA_END:
                self._check_data_end(file, offset, length, crc)
                return
            elif opcode == Opcode.FOOTER:
                raise self._damage(offset, "a footer before the end of the data")
            elif not kept:
                self._skip(file, length)

    def _run(self, end: int, run: bytearray) -> Iterator[tuple[Segment, list[Message]]]:
        if run:
            segment = Segment(end - len(run), len(run), False)
            yield segment, self._parse(segment, bytes(run))

    def _check_data_end(self, file: BinaryIO, offset: int, length: int, crc: int) -> None:
        if length < 4:
            raise self._damage(offset, "a data end record that is too short")
        (expected,) = struct.unpack("<I", self._take(file, 4))
        self._skip(file, length - 4)
        if expected not in (0, crc):
            raise self._damage(offset, "the checksum of the data section does not fit")
        self._crc = 0

    def _summary_section(self, file: BinaryIO) -> None:
        while True:
            offset = file.tell()
            opcode, length = _HEAD.unpack(self._take(file, _HEAD.size))
            if opcode != Opcode.FOOTER:
                self._skip(file, length)
                continue
            if length < 20:
                raise self._damage(offset, "a footer that is too short")
            self._take(file, 16)
            crc = self._crc
            (expected,) = struct.unpack("<I", self._take(file, 4))
            self._skip(file, length - 20)
            if expected not in (0, crc):
                raise self._damage(offset, "the checksum of the summary does not fit")
            if self._take(file, len(MAGIC)) != MAGIC or file.tell() != self._size:
                raise self._damage(file.tell(), "wrong bytes after the footer")
            return

    def _parse(self, segment: Segment, raw: bytes) -> list[Message]:
        try:
            return self._messages(unpack_chunk(raw[_HEAD.size :]) if segment.is_chunk else raw)
        except PARSE_ERRORS as error:
            kind = "chunk: " if segment.is_chunk else ""
            raise self._damage(segment.offset, f"{kind}{error}") from error

    def _messages(self, content: bytes) -> list[Message]:
        messages, position, end = [], 0, len(content)
        head, fields, channels, is_message = _HEAD.unpack_from, _MESSAGE.unpack_from, self.channels, int(Opcode.MESSAGE)
        head_size, fields_size = _HEAD.size, _MESSAGE.size  # looked up once: this loop is long
        while position < end:
            opcode, length = head(content, position)
            start, position = position + head_size, position + head_size + length
            if position > end:
                raise ValueError("a record runs over the end of its chunk")
            if opcode == is_message:
                if length < fields_size:
                    raise ValueError("a message that is too short")
                channel_id, _, log_time, _ = fields(content, start)
                if channel_id not in channels:
                    raise ValueError(f"a message of channel {channel_id}, which the file does not define")
                messages.append(Message(channel_id, log_time, content[start + fields_size : position]))
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream(content[start:position]))
                self.channels[channel.id] = channel
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(stream(content[start:position]))
                self.schemas[schema.id] = schema
        return messages


def unpack_chunk(body: bytes) -> bytes:
    """The records inside a chunk record's body, its size and checksum verified.

    Raises
    ------
    ValueError, struct.error, zstandard.ZstdError, RuntimeError
        If they are damaged or would need more than `MAX_RECORD_BYTES`.
    """
    _, _, size, crc, name_length = _CHUNK.unpack_from(body)
    start = _CHUNK.size + name_length
    compression = str(body[_CHUNK.size : start], "utf-8")
    (length,) = struct.unpack_from("<Q", body, start)
    packed = body[start + 8 : start + 8 + length]
    if size > MAX_RECORD_BYTES or len(packed) != length:
        raise ValueError(f"it claims {length} bytes, {size} unpacked")
    # Never ask for more than the chunk states: a few bytes can unpack to terabytes.
    if compression == "zstd" and zstandard.frame_content_size(packed) == size:
        content = zstandard.ZstdDecompressor().decompress(packed)
    elif compression == "zstd":  # of unknown size, or several frames
        with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
            content = reader.read(size + 1)
    elif compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif compression == "":
        content = packed
    else:
        raise ValueError(f"unknown compression {compression[:20]!r}; known: zstd, lz4")
    if len(content) != size:
        raise ValueError(f"{len(content)} bytes unpacked, {size} stated")
    if crc not in (0, zlib.crc32(content)):
        raise ValueError("the checksum does not fit")
    return content if isinstance(content, bytes) else bytes(content)


def stream(data: bytes) -> ReadDataStream:
    """Bytes as the library's record parsers take them."""
    return ReadDataStream(io.BytesIO(data))
