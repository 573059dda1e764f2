"""Report of a diagnosis as one HTML page that needs no network and can be printed: first the verdict, then the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, name_stories, write_atomically
from monitor.diagnosis import Diagnosis, StoryLaw, csd_error_in_words, in_words
from monitor.inference import Segments
from monitor.model import FORMS, Effect, interval, unit
from monitor.publish.reports import charts
from monitor.publish.reports.charts import Axes
from monitor.publish.reports.comparison import Comparison, LevelDependence, compare, level_dependence
from monitor.publish.reports.page import document, doubts, figures, table, verdict

Content = Mapping[str, Any]

_MAX_SHOWN = 12
"""Largest number of rows of the misfit's table, and of bars of a ranking."""


def write_report(
    path: Path,
    diagnosis: Diagnosis,
    content: Content,
    segments: Segments,
    story_names: Sequence[str] = (),
    laws: Sequence[StoryLaw] = (),
) -> None:
    """Write the page, which appears under its name only when complete; `content` is that of diagnosis.json."""
    names = [escape(name) for name in story_names]
    write_atomically(path, name_stories(page(diagnosis, content, segments, laws), names))


def page(diagnosis: Diagnosis, content: Content, segments: Segments, laws: Sequence[StoryLaw] = ()) -> str:
    """Write the page, which is well-formed XML as well; parameters as of `write_report`."""
    compared, by_level = compare(diagnosis, segments), level_dependence(diagnosis)
    verdict_text = content["says"]
    parts = [
        _head(verdict_text, content, compared, segments),
        _spectra(compared, content),
        _misfit(compared, diagnosis),
        "" if by_level is None else _modes_by_class(by_level),
        _story_laws(laws, extended=compared.extended),
        _witnesses(content.get("witness", ())),
        _ranking(diagnosis, content),
        _parameters(diagnosis, content, compared.hz),
        _data(diagnosis, content, segments, compared),
    ]
    return document(f"Diagnosis: {verdict_text}", parts)


def _head(verdict_text: str, content: Content, compared: Comparison, segments: Segments) -> str:
    """Write the verdict, the separating measurement, the key figures and how to read the page."""
    kind = str(content["verdict"])
    out = [verdict(kind, {"none": "explained", "named": "cause named"}.get(kind, kind), verdict_text)]
    if content.get("doubts"):
        out.append(doubts(content["doubts"]))
    if content["separating_measurement"]:
        out.append(f"<p><b>To tell them apart:</b> {escape(content['separating_measurement'])}.</p>")
    gain, error = content["gain"]["log_score_per_sample"], content["gain"]["csd_error"]
    low, high = gain["ci95"]
    wrong = [int((np.abs(z) > compared.limit).sum()) for z in (compared.z_before, compared.z_after)]
    shown = [
        (f"{wrong[0]} → {wrong[1]}" if compared.extended else f"{wrong[0]}",
         f"bands with a misfit beyond {compared.limit:g} standard deviations"),
        (_minutes(segments), f"of data, {len(compared.channels)} channels"),
    ]  # fmt: skip
    was_held_out = not content["gain"]["heldout"].startswith("none")  # else the sentence above says why not
    if compared.extended and kind != "none" and was_held_out:
        shown = [
            (
                f"{gain['gain']:+.4f} ({low:+.4f} to {high:+.4f})",
                "gain on held-out data, nats a sample, 95 % interval; above 0: the cause predicts better",
            ),
            (_change(error["before"], error["after"]), "error of held-out cross-spectra"),
            *shown,
        ]
    out.append(figures(shown))
    out.append(
        '<p class="muted"><b>How to read this page.</b> A simulation of the structure was fitted to the measured '
        "vibration twice: <i>before</i>, with the model as it was, its numbers refitted, and <i>after</i>, with the "
        "cause above added (the most probable one, where several remain). A cause counts if measured and simulated "
        "spectra then agree within chance, on data that the fit has not seen. Intervals (±) are two standard "
        "deviations, about 95 %.</p>"
    )
    return "".join(out)


def _change(before: float, after: float) -> str:
    """Write a relative squared error of cross-spectra before and after."""
    if max(before, after) <= 1.0:
        return f"{100 * before:.1f} → {100 * after:.1f} %"
    return f"{csd_error_in_words(before)} → {csd_error_in_words(after)}"


def _spectra(c: Comparison, content: Content) -> str:
    """Draw the measured and the modelled spectrum of every channel, and their ratio."""
    out = ["<h2>Measured against simulated</h2><p>"]
    keys = [("ink", "measured"), ("before", "simulated, before"), ("after", "simulated, after")]
    for kind, words in keys if c.extended else [keys[0], ("before", "simulated")]:
        out.append(f'<span class="key" style="color: var(--{kind})">━ {words}</span> &#160; ')
    out.append("</p>")
    for i, name in enumerate(c.channels):
        out.append(_channel_charts(c, i, name))
    out.append(
        "<p class='muted'>Ratio 1: the simulation is right; the grey strip is what chance allows. Shaded orange: "
        "bands with a misfit on this channel; shaded red: what is left after."
    )
    if c.doubtful_hz:
        out.append(" Shaded grey: there the healthy data contradict the model too, and what is seen counts less.")
    out += [f" Shaded dark: {escape(words)}." for words in content["band"]["says"]]
    out.append("</p>")
    return "".join(out)


def _channel_charts(c: Comparison, i: int, name: str) -> str:
    """Draw the spectra of channel i and their ratio, with the bands of misfit shaded."""
    x = (float(c.whole_hz[0]), float(c.whole_hz[-1]))
    power = np.concatenate([c.whole_measured[i], c.before[i], c.after[i]])
    upper = Axes(x, (float(power.min()) / 1.3, float(power.max()) * 1.6), 190.0, log_y=True)
    largest_log_ratio = float(np.abs(np.log(np.maximum(np.stack([c.ratio_before[i], c.ratio_after[i]]), 1e-3))).max())
    limit = float(np.clip(np.exp(1.1 * largest_log_ratio), 1.5, 20.0))
    lower = Axes(x, (1.0 / limit, limit), 100.0, log_y=True)
    shades = [(low, high, "known") for low, high in c.doubtful_hz]
    shades += [(low, high, "unjudged") for low, high in ((x[0], float(c.hz[0])), (float(c.hz[-1]), x[1])) if high > low]
    n = 2 if c.extended else 1
    for z, kind in ((c.z_before, "off"), (c.z_after, "still"))[:n]:
        wrong = (np.abs(z) > c.limit)[:, i, :].any(axis=1) | (np.abs(z) > c.limit)[:, :, i].any(axis=1)
        shades += [(m - c.width_hz / 2, m + c.width_hz / 2, kind) for m in c.band_hz[wrong].tolist()]
    above, below = [
        [axes.shade((max(low, x[0]), min(high, x[1])), kind) for low, high, kind in shades] for axes in (upper, lower)
    ]
    judged = (float(c.hz[0]), float(c.hz[-1]))
    below.append(lower.shade(judged, "chance", (1.0 / (1.0 + c.chance), 1.0 + c.chance)))
    above.append(upper.line(c.whole_hz, c.whole_measured[i], "measured"))
    for values, kind in ((c.before, "before dashed"), (c.after, "after"))[:n]:
        above.append(upper.line(c.hz, values[i], kind))
    for values, kind in ((c.ratio_before, "before"), (c.ratio_after, "after"))[:n]:
        below.append(lower.line(c.ratio_hz, values[i], kind))
    return upper.chart(f"{name}: power spectral density, (m/s²)²/Hz", *above, numbers=False) + lower.chart(
        f"{name}: measured / simulated, ratio of power", *below, x_title="frequency, Hz"
    )


def _misfit(c: Comparison, diagnosis: Diagnosis) -> str:
    """Draw heat maps of the misfit before and after, and tabulate the largest misfits in words."""
    rows = c.rows()
    if len(rows) > 36:  # many channels: show only the rows with the largest misfit
        size = [np.abs(c.z_before[:, i, j]).max() + np.abs(c.z_after[:, i, j]).max() for _, i, j in rows]
        rows = [rows[k] for k in sorted(np.argsort(size)[-36:])]
    x = (float(c.band_hz[0]) - c.width_hz / 2, float(c.band_hz[-1]) + c.width_hz / 2)
    stages = [("before", c.z_before, diagnosis.misfit), ("after", c.z_after, diagnosis.left_over)]
    stages = stages if c.extended else stages[:1]
    out = ["<h2>Where the misfit is</h2><div class='pair'>"]
    for when, z, _ in stages:
        values = np.array([z[:, i, j] for _, i, j in rows])
        title = f"Misfit {when}: worst {np.abs(z).max():.1f} standard deviations"
        out.append(charts.heat(values, x, [r[0] for r in rows], 12.0, title))
    out.append(
        "</div><p class='muted'>Red: measured more than simulated, blue: less; full colour at 12 standard deviations, "
        f"chance up to {c.limit:g}. Power is counted given the channels above; the other rows compare how two channels "
        "move together.</p>"
    )
    for when, _, listed in stages:
        if listed:
            worst = [
                (m.where.removeprefix("f = "), f"{m.size:.1f}" if m.size else "–", m.says) for m in listed[:_MAX_SHOWN]
            ]
            more = f"<p class='muted'>and {len(listed) - _MAX_SHOWN} more</p>" if len(listed) > _MAX_SHOWN else ""
            out.append(table([f"Misfit {when}", "#std. dev.", "what it says"], worst) + more)
        else:
            out.append(f"<p>No misfit {when if c.extended else 'beyond chance'}.</p>")
    return "".join(out)


def _modes_by_class(dependence: LevelDependence) -> str:
    """Draw frequency and damping of every mode by class."""
    n = dependence.frequency_hz.shape[1]
    margin = 0.08 * float(np.ptp(dependence.at) or 1.0)
    x = (float(dependence.at[0]) - margin, float(dependence.at[-1]) + margin)
    out = []
    series = (
        ("frequency, Hz", dependence.frequency_hz, dependence.frequency_std, dependence.model_frequency_hz),
        ("damping, %", 100 * dependence.damping, 100 * dependence.damping_std, 100 * dependence.model_damping),
    )
    for mode in range(n):
        pair = []
        for name, value, std, model in series:
            y, half, curve = value[:, mode], 2.0 * std[:, mode], model[:, mode]
            low, high = min((y - half).min(), curve.min()), max((y + half).max(), curve.max())
            pad = 0.1 * (high - low) + 1e-9
            axes = Axes(x, (float(low - pad), float(high + pad)), 120.0)
            marks = [axes.line(dependence.at, curve, "after"), axes.dots(dependence.at, y, half)]
            pair.append(axes.chart(f"mode {mode + 1}: {name}", *marks, x_title=dependence.axis))
        out.append(f"<div class='pair'>{''.join(pair)}</div>")
    note = "Points: each class fitted alone, with 95 % intervals. Line: what the model with its causes predicts."
    return f"<h2>How the modes move</h2>{''.join(out)}<p class='muted'>{note}</p>"


def _story_laws(laws: Sequence[StoryLaw], *, extended: bool) -> str:
    """Draw the force of every story against its drift, and tabulate how its stiffness and its loss change with the level."""
    if not laws:
        return ""
    out, rows = [], []
    for law in laws:
        loops = [(law.measured, "measured"), (law.before, "before dashed"), (law.after, "after")][
            : 3 if extended else 2
        ]
        x, y = (
            1.05 * max(float(np.abs(getattr(loop, name)).max()) for loop, _ in loops) for name in ("drift_m", "force_n")
        )
        axes = Axes((-1e3 * x, 1e3 * x), (-y, y), 220.0)
        marks = [axes.line(1e3 * loop.drift_m, loop.force_n, kind) for loop, kind in loops]
        out.append(axes.chart(f"story {law.story}: force, N", *marks, x_title="drift, mm"))
        for i, level in enumerate(("small", "large")):
            rows.append((
                f"story {law.story}", level, f"{1e3 * law.drift_m[i]:.3g}",
                f"{law.stiffness_n_per_m[i]:.5g} ± {2.0 * law.stiffness_std[i]:.2g}", f"{law.model_stiffness_n_per_m[i]:.5g}",
                f"{100.0 * law.loss[i]:.2g} ± {200.0 * law.loss_std[i]:.1g}", f"{100.0 * law.model_loss[i]:.2g}",
                escape(law.says) if i else "",
            ))  # fmt: skip
    numbers = ["#RMS, mm", "#stiffness, N/m", "#of the model", "#loss factor, %", "#of the model"]
    head = ["story", "drifts", *numbers, "in words"]
    note = (
        "Force of a story: masses above it times their measured accelerations, less the measured forces. Drawn: the "
        "segment with the largest drift, in the band that is judged. Black: measured; the model's as in the spectra "
        "above. The table compares the third of the segments with the smallest drifts with that with the largest."
    )
    return f"<h2>Story forces, from the data</h2>{''.join(out)}{table(head, rows)}<p class='muted'>{note}</p>"


def _witnesses(compared: Sequence[Content]) -> str:
    """Tabulate what sensors of other quantities and axes say of the model and their motion in each mode; those judged first."""
    if not compared:
        return ""
    compared = sorted(compared, key=lambda w: w["verdict"] is None)
    said = [(w["channel"], w["verdict"] or "nothing to judge", w["says"]) for w in compared]
    rows = [
        (w["channel"], m["of"].replace("_", " "), f"{m['frequency_hz']:.2f}",
         interval({"value": m["ratio"], "std": m["std"]}, 1.0, w["unit"]), f"{m['coherence']:.2f}",
         *("" if m[key] is None else f"{m[key]:.3g}" for key in ("predicted_before", "predicted")))
        for w in compared for m in w["modes"]
    ]  # fmt: skip
    head = ["channel", "mode", "#Hz", "measured", "#coherence", "#predicted before", "#predicted"]
    note = (
        "They entered no fit. Measured: the channel's rotation or motion over the motion of the structure in the mode, "
        "that of a joint over the drift of the story below its floor."
    )
    return (
        f"<h2>Witnesses</h2>{table(['channel', 'verdict', 'in words'], said)}{table(head, rows, flows=True) if rows else ''}"
        f"<p class='muted'>{note}</p>"
    )


def _ranking(diagnosis: Diagnosis, content: Content) -> str:
    """Draw bars of log evidence, one chart for each round of the search."""
    accepted = [(c["effect"], c["location"]) for c in content["causes"]]
    rivals = {c.key for c, _ in diagnosis.alternatives}
    out = ["<h2>Which causes were tried</h2>"]
    for i, candidates in enumerate(diagnosis.rounds):
        shown = [c for c in candidates if np.isfinite(c.log_evidence)][:_MAX_SHOWN]
        if not shown:
            continue
        if i:
            before = " at ".join(accepted[i - 1]) if i <= len(accepted) else "the best of these"
            out.append(f"<p>With {escape(before)} in the model:</p>")
        winner = accepted[i] if i < len(accepted) else None
        last = i == len(accepted)
        kinds = ["accepted" if c.key == winner else "rival" if last and c.key in rivals else "" for c in shown]
        names = [f"{c.effect.name}, {c.effect.location}" for c in shown]
        out.append(charts.bars(names, [c.log_evidence for c in shown], kinds, "Evidence of each cause"))
    out.append(
        "<p class='muted'>Log evidence over the model without the cause, nats: 5 is odds of 150 to 1. "
        "Blue: accepted; orange: cannot be told apart; grey: not accepted.</p>"
    )
    return "".join(out)


def _parameters(diagnosis: Diagnosis, content: Content, hz: Array) -> str:
    """Tabulate the causes with their parameters, the alternatives and the causes found at calibration."""
    reference = diagnosis.posterior.prior
    out = [_refit(content["refit"])]
    lists = (("Causes", "causes"), ("Also fitted, no news", "also_fitted"), ("Already so at calibration", "standing"))
    out += [_causes(title, content[key], diagnosis) for title, key in lists]
    if content["standing_misfit"] is not None:
        out.append(f"<p>Already so at calibration: {content['standing_misfit']['says']}.</p>")
    out += [f"<p>Left out: {escape(item['says'])}.</p>" for item in content["left_out"]]
    out += [_force_spectrum(effect, hz) for effect in reference.effects(reference.mean) if effect.colour_title]
    if content["alternatives"]:
        rivals = [
            (a["effect"], a["location"], f"{100 * a['probability']:.0f} %", a["says"]) for a in content["alternatives"]
        ]
        out.append("<h2>Alternatives</h2>" + table(["effect", "place", "#probability", "in words"], rivals))
        out.append(_signatures(content["alternatives"]))
    index = content.get("ddi_effect", {})
    if index.get("with"):
        pairs = enumerate(zip(index["without"], index["with"], strict=True), 1)
        losses = [(f"story {j}", *(f"{round(100 * v, 1) + 0.0:.1f} %" for v in pair)) for j, pair in pairs]
        head = ["damage index (stiffness lost)", "#by refitting stiffness alone", "#beside the causes"]
        out.append("<h2>What it does to the damage index</h2>" + table(head, losses))
    return "".join(out)


def _refit(refitted: Sequence[Content]) -> str:
    """Tabulate what was refitted against the drawing."""
    rows = [
        (row["location"], row["parameter"], f"{row['drawn']:.5g}",
         interval({"value": row["refitted"], "std": row["std"]}, 1.0, unit(row["parameter"])),
         "" if row["tolerance"] is None else f"± {100 * row['tolerance']:.3g} %", row["says"])
        for row in refitted
    ]  # fmt: skip
    head = ["place", "parameter", "#drawn", "refitted", "#tolerance", "in words"]
    return "<h2>What was refitted against the drawing</h2>" + table(head, rows) if rows else ""


def _causes(title: str, causes: Sequence[Content], diagnosis: Diagnosis) -> str:
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
    head = ["effect", "place", "parameter", "value", "in words"]
    return f"<h2>{title}</h2>{table(head, rows)}{_signatures(causes)}" if rows else ""


def _force_spectrum(effect: Effect, hz: Annotated[Array, "bins"]) -> str:
    """Draw the power spectral density of an effect's forces."""
    density = np.asarray(effect.colour(hz))
    axes = Axes(
        (float(hz[0]), float(hz[-1])), (float(density.min()) / 1.3, float(density.max()) * 1.3), 120.0, log_y=True
    )
    return axes.chart(effect.colour_title, axes.line(hz, density, "after"), x_title="frequency, Hz")


def _signatures(causes: Sequence[Content]) -> str:
    """Describe how each kind of cause shows in the accelerations."""
    kinds = dict.fromkeys(c["effect"] for c in causes)
    says = (f"How {name} shows: {escape(FORMS[name].signature)}." for name in kinds)
    return f"<p class='muted'>{'<br/>'.join(says)}</p>"


def _data(diagnosis: Diagnosis, content: Content, segments: Segments, c: Comparison) -> str:
    """Tabulate the data and the method of the diagnosis."""
    e = diagnosis.posterior.observed
    rows = [
        ("length", f"{_minutes(segments)}; {segments.samples} sample instants"),
        ("channels", ", ".join(c.channels) + f"; source at {segments.rate_hz:g} Hz"),
        ("segments", f"{segments.t_s.size} of {1.0 / e.band.bin_hz:g} s, Hann taper, half overlapping"),
        ("classes", f"{e.counts.size} of vibration level or temperature: " + ", ".join(f"{n:g}" for n in e.counts)),
        ("band", "; ".join([f"{c.hz[0]:.2f} to {c.hz[-1]:.2f} Hz in steps of {e.band.bin_hz:g} Hz", *content["band"]["says"]])),
        ("ground motion", "measured, and used as input" if e.drive is not None else "not measured"),
        ("likelihood", "debiased Whittle likelihood of the classes' cross-spectra (complex Wishart), "
         f"tempered by {e.weight:.2f} for the correlation of neighbouring bins and segments"),
        ("reference", "baseline" if diagnosis.posterior.prior.is_baseline else "structure file"),
        ("held out", content["gain"]["heldout"]),
    ]  # fmt: skip
    return "<h2>The data judged</h2>" + table([], rows)


def _minutes(segments: Segments) -> str:
    """Write the length of the data in minutes, from the segments' middles."""
    seconds = float(np.ptp(segments.t_s)) + 1.0 / segments.band.bin_hz
    return f"{seconds / 60.0:.1f} min"
