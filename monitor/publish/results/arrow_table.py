"""Conversion of the lines of results.jsonl to an Arrow table, for Parquet files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa

from monitor.publish.results.window_fields import FIELDS, Field, Kind

_MANY = pa.list_(pa.float64())
_NUMBERS = pa.list_(pa.int64())
_OTHER_MODE = pa.struct(
    [
        ("frequency_hz", pa.float64()),
        ("frequency_std_hz", pa.float64()),
        ("damping_ratio", pa.float64()),
        ("mode_shape", pa.list_(_MANY)),
        ("track", pa.int64()),
    ]
)

_TYPES = {
    Kind.NEVER_NULL_INTEGER: pa.int64(),
    Kind.NEVER_NULL_NUMBER: pa.float64(),
    Kind.NUMBER: pa.float64(),
    Kind.INTEGER: pa.int64(),
    Kind.FLAG: pa.bool_(),
    Kind.TEXT: pa.string(),
    Kind.NUMBERS: _MANY,
    Kind.INTEGERS: _NUMBERS,
    Kind.TEXTS: pa.list_(pa.string()),
    Kind.SHAPES: pa.list_(pa.list_(_MANY)),
    Kind.MODES: pa.list_(_OTHER_MODE),
    Kind.BY_NAME: pa.map_(pa.string(), pa.float64()),
    Kind.LISTS_BY_NAME: pa.map_(pa.string(), _MANY),
}
"""Kind of a field -> Arrow type of its column. [none; definition]"""
_ALARM = [
    ("alarm_level", pa.string()),
    ("alarm_stories", _NUMBERS),
    ("alarm_reason", pa.string()),
    ("alarm_active", pa.map_(pa.string(), pa.string())),
    ("alarm_shelved", _NUMBERS),
    ("alarm_changed", pa.list_(pa.string())),
]
_END = ("t_end", pa.timestamp("ns", tz="UTC"))


def _columns(field: Field) -> list[tuple[str, pa.DataType]]:
    """Return the columns of a field: the alarm has six, and the end of a window stands there as a timestamp too."""
    if field.kind is Kind.ALARM:
        return _ALARM
    return [(field.key, _TYPES[field.kind]), *([_END] if field.key == "t_end_ns" else [])]


WINDOWS_SCHEMA = pa.schema([("stream", pa.string()), *(column for field in FIELDS for column in _columns(field))])
"""Columns: the keys of a line of results.jsonl, `alarm` as six, the stream's name, and the window's end as a timestamp."""


def windows_table(lines: Iterable[Mapping[str, Any]], stream: str) -> pa.Table:
    """Convert parsed lines of results.jsonl to rows with the columns `WINDOWS_SCHEMA`; `stream` is the stream's name."""
    rows = []
    for line in lines:
        alarm = {f"alarm_{key}": value for key, value in line["alarm"].items()}
        given = {f.key: line.get(f.key) for f in FIELDS if f.kind in (Kind.BY_NAME, Kind.LISTS_BY_NAME)}
        given["alarm_active"] = alarm.get("alarm_active")
        maps = {key: None if value is None else list(dict(value).items()) for key, value in given.items()}
        rows.append({**line, **alarm, **maps, "stream": stream, "t_end": line["t_end_ns"]})
    return pa.Table.from_pylist(rows, schema=WINDOWS_SCHEMA)
