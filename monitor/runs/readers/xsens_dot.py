"""Reads the Xsens DOT dialect of CSV: a packet counter, a microsecond clock of 32 bit, local start time."""

from __future__ import annotations

import re

import numpy as np

from monitor.core import BadInputError, utc_ns
from monitor.runs.readers.delimited import Text
from monitor.runs.readers.stamps import ZONE_HOURS
from monitor.runs.readers.table import OnWarning, Table

_START = re.compile(r"StartTime:[\s,;]*(\d{4}-\d{2}-\d{2})_(\d{2}:\d{2}:\d{2})_(\d{3})\s*(\w*)")
_WRAP = 1 << 32


def is_xsens(text: Text) -> bool:
    """Test whether the header is that of Xsens DOT."""
    return {"PacketCounter", "SampleTimeFine"} <= {column.name for column in text.dialect.columns}


def to_table(text: Text, on_warning: OnWarning) -> Table:
    """Convert a text to a table of accelerations (m/s^2) and rates of rotation (deg/s) on the sensor's own clock.

    The default column is Acc_X.
    """
    header = [column.name for column in text.dialect.columns]
    moved = tuple(name for name in header if name.startswith("Acc_"))
    if not moved:
        raise BadInputError(f"{text.path}: no Acc_ column; export the free or calibrated acceleration")
    columns = (*moved, *(name for name in header if name.startswith("Gyr_")))
    values = text.values([header.index(name) for name in columns], on_warning)
    micros, counter = text.values([header.index("SampleTimeFine"), header.index("PacketCounter")], on_warning).T
    if not ((np.abs(micros) < 1e15).all() and (np.abs(counter) < 1e15).all()):
        raise BadInputError(f"{text.path}: empty or absurd cells in PacketCounter or SampleTimeFine")
    clock = micros.astype(np.int64)
    clock[1:] += _WRAP * np.cumsum(np.diff(clock) < -_WRAP // 2)
    start_ns = _start_ns(text, on_warning)
    # The device writes the orientation before its first acceleration is available: that row is all zeros, even gravity.
    first = int(len(values) > 1 and not values[0, : len(moved)].any())
    if start_ns is not None:
        start_ns += 1000 * int(clock[first] - clock[0])
    return Table(
        path=text.path,
        columns=columns,
        units=("m/s^2",) * len(moved) + ("deg/s",) * (len(columns) - len(moved)),
        values=values[first:],
        time_ns=1000 * clock[first:],
        index=counter[first:].astype(np.int64),
        start_ns=start_ns,
        rate_hz=text.dialect.rate_hz,
        chosen=("Acc_X",) if "Acc_X" in columns else moved[:1],
    )


def _start_ns(text: Text, on_warning: OnWarning) -> int | None:
    """Read the start time from the preamble, UTC in ns since 1970; None if it is not stated."""
    found = next((match for line in text.preamble if (match := _START.search(line))), None)
    if found is None:
        return None
    hours = ZONE_HOURS.get(found[4].upper() or "UTC")
    if hours is None:
        on_warning(f"{text.path}: unknown time zone {found[4]!r} in StartTime; taken as UTC")
    try:
        return utc_ns(f"{found[1]}T{found[2]}.{found[3]}") - 3600 * (hours or 0) * 10**9
    except ValueError as error:
        raise BadInputError(f"{text.path}: StartTime {error}") from error
