"""Commands that create recordings: simulate, import."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, BadParameter, Option, prompt

from monitor.cli.common import Json, Structure, say, time_ns, warn
from monitor.cli.emulate import Dbc, OptionalTo, Speed, recording_for
from monitor.cli.progress import ProgressLine, progress
from monitor.cli.reader_options import reads_files
from monitor.core import spare_inputs, utc

if TYPE_CHECKING:
    from monitor.runs import Options


def simulate(
    structure: Structure,
    out: Annotated[Path | None, Option(metavar="REC.mcap", help="Recording to write; or give --to.")] = None,
    duration: Annotated[float, Option(min=0.01, max=1e8, help="Length in s.")] = 1200.0,
    excitation: Annotated[str, Option(help="ambient, impulse, ground, force or sweep (a shaker).")] = "ambient",
    noise: Annotated[
        float, Option(min=0.0, max=1e3, help="Sensor noise, fraction of the mean RMS acceleration.")
    ] = 0.05,
    damage: Annotated[
        list[str],
        Option(metavar="storyN=LOSS", help="Loss of stiffness; or storeyNx=, y=, torsion=."),
    ] = [],  # noqa: B006
    effect: Annotated[list[str], Option(metavar="NAME:LOCATION:PARAM=VALUE,...", help="Hidden effect.")] = [],  # noqa: B006
    rate: Annotated[float, Option(min=1.0, max=1e6, help="Sample rate in Hz.")] = 1024.0,
    level_spread: Annotated[float, Option(min=0.0, max=10.0, help="Relative spread of the excitation's level.")] = 0.0,
    temperature: Annotated[
        str | None,
        Option(
            metavar="MEAN[,SWING[,PERIOD_S[,REFERENCE]]]",
            help="Also record /temperature, in degC: a cosine, SWING from lowest to highest. With temperature_stiffness "
            "20,10,DURATION by default; REFERENCE, by default MEAN, is where the stiffness is the structure file's.",
        ),
    ] = None,
    start: Annotated[str, Option(help="UTC of the first sample, ISO 8601.")] = "2026-01-01T00:00:00",
    seed: Annotated[int, Option(min=0, help="Seed of the random numbers.")] = 0,
    to: OptionalTo = None,
    dbc: Dbc = None,
    speed: Speed = None,
    as_json: Json = False,
) -> None:
    """Simulate a recording of a known structure.  It is written to --out, or sent to --to as sensor nodes would send it."""
    from monitor.config import configuration
    from monitor.runs import synthetic_recording

    if out is None and to is None:
        raise BadParameter("name a recording to write (--out), a destination (--to), or both")
    spare_inputs([] if out is None else [out], [structure, dbc])
    t0_ns = time_ns("--start", start) or 0
    with recording_for(out, to, dbc, speed) as file:
        settings = configuration.load_with_model(structure)
        highest_hz = float(settings.model().modes().frequencies_hz[-1])
        if highest_hz > rate / 2.0:
            warn(
                f"{structure}: the highest mode, {highest_hz:.4g} Hz, lies beyond half of --rate; such modes fold into the "
                f"band, since no filter comes before the samples: set --rate {2.0 * highest_hz:.0f} or more"
            )
        with progress("simulate") as on_progress:
            synthetic_recording.write_simulated_recording(
                file,
                settings,
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
                on_progress=on_progress,
            )
    if out is not None:
        say(f"{duration:g} s in {out}", {"recording": str(out), "duration_s": duration, "seed": seed}, as_json)


@reads_files()
def import_(
    files: Annotated[
        list[Path],
        Argument(
            metavar="FILE...",
            help="Table of text, XLSX, NPZ, MAT, HDF5, UFF, TDMS, MDF, GeoCSV, seismic record or CAN log; or one file a level.",
        ),
    ],
    out: Annotated[Path | None, Option(metavar="REC.mcap", help="Recording to write.")] = None,
    *,
    reading: Options,
    explain: Annotated[
        bool,
        Option("--explain", help="Print what each part of a table of text was taken for, and why; writes nothing."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Convert foreign data to the recording format.

    Prints what was taken: start, rate, unit and level.
    """
    from drivers.base import UNIT_OF
    from monitor.runs import ImportedChannel, import_files

    if explain:
        _explain(files, reading.time, as_json)
        return
    if out is None:
        raise BadParameter("name a recording to write: --out REC.mcap")
    spare_inputs([out], [*files, reading.dbc, reading.inventory])
    taken: list[ImportedChannel] = []
    with progress("import") as on_progress:
        info = import_files(
            files,
            out,
            reading,
            ask_unit=partial(_ask_unit, on_progress) if sys.stdin.isatty() and sys.stderr.isatty() else None,
            on_warning=warn,
            on_channel=taken.append,
            on_progress=on_progress,
        )
    start_text = f"{utc(info.t_start_ns, seconds=True)} UTC"
    names = "; ".join(f"{topic}: {', '.join(c)}" for topic, c in info.channels.items())
    text = [f"{info.duration_s:.2f} s at {info.sample_rate_hz:g} Hz from {start_text} in {out}: {names}"]
    for one in taken:
        origin = "by the column's name" if one.by_name else "stated in the file" if one.stated else "taken"
        level = f"mean {one.mean:.4g}, RMS about it {one.rms:.4g} {UNIT_OF.get(one.topic, one.unit)}"
        text.append(f"  {one.name}: {one.source}, unit {one.unit} ({origin}), {level}")
    content = {
        "recording": str(out),
        "start_ns": info.t_start_ns,
        "duration_s": info.duration_s,
        "sample_rate_hz": info.sample_rate_hz,
        "channels": dict(info.channels),
        "taken": [asdict(one) for one in taken],
    }
    say("\n".join(text), content, as_json)


def _explain(files: list[Path], time: str | None, as_json: bool) -> None:
    """Print how tables of text are read."""
    from monitor.runs import explain_table

    rows = {str(path): explain_table(path, time) for path in files}
    lines = []
    for path, found in rows.items():
        wide = [max(len(row[k]) for row in found) for k in (0, 1)]
        lines += [f"{path}:", *(f"  {a:<{wide[0]}}  {b:<{wide[1]}}  {why}" for a, b, why in found)]
    say("\n".join(lines), {path: [list(row) for row in found] for path, found in rows.items()}, as_json)


def _ask_unit(progress_line: ProgressLine, columns: Sequence[str]) -> str:
    """Ask on the terminal for the unit of columns whose file states none, until the answer is a unit."""
    from monitor.runs import acceleration_unit

    shown = ", ".join(columns[:4]) + (f" and {len(columns) - 4} more" if len(columns) > 4 else "")
    progress_line.is_paused = True
    while True:
        answer = str(prompt(f"Unit of {shown} (m/s^2, g, mg, gal)", default="m/s^2", err=True))
        if acceleration_unit(answer):
            progress_line.is_paused = False
            return answer
        print(f"{answer!r} is no unit of acceleration", file=sys.stderr)
