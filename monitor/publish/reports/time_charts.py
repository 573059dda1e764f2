"""Charts over time of a period report."""

from __future__ import annotations

import numpy as np

from monitor.publish.reports.charts import Axes
from monitor.publish.reports.period_data import Curve, Envelope, Grid, utc

HEIGHT = 110.0
"""Height of a curve, px."""
TIME = "time, UTC"
"""Title of the axis."""
_STEPS_S = (1, 5, 15, 60, 300, 900, 1800, 3600, 10800, 21600, 43200)
_STEPS_DAYS = (1, 2, 7, 14, 28, 91, 182, 364)


class TimeAxes(Axes):
    """Axes over time: x in s from 1970 UTC."""

    __slots__ = ()

    def x_ticks(self) -> list[tuple[float, str]]:
        """Return at most nine round times; their labels say the time of day above the date."""
        start, stop = self.x
        step = next((s for s in (*_STEPS_S, *(86400 * d for d in _STEPS_DAYS)) if (stop - start) / s <= 9), None)
        step = step or 86400 * 364 * int((stop - start) / (86400 * 364 * 9) + 1)
        places = np.arange(np.ceil(start / step), np.floor(stop / step) + 1) * step
        texts = [utc(1e9 * t) for t in places]
        end = 19 if step < 60 else 16
        labels = [text[:10] if step >= 86400 else f"{text[11:end]}\n{text[:10]}" for text in texts]
        return [(float(t), label) for t, label in zip(places, labels, strict=True)]


def time_axes(grid: Grid, low: float, high: float, height: float = HEIGHT) -> TimeAxes:
    """Make axes over a grid's time, with a margin above and below the range of values."""
    margin = 0.06 * (high - low) or 0.01 * abs(high) or 1.0
    return TimeAxes((grid.from_ns * 1e-9, grid.to_ns * 1e-9), (low - margin, high + margin), height)


def draw_envelope(axes: Axes, e: Envelope, scale: float = 1.0) -> list[str]:
    """Draw an envelope as a line of the mean in its band, interrupted where there are no values; a lone bin is a point."""
    marks = []
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
