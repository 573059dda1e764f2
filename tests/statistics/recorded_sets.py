"""Measured and simulated recordings as pieces: learned, healthy, changed.

The recordings of the repository are always there, those of a folder of one's own downloads (docs/measured.md) where they are.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import shm_monitor as shm
from scipy.io import loadmat
from scipy.signal import resample

from monitor.core import Array
from tests.measured.sensor_faults import RECORDINGS
from tests.statistics import charts

KEPT = 0.9
"""Rate of all pieces over their source's: a spectrum that is moved then leaves nothing empty at its end. [ratio; choice]"""
Piece = Annotated[Array, "n c"]
Pieces = tuple[list[Piece], list[Piece], Mapping[str, list[Piece]]]
"""Learned, healthy, and changed by what is known of them."""


@dataclass(frozen=True)
class Recorded:
    """A set of recordings."""

    name: str
    source_hz: float
    window_s: float
    """Windows of `modal`; they follow every eighth of it, whole samples of a piece."""
    segment_s: float
    """Segments of the chart."""
    order: int
    """Of the AR model of each channel: ten, eight where there are several."""
    of: Callable[[Path], Pieces]
    file: str = ""
    """In the folder of downloads; empty if the repository has it."""
    changes: tuple[str, ...] = ()
    """What is known to have changed."""

    @property
    def rate_hz(self) -> float:
        """Rate of the pieces as they are judged."""
        return KEPT * self.source_hz

    @property
    def committed(self) -> bool:
        """Whether the repository has it."""
        return not self.file

    def coefficients(self, piece: Piece) -> Annotated[Array, "m k"]:
        """Compute what the chart judges of a piece."""
        return charts.ar_coefficients(piece, round(self.segment_s * self.rate_hz), self.order)

    def is_there(self, data: Path | None) -> bool:
        """Tell if its file is there."""
        return self.committed or (data is not None and (data / self.file).exists())

    def read(self, data: Path | None) -> Pieces:
        """Read the pieces."""
        return self.of(RECORDINGS if self.committed or data is None else data / self.file)


def stretched(samples: Piece, change: float = 0.0) -> Piece:
    """Resample a piece to `KEPT` of its rate; its frequencies fall by `change`."""
    return np.asarray(resample(samples, round(len(samples) * KEPT / (1.0 - change)), axis=0))


def quarters(samples: Piece) -> Pieces:
    """Cut a record of one state: two quarters are learned, two are healthy."""
    pieces = [np.asarray(piece) for piece in np.array_split(samples, 4)]
    return pieces[:2], pieces[2:], {}


def read(path: Path) -> Piece:
    """Read the samples of a file as the library does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(shm.read(path).samples)


def _frame(folder: Path) -> Pieces:
    learned, healthy, _ = quarters(read(folder / "frame-healthy.mcap"))
    after = read(folder / "frame-after.mcap")
    return learned, healthy, {"12 % of a story lost (simulated)": [after[:60_000], after[60_000:]]}


def _propeller(file: Path) -> Pieces:
    with np.load(file) as runs:
        healthy, damaged = (np.swapaxes(runs[name].astype(float), 1, 2) for name in ("healthy", "damaged"))
    return list(healthy[:3]), list(healthy[3:]), {"a hole": list(damaged)}


def _f16(file: Path) -> Pieces:
    levels = [loadmat(file.with_name(f"F16_FM_Level{n}.mat"))["Acceleration"].T[8192:] for n in (1, 3, 5, 7)]
    learned, healthy, _ = quarters(levels[0])
    return (
        learned,
        healthy,
        {f"a joint at level {n}": quarters(x)[0] for n, x in zip((3, 5, 7), levels[1:], strict=True)},
    )


def _silverbox(file: Path) -> Pieces:
    """Read the multisines; their 610.35 Hz are called 600."""
    return quarters(loadmat(file)["V2"].T[45_000:])


def _footbridge(file: Path) -> Pieces:
    with np.load(file) as record:
        nodes = 9.81 * record["nodes"].astype(float).T
    return quarters(np.asarray(resample(nodes - nodes.mean(axis=0), round(len(nodes) / 36))))


def _flexible(folder: Path) -> Pieces:
    return quarters(read(folder / "mini-shake-table-flexible.mcap"))


def _stiff(folder: Path) -> Pieces:
    return quarters(read(folder / "mini-shake-table-stiff.mcap"))


def _munich(file: Path) -> Pieces:
    return quarters(read(file))


def _one_channel(folder: Path) -> Pieces:
    learned, healthy, changed = _frame(folder)
    return (
        [x[:, :1] for x in learned],
        [x[:, :1] for x in healthy],
        {k: [x[:, :1] for x in v] for k, v in changed.items()},
    )


_MUNICH = "munich-test-bridge/Settlements/UniBw_2022-04-11_ref_support_load_01AllM100Hz.csv.zip"
_LOST = ("12 % of a story lost (simulated)",)
SETS = (
    Recorded("frame (simulated)", 200.0, 50.0, 2.0, 8, _frame, changes=_LOST),
    Recorded("frame, one channel (simulated)", 200.0, 50.0, 2.0, 10, _one_channel, changes=_LOST),
    Recorded("shake table, flexible frame", 120.0, 10.0, 1.0, 8, _flexible),
    Recorded("shake table, stiff frame", 120.0, 10.0, 1.0, 8, _stiff),
    Recorded("propeller", 1600.0, 2.0, 0.25, 8, _propeller, "propeller/propeller50.npz", ("a hole",)),
    Recorded("Munich bridge, one channel", 100.0, 32.0, 2.0, 10, _munich, _MUNICH),
    Recorded("footbridge", 200.0, 2.4, 0.25, 8, _footbridge, "usc-bridge/usc_roller.npz"),
    Recorded(
        "F-16",
        400.0,
        10.0,
        0.5,
        8,
        _f16,
        "f16/F16_FM_Level1.mat",
        tuple(f"a joint at level {n}" for n in (3, 5, 7)),
    ),
    Recorded("Silverbox", 600.0, 4.8, 0.25, 10, _silverbox, "silverbox/SNLS80mV.mat"),
)
"""The sets, by the order of the table."""
