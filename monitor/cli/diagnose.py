"""The commands on what a simulation gets wrong: diagnose, evaluate, accept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.common import Json, Recordings, Structure, progress, say, warn
from monitor.core import demand_place, spare_inputs, write_atomically

Healthy = Annotated[Path | None, typer.Option(metavar="B.json", help="Healthy baseline by 'calibrate'.")]


def diagnose(
    recordings: Recordings,
    structure: Structure,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")],
    baseline: Healthy = None,
    as_json: Json = False,
) -> None:
    """What the simulation gets wrong, and why.

    Writes diagnosis.json, report.html, diagnosis.rrd and the extended model in DIR.
    """
    from monitor.config import configuration
    from monitor.damage import load_baseline
    from monitor.diagnosis import structure_text
    from monitor.runs import diagnose as job

    names = ("diagnosis.json", "report.html", "structure.updated.toml", "structure.extended.toml", "diagnosis.rrd")
    content, report, updated, extended, view = (out / name for name in names)
    spare_inputs([content, report, updated, extended, view], [*recordings, structure, baseline])
    settings = configuration.load(structure)
    healthy = None if baseline is None else load_baseline(baseline, settings.instrumented(), settings.updating)
    for path in (content, report, updated, extended, view):
        demand_place(path)
    found = job.diagnose(recordings, settings, healthy, warn, progress("diagnose"))
    text = structure.read_text(encoding="utf-8")
    write_atomically(content, json.dumps(found.content, indent=1, allow_nan=False) + "\n")
    write_atomically(updated, structure_text(text, found.updated, found.reference_degc))
    write_atomically(extended, structure_text(text, found.extended, found.reference_degc))
    # Rerun starts threads of its own, beside which nothing should be forked.
    from monitor.publish import write_report, write_view

    write_report(report, found.diagnosis, found.content, found.segments)
    write_view(view, found.diagnosis, found.content, found.segments)
    lines = [f"{found.diagnosis.verdict}: {found.content['says']}"]
    stood = [*found.content["standing"], *filter(None, [found.content["standing_misfit"]])]
    lines += [f"already so at calibration: {one['says']}" for one in stood]
    if found.diagnosis.verdict != "none":
        low, high = found.gain.ci95
        lines.append(f"gain on held-out data: {found.gain.value:.3g} nats a sample (95 %: {low:.3g} to {high:.3g})")
    lines.append(f"report in {report}")
    say("\n".join(lines), found.content, as_json)


def evaluate(recordings: Recordings, structure: Structure) -> None:
    """How well a model predicts recordings, as JSON.  Nothing but the excitation's level and the noise is fitted.

    log_score_per_sample: nats per sample instant, all channels together, in the band from 5 to 90 % of cutoff_hz, by the
    debiased Whittle likelihood.  csd_error: squared error of the mean cross-spectra over their own square.
    """
    from monitor.config import configuration
    from monitor.runs import diagnose as job

    score = job.evaluate(recordings, configuration.load(structure), warn, progress("evaluate"))
    plain = {
        "log_score_per_sample": score.log_score_per_sample,
        "csd_error": score.csd_error,
        "samples": score.samples,
    }
    print(json.dumps(plain, allow_nan=False))


def accept(
    finding: Annotated[Path, typer.Argument(metavar="FINDING.json", help="diagnosis.json, or one of DIR/findings.")],
    structure: Structure,
    out: Annotated[Path, typer.Option(metavar="OUT.toml", help="Structure file to write, with the causes.")],
    baseline: Healthy = None,
    by: Annotated[str | None, typer.Option(metavar="NAME", help="Who decides; the login name by default.")] = None,
    as_json: Json = False,
) -> None:
    """Take a named cause into the structure file.  The decision is written into ledger.jsonl beside it.

    With the baseline that the finding refers to, the causes alone are added: the baseline brings the healthy stiffness.
    """
    from monitor.config import configuration
    from monitor.damage import load_baseline
    from monitor.runs import ledger

    spare_inputs([out, out.parent / ledger.LEDGER], [finding, structure, baseline])
    content = ledger.read_finding(finding)
    settings = configuration.load(structure)
    if baseline is not None:
        load_baseline(baseline, settings.instrumented(), settings.updating)
    text = structure.read_text(encoding="utf-8")
    extended = ledger.extended_structure_text(finding, content, text, settings, with_baseline=baseline is not None)
    demand_place(out)
    write_atomically(out, extended)
    files = {"finding": finding, "structure": structure, "baseline": baseline, "out": out}
    kept = ledger.append_entry(out, content, files, by)
    text = f"{content['says']}\nextended model in {out}; noted in {kept}"
    say(text, {"accepted": content["says"], "structure": str(out), "ledger": str(kept)}, as_json)
