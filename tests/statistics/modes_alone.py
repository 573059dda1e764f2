"""Modes alone: how often an intact frame is announced as changed, and from which loss a changed one is.

    .venv/bin/python -m tests.statistics.modes_alone SEEDS [HOURS] [CALIBRATION_S]

Each seed calibrates with ambient motion (by default 2400 s, six windows of 400 s), then watches the intact frame for some hours,
and then the frame with a story of 10, 5 and 3 % less stiffness for half an hour each.  The modes and their number are chosen by
calibration; nothing of the model that simulates is told to the monitor.  Windows follow every 50 s.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from drivers.base import ACCELERATION
from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.core import Array, Level, WindowResult
from monitor.damage import ModalBaseline
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, cut_into_blocks
from tests.statistics.estimates import configuration
from tests.support.campaign import words
from tests.support.simulated import ambient, windows_of

WINDOW_S, HOP_S, RATE_HZ, BURN_IN_S, T0_NS = 400.0, 50.0, 128.0, 5.0, 1_800_000_000_000_000_000
FRAME = configuration(WINDOW_S)
"""The frame that is simulated."""
SITE = Configuration.model_validate(
    {
        "structure": {"kind": "modal"},
        "sensors": [{"channel": name} for name in FRAME.channels],
        "processing": {"window_s": WINDOW_S, "hop_s": HOP_S},
    }
)
"""What the monitor is told."""


@dataclass
class Watched:
    """Windows of a run of the monitor."""

    windows: list[WindowResult]

    def announced(self, least: Level = Level.ADVISORY) -> int:
        """Count the episodes of this level and above."""
        high = [w.alarm.level.rank >= least.rank for w in self.windows]
        return sum(now and not before for before, now in zip([False, *high], high, strict=False))


def motion(seconds: float, seed: int, loss: tuple[float, ...] = (0.0,)) -> Array:
    """Ambient motion of the frame with losses of its stories."""
    return ambient(FRAME.model(), seconds, RATE_HZ, seed, loss=loss, lead_s=BURN_IN_S)


def watch(pipeline: Pipeline, seconds: float, seed: int, loss: tuple[float, ...] = (0.0,)) -> Watched:
    """Push ambient motion of the frame through a pipeline."""
    return Watched(windows_of(pipeline, motion(seconds, seed, loss), RATE_HZ, t0_ns=T0_NS))


def calibrated(seconds: float, seed: int) -> ModalBaseline:
    """Learn the modes from ambient motion of the intact frame, as `calibrate` does."""
    with tempfile.TemporaryDirectory() as folder:
        with McapWriter(Path(folder) / "healthy.mcap") as writer:
            floors = motion(seconds, seed)
            for block in cut_into_blocks(ACCELERATION, floors, SITE.channels, RATE_HZ, T0_NS, 10_000):
                writer.write(block)
        return calibrate.calibrate_modes([Path(folder) / "healthy.mcap"], SITE)


def main() -> None:
    """Print one line a seed, and the totals."""
    seeds, hours, calibration_s = words(10, 4.0, 2400.0)
    false, watched_h, found = 0, 0.0, dict.fromkeys((0.10, 0.05, 0.03), 0)
    for seed in range(seeds):
        baseline = calibrated(calibration_s, 10_000 + seed)
        healthy = watch(Pipeline(SITE, baseline), 3600.0 * hours, 20_000 + seed)
        n, skipped = healthy.announced(), sum(w.skipped is not None for w in healthy.windows)
        false, watched_h = false + n, watched_h + hours
        line = f"seed {seed}: {baseline.frequencies_hz.size} modes, {n} false, {len(healthy.windows)} windows, {skipped} skipped"
        for size in found:
            loss = tuple(size if j == seed % 3 else 0.0 for j in range(3))
            damaged = watch(Pipeline(SITE, baseline), 1800.0, 30_000 + seed, loss)
            is_found = damaged.announced(Level.WARNING) > 0
            found[size] += is_found
            line += f"; {100 * size:.0f} % of story {seed % 3 + 1}: {'announced' if is_found else 'not'}"
        print(line, flush=True)
        for w in healthy.windows:
            if w.alarm.level is not Level.NORMAL:
                print(f"   {w.t_end_ns}: {w.alarm.level}: {w.alarm.reason}", flush=True)
    shares = ", ".join(f"{100 * size:.0f} %: {n} of {seeds}" for size, n in found.items())
    print(f"{false} false announcements in {watched_h:.0f} h; announced within half an hour: {shares}")


if __name__ == "__main__":
    main()
