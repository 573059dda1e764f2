"""Frames, recordings and pipelines for the benchmarks."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path

import numpy as np

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.core import Array, WindowResult
from monitor.damage import Baseline
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from tests.statistics.estimates import MASSES, STIFFNESS
from tests.support.frames import shear_frame
from tests.support.simulated import ambient, learned, windows_of

T0_NS = 1_767_225_600_000_000_000
PAPER = (MASSES.tolist(), STIFFNESS.tolist())


def configuration(n: int = 3, *, refined: bool = True, uncertainty: bool = True, **processing: float) -> Configuration:
    """The paper's frame, or a uniform one of n stories with as many channels whose eight lowest modes lie in the band."""
    masses, stiffness = PAPER if n == 3 else ([0.33] * n, [2000.0 * max(1.0, (n / 10.0) ** 2)] * n)
    tables = {"refinement": {"enabled": refined}, "identification": {"uncertainty": uncertainty}}
    return shear_frame(masses, stiffness, processing=processing, **tables)


def floors(config: Configuration, duration_s: float, rate_hz: float, seed: int) -> Array:
    """Simulated accelerations, shape (n_samples, n)."""
    return ambient(config.model(), duration_s, rate_hz, seed, noise=0.05)


def write(path: Path, config: Configuration, hours: float, rate_hz: float = 1024.0, block_n: int = 128) -> Path:
    """A recording in blocks of 128 samples, simulated hour by hour."""
    first, left_s, seed = 0, 3600.0 * hours, 0
    with McapWriter(path) as writer:
        while left_s > 0:
            motion = floors(config, min(3600.0, left_s), rate_hz, seed)
            for block in cut_into_blocks(ACCELERATION, motion, config.channels, rate_hz, T0_NS, block_n, first):
                writer.write(block)
            first, left_s, seed = first + len(motion), left_s - 3600.0, seed + 1
    return path


def baseline(config: Configuration) -> Baseline:
    """Learned from 20 minutes."""
    motion = floors(config, config.processing.window_s + 800.0, 100.0, 1)
    return learned(config, windows_of(Pipeline(config), motion, 100.0, t0_ns=T0_NS, size=1000))


class Hops:
    """A pipeline whose window is full; each call is one hop of 10 s at the rate of the source."""

    def __init__(self, config: Configuration, healthy: Baseline | None = None, rate_hz: float = 100.0) -> None:
        self.pipeline = Pipeline(config, healthy)
        self.results: list[WindowResult] = []
        hop_s = config.processing.hop_s
        size = round(hop_s * rate_hz)
        motion = floors(config, config.processing.window_s + 20 * hop_s, rate_hz, 2)
        self._pieces = cycle([motion[i : i + size] for i in range(0, len(motion) - size + 1, size)])
        self._n, self._rate_hz = 0, rate_hz
        while not self.results:
            self()

    def __call__(self) -> None:
        """Push the next hop."""
        values = next(self._pieces).astype(np.float32)
        t_ns = T0_NS + round(self._n / self._rate_hz * 1e9)
        block = SampleBlock(ACCELERATION, t_ns, self._n, self._rate_hz, self.pipeline.config.channels, "m/s^2", values)
        self._n += len(values)
        self.results += [r for r in self.pipeline.push(block) if isinstance(r, WindowResult)]
