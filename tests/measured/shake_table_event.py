"""Judge structures of the flexible shake-table frame on another event, whose sensors were not synchronized.

    .venv/bin/python -m tests.measured.shake_table_event STRUCTURE.toml ... [--as-recorded] [--out EVENT.mcap]

Nothing was fitted to the event.  Its clocks are aligned by the motion: below the first mode the floors follow the table, and at
the first mode they are in phase.  Then every structure gets the three delays that suit it best, so that none has the advantage of
a delay that it was fitted with.  Of every structure the log score a sample and the error of the cross-spectra are printed.

In the source's files of this event the lowest and the middle floor are exchanged: the modes of the other recordings say so.  And
the top floor's sensor reads with the other sign: below the first mode it moves against the table.  Both are set right, unless
``--as-recorded``.  ``--out`` writes the recording, aligned by the motion.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import shift
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, GROUND, SampleBlock
from drivers.mcap_writer import McapWriter
from monitor.config import configuration
from monitor.diagnosis import Score, score
from monitor.inference import Segments, gather
from monitor.model import EFFECTS, Model
from tests.measured.sensor_faults import CHANNELS
from tests.measured.shake_table_laws import RATE_HZ, in_band

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "data" / "mini-shake-table"
AS_RECORDED = ("floor3", "floor2", "floor1"), (1.0, 1.0, 1.0)
"""Files of channels a1 (top), a2 and a3 by their names, and their signs."""
SET_RIGHT = ("floor3", "floor1", "floor2"), (-1.0, 1.0, 1.0)
"""The same by how far the floors move in each mode, and which way."""
FIRST_BAND_HZ = (2.5, 5.5)
SLOW_BAND_HZ = (0.6, 1.6)
WITHIN_S = 0.1
"""Least of half a period of the first mode."""
STEP_MS = 2.0
"""First step of the search for delays."""


def read(level: str) -> Array:
    """Read the acceleration along the motion without its mean, shape (n,), m/s^2."""
    lines = (FOLDER / f"flexible-bonus-event-{level}.csv").read_text(encoding="latin-1").splitlines()
    header = next(i for i, line in enumerate(lines) if line.startswith("PacketCounter"))
    column = lines[header].split(",").index("Acc_X")
    x = np.array([float(line.split(",")[column]) for line in lines[header + 2 :] if line])  # the first sample is zero
    return np.asarray(x - x.mean())


def lag(one: Array, other: Array, band_hz: tuple[float, float], near: float = 0.0, reach_s: float = 12.0) -> float:
    """Find the lag of one series behind another at which they move in phase, or in antiphase, in a band, samples.

    Only lags within `reach_s` of `near`, in samples, are considered.
    """
    n = max(one.size, other.size)
    a, b = (in_band(np.pad(x, (0, 2 * n - x.size)), band_hz) for x in (one, other))
    together = np.fft.irfft(np.fft.rfft(a) * np.fft.rfft(b).conj(), 2 * n)
    at = round(near) + np.arange(-round(reach_s * RATE_HZ), round(reach_s * RATE_HZ) + 1)
    i = int(np.abs(together[at[1:-1]]).argmax()) + 1
    before, top, after = together[at[i - 1 : i + 2]]
    return float(at[i] + 0.5 * (before - after) / (before - 2.0 * top + after))


def aligned(files: Sequence[str], signs: Sequence[float]) -> tuple[Array, Array]:
    """Align floors and table; return floors, shape (n, 3), and table, shape (n, 1)."""
    floors, table = [read(level) for level in files], read("ground")
    slow = [lag(x, table, SLOW_BAND_HZ) for x in floors]
    lags = [
        slow[0] + lag(x, floors[0], FIRST_BAND_HZ, own - slow[0], WITHIN_S) for x, own in zip(floors, slow, strict=True)
    ]
    n = min(x.size for x in (*floors, table))
    moved = [shift(x, -own, order=5)[:n] for x, own in zip((*floors, table), (*lags, 0.0), strict=True)]
    first, last = max(0, int(np.ceil(-min(lags)))) + 1, max(0, int(np.ceil(max(lags)))) + 1
    whole = np.column_stack(moved)[first : n - last]
    return whole[:, :3] * signs, whole[:, 3:]


def blocks(floors: Array, table: Array) -> list[SampleBlock]:
    """Make blocks as a driver hands them over."""
    streams = ((GROUND, ("ground",), table), (ACCELERATION, CHANNELS, floors))
    return [SampleBlock(topic, 10**18, 0, RATE_HZ, names, "m/s^2", x.astype(np.float32)) for topic, names, x in streams]


def best_score(structure: Path, event: Sequence[SampleBlock]) -> tuple[Score, Array]:
    """Score a structure with the delays of the channels that suit it best; return the score and the delays, ms."""
    config = configuration.load(structure)
    segments: Segments = gather(event, config.front_end())
    context, model = config.instrumented().context(segments.rate_hz), config.model()
    others = tuple(e for e in model.effects if e.name != "time_offset")

    def scored(delays_ms: Array) -> Score:
        delays = (
            EFFECTS["time_offset"].create(f"channel {name}", {"seconds": 1e-3 * ms})
            for name, ms in zip(CHANNELS, delays_ms, strict=True)
        )
        delayed: Model = replace(model, effects=(*others, *delays))
        return score(segments, delayed, context)

    simplex = np.vstack([np.zeros(3), STEP_MS * np.eye(3)])
    found = minimize(
        lambda x: -scored(x).log_score_per_sample,
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-3},
    )
    return scored(found.x), found.x


def main() -> None:
    """Print the scores of every structure."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.shake_table_event", description=__doc__)
    parser.add_argument("structures", type=Path, nargs="*")
    parser.add_argument("--as-recorded", action="store_true", help="leave the floors' names and signs as they are")
    parser.add_argument("--out", type=Path, help="write the aligned recording")
    options = parser.parse_args()
    event = blocks(*aligned(*(AS_RECORDED if options.as_recorded else SET_RIGHT)))
    if options.out is not None:
        with McapWriter(options.out) as writer:
            for block in event:
                writer.write(block)
    for structure in options.structures:
        with threadpool_limits(limits=1):
            found, delays_ms = best_score(structure, event)
        delays = ", ".join(f"{ms:.2f}" for ms in delays_ms)
        print(
            f"{structure}: log score a sample {found.log_score_per_sample:.3f}, error of the cross-spectra "
            f"{found.csd_error:.4f}; delays of a1, a2, a3 {delays} ms",
            flush=True,
        )


if __name__ == "__main__":
    main()
