"""Reads TDMS, the files of LabVIEW and DIAdem: channels with their unit and rate, by npTDMS."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np

from monitor.core import BadInputError, import_extra
from monitor.runs.readers.arrays import VALUE_BYTES
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import Arrays, demand_room, hand_over, read_apart
from monitor.runs.readers.table import Table


class Tdms:
    """TDMS."""

    name = "TDMS"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format."""
        return file.raw.startswith(b"TDSm")

    def read(self, file: File) -> list[Table]:
        """Convert the channels, a table for each rate, length and start."""
        import_extra("nptdms", f"{file.path}: TDMS")
        arrays, told = read_apart(__name__, self.name, file.path, file.most_bytes, file.limits.reader_s)
        groups: dict[str, list[str]] = {}
        for name in arrays:
            _, _, *clock = json.loads(told[name])
            groups.setdefault(json.dumps([*clock, len(arrays[name])]), []).append(name)
        tables = []
        for clock, names in groups.items():
            step_s, offset_s, start_ns, _ = json.loads(clock)
            shown, units = zip(*(json.loads(told[name])[:2] for name in names), strict=True)
            if len(set(shown)) != len(shown):
                raise BadInputError(f"{file.path}: channels of the same name in several groups: {', '.join(shown)}")
            start = None if start_ns is None else start_ns + round(offset_s * 1e9)
            tables.append(
                Table(
                    file.path,
                    tuple(shown),
                    tuple(units),
                    np.column_stack([arrays[name] for name in names]).astype(np.float64),
                    start_ns=start,
                    rate_hz=round(1.0 / step_s, 6) if step_s else None,
                )
            )
        if not tables:
            raise BadInputError(f"{file.path}: holds no channel of numbers")
        return tables


def read(path: Path, most_bytes: int) -> tuple[Arrays, dict[str, str]]:
    """Read the channels of a file; of each are told name, unit, step and offset in s, and start in ns."""
    TdmsFile = import_extra("nptdms", "TDMS").TdmsFile  # noqa: N806
    arrays: Arrays = {}
    told: dict[str, str] = {}
    held = 0
    with TdmsFile.open(io.BytesIO(path.read_bytes())) as file:
        for group in file.groups():
            for channel in group.channels():
                if channel.dtype.kind not in "iuf" or len(channel) < 2:
                    continue
                held += VALUE_BYTES * len(channel)
                demand_room(held, most_bytes)
                told_of = channel.properties
                start = told_of.get("wf_start_time")
                start_ns = (
                    None
                    if start is None or int(start.astype("datetime64[s]").astype(int)) <= 0
                    else int(start.astype("datetime64[ns]").astype(int))
                )
                unit = str(told_of.get("unit_string") or told_of.get("NI_UnitDescription") or "")
                key = str(len(arrays))
                arrays[key] = channel[:]
                told[key] = json.dumps(
                    [
                        channel.name,
                        unit,
                        float(told_of.get("wf_increment", 0.0)),
                        float(told_of.get("wf_start_offset", 0.0)),
                        start_ns,
                    ]
                )
    return arrays, told


if __name__ == "__main__":
    sys.exit(hand_over(read, *sys.argv[1:]))
