"""A day of a simulated site at speed, with everything wrong at once: what it cost, and whether anything was lost beside that.

    .venv/bin/python -m tests.system.site_day [DATA_HOURS] [PACE] [SEED]

Samples come over Zenoh at `PACE` times real time (they wait while a daemon starts), with NaN bursts, gaps, steps of the clock,
repeated and malformed messages.
Meanwhile the folder is flooded with requests, viewers and metrics readers hang, addresses of messages hang, drip and fail, the
disk fills and (for root, who may mount one) hangs, the daemon is killed, ended and told to read its settings again.  At the end
the recordings are replayed, and what the daemon wrote is compared with the replay.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from drivers import codec
from drivers.base import ACCELERATION, SampleBlock
from monitor.config import configuration
from monitor.model import simulate
from monitor.runs import cut_into_blocks
from tests.support.faulty_disk import Disk, faulty_disk, is_possible
from tests.support.forked import Forked, Held
from tests.support.frame_text import THREE_STORIES
from tests.support.hooks import Drip, Hook
from tests.support.http import fetch
from tests.support.live_rig import call, shm_monitor
from tests.support.repeating import Repeating
from tests.support.samples import CHANNELS, T0_NS
from tests.support.site import lines, summary, write
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

RATE, SIZE = 128.0, 256
BLOCK_S = SIZE / RATE
KEY = "shm/day/acceleration"
WINDOW_S = 20.0
HOP_S = 5
SITE = """
[site]
name = "day"
baseline = "baseline.json"

[source]
kind = "zenoh"
key = "{key}"
mode = "router"
listen = ["tcp/127.0.0.1:{bus}"]

[output]
dir = "out"
serve = "127.0.0.1:{viewer}"
[output.metrics]
listen = "127.0.0.1:{metrics}"

[notify]
urls = ["json://{drip}/a", "{hook}", "json://127.0.0.1:{closed}/b", "json://127.0.0.1:{mute}/c"]
heartbeat_url = "http://{drip}/beat"
heartbeat_s = 5.0

[recorder]
min_free_gb = 0.0
file_s = 600.0

[alarm]
false_announcements_per_year = 0.10

[watch]
diagnose = false

[processing]
window_s = 20.0
hop_s = 5.0
"""


@dataclass
class Report:
    """What came of the day."""

    data_h: float = 0.0
    lives: int = 0
    samples: list[tuple[int, Held]] = field(default_factory=list)
    """What the process held, by its life."""
    ends_s: list[float] = field(default_factory=list)
    """Time that each end by SIGTERM took, s."""
    troubles: list[tuple[float, float]] = field(default_factory=list)
    """Spans of the data in which the docs allow losses: kills, full disks; s."""
    windows: int = 0
    judged: int = 0
    replayed: int = 0
    same: int = 0
    """Windows whose lines are those of the replay, byte for byte."""
    unlike: list[float] = field(default_factory=list)
    """Ends of the windows outside the troubles whose estimates are not those of the replay, s."""
    latency_ms: dict[str, Any] = field(default_factory=dict)
    messages: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    log_rows: int = 0
    strange_rows: list[str] = field(default_factory=list)
    """Rows of the log that are no records."""

    def growth(self) -> dict[str, float]:
        """Return the greatest growth within a life from its fifth sample on: threads, handles, memory in MB."""
        most = {"threads": 0.0, "handles": 0.0, "memory_mb": 0.0}
        for life in range(self.lives):
            own = [held for number, held in self.samples if number == life][4:]
            for name in most if len(own) > 1 else ():
                most[name] = max(most[name], getattr(own[-1], name) - getattr(own[0], name))
        return most


class Stream(threading.Thread):
    """Node that publishes the day at speed, faults included."""

    def __init__(self, floors: np.ndarray, bus: int, hours: float, pace: float, seed: int) -> None:
        super().__init__(name="node")
        self._floors, self._pace, self._draw = floors, pace, random.Random(seed)
        self._endpoint, self._end_s = f"tcp/127.0.0.1:{bus}", hours * 3600.0
        self.data_s = 0.0
        self.going = threading.Event()
        """Cleared while a daemon starts: its seconds would be hours of the data."""
        self.going.set()
        self.failed: BaseException | None = None

    def run(self) -> None:
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [self._endpoint],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "scouting/multicast/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        try:
            with zenoh.open(config) as session:
                self._publish(session)
        except BaseException as error:  # noqa: BLE001 - told by `failed`
            self.failed = error

    def _publish(self, session: zenoh.Session) -> None:
        draw, number, offset_ns, due_s = self._draw, 0, 0, time.monotonic()
        publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        while self.data_s < self._end_s:
            self.going.wait()
            due_s = max(due_s + BLOCK_S / self._pace, time.monotonic() - 1.0)
            time.sleep(max(0.0, due_s - time.monotonic()))
            rows = np.arange(number * SIZE, (number + 1) * SIZE) % len(self._floors)
            values = self._floors[rows].astype(np.float32)
            t_ns = T0_NS + round(number * BLOCK_S * 1e9) + offset_ns
            block = SampleBlock(ACCELERATION, t_ns, number * SIZE, RATE, CHANNELS, "m/s^2", values)
            number += 1
            self.data_s = number * BLOCK_S
            match draw.randrange(400):
                case 0:  # lost
                    continue
                case 1:
                    values[draw.randrange(SIZE) :] = np.nan
                case (
                    2
                ):  # by whole hops: a replay does not see a step amid lost samples, and its windows would lie elsewhere
                    offset_ns += draw.choice([-HOP_S, HOP_S]) * 10**9
                case 3:
                    publisher.put(codec.encode(block))
                case 4 | 5:
                    publisher.put(draw.randbytes(draw.randrange(200)))
                case 6:
                    publisher.put(codec.encode(replace(block, sample_rate_hz=1e9)))
                case 7:
                    publisher.put(bytes(2 << 20))
            publisher.put(codec.encode(block))


class Floods:
    """Whoever asks, reads and hangs, until closed."""

    def __init__(self, out: Path, metrics: int, viewer: int, seed: int) -> None:
        self._out, self._metrics, self._viewer, self._draw = out, metrics, viewer, random.Random(seed)
        self._acts, self._held = Repeating(), list[socket.socket]()
        for act, pause_s in ((self._request, 0.05), (self._read, 0.5), (self._hold, 0.5)):
            self._acts.start(act, pause_s)

    def close(self) -> None:
        self._acts.end()
        for one in self._held:
            one.close()

    def _request(self) -> None:
        """Through a file that another folder held: the flood itself waits for no disk that hangs, but here it may."""
        draw, place = self._draw, self._out / "state" / "requests" / f"{time.time_ns()}.json"
        request: Any = {"action": draw.choice(["acknowledge", "reset", "unshelve"]), "story": draw.randrange(5)}
        text = json.dumps({**request, "who": f"w{draw.randrange(20)}"})
        if draw.random() < 0.5 and place.parent.is_dir() and len(os.listdir(place.parent)) < 1000:
            place.write_text(text if draw.random() < 0.7 else text[: draw.randrange(40)])

    def _read(self) -> None:
        fetch(self._metrics)

    def _hold(self) -> None:
        """Connect, say half a request, and stay."""
        for port, text in ((self._metrics, b"GET /metrics HTTP/1.1\r\n"), (self._viewer, b"PRI * HTTP/2.0\r\n")):
            if len(self._held) > 80:
                self._held.pop(0).close()
            one = socket.create_connection(("127.0.0.1", port), 1.0)
            self._held.append(one)
            one.sendall(text)


class Day:
    """A daemon's day in a folder."""

    def __init__(self, folder: Path, hours: float, pace: float, seed: int) -> None:
        self._folder, self._out = folder, folder / "out"
        self._hours, self._pace, self._seed = hours, pace, seed
        self._draw, self.report = random.Random(seed), Report(data_h=hours)
        self._metrics, self._bus = free_port(), free_port()
        self._daemon: Forked | None = None
        self._disk: Disk | None = None

    def run(self) -> Report:
        """Live through the day and compare."""
        viewer, closed, mute = free_port(), free_port(), socket.create_server(("127.0.0.1", 0))
        drip, hook, site = Drip(0.2), Hook(), self._folder / "site.toml"
        ports = {"bus": self._bus, "viewer": viewer, "metrics": self._metrics, "closed": closed}
        text = SITE.format(key=KEY, drip=drip.address, hook=hook.url, mute=mute.getsockname()[1], **ports)
        site.write_text(text + THREE_STORIES)
        floors = self._prepare(site)
        (self._out).mkdir()
        with ExitStack() as undo:
            for close in (drip.close, hook.server_close, hook.shutdown, mute.close):
                undo.callback(close)
            if is_possible():
                (self._folder / "backing").mkdir()
                self._disk = undo.enter_context(faulty_disk(self._folder / "backing", self._out))
            undo.callback(self._kill)
            stream = Stream(floors, self._bus, self._hours, self._pace, self._seed)
            self._start(stream)
            stream.start()
            floods = Floods(self._out, self._metrics, viewer, self._seed)
            undo.callback(floods.close)
            self._live(stream)
            stream.join()
            assert stream.failed is None, stream.failed
            time.sleep(5.0)
            self._note(self.report.lives - 1)
            self._end()
            floods.close()
            self.report.messages = len(hook.got)
            self._compare(site)
        return self.report

    def _prepare(self, site: Path) -> np.ndarray:
        """Simulate healthy samples with a weak story now and then, and learn a baseline; accelerations, shape (n, 3)."""
        bare = self._folder / "frame.toml"
        bare.write_text(THREE_STORIES + "\n[processing]\nwindow_s = 20.0\nhop_s = 5.0\n")
        weak = self._folder / "weak.toml"
        weak.write_text(bare.read_text().replace("1514.8507", "900.0"))
        parts = []
        for path, seconds, seed in ((bare, 900.0, 1), (weak, 180.0, 2)):
            model = configuration.load(path).model()
            parts.append(simulate(model, duration_s=seconds, rate_hz=RATE, noise=0.03, seed=seed).floors)
        healthy = list(cut_into_blocks(ACCELERATION, parts[0], CHANNELS, RATE, T0_NS, SIZE))
        write(self._folder / "healthy.mcap", healthy)
        files = [self._folder / name for name in ("healthy.mcap", "baseline.json")]
        shm_monitor("calibrate", files[0], "--structure", bare, "--out", files[1])
        return np.concatenate(parts)

    @property
    def _running(self) -> Forked:
        assert self._daemon is not None and self._daemon.code is None, (self._folder / "log").read_text()[-2000:]
        return self._daemon

    def _start(self, stream: Stream) -> None:
        stream.going.clear()
        self._daemon = Forked(self._folder / "log", call, "run", str(self._folder / "site.toml"))
        self.report.lives += 1
        until(lambda: self._running.said.count("READY\n") == self.report.lives, "it has started")
        time.sleep(5.0)  # the node, too, is connected again
        stream.going.set()

    def _kill(self) -> None:
        if self._daemon is not None:
            self._daemon.kill()

    def _end(self) -> None:
        code, seconds = self._running.stop()
        self.report.ends_s.append(seconds)
        assert code in {0, -signal.SIGTERM}, code  # by the signal itself while it starts

    def _live(self, stream: Stream) -> None:
        """Look at the daemon and do something to it now and then, until the stream is over; the last third is left to itself."""
        deeds = self._deeds()
        due_s = time.monotonic()
        while stream.is_alive():
            time.sleep(1.0)
            self._note(self.report.lives - 1)
            now = time.monotonic()
            if stream.data_s < 2400.0 * self._hours and now >= due_s + 10.0:
                name = next(deeds)
                before_s = stream.data_s
                self._do(name, stream)
                self.report.counts[name] = self.report.counts.get(name, 0) + 1
                if name in {"kill", "end", "fill"}:
                    self.report.troubles.append((before_s - 3.0 * self._pace, stream.data_s + 8.0 * self._pace))
                due_s = time.monotonic()

    def _deeds(self) -> Iterator[str]:
        names = ["kill", "reload", "hang", "fill", "end"] if self._disk is not None else ["kill", "reload", "end"]
        while True:
            self._draw.shuffle(names)
            yield from names

    def _do(self, name: str, stream: Stream) -> None:
        running, disk = self._running, self._disk
        if name == "kill":
            self._kill()
            self._start(stream)
        elif name == "end":
            self._end()
            self._start(stream)
        elif name == "reload":
            site = self._folder / "site.toml"
            rate = f"per_year = 0.{self._draw.randrange(10, 20)}"
            site.write_text(re.sub(r"per_year = 0\.\d+", rate, site.read_text()))
            running.send(signal.SIGHUP)
        elif name == "hang" and disk is not None:
            disk.hang()
            time.sleep(8.0)
            disk.answer()
        elif name == "fill" and disk is not None:
            disk.fill()
            time.sleep(4.0)
            disk.make_room()

    def _note(self, life: int) -> None:
        """Note what the process holds, while it answers."""
        with contextlib.suppress(OSError, KeyError):
            fetch(self._metrics)
            self.report.samples.append((life, self._running.holds))

    def _compare(self, site: Path) -> None:
        """Replay the recordings, and compare the results line by line."""
        report, again = self.report, self._folder / "again"
        recordings = sorted((self._out / "recordings").glob("*.mcap"))
        files = ["--structure", site, "--baseline", self._folder / "baseline.json", "--out", again]
        shm_monitor("replay", *recordings, *files)
        live, replayed = ((folder / "results.jsonl").read_text().splitlines() for folder in (self._out, again))
        report.windows, report.replayed = len(live), len(replayed)
        report.judged = sum(json.loads(text)["skipped"] is None for text in live)
        known: dict[int, list[str]] = {}  # two windows end at one time where the clock was set back
        for text in replayed:
            known.setdefault(json.loads(text)["t_end_ns"], []).append(text)
        for text in live:
            line = json.loads(text)
            others = known.get(line["t_end_ns"], [])
            report.same += text in others
            t_s = (line["t_end_ns"] - T0_NS) * 1e-9
            if any(begin <= t_s <= end + WINDOW_S for begin, end in report.troubles):
                continue
            told = ("skipped", "frequencies_hz", "frequencies_std_hz")
            if not any(all(line[key] == wanted[key] for key in told) for wanted in map(json.loads, others)):
                report.unlike.append(t_s)
        report.latency_ms, report.lost = summary(self._out)["latency_ms"], lines(self._out, "health.jsonl")[-1]["lost"]
        rows = (self._folder / "log").read_text().splitlines()
        report.log_rows = len(rows)
        report.strange_rows = [row for row in rows if row != "READY" and not row.startswith("time=")]


def live_through(folder: Path, hours: float, pace: float, seed: int) -> Report:
    """Live through a day in a folder."""
    return Day(folder, hours, pace, seed).run()


def main() -> None:
    """Print what came of a day."""
    hours, pace, seed = (*map(float, sys.argv[1:]), *(24.0, 15.0, 1.0)[len(sys.argv) - 1 :])
    with tempfile.TemporaryDirectory() as folder:
        report = live_through(Path(folder), hours, pace, int(seed))
    print(
        f"{report.data_h:g} h of data, {report.lives} lives, deeds {report.counts}, ends in {np.round(report.ends_s, 1)} s"
    )
    print(
        f"windows: {report.windows}, {report.judged} judged; of the replay {report.replayed}, {report.same} the same bytes"
    )
    print(
        f"not as in the replay, outside of kills and full disks: {len(report.unlike)} {np.round(report.unlike[:20], 1)}"
    )
    for name in ("threads", "handles", "memory_mb"):
        values = [getattr(held, name) for _, held in report.samples]
        print(f"{name}: {min(values):.0f} to {max(values):.0f}; most growth in a life {report.growth()[name]:.0f}")
    print(f"latency of the last life: {report.latency_ms}; lost: {report.lost}; messages {report.messages}")
    print(f"log: {report.log_rows} rows; no records: {report.strange_rows[:5]}")


if __name__ == "__main__":
    main()
