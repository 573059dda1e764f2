"""Diagnosis as a Rerun recording whose time axis is frequency, so that one cursor reads all spectra at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from monitor.core import Array, name_stories
from monitor.diagnosis import Diagnosis, in_words
from monitor.inference import Segments
from monitor.publish.reports.comparison import Comparison, compare
from monitor.publish.viewer.layout import ALL_TIME
from monitor.publish.viewer.output import Output
from monitor.publish.viewer.scene import GREY, Colour
from monitor.publish.viewer.trust import VERDICTS

_TIMELINE = "frequency_mHz"
_MEASURED, _BEFORE, _AFTER = (235, 235, 235), (240, 154, 74), (90, 169, 240)
_CLOSE_S = 10.0
"""Longest time that closing the recording may take, s."""
_FULL = 12.0
"""Standard deviations at which the maps reach their full colour."""


def write_view(
    path: Path, diagnosis: Diagnosis, content: Mapping[str, Any], segments: Segments, story_names: Sequence[str] = ()
) -> None:
    """Write the recording; the file appears under its name only when complete.

    Parameters
    ----------
    path : Path
        File of the recording.
    diagnosis : Diagnosis
    content : mapping
        diagnosis.json.
    segments : Segments
        The segments that were diagnosed.
    story_names : sequence of str
        What people call each story.

    Raises
    ------
    OSError, RuntimeError
        The file cannot be written.
    """
    compared = compare(diagnosis, segments)
    output = Output("diagnosis", path, None)
    try:
        output.stream.send_blueprint(_blueprint(compared))
        text = name_stories(_status(diagnosis, content, segments, compared), story_names)
        status = rr.TextDocument(text, media_type="text/markdown")
        output.stream.log("/verdict", status, static=True)
        _spectra(output.stream, compared)
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
        stream.log(path, rr.SeriesLines(names=[name], colors=[colour], widths=[1.5]), static=True)
        column = rr.TimeColumn(_TIMELINE, sequence=np.round(1e3 * hz).astype(np.int64))
        stream.send_columns(path, [column], rr.Scalars.columns(scalars=values))

    for i, channel in enumerate(c.channels):
        name = rr.escape_entity_path_part(channel)
        series = (("measured", _MEASURED, c.measured), ("before", _BEFORE, c.before), ("after", _AFTER, c.after))
        for what, colour, values in series:
            line(f"/spectra/{name}/{what}", what, colour, c.hz, 10.0 * np.log10(values[i]))
        for what, colour, ratio in (("before", _BEFORE, c.ratio_before), ("after", _AFTER, c.ratio_after)):
            line(f"/ratios/{name}/{what}", what, colour, c.ratio_hz, 10.0 * np.log10(ratio[i]))
    for what, colour, z in (("before", _BEFORE, c.z_before), ("after", _AFTER, c.z_after)):
        line(f"/worst/{what}", what, colour, c.band_hz, np.abs(z).max(axis=(1, 2)))
    line("/worst/limit", "misfit from here", GREY, c.band_hz, np.full(c.band_hz.size, c.limit))


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
    lines += ["| tried | place | log evidence, nats |", "|---|---|---|"]
    lines += [f"| {t['effect']} | {t['location']} | {t['log_evidence_over_none']:.1f} |" for t in content["tried"]]
    lines += ["", "| misfit before | std. dev. | what it says |", "|---|---|---|"]
    lines += [f"| {m['where']} | {m['size']:.1f} | {m['says']} |" for m in content["misfit"][:10]]
    rows = "; ".join(name for name, _, _ in compared.rows())
    lines += [
        "",
        f"{segments.t_s.size} segments, source at {segments.rate_hz:g} Hz; the time axis is frequency in mHz.",
        *[f"{words.capitalize()}." for words in content["band"]["says"]],
    ]
    lines += [
        "",
        f"Power in dB re 1 (m/s²)²/Hz; ratio: measured over simulated; rows of the maps from the top: {rows}.",
    ]
    return "\n".join(lines)


def _blueprint(c: Comparison) -> rrb.Blueprint:
    """Place the verdict and the maps of the misfit at the left, the spectra at the right."""
    corner = rrb.PlotLegend("RightTop")

    def plot(origin: str, name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=corner, axis_x=ALL_TIME)

    def tab(channel: str) -> rrb.Vertical:
        part = rr.escape_entity_path_part(channel)
        return rrb.Vertical(
            plot(f"/spectra/{part}", f"{channel}: power, dB re 1 (m/s²)²/Hz, over mHz"),
            plot(f"/ratios/{part}", f"{channel}: measured over simulated, dB, over mHz"),
            row_shares=[2, 1],
            name=channel,
        )

    columns = [tab(channel) for channel in c.channels]
    scale = rrb.TensorScalarMapping(colormap="CyanToYellow")
    maps = [
        rrb.TensorView(origin=f"/misfit/{when}", name=f"Misfit {when}", scalar_mapping=scale, view_fit="fill")
        for when in ("before", "after")
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.TextDocumentView(origin="/verdict", name="Verdict"),
                rrb.Horizontal(*maps),
                row_shares=[3, 1],
            ),
            rrb.Vertical(
                rrb.Horizontal(*columns) if len(columns) <= 3 else rrb.Tabs(*columns),
                plot("/worst", "Worst misfit of a band, standard deviations, over mHz"),
                row_shares=[3, 1],
            ),
            column_shares=[2, 3],
        ),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
