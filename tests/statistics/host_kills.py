"""Workers of a host killed again and again: windows, alarms and messages beside those of an undisturbed `run`.

``python -m tests.statistics.host_kills --kills 50 --out DIR`` plays recordings in which a story softens and recovers, and kills
one of two workers at random moments.  With ``--machines`` it is one of two hosts with folders of their own, which share nothing
but object storage (moto's server), and comes back to stand by.  It prints one JSON object: lines that differ, messages that are
lost, by their numbers, and those that came again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import signal
import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION
from monitor.runs import cut_into_blocks
from tests.support.frames import settings_of
from tests.support.live_rig import Command, shm_monitor, write
from tests.support.object_storage import object_storage
from tests.support.samples import CHANNELS, FRAME, T0_NS
from tests.support.simulated import ambient
from tests.support.waiting import until

_RATE = 128.0
_SITES = 4
_SITE = """
[site]
name = "{name}"
baseline = "../baseline.json"
[source]
kind = "mcap"
files = ["../{name}.mcap"]
{speed}
[output]
dir = "out-{name}"
{store}
[recorder]
min_free_gb = 0.0
flush_s = 1.0
[watch]
diagnose = false
[state]
checkpoint_s = 20.0
[notify]
urls = ["json://127.0.0.1:{port}"]
most_per_hour = 1000
"""
_STORE = 'store = "s3://city/sites"\nstore_every_s = 2.0'


class Sink:
    """Address that takes messages: who sent which number with which words, in the order in which they came."""

    def __init__(self) -> None:
        self.taken: list[tuple[str, int, str]] = []
        sink = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                found = re.search(r"site (\S+), message (\d+)", body["message"])
                sink.taken.append((found[1], int(found[2]), body["title"]))
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()


def main() -> None:
    """Run, kill and compare."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--kills", type=int, default=50)
    options.add_argument("--every", type=float, default=6.0, help="mean time between kills, s")
    options.add_argument("--machines", action="store_true", help="kill one of two hosts that share object storage")
    options.add_argument("--out", type=Path, default=Path("out/kills"))
    given = options.parse_args()
    out = given.out.resolve()
    out.mkdir(parents=True)
    start_s = 20.0 if given.machines else 0.0  # in which the machine that was killed comes back
    seconds = 4.0 * given.kills * (given.every + start_s) + 120.0
    _record(out, seconds)
    calm, killed = Sink(), Sink()
    names = [f"s{k}" for k in range(_SITES)]
    hosts = ("a", "b") if given.machines else ("host",)
    for folder in ("run", *hosts):
        (out / folder).mkdir()
        sink, speed = (calm, "") if folder == "run" else (killed, "speed = 4.0")
        store = _STORE if folder in {"a", "b"} else ""
        for name in names:
            text = _SITE.format(name=name, speed=speed, port=sink.port, store=store) + FRAME
            (out / folder / f"{name}.toml").write_text(text)
    for name in names:
        shm_monitor("run", out / "run" / f"{name}.toml")
    if given.machines:
        with object_storage("city"):
            kills, away, last = _kill_machines(out, given.kills, given.every)
    else:
        host = Command(out / "host.log", "host", *sorted((out / "host").glob("*.toml")), "--workers", 2)
        kills, away = _kill(host, given.kills, given.every)
        host.finish(seconds)
        last = "host"
    time.sleep(2.0)
    found = {"kills": kills, "seconds_of_data_a_site": seconds, "sites": _SITES, "away_s": away}
    print(json.dumps({**found, **_compare(out, names, killed, last)}, indent=1))


def _record(out: Path, seconds: float) -> None:
    """Write healthy data for the baseline, and for each site data in which story 2 softens every few minutes."""
    (out / "s.toml").write_text(FRAME)
    sound, weak = (settings_of(text).model() for text in (FRAME, FRAME.replace("1514.8507", "900.0")))
    parts = {
        k: ambient(model, length, _RATE, k, noise=0.03)
        for k, (model, length) in enumerate(((sound, 400.0), (sound, 120.0), (weak, 120.0)))
    }
    course = np.tile(np.concatenate([parts[1], parts[2]]), (int(seconds // 240.0) + 1, 1))[: round(seconds * _RATE)]
    streams = {"healthy": parts[0]} | {f"s{k}": np.roll(course, 1000 * k, axis=0) for k in range(_SITES)}
    for name, floors in streams.items():
        write(out / f"{name}.mcap", list(cut_into_blocks(ACCELERATION, floors, CHANNELS, _RATE, T0_NS, 64)))
    shm_monitor("calibrate", out / "healthy.mcap", "--structure", out / "s.toml", "--out", out / "baseline.json")


def _children(host: Command) -> list[int]:
    pid = host.pid
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _kill(host: Command, kills: int, every_s: float) -> tuple[int, dict[str, float]]:
    """Kill a worker at random moments; return how often, and how long it was until another process had its place, s."""
    chance, away = random.Random(1), []
    host.wait_for("READY")
    for _ in range(kills):
        time.sleep(chance.uniform(0.3, 1.7) * every_s)
        before = _children(host)
        if len(before) < 2 or host.code is not None:
            break
        victim, begun_s = chance.choice(before), time.monotonic()
        os.kill(victim, signal.SIGKILL)
        until(
            lambda victim=victim: len(_children(host)) == 2 and victim not in _children(host), "another process", 120.0
        )  # type: ignore[misc]
        away.append(time.monotonic() - begun_s)
    return len(away), {"median": round(float(np.median(away)), 2), "max": round(max(away), 2)}


def _kill_machines(out: Path, kills: int, every_s: float) -> tuple[int, dict[str, float], str]:
    """Kill the host that has the sites, again and again, and let it come back to stand by.

    Returns how often, how long it was until the other one had written a line of each site, s, and which had the sites last.
    """
    chance, away = random.Random(1), []

    def begin(name: str, number: int) -> Command:
        return Command(out / f"{name}-{number}.log", "host", out / name, "--standby")

    def lines(name: str) -> list[int]:
        files = [out / name / f"out-s{k}" / "results.jsonl" for k in range(_SITES)]
        return [file.stat().st_size if file.exists() else 0 for file in files]

    has, waits = "a", "b"
    hosts = {has: begin(has, 0)}
    until(lambda: all(lines(has)), "lines of all sites", 120.0)
    hosts[waits] = begin(waits, 0)
    hosts[waits].wait_for("READY")
    for number in range(1, kills + 1):
        time.sleep(chance.uniform(0.3, 1.7) * every_s)
        before, begun_s = lines(has), time.monotonic()
        hosts[has].stop(signal.SIGKILL)
        until(
            lambda before=before, name=waits: all(n > m for n, m in zip(lines(name), before, strict=True)),  # type: ignore[misc]
            "the other one goes on with all sites",
            180.0,
        )
        away.append(time.monotonic() - begun_s)
        hosts[has] = begin(has, number)
        hosts[has].wait_for("READY")
        has, waits = waits, has
    ends = [len((out / "run" / f"out-s{k}" / "results.jsonl").read_bytes()) for k in range(_SITES)]
    until(lambda: lines(has) == ends, "all lines", 1e5)
    for host in hosts.values():
        host.stop()
    return len(away), {"median": round(float(np.median(away)), 1), "max": round(max(away), 1)}, has


def _compare(out: Path, names: list[str], killed: Sink, host: str) -> dict[str, Any]:
    """Compare windows, alarms and messages with those of the folder of a host."""
    differing = {}
    for name in names:
        files = [(out / folder / f"out-{name}" / "results.jsonl").read_text().splitlines() for folder in ("run", host)]
        differing[name] = sum(a != b for a, b in zip(*files, strict=False)) + abs(len(files[0]) - len(files[1]))
    alarms = {
        folder: [json.loads((out / folder / f"out-{name}" / "summary.json").read_text())["alarms"] for name in names]
        for folder in ("run", host)
    }
    numbers = {folder: {name: outbox(out / folder / f"out-{name}") for name in names} for folder in ("run", host)}
    told = dict.fromkeys(killed.taken)
    words = Counter((site, number) for site, number, _ in told)
    lost = {}
    for name in names:
        last, waiting = numbers[host][name]
        lost[name] = sorted(set(range(1, last + 1)) - waiting - {n for site, n, _ in told if site == name})
    return {
        "lines_that_differ": differing,
        "alarm_episodes": sum(map(len, alarms["run"])),
        "alarm_episodes_equal": alarms["run"] == alarms[host],
        "messages_of_run": {name: numbers["run"][name][0] for name in names},
        "messages_of_host": {name: numbers[host][name][0] for name in names},
        "numbers_lost": lost,
        "repeats_with_their_number": len(killed.taken) - len(told),
        "numbers_used_for_other_words": sum(n > 1 for n in words.values()),
    }


def outbox(folder: Path) -> tuple[int, set[int]]:
    """Read from a site's output folder how many messages there were, and which still wait."""
    head, *rows = (folder / "state" / "outbox.jsonl").read_text().splitlines()
    return json.loads(head)["next_id"] - 1, {json.loads(row)["id"] for row in rows}


if __name__ == "__main__":
    main()
