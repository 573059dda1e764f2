"""Client of a socketcand server that goes on after a malformed message, which python-can's takes for the loss of the bus."""

from __future__ import annotations

import select
import socket

import can
from can.interfaces.socketcand import socketcand

_LONGEST_MESSAGE = 512
"""Greatest length of a message. [bytes; judgement: a frame of 64 bytes takes 160]"""


class SocketcandBus(socketcand.SocketCanDaemonBus):
    """Client that goes on after a malformed message, and fails when the server closes the connection.

    python-can parses all that has arrived at once and keeps it when one message of it is malformed, so that the next call
    fails again; and it waits for ever when the connection is closed.
    """

    _unread = b""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next message; None if no whole message arrives within `timeout`, s.

        Raises `can.CanOperationError` if a message is malformed, which is then the error's cause, or the server has closed the
        connection, and `OSError` if that failed.
        """
        if b">" not in self._unread:
            peer: socket.socket = self._SocketCanDaemonBus__socket  # type: ignore[attr-defined]
            if not select.select([peer], [], [], timeout)[0]:
                return None, False
            data = peer.recv(1 << 16)
            if not data:
                raise can.CanOperationError("the server closed the connection")
            if self._SocketCanDaemonBus__tcp_tune:  # type: ignore[attr-defined]
                peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
            self._unread += data
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
