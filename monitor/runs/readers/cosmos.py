"""Reads strong-motion records in the COSMOS format: components one after another, each with its headers, in fixed columns."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np

from monitor.core import BadInputError
from monitor.runs.readers.base import File
from monitor.runs.readers.table import Array, Table

_FIRST = re.compile(r"(.*)\(Format v *[\d.]+ +with +(\d+) +text +lines", re.IGNORECASE)
_CHANNEL = re.compile(r"Sta +Cha\w*[ :]*(\d+)", re.IGNORECASE)
_FORM = r".*Format *= *\((\d+)[A-Z](\d+)[.\d]*\)"
_HEADER = re.compile(rf"\s*(\d+) +(?:Integer|Real)-header +values {_FORM}", re.IGNORECASE)
_COMMENTS = re.compile(r"\s*(\d+) +Comment", re.IGNORECASE)
_DATA = re.compile(rf"\s*(\d+) +(.*), *approx\.? +([\d.]+) *secs?, *units *= *([^(,]*){_FORM}", re.IGNORECASE)
_BETWEEN = re.compile(r"\s*$|.*\bend[- ]of[- ]data\b", re.IGNORECASE)
_DATE, _SECOND = slice(39, 45), 29
"""Places in the integer header of year, day of the year, month, day, hour and minute of the start, and in the real header of its
second. [places from 0; COSMOS 1.20]"""
_STEPS_S = {61: 1e-3, 33: 1.0}
"""Places in the real header of the sampling interval of the data and of the recorder, and their units. [places from 0, s; COSMOS
1.20, and files that the USGS wrote]"""
_ROUNDED_S = 1.0
"""Most by which the length that stands beside the number of samples differs from the true one. [s; whole seconds are written]"""

Clock = tuple[float, int | None, int]
"""Rate in Hz, start in ns and length of a series."""


class Cosmos:
    """COSMOS, versions V0 (counts, which need a scale), V1 and V2; V3 holds response spectra, which are refused."""

    name = "COSMOS"

    def is_mine(self, file: File) -> bool:
        """Test whether the first line states the format."""
        return _FIRST.match(file.raw[:200].partition(b"\n")[0].decode("latin-1")) is not None

    def read(self, file: File) -> list[Table]:
        """Convert the series, a table for each clock."""
        lines, number = _Lines(file.path, file.raw.decode("latin-1").splitlines()), 0
        clocks: dict[Clock, list[tuple[str, str, Array]]] = {}
        while lines.go_on():
            number += 1
            for clock, series in _component(lines, number):
                clocks.setdefault(clock, []).append(series)
        tables = []
        for (rate_hz, start_ns, _), found in clocks.items():
            names, units, values = zip(*found, strict=True)
            tables.append(Table(file.path, names, units, np.column_stack(values), start_ns=start_ns, rate_hz=rate_hz))
        return tables


@dataclass(slots=True)
class _Lines:
    """Lines of a file, and how far they are read."""

    path: Path
    lines: list[str]
    at: int = 0

    def go_on(self) -> bool:
        """Skip lines between the series, and test whether more follow."""
        while self.at < len(self.lines) and _BETWEEN.match(self.lines[self.at]):
            self.at += 1
        return self.at < len(self.lines)

    def take(self, pattern: re.Pattern[str], what: str) -> re.Match[str]:
        """Return the match of the next line, which must be one."""
        if self.at >= len(self.lines) or (match := pattern.match(self.lines[self.at])) is None:
            raise BadInputError(f"{self.path}: line {self.at + 1}: {what} is expected here; the file is cut or damaged")
        self.at += 1
        return match

    def numbers(self, count: str, each: str, width: str) -> Annotated[Array, "n"]:
        """Return the numbers of the next lines, each of so many in columns of a width, between which need be no space."""
        begin, size = self.at, int(width)
        self.at += -(-int(count) // max(1, int(each)))
        rows = [line.rstrip() for line in self.lines[begin : self.at]]
        cells = [row[k : k + size] for row in rows for k in range(0, len(row), max(1, size))]
        try:
            if len(cells) != int(count):
                raise ValueError(f"{len(cells)} numbers stand there, not {count}")
            return np.array(cells, dtype=np.float64)
        except ValueError as error:
            raise BadInputError(f"{self.path}: behind line {begin}: {error}; the file is cut or damaged") from error


def _component(lines: _Lines, number: int) -> Iterator[tuple[Clock, tuple[str, str, Array]]]:
    """Yield clock, name, unit and readings of each series behind one set of headers: acceleration, velocity, displacement."""
    kind, texts = lines.take(_FIRST, "the first line of a record").groups()
    if "spectra" in kind.casefold():
        raise BadInputError(
            f"{lines.path}: holds response spectra, which are no samples; import V1 or V2 of the record"
        )
    channel = _CHANNEL.search("\n".join(lines.lines[lines.at : lines.at + int(texts)]))
    lines.at += int(texts) - 1
    whole = lines.numbers(*lines.take(_HEADER, "the integer header").groups())
    real = lines.numbers(*lines.take(_HEADER, "the real header").groups())
    comments = lines.take(_COMMENTS, "the number of comments")
    lines.at += int(comments[1])
    while True:
        count, what, length, unit, *form = lines.take(_DATA, "the number of samples, with length and unit,").groups()
        name = next((f"_{word}" for word in ("velocity", "displacement") if word in what.casefold()), "")
        values = lines.numbers(count, *form)
        clock = _rate_hz(lines.path, real, len(values), float(length)), _start_ns(whole, real), len(values)
        yield clock, (f"chan{number if channel is None else channel[1]}{name}", unit.strip(), values)
        if not lines.go_on() or not _DATA.match(lines.lines[lines.at]):
            return


def _rate_hz(path: Path, real: Annotated[Array, "n"], count: int, length_s: float) -> float:
    """Return the rate, Hz, by the sampling interval that agrees with number and length of the samples."""
    steps = [unit * real[at] for at, unit in _STEPS_S.items() if at < len(real)]
    for step in steps:
        if step > 0.0 and abs(count * step - length_s) <= _ROUNDED_S + step:
            return float(round(1.0 / step, 6))
    raise BadInputError(f"{path}: {count} samples in {length_s:g} s do not agree with the stated {steps} s between two")


def _start_ns(whole: Annotated[Array, "n"], real: Annotated[Array, "n"]) -> int | None:
    """Return the UTC of the first sample, ns since 1970; None where it is not known."""
    try:
        year, _, month, day, hour, minute = whole[_DATE].astype(int).tolist()
        start = datetime(year, month, day, hour, minute, tzinfo=UTC)
    except ValueError:
        return None
    return int(start.timestamp()) * 10**9 + round(float(max(real[_SECOND], 0.0)) * 1e9)
