"""Client of a socketcand server that waits for no answer for ever, and goes on after a malformed message."""

from __future__ import annotations

import select
import socket
import time
from typing import Any

import can
from can.interfaces.socketcand import socketcand

ANSWER_S = 2.0
"""Longest wait for an answer of the server's handshake. [s; judgement]"""
_LONGEST_MESSAGE = 512
"""Greatest length of a message. [bytes; judgement: a frame of 64 bytes takes 160]"""


class SocketcandBus(socketcand.SocketCanDaemonBus):
    """Client that goes on after a malformed message, and fails when the server closes the connection or does not answer.

    python-can waits for ever for the answers of a handshake, and refuses one with which the first frames came.  It parses all
    that has arrived at once and keeps it when one message of it is malformed, so that the next call fails again; and it waits
    for ever when the connection is closed.  Each answer of the handshake may take `answer_s`.
    """

    _unread = b""

    def __init__(self, channel: str, *, answer_s: float = ANSWER_S, **options: Any) -> None:
        self._answer_s = answer_s
        super().__init__(channel, **options)  # type: ignore[no-untyped-call]

    def _expect_msg(self, msg: str) -> None:
        """Read an answer of the handshake, and no more; raises `can.CanError` if another one comes, or none, and `OSError`."""
        deadline = time.monotonic() + self._answer_s
        try:
            while b">" not in self._unread:
                if not self._receive(max(0.0, deadline - time.monotonic())):
                    raise can.CanError(f"the server does not answer: no {msg!r} within {self._answer_s:g} s")
            answer, end, self._unread = self._unread.partition(b">")
            if (answer + end).strip() != msg.encode("ascii"):
                raise can.CanError(f"expected {msg!r}, got {(answer + end).decode('ascii', 'replace')!r}")
        except (can.CanError, OSError):
            self._socket.close()
            raise

    @property
    def _socket(self) -> socket.socket:
        peer: socket.socket = self._SocketCanDaemonBus__socket  # type: ignore[attr-defined]
        return peer

    def _receive(self, timeout: float | None) -> bool:
        """Add what arrives within `timeout`, s, to the unread text; False if nothing does (errors as `_recv_internal`)."""
        peer = self._socket
        if not select.select([peer], [], [], timeout)[0]:
            return False
        data = peer.recv(1 << 16)
        if not data:
            raise can.CanOperationError("the server closed the connection")
        if self._SocketCanDaemonBus__tcp_tune:  # type: ignore[attr-defined]
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        self._unread += data
        return True

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next message; None if no whole message arrives within `timeout`, s.

        Raises `can.CanOperationError` if a message is malformed, which is then the error's cause, or the server has closed the
        connection, and `OSError` if that failed.
        """
        if b">" not in self._unread and not self._receive(timeout):
            return None, False
        text, end, rest = self._unread.partition(b">")
        if not end and len(text) <= _LONGEST_MESSAGE:
            return None, False
        self._unread = rest
        try:
            return _parse(text + end), False
        except (ValueError, LookupError) as error:
            raise can.CanOperationError("malformed message") from error


def _parse(text: bytes) -> can.Message:
    """Parse the message that begins at the last opening bracket; raises ValueError or LookupError if it is malformed."""
    message = socketcand.convert_ascii_message_to_can_message(text[max(0, text.rfind(b"<")) :].decode("ascii"))
    if message is None:
        raise ValueError("no frame")
    return message
