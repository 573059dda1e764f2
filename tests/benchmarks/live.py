"""Emulator and daemon as two processes on this machine, over CAN (socketcand on loopback), Zenoh (a router) or MQTT (a broker).

Run: ``python tests/benchmarks/live.py [can|zenoh|mqtt] [--seconds 600] [--speed 1]``; without a kind the first two at once.
Three channels at 1024 Hz with a baseline and a loss of stiffness, so that an alarm asks for a diagnosis on the way.  Prints a
line of figures for each kind; exit code 1 if one is beyond its bound.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import tomlkit

ROOT = Path(__file__).resolve().parents[2]
sys.path = [str(ROOT), *(p for p in sys.path if p != str(Path(__file__).parent))]

from tests.support.live_rig import (  # noqa: E402
    Command,
    Site,
    blocks,
    make_site,
    quantised,
    router_for,
    samples,
    shm_monitor,
    write,
)  # fmt: skip
from tests.support.waiting import until  # noqa: E402

MOST_CPU_PERCENT = 10.0
MOST_LATENCY_MS = 100.0
CALIBRATION_S = 600.0


def measure(
    folder: Path, kind: str, *, seconds: float, speed: float, window_s: float, calibration_s: float
) -> dict[str, Any]:
    """Stream a recording, stop the daemon, compare what it said with replays."""
    processing = {"window_s": window_s, "hop_s": 5.0}
    site = make_site(folder, kind, processing, site={"baseline": "baseline.json"})
    healthy = write(folder / "healthy.mcap", blocks(calibration_s, 1))
    shm_monitor("calibrate", healthy, "--structure", _unjudged(site), "--out", folder / "baseline.json")
    stream = blocks(seconds, 2, "story2=0.08")
    sent = write(folder / "sent.mcap", stream)
    truth = write(folder / "truth.mcap", quantised(stream)) if kind == "can" else sent
    wanted = site.replayed([truth], "source")
    with router_for(site):
        told = stream_through(site, sent, seconds, speed, wanted.count(b"\n"))
    live = (site.out / "results.jsonl").read_bytes()
    summary = site.summary
    recorded = samples(site.recordings)
    total = sum(b.n_samples for b in stream)
    return {
        "kind": kind,
        "seconds": seconds,
        "speed": speed,
        "windows": live.count(b"\n"),
        "judged": summary["windows"] - summary["skipped"],
        "equal_to_replay_of_source": live == wanted,
        "equal_to_replay_of_own_recordings": live == site.replayed(site.recordings, "own"),
        "sent": total,
        "lost": total - recorded,
        "gaps": summary["gaps"],
        "latency_ms": {key: summary["latency_ms"][key] for key in ("median", "max")},
        "alarms": len(summary["alarms"]),
        "findings": len(summary["findings"]),
        **told,
    }


def _unjudged(site: Site) -> Path:
    """The site file without its baseline, which is yet to be made."""
    table: Any = tomlkit.parse(site.path.read_text())
    del table["site"]["baseline"]
    path = site.path.with_name(f"calibrate-{site.kind}.toml")
    path.write_text(tomlkit.dumps(table))
    return path


def stream_through(site: Site, sent: Path, seconds: float, speed: float, windows: int) -> dict[str, Any]:
    """Emulator and daemon for the length of the recording; what the kernel says of the daemon."""
    play = ("emulate", sent, *site.destination, "--speed", speed)
    patience_s = seconds / speed + 60.0
    nodes = Command(site.path.parent / f"nodes-{site.kind}.log", *play) if site.kind == "can" else None
    if nodes is not None:
        nodes.wait_for("waiting for a client")
    daemon = site.run()
    try:
        daemon.wait_for("READY")
        nodes = nodes or Command(site.path.parent / f"nodes-{site.kind}.log", *play)
        begun, before = time.monotonic(), daemon.cpu_s
        nodes.finish(patience_s)
        until(lambda: len(site.results) >= windows, f"{windows} windows of {site.kind}", 30.0)
        cpu_percent = 100.0 * (daemon.cpu_s - before) / (time.monotonic() - begun)
        rss_mb = daemon.rss_mb
        code, took_s = daemon.stop()
    finally:
        daemon.kill()
        if nodes is not None:
            nodes.kill()
    told = {"cpu_percent": cpu_percent, "rss_mb": rss_mb, "exit_code": code, "stopped_in_s": took_s}
    return {name: round(value, 2) for name, value in told.items()}


def wrong(found: dict[str, Any]) -> list[str]:
    """Bounds that are missed."""
    checks = {
        "results are not those of the source": not found["equal_to_replay_of_source"],
        "results are not those of the own recordings": not found["equal_to_replay_of_own_recordings"],
        "samples lost": found["lost"] != 0 or found["gaps"] != 0,
        f"more than {MOST_CPU_PERCENT:g} % of a core": found["cpu_percent"] >= MOST_CPU_PERCENT * found["speed"],
        f"latency beyond {MOST_LATENCY_MS:g} ms": found["latency_ms"]["max"] >= MOST_LATENCY_MS,
        "did not end with 0 within 5 s": found["exit_code"] != 0 or found["stopped_in_s"] >= 5.0,
    }
    return [name for name, missed in checks.items() if missed]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="?", choices=("can", "zenoh", "mqtt"), help="the first two without")
    for name, default, of in (
        ("seconds", 600.0, "of data"),
        ("speed", 1.0, "times real time"),
        ("window_s", 200.0, "of a window"),
        ("calibration_s", CALIBRATION_S, "of healthy data"),
    ):
        parser.add_argument(f"--{name.removesuffix('_s')}", dest=name, type=float, default=default, help=of)
    options = vars(parser.parse_args(arguments))
    chosen = options.pop("kind")
    kinds = ("can", "zenoh") if chosen is None else (chosen,)
    with tempfile.TemporaryDirectory(prefix="shm-live-") as folder, ThreadPoolExecutor() as pool:
        for kind in kinds:
            (Path(folder) / kind).mkdir()
        found = list(pool.map(lambda kind: measure(Path(folder) / kind, kind, **options), kinds))
    for figures in found:
        print(json.dumps({**figures, "wrong": wrong(figures)}), flush=True)
    return int(any(wrong(figures) for figures in found))


if __name__ == "__main__":
    raise SystemExit(main())
