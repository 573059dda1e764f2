"""Command that compares two recordings or two folders of results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from monitor.cli.common import Json, say, warn
from monitor.cli.progress import progress
from monitor.core import WrongUsageError


def compare(
    first: Annotated[Path, Argument(metavar="A", help="Recording, or folder of results of replay or run.")],
    second: Annotated[Path, Argument(metavar="B", help="Of the same kind as A, by the same sensors.")],
    more: Annotated[list[Path] | None, Argument(metavar="[REC...]", hidden=True)] = None,
    healthy: Annotated[
        list[Path] | None,
        Option(
            metavar="REC...",
            help="Three or more of the same kind from other days without a change: their scatter counts.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare two recordings or two folders of results.

    One answer, by the scatter within both or between healthy ones; then modes, levels and damage index with what chance allows.
    """
    from monitor.runs import compare as run

    if more and not healthy:
        raise WrongUsageError(f"{more[0]}: compare takes two; name healthy records of other days after --healthy")

    with progress("compare", "reads the results") as on_progress:
        content = run.compare(
            first, second, healthy=[*(healthy or []), *(more or [])], on_warning=warn, on_progress=on_progress
        )
    say(run.in_words(content), content, as_json)
