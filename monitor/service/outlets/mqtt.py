"""Publication of results, alarms, health, gaps and findings over MQTT.

The topics are documented in `docs/mqtt.md`.  The outlet has a connection of its own, because that of the source may be held up
by a full queue.  Requests of operators are not taken here: a broker does not tell who sent a message.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from pathlib import Path

from drivers.base import SourceError
from drivers.mqtt_session import BrokerSettings, Connection, Topic, client_id
from monitor.core import Busy
from monitor.service.outlets.messages import Messages, site_prefix

_log = logging.getLogger(__name__)
_RETRY_S = (0.5, 30.0)
_WAIT_S = 1.0
"""Time between two looks at whether the broker has a message, or the outlet is to end. [s; cost]"""
_RETAINED = frozenset({"state", "alarm", "health", "alive"})
"""Names whose latest message the broker keeps for subscribers that come later."""


class MqttOutSettings(BrokerSettings):
    """``[output.mqtt]`` of the site file: broker to which results are published."""

    prefix: Topic | None = None
    """Common prefix of the topics; ``shm/<site>`` by default."""


class MqttOut(Messages):
    """Publish results over MQTT; no method but `close` waits, and none raises.

    Parameters
    ----------
    site : str
        Name of the site in the topics, if the settings give no prefix.
    settings : MqttOutSettings
        Settings of ``[output.mqtt]``.
    folder : Path
        Folder to which relative paths of the settings refer.
    queue_size : int
        Largest number of messages that wait while there is no broker; beyond it the oldest are discarded and counted in
        `dropped`.
    """

    dropped: int = 0

    def __init__(self, site: str, settings: MqttOutSettings, folder: Path = Path(), *, queue_size: int = 256) -> None:
        super().__init__()
        self.prefix = settings.prefix or site_prefix(site)
        self._settings, self._folder = settings, folder
        self._waiting: deque[tuple[str, str]] = deque(maxlen=queue_size)
        self._changed = threading.Condition()
        self._ends_s: float | None = None
        """When the outlet must have ended, by a clock that nobody sets; None while it is open."""
        self._failure: str | None = None
        self._connection: Connection | None = None
        self._busy = Busy()
        self._thread = threading.Thread(target=self._run, name="mqtt-out", daemon=True)
        self._thread.start()

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present; None if everything is published."""
        connection = self._connection
        told = None if connection is None else connection.problem or connection.refused
        return self._failure or told or self._busy.overdue

    def close(self, timeout_s: float = 5.0) -> None:
        """Publish the messages that wait and leave the broker, for at most `timeout_s`."""
        with self._changed:
            self._ends_s = time.monotonic() + timeout_s
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _put(self, name: str, text: str) -> None:
        with self._changed:
            self.dropped += len(self._waiting) == self._waiting.maxlen
            self._waiting.append((name, text))
            self._changed.notify_all()

    def _run(self) -> None:
        """Connect and publish until closed; connect again after a failure (the thread's work)."""
        pause = _RETRY_S[0]
        while True:
            try:
                self._publish()
            except Exception as error:  # noqa: BLE001 - no failure of the network may reach the monitor
                if self._failure is None:
                    _log.error("nothing is published over MQTT for now: %s", error)
                self._failure = str(error) or type(error).__name__
            if self._ends_s is not None:
                return
            with self._changed:
                self._changed.wait_for(lambda: self._ends_s is not None, pause)
            pause = min(2 * pause, _RETRY_S[1])

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

    def _take(self) -> tuple[str, str] | None:
        """Wait for what is to be sent next: name and text; None if the outlet is closed and nothing waits."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ends_s is not None)
            return self._waiting.popleft() if self._waiting else None
