"""Command that judges features without waveforms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, BadParameter, Option

from monitor.cli.common import Json, Results, say, time_ns, warn
from monitor.cli.progress import progress
from monitor.cli.reader_options import reads_files
from monitor.core import spare_inputs

if TYPE_CHECKING:
    from monitor.runs import Options


@reads_files("timezone", "start")
def features(
    table: Annotated[
        Path, Argument(metavar="FILE", help="Times, features and covariates in columns, as 'import' reads.")
    ],
    time: Annotated[str, Option(metavar="COLUMN", help="Column of the times (ISO 8601, or s since 1970).")],
    names: Annotated[str, Option("--features", metavar="F1,F2", help="Columns of the features.")],
    train_until: Annotated[str, Option(metavar="TIME", help="End of the healthy part, ISO 8601.")],
    out: Results,
    covariates: Annotated[
        str, Option(metavar="C1,C2", help="Columns of the covariates, as temperature and wind.")
    ] = "",
    false_announcements_per_year: Annotated[
        float, Option(min=1e-6, max=1e4, help="False announcements that are allowed in a year.")
    ] = 0.1,
    *,
    reading: Options,
    as_json: Json = False,
) -> None:
    """Judge features without waveforms, less what covariates explain.

    Writes results.jsonl, results.mcap, live.rrd and summary.json in DIR, as 'replay' does.
    """
    from monitor.damage import State
    from monitor.runs import features as run, replay

    until_ns = time_ns("--train-until", train_until)
    assert until_ns is not None
    spare_inputs([out / name for name in replay.RESULT_FILES], [table])
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    if not wanted:
        raise BadParameter("--features: name at least one column")
    others = [name.strip() for name in covariates.split(",") if name.strip()]
    with progress("features") as on_progress:
        summary = run.features(
            table,
            replace(reading, time=time),
            wanted,
            others,
            until_ns,
            out,
            warn,
            on_progress,
            false_announcements_per_year,
        )
    lines = [
        f"{f['feature']}: {100 * f['variance_explained']:.0f} % of its healthy variance explained, "
        f"{f['residual_std']:.3g} left (one standard deviation)"
        for f in summary["features"]
    ]
    lines.append(f"{summary['judged']} rows judged, {summary['skipped']} not; {summary['announced']} announced")
    lines += [f"{State(summary['state']).words}: {summary['headline']}", *(f"  {doubt}" for doubt in summary["doubts"])]
    look = f"; look at them with: shm-monitor view {out}" if (out / "live.rrd").exists() else ""
    say("\n".join([*lines, f"results in {out}{look}"]), {**summary, "out": str(out)}, as_json)
