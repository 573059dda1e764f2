"""Command `run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def run(
    file: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="Site file: structure, source, output.")],
) -> None:
    """Monitor a live source until it ends or SIGTERM arrives.

    Writes results.jsonl, summary.json and recordings in [output] dir.  Prints READY on standard error when the source is open.
    """
    from monitor.config import configuration
    from monitor.service import Daemon, logs

    settings = configuration.load(file)
    logs.begin(settings.log, settings.site_name)
    Daemon(file).run()
