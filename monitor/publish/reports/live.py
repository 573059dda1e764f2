"""The page of a running monitor: the page of a period (`period_report`) of what the daemon has published."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from monitor.core import Level
from monitor.damage import Assessment, Course, Loss, WindowFacts
from monitor.events import EventAlarm
from monitor.publish.page.sheet import Sheet
from monitor.publish.reports.period_data import Grid, PeriodResults
from monitor.publish.reports.period_notes import event_alarms
from monitor.publish.reports.period_report import Live, Period, hidden_losses, known_of, sheet, told_in
from monitor.publish.results.event_lines import read_event

_BINS = 360
"""Steps of time of a curve. [1; cost: some 30 kB of charts, compressed]"""


def live_sheet(published: Mapping[str, Any], assessment: Assessment) -> Sheet:
    """Make the page of what was published, in the state that is shown.

    `published` has the keys of `summary` (of summary.json), `windows`, `events` and `findings` (as the endpoints give them, and
    of events the whole lines), `status` and `sensors` (of these endpoints), and `since_ns`, the time of the data at which the
    state began.
    """
    summary, status, rows = published["summary"], published["status"], published["windows"]
    ends = [row["t_end_ns"] for row in rows] or [status.get("t_ns") or 0]
    start = ends[0] - round(1e9 * (rows[0].get("window_s") or 0.0 if rows else 0.0))
    results = PeriodResults(Grid(start, max(ends[-1], start + 1), min(_BINS, max(len(rows), 1))), 1.0, start)
    for row in rows:
        with suppress(ValueError, KeyError, TypeError, IndexError):
            results.add(row)
    known, losses, alarms, active, as_told = (
        known_of({}),
        tuple[Loss, ...](),
        list[EventAlarm](),
        dict[int, Level](),
        {},
    )
    with suppress(KeyError, TypeError, ValueError, AttributeError):  # a summary of another version
        known, losses = known_of(summary), tuple(hidden_losses((), summary, 0, ends[-1]))
        active = {int(j): Level(level) for j, level in ((summary.get("alarm") or {}).get("active") or {}).items()}
        alarms, as_told = event_alarms(summary), told_in(summary)
    judged = status.get("judged") or {}
    detectable = judged.get("detectable_loss")
    facts = WindowFacts(ends[-1], 0.0, None, active, detectable=None if detectable is None else tuple(detectable))
    reasons = summary.get("skip_reasons") or {}
    course = Course(summary.get("windows") or 0, summary.get("skipped") or 0, reasons, judged=facts, losses=losses)
    events = []
    for line in published["events"]:
        with suppress(KeyError, TypeError, ValueError):
            events.append(read_event(line))
    told = published["sensors"]
    age_s, since_ns = status.get("data_age_s"), published["since_ns"]
    live = Live(status["monitor"], age_s, since_ns, _facts(status), _stream(told), _sensors(told))
    return sheet(
        Period(
            status["site"], results, course, assessment, known, findings=published["findings"], events=events[::-1],
            event_alarms=alarms, live=live, **as_told,
        )
    )  # fmt: skip


def _facts(status: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Say how the monitor is."""
    latest, troubles, free = status.get("latest"), status["troubles"], status.get("disk_free_bytes")
    window = "none yet" if latest is None else (latest.get("skipped") or "judged").partition(" (")[0].partition(":")[0]
    facts = [("; ".join(troubles) or "none", "parts that fail"), (window, "latest window")]
    if (up := status.get("uptime_s")) is not None:
        facts.append(
            (f"{up / 3600.0:.1f} h" if up >= 3600.0 else f"{up / 60.0:.0f} min", "since the monitor was started")
        )
    if free is not None:
        facts.append((f"{free / 2**30:.0f} GiB", "free on the disk"))
    return tuple(facts)


def _stream(told: Mapping[str, Any]) -> str:
    """Say how the source is, and what came of the samples."""
    source, stream, quality, refused = (told.get(key) or {} for key in ("source", "stream", "quality", "refused"))
    says = [str(source.get("trouble") or "")]
    if source:
        error = f": {source['error']}" if source.get("error") else ""
        lost = "Source read to its end" if source.get("ended") else f"Source not connected{error}"
        says.insert(0, "Source connected" if source.get("connected") else lost)
    if stream:
        says += [f"{stream['rate_hz']:.5g} Hz", f"{100 * stream['availability']:.1f} % of the latest span came"]
    if quality.get("availability") is not None:
        says.append(f"{100 * quality['availability']:.2f} % since the start, {quality['gaps']} gaps")
    says.append(f"{refused['blocks']} blocks refused" if refused.get("blocks") else "")
    return "; ".join(filter(None, says))


def _sensors(told: Mapping[str, Any]) -> tuple[tuple[str, ...], ...]:
    """Write the table of the channels."""
    rows = []
    for c in told["channels"]:
        remarks = [
            str(c.get("reason") or ""),
            f"{c['spikes']} spikes" if c.get("spikes") else "",
            f"{100 * c['clipped']:.1f} % clipped" if c.get("clipped") else "",
            f"{100 * c['repeated']:.0f} % repeated" if (c.get("repeated") or 0.0) > 0.1 else "",
            "samples lost" if c.get("lost") else "",
            f"mains hum at {c['hum_hz']:.3g} Hz" if c.get("hum_hz") else "",
            "its offset stepped" if c.get("step_m_s2") else "",
        ]
        numbers = (_number(c.get(key)) for key in ("rms_m_s2", "peak_m_s2", "noise_floor"))
        rows.append(
            (c["channel"], "✓ yes" if c["in_use"] else "✗ no", *numbers, "; ".join(filter(None, remarks)) or "none")
        )
    return tuple(rows)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
