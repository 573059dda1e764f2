"""Command that compares two recordings or two folders of results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument

from monitor.cli.common import Json, say, warn
from monitor.cli.progress import progress


def compare(
    first: Annotated[Path, Argument(metavar="A", help="Recording, or folder of results of replay or run.")],
    second: Annotated[Path, Argument(metavar="B", help="Of the same kind as A, by the same sensors.")],
    as_json: Json = False,
) -> None:
    """Compare two recordings or two folders of results.

    Modes, levels and damage index, each with what chance allows.
    """
    from monitor.runs import compare as run

    with progress("compare", "reads the results") as on_progress:
        content = run.compare(first, second, on_warning=warn, on_progress=on_progress)
    say(run.in_words(content), content, as_json)
