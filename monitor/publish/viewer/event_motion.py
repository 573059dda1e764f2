"""Motion of the structure in an event as a Rerun recording, which the viewer plays in slow motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from monitor.core import Array
from monitor.events import Event, Review, Site
from monitor.model import Drawing
from monitor.publish.viewer.layout import alone, plot, view_from_front
from monitor.publish.viewer.output import Output
from monitor.publish.viewer.rows import Rows, Strips, name_line
from monitor.publish.viewer.scene import GREY, SERIES, loss_colour

_TIMELINE = "event"
"""Timeline of the recording: time since the event's begin."""
_SPEED = 0.25
"""Speed at which the viewer plays, over the true one. [ratio; judgement: a mode of 4 Hz is then seen once a second]"""
_AROUND_S = 2.0
"""Motion shown before and after the event. [s; judgement]"""
_DEFLECTION = 0.15
"""Largest displacement of a floor as drawn, over the height of the structure. [ratio; judgement]"""
_RADIUS = 0.008
"""Radius of the lines. [1 = height of the structure; judgement]"""
_CLOSE_S = 10.0
"""Longest time that closing the recording may take. [s; as of other recordings]"""


def write_motion(path: Path, name: str, event: Event, site: Site, review: Review) -> None:
    """Write the recording; the file appears under its name only when complete.

    Floors move relative to the ground, by the sum of the drifts below them, all of them enlarged alike.  Each story's columns
    have the colour of its drift at that moment: green at rest, red at the limit of the site, or, without one, at the largest
    drift of any story in the event.  A story whose drift no sensors tell is grey and stays upright, as the title says.  Beside
    the frame stand the drifts and accelerations over time.

    Raises OSError or RuntimeError if the file cannot be written.
    """
    heights = np.ones(site.n_stories) if site.heights_m is None else site.heights_m
    drawing = Drawing.of_frame(heights / heights.sum())
    shown = (review.t_s >= -_AROUND_S) & (review.t_s <= (event.end_ns - event.begin_ns) * 1e-9 + _AROUND_S)
    t_ns, drift = np.round(review.t_s[shown] * 1e9).astype(np.int64), review.drift_m[shown]
    floors = np.cumsum(np.nan_to_num(drift)[:, ::-1], axis=1)[:, ::-1]
    drawn = _DEFLECTION / max(float(np.abs(floors).max()), 1e-12)  # the structure is drawn 1 high
    output = Output(f"event {event.id}", path, None)
    try:
        stream = output.stream
        unknown = [story for story, own in zip(site.names, drift.T, strict=True) if not np.isfinite(own).any()]
        title = f"{name}, {event.id}" + (f"; drift not known: {', '.join(unknown)}" if unknown else "")
        stream.send_blueprint(_blueprint(title, drawing, site.names, 1e3 * drift))
        _series(stream, "/drift", site.names, t_ns, 1e3 * drift)
        record = review.record
        accelerations, channels = record.floors[shown], review.channels
        if record.ground is not None:
            accelerations, channels = np.column_stack([accelerations, record.ground[shown]]), (*channels, "ground")
        _series(stream, "/acceleration", channels, t_ns, accelerations)
        _frames(stream, drawing, t_ns, drawn * floors, drift, _most(site, heights, drift))
        output.close(_CLOSE_S)
    finally:
        output.abandon()


def _most(site: Site, heights: Array, drift: Array) -> Annotated[Array, "n"]:
    """Return the drift of each story that is drawn red, m."""
    ratios = [limit.drift_ratio for limit in site.settings.limits if limit.drift_ratio is not None]
    if ratios and site.heights_m is not None:
        return np.asarray(min(ratios) * heights)
    largest = float(np.abs(np.nan_to_num(drift)).max())
    return np.full(len(heights), max(largest, 1e-12))


def _frames(
    stream: rr.RecordingStream,
    drawing: Drawing,
    t_ns: Annotated[NDArray[np.int64], "t"],
    floors: Annotated[Array, "t n"],
    drift: Annotated[Array, "t n"],
    most: Annotated[Array, "n"],
) -> None:
    """Draw the structure at every time, with the floors displaced as drawn; a drift as large as `most` (m) is drawn red."""
    rest = list(drawing.points[drawing.lines].astype(np.float32))
    ghost = rr.LineStrips3D(rest, colors=[GREY] * len(rest), radii=0.15 * _RADIUS)
    stream.log("/frame/at_rest", ghost, static=True)
    rows, moving = Rows(stream, _TIMELINE), drawing.dofs[:, 0]
    for t, displacement, own in zip(t_ns.tolist(), floors, drift, strict=True):
        points = drawing.points.copy()
        points[moving >= 0, 0] += displacement[moving[moving >= 0]]
        of_stories = [
            loss_colour(abs(value) if np.isfinite(value) else None, limit)
            for value, limit in zip(own.tolist(), most.tolist(), strict=True)
        ]
        colours = np.array([of_stories[j] if j >= 0 else GREY for j in drawing.stories.tolist()], dtype=np.uint8)
        radii = np.full(len(colours), _RADIUS)
        rows.at(t)
        rows.add("/frame/moving", rr.LineStrips3D, strips=Strips(points[drawing.lines]), colors=colours, radii=radii)
    rows.send()


def _series(
    stream: rr.RecordingStream,
    path: str,
    names: tuple[str, ...],
    t_ns: Annotated[NDArray[np.int64], "t"],
    values: Annotated[Array, "t k"],
) -> None:
    """Draw values over time."""
    column = rr.TimeColumn(_TIMELINE, duration=t_ns.astype("timedelta64[ns]"))
    for i, (name, own) in enumerate(zip(names, values.T, strict=True)):
        place = _place(path, name)
        name_line(stream, place, name, SERIES[i % len(SERIES)], widths=[1.5])
        stream.send_columns(place, [column], rr.Scalars.columns(scalars=own))


def _blueprint(title: str, drawing: Drawing, stories: tuple[str, ...], drift_mm: Array) -> rrb.Blueprint:
    """Make the layout: the frame at the left, drifts and accelerations at the right, played in slow motion."""
    room = np.array([_DEFLECTION, 0.0, 0.05])
    low, high = drawing.points.min(axis=0) - room, drawing.points.max(axis=0) + room
    high[1] = low[1]  # the front, which is nearest and largest
    largest = 1.1 * max(float(np.abs(np.nan_to_num(drift_mm)).max()), 1e-9)
    alike = rrb.ScalarAxis(range=(-largest, largest))
    drifts = [plot(_place("/drift", name), f"{name}: drift, mm", legend=False, axis_y=alike) for name in stories]
    accelerations = plot("/acceleration", "Accelerations, m/s²", corner="RightTop")
    frame = view_from_front("/frame", title, low, high)
    views = rrb.Horizontal(frame, rrb.Vertical(rrb.Grid(*drifts, grid_columns=1), accelerations))
    return alone(views, timeline=_TIMELINE, playback_speed=_SPEED, play_state="playing", loop_mode="all")


def _place(path: str, name: str) -> str:
    return f"{path}/{rr.escape_entity_path_part(name)}"
