"""Commands that diagnose the lack of fit of a simulation: diagnose, evaluate, accept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from monitor.cli.common import Healthy, Json, Recordings, Results, Structure, say, warn
from monitor.cli.progress import progress
from monitor.core import BadInputError, demand_place, missing_extra, no_empty_folder, spare_inputs, write_atomically


def diagnose(
    recordings: Recordings, structure: Structure, out: Results, baseline: Healthy = None, as_json: Json = False
) -> None:
    """Find what the simulation gets wrong, and why.

    Writes diagnosis.json, report.html, diagnosis.rrd and the extended model in DIR.
    """
    from monitor.config import configuration
    from monitor.damage import load_baseline
    from monitor.diagnosis import not_relied_on, structure_text
    from monitor.runs import diagnose as job, local_copies

    names = ("diagnosis.json", "report.html", "structure.updated.toml", "structure.extended.toml", "diagnosis.rrd")
    content, report, updated, extended, view = written = [out / name for name in names]
    spare_inputs(written, [*recordings, structure, baseline])
    settings = configuration.load_with_model(structure)
    healthy = None if baseline is None else load_baseline(baseline, settings.instrumented(), settings.updating)
    if healthy is not None and healthy.reference is None:
        raise BadInputError(f"{baseline}: {job.NO_REFERENCE}")
    with no_empty_folder(out):
        for path in written:
            demand_place(path)
        with progress("diagnose", "fetches the recordings") as on_progress, local_copies(recordings) as (copies, named):
            found = job.diagnose(copies, settings, healthy, lambda text: warn(named(text)), on_progress)
    for doubt in found.content["doubts"]:
        warn(doubt)
    text = structure.read_text(encoding="utf-8")
    write_atomically(content, json.dumps(found.content, indent=1, allow_nan=False) + "\n")
    write_atomically(updated, structure_text(text, found.updated, found.reference_degc))
    write_atomically(extended, structure_text(text, found.extended, found.reference_degc))
    from monitor.publish import write_report

    shown = found.diagnosis, found.content, found.segments, settings.story_names, found.laws
    write_report(report, *shown)
    if (missing := missing_extra("viewer")) is None:
        # Imported only now: Rerun starts threads, and no process should be forked while threads run.
        from monitor.publish import write_view

        write_view(view, *shown)
    else:
        view.unlink(missing_ok=True)  # an earlier one would be taken for this diagnosis
        warn(f"{view.name} is left out: it {missing}")
    lines = [f"{found.diagnosis.verdict}: {found.content['says']}"]
    lines += [f"  {100 * a['probability']:.0f} %: {a['says']}" for a in found.content["alternatives"]]
    lines += [f"refitted: {row['says']}" for row in found.content["refit"]]
    lines += not_relied_on(found.content)
    lines += [f"witness: {item['says']}" for item in found.content["witness"] if item["verdict"]]
    lines += [f"left out: {item['says']}" for item in found.content["left_out"]]
    at_calibration = [*found.content["standing"], *filter(None, [found.content["standing_misfit"]])]
    lines += [f"already so at calibration: {cause['says']}" for cause in at_calibration]
    lines += found.content["band"]["says"]
    if found.gain.withheld and found.diagnosis.verdict != "none":
        lines.append(f"gain on held-out data: none, {found.gain.withheld}")
    elif not found.gain.withheld:
        low, high = found.gain.ci95
        lines.append(f"gain on held-out data: {found.gain.value:.3g} nats a sample (95 %: {low:.3g} to {high:.3g})")
    lines.append(f"report in {report}")
    say("\n".join(lines), found.content, as_json)


def evaluate(recordings: Recordings, structure: Structure) -> None:
    """Score how well a model predicts recordings, as JSON.  Only the level of the excitation and the noise are fitted.

    log_score_per_sample: debiased Whittle log-likelihood in nats per sample instant, all channels together, in band_hz: 5 to
    90 % of cutoff_hz, or the part of it in which the recording shows forces.  csd_error: squared error of the mean cross-spectra
    over their own square.
    """
    from monitor.config import configuration
    from monitor.runs import diagnose as job

    settings = configuration.load_with_model(structure)
    with progress("evaluate") as on_progress:
        score = job.evaluate(recordings, settings, warn, on_progress)
    content = {
        "log_score_per_sample": score.log_score_per_sample,
        "csd_error": score.csd_error,
        "samples": score.samples,
        "band_hz": list(score.band_hz),
    }
    print(json.dumps(content, allow_nan=False))


def accept(
    finding: Annotated[Path, Argument(metavar="FINDING.json", help="diagnosis.json, or one of DIR/findings.")],
    structure: Structure,
    out: Annotated[Path, Option(metavar="OUT.toml", help="Structure file to write, with the causes.")],
    baseline: Healthy = None,
    by: Annotated[str | None, Option(metavar="NAME", help="Name of who decides; the login name by default.")] = None,
    as_json: Json = False,
) -> None:
    """Add the named causes to a structure file.  The decision is recorded in ledger.jsonl beside the written file.

    With the baseline to which the finding refers, only the causes are added: the healthy stiffness comes from the baseline.
    """
    from monitor.config import configuration
    from monitor.damage import load_baseline
    from monitor.runs import ledger

    spare_inputs([out, out.parent / ledger.LEDGER], [finding, structure, baseline])
    content = ledger.read_finding(finding)
    settings = configuration.load(structure)
    if baseline is not None:
        for doubt in load_baseline(baseline, settings.instrumented(), settings.updating).doubts:
            warn(doubt)
    text = structure.read_text(encoding="utf-8")
    extended = ledger.extended_structure_text(finding, content, text, settings, with_baseline=baseline is not None)
    demand_place(out)
    write_atomically(out, extended)
    files = {"finding": finding, "structure": structure, "baseline": baseline, "out": out}
    kept = ledger.append_entry(out, content, files, by)
    text = f"{content['says']}\nextended model in {out}; noted in {kept}"
    say(text, {"accepted": content["says"], "structure": str(out), "ledger": str(kept)}, as_json)
