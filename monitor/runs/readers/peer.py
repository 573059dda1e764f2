"""Reads records of the PEER ground motion database (AT2): one series, wrapped in columns, behind four lines of text."""

from __future__ import annotations

import re

import numpy as np

from monitor.core import BadInputError
from monitor.runs.readers.base import File
from monitor.runs.readers.table import Table
from monitor.runs.readers.units import unit_of

_STEP = re.compile(rb"NPTS\s*=\s*(\d+)\s*,?\s*DT\s*=\s*([\d.Ee+-]+)", re.IGNORECASE)
_BARE = re.compile(rb"^\s*(\d+)\s+([\d.]+)\s+NPTS", re.IGNORECASE | re.MULTILINE)
_UNIT = re.compile(rb"UNITS?\s+(?:OF|IN)\s+([^\s,;]+)", re.IGNORECASE)
_GRAVITY = re.compile(rb"\b(G)\b", re.IGNORECASE)
"""The unit where the words of `_UNIT` are left out. [pattern]"""
_HEAD = 2048
"""Bytes in which the four lines of text stand. [bytes; judgement]"""


class Peer:
    """AT2, and VT2 and DT2, which are refused."""

    name = "PEER AT2"

    def is_mine(self, file: File) -> bool:
        """Test whether number and step of the samples stand above a series."""
        head = file.raw[:_HEAD]
        return b"\0" not in head and (_STEP.search(head) or _BARE.search(head)) is not None

    def read(self, file: File) -> list[Table]:
        """Convert it."""
        match = _STEP.search(file.raw[:_HEAD]) or _BARE.search(file.raw[:_HEAD])
        assert match is not None
        head, body = file.raw[: match.end()], file.raw[match.end() :].partition(b"\n")[2]
        if b"VELOCITY" in head.upper() or b"DISPLACEMENT" in head.upper():
            raise BadInputError(f"{file.path}: holds no acceleration; import the AT2 file of the same record")
        try:
            values = np.array(body.split(), dtype=np.float64)
            rate_hz = round(1.0 / float(match[2]), 6)
        except (ValueError, ZeroDivisionError) as error:
            raise BadInputError(f"{file.path}: damaged AT2: {error}") from error
        if len(values) != int(match[1]):
            file.on_warning(f"{file.path}: states {int(match[1])} samples and has {len(values)}")
        told = _UNIT.search(head) or _GRAVITY.search(head)
        stated = told[1].decode("latin-1") if told else ""
        known = unit_of(stated)
        unit = known.symbol if known else stated
        return [Table(file.path, (file.path.stem,), (unit,), values[:, None], rate_hz=rate_hz)]
