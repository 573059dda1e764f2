"""Page of a fleet: one HTML file with the state of every site, which a browser filters, sorts and draws row by row."""

from __future__ import annotations

from collections.abc import Sequence

from monitor.core import rounded, utc
from monitor.damage import State
from monitor.publish import one_file
from monitor.service.fleet import SiteStatus

_HEAD = {"site": 0, "state": 1, "largest loss": 2, "first mode": 4, "window until, UTC": 5, "available": 6, "says": 7}
"""Heading of a column -> item of a row by which it is sorted."""


def fleet_page(statuses: Sequence[SiteStatus], title: str, at_ns: int) -> str:
    """Write the page of a fleet; only the rows in view are elements of it, so that ten thousand sites are drawn at once.

    The sites are first shown in the given order, the gravest first; they were asked at `at_ns`, UTC, ns since 1970.
    """
    states = list(State)
    rows = [
        [
            s.site,
            states.index(s.state),
            rounded(s.ddi, 6),
            rounded(s.ddi_std, 6),
            rounded(s.frequency_hz, 6),
            None if s.t_end_ns is None else s.t_end_ns // 1_000_000_000,
            rounded(s.availability, 6),
            s.says,
        ]
        for s in statuses
    ]
    content = {"at": utc(at_ns, seconds=True), "states": [state.words for state in states], "rows": rows}
    head = [(k, name) for name, k in _HEAD.items()]
    return one_file("fleet.html", content, styles=("page", "fleet"), scripts=("fleet",), title=title, head=head)
