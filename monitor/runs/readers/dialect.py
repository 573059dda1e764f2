"""Guesses how a table of text is written, before any of it is converted: one value that says all of it, with the reasons."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np

from monitor.core import Array, BadInputError
from monitor.runs.readers.stamps import CLOCK, DATE, DATED, form_of
from monitor.runs.readers.units import ACCELERATION, TIME, Unit, split_name, split_names, unit_of

_MISSING = frozenset({
    "nan", "-nan", "+nan", "na", "n/a", "#n/a", "#na", "null", "none", "nil", "missing", "invalid", "nodata", "no-data", "?", "*",
    "-", "--", "---", "----", "error", "#value!", "#num!", "#div/0!", "1.#qnan", "-1.#ind", "1.#ind", "ol", "ovl", "ovld",
    "over", "overrange", "underrange", "overload", "overflow", "inf", "+inf", "-inf", "∞", "-∞", "1.#inf", "-1.#inf",
})  # fmt: skip
"""Words for a reading that is missing, in lower case, without spaces. [words; conventions of loggers and spreadsheets]"""
_NUMBER = re.compile(r"[+-]?(\d+(?:[.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:([,.' ])\d{3})(?:\1\d{3})*(?:[.,]\d+)?")
"""A number whose digits are set off in groups of three. [pattern]"""
_TIME_NAME = re.compile(
    r"(ts?|time.*|zeit.*|date.*|datum.*|stamp|timestamp.*|sampletimefine|elapsed.*|temps|tiempo|fecha.*|hora|epoch.*|utc.*"
    r"|clock|x_value|seconds?|seconds?.elapsed|sec|ms|millis|micros|relative.?time|local.?time|unix.*)",
    re.IGNORECASE,
)
_COUNTER_NAME = re.compile(
    r"(|#|index|idx|id|sample|samples|sample.?(no|nr|number|index)\.?|counter|count|packetcounter|nr\.?|no\.?|num|number|n|record"
    r"|rec|row|line|point|place|scan|seq(uence)?)",
    re.IGNORECASE,
)
_FRACTION_NAME = re.compile(r"(m|u|n|milli|micro|nano)(?:s|secs?|seconds?)", re.IGNORECASE)
_TICKS_NS = {"m": 10**6, "u": 1000, "n": 1, "milli": 10**6, "micro": 1000, "nano": 1}
"""Prefix of a second -> ns. [ns; definition: SI]"""
_RATE_CELL = re.compile(r"(?:sr|rate|fs)?\s*[=:]?\s*(\d+\.?\d*|\.\d+)\s*(k?hz)", re.IGNORECASE)
_RATE_UNIT, _STEP_UNIT = r"k?hz|k?sps|ks/s", r"s|sec|seconds|ms|msec|us"
_RATE_LINE = re.compile(
    r"(?:sampl\w*|data|scan|acquisition|logging)?[\s_]*(?:rate|fr[eé][cq]u\w*|fs|sr|sps|samples?(?:/|\s+per\s+)s\w*)\b[^\d]{0,24}?"
    rf"(?:\(?\s*({_RATE_UNIT}|samples/s\w*)\s*\)?)?[\s:=,;\t\"]+([\d.,]+)\s*({_RATE_UNIT})?",
    re.IGNORECASE,
)
_STEP_LINE = re.compile(
    r"(?:sampl\w*[\s_]*(?:interval|period|time|step)|time[\s_]*(?:step|interval)|interval|delta[\s_]?[xt]|dt|period)\b"
    rf"\s*[\[(]?\s*({_STEP_UNIT})?\s*[\])]?[\s:=,;\t\"]+([\d.,eE+-]+)\s*({_STEP_UNIT})?\b",
    re.IGNORECASE,
)
_START_LINE = re.compile(
    rf"(?:start|begin|trigger|record\w*|acqui\w*|date|time)[\w\s./-]*?[\s:=,;\t\"]+(?P<stamp>{DATED.pattern})",
    re.IGNORECASE,
)
_ZONE_LINE = re.compile(r"time.?zone|zeitzone|(?:utc|gmt).?offset", re.IGNORECASE)
_UNIT_LINE = re.compile(r"(?:y_?)?units?(?:_label)?\b[\s:=,;\t\"]+([^\s,;\t\"]+(?: s-2)?)", re.IGNORECASE)
_UNIT_SENTENCE = re.compile(
    r"^[\s#%!;]*(?:all\s+)?(?:accelerations?|values|data|amplitudes?|readings?)\s+(?:are\s+)?in\s+(?:units\s+of\s+)?(\S+)\s*$",
    re.IGNORECASE,
)
_NO_RATE = re.compile(
    r"filter|cut.?off|corner|natural|nyquist|baud|resonan|(?:low|high|band).?pass|band.?width|internal|maxim|\bmax\b",
    re.IGNORECASE,
)
"""Words of a line whose frequency is not that of the samples. [words; conventions of loggers]"""
_OF_SAMPLES = re.compile(r"sampl|scan|acqui|logg|abtast|chantill|muestr|campion", re.IGNORECASE)
_SHOWN = {None: "white space", "\t": "tab", ",": "comma", ";": "semicolon", "|": "stroke", ".": "point"}
MARKS = ("\t", ";", "|", ",", None)
"""Marks between cells; None for white space. [characters; convention]"""
_FEW = 3
"""Lines of a table so short that the last one counts as well. [lines; judgement]"""
_TAIL = 100
"""Rows from the end that show the shape of a table. [rows; judgement: the head may be comments]"""
HEAD = 400
"""Most lines before the rows, or before a heading, that are looked at. [lines; judgement]"""
_LONGEST_LINE, _LONGEST_NAME = 1000, 200
"""Most of a line before the rows that is searched, and of a heading that is its name. [characters; cost: patterns that are
searched take a time that grows with the square]"""
_SHARE = 0.9
"""Share of the rows that must fit. [ratio; judgement: a row in ten may be damaged]"""


class Role(Enum):
    """What a column holds."""

    STAMP = "date and time"
    DATE = "date"
    CLOCK = "time of day"
    TIME = "time"
    FRACTION = "fraction of a second"
    PART = "part of a date"
    COUNTER = "counter of samples"
    READING = "readings"
    TEXT = "text"


DATE_PARTS = ("year", "month", "day", "hour", "minute", "second")
"""Names of columns that hold a date together, in lower case. [names; convention]"""
MIDNIGHT = re.compile(r"[ T]00?:00(:00)?([.,]0+)?$")
"""End of a date that a spreadsheet wrote with its time. [pattern]"""
SINCE_1970_S = (3e8, 3.6e9)
"""Seconds since 1970 that are a date, of 1979 to 2084. [s; judgement]"""
TICKS = (1.0, 1e-3, 1e-6, 1e-9)
"""Units of times since 1970. [s; convention]"""
CALENDAR = frozenset({Role.STAMP, Role.DATE, Role.CLOCK})
"""Roles of columns whose cells are dates, times of day or both."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table of text."""

    name: str
    role: Role
    unit: Unit | None
    unit_text: str
    """As the file writes it; empty where it states none."""
    unit_by_name: bool
    """Whether the unit is part of the name."""
    why: str


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a table of text is written."""

    path: Path
    delimiter: str | None
    """Mark between cells; None for white space."""
    decimal: str
    thousands: str
    first: int
    """Index of the first row of readings among the lines."""
    width: int
    columns: tuple[Column, ...]
    rate_hz: float | None = None
    """As the lines before the rows state it."""
    start_text: str = ""
    """Time of the first sample as the lines before the rows state it."""
    zone_text: str = ""
    """Line before the rows that states the zone of the times."""
    told: tuple[tuple[str, str, str], ...] = ()
    """What was taken, for what, and the reason."""

    def of(self, *roles: Role) -> list[int]:
        """List the columns of these roles."""
        return [at for at, column in enumerate(self.columns) if column.role in roles]

    def plain(self, cell: str) -> str:
        """Write a number with a decimal point and without groups of digits."""
        if self.thousands:
            cell = cell.replace(self.thousands, "")
        return cell.replace(",", ".") if self.decimal == "," else cell

    def explained(self) -> list[tuple[str, str, str]]:
        """Return what was taken, for what, and the reason, for a table."""
        units = [f", {column.unit_text}" if column.unit_text else "" for column in self.columns]
        of_columns = [
            (f"column {at}", f"{column.name!r}: {column.role.value}{unit}", column.why)
            for at, (column, unit) in enumerate(zip(self.columns, units, strict=True), start=1)
        ]
        return [row for row in self.told if row[1]] + of_columns


def split(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells; without a delimiter, at white space."""
    if delimiter and '"' in line and len(line) <= csv.field_size_limit():
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])]
    return [cell.strip(' \t"') for cell in (line.split(delimiter) if delimiter else line.split())]


def is_missing(cell: str) -> bool:
    """Test whether a cell is empty, of marks alone, or a word for a missing reading."""
    return not cell.strip("*-#?") or cell.casefold().replace(" ", "") in _MISSING


def is_number(cell: str) -> bool:
    """Test whether a cell is a number, with any decimal mark and with groups of digits or without."""
    return _NUMBER.fullmatch(cell) is not None or _GROUPED.fullmatch(cell) is not None


def guess(path: Path, lines: Sequence[str], time: str | None = None, marks: Sequence[str | None] = MARKS) -> Dialect:
    """Guess how a table of text is written; `time` names the column of the times, `marks` are those that may be between cells.

    Raises BadInputError if there is no table of numbers.
    """
    tail = [line for line in lines[-_TAIL - 1 :] if line.strip(" \t,;|")]
    tail = tail[:-1] if len(tail) > _FEW else tail  # the last line may be incomplete
    if not tail:
        raise BadInputError(f"{path}: no rows of numbers found; is it a table?")
    try:
        delimiter, width, texts, why = _delimiter(path, tail, marks)
        first = next((at for at, line in enumerate(lines) if _is_row(split(line, delimiter), width, texts)), None)
        if first is None:
            raise BadInputError(f"{path}: no rows of numbers found; is it a table?")
        above = lines[max(0, first - HEAD) : first]
        head = _cells_above(above, delimiter, width)
        both_ends = [*lines[first : first + _TAIL], *lines[max(first, len(lines) - _TAIL) :]]
        rows = [cells for cells in (split(line, delimiter) for line in both_ends) if len(cells) >= width]
    except csv.Error as error:
        raise BadInputError(f"{path}: {error}") from error
    if _ends_with_mark(rows, head, width):
        width -= 1
    if delimiter == "," and (part := _split_fraction(rows)):
        head = [[cells[0], part, *cells[1:]] if len(cells) == width - 1 else cells for cells in head]
    decimal, thousands, why_decimal = _marks(path, [cell for cells in rows for cell in cells[:width]], width, delimiter)
    preamble = [line[:_LONGEST_LINE] for line in above]
    headings = _headings(path, head, width)
    rate_hz, why_rate = headings.rate_hz, "a row of rates stands above the columns"
    if rate_hz is None:
        rate_hz, why_rate = _rate_above(preamble, decimal)
    start_text, why_start = _start_above(preamble)
    zone_text = next(filter(_ZONE_LINE.search, preamble), "")
    unit_text = _unit_in_column(path, headings.names, rows) or next(filter(None, map(_unit_stated, preamble)), "")
    columns = _columns(headings, rows, unit_text, time)
    told = (
        ("delimiter", _SHOWN.get(delimiter, str(delimiter)), why),
        ("decimal mark", _SHOWN[decimal], why_decimal),
        ("first row", f"line {first + 1}", f"the first line of {width} numbers, times or missing values"),
        ("groups of digits", thousands and repr(thousands), why_decimal),
        ("rate", "" if rate_hz is None else f"{rate_hz:g} Hz", why_rate),
        ("start", start_text, why_start),
        ("zone", zone_text.strip(), "stated"),
    )
    return Dialect(path, delimiter, decimal, thousands, first, width, columns, rate_hz, start_text, zone_text, told)


def _cells_above(above: Sequence[str], delimiter: str | None, width: int) -> list[list[str]]:
    """Split the lines before the rows that may be headings: at white space, a statement would make some too."""
    return [
        [cell[:_LONGEST_NAME] for cell in _split_heading(line, delimiter, width)]
        for line in above
        if delimiter or not _states(line[:_LONGEST_LINE])
    ]


def _ends_with_mark(rows: Sequence[Sequence[str]], head: Sequence[Sequence[str]], width: int) -> bool:
    """Test whether rows end with a delimiter: behind it nothing ever stands, and no heading."""
    named = any(len(cells) == width and cells[-1] for cells in head[-1:])
    return width > 1 and not named and not any(cells[width - 1] for cells in rows)


def _split_fraction(rows: Sequence[Sequence[str]]) -> str:
    """Return the unit of the second column where it holds the fractions of the seconds in the first, behind a decimal comma."""
    lengths = {len(cells[1]) if len(cells) > 1 and cells[1].isdigit() else 0 for cells in rows}
    behind = {form_of(cells[0]) for cells in rows} <= {DATED, CLOCK} and all(cells[0][-3:-2] == ":" for cells in rows)
    return {3: "ms", 6: "us", 9: "ns"}.get(max(lengths), "") if len(lengths) == 1 and behind else ""


def _rate_above(preamble: Sequence[str], decimal: str) -> tuple[float | None, str]:
    """Return the rate, Hz, that a line before the rows states, and the reason; that of samples before any other."""
    # A sensor's own converter may have another one.
    for line in sorted(preamble, key=lambda line: _OF_SAMPLES.search(line) is None):
        if (rate := _stated_rate(line, decimal)) is not None:
            return rate, f"stated: {line.strip()[:60]!r}"
    return None, ""


def _start_above(preamble: Sequence[str]) -> tuple[str, str]:
    """Return the time of the first sample that lines before the rows state, as written, and the reason; else empty texts."""
    for line in preamble:
        if (match := _START_LINE.search(line)) is not None:
            return match["stamp"].strip(), f"stated: {line.strip()[:60]!r}"
    day = next(filter(None, (_value_of("date", DATE, line) for line in preamble)), "")
    clock = next(filter(None, (_value_of("time", CLOCK, line) for line in preamble)), "")
    return (f"{day} {clock}", "date and time are stated above the table") if day and clock else ("", "")


def _delimiter(
    path: Path, tail: Sequence[str], marks: Sequence[str | None]
) -> tuple[str | None, int, frozenset[int], str]:
    """Choose the mark by which most rows have one number of cells, all of them data; the widest of those.

    Also the columns of words, as of a state: where no mark makes all cells data, that by which most columns are.
    """
    cuts = [
        (mark, [split(line, mark) for line in tail])
        for mark in marks
        if mark is None or any(mark in line for line in tail)
    ]
    best: tuple[float, int, str | None] = (0.0, 0, None)
    for mark, cut in cuts:
        if mark == "," and _holds_decimals(cut):
            continue
        widths = Counter(len(cells) for cells in cut if all(map(_is_data, cells)) and any(map(is_number, cells)))
        if not widths:
            continue
        width, count = widths.most_common(1)[0]
        share = count / len(tail)
        if (round(min(share, _SHARE), 3), width) > best[:2]:
            best = (round(min(share, _SHARE), 3), width, mark)
    if best[0] >= 0.5:
        return best[2], best[1], frozenset(), f"{best[1]} cells a row, all of them numbers, times or missing values"
    worded = [(*_worded(cut), mark) for mark, cut in cuts]
    data, width, texts, mark = max(worded, key=lambda one: one[0])
    if data < 2:
        raise BadInputError(f"{path}: no rows of numbers found; is it a table?")
    return mark, width, texts, f"{width} cells a row, those of {data} columns numbers, times or missing values"


def _worded(cut: Sequence[Sequence[str]]) -> tuple[int, int, frozenset[int]]:
    """Return how many columns of rows of one width hold data (0 if rows do not fit), the width, and the columns of words."""
    width, count = Counter(map(len, cut)).most_common(1)[0]
    if count < _SHARE * len(cut):
        return 0, 0, frozenset()
    rows = [cells for cells in cut if len(cells) == width]
    texts = frozenset(
        at for at in range(width) if sum(_is_data(cells[at]) for cells in rows) < (1.0 - _SHARE) * len(rows)
    )
    fit = sum(_is_row(cells, width, texts) for cells in rows) >= _SHARE * len(cut)
    return (width - len(texts) if fit else 0), width, texts


def _holds_decimals(cut: Sequence[Sequence[str]]) -> bool:
    """Test whether the comma of two cells a row is a decimal mark: the second ones have one length, and a leading zero."""
    behind = [
        cells[1] for cells in cut if len(cells) == 2 and re.fullmatch(r"[+-]?\d+", cells[0]) and cells[1].isdigit()
    ]
    return len(behind) == len(cut) > _FEW and len(set(map(len, behind))) == 1 and any(c[0] == "0" != c for c in behind)


def _is_data(cell: str) -> bool:
    """Test whether a cell may stand in a row of readings."""
    return is_missing(cell) or is_number(cell) or form_of(cell) is not None


def _is_row(cells: Sequence[str], width: int, texts: frozenset[int]) -> bool:
    """Test whether cells are a row of readings, with words in the columns of `texts`."""
    if texts:
        cells = [cell for at, cell in enumerate(cells) if at not in texts]
        width -= len(texts)
    return len(cells) == width and all(map(_is_data, cells)) and any(map(is_number, cells))


def _demand_groups(path: Path, cells: Sequence[str], width: int) -> None:
    """Refuse numbers such as 1.010 beside decimal commas where no number below 1000 shows that the point sets off digits."""
    pointed = {at % width: cell for at, cell in enumerate(cells) if "." in cell and is_number(cell)}
    below = {at % width for at, cell in enumerate(cells) if cell.lstrip("+-").isdigit()}
    for at, cell in pointed.items():
        if at not in below and cell.count(".") == 1:
            raise BadInputError(
                f"{path}: {cell!r} in column {at + 1} may be {cell.replace('.', '')} or {cell}, since other numbers have a "
                "decimal comma; write all numbers with one decimal mark, and without groups of digits"
            )


def _is_grouped(cell: str) -> bool:
    """Test whether a number may be one whose digits are set off in groups of three."""
    return _GROUPED.fullmatch(cell) is not None and not cell.lstrip("+-").startswith("0")


def _marks(path: Path, cells: Sequence[str], width: int, delimiter: str | None) -> tuple[str, str, str]:
    """Return decimal mark and mark of groups of three digits, once for the whole table, and the reason."""
    if delimiter == "," and not any("," in cell for cell in cells):
        return ".", "", "the comma stands between cells"
    numbers = [cell for cell in cells if is_number(cell)]
    both = [cell for cell in numbers if "," in cell and "." in cell]
    if both:
        decimal = max(both[0].rfind(","), both[0].rfind("."))
        mark = both[0][decimal]
        return mark, "," if mark == "." else ".", f"as in {both[0]!r}"
    for other in ("'", " "):
        if any(other in cell for cell in numbers):
            return ("," if any("," in cell for cell in numbers) else "."), other, "groups of three digits"
    commas = [cell for cell in numbers if "," in cell]
    if not commas:
        return ".", "", "no cell has a comma"
    if any(cell.count(",") > 1 for cell in commas):
        return ".", ",", f"as in {next(c for c in commas if c.count(',') > 1)!r}"
    points = [cell for cell in numbers if "." in cell]
    if points and all(map(_is_grouped, points)):
        _demand_groups(path, cells, width)
        return ",", ".", f"{commas[0]!r} beside {points[0]!r}: points set off thousands"
    # Decimals fixed at three would leave no number without a comma; groups leave those below 1000 without one.
    bare = [cell for cell in numbers if "," not in cell and "." not in cell]
    if all(map(_is_grouped, commas)) and any(abs(value) >= 100.0 for value in _floats(bare)):
        return ".", ",", f"{commas[0]!r} beside {bare[0]!r}: commas set off thousands"
    return ",", "", f"as in {commas[0]!r}"


@dataclass(frozen=True, slots=True)
class _Headings:
    """What the rows of cells above the readings say of the columns."""

    names: list[str]
    units: list[str]
    """Of each column, that of a row of units; empty where there is none."""
    rate_hz: float | None
    """That of a row of rates."""
    are_given: bool
    """Whether there is a row of names."""


def _headings(path: Path, head: Sequence[Sequence[str]], width: int) -> _Headings:
    """Find names, units and rate among the rows above the readings: what each row is shows by its cells."""
    near = [cells for cells in (_fitted([*cells], width) for cells in head[-8:]) if any(cells)]
    names: list[str] = []
    units = [""] * width
    rate: float | None = None
    for cells in reversed(near):
        if len(cells) != width:
            _demand_fit(path, cells, width, near)
            if names:
                break
            continue
        filled = [cell for cell in cells if cell]
        if (found := _rate_of(filled)) is not None:
            rate = found
        elif _are_units(filled) and not any(units) and (names or not _are_components(filled)):
            units = [cell.strip("[](){} ") for cell in _unlabelled(cells)]
        elif all(cell.casefold() in _PROCESSING for cell in filled):
            continue
        elif sum(map(is_number, filled)) * 2 > len(filled) and len(near) > 1:
            continue  # numbers of channels or of sensors
        elif not names and len(filled) > 2 and len({*filled[1:]}) == 1 and cells is not near[0]:
            continue  # of sensitivities or types, below that of the names
        elif not names:
            names = _unlabelled(cells)
            _demand_names(path, names)
            if any(units):
                break
        else:
            break
    if not names:
        return _Headings([f"column{at + 1}" for at in range(width)], units, rate, False)
    is_short = names[-1] == "" and not any(map(unit_of, names))
    return _Headings(_placed(names, width) if is_short else names, units, rate, True)


_LABELS = frozenset({"unit", "units", "einheit", "einheiten", "name", "channel", "channels", "kanal"})
"""Words before a row of headings that say what it holds. [words; conventions of loggers]"""


def _unlabelled(cells: list[str]) -> list[str]:
    """Empty the first cell where it says what the row holds."""
    return ["" if cells[0].casefold().rstrip(":") in _LABELS else cells[0], *cells[1:]]


_PROCESSING = frozenset({"smp", "avg", "max", "min", "std", "tot", "sample", "raw"})
"""Words of the rows in which loggers state the processing. [words; Campbell TOA5]"""


def _rate_of(cells: Sequence[str]) -> float | None:
    """Return the rate, Hz, that a row of rates states, by its first cell; None where the row is another one."""
    rates = [_RATE_CELL.fullmatch(cell) for cell in cells]
    if (first := rates[0]) is None or None in rates:
        return None
    return float(first[1]) * (1e3 if first[2].casefold() == "khz" else 1.0)


def _are_units(cells: Sequence[str]) -> bool:
    """Test whether most cells are units."""
    return 2 * sum(unit_of(cell) is not None for cell in cells) > len(cells)


def _are_components(cells: Sequence[str]) -> bool:
    """Test whether cells that could be units are names: components, as E, N, Z."""
    return len(set(cells)) == len(cells) and all(len(cell) == 1 and cell.isupper() for cell in cells)


def _is_time_name(heading: str) -> bool:
    """Test whether a heading, without a unit in brackets, is a name of times."""
    return _TIME_NAME.fullmatch(split_name(heading).name) is not None


def _split_heading(line: str, delimiter: str | None, width: int) -> list[str]:
    """Split a line above the rows; in a table of white space a name may have spaces, and a unit in brackets behind it."""
    line = line.lstrip("#%! " if delimiter == ";" else "#%!; ")
    cells = split(line, delimiter)
    if delimiter is not None or len(cells) == width:
        return cells
    spaced = [re.split(pattern, line.strip()) for pattern in (r"\t+", r"\s{2,}|\t", r"\s+(?![\[(])|(?<=[\])])\s+")]
    return next((found for found in spaced if len(found) == width), cells)


def _fitted(cells: list[str], width: int) -> list[str]:
    """Fit headings of which there is one too many or too few to the columns: a word before the name of the time is none."""
    if len(cells) == width + 1:
        named = [_is_time_name(cell) for cell in cells[:2]]
        return cells[1:] if named == [False, True] and not _COUNTER_NAME.fullmatch(cells[0]) else cells[:width]
    return [*cells, ""] if len(cells) == width - 1 else cells


def _demand_fit(path: Path, cells: list[str], width: int, near: Sequence[Sequence[str]]) -> None:
    """Refuse headings with units of acceleration that stand next to the rows and cannot be those of the columns."""
    if cells is near[-1] and 2 * len(cells) == width and _is_time_name(cells[0]):
        raise BadInputError(
            f"{path}: {len(cells)} headings stand above {width} columns: is the comma between cells a decimal mark too? write "
            "numbers with a decimal point, or put a semicolon between cells"
        )
    known = [unit_of(split_name(cell).unit) for cell in cells]
    if cells is near[-1] and sum(unit is not None and unit.quantity == ACCELERATION for unit in known) > 1:
        raise BadInputError(
            f"{path}: {len(cells)} headings stand above {width} columns, so that no unit belongs to one for sure; mend the "
            "line of headings"
        )


def _states(line: str) -> bool:
    """Test whether a line before the rows is a statement, as of rate, start or unit, and no row of headings."""
    return any(pattern.search(line) for pattern in (_RATE_LINE, _STEP_LINE, _START_LINE)) or bool(_unit_stated(line))


def _unit_stated(line: str) -> str:
    """Return the unit that a line before the rows states for all columns; empty where it states none."""
    for pattern in (_UNIT_LINE, _UNIT_SENTENCE):
        if (match := pattern.search(line)) is not None and unit_of(match[1]) is not None:
            return match[1]
    return ""


def _demand_names(path: Path, names: Sequence[str]) -> None:
    """Refuse a row of numbers and words as headings: it is a damaged row of readings, unless it begins with a time's name."""
    if any(map(is_number, names)) and not any(map(_is_time_name, names)):
        bad = next((name for name in names if name and not is_number(name)), names[0])
        raise BadInputError(f"{path}: {bad[:40]!r} is no number, in the row above the first one of numbers alone")


def _placed(names: list[str], width: int) -> list[str]:
    """Place headings, of which there is one too few: the column without one is the first, unless the first one is a time's."""
    given = names[:-1]
    if any(map(_is_time_name, given[:1])):
        return [*given, f"column{width}"]
    return ["", *given]


def _value_of(name: str, pattern: re.Pattern[str], line: str) -> str:
    """Return what a line before the rows states behind a name; empty where it states nothing of this form."""
    match = re.match(
        rf"[\s#\"]*(?:start|test|record\w*)?[\s_]*{name}[\s:=,;\t\"]+({pattern.pattern})", line, re.IGNORECASE
    )
    return "" if match is None else match[1]


def _stated_rate(line: str, decimal: str) -> float | None:
    """Return the rate, Hz, that a line before the rows states; None if it states none."""
    if _NO_RATE.search(line):
        return None
    if (match := _STEP_LINE.search(line)) is not None:
        step = _plain(match[2], decimal)
        unit = unit_of(match[3] or match[1] or "s")
        if step and unit is not None and unit.quantity == TIME:
            return round(1.0 / (step * unit.factor), 6)
    if (match := _RATE_LINE.search(line)) is not None:
        rate = _plain(match[2], decimal)
        kilo = (match[1] or match[3] or "").casefold() in ("khz", "ks/s", "ksps")
        return None if not rate else rate * (1e3 if kilo else 1.0)
    return None


def _plain(text: str, decimal: str) -> float | None:
    """Convert a number of a line before the rows, of a table with this decimal mark."""
    if decimal == "." and re.fullmatch(r"[1-9]\d{0,2}(,\d{3})+(\.\d*)?", text):
        text = text.replace(",", "")
    try:
        value = float(text.replace(",", ".").rstrip("."))
    except ValueError:
        return None
    return value if value > 0.0 else None


def _unit_in_column(path: Path, names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return the unit that a column of units states; empty without such a column.

    Raises BadInputError if several columns state units that differ: nothing tells of which readings each is.
    """
    columns = [{row[at] for row in rows} for at, name in enumerate(names) if name.casefold() in ("unit", "units")]
    stated = {word for words in columns if len(words) == 1 for word in words if unit_of(word)}
    if len(stated) > 1:
        raise BadInputError(
            f"{path}: columns of units state {' and '.join(sorted(stated))}; write the unit of each reading into its heading"
        )
    return next(iter(stated), "")


def _columns(headings: _Headings, rows: Sequence[Sequence[str]], stated: str, time: str | None) -> tuple[Column, ...]:
    """Say what each column holds; `stated` is the unit of readings whose headings state none, `time` the name of the times."""
    found: list[Column] = []
    split_headings = zip(headings.names, split_names(headings.names), headings.units, strict=True)
    for at, (heading, (name, unit_text, by_name), unit_of_row) in enumerate(split_headings):
        if unit_of_row:
            unit_text, by_name = unit_of_row, False
        unit = unit_of(unit_text)
        if not unit_text and (alone := unit_of(name)) is not None and alone.quantity == TIME and len(name) > 1:
            unit_text, unit = name, alone
        cells = [row[at] for row in rows if not is_missing(row[at])]
        is_named = None if time is None else time in (heading, name)
        role, why = _role(name, unit, cells, found, headings.are_given, is_named)
        if role is Role.READING and not unit_text and stated:
            unit_text, unit, why = stated, unit_of(stated), f"{why}; its unit stands above the table"
        found.append(Column(name or f"column{at + 1}", role, unit, unit_text, by_name, why))
    parts = {at for at, column in enumerate(found) if column.name.casefold() in DATE_PARTS}
    why = "year, month, day, hour, minute and second have a column each"
    if len(parts) < len(DATE_PARTS):
        return tuple(found)
    return tuple(replace(one, role=Role.PART, why=why) if at in parts else one for at, one in enumerate(found))


def _role(
    name: str,
    unit: Unit | None,
    cells: Sequence[str],
    before: Sequence[Column],
    has_heading: bool,
    is_named: bool | None,
) -> tuple[Role, str]:
    """Say what a column holds, by its cells first and by its name then, and why.

    `cells` are those that are not missing, `before` the columns on its left; `is_named` says whether the caller names it as the
    times, None where the caller names none.
    """
    if (form := _form(cells)) is not None:
        return form
    if is_named:
        return Role.TIME, "named as the times"
    has_time = any(column.role in (Role.STAMP, Role.CLOCK, Role.TIME) for column in before)
    integers = [int(cell) for cell in cells if re.fullmatch(r"[+-]?\d+", cell)]
    are_whole = len(integers) == len(cells)
    if has_time and are_whole and max(integers) * fraction_ns(name) < 10**9 and fraction_ns(name):
        return Role.FRACTION, "whole numbers below a second, named as a fraction, behind a time"
    if is_named is None and (why := _why_time(name, unit)) and (not has_time or _rises(cells)):
        return Role.TIME, why
    if is_named is None and not has_time and is_since_1970(cells):
        return Role.TIME, "rises by one step throughout, as since 1970"
    if (
        are_whole
        and _counts_on(integers)
        and (_COUNTER_NAME.fullmatch(_last(name)) or (not before and not has_heading))
    ):
        return Role.COUNTER, "whole numbers that count on"
    if not before and not (has_heading and name) and _is_ramp(cells):
        return Role.TIME, "rises by one step throughout"
    return Role.READING, "numbers"


def fraction_ns(name: str) -> int:
    """Return the part of a second, ns, that a column is named after; 0 for another name."""
    match = _FRACTION_NAME.fullmatch(name)
    return 0 if match is None else _TICKS_NS[match[1].casefold()]


def _form(cells: Sequence[str]) -> tuple[Role, str] | None:
    """Return what a column of cells that are not missing holds, where it is no numbers, and why; None for numbers."""
    if not cells:
        return Role.TEXT, "empty"
    forms = [form_of(cell) for cell in cells]
    if forms.count(DATED) >= _SHARE * len(cells):
        return Role.STAMP, f"dates and times, as {cells[0]!r}"
    if set(forms) == {DATE}:
        return Role.DATE, f"dates, as {cells[0]!r}"
    if set(forms) == {CLOCK}:
        return Role.CLOCK, f"times of day, as {cells[0]!r}"
    return None if any(map(is_number, cells)) else (Role.TEXT, f"no numbers, as {cells[0]!r}")


def _why_time(name: str, unit: Unit | None) -> str:
    """Return why numbers may be times, by their unit or their name; empty where neither says so."""
    if unit is not None and unit.quantity == TIME:
        return f"in {unit.symbol}"
    return "named as a time" if _TIME_NAME.fullmatch(_last(name)) else ""


def _last(name: str) -> str:
    """Return the last part of a name with points, as of a field of a message."""
    return re.sub(r"[\s_.-]+$", "", name).rpartition(".")[2]


def _counts_on(numbers: Sequence[int]) -> bool:
    """Test whether whole numbers go up by one, but for a few of them."""
    return len(numbers) > 2 and sum(b - a == 1 for a, b in pairwise(numbers)) >= 0.8 * (len(numbers) - 2)


def _floats(cells: Sequence[str]) -> list[float]:
    """Convert the plain numbers among cells."""
    plain = str.maketrans({",": ".", "d": "e", "D": "e"})
    return [float(cell.translate(plain)) for cell in cells if _NUMBER.fullmatch(cell)]


def _steps(cells: Sequence[str]) -> Annotated[Array, "n"]:
    """Return the steps between the numbers of the head of a table."""
    values = _floats(cells)
    return np.diff(values[: len(values) // 2])  # the head of the table, then its tail


def _rises(cells: Sequence[str]) -> bool:
    """Test whether numbers rise throughout the head of the table, as a second column of times does."""
    steps = _steps(cells)
    return len(steps) > 1 and bool((steps >= 0.0).all() and steps.any())


def is_since_1970(cells: Sequence[str]) -> bool:
    """Test whether numbers are of a size and of steps that only times since 1970 have."""
    (low, high), values = SINCE_1970_S, _floats(cells[:1])
    return any(low < value * tick < high for value in values for tick in TICKS) and _is_ramp(cells)


def _is_ramp(cells: Sequence[str]) -> bool:
    """Test whether numbers rise by much the same step throughout."""
    steps = _steps(cells)
    return len(steps) > 2 and bool(steps.min() > 0.0 and steps.max() < 3.0 * np.median(steps))
