"""Options by which files of loggers are read: declared once, for every command that takes such files."""

from __future__ import annotations

import functools
from collections.abc import Callable
from datetime import tzinfo
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import BadParameter, Option

from monitor.cli.common import time_ns

if TYPE_CHECKING:
    from monitor.runs import Options

_LATER = {"Options": object}
"""Types of commands' parameters that are loaded only when a command is called. [names]"""


def reader_options(
    rate: Annotated[
        float | None, Option(min=0.001, max=1e7, help="Sample rate in Hz, where the file has no time.")
    ] = None,
    unit: Annotated[
        str | None,
        Option(
            help="Unit where a file states none: m/s^2 (default), g, mg or gal. 'import' asks for it on a terminal."
        ),
    ] = None,
    channel: Annotated[
        list[str], Option(metavar="NAME=FILE[:COLUMN]", help="A channel; of one file, NAME=COLUMN.")
    ] = [],  # noqa: B006
    ground: Annotated[str | None, Option(metavar="FILE[:COLUMN]", help="Measured base motion.")] = None,
    force: Annotated[
        list[str], Option(metavar="NAME=FILE[:COLUMN]", help="A measured force in N, as [[inputs]] names it.")
    ] = [],  # noqa: B006
    time: Annotated[str | None, Option(metavar="COLUMN", help="Column of the times, where it is not found.")] = None,
    covariate: Annotated[
        list[str], Option(metavar="NAME=[FILE:]COLUMN", help="A quantity to be kept beside, as temperature or wind.")
    ] = [],  # noqa: B006
    start: Annotated[str | None, Option(help="UTC of the first sample, ISO 8601.")] = None,
    timezone: Annotated[
        str | None,
        Option(metavar="ZONE", help="Zone of times that state none, as Europe/Zurich or +01:00; UTC by default."),
    ] = None,
    dbc: Annotated[Path | None, Option(metavar="FILE.dbc", help="Layout of the frames of a CAN log.")] = None,
    bus: Annotated[str | None, Option(help="Bus of a CAN log of several, as the log names it.")] = None,
    scale: Annotated[
        float | None, Option(min=1e-30, max=1e30, help="m/s^2 of a count, where a file holds counts.")
    ] = None,
    inventory: Annotated[
        Path | None, Option(metavar="STATION.xml", help="Of seismic formats: the channels' sensitivities.")
    ] = None,
    align: Annotated[
        bool, Option("--align", help="Shift files whose clocks do not agree until their readings fit the first file's.")
    ] = False,
) -> Options:
    """Form what the readers are told."""
    from monitor.runs import Options

    return Options(
        rate_hz=rate,
        unit=unit,
        channels=_places("--channel", channel) or None,
        time=time,
        covariates=_places("--covariate", covariate) or None,
        ground=ground,
        forces=_places("--force", force) or None,
        start_ns=time_ns("--start", start),
        zone=None if timezone is None else _zone(timezone),
        dbc=dbc,
        bus=bus,
        scale=scale,
        inventory=inventory,
        align=align,
    )


def reads_files(*only: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of `reader_options` (only those named, if any), and their value as its parameter `reading`."""
    shared = {
        name: each.replace(kind=Parameter.KEYWORD_ONLY)
        for name, each in signature(reader_options, locals=_LATER, eval_str=True).parameters.items()
        if not only or name in only
    }

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def called(**given: Any) -> None:
            reading = reader_options(**{name: given.pop(name) for name in shared})
            command(**given, reading=reading)

        whole = signature(command, locals=_LATER, eval_str=True)
        own = {name: each for name, each in whole.parameters.items() if name != "reading"}
        last = [own.pop("as_json").replace(kind=Parameter.KEYWORD_ONLY)]
        parameters = [*own.values(), *shared.values(), *last]
        called.__signature__ = whole.replace(parameters=parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in parameters}
        return called

    return decorate


def _zone(name: str) -> tzinfo:
    """Return the zone of a name."""
    from monitor.runs import zone_named

    zone = zone_named(name)
    if zone is None:
        raise BadParameter(f"--timezone {name}: no such zone; as Europe/Zurich, +01:00 or UTC")
    return zone


def _places(option: str, items: list[str]) -> dict[str, str]:
    """Parse NAME=FILE[:COLUMN] of an option that may stand several times."""
    out: dict[str, str] = {}
    for item in items:
        name, separator, place = item.partition("=")
        if not separator or not name or not place:
            raise BadParameter(f"{option}: {item!r} is not NAME=FILE[:COLUMN]")
        if name in out:
            raise BadParameter(f"{option}: {name!r} stands twice")
        out[name] = place
    return out
