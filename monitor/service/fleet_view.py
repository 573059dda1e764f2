"""View of a fleet as text and as a Rerun recording: a table, states over time, losses of stiffness over time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from monitor.service.fleet import SiteStatus

_HEAD = ("site", "state", "largest loss", "first mode", "window until", "last event", "says")


def cells(status: SiteStatus) -> tuple[str, ...]:
    """Format the state of a site as a row of the table."""
    loss = (
        ""
        if status.ddi is None or status.ddi_std is None
        else f"{100 * status.ddi:.1f} +- {100 * status.ddi_std:.1f} %"
    )
    mode = "" if status.frequency_hz is None else f"{status.frequency_hz:.4g} Hz"
    until = "" if status.t_end_ns is None else str(np.datetime64(status.t_end_ns, "ns").astype("datetime64[s]"))
    return status.site, status.state.words, loss, mode, until, status.event, status.says


def text(statuses: Sequence[SiteStatus]) -> str:
    """Format the states of all sites as a table for a terminal."""
    rows = [_HEAD, *map(cells, statuses)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


class FleetView:
    """Rerun view of a fleet, one query after another, timed by the clock of this machine, in a file or served to viewers.

    Raises
    ------
    OSError, RuntimeError
        The file cannot be made or the port is taken.
    """

    def __init__(self, file: Path | None, serve: tuple[str, int] | None) -> None:
        # Imported here: the table as text needs no viewer.
        import rerun.blueprint as rrb

        from monitor.publish import Output

        self._output = Output("fleet", file, serve)
        states = rrb.StateTimelineView(origin="/state", name="State")
        losses = rrb.TimeSeriesView(origin="/ddi", name="Largest loss of stiffness, %")
        table = rrb.TextDocumentView(origin="/table", name="Fleet")
        self._output.stream.send_blueprint(rrb.Blueprint(rrb.Vertical(table, states, losses), collapse_panels=True))

    def show(self, statuses: Sequence[SiteStatus]) -> None:
        """Draw the states of one query."""
        import rerun as rr

        stream = self._output.stream
        stream.set_time("time", timestamp=np.datetime64(time.time_ns(), "ns"))
        lines = ["| " + " | ".join(row) + " |" for row in (_HEAD, ("---",) * len(_HEAD), *map(cells, statuses))]
        stream.log("/table", rr.TextDocument("\n".join(lines), media_type="text/markdown"))
        for status in statuses:
            name = rr.escape_entity_path_part(status.site)
            stream.log(f"/state/{name}", rr.StateChange(state=status.state.words))
            if status.ddi is not None:
                stream.log(f"/ddi/{name}", rr.Scalars(100.0 * status.ddi))

    def close(self) -> None:
        """Finish the recording file."""
        self._output.close(10.0)
