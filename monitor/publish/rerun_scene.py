"""What stands in the viewer and where: the site, the status text, the layout.  Pure functions."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from monitor.results import Array, Level, ModalEstimate, WindowResult

Colour = tuple[int, int, int]

GREEN, AMBER, RED, GREY = (80, 190, 110), (240, 180, 50), (230, 70, 60), (130, 130, 130)
SERIES: tuple[Colour, ...] = ((90, 170, 250), (250, 170, 70), (190, 130, 240), (90, 210, 190), (240, 120, 160))
LEVELS = {
    Level.NORMAL: (rr.TextLogLevel.INFO, GREEN),
    Level.ADVISORY: (rr.TextLogLevel.INFO, (220, 215, 100)),
    Level.WARNING: (rr.TextLogLevel.WARN, AMBER),
    Level.ALARM: (rr.TextLogLevel.CRITICAL, RED),
}
LIVE_BLOCK_S, FILE_BLOCK_S = 1.0, 10.0
"""Samples are sent in blocks of at least this length: short for viewers that watch, long for a small file."""
COLUMNS = ((0.0, 0.0), (0.6, 0.0), (0.6, 0.6), (0.0, 0.6))
"""Corners of the frame; it is drawn 1 high."""
STABILISATION = (100.0, 55.0)
"""Width and height of the stabilisation diagram's canvas."""


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """What the viewer needs to know of the site."""

    name: str
    channels: tuple[str, ...]
    sensor_floor: tuple[int, ...]
    """Floor of each channel, from 1 = top."""
    story_heights_m: Array
    """Shape (n,); story 1 = top.  Only their proportions are drawn."""
    baseline_frequencies_hz: Array | None
    """Shape (m,); mode 0 = lowest."""
    has_baseline: bool
    alarm_loss: float
    """Relative stiffness loss that counts as an alarm."""

    @property
    def n_stories(self) -> int:
        """Stories, as many as the model has modes."""
        return len(self.story_heights_m)


def severity(loss: float | None, alarm_loss: float) -> Colour:
    """Colour of a story: green, amber at half of `alarm_loss`, red from there on; grey when unknown."""
    if loss is None:
        return GREY
    x = float(np.clip(2.0 * loss / alarm_loss, 0.0, 2.0))
    mixed = [np.interp(x, (0.0, 1.0, 2.0), stops) for stops in zip(GREEN, AMBER, RED, strict=True)]
    return round(mixed[0]), round(mixed[1]), round(mixed[2])


def utc(t_ns: int) -> np.datetime64:
    """UTC nanoseconds as NumPy's time."""
    return np.datetime64(t_ns, "ns")


def plus_minus(value: float, std: float, scale: float = 1.0, digits: int = 1) -> str:
    """A value with two standard deviations."""
    return f"{value * scale:.{digits}f} ± {2 * std * scale:.{digits}f}"


def status(scene: Scene, result: WindowResult) -> str:
    """The state after a window in words, Markdown; intervals are two standard deviations."""
    end = datetime.fromtimestamp(result.t_end_ns * 1e-9, UTC)
    alarm, modes, damage = result.alarm, result.modes, result.damage
    judged = result.skipped is None or alarm.level is not Level.NORMAL
    lines = [f"# {alarm.level.value.upper() if judged else 'NOT JUDGED'}", alarm.reason, ""]
    if result.skipped is not None:
        lines += [f"**No result for this window:** {result.skipped.reason}", ""]
    if damage is not None:
        since = "since the baseline" if scene.has_baseline else "against the structure file (no baseline)"
        lines += [f"Stiffness lost {since}, alarm from {100 * scene.alarm_loss:g} %", ""]
        lines += ["| story | loss, % (± 2σ) |", "|---|---|"]
        pairs = zip(damage.ddi, damage.ddi_std, strict=True)
        lines += [f"| {j} | {plus_minus(d, s, 100)} |" for j, (d, s) in enumerate(pairs, 1)] + [""]
    if modes is not None:
        lines += ["| mode | frequency, Hz (± 2σ) | baseline, Hz | damping, % (± 2σ) |", "|---|---|---|---|"]
        for k, f, fs, d, ds in rows(modes):
            base = scene.baseline_frequencies_hz
            was = f"{base[k]:.3f}" if base is not None and k < len(base) else "-"
            lines.append(f"| {k + 1} | {plus_minus(f, fs, digits=3)} | {was} | {plus_minus(d, ds, 100, 2)} |")
    lines += ["", f"{scene.name}, window of {result.window_s:g} s to {end:%Y-%m-%d %H:%M:%S} UTC"]
    return "\n".join(lines)


def rows(modes: ModalEstimate) -> list[tuple[int, float, float, float, float]]:
    """For each mode: number of the model's mode, frequency and its std (Hz), damping ratio and its std."""
    columns = (modes.frequencies_hz, modes.frequencies_std_hz, modes.damping_ratio, modes.damping_std)
    table = np.column_stack(columns).tolist()
    return [(int(k), f, fs, d, ds) for k, (f, fs, d, ds) in zip(modes.model_mode, table, strict=True)]


HOLE = rr.Scalars([np.nan] * 3)
"""No value: breaks a line and its bounds, where no row would be bridged, and a Clear or an empty row drags the axis to 0."""
ALL_TIME = rrb.TimeAxis(
    view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
)
"""Otherwise plots show one minute about the cursor."""


def _plot(origin: str, name: str, *, legend: bool = True) -> rrb.TimeSeriesView:
    """Series over all the time there is."""
    corner = rrb.PlotLegend("LeftTop", visible=legend)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=corner, axis_x=ALL_TIME)


def blueprint(scene: Scene) -> rrb.Blueprint:
    """The state at the left, how it came about at the right."""
    n = scene.n_stories
    modes = [_plot(f"/modes/frequency/{i}", f"Mode {i}, Hz", legend=False) for i in range(1, n + 1)]
    together = _plot("/modes/frequency", "Frequencies, Hz")
    since = "since the baseline" if scene.has_baseline else "against the structure file"
    width, height = STABILISATION
    bounds = rrb.VisualBounds2D(x_range=[-0.2 * width, 1.06 * width], y_range=[-1.06 * height, 0.14 * height])
    centre = 0.275 * n
    eye = rrb.EyeControls3D(position=(centre, -1.1 - 0.5 * n, 0.75), look_target=(centre, 0.0, 0.42))
    left = rrb.Vertical(
        rrb.Spatial3DView(
            origin="/frame", name="Stiffness lost and mode shapes", eye_controls=eye,
            line_grid=rrb.LineGrid3D(visible=False), background=(24, 26, 30),
        ),
        rrb.TextDocumentView(origin="/status", name="Status"),
        row_shares=[1, 1],
    )  # fmt: skip
    right = rrb.Vertical(
        rrb.Tabs(
            _plot("/ddi", f"Stiffness lost {since} (DDI), %"),
            _plot("/stiffness", "Stiffness, N/m"),
            active_tab=0 if scene.has_baseline else 1,
        ),
        rrb.StateTimelineView(origin="/alarm_level", name="Alarm level", time_view=ALL_TIME),
        rrb.Horizontal(
            rrb.Vertical(*modes) if n <= 3 else together,
            rrb.Tabs(
                rrb.Spatial2DView(
                    origin="/", contents="/stabilisation/**", visual_bounds=bounds, background=(24, 26, 30),
                    name="Stabilisation diagram: order over frequency, Hz",
                ),
                _plot("/modes/damping", "Damping, %"),
            ),
        ),
        rrb.Horizontal(
            _plot("/streams", "Acceleration, m/s²"),
            rrb.TextLogView(origin="/", contents=["/alarms", "/events"], name="Alarms and events",
                            columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])),
        ),
        row_shares=[5, 2, 6, 3],
    )  # fmt: skip
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
