"""Commands that process recordings with the pipeline: replay, calibrate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, BadParameter, Option

from monitor.cli.common import Healthy, Json, Recordings, Results, Serve, Structure, address, say, warn
from monitor.cli.emulate import parse_speed
from monitor.cli.progress import progress
from monitor.cli.reader_options import reads_files
from monitor.core import demand_place, no_empty_folder, spare_inputs, storey_of

if TYPE_CHECKING:
    from monitor.config import Configuration
    from monitor.damage import Baseline, ModalBaseline
    from monitor.runs import Options


@reads_files()
def replay(
    recordings: Recordings,
    structure: Structure,
    out: Results,
    baseline: Healthy = None,
    speed: Annotated[str, Option(help="'max', or a multiple of real time; gaps are not waited for.")] = "max",
    serve: Serve = None,
    *,
    reading: Options,
    as_json: Json = False,
) -> None:
    """Run recordings through the monitor.  Writes results.jsonl, events.jsonl, results.mcap, live.rrd and summary.json in DIR."""
    from monitor.config import configuration
    from monitor.publish import replay_text
    from monitor.runs import as_recordings, load_healthy, replay as run

    spare_inputs(
        [out / name for name in run.RESULT_FILES], [*recordings, structure, baseline, reading.dbc, reading.inventory]
    )
    pace, served = parse_speed(speed), address(serve)
    settings = configuration.load(structure)
    healthy = None if baseline is None else load_healthy(baseline, settings)
    with as_recordings(recordings, reading, warn) as paths, no_empty_folder(out), progress("replay") as on_progress:
        summary = run.replay(
            paths,
            settings,
            healthy,
            out,
            speed=pace,
            serve=served,
            files=(structure, baseline),
            on_warning=warn,
            on_progress=on_progress,
        )
    summary_text = replay_text(summary)
    look = f"; look at them with: shm-monitor view {out}" if (out / "live.rrd").exists() else ""
    page = f"\npage of the last event: shm-monitor report {out} --event last" if summary["events"] else ""
    text = f"{summary_text}\nresults in {out}{look}{page}"
    say(text, {**summary, "out": str(out)}, as_json)


def calibrate(
    structure: Structure,
    out: Annotated[Path, Option(metavar="B.json", help="Baseline file to write.")],
    recordings: Annotated[
        list[Path] | None, Argument(metavar="REC.mcap...", help="Healthy recordings, in any order.")
    ] = None,
    rebase: Annotated[
        Path | None,
        Option(metavar="OLD.json", help="Baseline of this structure whose drawing was changed; needs no recordings."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Estimate the healthy baseline.  It holds the updated stiffness with its covariance, the modes and the remaining misfit.

    With --rebase the healthy modes are those of another baseline of the same structure, and the changed drawing is updated to
    them.  Exit code 65 if the updating did not converge; the baseline is written all the same, to look at.
    """
    from monitor.config import configuration
    from monitor.core import BadInputError
    from monitor.damage import law_lines, save_baseline
    from monitor.diagnosis import standing_causes
    from monitor.runs import calibrate as run

    recordings = recordings or []
    if bool(recordings) == (rebase is not None):
        raise BadParameter("name either healthy recordings, or a baseline with --rebase")
    spare_inputs([out], [*recordings, structure, rebase])
    settings = configuration.load(structure) if rebase is None else configuration.load_with_model(structure)
    demand_place(out)
    if not settings.has_model:
        _calibrate_modes(recordings, settings, out, as_json)
        return
    if rebase is not None:
        with progress("calibrate", "updates the drawing"):
            baseline, says, converged = run.rebase(rebase, settings)
        lines = [f"{rebase} with the drawing of {structure}:", *says]
        content: dict[str, Any] = {"rebased": str(rebase), "says": list(says), "converged": converged}
    else:
        with progress("calibrate") as on_progress:
            baseline, fit = run.calibrate(recordings, settings, on_warning=warn, on_progress=on_progress)
        converged = bool(fit.converged)
        lines = [f"{baseline.windows} windows; the updating {'converged' if converged else 'did NOT converge'}"]
        content = {"converged": converged}
    save_baseline(baseline, out)
    nominal_hz = settings.model().modes().frequencies_hz
    for k, f, std in zip(baseline.model_mode, baseline.frequencies_hz, baseline.frequencies_std_hz, strict=True):
        lines.append(f"mode {k + 1}: {_interval(f, std, 'Hz')}; structure file {nominal_hz[k]:.4f} Hz")
    relative_std = baseline.covariance.diagonal() ** 0.5
    stiffness, as_drawn = baseline.model.structure.stiffness_n_per_m, settings.drawn.stiffness_n_per_m
    for name, k, drawn, std in zip(settings.story_names, stiffness, as_drawn, relative_std, strict=False):
        change = f"{100.0 * (k / drawn - 1.0):+.1f} %"
        of = "N m/rad" if (storey_of(name) or ("", ""))[1] == "torsion" else "N/m"
        lines.append(f"{name}: {_interval(k, k * std, of)}; structure file {drawn:.5g} {of} ({change})")
    if baseline.reference is not None:
        lines += [f"already so at calibration: {cause['says']}" for cause in standing_causes(baseline.reference)]
    lines += law_lines(baseline.law)
    lines.append(f"baseline in {out}: what differs from the structure file here counts as healthy from now on")
    content |= _learned(baseline, out) | {
        "stiffness_n_per_m": stiffness.tolist(),
        "structure_file_frequencies_hz": nominal_hz.tolist(),
        "structure_file_stiffness_n_per_m": list(as_drawn),
    }
    say("\n".join(lines), content, as_json)
    if not converged:
        raise BadInputError(
            f"{out}: the updating did NOT converge: no stiffnesses of {structure} have the measured modes, so losses against "
            "this baseline are not to be trusted; check floors and signs of the sensors and the masses, or draw what is missing"
        )


def _calibrate_modes(recordings: list[Path], settings: Configuration, out: Path, as_json: bool) -> None:
    """Learn the healthy modes of a structure without a model, and tell them."""
    from monitor.damage import law_lines, save_baseline
    from monitor.runs import calibrate as run

    with progress("calibrate") as on_progress:
        baseline = run.calibrate_modes(recordings, settings, on_warning=warn, on_progress=on_progress)
    save_baseline(baseline, out)
    lines = [f"{baseline.windows} windows"]
    rows = zip(
        baseline.frequencies_hz, baseline.frequencies_std_hz, baseline.damping_ratio, baseline.shapes, strict=True
    )
    for k, (f, std, damping, shape) in enumerate(rows, 1):
        moves = ", ".join(f"{c} {x:+.2f}" for c, x in zip(baseline.channels, shape, strict=True))
        lines.append(f"mode {k}: {_interval(f, std, 'Hz')}, damping {100 * damping:.2g} %; {moves}")
    lines += law_lines(baseline.law, "the squares of the frequencies")
    lines.append(f"baseline in {out}: the modes of this structure, with which later ones are compared")
    shapes = {"damping_ratio": baseline.damping_ratio.tolist(), "mode_shapes": baseline.shapes.tolist()}
    say("\n".join(lines), _learned(baseline, out) | shapes, as_json)


def _interval(value: float, std: float, unit: str) -> str:
    """Write a value with its uncertainty."""
    from monitor.model import interval

    return interval({"value": float(value), "std": float(std)}, 1.0, unit)


def _learned(baseline: Baseline | ModalBaseline, out: Path) -> dict[str, Any]:
    """Return what the JSON of either calibration begins with."""
    return {
        "baseline": str(out),
        "windows": baseline.windows,
        "frequencies_hz": baseline.frequencies_hz.tolist(),
        "frequencies_std_hz": baseline.frequencies_std_hz.tolist(),
    }
