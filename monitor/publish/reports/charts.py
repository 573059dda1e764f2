"""Charts as inline SVG: a few marks on axes, coloured by the page's style sheet, so that they follow light, dark and print.

Marks lie in a box that the page stretches to its own width.  Texts keep their size: they stand beside it at shares of the width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Annotated

import numpy as np

from monitor.core import Array

Range = tuple[float, float]

WIDTH = 1000.0
"""Width of a chart's box in its own units. [1; definition]"""
_NARROW_PX, _LETTER_PX = 270.0, 6.5
"""Width of a box on a page of 390 px, and of a letter of a tick's label. [px; measured]"""
_LEAST_HEIGHT_PX = 40.0
"""Height of a box from which it has ticks along y. [px; judgement]"""
STYLE = """
.chart { --left: 3.5rem; padding: 0 1.25rem 0 var(--left); } .heat { --left: 9.5rem; }
.chart figcaption { margin: 0 0 .3rem calc(-1 * var(--left)); color: var(--ink); font-weight: 600; font-size: .8rem; }
svg { display: block; width: 100%; overflow: visible; }
svg * { vector-effect: non-scaling-stroke; }
svg text { font: 12px system-ui, sans-serif; fill: var(--muted); }
svg .frame { fill: none; stroke: var(--line); }
svg .grid { stroke: var(--line); stroke-width: .5; }
svg .line { fill: none; stroke-width: 1.4; stroke-linejoin: round; }
svg .measured { stroke: var(--ink); stroke-width: 1; }
svg .before { stroke: var(--before); }
svg .after { stroke: var(--after); }
svg .dashed { stroke-dasharray: 5 3; }
svg .dot { stroke: var(--after); stroke-width: 6; stroke-linecap: round; }
svg .bar { fill: var(--quiet); } svg .accepted { fill: var(--after); } svg .rival { fill: var(--before); }
svg .off { fill: var(--before); opacity: .16; }
svg .still { fill: var(--bad); opacity: .25; }
svg .band { fill: var(--after); opacity: .25; }
svg .limit { stroke: var(--bad); }
svg .used { fill: var(--after); opacity: .6; }
svg .chance { fill: var(--quiet); opacity: .25; }
svg .unjudged { fill: var(--muted); opacity: .3; }
svg .cut { fill: var(--quiet); opacity: .55; }
svg .known { fill: var(--muted); opacity: .13; }
.unseen svg svg { opacity: .35; }
.bars div { display: grid; grid-template-columns: 16rem 1fr; gap: .6rem; padding-right: 4rem; font-size: .8rem; }
.bars span { text-align: right; color: var(--muted); } .bars .name { color: var(--ink); font-weight: 600; }
@media screen and (max-width: 640px) { svg .more { display: none; }
  .bars div { grid-template-columns: 1fr; gap: 0; } .bars span { text-align: left; } }
"""
"""Uses the page's colours --ink, --muted, --line, --quiet, --before, --after and --bad."""


@dataclass(frozen=True, slots=True)
class Axes:
    """Axes of a chart, which map data to places in its box and draw the frame, the ticks and the marks."""

    x: Range
    y: Range
    height: float
    """Height of the box, px."""
    log_y: bool = False
    x_names: Sequence[str] = ()
    """What x counts, if it counts named things."""
    y_names: Sequence[str] = ()
    """What y counts in rows, from the top."""

    def px(self, x: Array | float) -> Array:
        """Return horizontal places, 0 at the left to `WIDTH` at the right, of the shape of `x`."""
        return np.asarray((np.asarray(x, dtype=float) - self.x[0]) / (self.x[1] - self.x[0]) * WIDTH)

    def py(self, y: Array | float) -> Array:
        """Return vertical places in px from the top, of the shape of `y`; values outside the range lie at its edge."""
        y, (low, high) = np.asarray(y, dtype=float), self.y
        if self.log_y:
            y, low, high = np.log(np.maximum(y, 1e-300)), np.log(low), np.log(high)
        return np.asarray((1.0 - np.clip((y - low) / (high - low), 0.0, 1.0)) * self.height)

    def chart(self, title: str, *marks: str, x_title: str = "", numbers: bool = True, kind: str = "") -> str:
        """Write the chart with its title, frame, grid and ticks; `numbers` tells whether the ticks along x have labels."""
        at_x = [(float(self.px(value)), label.split("\n")) for value, label in self.x_ticks()]
        at_y = [(float(self.py(value)), label) for value, label in self.y_ticks()]
        grid = [f'<path class="grid" d="M{place:.1f} 0V{self.height:g}"/>' for place, _ in at_x]
        grid += [f'<path class="grid" d="M0 {place:.1f}H{WIDTH:g}"/>' for place, _ in at_y]
        words = [text("-6", place + 4.0, label, "end") for place, label in at_y]
        free = -np.inf  # where a narrow page has room for the next label
        for place, lines in at_x if numbers else []:
            half = 0.5 * (max(map(len, lines)) + 1) * _LETTER_PX / _NARROW_PX * WIDTH
            hidden = "more" if place - half < free else ""
            free = free if hidden else place + half
            for row, line in enumerate(lines):
                words.append(text(_share(place), self.height + 15.0 + 14.0 * row, line, "middle", hidden))
        below = 15.0 + 14.0 * max((len(lines) for _, lines in at_x), default=1) if numbers else 0.0
        if x_title:
            words.append(text("100%", self.height + below, x_title, "end"))
            below += 14.0
        frame = f'<rect class="frame" width="{WIDTH:g}" height="{self.height:g}"/>'
        size = (
            f'viewBox="0 0 {WIDTH:g} {self.height:g}" preserveAspectRatio="none" width="100%" height="{self.height:g}"'
        )
        box = f"<svg {size}>{''.join([*grid, *marks, frame])}</svg>"
        drawing = svg(self.height + below, title, box, *words)
        return f'<figure class="chart{kind}"><figcaption>{escape(title)}</figcaption>{drawing}</figure>'

    def x_ticks(self) -> list[tuple[float, str]]:
        """Return the values and the labels of the ticks along x."""
        if self.x_names:
            return [(float(i), name) for i, name in enumerate(self.x_names)]
        return [(float(value), f"{value:.6g}") for value in ticks(self.x)]

    def y_ticks(self) -> list[tuple[float, str]]:
        """Return the values and the labels of the ticks along y; none on a strip."""
        if self.y_names:
            return [(len(self.y_names) - 0.5 - i, name) for i, name in enumerate(self.y_names)]
        if self.height < _LEAST_HEIGHT_PX:
            return []
        return [(float(value), f"{value:.6g}") for value in (decades(self.y) if self.log_y else ticks(self.y, 4))]

    def band(self, x: Annotated[Array, "n"], low: Annotated[Array, "n"], high: Annotated[Array, "n"], kind: str) -> str:
        """Draw the area between two lines, in the units of the axes."""
        sides = (*zip(self.px(x), self.py(high), strict=True), *zip(self.px(x)[::-1], self.py(low)[::-1], strict=True))
        return f'<polygon class="{kind}" points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in sides)}"/>'

    def line(self, x: Annotated[Array, "n"], y: Annotated[Array, "n"], kind: str) -> str:
        """Draw a polyline."""
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(self.px(x), self.py(y), strict=True))
        return f'<polyline class="line {kind}" points="{points}"/>'

    def dots(self, x: Annotated[Array, "n"], y: Annotated[Array, "n"], half: Annotated[Array, "n"]) -> str:
        """Draw points with intervals of `half` on either side."""
        out = []
        for a, b, h in zip(self.px(x), y, half, strict=True):
            low, middle, high = self.py(b - h), self.py(b), self.py(b + h)
            out.append(f'<path class="line measured" d="M{a:.1f} {low:.1f}V{high:.1f}"/>')
            out.append(f'<path class="dot" d="M{a:.1f} {middle:.1f}h0"/>')  # the end of a line: round at any width
        return "".join(out)

    def shade(self, x: Range, kind: str, y: Range | None = None) -> str:
        """Draw a rectangle over a range of x, of full height unless `y` is given."""
        a, b = self.px(x[0]), self.px(x[1])
        high, low = self.py((y or self.y)[1]), self.py((y or self.y)[0])
        return f'<rect class="{kind}" x="{a:.1f}" y="{high:.1f}" width="{b - a:.1f}" height="{low - high:.1f}"/>'


def svg(height: float, label: str, *marks: str) -> str:
    """Put marks, SVG elements, into one as wide as the page and `height` px high; `label` is for readers who do not see it.

    Examples
    --------
    >>> svg(10, "a < b", '<path d="M0 0h5"/>')
    '<svg height="10" role="img" aria-label="a &lt; b"><path d="M0 0h5"/></svg>'
    """
    return f'<svg height="{height:g}" role="img" aria-label="{escape(label)}">{"".join(marks)}</svg>'


def _share(place: float) -> str:
    """Write a place in a box as a share of its width."""
    return f"{100.0 * place / WIDTH:.2f}%"


def text(x: str, y: float, words: str, anchor: str = "start", kind: str = "") -> str:
    """Write words at a place: `x` as a share of the width or in px, `y` in px.

    Examples
    --------
    >>> text("50%", 4, "mode 1")
    '<text x="50%" y="4.0" text-anchor="start">mode 1</text>'
    """
    kind = f' class="{kind}"' if kind else ""
    return f'<text x="{x}" y="{y:.1f}" text-anchor="{anchor}"{kind}>{escape(words)}</text>'


def ticks(span: Range, n: int = 8) -> Annotated[Array, "k"]:
    """Return about `n` round numbers within a range and never fewer than three.

    Examples
    --------
    >>> ticks((0.0, 1.0), 4).tolist()
    [0.0, 0.5, 1.0]
    >>> [round(f, 2) for f in ticks((4.71, 4.92), 4).tolist()]
    [4.75, 4.8, 4.85, 4.9]
    """
    raw = (span[1] - span[0]) / n
    power = 10.0 ** np.floor(np.log10(raw))
    coarsest = min((m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw * 0.999), default=10.0)
    for multiple in (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1):
        step = multiple * power
        places = np.arange(np.ceil(span[0] / step - 1e-9), np.floor(span[1] / step + 1e-9) + 1.0)
        if multiple <= coarsest and places.size >= 3:
            break
    return np.asarray((places + 0.0) * step)  # never -0


def decades(span: Range) -> Annotated[Array, "k"]:
    """Return powers of ten within a range, and multiples of them where the range has few powers."""
    low, high = np.log10(span[0]), np.log10(span[1])
    powers = np.arange(np.floor(low), np.ceil(high) + 1)
    wide = max(1, round((high - low) / 5))
    fine = [1.0, 2.0, 5.0] if high - low > 0.6 else [1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 8.0]
    values = 10.0 ** powers[::wide] if high - low > 2.0 else np.outer(10.0**powers, fine).ravel()
    return np.asarray(values[(values >= span[0] * 0.999) & (values <= span[1] * 1.001)])


def bars(names: Sequence[str], values: Sequence[float], kinds: Sequence[str], label: str) -> str:
    """Draw horizontal bars with their names and values; the axis reaches to ten at least."""
    axes = Axes((min(0.0, *values), max(10.0, *values)), (0.0, 1.0), 14.0)
    zero = float(axes.px(0.0))
    rows = []
    for name, value, kind in zip(names, values, kinds, strict=True):
        end = float(axes.px(value))
        span = f'x="{_share(min(zero, end))}" width="{_share(abs(end - zero))}" height="14"'
        after = f'<svg x="{_share(max(end, zero))}">{text("5", 11.0, f"{value:.1f}")}</svg>'
        drawing = svg(20.0, f"{name}: {value:.1f}", f'<rect class="bar {kind}" {span}/>', after)
        style = ' class="name"' if kind else ""
        rows.append(f"<div><span{style}>{escape(name)}</span>{drawing}</div>")
    return f'<div class="bars" aria-label="{escape(label)}">{"".join(rows)}</div>'


def heat(values: Annotated[Array, "rows columns"], x: Range, rows: Sequence[str], limit: float, title: str) -> str:
    """Draw a map of signed values: blue below zero, red above, full colour from +-`limit` on."""
    row = 16.0
    axes = Axes(x, (0.0, float(len(rows))), row * len(rows), y_names=rows)
    edges = axes.px(np.linspace(*x, values.shape[1] + 1))
    out = []
    for i in range(len(rows)):
        for value, a, b in zip(values[i], edges[:-1], edges[1:], strict=True):
            strength = min(abs(value) / limit, 1.0)
            if strength > 0.1:
                kind = "var(--bad)" if value > 0 else "var(--after)"
                box = f'x="{a:.1f}" y="{row * i:g}" width="{b - a:.1f}" height="{row:g}"'
                out.append(f'<rect {box} fill="{kind}" fill-opacity="{strength:.2f}"/>')
    return axes.chart(title, *out, x_title="frequency, Hz", kind=" heat")
