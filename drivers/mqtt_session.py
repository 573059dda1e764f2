"""Configures and keeps MQTT 5 connections for the source, the sensor's publisher and the publisher of results."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from drivers.base import SourceError
from drivers.recent import Recent
from drivers.settings import Settings

try:
    from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTv5
    from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode
    from paho.mqtt.subscribeoptions import SubscribeOptions
except ImportError as absent:
    raise ImportError("needs the extra mqtt: pip install 'shm-monitor[mqtt]'") from absent

Message = MQTTMessage
"""Message as the broker sends it, with `topic`, `payload`, `qos`, `retain` and the identifier `mid`."""
Topic = Annotated[str, Field(pattern=r"^[^#+$\x00][^#+\x00]*$", max_length=256)]
"""MQTT topic without wildcards; topics that begin with ``$`` are the broker's own."""
_RETRY_S = (1, 30)
"""Shortest and longest pause before a lost connection is tried again; each pause is twice the one before. [s; judgement]"""
_KEEPALIVE_S = 30
"""Time after which a silent connection is tested; half as long again and it counts as lost. [s; judgement]"""
_TAKEN_OVER = 0x8E
"""Reason for which a broker ends a connection: another client came by the same name. [none; definition]"""
_NO_REASON = 0x80
"""Reason that stands for none: the connection just ended. [none; definition]"""
_HEADER_BYTES = 1 << 17
"""Room of a packet for its topic and properties. [bytes; definition: each is at most 64 KiB]"""


class MqttTls(Settings):
    """Table ``tls``: files of the encryption, relative to the site file."""

    root_ca: Path | None = None
    """PEM file of the authority that signed the broker's certificate; by default those that the system trusts."""
    certificate: Path | None = None
    """PEM file of this side's certificate, where the broker demands one."""
    private_key: Path | None = None
    """PEM file of this side's private key."""

    @model_validator(mode="after")
    def _both(self) -> MqttTls:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("`certificate` and `private_key` go together")
        return self


class BrokerSettings(Settings):
    """Part of a table that describes the connection to an MQTT broker."""

    host: str = Field(min_length=1, max_length=255)
    """Name or address of the broker."""
    port: int | None = Field(default=None, ge=1, le=65535)
    """Port of the broker; 1883 by default, with `tls` 8883."""
    tls: bool | MqttTls = False
    """Encrypt: ``true`` trusts the system's authorities, a table names files; the broker's name is verified."""
    user: str | None = Field(default=None, min_length=1)
    """User name at the broker."""
    password_file: Path | None = None
    """File whose first line is the password, relative to the site file; read anew at each start."""
    connect_timeout_s: float = Field(default=5.0, gt=0)
    """Time after which a broker that does not answer is reported; it is tried again."""

    @field_validator("host")
    @classmethod
    def _is_host(cls, host: str) -> str:
        if not re.fullmatch(r"[\w.-]+|[0-9A-Fa-f:.]+(%[\w.-]+)?", host):
            parts = "the port belongs to `port`, user and password to `user` and `password_file`"
            raise ValueError(f"must be a name or an address alone: {parts}")  # what it is may hold a password
        return host

    @model_validator(mode="after")
    def _has_user(self) -> BrokerSettings:
        if self.password_file is not None and self.user is None:
            raise ValueError("`password_file` needs `user`")
        return self

    @property
    def where(self) -> str:
        """Address of the broker, for messages."""
        return f"{self.host}:{self.port or (8883 if self.tls else 1883)}"


class _Client(Client):
    """Client of Eclipse Paho whose thread ends with a reason instead of a traceback."""

    ended: str | None = None
    """Why the network thread ended, where that is no loss of the connection: the broker sent what is no MQTT."""

    def loop_forever(self, timeout: float = 1.0, retry_first_connection: bool = False) -> MQTTErrorCode:
        """Serve the connection until `disconnect`; see the base class."""
        try:
            return super().loop_forever(timeout, retry_first_connection)
        except Exception as error:  # noqa: BLE001 - kept for whoever asks: what a broken broker causes is not known
            self.ended = f"{type(error).__name__}: {error}"
            return MQTTErrorCode.MQTT_ERR_UNKNOWN


def client_id(role: str, topic: str) -> str:
    """Return the name of a client, which a broker must accept: letters, digits and hyphens.

    Examples
    --------
    >>> client_id("monitor", "shm/lab frame/acceleration")
    'shm-monitor-shm-lab-frame-acceleration'
    """
    return re.sub(r"[^0-9A-Za-z]+", "-", f"shm-{role}-{topic}")


class Connection:
    """Connection to a broker, which is restored by itself after a loss; quality of service 1 throughout.

    Parameters
    ----------
    client_id
        Name under which the broker keeps the session; no two clients of a broker may have the same.
    retained
        Ask for the retained messages of the topics subscribed to, which are of the past.
    on_message
        Called in the network's thread for each message, which is acknowledged by `acknowledge` only.
    session_s
        Time for which the broker keeps the session without a connection; 0: the session ends with the connection.
    in_flight
        Greatest number of messages that the broker sends before the first of them is acknowledged.
    most_bytes
        Greatest size of a payload that the broker may send.
    will
        Topic and retained message that the broker publishes when this connection is lost.
    """

    def __init__(
        self,
        settings: BrokerSettings,
        folder: Path,
        client_id: str,
        *,
        subscriptions: tuple[str, ...] = (),
        on_message: Callable[[Message], None] = lambda _: None,
        session_s: int = 0,
        in_flight: int | None = None,
        most_bytes: int | None = None,
        retained: bool = False,
        will: tuple[str, bytes] | None = None,
    ) -> None:
        self._settings, self._folder, self._subscriptions, self._retained = settings, folder, subscriptions, retained
        self.generation = self.lost = self.sessions_lost = 0
        """How often the connection was established and lost, and was restored without its session and what waited in it."""
        self.recent = Recent()
        """Teller of lost connections."""
        self.refused: str | None = None
        """Reason for which the broker took the latest message and gave it to nobody, such as a missing permission."""
        self._client_id = client_id
        self._answered = threading.Event()
        self._changed = threading.Condition()
        self._published: set[int] = set()
        self._problem: str | None = "no connection yet"
        client = self._client = _Client(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTv5, manual_ack=True)
        client.connect_timeout = settings.connect_timeout_s
        client.reconnect_delay_set(*_RETRY_S)
        client.on_connect, client.on_subscribe = self._on_connect, self._on_subscribe
        client.on_disconnect, client.on_connect_fail = self._on_disconnect, self._on_connect_fail
        client.on_publish = self._on_publish
        client.on_message = lambda _client, _data, message: on_message(message)
        self._properties: Any = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        self._properties.SessionExpiryInterval = session_s
        if in_flight is not None:
            self._properties.ReceiveMaximum = in_flight
        if most_bytes is not None:
            self._properties.MaximumPacketSize = most_bytes + _HEADER_BYTES
        self._clean = session_s == 0
        if will is not None:
            client.will_set(will[0], will[1], qos=1, retain=True)

    def open(self) -> None:
        """Connect and subscribe.

        Raises `SourceError` if the broker cannot be reached, refuses the connection or a topic, or a file is missing.
        """
        where, host = self._settings.where, self._settings.host
        self._identify()
        try:
            port = int(where.rpartition(":")[2])
            self._client.connect(host, port, _KEEPALIVE_S, clean_start=self._clean, properties=self._properties)
        except (OSError, ValueError) as error:
            raise SourceError(f"no MQTT broker at {where}: {error}") from error
        self._client.loop_start()
        answered = self._answered.wait(self._settings.connect_timeout_s)
        problem = self.problem
        if problem is not None:
            self.close()
            raise SourceError(problem if answered else f"the broker at {where} does not answer")

    def _identify(self) -> None:
        """Give the client its user, password and certificates; raise SourceError if a file is missing."""
        settings, client = self._settings, self._client
        password = None
        try:
            if settings.password_file is not None:
                path = self._folder / settings.password_file
                password = (path.read_text(encoding="utf-8").splitlines() or [""])[0]
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "it is no text"
            raise SourceError(f"{path}: the password cannot be read: {reason}") from error
        if settings.user is not None:
            client.username_pw_set(settings.user, password)
        if not settings.tls:
            return
        tls = MqttTls() if settings.tls is True else settings.tls
        files = [None if p is None else str(self._folder / p) for p in (tls.root_ca, tls.certificate, tls.private_key)]
        try:
            client.tls_set(ca_certs=files[0], certfile=files[1], keyfile=files[2])
        except (OSError, ValueError) as error:
            named = ", ".join(file for file in files if file is not None) or "the system's authorities"
            raise SourceError(f"{named}: cannot be used for TLS: {error}") from error

    @property
    def problem(self) -> str | None:
        """Reason for which nothing comes or goes at present; None if all is well."""
        ended = self._client.ended
        return self._problem if ended is None else f"the broker at {self._settings.where} speaks no MQTT: {ended}"

    @property
    def ended(self) -> bool:
        """True if the connection failed in a way that it is not restored by itself."""
        return self._client.ended is not None

    def acknowledge(self, message_id: int) -> None:
        """Tell the broker that it need not keep a message any more."""
        self._client.ack(message_id, 1)

    def publish(self, topic: str, payload: bytes | str, *, retain: bool = False) -> int:
        """Send a message, again after each loss of the connection until the broker has it; return its identifier."""
        return self._client.publish(topic, payload, qos=1, retain=retain).mid

    def wait_until_published(self, message_id: int, timeout_s: float) -> bool:
        """Wait until the broker has a message; return whether it has.  To be asked until it is true, then no more."""
        with self._changed:
            taken = self._changed.wait_for(lambda: message_id in self._published, timeout_s)
            self._published.discard(message_id)
        return taken

    def close(self) -> None:
        """Leave the broker; a session that it keeps is continued by the next connection of this client."""
        self._problem = self._problem or "closed"
        self._client.disconnect()
        self._client.loop_stop()
        left = self._client.socket()
        if left is not None:
            left.close()

    def _on_connect(self, client: Client, _data: Any, flags: ConnectFlags, reason: ReasonCode, *_: Any) -> None:
        if reason.is_failure:
            who = "a client without a user" if self._settings.user is None else f"user {self._settings.user!r}"
            self._report(f"the broker at {self._settings.where} refuses {who}: {reason}")
            return
        self.sessions_lost += self.generation > 0 and not self._clean and not flags.session_present
        self.generation += 1
        if not self._subscriptions:
            self._report(None)
            return
        sends = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE if self._retained else SubscribeOptions.RETAIN_DO_NOT_SEND
        options = SubscribeOptions(qos=1, retainHandling=sends)
        client.subscribe([(topic, options) for topic in self._subscriptions])

    def _on_subscribe(self, _client: Client, _data: Any, _id: int, reasons: list[ReasonCode], *_: Any) -> None:
        refused = [t for t, reason in zip(self._subscriptions, reasons, strict=False) if reason.is_failure]
        where, names = self._settings.where, ", ".join(refused)
        self._report(f"the broker at {where} does not let this client read {names}" if refused else None)

    def _on_disconnect(self, _client: Client, _data: Any, _flags: DisconnectFlags, reason: ReasonCode, *_: Any) -> None:
        if self._problem is None:
            self.lost += 1
            other = f"another client came by the same client_id {self._client_id!r}"
            why = str(reason)
            if reason.value == _TAKEN_OVER:
                why = f"{other}; each needs its own"
            elif reason.value == _NO_REASON:  # mosquitto 2.0 ends it so
                why = f"it ended without a reason, as where {other} or the broker stopped"
            self._problem = f"the connection with the broker at {self._settings.where} is lost: {why}"
            self.recent.tell(f"{self._problem} ({self.lost} times so far); it is tried again")

    def _on_connect_fail(self, _client: Client, _data: Any) -> None:
        if self._problem is None:
            self._problem = f"no MQTT broker at {self._settings.where}"

    def _on_publish(self, _client: Client, _data: Any, message_id: int, reason: ReasonCode, *_: Any) -> None:
        said = f"the broker at {self._settings.where} refuses a message: {reason}"
        self.refused = said if reason.is_failure else None
        with self._changed:
            self._published.add(message_id)
            self._changed.notify_all()

    def _report(self, problem: str | None) -> None:
        """Note how the broker answered."""
        self._problem = problem
        self._answered.set()
