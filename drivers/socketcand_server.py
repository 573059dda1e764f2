"""Serves a CAN bus to clients over TCP, by the protocol of socketcand in raw mode."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
import time

_SEND = re.compile(rb"< *send +([0-9A-Fa-f]{1,8}) +([0-9A-Fa-f]{1,2})((?: +[0-9A-Fa-f]{1,2})*) *>")
_MAX_COMMAND = 4096
_MAX_CLIENTS = 32


class SocketcandServer:
    """Bus that is shared by the clients and the owner of the server; each frame goes to all but its sender.

    A client that receives nothing for `patience_s` is disconnected.  Until then all others wait for it, so that no client
    loses a frame.  Port 0 selects a free port.  A client's first frame comes `settle_s` after the last answer to it: python-can's
    client takes anything in the same packet as part of the answer, and fails.
    """

    def __init__(self, host: str, port: int, *, settle_s: float = 0.5, patience_s: float = 30.0) -> None:
        self._settle_s, self._patience_s = settle_s, patience_s
        self._lock = threading.Lock()
        self._raw: dict[socket.socket, float] = {}
        self._all: set[socket.socket] = set()
        self._listener = socket.create_server((host, port))
        self.port = int(self._listener.getsockname()[1])
        """Port at which the server listens, also if port 0 was requested."""
        threading.Thread(target=self._accept, name="socketcand", daemon=True).start()

    def wait_for_client(self, timeout_s: float, *, clients: int = 1) -> bool:
        """Wait until so many clients receive frames; False if fewer do within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            with self._lock:
                if sum(since <= time.monotonic() for since in self._raw.values()) >= clients:
                    return True
            time.sleep(0.01)
        return False

    def send(self, text: bytes, sender: socket.socket | None = None) -> None:
        """Send frames (see `frame_text`) to all clients but the sender."""
        with self._lock:
            now = time.monotonic()
            for client in [c for c, since in self._raw.items() if since <= now and c is not sender]:
                try:
                    client.sendall(text)
                except OSError:
                    self._drop(client)

    def close(self) -> None:
        """Close all connections, after the data already sent."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            for client in list(self._all):
                self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._raw.pop(client, None)
        self._all.discard(client)
        with contextlib.suppress(OSError):
            client.shutdown(socket.SHUT_RDWR)
        client.close()

    def _accept(self) -> None:
        """Accept clients until the server is closed."""
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            with self._lock:
                if len(self._all) >= _MAX_CLIENTS:
                    client.close()
                    continue
                self._all.add(client)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.settimeout(self._patience_s)
            threading.Thread(target=self._serve, args=(client,), name="socketcand-client", daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        """Greet a client, and execute its commands until it leaves."""
        waiting = b""
        with contextlib.suppress(OSError):
            client.sendall(b"< hi >")
            while len(waiting) < _MAX_COMMAND:
                try:
                    data = client.recv(4096)
                except TimeoutError:
                    continue  # a client that only receives need not send
                if not data:
                    break
                *commands, waiting = (waiting + data).split(b">")
                for command in commands:
                    self._execute(client, command.strip() + b" >")
        with self._lock:
            self._drop(client)

    def _execute(self, client: socket.socket, command: bytes) -> None:
        word = b"".join(command.split()[1:2])
        if word == b"send":
            if found := _SEND.fullmatch(command):
                data, extended = bytes(int(part, 16) for part in found[3].split()), len(found[1]) > 3
                self.send(frame_text(int(found[1], 16), extended, time.time(), data), client)
        elif word == b"open":
            client.sendall(b"< ok >")
        elif word == b"rawmode":
            client.sendall(b"< ok >")
            with self._lock:
                if client in self._all:
                    self._raw[client] = time.monotonic() + self._settle_s
        elif word == b"echo":
            client.sendall(b"< echo >")
        else:
            client.sendall(b"< error unknown command >")


def frame_text(frame_id: int, extended: bool, t_s: float, data: bytes) -> bytes:
    """Format one frame as socketcand sends it; `t_s` is UTC, s since 1970."""
    number = f"{frame_id:08X}" if extended else f"{frame_id:03X}"
    return f"< frame {number} {t_s:.6f} {data.hex().upper()} >".encode()
