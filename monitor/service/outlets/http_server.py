"""HTTP server in one thread: connections, requests and their time are bounded, so that readers cost the monitor little."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
import threading
import time
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import unquote

_log = logging.getLogger(__name__)

_MAX_HEAD_BYTES = 8192
"""Largest size of the head of a request. [B; judgement]"""

WsgiApplication = Callable[[dict[str, Any], Callable[[str, list[tuple[str, str]]], object]], Iterable[bytes]]
Message = MutableMapping[str, Any]
AsgiApplication = Callable[
    [Message, Callable[[], Awaitable[Message]], Callable[[Message], Awaitable[None]]], Awaitable[None]
]
Respond = Callable[[bytes], Awaitable[bytes]]
"""Function that answers the head of a request; it raises ValueError where that is none."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What readers may cost."""

    connections: int = 8
    """Largest number of open connections. [1; judgement: one or two readers, and some that hang]"""
    per_s: float = 20.0
    """Largest number of connections accepted in a second. [1/s; cost: an answer takes some ms of the interpreter]"""
    connection_s: float = 5.0
    """Longest time of a connection, from its start to the last byte of its answer. [s; judgement]"""
    share: float = 0.25
    """Largest share of a core that answers take: after costly ones the next connection waits longer. [1; judgement: the rest is
    the monitor's]"""
    waiting: int = 8
    """Number of connections that the system keeps until they are accepted. [1; judgement: as many as may be open]"""
    rest_s: float = 1.0
    """Pause where the system has no room for a connection. [s; judgement]"""


class HttpServer:
    """Answer requests without a body, one a connection, in one thread, at `port` (0 asks for any); with `tls` it speaks TLS.

    A connection beyond the largest number replaces the oldest, so that readers that hang do not shut out others.  OSError is
    raised where the port cannot be opened.
    """

    def __init__(
        self, host: str, port: int, respond: Respond, tls: ssl.SSLContext | None = None, bounds: Bounds = Bounds()
    ) -> None:
        self._bounds = bounds
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self._listener = socket.create_server(address[:2], family=family, backlog=bounds.waiting)
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._respond, self._tls = respond, tls
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _, context: _log.error("http: %s", context["message"]))
        self._serving: dict[asyncio.Task[None], None] = {}
        self._running = self._loop.create_task(self._run())
        self._thread = threading.Thread(target=self._work, name="http", daemon=True)
        self._thread.start()

    @property
    def connections(self) -> int:
        """Number of open connections."""
        return len(self._serving)

    def close(self, timeout_s: float) -> None:
        """Stop listening and close all connections."""
        with contextlib.suppress(RuntimeError):  # the loop has ended before
            self._loop.call_soon_threadsafe(self._running.cancel)
        self._thread.join(timeout_s)

    def _work(self) -> None:
        """Serve until closed (the thread's work)."""
        try:
            with contextlib.suppress(asyncio.CancelledError):
                self._loop.run_until_complete(self._running)
        finally:
            self._listener.close()
            self._loop.close()

    async def _run(self) -> None:
        """Serve until cancelled, then close what is open."""
        try:
            await self._accept()
        finally:
            for task in self._serving:
                task.cancel()
            await asyncio.gather(*self._serving, return_exceptions=True)

    async def _accept(self) -> None:
        """Accept connections, no faster than the bounds allow."""
        refused, spent_s = False, time.thread_time()
        while True:
            try:
                connection, _ = await self._loop.sock_accept(self._listener)
            except OSError as error:
                if not refused:
                    _log.error("http: no connection can be accepted: %s", error.strerror or error)
                refused = True
                await asyncio.sleep(self._bounds.rest_s)
                continue
            refused = False
            if len(self._serving) >= self._bounds.connections:
                next(iter(self._serving)).cancel()
            task = self._loop.create_task(self._serve(connection))
            self._serving[task] = None
            task.add_done_callback(lambda done: self._serving.pop(done, None))
            await asyncio.sleep(1.0 / self._bounds.per_s)
            now_s = time.thread_time()
            await asyncio.sleep((now_s - spent_s) / self._bounds.share - 1.0 / self._bounds.per_s)
            spent_s = now_s

    async def _serve(self, connection: socket.socket) -> None:
        """Answer one request, or close the connection where it does not come or its answer is not taken in time."""
        with contextlib.closing(connection):
            try:
                async with asyncio.timeout(self._bounds.connection_s):
                    await self._answer(connection)
            except (OSError, EOFError, ValueError, asyncio.LimitOverrunError) as error:
                _log.debug("http: a connection was closed: %s", error or type(error).__name__)
            except Exception:  # noqa: BLE001 - a request that cannot be answered is no end of the server
                _log.exception("http: a request failed")

    async def _answer(self, connection: socket.socket) -> None:
        """Read a request and write its answer.

        OSError, EOFError or LimitOverrunError tell that the connection failed, or that the request is not complete or too long;
        ValueError that it is none.
        """
        reader = asyncio.StreamReader(limit=_MAX_HEAD_BYTES)
        protocol = asyncio.StreamReaderProtocol(reader)
        longest_s = self._bounds.connection_s
        limits = {"ssl_handshake_timeout": longest_s, "ssl_shutdown_timeout": longest_s} if self._tls else {}
        transport, _ = await self._loop.connect_accepted_socket(lambda: protocol, connection, ssl=self._tls, **limits)
        writer = asyncio.StreamWriter(transport, protocol, reader, self._loop)
        try:
            writer.write(await self._respond(await reader.readuntil(b"\r\n\r\n")))
            writer.close()
            await writer.wait_closed()
        finally:
            transport.abort()


def wsgi(application: WsgiApplication) -> Respond:
    """Make the function that answers a request by a WSGI application, which gets method, path, query and accept headers."""

    async def respond(head: bytes) -> bytes:
        method, path, query, fields = _parts(head)
        environment: dict[str, Any] = {"REQUEST_METHOD": method, "PATH_INFO": path, "QUERY_STRING": query}
        for name, value in fields:
            if name in {"accept", "accept-encoding"}:
                environment[f"HTTP_{name.upper().replace('-', '_')}"] = value
        started: list[str] = []

        def start(status: str, headers: list[tuple[str, str]]) -> None:
            started.extend([f"HTTP/1.1 {status}", *(f"{name}: {value}" for name, value in headers)])

        body = b"".join(application(environment, start))
        lines = [*started, f"Content-Length: {len(body)}", "Connection: close", "", ""]
        return "\r\n".join(lines).encode("latin-1") + body

    return respond


def asgi(application: AsgiApplication) -> Respond:
    """Make the function that answers a request by an ASGI application, which gets no body; it is sent when it is whole."""

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def respond(head: bytes) -> bytes:
        method, path, query, fields = _parts(head)
        scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.3"},
            "http_version": "1.1",
            "method": method,
            "scheme": "http",
            "path": unquote(path),
            "raw_path": path.encode("latin-1"),
            "query_string": query.encode("latin-1"),
            "root_path": "",
            "headers": [(name.encode("latin-1"), value.encode("latin-1")) for name, value in fields],
            "client": None,
            "server": None,
        }
        sent: list[Message] = []

        async def send(message: Message) -> None:
            sent.append(message)

        await application(scope, receive, send)
        begun, *parts = sent
        lines = [f"HTTP/1.1 {begun['status']} {HTTPStatus(begun['status']).phrase}".encode("latin-1")]
        lines += [name + b": " + value for name, value in begun["headers"]]
        body = b"" if method == "HEAD" else b"".join(part.get("body", b"") for part in parts)
        return b"\r\n".join([*lines, b"Connection: close", b"", body])

    return respond


def _parts(head: bytes) -> tuple[str, str, str, list[tuple[str, str]]]:
    """Split the head of a request into method, path, query, and names (lower case) and values of its fields; else ValueError."""
    first, *rows = head.decode("latin-1").split("\r\n")
    method, target, _version = first.split(" ")
    path, _, query = target.partition("?")
    fields = (row.partition(":") for row in rows if row)
    return method, path, query, [(name.strip().lower(), value.strip()) for name, _, value in fields]
