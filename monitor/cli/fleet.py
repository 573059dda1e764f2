"""Command `fleet`."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.common import address
from monitor.core import MissingInputError, demand_place, require_extra, spare_inputs, write_atomically


def fleet(
    file: Annotated[Path, typer.Argument(metavar="FLEET.toml", help="Fleet file: how to join, which sites.")],
    every: Annotated[
        float | None,
        typer.Option(min=0.1, max=86400.0, metavar="S", help="Time from one query to the next; one query without."),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Number of queries; endless by default.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object a query.")] = False,
    out: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Also draw into a Rerun recording.")] = None,
    page: Annotated[
        Path | None, typer.Option(metavar="F.html", help="Also write a page that a browser filters and sorts.")
    ] = None,
    serve: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Serve Rerun viewers here, as 127.0.0.1:9876.")
    ] = None,
) -> None:
    """Ask every monitor on a Zenoh network for its state.

    Exit code of the last query: 0 all normal; 10 advisory, warning or alarm; 11 doubtful, not judged, or a part of a monitor
    does not work.
    """
    from monitor.service import FleetView, fleet_page, text
    from monitor.service import fleet as fleet_status

    if count is not None and every is None:
        raise typer.BadParameter("--count says how often to look: needs --every")
    spare_inputs([place for place in (out, page) if place is not None], [file])
    settings, served = fleet_status.load(file), address(serve)
    if out is not None or served is not None:
        require_extra("viewer", "--out and --serve: the view")
    for place in (out, page):
        if place is not None:
            demand_place(place)
    statuses: list[fleet_status.SiteStatus] = []
    with fleet_status.Fleet(settings, file.resolve().parent) as network:
        try:
            view = FleetView(out, served) if out is not None or served is not None else None
        except (OSError, RuntimeError) as error:
            raise MissingInputError(f"the view cannot be made: {error}") from error
        remaining = 1 if every is None else count
        try:
            with suppress(KeyboardInterrupt):
                while remaining is None or remaining > 0:
                    statuses = network.look()
                    lines = json.dumps({"sites": [s.content for s in statuses]}) if as_json else text(statuses)
                    print(lines, flush=True)
                    if view is not None:
                        view.show(statuses)
                    if page is not None:
                        write_atomically(page, fleet_page(statuses, f"Fleet {settings.prefix}", time.time_ns()))
                    remaining = None if remaining is None else remaining - 1
                    if remaining != 0:
                        time.sleep(every or 0.0)
        finally:
            if view is not None:
                view.close()
    raise typer.Exit(fleet_status.code(statuses))
