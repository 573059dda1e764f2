"""Judging of a window: from its modes to the alarms, what is learned in service and the smallest detectable loss.

It is the same whatever the parts are whose stiffness is judged (`quantities`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from monitor.core import (
    WHOLE,
    Alarm,
    Array,
    CrossSpectra,
    DamageReading,
    Level,
    ModalEstimate,
    ModalReading,
    Reading,
    Skipped,
    name_stories,
)
from monitor.damage import alarm, slow_learning
from monitor.damage.alarm import AlarmState, Shown
from monitor.damage.common_change import Beside as BesideOthers
from monitor.damage.covariate_law import CovariateLaw, Effect
from monitor.damage.covariates import beyond_words
from monitor.damage.detectable_loss import smallest_detectable_loss
from monitor.damage.parts import ALONE, SPECTRUM, Parts, change_words, located
from monitor.damage.presence import Beside, Sighting
from monitor.damage.quantities import Covariates, Found, JudgeSettings, Quantities, View, explained
from monitor.damage.slow_learning import LearningState

_NONE_FOUND = "no mode of the baseline was found"
"""What a window says that shows no part at all. [words]"""


@dataclass(frozen=True, eq=False, slots=True)
class Memory:
    """State of the judging between windows."""

    alarm: AlarmState
    learning: LearningState | None
    """The covariates' law as it was learned on in service; None before the first judged window."""
    sightings: tuple[Sighting, ...] = ()
    """Modes of the latest windows."""


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
    spectra: CrossSpectra | None = None,
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
    limit = settings.alarm.limit(tests, p.window_s, p.hop_s)
    shown_std = settings.alarm.alarm_loss / limit  # with which a loss that is an `alarm` is just announced
    reading = replace(reading, beyond=_beyond(law, effect, beside, covariates, shown_std))
    sightings, more = quantities.beside(memory.sightings, modes, spectra, covariates, view, t_end_ns, settings)
    if isinstance(reading, ModalReading) and more is not None:
        reading = replace(reading, spectrum=more.z)
    is_seen = bool(np.isfinite(reading.loss).any())
    alarms = memory.alarm
    if more is not None:
        least_z = settings.alarm.limit(tests, p.window_s, alarms.history.spacing_ns * 1e-9)
        alarms = _with_spectrum(alarms, more, t_end_ns, settings, least_z)
    if is_seen:
        alarms, verdict = alarm.step(alarms, reading, t_end_ns, settings.alarm, together, quantities.parts)
    else:
        alarms, verdict = alarm.hold(alarms, t_end_ns, quantities.parts)
        verdict = replace(verdict, reason=_NONE_FOUND)
    if more is not None:
        verdict = _with_words(verdict, more, quantities.parts)
    learning, history = memory.learning, alarms.history
    if law is not None and settings.compensation.learn_in_service:
        learning = learning or slow_learning.start(law, t_end_ns)
        is_normal = verdict.level is Level.NORMAL
        learning = _learn(learning, reading, covariates, t_end_ns, settings.compensation.unevenness, normal=is_normal)
    if together is not None and beside is not None:
        reading, history = together.take_out(reading, beside), history.left_by_others(together, beside)
    detectable = np.full(reading.loss.size, np.inf)
    if is_seen:
        detectable = smallest_detectable_loss(reading, history, settings.alarm, tests)
    verdict = _named(verdict, quantities)
    judged = Judged(found.modes, reading, found.stiffness, alarm=verdict, detectable_loss=detectable)
    return Memory(alarms, learning, sightings), judged


def hold(quantities: Quantities, state: AlarmState, t_ns: int) -> tuple[AlarmState, Alarm]:
    """Keep the alarms over a window that was not judged."""
    state, verdict = alarm.hold(state, t_ns, quantities.parts)
    return state, _named(verdict, quantities)


def _with_spectrum(state: AlarmState, more: Beside, t_ns: int, settings: JudgeSettings, limit: float) -> AlarmState:
    """Update the alarm of the spectrum, the last before that of the whole; what it tells has no size, and is never an `alarm`."""
    (*parts, spectrum, whole), by = state.stories, alarm.warning_only(settings.alarm)
    window_ns = settings.processing.window_s * 1e9
    shown = Shown(1.0, 0.0, more.z, more.z if more.windows > 1 else -np.inf, more.windows)
    spectrum = alarm.update_alarm(spectrum, shown, t_ns, by, limit, window_ns, more.windows * window_ns)
    return replace(state, stories=(*parts, spectrum, whole))


def _with_words(verdict: Alarm, more: Beside, parts: Parts) -> Alarm:
    """Say of the spectrum, where its alarm is active, what its newest windows lack or show beside."""
    names = {j for j in verdict.active if j != WHOLE and parts.name(j) == SPECTRUM}
    if not names:
        return verdict
    says = more.says or change_words(SPECTRUM, 0.0, 0.0)
    if parts.unchanged in verdict.reason:
        says += ALONE[SPECTRUM] if len(verdict.active) == 1 else ""
        return replace(verdict, reason=verdict.reason.replace(parts.unchanged, says, 1))
    return replace(verdict, reason=f"{verdict.reason}; {says}")


def _named(verdict: Alarm, quantities: Quantities) -> Alarm:
    """Put the names of the stories into the reason."""
    return located(replace(verdict, reason=name_stories(verdict.reason, quantities.names)), quantities.names)


def _beyond(
    law: CovariateLaw | None,
    effect: Effect | None,
    beside: BesideOthers | None,
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
