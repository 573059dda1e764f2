"""Alarms by significance, confirmation and size of a loss, in the vocabulary of IEC 62682.

There is an alarm for each part (`parts`), a story or a mode and its shape, and one for the structure as a whole.  A part is
announced for what it lost beyond what all have in common, from the limit of the z-score (`sequential_test`) on that follows from
the false announcements allowed in a year (`limits`).  Readings that share no data confirm it: their mean, or each by itself.  A
level is held until every reading of the off-delay has said with 95 % that it is no longer reached (deadband): as long as it takes
for two estimates that share no data, for windows overlap and repeat one another's errors.  Operators acknowledge, shelve and
reset alarms; this does not change what is measured.

References
----------
IEC 62682, Management of alarm systems for the process industries; ANSI/ISA-18.2, figure 3 (alarm state transition diagram).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from pydantic import Field

from monitor.core import WHOLE, Alarm, AlarmCondition, Level, Reading, Settings
from monitor.damage import sequential_test
from monitor.damage.common_change import LOCAL_LOSS_CREDIT, Expected
from monitor.damage.limits import Scores, as_normal, limit
from monitor.damage.parts import STORIES, Parts
from monitor.damage.sequential_test import STRETCHES, SURE_STDS, History


class AlarmSettings(Settings):
    """``[alarm]``: what is announced of a loss of stiffness."""

    false_announcements_per_year: float = Field(default=0.1, gt=0)
    """False announcements that chance may bring in a year, of all parts together; one is an episode, however long.  The limit of
    the statistic follows from it, with the number of parts and of looks."""
    min_loss: float = Field(default=0.002, ge=0, lt=1)
    """Losses below this are never announced."""
    alarm_loss: float = Field(default=0.10, gt=0, lt=1)
    """A confirmed loss of at least this is an `alarm`."""
    model_form: float = Field(default=0.05, ge=0)
    """Share of one story's loss that may appear in another because of errors in the model's form (one standard deviation)."""
    uniform_loss: float = Field(default=0.05, gt=0, lt=1)
    """A loss common to all stories is announced, as `advisory` of the whole structure, from this size on."""
    latching: bool = False
    """Keep an alarm that returned to normal announced until it is reset."""
    unwatched: tuple[int, ...] = ()
    """Stories that the sensors are known not to see: they are named, but no longer keep the state from being `normal`."""

    def limit(self, tests: Scores, reading_s: float, spacing_s: float) -> float:
        """Return the z-score from which a loss is announced, by readings of `reading_s` seconds that come each `spacing_s`."""
        apart_s, step = max(reading_s, spacing_s), min(spacing_s / reading_s, 1.0)
        return limit(self.false_announcements_per_year, tests, LOCAL_LOSS_CREDIT, STRETCHES, apart_s, step)


class Shown(NamedTuple):
    """What the statistic says of one alarm."""

    loss: float
    std: float
    z: float
    lasting: float
    """z-score of readings of which at least two share no data."""
    readings: int
    """Number of readings that share no data in the mean that is `loss`."""


@dataclass(frozen=True, slots=True)
class Shelving:
    """Suppression of an alarm's announcement by an operator, for a limited time."""

    until_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class StoryState:
    """State of the alarm of one story, or of the structure as a whole."""

    level: Level = Level.NORMAL
    """Level by the data up to now, held until they surely say less."""
    since_ns: int | None = None
    """End of the first window of the present unbroken run of significant windows."""
    less_since_ns: dict[Level, int] = field(default_factory=dict)
    """Of each level up to the held one: end of the first window of the unbroken run that surely says less."""
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
    """Alarms of the parts, as `Parts.name` numbers them, then the alarm of the structure as a whole."""
    history: History
    shapes: History | None = None
    """History of the mode shapes, where the modes alone are judged."""


def start(n_parts: int, window_s: float = 400.0, n_channels: int = 0) -> AlarmState:
    """Return the state before the first window of `window_s` seconds: readings further apart share no data.

    `n_channels` is the number of components of the parts' shapes, where these are judged too, and the spectrum after them.

    Examples
    --------
    >>> state, announced = hold(start(n_parts=2), t_ns=0)
    >>> announced.level.value, announced.reason
    ('normal', 'unchanged: the window was skipped')
    """
    history, n_alarms, shapes = sequential_test.begin(n_parts, window_s), n_parts, None
    if n_channels:
        n_alarms += n_parts + 1
        shapes = sequential_test.begin(n_parts * n_channels, window_s, variances_only=True)
    return AlarmState((StoryState(),) * (n_alarms + 1), history, shapes)


def step(
    state: AlarmState,
    reading: Reading,
    t_ns: int,
    settings: AlarmSettings,
    expected: Expected | None = None,
    parts: Parts = STORIES,
) -> tuple[AlarmState, Alarm]:
    """Update the alarms by one window's reading; `t_ns` is the UTC of the window's end.

    What the parts do together without a known cause is still in the reading; `expected` takes it out, where it was learned.

    A part that the window does not show leaves its alarm as it is.  A window beyond calibration (`Reading.beyond`) may announce a
    loss and ends no announcement: there a loss becomes insignificant because less is known.
    """
    history, evidence = sequential_test.look(state.history, reading, t_ns, settings.model_form, expected)
    tests = tests_of(reading, beside_others=expected is None)
    least_z = settings.limit(tests, history.window_ns * 1e-9, history.spacing_ns * 1e-9)
    alarms, says = list(state.stories), dict[int, str]()

    def update(alarm: int, shown: Shown, by: AlarmSettings, confirm_ns: float = history.window_ns) -> None:
        """Update one of the alarms (0 = first)."""
        if reading.either_side:
            shown = shown._replace(loss=abs(shown.loss))
        # The z-score is the largest over all stretches: it falls only when none shows the loss any more.
        readings = shown.readings if shown.z >= least_z - SURE_STDS else 1
        off_ns = readings * max(history.window_ns, history.spacing_ns)
        alarms[alarm] = update_alarm(alarms[alarm], shown, t_ns, by, least_z, confirm_ns, off_ns)

    rows = (evidence.own, evidence.own_std, evidence.z, evidence.lasting, evidence.stretch)
    for k, (j, *row) in enumerate(zip(evidence.parts, *(x.tolist() for x in rows), strict=True)):
        shown = Shown(*row)
        says[j + 1] = parts.changed(j + 1, shown.loss, float(evidence.loss[k]), shown.std)
        if j + 1 not in reading.unidentified:
            update(j, shown, settings)
    shapes = state.shapes
    if shapes is not None:
        n, n_channels = reading.shape.shape
        shapes, found = sequential_test.look_at_shapes(shapes, reading, t_ns)
        for j in evidence.parts:
            best = j * n_channels + int(found.z[j * n_channels : (j + 1) * n_channels].argmax())
            shown = Shown(*(x[best].item() for x in (found.loss, found.std, found.z, found.lasting, found.stretch)))
            says[n + j + 1] = parts.shape_changed(j + 1, shown.loss, shown.std, best % n_channels)
            update(n + j, shown, warning_only(settings))
    shared, std = sequential_test.shared_change(evidence.loss, evidence.std), float(evidence.std.max())
    z = float(as_normal((abs(shared) if reading.either_side else shared) / std, evidence.freedom.min()))
    whole = state.stories[-1]
    # Above advisory it is the alarm of a part that is gone (`carry_over`), of which no window tells.
    if not (whole.unacknowledged and whole.level.rank > Level.ADVISORY.rank):
        # Nothing confirms it: the cause is unknown, so its level never exceeds advisory.
        shown = Shown(shared, std, z, -np.inf, int(evidence.stretch.max()))
        update(-1, shown, _of_the_whole(settings), confirm_ns=np.inf)
    says[WHOLE], beside = parts.alike(shared)
    if reading.beyond:
        alarms = [_unless_fallen(s, now) for s, now in zip(state.stories, alarms, strict=True)]
    state = AlarmState(tuple(_end_shelving(s, t_ns) for s in alarms), history, shapes)
    announced = summarize(state.stories, says, beside if shared else "", parts)
    return state, replace(announced, reason=f"{announced.reason}; {reading.beyond}") if reading.beyond else announced


def tests_of(reading: Reading, *, beside_others: bool) -> Scores:
    """Count what is tested of a reading: its parts, compared with each other or not, and the components of their shapes."""
    n, (n_modes, n_channels) = int(reading.loss.size), reading.shape.shape
    components = n_modes * max(n_channels - 1, 0)  # the largest is 1
    return Scores(n * beside_others, components + n * (not beside_others), 2 if reading.either_side else 1)


def hold(state: AlarmState, t_ns: int, parts: Parts = STORIES) -> tuple[AlarmState, Alarm]:
    """Keep the alarms over a skipped window; only shelving whose time is over ends."""
    stories = tuple(_end_shelving(s, t_ns) for s in state.stories)
    return replace(state, stories=stories), summarize(stories, {}, "unchanged: the window was skipped", parts)


def acknowledge(state: AlarmState, story: int, who: str) -> AlarmState:
    """Acknowledge a story's alarm (`WHOLE`: the structure's), or raise ValueError; a later rise must be acknowledged again."""
    alarm = _find_alarm(state, story)
    if not alarm.unacknowledged:
        return state
    return _replace_alarm(state, story, replace(alarm, unacknowledged=False, acknowledged_by=who))


def reset(state: AlarmState, story: int) -> AlarmState:
    """Release an acknowledged alarm that is latched above the level by the data; ValueError where there is no such story."""
    alarm = _find_alarm(state, story)
    if alarm.unacknowledged or alarm.shelved is not None:
        return state
    return _replace_alarm(state, story, replace(alarm, latched=min(alarm.latched, alarm.level, key=lambda x: x.rank)))


def shelve(state: AlarmState, story: int, until_ns: int, reason: str) -> AlarmState:
    """Suppress the announcement of a story's alarm until `until_ns` (UTC); its level is still updated meanwhile.

    ValueError if there is no such story or no reason is given.
    """
    if not reason.strip():
        raise ValueError("shelving needs a reason")
    return _replace_alarm(state, story, replace(_find_alarm(state, story), shelved=Shelving(until_ns, reason)))


def unshelve(state: AlarmState, story: int) -> AlarmState:
    """Announce a shelved alarm again; ValueError where there is no such story."""
    return _replace_alarm(state, story, replace(_find_alarm(state, story), shelved=None))


def carry_over(state: AlarmState, before: tuple[StoryState, ...], *, alike: bool = True) -> AlarmState:
    """Take over the alarms of a run `before`, whose parts may be more or fewer, or of another kind where they are not `alike`.

    A part keeps the alarm of its number.  The gravest alarm of those whose part is gone stands on as that of the structure as a
    whole, shelved no longer, and is left by no window before it is acknowledged.

    Examples
    --------
    >>> raised = StoryState(Level.WARNING, since_ns=0, unacknowledged=True)
    >>> [s.level.value for s in carry_over(start(n_parts=2), (StoryState(), StoryState(), raised, StoryState())).stories]
    ['normal', 'normal', 'warning']
    """
    (*old, whole), now = before, list(state.stories)
    kinds = 1 if state.shapes is None else 2  # modes, then their shapes, then the spectrum by itself
    n_old, n_new = len(old) // kinds, (len(now) - 1) // kinds
    for k, alarm in enumerate(old):
        kind, part = divmod(k, max(n_old, 1))
        if alike and part < n_new and kind * n_new + part < len(now) - 1:
            now[kind * n_new + part] = alarm
        else:
            whole = max(whole, replace(alarm, shelved=None), key=lambda a: (a.announced.rank, a.unacknowledged))
    now[-1] = whole
    return replace(state, stories=tuple(now))


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


def _end_shelving(alarm: StoryState, t_ns: int) -> StoryState:
    """End the shelving of an alarm if its time is over."""
    return replace(alarm, shelved=None) if alarm.shelved is not None and t_ns >= alarm.shelved.until_ns else alarm


@lru_cache(maxsize=8)
def _of_the_whole(settings: AlarmSettings) -> AlarmSettings:
    """Return the settings for the structure as a whole."""
    return settings.model_copy(update={"min_loss": settings.uniform_loss})


@lru_cache(maxsize=8)
def warning_only(settings: AlarmSettings) -> AlarmSettings:
    """Return the settings for shapes, the spectrum and features, whose change is no loss that has a size: never above warning."""
    return settings.model_copy(update={"alarm_loss": np.inf})


def update_alarm(
    alarm: StoryState,
    shown: Shown,
    t_ns: int,
    settings: AlarmSettings,
    least_z: float,
    confirm_ns: float,
    off_ns: float,
    sure: float = SURE_STDS,
) -> StoryState:
    """Update one alarm, announced from the z-score `least_z` on, or from any other score, which is surely less by `sure`.

    It is confirmed where readings that share no data reach that together, or one does so `confirm_ns` after the first of an
    unbroken run that reached it.  `off_ns` is the off-delay.
    """
    is_active, since = alarm.level is not Level.NORMAL, None
    slack, says = sure if is_active else 0.0, Level.NORMAL
    if shown.z >= least_z - slack and shown.loss >= settings.min_loss - slack * shown.std:
        since = t_ns if alarm.since_ns is None else min(alarm.since_ns, t_ns)  # the clock may have been set back
        again = shown.z >= least_z and t_ns - since >= confirm_ns
        if alarm.level.rank < Level.WARNING.rank and not again and shown.lasting < least_z:
            says = Level.ADVISORY
        else:
            least = settings.alarm_loss - (slack * shown.std if alarm.level is Level.ALARM else 0.0)
            says = Level.ALARM if shown.loss >= least else Level.WARNING
    if not is_active and says is Level.NORMAL:
        return alarm
    less = {
        level: min(alarm.less_since_ns.get(level, t_ns), t_ns)
        for level in Level
        if says.rank < level.rank <= alarm.level.rank
    }
    held = [level for level, since_ns in less.items() if t_ns - since_ns < off_ns]
    level = max([says, *held], key=lambda x: x.rank)
    has_risen = level.rank > alarm.level.rank
    return replace(
        alarm,
        level=level,
        since_ns=since,
        less_since_ns={of: since_ns for of, since_ns in less.items() if of in held},
        latched=max(alarm.latched, level, key=lambda x: x.rank) if settings.latching else alarm.latched,
        unacknowledged=alarm.unacknowledged or has_risen,
        acknowledged_by="" if has_risen else alarm.acknowledged_by,
    )


def _unless_fallen(before: StoryState, now: StoryState) -> StoryState:
    """Return the present state of an alarm, or the one before where the alarm fell or began to fall."""
    return before if now.less_since_ns or now.level.rank < before.level.rank else now


def summarize(stories: tuple[StoryState, ...], says: dict[int, str], alike: str, parts: Parts) -> Alarm:
    """Combine all alarms to the announced level with its reason.

    `says` has words for each part's change, by its number; `alike` those for a common change, or for what else is to be said.
    """
    alarms = dict(zip([*range(1, len(stories)), WHOLE], stories, strict=True))
    active: dict[int, Level] = {j: a.announced for j, a in alarms.items() if a.announced is not Level.NORMAL}
    conditions: dict[int, AlarmCondition] = {j: a.condition for j, a in alarms.items()}
    level = max(active.values(), key=lambda item: item.rank, default=Level.NORMAL)
    highest = [j for j, item in active.items() if item is level]
    words = _words(level, highest, says, alike, parts)
    shelved = {"the whole structure" if j == WHOLE else parts.name(j): a.shelved for j, a in alarms.items()}
    words += [f"{name} shelved: {by.reason}" for name, by in shelved.items() if by is not None]
    return Alarm(
        level,
        tuple(j for j in highest if j != WHOLE) if parts.are_places else (),
        (parts.since if active and says else "") + ", ".join(words),
        active,
        {j: condition for j, condition in conditions.items() if condition is not AlarmCondition.NORMAL},
    )


def _words(level: Level, highest: list[int], says: dict[int, str], alike: str, parts: Parts) -> list[str]:
    """Say what changed at the announced level, and what is to be known beside it."""
    words = [says[j] for j in highest if j in says] or [alike or parts.unchanged]
    if highest and WHOLE not in highest and alike and says and alike not in words:
        words.append(alike)
    if level is Level.ADVISORY and highest != [WHOLE]:
        words.append("not confirmed yet")
    return words
