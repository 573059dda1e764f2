"""Sample blocks over Zenoh: the source that the daemon reads, and the publisher of a sensor node."""

from __future__ import annotations

import threading
import time
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal

import zenoh
from pydantic import Field
from zenoh import ext

from drivers import codec
from drivers.arrivals import Arrivals
from drivers.base import UNIT_OF, EndOfStream, SampleBlock, SourceContext, SourceError, SourceHealth
from drivers.inbox import Inbox
from drivers.limits import BlockLimits
from drivers.live import LiveSettings
from drivers.zenoh_session import Callbacks, Key, SessionSettings, leave, open_session, where

ENCODING = f"application/protobuf;{codec.SCHEMA_NAME}"
_QUERY_PERIOD: Any = timedelta(seconds=10)
"""Interval at which publishers are queried for missed blocks.  Heartbeats would stop the stream for good: with a direct peer
as publisher and a slow reader, the subscriber's handling of a heartbeat deadlocks in Zenoh 1.10."""
_MAX_ALIVE = 256
"""Greatest number of sensors listed as alive, so that no participant can fill the memory."""
_EVENTS = ("missed", "links_lost", "sensors_lost")


class StreamSettings(SessionSettings):
    """Keys of a stream of blocks; a topic without a key is not carried."""

    key: Key
    """Key of the floors' accelerations, as ``shm/lab-frame/acceleration``."""
    temperature_key: Key | None = None
    """Key of the temperatures, degC."""
    ground_key: Key | None = None
    """Key of the measured base motion."""
    force_key: Key | None = None
    """Key of the measured forces, N."""
    rotation_rate_key: Key | None = None
    """Key of the measured rates of rotation, rad/s."""

    @property
    def topics(self) -> dict[str, str]:
        """Key of each topic that is carried."""
        keys = (self.key, self.ground_key, self.force_key, self.temperature_key, self.rotation_rate_key)
        return {topic: key for topic, key in zip(UNIT_OF, keys, strict=True) if key is not None}  # in its order


def _sibling_key(key: str, name: str) -> str:
    """Replace the last chunk of a key by `name`."""
    return "/".join([*key.split("/")[:-1], name])


def _received_key(key: str) -> str:
    """Return the key that a publisher queries before it ends; a reader replies after it has received all earlier blocks."""
    return f"{key}/received"


class ZenohSettings(StreamSettings, BlockLimits, LiveSettings):
    """Table ``[source]`` with ``kind = "zenoh"``."""

    kind: Literal["zenoh"] = "zenoh"
    history_blocks: int = Field(default=512, ge=0)
    """Number of blocks requested from the publishers' caches when the source is opened."""
    hold_blocks: int = Field(default=4, ge=0, le=64)
    """Number of blocks that may wait for an earlier block before the earlier block counts as lost."""


class ZenohSource:
    """Source of the sample blocks of any publisher, plain or advanced; see `drivers.base.Source`.

    Blocks lost on a broken link are requested again from publishers with a cache.  The session reconnects by itself when a
    router comes back.  After `close`, `read` still returns the blocks that had arrived, then raises `EndOfStream`.
    """

    Settings = ZenohSettings

    def __init__(self, settings: ZenohSettings, context: SourceContext) -> None:
        self._settings, self._context = settings, context
        self._inbox = Inbox[str](settings.queue_bytes)
        self._arrivals = Arrivals(settings.topics, settings, settings.hold_blocks, _EVENTS)
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._entities: list[Any] = []
        self._callbacks = Callbacks()
        self._alive: set[str] = set()

    def open(self) -> None:
        """Open the session and subscribe; see `drivers.base.Source.open`."""
        self.close()
        session = open_session(self._settings, self._context.folder)
        self._session = session
        self._inbox.open()
        try:
            for topic, key in self._settings.topics.items():
                self._subscribe(session, topic, key)
            alive = _sibling_key(self._settings.key, "alive/*")
            self._entities += [
                session.liveliness().declare_subscriber(alive, self._callbacks.of(self._on_alive), history=True),
                session.info.declare_transport_events_listener(self._callbacks.of(self._on_transport), history=False),
            ]
        except zenoh.ZError as error:
            self.close()
            raise SourceError(f"cannot subscribe: {error}") from error

    def _subscribe(self, session: zenoh.Session, topic: str, key: str) -> None:
        """Subscribe to the blocks of one topic, and reply to publishers that end."""

        def on_sample(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            if len(sample.payload) > self._settings.max_payload_bytes:
                with self._lock:
                    self._arrivals.refuse_oversized(topic, len(sample.payload))
            else:
                self._inbox.put(topic, sample.payload.to_bytes())

        history = self._settings.history_blocks
        subscriber = ext.declare_advanced_subscriber(
            session,
            key,
            self._callbacks.of(on_sample),
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=history) if history else None,
            recovery=ext.RecoveryConfig(periodic_queries=_QUERY_PERIOD, heartbeat=None),
        )
        self._entities += [
            subscriber,
            subscriber.sample_miss_listener(self._callbacks.of(self._on_miss)),
            session.declare_queryable(_received_key(key), self._callbacks.of(self._on_received)),
        ]

    def read(self, timeout_s: float) -> SampleBlock | None:
        """Return the next block in order; see `drivers.base.Source.read`."""
        deadline = time.monotonic() + timeout_s
        while not self._arrivals.ready:
            item = self._inbox.get(max(0.0, deadline - time.monotonic()))
            if item is not None:
                self._arrivals.add(*item)
            elif self._session is not None:
                return None
            elif not self._arrivals.flush():
                raise EndOfStream
        return self._arrivals.take()

    def health(self) -> SourceHealth:
        """Return the counts so far, the state of the connection, and the sensors that are alive."""
        session, alive = self._session, sorted(self._alive)
        connected = session is not None and not session.is_closed() and bool(session.info.transports())
        place = where(self._settings)
        link = f"connected by {place}" if connected else f"no router or peer at {place}"
        detail = f"{link}; alive: {', '.join(alive) or 'no sensor says so'}"
        return SourceHealth(connected, dict(self._arrivals.counts), detail=detail, trouble=self._arrivals.recent.latest)

    def close(self) -> None:
        """Leave the network; see `drivers.base.Source.close`."""
        self._inbox.close()  # first, so that no callback waits while it is undeclared
        session, self._session = self._session, None
        entities, self._entities = self._entities, []
        for entity in reversed(entities):  # otherwise a callback would outlive this object
            entity.undeclare()
        if session is not None:
            leave(session)
        self._callbacks.join()
        self._alive.clear()

    def _count(self, event: str, times: int = 1) -> None:
        with self._lock:  # Zenoh calls back from several threads; the reader counts other events
            self._arrivals.counts[event] += times

    def _on_miss(self, miss: ext.Miss) -> None:
        self._count("missed", miss.nb)

    def _on_alive(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            if len(self._alive) < _MAX_ALIVE:
                self._alive.add(name)
        elif name in self._alive:
            self._alive.discard(name)
            self._count("sensors_lost")

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self._count("links_lost")

    def _on_received(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")


class PublisherSettings(StreamSettings):
    """Settings of a sensor node's publisher."""

    name: str = Field(default="sensor", pattern=r"^[A-Za-z0-9._-]+$")
    """Name of the node, visible as ``<site>/alive/<name>`` while the node is connected."""
    cache_blocks: int = Field(default=512, ge=1)
    """Number of blocks kept for readers that connect late or lost their link."""


class ZenohPublisher:
    """Publisher of sample blocks (errors as `open_session`).

    No block is lost on an intact link, and the latest blocks are cached for a broken one.
    """

    def __init__(self, settings: PublisherSettings, folder: Path = Path()) -> None:
        self._settings = settings
        self._session = open_session(settings, folder)
        self._token = self._session.liveliness().declare_token(_sibling_key(settings.key, f"alive/{settings.name}"))
        self._publishers = {
            topic: ext.declare_advanced_publisher(
                self._session,
                key,
                encoding=ENCODING,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                cache=ext.CacheConfig(settings.cache_blocks),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                publisher_detection=True,
            )
            for topic, key in settings.topics.items()
        }

    def send(self, block: SampleBlock) -> None:
        """Publish a block; wait while readers lag behind.  Blocks of a topic without a key are ignored."""
        if (publisher := self._publishers.get(block.topic)) is not None:
            publisher.put(codec.encode(block))

    put = send

    def close(self, timeout_s: float = 10.0) -> None:
        """Wait until the readers have received all blocks, no longer than `timeout_s` for each key, and close the session."""
        if self._session.is_closed():
            return
        # Zenoh itself drops data still in transit.  A query does not overtake the data sent before it.
        for key in self._settings.topics.values():
            for _ in self._session.get(
                _received_key(key), target=zenoh.QueryTarget.ALL, timeout=timeout_s,
                congestion_control=zenoh.CongestionControl.BLOCK,
            ):  # fmt: skip
                pass
        leave(self._session)
