"""Records as measured ones are: stiffness and damping differ between them, a mode is not excited, they last seconds."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from drivers.base import ACCELERATION
from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.core import Array, WindowResult
from monitor.damage import ModalBaseline
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, cut_into_blocks
from tests.support.simulated import windows_of

T0_NS, APART_S = 1_800_000_000_000_000_000, 600
"""Beginning of the first record, and time from one record's beginning to the next one's."""


@dataclass(frozen=True)
class Scattered:
    """A structure of modes, each excited by noise of its own, whose records differ."""

    frequencies_hz: tuple[float, ...]
    shapes: tuple[tuple[float, ...], ...] = ()
    """Of each mode at the channels; one channel that sees all modes alike where none are given."""
    damping: float = 0.015
    rate_hz: float = 200.0
    scatter: float = 0.0
    """Standard deviation of ln stiffness of each mode from record to record."""
    damping_scatter: float = 0.0
    """The same of ln damping."""
    quiet: float = 0.0
    """Probability with which a mode is not excited in a record."""
    noise: float = 0.05
    """Of each channel, over the response of a mode."""

    def record(self, seconds: float, seed: int, change: Sequence[float] = ()) -> Array:
        """Return accelerations of one record; `change` is that of each mode's frequency (-0.1: a tenth lower)."""
        rng, n = np.random.default_rng(seed), round(seconds * self.rate_hz)
        shapes = np.array(self.shapes or [(1.0,)] * len(self.frequencies_hz))
        out = self.noise * rng.standard_normal((n, shapes.shape[1]))
        for k, f in enumerate(self.frequencies_hz):
            f *= float(np.exp(0.5 * self.scatter * rng.standard_normal())) * (1.0 + (change[k] if change else 0.0))
            damping = self.damping * float(np.exp(self.damping_scatter * rng.standard_normal()))
            lead, excited = round(8.0 / (damping * 2.0 * np.pi * f) * self.rate_hz), rng.random() >= self.quiet
            pole = np.exp(2.0 * np.pi * f / self.rate_hz * (-damping + 1j * np.sqrt(1.0 - damping**2)))
            motion = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.standard_normal(n + lead))[lead:]
            out += excited * np.outer(motion / motion.std(), shapes[k])
        return out

    def records(self, n: int, seconds: float, seed: int, change: Sequence[float] = ()) -> list[Array]:
        """Return n records."""
        return [self.record(seconds, 1000 * seed + k, change) for k in range(n)]


def site(n_channels: int, window_s: float, hop_s: float, rate_hz: float, **tables: dict[str, object]) -> Configuration:
    """Return a site of modes alone that evaluates up to 0.4 of the rate."""
    processing = {"window_s": window_s, "hop_s": hop_s, "rate_hz": rate_hz, "cutoff_hz": 0.4 * rate_hz}
    content: dict[str, object] = {
        "structure": {"kind": "modal"},
        "sensors": [{"channel": f"a{k + 1}"} for k in range(n_channels)],
        "processing": processing,
    }
    return Configuration.model_validate({**content, **tables})


def calibrated(records: Sequence[Array], config: Configuration, rate_hz: float) -> ModalBaseline:
    """Learn the modes from records, as `calibrate` does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "healthy.mcap"
        with McapWriter(path) as writer:
            for k, record in enumerate(records):
                at = _first(k, rate_hz)
                for block in cut_into_blocks(ACCELERATION, record, config.channels, rate_hz, T0_NS, 10_000, first=at):
                    writer.write(block)
        return calibrate.calibrate_modes([path], config)


def watched(pipeline: Pipeline, records: Sequence[Array], rate_hz: float, first: int = 100) -> list[list[WindowResult]]:
    """Push records through a pipeline and return the windows of each; `first` is the number of the first record."""
    return [
        windows_of(pipeline, record, rate_hz, t0_ns=T0_NS, first=_first(first + k, rate_hz))
        for k, record in enumerate(records)
    ]


def _first(record: int, rate_hz: float) -> int:
    """Return the number of a record's first sample."""
    return round(record * APART_S * rate_hz)
