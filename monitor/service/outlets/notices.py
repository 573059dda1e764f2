"""Notices to people: derived by pure functions from the present state and the state that was announced last.

A notice follows from the difference of the two states, not from an event.  So after any interruption the next comparison
yields every notice that is still due, and none twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import Field

from monitor.core import WHOLE, AlarmCondition, Level, Settings, WindowResult

_MOST_TEXT = 1000


class NoticeSettings(Settings):
    """Settings of ``[notify]`` that select what is announced, without the addresses."""

    level: Level = Level.ADVISORY
    """Lowest level of an alarm that is announced; ``normal`` has the effect of ``advisory``."""
    source_lost_s: float = Field(default=300.0, gt=0)
    """Time without data, by the clock, after which the source is announced as lost."""
    blind_s: float = Field(default=3600.0, gt=0)
    """Time without a judged window, in data time, after which that is announced."""
    findings: bool = True
    """Announce diagnoses."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Message to people."""

    kind: str
    """``alarm``, ``source``, ``recorder``, ``blind`` or ``finding``."""
    good: bool
    """True if the message announces the end of a trouble."""
    title: str
    text: str


@dataclass(frozen=True, slots=True)
class Told:
    """State that was announced last."""

    levels: Mapping[int, Level] = field(default_factory=dict)
    """Highest announced level of each alarm whose end has not been announced, by story; story 0 is the whole structure."""
    lost: bool = False
    """True if the source was announced as lost."""
    stopped: bool = False
    """True if the recorder was announced as stopped."""
    blind: bool = False
    """True if it was announced that windows cannot be judged."""
    judged_ns: int | None = None
    """End of the latest judged window, or before any of the first window that was not judged; UTC, ns since 1970."""


def of_window(told: Told, result: WindowResult, settings: NoticeSettings) -> tuple[Told, list[Notice]]:
    """Derive the notices that a window calls for: alarms raised, escalated and cleared, and long times without a judged window.

    Returns
    -------
    (Told, list of Notice)
        The announced state after the notices, and the notices.
    """
    if result.skipped is not None:
        since = result.t_end_ns if told.judged_ns is None else told.judged_ns
        told = replace(told, judged_ns=since)
        if told.blind or (result.t_end_ns - since) * 1e-9 < settings.blind_s:
            return told, []
        text = f"no window could be judged for {(result.t_end_ns - since) / 60e9:.0f} min: {result.skipped.reason}"
        return replace(told, blind=True), [Notice("blind", False, "nothing can be said", text[:_MOST_TEXT])]
    notices = [Notice("blind", True, "windows are judged again", "")] if told.blind else []
    levels, least = dict(told.levels), max(settings.level.rank, Level.ADVISORY.rank)
    for story in sorted(levels.keys() | result.alarm.active.keys()):
        if result.alarm.conditions.get(story) is AlarmCondition.SHELVED:
            continue  # neither its rise nor its end is announced, as the operator asked
        before, now = levels.get(story, Level.NORMAL), result.alarm.active.get(story, Level.NORMAL)
        place = "the whole structure" if story == WHOLE else f"story {story}"
        if now.rank > before.rank and now.rank >= least:
            levels[story] = now
            notices.append(Notice("alarm", False, f"{now.value}: {place}", result.alarm.reason[:_MOST_TEXT]))
        elif now is Level.NORMAL and before is not Level.NORMAL:
            del levels[story]
            notices.append(Notice("alarm", True, f"cleared: {place}", f"was {before.value}"))
    return replace(told, levels=levels, blind=False, judged_ns=result.t_end_ns), notices


def of_health(
    told: Told, line: Mapping[str, Any], silent_s: float, settings: NoticeSettings
) -> tuple[Told, list[Notice]]:
    """Derive the notices that a health line calls for: source lost or back, recorder stopped or going on.

    Parameters
    ----------
    told : Told
        State that was announced last.
    line : mapping
        Line of health.jsonl.
    silent_s : float
        Time since the latest data, s.
    settings : NoticeSettings
        Selection of what is announced.

    Returns
    -------
    (Told, list of Notice)
        The announced state after the notices, and the notices.
    """
    notices = []
    lost = silent_s >= settings.source_lost_s
    if lost != told.lost and (lost or silent_s == 0.0):
        source = line["source"]
        why = str(source["error"] or source["detail"] or ("connected" if source["connected"] else "not connected"))
        text = f"no data for {silent_s / 60:.0f} min: {why}" if lost else ""
        told = replace(told, lost=lost)
        notices.append(Notice("source", not lost, "source lost" if lost else "source is back", text[:_MOST_TEXT]))
    recorder = line["recorder"]
    stopped = recorder is not None and not recorder["recording"]
    if stopped != told.stopped:
        told = replace(told, stopped=stopped)
        title = "recorder stopped" if stopped else "recorder goes on"
        notices.append(Notice("recorder", not stopped, title, str(recorder["detail"])[:_MOST_TEXT] if stopped else ""))
    return told, notices


def of_finding(finding: Mapping[str, Any], settings: NoticeSettings) -> list[Notice]:
    """Derive the notice of a finding; a diagnosis that failed is not announced."""
    if not settings.findings or finding["verdict"] is None:
        return []
    return [Notice("finding", False, f"diagnosis: {finding['verdict']}", str(finding["says"])[:_MOST_TEXT])]
