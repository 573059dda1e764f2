"""Reads TDMS, the files of LabVIEW and DIAdem: channels with their unit and rate, by npTDMS."""

from __future__ import annotations

import io
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadInputError, import_extra
from monitor.runs.readers.arrays import VALUE_BYTES
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import Arrays, Told, demand_room
from monitor.runs.readers.table import Table

_LEFT_OUT = "left out"
"""Name under which the process that reads tells the channels that hold no readings."""


class Tdms:
    """TDMS."""

    name = "TDMS"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format."""
        return file.raw.startswith(b"TDSm")

    def read(self, file: File) -> list[Table]:
        """Convert the channels, a table for each rate, length and start."""
        import_extra("nptdms", f"{file.path}: TDMS")
        arrays, told = file.read_apart(__name__, self.name)
        if not arrays:
            raise BadInputError(f"{file.path}: holds no channel of numbers")
        if words := told.pop(_LEFT_OUT):
            file.on_warning(f"{file.path}: left out, since they hold no numbers or only one: {words}")
        several = Counter(name for _, name, *_ in told.values())
        clocks: dict[tuple[Any, ...], list[str]] = {}
        for key, (_, _, _, *clock) in told.items():
            clocks.setdefault((*clock, len(arrays[key])), []).append(key)
        return [
            Table(
                file.path,
                tuple(f"{told[k][0]}/{told[k][1]}" if several[told[k][1]] > 1 else told[k][1] for k in keys),
                tuple(told[key][2] for key in keys),
                np.column_stack([arrays[key] for key in keys]).astype(np.float64),
                start_ns=None if start_ns is None else start_ns + round(offset_s * 1e9),
                rate_hz=round(1.0 / step_s, 6) if step_s else None,
            )
            for (step_s, offset_s, start_ns, _), keys in clocks.items()
        ]


def read(path: Path, most_bytes: int) -> tuple[Arrays, Told]:
    """Read the channels of a file; of each are told group, name, unit, step and offset in s, and start in ns."""
    TdmsFile = import_extra("nptdms", "TDMS").TdmsFile  # noqa: N806
    arrays: Arrays = {}
    told: Told = {}
    left_out: list[str] = []
    held = 0
    with TdmsFile.open(io.BytesIO(path.read_bytes())) as file:
        for group in file.groups():
            for channel in group.channels():
                if channel.dtype.kind not in "iuf" or len(channel) < 2:
                    left_out += [channel.name] if len(channel) else []
                    continue
                held += VALUE_BYTES * len(channel)
                demand_room(held, most_bytes)
                told_of = channel.properties
                start = told_of.get("wf_start_time")  # by LabVIEW that of 1904 where there is none
                dated = start is not None and int(start.astype("datetime64[s]").astype(int)) > 0
                start_ns = int(start.astype("datetime64[ns]").astype(int)) if dated else None
                unit = str(told_of.get("unit_string") or told_of.get("NI_UnitDescription") or "")
                key = str(len(arrays))
                arrays[key] = channel[:]
                clock = (float(told_of.get(name, 0.0)) for name in ("wf_increment", "wf_start_offset"))
                told[key] = [group.name, channel.name, unit, *clock, start_ns]
    told[_LEFT_OUT] = ", ".join(left_out)
    return arrays, told
