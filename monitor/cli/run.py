"""Commands `run` and `warm`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument


def run(file: Annotated[Path, Argument(metavar="CONFIG.toml", help="Site file: structure, source, output.")]) -> None:
    """Monitor a live source until it ends or SIGTERM arrives.

    Writes results.jsonl, summary.json and recordings in [output] dir.  Prints READY on standard error when the source is open.
    """
    from monitor.config import configuration
    from monitor.service import ALONE, Host, logs

    settings = configuration.load(file)
    logs.begin(settings.log, settings.site_name)
    Host([file], ALONE).run()


def warm(
    file: Annotated[Path | None, Argument(metavar="SITE.toml", help="Site file; a small frame by default.")] = None,
) -> None:
    """Compile what windows need, so that no start waits for it.

    Run it as the daemon's user, with its NUMBA_CACHE_DIR, after an installation.  A daemon does the same before READY.
    """
    from monitor.config import configuration
    from monitor.runs import load_healthy, warm_up

    if file is None:
        warm_up()
        return
    settings = configuration.load(file)
    name = settings.site.baseline
    warm_up(settings, None if name is None else load_healthy(file.resolve().parent / name, settings))
