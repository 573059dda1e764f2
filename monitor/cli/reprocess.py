"""Command `reprocess`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from monitor.cli.common import Healthy, Json, Structure, say, warn
from monitor.cli.progress import progress
from monitor.core import BadInputError, require_extra


def reprocess(
    recordings: Annotated[
        list[str],
        Argument(metavar="GLOB...", help="Recordings, or patterns as 'archive/**/*.mcap' or 's3://archive/*.mcap'."),
    ],
    structure: Structure,
    out: Annotated[
        Path, Option(metavar="DIR", help="Folder for the results; results that it already has are not computed again.")
    ],
    baseline: Healthy = None,
    diagnose: Annotated[bool, Option("--diagnose", help="Also diagnose each recording by itself.")] = False,
    gap: Annotated[
        float | None,
        Option(min=0.0, max=1e9, help="Pause in s after which a recording begins a new replay; window_s by default."),
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(metavar="ADDRESS", help="Dask scheduler, as tcp://127.0.0.1:8786; local processes by default."),
    ] = None,
    workers: Annotated[int | None, Option(min=1, max=1024, help="Local processes; one a core by default.")] = None,
    as_json: Json = False,
) -> None:
    """Replay an archive on many processes.  Writes a Parquet dataset of all windows in DIR/windows.

    Consecutive recordings of one folder are replayed together, with the results that 'replay' gives for them.
    """
    require_extra("archive", "reprocess")
    from monitor.runs import WINDOWS, expand_patterns, reprocess as run

    with progress("reprocess") as on_progress:
        outcomes = run(
            expand_patterns(recordings),
            structure,
            baseline,
            out,
            diagnose=diagnose,
            longest_gap_s=gap,
            scheduler=scheduler,
            workers=workers,
            on_progress=on_progress,
        )
    for outcome in outcomes:
        for message in outcome.warnings:
            warn(f"{outcome.name}: {message}")
    done, done_before = (sum(o.error is None and o.made is made for o in outcomes) for made in (True, False))
    errors, windows = [o.error for o in outcomes if o.error is not None], str(out / WINDOWS)
    content = {"done": done, "done_before": done_before, "failed": len(errors), "windows": windows}
    say(f"{done} done, {done_before} done before; windows in {windows}", content, as_json)
    if errors:
        raise BadInputError("\n".join([f"{len(errors)} could not be done", *errors]))
