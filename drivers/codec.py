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
    """Protobuf bytes of a block (docs/connect.md has the field numbers)."""
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
    first: SampleBlock | None = None
    parts: list[bytes] = []
    n, last_ns, size, like = 0, -1, 0, b""
    for data in messages:
        # What lies between sequence and samples is mostly the same in block after block: then only the beginning is read.
        short = bool(like) and data[-size - len(like) : -size] == like
        message = _parsed(data[: -size - len(like)] if short else data)
        if short and (message.samples or message.unit or message.channels or message.sample_rate_hz):
            short, message = False, _parsed(data)
        t_ns = _time_ns(message)
        if t_ns < last_ns:
            raise ValueError("blocks out of order")
        last_ns = t_ns
        samples = data[-size:] if short else message.samples
        rows = 0 if first is None else len(samples) // (4 * len(first.channels))
        if (
            first is not None
            and message.sequence == first.sequence + n
            and n + rows <= longest_s * first.sample_rate_hz
            and abs(t_ns - first.t_ns - round(n / first.sample_rate_hz * 1e9)) <= 1
            and (short or _fits(message, first))
        ):
            parts.append(samples)
            n += rows
            continue
        if first is not None:
            joined.append(_with(first, parts))
        first = decode(data, topic)
        parts, n = [first.samples.tobytes()], first.n_samples
        size, like = len(parts[0]), _between(data, first, parts[0])
    return joined if first is None else [*joined, _with(first, parts)]


def _fits(message: Any, first: SampleBlock) -> bool:
    """Whether a block is of the kind of another."""
    return (
        message.sample_rate_hz == first.sample_rate_hz
        and len(message.samples) % (4 * len(first.channels)) == 0
        and message.unit == first.unit
        and tuple(message.channels) == first.channels
    )


def _between(data: bytes, block: SampleBlock, samples: bytes) -> bytes:
    """The bytes between time and sequence, which begin a message, and the samples, which end it; none if it is not so."""
    begin = _Message(sequence=block.sequence)
    begin.timestamp.seconds, begin.timestamp.nanos = divmod(block.t_ns, _NS)
    head = begin.SerializeToString()
    if not (samples and data.startswith(head) and data.endswith(samples)):
        return b""
    rest = _parsed(data[len(head) :])
    return b"" if rest.HasField("timestamp") or rest.sequence else data[len(head) : -len(samples)]


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
