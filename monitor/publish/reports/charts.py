"""Charts as inline SVG: a few marks on axes, coloured by the page's style sheet, so that they follow light, dark and print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from monitor.core import Array

Range = tuple[float, float]

STYLE = """
svg { display: block; width: 100%; height: auto; }
svg text { font: 11px system-ui, sans-serif; fill: var(--muted); }
svg .name { fill: var(--ink); font-weight: 600; }
svg .frame { fill: none; stroke: var(--line); }
svg .grid { stroke: var(--line); stroke-width: .5; }
svg .line { fill: none; stroke-width: 1.4; stroke-linejoin: round; }
svg .measured { stroke: var(--ink); stroke-width: 1; }
svg .before { stroke: var(--before); }
svg .after { stroke: var(--after); }
svg .dashed { stroke-dasharray: 5 3; }
svg .bar, svg .dot { fill: var(--quiet); }
svg .accepted, svg .dot { fill: var(--after); }
svg .rival { fill: var(--before); }
svg .off { fill: var(--before); opacity: .16; }
svg .still { fill: var(--bad); opacity: .25; }
svg .band { fill: var(--after); opacity: .25; }
svg .limit { stroke: var(--bad); }
svg .good { fill: var(--good); opacity: .6; }
svg .chance { fill: var(--quiet); opacity: .25; }
svg .known { fill: var(--muted); opacity: .13; }
"""
"""Uses the page's colours --ink, --muted, --line, --quiet, --before, --after, --good and --bad."""


@dataclass(frozen=True, slots=True)
class Axes:
    """Axes of a chart, which map data to places in its box and draw the frame, the ticks and the marks."""

    x: Range
    y: Range
    box: tuple[float, float, float, float]
    """Left, top, width, height, px."""
    log_y: bool = False

    def px(self, x: Array | float) -> Array:
        """Return horizontal places in px, of the shape of `x`."""
        left, _, width, _ = self.box
        return np.asarray(left + (np.asarray(x, dtype=float) - self.x[0]) / (self.x[1] - self.x[0]) * width)

    def py(self, y: Array | float) -> Array:
        """Return vertical places in px, of the shape of `y`; values outside the range lie at its edge."""
        _, top, _, height = self.box
        y, (low, high) = np.asarray(y, dtype=float), self.y
        if self.log_y:
            y, low, high = np.log(np.maximum(y, 1e-300)), np.log(low), np.log(high)
        return np.asarray(top + (1.0 - np.clip((y - low) / (high - low), 0.0, 1.0)) * height)

    def frame(self, title: str, x_title: str = "", *, numbers: bool = True) -> str:
        """Draw the frame, the grid, the ticks and the titles."""
        left, top, width, height = self.box
        out = []
        for value, label in self.x_ticks():
            place = float(self.px(value))
            out.append(f'<path class="grid" d="M{place:.1f} {top:g}v{height:g}"/>')
            if numbers:
                out.append(text(place, top + height + 14, label, "middle"))
        for value in (decades(self.y) if self.log_y else ticks(self.y, 4)) if height > 40.0 else ():
            place = float(self.py(value))
            out.append(f'<path class="grid" d="M{left:g} {place:.1f}h{width:g}"/>')
            out.append(text(left - 6, place + 4, f"{value:.6g}", "end"))
        out.append(f'<rect class="frame" x="{left:g}" y="{top:g}" width="{width:g}" height="{height:g}"/>')
        out.append(text(left, top - 6, title, "start", "name"))
        if x_title:
            out.append(text(left + width, top + height + 28, x_title, "end"))
        return "".join(out)

    def x_ticks(self) -> list[tuple[float, str]]:
        """Return the values and the labels of the ticks along x."""
        return [(float(value), f"{value:.6g}") for value in ticks(self.x)]

    def band(self, x: Array, low: Array, high: Array, kind: str) -> str:
        """Draw the area between two lines; `x`, `low`, `high` of shape (n,), in the units of the axes."""
        sides = (*zip(self.px(x), self.py(high), strict=True), *zip(self.px(x)[::-1], self.py(low)[::-1], strict=True))
        return f'<polygon class="{kind}" points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in sides)}"/>'

    def line(self, x: Array, y: Array, kind: str) -> str:
        """Draw a polyline; `x`, `y` of shape (n,)."""
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(self.px(x), self.py(y), strict=True))
        return f'<polyline class="line {kind}" points="{points}"/>'

    def dots(self, x: Array, y: Array, half: Array) -> str:
        """Draw points with intervals of `half` on either side; all of shape (n,)."""
        out = []
        for a, b, h in zip(self.px(x), y, half, strict=True):
            low, middle, high = self.py(b - h), self.py(b), self.py(b + h)
            out.append(f'<path class="line measured" d="M{a:.1f} {low:.1f}V{high:.1f}"/>')
            out.append(f'<circle class="dot" cx="{a:.1f}" cy="{middle:.1f}" r="3"/>')
        return "".join(out)

    def shade(self, x: Range, kind: str, y: Range | None = None) -> str:
        """Draw a rectangle over a range of x, of full height unless `y` is given."""
        a, b = self.px(x[0]), self.px(x[1])
        high, low = self.py((y or self.y)[1]), self.py((y or self.y)[0])
        return f'<rect class="{kind}" x="{a:.1f}" y="{high:.1f}" width="{b - a:.1f}" height="{low - high:.1f}"/>'


def svg(width: float, height: float, label: str, *marks: str) -> str:
    """Put marks into an SVG element.

    Parameters
    ----------
    width, height : float
        Size of the drawing, px.
    label : str
        What the drawing shows, in words, for readers who do not see it.
    *marks : str
        SVG elements.

    Examples
    --------
    >>> svg(20, 10, "a < b", '<path d="M0 0h5"/>')
    '<svg viewBox="0 0 20 10" role="img" aria-label="a &lt; b"><path d="M0 0h5"/></svg>'
    """
    label = escape(label)
    return f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}">{"".join(marks)}</svg>'


def text(x: float, y: float, words: str, anchor: str = "start", kind: str = "") -> str:
    """Write words at a place of the drawing, px.

    Examples
    --------
    >>> text(3, 4, "mode 1")
    '<text x="3.0" y="4.0" text-anchor="start">mode 1</text>'
    """
    kind = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{kind}>{escape(words)}</text>'


def ticks(span: Range, n: int = 8) -> Array:
    """Return about `n` round numbers within a range, shape (k,).

    Examples
    --------
    >>> ticks((0.0, 1.0), 4).tolist()
    [0.0, 0.5, 1.0]
    """
    raw = (span[1] - span[0]) / n
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw * 0.999), default=10.0)
    places = np.arange(np.ceil(span[0] / step - 1e-9), np.floor(span[1] / step + 1e-9) + 1.0)
    return np.asarray((places + 0.0) * step)  # never -0


def decades(span: Range) -> Array:
    """Return powers of ten within a range, shape (k,), and multiples of them where the range has few powers."""
    low, high = np.log10(span[0]), np.log10(span[1])
    powers = np.arange(np.floor(low), np.ceil(high) + 1)
    wide = max(1, round((high - low) / 5))
    fine = [1.0, 2.0, 5.0] if high - low > 0.6 else [1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0]
    values = 10.0 ** powers[::wide] if high - low > 2.0 else np.outer(10.0**powers, fine).ravel()
    return np.asarray(values[(values >= span[0] * 0.999) & (values <= span[1] * 1.001)])


def bars(names: Sequence[str], values: Sequence[float], kinds: Sequence[str], label: str) -> str:
    """Draw horizontal bars with their names and values; the axis reaches to ten at least."""
    width, row, left, right = 1080.0, 20.0, 260.0, 70.0
    low, high = min(0.0, *values), max(10.0, *values)
    axes = Axes((low, high), (0.0, 1.0), (left, 0.0, width - left - right, row * len(names)))
    zero = float(axes.px(0.0))
    out = []
    for i, (name, value, kind) in enumerate(zip(names, values, kinds, strict=True)):
        end, y = float(axes.px(value)), row * i + 3
        out.append(text(left - 8, y + 11, name, "end", "name" if kind else ""))
        out.append(
            f'<rect class="bar {kind}" x="{min(zero, end):.1f}" y="{y:g}" width="{abs(end - zero):.1f}" height="14"/>'
        )
        out.append(text(max(end, zero) + 5, y + 11, f"{value:.1f}"))
    return svg(width, row * len(names), label, *out)


def heat(values: Array, x: Range, rows: Sequence[str], limit: float, title: str, label: str) -> str:
    """Draw a map of signed values, shape (rows, columns): blue below zero, red above, full colour from +-`limit` on."""
    width, row, left, top = 530.0, 16.0, 150.0, 20.0
    height = row * len(rows)
    axes = Axes(x, (0.0, 1.0), (left, top, width - left - 8, height))
    edges = axes.px(np.linspace(*x, values.shape[1] + 1))
    out = [text(left, top - 6, title, "start", "name")]
    for i, name in enumerate(rows):
        y = top + row * i
        out.append(text(left - 6, y + 12, name, "end"))
        for value, a, b in zip(values[i], edges[:-1], edges[1:], strict=True):
            strength = min(abs(value) / limit, 1.0)
            if strength > 0.1:
                kind = "var(--bad)" if value > 0 else "var(--after)"
                box = f'x="{a:.1f}" y="{y:g}" width="{b - a:.1f}" height="{row:g}"'
                out.append(f'<rect {box} fill="{kind}" fill-opacity="{strength:.2f}"/>')
    for value in ticks(x):
        out.append(text(float(axes.px(value)), top + height + 14, f"{value:g}", "middle"))
    out.append(f'<rect class="frame" x="{left:g}" y="{top:g}" width="{width - left - 8:g}" height="{height:g}"/>')
    out.append(text(width - 8, top + height + 28, "frequency, Hz", "end"))
    return svg(width, top + height + 34, label, *out)
