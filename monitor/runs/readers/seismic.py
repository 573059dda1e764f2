"""Reads seismic records of any format by ObsPy; counts need a scale or the inventory of the station."""

from __future__ import annotations

import io
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from monitor.core import BadInputError, MissingInputError, import_extra
from monitor.runs.readers import clocks
from monitor.runs.readers.arrays import VALUE_BYTES, AnyArray
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import Arrays, Told, demand_room
from monitor.runs.readers.table import Table

_MINISEED = re.compile(rb"[0-9 ]{6}[DRQM][ \0]|MS\x03")
"""Begin of a file: sequence number and quality of the first record, or that of version 3. [text; FDSN]"""
_NIED = b"Origin Time"
"""Begin of a file. [text; NIED]"""
_MARKS = (_MINISEED, re.compile(_NIED), re.compile(rb"TIMESERIES "), re.compile(rb"WID[12] "))
"""Begins of the files that tell their format. [text; FDSN, NIED, IRIS, GSE]"""
_SUFFIXES = re.compile(r"\.(sac|gcf|sgy|segy|evt|win|gse2?|ah|m?seed|msd|su|seg2|dmx|rg16|fcnt|cmp)")
"""Of formats that ObsPy knows by trying. [names; convention]"""
_SAME_RATE = 1e-6
"""Distance from a whole rate within which the whole rate is meant. [1; rounding: single precision of a header]"""
_SEED_UNIT = "m/s^2"
"""Unit of an accelerometer, by StationXML `M/S**2`. [text; FDSN]"""
_WHOLE = "whole"
"""Name under which the process that reads tells what holds for the whole file."""


class Seismic:
    """All waveform formats that ObsPy reads: MiniSEED, K-NET, SAC, GSE2, GCF, SEG-Y, EVT, WIN, SLIST, TSPAIR and others.

    What is missing between records is NaN.  Formats of counts need a scale, or the inventory of the station, of which the
    sensitivity of each channel is taken as flat, and that tells its unit; K-NET and KiK-net state their scale, and take no other.
    """

    name = "seismic records"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format, by its first bytes, or by its suffix where it has none of its own."""
        named = _SUFFIXES.fullmatch(file.suffix) is not None and b"\0" in file.raw[:4096]
        return named or any(mark.match(file.raw) for mark in _MARKS)

    def read(self, file: File) -> list[Table]:
        """Convert the traces to one table, whose columns are named NETWORK.STATION.LOCATION.CHANNEL."""
        path, options = file.path, file.options
        obspy = import_extra("obspy", f"{path}: MiniSEED or another seismic format")
        arrays, told = file.read_apart(__name__, self.name)
        whole = told[_WHOLE]
        for note in whole["notes"]:
            file.on_warning(f"{path}: {note}")
        table = _joined(path, [_Trace(data, *told[key]) for key, data in arrays.items()], file)
        unit = whole["unit"]
        if unit == "counts" and (options.scale is None) == (options.inventory is None):
            raise BadInputError(
                f"{path}: {'MiniSEED ' if _MINISEED.match(file.raw) else ''}holds counts; give --scale M/S^2-A-COUNT or "
                "--inventory STATION.xml, one of them"
            )
        if options.inventory is None or unit == "m/s^2":
            return [replace(table, units=(unit,) * len(table.columns))]
        stations, time = _inventory(obspy, options.inventory), obspy.UTCDateTime(ns=table.start_ns)
        known = [_sensitivity(options.inventory, stations, name, time) for name in table.columns]
        units = tuple(of for of, _ in known)
        if not any(of == _SEED_UNIT for of in units):
            raise BadInputError(
                f"{path}: {', '.join(table.columns)} measure {', '.join(units)}, which is no acceleration"
            )
        return [replace(table, units=units, values=table.values / [count for _, count in known], is_scaled=True)]


class _Trace(NamedTuple):
    """Readings without a gap of one channel."""

    data: AnyArray
    name: str
    rate_hz: float
    begin_ns: int

    @property
    def end_ns(self) -> float:
        """Time one sampling period after the last reading."""
        return self.begin_ns + len(self.data) * 1e9 / self.rate_hz


def read(path: Path, most_bytes: int) -> tuple[Arrays, Told]:
    """Read the traces of a file; of each are told name, rate in Hz and time in ns, and under `_WHOLE` what holds for the file."""
    import obspy
    from obspy.core.util.base import ENTRY_POINTS

    ENTRY_POINTS["waveform"].pop("PICKLE", None)  # ObsPy tries every format, and to load a pickle runs the code in it
    raw = path.read_bytes()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        form = "MSEED" if _MINISEED.match(raw) else "KNET" if raw.startswith(_NIED) else None
        stream = obspy.read(io.BytesIO(raw), format=form, apply_calib=form == "KNET")
    notes = _notes(raw if form == "MSEED" else b"", stream, caught)
    traces = {str(k): t for k, t in enumerate(t for t in stream if t.stats.npts and t.data.dtype.kind in "iuf")}
    demand_room(VALUE_BYTES * sum(trace.stats.npts for trace in traces.values()), most_bytes)
    # Whole numbers are counts; what a program wrote in floating point is in a unit that it does not say.
    whole = form == "MSEED" or all(trace.data.dtype.kind in "iu" for trace in traces.values())
    told: Told = {
        key: [trace.id, float(trace.stats.sampling_rate), int(trace.stats.starttime.ns)]
        for key, trace in traces.items()
    }
    told[_WHOLE] = {"notes": notes, "unit": "m/s^2" if form == "KNET" else "counts" if whole else ""}
    return {key: trace.data for key, trace in traces.items()}, told


def _notes(miniseed: bytes, stream: Any, caught: Sequence[warnings.WarningMessage]) -> list[str]:
    """Say what of a file is damaged or left out."""
    damage = [str(one.message).partition(",")[0] for one in caught if "MSEED" in one.category.__name__]
    failed = Counter(re.sub(r"\d+", "..", text) for text in damage)  # each record tells its own bytes
    texts = Counter(trace.id for trace in stream if trace.data.dtype.kind not in "iuf")
    notes = [f"{what}: {count} records" for what, count in failed.items()]
    notes += [f"{name}: {count} records of text are left out" for name, count in texts.items()]
    if rest := len(miniseed) % (int(stream[0].stats.mseed.record_length) if miniseed and stream else 512):
        notes.append(f"the last record is cut: {rest} bytes are left out")
    return notes


def _joined(path: Path, traces: Sequence[_Trace], file: File) -> Table:
    """Put traces on one clock; NaN where there is no reading. Units are not told yet."""
    if not traces:
        raise BadInputError(f"{path}: holds no samples")
    rate_hz, first_ns = _one_rate_hz(path, traces), min(trace.begin_ns for trace in traces)
    places = [(trace.begin_ns - first_ns) * 1e-9 * rate_hz for trace in traces]
    clocks.tell_apart(path, max(abs(place - round(place)) for place in places), file.on_warning)
    names = tuple(dict.fromkeys(trace.name for trace in traces))
    n = max(round(place) + len(trace.data) for place, trace in zip(places, traces, strict=True))
    if n * len(names) * VALUE_BYTES > file.most_bytes:
        raise BadInputError(
            f"{path}: {n} samples from the first record to the last are too many; cut it into several files"
        )
    values, overlap = np.full((n, len(names)), np.nan), 0
    for place, trace in zip(places, traces, strict=True):
        held = values[round(place) : round(place) + len(trace.data), names.index(trace.name)]
        overlap += int(np.count_nonzero(np.isfinite(held) & (held != trace.data)))
        held[:] = np.where(np.isfinite(held), held, trace.data)
    if overlap:
        file.on_warning(
            f"{path}: records overlap: {overlap / rate_hz:.4g} s stand twice with other readings; those that stand first are kept"
        )
    whole = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not whole.size:
        raise BadInputError(f"{path}: its channels have no time in common")
    # Before the last channel begins and after the first one ends there is no whole sample.
    start_ns = first_ns + round(int(whole[0]) * 1e9 / rate_hz)
    return Table(path, names, (), values[whole[0] : whole[-1] + 1], start_ns=start_ns, rate_hz=rate_hz)


def _one_rate_hz(path: Path, traces: Sequence[_Trace]) -> float:
    """Return the one rate of traces, which differ by less than a sample over the whole file; BadInputError for several."""
    rates = [trace.rate_hz for trace in traces]
    if not all(0.0 < rate < inf for rate in rates):
        raise BadInputError(f"{path}: states {min(rates):g} Hz, which is no rate")
    length_s = 1e-9 * (max(trace.end_ns for trace in traces) - min(trace.begin_ns for trace in traces))
    rate_hz = float(np.median(rates))
    if (max(rates) / min(rates) - 1.0) * length_s * rate_hz > 1.0:
        text = ", ".join(f"{trace.name} {trace.rate_hz:g} Hz" for trace in traces[:20])
        raise BadInputError(f"{path}: channels of several rates ({text}); cut it into a file a rate")
    return float(round(rate_hz)) if round(rate_hz) and abs(rate_hz / round(rate_hz) - 1.0) < _SAME_RATE else rate_hz


def _inventory(obspy: Any, path: Path) -> Any:
    """Read an inventory."""
    try:
        return obspy.read_inventory(io.BytesIO(path.read_bytes()))
    except OSError as error:
        raise MissingInputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise BadInputError(f"{path}: is no inventory: {error}") from error


def _sensitivity(path: Path, stations: Any, name: str, time: Any) -> tuple[str, float]:
    """Return by the inventory what a channel measures, as its unit, and its counts of a unit."""
    try:
        known = stations.get_response(name, time).instrument_sensitivity
        unit, value = str(known.input_units).lower().replace("**", "^"), float(known.value)
    except Exception as error:
        raise BadInputError(f"{path}: has no sensitivity of {name} at {time}") from error
    if not value > 0.0:
        raise BadInputError(f"{path}: states {value:g} counts of a unit of {name}, which is no sensitivity")
    return unit, value
