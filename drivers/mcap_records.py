"""Reads the records of an MCAP file and verifies lengths and checksums, also in a file that a crash left unfinished.

The library's reader is not used because it trusts every length field (a flipped bit makes it ask for terabytes), gives
nothing of a file without footer in time order, and leaves most checksums unread.
"""

from __future__ import annotations

import contextlib
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
"""Largest chunk (packed or unpacked) or message that is loaded, bytes; only a damaged length field asks for more."""
_MOST_MESSAGES = 1 << 20
"""Largest number of messages in a chunk: each takes some 200 bytes of memory, whatever it holds. [1; cost: 200 MB]"""
_RUN_BYTES = 1 << 18
HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<QQI")
_KEPT = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
PARSE_ERRORS = (
    McapError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # lz4
    ValueError,  # includes UnicodeDecodeError
    EOFError,
    OverflowError,
    MemoryError,
)
"""All errors that the parsers below raise on bytes that are no MCAP."""


class Message(NamedTuple):
    """Message as stored in the file: channel, log time (ns), data."""

    channel_id: int
    log_time: int
    data: bytes


class Segment(NamedTuple):
    """Place of a chunk's record, or of consecutive records outside chunks, in the file (bytes)."""

    offset: int
    length: int
    is_chunk: bool


class _CutError(Exception):
    """End of the file inside a record."""


@dataclass
class McapFile:
    """MCAP file: `segments` reads it through once, then `load` reads any segment again."""

    path: Path
    channels: dict[int, Channel] = field(default_factory=dict)
    """Channels by id, complete after `segments`, as are `schemas`."""
    schemas: dict[int, Schema] = field(default_factory=dict)
    cut: str | None = None
    """Reason why `segments` ended early (crash, full disk), or None; all data before that place are whole."""
    most_messages: int = _MOST_MESSAGES
    """Largest number of messages in a chunk; a chunk with more is damage."""
    leave_out: bool = False
    """Leave out a damaged chunk and go on with the next; otherwise it is an error."""
    damage: list[RecordingError] = field(default_factory=list)
    """Errors of the chunks that `segments` left out."""
    _unchecked: bool = False
    """True once a chunk without a checksum of its own was read."""
    _crc: int = 0
    _size: int = 0

    def segments(self) -> Iterator[tuple[Segment, list[Message]]]:
        """Yield every segment in file order with its messages, and verify all lengths and checksums.

        Raises `RecordingMissingError` if the file cannot be opened, `RecordingError` if its bytes are damaged or no MCAP.
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
                    raise self._damage_error(file.tell(), str(error)) from error
                self.cut = str(error)

    def load(self, segment: Segment) -> list[Message]:
        """Load the messages of a segment that `segments` has yielded (errors as `segments`)."""
        with self._open() as file:
            file.seek(segment.offset)
            return self._parse(segment, file.read(segment.length))

    def demand(self) -> None:
        """Check that the file can be opened (errors as `segments`)."""
        self._open().close()

    def define(self, opcode: int, body: bytes) -> None:
        """Keep what the record of a channel or a schema defines; pass over other records."""
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(stream(body))
            self.channels[channel.id] = channel
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream(body))
            self.schemas[schema.id] = schema

    def schema_name(self, channel: Channel) -> str:
        """Return the name of a channel's schema, empty if the channel has none."""
        schema = self.schemas.get(channel.schema_id)
        return schema.name if schema else ""

    def _open(self) -> BinaryIO:
        try:
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait forever
                raise RecordingMissingError(f"{self.path}: is no regular file; name a recording")
            self._size = status.st_size
            return self.path.open("rb")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise RecordingMissingError(f"{self.path}: cannot be opened: {reason}") from error

    def _damage_error(self, offset: int, what: object) -> RecordingError:
        return RecordingError(f"{self.path}: damaged at byte {offset}: {what}; use another copy of this file")

    def _read_checked(self, file: BinaryIO, length: int) -> bytes:
        """Read `length` bytes and update the checksum."""
        if length > self._size - file.tell():
            raise _CutError(f"the file ends inside a record at byte {self._size}")
        data = file.read(length)
        self._crc = zlib.crc32(data, self._crc)
        return data

    def _skip(self, file: BinaryIO, length: int) -> None:
        if length > self._size - file.tell():
            raise _CutError(f"the file ends inside a record at byte {self._size}")
        for start in range(0, length, _RUN_BYTES):
            self._read_checked(file, min(_RUN_BYTES, length - start))

    def _data_section(self, file: BinaryIO, closed: bool) -> Iterator[tuple[Segment, list[Message]]]:
        """Yield the segments of the data section; `closed` means that the file ends with the magic bytes."""
        run = bytearray()
        while True:
            offset, crc = file.tell(), self._crc
            try:
                opcode, length, record = self._read_record(file, closed)
            except _CutError:
                yield from self._finish_run(offset, run)
                raise
            if opcode in _KEPT:
                run += record
                if len(run) < _RUN_BYTES:
                    continue
                offset = file.tell()
            yield from self._finish_run(offset, run)
            run.clear()
            if opcode == Opcode.CHUNK:
                segment = Segment(offset, len(record), True)
                yield segment, self._parse_chunk(file, segment, record, closed)
            elif opcode == Opcode.DATA_END:
                self._check_data_end(file, offset, length, crc)
                return
            elif opcode == Opcode.FOOTER:
                raise self._damage_error(offset, "a footer before the end of the data")
            elif opcode not in _KEPT:
                self._skip(file, length)

    def _read_record(self, file: BinaryIO, closed: bool) -> tuple[int, int, bytes]:
        """Read opcode and length of a record; all of its bytes if it is a chunk, a message or what defines one, else its head."""
        offset = file.tell()
        if offset == self._size:
            raise _CutError("the file has no footer")
        opcode, length = HEAD.unpack(head := self._read_checked(file, HEAD.size))
        if opcode == 0:  # zeros: the file system never wrote these blocks
            raise self._damage_error(offset, "opcode 0") if closed else _CutError(f"unwritten bytes from {offset}")
        if opcode not in _KEPT and opcode != Opcode.CHUNK:
            return opcode, length, head
        if length > min(MAX_RECORD_BYTES, self._size - file.tell()):
            raise _CutError(f"the record at byte {offset} claims {length} bytes")
        return opcode, length, head + self._read_checked(file, length)

    def _parse_chunk(self, file: BinaryIO, segment: Segment, record: bytes, closed: bool) -> list[Message]:
        """Parse a chunk that was just read; a damaged one of a file that was not closed may be its cut end."""
        try:
            messages = self._parse(segment, record)
        except RecordingError as error:
            # Zeros after the chunk, or at its end, mean that the machine stopped while writing the chunk.
            end = file.tell()
            if not closed and not (file.read(_RUN_BYTES) or record[HEAD.size :][-16:]).strip(b"\0"):
                raise _CutError(f"the chunk at byte {segment.offset} was written in part") from None
            if not self.leave_out:
                raise
            if closed and not self.damage:
                self._define_by_summary(file)
            self.damage.append(error)
            file.seek(end)
            return []
        self._unchecked |= not _CHUNK.unpack_from(record, HEAD.size)[3]
        return messages

    def _define_by_summary(self, file: BinaryIO) -> None:
        """Take channels and schemas from the summary, which repeats them: a chunk that is left out may have defined them."""
        file.seek(self._size - len(MAGIC) - _FOOTER.size)
        with contextlib.suppress(*PARSE_ERRORS):
            file.seek(min(_FOOTER.unpack(file.read(_FOOTER.size))[0], self._size))
            while True:  # until what follows is no record
                opcode, length = HEAD.unpack(file.read(HEAD.size))
                end = file.tell() + min(length, self._size)
                if opcode in _KEPT:
                    self.define(opcode, file.read(min(length, MAX_RECORD_BYTES)))
                file.seek(end)

    def _finish_run(self, end: int, run: bytearray) -> Iterator[tuple[Segment, list[Message]]]:
        """Yield the records outside chunks that end at byte `end` as one segment, if there are any."""
        if run:
            segment = Segment(end - len(run), len(run), False)
            yield segment, self._parse(segment, bytes(run))

    def _check_data_end(self, file: BinaryIO, offset: int, length: int, crc: int) -> None:
        """Verify the checksum of the data section."""
        if length < 4:
            raise self._damage_error(offset, "a data end record that is too short")
        self._check_crc(file, offset, length - 4, crc, "data section")
        self._crc = 0

    def _check_crc(self, file: BinaryIO, offset: int, rest: int, crc: int, what: str) -> None:
        """Compare the checksum that stands here, 0 if the writer stored none; read past the `rest` of the record."""
        (expected,) = struct.unpack("<I", self._read_checked(file, 4))
        self._skip(file, rest)
        # The checksum of all data does not fit where a chunk was left out; then those of the other chunks have to do.
        known = what == "data section" and self.damage and not self._unchecked
        if expected not in (0, crc) and not known:
            raise self._damage_error(offset, f"the checksum of the {what} does not fit")

    def _summary_section(self, file: BinaryIO) -> None:
        """Read past the summary section, and verify its checksum and the end of the file."""
        while True:
            offset = file.tell()
            opcode, length = HEAD.unpack(self._read_checked(file, HEAD.size))
            if opcode != Opcode.FOOTER:
                self._skip(file, length)
                continue
            if length < 20:
                raise self._damage_error(offset, "a footer that is too short")
            self._read_checked(file, 16)
            self._check_crc(file, offset, length - 20, self._crc, "summary")
            if self._read_checked(file, len(MAGIC)) != MAGIC or file.tell() != self._size:
                raise self._damage_error(file.tell(), "wrong bytes after the footer")
            return

    def _parse(self, segment: Segment, raw: bytes) -> list[Message]:
        try:
            return self._messages(unpack_chunk(raw[HEAD.size :]) if segment.is_chunk else raw)
        except PARSE_ERRORS as error:
            kind = "chunk: " if segment.is_chunk else ""
            raise self._damage_error(segment.offset, f"{kind}{error}") from error

    def _messages(self, content: bytes) -> list[Message]:
        messages: list[Message] = []
        position, end = 0, len(content)
        head, fields, channels, is_message = HEAD.unpack_from, _MESSAGE.unpack_from, self.channels, int(Opcode.MESSAGE)
        head_size, fields_size = HEAD.size, _MESSAGE.size  # looked up once, because this loop is long
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
                if len(messages) == self.most_messages:
                    raise ValueError(f"more than {self.most_messages} messages in a chunk")
                messages.append(Message(channel_id, log_time, content[start + fields_size : position]))
            else:
                self.define(opcode, content[start:position])
        return messages


def unpack_chunk(body: bytes) -> bytes:
    """Unpack the records inside a chunk record's body, and verify size and checksum.

    Raises one of `PARSE_ERRORS` if the chunk is damaged or would need more than `MAX_RECORD_BYTES`.
    """
    _, _, size, crc, name_length = _CHUNK.unpack_from(body)
    start = _CHUNK.size + name_length
    compression = str(body[_CHUNK.size : start], "utf-8")
    (length,) = struct.unpack_from("<Q", body, start)
    packed = body[start + 8 : start + 8 + length]
    if size > MAX_RECORD_BYTES or len(packed) != length:
        raise ValueError(f"it claims {length} bytes, {size} unpacked")
    # Never unpack more than the chunk states: a few bytes can unpack to terabytes.
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
    """Wrap bytes as the stream that the library's record parsers read."""
    return ReadDataStream(io.BytesIO(data))
