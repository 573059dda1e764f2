"""Command that compares two recordings or two folders of results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument

from monitor.cli.common import Json, say, warn
from monitor.cli.progress import progress
from monitor.cli.reader_options import reads_files

if TYPE_CHECKING:
    from monitor.runs import Options


@reads_files()
def compare(
    first: Annotated[Path, Argument(metavar="A", help="Recording, file that 'import' reads, or folder of results.")],
    second: Annotated[Path, Argument(metavar="B", help="Of the same kind as A, by the same sensors.")],
    *,
    reading: Options,
    as_json: Json = False,
) -> None:
    """Compare two recordings or two folders of results.

    Modes, levels and damage index, each with what chance allows.  The options hold for both files.
    """
    from monitor.runs import compare as run

    with progress("compare", "reads the results") as on_progress:
        content = run.compare(first, second, reading, on_warning=warn, on_progress=on_progress)
    say(run.in_words(content), content, as_json)
