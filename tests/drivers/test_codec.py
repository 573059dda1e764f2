"""Sample blocks as protobuf bytes: the contract's field numbers, nothing lost, nothing foreign accepted."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from hypothesis import given

from drivers import codec
from drivers.base import ACCELERATION, SampleBlock
from drivers.merged import merged
from tests.support.any_block import blocks, same
from tests.support.samples import Cut


@given(blocks())
def test_any_block_comes_back_the_same(block: SampleBlock) -> None:
    assert same(codec.decode(codec.encode(block), block.topic), block)


def test_bytes_follow_the_contract_field_by_field() -> None:
    block = SampleBlock("/x", 5_000_000_007, 3, 100.0, ("a", "b"), "degC", np.array([[1, 2]], np.float32))
    assert codec.encode(block) == (
        b"\x0a\x04\x08\x05\x10\x07"  # 1: timestamp {1: 5 s, 2: 7 ns}
        b"\x10\x03"  # 2: sequence
        + b"\x19"
        + struct.pack("<d", 100.0)  # 3: rate
        + b"\x22\x01a\x22\x01b\x2a\x04degC"  # 4: channels, 5: unit
        + b"\x32\x08"
        + struct.pack("<2f", 1, 2)  # 6: samples
    )


def test_schema_describes_itself_with_its_dependency() -> None:
    files = descriptor_pb2.FileDescriptorSet.FromString(codec.SCHEMA_BYTES)
    assert [file.package for file in files.file] == ["google.protobuf", "shm"]
    fields = {field.name: field.number for field in files.file[1].message_type[0].field}
    assert fields == {"timestamp": 1, "sequence": 2, "sample_rate_hz": 3, "channels": 4, "unit": 5, "samples": 6}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: data.replace(b"m/s^2", b"parsec"[:5]), "unknown unit"),
        (lambda data: data[:-1], "no shm.SampleBlock"),
        (lambda data: data.replace(b"\x22\x01a", b""), "without channel names"),
        (lambda data: data.replace(struct.pack("<d", 100.0), struct.pack("<d", float("nan"))), "sample rate"),
        (lambda data: data + b"\x22\x01b\x22\x01c", "no whole rows"),
    ],
)
def test_contradictions_are_refused_with_their_reason(change, reason: str) -> None:  # type: ignore[no-untyped-def]
    block = SampleBlock(ACCELERATION, 0, 0, 100.0, ("a",), "m/s^2", np.ones((4, 1), np.float32))
    with pytest.raises(ValueError, match=reason):
        codec.decode(change(codec.encode(block)), ACCELERATION)


def test_joined_blocks_are_those_that_go_on(cut: Cut) -> None:
    """Joining while decoding gives what joining decoded blocks gives."""
    blocks = cut(np.arange(3.0 * 1000).reshape(1000, 3), 100.0, [10])
    blocks = [*blocks[:30], *blocks[31:60], replace(blocks[60], unit="degC"), *blocks[61:]]
    joined = codec.decode_joined(map(codec.encode, blocks), ACCELERATION, 2.0)
    wanted = list(merged(blocks, 2.0))
    assert [(b.t_ns, b.sequence, b.unit, b.samples.tobytes()) for b in joined] == [
        (b.t_ns, b.sequence, b.unit, b.samples.tobytes()) for b in wanted
    ]
    assert codec.decode_joined([], ACCELERATION, 2.0) == []
    with pytest.raises(ValueError, match="order"):
        codec.decode_joined(map(codec.encode, blocks[::-1]), ACCELERATION, 2.0)
