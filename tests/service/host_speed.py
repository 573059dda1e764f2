"""Many emulated sites live over Zenoh at real pace: latency, losses, memory and processor of a host.

``python -m tests.service.host_speed --sites 200 60 --rates 100 1024 --seconds 1800 [--workers 2] --out DIR`` starts a router,
processes that emulate the sensors (counted apart) and ``shm-monitor host``, and prints one JSON object.  ``--spread 10`` lets the
streams begin at different moments of ten seconds, as those of a city do.  ``--trouble`` adds three sites that are counted apart:
one is sent garbage, one is flooded for a third of the time, and the sensor of one is killed halfway.  ``--arrivals`` simulates
instead how long the windows of up to 2000 sites wait that are due together, from the measured cost of a block and of a window.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION, SampleBlock
from drivers.recorder import recorded
from monitor.config import Configuration
from monitor.runs import Session
from monitor.service.schedule import Line, Runner
from monitor.service.threads import BlockQueue
from tests.support.frame_text import THREE_STORIES
from tests.support.live_rig import ROOT, Command
from tests.support.simulated import ambient
from tests.support.site import judged_lines, lines
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port

_BLOCK_S = 1.0
_RECORD_S = 200.0
_PER_EMULATOR = 150
_TROUBLE = ("garbage", "flood", "killed")
_TROUBLE_HZ = 100.0
_SITE = """
[site]
name = "{name}"
[source]
kind = "zenoh"
key = "shm/{name}/acceleration"
mode = "client"
connect = ["{router}"]
[output]
dir = "out-{name}"
[processing]
window_s = {window_s}
hop_s = 10.0
[recorder]
min_free_gb = 0.0
"""


def main() -> None:
    """Run the benchmark that the arguments name."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--sites", type=int, nargs="+", default=[20, 6], help="number of sites of each rate")
    options.add_argument("--rates", type=float, nargs="+", default=[100.0, 1024.0], help="rates, Hz")
    options.add_argument("--seconds", type=float, default=120.0, help="length, s")
    options.add_argument("--window", type=float, default=40.0, help="length of a window, s")
    options.add_argument("--workers", type=int, default=1)
    options.add_argument("--out", type=Path, default=Path("out/host"))
    options.add_argument("--spread", type=float, default=1.0, help="seconds in which the streams begin")
    options.add_argument("--trouble", action="store_true")
    options.add_argument("--arrivals", action="store_true")
    options.add_argument("--make-trouble", nargs=3, metavar=("SITE", "ROUTER", "BEGIN_S"), help=argparse.SUPPRESS)
    options.add_argument("--emulate", nargs=4, metavar=("ROUTER", "BEGIN_S", "SHARE", "SHARES"), help=argparse.SUPPRESS)
    given = options.parse_args()
    sites = [(f"s{rate:g}-{k}", rate) for rate, n in zip(given.rates, given.sites, strict=True) for k in range(n)]
    if given.emulate:
        router, begin_s, share, shares = given.emulate
        own = list(enumerate(sites))[int(share) :: int(shares)]
        _emulate(router, float(begin_s), given.seconds, [(n, hz, given.spread * i / len(sites)) for i, (n, hz) in own])
    elif given.make_trouble:
        name, router, begin_s = given.make_trouble
        _make_trouble(name, router, float(begin_s), given.seconds)
    elif given.arrivals:
        print(json.dumps(_arrivals(), indent=1))
    else:
        print(json.dumps(_live(given, sites), indent=1))


def _frame() -> Configuration:
    tables = {**tomllib.loads(THREE_STORIES), "processing": {"window_s": 40.0, "hop_s": 10.0}}
    return Configuration.model_validate(tables)


def _session(router: str) -> Any:
    from drivers.zenoh_session import SessionSettings, open_session

    return open_session(SessionSettings(connect=(router,)), Path())


def _publisher(session: Any, name: str) -> Any:
    import zenoh

    return session.declare_publisher(f"shm/{name}/acceleration", congestion_control=zenoh.CongestionControl.BLOCK)


def _record(rate_hz: float) -> np.ndarray:
    return ambient(_frame().model(), _RECORD_S, rate_hz, 1, noise=0.03).astype(np.float32)


def _block(record: np.ndarray, rate_hz: float, begin_s: float, k: int, first: int = 0) -> SampleBlock:
    """Return block k of a stream; `first` shifts the record, so that sites do not move alike."""
    n = round(rate_hz * _BLOCK_S)
    rows = (np.arange(k * n, (k + 1) * n) + first) % len(record)
    t_ns = round((begin_s + k * _BLOCK_S) * 1e9)
    return SampleBlock(ACCELERATION, t_ns, k * n, rate_hz, ("a1", "a2", "a3"), "m/s^2", record[rows])


def _emulate(router: str, begin_s: float, seconds: float, sites: list[tuple[str, float, float]]) -> None:
    """Send the blocks of some sites (name, rate in Hz, delay of the beginning in s) at real pace."""
    from drivers import codec

    records = {rate: _record(rate) for rate in {rate for _, rate, _ in sites}}
    order, late_s = sorted(range(len(sites)), key=lambda i: sites[i][2] % _BLOCK_S), 0.0
    with _session(router) as session:
        publishers = [_publisher(session, name) for name, _, _ in sites]
        for second in range(round(seconds / _BLOCK_S)):
            for i in order:
                _, rate, delay_s = sites[i]
                k = second - int(delay_s // _BLOCK_S)
                if k < 0:
                    continue
                wait_s = begin_s + delay_s + (k + 1) * _BLOCK_S - time.time()
                late_s = max(late_s, -wait_s)
                time.sleep(max(0.0, wait_s))
                publishers[i].put(codec.encode(_block(records[rate], rate, begin_s + delay_s, k, 997 * i)))
        time.sleep(5.0)
    used = os.times()
    print(json.dumps({"cpu_s": used.user + used.system, "late_s": late_s}), flush=True)


def _make_trouble(name: str, router: str, begin_s: float, seconds: float) -> None:
    """Send what a site must not be sent, or send it too fast, or end without a word."""
    from drivers import codec

    record, draw, sent = _record(_TROUBLE_HZ), np.random.default_rng(1), 0
    until_s = begin_s + seconds
    with _session(router) as session:
        publisher = _publisher(session, name)
        for k in range(round(seconds / _BLOCK_S)):
            time.sleep(max(0.0, begin_s + (k + 1) * _BLOCK_S - time.time()))
            whole = codec.encode(_block(record, _TROUBLE_HZ, begin_s, k))
            if name == "garbage":
                for broken in (b"", whole[: len(whole) // 2], draw.bytes(1000), draw.bytes(1 << 20)):
                    publisher.put(broken)
            elif name == "killed" and k >= 0.5 * seconds / _BLOCK_S:
                os.kill(os.getpid(), signal.SIGKILL)
            elif name == "flood" and k == round(seconds / 3.0 / _BLOCK_S):  # from here on as fast as it is taken
                while time.time() < until_s - seconds / 3.0:
                    publisher.put(codec.encode(_block(record, _TROUBLE_HZ, begin_s, k + sent)))
                    sent += 1
                break
            else:
                publisher.put(whole)
    print(json.dumps({"flood_blocks": sent}), flush=True)


def _processes(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(int(child) for child in children)]


def _used(pid: int) -> dict[str, float]:
    """Processor time (s), memory (MiB; own pages apart) and threads of a process and its children."""
    total: Counter[str] = Counter()
    for one in _processes(pid):
        fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        total["cpu_s"] += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # type: ignore[assignment]
        status = dict(row.split(":", 1) for row in Path(f"/proc/{one}/status").read_text().splitlines())
        for name, key in (("rss_mb", "VmRSS"), ("own_mb", "RssAnon")):
            total[name] += int(status[key].split()[0]) / 1024  # type: ignore[assignment]
        total["threads"] += int(status["Threads"])
    return dict(total)


def _live(given: argparse.Namespace, sites: list[tuple[str, float]]) -> dict[str, Any]:
    out = given.out.resolve()
    out.mkdir(parents=True)
    router = f"tcp/127.0.0.1:{free_port()}"
    process = Router(router)
    for name in [*(name for name, _ in sites), *(_TROUBLE if given.trouble else ())]:
        text = _SITE.format(name=name, router=router, window_s=given.window) + THREE_STORIES
        (out / f"{name}.toml").write_text(text)
    begun_s = time.monotonic()
    host = Command(out / "host.log", "host", out, "--workers", given.workers)
    try:
        until(lambda: "READY" in host.said, "READY", 600.0)
        ready_s = time.monotonic() - begun_s
        before, begin_s = _used(host.pid), time.time() + 8.0
        emulators = _start_emulators(given, router, begin_s, len(sites))
        own = [sys.executable, "-m", "tests.service.host_speed", "--seconds", str(given.seconds), "--make-trouble"]
        trouble = [
            subprocess.Popen([*own, name, router, str(begin_s)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
            for name in (_TROUBLE if given.trouble else ())
        ]
        course = []
        while any(one.poll() is None for one in emulators):
            time.sleep(10.0)
            course.append({"t_s": round(time.time() - begin_s), **_used(host.pid)})
        sent = [json.loads(one.communicate()[0]) for one in emulators]
        told = [one.communicate()[0].strip() for one in trouble]
        after = _used(host.pid)
        code, end_s = host.stop(signal.SIGTERM)
    finally:
        host.kill()
        process.kill()
    cpu = (after["cpu_s"] - before["cpu_s"]) / given.seconds
    return {
        "sites": len(sites), "seconds": given.seconds, "workers": given.workers, "window_s": given.window,
        "ready_s": round(ready_s, 1), "exit": [code, round(end_s, 1)],
        "host_cores": round(cpu, 3), "ms_of_cpu_per_site_and_s": round(1e3 * cpu / len(sites), 2),
        "rss_mb": round(after["rss_mb"]), "own_mb_at_ready": round(before["own_mb"]), "own_mb": round(after["own_mb"]),
        "threads": after["threads"], "emulator_cores": round(sum(s["cpu_s"] for s in sent) / given.seconds, 3),
        "emulators_late_s": round(max(s["late_s"] for s in sent), 2),
        **_outcome(out, sites, given), "trouble": _trouble(out, told), "course": course[:: max(1, len(course) // 20)],
    }  # fmt: skip


def _start_emulators(given: argparse.Namespace, router: str, begin_s: float, count: int) -> list[subprocess.Popen[str]]:
    shares = -(-count // _PER_EMULATOR)
    own = [sys.executable, "-m", "tests.service.host_speed", "--seconds", str(given.seconds)]
    own += ["--sites", *map(str, given.sites), "--rates", *map(str, given.rates), "--spread", str(given.spread)]
    return [
        subprocess.Popen(
            [*own, "--emulate", router, str(begin_s), str(k), str(shares)], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        for k in range(shares)
    ]


def _outcome(out: Path, sites: list[tuple[str, float]], given: argparse.Namespace) -> dict[str, Any]:
    """Latency, losses, and whether one site of each rate is a replay of its own recordings."""
    latency: Counter[str] = Counter()
    most_ms, delays, lost, lines = 0.0, [], Counter[str](), []
    for name, _ in sites:
        folder = out / f"out-{name}"
        ms = json.loads((folder / "summary.json").read_text())["latency_ms"]
        latency.update(ms["windows"])
        most_ms = max(most_ms, ms["max"])
        health = [json.loads(line) for line in (folder / "health.jsonl").read_text().splitlines()]
        delays += [line["delay_s"] for line in health if line["delay_s"] is not None]
        counts = health[-1]["source"]["counts"]
        lost.update({key: counts.get(key, 0) for key in ("lost_samples", "gaps", "undecodable")})
        lost["unrecorded_blocks"] += health[-1]["recorder"]["lost_blocks"]
        lines.append((folder / "results.jsonl").read_bytes().count(b"\n"))
    replays = {}
    for name in {rate: name for name, rate in sites}.values():
        replays[name] = _is_replay(out, name, given.window)
    total, below, shares = sum(latency.values()), 0, {}
    for edge, count in latency.items():
        below += count
        shares[edge] = round(100.0 * below / max(total, 1), 3)
    due = int((given.seconds - given.spread - given.window) // 10.0) + 1
    quantiles = {f"{100 * q:g} %": round(float(np.quantile(delays, q)), 3) for q in (0.5, 0.9, 0.99, 0.999, 1.0)}
    return {
        "windows": total, "windows_a_site": [min(lines), max(lines)], "windows_due": due,
        "arrival_to_line_percent_within_ms": shares, "arrival_to_line_max_ms": most_ms,
        "last_sample_to_evaluation_s": quantiles, "lost": dict(lost), "equals_replay_of_recordings": replays,
    }  # fmt: skip


def _trouble(out: Path, told: list[str]) -> dict[str, Any]:
    """What became of the sites in trouble."""
    found: dict[str, Any] = {}
    for name, said in zip(_TROUBLE if told else (), told, strict=True):
        folder = out / f"out-{name}"
        health = [json.loads(line) for line in (folder / "health.jsonl").read_text().splitlines()]
        results = folder / "results.jsonl"
        found[name] = {
            "said": said,
            "windows": results.read_bytes().count(b"\n") if results.exists() else 0,
            "counts": health[-1]["source"]["counts"],
            "failed": health[-1].get("failed"),
        }
    return found


def _is_replay(out: Path, name: str, window_s: float) -> bool:
    kept = judged_lines(out / f"{name}.toml", [block for _, block in recorded(out / f"out-{name}" / "recordings", 0)])
    return lines(out / f"out-{name}") == kept


def _costs(rate_hz: float, sessions: int = 5) -> tuple[float, float]:
    """Processor time of a block without and with a window, s, in memory that other sites used meanwhile."""
    record, many = _record(rate_hz), [Session(_frame(), None, (), None, Path()) for _ in range(sessions)]
    plain: list[float] = []
    window: list[float] = []
    for k in range(round(_RECORD_S / _BLOCK_S)):
        for session in many:
            block = _block(record, rate_hz, 0.0, k)
            windows, begun_s = session.windows, time.thread_time()
            session.push(block)
            (window if session.windows > windows else plain).append(time.thread_time() - begun_s)
    return float(np.mean(plain)), float(np.mean(window[sessions:]))


def _arrivals(overhead_s: float = 1.3e-3) -> dict[str, Any]:
    """Simulate the line of sites whose windows are all due at once every 10 s; the clock is that of the simulation."""
    found: dict[str, Any] = {"overhead_ms_a_block": 1e3 * overhead_s}
    for rate_hz in (100.0, 1024.0):
        plain_s, window_s = _costs(rate_hz)
        found[f"{rate_hz:g} Hz"] = {
            "block_ms": round(1e3 * plain_s, 3), "window_ms": round(1e3 * window_s, 3),
            "sites": {n: _waits(n, plain_s + overhead_s, window_s + overhead_s) for n in (10, 50, 100, 200, 400, 1000, 2000)},
        }  # fmt: skip
    return found


def _waits(sites: int, plain_s: float, window_s: float, hops: int = 6) -> dict[str, float]:
    """Waits of the windows of a number of sites on one core, s; blocks come together, once a second."""
    empty = np.zeros((1, 1), np.float32)
    line, now_s, waits = Line(), 0.0, []
    no_site: Any = None
    places = [Runner(str(k), no_site, BlockQueue(1 << 20), lambda: None) for k in range(sites)]
    for second in range(10 * hops):
        for place in places:
            block = SampleBlock(ACCELERATION, second, 0, 1.0, ("a",), "m/s^2", empty)
            place.queue.put(block)
            line.join(place)
        now_s = max(now_s, float(second))
        while (now_s < second + 1 or second == 10 * hops - 1) and (place := line.next()) is not None:
            item = place.queue.take(0.0)
            arrived_s, is_window = float(item[0].t_ns), item[0].t_ns % 10 == 9  # by the clock of the simulation
            cost_s = window_s if is_window else plain_s
            now_s += cost_s
            if is_window:
                waits.append(now_s - arrived_s)
            line.spend(place, arrived_s, 1.0, cost_s)
            line.join(place)
    load = (9 * plain_s + window_s) / 10 * sites
    return {
        "cores": round(load, 3),
        "median_s": round(float(np.median(waits)), 3),
        "p99_s": round(float(np.quantile(waits, 0.99)), 3),
        "max_s": round(max(waits), 3),
    }


if __name__ == "__main__":
    main()
