"""Commands that demonstrate the monitor: reproduce, demo."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from typer import Option

from monitor.cli.common import warn
from monitor.cli.progress import progress
from monitor.core import demand_place, write_atomically


def reproduce(
    json_file: Annotated[Path | None, Option("--json", metavar="F", help="Also write the figures here.")] = None,
    seeds: Annotated[int, Option(min=1, help="Simulated tests of each kind.")] = 100,
) -> None:
    """Compare the paper's Tables 2-7 and DDI figures with ours."""
    from monitor.runs import paper_tables as paper

    if json_file is not None:
        demand_place(json_file)
    with progress("reproduce") as on_progress:
        content = paper.reproduce(seeds, on_progress)
    print(paper.tables_text(content))
    if json_file is not None:
        write_atomically(json_file, json.dumps(content, indent=1, allow_nan=False) + "\n")


def demo(
    out: Annotated[Path, Option(metavar="DIR", help="Folder for the results.")] = Path("out/demo"),
    recordings: Annotated[Path, Option(metavar="DIR", help="Folder of the shipped recordings.")] = Path("recordings"),
) -> None:
    """Calibrate, watch damage appear, replay a measured frame.  It uses the shipped recordings."""
    from monitor.runs import demo as tour

    tour.run(recordings, out, say=print, on_warning=warn)
