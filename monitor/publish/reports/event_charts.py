"""Charts of the page of an event."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.events import Event, FirstMode, LimitTable, Review, Spectrum, compared
from monitor.publish.reports.charts import WIDTH, Axes
from monitor.publish.reports.page import rest
from monitor.publish.results.event_lines import with_interval

_HEIGHT, _TALL = 90.0, 220.0
"""Height of a curve over time, and of other charts, px."""
_MOST_CURVES = 12
"""Most channels or stories that are drawn. [count; judgement]"""
_MOST_LOOP_POINTS = 4000
"""Most points of a loop. [count; cost of the page]"""
_ROW = 34.0
"""Height of a story in the profile, px."""
_MARGIN = 1.06


def thinned(
    t: Annotated[Array, "n"], values: Annotated[Array, "n"]
) -> tuple[Annotated[Array, "k"], Annotated[Array, "k"]]:
    """Thin a curve to the least and the greatest value within each unit of a chart's width.

    Examples
    --------
    >>> t, x = thinned(np.arange(100_000.0), np.sin(np.arange(100_000.0)))
    >>> t.size <= 2 * WIDTH, bool(x.max() > 0.9999)
    (True, True)
    """
    per = -(-t.size // int(WIDTH))
    n = t.size // per * per
    if per <= 2 or not n:
        return t, values
    parts = values[:n].reshape(-1, per)
    low, high = parts.argmin(axis=1), parts.argmax(axis=1)
    first = np.arange(len(parts)) * per
    index = np.column_stack([np.minimum(low, high) + first, np.maximum(low, high) + first]).ravel()
    return t[index], values[index]


def accelerations(review: Review, channels: Sequence[str]) -> str:
    """Draw the acceleration of every channel and the ground over time, on one scale."""
    record = review.record
    curves = [(name, record.floors[:, i]) for i, name in enumerate(channels) if not record.still[i]]
    curves = curves[:_MOST_CURVES] + ([] if record.ground is None else [("ground", record.ground)])
    quiet = slice(0, max(record.strong.start, 1))
    centred = [(f"{name}: acceleration, m/s²", values - values[quiet].mean()) for name, values in curves]
    return _over_time(review, centred, len(channels) - _MOST_CURVES)


def drifts_over_time(review: Review, names: Sequence[str]) -> str:
    """Draw the drift of every story over time, on one scale."""
    known = [j for j in range(len(names)) if np.isfinite(review.drift_m[:, j]).all()]
    curves = [(f"{names[j]}: drift, mm", 1e3 * review.drift_m[:, j]) for j in known[:_MOST_CURVES]]
    return _over_time(review, curves, len(known) - _MOST_CURVES)


def _over_time(review: Review, curves: Sequence[tuple[str, Array]], left_out: int) -> str:
    """Draw curves over the time from the begin of the event, with strong motion shaded."""
    if not curves:
        return ""
    largest = _MARGIN * max(float(np.abs(values).max()) for _, values in curves) or 1.0
    span, strong = (float(review.t_s[0]), float(review.t_s[-1])), review.record.strong
    shade = (float(review.t_s[strong.start]), float(review.t_s[strong.stop - 1]))
    out = []
    for i, (title, values) in enumerate(curves):
        axes = Axes(span, (-largest, largest), _HEIGHT)
        marks = [axes.shade(shade, "known"), axes.line(*thinned(review.t_s, values), "measured")]
        last = i == len(curves) - 1
        out.append(axes.chart(title, *marks, numbers=last, x_title="time, s" if last else ""))
    return "".join(out) + rest(left_out, "drawn")


def story_map(event: Event, names: Sequence[str], limits: Sequence[LimitTable]) -> str:
    """Draw the stories above each other, coloured by the site's limits: red exceeded, green not, grey not judged."""
    rows = []
    for j, name in enumerate(names):
        state = _state(event, j, limits)
        least = "at least " if event.is_bound[j] else ""
        drift = f"{least}{1e3 * event.drift_m[j]:.3g} mm" if np.isfinite(event.drift_m[j]) else "not known"
        ratio = f" ({100 * event.drift_ratio[j]:.2g} %)" if np.isfinite(event.drift_ratio[j]) else ""
        loss = with_interval(100.0 * event.loss[j], 200.0 * event.loss_std[j])
        lost = f", lasting loss {loss} %" if np.isfinite(event.loss[j]) else ""
        words = {"beyond": "limit exceeded", "within": "within the limits", "unknown": "not judged"}[state]
        if state != "beyond" and any(compared(event, limit).possibly[j] for limit in limits):
            words = "limit possibly exceeded"
        said = f"drift {drift}{ratio}{lost}: {words}"
        rows.append(f'<div><b class="{state}">{escape(name)}</b><span>{escape(said)}</span></div>')
    return f'<div class="stories">{"".join(rows)}</div>'


def _state(event: Event, j: int, limits: Sequence[LimitTable]) -> str:
    """Say how a story stands against the limits: beyond one, within all that can be judged, or unknown."""
    compare = [compared(event, limit) for limit in limits]
    if any(c.least[j] > c.limit for c in compare):
        return "beyond"
    within = any(c.largest[j] <= c.limit for c in compare)
    of_drift = (c for c, limit in zip(compare, limits, strict=True) if limit.drift_ratio is not None)
    return "within" if within and all(c.largest[j] <= c.limit for c in of_drift) else "unknown"


def drift_profile(event: Event, names: Sequence[str], heights_m: Array | None, limits: Sequence[float]) -> str:
    """Draw the largest drift of each story over the height: its ratio with the limits, without heights the drift in mm."""
    n = len(names)
    thick = np.ones(n) if heights_m is None else heights_m
    top = np.cumsum(thick[::-1])[::-1]  # story 1 is the uppermost
    by_ratio = bool(np.isfinite(event.drift_ratio).any())
    scale = 100.0 / thick if by_ratio else np.full(n, 1e3)
    values, halves = event.drift_m * scale, 2.0 * event.drift_std_m * scale
    shown = [100.0 * limit for limit in limits] if by_ratio else []
    largest = _MARGIN * max(float(np.nanmax(values + np.nan_to_num(halves))), *shown, 0.0)
    axes = Axes((0.0, largest), (0.0, float(top[0])), max(_HEIGHT, min(_TALL, 2.0 * _ROW * n)))
    marks = []
    for j in np.flatnonzero(np.isfinite(values)):
        low, high = float(top[j] - thick[j]), float(top[j])
        marks.append(axes.shade((0.0, float(values[j])), "used", (low, high)))
        half = float(np.nan_to_num(halves[j]))
        middle = 0.5 * (low + high)
        ends = np.array([max(float(values[j]) - half, 0.0), float(values[j]) + half])
        marks.append(axes.line(ends, np.full(2, middle), "measured"))
    marks += [axes.line(np.full(2, limit), np.array(axes.y), "limit dashed") for limit in shown]
    unit, what = ("m", "height") if heights_m is not None else ("stories", "height")
    title = f"Largest drift {'ratio, %' if by_ratio else ', mm'}, over the {what} in {unit}".replace(" ,", ",")
    said = "Line: two standard deviations on either side." + (" Dashed red: the site's limits." if shown else "")
    x_title = "drift ratio, %" if by_ratio else "drift, mm"
    return axes.chart(title, *marks, x_title=x_title) + f"<p class='muted'>{said}</p>"


def first_mode(mode: FirstMode, review: Review) -> str:
    """Draw frequency, damping and level of the first mode over the time of the review."""
    span = (float(review.t_s[0]), float(review.t_s[-1]))
    series = (
        ("First mode: frequency, Hz", mode.hz, 2.0 * mode.hz_std),
        ("Damping ratio, %", 100.0 * mode.damping, 200.0 * mode.damping_std),
        ("Largest displacement relative to the ground, mm", 1e3 * mode.level_m, np.zeros(mode.t_s.size)),
    )
    out = []
    for i, (title, values, half) in enumerate(series):
        low, high = float((values - half).min()), float((values + half).max())
        pad = 0.06 * (high - low) + 1e-9
        axes = Axes(span, (low - pad, high + pad), _HEIGHT + 20.0)
        last = i == len(series) - 1
        out.append(
            axes.chart(title, axes.dots(mode.t_s, values, half), numbers=last, x_title="time, s" if last else "")
        )
    return "".join(out)


def loops(review: Review, names: Sequence[str]) -> str:
    """Draw the force of every story against its drift during strong motion."""
    assert review.force_n is not None
    strong, out = review.record.strong, []
    per = -(-(strong.stop - strong.start) // _MOST_LOOP_POINTS)
    for j, name in enumerate(names[:_MOST_CURVES]):
        drift, force = 1e3 * review.drift_m[strong, j][::per], review.force_n[strong, j][::per]
        x, y = (_MARGIN * float(np.abs(values).max()) or 1.0 for values in (drift, force))
        axes = Axes((-x, x), (-y, y), _TALL)
        out.append(axes.chart(f"{name}: force, N", axes.line(drift, force, "measured"), x_title="drift, mm"))
    pairs = (out[i : i + 2] for i in range(0, len(out), 2))
    drawn = "".join(f"<div class='pair'>{''.join(pair)}</div>" for pair in pairs)
    return drawn + rest(len(names) - _MOST_CURVES, "drawn")


def response_spectrum(spectrum: Spectrum, modes_hz: Array) -> str:
    """Draw the pseudo-acceleration over the period, with the periods of the modes."""
    period, values = spectrum.period_s, spectrum.pseudo_acceleration_m_s2
    axes = Axes((0.0, float(period[-1])), (0.0, _MARGIN * float(values.max())), _TALL)
    inside = [1.0 / hz for hz in modes_hz if 1.0 / hz < period[-1]]
    marks = [axes.line(np.full(2, p), np.array(axes.y), "before dashed") for p in inside]
    title = "Pseudo-acceleration at 5 % damping, m/s²"
    return axes.chart(title, *marks, axes.line(period, values, "after"), x_title="period, s")
