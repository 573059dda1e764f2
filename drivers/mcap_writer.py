"""Writes recordings: indexed MCAP in zstd chunks, under their final name only when they are whole."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from mcap.writer import CompressionType, Writer

from drivers import codec
from drivers.base import SampleBlock
from drivers.disk import finish, partial

_CHUNK_BYTES = 256 * 1024
LIBRARY = "shm-monitor"
"""Library name in the file's header; it says that a chunk's log times are the times by which its blocks are ordered."""
ORDER, AS_ARRIVED = "order", "as arrived"
"""Key and value of the channel metadata that mark a live recording."""
CLOCK = "clock"
"""Key of the channel metadata that counts how often the clock had been set back when a live recording began."""
_CLOCK_NS = 1 << 62
"""Bound of log times. [ns; definition]"""
_MOST_DIGITS = 9
"""Most digits of the count of clocks in a file from elsewhere. [1; judgement]"""


def arrival(log_time_ns: int, clock: int) -> int:
    """Compute the place of a block in the order of arrival; `clock` counts how often the clock had been set back.

    Examples
    --------
    >>> arrival(5, 0), arrival(5, 1) > arrival(10**18, 0)
    (5, True)
    """
    return clock * _CLOCK_NS + log_time_ns


def clock_of(metadata: Mapping[str, str]) -> int:
    """Read from a channel's metadata how often the clock had been set back; 0 where nothing, or nonsense, says so."""
    text = metadata.get(CLOCK, "")
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS else 0


class McapWriter:
    """Writer of a recording that has the name `NAME.part` until it is whole; raises `OSError` where it cannot be written.

    The same calls give the same bytes.  After a crash the `.part` file is readable up to the last `flush`.

    Parameters
    ----------
    path
        Final name; its folder is created if necessary.
    metadata
        MCAP metadata records, name -> keys and values.
    as_arrived
        Live recording: readers order the blocks by their log times, not by the times of their samples.
    clock
        Number of times that the clock of a live recording was set back; readers order by it before log times.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        *,
        as_arrived: bool = False,
        clock: int = 0,
    ) -> None:
        self.path = Path(path)
        self.part_path = partial(self.path)
        self.part_path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.part_path.open("wb")
        self._writer = Writer(
            self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._tags = {ORDER: AS_ARRIVED} if as_arrived else {}
        if clock:
            self._tags[CLOCK] = str(clock)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer.start(profile="", library=LIBRARY)
        for name, values in (metadata or {}).items():
            self._writer.add_metadata(name, dict(values))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the recording, or remove the `.part` file after an error."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def write(self, block: SampleBlock, log_time_ns: int | None = None) -> None:
        """Append a block; raises `ValueError` if it lies before 1970, which MCAP cannot represent.

        Its log time is its own time, but in a live recording (`as_arrived`) `log_time_ns` if that is given.
        """
        if block.t_ns < 0:
            raise ValueError(f"block of {block.topic} at {block.t_ns} ns: before 1970")
        channel = self._channel(block.topic, "protobuf", codec.SCHEMA_NAME, "protobuf", codec.SCHEMA_BYTES)
        if log_time_ns is None or not self._tags:
            log_time_ns = block.t_ns
        self._writer.add_message(channel, log_time_ns, codec.encode(block), block.t_ns)

    def write_json(self, topic: str, t_ns: int, data: bytes | str, schema: Mapping[str, object] | None = None) -> None:
        """Append one JSON message at `t_ns` (UTC, ns); `schema` is its JSON schema, by default that of any object."""
        channel = self._channels.get(topic)
        if channel is None:
            text = json.dumps(schema or {"type": "object"}, sort_keys=True).encode()
            channel = self._channel(topic, "json", "shm." + topic.strip("/").replace("/", "."), "jsonschema", text)
        self._writer.add_message(channel, t_ns, data.encode() if isinstance(data, str) else data, t_ns)

    def flush(self) -> None:
        """End the chunk, and write all data so far to the disk, where they outlast a crash."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Finish the file and give it its final name; a second call does no harm."""
        if self._file.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            finish(self.path)
        except BaseException:
            self.abort()
            raise

    def keep(self) -> None:
        """Give the unfinished file its final name, readable up to the last whole chunk; for a full disk."""
        with contextlib.suppress(OSError):
            self._file.close()
        finish(self.path)

    def abort(self) -> None:
        """Remove the unfinished file."""
        self._file.close()
        self.part_path.unlink(missing_ok=True)

    def _channel(self, topic: str, encoding: str, name: str, schema_encoding: str, schema: bytes) -> int:
        """Return the id of a topic's MCAP channel, registered with its schema at the first call."""
        if topic not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, schema_encoding, schema)
            tags = self._tags if encoding == "protobuf" else {}
            self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[name], tags)
        return self._channels[topic]
