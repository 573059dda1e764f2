"""Judging of a window: from its modes to the alarms, what is learned in service and the smallest detectable loss.

It is the same whatever the parts are whose stiffness is judged (`quantities`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from monitor.core import (
    Alarm,
    Array,
    DamageReading,
    Level,
    ModalEstimate,
    ModalReading,
    Reading,
    Skipped,
    name_stories,
)
from monitor.damage import alarm, slow_learning
from monitor.damage.alarm import AlarmState
from monitor.damage.common_change import Beside
from monitor.damage.covariate_law import CovariateLaw, Effect
from monitor.damage.covariates import beyond_words
from monitor.damage.detectable_loss import smallest_detectable_loss
from monitor.damage.quantities import Covariates, Found, JudgeSettings, Quantities, View, explained
from monitor.damage.slow_learning import LearningState


@dataclass(frozen=True, eq=False, slots=True)
class Memory:
    """State of the judging between windows."""

    alarm: AlarmState
    learning: LearningState | None
    """The covariates' law as it was learned on in service; None before the first judged window."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Judged(Found):
    """What the modes of a window say of the structure."""

    alarm: Alarm
    detectable_loss: Array | None = None
    """As in `WindowResult`."""

    @property
    def damage(self) -> DamageReading | None:
        """The reading of stories."""
        return self.reading if isinstance(self.reading, DamageReading) else None

    @property
    def modal(self) -> ModalReading | None:
        """The reading of modes alone."""
        return self.reading if isinstance(self.reading, ModalReading) else None


def step(
    quantities: Quantities,
    memory: Memory,
    modes: ModalEstimate,
    covariates: Covariates,
    view: View,
    t_end_ns: int,
    settings: JudgeSettings,
) -> tuple[Memory, Judged] | Skipped:
    """Compare a window's modes with the baseline's, and update the alarms; `t_end_ns` is the UTC of the window's end."""
    if (lacking := quantities.lacking(modes, view, settings.selection)) is not None:
        return lacking
    baseline, law = quantities.baseline, None
    if baseline is not None:
        law = baseline.law if memory.learning is None else memory.learning.law
    effect = explained(law, covariates, settings)
    if isinstance(effect, Skipped):
        return effect
    found = quantities.read(modes, view, effect, covariates, settings)
    if isinstance(found, Skipped):
        return found
    reading = found.reading
    if reading is not None and len(view.array.channels) < view.array.n_channels:
        reading = replace(reading, channels=view.array.channels)
    if baseline is None or reading is None:
        nothing = Alarm(Level.NORMAL, (), quantities.without_baseline)
        return memory, Judged(found.modes, reading, found.stiffness, alarm=nothing)
    together = None if law is None else law.together(settings.compensation.unevenness)
    beside = None if together is None else together.beside_others(reading.loss, reading.covariance)
    p = settings.processing
    tests = alarm.tests_of(reading, beside_others=together is None)
    # With which a loss that is an `alarm` is just announced.
    shown_std = settings.alarm.alarm_loss / settings.alarm.limit(tests, p.window_s, p.hop_s)
    reading = replace(reading, beyond=_beyond(law, effect, beside, covariates, shown_std))
    alarms, verdict = alarm.step(memory.alarm, reading, t_end_ns, settings.alarm, together, quantities.parts)
    learning, history = memory.learning, alarms.history
    if law is not None and settings.compensation.learn_in_service:
        learning = learning or slow_learning.start(law, t_end_ns)
        is_normal = verdict.level is Level.NORMAL
        learning = _learn(learning, reading, covariates, t_end_ns, settings.compensation.unevenness, normal=is_normal)
    if together is not None and beside is not None:
        reading, history = together.take_out(reading, beside), history.left_by_others(together, beside)
    detectable = smallest_detectable_loss(reading, history, settings.alarm, tests)
    verdict = _named(verdict, quantities)
    judged = Judged(found.modes, reading, found.stiffness, alarm=verdict, detectable_loss=detectable)
    return Memory(alarms, learning), judged


def hold(quantities: Quantities, state: AlarmState, t_ns: int) -> tuple[AlarmState, Alarm]:
    """Keep the alarms over a window that was not judged."""
    state, verdict = alarm.hold(state, t_ns, quantities.parts)
    return state, _named(verdict, quantities)


def _named(verdict: Alarm, quantities: Quantities) -> Alarm:
    """Put the names of the stories into the reason."""
    return replace(verdict, reason=name_stories(verdict.reason, quantities.names))


def _beyond(
    law: CovariateLaw | None,
    effect: Effect | None,
    beside: Beside | None,
    covariates: Covariates,
    most_std: float,
) -> str:
    """Say what lies beyond calibration where the law, or what parts do together, is less certain than `most_std`."""
    if law is not None and effect is not None:
        std = float(np.sqrt(effect.covariance.diagonal().max()))
        if std > most_std:
            return beyond_words(law, covariates)
    return "" if beside is None else beside.beyond_words(most_std)


def _learn(
    state: LearningState, reading: Reading, covariates: Covariates, t_end_ns: int, unevenness: float, *, normal: bool
) -> LearningState:
    """Learn the covariates' law on from healthy service; from windows that show all parts alone."""
    # The loss has what the law explains taken out; it is put back.
    change = reading.ln_stiffness + sum(reading.covariate_effect.values(), np.zeros(1))
    if normal and not np.isfinite(change).all():
        return state
    return slow_learning.step(state, covariates, change, t_end_ns, unevenness, normal=normal)
