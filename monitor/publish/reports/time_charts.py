"""Charts over time of a period report."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from monitor.core import Array
from monitor.publish.reports.charts import WIDTH, Axes
from monitor.publish.reports.period_data import Curve, Envelope, Grid, utc

HEIGHT = 110.0
"""Height of a curve, px."""
TIME = "time, UTC"
"""Title of the axis."""
_MOST_TICKS = 9
"""Most times along a chart. [count; judgement]"""
_STEPS_S = (1, 5, 15, 60, 300, 900, 1800, 3600, 10800, 21600, 43200)
_STEPS_DAYS = (1, 2, 7, 14, 28, 91, 182, 364)


@dataclass(frozen=True, slots=True)
class TimeAxes(Axes):
    """Axes over time: x in s from 1970 UTC."""

    grid: Grid = field(kw_only=True)
    """Grid of the period, whose long gaps are shortened."""

    def px(self, x: Array | float) -> Array:
        """Return horizontal places, 0 at the left to `WIDTH` at the right, of the shape of `x`."""
        return self.grid.share(np.asarray(x, dtype=float) * 1e9) * WIDTH

    def x_ticks(self) -> list[tuple[float, str]]:
        """Return at most nine round times a stretch without a long gap, fewer where it is narrow; at least its begin."""
        out = []
        for stretch in self.grid.stretches:
            most = max(1, int(_MOST_TICKS * float(np.diff(self.grid.share(np.array(stretch, dtype=float)))[0])))
            out += _round_times(stretch[0] * 1e-9, stretch[1] * 1e-9, most, start_too=bool(self.grid.gaps))
        return out

    def gap_marks(self) -> list[str]:
        """Draw the gaps that are shortened."""
        return [self.shade((a * 1e-9, b * 1e-9), "cut") for a, b in self.grid.gaps]


def _round_times(start: float, stop: float, most: int, *, start_too: bool) -> list[tuple[float, str]]:
    """Return at most `most` round times between two times, s; their labels say the time of day above the date.

    Where there is none, the start is returned if `start_too`.
    """
    step = next((s for s in (*_STEPS_S, *(86400 * d for d in _STEPS_DAYS)) if (stop - start) / s <= most), None)
    step = step or 86400 * 364 * int((stop - start) / (86400 * 364 * most) + 1)
    places = np.arange(np.ceil(start / step), np.floor(stop / step) + 1) * step
    if not places.size and start_too:
        places, step = np.array([start]), min(step, 60)
    texts = [utc(1e9 * t) for t in places]
    end = 19 if step < 60 else 16
    labels = [text[:10] if step >= 86400 else f"{text[11:end]}\n{text[:10]}" for text in texts]
    return [(float(t), label) for t, label in zip(places, labels, strict=True)]


def time_axes(grid: Grid, low: float, high: float, height: float = HEIGHT) -> TimeAxes:
    """Make axes over a grid's time, with a margin above and below the range of values."""
    margin = 0.06 * (high - low) or 0.01 * abs(high) or 1.0
    return TimeAxes((grid.from_ns * 1e-9, grid.to_ns * 1e-9), (low - margin, high + margin), height, grid=grid)


def draw_envelope(axes: Axes, e: Envelope, scale: float = 1.0) -> list[str]:
    """Draw an envelope as a line of the mean in its band, interrupted where there are no values; a lone bin is a point."""
    marks = axes.gap_marks() if isinstance(axes, TimeAxes) else []
    for piece in e.pieces():
        t = e.t_ns[piece] * 1e-9
        if t.size == 1:
            half = scale * np.maximum(e.high[piece] - e.mean[piece], 0.0)
            marks.append(axes.dots(t, scale * e.mean[piece], half))
            continue
        marks.append(axes.band(t, scale * e.low[piece], scale * e.high[piece], "band"))
        marks.append(axes.line(t, scale * e.mean[piece], "after"))
    return marks


def panel(grid: Grid, curve: Curve | None, title: str) -> str:
    """Draw one quantity over the period; return an empty string where it has no values."""
    if curve is None or not curve.values:
        return ""
    e = curve.envelope()
    axes = time_axes(grid, float(e.low.min()), float(e.high.max()))
    return axes.chart(title, *draw_envelope(axes, e), x_title=TIME)
