"""ROS 2 Imu recordings: CDR read by hand, topics joined by their stamps or refused."""

import itertools
import random
from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION, RecordingError, SampleBlock
from drivers.mcap_file import read_recordings, recording_info
from drivers.ros2_imu import decode_imu, split_target
from tests.support.ros2 import imu, record

_STEP = 5_000_000  # 200 Hz
_START = 1_700_000_000 * 10**9


def read(path: Path, *topics: str) -> list[SampleBlock]:
    names = {topic: f"a{number}" for number, topic in enumerate(topics, start=1)}
    return list(read_recordings([path], topic_map=names))


def times(count: int, offset: int = 0, step: int = _STEP) -> list[int]:
    return [_START + offset + step * number for number in range(count)]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("frame", [b"", b"imu", b"base_link_7"])
@pytest.mark.parametrize(("axis", "expected"), [("x", 1.5), ("y", -2.5), ("z", 9.81)])
def test_cdr_of_either_byte_order_and_any_alignment(order: str, frame: bytes, axis: str, expected: float) -> None:
    sample = decode_imu(imu(_START + 7, (1.5, -2.5, 9.81), frame, order), "/imu", axis)
    assert (sample.t_ns, sample.topic, sample.value) == (_START + 7, "/imu", expected)


def test_damaged_messages_are_value_errors() -> None:
    whole = imu(_START, (1.0, 2.0, 3.0))
    for size in range(len(whole)):
        with pytest.raises(ValueError, match=r"no plain CDR|too short"):
            decode_imu(whole[:size], "/imu")
    chance = random.Random(1)
    for _ in range(2000):
        data = bytearray(whole)
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        try:
            assert isinstance(decode_imu(bytes(data), "/imu").value, float)
        except ValueError:
            continue


@pytest.mark.parametrize(
    ("target", "expected"), [("a1", ("a1", "x")), ("a1.z", ("a1", "z")), ("mast.top", ("mast.top", "x"))]
)
def test_a_target_names_channel_and_axis(target: str, expected: tuple[str, str]) -> None:
    assert split_target(target) == expected


def test_topics_become_columns_in_the_order_of_the_map(tmp_path: Path) -> None:
    jitter = random.Random(2)
    shaken = [t_ns + jitter.randrange(-1_000_000, 1_000_000) for t_ns in times(1000)]
    stamps = {"/low": shaken, "/top": times(1000)}
    path = record(tmp_path / "a.mcap", stamps, lambda topic, t: (topic == "/top") + round((t - _START) / _STEP) / 1e3)
    blocks = read(path, "/top", "/low")
    values = np.concatenate([block.samples for block in blocks])
    ramp = np.arange(1000) / 1e3
    np.testing.assert_allclose(values, np.column_stack([ramp + 1, ramp]), atol=1e-6)
    assert {block.topic for block in blocks} == {ACCELERATION} and blocks[0].channels == ("a1", "a2")
    assert [block.sequence for block in blocks] == list(range(0, 1000, 200))
    assert blocks[0].sample_rate_hz == pytest.approx(200, rel=1e-3) and blocks[0].t_ns == _START
    assert recording_info(path, topic_map={"/top": "a1.z"}).n_samples == 1000


def test_a_lost_message_is_a_jump_of_the_sequence(tmp_path: Path) -> None:
    holed = times(1000)
    del holed[500:503]
    blocks = read(record(tmp_path / "a.mcap", {"/top": times(1000), "/low": holed}), "/top", "/low")
    ends = [block.sequence + block.n_samples for block in blocks]
    jumps = [(end, block.sequence) for end, block in zip(ends, blocks[1:], strict=False) if block.sequence != end]
    assert jumps == [(500, 503)] and ends[-1] == 1000


def test_messages_that_came_twice_are_taken_once_and_counted(tmp_path: Path) -> None:
    def value(topic: str, t_ns: int) -> float:
        return (t_ns - _START) / 1e9

    once = read(record(tmp_path / "once.mcap", {"/top": times(1000), "/low": times(1000)}, value), "/top", "/low")
    twice = [*times(1000), *times(1000)[100:103], times(1000)[999]]
    path, warnings = record(tmp_path / "twice.mcap", {"/top": times(1000), "/low": twice}, value), list[str]()
    blocks = list(read_recordings([path], topic_map={"/top": "a1", "/low": "a2"}, on_warning=warnings.append))
    assert [(b.t_ns, b.sequence, b.samples.tobytes()) for b in blocks] == [
        (b.t_ns, b.sequence, b.samples.tobytes()) for b in once
    ]
    assert warnings == [f"{path}: /low: 4 messages that came again, with the same stamp, are left out"]


def test_a_topic_that_starts_late_only_shortens_the_recording(tmp_path: Path) -> None:
    blocks = read(record(tmp_path / "a.mcap", {"/top": times(1000), "/low": times(1000)[400:]}), "/top", "/low")
    assert blocks[0].t_ns == times(1000)[400] and blocks[0].sequence == 0
    assert sum(block.n_samples for block in blocks) == 600


@pytest.mark.parametrize(
    ("low", "reason"),
    [
        (times(1000, 10 * 10**9), "never agree"),
        (times(1000, step=2 * _STEP), "different rates.*200.00 Hz.*100.00 Hz"),
        ([_START] * 500, "do not rise"),
        (times(1), "too few"),
        ([], "no messages of /low"),
    ],
)
def test_clocks_that_do_not_fit_are_refused(tmp_path: Path, low: list[int], reason: str) -> None:
    readings = itertools.count()
    path = record(tmp_path / "a.mcap", {"/top": times(1000), "/low": low}, lambda *_: next(readings))
    with pytest.raises(RecordingError, match=rf"a\.mcap: .*({reason})"):
        read(path, "/top", "/low")


def test_without_a_map_the_error_names_the_topics_and_the_map(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", {"/top": times(10)})
    with pytest.raises(RecordingError, match=r"/top \(sensor_msgs/msg/Imu\).*topic map"):
        list(read_recordings([path]))
