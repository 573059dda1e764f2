"""Publication of results, alarms, health, gaps and findings over MQTT.

The topics are documented in `docs/mqtt.md`.  The outlet has a connection of its own, because that of the source may be held up
by a full queue.  Requests of operators are not taken here: a broker does not tell who sent a message.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import ClassVar

from drivers.base import SourceError
from drivers.mqtt_session import BrokerSettings, Connection, Topic, client_id
from monitor.service.outlets.messages import Messages

_WAIT_S = 1.0
"""Time between two looks at whether the broker has a message, or the outlet is to end. [s; cost]"""
_RETAINED = frozenset({"state", "alarm", "health", "alive"})
"""Names whose latest message the broker keeps for subscribers that come later."""


class MqttOutSettings(BrokerSettings):
    """``[output.mqtt]`` of the site file: broker to which results are published."""

    prefix: Topic | None = None
    """Common prefix of the topics; ``shm/<site>`` by default."""


class MqttOut(Messages[MqttOutSettings]):
    """Publish results over MQTT."""

    network: ClassVar[str] = "MQTT"

    def __init__(self, site: str, settings: MqttOutSettings, folder: Path = Path(), *, queue_size: int = 256) -> None:
        super().__init__(site, settings, folder, queue_size=queue_size)
        self._connection: Connection | None = None
        self._worker.start()

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present, also one that the broker gave; None if all is published."""
        connection = self._connection
        told = None if connection is None else connection.problem or connection.refused
        return told or super().failed

    def _join(self) -> None:
        """Connect, and say that the outlet is at work; the broker says else when the connection breaks."""
        alive = f"{self.prefix}/alive"
        connection = Connection(self._settings, self._folder, client_id("results", self.prefix), will=(alive, b"false"))
        connection.open()
        self._connection = connection
        self._send("alive", "true")

    def _send(self, name: str, text: str) -> None:
        """Publish a message, and wait until the broker has it; raise SourceError if the connection has failed for good."""
        connection = self._connection
        assert connection is not None
        identifier = connection.publish(f"{self.prefix}/{name}", text, retain=name in _RETAINED)
        while not connection.wait_until_published(identifier, _WAIT_S):
            if connection.ended:
                raise SourceError(str(connection.problem))
            if time.monotonic() >= self._ends_s:
                return

    def _say_farewell(self) -> None:
        if self._connection is not None:
            self._send("alive", "false")

    def _leave(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
