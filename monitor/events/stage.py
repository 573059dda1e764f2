"""The stage of events: from conditioned samples to what is told of each event, in the data's own time.

`step` takes the samples that the windows are made of, on the same grid, and `window` what the windows tell.  An event has three
tellings: a preliminary one when strong motion ends, a final one after a stretch of quiet motion, and a revision with the lasting
loss after an hour of ambient motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import STRONG_MOTION, Array, Skipped, WindowResult
from monitor.events import alarm, recognition
from monitor.events.alarm import EventAlarm
from monitor.events.ambient import AmbientReading, lasting_loss, mean_frequencies, reading_of
from monitor.events.event import Event
from monitor.events.ground import Ground
from monitor.events.limits import exceedances, judge
from monitor.events.settings import EventSettings
from monitor.events.site import Site
from monitor.signals import Conditioner

_SETTLED_STEPS = 2
"""Steps after a gap that are neither judged nor kept, while the filters, which begin at rest, settle. [steps of 2 s; a lowpass
of 40 Hz settles in 1 s]"""
_TOGETHER_STEPS = 30
"""Most steps whose power is measured together. [steps; cost: the arrays stay small where a block is an hour long]"""
_GROUND_LATE_S = recognition.STEP_S
"""Time by which the ground's samples may arrive after the floors'. [s; the time after which the preliminary message is sent]"""


Saturated = Callable[[int, int], NDArray[np.bool_]]
"""Function that finds the channels which reached the end of their range between two times (UTC), shape (c,), or (0,) where none
is known."""


def none_saturated(begin_ns: int, end_ns: int) -> NDArray[np.bool_]:
    """Say that nothing is known of the sensors' range."""
    return np.zeros(0, dtype=bool)


@dataclass(frozen=True, eq=False, slots=True)
class Strong:
    """Strong motion, by indices of the samples' grid."""

    begin: int
    end: int
    """End of the last loud frame so far."""
    told: bool = False
    """Whether the preliminary message was sent."""
    closed: bool = False
    """Whether it has ended, and only quiet motion is waited for."""
    cut: bool = False
    """As in `Event`."""
    note: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Awaiting:
    """Event whose lasting loss is still to be told."""

    event: Event
    before: tuple[AmbientReading, ...]
    after: tuple[AmbientReading, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class EventState:
    """State of the stage between spans of samples."""

    recognition: recognition.RecognitionState | None = None
    """None before the first sample."""
    conditioner: Conditioner | None = None
    """Filter of the samples, with their rate; None before the first sample."""
    t0_ns: int = 0
    """UTC of grid index 0, less the delay of the floors' filter."""
    first: int = 0
    """Grid index of the first sample in `kept`."""
    kept: tuple[Array, ...] = ()
    """Latest samples in pieces of shape (n, c), m/s^2: to join all of them at every step costs more than to judge one."""
    judged: int = 0
    """Grid index of the end of the last judged step."""
    settling: int = 0
    """Steps that are still not judged."""
    opening: int | None = None
    """Grid index of the first judged step, while it is not known whether the samples begin amid strong motion."""
    strong: tuple[Strong, ...] = ()
    """Events of which the final line is still to come; only the last may still go on."""
    marks: tuple[tuple[int, int], ...] = ()
    """Begin and end, as grid indices, of every step in which motion was strong or may have been; oldest first."""
    ground: tuple[Ground, ...] = ()
    ground_filter: Conditioner | None = None
    """Filter of the ground's samples; None before the first."""
    recent: tuple[AmbientReading, ...] = ()
    """What the latest windows told, which do not overlap."""
    awaiting: tuple[Awaiting, ...] = ()
    alarms: tuple[EventAlarm, ...] = ()
    """Alarms of events that exceeded a limit, oldest first."""

    @property
    def rate_hz(self) -> float:
        """Rate of the samples; 0 before the first."""
        return 0.0 if self.conditioner is None else self.conditioner.rate_hz

    @property
    def may_be_strong(self) -> bool:
        """Whether the motion of an event goes on, or the latest frames may be the beginning of one."""
        going = bool(self.strong) and not self.strong[-1].closed
        return going or (self.recognition is not None and self.recognition.raised > 0)

    @property
    def end(self) -> int:
        """Grid index past the latest sample."""
        return self.first + sum(map(len, self.kept))

    def samples(self, begin: int, end: int) -> Annotated[Array, "n c"]:
        """Return the kept samples from one grid index up to another, m/s^2."""
        parts, last = list[Array](), self.end
        for piece in reversed(self.kept):
            first = last - len(piece)
            if first < end and last > begin:
                parts.append(piece[max(begin - first, 0) : end - first])
            last = first
        return np.ascontiguousarray(np.concatenate(parts[::-1]))


def start() -> EventState:
    """Return the state before the first sample."""
    return EventState()


def keep_ground(
    state: EventState, piece: Ground, conditioner: Conditioner | None, settings: EventSettings
) -> EventState:
    """Keep samples of the measured ground motion, filtered by `conditioner`, as long as the floors' samples beside them."""
    oldest_ns = piece.t_ns - round(settings.reach_s * 1e9)
    if state.conditioner is not None:
        oldest_ns = max(oldest_ns, state.t0_ns + round((state.first / state.rate_hz - _GROUND_LATE_S) * 1e9))
    kept = [g for g in state.ground if g.t_ns + round(g.values.size / g.rate_hz * 1e9) > oldest_ns]
    return replace(state, ground=(*kept, piece), ground_filter=conditioner)


def step(
    state: EventState,
    first: int,
    t0_ns: int,
    conditioner: Conditioner,
    values: Annotated[Array, "samples c"],
    site: Site,
    saturated: Saturated = none_saturated,
) -> tuple[EventState, list[Event]]:
    """Take a span of conditioned samples.

    Grid index `first` is not that after the last span's where samples are missing, and `t0_ns` is the UTC of grid index 0.
    `saturated` finds the channels that reached the end of their range between two times.  Return preliminary messages and final
    lines, in order.
    """
    rate_hz = conditioner.rate_hz
    n, told = recognition.step_n(rate_hz), list[Event]()
    follows = state.recognition is not None and rate_hz == state.rate_hz and first == state.end
    if not follows:
        state, told = _break_off(state, site, "a gap in the data cut it", saturated)
        state = _begin(state, first, conditioner, values.shape[1])
    t0_ns -= round(conditioner.delay_s * 1e9)
    pieces = (*state.kept, values)
    if len(pieces) > 1 and len(pieces[-2]) < n:
        pieces = (*pieces[:-2], np.concatenate(pieces[-2:]))
    state = replace(state, t0_ns=t0_ns, kept=pieces)
    end = state.end
    while state.settling and state.judged + n <= end:
        state = _settle(state)
    while state.judged + n <= end:
        assert state.recognition is not None
        count = min((end - state.judged) // n, recognition.unsettled(state.recognition) or _TOGETHER_STEPS)
        state, new = _judge(state, count, conditioner.cutoff_hz, site, saturated)
        told += new
        settled = state.recognition is not None and not recognition.unsettled(state.recognition)
        if state.opening is not None and settled:
            state = _opened(state, site)
    return _forget(_with_alarms(state, told, site), site), told


def finish(state: EventState, site: Site, saturated: Saturated = none_saturated) -> tuple[EventState, list[Event]]:
    """Tell what is known of events whose final line is still to come where the data end."""
    state, told = _break_off(state, site, "the data end in it", saturated)
    return _with_alarms(state, told, site), told


def window(state: EventState, result: WindowResult, site: Site) -> tuple[EventState, list[Event]]:
    """Take what a window tells of stiffness and frequencies, and tell the lasting loss of events where an hour has passed."""
    begin_ns = result.t_end_ns - round(result.window_s * 1e9)
    if state.recent and begin_ns < state.recent[-1].end_ns and not state.awaiting:
        return state, []  # as mostly: none that overlaps is kept
    reading = reading_of(result)
    if reading is None:
        return state, []
    state = replace(state, recent=_joined(state.recent, reading, site.settings.revision_s))
    told, awaiting = [], []
    for item in state.awaiting:
        if reading.begin_ns >= item.event.end_ns:
            item = replace(item, after=_joined(item.after, reading, site.settings.revision_s))
        if reading.end_ns - item.event.end_ns >= round(site.settings.revision_s * 1e9):
            told.append(_revised(item, site))
        else:
            awaiting.append(item)
    return _with_alarms(replace(state, awaiting=tuple(awaiting)), told, site), told


def skipped(state: EventState, end_ns: int, window_s: float, settings: EventSettings) -> Skipped | None:
    """Say why a window is not judged: strong motion, known or suspected when it ended; None where there was none."""
    if not settings.skip_windows or state.rate_hz == 0.0:
        return None
    end = round((end_ns - state.t0_ns) * 1e-9 * state.rate_hz)
    begin = end - round(window_s * state.rate_hz)
    held = any(mark[0] < end and mark[1] > begin for mark in state.marks)
    return Skipped(STRONG_MOTION) if held else None


def _with_alarms(state: EventState, told: list[Event], site: Site) -> EventState:
    """Raise the alarms of what is told of events."""
    alarms = state.alarms
    for event in told:
        alarms = alarm.follow(alarms, event, exceedances(event, site))
    return replace(state, alarms=alarms) if told else state


def _begin(state: EventState, first: int, conditioner: Conditioner, n_channels: int) -> EventState:
    """Begin anew at the first sample, or after a gap, with steps on the grid."""
    rate_hz, cutoff_hz = conditioner.rate_hz, conditioner.cutoff_hz
    n = recognition.step_n(rate_hz)
    same = state.recognition is not None and rate_hz == state.rate_hz
    known = state.recognition if same else recognition.start(n_channels, rate_hz, cutoff_hz)
    assert known is not None
    aligned = -(-first // n) * n
    opening = None if known.steps else aligned + _SETTLED_STEPS * n
    return replace(
        state,
        recognition=replace(known, raised=0),
        conditioner=conditioner,
        first=first,
        kept=(),
        judged=aligned,
        settling=_SETTLED_STEPS,
        opening=opening,
        marks=state.marks if same else (),
    )


def _opened(state: EventState, site: Site) -> EventState:
    """Find strong motion amid which the samples begin, which has no quiet before it to be compared with.

    The samples so far are judged backwards in time, by the same rules: what then has not ended at the first one is an event.
    """
    begin, end = state.opening, state.judged
    state = replace(state, opening=None)
    if begin is None or begin >= end or state.strong or state.conditioner is None:
        return state
    if any(item.event.end_ns > state.t0_ns + round(begin / state.rate_hz * 1e9) for item in state.awaiting):
        return state
    samples, n = state.samples(begin, end)[::-1], recognition.step_n(state.rate_hz)
    back = _begin(start(), 0, state.conditioner, samples.shape[1])
    back = replace(back, kept=(samples,), settling=0, opening=None)
    for _ in range(len(samples) // n):
        back, _told = _judge(back, 1, state.conditioner.cutoff_hz, site, none_saturated)
    if not back.strong or back.strong[-1].closed:
        return state
    found = back.strong[-1]
    first, last = max(end - found.end, begin), end - found.begin
    cut = first - begin < n
    note = "it began before the recording, or in its first seconds" if cut else ""
    return replace(state, strong=(Strong(first, last, told=True, closed=True, cut=cut, note=note),))


def _settle(state: EventState) -> EventState:
    """Take a step while the filters settle, which is neither judged nor kept."""
    assert state.recognition is not None
    n = recognition.step_n(state.rate_hz)
    end = state.judged + n
    tail = state.samples(end - n // 2, end)
    return replace(
        state,
        recognition=replace(state.recognition, tail=tail),
        judged=end,
        settling=state.settling - 1,
        first=end,
        kept=_dropped(state.kept, end - state.first),
    )


def _judge(
    state: EventState, count: int, cutoff_hz: float, site: Site, saturated: Saturated
) -> tuple[EventState, list[Event]]:
    """Judge the next steps of samples, `count` of them, whose power is measured together."""
    assert state.recognition is not None
    settings, rate_hz, told = site.settings, state.rate_hz, list[Event]()
    n = recognition.step_n(rate_hz)
    own = recognition.own_band(n, rate_hz, cutoff_hz, site.lowest_hz)
    samples = state.samples(state.judged, state.judged + count * n)
    known, judged = state.recognition, state.judged
    peaks = settings.level_m_s2 is not None
    frames = recognition.measure(known.tail, samples, rate_hz, cutoff_hz, peaks=peaks)
    quiet, cut_off = None, False
    if not state.strong:
        quiet = recognition.pass_quiet(known, frames, own, settings, saturated=True)
        if quiet is None:  # what the sensors' range is worth is asked for here alone: it costs more
            cut_off = _are_saturated(state, judged, judged + count * n, saturated)
            quiet = None if cut_off else recognition.pass_quiet(known, frames, own, settings)
    if quiet is not None:  # as mostly
        return replace(state, recognition=quiet, judged=judged + count * n), told
    for k in range(count):
        active = bool(state.strong) and not state.strong[-1].closed
        at_end = cut_off and _are_saturated(state, judged, judged + n, saturated)
        known, found = recognition.step(known, frames, k, own, settings, active=active, saturated=at_end)
        judged += n
        if state.strong or any(found.raised):
            state, new = _follow(replace(state, recognition=known, judged=judged), found, cutoff_hz, site, saturated)
            assert state.recognition is not None
            known, told = state.recognition, told + new
    return replace(state, recognition=known, judged=judged), told


def _are_saturated(state: EventState, begin: int, end: int, saturated: Saturated) -> bool:
    """Say whether more than half of the live channels reached the end of their range between two grid indices."""
    assert state.recognition is not None
    begin_ns, end_ns = (state.t0_ns + round(i / state.rate_hz * 1e9) for i in (begin, end))
    return recognition.are_most(state.recognition, saturated(begin_ns, end_ns))


def _follow(
    state: EventState, found: recognition.Trigger, cutoff_hz: float, site: Site, saturated: Saturated
) -> tuple[EventState, list[Event]]:
    """Follow events through the last judged step, of which the frames have `found` something, or during an event."""
    known = state.recognition
    assert known is not None
    before = state.strong if not state.strong or state.strong[-1].closed else state.strong[:-1]
    going = _grown(state, found, cutoff_hz, site)
    n = recognition.step_n(state.rate_hz)
    # Of a recording that begins with a few seconds of quiet before strong motion, a test's, the windows are judged.
    if (going is not None or known.raised) and not recognition.unsettled(known):
        state = replace(state, marks=(*state.marks, (state.judged - n, state.judged)))
    told = list[Event]()
    if going is not None:
        state, going, told = _judged_end(state, going, site, saturated)
        before = (*before, going)
    # What is refused holds the average too, and no event ends it.
    elif known.raised * (n // 2) >= site.settings.longest_s * state.rate_hz:
        state = replace(state, recognition=recognition.begin_anew(known), opening=None)
    return _tell_final(replace(state, strong=before), state.judged, site, told, saturated)


def _grown(state: EventState, found: recognition.Trigger, cutoff_hz: float, site: Site) -> Strong | None:
    """Return the event that the last judged step begins or carries on; None where none goes on."""
    going = state.strong[-1] if state.strong and not state.strong[-1].closed else None
    known, rate_hz = state.recognition, state.rate_hz
    assert known is not None
    n = recognition.step_n(rate_hz)
    half = n // 2
    for at, raised, loud in zip((state.judged - n - half, state.judged - n), found.raised, found.loud, strict=True):
        if going is not None:
            going = replace(going, end=at + n) if loud else going
        elif raised >= recognition.FRAMES_IN_A_ROW:
            frames = state.samples(max(state.first, at - n), at + n)
            if len(frames) == 2 * n and recognition.is_whole(
                known.long_term, frames, rate_hz, cutoff_hz, site.settings, one_direction=site.is_chain
            ):
                # All frames in a row belong to the event, also those that did not confirm it yet.
                going = Strong(max(at - (raised - 1) * half, state.first), at + n)
    return going


def _judged_end(
    state: EventState, going: Strong, site: Site, saturated: Saturated
) -> tuple[EventState, Strong, list[Event]]:
    """Send the preliminary message of an event once its motion ends, and close it after enough quiet motion, or too long."""
    settings, rate_hz, told = site.settings, state.rate_hz, list[Event]()
    quiet_s, length_s = (state.judged - going.end) / rate_hz, (state.judged - going.begin) / rate_hz
    if quiet_s >= recognition.STEP_S and not going.told:
        told.append(_describe(state, going, None, site, saturated))
        going = replace(going, told=True)
    if quiet_s >= settings.merge_s:
        going = replace(going, closed=True)
    elif length_s >= settings.longest_s:
        note = f"it went on: cut after {settings.longest_s:g} s"
        going = replace(going, closed=True, end=state.judged, note=note)
        assert state.recognition is not None
        state = replace(state, recognition=recognition.begin_anew(state.recognition), opening=None)
    return state, going, told


def _tell_final(
    state: EventState, end: int, site: Site, told: list[Event], saturated: Saturated
) -> tuple[EventState, list[Event]]:
    """Tell the final line of every event that is followed by enough quiet motion, or by another event."""
    wanted, waiting = round(site.settings.post_s * state.rate_hz), list[Strong]()
    for i, item in enumerate(state.strong):
        later = state.strong[i + 1 :]
        if item.closed and (later or end >= item.end + wanted):
            until = min([end, *(next_.begin for next_ in later[:1])])
            state, final = _final(state, item, until, site, saturated)
            told = [*told, final]
        else:
            waiting.append(item)
    return replace(state, strong=tuple(waiting)), told


def _break_off(state: EventState, site: Site, note: str, saturated: Saturated) -> tuple[EventState, list[Event]]:
    """Tell what is known of events that a gap, or the end of the data, cuts."""
    state, told = _opened(state, site), list[Event]()
    for item in state.strong:
        cut = item if item.closed else replace(item, cut=True, note=note)
        state, final = _final(state, cut, state.end, site, saturated)
        told.append(final)
    return replace(state, strong=()), told


def _final(state: EventState, item: Strong, end: int, site: Site, saturated: Saturated) -> tuple[EventState, Event]:
    """Describe an event for good, by the samples up to grid index `end`, and wait for what the windows tell after it."""
    event = _describe(state, item, end, site, saturated)
    before = tuple(r for r in state.recent if r.end_ns <= event.begin_ns)
    return replace(state, awaiting=(*state.awaiting, Awaiting(event, before))), event


def _describe(state: EventState, item: Strong, end: int | None, site: Site, saturated: Saturated) -> Event:
    """Describe an event: preliminarily, by the samples so far, or for good by those up to grid index `end`."""
    from monitor.events.description import describe  # filters take a while to load
    from monitor.events.record import make_record

    assert state.conditioner is not None

    settings, rate_hz = site.settings, state.rate_hz
    last = max(item.end, (state.judged if end is None else end) - round(_GROUND_LATE_S * rate_hz))
    first = max(state.first, item.begin - round(settings.pre_s * rate_hz))
    begin_ns, end_ns, t_ns = (state.t0_ns + round(i / rate_hz * 1e9) for i in (item.begin, item.end, first))
    before = tuple(r for r in state.recent if r.end_ns <= begin_ns)
    quiet_s = (item.begin - first) / rate_hz
    early = f"only {quiet_s:.0f} s of motion before it are known" if quiet_s < settings.pre_s - 1.0 / rate_hz else ""
    values = state.samples(first, last)
    strong = slice(item.begin - first, item.end - first)
    record = make_record(values, t_ns, state.conditioner, (state.ground, state.ground_filter), strong, site)
    name = datetime.fromtimestamp(begin_ns // 10**9, UTC).strftime("%Y%m%dT%H%M%S") + f".{begin_ns // 10**7 % 100:02d}Z"
    return describe(
        record,
        site,
        id=name,
        revision=None if end is None else 0,
        begin_ns=begin_ns,
        end_ns=end_ns,
        before_hz=mean_frequencies(before, site.modes_hz.size),
        note="; ".join(filter(None, (item.note, early))),
        saturated=saturated(begin_ns, end_ns),
        cut=item.cut,
    )


def _forget(state: EventState, site: Site) -> EventState:
    """Drop samples and marks that nothing needs any more."""
    begun = [item.begin for item in state.strong]
    # An event may turn out to have begun some frames before the last judged step.
    oldest = min([state.judged - recognition.FRAMES_IN_A_ROW * recognition.step_n(state.rate_hz), *begun])
    oldest -= round(site.settings.pre_s * state.rate_hz)
    oldest = oldest if state.opening is None else min(oldest, state.opening)
    drop = max(0, oldest - state.first)
    old = state.judged - round(site.window_s * state.rate_hz)
    marks = state.marks if not state.marks or state.marks[0][1] > old else tuple(m for m in state.marks if m[1] > old)
    if not drop:
        return replace(state, marks=marks)
    return replace(state, first=state.first + drop, kept=_dropped(state.kept, drop), marks=marks)


def _dropped(kept: tuple[Array, ...], n: int) -> tuple[Array, ...]:
    """Drop the first `n` samples of pieces."""
    for i, piece in enumerate(kept):
        if n < len(piece):
            return (piece[n:], *kept[i + 1 :])
        n -= len(piece)
    return ()


def _joined(readings: tuple[AmbientReading, ...], new: AmbientReading, length_s: float) -> tuple[AmbientReading, ...]:
    """Add a window's reading if it overlaps none, and drop those older than a length in seconds."""
    if readings and new.begin_ns < readings[-1].end_ns:
        return readings
    oldest = new.end_ns - round(length_s * 1e9)
    return (*(r for r in readings if r.begin_ns >= oldest), new)


def _revised(item: Awaiting, site: Site) -> Event:
    """Tell the lasting loss of an event, by ambient motion after and before it."""
    loss, std, note = lasting_loss(item.before, item.after, site.n_stories)
    if np.isnan(loss).all() and np.isfinite(item.event.loss).any():
        loss, std, note = item.event.loss, item.event.loss_std, f"{note}: it is that of the final line"
    after = mean_frequencies(item.after, site.modes_hz.size)
    notes = "; ".join(filter(None, (item.event.note, note)))
    revised = replace(item.event, revision=1, after_hz=after, loss=loss, loss_std=std, note=notes)
    return judge(revised, site)
