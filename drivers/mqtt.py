"""Sample blocks over MQTT: the source that the daemon reads, and the publisher of a sensor node."""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers import codec
from drivers.arrivals import Arrivals
from drivers.base import ACCELERATION, EndOfStream, SampleBlock, SourceContext, SourceError, SourceHealth
from drivers.inbox import Inbox
from drivers.limits import BlockLimits
from drivers.live import LiveSettings
from drivers.mqtt_session import BrokerSettings, Connection, Message, Topic, client_id

_WAIT_S = 1.0
"""Time between two looks at whether the broker has a block. [s; cost]"""
Format = Literal["protobuf", "json"]
_MOST_IN_FLIGHT = 200
"""Largest number of messages under way: fewer than `drivers.reorder` remembers, so that it knows each that comes again."""


class StreamSettings(BrokerSettings):
    """Keys of a stream of blocks."""

    topic: Topic
    """MQTT topic of the floors' accelerations, as ``shm/lab-frame/acceleration``."""
    topics: dict[Annotated[str, Field(pattern="^/")], Topic] = Field(default={})
    """Recording topic -> MQTT topic of other quantities, as ``"/temperature" = "shm/lab-frame/temperature"``."""
    format: Format = "protobuf"
    """Form of the messages: the bytes of our recordings, or JSON (docs/mqtt.md)."""
    client_id: str | None = Field(default=None, pattern=r"^[^\x00]{1,128}$")
    """Name under which the broker keeps what is not yet taken; no two clients may share it.  By default told by `topic`."""

    @property
    def carried(self) -> dict[str, str]:
        """MQTT topic of each recording topic."""
        return {**self.topics, ACCELERATION: self.topic}


class MqttSettings(StreamSettings, BlockLimits, LiveSettings):
    """Table ``[source]`` with ``kind = "mqtt"``."""

    kind: Literal["mqtt"] = "mqtt"
    in_flight: int = Field(default=64, ge=1, le=_MOST_IN_FLIGHT)
    """Greatest number of messages that the broker sends before the first of them was taken."""
    session_s: int = Field(default=604_800, ge=1, le=0xFFFF_FFFF)
    """Time for which the broker keeps the messages of an absent reader, s."""
    hold_blocks: int = Field(default=4, ge=0, le=64)
    """Number of blocks that may wait for an earlier block before the earlier block counts as lost."""


@dataclass(frozen=True, slots=True)
class _Delivery:
    """Message as the broker sent it."""

    topic: str | None
    """Recording topic; None for a message that is only to be acknowledged."""
    generation: int
    """Connection that it came by: on another one its identifier belongs to another message."""
    message_id: int
    """Identifier to acknowledge; 0 for a message of quality of service 0."""


class MqttSource:
    """Source of the sample blocks of any MQTT publisher; see `drivers.base.Source`.

    A message is acknowledged when its block was handed on, so the broker keeps whatever this process, its connection or the
    broker itself loses before that, and sends it again.  What comes twice is recognised by its sequence number.  After
    `close` nothing more is handed out: the broker has it.
    """

    Settings = MqttSettings

    def __init__(self, settings: MqttSettings, context: SourceContext) -> None:
        self._settings, self._context = settings, context
        self._topics = {topic: ours for ours, topic in settings.carried.items()}
        if len(self._topics) < len(settings.carried):
            raise ValueError("an MQTT topic stands twice; each carries one quantity")
        if settings.password_file is not None and not (context.folder / settings.password_file).is_file():
            raise ValueError(f"password_file: {settings.password_file}: no such file")
        self._inbox = Inbox[_Delivery](settings.queue_bytes)
        self._arrivals = Arrivals(
            settings.carried, settings, settings.hold_blocks, ["retained"], partial(decode, form=settings.format)
        )
        self._taken: list[_Delivery] = []
        """Messages whose blocks may not have been handed on yet, in the order in which they came."""
        self._connection: Connection | None = None
        self._before = Counter[str]()
        """Losses of earlier connections."""

    def open(self) -> None:
        """Connect and subscribe; see `drivers.base.Source.open`."""
        self.close()
        settings = self._settings
        self._connection = connection = Connection(
            settings,
            self._context.folder,
            settings.client_id or client_id("monitor", settings.topic),
            subscriptions=tuple(self._topics),
            on_message=self._on_message,
            session_s=settings.session_s,
            in_flight=settings.in_flight,
            most_bytes=settings.max_payload_bytes,
        )
        self._inbox.open()
        try:
            connection.open()
        except SourceError:
            self.close()
            raise

    def _on_message(self, message: Message) -> None:
        """Queue a message (called in the network's thread)."""
        connection, payload = self._connection, bytes(message.payload)
        topic = self._topics.get(message.topic)
        if connection is None:
            return
        if message.retain or topic is None:  # a retained message is of the past, and came before
            self._arrivals.counts["retained"] += 1
            topic, payload = None, b""
        elif len(payload) > self._settings.max_payload_bytes:
            self._arrivals.refuse_oversized(topic, len(payload))
            topic, payload = None, b""
        self._inbox.put(_Delivery(topic, connection.generation, message.mid if message.qos else 0), payload)

    def read(self, timeout_s: float) -> SampleBlock | None:
        """Return the next block in order; see `drivers.base.Source.read`."""
        if not self._arrivals.holds:
            self._acknowledge()  # the caller has everything
        deadline = time.monotonic() + timeout_s
        while not self._arrivals.ready:
            connection = self._connection
            if connection is None:
                raise EndOfStream
            item = self._inbox.get(max(0.0, deadline - time.monotonic()))
            if item is not None:
                delivery, data = item
                self._taken.append(delivery)
                if delivery.topic is not None:
                    self._arrivals.add(delivery.topic, data)
            elif connection.ended:
                raise SourceError(str(connection.problem))
            else:
                # A broker that sends few messages at a time would otherwise wait for ever while a block waits for an earlier one.
                self._acknowledge()
                return None
        return self._arrivals.take()

    def _acknowledge(self) -> None:
        """Acknowledge what was taken, in the order in which it came."""
        connection, taken = self._connection, self._taken
        self._taken = []
        for delivery in taken:
            if connection is not None and delivery.message_id and delivery.generation == connection.generation:
                connection.acknowledge(delivery.message_id)

    def health(self) -> SourceHealth:
        """Return the counts so far and the state of the connection."""
        connection, where = self._connection, self._settings.where
        losses = Counter(self._before)
        if connection is not None:
            losses += _losses(connection)
        counts = dict(self._arrivals.counts) | {name: losses[name] for name in ("links_lost", "sessions_lost")}
        problem = f"not connected with {where}" if connection is None else connection.problem
        trouble = "" if connection is None else connection.recent.latest or self._arrivals.recent.latest
        return SourceHealth(problem is None, counts, (), problem or f"connected with {where}", trouble)

    def close(self) -> None:
        """Leave the broker; see `drivers.base.Source.close`."""
        self._inbox.close()  # first, so that the network's thread does not wait while it is ended
        connection = self._connection
        if connection is None:
            return
        if not self._arrivals.holds:
            self._acknowledge()
        self._connection = None
        connection.close()
        self._before += _losses(connection)
        # What was not acknowledged comes again: forget it.
        self._inbox = Inbox(self._settings.queue_bytes)
        self._arrivals.forget()
        self._taken.clear()


def _losses(connection: Connection) -> Counter[str]:
    return Counter(links_lost=connection.lost, sessions_lost=connection.sessions_lost)


class _Message(BaseModel):
    """Block as JSON, also with the NaN and Infinity that some writers put for a missing sample; other keys are ignored."""

    model_config = ConfigDict(strict=True)

    t_ns: int
    sequence: int
    sample_rate_hz: float
    channels: list[str]
    unit: str
    samples: list[list[float | None]]


def decode(data: bytes, topic: str, form: Format) -> SampleBlock:
    """Decode the message of a block; raises `ValueError` if it is no block, or its fields contradict each other.

    Examples
    --------
    >>> block = SampleBlock("/acceleration", 0, 7, 100.0, ("a1",), "m/s^2", np.array([[0.5], [np.nan]], np.float32))
    >>> decode(encode(block, "json"), "/acceleration", "json").samples.tolist()
    [[0.5], [nan]]
    """
    if form == "protobuf":
        return codec.decode(data, topic)
    try:
        message = _Message.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"Message is no block: {where}{': ' if where else ''}{first['msg']}") from error
    columns = len(message.channels)
    if any(len(row) != columns for row in message.samples):
        raise ValueError(f"a row of samples has not {columns} numbers")
    with np.errstate(over="ignore"):  # beyond float32: infinite, as the pipeline expects
        samples = np.array(message.samples, dtype=np.float64).astype(np.float32).reshape(-1, columns)
    return SampleBlock(
        topic, message.t_ns, message.sequence, message.sample_rate_hz, tuple(message.channels), message.unit, samples
    )


def encode(block: SampleBlock, form: Format) -> bytes:
    """Encode a block as a message; in JSON a sample that is not finite is null."""
    if form == "protobuf":
        return codec.encode(block)
    samples = block.samples.astype(object)
    samples[~np.isfinite(block.samples)] = None
    content = {
        "t_ns": block.t_ns,
        "sequence": block.sequence,
        "sample_rate_hz": block.sample_rate_hz,
        "channels": list(block.channels),
        "unit": block.unit,
        "samples": samples.tolist(),
    }
    return json.dumps(content, allow_nan=False).encode()


class PublisherSettings(StreamSettings):
    """Settings of a sensor node's publisher."""

    in_flight: int = Field(default=64, ge=1, le=_MOST_IN_FLIGHT)
    """Greatest number of blocks that the broker may not have acknowledged yet; beyond it `send` waits."""


class MqttPublisher:
    """Publisher of sample blocks, each of which is sent again until the broker has it (errors as `Connection.open`)."""

    def __init__(self, settings: PublisherSettings, folder: Path = Path()) -> None:
        self._settings = settings
        self._connection = Connection(settings, folder, settings.client_id or client_id("sensor", settings.topic))
        self._connection.open()
        self._under_way: deque[int] = deque()

    def send(self, block: SampleBlock) -> None:
        """Publish a block; wait while the broker lags behind.  Blocks of a topic that is not carried are ignored."""
        topic = self._settings.carried.get(block.topic)
        if topic is None:
            return
        self._under_way.append(self._connection.publish(topic, encode(block, self._settings.format)))
        while len(self._under_way) > self._settings.in_flight:
            self._settle(_WAIT_S)

    put = send

    def close(self, timeout_s: float = 10.0) -> None:
        """Wait until the broker has all blocks, and leave it; raises `SourceError` if it has not after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while self._under_way and time.monotonic() < deadline:
            self._settle(max(0.0, min(_WAIT_S, deadline - time.monotonic())))
        self._connection.close()
        if self._under_way:
            raise SourceError(
                f"the broker at {self._settings.where} has not acknowledged the last {len(self._under_way)} blocks"
            )

    def _settle(self, timeout_s: float) -> None:
        """Wait for the acknowledgement of the oldest block."""
        if self._connection.wait_until_published(self._under_way[0], timeout_s):
            self._under_way.popleft()
