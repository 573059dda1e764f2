"""Encodes sample blocks as protobuf bytes and decodes them: the same bytes in MCAP files and over Zenoh.

The message type is built at run time rather than generated, so that a checkout needs no protobuf compiler.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.message import DecodeError

from drivers.base import SampleBlock

SCHEMA_NAME = "shm.SampleBlock"
_FIELD = descriptor_pb2.FieldDescriptorProto
_NS = 1_000_000_000
_FLOAT32 = np.dtype("<f4")


def _file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name="shm/sample_block.proto", package="shm", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name="SampleBlock")
    for number, (name, kind, label) in enumerate(
        (
            ("timestamp", _FIELD.TYPE_MESSAGE, _FIELD.LABEL_OPTIONAL),
            ("sequence", _FIELD.TYPE_UINT64, _FIELD.LABEL_OPTIONAL),
            ("sample_rate_hz", _FIELD.TYPE_DOUBLE, _FIELD.LABEL_OPTIONAL),
            ("channels", _FIELD.TYPE_STRING, _FIELD.LABEL_REPEATED),
            ("unit", _FIELD.TYPE_STRING, _FIELD.LABEL_OPTIONAL),
            ("samples", _FIELD.TYPE_BYTES, _FIELD.LABEL_OPTIONAL),
        ),
        start=1,
    ):
        field = message.field.add(name=name, number=number, type=kind, label=label)
        if kind == _FIELD.TYPE_MESSAGE:
            field.type_name = ".google.protobuf.Timestamp"
    return file


def _schema_bytes() -> bytes:
    files = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    files.file.add().CopyFrom(_file_descriptor())
    return files.SerializeToString()


_pool = descriptor_pool.Default()
_pool.Add(_file_descriptor())
_Message: Any = message_factory.GetMessageClass(_pool.FindMessageTypeByName(SCHEMA_NAME))
SCHEMA_BYTES = _schema_bytes()
"""FileDescriptorSet of `shm.SampleBlock` and its dependencies, in the form that MCAP's protobuf encoding requires."""


def _begin(block: SampleBlock) -> Any:
    """Begin the message of a block: time and sequence."""
    message = _Message(sequence=block.sequence)
    message.timestamp.seconds, message.timestamp.nanos = divmod(block.t_ns, _NS)
    return message


def encode(block: SampleBlock) -> bytes:
    """Encode a block as protobuf bytes (docs/connect.md has the field numbers)."""
    message = _begin(block)
    message.sample_rate_hz, message.unit = block.sample_rate_hz, block.unit
    message.channels.extend(block.channels)
    message.samples = np.ascontiguousarray(block.samples, dtype="<f4").tobytes()
    return bytes(message.SerializeToString())


def decode(data: bytes, topic: str) -> SampleBlock:
    """Decode the block in `data`; raises `ValueError` if that is no SampleBlock, or its fields contradict each other."""
    message = _parse(data)
    channels = tuple(message.channels)
    samples = message.samples
    if not channels:
        raise ValueError("a sample block without channel names")
    if len(samples) % (4 * len(channels)):
        raise ValueError(f"{len(samples)} bytes of samples are no whole rows of {len(channels)} float32 channels")
    rows, rate_hz = np.frombuffer(samples, _FLOAT32).reshape(-1, len(channels)), message.sample_rate_hz
    return SampleBlock(topic, _time_ns(message), message.sequence, rate_hz, channels, message.unit, rows)


def decode_joined(messages: Iterable[bytes], topic: str, longest_s: float) -> list[SampleBlock]:
    """Decode consecutive blocks, and join them as `drivers.merged.merged` does, but fast enough for the aims of docs/figures.md.

    Raises `ValueError` as `decode`, and if a message begins before the preceding one.
    """
    joined: list[SampleBlock] = []
    first: SampleBlock | None = None
    parts: list[bytes] = []
    n, last_ns, size, middle = 0, -1, 0, b""
    for data in messages:
        # The bytes between sequence and samples are mostly the same in consecutive blocks: then only the beginning is parsed.
        abridged = bool(middle) and data[-size - len(middle) : -size] == middle
        message = _parse(data[: -size - len(middle)] if abridged else data)
        if abridged and (message.samples or message.unit or message.channels or message.sample_rate_hz):
            abridged, message = False, _parse(data)
        t_ns = _time_ns(message)
        if t_ns < last_ns:
            raise ValueError("blocks out of order")
        last_ns = t_ns
        samples = data[-size:] if abridged else message.samples
        rows = 0 if first is None else len(samples) // (4 * len(first.channels))
        if (
            first is not None
            and message.sequence == first.sequence + n
            and n + rows <= longest_s * first.sample_rate_hz
            and abs(t_ns - first.t_ns - round(n / first.sample_rate_hz * 1e9)) <= 1
            and (abridged or _is_same_kind(message, first))
        ):
            parts.append(samples)
            n += rows
            continue
        if first is not None:
            joined.append(_with_samples(first, parts))
        first = decode(data, topic)
        parts, n = [first.samples.tobytes()], first.n_samples
        size, middle = len(parts[0]), _middle_bytes(data, first, parts[0])
    return joined if first is None else [*joined, _with_samples(first, parts)]


def _is_same_kind(message: Any, first: SampleBlock) -> bool:
    """Test whether a message has the rate, channels and unit of a block."""
    return (
        message.sample_rate_hz == first.sample_rate_hz
        and len(message.samples) % (4 * len(first.channels)) == 0
        and message.unit == first.unit
        and tuple(message.channels) == first.channels
    )


def _middle_bytes(data: bytes, block: SampleBlock, samples: bytes) -> bytes:
    """Return the bytes between time and sequence, at the beginning, and the samples, at the end; none in another order."""
    head = _begin(block).SerializeToString()
    if not (samples and data.startswith(head) and data.endswith(samples)):
        return b""
    rest = _parse(data[len(head) :])
    return b"" if rest.HasField("timestamp") or rest.sequence else data[len(head) : -len(samples)]


def _with_samples(block: SampleBlock, parts: list[bytes]) -> SampleBlock:
    """Return the block with the joined samples of all parts, each the bytes of float32 rows."""
    if len(parts) == 1:
        return block
    return replace(block, samples=np.frombuffer(b"".join(parts), _FLOAT32).reshape(-1, len(block.channels)))


def time_ns(data: bytes) -> int:
    """Read the UTC of the first sample of the block in `data`, ns; only that it is a SampleBlock is checked (`ValueError`)."""
    return _time_ns(_parse(data))


def _parse(data: bytes) -> Any:
    try:
        return _Message.FromString(data)
    except DecodeError as error:
        raise ValueError(f"no {SCHEMA_NAME} message: {error}") from error


def _time_ns(message: Any) -> int:
    timestamp = message.timestamp
    return int(timestamp.seconds * _NS + timestamp.nanos)
