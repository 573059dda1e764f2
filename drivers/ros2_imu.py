"""ROS 2 `sensor_msgs/msg/Imu` recordings, one topic a floor, as sample blocks.

The CDR layout of this one message is fixed, so it is read by hand; no ROS installation is needed.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from drivers.base import ACCELERATION, RecordingError, SampleBlock

IMU_SCHEMAS = ("sensor_msgs/msg/Imu", "sensor_msgs/Imu")
_NS = 1_000_000_000
_AXES = {"x": 25, "y": 26, "z": 27}  # of 37 doubles: orientation 4+9, angular velocity 3+9, acceleration 3+9
_LEARN = 256  # samples of a topic from which its rate is learned
_PENDING = 100_000  # samples of one topic waiting for the others; more means that another has ended


class ImuSample(NamedTuple):
    """One reading: stamp of the header (ns), topic, acceleration along the mapped axis (m/s^2)."""

    t_ns: int
    topic: str
    value: float


def split_target(target: str) -> tuple[str, str]:
    """Channel name and axis of a topic map's value, "a1" or "a1.y"; the axis is x unless told."""
    name, dot, axis = target.rpartition(".")
    return (name, axis) if dot and axis in _AXES else (target, "x")


def decode_imu(data: bytes, topic: str, axis: str = "x") -> ImuSample:
    """The acceleration in one CDR message.

    Raises
    ------
    ValueError
        If the bytes are no little- or big-endian CDR of this message.
    """
    if len(data) < 16 or data[0] != 0 or data[1] not in (0, 1):
        raise ValueError("no plain CDR message")
    order = "<" if data[1] else ">"
    body = data[4:]  # alignment counts from behind the encapsulation header
    seconds, nanoseconds, frame_length = struct.unpack_from(order + "iII", body)
    start = -(-(12 + frame_length) // 8) * 8
    if start + 37 * 8 > len(body):
        raise ValueError(f"an Imu message of {len(data)} bytes is too short")
    (value,) = struct.unpack_from(order + "d", body, start + 8 * _AXES[axis])
    return ImuSample(seconds * _NS + nanoseconds, topic, value)


class ImuJoiner:
    """Joins topics sample by sample: a row where all stamps agree within half a sample.

    Samples before the last topic's start, and those whose partner was lost, are left out; the jump of
    `sequence` says so.  Feed samples in the order of their stamps.
    """

    def __init__(self, topic_map: Mapping[str, str], where: str) -> None:
        """Topic -> channel name with axis; `where` names the files in errors."""
        self._where = where
        self._queues: dict[str, deque[ImuSample]] = {topic: deque() for topic in topic_map}
        self._channels = tuple(split_target(target)[0] for target in topic_map.values())
        self._step_ns = 0.0
        self._rows: list[list[float]] = []
        self._start_ns = self._last_ns = self._sequence = 0
        self._rows_in_all = 0

    def add(self, sample: ImuSample) -> Iterator[SampleBlock]:
        """Take one sample; give the blocks that it completes.

        Raises
        ------
        RecordingError
            If the topics do not run at one rate on one clock.
        """
        queue = self._queues[sample.topic]
        if queue and sample.t_ns <= queue[-1].t_ns:
            raise RecordingError(
                f"{self._where}: topic {sample.topic}: stamps do not rise at {sample.t_ns} ns; record stamped messages"
            )
        queue.append(sample)
        if len(queue) > _PENDING:
            silent = [topic for topic, waiting in self._queues.items() if not waiting]
            raise RecordingError(
                f"{self._where}: topic {sample.topic} runs {_PENDING} samples ahead of "
                f"{', '.join(silent) or 'the others'}; "
                "map only topics recorded at the same time"
            )
        if not self._step_ns:
            if min(map(len, self._queues.values())) < _LEARN:
                return
            self._learn()
        yield from self._drain()

    def finish(self) -> Iterator[SampleBlock]:
        """What remains at the end (same errors)."""
        if not self._step_ns:
            self._learn()
        yield from self._drain()
        yield from self._emit()
        if not self._rows_in_all:
            raise RecordingError(
                f"{self._where}: the stamps of {', '.join(self._queues)} never agree within half a sample; "
                "set the clocks"
            )

    def _learn(self) -> None:
        steps = {}
        for topic, queue in self._queues.items():
            if len(queue) < 2:
                raise RecordingError(f"{self._where}: topic {topic}: {len(queue)} Imu messages are too few to join")
            steps[topic] = float(np.median(np.diff([sample.t_ns for sample in queue])))
        self._step_ns = min(steps.values())
        if max(steps.values()) > 1.02 * self._step_ns:
            rates = ", ".join(f"{topic} {_NS / step:.2f} Hz" for topic, step in steps.items())
            raise RecordingError(f"{self._where}: the Imu topics run at different rates: {rates}; record them at one")

    def _drain(self) -> Iterator[SampleBlock]:
        queues = list(self._queues.values())
        while all(queues):
            newest = max(queue[0].t_ns for queue in queues)
            late = [queue for queue in queues if newest - queue[0].t_ns > self._step_ns / 2]
            if late:
                for queue in late:
                    queue.popleft()
                continue
            t_ns = queues[0][0].t_ns
            missed = max(1, round((t_ns - self._last_ns) / self._step_ns)) if self._rows_in_all else 1
            if missed > 1 or len(self._rows) * self._step_ns >= _NS:
                yield from self._emit()
                self._sequence += missed - 1
            if not self._rows:
                self._start_ns = t_ns
            self._rows.append([queue.popleft().value for queue in queues])
            self._last_ns = t_ns
            self._rows_in_all += 1

    def _emit(self) -> Iterator[SampleBlock]:
        if self._rows:
            yield SampleBlock(
                topic=ACCELERATION,
                t_ns=self._start_ns,
                sequence=self._sequence,
                sample_rate_hz=round(_NS / self._step_ns, 3),
                channels=self._channels,
                unit="m/s^2",
                samples=np.array(self._rows, dtype=np.float32),
            )
            self._sequence += len(self._rows)
            self._rows = []
