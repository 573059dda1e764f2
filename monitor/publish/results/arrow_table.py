"""Conversion of the lines of results.jsonl to an Arrow table, for Parquet files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa

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

WINDOWS_SCHEMA = pa.schema(
    [
        ("stream", pa.string()),
        ("window", pa.int64()),
        ("t_end_ns", pa.int64()),
        ("t_end", pa.timestamp("ns", tz="UTC")),
        ("window_s", pa.float64()),
        ("frequencies_hz", _MANY),
        ("frequencies_std_hz", _MANY),
        ("damping_ratio", _MANY),
        ("damping_std", _MANY),
        ("mode_shapes", pa.list_(pa.list_(_MANY))),
        ("order", pa.int64()),
        ("refined", pa.bool_()),
        ("stiffness_n_per_m", _MANY),
        ("stiffness_std", _MANY),
        ("ddi", _MANY),
        ("ddi_std", _MANY),
        ("ddi_sequential", _MANY),
        ("loss_n_per_m", _MANY),
        ("unidentified", _NUMBERS),
        ("detectable_loss", _MANY),
        ("rms_m_s2", pa.float64()),
        ("model_modes", _NUMBERS),
        ("mode_tracks", _NUMBERS),
        ("other_modes", pa.list_(_OTHER_MODE)),
        ("misfit", pa.float64()),
        ("temperature_degc", pa.float64()),
        ("temperature_effect", _MANY),
        ("covariates", pa.map_(pa.string(), pa.float64())),
        ("covariate_effect", pa.map_(pa.string(), _MANY)),
        ("frequency_change", _MANY),
        ("frequency_change_std", _MANY),
        ("shape_change", _MANY),
        ("shape_change_std", _MANY),
        ("frequency_effect", pa.map_(pa.string(), _MANY)),
        ("alarm_level", pa.string()),
        ("alarm_stories", _NUMBERS),
        ("alarm_reason", pa.string()),
        ("alarm_active", pa.map_(pa.string(), pa.string())),
        ("alarm_shelved", _NUMBERS),
        ("alarm_changed", pa.list_(pa.string())),
        ("channels_left_out", pa.list_(pa.string())),
        ("left_out_reasons", pa.list_(pa.string())),
        ("rates_hz", _MANY),
        ("skipped", pa.string()),
    ]
)
"""Columns of the table: the keys of a line of results.jsonl, with `alarm` as six columns, the stream's name, and the end of the
window as a timestamp.
"""


def windows_table(lines: Iterable[Mapping[str, Any]], stream: str) -> pa.Table:
    """Convert lines of results.jsonl to rows of an Arrow table.

    Parameters
    ----------
    lines : iterable of mapping
        Parsed lines.
    stream : str
        Name of the stream, the same in every row.

    Returns
    -------
    pyarrow.Table
        Columns as in `WINDOWS_SCHEMA`.
    """
    rows = []
    for line in lines:
        alarm = {f"alarm_{key}": value for key, value in line["alarm"].items()}
        given = {key: line.get(key) for key in ("covariates", "covariate_effect", "frequency_effect")}
        given["alarm_active"] = alarm.get("alarm_active")
        maps = {key: None if value is None else list(dict(value).items()) for key, value in given.items()}
        rows.append({**line, **alarm, **maps, "stream": stream, "t_end": line["t_end_ns"]})
    return pa.Table.from_pylist(rows, schema=WINDOWS_SCHEMA)
