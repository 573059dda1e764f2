"""Drawing of the results into a Rerun recording; owned by one thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import rerun as rr

from monitor.core import Gap, ModalEstimate, Samples, StiffnessEstimate, WindowResult
from monitor.damage import Assessment, is_seen
from monitor.events import Event
from monitor.publish.results.event_lines import event_text as words_of, telling
from monitor.publish.results.window_fields import shown_as
from monitor.publish.viewer.layout import DRIFT, blueprint
from monitor.publish.viewer.mode_shapes import ModeShapes, label
from monitor.publish.viewer.rows import Rows, Strips, name_line, ui_radius
from monitor.publish.viewer.scene import (
    GREEN,
    GREY,
    LIVE_BLOCK_S,
    NO_VALUE,
    RED,
    SERIES,
    STABILISATION,
    Clocks,
    Scene,
    loss_colour,
    mode_rows,
    plus_minus,
    status_markdown,
)
from monitor.publish.viewer.spectra import FILE_EVERY_S, LIVE_EVERY_S, SpectraDrawing, follows
from monitor.publish.viewer.state import PLAIN, StateDrawing, event_text
from monitor.publish.viewer.thinning import Thinning
from monitor.publish.viewer.trust import TrustDrawing
from monitor.signals import Health

Item = Samples | WindowResult | Gap | Health | Clocks | Assessment | Event | dict[str, Any]
"""Items that can be drawn; a dict is a finding."""


class ResultDrawing:
    """Drawing of all results into one recording, in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, block_s: float, *, thin: bool = False) -> None:
        self._scene, self._stream, self._block_s = scene, stream, block_s
        self._rows, self._most, self._gathered = Rows(stream), max(1, round(block_s / LIVE_BLOCK_S)), 0
        self._blocks: list[Samples] = []
        self._state = StateDrawing(stream, live=block_s <= LIVE_BLOCK_S)
        baseline_hz = scene.baseline_frequencies_hz
        self._reference_hz = {
            k: hz for k, hz in enumerate(() if baseline_hz is None else baseline_hz.tolist()) if hz > 0.0
        }
        """Frequency of each mode from which its change is counted: the baseline's, else the first one found."""
        self._found: set[int] = set()
        """Modes that were found at least once."""
        self._skipped: str | None = None
        self._left_out: set[str] = set()
        self._extent = (1.0, 1.0)
        every_s = LIVE_EVERY_S if block_s <= LIVE_BLOCK_S else FILE_EVERY_S
        self._spectra, self._trust = (
            SpectraDrawing(scene, stream, self._rows, every_s),
            TrustDrawing(scene, stream, self._rows),
        )
        self._shapes, self._plan = ModeShapes(scene, stream, self._rows), scene.plan
        self._is_member = scene.drawing.stories >= 0
        self._radius = [0.02 if self._plan.apart is None else 0.012]
        self._members = Strips(self._plan.points[scene.drawing.lines[self._is_member]])
        self._thin = Thinning() if thin else None
        self._drawn_by: dict[type[Any], Callable[[Any], None]] = {
            Assessment: self._state.take,
            Clocks: self._trust.clocks,
            Event: self.event,
            Gap: self.gap,
            Health: self._trust.health,
            Samples: self.samples,
            WindowResult: self.window,
            dict: self._trust.finding,
        }

    def begin(self) -> None:
        """Draw the names, the colours and the static parts."""
        self._stream.send_blueprint(blueprint(self._scene))
        self._trust.begin()
        self._state.begin()
        for i, channel in enumerate(self._scene.channels):
            self._style(self._stream_path(channel), [channel], i)
        for j, (_, name, i) in enumerate(self._scene.series, 1):
            for entity in ("ddi", "stiffness"):
                self._style(f"/{entity}/story_{j}", [name] * 3, i)
            marks = rr.SeriesPoints(names=[name], colors=[SERIES[i % len(SERIES)]], marker_sizes=[5.0])
            self._stream.log(f"{DRIFT}/story_{j}", marks, static=True)
        for i, name in enumerate(() if self._scene.features is None else self._scene.features.features):
            self._style(f"/modes/change/{i + 1}", [name] * 3, i)
            self._style(f"/modes/sigma/{i + 1}", [name], i)
        for i in range(self._scene.n_modes):
            for entity in ("frequency", "change", "damping"):
                self._style(f"/modes/{entity}/{i + 1}", [f"mode {i + 1}"] * 3, i)
        name_line(self._stream, "/ddi/alarm_loss", "alarm", RED, widths=[1.0])
        drawing, points = self._scene.drawing, self._plan.points
        others = rr.LineStrips3D(list(points[drawing.lines[~self._is_member]]), colors=[GREY], radii=[0.006])
        self._stream.log("/frame/lines", others, static=True)
        named = [(points[i], name) for i, name in enumerate(drawing.names) if name]
        if named:
            dot = 0.0001 if drawing.beside else 0.012
            nodes = rr.Points3D([p for p, _ in named], labels=[n for _, n in named], colors=[GREY], radii=[dot],
                                show_labels=True)  # fmt: skip
            self._stream.log("/frame/nodes", nodes, static=True)

    @staticmethod
    def _stream_path(channel: str) -> str:
        return "/streams/" + rr.escape_entity_path_part(channel)

    def _style(self, path: str, names: list[str], i: int) -> None:
        """Set names and colour of a line; its bounds are fainter and thinner."""
        colour = SERIES[i % len(SERIES)]
        faint = (*colour, 110)
        self._stream.log(
            path,
            rr.SeriesLines(names=names, colors=[(*colour, 255), faint, faint][: len(names)],
                           widths=[2.0, 0.7, 0.7][: len(names)]),
            static=True,
        )  # fmt: skip

    def draw(self, item: Item) -> None:
        """Draw an item from the queue."""
        self._drawn_by[type(item)](item)
        if isinstance(item, Health | WindowResult):
            self._gathered += 1
            if self._gathered >= self._most * self._stretch:
                self._send()

    @property
    def _stretch(self) -> int:
        """Factor on the amount that is sent at once; viewers that watch are not kept waiting."""
        return 1 if self._thin is None or self._block_s <= LIVE_BLOCK_S else self._thin.stretch

    def samples(self, samples: Samples) -> None:
        """Collect blocks until they are long enough to send."""
        self._state.reached(samples.t_ns)
        self._spectra.samples(samples)
        if self._blocks and not follows(self._blocks[-1], samples):
            self.flush()
        self._blocks.append(samples)
        if sum(len(block.values) for block in self._blocks) >= self._block_s * self._stretch * samples.rate_hz:
            self.flush()

    def finish(self) -> None:
        """Send the remaining results, and the latest mode shapes as an animation."""
        self.flush()
        self._send()
        self._state.finish()
        self._shapes.animate()

    def flush(self) -> None:
        """Send the collected samples."""
        if not self._blocks:
            return
        first = self._blocks[0]
        values = np.concatenate([block.values for block in self._blocks])
        self._blocks = []
        t_ns = first.t_ns + np.round(np.arange(len(values)) * (1e9 / first.rate_hz)).astype(np.int64)
        if self._thin is not None:
            t_ns, values = self._thin.samples(t_ns, values)
        time = rr.TimeColumn("time", timestamp=t_ns.astype("datetime64[ns]"))
        for channel, column in zip(self._scene.channels, values.T, strict=True):
            self._stream.send_columns(self._stream_path(channel), [time], rr.Scalars.columns(scalars=column))

    def _send(self) -> None:
        self._rows.send()
        self._state.send()
        self._gathered = 0

    def gap(self, gap: Gap) -> None:
        """Break the lines of the streams where samples are missing."""
        self.flush()
        self._set_time(gap.t_ns)
        self._event(gap.t_ns, f"gap of {gap.duration_s:.3g} s: {gap.reason}", rr.TextLogLevel.WARN)
        for channel in self._scene.channels:
            self._stream.log(self._stream_path(channel), rr.Scalars(np.nan))

    def event(self, event: Event) -> None:
        """Write an event into the log, and draw the largest drift of each story at its end."""
        self._set_time(event.end_ns)
        level = rr.TextLogLevel.WARN if event.exceeded else rr.TextLogLevel.INFO
        self._event(event.end_ns, f"{telling(event)}: {words_of(event, self._scene.story_names)}", level)
        for j in np.flatnonzero(np.isfinite(event.drift_m)):
            self._stream.log(f"{DRIFT}/story_{j + 1}", rr.Scalars(1e3 * event.drift_m[j]))

    def window(self, result: WindowResult) -> None:
        """Draw the result of one window at the window's end."""
        if self._thin is not None and not self._thin.window(result, changed=self._state.changed):
            return
        self._set_time(result.t_end_ns)
        self._rows.text("/status", status_markdown(self._scene, result))
        self._state.draw(result.t_end_ns)
        self._tell_changes(result)
        self._modes(result)
        self._features(result)
        self._stiffness(result.stiffness)
        self._damage(result)
        self._shapes.draw(result.modes if result.modes is not None and result.modes.model_mode.size else None)
        self._trust.misfit(None if result.stiffness is None else result.stiffness.misfit)
        self._trust.covariates({n: shown_as(n, v[0], result) for n, v in result.covariates.items()})
        self._spectra.window(result)
        if result.modes is not None:
            self._stabilisation(result.modes)

    def _tell_changes(self, result: WindowResult) -> None:
        """Write into the log from when on windows are skipped and channels left out, and where that ends."""
        reason = result.skipped.reason if result.skipped else None
        if reason != self._skipped:
            text = f"no result: {reason}" if reason else "results again"
            self._event(result.t_end_ns, text, rr.TextLogLevel.INFO)
            self._skipped = reason
        left_out = {gone.channel: gone.reason for gone in result.left_out}
        for channel in sorted(left_out.keys() ^ self._left_out):
            text = f"is left out: it {left_out[channel]}" if channel in left_out else "is in use again"
            self._event(result.t_end_ns, f"{channel} {text}", rr.TextLogLevel.WARN)
        self._left_out = set(left_out)

    def _modes(self, result: WindowResult) -> None:
        """Draw frequency, damping and change of every mode that was found before."""
        modes = {row[0]: row for row in mode_rows(result.modes)} if result.modes else {}
        self._found |= modes.keys()
        for k in sorted(self._found):
            _, f, fs, d, ds = modes.get(k, (k, *[None] * 4))
            self._bounded(f"/modes/frequency/{k + 1}", f, fs)
            self._bounded(f"/modes/damping/{k + 1}", d, ds, 100.0)
            reference = self._reference_hz.setdefault(k, f or np.nan)
            change, change_std = (None, None) if f is None or fs is None else (f / reference - 1.0, fs / reference)
            if result.modal is not None and f is not None:  # less what the covariates explain
                change, change_std = np.expm1(result.modal.ln_frequency[k]), result.modal.ln_frequency_std[k]
            self._bounded(f"/modes/change/{k + 1}", change, change_std, 100.0)

    def _features(self, result: WindowResult) -> None:
        """Draw the change of every feature, and what the covariates leave of its reading."""
        said, parts = result.features, self._scene.features
        if said is None or parts is None:
            return
        rows = zip(said.change.tolist(), said.change_std.tolist(), said.sigma.tolist(), parts.relative, strict=True)
        for k, (change, std, sigma, relative) in enumerate(rows, 1):
            self._bounded(
                f"/modes/change/{k}", change if np.isfinite(change) else None, std, 100.0 if relative else 1.0
            )
            self._rows.scalars(f"/modes/sigma/{k}", sigma)

    def _set_time(self, t_ns: int) -> None:
        """Set the time of what is drawn next, UTC in ns."""
        self._stream.set_time("time", timestamp=np.datetime64(t_ns, "ns"))
        self._rows.at(t_ns)

    def _event(self, t_ns: int, text: str, level: rr.TextLogLevel) -> None:
        self._stream.log("/events", rr.TextLog(event_text(t_ns, text), level=level, color=PLAIN))

    def _bounded(self, path: str, value: float | None, std: float | None, scale: float = 1.0) -> None:
        """Draw one value with two standard deviations on either side, or an interruption where there is none."""
        if value is None or std is None:
            self._rows.scalars(path, *NO_VALUE)
        else:
            self._rows.scalars(path, scale * value, scale * (value - 2 * std), scale * (value + 2 * std))

    def _stiffness(self, stiffness: StiffnessEstimate | None) -> None:
        n = self._scene.n_stories
        values = stiffness.stiffness_n_per_m.tolist() if stiffness else [None] * n
        stds = np.sqrt(np.diag(stiffness.covariance)).tolist() if stiffness else [None] * n
        for j, (value, std) in enumerate(zip(values, stds, strict=True)):
            self._bounded(f"/stiffness/story_{j + 1}", value, std)

    def _damage(self, result: WindowResult) -> None:
        """Draw the damage index over time, and colour the frame by it: green only where a loss would have been seen."""
        if not self._scene.n_stories:
            return
        damage, detectable = result.damage, result.detectable_loss
        loss_at, n = self._scene.alarm_loss, self._scene.n_stories
        readings: list[tuple[float | None, float | None]] = [(None, None)] * n
        if damage is not None:
            readings = list(zip(damage.ddi.tolist(), damage.ddi_std.tolist(), strict=True))
        if damage is not None and self._scene.has_baseline:
            self._rows.scalars("/ddi/alarm_loss", 100.0 * loss_at)
        colours, labels = [], []
        for j, (ddi, std) in enumerate(readings):
            if is_blind := detectable is not None and detectable[j] >= 1.0:  # nothing but the prior
                ddi = std = None
            self._bounded(f"/ddi/story_{j + 1}", ddi, std, 100.0)
            seen = detectable is not None and is_seen(float(detectable[j]), loss_at)
            judged = self._scene.has_baseline and (seen or j + 1 in result.alarm.active)
            colours.append(loss_colour(ddi if judged else None, loss_at))
            unknown = "not seen" if is_blind else "unknown"
            known = unknown if ddi is None or std is None else plus_minus(ddi, std, 100) + " %"
            is_quiet = ddi is None or std is None or abs(ddi) <= 2 * std
            named = (f"{j + 1}", f"{self._scene.story_names[j]}: {known}") if self._plan.apart is None else ("", known)
            labels.append(named[0] if self._plan.is_crowded and is_quiet else named[1])
        of_stories = np.array(colours, dtype=np.uint8)
        of_members = of_stories[self._scene.drawing.stories[self._is_member]]
        self._rows.add("/frame/stories", rr.LineStrips3D, strips=self._members, colors=of_members, radii=self._radius)
        places = [(x, y, z) for x, y, z in self._plan.labels.tolist()]
        label(self._rows, "/frame/stories/labels", places, labels, of_stories)

    def _stabilisation(self, modes: ModalEstimate) -> None:
        """Draw the poles in (Hz, order), scaled to the canvas, with axes and the selected modes."""
        poles = modes.poles
        if not len(poles):
            return
        f_max = max(self._extent[0], 5.0 * np.ceil(poles[:, 1].max() / 5.0))
        n_max = max(self._extent[1], 10.0 * np.ceil(poles[:, 0].max() / 10.0))
        if (f_max, n_max) != self._extent:
            self._extent = (f_max, n_max)
            self._stabilisation_axes(f_max, n_max)
        colours = np.where(poles[:, 3:] > 0, GREEN, GREY).astype(np.uint8)
        width, height = STABILISATION
        self._rows.add("/stabilisation", rr.Transform3D, scale=[(width / f_max, -height / n_max, 1.0)])
        self._rows.add("/stabilisation", rr.Points2D, positions=poles[:, [1, 0]], colors=colours,
                       radii=ui_radius(2.5), draw_order=[2.0])  # fmt: skip
        selected = [*modes.frequencies_hz.tolist(), *(mode.frequency_hz for mode in modes.others)]
        chosen = Strips(np.array([(f, 0.0), (f, n_max)]) for f in selected)
        of_model = [SERIES[k % len(SERIES)] for k in modes.model_mode.tolist()]
        self._rows.add("/stabilisation/modes", rr.LineStrips2D, strips=chosen,
                       colors=[*of_model, *[GREY] * len(modes.others)],
                       radii=ui_radius(0.8), draw_order=[1.0])  # fmt: skip

    def _stabilisation_axes(self, f_max: float, n_max: float) -> None:
        """Draw the axes again when they grow."""
        frame = rr.LineStrips2D([[(0, n_max), (0, 0), (f_max, 0)]], colors=[GREY], draw_order=0.0)
        self._stream.log("/stabilisation/axes", frame)
        ticks = [(f, 0.0, f"{f:g} Hz") for f in np.arange(0.0, f_max + 0.1, 10.0 if f_max > 25.0 else 5.0)]
        ticks += [(-0.1 * f_max, n, f"order {n:g}") for n in np.linspace(0, n_max, 3)[1:]]
        places, texts = [(f, n) for f, n, _ in ticks], [text for *_, text in ticks]
        marks = rr.Points2D(places, labels=texts, colors=[GREY], radii=rr.Radius.ui_points(2.0), show_labels=True)
        self._stream.log("/stabilisation/ticks", marks)
