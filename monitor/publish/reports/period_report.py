"""Report of a period as one HTML page that needs no network and can be printed: health, trust in the results, decisions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from monitor.core import WHOLE, BadInputError, Level, Skipped, write_atomically
from monitor.damage import Assessment, Course, Known, LearnedRange, Loss, assess, diagnosis_of, is_seen
from monitor.events import Event, EventAlarm
from monitor.publish.reports import period_notes as notes
from monitor.publish.reports.page import document, doubts, figures, rest, table, verdict
from monitor.publish.reports.period_data import Envelope, Grid, PeriodResults, read_results, utc
from monitor.publish.reports.period_notes import Decision, Quality
from monitor.publish.reports.time_charts import TIME, TimeAxes, draw_envelope, panel, time_axes
from monitor.publish.results.event_lines import event_text
from monitor.publish.results.recorded_time import between_recordings

_MAX_ROWS = 200
"""Largest number of rows of a table."""
_UNKNOWN = "–"
_UNITS = {"temperature": "degC", "level": "m"}
"""Units of the covariates that are not named in the site file. [units; definition]"""


@dataclass(frozen=True, eq=False, slots=True)
class Period:
    """Content of the page."""

    name: str
    results: PeriodResults
    quality: Quality | None
    course: Course
    """The windows and all alarm episodes, those included that a higher alarm of another story hid in the lines."""
    assessment: Assessment
    known: Known
    findings: list[dict[str, Any]]
    decisions: list[Decision]
    thresholds: Mapping[str, float]
    """`alarm_loss`, `min_loss`, `significance`; empty where the run did not record them."""
    learned: Mapping[str, LearnedRange] = field(default_factory=dict)
    """Range of each covariate at calibration."""
    events: list[Event] = field(default_factory=list)
    event_alarms: list[EventAlarm] = field(default_factory=list)
    """Of these events, and of earlier ones those that nobody has acknowledged."""

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
        known, between = _known_of(summary), between_recordings(summary.get("recorded", ()))
        window_s = float(summary.get("window_s", 0.0))
    results = read_results(folder, from_ns, to_ns, known, between, window_s)
    start, stop = results.grid.from_ns, results.grid.to_ns
    with _name_file_in_errors(folder / "health.jsonl"):
        health = notes.HealthFile(folder, start, stop)
    with _name_file_in_errors(folder / "summary.json"):
        quality = health.quality() or notes.summary_quality(summary)
        losses = results.course.losses
        losses = (*losses, *_hidden_losses(losses, summary, start, stop))
        course = replace(results.course, losses=tuple(sorted(losses, key=lambda loss: loss.t_first_ns)))
        thresholds = {str(name): float(value) for name, value in summary.get("thresholds", {}).items()}
        learned = {str(n): LearnedRange(**r) for n, r in summary.get("covariates_learned", {}).items()}
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
    name = folder.resolve().name
    return Period(
        name, results, quality, course, assessment, known, findings, decisions, thresholds, learned, events, alarms
    )


def _known_of(summary: Mapping[str, Any]) -> Known:
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


def _hidden_losses(known: Sequence[Loss], summary: Mapping[str, Any], start: int, stop: int) -> list[Loss]:
    """List from the summary the alarms that the lines do not show, since another story had a higher alarm."""
    out = []
    for a in summary.get("alarms", ()):
        last, modal = a["t_last_ns"], bool(a.get("part"))
        story, size, std = ("part", "change", "change_std") if "part" in a else ("story", "ddi", "ddi_std")
        loss = Loss(
            Level(a["level"]), a[story] or WHOLE, a[size], a[std], a.get("loss_n_per_m"), a["t_first_ns"], last, modal
        )
        same = [k for k in known if k.story == loss.story and (last is None or k.t_first_ns <= last)]
        same = [k for k in same if k.t_last_ns is None or k.t_last_ns >= loss.t_first_ns]
        if loss.t_first_ns <= stop and (last is None or last > start) and not same:
            out.append(loss)
    return out


def write_period(path: Path, period: Period) -> None:
    """Write the page; the file appears under its name only when complete."""
    write_atomically(path, page(period))


def page(period: Period) -> str:
    """Write the page, which is well-formed XML as well."""
    sections = (_head, _damage, _changes, _alarms, _events, _modes, _covariates, _trust, _findings)
    return document(f"{period.name}: {_span(period)}", [section(period) for section in sections])


def _span(period: Period) -> str:
    return f"{utc(period.results.grid.from_ns)} to {utc(period.results.grid.to_ns)} UTC"


def _story(story: int, period: Period) -> str:
    if story == WHOLE:
        return period.known.parts.every
    return period.known.names[story - 1] if story <= len(period.known.names) else f"story {story}"


def _head(period: Period) -> str:
    """Write the verdict, the span and the key figures."""
    r, said = period.results, period.assessment
    apart = ", the time between recordings apart" if r.between else ""
    evaluated = f"of {r.due} windows due were evaluated, one every {r.hop_s:g} s{apart}"
    shown = [(f"{100 * sum(r.judged) / r.due:.1f} %", evaluated)]
    if period.known.has_baseline or period.alarms:
        shown.append((f"{period.alarms}", "alarm" if period.alarms == 1 else "alarms"))
    if period.quality is not None and period.quality.availability is not None:
        shown.insert(0, (f"{100 * period.quality.availability:.2f} %", "of the samples due came"))
    if r.ddi and period.known.has_baseline:
        seen = ((j, c.latest) for j, c in enumerate(r.ddi, 1) if _sight(j, period)[0])
        latest = [(f"{100 * loss:.2f} %", f"{_story(j, period)}, latest") for j, loss in seen]
        shown += latest if len(latest) <= 4 else [max(latest, key=lambda f: float(f[0].split()[0]))]
    shown += [(f"{100 * c.latest:+.2f} %", f"mode {k}, latest") for k, c in enumerate(r.changes[:4], 1) if c.values]
    return (
        f"{verdict(said.state, said.state.words, said.headline)}{doubts(said.doubts)}"
        f'<p class="muted">{escape(period.name)}, {_span(period)}</p>{figures(shown)}'
        '<p class="muted">Shaded: least to greatest value in each step of time, with two standard deviations; line: '
        f"their mean. Times are those of the windows' ends, by the data.{_shortened(r.grid)}</p>"
    )


def _shortened(grid: Grid) -> str:
    """Say which gaps the charts shorten; empty where they shorten none."""
    if not grid.gaps:
        return ""
    said = [f"{utc(a)} to {utc(b)}" for a, b in grid.gaps[:3]]
    said += [f"{len(grid.gaps) - 3} more"] if len(grid.gaps) > 3 else []
    return f" Grey: times without data, which the charts shorten ({'; '.join(said)})."


def _damage(period: Period) -> str:
    """Draw the damage index of every story on one scale, with alarms and threshold."""
    if not period.results.ddi:
        return ""
    judged, r = period.known.has_baseline, period.results
    limit = period.thresholds.get("alarm_loss") if judged else None
    curves = [c.envelope() for c in r.ddi]
    low = 100 * min(0.0, *(float(e.low.min()) for e in curves))
    high = 100 * max(limit or 0.0, 0.001, *(float(e.high.max()) for e in curves))
    since = "since the baseline" if judged else "against the structure file"
    out = [f"<h2>{'Damage index' if judged else 'Stiffness'}</h2>"]
    for j, e in enumerate(curves, 1):
        axes = time_axes(r.grid, low, high)
        seen, says = _sight(j, period)
        title = f"{_story(j, period)}: stiffness lost {since}, %; {says}"
        marks = _over_alarms(axes, period, (j, WHOLE), None if limit is None else 100 * limit, e)
        out.append(axes.chart(title, *marks, x_title=TIME, kind="" if seen else " unseen"))
    how = _thresholds(period.thresholds) if judged else "Without a baseline this is no damage index."
    return "".join(out) + f"<p class='muted'>{how}</p>"


def _changes(period: Period) -> str:
    """Draw the change of every mode's frequency on one scale, with alarms and threshold, where there is no model."""
    r = period.results
    if not any(c.values for c in r.changes):
        return ""
    limit = 50 * period.thresholds.get("alarm_loss", period.known.alarm_loss)
    curves = [(k, c.envelope()) for k, c in enumerate(r.changes, 1) if c.values]
    low = 100 * min(-0.001, *(float(e.low.min()) for _, e in curves))
    high = 100 * max(0.001, *(float(e.high.max()) for _, e in curves))
    out = ["<h2>Change of the modes</h2>"]
    for k, e in curves:
        axes = time_axes(r.grid, min(low, -limit), max(high, 0.2 * limit))
        marks = _over_alarms(axes, period, (k, k + (period.known.n_modes or 0), WHOLE), -limit, e)
        title = f"mode {k}: frequency since the baseline, less what covariates explain, %"
        out.append(axes.chart(title, *marks, x_title=TIME))
    says = "Shaded where frequency or shape was announced as changed; dashed red: a confirmed fall of this size is an alarm."
    return "".join(out) + f"<p class='muted'>{says}</p>"


def _sight(story: int, period: Period) -> tuple[bool, str]:
    """Tell whether a loss of the alarm's size would have been seen in a story, and from which loss on it would."""
    known, window = period.known, period.course.judged
    if not known.has_baseline:
        return True, "not judged"
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
    if not {"alarm_loss", "min_loss", "significance"} <= thresholds.keys():
        return f"{shades} The run did not note its thresholds."
    return (
        f"{shades} Announced from {thresholds['significance']:g} standard deviations of the evidence and a loss of "
        f"{100 * thresholds['min_loss']:g} % on; dashed red: a confirmed loss of "
        f"{100 * thresholds['alarm_loss']:g} % is an alarm."
    )


def _over_alarms(axes: TimeAxes, period: Period, parts: tuple[int, ...], limit: float | None, e: Envelope) -> list[str]:
    """Draw an envelope in percent over the alarms of some parts, no change, and the limit of an alarm."""
    start, stop = axes.x
    marks = []
    for a in period.course.losses:
        if a.story in parts:
            last = stop if a.t_last_ns is None else a.t_last_ns * 1e-9
            span = max(start, a.t_first_ns * 1e-9), min(stop, last)
            marks.append(axes.shade(span, "still" if a.level == "alarm" else "off"))
    lines = [(0.0, "before dashed")] + ([] if limit is None else [(limit, "limit dashed")])
    marks += [axes.line(np.array(axes.x), np.full(2, y), kind) for y, kind in lines]
    return marks + draw_envelope(axes, e, 100.0)


def _alarms(period: Period) -> str:
    """Tabulate every alarm with the verdict of its diagnosis and the actions of the operators."""
    if not period.alarms:
        none = "None." if period.known.has_baseline else "Without a baseline none can be raised."
        return f"<h2>Alarms</h2><p>{none}</p>"
    rows = []
    for i, e in enumerate(period.course.losses[:_MAX_ROWS]):
        later = (n.t_first_ns for n in period.course.losses[i + 1 :] if n.story == e.story)
        asked = notes.requests_for(e, period.decisions, next(later, float("inf")))
        actions = "; ".join(f"{d.action} by {d.who}, {utc(d.t_ns)}" for d in asked) or "nobody yet"
        ended = "lasts" if e.t_last_ns is None else utc(e.t_last_ns)
        diagnosis = diagnosis_of(e, period.findings) or ("needs a model" if e.modal else "not diagnosed")
        size = f"{100 * e.ddi:.2f} ± {200 * e.ddi_std:.2f} %"
        rows.append((e.level, _story(e.story, period), utc(e.t_first_ns), ended, size, diagnosis, actions))
    began = {event.id: utc(event.begin_ns) for event in period.events}
    for alarm in period.event_alarms[:_MAX_ROWS]:
        seen = "nobody yet" if alarm.unacknowledged else f"by {alarm.acknowledged_by}"
        lasts = "lasts" if alarm.unacknowledged else _UNKNOWN
        what = f"event {alarm.id}: {'; '.join(alarm.exceeded)}"
        rows.append((Level.ALARM, what, began.get(alarm.id, _UNKNOWN), lasts, _UNKNOWN, "a limit of the site", seen))
    size = "#stiffness lost" if period.known.n_modes is None else "#change"
    head = ["level", "where", "@from, UTC", "@to, UTC", size, "diagnosis", "acknowledged"]
    return "<h2>Alarms</h2>" + table(head, rows) + rest(len(period.course.losses) - _MAX_ROWS, "shown")


def _events(period: Period) -> str:
    """Tabulate the strong motions of the whole structure; nothing where there was none."""
    if not period.events:
        return ""
    rows = [(e.id, utc(e.begin_ns), utc(e.end_ns), event_text(e), e.note) for e in period.events[:_MAX_ROWS]]
    head = ["@event", "@from, UTC", "@to, UTC", "what it was", "note"]
    return "<h2>Events</h2>" + table(head, rows) + rest(len(period.events) - _MAX_ROWS, "shown")


def _modes(period: Period) -> str:
    curves = period.results.common_modes()
    if not curves:
        return ""
    other = "another mode, not of the model" if period.known.n_modes is None else "another mode"
    names = [f"mode {c.mode}" if c.mode is not None else other for c in curves]
    panels = [panel(period.results.grid, c, f"{name}: frequency, Hz") for name, c in zip(names, curves, strict=True)]
    return "<h2>Modes</h2>" + "".join(panels)


def _covariates(period: Period) -> str:
    """Draw level of motion and weather, with the range that calibration learned from and where the latest value lies in it."""
    rows, panels = [], []
    for name, curve in sorted(period.results.covariates.items()):
        e, learned = curve.envelope(), period.learned.get(name)
        unit = learned.unit if learned is not None else _UNITS.get(name, "")
        extent = f"{e.low.min():.3g}", f"{e.high.max():.3g}", f"{curve.latest:.3g}"
        known = (_UNKNOWN, _UNKNOWN) if learned is None else (f"{learned.low:.3g}", f"{learned.high:.3g}")
        rows.append((name, unit, *known, *extent, _place(curve.latest, learned, period)))
        panels.append(panel(period.results.grid, curve, f"{name}, {unit}".rstrip(", ")))
    if not rows:
        return ""
    head = ["covariate", "unit", "#learned from", "#to", "#here from", "#to", "#latest", "the latest lies"]
    return "<h2>Level of motion and weather</h2>" + table(head, rows) + "".join(panels)


def _place(value: float, learned: LearnedRange | None, period: Period) -> str:
    """Say where a value lies in the range that calibration learned from."""
    if learned is None:
        return "not learned"
    what = "stiffness is" if period.known.n_modes is None else "frequencies are"
    if value < learned.low:
        return f"below it: {what} compared by extrapolation"
    return f"above it: {what} compared by extrapolation" if value > learned.high else "within it"


def _trust(period: Period) -> str:
    """Write availability, goodness of fit, sensors and clocks."""
    r, q = period.results, period.quality
    rows = [
        (Skipped(reason).mend, str(n))
        for reason, n in sorted(r.course.skip_reasons.items(), key=lambda item: -item[1])[:_MAX_ROWS]
    ]
    missing = r.due - r.course.windows
    rows += [("no data, or the monitor did not run", str(missing))] if missing > 0 else []
    rows += [("a line of results.jsonl that cannot be read", str(r.damaged))] if r.damaged else []
    out = ["<h2>Can it be trusted</h2>", _coverage_strip(period)]
    out.append(table(["windows that say nothing, and why", "#windows"], rows) if rows else "")
    title = "goodness of fit: squared misfit over its expectation (1: stiffness explains the change)"
    out.append(panel(period.results.grid, r.misfit, title))
    if q is None:
        return "".join([*out, "<p class='muted'>No record of the sensors' quality in this period.</p>"])
    out.append(f"<h2>Sensors</h2><p class='muted'>From {escape(q.says)}.</p>")
    availability = "not known" if q.availability is None else f"{100 * q.availability:.3f} %"
    stream = [("samples that came", availability), ("gaps", str(q.gaps)), ("lost, s", f"{q.lost_s:.6g}")]
    out.append(table([], [*stream, ("samples dropped (repeated, late, not finite)", str(q.overlaps))]))
    head = ["channel", "#RMS, m/s²", "#peak, m/s²", "#spikes", "#stuck, s", "#clipped samples", "#noise, m/s²/√Hz"]
    channels = [
        (c.name, f"{c.rms_m_s2:.4g}", _known(c.peak_m_s2), str(c.spikes), f"{c.stuck_s:g}", f"{c.clipped:.0f}",
         _known(c.noise_floor))
        for c in q.channels
    ]  # fmt: skip
    clocks = [(node, f"{1e3 * offset:.3g}", f"{drift:.3g}") for node, offset, drift in q.clocks]
    known_columns = [i for i in range(len(head)) if any(c[i] != _UNKNOWN for c in channels)]  # a replay knows no peaks
    out.append(table([head[i] for i in known_columns], [[c[i] for i in known_columns] for c in channels]))
    out.append(table(["clock", "#largest offset, ms", "#drift, ppm"], clocks) if clocks else "")
    return "".join(out)


def _known(value: float | None) -> str:
    """Write a number, or a dash where it is not known."""
    return _UNKNOWN if value is None else f"{value:.4g}"


def _coverage_strip(period: Period) -> str:
    """Draw where windows were evaluated, where they were skipped, and where there are none."""
    r = period.results
    axes = time_axes(r.grid, 0.0, 1.0, 26.0)
    edges = r.grid.edges_ns * 1e-9
    kinds = ["used" if j and not s else "off" if s else "" for j, s in zip(r.judged, r.refused, strict=True)]
    marks, start = axes.gap_marks(), 0
    for kind, run in groupby(kinds):
        stop = start + len(list(run))
        if kind:
            marks.append(axes.shade((float(edges[start]), float(edges[stop])), kind))
        start = stop
    title = "windows: blue evaluated, orange skipped in part or whole, blank none"
    return axes.chart(title, *marks, x_title=TIME)


def _findings(period: Period) -> str:
    """Tabulate the diagnoses and all decisions of people."""
    out = []
    if period.findings:
        rows = [
            (str(f.get("id", "")), utc(f["t_ns"]), f.get("reason") or "", f.get("verdict") or "failed",
             f.get("says") or f.get("error") or "")
            for f in period.findings[:_MAX_ROWS]
        ]  # fmt: skip
        out.append("<h2>Findings</h2>" + table(["no.", "@data until, UTC", "asked because", "verdict", "says"], rows))
        out.append(rest(len(period.findings) - _MAX_ROWS, "shown"))
    if period.decisions:
        lines = [(utc(d.t_ns), d.who, d.what) for d in period.decisions[:_MAX_ROWS]]
        out.append(
            "<h2>Ledger</h2>"
            + table(["@when, UTC", "who", "what"], lines)
            + rest(len(period.decisions) - _MAX_ROWS, "shown")
        )
    return "".join(out)
