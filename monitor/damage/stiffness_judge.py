"""Judgement by a model: stiffness updated to a window's modes, compared with the baseline's, and the alarm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import inf

import numpy as np

from monitor.core import (
    Alarm,
    Array,
    DamageReading,
    Level,
    ModalEstimate,
    Skipped,
    StiffnessEstimate,
    Window,
    name_stories,
)
from monitor.damage import alarm, damage_index, slow_learning
from monitor.damage.alarm import AlarmState
from monitor.damage.baseline import Baseline
from monitor.damage.covariate_law import CovariateLaw, Effect
from monitor.damage.detectable_loss import smallest_detectable_loss
from monitor.damage.judge import LEAST_SHARE, Judged, JudgeSettings, Memory, View, explained, hidden_words
from monitor.damage.level import drift_weights, drift_weights_of_some
from monitor.identification import SelectionSettings, SubArray, expected_modes, identify, refine
from monitor.model import InstrumentedModel

_CHECK = "check floors, signs and units of the channels, and what 'check' says of the lags"
"""What to do where not even the lowest mode is found. [words]"""

_ONE_FACTOR = 1.25
"""Largest over smallest multiple of the model's frequencies that still is one. [ratio; judgement: drawings are 10 % off]"""


@dataclass(frozen=True, eq=False, slots=True)
class StiffnessView(View):
    """The channels that a window is judged with, and the healthy state as these see it."""

    baseline: Baseline | None


class StiffnessJudge:
    """Comparison of a model's stiffness with that of the baseline.

    Parameters
    ----------
    nominal : InstrumentedModel
        The structure file's model.
    baseline : Baseline, optional
        Without a baseline, modes and stiffness are compared with the structure file's, and no alarm is announced: the
        structure file is never exact, so a difference from it is no change.
    past : sequence of int
        Reference channels (0 = first) of the identification.
    names : tuple of str
        What people call each story.
    """

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
        self._sensors, self._past, self._names = instrumented.sensor_matrix, past, names
        self._acquisition = tuple(e for e in nominal.model.effects if e.family == "sensor")
        self._context = instrumented.context(rate_hz)
        self._prior_std = instrumented.stiffness_prior_std
        self._drawing, self._cutoff_hz = nominal.model, cutoff_hz
        stored = None if baseline is None else baseline.drift_weights
        self._drift_weights = drift_weights(self._drawing, self._sensors, cutoff_hz) if stored is None else stored

    def start(self, window_s: float) -> AlarmState:
        """Return the state of the alarms before the first window."""
        return alarm.start(self.reference.structure.n_stories, window_s)

    def view(self, channels: tuple[int, ...]) -> StiffnessView:
        """Return what windows of some channels (0 = first) are judged with."""
        array = SubArray.of(channels, self._past, self._sensors, self._acquisition, self._context)
        healthy = None if self.baseline is None else self.baseline.seen_by(array.places)
        weights = self._drift_weights
        if len(channels) < len(self._sensors):
            motion = None if self.baseline is None else self.baseline.motion
            weights = drift_weights_of_some(
                self._drawing, self._sensors, channels, self._cutoff_hz, self._drift_weights, motion
            )
        return StiffnessView(array, weights, healthy)

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

    def judge(
        self,
        memory: Memory,
        modes: ModalEstimate,
        covariates: Mapping[str, Array],
        view: View,
        t_end_ns: int,
        settings: JudgeSettings,
    ) -> tuple[Memory, Judged] | Skipped:
        """Update the stiffness to a window's modes, compare it with the baseline's, and update the alarms."""
        assert isinstance(view, StiffnessView)
        law = self._law(memory)
        updated = self._update(modes, covariates, view, law, settings)
        if isinstance(updated, Skipped):
            return updated
        modes, stiffness, reading = updated
        if len(view.array.channels) < len(self._sensors):
            reading = replace(reading, channels=view.array.channels)
        if self.baseline is None:
            nothing = Alarm(Level.NORMAL, (), "no baseline: a difference from the structure file is no change")
            return memory, Judged(modes, nothing, stiffness, reading)
        together = None if law is None else law.together(settings.compensation.unevenness)
        beside = None if together is None else together.beside_others(reading.ddi, reading.ddi_covariance)
        if beside is not None and not reading.beyond:
            most_std = settings.alarm.alarm_loss / settings.alarm.significance
            reading = replace(reading, beyond=beside.beyond_words(most_std))
        alarms, verdict = alarm.step(memory.alarm, reading, t_end_ns, settings.alarm, together)
        normal = verdict.level is Level.NORMAL
        learning = self._learn(memory, law, reading, covariates, t_end_ns, settings, normal=normal)
        history = alarms.history
        if together is not None and beside is not None:
            reading, history = together.take_out(reading, history, beside)
        detectable = smallest_detectable_loss(reading, history, settings.processing.hop_s, settings.alarm)
        judged = Judged(modes, self._named(verdict), stiffness, reading, detectable_loss=detectable)
        return Memory(alarms, learning), judged

    def hold(self, state: AlarmState, t_ns: int) -> tuple[AlarmState, Alarm]:
        """Keep the alarms over a window that was not judged."""
        state, verdict = alarm.hold(state, t_ns)
        return state, self._named(verdict)

    def _named(self, verdict: Alarm) -> Alarm:
        """Put the names of the stories into the reason."""
        return replace(verdict, reason=name_stories(verdict.reason, self._names))

    def _law(self, memory: Memory) -> CovariateLaw | None:
        """Return the covariates' law: as calibrated, and as learned on in service."""
        if memory.learning is not None:
            return memory.learning.law
        return None if self.baseline is None else self.baseline.law

    def _learn(
        self,
        memory: Memory,
        law: CovariateLaw | None,
        reading: DamageReading,
        covariates: Mapping[str, Array],
        t_end_ns: int,
        settings: JudgeSettings,
        *,
        normal: bool,
    ) -> slow_learning.LearningState | None:
        """Learn the covariates' law on from healthy service."""
        if law is None or not settings.compensation.learn_in_service:
            return memory.learning
        state = memory.learning or slow_learning.start(law, t_end_ns)
        # The index has what the law explains taken out; it is put back.
        change = np.log1p(-np.minimum(reading.ddi, 1.0 - 1e-6)) + sum(reading.covariate_effect.values(), np.zeros(1))
        return slow_learning.step(state, covariates, change, t_end_ns, settings.compensation.unevenness, normal=normal)

    def _update(
        self,
        modes: ModalEstimate,
        covariates: Mapping[str, Array],
        view: StiffnessView,
        law: CovariateLaw | None,
        settings: JudgeSettings,
    ) -> tuple[ModalEstimate, StiffnessEstimate, DamageReading] | Skipped:
        """Update the stiffness to a window's modes and compare it with the baseline's.

        With a baseline, a mode that is missing or that the model cannot follow may be the change itself, and the window is not
        judged.  Without one the modes that the model can follow are enough.

        Returns
        -------
        ModalEstimate
            The modes that the stiffness was updated to.
        StiffnessEstimate
        DamageReading
        """
        baseline = view.baseline
        missing = self._missing(modes, settings.selection)
        if missing:
            required = () if baseline is None else baseline.model_mode
            fewer = min(required.index(mode) for mode in missing) if required else 0
            mend = (
                f"set [selection] required_modes = {fewer}, or calibrate anew"
                if fewer
                else self._elsewhere(modes, view, settings.selection) or _CHECK
            )
            return Skipped(f"{'; '.join(missing.values())}; {mend}")
        if not len(modes.deviations):
            return Skipped("the modes' uncertainty is not asked for, so nothing is judged")
        identified = tuple(int(k) for k in modes.model_mode)
        healthy = None if baseline is None else baseline.only(identified)
        if healthy is not None and healthy.model_mode != identified:
            return Skipped("modes are not the baseline's")
        effect = explained(law, covariates, settings.alarm)
        if isinstance(effect, Skipped):
            return effect
        by: Effect | None = effect

        def step(modes: ModalEstimate) -> tuple[StiffnessEstimate, DamageReading]:
            """Update the stiffness to modes."""
            return damage_index.step(
                modes, self.reference, healthy, view.array.sensors, settings.updating, by, self._prior_std
            )

        stiffness, reading = step(modes)
        while not stiffness.converged:
            # Of the modes without each of which the updating converges, that is set aside whose absence leaves the least misfit.
            candidates = modes.model_mode.tolist() if baseline is None else []
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
        return modes, stiffness, replace(reading, beyond=hidden_words(law, effect, covariates, settings.alarm))

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

    def _elsewhere(self, modes: ModalEstimate, view: StiffnessView, select: SelectionSettings) -> str:
        """State that modes of the missing modes' shapes lie at one multiple of their frequencies; empty where they do not."""
        if len(view.array.channels) < 2 or not modes.others:
            return ""
        measured = np.array([other.shape / np.linalg.norm(other.shape) for other in modes.others])
        factors, found = [], []
        for mode, _ in modes.missing:
            shape = view.array.sensors @ self._reference_modes.shapes[:, mode]
            likeness = np.abs(measured.conj() @ shape) ** 2 / float(shape @ shape)
            best = int(likeness.argmax())
            if likeness[best] >= select.min_model_mac:
                found.append(best)
                factors.append(modes.others[best].frequency_hz / self._reference_modes.frequencies_hz[mode])
        if len(set(found)) < max(2, len(found)) or max(factors) > _ONE_FACTOR * min(factors):
            return ""
        times = float(np.exp(np.log(factors).mean()))
        return (
            f"modes of these shapes lie at {times:.2g} times the frequencies by the model: "
            "are the sampling rate, masses and stiffness right?"
        )

    def _unfitting(self, mode: int, modes: ModalEstimate) -> str:
        """State that the model cannot follow the counterpart of its `mode` (0 = lowest)."""
        measured_hz = modes.frequencies_hz[modes.model_mode.tolist().index(mode)]
        there = f"{self._reference_modes.frequencies_hz[mode]:.3g} Hz by the model, {measured_hz:.3g} Hz in the data"
        return f"model updating did not converge with mode {mode + 1} ({there}): another direction, or torsion?"
