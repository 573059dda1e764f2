"""Two plots of the estimates as SVG: errors over their bounds, and the tails of what the intervals leave out."""

from __future__ import annotations

from math import erfc, log10, sqrt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from monitor.core import write_atomically

if TYPE_CHECKING:
    from tests.statistics.estimates import Estimates

_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 640, 320, 60, 40, 50
_REFINED, _SUBSPACE, _REFERENCE = "#1f6fb4", "#c8641e", "#777"
_QUANTITIES = ("frequency", "damping", "stiffness", "ddi")


def write(estimates: dict[str, Estimates], spread: float, directory: Path) -> None:
    """Write ``estimates-efficiency-S.svg`` and ``estimates-tails-S.svg``, S the level's spread in percent."""
    percent = round(100.0 * spread)
    for name, drawing in (("efficiency", _efficiency(estimates, percent)), ("tails", _tails(estimates, percent))):
        write_atomically(directory / f"estimates-{name}-{percent}.svg", drawing)


def _efficiency(estimates: dict[str, Estimates], percent: int) -> str:
    """RMSE over the Cramer-Rao bound, modes or stories 1 to 3 side by side."""
    low, high = 0.9, 1.7
    marks = [_axis(y, low, high, f"{y:.1f}") for y in np.arange(0.9, 1.71, 0.1)]
    marks.append(_line(_LEFT, _y(1.0, low, high), _WIDTH - 10, _y(1.0, low, high), _REFERENCE, 2.0))
    room = (_WIDTH - _LEFT - 10) / len(_QUANTITIES)
    for column, quantity in enumerate(_QUANTITIES):
        middle = _LEFT + (column + 0.5) * room
        marks.append(_text(middle, _HEIGHT - 28, "damage index" if quantity == "ddi" else quantity, "middle"))
        for name, colour, radius in ((f"subspace {quantity}", _SUBSPACE, 4), (quantity, _REFINED, 5)):
            for place, value in enumerate(estimates[name].efficiency if name in estimates else ()):
                x, y = middle + (place - 1) * room / 5, _y(min(value, high), low, high)
                marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}"/>')
                marks.append(_text(x, _HEIGHT - 12, str(place + 1), "middle") if name == quantity else "")
    return _page(f"RMSE over the Cramer-Rao bound, level wandering by {percent} %", marks)


def _tails(estimates: dict[str, Estimates], percent: int) -> str:
    """Share of errors beyond t stated deviations against the normal distribution's, t from 0 to 5."""
    low, high = -5.0, 0.0
    across = (_WIDTH - _LEFT - 10) / 5.0
    marks = [_axis(y, low, high, f"1e{y:.0f}") for y in np.arange(low, high + 0.5)]
    marks += [_text(_LEFT + t * across, _HEIGHT - 30, str(t), "middle") for t in range(6)]
    marks.append(_text(_WIDTH / 2, _HEIGHT - 10, "error over its stated standard deviation", "middle"))
    t = np.linspace(0.0, 4.4, 89)
    curves = [(_REFERENCE, np.array([erfc(x / sqrt(2.0)) for x in t]))]
    for name, colour in (("subspace stiffness", _SUBSPACE), ("ddi", _REFINED)):
        z = np.abs(estimates[name].z).ravel()
        curves.append((colour, np.array([(z > x).mean() for x in t])))
    for colour, share in curves:
        seen = [(x, log10(s)) for x, s in zip(t, share, strict=True) if s > 10.0**low]
        points = " ".join(f"{_LEFT + x * across:.1f},{_y(s, low, high):.1f}" for x, s in seen)
        marks.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>')
    return _page(f"Share of errors beyond, all stories, level wandering by {percent} %; grey: normal", marks)


def _y(value: float, low: float, high: float) -> float:
    return _TOP + (high - value) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)


def _line(x1: float, y1: float, x2: float, y2: float, colour: str, width: float) -> str:
    return f'<path d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}" stroke="{colour}" stroke-width="{width}"/>'


def _text(x: float, y: float, text: str, anchor: str, colour: str = "#222") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{text}</text>'


def _axis(value: float, low: float, high: float, label: str) -> str:
    y = _y(value, low, high)
    return _line(_LEFT, y, _WIDTH - 10, y, "#ddd", 1.0) + _text(_LEFT - 8, y + 4, label, "end")


def _page(title: str, marks: list[str]) -> str:
    key = _text(_WIDTH - 110, 34, "refined", "end", _REFINED) + _text(
        _WIDTH - 12, 34, "subspace alone", "end", _SUBSPACE
    )
    body = "\n".join(mark for mark in marks if mark)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif" font-size="12">\n'
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>\n{_text(_LEFT, 18, title, "start")}{key}\n{body}\n</svg>\n'
    )
