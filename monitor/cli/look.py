"""Command that looks at recordings without a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, BadParameter, Option

from monitor.cli.common import Json, say, warn
from monitor.cli.progress import progress
from monitor.cli.reader_options import reads_files
from monitor.core import spare_inputs

if TYPE_CHECKING:
    from monitor.runs import Options


@reads_files()
def look(
    recordings: Annotated[
        list[Path], Argument(metavar="REC.mcap...", help="Recordings in any order, or files that 'import' reads.")
    ],
    out: Annotated[Path | None, Option(metavar="DIR", help="Folder for look.html, look.json and modes.csv.")] = None,
    write_structure: Annotated[
        Path | None, Option(metavar="S.toml", help="Write a structure file that fits the modes, with its doubts.")
    ] = None,
    mass_kg: Annotated[
        float | None, Option(min=1e-6, max=1e12, help="Mass of the whole structure for --write-structure; else 1 kg.")
    ] = None,
    *,
    reading: Options,
    as_json: Json = False,
) -> None:
    """Look at recordings without a model.

    Shows level, spectra, modes with intervals and a second opinion, and what is doubtful.
    """
    from monitor.runs import look as run

    written = [] if out is None else [out / name for name in run.RESULT_FILES]
    spare_inputs(
        [*written, *([] if write_structure is None else [write_structure])],
        [*recordings, reading.dbc, reading.inventory],
    )
    if mass_kg is not None and write_structure is None:
        raise BadParameter("--mass-kg is for --write-structure")
    with progress("look") as on_progress:
        found = run.look(recordings, reading, on_warning=warn, on_progress=on_progress)
    text, content = run.in_words(found), found.content()
    if out is not None:
        run.write_results(found, out)
        text += f"\nresults in {out}; open {out / 'look.html'}"
        content["out"] = str(out)
    if write_structure is not None:
        run.write_structure(found, write_structure, mass_kg)
        advice = f"read its comments, then: shm-monitor check {write_structure}"
        text += f"\nproposed structure in {write_structure}: {advice}"
        content["structure"] = str(write_structure)
    say(text, content, as_json)
