"""A web hook that hears messages, fails, sends on or dribbles."""

from __future__ import annotations

import contextlib
import http.server
import json
import socket
import threading
from typing import Any


class Hook(http.server.ThreadingHTTPServer):
    """Keeps what it is sent; answers with `status`, and `location` if there is one, but well at the place `ELSEWHERE`."""

    ELSEWHERE = "elsewhere"

    def __init__(self) -> None:
        self.status = 200
        self.location: str | None = None
        self.refuses: str | None = None
        self.got: list[dict[str, Any]] = []
        self.paths: list[str] = []
        self.tries = self.beats = 0
        super().__init__(("127.0.0.1", 0), _Handler)
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def url(self) -> str:
        return f"json://127.0.0.1:{self.server_port}/hush-hush"

    @property
    def titles(self) -> list[str]:
        return [item["title"] for item in self.got]


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Hook

    def do_POST(self) -> None:
        text = self.rfile.read(int(self.headers["content-length"]))
        body = json.loads(text) if "json" in self.headers["content-type"] else {"title": "", "text": text}
        self.server.tries += 1
        refused = self.server.refuses is not None and self.server.refuses in body["title"]
        status = 422 if refused else self._status
        if status == 200:
            self.server.got.append(body)
        self._answer(status)

    def do_GET(self) -> None:
        self.server.beats += 1
        self.server.paths.append(self.path)
        self._answer(self._status)

    @property
    def _status(self) -> int:
        return 200 if self.path.strip("/") == Hook.ELSEWHERE else self.server.status

    def _answer(self, status: int) -> None:
        self.send_response(status)
        if self.server.location is not None:
            self.send_header("location", self.server.location)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None: ...


class Drip:
    """Takes every request and answers with one byte of a header now and then, for ever."""

    def __init__(self, pause_s: float = 0.05) -> None:
        self.calls = 0
        self._pause_s = pause_s
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._closed = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    def close(self) -> None:
        self._closed.set()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                self.calls += 1
                threading.Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            connection.sendall(b"HTTP/1.1 200 OK\r\nX-Long: ")
            while not self._closed.wait(self._pause_s):
                connection.sendall(b"a")
