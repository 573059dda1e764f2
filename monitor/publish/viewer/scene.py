"""Description of a site for the viewer, the text of its estimates and its colours; pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from drivers.base import ClockHealth
from monitor.core import Array, ModalEstimate, WindowResult
from monitor.damage import Baseline
from monitor.model import Model, StructureTable

Colour = tuple[int, int, int]

GREEN, AMBER, RED, GREY = (80, 190, 110), (240, 180, 50), (230, 70, 60), (130, 130, 130)
SERIES: tuple[Colour, ...] = ((90, 170, 250), (250, 170, 70), (190, 130, 240), (90, 210, 190), (240, 120, 160))
LIVE_BLOCK_S, FILE_BLOCK_S = 1.0, 60.0
"""Shortest length of the blocks in which samples are sent, s, and number of results that are sent at a time.

Both are small for viewers that watch, and large for a small file that is written fast.
"""
COLUMNS = ((0.0, 0.0), (0.6, 0.0), (0.6, 0.6), (0.0, 0.6))
"""Corners of the frame; it is drawn 1 high."""
STABILISATION = (100.0, 55.0)
"""Width and height of the canvas of the stabilisation diagram."""


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """Description of a site for the viewer."""

    name: str
    channels: tuple[str, ...]
    sensor_floor: tuple[int, ...]
    """Floor of each channel, from 1 = top."""
    story_heights_m: Array
    """Shape (n,); story 1 = top.  Only their proportions are drawn."""
    baseline_frequencies_hz: Array | None
    """Shape (m,); mode 0 = lowest."""
    has_baseline: bool
    alarm_loss: float
    """Relative stiffness loss that counts as an alarm."""
    model: Model | None = None
    """Model that predicts spectra; no spectra are predicted without one."""
    cutoff_hz: float = 40.0
    """Highest frequency of the analysis, Hz."""
    misfit_threshold: float = 5.0
    """Goodness of fit from which a diagnosis is requested."""

    @property
    def n_stories(self) -> int:
        """Number of stories, which is also the number of the model's modes."""
        return len(self.story_heights_m)


class Clocks(NamedTuple):
    """State of the sensor nodes' clocks at a time."""

    t_ns: int
    clocks: Sequence[ClockHealth]


def make_scene(
    name: str,
    structure: StructureTable,
    sensor_floor: Mapping[str, int],
    model: Model,
    baseline: Baseline | None,
    *,
    alarm_loss: float,
    cutoff_hz: float,
    misfit_threshold: float,
) -> Scene:
    """Describe a site to the viewer.

    Parameters
    ----------
    name : str
        Name of the site.
    structure : StructureTable
        Its story heights set the proportions of the drawing; all stories are equally high where it has none.
    sensor_floor : Mapping
        Floor of each channel by the channel's name, from 1 = top, in column order of the samples.
    model : Model
        Nominal model; the baseline's model replaces it.
    baseline : Baseline, optional
        The healthy reference.
    alarm_loss : float
        Relative stiffness loss that counts as an alarm.
    cutoff_hz : float
        Highest frequency of the analysis, Hz.
    misfit_threshold : float
        Goodness of fit of the updated stiffness from which a diagnosis is requested.
    """
    heights = structure.story_heights_m
    n = max(len(structure.masses_kg), len(structure.stiffness_n_per_m))
    return Scene(
        name=name,
        channels=tuple(sensor_floor),
        sensor_floor=tuple(sensor_floor.values()),
        story_heights_m=np.ones(n) if heights is None else np.array(heights),
        baseline_frequencies_hz=None if baseline is None else baseline.frequencies_hz,
        has_baseline=baseline is not None,
        alarm_loss=alarm_loss,
        model=model if baseline is None else baseline.model,
        cutoff_hz=cutoff_hz,
        misfit_threshold=misfit_threshold,
    )


def loss_colour(loss: float | None, alarm_loss: float) -> Colour:
    """Choose the colour of a story: green, amber at half of `alarm_loss`, red from there on; grey when unknown."""
    if loss is None:
        return GREY
    x = min(max(2.0 * loss / alarm_loss, 0.0), 2.0)
    first, last, share = (GREEN, AMBER, x) if x < 1.0 else (AMBER, RED, x - 1.0)
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, last, strict=True))
    return red, green, blue


def utc(t_ns: int) -> np.datetime64:
    """Convert UTC nanoseconds to NumPy's time.

    Examples
    --------
    >>> str(utc(1_700_000_000_000_000_000))
    '2023-11-14T22:13:20.000000000'
    """
    return np.datetime64(t_ns, "ns")


def plus_minus(value: float, std: float, scale: float = 1.0, digits: int = 1) -> str:
    """Write a value with two standard deviations."""
    return f"{value * scale:.{digits}f} ± {2 * std * scale:.{digits}f}"


def status_markdown(scene: Scene, result: WindowResult) -> str:
    """Describe the estimates of a window in Markdown; intervals are two standard deviations."""
    end = datetime.fromtimestamp(result.t_end_ns * 1e-9, UTC)
    modes, damage, lines = result.modes, result.damage, []
    if result.skipped is not None:
        lines += [f"**No result for this window:** {result.skipped.reason}", ""]
    if damage is not None:
        since = f"since the baseline, alarm from {100 * scene.alarm_loss:g} %"
        lines += [f"Stiffness lost {since if scene.has_baseline else 'against the structure file (no baseline)'}", ""]
        lines += ["| story | loss, % (± 2σ) |", "|---|---|"]
        pairs = zip(damage.ddi, damage.ddi_std, strict=True)
        lines += [f"| {j} | {plus_minus(d, s, 100)} |" for j, (d, s) in enumerate(pairs, 1)] + [""]
    if modes is not None:
        lines += ["| mode | frequency, Hz (± 2σ) | baseline, Hz | damping, % (± 2σ) |", "|---|---|---|---|"]
        for k, f, fs, d, ds in mode_rows(modes):
            base = scene.baseline_frequencies_hz
            was = f"{base[k]:.3f}" if base is not None and k < len(base) else "-"
            lines.append(f"| {k + 1} | {plus_minus(f, fs, digits=3)} | {was} | {plus_minus(d, ds, 100, 2)} |")
    lines += ["", f"{scene.name}, window of {result.window_s:g} s to {end:%Y-%m-%d %H:%M:%S} UTC"]
    return "\n".join(lines)


def mode_rows(modes: ModalEstimate) -> list[tuple[int, float, float, float, float]]:
    """List number, frequency and its standard deviation (Hz), damping ratio and its standard deviation of each mode.

    The number is that of the model's mode.
    """
    columns = (modes.frequencies_hz, modes.frequencies_std_hz, modes.damping_ratio, modes.damping_std)
    table = np.column_stack(columns).tolist()
    return [(int(k), f, fs, d, ds) for k, (f, fs, d, ds) in zip(modes.model_mode, table, strict=True)]


NO_VALUE = (np.nan,) * 3
"""Interruption of a line and its bounds: without a row the line is bridged, and a Clear or an empty row drags the axis to 0."""
