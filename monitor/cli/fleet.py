"""Command `fleet`."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, BadParameter, Exit, Option

from monitor.cli.common import Serve, address
from monitor.core import MissingInputError, demand_place, require_extra, spare_inputs, write_atomically

if TYPE_CHECKING:
    from monitor.service import FleetView


def fleet(
    file: Annotated[Path, Argument(metavar="FLEET.toml", help="Fleet file: how to join, which sites.")],
    every: Annotated[
        float | None,
        Option(min=0.1, max=86400.0, metavar="S", help="Time from one query to the next; one query without."),
    ] = None,
    count: Annotated[int | None, Option(min=1, help="Number of queries; endless by default.")] = None,
    as_json: Annotated[bool, Option("--json", help="Print one JSON object a query.")] = False,
    out: Annotated[Path | None, Option(metavar="F.rrd", help="Also draw into a Rerun recording.")] = None,
    page: Annotated[
        Path | None, Option(metavar="F.html", help="Also write a page that a browser filters and sorts.")
    ] = None,
    serve: Serve = None,
) -> None:
    """Ask every monitor on a Zenoh network for its state.

    Exit code of the last query: 0 all normal; 10 advisory, warning or alarm; 11 doubtful, not judged, or a part of a monitor
    does not work.
    """
    from monitor.service import fleet as fleet_status, fleet_page, text

    if count is not None and every is None:
        raise BadParameter("--count says how often to look: needs --every")
    written = [place for place in (out, page) if place is not None]
    spare_inputs(written, [file])
    settings, served = fleet_status.load(file), address(serve)
    if out is not None or served is not None:
        require_extra("viewer", "--out and --serve: the view")
    for place in written:
        demand_place(place)
    statuses: list[fleet_status.SiteStatus] = []
    with fleet_status.Fleet(settings, file.resolve().parent) as network, ExitStack() as stack:
        view = None if out is None and served is None else stack.enter_context(closing(_view(out, served)))
        stack.enter_context(suppress(KeyboardInterrupt))
        for _ in _queries(every, count):
            statuses = network.look()
            print(json.dumps({"sites": [s.content for s in statuses]}) if as_json else text(statuses), flush=True)
            if view is not None:
                view.show(statuses)
            if page is not None:
                write_atomically(page, fleet_page(statuses, f"Fleet {settings.prefix}", time.time_ns()))
    raise Exit(fleet_status.code(statuses))


def _view(out: Path | None, served: tuple[str, int] | None) -> FleetView:
    """Open the view of the fleet."""
    from monitor.service import FleetView

    try:
        return FleetView(out, served)
    except (OSError, RuntimeError) as error:
        raise MissingInputError(f"the view cannot be made: {error}") from error


def _queries(every_s: float | None, count: int | None) -> Iterator[int]:
    """Number the queries from 0, and wait between two: one without `every_s`, endless without `count`."""
    number = 0
    while True:
        yield number
        number += 1
        if every_s is None or number == count:
            return
        time.sleep(every_s)
