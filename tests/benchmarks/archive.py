"""Recordings: a replay beside reading alone, its memory, the reprocessing on one and on two workers, a diagnosis."""

from __future__ import annotations

import itertools
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from google.protobuf import descriptor_pool, message_factory
from mcap.reader import make_reader

from drivers import codec
from drivers.base import ACCELERATION
from drivers.mcap_file import read_recordings
from monitor.config import Configuration
from monitor.runs import WINDOWS
from monitor.signals import Conditioner, WindowGrid, alignment, windows as window
from tests.benchmarks.frames import baseline, configuration, write
from tests.benchmarks.rounds import Cost, interleaved
from tests.support.frame_text import THREE_STORIES

LIBRARY, READ, WINDOWED = "mcap library, float32 arrays", "read_recordings", "read, filtered, resampled, windowed"
BARE_LIBRARY = "mcap library, nothing done"


def library(path: Path, decoded: bool) -> int:
    """Read with the library of the format's makers; the samples as arrays if wanted."""
    total, pool = 0, descriptor_pool.Default()
    block = message_factory.GetMessageClass(pool.FindMessageTypeByName(codec.SCHEMA_NAME))
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages():
            if decoded:
                total += len(np.frombuffer(block.FromString(message.data).samples, "<f4").reshape(-1, 3))
    return total


def windowed(path: Path, config: Configuration) -> int:
    """Everything before identification, and nothing else."""
    p, n_lags = config.processing, 2 * config.identification.block_rows
    state, count = alignment.start(), 0
    conditioner = memory = grid = held = None
    for block in read_recordings([path], longest_s=30.0):
        if block.topic != ACCELERATION:
            continue
        state, pieces = alignment.step(state, block, config.channels)
        for piece in pieces:
            if conditioner is None or memory is None or grid is None or held is None:
                conditioner = Conditioner.design(piece.rate_hz, p.rate_hz, p.cutoff_hz, 10.0)
                memory = conditioner.start(len(config.channels))
                grid = WindowGrid.design(p.rate_hz, p.window_s, p.hop_s, n_lags)
                held = window.start(grid, len(config.channels), index=0)
            memory, values = conditioner.step_block(memory, piece.values)
            held, windows = window.step(grid, held, values, 0)
            count += len(windows)
    return count


def reading(path: Path, rounds: int) -> dict[str, Cost]:
    """CPU of the stages before identification beside reading alone."""
    config = configuration()
    things = {
        BARE_LIBRARY: lambda: library(path, False),
        LIBRARY: lambda: library(path, True),
        READ: lambda: sum(b.n_samples for b in read_recordings([path])),
        WINDOWED: lambda: windowed(path, config),
    }
    return interleaved(things, rounds)


PLAIN = "\n[refinement]\nenabled = false\n\n[identification]\nuncertainty = false\n"


@dataclass(frozen=True)
class Run:
    """One command as a process of its own."""

    wall_s: float
    cpu_s: float
    rss_mb: float


def command(*arguments: object) -> Run:
    """Run a command of the monitor to its end."""
    # A child's ru_maxrss begins with its parent's, so it tells its own peak.
    code = (
        "import atexit, sys; from pathlib import Path; from monitor.cli import main; sys.argv[0] = 'shm-monitor'\n"
        "told = Path('/proc/self/status'); atexit.register(lambda: print(told.read_text(), file=sys.stderr)); main()"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    line = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, arguments))}: {done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime  # and of its own children
    return Run(time.monotonic() - begin, cpu_s, int(done.stderr.partition("VmHWM:")[2].split()[0]) / 1024.0)


def _kinds(folder: Path, config: Configuration) -> dict[str, tuple[object, ...]]:
    """Options of a replay with all that it can do, and of one without what costs the most."""
    from monitor.damage import save_baseline

    save_baseline(baseline(config), folder / "baseline.json")
    (folder / "frame.toml").write_text(THREE_STORIES)
    (folder / "plain.toml").write_text(THREE_STORIES + PLAIN)
    return {
        "all": ("--structure", folder / "frame.toml", "--baseline", folder / "baseline.json"),
        "without refinement and uncertainty": ("--structure", folder / "plain.toml"),
    }


def memory(folder: Path, hours: Iterable[float]) -> dict[str, dict[float, float]]:
    """Peak memory of whole replays of recordings at 100 Hz with all files, MB by hours of data."""
    config = configuration()
    kinds = _kinds(folder, config)
    found: dict[str, dict[float, float]] = {name: {} for name in kinds}
    for length in hours:
        recording = write(folder / "at-100-hz.mcap", config, length, rate_hz=100.0)
        for name, options in kinds.items():
            found[name][length] = command("replay", recording, *options, "--out", folder / "kept").rss_mb
    return found


def replays(folder: Path, hours: float, kinds: int | None = None) -> dict[str, dict[str, float]]:
    """Whole replays with all files, as processes of their own: times real time, start-up apart, and peak memory.

    Of the first so many kinds of windows, or of all.
    """
    config = configuration()
    few_hours = min(0.25, hours / 2)
    short, long = write(folder / "short.mcap", config, few_hours), write(folder / "long.mcap", config, hours)
    found = {}
    for name, options in list(_kinds(folder, config).items())[:kinds]:
        few = command("replay", short, *options, "--out", folder / "few")
        many = command("replay", long, *options, "--out", folder / "many")
        data_s = 3600.0 * (hours - few_hours)
        summary = json.loads((folder / "many" / "summary.json").read_text())
        found[name] = {
            "hours": hours,
            "times_real_time": data_s / (many.wall_s - few.wall_s),
            "times_real_time_of_cpu": data_s / (many.cpu_s - few.cpu_s),
            "start_s": few.wall_s - few_hours * 3600.0 * (many.wall_s - few.wall_s) / data_s,
            "rss_short_mb": few.rss_mb,
            "rss_long_mb": many.rss_mb,
            "windows": summary["windows"],
        }
    return found


def reprocessing(folder: Path, hours: float, recordings: int = 4) -> dict[str, float]:
    """Time of `reprocess` on one and on two workers, for recordings of streams of their own; with and without start-up."""
    (folder / "frame.toml").write_text(THREE_STORIES)
    paths: dict[str, list[Path]] = {"few": [], "many": []}
    for number, (name, total) in itertools.product(
        range(recordings), (("few", max(hours / 8.0, 0.15 * recordings)), ("many", hours))
    ):
        stream = folder / f"{name}-{number}"
        stream.mkdir(exist_ok=True)
        paths[name].append(write(stream / "r.mcap", configuration(), total / recordings))
    run = {}
    for workers, name in itertools.product((1, 2), paths):
        out = folder / f"reprocessed-{name}-{workers}"
        options = ("--structure", folder / "frame.toml", "--out", out, "--workers", workers)
        run[name, workers] = command("reprocess", *paths[name], *options)
        assert len(list((out / WINDOWS).iterdir())) == recordings
    one, two = run["many", 1], run["many", 2]
    return {
        "hours": hours,
        "one_s": one.wall_s,
        "two_s": two.wall_s,
        "ratio": one.wall_s / two.wall_s,
        "ratio_beyond_start": (one.wall_s - run["few", 1].wall_s) / (two.wall_s - run["few", 2].wall_s),
        # As far as CPU goes: what a second worker costs besides, on a machine that is not shared.
        "ratio_of_cpu": 2.0 * one.cpu_s / two.cpu_s,
        "ratio_of_cpu_beyond_start": 2.0 * (one.cpu_s - run["few", 1].cpu_s) / (two.cpu_s - run["few", 2].cpu_s),
        "cores": float(os.cpu_count() or 1),
    }


def diagnosis(folder: Path) -> dict[str, float]:
    """`diagnose` on 20 minutes of three channels."""
    path = write(folder / "twenty-minutes.mcap", configuration(), 1.0 / 3.0)
    (folder / "frame.toml").write_text(THREE_STORIES)
    done = command("diagnose", path, "--structure", folder / "frame.toml", "--out", folder / "diagnosis")
    return {"cpu_s": done.cpu_s, "wall_s": done.wall_s}
