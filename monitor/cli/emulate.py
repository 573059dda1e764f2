"""Command that emulates sensor nodes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from typer import BadParameter, Option

from monitor.cli.common import Recordings

_FORMS = "can:socketcand-server:HOST:PORT, can:INTERFACE:CHANNEL, zenoh:MODE:ENDPOINT:KEY or mqtt:HOST:PORT:TOPIC."
To = Annotated[str, Option(metavar="DESTINATION", help=_FORMS)]
OptionalTo = Annotated[str | None, Option(metavar="DESTINATION", help=f"Also send it: {_FORMS}")]
Dbc = Annotated[Path | None, Option(metavar="FILE.dbc", help="Layout of the CAN frames; its factors quantise.")]
Speed = Annotated[str | None, Option(help="Multiple of real time, or 'max'; 1.0 by default.")]


def emulate(recordings: Recordings, to: To, dbc: Dbc = None, speed: Speed = None) -> None:
    """Send recordings as sensor nodes would.

    Over CAN, Zenoh or MQTT; in real time unless --speed says otherwise.
    """
    send(recordings, to, dbc, speed)


def send(recordings: list[Path], to: str, dbc: Path | None, speed: str | None) -> None:
    """Send recordings to a destination, and report on standard error what is sent."""
    from drivers.mcap_file import read_recordings
    from monitor.core import read_by_user
    from monitor.runs import send_all

    def tell(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    with read_by_user():
        send_all(read_recordings(recordings), to, dbc=dbc, speed=parse_speed(speed), say=tell)


@contextmanager
def recording_for(out: Path | None, to: str | None, dbc: Path | None, speed: str | None) -> Iterator[Path]:
    """Provide the path of a recording to write; on leaving the context, send the recording to `to` if that is given.

    The file is kept if `out` names it; without `out` the file is temporary.
    """
    if to is None and (dbc is not None or speed is not None):
        raise BadParameter("--dbc and --speed say how to send: name a destination (--to)")
    parse_speed(speed)
    with TemporaryDirectory() as folder:
        file = out or Path(folder) / "simulated.mcap"
        yield file
        if to is not None:
            send([file], to, dbc, speed)


def parse_speed(text: str | None) -> float | None:
    """Parse the value of --speed into a multiple of real time; 1 by default, None for ``max``.

    Examples
    --------
    >>> parse_speed("2.5"), parse_speed(None), parse_speed("max")
    (2.5, 1.0, None)
    """
    if text == "max":
        return None
    try:
        value = 1.0 if text is None else float(text)
    except ValueError:
        value = 0.0
    if not 1e-6 <= value <= 1e6:
        raise BadParameter(f"--speed: {text!r} is neither 'max' nor a number from 1e-6 to 1e6")
    return value
