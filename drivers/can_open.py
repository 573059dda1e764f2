"""Opens the origin of CAN frames: a bus of python-can, or a log file."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Annotated, Any, Literal, Self, cast

import can
from can.io.generic import TextIOMessageReader
from can.io.player import MESSAGE_READERS
from pydantic import Field, model_validator

from drivers.base import SourceError
from drivers.live import LiveSettings
from drivers.socketcand_client import ANSWER_S, SocketcandBus

PARSE_ERRORS = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    ArithmeticError,
    AssertionError,
    EOFError,
    MemoryError,
    struct.error,
    zlib.error,
    can.CanError,
    can.io.blf.BLFParseError,
)
"""Errors that python-can's readers raise on a damaged log."""
_NETWORK_INTERFACES = ("udp_multicast", "socketcand")
"""Interfaces that parse what any sender of the network wrote; their error names the error of parsing as its cause."""
_SERIAL_INTERFACES = ("slcan", "serial", "robotell", "seeedstudio")
"""Interfaces that parse what an adapter wrote on a serial line; they raise the bare error of parsing."""
LOG_SUFFIXES = (".blf", ".asc", ".log", ".trc", ".mf4")


class CanSettings(LiveSettings):
    """Table ``[source]`` with ``kind = "can"``."""

    kind: Literal["can"] = "can"
    interface: str = Field(min_length=1)
    """Interface of python-can, as socketcan, socketcand, slcan; or "log" if `channel` is a file."""
    channel: str | int
    """Channel of the interface, as ``can0``."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Further options, passed to python-can unchanged."""
    dbc: str = Field(min_length=1)
    """DBC file that describes the frames; relative to the site file."""
    sample_rate_hz: Annotated[float, Field(gt=0, le=1e6)]
    """Nominal sample rate of each channel."""
    block_samples: Annotated[int, Field(ge=1, le=65536)] = 128
    """Number of samples in a block."""
    fd: bool = False
    """Use CAN FD."""
    receive_buffer_bytes: Annotated[int, Field(ge=4096)] = 1 << 22
    """Size of the socket's receive buffer, where the interface has a socket."""
    counter_counts: Literal["samples", "frames"] = "samples"
    """Unit in which the signal `counter` counts, for frames of several samples."""
    realign: bool = False
    """Shift nodes whose counters differ, by whole samples, instead of refusing them."""
    bus: str | None = None
    """Bus of a log of several, as the log names it: ``can0``, or ``1``; the frames of the others are left out."""

    @model_validator(mode="after")
    def _is_live(self) -> Self:
        if self.interface == "log" and (self.max_pace is not None or self.max_ahead_s is not None):
            raise ValueError("max_pace and max_ahead_s bound a live bus; leave them out for a log")
        if self.interface != "log" and self.bus is not None:
            raise ValueError("bus chooses among those of a log; channel names a live bus")
        return self


def open_bus(settings: CanSettings, ids: tuple[tuple[int, bool], ...]) -> can.BusABC:
    """Open the bus, or raise `SourceError`; kernel or hardware, where possible, filter the frames by identifier.

    Each identifier to receive has a flag for an extended one.
    """
    if settings.interface == "socketcand":
        _require_server(settings.options.get("host"), settings.options.get("port"))
    masks: list[Any] = [{"can_id": i, "can_mask": 0x1FFFFFFF if ext else 0x7FF, "extended": ext} for i, ext in ids]
    options: dict[str, Any] = {**({"fd": True} if settings.fd else {}), **settings.options}
    try:
        if settings.interface == "socketcand":
            bus: can.BusABC = SocketcandBus(str(settings.channel), **options)
        else:
            bus = can.Bus(interface=settings.interface, channel=settings.channel, **options)
        # Filters in python-can itself would save nothing and would suppress error frames.
        if type(bus)._apply_filters is not can.BusABC._apply_filters:
            bus.set_filters(masks)
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
        raise SourceError(f"{settings.interface} {settings.channel}: {error}") from error
    with (
        contextlib.suppress(OSError, NotImplementedError, can.CanError),
        socket.socket(fileno=os.dup(bus.fileno())) as opened,
    ):
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, settings.receive_buffer_bytes)
    return bus


def _require_server(host: object, port: object) -> None:
    """Raise SourceError if no socketcand server answers: python-can's client would retry in a busy loop and wait forever."""
    if not (isinstance(host, str) and isinstance(port, int)):
        raise SourceError("socketcand needs options = {host = ..., port = ...}")
    # python-can also warns of every malformed message.
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.CRITICAL)
    try:
        with socket.create_connection((host, port), timeout=ANSWER_S) as probe:
            if not probe.recv(64).startswith(b"< hi"):
                raise SourceError(f"{host}:{port} is no socketcand server")
    except OSError as error:
        raise SourceError(f"socketcand at {host}:{port}: {error}") from error


def open_log(path: Path) -> tuple[IO[Any], Iterator[can.Message]]:
    """Open a log file of CAN frames; the caller closes it.  The frames have absolute times.

    Raises `SourceError` if the log cannot be read; the message names file and remedy.
    """
    reader = MESSAGE_READERS.get(path.suffix.lower())
    if path.suffix.lower() not in LOG_SUFFIXES or reader is None:
        raise SourceError(f"{path}: known logs are {', '.join(LOG_SUFFIXES)}")
    try:
        text = issubclass(reader, TextIOMessageReader)
        file: IO[Any] = path.open(encoding="utf-8", errors="replace") if text else path.open("rb")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    try:
        return file, iter(reader(file=cast(Any, file), relative_timestamp=False))
    except NotImplementedError as error:
        file.close()
        raise SourceError(f"{path}: reading .mf4 needs the package asammdf (the extra mdf); install it") from error
    except PARSE_ERRORS as error:
        file.close()
        raise SourceError(f"{path}: is no CAN log: {error or type(error).__name__}") from error


def first_bus(log: str) -> int:
    """Return the number that a log gives to the bus which python-can numbers 0: the files .blf and .asc count from 1."""
    return int(Path(log).suffix.lower() in (".blf", ".asc"))


def is_malformed(error: Exception, interface: str) -> bool:
    """Test whether an error of `recv` tells of one message that cannot be parsed, rather than of a bus that failed."""
    if interface in _SERIAL_INTERFACES and not isinstance(error, (OSError, can.CanError)):
        return True
    cause = error.__cause__ if isinstance(error, can.CanError) else None
    return interface in _NETWORK_INTERFACES and cause is not None and not isinstance(cause, OSError)
