"""Charts as data: axes and marks on them, which the page's script draws."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Self

import numpy as np

from monitor.core import Array

Range = tuple[float, float]
Values = Array | Sequence[float]
_POINTS = 1000
"""Points of a chart's width: a curve has at most two for each. [1; about the pixels of a screen]"""


@dataclass(slots=True)
class Chart:
    """A chart; the kinds of its marks are named in ``page.js``."""

    title: str
    x: Range
    y: Range
    height: float = 110.0
    """Height of the box, px."""
    log: bool = False
    """Whether y is logarithmic."""
    x_title: str = ""
    note: str = ""
    """What stands below the title."""
    kind: str = ""
    x_names: Sequence[str] = ()
    """What x counts, if it counts named things."""
    y_names: Sequence[str] = ()
    """What y counts in rows, from the top."""
    stretches: Sequence[tuple[float, float, float, float]] = ()
    """Over time x is a share of the width; of each stretch its ends, s since 1970 UTC, and their shares."""
    marks: list[dict[str, Any]] = field(default_factory=list)

    @property
    def content(self) -> dict[str, Any]:
        """The chart as the script reads it."""
        given = {key: getattr(self, key) for key in ("log", "x_title", "x_names", "y_names", "stretches")}
        base = {"x": list(self.x), "y": list(self.y), "height": self.height, "marks": self.marks}
        return base | {key: list(v) if isinstance(v, tuple | list) else v for key, v in given.items() if v}

    def line(
        self, x: Values, y: Values, kind: str = "after", low: Values | None = None, high: Values | None = None
    ) -> Self:
        """Draw a line, broken where a value is NaN, in the band from `low` to `high` where these are given."""
        band = {} if low is None or high is None else {"low": np.asarray(low), "high": np.asarray(high)}
        return self._mark("line", kind, x=np.asarray(x), y=np.asarray(y), **band)

    def level(self, y: float, kind: str) -> Self:
        """Draw a level line."""
        return self.line(self.x, (y, y), kind)

    def dots(self, x: Values, y: Values, half: Values | None = None, kind: str = "stable") -> Self:
        """Draw points, with intervals of `half` on either side where these are given."""
        return self._mark(
            "dots", kind, x=np.asarray(x), y=np.asarray(y), half=half if half is None else np.asarray(half)
        )

    def shade(self, x: Range, kind: str, y: Range | None = None) -> Self:
        """Draw a rectangle over a range of x, of full height unless `y` is given."""
        return self._mark("shade", kind, x=list(x), y=None if y is None else list(y))

    def grid(self, levels: Annotated[Array, "rows columns"], x: Range, y: Range, *, signed: bool = False) -> Self:
        """Draw a picture of levels from 0 to 1, or if `signed` from -1 to 1, the top row first."""
        level = np.clip(levels, -1.0 if signed else 0.0, 1.0)
        data = np.rint(128.0 + 127.0 * level if signed else 255.0 * level).astype(np.uint8)
        size = {"rows": data.shape[0], "columns": data.shape[1], "levels": b64encode(data.tobytes()).decode()}
        return self._mark("grid", "", x=list(x), y=list(y), signed=signed, **size)

    def _mark(self, what: str, kind: str, **content: Any) -> Self:
        self.marks.append({"is": what, "kind": kind, **content})
        return self


def thinned(
    t: Annotated[Array, "n"], values: Annotated[Array, "n"]
) -> tuple[Annotated[Array, "k"], Annotated[Array, "k"]]:
    """Thin a curve to the least and the greatest value within each unit of a chart's width.

    Examples
    --------
    >>> t, x = thinned(np.arange(100_000.0), np.sin(np.arange(100_000.0)))
    >>> t.size <= 2 * 1000, bool(x.max() > 0.9999)
    (True, True)
    """
    per = -(-t.size // _POINTS)
    n = t.size // per * per
    if per <= 2 or not n:
        return t, values
    parts = values[:n].reshape(-1, per)
    first = np.arange(len(parts)) * per
    index = np.sort(np.column_stack([parts.argmin(axis=1) + first, parts.argmax(axis=1) + first]), axis=1).ravel()
    return t[index], values[index]
