"""Judgement by the modes alone: frequencies and shapes of a window's modes, compared with those of the healthy structure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from monitor.core import Alarm, Array, Level, ModalEstimate, ModalReading, Skipped, Window
from monitor.damage import modal_alarm, slow_learning
from monitor.damage.alarm import AlarmState
from monitor.damage.covariate_law import Effect
from monitor.damage.judge import LEAST_SHARE, Judged, JudgeSettings, Memory, View, explained, hidden_words
from monitor.damage.level import displacement_weights
from monitor.damage.modal_baseline import ModalBaseline
from monitor.identification import SubArray, identify, identify_modes, refine
from monitor.model import Modes

_LEAST_MODES = 2
"""Fewest modes that tell a change of one from a change of all alike, if the baseline has as many. [count; definition]"""


class ModalJudge:
    """Comparison of modes with those of the baseline.

    Parameters
    ----------
    channels : tuple of str
        Names of the channels.
    baseline : ModalBaseline, optional
        Without a baseline nothing is compared.
    past : sequence of int
        Reference channels (0 = first) of the identification.
    reference : Modes, optional
        Modes by which those of the windows are numbered: the baseline's, or where there is none yet those that calibration
        chose.  Without either, the modes of each window are chosen by themselves.
    """

    def __init__(
        self,
        channels: tuple[str, ...],
        baseline: ModalBaseline | None,
        past: tuple[int, ...],
        reference: Modes | None = None,
    ) -> None:
        self.baseline = baseline
        self.reference = reference if baseline is None else baseline.modes
        self._channels, self._past = channels, past

    def start(self, window_s: float) -> AlarmState:
        """Return the state of the alarms before the first window."""
        n_modes = 0 if self.baseline is None else self.baseline.frequencies_hz.size
        return modal_alarm.start(n_modes, len(self._channels), window_s)

    def view(self, channels: tuple[int, ...]) -> View:
        """Return what windows of some channels (0 = first) are judged with."""
        motion = None if self.baseline is None else self.baseline.motion
        weights = None if self.reference is None else displacement_weights(self.reference, channels, motion)
        return View(SubArray.plain(channels, self._past, len(self._channels)), weights)

    def identify(
        self, window: Window, cutoff_hz: float, view: View, settings: JudgeSettings
    ) -> ModalEstimate | Skipped:
        """Identify the modes of a window of the channels in use: the reference's, or those that the window shows."""
        refiner = partial(refine, window, settings=settings.refinement)
        ssi, select, past = settings.identification, settings.selection, view.array.past
        if self.reference is None:
            return identify_modes(window, ssi, select, settings.refinement, past, cutoff_hz)
        wanted = tuple(range(self.reference.eigenvalues.size))
        return identify(
            window,
            past,
            self.reference,
            view.array.shown,
            ssi,
            select,
            wanted,
            cutoff_hz,
            refiner,
            "at calibration",
            measured=True,
        )

    def judge(
        self,
        memory: Memory,
        modes: ModalEstimate,
        covariates: Mapping[str, Array],
        view: View,
        t_end_ns: int,
        settings: JudgeSettings,
    ) -> tuple[Memory, Judged] | Skipped:
        """Compare a window's modes with the baseline's, and update the alarms."""
        if self.baseline is None:
            nothing = Alarm(Level.NORMAL, (), "no baseline: there is nothing to compare the modes with")
            return memory, Judged(modes, nothing)
        m, found = self.baseline.frequencies_hz.size, modes.model_mode.size
        if found < max(LEAST_SHARE * m, min(_LEAST_MODES, m)):
            return Skipped("; ".join(why for _, why in modes.missing))
        if not len(modes.deviations):
            return Skipped("the modes' uncertainty is not asked for, so nothing is judged")
        law = self.baseline.law if memory.learning is None else memory.learning.law
        effect = explained(law, covariates, settings.alarm)
        if isinstance(effect, Skipped):
            return effect
        of_shapes = explained(self.baseline.shape_law, covariates, settings.alarm)
        in_use = view.array.channels if len(view.array.channels) < len(self._channels) else ()
        reading = replace(
            _reading(self.baseline, view.array.spread(modes), effect, of_shapes),
            beyond=hidden_words(law, effect, covariates, settings.alarm),
            channels=in_use,
        )
        alarms, verdict = modal_alarm.step(memory.alarm, reading, t_end_ns, settings.alarm, self._channels)
        detectable = modal_alarm.detectable(alarms, reading, settings.processing.hop_s, settings.alarm)
        learning = memory.learning
        if law is not None and settings.compensation.learn_in_service:
            state = learning or slow_learning.start(law, t_end_ns)
            learning = _learned(state, reading, covariates, t_end_ns, settings, normal=verdict.level is Level.NORMAL)
        return Memory(alarms, learning), Judged(modes, verdict, modal=reading, detectable_loss=detectable)

    def hold(self, state: AlarmState, t_ns: int) -> tuple[AlarmState, Alarm]:
        """Keep the alarms over a window that was not judged."""
        return modal_alarm.hold(state, t_ns)


def _reading(
    healthy: ModalBaseline, modes: ModalEstimate, effect: Effect | None, of_shapes: Effect | Skipped | None
) -> ModalReading:
    """Compare modes of all channels with the healthy ones, less what the covariates explain.

    Shapes are left out (NaN) where the covariates may change them by any amount (`Skipped`).
    """
    (m, c), found = healthy.shapes.shape, modes.model_mode
    change, covariance, common = np.full(m, np.nan), np.full((m, m), np.nan), healthy.covariance.copy()
    change[found] = np.log(modes.frequencies_hz / healthy.frequencies_hz[found])
    covariance[np.ix_(found, found)] = modes.deviations[:, :, 0].T @ modes.deviations[:, :, 0]
    parts: dict[str, Array] = {}
    if effect is not None:  # of the modal stiffness, the square of the frequency
        change -= 0.5 * np.log1p(effect.relative)
        common += 0.25 * effect.covariance
        parts = {name: 0.5 * part for name, part in effect.parts.items()}
    shape, variance, shape_common = np.full((m, c), np.nan), np.full((m, c), np.nan), healthy.shape_variance.copy()
    if not isinstance(of_shapes, Skipped):
        shape[found], variance[found] = _ratios(modes, [healthy.gauges[k] for k in found])
        shape -= healthy.shapes
        shape[~healthy.free] = variance[~healthy.free] = np.nan
        if of_shapes is not None:
            shape[healthy.free] -= np.log1p(of_shapes.relative)
            shape_common[healthy.free] += of_shapes.covariance.diagonal()
    return ModalReading(
        change, covariance + common, common, shape, variance + shape_common, shape_common, covariate_effect=parts
    )


def _ratios(modes: ModalEstimate, gauges: list[int]) -> tuple[Array, Array]:
    """Compute the real parts of the shapes over their components at the gauges, and their variances, shape (m, c).

    They are NaN at channels that are left out, and as a whole where that is the gauge.
    """
    m, c = modes.shapes.shape
    seen = np.flatnonzero(np.isfinite(modes.shapes).all(axis=0))
    rows = np.array([row for row, gauge in enumerate(gauges) if gauge in seen], dtype=np.intp)
    at = np.array([gauges[row] for row in rows], dtype=np.intp)
    ratio, variance = np.full((m, c), np.nan), np.full((m, c), np.nan)
    at_gauge = modes.shapes[rows, at][:, None]
    shown = modes.shapes[np.ix_(rows, seen)] / at_gauge
    influence = modes.deviations[:, rows, 2 : 2 + c] + 1j * modes.deviations[:, rows, 2 + c :]
    of_gauge = influence[:, np.arange(rows.size), at][:, :, None]
    moved = (influence[:, :, seen] - shown * of_gauge) / at_gauge
    ratio[np.ix_(rows, seen)], variance[np.ix_(rows, seen)] = shown.real, (moved.real**2).sum(axis=0)
    return ratio, variance


def _learned(
    state: slow_learning.LearningState,
    reading: ModalReading,
    covariates: Mapping[str, Array],
    t_end_ns: int,
    settings: JudgeSettings,
    *,
    normal: bool,
) -> slow_learning.LearningState:
    """Learn the covariates' law on from healthy service; from windows that show all modes alone."""
    change = 2.0 * (reading.ln_frequency + sum(reading.covariate_effect.values(), np.zeros(1)))
    if normal and not np.isfinite(change).all():
        return state
    return slow_learning.step(state, covariates, change, t_end_ns, settings.compensation.unevenness, normal=normal)
