"""Writes recordings: indexed MCAP in zstd chunks, whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import CompressionType, Writer

from drivers import codec
from drivers.base import SampleBlock

_CHUNK_BYTES = 256 * 1024
LIBRARY = "shm-monitor"
"""Named in the file's header: a chunk's log times are then the times by which its blocks are ordered."""
ORDER, AS_ARRIVED = "order", "as arrived"
"""Channel metadata that tells a live record from others."""


class McapWriter:
    """A recording that appears under its name only when whole; until then it is `NAME.part` beside it.

    The same calls give the same bytes.  After a crash the `.part` file is readable up to the last `flush`.

    Parameters
    ----------
    path
        Final name; its folder is made if need be.
    metadata
        MCAP metadata records, name -> keys and values.
    as_arrived
        Readers are to give the blocks in the order of their log times, not of their own: a live record.

    Raises ``OSError`` if the file cannot be written.
    """

    def __init__(
        self, path: Path, metadata: Mapping[str, Mapping[str, str]] | None = None, *, as_arrived: bool = False
    ) -> None:
        """Open the part file."""
        self.path = Path(path)
        self.part_path = self.path.with_name(self.path.name + ".part")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.part_path.open("wb")
        self._writer = Writer(
            self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._tags = {ORDER: AS_ARRIVED} if as_arrived else {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer.start(profile="", library=LIBRARY)
        for name, values in (metadata or {}).items():
            self._writer.add_metadata(name, dict(values))

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close, or after an error remove the part file."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def write(self, block: SampleBlock, log_time_ns: int | None = None) -> None:
        """Append a block; its log time is its own time, in a live record (`as_arrived`) the one given.

        Raises
        ------
        ValueError
            If its time lies before 1970, which MCAP cannot say.
        """
        if block.t_ns < 0:
            raise ValueError(f"block of {block.topic} at {block.t_ns} ns: before 1970")
        channel = self._channel(block.topic, "protobuf", codec.SCHEMA_NAME, "protobuf", codec.SCHEMA_BYTES)
        if log_time_ns is None or not self._tags:
            log_time_ns = block.t_ns
        self._writer.add_message(channel, log_time_ns, codec.encode(block), block.t_ns)

    def write_json(self, topic: str, t_ns: int, data: bytes | str, schema: Mapping[str, object] | None = None) -> None:
        """Append one JSON message; `schema` is its JSON schema, by default any object."""
        channel = self._channels.get(topic)
        if channel is None:
            text = json.dumps(schema or {"type": "object"}, sort_keys=True).encode()
            channel = self._channel(topic, "json", "shm." + topic.strip("/").replace("/", "."), "jsonschema", text)
        self._writer.add_message(channel, t_ns, data.encode() if isinstance(data, str) else data, t_ns)

    def flush(self) -> None:
        """End the chunk and put all so far on the disk: what a crash then leaves."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Finish the file and give it its name; calling it again does no harm."""
        if self._file.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.part_path, self.path)
        except BaseException:
            self.abort()
            raise

    def keep(self) -> None:
        """Give the file its name as it stands, readable up to the last whole chunk: what to do when the disk is full."""
        with contextlib.suppress(OSError):
            self._file.close()
        os.replace(self.part_path, self.path)

    def abort(self) -> None:
        """Remove the unfinished file."""
        self._file.close()
        self.part_path.unlink(missing_ok=True)

    def _channel(self, topic: str, encoding: str, name: str, schema_encoding: str, schema: bytes) -> int:
        if topic not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, schema_encoding, schema)
            tags = self._tags if encoding == "protobuf" else {}
            self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[name], tags)
        return self._channels[topic]
