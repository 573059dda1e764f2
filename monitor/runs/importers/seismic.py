"""Reads MiniSEED and K-NET/KiK-net (NIED's ASCII) by ObsPy; counts need a scale or the inventory of the station."""

from __future__ import annotations

import io
import json
import re
import sys
import warnings
from collections import Counter
from math import inf
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import BadInputError, MissingInputError, import_extra
from monitor.runs.importers.arrays import VALUE_BYTES
from monitor.runs.importers.own_process import Arrays, demand_room, hand_over, read_apart
from monitor.runs.importers.table import Array, OnWarning, Table

_MINISEED = re.compile(rb"[0-9 ]{6}[DRQM][ \0]|MS\x03")
"""Begin of a file: sequence number and quality of the first record, or that of version 3. [text; FDSN]"""
_NIED = b"Origin Time"
"""Begin of a file. [text; NIED]"""
_UNIT = "m/s^2"
_SEED_UNIT = "M/S**2"
"""Unit of an accelerometer in StationXML. [text; FDSN]"""
_NOTES = "notes"
"""Name under which the process that reads tells what is doubtful of the whole file."""


def is_seismic(raw: bytes) -> bool:
    """Return whether the content of a file is MiniSEED or K-NET/KiK-net."""
    return raw.startswith(_NIED) or _MINISEED.match(raw) is not None


def holds_counts(raw: bytes) -> bool:
    """Return whether the content of a file is MiniSEED, whose readings are counts."""
    return _MINISEED.match(raw) is not None


def to_table(
    path: Path,
    raw: bytes,
    most_bytes: int,
    scale: float | None,
    inventory: Path | None,
    on_warning: OnWarning,
    least_s: float,
) -> Table:
    """Convert the traces of a file to a table of at most `most_bytes`, whose columns are named NETWORK.STATION.LOCATION.CHANNEL.

    K-NET and KiK-net state their scale, and take no other. What is missing between records of MiniSEED is NaN; `scale` is the
    m/s^2 of its counts, else the StationXML `inventory` has the sensitivity of each channel, taken as flat.
    """
    obspy, is_nied = import_extra("obspy", f"{path}: MiniSEED or K-NET"), raw.startswith(_NIED)
    if not is_nied and (scale is None) == (inventory is None):
        raise BadInputError(
            f"{path}: MiniSEED holds counts; give --scale M/S^2-A-COUNT or --inventory STATION.xml, one of them"
        )
    kind = "K-NET" if is_nied else "MiniSEED"
    columns, values, t_ns, rate_hz = join(
        path, *read_apart(__name__, kind, path, most_bytes, least_s, kind), most_bytes, on_warning
    )
    if not is_nied:
        stations = None if inventory is None else _inventory(obspy, inventory)
        time = obspy.UTCDateTime(ns=t_ns)
        values = values * np.array([scale or _sensitivity(inventory, stations, name, time) for name in columns])
    clock = t_ns + np.rint(np.arange(len(values)) * (1e9 / rate_hz)).astype(np.int64)
    return Table(path, columns, (_UNIT,) * len(columns), values, columns, clock, None, t_ns, rate_hz)


def read(path: Path, most_bytes: int, kind: str) -> tuple[Arrays, dict[str, str]]:
    """Read the traces of a file; of each are told name, rate in Hz and time in ns, and under `_NOTES` what is doubtful."""
    import obspy

    is_nied = kind == "K-NET"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stream = obspy.read(io.BytesIO(path.read_bytes()), format="KNET" if is_nied else "MSEED", apply_calib=is_nied)
    failed = Counter(str(one.message).partition(",")[0] for one in caught if "MSEED" in one.category.__name__)
    notes = [f"{what}: {count} records" for what, count in failed.items()]
    traces = [trace for trace in stream if trace.stats.npts and trace.data.dtype.kind in "iuf"]
    texts = Counter(trace.id for trace in stream if trace.data.dtype.kind not in "iuf")
    notes += [f"{name}: {count} records of text are left out" for name, count in texts.items()]
    told = {
        str(k): json.dumps([trace.id, float(trace.stats.sampling_rate), int(trace.stats.starttime.ns)])
        for k, trace in enumerate(traces)
    }
    demand_room(VALUE_BYTES * sum(trace.stats.npts for trace in traces), most_bytes)
    return {str(k): trace.data for k, trace in enumerate(traces)}, {**told, _NOTES: json.dumps(notes)}


def join(
    path: Path, arrays: Arrays, told: dict[str, str], most_bytes: int, on_warning: OnWarning
) -> tuple[tuple[str, ...], Annotated[Array, "n c"], int, float]:
    """Put traces as `read` tells them on one clock: names, values, time of the first in ns, rate in Hz."""
    for note in json.loads(told[_NOTES]):
        on_warning(f"{path}: {note}")
    stream = [(*json.loads(told[k]), data) for k, data in arrays.items()]
    if not stream:
        raise BadInputError(f"{path}: holds no samples")
    names = tuple(dict.fromkeys(name for name, *_ in stream))
    rates = {rate for _, rate, *_ in stream}
    if len(rates) != 1:
        text = ", ".join(f"{name} {rate:g} Hz" for name, rate, *_ in stream[:20])
        raise BadInputError(f"{path}: channels of several rates ({text}); cut it into a file a rate")
    (rate_hz,) = rates
    if not 0.0 < rate_hz < inf:
        raise BadInputError(f"{path}: states {rate_hz:g} Hz, which is no rate")
    first_ns = min(begin_ns for _, _, begin_ns, _ in stream)
    begins = [round((begin_ns - first_ns) * 1e-9 * rate_hz) for _, _, begin_ns, _ in stream]
    n = max(begin + len(data) for begin, (*_, data) in zip(begins, stream, strict=True))
    if n * len(names) * VALUE_BYTES > most_bytes:
        raise BadInputError(
            f"{path}: {n} samples from the first record to the last are too many; cut it into several files"
        )
    values = np.full((n, len(names)), np.nan)
    for begin, (name, _, _, data) in zip(begins, stream, strict=True):
        values[begin : begin + len(data), names.index(name)] = data
    held = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not held.size:
        raise BadInputError(f"{path}: its channels have no time in common")
    # Before the last channel begins and after the first one ends there is no whole sample.
    values = values[held[0] : held[-1] + 1]
    return names, values, first_ns + round(int(held[0]) * 1e9 / rate_hz), rate_hz


def _inventory(obspy: Any, path: Path) -> Any:
    """Read an inventory."""
    try:
        return obspy.read_inventory(io.BytesIO(path.read_bytes()))
    except OSError as error:
        raise MissingInputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise BadInputError(f"{path}: is no inventory: {error}") from error


def _sensitivity(path: Path | None, stations: Any, name: str, time: Any) -> float:
    """Return the m/s^2 of a count of a channel by its inventory."""
    try:
        known = stations.get_response(name, time).instrument_sensitivity
        unit, value = str(known.input_units), float(known.value)
    except Exception as error:
        raise BadInputError(f"{path}: has no sensitivity of {name} at {time}") from error
    if unit.upper() != _SEED_UNIT or not value > 0.0:
        raise BadInputError(
            f"{path}: {name} measures {unit}, which is no acceleration; import its accelerometers alone"
        )
    return 1.0 / value


if __name__ == "__main__":
    sys.exit(hand_over(read, *sys.argv[1:]))
