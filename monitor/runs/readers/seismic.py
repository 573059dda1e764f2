"""Reads seismic records of any format by ObsPy; counts need a scale or the inventory of the station."""

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
from monitor.runs.readers.arrays import VALUE_BYTES
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import Arrays, demand_room, hand_over, read_apart
from monitor.runs.readers.table import Array, OnWarning, Table

_MINISEED = re.compile(rb"[0-9 ]{6}[DRQM][ \0]|MS\x03")
"""Begin of a file: sequence number and quality of the first record, or that of version 3. [text; FDSN]"""
_NIED = b"Origin Time"
"""Begin of a file. [text; NIED]"""
_MARKS = (_MINISEED, re.compile(_NIED), re.compile(rb"TIMESERIES "), re.compile(rb"WID[12] "))
"""Begins of the files that tell their format. [text; FDSN, NIED, IRIS, GSE]"""
_SUFFIXES = frozenset(
    [
        ".sac",
        ".gcf",
        ".sgy",
        ".segy",
        ".evt",
        ".win",
        ".gse",
        ".gse2",
        ".ah",
        ".seed",
        ".mseed",
        ".msd",
        ".su",
        ".seg2",
        ".dmx",
        ".rg16",
        ".fcnt",
        ".cmp",
    ]
)
"""Of formats that ObsPy knows by trying. [names; convention]"""
_SAME_RATE = 1e-6
"""Distance from a whole rate within which the whole rate is meant. [1; rounding: single precision of a header]"""
_OFF = 0.1
"""Part of a sample by which channels lie apart and are told. [1; judgement: 0.6 rad of phase at the Nyquist rate]"""
_SEED_UNIT = "M/S**2"
"""Unit of an accelerometer in StationXML. [text; FDSN]"""
_NOTES = "notes"
"""Name under which the process that reads tells what is doubtful of the whole file."""


class Seismic:
    """All waveform formats that ObsPy reads: MiniSEED, K-NET, SAC, GSE2, GCF, SEG-Y, EVT, WIN, SLIST, TSPAIR and others.

    What is missing between records is NaN.  Formats of counts need a scale, or the inventory of the station, of which the
    sensitivity of each channel is taken as flat; K-NET and KiK-net state their scale, and take no other.
    """

    name = "seismic records"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format, by its first bytes, or by its suffix where it has none of its own."""
        return any(mark.match(file.raw) for mark in _MARKS) or (file.suffix in _SUFFIXES and b"\0" in file.raw[:4096])

    def read(self, file: File) -> list[Table]:
        """Convert the traces to one table, whose columns are named NETWORK.STATION.LOCATION.CHANNEL."""
        path, options = file.path, file.options
        obspy = import_extra("obspy", f"{path}: MiniSEED or another seismic format")
        is_nied = file.raw.startswith(_NIED)
        arrays, told = read_apart(__name__, self.name, path, file.most_bytes, file.limits.reader_s)
        columns, values, t_ns, rate_hz = join(path, arrays, told, file.most_bytes, file.on_warning)
        unit = "m/s^2" if is_nied else json.loads(told[_NOTES])["unit"]
        if unit == "counts" and (options.scale is None) == (options.inventory is None):
            raise BadInputError(
                f"{path}: {'MiniSEED ' if _MINISEED.match(file.raw) else ''}holds counts; give --scale M/S^2-A-COUNT or "
                "--inventory STATION.xml, one of them"
            )
        if options.inventory is not None and not is_nied:
            stations = _inventory(obspy, options.inventory)
            time = obspy.UTCDateTime(ns=t_ns)
            values = values * np.array([_sensitivity(options.inventory, stations, name, time) for name in columns])
            unit = "m/s^2"
        scaled = options.inventory is not None and not is_nied
        return [Table(path, columns, (unit,) * len(columns), values, None, None, t_ns, rate_hz, is_scaled=scaled)]


def read(path: Path, most_bytes: int) -> tuple[Arrays, dict[str, str]]:
    """Read the traces of a file; of each are told name, rate in Hz and time in ns, and under `_NOTES` what holds for the file."""
    import obspy

    raw = path.read_bytes()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        form = "MSEED" if _MINISEED.match(raw) else "KNET" if raw.startswith(_NIED) else None
        stream = obspy.read(io.BytesIO(raw), format=form, apply_calib=form == "KNET")
    damage = [str(one.message).partition(",")[0] for one in caught if "MSEED" in one.category.__name__]
    failed = Counter(re.sub(r"\d+", "..", text) for text in damage)  # each record tells its own bytes
    notes = [f"{what}: {count} records" for what, count in failed.items()]
    traces = [trace for trace in stream if trace.stats.npts and trace.data.dtype.kind in "iuf"]
    texts = Counter(trace.id for trace in stream if trace.data.dtype.kind not in "iuf")
    notes += [f"{name}: {count} records of text are left out" for name, count in texts.items()]
    if form == "MSEED" and (rest := len(raw) % (int(stream[0].stats.mseed.record_length) if stream else 512)):
        notes.append(f"the last record is cut: {rest} bytes are left out")
    told = {
        str(k): json.dumps([trace.id, float(trace.stats.sampling_rate), int(trace.stats.starttime.ns)])
        for k, trace in enumerate(traces)
    }
    demand_room(VALUE_BYTES * sum(trace.stats.npts for trace in traces), most_bytes)
    # Whole numbers are counts; what a program wrote in floating point is in a unit that it does not say.
    unit = "counts" if all(trace.data.dtype.kind in "iu" for trace in traces) or form == "MSEED" else ""
    return {str(k): trace.data for k, trace in enumerate(traces)}, {
        **told,
        _NOTES: json.dumps({"notes": notes, "unit": unit}),
    }


def join(
    path: Path, arrays: Arrays, told: dict[str, str], most_bytes: int, on_warning: OnWarning
) -> tuple[tuple[str, ...], Annotated[Array, "n c"], int, float]:
    """Put traces as `read` tells them on one clock: names, values, time of the first in ns, rate in Hz."""
    for note in json.loads(told[_NOTES])["notes"]:
        on_warning(f"{path}: {note}")
    stream = [(*json.loads(told[k]), data) for k, data in arrays.items()]
    if not stream:
        raise BadInputError(f"{path}: holds no samples")
    names = tuple(dict.fromkeys(name for name, *_ in stream))
    rates = [rate for _, rate, *_ in stream]
    if not all(0.0 < rate < inf for rate in rates):
        raise BadInputError(f"{path}: states {min(rates):g} Hz, which is no rate")
    first_ns = min(begin_ns for _, _, begin_ns, _ in stream)
    last_ns = max(begin_ns + len(data) * 1e9 / rate for _, rate, begin_ns, data in stream)
    rate_hz = float(np.median(rates))
    # One rate, where they differ by less than a sample over the whole file.
    if (max(rates) / min(rates) - 1.0) * (last_ns - first_ns) * 1e-9 * rate_hz > 1.0:
        text = ", ".join(f"{name} {rate:g} Hz" for name, rate, *_ in stream[:20])
        raise BadInputError(f"{path}: channels of several rates ({text}); cut it into a file a rate")
    rate_hz = float(round(rate_hz)) if round(rate_hz) and abs(rate_hz / round(rate_hz) - 1.0) < _SAME_RATE else rate_hz
    places = [(begin_ns - first_ns) * 1e-9 * rate_hz for _, _, begin_ns, _ in stream]
    begins = [round(place) for place in places]
    off = max(abs(place - begin) for place, begin in zip(places, begins, strict=True))
    if off > _OFF:
        on_warning(f"{path}: channels are sampled up to {off:.2g} of a sample apart; phases of shapes are off by that")
    n = max(begin + len(data) for begin, (*_, data) in zip(begins, stream, strict=True))
    if n * len(names) * VALUE_BYTES > most_bytes:
        raise BadInputError(
            f"{path}: {n} samples from the first record to the last are too many; cut it into several files"
        )
    values = np.full((n, len(names)), np.nan)
    overlap = 0
    for begin, (name, _, _, data) in zip(begins, stream, strict=True):
        held = values[begin : begin + len(data), names.index(name)]
        overlap += int(np.count_nonzero(np.isfinite(held) & (held != data)))
        values[begin : begin + len(data), names.index(name)] = np.where(np.isfinite(held), held, data)
    if overlap:
        on_warning(
            f"{path}: records overlap: {overlap / rate_hz:.4g} s stand twice with other readings; those that stand first are kept"
        )
    held_rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not held_rows.size:
        raise BadInputError(f"{path}: its channels have no time in common")
    # Before the last channel begins and after the first one ends there is no whole sample.
    values = values[held_rows[0] : held_rows[-1] + 1]
    return names, values, first_ns + round(int(held_rows[0]) * 1e9 / rate_hz), rate_hz


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
