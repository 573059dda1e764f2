"""Healthy records with the troubles of every day: does anything say that the logger, its clock or its modes are at fault?

    .venv/bin/python -m tests.statistics.healthy_records 40 SEED

Frames of two to six floors, three to nine minutes in blocks of any length, by day or in a night whose motion ends near the
resolution of the sensors; a clock some parts in a million off, stamps with jitter, gaps of up to two seconds, and a restart after
which the last 200 s of blocks come again.  The same record goes through the daemon, whose clock follows the data.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit

from drivers.base import ACCELERATION, SampleBlock, Source
from monitor.config import Configuration
from monitor.core import WindowResult
from monitor.damage import Assessment, Baseline, save_baseline
from monitor.model import simulate
from monitor.pipeline import Pipeline, Result
from monitor.runs import Session
from monitor.service import outlets
from tests.support.campaign import each, words
from tests.support.frames import shear_frame
from tests.support.learned import baseline_of
from tests.support.site import SITE, Daemon, Scripted

T0_NS = 1_767_225_600_000_000_000
SAYINGS = ("no reading", "logger", "timestamps", "at odds", "no data", "saturated", "possibly")
"""Words of the rules that no healthy record is to bring up."""


@dataclass(frozen=True)
class Record:
    """One healthy record."""

    site: Configuration
    rate_hz: float
    blocks: list[SampleBlock]
    gaps: int
    quiet: bool
    restart: int
    """Number of the block before which the monitor is begun again."""


def record(seed: int) -> Record:
    """Draw a healthy record."""
    draw = np.random.default_rng([seed, 66])
    n, rate = int(draw.integers(2, 7)), float(draw.choice([100.0, 128.0, 200.0]))
    mass, stiffness = draw.uniform(0.8, 1.2, n), draw.uniform(0.8, 1.2, n) * (2.0 * np.pi * draw.uniform(6.0, 9.0)) ** 2
    window_s = float(draw.choice([40.0, 60.0]))
    tables = {"processing": {"window_s": window_s, "hop_s": 10.0}, "selection": {"required_modes": min(n, 3)}}
    site = shear_frame(mass, stiffness, **tables)
    seconds = float(draw.uniform(180.0, 540.0))
    floors = simulate(site.model(), duration_s=seconds, rate_hz=rate, noise=0.05, seed=seed).floors
    floors = floors / floors.std()
    quiet = bool(draw.random() < 0.5)
    end = draw.uniform(0.25, 3.0) if quiet else draw.uniform(20.0, 2000.0)
    begin = draw.uniform(5.0, 50.0) if quiet else end
    level = begin * (end / begin) ** np.clip(np.linspace(-0.3, 1.3, len(floors)), 0.0, 1.0)
    values = 0.001 * np.round(level[:, None] * floors + draw.uniform(-0.5, 0.5, n))
    clock, jitter_s = 1.0 + 60e-6 * draw.normal(), 10.0 ** draw.uniform(-5.0, -2.5)
    blocks, at = [], 0
    while at < len(values):
        size = min(int(draw.integers(10, 400)), len(values) - at)
        t_ns = T0_NS + round((at / rate / clock + jitter_s * draw.normal()) * 1e9)
        blocks.append(
            SampleBlock(ACCELERATION, t_ns, at, rate, site.channels, "m/s^2", values[at : at + size].astype(np.float32))
        )
        at += size
    gaps = int(draw.integers(0, 3))
    for _ in range(gaps):  # of at most two seconds, never the first block
        del blocks[int(draw.integers(len(blocks) // 3, len(blocks) - 1))]
    return Record(site, rate, blocks, gaps, quiet, int(draw.integers(len(blocks) // 2, len(blocks))))


def said(results: list[Result], session: Session) -> Iterator[str]:
    """Everything that a person reads."""
    yield from (r.skipped.reason for r in results if isinstance(r, WindowResult) and r.skipped is not None)
    yield session.present.headline
    yield from session.present.doubts


def learned(one: Record) -> Baseline | None:
    """Learn the baseline of a record's own windows with all modes; None where it has none."""
    pipeline, n = Pipeline(one.site), len(one.site.channels)
    windows = [r for b in one.blocks for r in pipeline.push(b) if isinstance(r, WindowResult)]
    usable = [r for r in windows if r.modes is not None and len(r.modes.model_mode) == n]
    return baseline_of(one.site, usable) if usable else None


class States(outlets.Outlet):
    """Keeps every state that the daemon publishes."""

    def __init__(self) -> None:
        self.said: set[str] = set()

    def state(self, assessment: Assessment) -> None:
        self.said |= {assessment.headline, *assessment.doubts}


def live(
    one: Record, baseline: Baseline | None, source: Callable[[Iterator[SampleBlock]], Source] = Scripted
) -> set[str]:
    """Push a record through the daemon, whose clock is at the latest block's time, and return all that its states say."""
    now_s, told = [0.0], States()

    def come() -> Iterator[SampleBlock]:
        for block in one.blocks:
            now_s[0] = (block.t_ns - T0_NS) * 1e-9
            yield block

    with tempfile.TemporaryDirectory() as folder:
        site, tables = (
            Path(folder) / "site.toml",
            one.site.model_dump(include={"processing", "selection"}, exclude_unset=True),
        )
        structure = one.site.structure.model_dump(include={"kind", "masses_kg", "stiffness_n_per_m", "damping_ratio"})
        tables |= {
            "structure": structure,
            "sensors": [s.model_dump(include={"channel", "floor"}) for s in one.site.sensors],
        }
        site.write_text(SITE + tomlkit.dumps(tables))
        if baseline is not None:
            save_baseline(baseline, site.with_name("healthy.json"))
            site.write_text(site.read_text().replace('name = "bench"', 'name = "bench"\nbaseline = "healthy.json"'))
        Daemon(site, source(come()), [told], clock=lambda: now_s[0], tick_s=0.001).run()
    assert told.said
    return told.said


def trial(seed: int) -> tuple[str, list[str]]:
    """Tell what the record is, and what was said that should not have been."""
    one = record(seed)
    baseline = learned(one)
    session = Session(one.site, baseline, (), None, Path())
    results = [r for b in one.blocks[: one.restart] for r in session.push(b)]
    spoken = list(said(results, session))
    again = Session(one.site, baseline, (), None, Path())
    again.restore(session.state)
    first = next(k for k, b in enumerate(one.blocks) if one.blocks[one.restart].t_ns - b.t_ns < 200e9)
    windows = {r.index for r in results if isinstance(r, WindowResult)}
    more = [r for b in one.blocks[first:] for r in again.push(b)]
    spoken += said(more, again)
    repeated = windows & {r.index for r in more if isinstance(r, WindowResult)}
    spoken += live(one, baseline)
    wrong = sorted({text for text in spoken if any(word in text.lower() for word in SAYINGS)})
    wrong += [f"windows {sorted(repeated)} came twice"] if repeated else []
    what = f"seed {seed}: {len(one.site.channels)} floors, {one.rate_hz:g} Hz, {'quiet' if one.quiet else 'day'}, {one.gaps} gaps"
    return f"{what}, {len(windows)} windows before the restart, {'judged' if baseline else 'no baseline'}", wrong


def main() -> None:
    count, seed = words(40, 1)
    spoke = 0
    for what, wrong in each(trial, [(seed * 1000 + k,) for k in range(count)], keep=True):
        spoke += bool(wrong)
        print(what, *wrong, sep="\n    ")
    print(f"{spoke} of {count} records brought up what is not there")


if __name__ == "__main__":
    main()
