"""Processes that talk as on a site: daemon, emulated nodes, router; their files, and what the kernel says of them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from monitor.config import configuration
from monitor.model import simulate
from monitor.runs import cut_into_blocks, synthetic_recording
from tests.support.mosquitto import Broker
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
KEY = "shm/lab-frame/acceleration"
RATE_HZ = 1024.0
FACTOR = 0.001
"""Of deploy/frame.dbc, m/s^2."""
T0_NS = 1_767_225_600_000_000_000
PATIENCE_S = 60.0
_RMS = 4.0
"""Of every recording, m/s^2: its peaks fit the DBC's range."""
_TICKS = os.sysconf("SC_CLK_TCK")


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}


class Command:
    """``shm-monitor ARGUMENTS`` as a process of its own; what it says goes to a file."""

    def __init__(self, log: Path, *arguments: object) -> None:
        self._log = log
        with log.open("wb") as said:
            command = [sys.executable, "-m", "monitor", *map(str, arguments)]
            self.process = subprocess.Popen(command, stdout=said, stderr=said, cwd=ROOT, env=_environment())

    @property
    def said(self) -> str:
        """Everything so far."""
        return self._log.read_text(errors="replace")

    def wait_for(self, text: str) -> None:
        """Until it has said that."""
        until(lambda: text in self.said or self.process.poll() is not None, f"{text!r} in {self._log}")
        assert text in self.said, self.said

    def finish(self, patience_s: float) -> None:
        """Until it ends by itself, with success."""
        assert self.process.wait(patience_s) == 0, self.said

    def stop(self, number: int = signal.SIGTERM) -> tuple[int, float]:
        """Exit code after a signal, and how long it took, s."""
        begun = time.monotonic()
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S), time.monotonic() - begun

    def kill(self) -> None:
        """End it at once, if it still runs."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    @property
    def cpu_s(self) -> float:
        """Time of this process alone on any core."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    @property
    def rss_mb(self) -> float:
        """Memory in use, MiB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def shm_monitor(*arguments: object) -> str:
    """Run a command to its end."""
    command = [sys.executable, "-m", "monitor", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=_environment(), check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@dataclass(frozen=True)
class Site:
    """One daemon's files, from those in deploy/."""

    path: Path
    kind: str
    port: int

    @property
    def out(self) -> Path:
        """Where the daemon writes."""
        return self.path.parent / f"out-{self.kind}"

    @property
    def recordings(self) -> list[Path]:
        """What the daemon recorded."""
        return sorted((self.out / "recordings").glob("*.mcap"))

    @property
    def destination(self) -> list[object]:
        """Options of ``emulate``."""
        if self.kind == "can":
            return ["--to", f"can:socketcand-server:127.0.0.1:{self.port}", "--dbc", DEPLOY / "frame.dbc"]
        if self.kind == "mqtt":
            return ["--to", f"mqtt:127.0.0.1:{self.port}:{KEY}"]
        return ["--to", f"zenoh:client:tcp/127.0.0.1:{self.port}:{KEY}"]

    @property
    def results(self) -> list[dict[str, Any]]:
        """Lines of results.jsonl so far; half a line is left out."""
        file = self.out / "results.jsonl"
        whole = file.read_bytes().rpartition(b"\n")[0] if file.exists() else b""
        return [json.loads(line) for line in whole.splitlines()]

    @property
    def health(self) -> dict[str, Any]:
        """The latest line of health.jsonl."""
        whole = (self.out / "health.jsonl").read_bytes().rpartition(b"\n")[0]
        return dict(json.loads(whole.splitlines()[-1]))

    @property
    def summary(self) -> dict[str, Any]:
        """summary.json."""
        return dict(json.loads((self.out / "summary.json").read_text()))

    def run(self) -> Command:
        """The daemon."""
        return Command(self.path.with_suffix(".log"), "run", self.path)

    def replayed(self, recordings: list[Path], name: str) -> bytes:
        """results.jsonl of a replay."""
        out = self.path.parent / f"{name}-{self.kind}"
        given = tomlkit.parse(self.path.read_text()).get("site", {}).get("baseline")
        baseline = ["--baseline", self.path.parent / given] if given else []
        quiet = self.path.with_name(f"replay-{self.kind}.toml")
        table = tomlkit.parse(self.path.read_text())
        table["watch"] = {"diagnose": False}
        quiet.write_text(tomlkit.dumps(table))
        shm_monitor("replay", *recordings, "--structure", quiet, *baseline, "--out", out)
        return (out / "results.jsonl").read_bytes()


def make_site(folder: Path, kind: str, processing: dict[str, float], **tables: dict[str, Any]) -> Site:
    """The site file that deploy/ ships for `kind`, on a free port, with other windows."""
    port = free_port()
    table: Any = tomlkit.parse((DEPLOY / f"{kind}.toml").read_text())
    if kind == "can":
        table["source"] |= {"options": {"host": "127.0.0.1", "port": port}, "dbc": str(DEPLOY / "frame.dbc")}
    elif kind == "mqtt":
        table["source"]["port"] = port
        table["output"]["mqtt"] = {"host": "127.0.0.1", "port": port}
    else:
        table["source"]["connect"] = [f"tcp/127.0.0.1:{port}"]
        table["output"]["zenoh"] = {"mode": "client", "connect": [f"tcp/127.0.0.1:{port}"]}
    table["output"]["dir"] = f"out-{kind}"
    table["processing"] = processing
    table["recorder"] = {"min_free_gb": 0.0}
    for name, more in tables.items():
        table[name] = {**table.get(name, {}), **more}
    site = Site(folder / f"{kind}.toml", kind, port)
    site.path.write_text(tomlkit.dumps(table))
    return site


def blocks(seconds: float, seed: int, *damage: str) -> list[SampleBlock]:
    """A simulated stream of the shipped site file's frame whose amplitudes the DBC can carry."""
    settings = configuration.load(DEPLOY / "can.toml")
    model = settings.model()
    model = replace(model, effects=(*model.effects, *map(synthetic_recording.parse_damage, damage)))
    floors = simulate(model, duration_s=seconds, rate_hz=RATE_HZ, noise=0.03, seed=seed).floors
    floors *= _RMS / np.sqrt(np.mean(floors**2))
    return list(cut_into_blocks(ACCELERATION, floors, settings.channels, RATE_HZ, T0_NS, 1024))


def quantised(stream: list[SampleBlock]) -> list[SampleBlock]:
    """As the DBC carries it."""
    return [replace(b, samples=(np.rint(b.samples.astype(float) / FACTOR) * FACTOR).astype(np.float32)) for b in stream]


def write(path: Path, stream: list[SampleBlock]) -> Path:
    """A recording of them."""
    with McapWriter(path) as writer:
        for block in stream:
            writer.write(block)
    return path


def samples(recordings: list[Path]) -> int:
    """How many of `/acceleration` they hold."""
    return sum(b.n_samples for b in read_recordings(recordings) if b.topic == ACCELERATION)


@contextmanager
def router_for(site: Site) -> Iterator[Router | Broker | None]:
    """What lies between nodes and daemon, if anything."""
    router: Router | Broker | None = None
    if site.kind == "zenoh":
        router = Router(f"tcp/127.0.0.1:{site.port}")
    elif site.kind == "mqtt":
        router = Broker(site.path.parent / "broker", port=site.port)
    try:
        yield router
    finally:
        if router is not None:
            router.kill()
