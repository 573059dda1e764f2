"""A year of the whole service, and two days of raw samples: memory, disk, false alarms.

    .venv/bin/python -m tests.statistics.year twin [DAYS] [FOLDER]
    .venv/bin/python -m tests.statistics.year raw [HOURS] [FOLDER]

`twin`: the daemon as it runs on a site, with recorder, checkpoints, history, metrics and notifications; only its pipeline is
another: the reading of every window (one each 10 s) is drawn from `alarm_twin` and judged by the alarm at its default settings;
a gap a day makes forty windows say nothing.  Every output is written.  `raw`: the daemon with its own pipeline on an hour of
simulated samples (128 Hz, 3 channels) over and over, as fast as it can.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, EndOfStream, SampleBlock, SourceHealth
from monitor.config import configuration
from monitor.core import Gap, Skipped, WindowResult
from monitor.damage import alarm, load_baseline, save_baseline
from monitor.pipeline import Pipeline, Result
from monitor.publish import Publisher
from monitor.runs import Session, calibrate, cut_into_blocks
from monitor.service import logs
from monitor.signals import Health
from tests.damage.alarm_twin import HOP_S, TWIN, WINDOW, WINDOW_S
from tests.support.frame_text import THREE_STORIES
from tests.support.live_rig import ROOT, write
from tests.support.live_site import RATE, SIZE, given
from tests.support.simulated import ambient
from tests.support.site import Daemon

T0_NS, DAY = 1_767_225_600_000_000_000, round(86_400 / HOP_S)
BASELINE_S = 4 * 3600.0
SITE = (
    """
[site]
name = "year"
baseline = "baseline.json"

[source]
kind = "mcap"
files = ["none.mcap"]

[output]
dir = "out"

[output.metrics]
listen = "127.0.0.1:0"

[watch]
diagnose = false

[recorder]
keep_gb = {keep_gb}
min_free_gb = 0.5

[log]
level = "error"

"""
    + THREE_STORIES
)


def rss_mb(pid: int | str = "self") -> float:
    """Memory in use, MiB."""
    return int(Path(f"/proc/{pid}/status").read_text().partition("VmRSS:")[2].split()[0]) / 1024


def make_site(folder: Path, keep_gb: float) -> tuple[Path, list[SampleBlock]]:
    """A site with a baseline, and twenty minutes of its healthy samples."""
    site = folder / "site.toml"
    site.write_text(SITE.format(keep_gb=keep_gb))
    settings = configuration.load(site)
    floors = ambient(settings.model(), 1200.0, RATE, 1)
    healthy = list(cut_into_blocks(ACCELERATION, floors, settings.channels, RATE, T0_NS, 1024))
    save_baseline(calibrate.calibrate([write(folder / "healthy.mcap", healthy)], settings)[0], folder / "baseline.json")
    return site, healthy


@dataclass(frozen=True)
class Growth:
    """Memory over time; the first tenth, in which caches fill, is left out."""

    days: np.ndarray
    mb: np.ndarray

    def __str__(self) -> str:
        late = self.days >= self.days[-1] / 10
        slope = np.polyfit(self.days[late], self.mb[late], 1)[0]
        return (
            f"memory: {self.mb[0]:.0f} MB at first, {self.mb[late][0]:.0f} after a tenth, {self.mb[-1]:.0f} at the end, "
            f"most {self.mb.max():.0f}; {slope:+.3f} MB a day"
        )


def disk(out: Path, days: float) -> str:
    """Bytes by file."""
    sizes: dict[str, int] = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        name = path.parent.name if path.parent.name == "recordings" else path.name
        sizes[name] = sizes.get(name, 0) + path.stat().st_size
    rows = (f"  {name:<24} {size / 1e6:9.2f} MB, {size / 1e6 / days:9.3f} a day" for name, size in sizes.items())
    return "\n".join(["disk:", *rows])


# --- the twin ----------------------------------------------------------------------------------------------------------


class TwinPipeline(Pipeline):
    """Judges readings that are drawn, not estimated; a block is a hop."""

    like: WindowResult
    health: Health
    readings: tuple[np.ndarray, np.ndarray, np.ndarray]

    def push(self, block: SampleBlock) -> list[Result]:
        """One window and one span of health; once a day a gap."""
        k = block.sequence // 10
        t_ns = block.t_ns + round(HOP_S * 1e9)
        span = replace(self.health, t_ns=block.t_ns, t_end_ns=t_ns)
        results: list[Result] = [span]
        if k % DAY == DAY - WINDOW:
            results.append(Gap(block.t_ns, 1.0, "a gap a day"))
        if k % DAY >= DAY - WINDOW:
            return [*results, self._skip(k, t_ns, WINDOW_S - 1.0, Skipped("gap in the data"))]
        ddi, variance, common = self.readings
        assert self.like.damage is not None
        reading = replace(
            self.like.damage,
            loss=ddi[k],
            covariance=np.diag(variance[k] + common),
            common_covariance=np.diag(common),
        )
        alarms, verdict = alarm.step(self.state.alarm, reading, t_ns, self.config.alarm)
        self.state = replace(self.state, alarm=alarms)
        return [*results, replace(self.like, index=k, t_end_ns=t_ns, damage=reading, alarm=verdict)]


class Hops:
    """A block of ten numbers a hop, as fast as they are taken; notes the memory once a day."""

    def __init__(self, hops: int) -> None:
        self._hops, self.given = hops, 0
        self.mb: list[float] = []
        self._begun = time.monotonic()

    def open(self) -> None: ...

    def read(self, timeout_s: float) -> SampleBlock | None:
        if self.given == self._hops:
            raise EndOfStream
        k, self.given = self.given, self.given + 1
        if k % DAY == 0:
            self.mb.append(rss_mb())
            if k and k // DAY % 10 == 0:
                print(f"day {k // DAY}: {rss_mb():.0f} MB, {time.monotonic() - self._begun:.0f} s", flush=True)
        values = np.full((10, 3), k, np.float32)
        return SampleBlock(ACCELERATION, T0_NS + k * 10**10, 10 * k, 1.0, ("a1", "a2", "a3"), "m/s^2", values)

    def health(self) -> SourceHealth:
        return SourceHealth(True, {"blocks": self.given})

    def close(self) -> None:
        self._hops = self.given  # nothing is on its way


def twin(days: int, folder: Path, seed: int = 20261121) -> None:
    """Windows drawn, everything else as on a site."""
    site, healthy = make_site(folder, keep_gb=0.02)
    settings = configuration.load(site)
    seen: list[Any] = []

    class Kept(Publisher):
        def window(self, result: WindowResult, line: str) -> None:
            seen.append(result)

        def health(self, health: Health) -> None:
            seen.append(health)

    baseline = load_baseline(folder / "baseline.json", settings.instrumented(), settings.updating)
    session = Session(settings, baseline, (Kept(),), None, folder)
    for block in healthy:
        session.push(block)
    like = next(r for r in seen if isinstance(r, WindowResult) and r.damage is not None)
    TwinPipeline.like = like
    TwinPipeline.health = next(r for r in seen if isinstance(r, Health))
    TwinPipeline.readings = TWIN.readings(days * DAY, BASELINE_S, np.random.default_rng(seed))
    logs.begin(settings.log, settings.site_name)
    source, begun = Hops(days * DAY), time.monotonic()
    daemon = Daemon(site, source)
    daemon.session.pipeline = TwinPipeline(settings, baseline)
    daemon.run()
    content = daemon.session.content(0.0)
    passed = source.given / DAY  # SIGTERM ends it before
    print(f"{passed:.1f} days, {content['windows']} windows, {content['skipped']} skipped, {content['gaps']} gaps")
    print(f"false alarms of any level at the default setting: {len(content['alarms'])}")
    print(Growth(np.arange(len(source.mb), dtype=float), np.array(source.mb)))
    print(f"rows lost by the history: {dict(daemon.outputs())['history'].dropped}")
    print(f"{time.monotonic() - begun:.0f} s\n{disk(folder / 'out', passed)}")


# --- raw samples -------------------------------------------------------------------------------------------------------


def raw(hours: float, folder: Path) -> None:
    """The daemon as a process on samples."""
    site, _ = make_site(folder, keep_gb=0.1)
    settings = configuration.load(site)
    np.save(folder / "stream.npy", ambient(settings.model(), 3600.0, RATE, 2).astype(np.float32))
    position, begun = folder / "position", time.monotonic()
    arguments = [site, folder / "stream.npy", position, 0, 0]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with (folder / "log").open("wb") as log:
        command = [sys.executable, "-m", "tests.support.live_site", *map(str, arguments)]
        process = subprocess.Popen(command, stderr=log, cwd=ROOT, env=environment)
    times, mb = [], []
    while (seconds := given(position) * SIZE / RATE) < hours * 3600.0:
        assert process.poll() is None, (folder / "log").read_text()
        if seconds and (not times or seconds / 86_400 - times[-1] > 0.01):
            times.append(seconds / 86_400)
            mb.append(rss_mb(process.pid))
        time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    code, wall_s = process.wait(60.0), time.monotonic() - begun
    windows = (folder / "out" / "results.jsonl").read_bytes().count(b"\n")
    said = (folder / "out" / "summary.json").read_text()
    print(f"{hours:g} h of samples in {wall_s:.0f} s, {windows} windows, exit code {code}")
    print(f"false alarms: {said.count('t_first_ns')}")
    print(Growth(np.array(times), np.array(mb)))
    print(disk(folder / "out", hours / 24))


if __name__ == "__main__":
    kind, *rest = sys.argv[1:]
    place = Path(rest[1]) if len(rest) > 1 else Path(tempfile.mkdtemp(prefix="shm-year-"))
    place.mkdir(parents=True, exist_ok=True)
    with threadpool_limits(limits=1):
        if kind == "twin":
            twin(int(rest[0]) if rest else 365, place)
        else:
            raw(float(rest[0]) if rest else 48.0, place)
