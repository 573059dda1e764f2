"""Page of a quick look at recordings without a model: modes and doubts first, then the diagrams they come from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from monitor.core import Array, ModalEstimate, Skipped
from monitor.identification import SingleMode
from monitor.publish.page.charts import Chart
from monitor.publish.page.sheet import Sheet
from monitor.publish.reports.look_data import G_M_S2, LookedBand, LookedMode, LookedRecording
from monitor.publish.results.event_lines import with_interval

_MOST_POINTS = 700
"""Most points of a spectrum's line; of the bins that fall on one the strongest is drawn. [count; cost]"""
_MOST_ROWS = 200
"""Most rows of a spectrogram. [count; cost]"""
_MOST_PEAKS = 20
"""Most peaks without a mode that are named in words. [count; judgement: a line]"""
_BEYOND_MODES = 1.5
"""Highest frequency of the diagrams, over that of the highest mode. [1; judgement]"""
_QUANTILES = (0.05, 0.999)
"""Shares of a spectrogram's values at the ends of its colours. [1; judgement]"""
_HZ = "frequency, Hz"


def write_look(path: Path, found: LookedRecording) -> None:
    """Write the page; the file appears under its name only when complete."""
    look_sheet(found).write(path)


def look_sheet(found: LookedRecording) -> Sheet:
    """Make the page."""
    highest = max((mode.frequency_hz for mode in found.modes), default=np.inf)
    top_hz = float(min(found.hz[-1], _BEYOND_MODES * highest))
    files = ", ".join(Path(name).name for name in found.files)
    kind, word = ("doubtful", "doubts") if found.doubts else ("normal", "looked at")
    sure = sum(number is not None for number, _ in found.numbered())
    count = f"{sure} {'mode' if sure == 1 else 'modes'}"
    sheet = Sheet(f"Look: {files}", files, kind, word, headline=f"{count} in {files}")
    _head(sheet, found)
    _modes(sheet, found)
    _shapes(sheet, found)
    stable = [_stabilisation(found, band) for band in found.bands if isinstance(band.modes, ModalEstimate)]
    if stable:
        sheet.section("Stabilisation diagrams")
        sheet.draw(*stable)
        sheet.note(
            "Each point is a pole of one order; blue: it recurs from the next lower order. Orange lines: modes that were chosen. "
            "Line: first singular value of the spectral matrix. Lower rates resolve lower modes."
        )
    sheet.section("Spectra")
    sheet.draw(*_spectra(found, top_hz))
    if pictures := spectrograms(found, top_hz):
        sheet.section("Spectrograms")
        sheet.draw(*pictures)
    _data(sheet, found)
    return sheet


def mode_rows(found: LookedRecording) -> list[list[str]]:
    """Write the table of modes: number, frequency, damping, both of the second opinion, and what is to say."""
    return [_row(str(number), mode) for number, mode in found.numbered() if number is not None]


def doubtful_rows(found: LookedRecording) -> list[list[str]]:
    """Write the doubtful modes, which stand below that table, without a number."""
    return [_row("", mode) for number, mode in found.numbered() if number is None]


def peaks_in_words(found: LookedRecording) -> str:
    """Name the peaks of the spectra without a mode, the lowest of many; empty where there are none."""
    named = ", ".join(f"{hz:.4g}" for hz in found.peaks_hz[:_MOST_PEAKS])
    more = len(found.peaks_hz) - _MOST_PEAKS
    rest = f", and {more} higher ones (look.json)" if more > 0 else ""
    return f"peaks of the spectra that no mode explains: {named} Hz{rest}" if named else ""


def _row(number: str, mode: LookedMode) -> list[str]:
    return [number, *_intervals(mode), *_intervals(mode.second), _says(mode)]


def _intervals(mode: LookedMode | SingleMode | Skipped) -> tuple[str, str]:
    """Write frequency and damping of an opinion, Hz and %, with two standard deviations."""
    if isinstance(mode, Skipped):
        return "-", "-"
    damping = with_interval(100.0 * mode.damping_ratio, 200.0 * mode.damping_std, 5)
    return with_interval(mode.frequency_hz, 2.0 * mode.frequency_std_hz, 5), damping


def _says(mode: LookedMode) -> str:
    """Say what is to know of a mode beside its numbers."""
    said = [mode.doubt] if mode.doubt else []
    if mode.differs:
        said.append(f"the two opinions differ in {mode.differs}: its interval is wider for that")
    if mode.collinearity < 0.9:
        said.append("the shape is complex")
    return "; ".join(said)


def _head(sheet: Sheet, found: LookedRecording) -> None:
    """Write the doubts, the key figures and the notes."""
    sheet.section("What was looked at")
    sheet.items(found.doubts, "doubts")
    sheet.figures([
        (f"{found.rate_hz:g} Hz", "sampling rate"),
        (_duration(found.duration_s), f"from {str(np.datetime64(found.t_start_ns, 'ns'))[:19]} UTC"),
        (f"{len(found.channels)}", f"channels: {', '.join(found.channels)}"),
        (f"{found.rms_m_s2.mean():.3g} m/s²", f"mean RMS acceleration, {found.rms_m_s2.mean() / G_M_S2:.2g} g"),
    ])  # fmt: skip
    for note in found.notes:
        sheet.note(note)


def _duration(seconds: float) -> str:
    """Write a length of time in its unit."""
    if seconds >= 5400:
        return f"{seconds / 3600:.2f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 300 else f"{seconds:.1f} s"


def _modes(sheet: Sheet, found: LookedRecording) -> None:
    sheet.section("Modes")
    rows, below = mode_rows(found), doubtful_rows(found)
    if not rows and below:
        sheet.text("None that is sure.")
    elif not rows:
        reasons = {band.modes.reason for band in found.bands if isinstance(band.modes, Skipped)}
        sheet.text(f"None found: {'; '.join(sorted(reasons)) or 'the record is too short'}.")
    head = ["mode", "#frequency, Hz", "#damping, %", "#second opinion, Hz", "#second opinion, %", "remark"]
    shown = len(head) if any(row[-1] for row in rows) else len(head) - 1
    sheet.table(head[:shown], [row[:shown] for row in rows])
    if below:
        sheet.text("Doubtful: modes that one opinion alone shows, or whose damping is hardly told.")
        sheet.table(head[1:], [row[1:] for row in below])
    words = peaks_in_words(found)
    sheet.text(words[:1].upper() + words[1:])
    if not found.modes:
        return
    sheet.note(
        "Chosen without a model: poles of the stochastic subspace identification that stay the same over its orders, refined by "
        "maximum likelihood where there are enough data. The second opinion fits the spectrum about each peak alone "
        "(frequency-spatial domain decomposition). ± is two standard deviations, about 95 %."
    )


def _shapes(sheet: Sheet, found: LookedRecording) -> None:
    """Draw the mode shapes over the channels."""
    if not found.modes or len(found.channels) < 2:
        return
    c, charts = len(found.channels), []
    for number, mode in found.numbered():
        title = f"{f'mode {number}' if number else 'doubtful'}: {mode.frequency_hz:.4g} Hz"
        chart = Chart(title, (-0.3, c - 0.7), (-1.15, 1.15), x_names=found.channels).level(0.0, "measured dashed")
        chart.line(np.arange(1.0 * c), mode.shape.real).dots(np.arange(1.0 * c), mode.shape.real, 2.0 * mode.shape_std)
        charts.append(chart)
    sheet.section("Mode shapes")
    sheet.draw(*charts, size="small")


def _stabilisation(found: LookedRecording, band: LookedBand) -> Chart:
    """Draw the stabilisation diagram of a band: poles by frequency and order, and the modes that were chosen."""
    assert isinstance(band.modes, ModalEstimate)
    orders, hz, _, stable = band.modes.poles.T
    low, high = band.band_hz
    top = float(orders.max()) + 2.0
    title = f"order of the model, at {band.rate_hz:g} samples a second"
    chart = Chart(title, (low, high), (0.0, top), 240.0, x_title=_HZ)
    inside = (found.hz >= low) & (found.hz <= high)
    level = np.log10(np.maximum(found.singular_values[0, inside], 1e-300))
    if inside.sum() > 2 and np.ptp(level) > 0:
        chart.line(*_pooled(found.hz[inside], (level - level.min()) / np.ptp(level) * 0.9 * top), "measured")
    for kind, chosen in (("pole", stable == 0.0), ("stable", stable == 1.0)):
        chart.dots(hz[chosen], orders[chosen], kind=kind)
    return _with_modes(chart, band.modes.frequencies_hz.tolist())


def _with_modes(chart: Chart, frequencies_hz: list[float]) -> Chart:
    """Draw the modes that were chosen as upright lines."""
    for hz in frequencies_hz:
        chart.line((hz, hz), chart.y, "chosen")
    return chart


def _spectra(found: LookedRecording, top_hz: float) -> list[Chart]:
    """Draw the singular values of the spectral matrix, and the spectrum of every channel."""
    charts = []
    inside = (found.hz > 0.0) & (found.hz <= top_hz)
    values = found.singular_values[:, inside]
    if len(found.channels) > 1:
        title = "singular values of the spectral matrix, (m/s²)²/Hz; orange: modes"
        chart = Chart(title, (0.0, top_hz), _decades(values), 220.0, log=True, x_title=_HZ)
        _with_modes(chart, [mode.frequency_hz for mode in found.modes])
        for k, row in enumerate(values):
            chart.line(*_pooled(found.hz[inside], row), "measured" if k else "after")
        charts.append(chart)
    band = _decades(found.power[:, 1:])
    for name, row in zip(found.channels, found.power, strict=True):
        title = f"{name}: power spectral density, (m/s²)²/Hz, to half the rate"
        chart = Chart(title, (0.0, float(found.hz[-1])), band, log=True, x_title=_HZ)
        charts.append(chart.line(*_pooled(found.hz[1:], row[1:]), "measured"))
    return charts


def _decades(values: Array) -> tuple[float, float]:
    """Return whole decades about positive values, at most eight."""
    high = np.ceil(np.log10(max(float(values.max()), 1e-290)))
    positive = values[values > 0.0]
    low = np.floor(np.log10(float(np.quantile(positive, 0.002)))) if positive.size else high - 1.0
    return float(10.0 ** max(low, high - 8.0)), float(10.0**high)


def _pooled(x: Annotated[Array, "n"], y: Annotated[Array, "n"]) -> tuple[Annotated[Array, "k"], Annotated[Array, "k"]]:
    """Draw together neighbouring points of a line to at most `_MOST_POINTS`: the largest y of each group."""
    per = -(-len(x) // _MOST_POINTS)
    if per == 1:
        return x, y
    n = len(x) // per * per
    at = y[:n].reshape(-1, per).argmax(axis=1) + np.arange(0, n, per)
    return x[at], y[at]


def spectrograms(found: LookedRecording, top_hz: float) -> list[Chart]:
    """Draw the spectrogram of every channel."""
    inside = np.flatnonzero((found.hz > 0.0) & (found.hz <= top_hz))
    if len(found.spectrogram) < 2 or not inside.size:
        return []
    charts, (begin, end) = [], found.spectrogram_s
    per = -(-inside.size // _MOST_ROWS)  # of every row alike, or the rows would not lie at their frequencies
    groups = [inside[i : i + per] for i in range(0, inside.size, per)]
    step_hz = float(found.hz[1] - found.hz[0])
    bottom_hz = float(found.hz[inside[0]]) - 0.5 * step_hz
    hz, span = (bottom_hz, bottom_hz + len(groups) * per * step_hz), (begin, max(end, begin + 1e-9))
    for k, name in enumerate(found.channels):
        level = np.log10(np.maximum([found.spectrogram[:, g, k].max(axis=1) for g in groups], 1e-300))[::-1]
        low, high = np.quantile(level, _QUANTILES)
        chart = Chart(f"{name}: frequency, Hz, over time", span, hz, 150.0, x_title="time, s")
        charts.append(chart.grid((level - low) / max(high - low, 1e-9), span, hz))
    return charts


def _data(sheet: Sheet, found: LookedRecording) -> None:
    """Write the level of every channel, the topics and the gaps."""
    sheet.section("Data")
    rows = [
        [name, f"{mean:.4g}", f"{rms:.4g}", f"{rms / G_M_S2:.3g}", f"{peak:.4g}", f"{peak / G_M_S2:.3g}"]
        for name, mean, rms, peak in zip(found.channels, found.mean_m_s2, found.rms_m_s2, found.peak_m_s2, strict=True)
    ]
    sheet.table(["channel", "#mean, m/s²", "#RMS, m/s²", "#RMS, g", "#peak, m/s²", "#peak, g"], rows)
    topics = [
        [name, ", ".join(topic["channels"]), topic["unit"], f"{topic['rate_hz']:g}", f"{topic['samples']}"]
        for name, topic in sorted(found.topics.items())
    ]
    sheet.table(["topic", "channels", "unit", "#Hz", "#samples"], topics)
    sheet.table(["@gap at, UTC", "#length, s"], [[str(at)[:23], f"{s:.3g}"] for at, s in found.gaps], most=20)
