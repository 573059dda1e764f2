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
        self._thread.start()

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present, also one that the broker gave; None if all is published."""
        connection = self._connection
        told = None if connection is None else connection.problem or connection.refused
        return self._failure or told or self._busy.overdue

    def _publish(self) -> None:
        """Connect and publish the queued messages until the outlet is closed."""
        alive = f"{self.prefix}/alive"
        connection = Connection(self._settings, self._folder, client_id("results", self.prefix), will=(alive, b"false"))
        connection.open()
        self._failure, self._connection = None, connection
        try:
            self._send(connection, "alive", "true")
            while (queued := self._take()) is not None:
                with self._busy:
                    self._send(connection, *queued)
            self._send(connection, "alive", "false")
        finally:
            self._connection = None
            connection.close()

    def _send(self, connection: Connection, name: str, text: str) -> None:
        """Publish a message, and wait until the broker has it; raise SourceError if the connection has failed for good."""
        identifier = connection.publish(f"{self.prefix}/{name}", text, retain=name in _RETAINED)
        while not connection.wait_until_published(identifier, _WAIT_S):
            if connection.ended:
                raise SourceError(str(connection.problem))
            if self._ends_s is not None and time.monotonic() >= self._ends_s:
                return
