"""HTTP by uvicorn, in one thread: what readers cost is bounded, so that the monitor does not notice them.

uvicorn reads a request, bounds its head, and writes the answer.  It bounds neither the time that a request takes to come and its
answer to be taken, nor handshakes of TLS; and beyond its `limit_concurrency` it refuses whoever comes next, so that readers that
hang would shut out all others.  So connections are accepted, counted and ended here.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from monitor.core import Work, Worker

_log = logging.getLogger(__name__)

_MOST_HEAD_BYTES = 8192
"""Largest size of the head of a request. [B; judgement]"""


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


class _Connection(H11Protocol):
    """One connection; `ended` is done when it is closed."""

    def __init__(self, config: Config, state: ServerState) -> None:
        super().__init__(config, state, {})
        self.ended = self.loop.create_future()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.ended.set_result(None)


class HttpServer:
    """Serve an ASGI application as `what`, one request a connection, in one thread, at `address` (port 0 asks for any).

    `tls` holds uvicorn's settings of that, their files by name.  A connection beyond the largest number replaces the oldest, so
    that readers that hang do not shut out others.  `port` is None until it listens; `failed` says why it does not.
    """

    def __init__(
        self,
        what: str,
        address: tuple[str, int],
        application: Callable[..., Any],
        tls: Mapping[str, Any] | None = None,
        bounds: Bounds = Bounds(),
    ) -> None:
        self.port: int | None = None
        self.failed: str | None = None
        self._what, self._address, self._bounds = what, address, bounds
        self._config = Config(
            _told(application),
            interface="asgi3",
            http=_Connection,
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="critical",  # what readers send is no line of the log
            access_log=False,
            proxy_headers=False,
            server_header=False,
            headers=[("Connection", "close")],
            h11_max_incomplete_event_size=_MOST_HEAD_BYTES,
            **(tls or {}),
        )
        self._state = ServerState()
        self._serving: dict[asyncio.Task[None], None] = {}
        self._worker: Worker[None] | None = None

    @property
    def at(self) -> str:
        """Host and port, as in an address."""
        host, port = self._address
        return f"{f'[{host}]' if ':' in host else host}:{self.port or port}"

    @property
    def connections(self) -> int:
        """Number of open connections."""
        return len(self._serving)

    def open(self) -> bool:
        """Listen if it does not yet; return whether it begins now.  A failure is kept in `failed` and logged once."""
        if self._worker is not None and not self._worker.over:
            return False
        try:
            self.listen()
        except (OSError, ValueError) as error:
            if self.failed is None:
                _log.error("no %s at %s for now: %s", self._what, self.at, error)
            self.failed = f"{self.at}: {error}"
            return False
        return True

    def listen(self) -> None:
        """Begin to listen; OSError or ValueError tells that the port cannot be opened, or which files of `tls` are wrong."""
        c = self._config
        if not c.loaded:
            try:
                c.load()
            except OSError as error:
                names = [str(name) for name in (c.ssl_certfile, c.ssl_keyfile, c.ssl_ca_certs) if name is not None]
                raise OSError(f"{', '.join(names)}: {error.strerror or error}") from error
        self._state.default_headers = c.encoded_headers
        family, *_, place = socket.getaddrinfo(*self._address, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self._listener = socket.create_server(place[:2], family=family, backlog=self._bounds.waiting)
        self._listener.setblocking(False)
        self.port, self.failed = int(self._listener.getsockname()[1]), None
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _, context: _log.error("http: %s", context["message"]))
        self._running = self._loop.create_task(self._run())
        self._worker = Worker("http", Work(idle=self._serve), ends_on_error=True)
        self._worker.start()

    def close(self, timeout_s: float) -> None:
        """Stop listening and close all connections."""
        if self._worker is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended before
                self._loop.call_soon_threadsafe(self._running.cancel)
            self._worker.close(timeout_s)

    def _serve(self) -> None:
        """Serve until closed (the thread's work)."""
        with contextlib.closing(self._loop), self._listener, contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._running)

    async def _run(self) -> None:
        """Serve until cancelled, then close what is open."""
        try:
            await self._accept()
        finally:
            for task in self._serving:
                task.cancel()
            await asyncio.gather(*self._serving, *self._state.tasks, return_exceptions=True)

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
            task = self._loop.create_task(self._answer(connection))
            self._serving[task] = None
            task.add_done_callback(lambda done: self._serving.pop(done, None))
            await asyncio.sleep(1.0 / self._bounds.per_s)
            now_s = time.thread_time()
            await asyncio.sleep((now_s - spent_s) / self._bounds.share - 1.0 / self._bounds.per_s)
            spent_s = now_s

    async def _answer(self, connection: socket.socket) -> None:
        """Let uvicorn answer one request; end the connection where that takes too long."""
        longest_s = self._bounds.connection_s
        limits = {"ssl_handshake_timeout": longest_s, "ssl_shutdown_timeout": longest_s} if self._config.ssl else {}
        with contextlib.closing(connection), contextlib.suppress(OSError):  # also TimeoutError
            async with asyncio.timeout(longest_s):
                transport, protocol = await self._loop.connect_accepted_socket(
                    lambda: _Connection(self._config, self._state), connection, ssl=self._config.ssl, **limits
                )
                try:
                    await protocol.ended
                finally:
                    transport.abort()


def _told(application: Callable[..., Any]) -> Callable[..., Any]:
    """Tell the log where a request fails, which uvicorn then answers by 500."""

    async def tell(scope: Any, receive: Any, send: Any) -> None:
        try:
            await application(scope, receive, send)
        except UnicodeDecodeError as error:
            _log.debug("http: a request is not text: %s", error)
            raise
        except Exception:
            _log.exception("http: a request failed")
            raise

    return tell
