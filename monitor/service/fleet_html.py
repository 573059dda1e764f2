"""Page of a fleet: one HTML file with the state of every site, which a browser filters, sorts and draws row by row."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from importlib import resources

from monitor.core import rounded, utc
from monitor.damage import State
from monitor.service.fleet import SiteStatus

_PAGES = resources.files("monitor.service.web") / "pages"
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
    # "<" could end the script; everything of the data is shown as text.
    data = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    head = "".join(
        f'<span role="columnheader"><button data-by="{k}">{escape(name)}</button></span>' for name, k in _HEAD.items()
    )
    style, script = (_PAGES.joinpath(f"fleet.{end}").read_text(encoding="utf-8") for end in ("css", "js"))
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"/><title>{escape(title)}</title>'
        f"<style>\n{style}</style></head>\n<body><header><h1>{escape(title)} "
        f'<span class="muted" id="count" role="status"></span></h1><div id="states"></div>'
        f'<input id="find" type="search" placeholder="site, state or words" aria-label="Filter"/></header>\n'
        f'<div class="row" id="head" role="row">{head}</div><div id="body" role="table" tabindex="0">'
        f'<div id="space"></div></div>\n<script type="application/json" id="data">{data}</script>\n'
        f"<script>\n{script}</script></body></html>\n"
    )
