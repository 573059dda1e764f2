"""SampleBlock <-> protobuf bytes: the same bytes in MCAP files and over Zenoh.

The message type is built here rather than generated, so that a checkout needs no protobuf compiler.
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
"""FileDescriptorSet of `shm.SampleBlock` and what it depends on, as MCAP's protobuf encoding wants it."""


def encode(block: SampleBlock) -> bytes:
    """Protobuf bytes of a block (CONTRACT field numbers)."""
    message = _Message(
        sequence=block.sequence,
        sample_rate_hz=block.sample_rate_hz,
        channels=block.channels,
        unit=block.unit,
        samples=np.ascontiguousarray(block.samples, dtype="<f4").tobytes(),
    )
    message.timestamp.seconds, message.timestamp.nanos = divmod(block.t_ns, _NS)
    return bytes(message.SerializeToString())


def decode(data: bytes, topic: str) -> SampleBlock:
    """The block in `data`.

    Raises
    ------
    ValueError
        If the bytes are no SampleBlock or contradict themselves; the message says how.
    """
    message = _parsed(data)
    channels = tuple(message.channels)
    samples = message.samples
    if not channels:
        raise ValueError("a sample block without channel names")
    if len(samples) % (4 * len(channels)):
        raise ValueError(f"{len(samples)} bytes of samples are no whole rows of {len(channels)} float32 channels")
    return SampleBlock(
        topic,
        _time_ns(message),
        message.sequence,
        message.sample_rate_hz,
        channels,
        message.unit,
        np.frombuffer(samples, _FLOAT32).reshape(-1, len(channels)),
    )


def decode_joined(messages: Iterable[bytes], topic: str, longest_s: float) -> list[SampleBlock]:
    """Consecutive blocks, those that go on where the one before ends joined up to `longest_s`.

    Raises
    ------
    ValueError
        If a message is no SampleBlock, contradicts itself, or begins before the one before it.
    """
    joined: list[SampleBlock] = []
    first, parts, n, last_ns = None, [], 0, -1
    for data in messages:
        message = _parsed(data)
        samples, t_ns = message.samples, _time_ns(message)
        if t_ns < last_ns:
            raise ValueError("blocks out of order")
        last_ns = t_ns
        rows = 0 if first is None else len(samples) // (4 * len(first.channels))
        if (
            first is not None
            and message.sequence == first.sequence + n
            and message.sample_rate_hz == first.sample_rate_hz
            and n + rows <= longest_s * first.sample_rate_hz
            and abs(t_ns - first.t_ns - round(n / first.sample_rate_hz * 1e9)) <= 1
            and len(samples) == 4 * rows * len(first.channels)
            and message.unit == first.unit
            and tuple(message.channels) == first.channels
        ):
            parts.append(samples)
            n += rows
            continue
        if first is not None:
            joined.append(_with(first, parts))
        first, parts = decode(data, topic), [samples]
        n = first.n_samples
    return joined if first is None else [*joined, _with(first, parts)]


def _with(block: SampleBlock, parts: list[bytes]) -> SampleBlock:
    if len(parts) == 1:
        return block
    return replace(block, samples=np.frombuffer(b"".join(parts), _FLOAT32).reshape(-1, len(block.channels)))


def time_ns(data: bytes) -> int:
    """UTC of the first sample of the block in `data`, which may yet contradict itself.

    Raises
    ------
    ValueError
        If the bytes are no SampleBlock.
    """
    return _time_ns(_parsed(data))


def _parsed(data: bytes) -> Any:
    try:
        return _Message.FromString(data)
    except DecodeError as error:
        raise ValueError(f"no {SCHEMA_NAME} message: {error}") from error


def _time_ns(message: Any) -> int:
    timestamp = message.timestamp
    return int(timestamp.seconds * _NS + timestamp.nanos)
