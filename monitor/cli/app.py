"""The commands; `monitor.core.errors` has their exit codes, README.md and docs/ what they are for."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Annotated

import typer
from threadpoolctl import threadpool_limits

from monitor import __version__
from monitor.cli import diagnose, emulate, operate, report, reprocess, view
from monitor.cli import fleet as cli_fleet
from monitor.cli import run as cli_run
from monitor.cli.common import Json, Recordings, Structure, address, leave_unread, progress, say, time_ns, warn
from monitor.config import configuration, security_check
from monitor.core import (
    BadConfigurationError,
    MissingInputError,
    NoResourcesError,
    UserError,
    demand_place,
    keep_freed,
    spare_inputs,
    write_atomically,
)
from monitor.identification import stabilization
from monitor.service import outlets

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # it would take what stands in square brackets for its own
    context_settings={"max_content_width": 120},
    help="Online structural health monitor: identification, model updating, damage index, alarms. SI units, UTC.",
)

app.command()(diagnose.diagnose)
app.command()(diagnose.evaluate)
app.command()(diagnose.accept)
app.command()(cli_run.run)
app.command()(emulate.emulate)
app.command()(report.report)
app.command()(operate.status)
app.command()(operate.ack)
app.command()(operate.export)
app.command()(reprocess.reprocess)
app.command()(view.view)
app.command()(cli_fleet.fleet)


@app.command()
def replay(
    recordings: Recordings,
    structure: Structure,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")],
    baseline: Annotated[Path | None, typer.Option(metavar="B.json", help="Healthy baseline by 'calibrate'.")] = None,
    speed: Annotated[str, typer.Option(help="'max', or times real time.")] = "max",
    serve: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Rerun viewers may join here, as 127.0.0.1:9876.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run recordings through the monitor.  Writes results.jsonl, results.mcap, live.rrd and summary.json in DIR."""
    from monitor.damage import load_baseline
    from monitor.publish import replay_text
    from monitor.runs import replay as run

    spare_inputs([out / name for name in run.RESULT_FILES], [*recordings, structure, baseline])
    pace, served = emulate.parse_speed(speed), address(serve)
    settings = configuration.load(structure)
    healthy = None if baseline is None else load_baseline(baseline, settings.instrumented(), settings.updating)
    summary = run.replay(
        recordings,
        settings,
        healthy,
        out,
        speed=pace,
        serve=served,
        files=(structure, baseline),
        on_warning=warn,
        on_progress=progress("replay"),
    )
    story = replay_text(summary, has_baseline=healthy is not None)
    text = f"{story}\nresults in {out}; look at them with: shm-monitor view {out}"
    say(text, {**summary, "out": str(out)}, as_json)


@app.command()
def calibrate(
    recordings: Recordings,
    structure: Structure,
    out: Annotated[Path, typer.Option(metavar="B.json", help="Baseline file to write.")],
    as_json: Json = False,
) -> None:
    """Learn the healthy baseline.  It holds the updated stiffness with covariance, modes, the misfit that remains."""
    from monitor.damage import save_baseline
    from monitor.runs import calibrate as run

    spare_inputs([out], [*recordings, structure])
    settings = configuration.load(structure)
    demand_place(out)
    baseline, fit = run.calibrate(recordings, settings, on_warning=warn, on_progress=progress("calibrate"))
    save_baseline(baseline, out)
    drawn = settings.model().modes().frequencies_hz
    lines = [f"{baseline.windows} windows; the updating {'converged' if fit.converged else 'did NOT converge'}"]
    for i, (f, std) in enumerate(zip(baseline.frequencies_hz, baseline.frequencies_std_hz, strict=True), start=1):
        lines.append(f"mode {i}: {f:.4f} ± {2 * std:.4f} Hz; structure file {drawn[baseline.model_mode[i - 1]]:.4f} Hz")
    for j, k in enumerate(baseline.model.structure.stiffness_n_per_m, start=1):
        lines.append(f"story {j}: {k:.1f} N/m; structure file {settings.structure.stiffness_n_per_m[j - 1]:.1f} N/m")
    if (law := baseline.temperature) is not None:
        slopes = ", ".join(f"{1e3 * a:+.2f}" for a in law.per_degc)
        lines.append(
            f"stiffness follows the temperature by {slopes} per mille a kelvin, lag {law.lag_s:.0f} s; "
            f"seen from {law.range_degc[0]:.1f} to {law.range_degc[1]:.1f} degC"
        )
    elif baseline.reference_temperature_degc is not None:
        lines.append(
            "no dependence on the temperature learned: too narrow a range, too short a record, or nothing showed"
        )
    lines.append(f"baseline in {out}")
    content = {
        "baseline": str(out),
        "windows": baseline.windows,
        "converged": bool(fit.converged),
        "frequencies_hz": baseline.frequencies_hz.tolist(),
        "frequencies_std_hz": baseline.frequencies_std_hz.tolist(),
        "stiffness_n_per_m": baseline.model.structure.stiffness_n_per_m.tolist(),
        "structure_file_frequencies_hz": drawn.tolist(),
        "structure_file_stiffness_n_per_m": list(settings.structure.stiffness_n_per_m),
    }
    say("\n".join(lines), content, as_json)


@app.command()
def simulate(
    structure: Structure,
    out: Annotated[Path | None, typer.Option(metavar="REC.mcap", help="Recording to write; or give --to.")] = None,
    duration: Annotated[float, typer.Option(min=0.01, max=1e8, help="Length in s.")] = 1200.0,
    excitation: Annotated[str, typer.Option(help="ambient, impulse or ground.")] = "ambient",
    noise: Annotated[
        float, typer.Option(min=0.0, max=1e3, help="Sensor noise, fraction of the mean RMS acceleration.")
    ] = 0.05,
    damage: Annotated[list[str], typer.Option(metavar="storyN=LOSS", help="Relative stiffness loss.")] = [],  # noqa: B006
    effect: Annotated[list[str], typer.Option(metavar="NAME:LOCATION:PARAM=VALUE,...", help="Hidden effect.")] = [],  # noqa: B006
    rate: Annotated[float, typer.Option(min=1.0, max=1e6, help="Sample rate in Hz.")] = 1024.0,
    level_spread: Annotated[
        float, typer.Option(min=0.0, max=10.0, help="Relative spread of the excitation's level.")
    ] = 0.0,
    temperature: Annotated[
        str | None,
        typer.Option(
            metavar="MEAN[,SWING[,PERIOD_S[,REFERENCE]]]",
            help="Also record /temperature, in degC: a cosine, SWING from lowest to highest. With temperature_stiffness "
            "20,10,DURATION by default; REFERENCE, by default MEAN, is where the stiffness is the structure file's.",
        ),
    ] = None,
    start: Annotated[str, typer.Option(help="UTC of the first sample, ISO 8601.")] = "2026-01-01T00:00:00",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
    to: emulate.OptionalTo = None,
    dbc: emulate.Dbc = None,
    speed: emulate.Speed = None,
    as_json: Json = False,
) -> None:
    """Write a recording with known truth, or send it.  With --to it is sent as sensor nodes would."""
    from monitor.runs import synthetic_recording

    if out is None and to is None:
        raise typer.BadParameter("name a recording to write (--out), a destination (--to), or both")
    spare_inputs([] if out is None else [out], [structure, dbc])
    t0_ns = time_ns("--start", start) or 0
    with emulate.recording_for(out, to, dbc, speed) as file:
        synthetic_recording.write_simulated_recording(
            file,
            configuration.load(structure),
            duration_s=duration,
            excitation=excitation,
            noise=noise,
            damage=damage,
            effects=effect,
            rate_hz=rate,
            level_spread=level_spread,
            t0_ns=t0_ns,
            seed=seed,
            temperature=temperature,
        )
    if out is not None:
        say(f"{duration:g} s in {out}", {"recording": str(out), "duration_s": duration, "seed": seed}, as_json)


@app.command("import")
def import_(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="CSV, NPZ, CAN log; several: one a level.")],
    out: Annotated[Path, typer.Option(metavar="REC.mcap", help="Recording to write.")],
    rate: Annotated[
        float | None, typer.Option(min=0.001, max=1e7, help="Sample rate in Hz, where the file has no time.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Unit of the samples: m/s^2, g, mg or gal.")] = "m/s^2",
    channel: Annotated[
        list[str], typer.Option(metavar="NAME=FILE[:COLUMN]", help="A channel; of one file, NAME=COLUMN.")
    ] = [],  # noqa: B006
    ground: Annotated[str | None, typer.Option(metavar="FILE[:COLUMN]", help="Measured base motion.")] = None,
    start: Annotated[str | None, typer.Option(help="UTC of the first sample, ISO 8601.")] = None,
    dbc: Annotated[Path | None, typer.Option(metavar="FILE.dbc", help="What the frames of a CAN log mean.")] = None,
    as_json: Json = False,
) -> None:
    """Foreign data to our recording format."""
    from monitor.runs import import_files

    spare_inputs([out], [*files, dbc])
    channels = {}
    for item in channel:
        name, separator, place = item.partition("=")
        if not separator or not name or not place:
            raise typer.BadParameter(f"--channel: {item!r} is not NAME=FILE[:COLUMN]")
        if name in channels:
            raise typer.BadParameter(f"--channel: {name!r} stands twice")
        channels[name] = place
    info = import_files(
        files,
        out,
        rate_hz=rate,
        unit=unit,
        channels=channels or None,
        ground=ground,
        start_ns=time_ns("--start", start),
        dbc=dbc,
        on_warning=warn,
    )
    names = "; ".join(f"{topic}: {', '.join(c)}" for topic, c in info.channels.items())
    text = f"{info.duration_s:.2f} s at {info.sample_rate_hz:g} Hz in {out}: {names}"
    content = {"duration_s": info.duration_s, "sample_rate_hz": info.sample_rate_hz, "channels": dict(info.channels)}
    say(text, {"recording": str(out), **content}, as_json)


@app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="Structure file, site file or fleet file.")],
    as_json: Json = False,
) -> None:
    """List every problem of a file at once.  A structure file, a site file or a fleet file."""
    if "fleet" in configuration.read_toml(file):
        from monitor.service import fleet

        sites = fleet.load(file).sites
        say(
            f"{file}: no problems; sites {', '.join(sites) or 'none named'}",
            {"file": str(file), "sites": sites},
            as_json,
        )
        return
    settings = configuration.load(file)
    outlets.make_outlets(file, settings, dry=True)
    for open_door in security_check.warnings(file, settings):
        warn(open_door)
    modes, p = settings.model().modes(), settings.processing
    frequencies = modes.frequencies_hz
    head = f"{file}: no problems; {len(settings.structure.masses_kg)} stories, channels {', '.join(settings.channels)}"
    text = f"{head}\nnatural frequencies: {', '.join(f'{f:.4g}' for f in frequencies)} Hz"
    content = {"file": str(file), "channels": list(settings.channels), "frequencies_hz": frequencies.tolist()}
    say(text, content, as_json)
    beyond = [f"{f:.4g}" for f in frequencies if f > p.cutoff_hz]
    if beyond:
        warn(f"modes at {', '.join(beyond)} Hz lie beyond cutoff_hz = {p.cutoff_hz:g}")
    if lags := stabilization.advice(modes, p.rate_hz, p.cutoff_hz, settings.identification, settings.selection):
        warn(lags)


@app.command()
def reproduce(
    json_file: Annotated[Path | None, typer.Option("--json", metavar="F", help="Also write the figures here.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Simulated tests of each kind.")] = 100,
) -> None:
    """The paper's Tables 2-7 and DDI figures beside ours."""
    from monitor.runs import paper_tables as paper

    if json_file is not None:
        demand_place(json_file)
    content = paper.reproduce(seeds, on_progress=progress("reproduce"))
    print(paper.tables_text(content))
    if json_file is not None:
        write_atomically(json_file, json.dumps(content, indent=1, allow_nan=False) + "\n")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")] = Path("out/demo"),
    recordings: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the shipped recordings.")] = Path(
        "recordings"
    ),
) -> None:
    """Calibrate, watch damage appear, replay a measured frame.  All from the shipped recordings."""
    from monitor.runs import demo as tour

    tour.run(recordings, out, say=print, on_warning=warn)


@app.callback(invoke_without_command=True)
def _main(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        print(__version__)
        raise typer.Exit


def main() -> None:
    """Entry point: user errors become one message and the contract's exit code."""
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s", level=logging.WARNING)
    keep_freed()
    leave_unread(app)
    try:
        # Small matrices: threads of the linear algebra only get in each other's way.
        with threadpool_limits(limits=1):
            app()
    except UserError as error:
        kind = "bad configuration\n" if isinstance(error, BadConfigurationError) else ""
        print(f"error: {kind}{error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        mend = "; run this as its owner or as root" if isinstance(error, PermissionError) else ""
        print(f"error: {place}{error.strerror or error}{mend}", file=sys.stderr)
        raise SystemExit(MissingInputError.exit_code) from None
    except MemoryError as error:
        print(f"error: too little memory: {error}", file=sys.stderr)
        raise SystemExit(NoResourcesError.exit_code) from None
