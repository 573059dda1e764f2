"""Options, output and parsing that several commands share."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from typer import Argument, BadParameter, Context, Option, Typer
from typer.models import ArgumentInfo, OptionInfo

from monitor.core import parse_address, utc_ns

Recordings = Annotated[list[Path], Argument(metavar="REC.mcap...", help="Recordings, in any order.")]


def _demand_structure(context: Context, structure: Path | None) -> Path | None:
    """Refuse a command without a structure file, with what can be done without one."""
    if structure is None and not context.resilient_parsing:  # which the shell's completion asks for
        remedy = "name the structure file; none yet? 'look REC' needs none, and proposes one"
        raise BadParameter(f"missing: {remedy}", param_hint="--structure")
    return structure


Structure = Annotated[
    Path,
    Option(
        metavar="S.toml",
        help="Structure file.  [required]",
        default_factory=lambda: None,  # not demanded by the command line, which would name no remedy
        callback=_demand_structure,
        show_default=False,
    ),
]
Json = Annotated[bool, Option("--json", help="Print one JSON object instead.")]
Results = Annotated[Path, Option(metavar="DIR", help="Folder for the results.")]
Healthy = Annotated[Path | None, Option(metavar="B.json", help="Healthy baseline by 'calibrate'.")]
Serve = Annotated[str | None, Option(metavar="HOST:PORT", help="Serve Rerun viewers here, as 127.0.0.1:9876.")]


def say(text: str, content: dict[str, Any], as_json: bool) -> None:
    """Print the result of a command on standard output: `text` for people, or `content` as JSON for programs."""
    print(json.dumps(content, allow_nan=False) if as_json else text)


def warn(message: str) -> None:
    """Print a warning on standard error."""
    over = "\r\x1b[K" if sys.stderr.isatty() else ""  # over the line of a progress
    print(f"{over}warning: {message}", file=sys.stderr)


def address(text: str | None, option: str = "--serve", *, any_port: bool = False) -> tuple[str, int] | None:
    """Parse the value HOST:PORT of an option into host and port; port 0 only where it may be any."""
    try:
        return None if text is None else parse_address(text, any_port=any_port)
    except ValueError as error:
        raise BadParameter(f"{option}: {error}") from error


def time_ns(option: str, text: str | None) -> int | None:
    """Parse the time (ISO 8601) of an option into UTC, ns since 1970.

    Examples
    --------
    >>> time_ns("--from", "1970-01-01T00:00:01")
    1000000000
    """
    try:
        t_ns = None if text is None else utc_ns(text)
    except ValueError as error:
        raise BadParameter(f"{option}: {error}") from error
    if t_ns is not None and t_ns < 0:
        raise BadParameter(f"{option}: {text} is before 1970, which a recording cannot say")
    return t_ns


def leave_unread(app: Typer) -> None:
    """Turn off the command line's own check that input files are readable.

    A file without read permission is then reported as missing input (exit code 66), as is a file that does not exist.  The
    command line would report wrong usage.
    """
    for command in app.registered_commands:
        for annotation in get_type_hints(command.callback, include_extras=True).values():
            for parameter in getattr(annotation, "__metadata__", ()):
                if isinstance(parameter, (ArgumentInfo, OptionInfo)):
                    parameter.readable = False
