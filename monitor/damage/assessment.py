"""The state of the structure in one word and one sentence: what a person reads first.

`assess` is the only place that decides it.  Replay, daemon, reports, viewer, messages and metrics show what it says.

A state is the gravest of what holds, in the order of `State`.  Green (`normal`) is said only where a loss smaller than the
alarm's threshold would have been seen in every story (`damage.detectable_loss`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from monitor.core import (
    CLOCK,
    DIRECTION_WORDS,
    STILL,
    STRONG_MOTION,
    WHOLE,
    Level,
    Skipped,
    storey_of,
    storey_words,
    story_name,
    together,
    utc,
)
from monitor.damage.detectable_loss import WITHIN_S, clock_error
from monitor.damage.origin import MOST_LISTED
from monitor.damage.parts import ALONE, STORIES, Features, ModesAndShapes, Parts, change_words
from monitor.damage.sequential_test import CHANCE_STDS
from monitor.model import FORMS

_UNIT_FACTOR = 4.9
"""Motion so many times stronger, or weaker, than at calibration asks whether the unit is right. [ratio; definition: half of 9.81,
by which g and m/s^2, the closest units in use, differ: the motion itself may be half as strong as at calibration]"""
_MOST_UNSEEN = 0.3
"""Loss of a story that green leaves unseen at most, however high a site sets its alarm. [ratio; judgement]"""

_PLAYBACK = 2.0
"""Pace, or its inverse, from which data are played back rather than measured with a wrong rate. [ratio; convention: `max_pace` of
the deployed sites; at such a rate no mode would be found where it was]"""
_MOST_OUTAGES = 64
"""Most ended times without a channel that are kept. [count; cost]"""


class State(StrEnum):
    """What is known of the structure, in rising gravity."""

    NORMAL = "normal"
    NOT_JUDGED = "not_judged"
    ADVISORY = "advisory"
    DOUBTFUL = "doubtful"
    WARNING = "warning"
    ALARM = "alarm"

    @property
    def rank(self) -> int:
        """0 for normal to 5 for alarm."""
        return _STATE_RANKS[self]

    @property
    def words(self) -> str:
        """The state as people read it."""
        return self.value.replace("_", " ")


_STATE_RANKS = {state: rank for rank, state in enumerate(State)}


@dataclass(frozen=True, slots=True)
class Loss:
    """The stiffness that a story lost, as its alarm says."""

    level: Level
    story: int
    """From 1; `WHOLE` for all stories alike."""
    ddi: float
    """Relative loss of stiffness: the latest significant one that has the size of the highest level."""
    ddi_std: float
    loss_n_per_m: float | None
    """Stiffness lost, N/m."""
    t_first_ns: int
    t_last_ns: int | None = None
    """None while the alarm lasts."""
    modal: bool = False
    """Whether `story` is the number of a mode or of a shape (`parts.modal_parts`), and `ddi` its relative change, negative
    for a fall."""
    t_level_ns: int | None = None
    """End of the window that raised it to this level."""


@dataclass(frozen=True, slots=True)
class Outage:
    """Time without a channel."""

    channel: str
    reason: str
    """What was wrong with it at the latest window without it, as in `core.LeftOutChannel`."""
    t_first_ns: int
    """End of the first window without it."""
    t_last_ns: int | None = None
    """End of the first window with it again; None while it is left out."""


@dataclass(frozen=True, slots=True)
class WindowFacts:
    """What the state needs of one window."""

    t_end_ns: int
    window_s: float
    skipped: str | None
    """Why nothing could be said."""
    active: dict[int, Level] = field(default_factory=dict)
    """Announced level of every story that is not normal."""
    losses: dict[int, tuple[float, float, float | None]] = field(default_factory=dict)
    """Relative loss, its standard deviation and the stiffness lost in N/m, of every active story."""
    shelved: tuple[int, ...] = ()
    """Stories whose alarm an operator shelved."""
    detectable: tuple[float | None, ...] | None = None
    """Smallest loss of each story that would have been seen; None where none would.  As a whole None without a baseline."""
    misfit: float | None = None
    """Goodness of fit of the change since the baseline; 1 is expected."""
    rms_m_s2: float | None = None
    """Level of motion, mean over channels."""
    changes: tuple[tuple[float, float], ...] = ()
    """Relative loss of stiffness, negative for a rise, and its standard deviation, of every story."""
    left_out: tuple[tuple[str, str], ...] = ()
    """Channels of which no use was made, and what was wrong with each."""
    modal: bool = False
    """Whether modes alone are judged: stories are then numbers of modes and shapes, and losses their changes."""
    rates_hz: tuple[float, float] | None = None
    """Rate that the source states, and its rate by the timestamps."""


@dataclass(frozen=True, slots=True)
class Course:
    """The windows up to now, as far as the state depends on them."""

    windows: int = 0
    skipped: int = 0
    skip_reasons: dict[str, int] = field(default_factory=dict)
    """How many windows were skipped for each reason."""
    recent: tuple[tuple[int, bool], ...] = ()
    """End and whether it was judged, of each window of the last hour."""
    last: WindowFacts | None = None
    """The latest window."""
    judged: WindowFacts | None = None
    """The latest window that was judged."""
    losses: tuple[Loss, ...] = ()
    """Every alarm episode at its highest level, in the order in which they began."""
    misfit_since_ns: int | None = None
    """End of the first window of the unbroken run of those that stiffness does not explain."""
    unexplained: float | None = None
    """Largest goodness of fit of a run that lasted a window's length: data without the onset of a change."""
    rms_range: tuple[float, float] | None = None
    """Least and largest level of motion, m/s^2."""
    outages: tuple[Outage, ...] = ()
    """The latest `_MOST_OUTAGES` times without a channel, in the order in which they began, and all that last."""


@dataclass(frozen=True, slots=True)
class Known:
    """What does not change from window to window."""

    names: tuple[str, ...]
    """Of the stories, as people call them."""
    has_baseline: bool
    alarm_loss: float
    """Loss from which a confirmed one is an alarm."""
    misfit: float
    """Goodness of fit from which stiffness explains too little."""
    level_range_m_s2: tuple[float, float] | None = None
    """The baseline's."""
    baseline_doubts: tuple[str, ...] = ()
    """Why the baseline may not be this structure's."""
    unwatched: tuple[int, ...] = ()
    """Stories that the site's owner knows to be unseen."""
    accepted: tuple[tuple[str, str], ...] = ()
    """Name and place of the effects that the structure file states."""
    channels: tuple[str, ...] = ()
    """Names of the channels; empty where they are not known."""
    clock_ratio: float = 1.0
    """Rate of the baseline's data by their timestamps over the stated one."""
    n_modes: int | None = None
    """Number of the modes, or features, where these alone are judged; `names` are then theirs (`Parts.name`)."""
    aside: tuple[str, ...] = ()
    """Channels that are measured and enter no estimate, as along other directions."""
    aside_faults: tuple[tuple[str, str], ...] = ()
    """Those of them that are faulty, and what is wrong with each."""
    relative: tuple[bool, ...] = ()
    """Of each feature, where these are judged, whether its change is told relative to its size."""

    @property
    def parts(self) -> Parts:
        """What is judged."""
        if self.relative:
            return Features(self.names[: len(self.relative)], self.relative)
        return STORIES if self.n_modes is None else ModesAndShapes(self.n_modes)

    @property
    def seen_from(self) -> float:
        """Change that must have been seen for an all-clear, as `detectable` counts it."""
        return self.parts.shown_per_loss * self.alarm_loss


@dataclass(frozen=True, slots=True)
class Assessment:
    """The state, the sentence that stands on top, and what else holds."""

    state: State
    headline: str
    doubts: tuple[str, ...] = ()

    @property
    def content(self) -> dict[str, Any]:
        """The keys of summary.json."""
        return {"state": self.state.value, "headline": self.headline, "doubts": list(self.doubts)}


def follow(course: Course, window: WindowFacts, known: Known) -> Course:
    """Take in a window."""
    recent = tuple(r for r in course.recent if window.t_end_ns - WITHIN_S * 1e9 < r[0] < window.t_end_ns)
    course = replace(
        course,
        windows=course.windows + 1,
        recent=(*recent, (window.t_end_ns, window.skipped is None)),
        last=window,
        outages=_with_outages(course.outages, window),
    )
    if window.rms_m_s2 is not None and window.skipped != STRONG_MOTION:
        low, high = course.rms_range or (window.rms_m_s2, window.rms_m_s2)
        course = replace(course, rms_range=(min(low, window.rms_m_s2), max(high, window.rms_m_s2)))
    if window.skipped is not None:
        reason = _without_numbers(window.skipped)
        reasons = {**course.skip_reasons, reason: course.skip_reasons.get(reason, 0) + 1}
        return replace(course, skipped=course.skipped + 1, skip_reasons=reasons)
    explained = window.misfit is None or window.misfit <= known.misfit
    since_ns = None if explained else min(course.misfit_since_ns or window.t_end_ns, window.t_end_ns)
    unexplained = course.unexplained
    if since_ns is not None and window.misfit is not None and window.t_end_ns - since_ns >= window.window_s * 1e9:
        unexplained = max(unexplained or 0.0, window.misfit)
    return replace(
        course,
        judged=window,
        losses=_followed(course, window, known.seen_from),
        misfit_since_ns=since_ns,
        unexplained=unexplained,
    )


def _with_outages(outages: tuple[Outage, ...], window: WindowFacts) -> tuple[Outage, ...]:
    """Begin and end times without a channel."""
    if not window.left_out and all(o.t_last_ns is not None for o in outages):
        return outages
    left_out, out = dict(window.left_out), []
    for o in outages:
        if o.t_last_ns is None:
            reason = left_out.pop(o.channel, None)
            o = replace(o, t_last_ns=window.t_end_ns) if reason is None else replace(o, reason=reason)
        out.append(o)
    out += [Outage(channel, reason, window.t_end_ns) for channel, reason in left_out.items()]
    ended = [o for o in out if o.t_last_ns is not None]
    return tuple(o for o in out if o not in ended[:-_MOST_OUTAGES])


def _without_numbers(reason: str) -> str:
    """Remove from a reason what stands in brackets: the numbers there differ between windows."""
    return re.sub(r" \([^()]*\)", "", reason)


def _followed(course: Course, window: WindowFacts, alarm_size: float) -> tuple[Loss, ...]:
    """Begin, raise and end the episodes; from `alarm_size` on a confirmed change is an alarm, which a smaller one only holds."""
    out, before = [], {} if course.judged is None else course.judged.active
    for loss in course.losses:
        if loss.t_last_ns is None and loss.story not in window.active:
            if loss.story not in window.shelved:  # a shelved alarm has not ended
                loss = replace(loss, t_last_ns=window.t_end_ns)
        elif loss.t_last_ns is None and loss.story in window.losses:
            level, (ddi, std, stiffness) = window.active[loss.story], window.losses[loss.story]
            size = abs(ddi) if window.modal else ddi
            has_risen = level.rank >= loss.level.rank and level is not before.get(loss.story, loss.level)
            if has_risen:
                loss = replace(loss, level=level, t_level_ns=window.t_end_ns)
            is_as_large = has_risen or size >= (alarm_size if level is Level.ALARM else 0.0)
            if level is loss.level and is_as_large and size > 2.0 * std:
                loss = replace(loss, ddi=ddi, ddi_std=std, loss_n_per_m=stiffness)
        out.append(loss)
    known = {loss.story for loss in out if loss.t_last_ns is None}
    for story, level in window.active.items():
        if story == WHOLE and level.rank > Level.ADVISORY.rank:
            continue  # that of a part that is gone (`alarm.carry_over`), of which no window tells the size
        if story not in known and story in window.losses:
            now_ns = window.t_end_ns
            out.append(Loss(level, story, *window.losses[story], now_ns, modal=window.modal, t_level_ns=now_ns))
    return tuple(out)


def assess(
    course: Course,
    known: Known,
    findings: Sequence[Mapping[str, Any]] = (),
    *,
    standing: Mapping[int, Level] | None = None,
    exceeded: Sequence[str] = (),
    clocks: Sequence[tuple[str, float, float]] = (),
    first: tuple[float, int | None] | None = None,
    whole: bool = False,
) -> Assessment:
    """Decide the state, with the sentence of the gravest fact as headline.

    Parameters
    ----------
    findings : sequence of mappings
        Results of diagnoses: `verdict`, `says`, `causes`, `alternatives`, `ddi_effect`, `from_ns`, `t_ns`.
    standing : mapping, optional
        Announced level by story before the first window: of alarms that a restart kept.
    exceeded : sequence of str
        What alarms of events say that nobody has acknowledged, oldest first.
    clocks : sequence of (str, float, float)
        Each sensor node whose rate the driver measures: its name, its rate over the stated one, and its standard deviation.
    first : (float, int or None), optional
        Length of a window, s, and UTC of the first one's end, None before the first sample: told until it has come.
    whole : bool
        State of a whole recording, alarms that ended and misfits that passed included, in place of the present state.
    """
    facts = [
        *_alarms(course, known, findings, whole),
        *_kept(course, known, standing or {}),
        *((State.ALARM, _sentence(says)) for says in reversed(exceeded)),
        *_doubts(course, known, findings, clocks, whole),
        *_silent(course, known),
        *_alike(course, known),
        *_unjudged(course, known, first),
    ]
    remarks, aside = _remarks(course, known, whole), _aside(known)
    if not facts:
        facts = [(State.NORMAL, _sentence("; ".join([_seen(course, known), *aside])))]
        aside = []
    remarks += map(_sentence, aside)
    facts.sort(key=lambda fact: -fact[0].rank)  # stable: of equals the first stays first
    (state, headline), *others = facts
    sentences = [headline, *(sentence for _, sentence in others), *remarks]
    headline, *doubts = dict.fromkeys(storey_words(sentence, known.names) for sentence in sentences)
    return Assessment(state, headline, tuple(doubts))


def outdated(assessment: Assessment, why: str, t_ns: int | None = None) -> Assessment:
    """State what is left of an assessment when nothing new is known: an alarm or a doubt stands, `normal` does not.

    `why` says why nothing new is known since `t_ns` (UTC, ns).
    """
    known = "" if t_ns is None else f", as of {utc(t_ns)} UTC"
    latest = f"{assessment.headline.rstrip('.')}{known}"
    if assessment.state.rank <= State.NOT_JUDGED.rank:
        headline = f"{why}; before: {latest[:1].lower()}{latest[1:]}"
        return Assessment(State.NOT_JUDGED, _sentence(headline), assessment.doubts)
    return Assessment(assessment.state, _sentence(latest), (_sentence(why), *assessment.doubts))


Fact = tuple[State, str]


def _alarms(course: Course, known: Known, findings: Sequence[Mapping[str, Any]], whole: bool) -> list[Fact]:
    """State every alarm that stands or, in a whole recording, that stood."""
    facts = []
    shelved = () if course.last is None else course.last.shelved
    losses = [loss for loss in course.losses if whole or (loss.t_last_ns is None and loss.story not in shelved)]
    for loss in sorted(losses, key=lambda item: (-item.level.rank, _kind(item, known), -abs(item.ddi))):
        level = loss.level if whole or course.last is None else course.last.active.get(loss.story, loss.level)
        if loss.t_last_ns is None:
            says = _since(loss, level, course, known)
        else:
            says = f"{_lost(loss, known)}, until {utc(loss.t_last_ns)} UTC"
        said = (diagnosis_of(loss, findings, known.names) or "").rstrip(".")
        diagnosis = f"; diagnosis: {said[:1].lower()}{said[1:]}" if said else ""
        alone = ALONE.get(_name(loss.story, known), "") if len(losses) == 1 else ""
        facts.append((State(level.value), _sentence(says + alone + diagnosis)))
    return facts


def _since(loss: Loss, level: Level, course: Course, known: Known) -> str:
    """Say since when an alarm stands, how large it was then and how large it is now; `level` is the one it has now."""
    since = f"since {utc(loss.t_level_ns or loss.t_first_ns)} UTC"
    now = None if course.judged is None else course.judged.losses.get(loss.story)
    if now is None or now[:2] == (loss.ddi, loss.ddi_std) or _name(loss.story, known) in ALONE:  # which has no size
        return f"{_lost(loss, known)}, {loss.level.value} {since}"
    present = replace(loss, level=level, ddi=now[0], ddi_std=now[1])
    if level is not loss.level:
        return f"{_lost(present, known)}; {loss.level.value} of {_size(loss, known)} {since} is over"
    return f"{_lost(loss, known)}, {loss.level.value} {since}; now {_size(present, known)}"


def _lost(loss: Loss, known: Known) -> str:
    """Say what an alarm is about and how much it changed."""
    unconfirmed = ", not confirmed yet" if loss.level is Level.ADVISORY and loss.story != WHOLE else ""
    if loss.modal:
        return f"{known.parts.since}{_change(loss, known)}{unconfirmed}"
    if loss.story == WHOLE:
        return f"every story lost {100 * loss.ddi:.1f} % alike (weather, mass, clock or stiffness)"
    return f"{_name(loss.story, known)} lost {_size(loss, known)} of its stiffness since the baseline{unconfirmed}"


def _kept(course: Course, known: Known, standing: Mapping[int, Level]) -> list[Fact]:
    """State every alarm that stands without a loss in these windows: it was raised before them."""
    said = {loss.story for loss in course.losses if loss.t_last_ns is None}
    active = standing if course.last is None else course.last.active
    return [
        (
            State(level.value),
            _sentence(f"the {level.value} of {_name(story, known)} stands from before; no window since says its size"),
        )
        for story, level in sorted(active.items(), key=lambda item: -item[1].rank)
        if story not in said
    ]


def diagnosis_of(loss: Loss, findings: Iterable[Mapping[str, Any]], names: Sequence[str] = ()) -> str | None:
    """Return the sentence of the first diagnosis that concerns an alarm of one of the parts `names`; None without one."""
    return next((str(f["says"]) for f in findings if f.get("says") and _concerns(f, loss, names)), None)


def _concerns(finding: Mapping[str, Any], loss: Loss, names: Sequence[str]) -> bool:
    """Decide if a diagnosis used data of an alarm's time, and speaks of the alarm's story or of no story's stiffness."""
    if not (loss.t_first_ns <= finding["t_ns"] and (loss.t_last_ns is None or finding["from_ns"] <= loss.t_last_ns)):
        return False
    places = {str(c["location"]) for c in finding.get("causes") or [] if _is_loss(c)}
    place = storey_of(names[loss.story - 1]) if 0 < loss.story <= len(names) else None
    own = f"story {loss.story}" if place is None else "storey {} {}".format(*place)
    return loss.story == WHOLE or not places or not places.isdisjoint({own, "frame"})


def _doubts(
    course: Course,
    known: Known,
    findings: Sequence[Mapping[str, Any]],
    clocks: Sequence[tuple[str, float, float]],
    whole: bool,
) -> list[Fact]:
    """State why the damage index cannot be relied on."""
    says = []
    if known.has_baseline:
        says += [f"diagnosis {f.get('id', '')}: {_proposal(f)}" for f in findings if is_open(f, known)]
        misfit = course.unexplained if whole else None
        if course.judged is not None and course.judged.misfit is not None and course.judged.misfit > known.misfit:
            misfit = max(misfit or 0.0, course.judged.misfit)
        if misfit is not None:
            says.append(
                f"a change of stiffness does not explain the modes (goodness of fit {misfit:.3g} where 1 is expected); "
                "a sensor, a cable or another cause may"
            )
        says += _unalarmed(course, findings, known)
        says += _risen(course, known)
        says += _levels(course, known, whole)
        says += _clock(course, known, clocks)
    says += known.baseline_doubts
    return [(State.DOUBTFUL, _sentence(sentence)) for sentence in says]


def is_open(finding: Mapping[str, Any], known: Known) -> bool:
    """Tell whether a diagnosis found anything but losses of stiffness that nobody has accepted yet."""
    if finding.get("verdict") not in {"named", "ambiguous", "unexplained"}:
        return False
    causes = finding.get("causes") or []
    settled = ((c["effect"], c["location"]) in known.accepted or _is_loss(c) for c in causes)
    return finding["verdict"] != "named" or not causes or not all(settled)


def _is_loss(cause: Mapping[str, Any]) -> bool:
    """Decide if a cause is a change of stiffness, which the alarms state."""
    return cause["effect"] in FORMS and FORMS[cause["effect"]].is_stiffness_loss


def _unalarmed(course: Course, findings: Sequence[Mapping[str, Any]], known: Known) -> list[str]:
    """State the findings of a change of stiffness that no alarm of their time states."""
    return [
        f"diagnosis {f.get('id', '')}: {_proposal(f)}"
        for f in findings
        if f.get("verdict") == "named" and not is_open(f, known)
        if any(_is_loss(c) and (c["effect"], c["location"]) not in known.accepted for c in f.get("causes") or [])
        if not any(_concerns(f, loss, known.names) for loss in course.losses)
    ]


def _risen(course: Course, known: Known) -> list[str]:
    """Ask about the baseline where a story is stiffer than at calibration by as much as an alarm's loss."""
    changes = () if course.judged is None or known.n_modes is not None else course.judged.changes
    return [
        f"{_name(j, known)} is {-100 * change:.1f} ± {200 * std:.1f} % stiffer than at calibration: was it damaged then, or is "
        "a sensor, a mass or the temperature another?"
        for j, (change, std) in enumerate(changes, start=1)
        if -change >= max(min(known.alarm_loss, _MOST_UNSEEN), CHANCE_STDS * std)
    ]


def _proposal(finding: Mapping[str, Any]) -> str:
    """State a finding as what it is until a person accepts it."""
    says = str(finding.get("says") or finding["verdict"]).rstrip(".")
    return f"{says} ({'a proposal until it is accepted' if finding['verdict'] == 'named' else 'not accepted yet'})"


def _silent(course: Course, known: Known) -> list[Fact]:
    """State the channels that are left out at present."""
    gone = [o for o in course.outages if o.t_last_ns is None]
    names = {o.channel for o in gone}
    left = [name for name in known.channels if name not in names]
    judged = f"judged with {', '.join(left)}" if left else "judged without it"
    judged = judged if course.last is not None and course.last.skipped is None else "the others are too few"
    return [
        (
            State.DOUBTFUL,
            _sentence(f"channel {o.channel} {_without_numbers(o.reason)}, since {utc(o.t_first_ns)} UTC; {judged}"),
        )
        for o in gone
    ]


def _levels(course: Course, known: Known, whole: bool) -> list[str]:
    """Ask whether the unit is right where the motion is far stronger, or weaker, than at calibration.

    That is the motion of the latest window or, in a whole recording, of any; that of strong motion is told as an event.
    """
    last = course.last
    if last is not None and last.skipped == STRONG_MOTION:
        last = course.judged
    latest = None if last is None else last.rms_m_s2
    seen = course.rms_range if whole or latest is None else (latest, latest)
    if seen is None or known.level_range_m_s2 is None:
        return []
    return unit_questions(*seen, known.level_range_m_s2)


def _clock(course: Course, known: Known, clocks: Sequence[tuple[str, float, float]]) -> list[str]:
    """State both rates where what a clock leaves open exceeds the smallest loss that would have been seen."""
    modal, last, judged = known.n_modes is not None, course.last, course.judged
    widened = 0.0 if judged is None else clock_error(judged.rates_hz, known.clock_ratio, known.parts.shown_per_loss)
    seen = [] if judged is None else [loss for loss in judged.detectable or () if loss is not None]
    least = max(seen) - widened if seen else known.seen_from
    if last is not None and (last.skipped or "").startswith(CLOCK):  # it lets no window be judged
        least = 0.0
    stated, stamped = (1.0, known.clock_ratio) if last is None or last.rates_hz is None else last.rates_hz
    found = [("by their timestamps", stamped / stated, 0.0)]
    found += [(f"by the clock of this machine ({node})", ratio, std) for node, ratio, std in clocks]
    says = []
    for how, ratio, std in found:
        away = max(abs(ratio / known.clock_ratio - 1.0) - 2.0 * std, 0.0)
        error = clock_error((1.0, 1.0 + away), 1.0, known.parts.shown_per_loss)
        if error > least and 1.0 / _PLAYBACK < ratio < _PLAYBACK:
            says.append(
                f"the samples come at {stated * ratio:.6g} Hz {how}, at {stated:g} Hz as the source states: all "
                f"{'frequencies' if modal else 'stiffnesses'} may be off by {100 * error:.2g} %, from the clock or from the rate"
            )
    return says


def unit_questions(least_m_s2: float, most_m_s2: float, calibration_m_s2: tuple[float, float]) -> list[str]:
    """Ask whether the unit is right where the least or the largest RMS is far from the range at calibration, all in m/s^2.

    Examples
    --------
    >>> unit_questions(0.1, 1.0, (0.1, 0.2))
    ['the motion is 5 times stronger than at calibration: is the unit right, or is it a storm?']
    """
    low, high = calibration_m_s2
    if most_m_s2 > _UNIT_FACTOR * high > 0.0:
        return [
            f"the motion is {most_m_s2 / high:.3g} times stronger than at calibration: is the unit right, or is it a storm?"
        ]
    if 0.0 < least_m_s2 < low / _UNIT_FACTOR:
        return [
            f"the motion is {low / least_m_s2:.3g} times weaker than at calibration: is the unit right, is the sensor fixed?"
        ]
    return []


def _alike(course: Course, known: Known) -> list[Fact]:
    """State a loss that all stories have alike and no alarm says: the loss that would have been seen is that of one story."""
    window = course.judged
    if window is None or not known.has_baseline or window.active or len(window.changes) < 2:
        return []
    changes = window.changes
    if window.modal:  # of the same sign, as losses
        falls = sum(size < 0.0 for size, _ in changes) > 0.5 * len(changes)
        changes = tuple((-size if falls else size, std) for size, std in changes)
    least, std = min(changes)
    seen = [loss for loss in window.detectable or () if loss is not None]
    if not seen or least < max(max(seen), CHANCE_STDS * std):
        return []
    what = f"{known.parts.every} {'changed by' if window.modal else 'lost'} {100 * least:.1f} % alike"
    says = f"{what}, too little for an alarm (weather, mass, clock or stiffness)"
    return [(State.NOT_JUDGED, _sentence(says))]


def _unjudged(course: Course, known: Known, first: tuple[float, int | None] | None) -> list[Fact]:
    """State why nothing, or not enough, can be said of damage."""
    says = [] if (why := _why_unjudged(course, first)) is None else [why]
    if not known.has_baseline:
        says.append("no baseline to compare with; make one with 'calibrate'")
    elif not says and course.judged is not None and not known.relative:
        detectable = course.judged.detectable
        watched = {*range(1, len(detectable or ()) + 1)} - {*known.unwatched}
        if _unseen(course.judged, known) or not watched:
            says.append(_seen(course, known))
    return [(State.NOT_JUDGED, _sentence(sentence)) for sentence in says]


def _why_unjudged(course: Course, first: tuple[float, int | None] | None) -> str | None:
    """Say why no window of late could be judged; None where one was."""
    if course.last is None:
        window_s, t_end_ns = first or (0.0, None)
        takes = f"; the first takes {window_s:g} s of data" if window_s else ""
        ends = "" if t_end_ns is None else f" and is full at {utc(t_end_ns, seconds=True)} UTC, if data keep coming"
        return f"no window of data yet{takes}{ends}"
    skipped = course.last.skipped or ""
    if course.judged is None or not any(judged for _, judged in course.recent):
        reason = max(course.skip_reasons, key=lambda r: course.skip_reasons[r], default="")
        if skipped and _without_numbers(skipped) == reason:
            reason = skipped
        since = "" if course.judged is None else " for an hour"
        return f"no window could be judged{since}: {Skipped(reason).mend}"
    if skipped.startswith(STILL):
        return skipped
    silent_s = (course.last.t_end_ns - course.judged.t_end_ns) * 1e-9
    if silent_s >= course.judged.window_s > 0.0:
        return f"the last {silent_s:.0f} s could not be judged: {Skipped(skipped).mend}"
    return None


def _unseen(window: WindowFacts, known: Known) -> list[int]:
    """List the watched stories in which a loss of the alarm's size would not have been seen."""
    return [
        j
        for j, loss in enumerate(window.detectable or (), start=1)
        if j not in known.unwatched and not ({j, WHOLE}.isdisjoint(window.shelved) and is_seen(loss, known.seen_from))
    ]


def is_seen(detectable: float | None, alarm_loss: float) -> bool:
    """Decide if a story's smallest detectable loss makes "no alarm" an all-clear; None where no loss would be seen."""
    return detectable is not None and detectable < min(alarm_loss, _MOST_UNSEEN)


def _seen(course: Course, known: Known) -> str:
    """State the smallest loss that would have been seen, and the stories in which none would."""
    window = course.judged
    if known.relative:
        return f"no change of {', '.join(known.names[: len(known.relative)])} beyond what the covariates explain"
    if window is None or window.detectable is None:
        return f"how small a {known.parts.loss} would have been seen is not recorded in these results"
    unseen = _unseen(window, known)
    blind = sorted({*unseen, *known.unwatched})
    losses = [loss for j, loss in enumerate(window.detectable, start=1) if j not in blind and loss is not None]
    if all(loss is None for loss in window.detectable):
        return f"no {known.parts.loss} could have been confirmed in any {known.parts.part}"
    of_unseen = [1.0 if (least := window.detectable[j - 1]) is None else least for j in unseen]
    share = f"in {len(unseen)} of {len(window.detectable)} only a {known.parts.loss}"
    why: dict[str, list[str]] = {}
    for j in blind:
        says = _why_unseen(j, window, known)
        if j in unseen and len({*of_unseen}) > MOST_LISTED:
            says = f"{share} above {100 * min(of_unseen):.3g} % would be seen, if any"
        why.setdefault(says, []).append(_name(j, known))
    notes = [
        (says.replace("{} is", "{} are") if len(names) > 1 else says).format(together(names, known.names))
        for says, names in why.items()
    ]
    if not losses:
        return f"no {known.parts.loss} would have been seen: " + "; ".join(notes)
    where = f"any {known.parts.part}" if not blind else f"any other {known.parts.part}"
    loss = f"no {known.parts.loss} above {100 * max(losses):.2g} % in {where}"
    if unseen:
        return f"{'; '.join(notes)}; {loss}"
    return "; ".join([loss, *notes])


def _why_unseen(story: int, window: WindowFacts, known: Known) -> str:
    """State that a story, whose name is to be put in, is not seen, and from which loss on it would be."""
    loss = None if window.detectable is None else window.detectable[story - 1]
    if WHOLE in window.shelved:
        return f"the alarm of {known.parts.every} alike is shelved, so nothing is said of {{}}"
    if story in window.shelved:
        return "the alarm of {} is shelved"
    if story in known.unwatched:
        return "{} is not watched"
    if loss is None or loss >= 1.0:
        return "{} is not seen"
    return f"in {{}} only a {known.parts.loss} above {100 * loss:.2g} % would be seen"


def _remarks(course: Course, known: Known, whole: bool) -> list[str]:
    """State what else is worth knowing and changes no state."""
    says = []
    if course.skipped and course.judged is not None:
        reasons = "; ".join(f"{n}: {Skipped(reason).mend}" for reason, n in course.skip_reasons.items())
        says.append(f"{course.skipped} of {course.windows} windows could not be judged ({reasons})")
    outages = [o for o in course.outages if o.t_last_ns is not None][-MOST_LISTED:]
    says += [
        f"channel {o.channel} was left out ({_without_numbers(o.reason)}) from {utc(o.t_first_ns)} to {utc(o.t_last_ns or 0)} UTC"
        for o in outages
    ]
    says += _all_frequencies(course, known)
    says += [f"channel {name}, which enters no estimate, {fault}" for name, fault in known.aside_faults]
    ended = [loss for loss in course.losses if loss.t_last_ns is not None]
    if ended and not whole:
        loss = ended[-1]
        name, size = _name(loss.story, known), _change(loss, known) if loss.modal else _size(loss, known)
        name += "" if size == name else f" ({size})"
        says.append(f"an earlier {loss.level.value} of {name} ended {utc(loss.t_last_ns or 0)} UTC")
    return [_sentence(sentence) for sentence in says]


def _aside(known: Known) -> list[str]:
    """Say in which directions alone the structure is judged, and that there are channels of which no estimate is made."""
    places = [place for name in known.names if (place := storey_of(name))]
    judged = list(dict.fromkeys(DIRECTION_WORDS[direction] for _, direction in places))
    if not known.aside and len(judged) in (0, len(DIRECTION_WORDS)):
        return []
    if not judged and known.n_modes is None:
        judged = [DIRECTION_WORDS["x"]]
    along = f"judged {' and '.join(judged)} only" if 0 < len(judged) < len(DIRECTION_WORDS) else ""
    beside = f"{len(known.aside)} of {len(known.aside) + len(known.channels)} channels enter no estimate"
    return [": ".join(filter(None, (along, beside if known.aside else "")))]


def _name(story: int, known: Known) -> str:
    if story == WHOLE:
        return known.parts.every
    return story_name(story, known.names)


def _all_frequencies(course: Course, known: Known) -> list[str]:
    """Say how all frequencies changed, where modes alone are judged, all are known and something was announced."""
    window = course.judged
    if window is None or not course.losses or known.n_modes is None or len(window.changes) != known.n_modes:
        return []
    changes = [_told(k, size, std, known) for k, (size, std) in enumerate(window.changes, 1)]
    return [f"by the latest window {', '.join(changes)}"]


def _kind(loss: Loss, known: Known) -> int:
    """Order what is told: frequencies, or stories, then shapes, then the spectrum."""
    return 0 if known.n_modes is None else (loss.story > known.n_modes) + (loss.story > 2 * known.n_modes)


def _change(loss: Loss, known: Known) -> str:
    """Say how a mode or a shape changed."""
    words = _told(loss.story, loss.ddi, loss.ddi_std, known)
    return f"{words} alike (weather, mass, clock or stiffness)" if loss.story == WHOLE else words


def _told(part: int, change: float, std: float, known: Known) -> str:
    """Say by how much a mode, a shape or a feature changed."""
    if known.relative:
        return known.parts.changed(part, -change, -change, std)
    return change_words(_name(part, known), change, std)


def _size(loss: Loss, known: Known) -> str:
    return known.parts.size(loss.story, loss.ddi, loss.ddi_std)


def _sentence(text: str) -> str:
    """Begin with a capital letter, and end with a full stop or a question mark."""
    text = text[:1].upper() + text[1:]
    return text if text.endswith(("?", ".")) else text + "."
