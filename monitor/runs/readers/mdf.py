"""Reads MDF, the files of CANape, INCA and many loggers (ASAM): channels in groups of one clock each, by asammdf."""

from __future__ import annotations

import io
import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadInputError, import_extra, utc
from monitor.runs.readers import stamps
from monitor.runs.readers.arrays import VALUE_BYTES, AnyArray
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import Arrays, demand_room, hand_over
from monitor.runs.readers.table import Table

MAGIC = (b"MDF     ", b"UnFinMF ")
"""Begins of a file; the second one of a file whose logger was cut off. [text; ASAM]"""
_WHOLE, _CLOCK = "whole", " clock"
"""Name under which the process that reads tells what holds for the whole file, and end of the name of a group's times."""
_LOCAL_TIME, _BUS_EVENT, _TIME = 1, 2, 1
"""Flag of a header, that it names no zone; flag of a group, that it holds frames of a bus; kind of a master channel.
[bits, number; ASAM MDF 4: hd_time_flags, cg_flags, cn_sync_type]"""
_LONGEST_S = 4e9
"""Time since the start of a recording that is absurd. [s; 64-bit ns end at 9e9]"""


class Mdf:
    """MDF of versions 2 to 4."""

    name = "MDF"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format."""
        return file.raw.startswith(MAGIC)

    def read(self, file: File) -> list[Table]:
        """Convert the channels, a table for each group; readings that the logger marks as invalid are NaN."""
        import_extra("asammdf", f"{file.path}: MDF")
        arrays, told = file.read_apart(__name__, self.name)
        stated, left_out = json.loads(told.pop(_WHOLE))
        for reason, names in left_out.items():
            text = ", ".join(names[:20]) + ", .." * (len(names) > 20)
            file.on_warning(f"{file.path}: left out, since they {reason}: {text}")
        groups = {key: json.loads(text) for key, text in told.items()}
        if not groups:
            raise BadInputError(f"{file.path}: holds no channel of numbers; frames of a bus are read with --dbc")
        several = Counter(name for _, names, _ in groups.values() for name in names)
        start = stamps.parse([stated], file.options.zone) if stated else None
        tables = []
        for key, (title, names, units) in groups.items():
            columns = tuple(f"{title}/{name}" if several[name] > 1 else name for name in names)
            table = Table(file.path, columns, tuple(units), arrays[key].astype(np.float64))
            if key + _CLOCK in arrays:
                table = replace(table, time_ns=arrays[key + _CLOCK].astype(np.int64))
            if start is not None:
                late_ns = 0 if table.time_ns is None else int(table.time_ns[0])
                text = "" if start.has_zone else stated
                table = replace(table, start_ns=int(start.t_ns[0]) + late_ns, start_text=text)
            tables.append(table)
        return tables


def read(path: Path, most_bytes: int) -> tuple[Arrays, dict[str, str]]:
    """Read the groups of a file; of each are told its title and the names and units of its channels."""
    asammdf = import_extra("asammdf", "MDF")
    arrays: Arrays = {}
    told: dict[str, str] = {}
    left_out: dict[str, list[str]] = {}
    with asammdf.MDF(io.BytesIO(path.read_bytes()), process_bus_logging=False) as file:
        for number, group in enumerate(file.groups):
            title = getattr(group.channel_group, "acq_name", "") or f"group {number + 1}"
            if reason := _not_readings(file, number):
                left_out.setdefault(reason, []).append(title)
                continue
            cells = group.channel_group.cycles_nr * len(group.channels)
            demand_room(VALUE_BYTES * (cells + sum(array.size for array in arrays.values())), most_bytes)
            found = list(_channels(file, number))
            if words := [name for name, _, samples in found if samples is None]:
                left_out.setdefault("are words or arrays", []).extend(words)
            readings = [(name, unit, samples) for name, unit, samples in found if samples is not None]
            if not readings:
                continue
            names, units, columns = zip(*readings, strict=True)
            arrays[str(number)], told[str(number)] = np.column_stack(columns), json.dumps([title, names, units])
            if number in file.masters_db:
                arrays[f"{number}{_CLOCK}"] = _times(file.get_master(number), len(arrays[str(number)]))
        told[_WHOLE] = json.dumps([_start(file.header), left_out])
    return arrays, told


def _not_readings(file: Any, number: int) -> str:
    """Say why a group holds no readings over time; empty where it does."""
    group = file.groups[number].channel_group
    if getattr(group, "flags", 0) & _BUS_EVENT:
        return "are frames of a bus (see --dbc)"
    if group.cycles_nr < 2:
        return "hold less than two samples"
    master = file.groups[number].channels[file.masters_db[number]] if number in file.masters_db else None
    return "are not along time" if getattr(master, "sync_type", _TIME) != _TIME else ""


def _channels(file: Any, number: int) -> Iterator[tuple[str, str, AnyArray | None]]:
    """Yield name, unit and samples of the channels of a group, None for samples that are no numbers; invalid ones are NaN."""
    for at, channel in enumerate(file.groups[number].channels):
        if at == file.masters_db.get(number):
            continue
        # Otherwise asammdf leaves the invalid samples out.
        samples, is_invalid = file.get(group=number, index=at, samples_only=True, ignore_invalidation_bits=True)
        unit = getattr(channel, "unit", "") or getattr(channel.conversion, "unit", "")
        if samples.dtype.kind not in "iuf" or samples.ndim != 1:
            yield channel.name, unit, None
        else:
            yield channel.name, unit, samples if is_invalid is None else np.where(is_invalid, np.nan, samples)


def _times(clock: AnyArray, count: int) -> AnyArray:
    """Convert the times of a group, s, to ns; ValueError where they are damaged."""
    if len(clock) != count or not (np.abs(clock) < _LONGEST_S).all():
        raise ValueError(f"the {len(clock)} times of {count} samples are damaged")
    return np.rint(clock.astype(np.float64) * 1e9).astype(np.int64)


def _start(header: Any) -> str:
    """Return the time at which a recording began, in ISO form, without a zone where it states none; empty without a time."""
    if start_ns := int(getattr(header, "abs_time", 0)):
        fraction = f".{start_ns % 10**9:09d}".rstrip(".0")
        zone = "" if getattr(header, "time_flags", 0) & _LOCAL_TIME else "Z"
        return f"{utc(start_ns - start_ns % 10**9, seconds=True)}{fraction}{zone}"
    if not hasattr(header, "date"):
        return ""
    local = f"{header.date.decode()} {header.time.decode()}".strip(" \0")
    return datetime.strptime(local, "%d:%m:%Y %H:%M:%S").isoformat(" ")


if __name__ == "__main__":
    sys.exit(hand_over(read, *sys.argv[1:]))
