"""Diagnosis as a Rerun recording whose time axis is frequency, so that one cursor reads all spectra at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from monitor.core import Array, name_stories
from monitor.diagnosis import Diagnosis, StoryLaw, in_words
from monitor.inference import Segments
from monitor.publish.reports.comparison import Comparison, compare
from monitor.publish.viewer.layout import DARK, alone, plot
from monitor.publish.viewer.output import Output
from monitor.publish.viewer.rows import name_line
from monitor.publish.viewer.scene import GREY, Colour, markdown_table
from monitor.publish.viewer.trust import VERDICTS

_TIMELINE = "frequency_mHz"
_MEASURED, _BEFORE, _AFTER = (235, 235, 235), (240, 154, 74), (90, 169, 240)
_CLOSE_S = 10.0
"""Longest time that closing the recording may take, s."""
_LOOP_RANGE = (-1.25, 1.25)
"""What a view of a loop shows, of its largest drift and force. [ratio; to leave room for its labels]"""
_LABELS_AT = [(0.75, 0.1), (0.0, -1.1)]
"""Where the largest drift and the largest force are written. [ratio; inside the view]"""
_FULL = 12.0
"""Standard deviations at which the maps reach their full colour."""


def write_view(
    path: Path,
    diagnosis: Diagnosis,
    content: Mapping[str, Any],
    segments: Segments,
    story_names: Sequence[str] = (),
    laws: Sequence[StoryLaw] = (),
) -> None:
    """Write the recording; the file appears under its name only when complete.

    `content` is that of diagnosis.json, `laws` are those of the stories straight from the data.  Raises OSError or RuntimeError
    if the file cannot be written.
    """
    compared = compare(diagnosis, segments)
    output = Output("diagnosis", path, None)
    try:
        output.stream.send_blueprint(_blueprint(compared, laws, story_names))
        text = name_stories(_status(diagnosis, content, segments, compared), story_names)
        status = rr.TextDocument(text, media_type="text/markdown")
        output.stream.log("/verdict", status, static=True)
        _spectra(output.stream, compared)
        _loops(output.stream, laws, extended=compared.extended)
        for when, z in (("before", compared.z_before), ("after", compared.z_after)):
            rows = np.array([z[:, i, j] for _, i, j in compared.rows()])
            tensor = rr.Tensor(rows, dim_names=["channels", "band"], value_range=[-_FULL, _FULL])
            output.stream.log(f"/misfit/{when}", tensor, static=True)
        output.close(_CLOSE_S)
    finally:
        output.abandon()


def _spectra(stream: rr.RecordingStream, c: Comparison) -> None:
    """Draw the spectra in dB, the ratios in dB and the misfit in bands, over frequency."""

    def line(path: str, name: str, colour: Colour, hz: Array, values: Array) -> None:
        name_line(stream, path, name, colour, widths=[1.5])
        column = rr.TimeColumn(_TIMELINE, sequence=np.round(1e3 * hz).astype(np.int64))
        stream.send_columns(path, [column], rr.Scalars.columns(scalars=values))

    for i, channel in enumerate(c.channels):
        name = rr.escape_entity_path_part(channel)
        series = (("measured", _MEASURED, c.measured), ("before", _BEFORE, c.before), ("after", _AFTER, c.after))
        for what, colour, values in series:
            line(f"/spectra/{name}/{what}", what, colour, c.hz, 10.0 * np.log10(np.maximum(values[i], 1e-300)))
        for what, colour, ratio in (("before", _BEFORE, c.ratio_before), ("after", _AFTER, c.ratio_after)):
            line(f"/ratios/{name}/{what}", what, colour, c.ratio_hz, 10.0 * np.log10(np.maximum(ratio[i], 1e-300)))
    for what, colour, z in (("before", _BEFORE, c.z_before), ("after", _AFTER, c.z_after)):
        line(f"/worst/{what}", what, colour, c.band_hz, np.abs(z).max(axis=(1, 2)))
    line("/worst/limit", "misfit from here", GREY, c.band_hz, np.full(c.band_hz.size, c.limit))


def _loops(stream: rr.RecordingStream, laws: Sequence[StoryLaw], *, extended: bool) -> None:
    """Draw the force of every story over its drift: measured, and of the model before and after the causes.

    A view of the plane has one scale for both axes, so drifts and forces are drawn over their largest, which labels state.
    """
    for law in laws:
        model = [(law.before, _BEFORE), (law.after, _AFTER)][: 2 if extended else 1]
        loops = [*model, (law.measured, _MEASURED)]
        drift, force = (
            max(float(np.abs(getattr(loop, name)).max()) for loop, _ in loops) for name in ("drift_m", "force_n")
        )
        # The picture's y axis points down.
        strips = [np.column_stack([loop.drift_m / drift, -loop.force_n / force]) for loop, _ in loops]
        at = f"/loops/{law.story}"
        colours, width = [colour for _, colour in loops], rr.Radius.ui_points(0.5)
        stream.log(f"{at}/loop", rr.LineStrips2D(strips, colors=colours, radii=width), static=True)
        cross = [[(-1.0, 0.0), (1.0, 0.0)], [(0.0, -1.0), (0.0, 1.0)]]
        axes = rr.LineStrips2D(cross, colors=[GREY], radii=rr.Radius.ui_points(0.3), draw_order=0.0)
        stream.log(f"{at}/axes", axes, static=True)
        labels = [f"{1e3 * drift:.3g} mm", f"{force:.3g} N"]
        ends = rr.Points2D(_LABELS_AT, labels=labels, colors=[GREY], radii=rr.Radius.ui_points(0.3), show_labels=True)
        stream.log(f"{at}/scale", ends, static=True)


def _status(diagnosis: Diagnosis, content: Mapping[str, Any], segments: Segments, compared: Comparison) -> str:
    """Write the content of the report as Markdown."""
    gain = content["gain"]["log_score_per_sample"]
    lines = [f"# {VERDICTS[content['verdict']].upper()}", content["says"], ""]
    if content["separating_measurement"]:
        lines += [f"**To tell them apart:** {content['separating_measurement']}.", ""]
    if content["causes"]:
        low, high = gain["ci95"]
        lines += [f"Gain on held-out data: {gain['gain']:+.4f} ({low:+.4f} to {high:+.4f}) nats a sample.", ""]
    for c in content["standing"]:
        words = in_words(c["effect"], c["location"], c["parameters"], diagnosis.posterior.prior)
        lines += [f"Already so at calibration: {words}.", ""]
    for item in content.get("witness", ()):
        lines += [f"Witness: {item['says']}.", ""]
    for item in content["left_out"]:
        lines += [f"Left out: {item['says']}.", ""]
    if content["standing_misfit"] is not None:
        lines += [f"Already so at calibration: {content['standing_misfit']['says']}.", ""]
    tried = [(t["effect"], t["location"], f"{t['log_evidence_over_none']:.1f}") for t in content["tried"]]
    misfit = [(m["where"], f"{m['size']:.1f}", m["says"]) for m in content["misfit"][:10]]
    lines += [*markdown_table(("tried", "place", "log evidence, nats"), tried), ""]
    lines += markdown_table(("misfit before", "std. dev.", "what it says"), misfit)
    rows = "; ".join(name for name, _, _ in compared.rows())
    lines += [
        "",
        f"{segments.t_s.size} segments, source at {segments.rate_hz:g} Hz; the time axis is frequency in mHz.",
        *[f"{words.capitalize()}." for words in content["band"]["says"]],
    ]
    lines += [
        "",
        f"Power in dB re 1 (m/s²)²/Hz; ratio: measured over simulated; rows of the maps from the top: {rows}. "
        "White: measured; orange: the model before the causes; blue: with them.",
    ]
    if content["story_laws"]:
        lines += ["", "Loops at the bottom: force of each story over its drift, in the segment with the largest drift."]
    return "\n".join(lines)


def _blueprint(c: Comparison, laws: Sequence[StoryLaw], story_names: Sequence[str]) -> rrb.Blueprint:
    """Place the verdict, the maps of the misfit and the stories' loops at the left, the spectra at the right."""

    def tab(channel: str) -> rrb.Vertical:
        part = rr.escape_entity_path_part(channel)
        return rrb.Vertical(
            plot(f"/spectra/{part}", f"{channel}: power, dB re 1 (m/s²)²/Hz, over mHz", corner="RightTop"),
            plot(f"/ratios/{part}", f"{channel}: measured over simulated, dB, over mHz", corner="RightTop"),
            row_shares=[2, 1],
            name=channel,
        )

    columns = [tab(channel) for channel in c.channels]
    scale = rrb.TensorScalarMapping(colormap="CyanToYellow")
    maps = [
        rrb.TensorView(origin=f"/misfit/{when}", name=f"Misfit {when}", scalar_mapping=scale, view_fit="fill")
        for when in ("before", "after")
    ]
    loops = [
        rrb.Spatial2DView(
            origin=f"/loops/{law.story}",
            name=name_stories(f"story {law.story}", story_names),
            background=DARK,
            visual_bounds=rrb.VisualBounds2D(x_range=_LOOP_RANGE, y_range=_LOOP_RANGE),
        )
        for law in laws
    ]
    left = rrb.Vertical(
        rrb.TextDocumentView(origin="/verdict", name="Verdict"),
        rrb.Horizontal(*maps),
        *([rrb.Horizontal(*loops)] if loops else []),
        row_shares=[3, 1, *([2] if loops else [])],
    )
    right = rrb.Vertical(
        rrb.Horizontal(*columns) if len(columns) <= 3 else rrb.Tabs(*columns),
        plot("/worst", "Worst misfit of a band, standard deviations, over mHz", corner="RightTop"),
        row_shares=[3, 1],
    )
    return alone(rrb.Horizontal(left, right, column_shares=[2, 3]), timeline=_TIMELINE)
