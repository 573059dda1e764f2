"""Sources and publishers of sample blocks over a Zenoh router or an MQTT broker of one's own, by the same few words."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from drivers import codec, mqtt, zenoh_bus
from drivers.base import SampleBlock, SourceContext
from drivers.mqtt_session import BrokerSettings, Connection
from drivers.zenoh_session import SessionSettings, open_session
from tests.support.mosquitto import PATIENCE_S, Broker
from tests.support.numbered import CHANNELS
from tests.support.waiting import until
from tests.support.zenoh_router import Router

_numbers = itertools.count()


class OverZenoh:
    """A site of its own on a router; `close` ends all that was made here."""

    def __init__(self, endpoint: str, router: Router | None = None) -> None:
        site = f"shm/frame-{next(_numbers)}"
        self.key, self.place, self._router = f"{site}/acceleration", endpoint, router
        self.with_others = {"temperature_key": f"{site}/temperature"}
        self._ends: list[Callable[[], object]] = []
        self._foreign: zenoh.Publisher | None = None

    def source(self, **options: Any) -> zenoh_bus.ZenohSource:
        """An open source."""
        chosen = {"key": self.key, "mode": "client", "connect": (self.place,)} | options
        made = zenoh_bus.ZenohSource(zenoh_bus.ZenohSettings.model_validate(chosen), SourceContext(CHANNELS))
        self._ends.append(made.close)
        made.open()
        return made

    def publisher(self, **options: Any) -> zenoh_bus.ZenohPublisher:
        chosen = {"key": self.key, "connect": (self.place,)} | options
        made = zenoh_bus.ZenohPublisher(zenoh_bus.PublisherSettings.model_validate(chosen))
        self._ends.append(lambda: made.close(0.1))
        return made

    def put(self, payload: bytes) -> None:
        """Publish raw bytes by a plain publisher that is none of ours, once somebody listens."""
        if self._foreign is None:
            session = open_session(SessionSettings(connect=(self.place,)), Path())
            self._ends.append(session.close)
            self._foreign = session.declare_publisher(self.key, congestion_control=zenoh.CongestionControl.BLOCK)
        foreign = self._foreign
        until(lambda: foreign.matching_status.matching, "a listener")
        foreign.put(payload)

    def encode(self, block: SampleBlock) -> bytes:
        return codec.encode(block)

    def start(self) -> None:
        self._router.start()

    def stop(self) -> None:
        self._router.kill()

    def close(self) -> None:
        for end in self._ends:
            end()


class OverMqtt:
    """A topic of a broker."""

    def __init__(self, broker: Broker, form: mqtt.Format = "protobuf") -> None:
        self.broker, self._form, self.key = broker, form, "shm/test-frame/acceleration"
        self.place = f"127.0.0.1:{broker.port}"
        self.start, self.stop = broker.start, broker.stop
        self._at = {"host": "127.0.0.1", "port": broker.port, "topic": self.key, "format": form}
        self.with_others = {"topics": {"/temperature": "shm/test-frame/temperature", "/wind": "shm/test-frame/wind"}}
        self._ends: list[Callable[[], object]] = []

    def source(self, **options: Any) -> mqtt.MqttSource:
        """An open source."""
        made = mqtt.MqttSource(mqtt.MqttSettings.model_validate(self._at | options), SourceContext(CHANNELS))
        self._ends.append(made.close)
        made.open()
        return made

    def publisher(self, **options: Any) -> mqtt.MqttPublisher:
        return mqtt.MqttPublisher(mqtt.PublisherSettings.model_validate(self._at | options))

    def put(self, payload: bytes, *, retain: bool = False) -> None:
        """Publish raw bytes by somebody else, and wait until the broker has them."""
        other = Connection(BrokerSettings(host="127.0.0.1", port=self.broker.port), Path(), "somebody else")
        other.open()
        assert other.wait_until_published(other.publish(self.key, payload, retain=retain), PATIENCE_S)
        other.close()

    def encode(self, block: SampleBlock) -> bytes:
        return mqtt.encode(block, self._form)

    def close(self) -> None:
        for end in self._ends:
            end()
        self.broker.kill()
