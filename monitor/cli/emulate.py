"""The command that plays sensor nodes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

_FORMS = "can:socketcand-server:HOST:PORT, can:INTERFACE:CHANNEL or zenoh:MODE:ENDPOINT:KEY."
To = Annotated[str, typer.Option(metavar="DESTINATION", help=_FORMS)]
OptionalTo = Annotated[str | None, typer.Option(metavar="DESTINATION", help=f"Also send it: {_FORMS}")]
Dbc = Annotated[Path | None, typer.Option(metavar="FILE.dbc", help="What CAN frames mean; their factors quantise.")]
Speed = Annotated[str | None, typer.Option(help="Times real time, or 'max'; 1.0 by default.")]


def emulate(
    recordings: Annotated[list[Path], typer.Argument(metavar="REC.mcap...", help="Recordings, in any order.")],
    to: To,
    dbc: Dbc = None,
    speed: Speed = None,
) -> None:
    """Send recordings as sensor nodes would, over CAN or Zenoh.  At their real pace, or another."""
    send(recordings, to, dbc, speed)


def send(recordings: list[Path], to: str, dbc: Path | None, speed: str | None) -> None:
    """Send recordings; what is sent is said on standard error."""
    from drivers.base import RecordingError, RecordingMissingError
    from drivers.mcap_file import read_recordings
    from monitor.core import BadInputError, MissingInputError
    from monitor.runs import send_all

    try:
        blocks = read_recordings(recordings)
        send_all(
            blocks, to, dbc=dbc, speed=parse_speed(speed), say=lambda text: print(text, file=sys.stderr, flush=True)
        )
    except RecordingMissingError as error:
        raise MissingInputError(str(error)) from error
    except RecordingError as error:
        raise BadInputError(str(error)) from error


@contextmanager
def recording_for(out: Path | None, to: str | None, dbc: Path | None, speed: str | None) -> Iterator[Path]:
    """A file to write a recording to; then it is sent to `to`, if given, and kept only as `out`."""
    if to is None and (dbc is not None or speed is not None):
        raise typer.BadParameter("--dbc and --speed say how to send: name a destination (--to)")
    parse_speed(speed)
    with TemporaryDirectory() as folder:
        file = out or Path(folder) / "simulated.mcap"
        yield file
        if to is not None:
            send([file], to, dbc, speed)


def parse_speed(text: str | None) -> float | None:
    """Times real time, 1 unless told; None for 'max'.

    Raises
    ------
    typer.BadParameter
        If it is neither.
    """
    if text == "max":
        return None
    try:
        value = 1.0 if text is None else float(text)
    except ValueError:
        value = 0.0
    if not 1e-6 <= value <= 1e6:
        raise typer.BadParameter(f"--speed: {text!r} is neither 'max' nor a number from 1e-6 to 1e6")
    return value
