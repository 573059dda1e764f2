"""Blocks that a network brings and that are refused: the reason stands in the log once a minute, and is asked for until then."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from drivers import codec
from drivers.arrivals import Arrivals
from drivers.base import ACCELERATION, SampleBlock
from drivers.limits import BlockLimits
from drivers.mqtt import decode, encode
from drivers.recent import Recent
from tests.support.numbered import block

JSON = partial(decode, form="json")


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def arrivals(clock: Clock, decoder: Callable[[bytes, str], SampleBlock] = codec.decode) -> Arrivals:
    return Arrivals([ACCELERATION], BlockLimits(max_channels=8), 4, (), decoder, Recent(clock))


def as_json(i: int, **wrong: object) -> bytes:
    return json.dumps(json.loads(encode(block(i), "json")) | wrong).encode()


@pytest.mark.parametrize(
    ("decoder", "payload", "reason"),
    [
        (JSON, as_json(0, unit="g"), "unknown unit 'g'; known: m/s^2"),
        (JSON, as_json(0, unit="degC"), "its unit is 'degC', not 'm/s^2'"),
        (JSON, as_json(0, t_ns="2026-01-01T00:00:00"), "t_ns: Input should be a valid integer"),
        (JSON, b"[", "Invalid JSON"),
        (codec.decode, codec.encode(replace(block(0), channels=("a1", "a1", "a3"))), "channel 'a1' stands twice"),
        (codec.decode, codec.encode(replace(block(0), samples=np.empty((0, 3), np.float32))), "no samples"),
        (codec.decode, codec.encode(block(0)).replace(b"m/s^2", b"m/s\n2"), "unknown unit"),
        (
            codec.decode,
            codec.encode(replace(block(0), channels=tuple("abcdefghi"), samples=np.zeros((4, 9), np.float32))),
            "9 channels, where max_channels = 8",
        ),
    ],
)
def test_a_refused_block_is_told_with_its_reason_once_a_minute(
    decoder: Callable[[bytes, str], SampleBlock], payload: bytes, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    clock = Clock()
    arrived = arrivals(clock, decoder)
    for k in range(181):
        clock.now_s = 1.0 * k
        arrived.add(ACCELERATION, payload)
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 4
    for record, n in zip(caplog.records, (1, 61, 121, 181), strict=True):
        words = record.getMessage()
        assert words.startswith(f"a block of {ACCELERATION} is refused, {n} so far: ") and reason in words
        assert "\n" not in words and len(words) <= 300
    assert reason in arrived.recent.latest and arrived.counts["undecodable"] == 181
    clock.now_s += 60.0
    assert arrived.recent.latest == ""


def test_a_message_that_is_too_large_is_told_too(caplog: pytest.LogCaptureFixture) -> None:
    arrived = arrivals(Clock())
    arrived.refuse_oversized("/force", 1 << 21)
    assert "a block of /force is refused, 1 so far: 2097152 bytes, where max_payload_bytes = 1048576" in caplog.text
    assert arrived.counts["oversized"] == 1


def test_good_blocks_beside_refused_ones_go_on_and_say_nothing(caplog: pytest.LogCaptureFixture) -> None:
    arrived = arrivals(Clock(), JSON)
    for i in range(3):
        arrived.add(ACCELERATION, as_json(i))
    assert [arrived.take().sequence for _ in range(3)] == [block(i).sequence for i in range(3)]
    assert not caplog.records and arrived.recent.latest == ""


def test_a_number_that_is_none_is_a_missing_sample_of_json() -> None:
    rows = [[0.5, float("nan"), None], [float("inf"), 1.0, -float("inf")]]
    text = as_json(0, samples=rows)
    assert b"NaN" in text and b"Infinity" in text  # as json.dumps of Python writes them
    samples = decode(text, ACCELERATION, "json").samples
    np.testing.assert_array_equal(np.isfinite(samples), [[True, False, False], [False, True, False]])
    with pytest.raises(ValueError, match="sample rate must be positive and finite"):
        decode(as_json(0, sample_rate_hz=float("nan")), ACCELERATION, "json")
