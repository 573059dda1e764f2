"""Options, output and parsing that several commands share."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
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
    print(f"warning: {message}", file=sys.stderr)


def progress(label: str, recordings: Sequence[Path] = (), *, is_all: bool = False) -> Callable[[float], None]:
    """Create a function that shows the processed time of the data, given in s; silent unless standard error is a terminal.

    Of `recordings` it shows their length too, and where to read them `is_all` that the command does, the time that is left.
    """
    if not sys.stderr.isatty():
        return lambda _: None
    begun_s, shown_s, total_s = time.monotonic(), 0.0, None if recordings else 0.0

    def show(seconds: float) -> None:
        nonlocal shown_s, total_s
        if seconds - shown_s >= 60.0:
            shown_s = seconds
            total_s = _length_s(recordings) if total_s is None else total_s
            says = progress_words(seconds, total_s, time.monotonic() - begun_s if is_all else None)
            # The next output begins on this line and overwrites it.
            print(f"\r\x1b[K{label}: {says}\r", end="", file=sys.stderr, flush=True)

    return show


def progress_words(seconds: float, total_s: float, took_s: float | None) -> str:
    """Say how much of the data is processed, of how much (0: not known), and from the time that it took how long the rest takes.

    Examples
    --------
    >>> progress_words(600.0, 3600.0, 24.0)
    '10 of 60 min of data, 2 min left'
    >>> progress_words(600.0, 0.0, 24.0)
    '10 min of data'
    """
    if total_s < seconds:
        return f"{seconds / 60.0:.0f} min of data"
    left_s = 0.0 if took_s is None else took_s * (total_s / seconds - 1.0)
    left = "" if took_s is None else f", {left_s:.0f} s left" if left_s < 100.0 else f", {left_s / 60.0:.0f} min left"
    return f"{seconds / 60.0:.0f} of {total_s / 60.0:.0f} min of data{left}"


def _length_s(recordings: Sequence[Path]) -> float:
    """Return the length of the accelerations in recordings, s; 0 where one does not tell."""
    from drivers.base import RecordingError
    from drivers.mcap_file import recorded_time

    try:
        spans = [recorded_time(path) for path in recordings]
    except (RecordingError, KeyError):
        return 0.0
    return sum(end_ns - begin_ns for begin_ns, end_ns in spans) * 1e-9


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
