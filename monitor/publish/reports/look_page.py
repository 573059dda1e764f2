"""Page of a quick look at recordings without a model: modes and doubts first, then the diagrams they come from."""

from __future__ import annotations

import struct
import zlib
from base64 import b64encode
from html import escape
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ModalEstimate, Skipped, write_atomically
from monitor.identification import SingleMode
from monitor.publish.reports.charts import WIDTH, Axes
from monitor.publish.reports.look_data import G_M_S2, LookedBand, LookedMode, LookedRecording
from monitor.publish.reports.page import document, doubts, figures, table, verdict
from monitor.publish.results.event_lines import with_interval

_MOST_POINTS = 700
"""Most points of a spectrum's line; of the bins that fall on one the strongest is drawn. [count; cost]"""
_MOST_ROWS = 200
"""Most rows of a spectrogram. [count; cost]"""
_BEYOND_MODES = 1.5
"""Highest frequency of the diagrams, over that of the highest mode. [1; judgement]"""
_PALETTE = np.array([[24, 24, 62], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)
"""Colours of a spectrogram, from weak to strong. [RGB; as viridis]"""
_QUANTILES = (0.05, 0.999)
"""Shares of a spectrogram's values at the ends of its colours. [1; judgement]"""
_STYLE = """<style>
.pole { stroke: var(--quiet); stroke-width: 3; stroke-linecap: round; fill: none; }
.pole.stable { stroke: var(--after); stroke-width: 4.5; }
.chosen { stroke: var(--before); stroke-width: 1.2; }
.shapes { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .4rem 1rem; }
image { image-rendering: pixelated; }
</style>"""


def write_look(path: Path, found: LookedRecording) -> None:
    """Write the page; the file appears under its name only when complete."""
    write_atomically(path, look_page(found))


def look_page(found: LookedRecording) -> str:
    """Write the page, which is well-formed XML as well."""
    top_hz = shown_hz(found)
    parts = [
        _STYLE,
        _head(found),
        _modes(found),
        _shapes(found),
        _stabilisations(found),
        _spectra(found, top_hz),
        spectrograms(found, top_hz),
        _data(found),
    ]
    return document(f"Look: {', '.join(Path(name).name for name in found.files)}", parts)


def shown_hz(found: LookedRecording) -> float:
    """Return the highest frequency of the diagrams, Hz."""
    highest = max((mode.frequency_hz for mode in found.modes), default=np.inf)
    return float(min(found.hz[-1], _BEYOND_MODES * highest))


def mode_rows(found: LookedRecording) -> list[list[str]]:
    """Write the table of modes: number, frequency, damping, both of the second opinion, and what is to say."""
    return [
        [str(number), *_intervals(mode), *_intervals(mode.second), _says(mode)]
        for number, mode in enumerate(found.modes, start=1)
    ]


def _intervals(mode: LookedMode | SingleMode | Skipped) -> tuple[str, str]:
    """Write frequency and damping of an opinion, Hz and %, with two standard deviations."""
    if isinstance(mode, Skipped):
        return "-", "-"
    damping = with_interval(100.0 * mode.damping_ratio, 200.0 * mode.damping_std, 5)
    return with_interval(mode.frequency_hz, 2.0 * mode.frequency_std_hz, 5), damping


def _says(mode: LookedMode) -> str:
    """Say what is to know of a mode beside its numbers."""
    said = [mode.remark] if mode.remark else []
    if mode.differs:
        said.append(f"the two opinions differ in {mode.differs}")
    if isinstance(mode.second, Skipped):
        said.append(f"no second opinion: {mode.second.reason}")
    if mode.collinearity < 0.9:
        said.append("the shape is complex")
    return "; ".join(said)


def _head(found: LookedRecording) -> str:
    """Write the title, the key figures and the doubts."""
    kind = "doubtful" if found.doubts else "normal"
    count = f"{len(found.modes)} {'mode' if len(found.modes) == 1 else 'modes'}"
    files = ", ".join(Path(name).name for name in found.files)
    out = [verdict(kind, "doubts" if found.doubts else "looked at", f"{count} in {files}")]
    shown = [
        (f"{found.rate_hz:g} Hz", "sampling rate"),
        (_duration(found.duration_s), f"from {str(np.datetime64(found.t_start_ns, 'ns'))[:19]} UTC"),
        (f"{len(found.channels)}", f"channels: {', '.join(found.channels)}"),
        (f"{found.rms_m_s2.mean():.3g} m/s²", f"mean RMS acceleration, {found.rms_m_s2.mean() / G_M_S2:.2g} g"),
    ]
    notes = [f'<p class="muted">{escape(note)}</p>' for note in found.notes]
    return "".join([*out, figures(shown), *notes, doubts(found.doubts)])


def _duration(seconds: float) -> str:
    """Write a length of time in its unit."""
    if seconds >= 5400:
        return f"{seconds / 3600:.2f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 300 else f"{seconds:.1f} s"


def _modes(found: LookedRecording) -> str:
    if not found.modes:
        reasons = {band.modes.reason for band in found.bands if isinstance(band.modes, Skipped)}
        return f"<h2>Modes</h2><p>None found: {escape('; '.join(sorted(reasons)) or 'the record is too short')}.</p>"
    head = ["mode", "#frequency, Hz", "#damping, %", "#second opinion, Hz", "#second opinion, %", "remark"]
    rows = mode_rows(found)
    shown = len(head) if any(row[-1] for row in rows) else len(head) - 1
    return (
        "<h2>Modes</h2>"
        + table(head[:shown], [row[:shown] for row in rows])
        + '<p class="muted">Chosen without a model: poles of the stochastic subspace identification that stay the same over its '
        "orders, refined by maximum likelihood where there are enough data. The second opinion fits the spectrum about each peak "
        "alone (frequency-spatial domain decomposition). ± is two standard deviations, about 95 %.</p>"
    )


def _shapes(found: LookedRecording) -> str:
    """Draw the mode shapes over the channels."""
    if not found.modes or len(found.channels) < 2:
        return ""
    c = len(found.channels)
    at = np.arange(c, dtype=float)
    charts = []
    for number, mode in enumerate(found.modes, start=1):
        axes = Axes((-0.3, c - 0.7), (-1.15, 1.15), 110.0, x_names=found.channels)
        charts.append(
            axes.chart(
                f"mode {number}: {mode.frequency_hz:.4g} Hz",
                axes.line(np.array([-0.3, c - 0.7]), np.zeros(2), "measured dashed"),
                axes.line(at, mode.shape.real, "after"),
                axes.dots(at, mode.shape.real, 2.0 * mode.shape_std),
            )
        )
    return f'<h2>Mode shapes</h2><div class="shapes">{"".join(charts)}</div>'


def _stabilisations(found: LookedRecording) -> str:
    """Draw the stabilisation diagrams of all bands with modes."""
    charts = [_stabilisation(found, band) for band in found.bands if isinstance(band.modes, ModalEstimate)]
    if not charts:
        return ""
    words = (
        "Each point is a pole of one order; blue: it recurs from the next lower order. Orange lines: modes that were chosen. "
        "Line: first singular value of the spectral matrix. Lower rates resolve lower modes."
    )
    return f'<h2>Stabilisation diagrams</h2>{"".join(charts)}<p class="muted">{words}</p>'


def _stabilisation(found: LookedRecording, band: LookedBand) -> str:
    """Draw the stabilisation diagram of a band: poles by frequency and order, and the modes that were chosen."""
    assert isinstance(band.modes, ModalEstimate)
    orders, hz, _, stable = band.modes.poles.T
    low, high = band.band_hz
    axes = Axes((low, high), (0.0, float(orders.max()) + 2.0), 240.0)
    inside = (found.hz >= low) & (found.hz <= high)
    level = np.log10(np.maximum(found.singular_values[0, inside], 1e-300))
    marks = []
    if inside.sum() > 2 and np.ptp(level) > 0:
        x, y = _pooled(found.hz[inside], (level - level.min()) / np.ptp(level) * 0.9 * axes.y[1])
        marks.append(axes.line(x, y, "measured"))
    for kind, chosen in (("pole", stable == 0.0), ("pole stable", stable == 1.0)):
        places = zip(axes.px(hz[chosen]), axes.py(orders[chosen]), strict=True)
        marks.append(f'<path class="{kind}" d="{"".join(f"M{a:.1f} {b:.1f}h0" for a, b in places)}"/>')
    marks += [
        f'<path class="chosen" d="M{float(axes.px(f)):.1f} 0V{axes.height:g}"/>'
        for f in band.modes.frequencies_hz.tolist()
    ]
    return axes.chart(f"order of the model, at {band.rate_hz:g} samples a second", *marks, x_title="frequency, Hz")


def _spectra(found: LookedRecording, top_hz: float) -> str:
    """Draw the singular values of the spectral matrix, and the spectrum of every channel."""
    out = ["<h2>Spectra</h2>"]
    inside = (found.hz > 0.0) & (found.hz <= top_hz)
    values = found.singular_values[:, inside]
    if len(found.channels) > 1:
        axes = Axes((0.0, top_hz), _decades(values), 220.0, log_y=True)
        marks = [
            f'<path class="chosen" d="M{float(axes.px(mode.frequency_hz)):.1f} 0V{axes.height:g}"/>'
            for mode in found.modes
        ]
        marks += [
            axes.line(*_pooled(found.hz[inside], row), "after" if k == 0 else "measured")
            for k, row in enumerate(values)
        ]
        title = "singular values of the spectral matrix, (m/s²)²/Hz; orange: modes"
        out.append(axes.chart(title, *marks, x_title="frequency, Hz"))
    band = _decades(found.power[:, 1:])
    for name, row in zip(found.channels, found.power, strict=True):
        axes = Axes((0.0, float(found.hz[-1])), band, 110.0, log_y=True)
        title = f"{name}: power spectral density, (m/s²)²/Hz, to half the rate"
        out.append(axes.chart(title, axes.line(*_pooled(found.hz[1:], row[1:]), "measured"), x_title="frequency, Hz"))
    return "".join(out)


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


def spectrograms(found: LookedRecording, top_hz: float) -> str:
    """Draw the spectrogram of every channel."""
    inside = np.flatnonzero((found.hz > 0.0) & (found.hz <= top_hz))
    if len(found.spectrogram) < 2 or not inside.size:
        return ""
    out = ["<h2>Spectrograms</h2>"]
    begin, end = found.spectrogram_s
    per = -(-inside.size // _MOST_ROWS)  # of every row alike, or the rows would not lie at their frequencies
    groups = [inside[i : i + per] for i in range(0, inside.size, per)]
    step_hz = float(found.hz[1] - found.hz[0])
    bottom_hz = float(found.hz[inside[0]]) - 0.5 * step_hz
    hz = bottom_hz, bottom_hz + len(groups) * per * step_hz
    for k, name in enumerate(found.channels):
        level = np.log10(np.maximum([found.spectrogram[:, g, k].max(axis=1) for g in groups], 1e-300))[::-1]
        low, high = np.quantile(level, _QUANTILES)
        axes = Axes((begin, max(end, begin + 1e-9)), hz, 150.0)
        picture = png((level - low) / max(high - low, 1e-9))
        data = b64encode(picture).decode()
        size = f'width="{WIDTH:g}" height="{axes.height:g}" preserveAspectRatio="none"'
        image = f'<image href="data:image/png;base64,{data}" {size}/>'
        out.append(axes.chart(f"{name}: frequency, Hz, over time", image, x_title="time, s"))
    return "".join(out)


def png(level: Annotated[Array, "rows columns"]) -> bytes:
    """Encode a picture of levels from 0 to 1, the top row first, in the colours of `_PALETTE`.

    Examples
    --------
    >>> png(np.zeros((2, 3)))[:8]
    b'\\x89PNG\\r\\n\\x1a\\n'
    """
    place = np.clip(level, 0.0, 1.0) * (len(_PALETTE) - 1)
    rgb = np.stack([np.interp(place, np.arange(len(_PALETTE)), colour) for colour in _PALETTE.T], axis=-1)
    rows: NDArray[np.uint8] = np.zeros((level.shape[0], 1 + 3 * level.shape[1]), dtype=np.uint8)
    rows[:, 1:] = np.rint(rgb).astype(np.uint8).reshape(level.shape[0], -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", level.shape[1], level.shape[0], 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def _data(found: LookedRecording) -> str:
    """Write the level of every channel, the topics and the gaps."""
    out = ["<h2>Data</h2>"]
    rows = [
        [name, f"{mean:.4g}", f"{rms:.4g}", f"{rms / G_M_S2:.3g}", f"{peak:.4g}", f"{peak / G_M_S2:.3g}"]
        for name, mean, rms, peak in zip(found.channels, found.mean_m_s2, found.rms_m_s2, found.peak_m_s2, strict=True)
    ]
    out.append(table(["channel", "#mean, m/s²", "#RMS, m/s²", "#RMS, g", "#peak, m/s²", "#peak, g"], rows))
    topics = [
        [name, ", ".join(topic["channels"]), topic["unit"], f"{topic['rate_hz']:g}", f"{topic['samples']}"]
        for name, topic in sorted(found.topics.items())
    ]
    out.append(table(["topic", "channels", "unit", "#Hz", "#samples"], topics))
    if found.gaps:
        out.append(table(["@gap at, UTC", "#length, s"], [[str(at)[:23], f"{s:.3g}"] for at, s in found.gaps[:20]]))
    return "".join(out)
