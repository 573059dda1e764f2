"""The page of a structure: its state, what to do, where and how much, whether it can be trusted, curves, and decisions.

The report of a period and the live page are this page: `sheet` makes it of a `Period`, read from a folder (`read_period`) or of
what a daemon publishes (`publish.reports.live`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from os.path import relpath
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from pydantic import TypeAdapter

from monitor.core import WHOLE, AlarmCondition, BadInputError, Level, Skipped, story_name
from monitor.damage import (
    ALONE,
    Assessment,
    Course,
    Known,
    LearnedRange,
    Loss,
    State,
    advice,
    assess,
    diagnosis_of,
    is_seen,
)
from monitor.events import Event, EventAlarm
from monitor.publish.page.charts import Chart
from monitor.publish.page.sheet import Link, Sheet
from monitor.publish.reports import period_notes as notes
from monitor.publish.reports.period_data import Curve, Grid, PeriodResults, read_results, utc
from monitor.publish.reports.period_notes import Decision, Quality
from monitor.publish.results.event_lines import event_text, with_interval
from monitor.publish.results.recorded_time import between_recordings

_MAX_ROWS = 200
"""Largest number of rows of a table."""
_UNKNOWN = "–"
_TIME = "time, UTC"
_OF_CHANNEL = {
    "rms_m_s2": "#RMS, m/s²",
    "peak_m_s2": "#peak, m/s²",
    "spikes": "#spikes",
    "stuck_s": "#stuck, s",
    "clipped_samples": "#clipped samples",
    "noise_floor": "#noise, m/s²/√Hz",
}
"""Key of a channel's quality -> heading of its column. [names]"""
_UNITS = {"temperature": "degC", "level": "m"}
"""Units of the covariates that are not named in the site file. [units; definition]"""


@dataclass(frozen=True, slots=True)
class Live:
    """How a running monitor is."""

    says: str
    """In a word."""
    age_s: float | None
    """Age of the latest data when the monitor told it last."""
    since_ns: int | None
    """Time of the data at which the state began; None where it is that of the run's first window."""
    facts: tuple[tuple[str, str], ...]
    stream: str
    """How the source is, and what came of the samples."""
    sensors: tuple[tuple[str, ...], ...]
    """Rows of the table of the channels, as `period_notes.SENSORS` names them."""


@dataclass(frozen=True, eq=False, slots=True)
class Period:
    """Content of the page."""

    name: str
    results: PeriodResults
    course: Course
    """The windows and all alarm episodes, those included that a higher alarm of another story hid in the lines."""
    assessment: Assessment
    known: Known
    quality: Quality | None = None
    findings: Sequence[Mapping[str, Any]] = ()
    decisions: Sequence[Decision] = ()
    events: Sequence[Event] = ()
    event_alarms: Sequence[EventAlarm] = ()
    """Of these events, and of earlier ones those that nobody has acknowledged."""
    thresholds: Mapping[str, float] = field(default_factory=dict)
    """`alarm_loss`, `min_loss`, `false_announcements_per_year`; empty where the run did not record them."""
    learned: Mapping[str, LearnedRange] = field(default_factory=dict)
    """Range of each covariate at calibration."""
    contact: str = ""
    """Whom to call, as `[site] contact` says."""
    baseline_hz: Mapping[int, float] = field(default_factory=dict)
    """Natural frequency at calibration, Hz, of modes by their number."""
    conditions: Mapping[int, str] = field(default_factory=dict)
    """Condition of the alarm of a story at the end, `core.AlarmCondition` in words."""
    pages: Mapping[str, Path] = field(default_factory=dict)
    """Place of the page of each event, which may be there."""
    live: Live | None = None
    """How the monitor is, where it runs."""

    @property
    def alarms(self) -> int:
        """Number of alarms, those of events among them."""
        return len(self.course.losses) + len(self.event_alarms)


def read_period(folder: Path, from_ns: int | None, to_ns: int | None) -> Period:
    """Read the records of a period (UTC; by default the run) that a replay or the daemon left in a folder.

    Raises MissingInputError or BadInputError where there are no results, or none of that period.
    """
    with _name_file_in_errors(folder / "summary.json"):
        summary = notes.read_summary(folder)
        known, between = known_of(summary), between_recordings(summary.get("recorded", ()))
        window_s = float(summary.get("window_s", 0.0))
    results = read_results(folder, from_ns, to_ns, known, between, window_s)
    start, stop = results.grid.from_ns, results.grid.to_ns
    with _name_file_in_errors(folder / "health.jsonl"):
        health = notes.HealthFile(folder, start, stop)
    with _name_file_in_errors(folder / "summary.json"):
        quality = health.quality() or notes.summary_quality(summary)
        losses = results.course.losses
        losses = (*losses, *hidden_losses(losses, summary, start, stop))
        course = replace(results.course, losses=tuple(sorted(losses, key=lambda loss: loss.t_first_ns)))
        told = told_in(summary)
        events = notes.read_events(folder)
        began_ns = {event.id: event.begin_ns for event in events}
        alarms = [a for a in notes.event_alarms(summary) if began_ns.get(a.id, start) <= stop]
        alarms = [a for a in alarms if a.unacknowledged or began_ns.get(a.id, start) > start]
        events = [event for event in events if start < event.begin_ns <= stop]
    with _name_file_in_errors(folder / "ledger.jsonl"):
        decisions = [d for d in notes.read_decisions(folder, health, known.n_modes or 0) if start < d.t_ns <= stop]
    with _name_file_in_errors(folder / "findings"):
        findings = notes.read_findings(folder, start, stop)
    if not known.names:  # the summary does not tell
        known = replace(known, names=tuple(f"story {j + 1}" for j in range(len(results.ddi))))
        known = replace(known, has_baseline=not results.no_baseline)
    with _name_file_in_errors(folder / "results.jsonl"):
        exceeded = [alarm.says for alarm in alarms if alarm.unacknowledged]
        assessment = assess(course, known, findings, exceeded=exceeded, whole=True)
    pages = {event.id: folder / "events" / f"{event.id}.html" for event in events}
    return Period(
        folder.resolve().name, results, course, assessment, known, quality, events=events, event_alarms=alarms,
        pages=pages, findings=findings, decisions=decisions, **told,
    )  # fmt: skip


def told_in(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Read from the summary what the page shows as it stands there, by the fields of a `Period`."""
    present = (summary.get("alarm") or {}).get("conditions") or {}
    return {
        "thresholds": {str(name): float(value) for name, value in summary.get("thresholds", {}).items()},
        "learned": {str(n): LearnedRange(**r) for n, r in (summary.get("covariates_learned") or {}).items()},
        "contact": str(summary.get("contact", "")),
        "baseline_hz": {int(k): float(hz) for k, hz in summary.get("baseline_frequencies_hz", {}).items()},
        "conditions": {int(story): str(says) for story, says in present.items()},
    }


def known_of(summary: Mapping[str, Any]) -> Known:
    """Read from the summary what the state depends on and no window changes; defaults where it does not tell."""
    content: dict[str, Any] = {"names": (), "has_baseline": True, "alarm_loss": 0.1, "misfit": 5.0}
    content |= summary.get("known", {})
    return TypeAdapter(Known).validate_python(content)


@contextmanager
def _name_file_in_errors(path: Path) -> Iterator[None]:
    """Turn errors in the content of a file into a BadInputError that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise BadInputError(f"{path}: not as the monitor writes it ({error!r}); move it away and ask again") from error


def hidden_losses(known: Sequence[Loss], summary: Mapping[str, Any], start: int, stop: int) -> list[Loss]:
    """List from the summary the alarms that the lines do not show, since another story had a higher alarm."""
    out = []
    for a in summary.get("alarms", ()):
        last, modal = a["t_last_ns"], bool(a.get("part"))
        story, size, std = ("part", "change", "change_std") if "part" in a else ("story", "ddi", "ddi_std")
        story = "index" if "index" in a else story
        loss = Loss(
            Level(a["level"]), a[story] or WHOLE, a[size], a[std], a.get("loss_n_per_m"), a["t_first_ns"], last, modal,
            a.get("t_level_ns"),
        )  # fmt: skip
        same = [k for k in known if k.story == loss.story and (last is None or k.t_first_ns <= last)]
        same = [k for k in same if k.t_last_ns is None or k.t_last_ns >= loss.t_first_ns]
        if loss.t_first_ns <= stop and (last is None or last > start) and not same:
            out.append(loss)
    return out


def write_period(path: Path, period: Period) -> None:
    """Write the report; the file appears under its name only when complete."""
    sheet(period, path.parent).write(path)


def sheet(period: Period, beside: Path | None = None) -> Sheet:
    """Make the page, which leads to the pages of events that are there if it lies in the folder `beside`."""
    said, span = period.assessment, _span(period)
    page = Sheet(f"{period.name}: {span}", period.name, said.state.value, said.state.words, headline=said.headline)
    _head(page, period)
    for part in (_where, _trust, _losses, _modes, _covariates, _alarms, _findings):
        part(page, period)
    _events(page, period, beside)
    _sensors(page, period)
    return page


def _span(period: Period) -> str:
    return f"{utc(period.results.grid.from_ns)} to {utc(period.results.grid.to_ns)} UTC"


def _name(part: int, period: Period) -> str:
    if part == WHOLE:
        return period.known.parts.every
    return story_name(part, period.known.names)


def _standing(period: Period) -> list[Loss]:
    """List the alarms that last, the gravest first, each with the level that it has now where the page is live."""
    now = period.course.judged.active if period.live is not None and period.course.judged is not None else {}
    lasting = (replace(a, level=now.get(a.story, a.level)) for a in period.course.losses if a.t_last_ns is None)
    return sorted(lasting, key=lambda a: (-a.level.rank, _name(a.story, period) in ALONE, -abs(a.ddi)))


def _since(alarm: Loss) -> int:
    """Return since when an alarm has been at its level, UTC in ns."""
    return alarm.t_level_ns or alarm.t_first_ns


def _head(page: Sheet, period: Period) -> None:
    """Say since when, how old the data are, what to do, and whom to call."""
    state, live = period.assessment.state, period.live
    standing = [a for a in _standing(period) if a.level.value == state.value]
    since_ns = min(map(_since, standing), default=None if live is None else live.since_ns)
    page.since = "" if since_ns is None else f"since {utc(since_ns)} UTC"
    if live is None:
        page.lead.append(("Data:", _span(period)))
    else:
        page.live = live.says
        when = "before the monitor fell silent" if live.says == "silent" else "ago"
        age = "no data yet" if live.age_s is None else f"the last came {_length(live.age_s)} {when}"
        until = f"until {utc(period.results.grid.to_ns)} UTC; " if period.course.windows else ""
        page.lead.append(("Data:", f"{until}{age}."))
    events = [a for a in period.event_alarms if a.unacknowledged]
    of_features = bool(period.known.relative)  # which are no places, and of no site with a daemon
    places = [_name(a.story, period) for a in standing if a.story != WHOLE and not of_features]
    of = {} if live is None else period.conditions  # those of now, not of the end of a period
    over = [story for story, says in of.items() if says == AlarmCondition.RETURNED_UNACKNOWLEDGED]
    page.lead.append(("What to do:", advice(state, places, [_name(story, period) for story in over])))
    if (state.rank > State.NOT_JUDGED.rank and not of_features) or period.contact:
        page.lead.append(("Call:", period.contact or "nobody is named; the site file may, as [site] contact."))
    seen = {
        story
        for story, says in period.conditions.items()
        if says in (AlarmCondition.ACKNOWLEDGED, AlarmCondition.LATCHED_ACKNOWLEDGED, AlarmCondition.SHELVED)
    }
    waiting = [a.story for a in standing if a.story not in seen] if state.rank >= State.WARNING.rank else []
    asked = [f"--story {story}" for story in waiting] + [f"--event {a.id}" for a in events]
    asked += [f"--story {story}" for story in over]
    if asked and not of_features:
        page.lead.append(("Acknowledge:", f"shm-monitor ack SITE.toml {asked[0]} --who NAME"))


def _length(seconds: float) -> str:
    if seconds < 5400.0:
        return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h" if seconds < 172_800.0 else f"{seconds / 86400.0:.1f} days"


def _where(page: Sheet, period: Period) -> None:
    """Tabulate the stories or modes with what they lost, the affected first."""
    r, judged = period.results, period.known.has_baseline
    page.section("Where, and how much", "where")
    page.items(f"Event {a.id}: {'; '.join(a.exceeded)}" for a in period.event_alarms if a.unacknowledged)
    standing = {a.story: a for a in reversed(_standing(period))}
    if (every := standing.get(WHOLE)) is not None:
        name = period.known.parts.every.capitalize()
        page.text(f"{name}: {every.level.value} since {utc(_since(every))} UTC.")
    rows, cells = [], []
    for j, c in enumerate(r.ddi or r.changes, 1):
        alarm, (seen, says) = standing.get(j), _sight(j, period)
        state = alarm.level.value if alarm else "normal" if judged and seen else "not judged"
        scale, _ = _unit(j, period)
        size = with_interval(scale * c.latest, scale * c.latest_half) if c.values else _UNKNOWN
        cells.append((state.replace(" ", "_"), size if state != "not judged" else state))
        rank = (-alarm.level.rank, -abs(c.latest)) if alarm else (0, 0.0)
        rows.append((rank, j, (_name(j, period), state, size, utc(_since(alarm)) if alarm else "", says)))
    says = f"stiffness lost {'since the baseline' if judged else 'against the structure file'}, %"
    page.elevation(f"{says}, by storey and direction", period.known.names, cells, {})
    what = "#stiffness lost, %" if judged else "#lost against the structure file, %"
    head = ["story", "state", what, "@since, UTC", "what would be seen"]
    change = "#change, %" if all(period.known.relative) else "#change (where % is not said, in its unit)"
    head = head if r.ddi else [period.known.parts.part, "state", change, "@since, UTC"]
    page.table(head, [row[: len(head)] for _, _, row in sorted(rows)], most=_MAX_ROWS)
    page.note("Latest value with two standard deviations, about 95 %." if rows else "No window has been judged.")


def _trust(page: Sheet, period: Period) -> None:
    """Say what is doubtful and what is not judged; availability and goodness of fit."""
    r, q = period.results, period.quality
    page.section("Can it be trusted", "trust")
    page.items(period.assessment.doubts, "doubts")
    shown = []
    if q is not None and q.table["availability"] is not None:
        shown.append((f"{100 * q.table['availability']:.2f} %", "of the samples due came"))
    if period.live is None:
        apart = ", the time between recordings apart" if r.between else ""
        evaluated = f"of {r.due} windows due were evaluated, one every {r.hop_s:g} s{apart}"
        shown.append((f"{100 * sum(r.judged) / r.due:.1f} %", evaluated))
    else:
        shown.append((f"{period.course.windows}", f"windows, {period.course.skipped} of them not judged"))
        shown += period.live.facts
    if period.known.has_baseline or period.alarms:
        shown.append((f"{period.alarms}", "alarm" if period.alarms == 1 else "alarms"))
    page.figures(shown)
    reasons = r.course.skip_reasons or period.course.skip_reasons
    rows = [(Skipped(why).mend, str(n)) for why, n in sorted(reasons.items(), key=lambda item: -item[1])]
    missing = 0 if period.live else r.due - r.course.windows
    none = "no row in the table" if period.known.relative else "no data, or the monitor did not run"
    rows += [(none, str(missing))] if missing > 0 else []
    rows += [("a line of results.jsonl that cannot be read", str(r.damaged))] if r.damaged else []
    page.table(["windows that say nothing, and why", "#windows"], rows, most=_MAX_ROWS)
    title = "Goodness of fit (1: a change of stiffness explains what is seen)"
    page.draw(_coverage(r), *([] if r.misfit is None else [_curve(period, title, r.misfit)]))


def _coverage(r: PeriodResults) -> Chart:
    """Draw where windows were evaluated, where they were skipped, and where there are none."""
    chart = _over_time(r.grid, "Windows: blue judged, orange not, blank none", (0.0, 1.0), 26.0)
    places = r.grid.share(r.grid.edges_ns)
    kinds, start = ["used" if j and not s else "off" if s else "" for j, s in zip(r.judged, r.refused, strict=True)], 0
    for kind, run in groupby(kinds):
        stop = start + len(list(run))
        if kind:
            chart.shade((float(places[start]), float(places[stop])), kind)
        start = stop
    return chart


def _over_time(grid: Grid, title: str, y: tuple[float, float], height: float = 110.0, note: str = "") -> Chart:
    """Make an empty chart over a grid's time, with a margin above and below the range of values."""
    margin = 0.06 * (y[1] - y[0]) or 0.01 * abs(y[1]) or 1.0
    range_y = (y[0] - margin, y[1] + margin) if height > 40.0 else y
    chart = Chart(title, (0.0, 1.0), range_y, height, x_title=_TIME, note=note, stretches=grid.places())
    for gap in grid.gaps:
        begin, end = grid.share(np.array(gap, dtype=float))
        chart.shade((float(begin), float(end)), "cut")
    return chart


def _curve(
    period: Period,
    title: str,
    curve: Curve,
    levels: Sequence[tuple[float, str]] = (),
    *,
    scale: float = 1.0,
    y: tuple[float, float] | None = None,
    parts: Sequence[int] = (),
    says: str = "",
) -> Chart:
    """Draw a curve's mean in its band, on the scale `y` if it is given, over the alarms of `parts`, with level lines."""
    grid, (t_ns, (low, mean, high)) = period.results.grid, curve.drawn()
    extent = [*(value for value, _ in levels), *(scale * value for value in curve.range)]
    latest = f"latest {with_interval(scale * curve.latest, scale * curve.latest_half, 4)}"
    chart = _over_time(grid, title, y or (min(extent), max(extent)), note="; ".join(filter(None, (latest, says))))
    for a in period.course.losses:
        if a.story in parts:
            last_ns = grid.to_ns if a.t_last_ns is None else a.t_last_ns
            begin, end = grid.share(np.array([a.t_first_ns, last_ns], dtype=float)).tolist()
            chart.shade((begin, end), "still" if a.level == "alarm" else "off")
    for value, kind in levels:
        chart.level(value, kind)
    return chart.line(grid.share(t_ns), scale * mean, "after", scale * low, scale * high)


def _losses(page: Sheet, period: Period) -> None:
    """Draw the loss of every story, or the change of every mode, on one scale, with alarms, threshold and the baseline."""
    r, judged = period.results, period.known.has_baseline
    curves = [(j, c) for j, c in enumerate(r.ddi or r.changes, 1) if c.values]
    if not curves:
        return
    alarm_loss = period.thresholds.get("alarm_loss")
    if r.ddi:
        limit = 100 * alarm_loss if judged and alarm_loss is not None else None
        page.section(f"Stiffness lost {'since the baseline' if judged else 'against the structure file'}", "loss")
        title, shapes = "stiffness lost", 0
    else:
        features, shapes = bool(period.known.relative), period.known.n_modes or 0
        limit = None if features else -50 * (period.known.alarm_loss if alarm_loss is None else alarm_loss)
        what, since = ("features", "healthy time") if features else ("modes", "baseline")
        page.section(f"Change of the {what} since the {since}", "loss")
        title = f"{'change' if features else 'frequency'} since the {since}, less what covariates explain"
    levels = [(0.0, "before dashed"), *([] if limit is None else [(limit, "limit dashed")])]
    scales = {j: _unit(j, period) for j, _ in curves}
    reach = [scales[j][0] * end for j, c in curves for end in c.range]
    y = min(*reach, -0.1, limit or 0.0), max(*reach, 0.1, limit or 0.0)
    charts = []
    for j, c in curves:
        (seen, says), parts = _sight(j, period) if r.ddi else (True, ""), {j, j + shapes, WHOLE}
        parts |= {len(curves) + 1} if period.known.relative else set()
        scale, unit = scales[j]
        of = f"{_name(j, period)}: {title}{unit}"
        chart = _curve(period, of, c, levels, scale=scale, y=y if unit else None, parts=[*parts], says=says)
        chart.kind = "" if seen or any(a.story in parts for a in period.course.losses) else "unseen"
        charts.append(chart)
    page.draw(*charts)
    fall = "Shaded where frequency or shape was announced as changed; dashed red: a confirmed fall of this size is an alarm."
    if period.known.relative:
        fall = "Shaded where a change was announced; each value is the mean of the latest readings that tells most, or of 8."
    how = _thresholds(period.thresholds) if judged else "Without a baseline this is no damage index."
    page.note(f"{how if r.ddi else fall} {_legend(r.grid)}")
    stiffness = enumerate(r.stiffness, 1)
    more = [_curve(period, f"{_name(j, period)}: stiffness, N/m", c) for j, c in stiffness if c.values]
    page.draw(*more, more="Stiffness in N/m")
    sigma = "each reading less what covariates explain, in healthy standard deviations"
    each = [_curve(period, f"{_name(j, period)}: {sigma}", c) for j, c in enumerate(r.residuals, 1) if c.values]
    page.draw(*each, more="Each reading, in healthy standard deviations")


def _unit(part: int, period: Period) -> tuple[float, str]:
    """Return the factor with which a loss or change is drawn, and its unit as a title ends with."""
    return (1.0, "") if period.known.relative and not period.known.relative[part - 1] else (100.0, ", %")


def _legend(grid: Grid) -> str:
    """Say what the curves are, and which gaps the charts shorten."""
    says = (
        "Line: mean in each step of time; band: least to greatest value, with two standard deviations. Orange dashes: the "
        "baseline. Times are those of the windows' ends, by the data."
    )
    if not grid.gaps:
        return says
    said = [f"{utc(a)} to {utc(b)}" for a, b in grid.gaps[:3]]
    said += [f"{len(grid.gaps) - 3} more"] if len(grid.gaps) > 3 else []
    return f"{says} Grey: times without data, which the charts shorten ({'; '.join(said)})."


def _sight(story: int, period: Period) -> tuple[bool, str]:
    """Tell whether a loss of the alarm's size would have been seen in a story, and from which loss on it would."""
    known, window = period.known, period.course.judged
    if not known.has_baseline or known.relative:
        return True, "" if known.relative else "not judged"
    detectable = None if window is None else window.detectable
    if story in known.unwatched:
        return False, "NOT WATCHED"
    if detectable is None:
        return False, "not known which loss would be seen"
    loss = detectable[story - 1] if story <= len(detectable) else None
    if loss is None or loss >= 1.0:
        return False, "NOT SEEN: the modes say next to nothing of it"
    if not is_seen(loss, known.alarm_loss):
        return False, f"only a loss above {100 * loss:.2g} % would be seen"
    return True, f"a loss above {100 * loss:.2g} % would be seen"


def _thresholds(thresholds: Mapping[str, float]) -> str:
    """Describe the thresholds in words."""
    shades = "Shaded from the first announcement on; orange: advisory or warning; red: what became an alarm."
    if not {"alarm_loss", "min_loss", "false_announcements_per_year"} <= thresholds.keys():
        return f"{shades} The run did not note its thresholds."
    return (
        f"{shades} Announced with {thresholds['false_announcements_per_year']:g} false announcements a year allowed, "
        f"from a loss of {100 * thresholds['min_loss']:g} % on; dashed red: a confirmed loss of "
        f"{100 * thresholds['alarm_loss']:g} % is an alarm."
    )


def _alarms(page: Sheet, period: Period) -> None:
    """Tabulate every alarm with the verdict of its diagnosis and the actions of the operators."""
    page.section("Alarms", "alarms")
    if not period.alarms:
        page.text("None." if period.known.has_baseline else "Without a baseline none can be raised.")
        return
    rows = []
    for i, e in enumerate(period.course.losses):
        later = (n.t_first_ns for n in period.course.losses[i + 1 :] if n.story == e.story)
        asked = notes.requests_for(e, period.decisions, next(later, float("inf")))
        present = period.conditions.get(e.story, "") if e.t_last_ns is None else ""
        actions = "; ".join(f"{d.action} by {d.who}, {utc(d.t_ns)}" for d in asked) or present
        actions = actions or ("nobody yet" if period.live is None else _UNKNOWN)
        ended = "lasts" if e.t_last_ns is None else utc(e.t_last_ns)
        diagnosis = diagnosis_of(e, period.findings, period.known.names) or (
            "needs a model" if e.modal else "not diagnosed"
        )
        where, size = _name(e.story, period), f"{100 * e.ddi:.2f} ± {200 * e.ddi_std:.2f} %"
        size = (
            period.known.parts.size(e.story, e.ddi, e.ddi_std) if period.known.relative and where not in ALONE else size
        )
        size = _UNKNOWN if where in ALONE else size  # which changes by no size
        rows.append((e.level, where, utc(e.t_first_ns), ended, size, diagnosis, actions))
    began = {event.id: utc(event.begin_ns) for event in period.events}
    for alarm in period.event_alarms:
        seen = "nobody yet" if alarm.unacknowledged else f"by {alarm.acknowledged_by}"
        lasts = "lasts" if alarm.unacknowledged else _UNKNOWN
        what = f"event {alarm.id}: {'; '.join(alarm.exceeded)}"
        rows.append((Level.ALARM, what, began.get(alarm.id, _UNKNOWN), lasts, _UNKNOWN, "a limit of the site", seen))
    size = "#stiffness lost" if period.known.n_modes is None else "#change"
    head = ["level", "where", "@from, UTC", "@to, UTC", size, "diagnosis", "acknowledged"]
    head = head[:-2] if period.known.relative else head
    page.table(head, [row[: len(head)] for row in rows[::-1]], most=_MAX_ROWS)


def _events(page: Sheet, period: Period, beside: Path | None) -> None:
    """Tabulate the strong motions of the whole structure, with their pages; nothing where there was none."""
    if not period.events:
        return
    page.section("Events: strong motion", "events")
    rows = []
    for e in reversed(period.events):
        place = period.pages.get(e.id)
        there = beside is not None and place is not None and place.is_file()
        named = Link(e.id, quote(relpath(str(place), beside))) if there else e.id
        rows.append((named, utc(e.begin_ns), utc(e.end_ns), event_text(e, period.known.names), e.note))
    page.table(["@event", "@from, UTC", "@to, UTC", "what it was", "note"], rows, most=_MAX_ROWS)
    page.note("The page of an event is written by: shm-monitor report DIR --event ID")


def _modes(page: Sheet, period: Period) -> None:
    """Draw the frequencies with those of the baseline, and tabulate frequency and damping."""
    r, modal = period.results, period.known.n_modes is not None
    curves = r.common_modes()
    if not curves:
        return
    page.section("Natural frequencies", "modes")
    other = "another mode" if modal else "another mode, compared with none of the model"
    charts, rows = [], []
    for c in curves:
        name, hz = f"mode {c.mode}" if c.mode is not None else other, period.baseline_hz.get(c.mode or 0)
        charts.append(_curve(period, f"{name}: frequency, Hz", c, [] if hz is None else [(hz, "before dashed")]))
        value, std = c.damping or (None, None)
        damping = _UNKNOWN if value is None else with_interval(100 * value, 200 * (std or 0.0))
        at_baseline = _UNKNOWN if hz is None else f"{hz:.4g}"
        rows.append((name, with_interval(c.latest, c.latest_half, 4), at_baseline, damping))
    page.draw(*charts)
    page.table(["mode, latest", "#frequency, Hz", "#at the baseline, Hz", "#damping, %"], rows)


def _covariates(page: Sheet, period: Period) -> None:
    """Draw level of motion and weather, with the range that calibration learned from and where the latest value lies in it."""
    rows, charts = [], []
    for name, curve in sorted(period.results.covariates.items()):
        (low, high), learned = curve.range, period.learned.get(name)
        unit = learned.unit if learned is not None else _UNITS.get(name, "")
        extent = f"{low:.3g}", f"{high:.3g}", f"{curve.latest:.3g}"
        known = (_UNKNOWN, _UNKNOWN) if learned is None else (f"{learned.low:.3g}", f"{learned.high:.3g}")
        rows.append((name, unit, *known, *extent, _place(curve.latest, learned, period)))
        charts.append(_curve(period, f"{name}, {unit}".rstrip(", "), curve))
    if rows:
        page.section("Level of motion and weather", "covariates")
        head = ["covariate", "unit", "#learned from", "#to", "#here from", "#to", "#latest", "the latest lies"]
        page.table(head, rows)
        page.draw(*charts)


def _place(value: float, learned: LearnedRange | None, period: Period) -> str:
    """Say where a value lies in the range that calibration learned from."""
    if learned is None:
        return "not learned"
    what = (
        "features are"
        if period.known.relative
        else "stiffness is"
        if period.known.n_modes is None
        else "frequencies are"
    )
    if value < learned.low:
        return f"below it: {what} compared by extrapolation"
    return f"above it: {what} compared by extrapolation" if value > learned.high else "within it"


def _sensors(page: Sheet, period: Period) -> None:
    """Tabulate the sensors' quality and the clocks; of features none is known."""
    q = period.quality
    if period.known.relative:
        return
    page.section("Sensors", "sensors")
    if period.live is not None:
        page.note(period.live.stream)
        page.table(notes.SENSORS, period.live.sensors)
        return
    if q is None:
        page.note("No record of the sensors' quality in this period.")
        return
    page.note(f"From {q.says}.")
    t, came = q.table, q.table["availability"]
    stream = [("samples that came", "not known" if came is None else f"{100 * came:.3f} %"), ("gaps", str(t["gaps"]))]
    stream += [("lost, s", f"{t['lost_s']:.6g}"), ("samples dropped (repeated, late, not finite)", str(t["overlaps"]))]
    page.table([], stream)
    channels = t["channels"].items()
    keys = [key for key in _OF_CHANNEL if any(c.get(key) is not None for _, c in channels)]  # a replay knows no peaks
    rows = [(name, *(_known(c.get(key)) for key in keys)) for name, c in channels]
    page.table(["channel", *(_OF_CHANNEL[key] for key in keys)], rows)
    clocks = [(node, f"{1e3 * offset:.3g}", f"{drift:.3g}") for node, offset, drift in q.clocks]
    page.table(["clock", "#largest offset, ms", "#drift, ppm"], clocks)


def _known(value: float | None) -> str:
    """Write a number, or a dash where it is not known."""
    return _UNKNOWN if value is None else str(value) if isinstance(value, int) else f"{value:.4g}"


def _findings(page: Sheet, period: Period) -> None:
    """Tabulate the diagnoses and all decisions of people; of features there are none."""
    if period.known.relative:
        return
    page.section("Findings: what explains a change", "findings")
    rows = [
        (str(f.get("id", "")), utc(f["t_ns"]), f.get("reason") or "",
         f.get("verdict") or "failed", f.get("says") or f.get("error") or "")
        for f in period.findings
    ]  # fmt: skip
    if not rows:
        page.text("No diagnosis so far. One is made when an alarm or a doubt asks for it.")
    page.table(["no.", "@data until, UTC", "asked because", "verdict", "says"], rows, most=_MAX_ROWS)
    if period.decisions:
        page.section("Ledger", "ledger")
        lines = [(utc(d.t_ns), d.who, d.what) for d in period.decisions]
        page.table(["@when, UTC", "who", "what"], lines, most=_MAX_ROWS)
