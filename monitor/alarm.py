"""The only place that decides: alarm levels by significance, persistence and size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from monitor.results import WHOLE, Alarm, Array, DamageReading, Level
from monitor.settings import Settings

_UNIFORM_SIGNIFICANCE = 3.0


class AlarmSettings(Settings):
    """When a loss of stiffness is announced."""

    significance: float = Field(default=5.0, gt=0)
    """DDI over its standard deviation from which a loss is significant (one-sided)."""
    min_loss: float = Field(default=0.005, ge=0, lt=1)
    """Losses below this are never announced."""
    alarm_loss: float = Field(default=0.10, gt=0, lt=1)
    """A confirmed loss of at least this is an `alarm`."""
    model_form: float = Field(default=0.05, ge=0)
    """Share of another story's loss that the model's wrong form may show here (one standard deviation)."""
    uniform_loss: float = Field(default=0.05, gt=0, lt=1)
    """A change alike in all stories is announced, as `advisory` of the whole structure, from this loss on."""
    confirm_s: float = Field(default=100.0, ge=0)
    """On-delay: a loss is confirmed when it has stayed significant this long."""
    clear_s: float = Field(default=100.0, ge=0)
    """Off-delay: an announced loss is cleared when it has stayed insignificant this long."""
    deadband: float = Field(default=1.0, ge=0)
    """An announced loss stays significant down to `significance` less this."""


@dataclass(frozen=True, slots=True)
class StoryState:
    """What the alarm remembers of one story."""

    level: Level = Level.NORMAL
    since_ns: int | None = None
    """End of the first window of the unbroken run of significant ones."""
    quiet_since_ns: int | None = None


def start(n_stories: int) -> tuple[StoryState, ...]:
    """State before the first window: the stories, then the structure as a whole."""
    return tuple(StoryState() for _ in range(n_stories + 1))


def uniform_change(ddi: Array, std: Array) -> float:
    """The part of a change that all stories share, or 0 where fewer stories changed than that would need.

    Weather, added mass, a slow clock and a loss in every story alike look the same in accelerations.  With three or
    more stories that all changed significantly, taking the least change out of all is the simpler story if fewer are
    left over.
    """
    significant = np.abs(ddi) > _UNIFORM_SIGNIFICANCE * std
    if ddi.size < 3 or not significant.all():
        return 0.0
    shared = float(ddi.min())
    left_over = np.abs(ddi - shared) > _UNIFORM_SIGNIFICANCE * std
    return shared if np.count_nonzero(left_over) < ddi.size - 1 else 0.0


def step(
    states: tuple[StoryState, ...], damage: DamageReading, t_ns: int, settings: AlarmSettings
) -> tuple[tuple[StoryState, ...], Alarm]:
    """Judge one window's damage reading.

    A window that was skipped is not judged: the alarm stays as it was.
    """
    ddi = damage.ddi
    elsewhere = np.array([np.delete(np.abs(ddi), j).max(initial=0.0) for j in range(ddi.size)])
    std = np.sqrt(damage.ddi_std**2 + (settings.model_form * elsewhere) ** 2 + 1e-24)
    shared = uniform_change(ddi, std)
    own = ddi - shared
    judged = [_judge(s, float(d), float(d / e), t_ns, settings) for s, d, e in zip(states, own, std, strict=False)]
    whole = _judge(
        states[-1], shared if shared >= settings.uniform_loss else 0.0, float(shared / std.max()), t_ns, settings
    )
    if whole.level is not Level.NORMAL:  # its cause is open, so it is never more than this
        whole = replace(whole, level=Level.ADVISORY)
    lost = {
        j: f"story {j} lost {100 * own[j - 1]:.1f} +- {100 * std[j - 1]:.1f} % (1 sigma)"
        for j in range(1, ddi.size + 1)
    }
    lost[WHOLE] = f"all stories lost {100 * shared:.1f} % alike (weather, mass, clock or stiffness)"
    otherwise = "no significant loss"
    if shared:
        otherwise = (
            f"all stories changed alike, stiffness by {-100 * shared:+.1f} % (weather, mass, clock or stiffness)"
        )
    return (*judged, whole), _summarize((*judged, whole), lost, otherwise)


def hold(states: tuple[StoryState, ...]) -> Alarm:
    """The alarm while nothing can be said: as it was."""
    return _summarize(states, {}, "unchanged: the window was skipped")


def _summarize(states: tuple[StoryState, ...], lost: dict[int, str], otherwise: str) -> Alarm:
    numbers = [*range(1, len(states)), WHOLE]
    active: dict[int, Level] = {j: s.level for j, s in zip(numbers, states, strict=True) if s.level is not Level.NORMAL}
    if not active:
        return Alarm(Level.NORMAL, (), otherwise)
    level = max(active.values(), key=lambda item: item.rank)
    highest = [j for j, item in active.items() if item is level]
    words = ", ".join(lost[j] for j in highest if j in lost) or otherwise
    unconfirmed = level is Level.ADVISORY and highest != [WHOLE]
    stories = tuple(j for j in highest if j != WHOLE)
    return Alarm(level, stories, words + (", not confirmed yet" if unconfirmed else ""), active)


def _judge(state: StoryState, ddi: float, z: float, t_ns: int, settings: AlarmSettings) -> StoryState:
    announced = state.level is not Level.NORMAL
    threshold = settings.significance - (settings.deadband if announced else 0.0)
    if z >= threshold and ddi >= settings.min_loss:
        since = t_ns if state.since_ns is None else state.since_ns
        if t_ns - since < settings.confirm_s * 1e9 and state.level.rank < Level.WARNING.rank:
            return StoryState(Level.ADVISORY, since)
        return StoryState(Level.ALARM if ddi >= settings.alarm_loss else Level.WARNING, since)
    if not announced:
        return StoryState()
    quiet = t_ns if state.quiet_since_ns is None else state.quiet_since_ns
    if t_ns - quiet >= settings.clear_s * 1e9:
        return StoryState()
    return StoryState(state.level, None, quiet)
