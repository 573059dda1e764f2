"""Reads the sample blocks of any number of MCAP files in time order (`drivers.mcap_writer` writes them)."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TypeVar

from mcap.reader import make_reader
from mcap.records import Channel

from drivers import codec
from drivers.base import ACCELERATION, UNIT_OF, RecordingError, RecordingMissingError, SampleBlock
from drivers.limits import absurdity
from drivers.mcap_index import read_index
from drivers.mcap_records import PARSE_ERRORS, McapFile, Message, Segment
from drivers.mcap_writer import AS_ARRIVED, LIBRARY, ORDER, McapWriter, arrival, clock_of
from drivers.merged import merged
from drivers.ros2_imu import IMU_SCHEMAS, Evenly, ImuJoiner, ImuSample, decode_imu, split_target

__all__ = [
    "McapWriter",
    "RecordingInfo",
    "read_metadata",
    "read_recordings",
    "recorded_time",
    "recording_info",
    "scan_messages",
]

_Item = SampleBlock | ImuSample
_Result = TypeVar("_Result")
OnWarning = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Content of a recording; rate, time and number of samples are those of `/acceleration`."""

    topics: tuple[str, ...]
    channels: dict[str, tuple[str, ...]]
    """Topic -> channel names, in column order."""
    sample_rate_hz: float
    duration_s: float
    """Time from the first sample to one sampling period after the last, gaps included."""
    t_start_ns: int
    n_samples: int

    @property
    def t_end_ns(self) -> int:
        """UTC one sampling period after the last sample."""
        return self.t_start_ns + round(self.duration_s * 1e9)


def read_recordings(
    paths: Iterable[Path],
    topics: Sequence[str] | None = tuple(UNIT_OF),
    *,
    topic_map: Mapping[str, str] | None = None,
    on_warning: OnWarning = lambda _: None,
    longest_s: float = 0.0,
    evenly: Evenly | None = None,
) -> Iterator[SampleBlock]:
    """Read the blocks of all files in the order of their times, or of their arrival if they were recorded live.

    Every file is checked as a whole (checksums, form of every message) before the first block is returned.  The blocks are
    then read again on demand, so that memory grows by some 100 bytes a chunk only.

    Parameters
    ----------
    topics
        Those to be read; None for all that hold blocks, covariates among them.
    topic_map
        Topic of ROS 2 `sensor_msgs/msg/Imu` -> channel name, with axis if it is not x: "a1" or "a1.z".
    on_warning
        Called once for each file that ends early or has damaged chunks, which are left out, and for each ROS 2 topic with
        messages that came again, once all are read.
    evenly
        Finds rate (Hz) and evenly spaced stamps (ns) of all stamps of a ROS 2 topic; by default the stamps are taken as they are,
        at the median of their steps.
    longest_s
        Greatest length, s, of the blocks to which consecutive blocks of `/acceleration` are joined; 0 joins none.

    Raises
    ------
    RecordingMissingError
        If a file cannot be opened.
    RecordingError
        If bytes outside of chunks, or all chunks, are damaged or foreign, a wanted topic is absent, or a unit is wrong.
        Contradictory fields of a message, and errors of joining ROS 2 topics, are raised while the blocks are iterated.
    """
    topic_map = topic_map or {}
    surveys = [_Survey(McapFile(Path(path), leave_out=True), topics, topic_map) for path in paths]
    found_topics: set[str] = set()
    for survey in surveys:
        survey.run(on_warning)
        found_topics |= survey.found_topics
    wanted = (topics is None or ACCELERATION in topics) and not topic_map
    if surveys and ((wanted and ACCELERATION not in found_topics) or not topic_map.keys() <= found_topics):
        names = ", ".join(str(survey.file.path) for survey in surveys)
        absent = ", ".join(sorted(topic_map.keys() - found_topics)) or ACCELERATION
        raise RecordingError(f"{names}: no messages of {absent}; the topics are {', '.join(sorted(found_topics))}")
    blocks = _join_topics(surveys, topic_map, longest_s, on_warning, evenly)
    return merged(blocks, longest_s) if longest_s else blocks


def recording_info(
    path: Path, *, topic_map: Mapping[str, str] | None = None, evenly: Evenly | None = None
) -> RecordingInfo:
    """Read a recording and return its channels, rate, duration and number of samples (all else as `read_recordings`)."""
    channels: dict[str, tuple[str, ...]] = {}
    samples: dict[str, int] = {}
    first: dict[str, SampleBlock] = {}
    last: dict[str, SampleBlock] = {}
    for block in read_recordings([path], None, topic_map=topic_map, evenly=evenly):
        channels.setdefault(block.topic, block.channels)
        samples[block.topic] = samples.get(block.topic, 0) + block.n_samples
        first.setdefault(block.topic, block)
        last[block.topic] = block
    start, end = first[ACCELERATION], last[ACCELERATION]
    duration_s = _duration_s(start, end)
    return RecordingInfo(tuple(channels), channels, start.sample_rate_hz, duration_s, start.t_ns, samples[ACCELERATION])


def recorded_time(
    path: Path, *, topic_map: Mapping[str, str] | None = None, evenly: Evenly | None = None
) -> tuple[int, int]:
    """Read when a recording begins and ends, UTC in ns, as `recording_info` does, of a file with an index from its ends alone."""
    survey = _Survey(McapFile(path), tuple(UNIT_OF), topic_map or {})
    end = survey.last_block(ACCELERATION) if survey.use_index() else None
    if end is None:
        info = recording_info(path, topic_map=topic_map, evenly=evenly)
        return info.t_start_ns, info.t_end_ns
    start = next(block for block in _join_topics([survey], {}, 0.0, lambda _: None) if block.topic == ACCELERATION)
    return start.t_ns, start.t_ns + round(_duration_s(start, end) * 1e9)


def _duration_s(start: SampleBlock, end: SampleBlock) -> float:
    """Compute the time from a block's first sample to one sampling period after another's last, s."""
    return (end.t_ns - start.t_ns) / 1e9 + end.length_s


def read_metadata(path: Path, name: str) -> dict[str, str] | None:
    """Read a metadata record of a recording; None where it has none of that name (errors as `read_recordings`)."""
    try:
        with path.open("rb") as file:
            found = (record.metadata for record in make_reader(file).iter_metadata() if record.name == name)
            return next(found, None)
    except OSError as error:
        raise RecordingMissingError(f"{path}: {error.strerror}") from error
    except PARSE_ERRORS as error:
        raise RecordingError(f"{path}: damaged: {error}") from error


def scan_messages(path: Path) -> Iterator[tuple[str, int, bytes]]:
    """Read topic, log time (ns) and data of every message in file order (errors as `read_recordings`)."""
    file = McapFile(Path(path))
    for _, messages in file.segments():
        for message in messages:
            yield file.channels[message.channel_id].topic, message.log_time, message.data


class _Survey:
    """Overview of one file: its segments that hold wanted messages, and the time at which each begins."""

    def __init__(self, file: McapFile, topics: Sequence[str] | None, topic_map: Mapping[str, str]) -> None:
        self.file = file
        self.found_topics: set[str] = set()
        self.segments: list[tuple[int, Segment]] = []
        self.ends: list[tuple[int, Segment]] = []
        """The time at which each segment ends, where the file's index tells it."""
        self._topics = frozenset(UNIT_OF if topics is None else topics)
        self._takes_all = topics is None
        self._channels: dict[int, tuple[Channel, bool]] = {}
        self._axes = {topic: split_target(target)[1] for topic, target in topic_map.items()}
        self.stamps: dict[str, list[int]] = {topic: [] for topic in topic_map}
        """Stamps of the mapped ROS 2 topics, ns, in the file's order."""

    def run(self, on_warning: OnWarning) -> None:
        """Check the whole file, and find the segments with wanted messages."""
        self.file.demand()
        if self.use_index():
            return
        count = 0
        for segment, messages in self.file.segments():
            if times := [t_ns for t_ns, _ in self._read_wanted(messages, self._time_ns)]:
                self.segments.append((min(times), segment))
                count += len(times)
        damage = self.file.damage
        if not self.segments:
            raise damage[0] if damage else RecordingError(f"{self.file.path}: {self._content_text()}")
        if damage:
            left_out = "one chunk is" if len(damage) == 1 else f"{len(damage)} chunks are"
            on_warning(f"{damage[0]}; {left_out} left out, the {count} blocks of the others are used")
        if self.file.cut:
            on_warning(f"{self.file.path}: {self.file.cut}; the {count} whole blocks before it are used")

    def use_index(self) -> bool:
        """Take the segments from the index, which suffices for a whole file of our own writer with wanted messages."""
        chunks = None if self._axes else read_index(self.file, LIBRARY)
        if chunks is None:
            return False
        channels = list(self.file.channels.values())
        try:
            if not any([self._wanted(channel) for channel in channels]):
                return False
        except ValueError:  # reading the file through gives an error message with the place
            return False
        clock = max(clock_of(channel.metadata) for channel in channels)
        self.segments = [(arrival(start_ns, clock), segment) for start_ns, _, segment in chunks]
        self.ends = [(arrival(end_ns, clock), segment) for _, end_ns, segment in chunks]
        return True

    def last_block(self, topic: str) -> SampleBlock | None:
        """Load the last block of a topic, of a file that has an index; None if it has none."""
        starts = {segment: start for start, segment in self.segments}
        found: list[tuple[int, int, Segment, SampleBlock]] = []
        for end_ns, segment in sorted(self.ends, reverse=True):
            if found and end_ns < max(t_ns for t_ns, *_ in found):
                break
            for t_ns, item in self.decoded(self.file.load(segment)):
                if isinstance(item, SampleBlock) and item.topic == topic:
                    found.append((t_ns, starts[segment], segment, item))
        return sorted(found, key=lambda one: one[:3])[-1][-1] if found else None

    def decoded(self, messages: list[Message]) -> list[tuple[int, _Item]]:
        """Decode the wanted ones of some messages, each with the time (ns) by which it is ordered."""
        return list(self._read_wanted(messages, self._decode))

    def load_joined(self, messages: list[Message], longest_s: float) -> list[SampleBlock] | None:
        """Decode to joined blocks; None unless all wanted messages are `/acceleration` on one MCAP channel and in order."""
        wanted = [c for c in (self.file.channels[n] for n in {m.channel_id for m in messages}) if self._wanted(c)]
        if [c.topic for c in wanted] != [ACCELERATION] or ACCELERATION in self._axes or ORDER in wanted[0].metadata:
            return None
        try:
            data = [m.data for m in messages if m.channel_id == wanted[0].id]
            blocks = codec.decode_joined(data, ACCELERATION, longest_s)
            for block in blocks:
                _require_plausible(block)
        except ValueError:  # decoding the messages one by one gives an error message with the place
            return None
        return blocks

    def _read_wanted(self, messages: list[Message], read: Callable[[Message, Channel], _Result]) -> Iterator[_Result]:
        """Yield the result of `read` for each wanted message; errors name file, topic and log time."""
        for message in messages:
            channel = self.file.channels[message.channel_id]
            try:
                if self._wanted(channel):
                    yield read(message, channel)
            except ValueError as error:
                place = f"{self.file.path}: {channel.topic} at {message.log_time} ns"
                raise RecordingError(f"{place}: {error}; record or import it again") from error

    def _wanted(self, channel: Channel) -> bool:
        """Test whether the channel's messages are to be read; the result is kept for each channel."""
        known = self._channels.get(channel.id)
        if known is None or known[0] is not channel:
            known = self._channels[channel.id] = channel, self._check_channel(channel)
        return known[1]

    def _check_channel(self, channel: Channel) -> bool:
        """Test whether a channel is wanted; raise ValueError if its schema or encoding is wrong."""
        topic, schema = channel.topic, self.file.schema_name(channel)
        fits = schema == codec.SCHEMA_NAME and channel.message_encoding == "protobuf"
        fault = f"schema {schema!r} ({channel.message_encoding}) where {codec.SCHEMA_NAME} is needed"
        if topic in self._axes:
            fits = schema in IMU_SCHEMAS and channel.message_encoding == "cdr"
            fault = f"the topic map needs {IMU_SCHEMAS[0]} in cdr, not {schema!r}"
        elif topic not in self._topics and not (self._takes_all and fits):
            return False
        if not fits:
            raise ValueError(fault)
        self.found_topics.add(topic)
        return True

    def _time_ns(self, message: Message, channel: Channel) -> tuple[int, None]:
        """Read the time by which a message is ordered, ns, without decoding its samples."""
        if channel.topic in self._axes:
            t_ns = self._decode(message, channel)[0]
            self.stamps[channel.topic].append(t_ns)
            return t_ns, None
        return _order_ns(message, channel, codec.time_ns(message.data)), None

    def _decode(self, message: Message, channel: Channel) -> tuple[int, _Item]:
        """Decode a message; return the time by which it is ordered, ns, and its content."""
        topic = channel.topic
        if topic in self._axes:
            sample = decode_imu(message.data, topic, self._axes[topic])
            return sample.t_ns, sample
        block = codec.decode(message.data, topic)
        _require_plausible(block)
        return _order_ns(message, channel, block.t_ns), block

    def _content_text(self) -> str:
        """Describe, for an error message, a file without a wanted message."""
        channels = list(self.file.channels.values())[:20]
        held = ", ".join(f"{c.topic} ({self.file.schema_name(c) or 'no schema'})" for c in channels)
        cut = f" ({self.file.cut})" if self.file.cut else ""
        return (
            f"no block of {', '.join(sorted(self._topics | self._axes.keys()))}{cut}; "
            f"it holds {held or 'no topics'}. Name ROS 2 Imu topics in a topic map, or import other data "
            "with shm-monitor import"
        )


def _order_ns(message: Message, channel: Channel, t_ns: int) -> int:
    """Return the time by which a block is ordered, ns: that of its arrival in a live recording, else its own, `t_ns`."""
    if channel.metadata.get(ORDER) != AS_ARRIVED:
        return t_ns
    return arrival(message.log_time, clock_of(channel.metadata))


def _require_plausible(block: SampleBlock) -> None:
    """Raise ValueError for values that only damage or a foreign writer explains."""
    if (absurd := absurdity(block)) is not None:
        raise ValueError(absurd)
    if block.unit != UNIT_OF.get(block.topic, block.unit):
        raise ValueError(f"unit {block.unit!r} where {UNIT_OF[block.topic]!r} is needed")


def _merge_in_time_order(surveys: list[_Survey], longest_s: float) -> Iterator[_Item]:
    """Yield the messages of all files in time order; only segments that overlap in time are in memory together."""
    pool = [(start, number, segment) for number, survey in enumerate(surveys) for start, segment in survey.segments]
    pool.sort()
    heap: list[tuple[int, int, int, _Item]] = []
    serial = 0
    starts = [start for start, *_ in pool]
    for following, (start, number, segment) in zip([*starts[1:], inf], pool, strict=True):
        while heap and heap[0][0] < start:
            yield heapq.heappop(heap)[-1]
        messages = surveys[number].file.load(segment)
        joined = surveys[number].load_joined(messages, longest_s) if longest_s and not heap else None
        if joined is not None and _last_ns(joined[-1]) < following:
            yield from joined
            continue
        items = surveys[number].decoded(messages)
        times = [t_ns for t_ns, _ in items]
        if not heap and times == sorted(times) and (not times or times[-1] < following):
            yield from (item for _, item in items)
            continue
        for t_ns, item in items:
            heapq.heappush(heap, (t_ns, number, serial, item))
            serial += 1
    while heap:
        yield heapq.heappop(heap)[-1]


def _last_ns(block: SampleBlock) -> int:
    """Compute the time of a block's last sample, ns: no small block inside a joined block begins later."""
    return block.t_ns + round((block.n_samples - 1) / block.sample_rate_hz * 1e9)


def _join_topics(
    surveys: list[_Survey],
    topic_map: Mapping[str, str],
    longest_s: float,
    on_warning: OnWarning,
    evenly: Evenly | None = None,
) -> Iterator[SampleBlock]:
    """Yield the blocks of all files in time order, and join the mapped ROS 2 topics to blocks."""
    stamps = {topic: [t for survey in surveys for t in survey.stamps[topic]] for topic in topic_map}
    names = ", ".join(str(survey.file.path) for survey in surveys)
    joiner = ImuJoiner(topic_map, names, stamps if evenly else {}, evenly) if topic_map else None
    for item in _merge_in_time_order(surveys, longest_s):
        if isinstance(item, SampleBlock):
            yield item
        elif joiner:
            yield from joiner.add(item)
    if joiner:
        yield from joiner.finish()
        for topic, count in joiner.doubled.items():
            on_warning(f"{names}: {topic}: {count} messages that came again, with the same stamp, are left out")
