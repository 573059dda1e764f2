"""The modes of a structure without a model, compared with those of the healthy structure: their stiffness, and their shapes.

The stiffness of a mode is the square of its frequency, so that the thresholds of ``[alarm]`` mean the same as with a model.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, CrossSpectra, ModalEstimate, ModalReading, Skipped, Window
from monitor.damage import alarm
from monitor.damage.alarm import AlarmState
from monitor.damage.baseline import ModalBaseline
from monitor.damage.covariate_law import CovariateLaw, Effect
from monitor.damage.covariates import LEVEL
from monitor.damage.level import displacement_weights
from monitor.damage.parts import ModesAndShapes
from monitor.damage.presence import Beside, Sighting, either, kept, look
from monitor.damage.quantities import UNCERTAIN, Covariates, Found, JudgeSettings, View, explained
from monitor.damage.updating import MODES_ALONE, observe
from monitor.identification import KnownModes, SelectionSettings, SubArray, identify, identify_modes, refine

_ONE_WINDOW = Skipped(
    "the baseline was learned from a single window, which does not tell how far healthy ones differ: calibrate with more"
)
"""Why nothing is compared with a baseline whose scatter is not known. [words]"""


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
        reference: KnownModes | None = None,
    ) -> None:
        self.baseline = baseline
        self._known = reference if baseline is None else baseline.known
        self.reference = None if self._known is None else self._known.modes
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
            learned=self._known,
        )

    def beside(
        self,
        sightings: tuple[Sighting, ...],
        modes: ModalEstimate,
        spectra: CrossSpectra | None,
        covariates: Covariates,
        view: View,
        t_end_ns: int,
        settings: JudgeSettings,
    ) -> tuple[tuple[Sighting, ...], Beside | None]:
        """Note a window's modes, and test what the latest windows lack or show beside, and the spectrum's shape.

        Fewer channels show less, and weather that calibration did not see moves a spectrum too: then neither is said.
        """
        if self.baseline is None or len(view.array.channels) < view.array.n_channels:
            return sightings, None
        window_ns, healthy_hz = round(settings.processing.window_s * 1e9), self.baseline.frequencies_hz
        chance = 1.0
        if spectra is not None and self.baseline.spectrum is not None and not _is_beyond(self.baseline.law, covariates):
            chance = self.baseline.spectrum.chance(spectra)
        newest, tolerance = (
            Sighting.of(modes, range(healthy_hz.size), t_end_ns, chance),
            2.0 * settings.selection.stable_frequency,
        )
        found = look(self.baseline.presence, sightings, newest, healthy_hz, window_ns, tolerance)
        found = either(found, sightings, newest, window_ns)
        return kept(sightings, newest, window_ns), found

    def lacking(self, modes: ModalEstimate, view: View, select: SelectionSettings) -> Skipped | None:
        """Say why a window's modes are not enough to be judged; None where they are."""
        if self.baseline is None:
            return None if modes.model_mode.size else Skipped("; ".join(why for _, why in modes.missing))
        if self.baseline.scatter.records < 2:
            return _ONE_WINDOW
        return None if len(modes.deviations) or not modes.model_mode.size else UNCERTAIN

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
    # Few blocks tell a window's own variance badly: it is no less than that of the healthy ones.
    own, scatter = (seen.deviations**2).sum(axis=0), healthy.scatter
    deviations = seen.deviations * np.sqrt(np.fmax(scatter.stated[rows] / own, 1.0) * scatter.scale[rows])
    change[rows], variance[rows] = seen.z - healthy.z[rows], (deviations**2).sum(axis=0)
    covariance = np.full((m, m), np.nan)
    influence = deviations[:, : found.size]
    covariance[np.ix_(found, found)] = influence.T @ influence
    common = healthy.z_covariance + np.diag(scatter.beyond)
    common_variance, common = common.diagonal().copy(), common[:m, :m]
    if effect is not None:
        change[:m] -= np.log1p(effect.relative)
        common += effect.covariance
    if isinstance(of_shapes, Skipped):
        change[m:] = variance[m:] = np.nan
    elif of_shapes is not None:
        change[m:] -= np.log1p(of_shapes.relative)
        common_variance[m:] += of_shapes.covariance.diagonal()
    # Of each mode the fewest of its frequency and shape.
    freedom = scatter.freedom[:m].copy()
    np.minimum.at(freedom, np.nonzero(free)[0], scatter.freedom[m:])
    return ModalReading(
        -change[:m],
        covariance + common,
        common,
        freedom,
        freedom,
        covariate_effect={} if effect is None else dict(effect.parts),
        shape=_placed(change[m:], free, np.nan),
        shape_variance=_placed(variance[m:] + common_variance[m:], free, np.nan),
        shape_common_variance=_placed(common_variance[m:], free, 0.0),
    )


def _is_beyond(law: CovariateLaw | None, covariates: Covariates) -> bool:
    """Tell whether a covariate lies beyond what was learned; the level of motion is divided out of spectra."""
    axes = () if law is None else law.axes
    return any(a.name in covariates and a.name != LEVEL and a.beyond(float(covariates[a.name][a.lag])) for a in axes)


def _placed(values: Array, free: NDArray[np.bool_], gauge: float) -> Annotated[Array, "m c"]:
    """Place the components that can change among those of the shapes."""
    placed = np.full(free.shape, gauge)
    placed[free] = values
    return placed
