"""The stiffness of a model's stories, updated to a window's modes and compared with the baseline's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from math import inf
from typing import ClassVar

import numpy as np

from monitor.core import DamageReading, ModalEstimate, Skipped, StiffnessEstimate, Window
from monitor.damage import alarm, damage_index
from monitor.damage.alarm import AlarmState
from monitor.damage.baseline import Baseline
from monitor.damage.covariate_law import Effect
from monitor.damage.level import drift_weights, drift_weights_of_some
from monitor.damage.parts import STORIES, Parts
from monitor.damage.presence import Sighting
from monitor.damage.quantities import LEAST_SHARE, UNCERTAIN, Covariates, Found, JudgeSettings, View
from monitor.identification import SelectionSettings, SubArray, expected_modes, identify, refine
from monitor.model import InstrumentedModel

_CHECK = "see the modes that 'look' finds, and what 'check' says of the lags"
"""What to do where not even the lowest mode is found. [words]"""
_ONE_FACTOR = 1.25
"""Largest over smallest multiple of the model's frequencies that still is one. [ratio; judgement: drawings are 10 % off]"""


@dataclass(frozen=True, eq=False, slots=True)
class StoryView(View):
    """The channels that a window is judged with, and the healthy state as these see it."""

    baseline: Baseline | None


class StoryStiffness:
    """Stiffness of a model's stories, and its loss since the baseline; `past` are the identification's reference channels.

    Without a baseline, modes and stiffness are compared with the structure file's, and no alarm is announced: the structure file
    is never exact, so a difference from it is no change.  `names` are what people call each story.
    """

    without_baseline: ClassVar[str] = "no baseline: a difference from the structure file is no change"
    parts: Parts = STORIES

    def __init__(
        self, nominal: InstrumentedModel, baseline: Baseline | None, past: tuple[int, ...], names: tuple[str, ...]
    ) -> None:
        instrumented = nominal if baseline is None else replace(nominal, model=baseline.model)
        rate_hz, cutoff_hz = nominal.rate_hz, nominal.cutoff_hz
        assert rate_hz is not None
        assert cutoff_hz is not None
        self.baseline = baseline
        self.instrumented = instrumented
        self.reference = instrumented.model
        self._reference_modes = self.reference.modes()
        self._sensors, self._past, self.names = instrumented.sensor_matrix, past, names
        self._acquisition = tuple(e for e in nominal.model.effects if e.family == "sensor")
        self._context = instrumented.context(rate_hz)
        self._prior_std = instrumented.stiffness_prior_std
        self._drawing, self._cutoff_hz = nominal.model, cutoff_hz
        stored = None if baseline is None else baseline.drift_weights
        self._drift_weights = drift_weights(self._drawing, self._sensors, cutoff_hz) if stored is None else stored

    def start(self, window_s: float) -> AlarmState:
        """Return the state of the alarms before the first window."""
        return alarm.start(self.reference.structure.n_stories, window_s)

    def view(self, channels: tuple[int, ...]) -> StoryView:
        """Return what windows of some channels (0 = first) are judged with."""
        array = SubArray.of(channels, self._past, self._sensors, self._acquisition, self._context)
        healthy = None if self.baseline is None else self.baseline.seen_by(array.places)
        weights = self._drift_weights
        if len(channels) < len(self._sensors):
            motion = None if self.baseline is None else self.baseline.motion
            weights = drift_weights_of_some(
                self._drawing, self._sensors, channels, self._cutoff_hz, self._drift_weights, motion
            )
        return StoryView(array, weights, healthy)

    def identify(
        self, window: Window, cutoff_hz: float, view: View, settings: JudgeSettings
    ) -> ModalEstimate | Skipped:
        """Identify the modes of a window of the channels in use, and remove the stated sensor effects from them."""
        wanted = (
            expected_modes(self._reference_modes, cutoff_hz, settings.selection)
            if self.baseline is None
            else self.baseline.model_mode
        )
        modes = identify(
            window,
            view.array.past,
            self._reference_modes,
            view.array.shown,
            settings.identification,
            settings.selection,
            wanted,
            cutoff_hz,
            partial(refine, window, settings=settings.refinement),
            measured=self.baseline is not None,
        )
        return modes if isinstance(modes, Skipped) else view.array.correct(modes)

    def beside(self, sightings: tuple[Sighting, ...], *_: object) -> tuple[tuple[Sighting, ...], None]:
        """Return that nothing is said beside the stories' stiffness."""
        return sightings, None

    def lacking(self, modes: ModalEstimate, view: View, select: SelectionSettings) -> Skipped | None:
        """Say why a window's modes are not enough to be judged; None where they are.

        With a baseline, a mode that is missing may be the change itself.
        """
        required = () if self.baseline is None else self.baseline.model_mode
        if missing := self._missing(modes, select):
            if len(view.array.channels) < len(self._sensors):  # the remedy is to mend those
                which = ", ".join(str(mode + 1) for mode in missing)
                says = f"the channels in use do not show mode{'s' * (len(missing) > 1)} {which}"
                return Skipped("; ".join(filter(None, (says, self._elsewhere(modes, view, select)))))
            fewer = min(required.index(mode) for mode in missing) if required else 0
            mend = f"set [selection] required_modes = {fewer}, or calibrate anew" if fewer else ""
            return Skipped(f"{'; '.join(missing.values())}; {mend or self._elsewhere(modes, view, select) or _CHECK}")
        if not len(modes.deviations):
            return UNCERTAIN
        identified = modes.model_mode.tolist()
        if required and [mode for mode in required if mode in identified] != identified:
            return Skipped("modes are not the baseline's")
        return None

    def read(
        self, modes: ModalEstimate, view: View, effect: Effect | None, covariates: Covariates, settings: JudgeSettings
    ) -> Found | Skipped:
        """Update the stiffness to a window's modes and compare it with the baseline's.

        With a baseline, a mode that the model cannot follow may be the change itself, and the window is not judged.  Without one
        the modes that the model can follow are enough.
        """
        assert isinstance(view, StoryView)
        healthy = None if view.baseline is None else view.baseline.only(tuple(modes.model_mode.tolist()))

        def step(modes: ModalEstimate) -> tuple[StiffnessEstimate, DamageReading]:
            """Update the stiffness to modes."""
            return damage_index.step(
                modes, self.reference, healthy, view.array.sensors, settings.updating, effect, self._prior_std
            )

        stiffness, reading = step(modes)
        while not stiffness.converged:
            # Of the modes without each of which the updating converges, that is set aside whose absence leaves the least misfit.
            candidates = modes.model_mode.tolist() if healthy is None else []
            less = [modes.set_aside(k, self._unfitting(k, modes)) for k in candidates]
            less = [fewer for fewer in less if not self._missing(fewer, settings.selection)]
            fits = [step(fewer) for fewer in less]
            left = [float(fit.mode_misfit.sum()) if fit.converged else inf for fit, _ in fits]
            if min(left, default=inf) == inf:
                worst = int(modes.model_mode[stiffness.mode_misfit.argmax()])
                mend = f"calibrate with [selection] max_modes = {worst}, or a lower [processing] cutoff_hz"
                return Skipped(f"{self._unfitting(worst, modes)}; {mend if worst else _CHECK}")
            best = left.index(min(left))
            modes, (stiffness, reading) = less[best], fits[best]
        return Found(modes, reading, stiffness)

    def _missing(self, modes: ModalEstimate, select: SelectionSettings) -> dict[int, str]:
        """Return the missing modes (0 = lowest) without which a window is not judged, and why they are missing.

        With a baseline these are its lowest `required_modes`; without one, half of the model's lowest are enough.
        """
        n = select.required_modes
        if self.baseline is not None:
            return {mode: why for mode, why in modes.missing if mode in self.baseline.model_mode[:n]}
        missing = {mode: why for mode, why in modes.missing if mode < n}
        found = int(np.count_nonzero(modes.model_mode < n))
        return missing if found < LEAST_SHARE * (found + len(missing)) or not modes.model_mode.size else {}

    def _elsewhere(self, modes: ModalEstimate, view: View, select: SelectionSettings) -> str:
        """State what gives missing modes counterparts: one multiple of their frequencies, or a channel turned or exchanged.

        Two counterparts at least, each of one mode.  Empty where nothing does.
        """
        if len(view.array.channels) < 2 or not modes.others:
            return ""
        measured = np.array([other.shape / np.linalg.norm(other.shape) for other in modes.others])
        measured_hz = np.array([other.frequency_hz for other in modes.others])
        missing = [mode for mode, _ in modes.missing]
        shapes, each = view.array.sensors @ self._reference_modes.shapes[:, missing], np.eye(len(view.array.sensors))
        turned = [each - 2.0 * np.outer(a, a) for a in each]
        for change in (each, *turned, *(each - np.outer(a - b, a - b) for a, b in combinations(each, 2))):
            likeness = np.abs(measured.conj() @ change @ shapes) ** 2 / (shapes**2).sum(axis=0)
            is_like, best = likeness.max(axis=0) >= select.min_model_mac, likeness.argmax(axis=0)
            factors = (measured_hz[best] / self._reference_modes.frequencies_hz[missing])[is_like]
            if len(set(best[is_like].tolist())) < max(2, len(factors)) or max(factors) > _ONE_FACTOR * min(factors):
                continue
            times = float(np.exp(np.log(factors).mean()))
            if change is each:
                says = f"modes of these shapes lie at {times:.2g} times the frequencies by the model: "
                return says + "are the sampling rate, masses and stiffness right?"
            if is_like.all() and 1.0 / _ONE_FACTOR < times < _ONE_FACTOR:
                return "with a channel turned, or two exchanged, modes there have these shapes: check floors and signs"
        return ""

    def _unfitting(self, mode: int, modes: ModalEstimate) -> str:
        """State that the model cannot follow the counterpart of its `mode` (0 = lowest)."""
        measured_hz = modes.frequencies_hz[modes.model_mode.tolist().index(mode)]
        there = f"{self._reference_modes.frequencies_hz[mode]:.3g} Hz by the model, {measured_hz:.3g} Hz in the data"
        return f"model updating did not converge with mode {mode + 1} ({there}): another direction, or torsion?"
