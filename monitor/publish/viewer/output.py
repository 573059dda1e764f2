"""Rerun recording of the results: a file, a server that viewers join, or both."""

from __future__ import annotations

import re
import socket
import warnings
from pathlib import Path

import rerun as rr
from rerun.chunk import RrdReader

from monitor.core import finish, partial


class Output:
    """Rerun recording that goes to a file, to viewers that join, or both; OSError or RuntimeError where it cannot be made.

    `name` is the recording's id too, so that the same data give the same recording.  The file takes its name only once
    complete. Viewers join at ``rerun+http://ADDRESS:PORT/proxy`` of `serve`; of the data that the server keeps for those that
    join late, `memory`, the oldest are dropped first.
    """

    def __init__(self, name: str, file: Path | None, serve: tuple[str, int] | None, memory: str = "64MB") -> None:
        rr.set_strict_mode(True)  # otherwise a wrong call only gives a warning
        entry = re.sub(r"[^0-9A-Za-z_ -]+", "-", name)  # the characters that Rerun accepts without a warning
        self.stream = rr.RecordingStream(entry, recording_id=entry, send_properties=False)
        self._file = file
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        if serve is not None:
            _require_free_port(*serve)
            host = f"[{serve[0]}]" if ":" in serve[0] else serve[0]
            sinks.append(rr.GrpcServerSink(bind_ip=host, port=serve[1], server_memory_limit=memory))
        if file is not None:
            # An index would be kept in memory until the end, with one entry for each message.
            sinks.append(rr.FileSink(partial(file), write_footer=False))
        self.stream.set_sinks(*sinks)
        self.stream.set_log_time_enabled(False)  # time is the data's

    def close(self, timeout_s: float) -> None:
        """Write the remaining data, check that the file is complete, and give it its name.

        Raises OSError or RuntimeError if some data did not arrive, as on a full disk; no file is left then.
        """
        try:
            self.stream.flush(timeout_sec=timeout_s)
            self.stream.disconnect()
            if self._file is not None:
                # Where writing failed, flush has raised.  The reader raises at an incomplete message, and warns that there is
                # no index.
                with warnings.catch_warnings(action="ignore"):
                    found = RrdReader(partial(self._file)).recordings()
                if not found:
                    raise OSError(f"{self._file}: nothing arrived")
                finish(self._file)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Disconnect the sinks and remove an unfinished file."""
        self.stream.disconnect()
        if self._file is not None:
            partial(self._file).unlink(missing_ok=True)


def _require_free_port(address: str, port: int) -> None:
    """Raise OSError if the port is taken, since Rerun itself only prints that and continues without a listener."""
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise OSError(f"cannot serve viewers on {address}:{port}: {error.strerror or error}") from error
