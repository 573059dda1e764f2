"""Report of one event as an HTML page that needs no network, can be printed and is signed: what happened, what it means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from monitor.core import write_atomically
from monitor.events import POSSIBLY, Event, Review, Site, compared
from monitor.publish.reports import event_charts as charts
from monitor.publish.reports.page import document, doubts, figures, table, verdict
from monitor.publish.reports.period_data import utc
from monitor.publish.results.event_lines import event_text, strongest_floor, with_interval

_UNKNOWN = "–"
_FINAL, _REVISED = 0, 1
_SKEW = "The last column says how far a skew of 1 ms between the two floors' clocks would move it."


@dataclass(frozen=True, eq=False, slots=True)
class EventPage:
    """Content of the page."""

    name: str
    """Name of the site or its structure, or of the folder of the results where they have none."""
    event: Event
    recording: str | None
    """File of the event's samples in that folder."""
    checksum: str | None
    """SHA-256 of this file."""
    site: Site | None
    """What the site's files said; None where the event has no recording."""
    review: Review | None
    """Motion over time; None where the recording does not show it, as `why_not` says in a sentence."""
    why_not: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stories."""
        n = self.event.drift_m.size
        return tuple(f"story {j + 1}" for j in range(n)) if self.site is None else self.site.names


def write_event(path: Path, page: EventPage) -> None:
    """Write the page; the file appears under its name only when complete."""
    write_atomically(path, event_html(page))


def event_html(page: EventPage) -> str:
    """Write the page, which is well-formed XML as well."""
    makers: tuple[Callable[[EventPage], str], ...] = (
        _head, _limits, _stories, _floors, _frequencies, _loss, _loops, _spectrum, _data, _signature,
    )  # fmt: skip
    return document(f"{page.name}: event {page.event.id}", [make(page) for make in makers])


def _head(page: EventPage) -> str:
    """Write the verdict, the event in one sentence, its figures and what limits them."""
    e = page.event
    state, words = _verdict(e)
    length_s = (e.end_ns - e.begin_ns) * 1e-9
    told_in_words = event_text(e).replace("m/s^2", "m/s²")
    of_all = "≥ " if e.cut else ""
    of_drift = ["≥ " if bound else "" for bound in e.is_bound]
    shown = [(f"{of_all}{length_s:.0f} s", "of strong motion")]
    strongest = strongest_floor(e)
    if strongest is not None:
        least = "≥ " if strongest.channel in e.saturated else of_all
        shown.append((f"{least}{strongest.peak_m_s2:.3g} m/s²", f"largest acceleration, at {strongest.channel}"))
    if e.ground is not None:
        shown.append((f"{of_all}{e.ground.peak_m_s2:.3g} m/s²", "largest acceleration of the ground"))
    if np.isfinite(e.drift_m).any():
        j = int(np.nanargmax(e.drift_m))
        shown.append((f"{of_drift[j]}{1e3 * e.drift_m[j]:.3g} mm", f"largest drift, {page.names[j]}"))
    if np.isfinite(e.drift_ratio).any():
        j = int(np.nanargmax(e.drift_ratio))
        shown.append((f"{of_drift[j]}{100 * e.drift_ratio[j]:.2g} %", f"largest drift ratio, {page.names[j]}"))
    if e.instrumental_intensity is not None:
        shown.append((f"{e.instrumental_intensity:.1f}", "intensity by one component, UNOFFICIAL (Wald et al. 1999)"))
    told = {_FINAL: "final line, by the event alone", _REVISED: "revised, by ambient motion after it"}
    limits = (f"{part[:1].upper()}{part[1:]}." for part in filter(None, e.note.split("; ")))
    span = f"{utc(e.begin_ns)} to {utc(e.end_ns)} UTC"
    return (
        f"{verdict(state, words, f'Strong motion of {length_s:.0f} s. {told_in_words}')}{doubts(limits)}"
        f'<p class="muted">{escape(page.name)}, event {escape(e.id)}: {span}; '
        f"{told.get(-1 if e.revision is None else e.revision, 'preliminary')}</p>{figures(shown)}"
    )


def _verdict(event: Event) -> tuple[str, str]:
    """Return the class of the verdict's colour, and the verdict in two words."""
    if event.exceeded:
        possibly = event.verdict is not None and event.verdict.startswith(POSSIBLY)
        return "alarm", "limit possibly exceeded" if possibly else "limit exceeded"
    return ("normal", "within limits") if event.verdict is not None else ("", "no limit judged")


def _limits(page: EventPage) -> str:
    """Tabulate the site's own limits beside the values of the worst story."""
    title = "<h2>Against the site's limits</h2>"
    said = "".join(f"<p><b>{escape(words)}</b></p>" for words in page.event.exceeded)
    if page.site is None:
        return title + (said or "<p>The limits are not in this folder: the event has no recording.</p>")
    rows = []
    for limit in page.site.settings.limits:
        c = compared(page.event, limit)
        largest, where = _UNKNOWN, _UNKNOWN
        if np.isfinite(c.value).any():
            j = int(np.nanargmax(c.value if np.isposinf(c.largest).any() else c.largest))
            least = "at least " if np.isinf(c.largest[j]) else ""
            largest = f"{least}{with_interval(100 * c.value[j], 100 * (c.largest[j] - c.value[j]))} %"
            where = page.names[j]
        undecided = "the interval holds it" if np.isfinite(c.value).all() else "not judged"
        exceeded, within = (c.least > c.limit).any(), (c.largest <= c.limit).all()
        undecided = "POSSIBLY EXCEEDED" if c.possibly.any() else undecided
        outcome = "EXCEEDED" if exceeded else "not exceeded" if within else undecided
        what = "drift ratio" if limit.drift_ratio is not None else "lasting loss of stiffness"
        rows.append((what, f"{100 * c.limit:.3g} %", largest, where, outcome, limit.says))
    if not rows:
        return f"{title}<p>The site file states none ([[events.limits]]), so nothing is judged.</p>"
    head = ["quantity", "#limit", "#largest", "where", "outcome", "beyond it"]
    return title + said + table(head, rows)


def _stories(page: EventPage) -> str:
    """Draw the map of stories, drifts over the height and drifts over time."""
    e, site = page.event, page.site
    limits = () if site is None else site.settings.limits
    of_drift = [limit.drift_ratio for limit in limits if limit.drift_ratio is not None]
    out = ["<h2>Stories</h2>", charts.story_map(e, page.names, limits)]
    if np.isfinite(e.drift_m).any():
        heights = None if site is None else site.heights_m
        out.append(charts.drift_profile(e, page.names, heights, of_drift))
        rows = [
            (name, ("at least " if bound else "") + _with_std(1e3 * drift, 1e3 * std), _number(100 * ratio, 3))
            for name, drift, std, ratio, bound in zip(
                page.names, e.drift_m, e.drift_std_m, e.drift_ratio, e.is_bound, strict=True
            )
        ]
        out.append(table(["story", "#largest drift, mm", "#over the height, %"], rows))
    else:
        out.append("<p>No drift is known.</p>")
    if page.review is not None:
        out.append(charts.drifts_over_time(page.review, page.names))
    return "".join(out)


def _floors(page: EventPage) -> str:
    """Draw the motion of floors and ground over time, and tabulate peaks."""
    out = ["<h2>Motion of the floors</h2>"]
    if page.review is not None:
        out.append(charts.accelerations(page.review, [f.channel for f in page.event.floors]))
        out.append("<p class='muted'>Time from the begin of the event. Shaded: strong motion.</p>")
    else:
        out.append(f"<p>{escape(page.why_not)}</p>")
    motions = [*page.event.floors, *([] if page.event.ground is None else [page.event.ground])]
    least = {f.channel: " (at least)" for f in motions if page.event.cut or f.channel in page.event.saturated}
    rows = [
        (
            f.channel + least.get(f.channel, ""),
            *(_number(v, 3) for v in (f.peak_m_s2, f.rms_m_s2, 1e3 * f.peak_m_s, f.arias_m_s, f.cav_m_s)),
        )
        for f in motions
    ]
    head = ["channel", "#peak, m/s²", "#RMS, m/s²", "#velocity, mm/s", "#Arias, m/s", "#CAV, m/s"]
    return "".join(out) + table(head, rows)


def _frequencies(page: EventPage) -> str:
    """Tabulate the frequencies before, during and after, and draw the first one and its damping over time."""
    e = page.event
    rows = [
        (f"mode {k}", *(_number(v, 4) for v in hz), _number(100 * (hz[2] / hz[0] - 1), 2))
        for k, hz in enumerate(zip(e.before_hz, e.during_hz, e.after_hz, strict=True), 1)
    ]
    head = ["mode", "#before, Hz", "#during, Hz", "#after, Hz", "#after against before, %"]
    out = ["<h2>Frequencies</h2>", table(head, rows)]
    quiet = "of the largest power in the quiet motion after it"
    after = "by windows of ambient motion" if e.revision == _REVISED else quiet
    out.append(f"<p class='muted'>Before: by windows; during: of the largest power; after: {after}.</p>")
    if page.review is not None and page.review.first_mode is not None:
        out.append(charts.first_mode(page.review.first_mode, page.review))
        out.append(
            "<p class='muted'>First mode, stretch by stretch of ten periods, with 95 % intervals: its absolute acceleration "
            "against its displacement and velocity relative to the measured ground. A frequency that falls with the level and "
            "comes back is no damage.</p>"
        )
        if (change := page.review.first_mode.change) is not None:
            value, std, low, high = change
            out.append(
                f"<p>At like levels of motion, {1e3 * low:.2g} to {1e3 * high:.2g} mm, the first frequency after the strongest "
                f"motion was <b>{with_interval(100 * value, 200 * std)} %</b> against before it.</p>"
            )
    return "".join(out)


def _loss(page: EventPage) -> str:
    """Tabulate what remains of the stiffness."""
    e = page.event
    title = "<h2>Lasting loss of stiffness</h2>"
    if not e.loss.size:  # nothing is known of stories
        return ""
    if not np.isfinite(e.loss).any():
        known = e.revision == _REVISED
        hours = "an hour" if page.site is None else f"{page.site.settings.revision_s / 60:.0f} minutes"
        why = e.note if known else f"not known until the revision after {hours} of ambient motion"
        return f"{title}<p>{escape(why[:1].upper() + why[1:])}.</p>"
    rows = [
        (name, _with_std(100 * loss, 100 * std)) for name, loss, std in zip(page.names, e.loss, e.loss_std, strict=True)
    ]
    note = "Stiffness of ambient motion after the event against that before it; with two standard deviations."
    if e.revision != _REVISED:
        note = (
            "By the frequencies of the quiet motion just before the event and just after it, with two standard deviations; the "
            "revision after ambient motion tells it far more closely."
        )
    return f"{title}{table(['story', '#lost, %'], rows)}<p class='muted'>{note}</p>"


def _loops(page: EventPage) -> str:
    """Draw force-drift loops, and tabulate the energy dissipated in each story."""
    r = page.review
    if r is None or r.force_n is None:
        return ""
    rows = [
        (name, _number(1e3 * np.abs(r.drift_m[:, j]).max(), 3), _number(np.abs(r.force_n[:, j]).max(), 3),
         _number(r.energy_j[j], 3), _number(r.energy_per_ms_j[j], 2))
        for j, name in enumerate(page.names)
    ]  # fmt: skip
    total = _number(r.energy_j.sum(), 3)
    rows.append(("all stories", "", "", total, _UNKNOWN))
    head = ["story", "#drift, mm", "#force, N", "#energy dissipated, J", "#± for 1 ms of skew, J"]
    note = (
        "Force of a story: masses above it times their measured absolute accelerations; the file's masses. Energy: the integral "
        f"of the force over the drift. {_SKEW} A story's energy that is small against it, or negative, says nothing."
    )
    return f"<h2>Force against drift</h2>{charts.loops(r, page.names)}{table(head, rows)}<p class='muted'>{note}</p>"


def _spectrum(page: EventPage) -> str:
    """Draw the response spectrum of the base."""
    s = page.event.spectrum
    if s is None:
        return "<h2>Response spectrum of the base</h2><p>The ground was not measured.</p>"
    modes = page.event.during_hz[np.isfinite(page.event.during_hz)]
    note = "Dashed: periods of the modes during the event. Intensity and spectrum are of the one measured component."
    return f"<h2>Response spectrum of the base</h2>{charts.response_spectrum(s, modes)}<p class='muted'>{note}</p>"


def _data(page: EventPage) -> str:
    """Tabulate the quality of the data, and how sure the figures are."""
    e, r = page.event, page.review
    rows = [("event", e.id), ("begin and end", f"{utc(e.begin_ns)} to {utc(e.end_ns)} UTC")]
    if r is not None:
        rate_hz, quiet_s = r.record.rate_hz, r.record.strong.start / r.record.rate_hz
        length = f"{quiet_s:.0f} s before the event to {r.t_s[-1]:.0f} s after its begin"
        rows.append(("samples", f"{rate_hz:g} Hz after filtering, from {length}"))
        worst = [f"{name} {100 * share:.2g} %" for name, share in zip(r.channels, r.lost, strict=True) if share > 0.0]
        rows.append(("lost samples", ", ".join(worst) or "none"))
        rows.append(("gaps", str(r.gaps) if r.gaps else "none"))
    still = [f.channel for f in e.floors if not np.isfinite(f.peak_m_s2)]
    rows.append(("channels without motion", ", ".join(still) or "none"))
    rows.append(("channels at the end of their range", ", ".join(e.saturated) or "none"))
    rows.append(("ground", "not measured" if e.ground is None else "measured, one component"))
    origin = "their standard deviations join noise, and what half the corner changes"
    rows.append(("drifts", f"dynamic, above {e.corner_hz:.2g} Hz; {origin}"))
    shares = e.drift_std_m / e.drift_m
    if np.isfinite(shares).any():
        sure = f"to within {200 * np.nanmax(shares):.2g} % (two standard deviations, worst story)"
        rows.append(("how sure the drifts are", sure))
    rows.append(("recording", page.recording or "none: the samples are not kept"))
    if page.checksum is not None:
        rows.append(("its SHA-256", page.checksum))
    return f'<h2>Data, and how sure</h2><div class="long">{table([], rows)}</div>'


def _signature(_: EventPage) -> str:
    """Leave room for who judges it."""
    lines = "".join(f'<div class="sign">{words}</div>' for words in ("judgement", "name", "date and signature"))
    return f'<h2>Judged by</h2><div class="signs">{lines}</div>'


def _number(value: float, digits: int) -> str:
    """Write a number to some digits; a dash for one that is not known."""
    if not np.isfinite(value):
        return _UNKNOWN
    return str(np.format_float_positional(float(f"{value:.{digits}g}"), trim="-"))


def _with_std(value: float, std: float) -> str:
    """Write a number with two standard deviations."""
    return with_interval(value, 2.0 * std) if np.isfinite(value) else _UNKNOWN
