"""Configures and opens Zenoh sessions for the source, the sensor's publisher and the publisher of results.

A session uses only the endpoints in its settings; discovery by multicast and gossip is off.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import zenoh
from pydantic import Field, model_validator

from drivers.base import SourceError
from drivers.settings import Settings

_log = logging.getLogger(__name__)

Key = Annotated[str, Field(pattern=r"^[^/*$?#@\s][^/*$?#\s]*(/[^/*$?#@\s][^/*$?#\s]*)*$", max_length=256)]
"""Key without wildcards; chunks that begin with ``@`` are reserved by Zenoh and not matched by ``**``."""
Endpoint = Annotated[str, Field(pattern=r"^(tcp|tls|quic)/[^\s]+:\d+$")]

_MAX_MESSAGE_BYTES = 16 << 20
_STALL_S = 60
"""Longest stall of a receiver, s, before the sender closes the link; Zenoh's default of 5 s loses data behind a slow reader."""


class TlsSettings(Settings):
    """Table ``tls``: both sides present a certificate of the site's own authority."""

    root_ca: Path
    """PEM file of the authority; this and the other paths are relative to the site file."""
    certificate: Path
    """PEM file of this side's certificate."""
    private_key: Path
    """PEM file of this side's private key."""
    verify_name: bool = True
    """Require that the router's certificate names the host of the endpoint."""


class SessionSettings(Settings):
    """Part of a table that describes the connection to the network."""

    mode: Literal["client", "peer", "router"] = "client"
    """Role: a client connects to a router, a peer connects or listens directly, a router also forwards data of others."""
    connect: tuple[Endpoint, ...] = ()
    """Endpoints to connect to, such as ``tcp/127.0.0.1:7447`` or ``tls/gateway:7447``."""
    listen: tuple[Endpoint, ...] = ()
    """Endpoints at which others may connect."""
    tls: TlsSettings | None = None
    """Certificates, required for endpoints of tls and quic."""
    connect_timeout_s: float = Field(default=5.0, gt=0)
    """Time after which a client that reaches no router reports an error."""

    @model_validator(mode="after")
    def _reachable(self) -> SessionSettings:
        if self.mode == "client" and (not self.connect or self.listen):
            raise ValueError("a client needs `connect` and cannot `listen`")
        if not self.connect and not self.listen:
            raise ValueError("neither `connect` nor `listen` is given: nothing could ever arrive")
        if self.tls is None and any(not e.startswith("tcp/") for e in (*self.connect, *self.listen)):
            raise ValueError("endpoints of tls or quic need the `tls` table")
        return self


class Callbacks:
    """Callbacks of a session, each of which Zenoh runs in a thread of its own.

    A thread continues with its queued items after its entity is undeclared.  If the interpreter ends meanwhile, the process
    is aborted.
    """

    def __init__(self) -> None:
        self._ended: list[threading.Event] = []

    def of(self, function: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
        """Wrap a function as a callback; pass the result to Zenoh once, in place of the function."""
        ended = threading.Event()
        self._ended.append(ended)
        return zenoh.handlers.Callback(function, drop=ended.set)

    def join(self, timeout_s: float = 10.0) -> None:
        """Wait until the callbacks of all undeclared entities have ended, no longer than `timeout_s`."""
        deadline, ended = time.monotonic() + timeout_s, self._ended
        self._ended = []
        if not all(event.wait(max(0.0, deadline - time.monotonic())) for event in ended):
            _log.warning("a callback of Zenoh has not ended %g s after it was undeclared", timeout_s)


def configuration(settings: SessionSettings, folder: Path) -> zenoh.Config:
    """Build Zenoh's configuration; certificate paths are relative to `folder`."""
    client = settings.mode == "client"
    values: dict[str, Any] = {
        "mode": settings.mode,
        "connect/endpoints": settings.connect,
        "listen/endpoints": settings.listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,  # required by caches and their recovery
        # A client that finds no router would wait inside `open`; peers and routers retry in the background.
        "connect/timeout_ms": round(1e3 * settings.connect_timeout_s) if client else -1,
        "connect/exit_on_failure": client,
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000 * _STALL_S,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100_000,  # us; 1 ms drops data under normal load
    }
    if (tls := settings.tls) is not None:
        certificate, key = str(folder / tls.certificate), str(folder / tls.private_key)
        values["transport/link/tls"] = {
            "root_ca_certificate": str(folder / tls.root_ca),
            "enable_mtls": True,
            "verify_name_on_connect": tls.verify_name,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "listen_certificate": certificate,
            "listen_private_key": key,
        }
    config = zenoh.Config()
    for name, value in values.items():
        config.insert_json5(name, json.dumps(value))
    return config


def open_session(settings: SessionSettings, folder: Path) -> zenoh.Session:
    """Open a session; certificate paths are relative to `folder`.

    Raises `SourceError` if no router can be reached, a port is taken, or a certificate cannot be used or is refused.
    """
    if (tls := settings.tls) is not None:
        for path in (tls.root_ca, tls.certificate, tls.private_key):
            if not (folder / path).is_file():
                raise SourceError(f"{folder / path}: no such file; `tls` needs root_ca, certificate and private_key")
    try:
        return zenoh.open(configuration(settings, folder))
    except zenoh.ZError as error:
        raise SourceError(f"no Zenoh {settings.mode} session with {where(settings)}: {error}") from error


def leave(session: zenoh.Session) -> None:
    """Close a session.

    Under heavy traffic Zenoh may abandon the closing after 10 s; by then all data to be kept have been transferred.
    """
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        _log.warning("a Zenoh session was left without its end: %s", error)


def where(settings: SessionSettings) -> str:
    """List the endpoints of a session, for messages."""
    return ", ".join(settings.connect or settings.listen)
