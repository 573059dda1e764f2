"""Report of one event as a page that needs no network, can be printed and is signed: what happened, what it means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, name_stories, storey_of
from monitor.events import POSSIBLY, Event, LimitTable, Review, Site, compared
from monitor.publish.page.charts import Chart, thinned
from monitor.publish.page.sheet import Sheet
from monitor.publish.reports.period_data import utc
from monitor.publish.results.event_lines import event_text, story_place, strongest_floor, with_interval

_UNKNOWN = "–"
_FINAL, _REVISED = 0, 1
_STATES = {"within": "normal", "unknown": "not_judged", "beyond": "alarm"}
"""How a story stands against the limits -> the state whose colour it has. [names]"""
_HEIGHT, _TALL = 90.0, 220.0
"""Height of a curve over time, and of other charts, px."""
_MOST_CURVES = 12
"""Most channels or stories that are drawn. [count; judgement]"""
_MOST_LOOP_POINTS = 4000
"""Most points of a loop. [count; cost of the page]"""
_ROW = 34.0
"""Height of a story in the profile, px."""
_MARGIN = 1.06


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
        """Names of the stories, as of their stiffnesses; the first ones have drifts."""
        if self.site is not None:
            return self.site.names
        n = max(self.event.drift_m.size, self.event.loss.size)
        return tuple(name_stories(story_place(self.event, j), ()) for j in range(n))


def write_event(path: Path, page: EventPage) -> None:
    """Write the page; the file appears under its name only when complete."""
    event_sheet(page).write(path)


def event_sheet(page: EventPage) -> Sheet:
    """Make the page."""
    state, words = _verdict(page.event)
    sheet = Sheet(f"{page.name}: event {page.event.id}", page.name, state, words)
    for part in (_head, _limits, _stories, _floors, _frequencies, _loss, _loops, _spectrum, _data):
        part(sheet, page)
    sheet.section("Judged by")
    sheet.add("signs", rows=["judgement", "name", "date and signature"])
    return sheet


def _head(sheet: Sheet, page: EventPage) -> None:
    """Write the verdict, the event in one sentence, its figures and what limits them."""
    e = page.event
    length_s = (e.end_ns - e.begin_ns) * 1e-9
    of_all, longer = ("≥ ", "at least ") if e.cut else ("", "")
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
        shown.append(
            (f"{of_all}{e.instrumental_intensity:.1f}", "intensity by one component, UNOFFICIAL (Wald et al. 1999)")
        )
    told = {_FINAL: "final line, by the event alone", _REVISED: "revised, by ambient motion after it"}
    sheet.headline = f"Strong motion of {longer}{length_s:.0f} s. {event_text(e, page.names).replace('m/s^2', 'm/s²')}"
    revision = told.get(-1 if e.revision is None else e.revision, "preliminary")
    sheet.lead.append(("", f"Event {e.id}: {utc(e.begin_ns)} to {utc(e.end_ns)} UTC; {revision}"))
    sheet.section("What happened")
    sheet.items((f"{part[:1].upper()}{part[1:]}." for part in filter(None, e.note.split("; "))), "doubts")
    sheet.figures(shown)


def _verdict(event: Event) -> tuple[str, str]:
    """Return the class of the verdict's colour, and the verdict in two words."""
    if event.exceeded:
        possibly = event.verdict is not None and event.verdict.startswith(POSSIBLY)
        return "alarm", "limit possibly exceeded" if possibly else "limit exceeded"
    return ("normal", "within limits") if event.verdict is not None else ("", "no limit judged")


def _limits(sheet: Sheet, page: EventPage) -> None:
    """Tabulate the site's own limits beside the values of the worst story."""
    sheet.section("Against the site's limits")
    sheet.items(page.event.exceeded)
    if page.site is None:
        sheet.text("" if page.event.exceeded else "The limits are not in this folder: the event has no recording.")
        return
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
    sheet.table(["quantity", "#limit", "#largest", "where", "outcome", "beyond it"], rows)
    sheet.text("" if rows else "The site file states none ([[events.limits]]), so nothing is judged.")


def _stories(sheet: Sheet, page: EventPage) -> None:
    """Show the map of stories, drifts over the height and drifts over time."""
    e, site, r = page.event, page.site, page.review
    limits = () if site is None else site.settings.limits
    sheet.section("Stories")
    stories = [_story(page, j, limits) for j in range(e.drift_m.size)]
    n_storeys = e.drift_corner_m.size
    if n_storeys and storey_of(page.names[0]):
        cells = [(_STATES[state], _number(1e3 * d, 3)) for (_, state, _), d in zip(stories, e.drift_m, strict=True)]
        corners = [("", _number(1e3 * d, 3)) for d in e.drift_corner_m]
        sheet.elevation("largest drift, mm", page.names[: len(cells)], cells, {"at a corner": corners})
    else:
        sheet.add("stories", rows=stories)
    if np.isfinite(e.drift_m).any():
        of_drift = [limit.drift_ratio for limit in limits if limit.drift_ratio is not None]
        ways = np.split(np.arange(e.drift_m.size), e.drift_m.size // n_storeys if n_storeys else 1)
        profiles = (_profile(page, way, None if site is None else site.heights_m, of_drift) for way in ways)
        sheet.draw(*profiles, size="" if len(ways) > 1 else "wide")
        rows = [
            (name, ("at least " if bound else "") + _with_std(1e3 * drift, 1e3 * std), _number(100 * ratio, 3))
            for name, drift, std, ratio, bound in zip(
                page.names[: e.drift_m.size], e.drift_m, e.drift_std_m, e.drift_ratio, e.is_bound, strict=True
            )
        ]
        sheet.table(["story", "#largest drift, mm", "#over the height, %"], rows)
    else:
        sheet.text("No drift is known.")
    if r is not None:
        known = [j for j in range(e.drift_m.size) if np.isfinite(r.drift_m[:, j]).all()]
        _over_time(sheet, r, [(f"{page.names[j]}: drift, mm", 1e3 * r.drift_m[:, j]) for j in known])


def _story(page: EventPage, j: int, limits: Sequence[LimitTable]) -> tuple[str, str, str]:
    """Say how a story stands against the limits: beyond one, within all that can be judged, or unknown."""
    event, compare = page.event, [compared(page.event, limit) for limit in limits]
    state = "within" if any(c.largest[j] <= c.limit for c in compare) else "unknown"
    of_drift = [c for c, limit in zip(compare, limits, strict=True) if limit.drift_ratio is not None]
    state = state if all(c.largest[j] <= c.limit for c in of_drift) else "unknown"
    words = {"within": "within the limits", "unknown": "not judged"}[state]
    words = "limit possibly exceeded" if any(c.possibly[j] for c in compare) else words
    if any(c.least[j] > c.limit for c in compare):
        state, words = "beyond", "limit exceeded"
    least = "at least " if event.is_bound[j] else ""
    drift = f"{least}{1e3 * event.drift_m[j]:.3g} mm" if np.isfinite(event.drift_m[j]) else "not known"
    ratio = f" ({100 * event.drift_ratio[j]:.2g} %)" if np.isfinite(event.drift_ratio[j]) else ""
    loss = with_interval(100.0 * event.loss[j], 200.0 * event.loss_std[j])
    lost = f", lasting loss {loss} %" if np.isfinite(event.loss[j]) else ""
    return page.names[j], state, f"drift {drift}{ratio}{lost}: {words}"


def _profile(page: EventPage, of: NDArray[np.intp], heights_m: Array | None, limits: Sequence[float]) -> Chart:
    """Draw the largest drift of some stories over the height: its ratio with the limits, without heights the drift in mm."""
    event, n, is_building = page.event, of.size, bool(page.event.drift_corner_m.size)
    thick = np.ones(n) if heights_m is None else heights_m[of]
    # Story 1 is the uppermost, storey 1 of a building the lowest.
    top = np.cumsum(thick) if is_building else np.cumsum(thick[::-1])[::-1]
    by_ratio = heights_m is not None and bool(np.isfinite(event.drift_ratio).any())
    scale = 100.0 / thick if by_ratio else np.full(n, 1e3)
    values, halves = event.drift_m[of] * scale, np.nan_to_num(2.0 * event.drift_std_m[of] * scale)
    shown = [100.0 * limit for limit in limits] if by_ratio else []
    largest = _MARGIN * max(float(np.nanmax(values + halves, initial=0.0)), 0.0, *shown) or 1.0
    title = f"Largest drift{' ratio, %' if by_ratio else ', mm'}, over the height in {'stories' if heights_m is None else 'm'}"
    title += page.names[of[0]][page.names[of[0]].rfind(", ") :] if is_building else ""
    said = "Line: two standard deviations on either side." + (" Dashed red: the site's limits." if shown else "")
    axes = (0.0, largest), (0.0, float(top.max())), max(_HEIGHT, min(_TALL, 2.0 * _ROW * n))
    chart = Chart(title, *axes, x_title="drift ratio, %" if by_ratio else "drift, mm", note=said)
    for j in np.flatnonzero(np.isfinite(values)):
        low, high, value = float(top[j] - thick[j]), float(top[j]), float(values[j])
        chart.shade((0.0, value), "used", (low, high))
        chart.line((max(value - halves[j], 0.0), value + halves[j]), (0.5 * (low + high),) * 2, "measured")
    for limit in shown:
        chart.line((limit, limit), chart.y, "limit dashed")
    return chart


def _over_time(sheet: Sheet, review: Review, curves: Sequence[tuple[str, Array]]) -> None:
    """Draw curves on one scale over the time from the begin of the event, with strong motion shaded."""
    shown, t_s, strong = curves[:_MOST_CURVES], review.t_s, review.record.strong
    largest = _MARGIN * max((float(np.abs(values).max()) for _, values in shown), default=0.0) or 1.0
    axes, shade = (
        ((t_s[0], t_s[-1]), (-largest, largest), _HEIGHT),
        (float(t_s[strong.start]), float(t_s[strong.stop - 1])),
    )
    charts = [Chart(title, *axes, x_title="time, s").shade(shade, "known") for title, _ in shown]
    sheet.draw(*(c.line(*thinned(t_s, v), "measured") for c, (_, v) in zip(charts, shown, strict=True)), size="wide")
    sheet.text(f"{len(curves) - len(shown)} more are not drawn." if len(curves) > len(shown) else "")


def _floors(sheet: Sheet, page: EventPage) -> None:
    """Draw the motion of ground and floors over time, and tabulate peaks."""
    sheet.section("Motion of the floors")
    if page.review is not None:
        record = page.review.record
        curves = [] if record.ground is None else [("ground", record.ground)]
        moving = [i for i in range(len(page.event.floors)) if not record.still[i]]
        curves += [(page.event.floors[i].channel, record.floors[:, i]) for i in moving]
        centred = [(f"{name}: acceleration, m/s²", values - _offset(values, record.strong)) for name, values in curves]
        _over_time(sheet, page.review, centred)
        sheet.note("Time from the begin of the event. Shaded: strong motion.")
    else:
        sheet.text(page.why_not)
    motions = [*page.event.floors, *([] if page.event.ground is None else [page.event.ground])]
    least = {f.channel: " (at least)" for f in motions if page.event.cut or f.channel in page.event.saturated}
    rows = [
        (f.channel + least.get(f.channel, ""),
         *(_number(v, 3) for v in (f.peak_m_s2, f.rms_m_s2, 1e3 * f.peak_m_s, f.arias_m_s, f.cav_m_s)))
        for f in motions
    ]  # fmt: skip
    sheet.table(["channel", "#peak, m/s²", "#RMS, m/s²", "#velocity, mm/s", "#Arias, m/s", "#CAV, m/s"], rows)


def _offset(values: Annotated[Array, "n"], strong: slice) -> float:
    """Return the mean of the quiet motion before the strong motion or after it, whichever is longer."""
    quiet = max(values[: strong.start], values[strong.stop :], key=len)
    return float((quiet if quiet.size else values).mean())


def _frequencies(sheet: Sheet, page: EventPage) -> None:
    """Tabulate the frequencies before, during and after, and draw the first one and its damping over time."""
    e = page.event
    sheet.section("Frequencies")
    rows = [
        (f"mode {k}", *(_number(v, 4) for v in hz), _number(100 * (hz[2] / hz[0] - 1), 2))
        for k, hz in enumerate(zip(e.before_hz, e.during_hz, e.after_hz, strict=True), 1)
    ]
    sheet.table(["mode", "#before, Hz", "#during, Hz", "#after, Hz", "#after against before, %"], rows)
    quiet = "of the largest power in the quiet motion after it"
    after = "by windows of ambient motion" if e.revision == _REVISED else quiet
    sheet.note(f"Before: by windows; during: of the largest power; after: {after}.")
    if page.review is None or page.review.first_mode is None:
        return
    mode, span = page.review.first_mode, (float(page.review.t_s[0]), float(page.review.t_s[-1]))
    series = (
        ("First mode: frequency, Hz", mode.hz, 2.0 * mode.hz_std),
        ("Damping ratio, %", 100.0 * mode.damping, 200.0 * mode.damping_std),
        ("Largest displacement relative to the ground, mm", 1e3 * mode.level_m, np.zeros(mode.t_s.size)),
    )
    charts = []
    for title, values, half in series:
        low, high = float((values - half).min()), float((values + half).max())
        pad = 0.06 * (high - low) + 1e-9
        chart = Chart(title, span, (low - pad, high + pad), x_title="time, s")
        charts.append(chart.dots(mode.t_s, values, half))
    sheet.draw(*charts, size="wide")
    sheet.note(
        "First mode, stretch by stretch of ten periods, with 95 % intervals: its absolute acceleration against its displacement "
        "and velocity relative to the measured ground. A frequency that falls with the level and comes back is no damage."
    )
    if mode.change is not None:
        value, std, low, high = mode.change
        sheet.text(
            f"At like levels of motion, {1e3 * low:.2g} to {1e3 * high:.2g} mm, the first frequency after the strongest motion "
            f"was {with_interval(100 * value, 200 * std)} % against before it."
        )


def _loss(sheet: Sheet, page: EventPage) -> None:
    """Tabulate what remains of the stiffness."""
    e = page.event
    if not e.loss.size:  # nothing is known of stories
        return
    sheet.section("Lasting loss of stiffness")
    if not np.isfinite(e.loss).any():
        hours = "an hour" if page.site is None else f"{page.site.settings.revision_s / 60:.0f} minutes"
        why = e.note if e.revision == _REVISED else f"not known until the revision after {hours} of ambient motion"
        sheet.text(f"{why[:1].upper() + why[1:]}.")
        return
    losses = zip(page.names[: e.loss.size], e.loss, e.loss_std, strict=True)
    sheet.table(["story", "#lost, %"], [(name, _with_std(100 * loss, 100 * std)) for name, loss, std in losses])
    if e.revision == _REVISED:
        sheet.note("Stiffness of ambient motion after the event against that before it; with two standard deviations.")
    else:
        sheet.note(
            "By the frequencies of the quiet motion just before the event and just after it, with two standard deviations; the "
            "revision after ambient motion tells it far more closely."
        )


def _loops(sheet: Sheet, page: EventPage) -> None:
    """Draw force-drift loops, and tabulate the energy dissipated in each story."""
    r = page.review
    if r is None or r.force_n is None:
        return
    sheet.section("Force against drift")
    strong, charts, rows = r.record.strong, [], []
    per = -(-(strong.stop - strong.start) // _MOST_LOOP_POINTS)
    for j, name in enumerate(page.names):
        drift, force = 1e3 * r.drift_m[strong, j][::per], r.force_n[strong, j][::per]
        x, y = (_MARGIN * float(np.abs(values).max()) or 1.0 for values in (drift, force))
        loop = Chart(f"{name}: force, N", (-x, x), (-y, y), _TALL, x_title="drift, mm")
        charts.append(loop.line(drift, force, "measured"))
        largest = 1e3 * np.abs(r.drift_m[:, j]).max(), np.abs(r.force_n[:, j]).max(), r.energy_j[j]
        rows.append((name, *(_number(v, 3) for v in largest), _number(r.energy_per_ms_j[j], 2)))
    sheet.draw(*charts[:_MOST_CURVES])
    sheet.text(f"{len(charts) - _MOST_CURVES} more are not drawn." if len(charts) > _MOST_CURVES else "")
    rows.append(("all stories", "", "", _number(r.energy_j.sum(), 3), _UNKNOWN))
    sheet.table(["story", "#drift, mm", "#force, N", "#energy dissipated, J", "#± for 1 ms of skew, J"], rows)
    sheet.note(
        "Force of a story: masses above it times their measured absolute accelerations; the file's masses. Energy: the integral "
        "of the force over the drift. The last column says how far a skew of 1 ms between the two floors' clocks would move it. "
        "A story's energy that is small against it, or negative, says nothing."
    )


def _spectrum(sheet: Sheet, page: EventPage) -> None:
    """Draw the response spectrum of the base, with the periods of the modes."""
    s = page.event.spectrum
    sheet.section("Response spectrum of the base")
    if s is None:
        sheet.text("The ground was not measured.")
        return
    period, values = s.period_s, s.pseudo_acceleration_m_s2
    axes = (0.0, float(period[-1])), (0.0, _MARGIN * float(values.max())), _TALL
    chart = Chart("Pseudo-acceleration at 5 % damping, m/s²", *axes, x_title="period, s")
    for hz in page.event.during_hz[np.isfinite(page.event.during_hz)]:
        if 1.0 / hz < period[-1]:
            chart.line((1.0 / hz, 1.0 / hz), chart.y, "before dashed")
    sheet.draw(chart.line(period, values), size="wide")
    sheet.note(
        "Dashed: periods of the modes during the event. Intensity and spectrum are of the one measured component."
    )


def _data(sheet: Sheet, page: EventPage) -> None:
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
    sheet.section("Data, and how sure")
    sheet.table([], rows)


def _number(value: float, digits: int) -> str:
    """Write a number to some digits; a dash for one that is not known."""
    if not np.isfinite(value):
        return _UNKNOWN
    return str(np.format_float_positional(float(f"{value:.{digits}g}"), trim="-"))


def _with_std(value: float, std: float) -> str:
    """Write a number with two standard deviations."""
    return with_interval(value, 2.0 * std) if np.isfinite(value) else _UNKNOWN
