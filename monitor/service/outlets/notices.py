"""Notices to people: derived by pure functions from the present state and the state that was announced last.

A notice follows from the difference of the two states, not from an event.  So after any interruption the next comparison
yields every notice that is still due, and none twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

from pydantic import Field

from monitor.core import WHOLE, AlarmCondition, Level, Settings, WindowResult, story_name
from monitor.damage import Assessment, State
from monitor.events import Event
from monitor.publish import event_text, telling

_MOST_TEXT = 1000

URGENT = ("event", "alarm", "doubtful", "finding")
"""Kinds of notices on the state of the structure, the most urgent first."""
HOUSEKEEPING = ("blind", "source", "recorder")
"""Kinds of notices on the monitor itself, the most urgent first; they wait for every urgent one."""


class NoticeSettings(Settings):
    """Settings of ``[notify]`` that select what is announced, without the addresses."""

    level: Level = Level.ADVISORY
    """Lowest level of an alarm that is announced; ``normal`` has the effect of ``advisory``."""
    source_lost_s: float = Field(default=300.0, gt=0)
    """Time without data, by the clock, after which the source is announced as lost."""
    blind_s: float = Field(default=3600.0, gt=0)
    """Time in which no window could be judged, or no loss would have been seen, in data time, after which that is announced."""
    findings: bool = True
    """Announce diagnoses."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Message to people."""

    kind: str
    """One of `URGENT` or `HOUSEKEEPING`."""
    good: bool
    """True if the message announces the end of a trouble."""
    title: str
    text: str
    about: str | None = None
    """Whose state it tells, among those of its kind: a later notice about the same supersedes it; None of one that none does."""

    @property
    def rank(self) -> int:
        """Place of the kind in the order of delivery, 0 for the most urgent."""
        kinds = (*URGENT, *HOUSEKEEPING)
        return kinds.index(self.kind) if self.kind in kinds else len(kinds)  # the file of a later version has others

    @property
    def urgent(self) -> bool:
        """True if the notice is on the state of the structure."""
        return self.kind in URGENT


@dataclass(frozen=True, slots=True)
class Told:
    """State that was announced last."""

    levels: dict[int, Level] = field(default_factory=dict)
    """Highest announced level of each alarm whose end has not been announced, by story; story 0 is the whole structure."""
    lost: bool = False
    """True if the source was announced as lost."""
    stopped: bool = False
    """True if the recorder was announced as stopped."""
    blind: bool = False
    """True if it was announced that nothing is judged."""
    judged_ns: int | None = None
    """End of the latest window that was judged and would have shown a loss, or before any of the first that would not have;
    UTC, ns since 1970."""
    doubtful: bool = False
    """True if it was announced that the state is doubtful."""
    doubt_ns: int | None = None
    """End of the first window of those since which the state is doubtful, or no longer, other than announced."""


Derived = tuple[Told, list[Notice]]
"""Announced state after notices, and these."""


def of_window(
    told: Told, result: WindowResult, present: Assessment, settings: NoticeSettings, names: Sequence[str] = ()
) -> Derived:
    """Derive the notices that a window calls for, and the announced state after them: alarms, doubts, long times without a word.

    An alarm is announced at once when it is raised, escalated or cleared.  That nothing is judged is announced when it has lasted
    `blind_s`, and that the state is, or no longer is, doubtful when it has lasted a window's length, so that a single window
    calls for neither.  The sentences of `present`, the state with that window, are the text of the notices; `names` are
    the stories'.
    """
    told, notices = _blindness(told, result, present, settings)
    if result.skipped is None:
        told, of_doubts = _doubts(told, result, present)
        told, of_alarms = _alarms(told, result, present, settings, names)
        notices += of_doubts + of_alarms
    return told, notices


def _text(present: Assessment) -> str:
    """Write the headline, then what else holds, a line each."""
    return "\n".join([present.headline, *present.doubts])[:_MOST_TEXT]


def _blindness(told: Told, result: WindowResult, present: Assessment, settings: NoticeSettings) -> Derived:
    """Derive the notice that nothing has been judged for `blind_s`, or is judged again."""
    if result.skipped is None and present.state is not State.NOT_JUDGED:
        notices = [Notice("blind", True, "judged again", _text(present), "structure")] if told.blind else []
        return replace(told, blind=False, judged_ns=result.t_end_ns), notices
    since = result.t_end_ns if told.judged_ns is None else told.judged_ns
    told = replace(told, judged_ns=since)
    if told.blind or (result.t_end_ns - since) * 1e-9 < settings.blind_s:
        return told, []
    text = _text(present)
    if result.skipped is not None and present.state is not State.NOT_JUDGED:
        text = f"no window could be judged for {(result.t_end_ns - since) / 60e9:.0f} min: {result.skipped.mend}"
    return replace(told, blind=True), [Notice("blind", False, State.NOT_JUDGED.words, text[:_MOST_TEXT], "structure")]


def _doubts(told: Told, result: WindowResult, present: Assessment) -> Derived:
    """Derive the notice that the state has been doubtful, or no longer, for a window's length."""
    doubtful = present.state is State.DOUBTFUL
    is_graver = present.state.rank > State.DOUBTFUL.rank  # beside an alarm doubts are its text only
    if doubtful == told.doubtful or is_graver:
        return replace(told, doubt_ns=None), []
    since = result.t_end_ns if told.doubt_ns is None else told.doubt_ns
    if result.t_end_ns - since < result.window_s * 1e9:
        return replace(told, doubt_ns=since), []
    title = present.state.words if doubtful else f"no longer doubtful: {present.state.words}"
    notice = Notice("doubtful", not doubtful, title, _text(present), "structure")
    return replace(told, doubtful=doubtful, doubt_ns=None), [notice]


def _alarms(
    told: Told, result: WindowResult, present: Assessment, settings: NoticeSettings, names: Sequence[str]
) -> Derived:
    """Derive the notices of alarms raised, escalated and cleared."""
    active = result.alarm.active
    if result.modal is not None and active:  # one change moves several modes and shapes: it is told once
        active = {WHOLE: result.alarm.level}
    n_stories = len(result.damage.loss) if result.damage is not None else 0 if result.modal is not None else inf
    notices, levels, least = [], dict(told.levels), max(settings.level.rank, Level.ADVISORY.rank)
    for story in sorted(levels.keys() | active.keys()):
        if result.alarm.conditions.get(story) is AlarmCondition.SHELVED:
            continue  # neither its rise nor its end is announced, as the operator asked
        before, now = levels.get(story, Level.NORMAL), active.get(story, Level.NORMAL)
        place = "the whole structure" if story == WHOLE else story_name(story, names)
        if now.rank > before.rank and now.rank >= least:
            levels[story] = now
            notices.append(Notice("alarm", False, f"{now.value}: {place}", _text(present), place))
        elif now is Level.NORMAL and before is not Level.NORMAL:
            del levels[story]
            if story > n_stories:
                continue  # the structure has it no longer: its alarm is now that of the whole (`damage.alarm.carry_over`)
            notices.append(Notice("alarm", True, f"cleared: {place}", f"was {before.value}; {_text(present)}", place))
    return replace(told, levels=levels), notices


def of_health(told: Told, line: Mapping[str, Any], silent_s: float, settings: NoticeSettings) -> Derived:
    """Derive the notices that a line of health.jsonl calls for, and the announced state after them.

    They say that the source is lost (`silent_s` without data, s) or back, and that the recorder stopped or goes on.
    """
    notices = []
    source = line["source"]
    lost = silent_s >= settings.source_lost_s and not source.get("ended")
    if lost != told.lost and (lost or silent_s == 0.0):
        though = f", though {source['detail'] or 'connected'}" if source["connected"] else f"; source {source['says']}"
        text = f"no data for {silent_s / 60:.0f} min{though}" if lost else ""
        told = replace(told, lost=lost)
        title = ("no data" if source["connected"] else "source lost") if lost else "source is back"
        notices.append(Notice("source", not lost, title, text[:_MOST_TEXT], "source"))
    recorder = line["recorder"]
    stopped = recorder is not None and not recorder["recording"]
    if stopped != told.stopped:
        told = replace(told, stopped=stopped)
        title = "recorder stopped" if stopped else "recorder goes on"
        text = str(recorder["detail"])[:_MOST_TEXT] if stopped else ""
        notices.append(Notice("recorder", not stopped, title, text, "recorder"))
    return told, notices


def of_finding(told: Told, finding: Mapping[str, Any], present: Assessment, settings: NoticeSettings) -> Derived:
    """Derive the notice of a finding; a diagnosis that failed is not announced.

    Where the finding is what makes the state doubtful, its notice announces that too.
    """
    if not settings.findings or finding["verdict"] is None:
        return told, []
    text = str(finding["says"])
    if present.state is State.DOUBTFUL and text.rstrip(".") in present.headline:
        told, text = replace(told, doubtful=True, doubt_ns=None), f"{present.state.words}: {_text(present)}"
    return told, [Notice("finding", False, f"diagnosis: {finding['verdict']}", text[:_MOST_TEXT])]


def of_event(event: Event) -> Notice:
    """Announce what is told of an event; the verdict stands first in the text."""
    return Notice("event", False, telling(event), event_text(event), event.id)
