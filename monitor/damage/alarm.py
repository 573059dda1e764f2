"""Alarms by significance, duration and size of a loss, in the vocabulary of IEC 62682.

There is an alarm for each story and one for the structure as a whole.  An alarm becomes active when the z-score
(`sequential_test`) has exceeded the threshold for the on-delay, and returns to normal when the z-score has stayed below threshold
minus deadband for the off-delay.  Operators acknowledge, shelve and reset alarms; this does not change what is measured.

References
----------
IEC 62682, Management of alarm systems for the process industries; ANSI/ISA-18.2, figure 3 (alarm state transition diagram).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from pydantic import Field

from monitor.core import WHOLE, Alarm, AlarmCondition, DamageReading, Level, Settings
from monitor.damage import sequential_test
from monitor.damage.common_change import Expected
from monitor.damage.sequential_test import History


class AlarmSettings(Settings):
    """``[alarm]``: thresholds and delays for announcing a loss of stiffness."""

    significance: float = Field(default=6.5, gt=0)
    """z-score from which a loss is significant, in standard deviations (one-sided)."""
    min_loss: float = Field(default=0.002, ge=0, lt=1)
    """Losses below this are never announced."""
    alarm_loss: float = Field(default=0.10, gt=0, lt=1)
    """A confirmed loss of at least this is an `alarm`."""
    model_form: float = Field(default=0.05, ge=0)
    """Share of one story's loss that may appear in another because of errors in the model's form (one standard deviation)."""
    uniform_loss: float = Field(default=0.05, gt=0, lt=1)
    """A loss common to all stories is announced, as `advisory` of the whole structure, from this size on."""
    confirm_s: float = Field(default=10.0, ge=0)
    """On-delay: a loss is confirmed when it has stayed significant this long."""
    clear_s: float = Field(default=100.0, ge=0)
    """Off-delay: an announced loss is cleared when it has stayed insignificant this long."""
    deadband: float = Field(default=1.0, ge=0)
    """Standard deviations by which an announced loss may fall below its thresholds before it returns to normal."""
    latching: bool = False
    """Keep an alarm that returned to normal announced until it is reset."""
    unwatched: tuple[int, ...] = ()
    """Stories that the sensors are known not to see: they are named, but no longer keep the state from being `normal`."""


@dataclass(frozen=True, slots=True)
class Shelving:
    """Suppression of an alarm's announcement by an operator, for a limited time."""

    until_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class StoryState:
    """State of the alarm of one story, or of the structure as a whole."""

    level: Level = Level.NORMAL
    """Level by the data up to now."""
    since_ns: int | None = None
    """End of the first window of the present unbroken run of significant windows."""
    quiet_since_ns: int | None = None
    latched: Level = Level.NORMAL
    """Highest level since the last reset, where alarms latch."""
    unacknowledged: bool = False
    acknowledged_by: str = ""
    shelved: Shelving | None = None

    @property
    def announced(self) -> Level:
        """The level that operators see: normal while shelved."""
        if self.shelved is not None:
            return Level.NORMAL
        return max(self.level, self.latched, key=lambda level: level.rank)

    @property
    def condition(self) -> AlarmCondition:
        """State in the alarm state diagram of the standard."""
        if self.shelved is not None:
            return AlarmCondition.SHELVED
        if self.level is not Level.NORMAL:
            return AlarmCondition.UNACKNOWLEDGED if self.unacknowledged else AlarmCondition.ACKNOWLEDGED
        if self.latched is not Level.NORMAL:
            return AlarmCondition.LATCHED_UNACKNOWLEDGED if self.unacknowledged else AlarmCondition.LATCHED_ACKNOWLEDGED
        return AlarmCondition.RETURNED_UNACKNOWLEDGED if self.unacknowledged else AlarmCondition.NORMAL


@dataclass(frozen=True, eq=False, slots=True)
class AlarmState:
    """State of all alarms between windows."""

    stories: tuple[StoryState, ...]
    """Alarms of the stories, then the alarm of the structure as a whole."""
    history: History
    shapes: History | None = None
    """History of the mode shapes, where the modes alone are judged."""


def start(n_stories: int, window_s: float = 400.0) -> AlarmState:
    """Return the state before the first window.

    Parameters
    ----------
    window_s : float
        Length of the windows, s: readings further apart share no data.

    Examples
    --------
    >>> state, announced = hold(start(n_stories=2), t_ns=0)
    >>> announced.level.value, announced.reason
    ('normal', 'unchanged: the window was skipped')
    """
    return AlarmState((StoryState(),) * (n_stories + 1), sequential_test.begin(n_stories, window_s))


def step(
    state: AlarmState, damage: DamageReading, t_ns: int, settings: AlarmSettings, expected: Expected | None = None
) -> tuple[AlarmState, Alarm]:
    """Update the alarms by one window's damage reading; `t_ns` is the UTC of the window's end.

    What the stories do together without a known cause is still in the reading; `expected` takes it out, where it was learned.

    A window beyond calibration (`DamageReading.beyond`) may announce a loss and ends no announcement: there a loss becomes
    insignificant because less is known.
    """
    history, evidence = sequential_test.look(state.history, damage, t_ns, settings.model_form, expected)
    shared = sequential_test.shared_change(evidence.loss, evidence.std)
    *before, whole_before = state.stories
    updated = [
        s if j in damage.unidentified else update_alarm(s, float(loss), float(z), float(std), t_ns, settings)
        for j, (s, loss, z, std) in enumerate(
            zip(before, evidence.own, evidence.z, evidence.own_std, strict=True), start=1
        )
    ]
    std = float(evidence.std.max())
    whole = update_alarm(whole_before, shared, shared / std, std, t_ns, advisory_only(settings))
    lost = {
        j: f"story {j} lost {100 * d:.1f} ± {200 * s:.1f} % (mean of the latest windows)"
        for j, (d, s) in enumerate(zip(evidence.own, evidence.own_std, strict=True), start=1)
    }
    lost[WHOLE] = f"all stories lost {100 * shared:.1f} % alike (weather, mass, clock or stiffness)"
    alike = f"all stories changed alike, stiffness by {-100 * shared:+.1f} % (weather, mass, clock or stiffness)"
    stories = [*updated, whole]
    if damage.beyond:
        stories = [unless_fallen(s, now) for s, now in zip(state.stories, stories, strict=True)]
    state = AlarmState(tuple(end_shelving(s, t_ns) for s in stories), history)
    announced = summarize(state.stories, lost, alike if shared else "")
    return state, replace(announced, reason=f"{announced.reason}; {damage.beyond}") if damage.beyond else announced


def hold(state: AlarmState, t_ns: int, names: Sequence[str] = ()) -> tuple[AlarmState, Alarm]:
    """Keep the alarms over a skipped window; only shelving whose time is over ends.

    Parameters
    ----------
    names : sequence of str
        What the alarms are about; stories by default.
    """
    stories = tuple(end_shelving(s, t_ns) for s in state.stories)
    return replace(state, stories=stories), summarize(stories, {}, "unchanged: the window was skipped", names)


def acknowledge(state: AlarmState, story: int, who: str) -> AlarmState:
    """Acknowledge a story's alarm (`WHOLE`: the structure's); a later rise of its level must be acknowledged again.

    Raises
    ------
    ValueError
        If there is no such story.
    """
    alarm = _find_alarm(state, story)
    if not alarm.unacknowledged:
        return state
    return _replace_alarm(state, story, replace(alarm, unacknowledged=False, acknowledged_by=who))


def reset(state: AlarmState, story: int) -> AlarmState:
    """Release a latched alarm that has returned to normal and was acknowledged; any other stays as it is.

    Raises
    ------
    ValueError
        If there is no such story.
    """
    alarm = _find_alarm(state, story)
    if alarm.condition is not AlarmCondition.LATCHED_ACKNOWLEDGED:
        return state
    return _replace_alarm(state, story, replace(alarm, latched=Level.NORMAL))


def shelve(state: AlarmState, story: int, until_ns: int, reason: str) -> AlarmState:
    """Suppress the announcement of a story's alarm until `until_ns` (UTC); its level is still updated meanwhile.

    Raises
    ------
    ValueError
        If there is no such story or no reason is given.
    """
    if not reason.strip():
        raise ValueError("shelving needs a reason")
    return _replace_alarm(state, story, replace(_find_alarm(state, story), shelved=Shelving(until_ns, reason)))


def unshelve(state: AlarmState, story: int) -> AlarmState:
    """Announce a shelved alarm again.

    Raises
    ------
    ValueError
        If there is no such story.
    """
    return _replace_alarm(state, story, replace(_find_alarm(state, story), shelved=None))


def _find_alarm(state: AlarmState, story: int) -> StoryState:
    """Return the alarm of a story, or of the whole structure for `WHOLE`."""
    if not 0 <= story < len(state.stories):
        raise ValueError(f"no story {story}: there are {len(state.stories) - 1}, and {WHOLE} for the whole")
    return state.stories[story - 1]  # the whole structure's is the last


def _replace_alarm(state: AlarmState, story: int, alarm: StoryState) -> AlarmState:
    """Replace the alarm of a story, or of the whole structure for `WHOLE`."""
    stories = list(state.stories)
    stories[story - 1] = alarm
    return replace(state, stories=tuple(stories))


def end_shelving(alarm: StoryState, t_ns: int) -> StoryState:
    """End the shelving of an alarm if its time is over."""
    return replace(alarm, shelved=None) if alarm.shelved is not None and t_ns >= alarm.shelved.until_ns else alarm


@lru_cache(maxsize=8)
def advisory_only(settings: AlarmSettings) -> AlarmSettings:
    """Return the settings for the structure as a whole: the cause is unknown, so its level never exceeds advisory."""
    return settings.model_copy(update={"confirm_s": np.inf, "min_loss": settings.uniform_loss})


def update_alarm(
    alarm: StoryState, loss: float, z: float, std: float, t_ns: int, settings: AlarmSettings
) -> StoryState:
    """Update one alarm by relative loss, z-score, and standard deviation of the loss."""
    active = alarm.level is not Level.NORMAL
    band = settings.deadband if active else 0.0
    slack = band * std
    if z >= settings.significance - band and loss >= settings.min_loss - slack:
        since = t_ns if alarm.since_ns is None else min(alarm.since_ns, t_ns)  # the clock may have been set back
        if t_ns - since < settings.confirm_s * 1e9 and alarm.level.rank < Level.WARNING.rank:
            level = Level.ADVISORY
        else:
            least = settings.alarm_loss - (slack if alarm.level is Level.ALARM else 0.0)
            level = Level.ALARM if loss >= least else Level.WARNING
        latched = max(alarm.latched, level, key=lambda x: x.rank) if settings.latching else alarm.latched
        risen = level.rank > alarm.level.rank
        return replace(
            alarm,
            level=level,
            since_ns=since,
            quiet_since_ns=None,
            latched=latched,
            unacknowledged=alarm.unacknowledged or risen,
            acknowledged_by="" if risen else alarm.acknowledged_by,
        )
    if not active:
        return alarm
    quiet = t_ns if alarm.quiet_since_ns is None else min(alarm.quiet_since_ns, t_ns)
    if t_ns - quiet < settings.clear_s * 1e9:
        return replace(alarm, since_ns=None, quiet_since_ns=quiet)
    return replace(alarm, level=Level.NORMAL, since_ns=None, quiet_since_ns=None)


def unless_fallen(before: StoryState, now: StoryState) -> StoryState:
    """Return the present state of an alarm, or the one before where the alarm fell or began to fall."""
    return before if now.quiet_since_ns is not None or now.level.rank < before.level.rank else now


def summarize(
    stories: tuple[StoryState, ...], lost: dict[int, str], otherwise: str, names: Sequence[str] = ()
) -> Alarm:
    """Combine all alarms to the announced level with its reason.

    Parameters
    ----------
    lost : dict
        Words for each story's loss, by its number.
    otherwise : str
        Words for a common change.
    names : sequence of str
        What the alarms are about; stories by default.
    """
    alarms = dict(zip([*range(1, len(stories)), WHOLE], stories, strict=True))
    active: dict[int, Level] = {j: a.announced for j, a in alarms.items() if a.announced is not Level.NORMAL}
    conditions: dict[int, AlarmCondition] = {
        j: a.condition for j, a in alarms.items() if a.condition is not AlarmCondition.NORMAL
    }
    level = max(active.values(), key=lambda item: item.rank, default=Level.NORMAL)
    highest = [j for j, item in active.items() if item is level]
    words = [lost[j] for j in highest if j in lost] or [otherwise or "no significant loss"]
    if highest and WHOLE not in highest and otherwise and lost:
        words.append(otherwise)
    if level is Level.ADVISORY and highest != [WHOLE]:
        words.append("not confirmed yet")
    words += [f"{_name(j, names)} shelved: {a.shelved.reason}" for j, a in alarms.items() if a.shelved is not None]
    return Alarm(level, tuple(j for j in highest if j != WHOLE), ", ".join(words), active, conditions)


def _name(story: int, names: Sequence[str]) -> str:
    """Name a story, or what else alarms are about, in a message."""
    if story == WHOLE:
        return "the whole structure"
    return names[story - 1] if names else f"story {story}"
