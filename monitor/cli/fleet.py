"""The command `fleet`."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from monitor.cli.common import address
from monitor.core import MissingInputError, demand_place, spare_inputs

_ALARM, _TROUBLE = 10, 11
"""Exit codes: an alarm stands; a monitor cannot be relied on."""


def fleet(
    file: Annotated[Path, typer.Argument(metavar="FLEET.toml", help="Fleet file: how to join, which sites.")],
    every: Annotated[
        float | None, typer.Option(min=0.1, max=86400.0, metavar="S", help="Look again and again; once without.")
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="So many looks; without end if not given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a look.")] = False,
    out: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Also draw into a Rerun recording.")] = None,
    serve: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Rerun viewers may join here, as 127.0.0.1:9876.")
    ] = None,
) -> None:
    """Ask every monitor on a Zenoh network how its structure is.

    Exit code of the last look: 0 all well, 10 an alarm stands, 11 a monitor is missing, silent or cannot judge.
    """
    from monitor.service import FleetView, text
    from monitor.service import fleet as ships

    if count is not None and every is None:
        raise typer.BadParameter("--count says how often to look: needs --every")
    spare_inputs([] if out is None else [out], [file])
    settings, served = ships.load(file), address(serve)
    if out is not None:
        demand_place(out)
    statuses: list[ships.SiteStatus] = []
    with ships.Fleet(settings, file.resolve().parent) as network:
        try:
            view = FleetView(out, served) if out is not None or served is not None else None
        except (OSError, RuntimeError) as error:
            raise MissingInputError(f"the view cannot be made: {error}") from error
        left = 1 if every is None else count
        try:
            with suppress(KeyboardInterrupt):
                while left is None or left > 0:
                    statuses = network.look()
                    told = json.dumps({"sites": [asdict(s) for s in statuses]}) if as_json else text(statuses)
                    print(told, flush=True)
                    if view is not None:
                        view.show(statuses)
                    left = None if left is None else left - 1
                    if left != 0:
                        time.sleep(every or 0.0)
        finally:
            if view is not None:
                view.close()
    states = {s.state for s in statuses}
    code = 0 if states <= {ships.WELL} else _TROUBLE if states <= {ships.WELL, ships.TROUBLE} else _ALARM
    raise typer.Exit(code)
