"""Drawing of the spectra: those measured lately, and those of the model that fits the window."""

from __future__ import annotations

from collections import deque
from typing import Annotated

import numpy as np
import rerun as rr

from monitor.core import Array, Samples, WindowResult
from monitor.model import Model
from monitor.publish.viewer.rows import Rows, Strips, ui_radius
from monitor.publish.viewer.scene import GREY, SERIES, STABILISATION, Scene
from monitor.signals import taper

LIVE_EVERY_S, FILE_EVERY_S = 60.0, 200.0
"""Intervals at which spectra are drawn, s; spectra change slowly, and after 200 s half of the averaged data are new."""
_SEGMENT_S, _LONGEST_S = 20.0, 400.0
"""Length of a segment and longest span of the averaged data, s."""
_SPAN_DB = 80.0
"""Range of power shown for each channel. [dB; judgement]"""
_TICKS_DB = (70.0, 40.0, 10.0)
"""Heights of the ticks of a channel above its lower end. [dB; judgement]"""
_MOST_CHANNELS = 6
MODEL = (235, 235, 235)


def follows(last: Samples, samples: Samples) -> bool:
    """Tell whether samples come where the last ones end, within half a step, at their rate."""
    due_ns = last.t_ns + len(last.values) / last.rate_hz * 1e9
    return samples.rate_hz == last.rate_hz and abs(samples.t_ns - due_ns) <= 0.5e9 / samples.rate_hz


def predict_power(scene: Scene, result: WindowResult, hz: Annotated[Array, "bins"]) -> Annotated[Array, "bins c"]:
    """Predict the power of the channels under equal white forces on all floors, up to a common factor.

    Modes are superposed: the model has the window's stiffnesses, and the window's damping where it was measured.
    """
    assert isinstance(scene.model, Model)
    k = result.stiffness
    model = scene.model if k is None else scene.model.with_stiffness(k.stiffness_n_per_m)
    modes, damping = model.modes(), np.array(model.damping_ratios())
    if result.modes is not None:
        damping[result.modes.model_mode] = result.modes.damping_ratio
    w = 2.0 * np.pi * hz[:, None]
    modal = w**2 / (modes.eigenvalues - w**2 + 2j * damping * np.sqrt(modes.eigenvalues) * w)
    sensor_shapes = scene.sensors @ modes.shapes
    return np.asarray((np.abs(np.einsum("cm,fm,nm->fcn", sensor_shapes, modal, modes.shapes)) ** 2).sum(axis=2))


class SpectraDrawing:
    """Drawing of measured and modelled spectra, one channel above the other, every `every_s` seconds of data."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, to: Rows, every_s: float) -> None:
        self._scene, self._stream, self._to = scene, stream, to
        self._every_ns = round(every_s * 1e9)
        self._blocks: deque[Samples] = deque()
        self._top_db: float | None = None
        self._drawn_ns = -self._every_ns

    def samples(self, samples: Samples) -> None:
        """Keep the latest samples; samples before a gap or at another rate are discarded."""
        if self._blocks and not follows(self._blocks[-1], samples):
            self._blocks.clear()
        self._blocks.append(samples)
        while samples.t_ns - self._blocks[0].t_ns > _LONGEST_S * 1e9:
            self._blocks.popleft()

    def window(self, result: WindowResult) -> None:
        """Draw the spectra if they are due; the recording's time is the window's end."""
        if not self._blocks or result.t_end_ns - self._drawn_ns < self._every_ns:
            return
        rate, values = self._blocks[0].rate_hz, np.concatenate([b.values for b in self._blocks])
        if len(values) < _SEGMENT_S * rate:
            return
        self._drawn_ns = result.t_end_ns
        hz, power = _welch_power(values[:, :_MOST_CHANNELS], rate)
        band = (hz > 0.01 * self._scene.cutoff_hz) & (hz <= self._scene.cutoff_hz)
        hz, power = hz[band], power[band]
        lanes = power.shape[1]
        width, height = STABILISATION
        scale = (width / self._scene.cutoff_hz, -height / lanes, 1.0)
        colours = [SERIES[c % len(SERIES)] for c in range(lanes)]
        moves = np.isfinite(power).all(axis=0) & (power.max(axis=0) > 0.0)
        power[:, ~moves] = 0.0  # a dead channel, or one that lost samples: a line at the foot of its lane
        power = np.maximum(power, 1e-30 * max(power.max(), 1e-270))
        top_db = 10.0 * float(np.ceil(np.log10(max(power.max(), 1e-300)) + 0.5))  # alike for all, for comparison
        lines = Strips(_scale_to_lane(hz, p, top_db, lanes - 1 - c) for c, p in enumerate(power.T))
        self._to.add("/spectra", rr.Transform3D, scale=[scale])
        self._to.add("/spectra/measured", rr.LineStrips2D, strips=lines, colors=colours, radii=ui_radius(0.7))
        if self._scene.model is not None:
            model = predict_power(self._scene, result, hz)[:, :lanes]
            model *= power[:, moves].sum() / max(model[:, moves].sum(), 1e-300)
            lines = Strips(_scale_to_lane(hz, p, top_db, lanes - 1 - c) for c, p in enumerate(model.T))
            self._to.add("/spectra/model", rr.LineStrips2D, strips=lines, colors=[MODEL], radii=ui_radius(0.4))
        if top_db != self._top_db:
            self._top_db = top_db
            self._draw_axes(lanes, top_db)

    def _draw_axes(self, lanes: int, top_db: float) -> None:
        """Draw a frame for each channel, the frequencies, the power and the names of the channels."""
        f_max = self._scene.cutoff_hz
        frame = [[(0, c), (f_max, c)] for c in range(lanes + 1)] + [[(0, 0), (0, lanes)]]
        self._stream.log(
            "/spectra/axes", rr.LineStrips2D(frame, colors=[GREY], radii=rr.Radius.ui_points(0.3)), static=True
        )
        marks: list[tuple[float, float, str]] = [(f, -0.04 * lanes, f"{f:g} Hz") for f in np.linspace(0, f_max, 5)]
        for c, channel in enumerate(self._scene.channels[:lanes]):
            foot = lanes - 1.0 - c
            marks.append((0.9 * f_max, foot + 0.88, channel))
            marks += [(-0.07 * f_max, foot + db / _SPAN_DB, f"{top_db - _SPAN_DB + db + 0.0:g} dB") for db in _TICKS_DB]
        places, labels = [(x, y) for x, y, _ in marks], [label for _, _, label in marks]
        self._stream.log(
            "/spectra/ticks",
            rr.Points2D(places, labels=labels, colors=[GREY], radii=rr.Radius.ui_points(0.5), show_labels=True),
        )


def _welch_power(
    values: Annotated[Array, "samples c"], rate_hz: float
) -> tuple[Annotated[Array, "bins"], Annotated[Array, "bins c"]]:
    """Compute the one-sided power spectral density from half-overlapping tapered segments; return Hz and (m/s^2)^2/Hz."""
    n = round(_SEGMENT_S * rate_hz)
    # Single precision is enough for a picture.
    segments = np.lib.stride_tricks.sliding_window_view(values.astype(np.float32), n, axis=0)[:: n // 2]
    spectra = np.fft.rfft((segments - segments.mean(axis=-1, keepdims=True)) * taper(n).astype(np.float32))
    power = (spectra.real**2 + spectra.imag**2).mean(axis=0, dtype=float).T * (2.0 / rate_hz)
    return np.asarray(np.arange(n // 2 + 1) * (rate_hz / n), dtype=float), np.asarray(power)


def _scale_to_lane(
    hz: Annotated[Array, "bins"], power: Annotated[Array, "bins"], top_db: float, lane: int
) -> Annotated[Array, "bins 2"]:
    """Place a channel's power in its lane, which is 1 high for `_SPAN_DB` and ends at `top_db`."""
    level = (10.0 * np.log10(np.maximum(power, 1e-300)) - top_db) / _SPAN_DB + 1.0
    return np.column_stack([hz, lane + np.clip(level, 0.0, 1.0)])
