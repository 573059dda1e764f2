"""Converts ROS 2 `sensor_msgs/msg/Imu` recordings, with one topic for each floor, to sample blocks.

The CDR layout of this message is fixed and decoded here, so that no ROS installation is needed.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import ACCELERATION, RecordingError, SampleBlock

IMU_SCHEMAS = ("sensor_msgs/msg/Imu", "sensor_msgs/Imu")
_NS = 1_000_000_000
_AXES = {"x": 25, "y": 26, "z": 27}  # of 37 doubles: orientation 4+9, angular velocity 3+9, acceleration 3+9
_RATE_SAMPLES = 256  # samples of a topic from which its rate is estimated
_MAX_PENDING = 100_000  # samples of one topic that wait for the others; more means that another topic has ended


Evenly = Callable[[NDArray[np.int64]], tuple[float, NDArray[np.int64]]]
"""Finds rate (Hz) and evenly spaced stamps (ns) of the rising stamps of a topic; raises ValueError where they tell no rate."""


class ImuSample(NamedTuple):
    """Reading of one Imu message: stamp of the header (ns), topic, acceleration along the mapped axis (m/s^2)."""

    t_ns: int
    topic: str
    value: float


def split_target(target: str) -> tuple[str, str]:
    """Split a topic map's value into channel name and axis; the axis is x by default.

    Examples
    --------
    >>> split_target("a1.y"), split_target("a1")
    (('a1', 'y'), ('a1', 'x'))
    """
    name, dot, axis = target.rpartition(".")
    return (name, axis) if dot and axis in _AXES else (target, "x")


def decode_imu(data: bytes, topic: str, axis: str = "x") -> ImuSample:
    """Decode stamp and acceleration along one axis from one CDR message of either byte order; else raises `ValueError`."""
    if len(data) < 16 or data[0] != 0 or data[1] not in (0, 1):
        raise ValueError("no plain CDR message")
    order = "<" if data[1] else ">"
    body = data[4:]  # alignment counts from the end of the encapsulation header
    seconds, nanoseconds, frame_length = struct.unpack_from(order + "iII", body)
    start = -(-(12 + frame_length) // 8) * 8
    if start + 37 * 8 > len(body):
        raise ValueError(f"an Imu message of {len(data)} bytes is too short")
    (value,) = struct.unpack_from(order + "d", body, start + 8 * _AXES[axis])
    return ImuSample(seconds * _NS + nanoseconds, topic, value)


class ImuJoiner:
    """Joiner of Imu topics: one row of samples where the stamps of all topics agree within half a sample.

    `topic_map` is topic -> channel name with axis; `where` names the files in errors.  Samples before the start of the last
    topic, and samples without a partner in another topic, are left out; a jump of `sequence` marks the loss.  Samples must be
    added in the order of their stamps.  A message that came twice, with the same stamp and reading, is taken once and counted in
    `doubled`.  Topics that do not run at one rate on one clock, or whose stamps never agree, raise `RecordingError`.
    """

    def __init__(
        self,
        topic_map: Mapping[str, str],
        where: str,
        stamps: Mapping[str, Sequence[int]] = MappingProxyType({}),
        evenly: Evenly | None = None,
    ) -> None:
        self._where = where
        self._even: dict[str, dict[int, int]] = {}
        """Of each topic: stamp -> evenly spaced stamp."""
        self._queues: dict[str, deque[ImuSample]] = {topic: deque() for topic in topic_map}
        self._channels = tuple(split_target(target)[0] for target in topic_map.values())
        self._latest: dict[str, ImuSample] = {}
        self.doubled: Counter[str] = Counter()
        """Number of messages that came again, by topic."""
        self._step_ns = 0.0
        self._rows: list[list[float]] = []
        self._start_ns = self._last_ns = self._sequence = 0
        self._n_joined = 0
        if evenly is not None:
            self._space_evenly(stamps, evenly)

    def add(self, sample: ImuSample) -> Iterator[SampleBlock]:
        """Add one sample, and yield the blocks that it completes."""
        queue = self._queues[sample.topic]
        place = f"{self._where}: topic {sample.topic}"
        latest = self._latest.get(sample.topic)
        if sample == latest:
            self.doubled[sample.topic] += 1
            return
        if latest is not None and sample.t_ns <= latest.t_ns:
            raise RecordingError(f"{place}: stamps do not rise at {sample.t_ns} ns; record stamped messages")
        self._latest[sample.topic] = sample
        queue.append(sample._replace(t_ns=self._even[sample.topic][sample.t_ns]) if self._even else sample)
        if len(queue) > _MAX_PENDING:
            others = ", ".join(topic for topic, waiting in self._queues.items() if not waiting) or "the others"
            remedy = "map only topics recorded at the same time"
            raise RecordingError(f"{place} runs {_MAX_PENDING} samples ahead of {others}; {remedy}")
        if not self._step_ns:
            if min(map(len, self._queues.values())) < _RATE_SAMPLES:
                return
            self._estimate_step()
        yield from self._join_rows()

    def finish(self) -> Iterator[SampleBlock]:
        """Yield the remaining blocks at the end of the recording."""
        if not self._step_ns:
            self._estimate_step()
        yield from self._join_rows()
        yield from self._emit_block()
        if not self._n_joined:
            topics = ", ".join(self._queues)
            raise RecordingError(
                f"{self._where}: the stamps of {topics} never agree within half a sample; set the clocks"
            )

    def _space_evenly(self, stamps: Mapping[str, Sequence[int]], evenly: Evenly) -> None:
        """Take the rate and the samples' times from all stamps of each topic."""
        steps = {}
        for topic, times in stamps.items():
            rising = np.unique(np.array(times, dtype=np.int64))
            try:
                rate_hz, even = evenly(rising)
            except ValueError as error:
                raise RecordingError(f"{self._where}: topic {topic}: {error}") from error
            steps[topic] = _NS / rate_hz
            self._even[topic] = dict(zip(rising.tolist(), even.tolist(), strict=True))
        self._agree(steps)

    def _estimate_step(self) -> None:
        """Estimate the sampling period, ns, as the median difference of the stamps."""
        steps = {}
        for topic, queue in self._queues.items():
            if len(queue) < 2:
                again = f" ({self.doubled[topic]} that came again left out)" if self.doubled[topic] else ""
                raise RecordingError(
                    f"{self._where}: topic {topic}: {len(queue)} Imu messages{again} are too few to join"
                )
            steps[topic] = float(np.median(np.diff([sample.t_ns for sample in queue])))
        self._agree(steps)

    def _agree(self, steps: Mapping[str, float]) -> None:
        """Take the sampling period, ns, of all topics, which must agree."""
        self._step_ns = min(steps.values())
        if max(steps.values()) > 1.02 * self._step_ns:
            rates = ", ".join(f"{topic} {_NS / step:.2f} Hz" for topic, step in steps.items())
            raise RecordingError(f"{self._where}: the Imu topics run at different rates: {rates}; record them at one")

    def _join_rows(self) -> Iterator[SampleBlock]:
        """Join the waiting samples to rows; yield a block before each gap and after each second."""
        queues = list(self._queues.values())
        while all(queues):
            newest = max(queue[0].t_ns for queue in queues)
            late = [queue for queue in queues if newest - queue[0].t_ns > self._step_ns / 2]
            if late:
                for queue in late:
                    queue.popleft()
                continue
            t_ns = queues[0][0].t_ns
            steps_since = max(1, round((t_ns - self._last_ns) / self._step_ns)) if self._n_joined else 1
            if steps_since > 1 or len(self._rows) * self._step_ns >= _NS:
                yield from self._emit_block()
                self._sequence += steps_since - 1
            if not self._rows:
                self._start_ns = t_ns
            self._rows.append([queue.popleft().value for queue in queues])
            self._last_ns = t_ns
            self._n_joined += 1

    def _emit_block(self) -> Iterator[SampleBlock]:
        """Yield the joined rows as one block, if there are any."""
        if self._rows:
            rows, rate_hz = np.array(self._rows, dtype=np.float32), round(_NS / self._step_ns, 3)
            yield SampleBlock(ACCELERATION, self._start_ns, self._sequence, rate_hz, self._channels, "m/s^2", rows)
            self._sequence += len(self._rows)
            self._rows = []
