"""Layout of the viewer: one page for each question of the operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from monitor.core import Array
from monitor.publish.viewer.scene import STABILISATION, Scene
from monitor.publish.viewer.state import LAMP

DARK = (24, 26, 30)
_BUILDING_RISE = 0.2
"""Height from which a building is seen, over the distance. [ratio; judgement: both directions, turns, and labels apart]"""
_DISTANCE_TO_WIDTH, _DISTANCE_TO_HEIGHT = 0.7, 0.95
"""Distance of the eye over width and height of what it sees. [ratio; the viewer's angle of view]"""
_MODES_IN_A_COLUMN = 3
"""Most modes whose frequencies are drawn below each other. [count; judgement]"""
DRIFT = "/drift"
"""Entity of the stories' largest drifts in events. [path; definition]"""
ALL_TIME = rrb.TimeAxis(
    view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
)
"""Time axis over the whole recording; by default plots show one minute about the cursor."""


def plot(
    origin: str, name: str, *, legend: bool = True, corner: Literal["LeftTop", "RightTop"] = "LeftTop", **more: Any
) -> rrb.TimeSeriesView:
    """Make a view of time series over the whole recording."""
    key = rrb.PlotLegend(corner, visible=legend)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=key, axis_x=ALL_TIME, **more)


def blueprint(scene: Scene, page: int = 0) -> rrb.Blueprint:
    """Make the layout with page 0 ("Is it healthy?"), 1 ("Can I trust it?") or 2 ("What does it do now?") in front."""
    if scene.features is not None:
        return alone(_of_features(scene, scene.features.features), timeline="time", play_state="following")
    pages = rrb.Tabs(_healthy(scene), _trust(scene), _present_motion(scene), active_tab=page)
    return alone(pages, timeline="time", play_state="following")


def alone(views: rrb.Container, **time: Any) -> rrb.Blueprint:
    """Make a layout of views with all panels collapsed; `time` sets the panel of the timeline."""
    return rrb.Blueprint(
        views,
        rrb.TimePanel(state="collapsed", **time),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _frame(scene: Scene) -> rrb.Spatial3DView:
    """Make the 3D view of the structure and its mode shapes, seen from the front; of a building without them."""
    plan, name = scene.plan, "Stiffness lost and mode shapes" if scene.n_stories else "Mode shapes"
    if plan.apart is None:
        return view_from_front("/frame", name, plan.low, plan.high)
    alone = ["/frame/**", "- /frame/modes/**"]
    return view_from_front("/frame", "Stiffness lost, %", plan.low, plan.high, _BUILDING_RISE, contents=alone)


def view_from_front(
    origin: str, name: str, low: Array, high: Array, rise: float = 0.15, **more: Any
) -> rrb.Spatial3DView:
    """Make the 3D view of a box between two corners, seen from the front and from above by a rise."""
    centre, (width, _, height) = 0.5 * (low + high), high - low
    away = max(_DISTANCE_TO_WIDTH * width, _DISTANCE_TO_HEIGHT * height)
    eye = rrb.EyeControls3D(position=centre + away * np.array([0.0, -1.0, rise]), look_target=centre)
    return rrb.Spatial3DView(
        origin=origin, name=name, eye_controls=eye, line_grid=rrb.LineGrid3D(visible=False), background=DARK,
        **more,
    )  # fmt: skip


def _canvas(path: str, name: str) -> rrb.Spatial2DView:
    """Make a 2D view of a diagram on the canvas of the stabilisation diagram."""
    width, height = STABILISATION
    bounds = rrb.VisualBounds2D(x_range=[-0.2 * width, 1.06 * width], y_range=[-1.06 * height, 0.14 * height])
    return rrb.Spatial2DView(origin="/", contents=f"{path}/**", visual_bounds=bounds, background=DARK, name=name)


def _events() -> rrb.TextLogView:
    """Make the log of states and events, whose texts begin with their time."""
    narrow = rrb.encodings.TimelineColumn("time", visible=False)
    columns = rrb.TextLogColumns(timeline_columns=[narrow], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="/events", name="States and events", columns=columns)


def _lamp() -> rrb.Spatial2DView:
    """Make the bar in the colour of the state."""
    width, height = LAMP
    bounds = rrb.VisualBounds2D(x_range=[0.0, width], y_range=[-0.5 * height, 0.5 * height])
    return rrb.Spatial2DView(
        origin="/state/lamp", visual_bounds=bounds, background=DARK, name="Colour of the state", titlebar=False
    )


def _state() -> rrb.TextDocumentView:
    """Make the view of the state in words, with what makes it doubtful."""
    return rrb.TextDocumentView(origin="/state", contents="/state", name="State")


def _healthy(scene: Scene) -> rrb.Horizontal:
    """Make the page of health, with the present state at the left and the history at the right."""
    n = scene.n_modes
    modes = [plot(f"/modes/frequency/{i}", f"Mode {i}, Hz", legend=False) for i in range(1, n + 1)]
    since = "since the baseline" if scene.has_baseline else "against the structure file"
    first = "the baseline" if scene.has_baseline else "the first window"
    left = rrb.Vertical(
        _lamp(),
        _state(),
        _frame(scene),
        rrb.Tabs(
            rrb.TextDocumentView(origin="/status", name="Latest window"),
            rrb.TextDocumentView(origin="/verdict", name="Latest diagnosis"),
        ),
        row_shares=[0.4, 3.4, 5.6, 4.4] if scene.plan.apart is None else [0.4, 3.4, 7.2, 2.8],
    )
    change = plot("/modes/change", f"Frequencies: change since {first}, %")
    frequencies = rrb.Grid(*modes, grid_columns=1 if n <= _MODES_IN_A_COLUMN else 2, name="Frequencies, Hz")
    stiffness = rrb.Tabs(
        _of_stories(scene, "/ddi", f"Stiffness lost {since} (DDI), %"),
        _of_stories(scene, "/stiffness", "Stiffness, N/m"),
        _of_stories(scene, DRIFT, "Events: largest drift, mm"),
        active_tab=0 if scene.has_baseline else 1,
    )
    right = rrb.Vertical(
        stiffness if scene.n_stories else change,
        rrb.StateTimelineView(origin="/state", contents="/state", name="State over time", time_view=ALL_TIME),
        rrb.Tabs(change, frequencies, active_tab=0) if scene.n_stories else frequencies,
        _events(),
        row_shares=[6, 2, 6, 3],
    )
    return rrb.Horizontal(left, right, column_shares=[2, 3], name="Is it healthy?")


def _of_stories(scene: Scene, origin: str, name: str) -> rrb.Container | rrb.View:
    """Make the plot of the stories' curves, of a building one for each direction."""
    ways = dict.fromkeys(way for way, *_ in scene.series)
    if not any(ways):
        return plot(origin, name)
    paths = {way: [f"{origin}/story_{j}" for j, of in enumerate(scene.series, 1) if of[0] == way] for way in ways}
    each = (plot(origin, way, contents=[*own, f"{origin}/alarm_loss"]) for way, own in paths.items())
    return rrb.Horizontal(*each, name=name)


def _of_features(scene: Scene, names: Sequence[str]) -> rrb.Horizontal:
    """Make the one page of features, with the present state at the left, and their history and the covariates' at the right."""
    left = rrb.Vertical(
        _lamp(), _state(), rrb.TextDocumentView(origin="/status", name="Latest reading"), row_shares=[0.4, 6, 6]
    )
    each = [
        plot(f"/modes/sigma/{k}", f"{name}: each reading, healthy σ", legend=False) for k, name in enumerate(names, 1)
    ]
    more: list[rrb.Container | rrb.View] = [rrb.Grid(*each, grid_columns=2, name="Readings"), *_covariates(scene)]
    right = rrb.Vertical(
        plot("/modes/change", "Change since the healthy time, less what covariates explain (% where relative)"),
        rrb.StateTimelineView(origin="/state", contents="/state", name="State over time", time_view=ALL_TIME),
        rrb.Tabs(*more, active_tab=0),
        _events(),
        row_shares=[6, 2, 6, 3],
    )
    return rrb.Horizontal(left, right, column_shares=[2, 3], name="Is it healthy?")


def _covariates(scene: Scene) -> list[rrb.TimeSeriesView]:
    """Make the plots of the covariates."""
    return [
        plot(
            f"/trust/covariate/{rr.escape_entity_path_part(name)}",
            f"{', '.join(filter(None, (name, learned.unit)))}, and the range learned",
        )
        for name, learned in scene.learned.items()
    ]


def _trust(scene: Scene) -> rrb.Horizontal:
    """Make the page of trust, with state, verdict and fit at the left, and the sensors and clocks at the right."""
    fit = plot("/trust/misfit", f"Goodness of fit: 1 is expected, doubtful above {scene.misfit_threshold:g}")
    known = [fit, *_covariates(scene)] if scene.n_stories else _covariates(scene)
    left = rrb.Vertical(
        rrb.Horizontal(_state(), rrb.TextDocumentView(origin="/verdict", name="Latest diagnosis")),
        _canvas("/stabilisation", "Stabilisation diagram: order over frequency, Hz"),
        *([rrb.Tabs(*known, active_tab=0)] if known else []),
        row_shares=[2, 3, 2][: 3 if known else 2],
    )
    right = rrb.Vertical(
        plot("/quality/availability", "Samples that came, %", legend=False),
        plot("/quality/rms", "RMS, m/s²"),
        plot("/quality/noise_floor", "Noise floor, m/s²/√Hz"),
        rrb.Tabs(plot("/quality/clipped", "Clipped, %"), plot("/clock", "Clock offset, ms"), active_tab=0),
    )
    return rrb.Horizontal(left, right, name="Can I trust it?")


def _present_motion(scene: Scene) -> rrb.Horizontal:
    """Make the page of the present motion, with the streams, the spectra with the model's, and the mode shapes."""
    left = rrb.Vertical(
        plot("/streams", "Acceleration, m/s²"),
        _canvas("/spectra", "Power spectral density, dB re 1 (m/s²)²/Hz: measured, and the model's (white)"),
        row_shares=[1, 1],
    )
    shapes = _frame(scene)
    if scene.plan.apart is not None:
        shapes = view_from_front("/frame/modes", "", *scene.plan.apart, _BUILDING_RISE)
    shapes.name = "Mode shapes: they move on the timeline 'phase'"
    right = rrb.Vertical(shapes, plot("/modes/damping", "Damping, %"), row_shares=[3, 2])
    return rrb.Horizontal(left, right, column_shares=[5, 4], name="What does it do now?")
