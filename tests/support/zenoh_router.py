"""A Zenoh router in a Python process: ``python tests/support/zenoh_router.py ENDPOINT|CONFIG.json5 [KEY=JSON ...]``.

Prints ``router up`` when it listens; SIGTERM ends it.
"""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path


def free_port() -> int:
    """A port on 127.0.0.1 where nobody listened a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Router:
    """A router process for tests; `place` is an endpoint or a configuration file."""

    def __init__(self, place: str, *options: str) -> None:
        self._command = [sys.executable, __file__, place, *options]
        self.start()

    def start(self) -> None:
        """Start it, again after `kill`, and wait until it listens."""
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        said = self._process.stdout.readline()
        if said.strip() != "router up":
            raise RuntimeError(said + self._process.communicate()[0])

    def kill(self) -> None:
        """End it at once, as a power cut would."""
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


def _main(place: str, *options: str) -> None:
    import zenoh

    values = {}
    if place.endswith(".json5"):
        config = zenoh.Config.from_file(place)
    else:
        config = zenoh.Config()
        values = {
            "mode": "router",
            "listen/endpoints": [place],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
        }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    for option in options:
        key, _, text = option.partition("=")
        config.insert_json5(key, text)
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    with zenoh.open(config):
        print("router up", flush=True)
        over.wait()


if __name__ == "__main__":
    sys.path = [p for p in sys.path if Path(p or ".").resolve() != Path(__file__).resolve().parent]
    _main(*sys.argv[1:])
