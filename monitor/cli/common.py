"""What the commands share."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

from monitor.core import parse_address, utc_ns

Recordings = Annotated[list[Path], typer.Argument(metavar="REC.mcap...", help="Recordings, in any order.")]
Structure = Annotated[Path, typer.Option(metavar="S.toml", help="Structure file.")]
Json = Annotated[bool, typer.Option("--json", help="Say it as one JSON object instead.")]


def say(text: str, content: dict[str, Any], as_json: bool) -> None:
    """The answer of a command on standard output, for people or for programs."""
    print(json.dumps(content, allow_nan=False) if as_json else text)


def warn(message: str) -> None:
    """Say it on standard error."""
    print(f"warning: {message}", file=sys.stderr)


def progress(label: str) -> Callable[[float], None]:
    """Seconds of data done, on a terminal only."""
    if not sys.stderr.isatty():
        return lambda _: None
    shown = [0.0]

    def tell(seconds: float) -> None:
        if seconds - shown[0] >= 60.0:
            shown[0] = seconds
            # What is said next begins on this line and takes its place.
            print(f"\r\x1b[K{label}: {seconds / 60.0:.0f} min of data\r", end="", file=sys.stderr, flush=True)

    return tell


def address(text: str | None) -> tuple[str, int] | None:
    """--serve HOST:PORT, taken apart."""
    try:
        return None if text is None else parse_address(text)
    except ValueError as error:
        raise typer.BadParameter(f"--serve: {error}") from error


def time_ns(option: str, text: str | None) -> int | None:
    """UTC, ns since 1970, of what an option says; no data are older."""
    try:
        t_ns = None if text is None else utc_ns(text)
    except ValueError as error:
        raise typer.BadParameter(f"{option}: {error}") from error
    if t_ns is not None and t_ns < 0:
        raise typer.BadParameter(f"{option}: {text} is before 1970, which a recording cannot say")
    return t_ns


def leave_unread(app: typer.Typer) -> None:
    """A file that must not be read is bad input (66), as one that is not there; the command line would call it wrong usage."""
    for command in app.registered_commands:
        for annotation in get_type_hints(command.callback, include_extras=True).values():
            for said in getattr(annotation, "__metadata__", ()):
                if isinstance(said, (ArgumentInfo, OptionInfo)):
                    said.readable = False
