"""The content of the live page: the same sheet as a report's, made anew of the snapshots whenever something has changed."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from pydantic import BaseModel, Field

from monitor.publish import Sheet, live_sheet
from monitor.service.web.snapshots import Answer, Range, Snapshots

_BINS = 360
"""Steps of time after which curves come anew. [1; as many as a curve has]"""
_WINDOWS = 1_000
"""Most windows of a page, evenly spaced. [1; cost: 0.1 s of a processor]"""


_MOST_KEPT = 4
"""Most spans of time of which the content is kept. [count; as many as the page offers]"""


class Shown(BaseModel):
    """What of the page is asked for."""

    range_s: int = Field(default=0, ge=0, lt=1 << 31)
    """Curves are of so many seconds; 0 asks for all that is kept."""
    charts: str = ""
    """Tag of the charts that the reader has."""


class LivePage:
    """Make the content of the page; it is kept until a snapshot changes, so that many readers cost as much as one."""

    def __init__(self, snapshots: Snapshots) -> None:
        self._snapshots = snapshots
        self._kept: dict[int, tuple[str, dict[str, Any]]] = {}

    def answer(self, asked: Shown) -> Answer:
        """Write the body's HTML, the page's title and, where the reader has not these already, the charts with their tag."""
        range_s = asked.range_s
        state = self._snapshots.answer("status").etag.strip('"')
        if self._kept.get(range_s, ("",))[0] != state:
            if len(self._kept) >= _MOST_KEPT and range_s not in self._kept:
                self._kept.clear()
            self._kept[range_s] = state, self._made(range_s)
        content = self._kept[range_s][1]
        has_charts = content["tag"] == asked.charts
        body = json.dumps(content | ({"charts": None} if has_charts else {}), allow_nan=False, separators=(",", ":"))
        return Answer(body.encode(), f'"{state}-{range_s}-{int(has_charts)}"')

    def report(self, asked: Shown) -> Answer:
        """Write the page as one file."""
        html = self.sheet(asked.range_s).html().encode()
        return Answer(html, f'"{hashlib.sha256(html).hexdigest()[:16]}"', "text/html")

    def _made(self, range_s: int) -> dict[str, Any]:
        sheet = self.sheet(range_s)
        last_s = max((ends[-1][1] for c in sheet.charts.values() if (ends := c.get("stretches"))), default=0.0)
        tag = f"{range_s}-{len(sheet.charts)}-{int(last_s / (range_s / _BINS or 60.0))}"
        title = f"{sheet.word}: {sheet.name}"
        return {"html": sheet.body(), "title": title, "tag": tag, "charts": sheet.charts}

    def sheet(self, range_s: int) -> Sheet:
        """Make the page."""
        status = self._content("status")
        last_ns = (status["latest"] or {}).get("t_end_ns") or self._last_ns()
        since_ns = max(0, last_ns - range_s * 1_000_000_000) if range_s else 0
        windows = self._content("windows", Range(since_ns=since_ns, limit=_WINDOWS))["windows"]
        sensors = self._content("sensors")
        assessment, published = self._snapshots.published()
        return live_sheet(published | {"status": status, "windows": windows, "sensors": sensors}, assessment)

    def _last_ns(self) -> int:
        windows = self._content("windows", Range(limit=1))["windows"]
        return int(windows[-1]["t_end_ns"]) if windows else 0

    def _content(self, name: str, *asked: Range) -> dict[str, Any]:
        return dict(json.loads(self._snapshots.answer(name, *asked).body))
