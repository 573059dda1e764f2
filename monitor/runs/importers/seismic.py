"""Reads MiniSEED and K-NET/KiK-net (NIED's ASCII) by ObsPy; counts need a scale or the inventory of the station."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadInputError, MissingInputError, import_extra
from monitor.runs.importers.table import Array, Table

_MINISEED = re.compile(rb"[0-9 ]{6}[DRQM][ \0]|MS\x03")
"""Begin of a file: sequence number and quality of the first record, or that of version 3. [text; FDSN]"""
_NIED = b"Origin Time"
"""Begin of a file. [text; NIED]"""
_UNIT = "m/s^2"
_SEED_UNIT = "M/S**2"
"""Unit of an accelerometer in StationXML. [text; FDSN]"""
_VALUE_BYTES = 8
"""Size of a reading in a table. [bytes; definition: float64]"""


def is_seismic(raw: bytes) -> bool:
    """Return whether the content of a file is MiniSEED or K-NET/KiK-net."""
    return raw.startswith(_NIED) or _MINISEED.match(raw) is not None


def holds_counts(raw: bytes) -> bool:
    """Return whether the content of a file is MiniSEED, whose readings are counts."""
    return _MINISEED.match(raw) is not None


def to_table(path: Path, raw: bytes, most_bytes: int, scale: float | None, inventory: Path | None) -> Table:
    """Convert the traces of a file to a table of at most `most_bytes`, whose columns are named NETWORK.STATION.LOCATION.CHANNEL.

    K-NET and KiK-net state their scale, and take no other.  What is missing between records of MiniSEED is NaN.

    Parameters
    ----------
    scale : float, optional
        m/s^2 of a count of MiniSEED.
    inventory : Path, optional
        StationXML with the sensitivity of each channel, taken as flat.

    Raises
    ------
    BadInputError
        The file is damaged, its traces do not fit each other, or nothing tells what a count is.
    MissingInputError
        ObsPy is not installed, or the inventory cannot be read.
    """
    obspy, is_nied = import_extra("obspy", f"{path}: MiniSEED or K-NET"), raw.startswith(_NIED)
    if not is_nied and (scale is None) == (inventory is None):
        raise BadInputError(
            f"{path}: MiniSEED holds counts; give --scale M/S^2-A-COUNT or --inventory STATION.xml, one of them"
        )
    try:
        stream = obspy.read(io.BytesIO(raw), format="KNET" if is_nied else "MSEED", apply_calib=is_nied)
    except Exception as error:
        raise BadInputError(f"{path}: cannot be read as {'K-NET' if is_nied else 'MiniSEED'}: {error}") from error
    stations = None if inventory is None else _inventory(obspy, inventory)
    columns, values, t_ns, rate_hz = _joined(path, stream, most_bytes)
    if not is_nied:
        factors = [scale or _sensitivity(inventory, stations, name, stream[0].stats.starttime) for name in columns]
        values = values * np.array(factors)
    clock = t_ns + np.rint(np.arange(len(values)) * (1e9 / rate_hz)).astype(np.int64)
    return Table(path, columns, (_UNIT,) * len(columns), values, columns, clock, None, t_ns, rate_hz)


def _joined(path: Path, stream: Any, most_bytes: int) -> tuple[tuple[str, ...], Array, int, float]:
    """Put the traces of a stream on one clock: names, values of shape (n, c), time of the first in ns, rate in Hz."""
    stream = [trace for trace in stream if trace.stats.npts]
    if not stream:
        raise BadInputError(f"{path}: holds no samples")
    names = tuple(dict.fromkeys(trace.id for trace in stream))
    rates = {float(trace.stats.sampling_rate) for trace in stream}
    if len(rates) != 1:
        text = ", ".join(f"{trace.id} {trace.stats.sampling_rate:g} Hz" for trace in stream[:20])
        raise BadInputError(f"{path}: channels of several rates ({text}); cut it into a file a rate")
    (rate_hz,) = rates
    first_ns = min(int(trace.stats.starttime.ns) for trace in stream)
    last_ns = max(int(trace.stats.endtime.ns) for trace in stream)
    n = round((last_ns - first_ns) * 1e-9 * rate_hz) + 1
    if not rate_hz > 0.0 or n * len(names) * _VALUE_BYTES > most_bytes:
        raise BadInputError(
            f"{path}: {n} samples from the first record to the last are too many; cut it into several files"
        )
    values = np.full((n, len(names)), np.nan)
    for trace in stream:
        at = round((int(trace.stats.starttime.ns) - first_ns) * 1e-9 * rate_hz)
        data = np.asarray(trace.data, dtype=np.float64)
        values[at : at + data.size, names.index(trace.id)] = data[: n - at]
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
