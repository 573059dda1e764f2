"""The modes of a structure without a model, compared with those of the healthy structure: their stiffness, and their shapes.

The stiffness of a mode is the square of its frequency, so that the thresholds of ``[alarm]`` mean the same as with a model.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ModalEstimate, ModalReading, Skipped, Window
from monitor.damage import alarm
from monitor.damage.alarm import AlarmState
from monitor.damage.baseline import ModalBaseline
from monitor.damage.covariate_law import Effect
from monitor.damage.level import displacement_weights
from monitor.damage.parts import ModesAndShapes
from monitor.damage.quantities import LEAST_SHARE, UNCERTAIN, Covariates, Found, JudgeSettings, View, explained
from monitor.damage.updating import MODES_ALONE, observe
from monitor.identification import SelectionSettings, SubArray, identify, identify_modes, refine
from monitor.model import Modes

_LEAST_MODES = 2
"""Fewest modes that tell a change of one from a change of all alike, if the baseline has as many. [count; definition]"""


class ModalStiffness:
    """Stiffness and shapes of modes, and their change since the baseline; `past` are the identification's reference channels.

    The modes of windows are numbered by the baseline's or, where there is none yet, by those that calibration chose
    (`reference`).  Without either, the modes of each window are chosen by themselves.
    """

    without_baseline: ClassVar[str] = "no baseline: there is nothing to compare the modes with"
    names: tuple[str, ...] = ()

    def __init__(
        self,
        channels: tuple[str, ...],
        baseline: ModalBaseline | None,
        past: tuple[int, ...],
        reference: Modes | None = None,
    ) -> None:
        self.baseline = baseline
        self.reference = reference if baseline is None else baseline.modes
        n_modes = 0 if baseline is None else baseline.frequencies_hz.size
        self.parts = ModesAndShapes(n_modes, channels)
        self._past = past

    def start(self, window_s: float) -> AlarmState:
        """Return the state of the alarms before the first window."""
        return alarm.start(self.parts.n_modes, window_s, len(self.parts.channels))

    def view(self, channels: tuple[int, ...]) -> View:
        """Return what windows of some channels (0 = first) are judged with."""
        motion = None if self.baseline is None else self.baseline.motion
        weights = None if self.reference is None else displacement_weights(self.reference, channels, motion)
        return View(SubArray.plain(channels, self._past, len(self.parts.channels)), weights)

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

    def lacking(self, modes: ModalEstimate, view: View, select: SelectionSettings) -> Skipped | None:
        """Say why a window's modes are not enough to be judged; None where they are."""
        m = self.parts.n_modes
        if modes.model_mode.size < max(LEAST_SHARE * m, min(_LEAST_MODES, m)):
            return Skipped("; ".join(why for _, why in modes.missing))
        return None if self.baseline is None or len(modes.deviations) else UNCERTAIN

    def read(
        self, modes: ModalEstimate, view: View, effect: Effect | None, covariates: Covariates, settings: JudgeSettings
    ) -> Found | Skipped:
        """Compare a window's modes with the baseline's, less what the covariates explain."""
        if self.baseline is None:
            return Found(modes, None)
        of_shapes = explained(self.baseline.shape_law, covariates, settings)
        return Found(modes, _reading(self.baseline, view.array.spread(modes), effect, of_shapes))


def _reading(
    healthy: ModalBaseline, modes: ModalEstimate, effect: Effect | None, of_shapes: Effect | Skipped | None
) -> ModalReading:
    """Compare modes of all channels with the healthy ones, less what the covariates explain.

    Shapes are left out (NaN) where the covariates may change them by any amount (`Skipped`), at channels that are left out,
    and as a whole where that is the gauge.
    """
    free, found = healthy.free, modes.model_mode
    m, place = len(free), np.zeros(free.shape, dtype=np.intp)
    place[free] = np.arange(m, healthy.z.size)
    rows = np.append(found, place[found][free[found]])  # of the healthy z
    # Channels that are left out are NaN; the weights, which they would spoil, are not needed.
    with np.errstate(invalid="ignore"):
        seen = observe(replace(modes, weight_factor=None), MODES_ALONE, tuple(healthy.gauges[k] for k in found))
    change, variance = np.full(healthy.z.size, np.nan), np.full(healthy.z.size, np.nan)
    change[rows], variance[rows] = seen.z - healthy.z[rows], (seen.deviations**2).sum(axis=0)
    covariance, common = np.full((m, m), np.nan), healthy.z_covariance[:m, :m].copy()
    influence = seen.deviations[:, : found.size]
    covariance[np.ix_(found, found)] = influence.T @ influence
    common_variance = healthy.z_covariance.diagonal().copy()
    if effect is not None:
        change[:m] -= np.log1p(effect.relative)
        common += effect.covariance
    if isinstance(of_shapes, Skipped):
        change[m:] = variance[m:] = np.nan
    elif of_shapes is not None:
        change[m:] -= np.log1p(of_shapes.relative)
        common_variance[m:] += of_shapes.covariance.diagonal()
    return ModalReading(
        -change[:m],
        covariance + common,
        common,
        covariate_effect={} if effect is None else dict(effect.parts),
        shape=_placed(change[m:], free, np.nan),
        shape_variance=_placed(variance[m:] + common_variance[m:], free, np.nan),
        shape_common_variance=_placed(common_variance[m:], free, 0.0),
    )


def _placed(values: Array, free: NDArray[np.bool_], gauge: float) -> Annotated[Array, "m c"]:
    """Place the components that can change among those of the shapes."""
    placed = np.full(free.shape, gauge)
    placed[free] = values
    return placed
