"""Report of a diagnosis as a page that needs no network and can be printed: first the verdict, then the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, name_stories
from monitor.diagnosis import Diagnosis, StoryLaw, csd_error_in_words, in_words, not_relied_on
from monitor.inference import Segments
from monitor.model import FORMS, Effect, interval, unit
from monitor.publish.page.charts import Chart
from monitor.publish.page.sheet import Sheet
from monitor.publish.reports.comparison import Comparison, LevelDependence, compare, level_dependence

Content = Mapping[str, Any]

_MAX_SHOWN = 12
"""Largest number of rows of the misfit's table, and of bars of a ranking."""
_FULL_COLOUR = 12.0
"""Misfit of the fullest colour. [standard deviations; judgement]"""
_HZ = "frequency, Hz"


def write_report(
    path: Path,
    diagnosis: Diagnosis,
    content: Content,
    segments: Segments,
    story_names: Sequence[str] = (),
    laws: Sequence[StoryLaw] = (),
) -> None:
    """Write the page, which appears under its name only when complete; `content` is that of diagnosis.json."""
    sheet = diagnosis_sheet(diagnosis, content, segments, laws)
    sheet.rename(lambda words: name_stories(words, story_names))
    sheet.write(path)


def diagnosis_sheet(diagnosis: Diagnosis, content: Content, segments: Segments, laws: Sequence[StoryLaw] = ()) -> Sheet:
    """Make the page; parameters as of `write_report`."""
    compared, by_level = compare(diagnosis, segments), level_dependence(diagnosis)
    kind, says = str(content["verdict"]), content["says"]
    word = {"none": "explained", "named": "cause named"}.get(kind, kind)
    sheet = Sheet(f"Diagnosis: {says}", "Diagnosis", kind, word, headline=says)
    _head(sheet, content, compared, segments)
    _spectra(sheet, compared, content)
    _misfit(sheet, compared, diagnosis)
    if by_level is not None:
        _modes_by_class(sheet, by_level)
    _story_laws(sheet, laws, extended=compared.extended)
    _witnesses(sheet, content.get("witness", ()))
    _ranking(sheet, diagnosis, content)
    _parameters(sheet, diagnosis, content, compared.hz)
    _data(sheet, diagnosis, content, segments, compared)
    return sheet


def _head(sheet: Sheet, content: Content, compared: Comparison, segments: Segments) -> None:
    """Write the doubts, the separating measurement, the key figures and how to read the page."""
    sheet.section("How sure")
    sheet.items(content.get("doubts") or (), "doubts")
    if content["separating_measurement"]:
        sheet.lead.append(("To tell them apart:", f"{content['separating_measurement']}."))
    gain, error = content["gain"]["log_score_per_sample"], content["gain"]["csd_error"]
    low, high = gain["ci95"]
    wrong = [int((np.abs(z) > compared.limit).sum()) for z in (compared.z_before, compared.z_after)]
    shown = [
        (f"{wrong[0]} → {wrong[1]}" if compared.extended else f"{wrong[0]}",
         f"bands with a misfit beyond {compared.limit:g} standard deviations"),
        (_minutes(segments), f"of data, {len(compared.channels)} channels"),
    ]  # fmt: skip
    was_held_out = not content["gain"]["heldout"].startswith("none")  # else the sentence above says why not
    if compared.extended and content["verdict"] != "none" and was_held_out:
        shown = [
            (
                f"{gain['gain']:+.4f} ({low:+.4f} to {high:+.4f})",
                "gain on held-out data, nats a sample, 95 % interval; above 0: the cause predicts better",
            ),
            (_change(error["before"], error["after"]), "error of held-out cross-spectra"),
            *shown,
        ]
    sheet.figures(shown)
    sheet.note(
        "How to read this page. A simulation of the structure was fitted to the measured vibration twice: before, with the model "
        "as it was, its numbers refitted, and after, with the cause above added (the most probable one, where several remain). A "
        "cause counts if measured and simulated spectra then agree within chance, on data that the fit has not seen. Intervals "
        "(±) are two standard deviations, about 95 %."
    )


def _change(before: float, after: float) -> str:
    """Write a relative squared error of cross-spectra before and after."""
    if max(before, after) <= 1.0:
        return f"{100 * before:.1f} → {100 * after:.1f} %"
    return f"{csd_error_in_words(before)} → {csd_error_in_words(after)}"


def _spectra(sheet: Sheet, c: Comparison, content: Content) -> None:
    """Draw the measured and the modelled spectrum of every channel, and their ratio."""
    sheet.section("Measured against simulated")
    drawn = "dashed orange: simulated before; blue: simulated after" if c.extended else "dashed orange: simulated"
    sheet.draw(*(chart for i, name in enumerate(c.channels) for chart in _channel_charts(c, i, name)))
    words = [
        f"Black: measured; {drawn}. Ratio 1: the simulation is right; the grey strip is what chance allows. Shaded orange: bands "
        "with a misfit on this channel; shaded red: what is left after."
    ]
    if c.doubtful_hz:
        words.append("Shaded grey: there the healthy data contradict the model too, and what is seen counts less.")
    sheet.note(" ".join([*words, *(f"Shaded dark: {says}." for says in content["band"]["says"])]))


def _channel_charts(c: Comparison, i: int, name: str) -> tuple[Chart, Chart]:
    """Draw the spectra of channel i and their ratio, with the bands of misfit shaded."""
    x = (float(c.whole_hz[0]), float(c.whole_hz[-1]))
    power = np.concatenate([c.whole_measured[i], c.before[i], c.after[i]])
    y = float(power.min()) / 1.3, float(power.max()) * 1.6
    upper = Chart(f"{name}: power spectral density, (m/s²)²/Hz", x, y, 190.0, log=True, x_title=_HZ)
    largest_log_ratio = float(np.abs(np.log(np.maximum(np.stack([c.ratio_before[i], c.ratio_after[i]]), 1e-3))).max())
    limit = float(np.clip(np.exp(1.1 * largest_log_ratio), 1.5, 20.0))
    lower = Chart(
        f"{name}: measured / simulated, ratio of power", x, (1.0 / limit, limit), 190.0, log=True, x_title=_HZ
    )
    shades = [(low, high, "known") for low, high in c.doubtful_hz]
    shades += [(low, high, "unjudged") for low, high in ((x[0], float(c.hz[0])), (float(c.hz[-1]), x[1])) if high > low]
    n = 2 if c.extended else 1
    for z, kind in ((c.z_before, "off"), (c.z_after, "still"))[:n]:
        wrong = (np.abs(z) > c.limit)[:, i, :].any(axis=1) | (np.abs(z) > c.limit)[:, :, i].any(axis=1)
        shades += [(m - c.width_hz / 2, m + c.width_hz / 2, kind) for m in c.band_hz[wrong].tolist()]
    for low, high, kind in shades:
        for chart in (upper, lower):
            chart.shade((max(low, x[0]), min(high, x[1])), kind)
    lower.shade((float(c.hz[0]), float(c.hz[-1])), "chance", (1.0 / (1.0 + c.chance), 1.0 + c.chance))
    upper.line(c.whole_hz, c.whole_measured[i], "measured")
    for values, ratio, kind in ((c.before, c.ratio_before, "before"), (c.after, c.ratio_after, "after"))[:n]:
        upper.line(c.hz, values[i], "before dashed" if kind == "before" else kind)
        lower.line(c.ratio_hz, ratio[i], kind)
    return upper, lower


def _misfit(sheet: Sheet, c: Comparison, diagnosis: Diagnosis) -> None:
    """Draw maps of the misfit before and after, and tabulate the largest misfits in words."""
    rows = c.rows()
    if len(rows) > 36:  # many channels: show only the rows with the largest misfit
        size = [np.abs(c.z_before[:, i, j]).max() + np.abs(c.z_after[:, i, j]).max() for _, i, j in rows]
        rows = [rows[k] for k in sorted(np.argsort(size)[-36:])]
    x = (float(c.band_hz[0]) - c.width_hz / 2, float(c.band_hz[-1]) + c.width_hz / 2)
    stages = [("before", c.z_before, diagnosis.misfit), ("after", c.z_after, diagnosis.left_over)]
    stages, charts = stages if c.extended else stages[:1], []
    for when, z, _ in stages:
        title = f"Misfit {when}: worst {np.abs(z).max():.1f} standard deviations"
        y, names = (0.0, float(len(rows))), [row[0] for row in rows]
        chart = Chart(title, x, y, 16.0 * len(rows), x_title=_HZ, y_names=names)
        charts.append(chart.grid(np.array([z[:, i, j] for _, i, j in rows]) / _FULL_COLOUR, x, y, signed=True))
    sheet.section("Where the misfit is")
    sheet.draw(*charts)
    sheet.note(
        f"Red: measured more than simulated, blue: less; full colour at {_FULL_COLOUR:g} standard deviations, chance up to "
        f"{c.limit:g}. Power is counted given the channels above; the other rows compare how two channels move together."
    )
    for when, _, listed in stages:
        worst = [(m.where.removeprefix("f = "), f"{m.size:.1f}" if m.size else "–", m.says) for m in listed]
        sheet.table([f"Misfit {when}", "#std. dev.", "what it says"], worst, most=_MAX_SHOWN)
        sheet.text("" if worst else f"No misfit {when if c.extended else 'beyond chance'}.")


def _modes_by_class(sheet: Sheet, dependence: LevelDependence) -> None:
    """Draw frequency and damping of every mode by class."""
    margin, charts = 0.08 * float(np.ptp(dependence.at) or 1.0), []
    x = (float(dependence.at[0]) - margin, float(dependence.at[-1]) + margin)
    series = (
        ("frequency, Hz", dependence.frequency_hz, dependence.frequency_std, dependence.model_frequency_hz),
        ("damping, %", 100 * dependence.damping, 100 * dependence.damping_std, 100 * dependence.model_damping),
    )
    for mode in range(dependence.frequency_hz.shape[1]):
        for name, value, std, model in series:
            y, half, curve = value[:, mode], 2.0 * std[:, mode], model[:, mode]
            low, high = min((y - half).min(), curve.min()), max((y + half).max(), curve.max())
            pad = 0.1 * (high - low) + 1e-9
            axes = x, (float(low - pad), float(high + pad)), 120.0
            chart = Chart(f"mode {mode + 1}: {name}", *axes, x_title=dependence.axis)
            charts.append(chart.line(dependence.at, curve).dots(dependence.at, y, half))
    sheet.section("How the modes move")
    sheet.draw(*charts)
    sheet.note("Points: each class fitted alone, with 95 % intervals. Line: what the model with its causes predicts.")


def _story_laws(sheet: Sheet, laws: Sequence[StoryLaw], *, extended: bool) -> None:
    """Draw the force of every story against its drift, and tabulate how its stiffness and its loss change with the level."""
    if not laws:
        return
    charts, rows = [], []
    for law in laws:
        loops = [(law.measured, "measured"), (law.before, "before dashed"), (law.after, "after")][
            : 3 if extended else 2
        ]
        x, y = (
            1.05 * max(float(np.abs(getattr(loop, name)).max()) for loop, _ in loops) for name in ("drift_m", "force_n")
        )
        chart = Chart(f"story {law.story}: force, N", (-1e3 * x, 1e3 * x), (-y, y), 220.0, x_title="drift, mm")
        for loop, kind in loops:
            chart.line(1e3 * loop.drift_m, loop.force_n, kind)
        charts.append(chart)
        for i, level in enumerate(("small", "large")):
            rows.append((
                f"story {law.story}", level, f"{1e3 * law.drift_m[i]:.3g}",
                f"{law.stiffness_n_per_m[i]:.5g} ± {2.0 * law.stiffness_std[i]:.2g}", f"{law.model_stiffness_n_per_m[i]:.5g}",
                f"{100.0 * law.loss[i]:.2g} ± {200.0 * law.loss_std[i]:.1g}", f"{100.0 * law.model_loss[i]:.2g}",
                law.says if i else "",
            ))  # fmt: skip
    sheet.section("Story forces, from the data")
    sheet.draw(*charts)
    numbers = ["#RMS, mm", "#stiffness, N/m", "#of the model", "#loss factor, %", "#of the model"]
    sheet.table(["story", "drifts", *numbers, "in words"], rows)
    sheet.note(
        "Force of a story: masses above it times their measured accelerations, less the measured forces. Drawn: the segment with "
        "the largest drift, in the band that is judged. Black: measured; the model's as in the spectra above. The table compares "
        "the third of the segments with the smallest drifts with that with the largest."
    )


def _witnesses(sheet: Sheet, compared: Sequence[Content]) -> None:
    """Tabulate what sensors of other quantities and axes say of the model and their motion in each mode; those judged first."""
    if not compared:
        return
    compared = sorted(compared, key=lambda w: w["verdict"] is None)
    rows = [
        (w["channel"], m["of"].replace("_", " "), f"{m['frequency_hz']:.2f}",
         interval({"value": m["ratio"], "std": m["std"]}, 1.0, w["unit"]), f"{m['coherence']:.2f}",
         *("" if m[key] is None else f"{m[key]:.3g}" for key in ("predicted_before", "predicted")))
        for w in compared for m in w["modes"]
    ]  # fmt: skip
    sheet.section("Witnesses")
    said = [(w["channel"], w["verdict"] or "nothing to judge", w["says"]) for w in compared]
    sheet.table(["channel", "verdict", "in words"], said)
    head = ["channel", "mode", "#Hz", "measured", "#coherence", "#predicted before", "#predicted"]
    sheet.table(head, rows, flows=True)
    sheet.note(
        "They entered no fit. Measured: the channel's rotation or motion over the motion of the structure in the mode, that of a "
        "joint over the drift of the story below its floor."
    )


def _ranking(sheet: Sheet, diagnosis: Diagnosis, content: Content) -> None:
    """Draw bars of log evidence, one group for each round of the search."""
    accepted = [(c["effect"], c["location"]) for c in content["causes"]]
    rivals = {c.key for c, _ in diagnosis.alternatives}
    sheet.section("Which causes were tried")
    for i, candidates in enumerate(diagnosis.rounds):
        shown = [c for c in candidates if np.isfinite(c.log_evidence)][:_MAX_SHOWN]
        if not shown:
            continue
        if i:
            before = " at ".join(accepted[i - 1]) if i <= len(accepted) else "the best of these"
            sheet.text(f"With {before} in the model:")
        winner = accepted[i] if i < len(accepted) else None
        last = i == len(accepted)
        largest = max(10.0, *(c.log_evidence for c in shown))
        rows = [
            (f"{c.effect.name}, {c.effect.location}", f"{c.log_evidence:.1f}",
             f"{100.0 * max(c.log_evidence, 0.0) / largest:.1f}",
             "accepted" if c.key == winner else "rival" if last and c.key in rivals else "")
            for c in shown
        ]  # fmt: skip
        sheet.add("bars", rows=rows)
    sheet.note(
        "Log evidence over the model without the cause, nats: 5 is odds of 150 to 1. Blue: accepted; orange: cannot be told "
        "apart; grey: not accepted."
    )


def _parameters(sheet: Sheet, diagnosis: Diagnosis, content: Content, hz: Array) -> None:
    """Tabulate the causes with their parameters, the alternatives and the causes found at calibration."""
    refitted = [
        (row["location"], row["parameter"], f"{row['drawn']:.5g}",
         interval({"value": row["refitted"], "std": row["std"]}, 1.0, unit(row["parameter"])),
         "" if row["tolerance"] is None else f"± {100 * row['tolerance']:.3g} %", row["says"])
        for row in content["refit"]
    ]  # fmt: skip
    if refitted:
        sheet.section("What was refitted against the drawing")
        sheet.table(["place", "parameter", "#drawn", "refitted", "#tolerance", "in words"], refitted)
    lists = (
        ("Causes", "causes"),
        ("Also fitted, not stated", "also_fitted"),
        ("Already so at calibration", "standing"),
    )
    for title, key in lists:
        _causes(sheet, title, content[key], diagnosis)
    for said in not_relied_on(content):
        sheet.text(f"{said[:1].upper()}{said[1:]}.")
    if content["standing_misfit"] is not None:
        sheet.text(f"Already so at calibration: {content['standing_misfit']['says']}.")
    for item in content["left_out"]:
        sheet.text(f"Left out: {item['says']}.")
    reference = diagnosis.posterior.prior
    sheet.draw(*(_force_spectrum(effect, hz) for effect in reference.effects(reference.mean) if effect.colour_title))
    if content["alternatives"]:
        sheet.section("Alternatives")
        rivals = [
            (a["effect"], a["location"], f"{100 * a['probability']:.0f} %", a["says"]) for a in content["alternatives"]
        ]
        sheet.table(["effect", "place", "#probability", "in words"], rivals)
        _signatures(sheet, content["alternatives"])
    index = content.get("ddi_effect", {})
    if index.get("with"):
        sheet.section("What it does to the damage index")
        pairs = enumerate(zip(index["without"], index["with"], strict=True), 1)
        losses = [(f"story {j}", *(f"{round(100 * v, 1) + 0.0:.1f} %" for v in pair)) for j, pair in pairs]
        sheet.table(["damage index (stiffness lost)", "#by refitting stiffness alone", "#beside the causes"], losses)


def _causes(sheet: Sheet, title: str, causes: Sequence[Content], diagnosis: Diagnosis) -> None:
    """Tabulate causes with their parameters, and say how they show."""
    rows: list[Sequence[str]] = []
    for c in causes:
        first = in_words(c["effect"], c["location"], c["parameters"], diagnosis.posterior.prior)
        drawn = {p.name for p in FORMS[c["effect"]].parameters if p.drawn}
        shown = {name: entry for name, entry in c["parameters"].items() if name not in drawn}
        for name, entry in shown.items() or [("", {})]:
            value = interval(entry, 1.0, unit(name)) if name else ""
            rows.append((c["effect"], c["location"], name, value, first))
            first = ""
        if "shape" in c:
            parts = zip(diagnosis.posterior.context.channels, c["shape"], strict=True)
            components = ", ".join(f"{name} {part['value']:.2f}" for name, part in parts)
            rows.append((c["effect"], c["location"], "shape", components, ""))
    if rows:
        sheet.section(title)
        sheet.table(["effect", "place", "parameter", "value", "in words"], rows)
        _signatures(sheet, causes)


def _force_spectrum(effect: Effect, hz: Annotated[Array, "bins"]) -> Chart:
    """Draw the power spectral density of an effect's forces."""
    density = np.asarray(effect.colour(hz))
    axes = (float(hz[0]), float(hz[-1])), (float(density.min()) / 1.3, float(density.max()) * 1.3), 120.0
    return Chart(effect.colour_title, *axes, log=True, x_title=_HZ).line(hz, density)


def _signatures(sheet: Sheet, causes: Sequence[Content]) -> None:
    """Describe how each kind of cause shows in the accelerations."""
    for name in dict.fromkeys(c["effect"] for c in causes):
        sheet.note(f"How {name} shows: {FORMS[name].signature}.")


def _data(sheet: Sheet, diagnosis: Diagnosis, content: Content, segments: Segments, c: Comparison) -> None:
    """Tabulate the data and the method of the diagnosis."""
    e = diagnosis.posterior.observed
    rows = [
        ("length", f"{_minutes(segments)}; {segments.samples} sample instants"),
        ("channels", ", ".join(c.channels) + f"; source at {segments.rate_hz:g} Hz"),
        ("segments", f"{segments.t_s.size} of {1.0 / e.band.bin_hz:g} s, Hann taper, half overlapping"),
        ("classes", f"{e.counts.size} of vibration level or temperature: " + ", ".join(f"{n:g}" for n in e.counts)),
        ("band", "; ".join([f"{c.hz[0]:.2f} to {c.hz[-1]:.2f} Hz in steps of {e.band.bin_hz:g} Hz", *content["band"]["says"]])),
        ("ground motion", "measured, and used as input" if e.drive.inputs else "not measured"),
        ("likelihood", "debiased Whittle likelihood of the classes' cross-spectra (complex Wishart), "
         f"tempered by {e.weight:.2f} for the correlation of neighbouring bins and segments"),
        ("reference", "baseline" if diagnosis.posterior.prior.is_baseline else "structure file"),
        ("held out", content["gain"]["heldout"]),
    ]  # fmt: skip
    sheet.section("The data judged")
    sheet.table([], rows)


def _minutes(segments: Segments) -> str:
    """Write the length of the data in minutes, from the segments' middles."""
    seconds = float(np.ptp(segments.t_s)) + 1.0 / segments.band.bin_hz
    return f"{seconds / 60.0:.1f} min"
