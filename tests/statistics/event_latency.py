"""Time from the end of strong motion to each message of an event, in a real `run` over Zenoh at real pace.

``python -m tests.statistics.event_latency [QUAKES]`` sends each quake with 80 s of quiet before and after it, in blocks of
half a second stamped with the present time, to a daemon with the default settings, and prints how long after the event's end each
message came.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import zenoh

from drivers.base import ACCELERATION, GROUND, SampleBlock
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher
from drivers.zenoh_session import SessionSettings, open_session
from tests.events.shaken import RATE, kanai_tajimi, shake, structure_text
from tests.support.campaign import words
from tests.support.live_rig import Command
from tests.support.zenoh_router import Router, free_port

_QUIET_S, _BLOCK = 80.0, 100
_SITE = """
[site]
name = "house"
[source]
kind = "zenoh"
key = "shm/house/acceleration"
ground_key = "shm/house/ground"
connect = ["tcp/127.0.0.1:{port}"]
[output]
dir = "out"
[output.zenoh]
connect = ["tcp/127.0.0.1:{port}"]
"""


def motion(quakes: int) -> tuple[np.ndarray, np.ndarray]:
    """Floors, shape (n, 3), and ground, shape (n, 1), m/s^2."""
    rng, quiet = np.random.default_rng(52), np.zeros(round(_QUIET_S * RATE))
    parts = [quiet]
    for _ in range(quakes):
        parts += [kanai_tajimi(20.0, 10.0 ** rng.uniform(-0.5, 0.5), 2.5, rng), quiet]
    ground = np.concatenate(parts)
    shaken, _ = shake(ground, rng)
    return shaken.floors, shaken.ground[:, None]


def send(publisher: ZenohPublisher, streams: dict[str, np.ndarray]) -> None:
    """Publish the streams at real pace; a block goes out when its last sample has been taken."""
    begun, begun_ns = time.monotonic(), time.time_ns()
    for first in range(0, len(streams[GROUND]), _BLOCK):
        time.sleep(max(0.0, begun + (first + _BLOCK) / RATE - time.monotonic()))
        for topic, values in streams.items():
            channels = tuple(f"a{i + 1}" for i in range(values.shape[1])) if topic == ACCELERATION else ("ground",)
            t_ns = begun_ns + round(first / RATE * 1e9)
            part = values[first : first + _BLOCK].astype(np.float32)
            publisher.send(SampleBlock(topic, t_ns, first, RATE, channels, "m/s^2", part))


def main() -> None:
    """Print the delay of each message, s."""
    (quakes,) = words(4)
    floors, ground = motion(quakes)
    port, told, lock = free_port(), list[tuple[object, float]](), threading.Lock()

    def take(sample: zenoh.Sample) -> None:
        line = json.loads(bytes(sample.payload))
        with lock:
            told.append((line["revision"], 1e-9 * (time.time_ns() - line["t_end_ns"])))

    place = f"tcp/127.0.0.1:{port}"
    with tempfile.TemporaryDirectory() as name:
        site, router = Path(name) / "site.toml", Router(place)
        site.write_text(_SITE.format(port=port) + structure_text())
        session = open_session(SessionSettings(connect=(place,)), Path())
        subscriber = session.declare_subscriber("**/event", take)
        daemon = Command(site.with_name("log"), "run", site)
        try:
            daemon.wait_for("READY")
            settings = {"key": "shm/house/acceleration", "ground_key": "shm/house/ground", "connect": [place]}
            publisher = ZenohPublisher(PublisherSettings.model_validate(settings))
            send(publisher, {ACCELERATION: floors, GROUND: ground})
            publisher.close()
            code, _ = daemon.stop()
        finally:
            daemon.kill()
            subscriber.undeclare()
            session.close()
            router.kill()
    for revision, kind in ((None, "preliminary"), (0, "final")):
        delays = sorted(delay for number, delay in told if number == revision)
        print(f"{kind}: {len(delays)} of {quakes}, after {', '.join(f'{delay:.1f}' for delay in delays)} s")
    print(f"exit code {code}")


if __name__ == "__main__":
    main()
