"""A mosquitto broker of one's own on loopback, which keeps sessions and messages over its restart."""

from __future__ import annotations

import getpass
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from tests.support.debian import demand, mosquitto
from tests.support.zenoh_router import free_port

PATIENCE_S = 60.0


class Broker:
    """A broker for tests; skips the test where the Debian package is absent.

    Parameters
    ----------
    folder : Path
        Where it keeps configuration and store.
    users : dict
        User -> password; without any, everybody may do everything.
    port : int, optional
        Where it listens; a free one by default.
    lines : sequence of str
        More lines of its listener's configuration.
    """

    def __init__(
        self, folder: Path, users: dict[str, str] | None = None, port: int | None = None, lines: Sequence[str] = ()
    ) -> None:
        demand("mosquitto")
        self._folder, self.port = folder, port or free_port()
        folder.mkdir(parents=True, exist_ok=True)
        configured = [
            f"listener {self.port} 127.0.0.1",
            *lines,
            f"user {getpass.getuser()}",  # else it gives up root's rights, and cannot write here
            "persistence true",
            f"persistence_location {folder}/",
            "max_queued_messages 0",
        ]
        if users:
            passwords = folder / "passwords"
            passwords.touch(mode=0o700)
            for user, password in users.items():
                subprocess.run(["mosquitto_passwd", "-b", passwords, user, password], check=True, capture_output=True)
        configured += ["allow_anonymous true"] if not users else [f"password_file {folder}/passwords"]
        (folder / "mosquitto.conf").write_text("\n".join(configured) + "\n")
        self.start()

    def start(self) -> None:
        """Start it, again after `stop`, and wait until it listens."""
        program = mosquitto()
        assert program is not None
        with (self._folder / "mosquitto.log").open("ab") as log:
            command = [program, "-c", str(self._folder / "mosquitto.conf"), "-v"]
            self._process = subprocess.Popen(command, stdout=log, stderr=log)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            assert self._process.poll() is None, self.log
            try:
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
            except OSError:
                time.sleep(0.02)
            else:
                return
        raise AssertionError(f"mosquitto does not listen: {self.log}")

    @property
    def log(self) -> str:
        """What it said so far."""
        return (self._folder / "mosquitto.log").read_text(errors="replace")

    def stop(self) -> None:
        """End it as a reboot does: it stores what it has."""
        self._process.terminate()
        self._process.wait(PATIENCE_S)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()
