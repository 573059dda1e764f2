"""A listening port is a promise: whoever reaches it costs a bounded number of connections, threads and seconds."""

from __future__ import annotations

import logging
import os
import re
import socket
import ssl
import threading
import time
import urllib.error
import urllib.request
from asyncio.selector_events import BaseSelectorEventLoop
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from monitor.service.outlets.http_server import Bounds, HttpServer
from monitor.service.outlets.metrics import Metrics, MetricsSettings, metrics_application
from tests.support.certificates import certify
from tests.support.http import fetch
from tests.support.waiting import until

PAGE = b"x" * 1000
UPGRADE = b"GET / HTTP/1.1\r\nHost: x\r\nConnection: upgrade\r\nUpgrade: websocket\r\n\r\n"
HEALTH: dict[str, Any] = {
    "stream": None,
    "source": {"connected": True, "lost": 0, "counts": {}, "clocks": []},
    "recorder": None,
    "refused": {"blocks": 0},
    "queue": 0,
    "delay_s": 0.0,
    "latency_ms": {"max": 0.0, "windows": {"<= 5": 0, "> 5": 0}},
    "failed": {},
    "channels": [],
}


async def application(scope: dict[str, Any], receive: Any, send: Any) -> None:
    if scope["path"] == "/bad":
        raise RuntimeError("two\nlines")
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": PAGE * (20_000 if scope["path"] == "/long" else 1)})


@contextmanager
def serving(asked: Callable[..., Any] = application, **bounds: float) -> Iterator[HttpServer]:
    one = HttpServer("page", ("127.0.0.1", 0), asked, bounds=Bounds(**bounds))  # type: ignore[arg-type]
    assert one.open()
    yield one
    one.close(60.0)
    assert not any(t.name == "http" for t in threading.enumerate())


@pytest.fixture
def server() -> Iterator[HttpServer]:
    with serving() as one:
        yield one


def connect(port: int | None, text: bytes = b"") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), 10.0)
    connection.sendall(text)
    return connection


def closed(connection: socket.socket) -> bool:
    """Whether the other side ends the connection within its timeout, whatever it says before."""
    try:
        while connection.recv(65536):
            pass
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return True


def test_it_answers(server: HttpServer) -> None:
    assert fetch(server.port) == PAGE
    with connect(server.port, b"GET / HTTP/1.1\r\nHost: x\r\n\r\n") as one:
        assert closed(one)


def test_hundreds_of_half_requests_cost_no_thread_and_shut_out_nobody(server: HttpServer) -> None:
    handles, threads = len(os.listdir("/proc/self/fd")), set(threading.enumerate())
    held: list[socket.socket] = []
    try:
        for _ in range(60):  # beyond what is open the system lets them wait
            one = socket.socket()
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", server.port))
            held.append(one)
        for one in held[:8]:
            one.setblocking(True)
            one.sendall(b"GET /metrics HTTP/1.1\r\n")
        assert fetch(server.port) == PAGE
        assert set(threading.enumerate()) <= threads
        ours = len(os.listdir("/proc/self/fd")) - handles - len(held)
        assert ours <= Bounds().connections + 1 and server.connections <= Bounds().connections
    finally:
        for one in held:
            one.close()


@pytest.mark.parametrize("how", ["silent", "drips", "reads slowly"])
def test_a_connection_has_one_time_limit_in_all(how: str) -> None:
    ended, text = threading.Event(), b"GET /long HTTP/1.1\r\nHost: x\r\n\r\n" if how == "reads slowly" else b"GET "
    with serving(connection_s=0.5) as server, connect(server.port, text) as one:

        def drip() -> None:
            while not ended.wait(0.02):
                try:
                    one.recv(100) if how == "reads slowly" else one.sendall(b"a")
                except OSError:
                    return

        thread = threading.Thread(target=drip)
        if how != "silent":
            thread.start()
        until(lambda: server.connections == 1, "open")
        until(lambda: server.connections == 0, "closed", 10.0)
        ended.set()
        if how != "silent":
            thread.join(10.0)
        assert closed(one)


def test_what_is_no_request_is_closed_and_an_error_is_one_line(
    server: HttpServer, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.INFO)
    bodies = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 999999999\r\n\r\n" + b"x" * 100_000, UPGRADE
    for text in (
        b"\r\n\r\n",
        b"\x00\xff\r\n\r\n",
        b"GET\r\n\r\n",
        b"a b c d\r\n\r\n",
        b"x" * 20_000,
        b"\x16\x03\x01",
        *bodies,
    ):
        with connect(server.port, text) as one:
            one.shutdown(socket.SHUT_WR)
            assert closed(one)
    assert not caplog.records
    with connect(server.port, b"GET /bad HTTP/1.1\r\nHost: x\r\n\r\n") as one:
        assert closed(one)
    assert fetch(server.port) == PAGE
    assert [record.getMessage() for record in caplog.records] == ["http: a request failed"]
    assert capfd.readouterr().err == ""


def test_a_field_of_metrics_that_is_no_text_is_no_line_of_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with (
        serving(metrics_application(Metrics("bench", None))) as server,
        connect(server.port, b"GET / HTTP/1.1\r\nHost: x\r\nAccept: \xff\r\n\r\n") as one,
    ):
        assert closed(one)
        assert b"shm_state" in fetch(server.port)
    assert not caplog.records


def test_requests_are_taken_no_faster_than_they_may_cost() -> None:
    with serving(per_s=10.0) as server:
        begun = time.monotonic()
        for _ in range(6):
            fetch(server.port)
        assert time.monotonic() - begun > 0.35


def test_readers_that_hang_do_not_hold_up_the_end() -> None:
    with serving(connection_s=3600.0) as server, ExitStack() as held:
        for text in (b"GET /long HTTP/1.1\r\n", b"GET /long HTTP/1.1\r\nHost: x\r\n\r\n") * 2:
            held.enter_context(connect(server.port, text))
        until(lambda: server.connections >= 2, "they are open")
        server.close(60.0)


def test_costly_answers_take_a_share_of_a_core_and_the_next_waits() -> None:
    async def costly(scope: dict[str, Any], receive: Any, send: Any) -> None:
        until = time.thread_time() + 0.05
        while time.thread_time() < until:
            pass
        await application(scope, receive, send)

    with serving(costly, per_s=1000.0, share=0.2) as one:
        begun = time.monotonic()
        for _ in range(5):
            assert fetch(one.port) == PAGE
        assert time.monotonic() - begun > 3 * 0.05 / 0.2


def test_no_room_for_a_connection_is_one_line_and_passes(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    accept, failures = BaseSelectorEventLoop.sock_accept, iter([False, True, True, True])

    async def failing(loop: BaseSelectorEventLoop, listener: socket.socket) -> Any:
        if next(failures, False):
            raise OSError(24, "Too many open files")
        return await accept(loop, listener)

    monkeypatch.setattr(BaseSelectorEventLoop, "sock_accept", failing)
    with serving(rest_s=0.05) as server:
        assert [fetch(server.port) for _ in range(2)] == [PAGE, PAGE]
    assert [r.getMessage() for r in caplog.records] == ["http: no connection can be accepted: Too many open files"]


def test_metrics_over_tls_for_those_who_show_a_certificate(tmp_path: Path) -> None:
    authority = certify(tmp_path, "ca", "ca", None)
    for name in ("server", "reader"):
        certify(tmp_path, name, name, authority)
    settings = MetricsSettings(
        listen="127.0.0.1:0", certificate=Path("server.pem"), private_key=Path("server.key"), client_ca=Path("ca.pem")
    )
    metrics = Metrics("bench", settings, tmp_path)
    metrics.health_line(HEALTH)
    assert metrics.port is not None and metrics.failed is None
    try:
        with ExitStack() as held:
            for _ in range(Bounds().connections + 2):  # no handshake comes
                held.enter_context(connect(metrics.port))
            context = ssl.create_default_context(cafile=str(tmp_path / "ca.pem"))
            with pytest.raises((OSError, urllib.error.URLError)):
                fetch(metrics.port, scheme="https", context=context)
            context.load_cert_chain(tmp_path / "reader.pem", tmp_path / "reader.key")
            assert b"shm_source_connected 1.0" in fetch(metrics.port, scheme="https", context=context)
    finally:
        metrics.close(5.0)


def test_a_port_that_cannot_be_opened_or_a_certificate_that_is_missing_is_told(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        metrics = Metrics("bench", MetricsSettings(listen=f"127.0.0.1:{taken.getsockname()[1]}"))
        metrics.health_line(HEALTH)
        assert metrics.failed is not None and "in use" in metrics.failed
    settings = MetricsSettings(listen="127.0.0.1:0", certificate=Path("none.pem"), private_key=Path("none.key"))
    metrics = Metrics("bench", settings, tmp_path)
    metrics.health_line(HEALTH)
    assert metrics.failed is not None and re.search("none.pem, .*none.key: No such file", metrics.failed)
