"""How a Zenoh session is set up: shared by the source, the sensor's publisher and the publisher of results.

Nothing is ever searched for: no multicast, no gossip, only the endpoints that are written down.
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
from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.base import SourceError

_log = logging.getLogger(__name__)

Key = Annotated[str, Field(pattern=r"^[^/*$?#@\s][^/*$?#\s]*(/[^/*$?#@\s][^/*$?#\s]*)*$", max_length=256)]
"""A key without wildcards; chunks that begin with ``@`` are Zenoh's own and are matched by no ``**``."""
Endpoint = Annotated[str, Field(pattern=r"^(tcp|tls|quic)/[^\s]+:\d+$")]

_MAX_MESSAGE_BYTES = 16 << 20
_STALL_S = 60
"""A receiver may stall this long before the sender gives up its link; Zenoh's own 5 s loses data behind a slow reader."""


class TlsSettings(BaseModel):
    """``tls`` table: both sides show a certificate of the site's own authority."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    root_ca: Path
    """PEM file of the authority; relative to the site file, as all of these."""
    certificate: Path
    """This side's own."""
    private_key: Path
    verify_name: bool = True
    """Whether the router's certificate must name the host that is connected to."""


class SessionSettings(BaseModel):
    """The part of a table that says how to join the network."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    mode: Literal["client", "peer", "router"] = "client"
    """Connect to a router; connect or listen directly; or let others connect and pass their data on."""
    connect: tuple[Endpoint, ...] = ()
    """Endpoints such as ``tcp/127.0.0.1:7447`` or ``tls/gateway:7447``."""
    listen: tuple[Endpoint, ...] = ()
    """Endpoints that others may connect to."""
    tls: TlsSettings | None = None
    """Certificates, for endpoints of tls and quic."""
    connect_timeout_s: float = Field(default=5.0, gt=0)
    """How long a client tries to reach a router before it says that it cannot."""

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
    """A session's callbacks.  Zenoh runs each in a thread of its own, which goes on with what it holds after its entity is
    undeclared; an interpreter that ends meanwhile is aborted."""

    def __init__(self) -> None:
        self._ended: list[threading.Event] = []

    def of(self, function: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
        """What to hand to Zenoh, once, in place of a function."""
        ended = threading.Event()
        self._ended.append(ended)
        return zenoh.handlers.Callback(function, drop=ended.set)

    def join(self, timeout_s: float = 10.0) -> None:
        """Wait until all have ended whose entities are undeclared; no longer than `timeout_s`."""
        deadline, ended = time.monotonic() + timeout_s, self._ended
        self._ended = []
        if not all(event.wait(max(0.0, deadline - time.monotonic())) for event in ended):
            _log.warning("a callback of Zenoh has not ended %g s after it was undeclared", timeout_s)


def configuration(settings: SessionSettings, folder: Path) -> zenoh.Config:
    """Zenoh's configuration; relative paths begin at `folder`."""
    client = settings.mode == "client"
    values: dict[str, Any] = {
        "mode": settings.mode,
        "connect/endpoints": settings.connect,
        "listen/endpoints": settings.listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,  # caches and their recovery need it
        # A client that found no router would wait inside `open`; others go on trying in the background.
        "connect/timeout_ms": round(1e3 * settings.connect_timeout_s) if client else -1,
        "connect/exit_on_failure": client,
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000 * _STALL_S,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100_000,  # us; 1 ms drops under mere load
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
    """Join the network.

    Raises
    ------
    SourceError
        No router can be reached, a port is taken, or a certificate cannot be used or is refused.
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
    """Close a session.  Behind a flood Zenoh may give that up after 10 s; by then nothing is lost that was to be kept."""
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        _log.warning("a Zenoh session was left without its end: %s", error)


def where(settings: SessionSettings) -> str:
    """The endpoints, for messages."""
    return ", ".join(settings.connect or settings.listen)
