"""Rows of a Rerun recording, sent in columns: a single row costs a tenth of a millisecond, a row in a column far less."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from monitor.core import Array

_Key = tuple[str, type[Any], tuple[str, ...]]


class Strips(list[Array]):
    """Line strips of a row, each a row of coordinates for each point."""


class Rows:
    """Collector of rows, entity by entity, in the worker's thread; the timeline ``time`` is UTC in ns, others count ns from 0."""

    def __init__(self, stream: rr.RecordingStream, timeline: str = "time") -> None:
        self._stream, self._timeline, self._t_ns = stream, timeline, 0
        self._times: defaultdict[_Key, list[int]] = defaultdict(list)
        self._rows: defaultdict[_Key, list[tuple[Any, ...]]] = defaultdict(list)

    def at(self, t_ns: int) -> None:
        """Set the time of the following rows, ns."""
        self._t_ns = t_ns

    def add(self, path: str, kind: type[Any], **components: Any) -> None:
        """Add a row of an archetype; each component is a sequence of its instances, `Strips` for strips."""
        key = (path, kind, tuple(components))
        self._times[key].append(self._t_ns)
        self._rows[key].append(tuple(components.values()))

    def scalars(self, path: str, *values: float) -> None:
        """Add a row of numbers."""
        self.add(path, rr.Scalars, scalars=values)

    def text(self, path: str, markdown: str) -> None:
        """Add a row of text."""
        self.add(path, rr.TextDocument, text=[markdown], media_type=["text/markdown"])

    def send(self) -> None:
        """Send the collected rows."""
        for key, rows in self._rows.items():
            path, kind, names = key
            columns = [
                column
                for name, instances in zip(names, zip(*rows, strict=True), strict=True)
                for column in kind.columns(**{name: _concatenate(instances)}).partition(
                    [len(each) for each in instances]
                )
            ]
            self._stream.send_columns(path, [self._index(self._times[key])], columns)
        self._times.clear()
        self._rows.clear()

    def _index(self, times: list[int]) -> rr.TimeColumn:
        if self._timeline == "time":
            return rr.TimeColumn("time", timestamp=np.array(times, dtype="datetime64[ns]"))
        return rr.TimeColumn(self._timeline, duration=np.array(times, dtype="timedelta64[ns]"))


def name_line(stream: rr.RecordingStream, path: str, name: str, colour: tuple[int, int, int], **more: Any) -> None:
    """Give the line of an entity its name and its colour."""
    stream.log(path, rr.SeriesLines(names=[name], colors=[colour], **more), static=True)


def ui_radius(points: float) -> list[float]:
    """Convert a radius in points of the screen, not of the scene, to a component of Rerun."""
    return [float(rr.Radius.ui_points(points))]  # type: ignore[arg-type]


@cache
def _strip_type(dimensions: int) -> pa.DataType:
    return (
        (rr.components.LineStrip2DBatch if dimensions == 2 else rr.components.LineStrip3DBatch)([])
        .as_arrow_array()
        .type
    )


def _concatenate(instances: Sequence[Any]) -> Any:
    if isinstance(instances[0], Strips):
        strips = [np.asarray(strip, dtype=np.float32) for row in instances for strip in row]
        points = np.concatenate(strips)
        vectors = (rr.encodings.Vec2DBatch if points.shape[1] == 2 else rr.encodings.Vec3DBatch)(points)
        ends = np.cumsum([0, *map(len, strips)], dtype=np.int32)
        return pa.ListArray.from_arrays(ends, vectors.as_arrow_array(), type=_strip_type(points.shape[1]))
    if isinstance(instances[0][0], str):
        return [text for row in instances for text in row]
    return np.concatenate([np.asarray(row) for row in instances])
