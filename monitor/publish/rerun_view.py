"""What the monitor says, as a Rerun recording: a file to keep, a server that viewers join, or both.

The only clock is the data's: everything stands on the timeline ``time``, in UTC.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from monitor.publish.rerun_queue import Output, Worker
from monitor.results import Array, DamageReading, Gap, Level, ModalEstimate, Samples, StiffnessEstimate, WindowResult

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


def _utc(t_ns: int) -> np.datetime64:
    return np.datetime64(t_ns, "ns")


def _plus_minus(value: float, std: float, scale: float = 1.0, digits: int = 1) -> str:
    return f"{value * scale:.{digits}f} ± {2 * std * scale:.{digits}f}"


def status(scene: Scene, result: WindowResult) -> str:
    """The state after a window in words, Markdown; intervals are two standard deviations."""
    end = datetime.fromtimestamp(result.t_end_ns * 1e-9, UTC)
    alarm, modes, damage = result.alarm, result.modes, result.damage
    lines = [f"# {alarm.level.value.upper()}", alarm.reason, ""]
    if result.skipped is not None:
        lines += [f"**No result for this window:** {result.skipped.reason}", ""]
    if damage is not None:
        since = "since the baseline" if scene.has_baseline else "against the structure file (no baseline)"
        lines += [f"Stiffness lost {since}, alarm from {100 * scene.alarm_loss:g} %", ""]
        lines += ["| story | loss, % (± 2σ) |", "|---|---|"]
        pairs = zip(damage.ddi, damage.ddi_std, strict=True)
        lines += [f"| {j} | {_plus_minus(d, s, 100)} |" for j, (d, s) in enumerate(pairs, 1)] + [""]
    if modes is not None:
        lines += ["| mode | frequency, Hz (± 2σ) | baseline, Hz | damping, % (± 2σ) |", "|---|---|---|---|"]
        for k, f, fs, d, ds in _rows(modes):
            base = scene.baseline_frequencies_hz
            was = f"{base[k]:.3f}" if base is not None and k < len(base) else "-"
            lines.append(f"| {k + 1} | {_plus_minus(f, fs, digits=3)} | {was} | {_plus_minus(d, ds, 100, 2)} |")
    lines += ["", f"{scene.name}, window of {result.window_s:g} s to {end:%Y-%m-%d %H:%M:%S} UTC"]
    return "\n".join(lines)


def _rows(modes: ModalEstimate) -> list[tuple[int, float, float, float, float]]:
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


class _Picture:
    """Draws on one recording; lives in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, block_s: float) -> None:
        self._scene, self._stream, self._block_s = scene, stream, block_s
        self._blocks: list[Samples] = []
        self._level: Level | None = None
        self._skipped: str | None = None
        self._extent = (1.0, 1.0)
        heights = np.asarray(scene.story_heights_m, dtype=float)
        self._z = np.append(np.cumsum(heights[::-1])[::-1], 0.0) / heights.sum()
        """Shape (n + 1,): height of floor 1 (top) .. n and of the ground, the whole frame 1 high."""

    def begin(self) -> None:
        """Names, colours and what never changes."""
        self._stream.send_blueprint(blueprint(self._scene))
        for i, channel in enumerate(self._scene.channels):
            self._style(self._stream_path(channel), [channel], i)
        for i in range(self._scene.n_stories):
            for entity in ("ddi", "stiffness"):
                self._style(f"/{entity}/story_{i + 1}", [f"story {i + 1}"] * 3, i)
            for entity in ("frequency", "damping"):
                self._style(f"/modes/{entity}/{i + 1}", [f"mode {i + 1}"] * 3, i)
        threshold = rr.SeriesLines(names=["alarm"], colors=[RED], widths=[1.0])
        self._stream.log("/ddi/alarm_loss", threshold, static=True)
        words = [level.value for level in LEVELS]
        states = rr.StateConfiguration(values=words, labels=words, colors=[colour for _, colour in LEVELS.values()])
        self._stream.log("/alarm_level", states, static=True)
        centres = [(0.3, 0.3, z) for z in self._z]
        half = [(0.33, 0.33, 0.012)] * self._scene.n_stories + [(0.45, 0.45, 0.008)]
        slabs = rr.Boxes3D(centers=centres, half_sizes=half, colors=[(150, 155, 165)], fill_mode="solid")
        self._stream.log("/frame/floors", slabs, static=True)

    @staticmethod
    def _stream_path(channel: str) -> str:
        return "/streams/" + rr.escape_entity_path_part(channel)

    def _style(self, path: str, names: list[str], i: int) -> None:
        """Name and colour a line, and its bounds fainter and thinner."""
        colour = SERIES[i % len(SERIES)]
        faint = (*colour, 110)
        self._stream.log(
            path,
            rr.SeriesLines(names=names, colors=[(*colour, 255), faint, faint][: len(names)],
                           widths=[2.0, 0.7, 0.7][: len(names)]),
            static=True,
        )  # fmt: skip

    def draw(self, item: Samples | WindowResult | Gap) -> None:
        """Whatever comes out of the queue."""
        if isinstance(item, Samples):
            self.samples(item)
        elif isinstance(item, Gap):
            self.gap(item)
        else:
            self.window(item)

    def samples(self, samples: Samples) -> None:
        """Collect blocks until they are long enough to send."""
        if self._blocks:
            last = self._blocks[-1]
            due = last.t_ns + len(last.values) / last.rate_hz * 1e9
            if samples.rate_hz != last.rate_hz or abs(samples.t_ns - due) > 0.5e9 / samples.rate_hz:
                self.flush()
        self._blocks.append(samples)
        if sum(len(block.values) for block in self._blocks) >= self._block_s * samples.rate_hz:
            self.flush()

    def flush(self) -> None:
        """Send the samples collected."""
        if not self._blocks:
            return
        first = self._blocks[0]
        values = np.concatenate([block.values for block in self._blocks])
        self._blocks = []
        t_ns = first.t_ns + np.round(np.arange(len(values)) * (1e9 / first.rate_hz)).astype(np.int64)
        time = rr.TimeColumn("time", timestamp=t_ns.astype("datetime64[ns]"))
        for channel, column in zip(self._scene.channels, values.T, strict=True):
            self._stream.send_columns(self._stream_path(channel), [time], rr.Scalars.columns(scalars=column))

    def gap(self, gap: Gap) -> None:
        """Break the streams where samples are missing."""
        self.flush()
        self._at(gap.t_ns)
        self._event(f"gap of {gap.duration_s:.3g} s: {gap.reason}", rr.TextLogLevel.WARN)
        for channel in self._scene.channels:
            self._stream.log(self._stream_path(channel), rr.Scalars(np.nan))

    def window(self, result: WindowResult) -> None:
        """Everything said about one window, at its end."""
        self._at(result.t_end_ns)
        self._stream.log("/status", rr.TextDocument(status(self._scene, result), media_type="text/markdown"))
        self._alarm(result)
        reason = result.skipped.reason if result.skipped else None
        if reason != self._skipped:
            self._event(f"no result: {reason}" if reason else "results again", rr.TextLogLevel.INFO)
            self._skipped = reason
        modes = {row[0]: row for row in _rows(result.modes)} if result.modes else {}
        for k in range(self._scene.n_stories):
            _, f, fs, d, ds = modes.get(k, (k, *[None] * 4))
            self._bounded(f"/modes/frequency/{k + 1}", f, fs)
            self._bounded(f"/modes/damping/{k + 1}", d, ds, 100.0)
        self._stiffness(result.stiffness)
        self._damage(result.damage)
        self._shapes(result.modes)
        if result.modes is not None:
            self._stabilisation(result.modes)

    def _at(self, t_ns: int) -> None:
        self._stream.set_time("time", timestamp=_utc(t_ns))

    def _event(self, text: str, level: rr.TextLogLevel) -> None:
        self._stream.log("/events", rr.TextLog(text, level=level))

    def _alarm(self, result: WindowResult) -> None:
        """Tell changes of level only; a recording begins as normal."""
        alarm = result.alarm
        if alarm.level is self._level:
            return
        if self._level is not None or alarm.level is not Level.NORMAL:
            level, colour = LEVELS[alarm.level]
            where = f" (story {', '.join(map(str, alarm.stories))})" if alarm.stories else ""
            text = f"{alarm.level.value}{where}: {alarm.reason}"
            self._stream.log("/alarms", rr.TextLog(text, level=level, color=colour))
        self._level = alarm.level
        self._stream.log("/alarm_level", rr.StateChange(state=alarm.level.value))

    def _bounded(self, path: str, value: float | None, std: float | None, scale: float = 1.0) -> None:
        """One value with its two standard deviations either side, or a hole."""
        if value is None or std is None:
            self._stream.log(path, HOLE)
        else:
            bounds = np.array([value, value - 2 * std, value + 2 * std])
            self._stream.log(path, rr.Scalars(scale * bounds))

    def _stiffness(self, stiffness: StiffnessEstimate | None) -> None:
        n = self._scene.n_stories
        values = stiffness.stiffness_n_per_m.tolist() if stiffness else [None] * n
        stds = np.sqrt(np.diag(stiffness.covariance)).tolist() if stiffness else [None] * n
        for j in range(n):
            self._bounded(f"/stiffness/story_{j + 1}", values[j], stds[j])

    def _damage(self, damage: DamageReading | None) -> None:
        """The index over time, and the frame coloured by it."""
        loss_at, n = self._scene.alarm_loss, self._scene.n_stories
        readings: list[tuple[float | None, float | None]] = [(None, None)] * n
        if damage is not None:
            readings = list(zip(damage.ddi.tolist(), damage.ddi_std.tolist(), strict=True))
        if damage is not None:
            self._stream.log("/ddi/alarm_loss", rr.Scalars(100.0 * loss_at))
        for j, (ddi, std) in enumerate(readings):
            self._bounded(f"/ddi/story_{j + 1}", ddi, std, 100.0)
            top, foot = self._z[j], self._z[j + 1]
            colour = severity(ddi, loss_at)
            strips = [[(x, y, foot), (x, y, top)] for x, y in COLUMNS]
            known = "unknown" if ddi is None or std is None else _plus_minus(ddi, std, 100) + " %"
            path = f"/frame/story_{j + 1}"
            self._stream.log(path, rr.LineStrips3D(strips, colors=[colour], radii=[0.022]))
            label = rr.Points3D([(-0.45, 0.0, (top + foot) / 2)], labels=[f"story {j + 1}: {known}"],
                                colors=[colour], radii=[0.0001], show_labels=True)  # fmt: skip
            self._stream.log(path + "/label", label)

    def _shapes(self, modes: ModalEstimate | None) -> None:
        """Mode shapes beside the frame: real part, floors without a sensor left out."""
        rows = _rows(modes) if modes else []
        for k in set(range(self._scene.n_stories)).difference(row[0] for row in rows):
            self._stream.log(f"/frame/modes/{k + 1}", rr.Clear(recursive=True))
        if modes is None:
            return
        order = sorted(range(len(self._scene.sensor_floor)), key=self._scene.sensor_floor.__getitem__)
        z = np.append(self._z[[self._scene.sensor_floor[c] - 1 for c in order]], 0.0)
        for shape, row in zip(modes.shapes, rows, strict=True):
            k, f = row[0], row[1]
            x = 1.15 + 0.55 * k
            deflection = np.append(np.real(shape[order]), 0.0)
            deflection *= 0.2 / max(float(np.abs(deflection).max()), 1e-12)
            shape_at = np.column_stack([x + deflection, np.zeros_like(z), z])
            path, colour = f"/frame/modes/{k + 1}", SERIES[k % len(SERIES)]
            strips = [np.array([(x, 0, 0), (x, 0, 1)]), shape_at]
            self._stream.log(path, rr.LineStrips3D(strips, colors=[GREY, colour], radii=[0.004, 0.014]))
            self._stream.log(path + "/floors", rr.Points3D(shape_at, colors=[colour], radii=[0.03]))
            label = rr.Points3D([(x, 0, -0.12)], labels=[f"{f:.2f} Hz"], colors=[colour], radii=[0.0001],
                                show_labels=True)  # fmt: skip
            self._stream.log(path + "/label", label)

    def _stabilisation(self, modes: ModalEstimate) -> None:
        """Poles in (Hz, order), stretched to the canvas, with their axes and the modes chosen."""
        poles = modes.poles
        if not len(poles):
            return
        f_max = max(self._extent[0], 5.0 * np.ceil(poles[:, 1].max() / 5.0))
        n_max = max(self._extent[1], 10.0 * np.ceil(poles[:, 0].max() / 10.0))
        self._extent = (f_max, n_max)
        width, height = STABILISATION
        stretch = rr.Transform3D(scale=(width / f_max, -height / n_max, 1.0))
        colours = np.where(poles[:, 3:] > 0, GREEN, GREY).astype(np.uint8)
        points = rr.Points2D(poles[:, [1, 0]], colors=colours, radii=rr.Radius.ui_points(2.5), draw_order=2.0)
        self._stream.log("/stabilisation", stretch, points)
        frame = rr.LineStrips2D([[(0, n_max), (0, 0), (f_max, 0)]], colors=[GREY], draw_order=0.0)
        self._stream.log("/stabilisation/axes", frame)
        ticks = [(f, 0.0) for f in np.linspace(0, f_max, 6)] + [(-0.1 * f_max, n) for n in np.linspace(0, n_max, 3)[1:]]
        texts = [f"{f:g} Hz" for f, _ in ticks[:6]] + [f"order {n:g}" for _, n in ticks[6:]]
        marks = rr.Points2D(ticks, labels=texts, colors=[GREY], radii=rr.Radius.ui_points(2.0), show_labels=True)
        self._stream.log("/stabilisation/ticks", marks)
        chosen = [[(f, 0), (f, n_max)] for f in modes.frequencies_hz]
        lines = rr.LineStrips2D(chosen, colors=[SERIES[k % len(SERIES)] for k in modes.model_mode],
                                radii=rr.Radius.ui_points(0.8), draw_order=1.0)  # fmt: skip
        self._stream.log("/stabilisation/modes", lines)


class RerunPublisher:
    """Publishes results to a file, to viewers that join, or both, and never holds up or fails its caller.

    Parameters
    ----------
    scene : Scene
    file : Path, optional
        Written beside itself as ``.part`` and renamed by `close`.
    serve : (str, int), optional
        Address and port where viewers may join.
    lossless : bool
        Whether a full queue makes the caller wait (replay to a file) or drops and counts (daemon).
    queue_size : int
        Blocks and results that may wait.

    Notes
    -----
    Trouble of any kind, an unwritable file and a taken port included, shows in `failed`, and is logged once.
    """

    def __init__(
        self, scene: Scene, *, file: Path | None, serve: tuple[str, int] | None, lossless: bool, queue_size: int = 256
    ) -> None:
        self._scene, self._file, self._serve = scene, file, serve
        self._timeout_s = 10.0
        self._worker: Worker[Samples | WindowResult | Gap] = Worker("rerun", self._run, queue_size, lossless)

    @property
    def dropped(self) -> int:
        """Blocks, results and gaps that found the queue full."""
        return self._worker.dropped

    @property
    def failed(self) -> str | None:
        """Why nothing is published any more."""
        return self._worker.failed

    def samples(self, samples: Samples) -> None:
        """Publish conditioned samples, shape (n_samples, c), m/s^2, in blocks of any size."""
        self._worker.put(replace(samples, values=samples.values.copy()))  # the caller may reuse its buffer

    def window(self, result: WindowResult) -> None:
        """Publish everything said about a window."""
        self._worker.put(result)

    def gap(self, gap: Gap) -> None:
        """Publish that samples are missing."""
        self._worker.put(gap)

    def close(self, timeout_s: float = 10.0) -> None:
        """Publish what waits and finish the file; gives up after `timeout_s`."""
        self._timeout_s = timeout_s
        self._worker.close(timeout_s)

    def abort(self, timeout_s: float = 10.0) -> None:
        """Stop at once and leave no file."""
        self._worker.close(timeout_s, cancel=True)

    def _run(self, take: Callable[[], Samples | WindowResult | Gap | None]) -> None:
        """Work of the thread: open, draw until the queue is closed, finish."""
        output = Output(self._scene.name, self._file, self._serve)
        try:
            picture = _Picture(self._scene, output.stream, LIVE_BLOCK_S if self._serve else FILE_BLOCK_S)
            picture.begin()
            while (item := take()) is not None:
                picture.draw(item)
            picture.flush()
            if not self._worker.cancelled:
                output.close(self._timeout_s)
        finally:
            output.abandon()
