"""What people are told, and when: pure, by comparing what is so with what was told last.

A notice follows from the difference, not from an event, so whatever interrupts the monitor, the next look says what is still
to be said and nothing twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import Field

from monitor.core import WHOLE, AlarmCondition, Level, Settings, WindowResult

_MOST_TEXT = 1000


class NoticeSettings(Settings):
    """What is worth telling; the part of ``[notify]`` that says nothing of where to."""

    level: Level = Level.ADVISORY
    """Alarms from this level on; ``normal`` is as ``advisory``."""
    source_lost_s: float = Field(default=300.0, gt=0)
    """A source that gives nothing for this long, by the clock, is lost."""
    blind_s: float = Field(default=3600.0, gt=0)
    """Windows that come but say nothing for this long, in data time."""
    findings: bool = True
    """Whether diagnoses are told."""


@dataclass(frozen=True, slots=True)
class Notice:
    """One message to people."""

    kind: str
    """``alarm``, ``source``, ``recorder``, ``blind`` or ``finding``."""
    good: bool
    """Whether it is the end of trouble."""
    title: str
    text: str


@dataclass(frozen=True, slots=True)
class Told:
    """What people were told last."""

    levels: Mapping[int, Level] = field(default_factory=dict)
    """Highest level told of each alarm that was not told to be over; story 0 is the whole structure."""
    lost: bool = False
    stopped: bool = False
    blind: bool = False
    judged_ns: int | None = None
    """End of the latest window that said something, or of the first that did not."""


def of_window(told: Told, result: WindowResult, settings: NoticeSettings) -> tuple[Told, list[Notice]]:
    """What a window calls for: alarms raised, escalated and cleared; windows that say nothing for long."""
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
            continue  # neither raised nor over: an operator wants to hear nothing of it
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
    """What a line of health.jsonl calls for: the source lost and back, the recorder stopped and going on.

    Parameters
    ----------
    silent_s : float
        How long no data have come.
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
    """What a diagnosis found; one that failed is for the log."""
    if not settings.findings or finding["verdict"] is None:
        return []
    return [Notice("finding", False, f"diagnosis: {finding['verdict']}", str(finding["says"])[:_MOST_TEXT])]
