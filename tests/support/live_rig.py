"""Processes that talk as on a site: daemon, emulated nodes, router; their files, and what the kernel says of them."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from monitor.cli import main
from monitor.config import configuration
from monitor.model import simulate
from monitor.runs import cut_into_blocks, synthetic_recording
from tests.support.forked import ROOT, Forked
from tests.support.mosquitto import Broker
from tests.support.zenoh_router import Router, free_port

DEPLOY = ROOT / "deploy"
KEY = "shm/lab-frame/acceleration"
RATE_HZ = 1024.0
FACTOR = 0.001
"""Of deploy/frame.dbc, m/s^2."""
T0_NS = 1_767_225_600_000_000_000
_RMS = 4.0
"""Of every recording, m/s^2: its peaks fit the DBC's range."""


def call(*words: str) -> None:
    """Do what the command line says."""
    sys.argv = ["shm-monitor", *words]
    main()


class Command(Forked):
    """``shm-monitor ARGUMENTS`` as a process of its own; what it says replaces the content of a file."""

    def __init__(self, log: Path, *arguments: object) -> None:
        log.write_bytes(b"")
        super().__init__(log, call, *map(str, arguments))


def shm_monitor(*arguments: object) -> None:
    """Run a command to its end."""
    with tempfile.TemporaryDirectory() as folder, Command(Path(folder) / "log", *arguments) as command:
        command.finish(600.0)


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


def blocks(seconds: float, seed: int, *damage: str, size: int = 1024) -> list[SampleBlock]:
    """A simulated stream of the shipped site file's frame whose amplitudes the DBC can carry."""
    settings = configuration.load(DEPLOY / "can.toml")
    model = settings.model()
    model = replace(model, effects=(*model.effects, *map(synthetic_recording.parse_damage, damage)))
    floors = simulate(model, duration_s=seconds, rate_hz=RATE_HZ, noise=0.03, seed=seed).floors
    floors *= _RMS / np.sqrt(np.mean(floors**2))
    return list(cut_into_blocks(ACCELERATION, floors, settings.channels, RATE_HZ, T0_NS, size))


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
