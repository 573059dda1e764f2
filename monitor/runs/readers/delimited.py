"""Reads delimited text by its guessed dialect (`dialect`); knows nothing of units but that of the times."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError
from monitor.runs.readers import stamps
from monitor.runs.readers.dialect import (
    CALENDAR,
    DATE_PARTS,
    HEAD,
    MARKS,
    MIDNIGHT,
    SINCE_1970_S,
    TICKS,
    Dialect,
    Role,
    fraction_ns,
    guess,
    is_missing,
    is_number,
    is_since_1970,
    split,
)
from monitor.runs.readers.table import Array, OnWarning, Table, Ticks, without_fillers
from monitor.runs.readers.units import ACCELERATION, TIME

_CHUNK_CELLS = 1 << 15
"""Cells of the rows that are converted to numbers together. [count; cost: they take 3 MB]"""
_LOOK_ALIKES = {0xA0: " ", 0x202F: " ", 0x2009: " ", 0x2212: "-"}
"""Characters that stand for a space between groups of digits, or for a minus. [characters; typography]"""
_SINCE_1904_S = (3.6e9, 4.4e9, 2_082_844_800)
"""Seconds since 1904 that are a date: least, most, that of 1970. [s; 2018 to 2043; LabVIEW]"""
_MOST_SENSORS = 256
"""Most sensors that a column may name. [count; judgement]"""
_CHANNEL_NAME = re.compile(r"^(ch|chan|channel|sensor|node|axis|kanal|device|id|no|nr)\b", re.IGNORECASE)
_EVEN = 0.9
"""Share of even steps from which times are those of one sensor. [ratio; judgement: pauses, and rows that were lost]"""
_OWN_ROWS = 0.1
"""Share of rows with readings of both, below which two columns have rows of their own. [ratio; judgement]"""
_HOUR_NS = 3600 * 10**9
"""An hour. [ns; definition]"""
_SERIAL_DAYS = (
    (3e4, 8e4, 25_569.0, "since 1900, as in spreadsheets"),
    (7.2e5, 8e5, 719_529.0, "since year 0, as in MATLAB"),
)
"""Days that are a date: least, most, that of 1970, and in words. [days; 1982 to 2119]"""
_NAMED_LINES = 5
"""Most lines that a message names. [lines; judgement]"""
_LEAST_RATE_HZ = 5.0
"""Rate below which a column of times without a unit is doubted. [Hz; judgement: no building is measured slower]"""


@dataclass(frozen=True, slots=True)
class Text:
    """Lines of a table of text, and how it is written."""

    path: Path
    lines: list[str]
    """Rows of readings, each with its line break removed."""
    numbers: list[int]
    """Of each row, its line in the file from 1."""
    dialect: Dialect
    preamble: tuple[str, ...]

    def cells(self, at: int) -> list[str]:
        """Return the cells of a column."""
        return [split(line, self.dialect.delimiter)[at] for line in self.lines]

    def values(self, columns: Sequence[int], on_warning: OnWarning) -> Annotated[Array, "n columns"]:
        """Convert columns to numbers, with NaN for missing readings, which are told; BadInputError where one is no number."""
        out = np.empty((len(self.lines), len(columns)))
        step = max(1, _CHUNK_CELLS // self.dialect.width)
        words: Counter[str] = Counter()
        for begin in range(0, len(self.lines), step):
            rows = [split(line, self.dialect.delimiter) for line in self.lines[begin : begin + step]]
            for at, column in enumerate(columns):
                cells = [row[column] for row in rows]
                try:
                    out[begin : begin + len(rows), at] = np.array(
                        [self.dialect.plain(cell) for cell in cells], dtype=np.float64
                    )
                except ValueError:
                    out[begin : begin + len(rows), at] = [
                        self._number(cell, begin + k, column, words) for k, cell in enumerate(cells)
                    ]
        if words:
            told = ", ".join(
                f"{word!r} {count} times" if word else f"{count} empty cells" for word, count in words.most_common(5)
            )
            on_warning(f"{self.path}: {words.total()} readings are missing: {told}")
        return out

    def _number(self, cell: str, row: int, column: int, words: Counter[str]) -> float:
        """Convert one cell, and count it where it stands for a missing reading."""
        if is_missing(cell):
            words[cell] += 1
            return np.nan
        try:
            return float(self.dialect.plain(cell).replace("D", "e").replace("d", "e"))
        except ValueError:
            raise BadInputError(
                f"{self.path}: line {self.numbers[row]}: {cell[:40]!r} in column {column + 1} is no number"
            ) from None


def decode(path: Path, raw: bytes) -> str:
    """Decode a file's bytes: UTF-16 by its byte order mark or its zeros, else UTF-8, cp1252 or latin-1.

    Raises BadInputError if the bytes are no text.
    """
    if not raw.strip():
        raise BadInputError(f"{path}: is empty")
    head = raw[:4096]
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    if b"\0" in head:
        zeros = [sum(byte == 0 for byte in head[k::2]) for k in (0, 1)]
        if max(zeros) > 0.8 * len(head) / 2 and min(zeros) == 0:
            return raw.decode("utf-16-be" if zeros[0] > zeros[1] else "utf-16-le", errors="replace")
    if b"\0" in raw:
        raise BadInputError(
            f"{path}: is no text table and no other known format (shm-monitor import --help lists them)"
        )
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            continue
    return raw.decode("latin-1")


def lines_of(text: str) -> list[str]:
    """Split a text into lines, without empty ones at its end."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").translate(_LOOK_ALIKES).split("\n")
    while lines and not lines[-1].strip(" ,;\t|"):
        lines.pop()
    return lines


def cut(path: Path, text: str, on_warning: OnWarning, time: str | None = None) -> Text:
    """Guess the dialect of a text and cut it into rows.

    Headings that stand again among the rows, as of files that were joined, and a last row that was cut off are left out and
    told.  Raises BadInputError if there is no table of numbers, or a row has another number of cells.
    """
    lines = lines_of(text)
    dialect = guess(path, lines, time)
    headings = {line.strip() for line in lines[: dialect.first] if line.strip()}
    rows: list[str] = []
    numbers: list[int] = []
    again = comments = 0
    marks: tuple[str, ...] = ("#", "%", "!", "//", *(() if dialect.delimiter == ";" else (";",)))
    keys = {cell for line in lines[: dialect.first] for cell in split(line, dialect.delimiter)[:1]}
    keys = {key for key in keys if len(key) > 1 and key[0].isalpha() and not is_missing(key)}
    if dialect.columns[0].role is Role.TEXT and dialect.columns[0].why != "empty":
        marks, keys = (), set()
    for number, line in enumerate(lines[dialect.first :], dialect.first + 1):
        bare = line.strip()
        if not bare:
            continue
        if bare.startswith(marks):
            comments += 1
            continue
        if bare in headings:
            again += 1
            continue
        cells = split(line, dialect.delimiter)
        if cells[0] in keys and rows:
            raise BadInputError(
                f"{path}: line {number}: lines as those above the table begin anew ({bare[:40]!r}): it holds several "
                "records; cut it before each of them, and import all files together"
            )
        if len(cells) >= dialect.width and not any(cells[dialect.width :]):
            rows.append(line)
            numbers.append(number)
        elif number == len(lines) and rows:
            on_warning(f"{path}: line {number} is cut short and left out")
        else:
            raise BadInputError(f"{path}: line {number}: {len(cells)} cells where {dialect.width} are expected")
    if comments:
        on_warning(f"{path}: {comments} {'line' if comments == 1 else 'lines'} of comments among the readings left out")
    if again:
        on_warning(f"{path}: {again} lines of headings stand again among the readings and are left out")
    return Text(path, rows, numbers, dialect, tuple(lines[: dialect.first]))


def named_columns(
    path: Path, text: str, wanted: Sequence[str], on_warning: OnWarning, zone: tzinfo | None = None
) -> Table:
    """Read the wanted columns alone, the times first; rows that cannot be read are left out and named.

    Raises BadInputError if a column is missing, or no row can be read.
    """
    rows = _named_rows(path, lines_of(text), wanted, on_warning)
    values = rows.values(range(1, len(wanted)), on_warning)
    return Table(path, tuple(wanted[1:]), ("",) * (len(wanted) - 1), values, times_in(rows, 0, on_warning, zone))


def _named_rows(path: Path, lines: list[str], wanted: Sequence[str], on_warning: OnWarning) -> Text:
    """Cut the rows that can be read, as a table of the wanted columns alone."""
    at, delimiter, header = _heading(lines, wanted)
    if absent := [name for name in wanted if name not in header]:
        raise BadInputError(f"{path}: no column {', '.join(absent)}; the columns are {', '.join(header)}")
    if twice := sorted({name for name in wanted if header.count(name) > 1 or wanted.count(name) > 1}):
        raise BadInputError(f"{path}: column {', '.join(twice)} stands or is named twice: give each its own name")
    columns = [header.index(name) for name in wanted]
    rows: dict[int, list[str]] = {}
    bad: dict[int, str] = {}
    for number, line in enumerate(lines[at + 1 :], at + 2):
        cells = split(line, delimiter)
        if not any(cells):
            continue
        if len(cells) < len(header) or any(cells[len(header) :]):
            bad[number] = f"{len(cells)} fields of {len(header)}"
        else:
            rows[number] = [cells[column] for column in columns]
    if not rows:
        raise BadInputError(f"{path}: no row can be read")
    dialect = guess(path, ["\t".join(cells) for cells in (wanted, *rows.values())], wanted[0], ("\t",))
    bad |= {number: reason for number, cells in rows.items() if (reason := _unreadable(cells, dialect))}
    if bad:
        named = "; ".join(f"line {number}: {bad[number]}" for number in sorted(bad)[:_NAMED_LINES])
        more = f" and {len(bad) - _NAMED_LINES} more" if len(bad) > _NAMED_LINES else ""
        on_warning(f"{path}: left out {named}{more}")
    good = [number for number in rows if number not in bad]
    if not good:
        raise BadInputError(f"{path}: no row can be read")
    return Text(path, ["\t".join(rows[number]) for number in good], good, dialect, ())


def _heading(lines: list[str], wanted: Sequence[str]) -> tuple[int, str | None, list[str]]:
    """Find the line, and the mark between its cells, that names most of the wanted columns, the most cells among those."""
    cut = ((at, mark, split(line.lstrip("#%! "), mark)) for at, line in enumerate(lines[:HEAD]) for mark in MARKS)
    return max(cut, key=lambda one: (len({*wanted} & {*one[2]}), -one[0], len(one[2])))


def _unreadable(cells: list[str], dialect: Dialect) -> str:
    """Return why a row of the wanted columns cannot be read; empty where it can."""
    time, *others = cells
    is_time = stamps.is_time if dialect.columns[0].role in CALENDAR else is_number
    if not is_time(time):
        return f"{time!r} is no time"
    return next((f"{cell!r} is no number" for cell in others if not (is_missing(cell) or is_number(cell))), "")


def to_tables(text: Text, on_warning: OnWarning, zone: tzinfo | None = None) -> list[Table]:
    """Convert a text to tables, one for each clock in it (errors as of `cut`)."""
    apart = _side_by_side(text, on_warning)
    return [table for one in apart for table in _tables_of(one, on_warning, zone)]


def _side_by_side(text: Text, on_warning: OnWarning) -> list[Text]:
    """Cut a text in which each sensor has a column of times of its own before its readings; one that has one is left whole."""
    dialect, times = text.dialect, text.dialect.of(Role.TIME)
    ends = [*times[1:], dialect.width]
    alike = {tuple(column.role for column in dialect.columns[at:end]) for at, end in zip(times, ends, strict=False)}
    if len(times) < 2 or times[0] != 0 or len(alike) != 1 or Role.READING not in next(iter(alike)):
        return [text]
    if len({tuple(text.cells(at)) for at in times}) == 1:
        return [text]
    found = []
    for at, end in zip(times, ends, strict=True):
        rows = [split(line, dialect.delimiter)[at:end] for line in text.lines]
        kept = [(row, number) for row, number in zip(rows, text.numbers, strict=True) if not is_missing(row[0])]
        part = replace(dialect, delimiter="\t", width=end - at, columns=dialect.columns[at:end])
        lines = ["\t".join(row) for row, _ in kept]
        found.append(Text(text.path, lines, [number for _, number in kept], part, text.preamble))
    return found


def _tables_of(text: Text, on_warning: OnWarning, zone: tzinfo | None) -> list[Table]:
    """Convert a text with one column of times."""
    dialect, path = text.dialect, text.path
    clock = _clock(text, on_warning, zone)
    labels = None if clock.time_ns is None else _label_column(text, clock.time_ns)
    readings = [at for at in dialect.of(Role.READING) if at != labels]
    if not readings:
        raise BadInputError(f"{path}: no column besides time and counter")
    if left := [dialect.columns[at].name for at in dialect.of(Role.TEXT) if at != labels]:
        on_warning(f"{path}: left out, since they hold no numbers: {', '.join(left)}")
    names = [dialect.columns[at].name for at in readings]
    if len(set(names)) != len(names):
        raise BadInputError(f"{path}: columns of the same name in the header: {', '.join(names)}")
    values = text.values(readings, on_warning)
    counters = [at for at in dialect.of(Role.COUNTER) if labels is None]
    index = text.values(counters[:1], on_warning)[:, 0] if counters else None
    if index is not None and not (np.isfinite(index).all() and (np.diff(index) >= 1).all()):
        index = None
    table = Table(
        path=path,
        columns=tuple(names),
        units=tuple(dialect.columns[at].unit_text for at in readings),
        by_name=tuple(dialect.columns[at].unit_by_name for at in readings),
        values=values,
        time_ns=clock.time_ns,
        index=None if index is None else index.astype(np.int64),
        start_ns=clock.start_ns,
        rate_hz=dialect.rate_hz,
        start_text=clock.start_text,
    )
    table = without_fillers(table, on_warning)
    if labels is not None:
        return _by_label(table, dialect.columns[labels].name, np.array(text.cells(labels)), on_warning)
    return _by_rate(_one_clock(table, on_warning))


def _label_column(text: Text, t_ns: Annotated[Ticks, "n"]) -> int | None:
    """Return the column that names the sensor of each row, where each sensor has rows of its own; None where none does.

    The times of each sensor rise evenly, and their spans overlap; all times together do not, or the column is named so.
    """
    is_even = _is_even(t_ns)
    for at in text.dialect.of(Role.TEXT, Role.COUNTER, Role.READING):
        column = text.dialect.columns[at]
        is_named = _CHANNEL_NAME.search(column.name) is not None
        if column.unit is not None or (not is_named and (is_even or column.role is Role.READING)):
            continue
        labels = np.array(text.cells(at))
        names = np.unique(labels)
        if not 1 < len(names) <= min(_MOST_SENSORS, len(labels) // 2):
            continue
        times = [t_ns[labels == name] for name in names]
        overlap = max(own[0] for own in times) < min(own[-1] for own in times)
        if overlap and all(map(_is_even, times)):
            return at
    return None


def _is_even(t_ns: Annotated[Ticks, "n"]) -> bool:
    """Test whether times rise by much the same step, but for pauses."""
    steps = np.diff(t_ns)
    usual = np.median(steps) if len(steps) else 0
    return bool(usual > 0 and (np.abs(steps - usual) < usual / 2).mean() >= _EVEN)


def _by_label(table: Table, heading: str, labels: NDArray[np.str_], on_warning: OnWarning) -> list[Table]:
    """Bring the readings of each sensor into columns of its own; sensors of the same times into one table."""
    found: list[Table] = []
    for label in dict.fromkeys(labels.tolist()):
        own = table.rows(np.flatnonzero(labels == label))
        name = f"{heading}_{label}" if is_number(label) else label
        own = replace(own, columns=(name,) if len(own.columns) == 1 else tuple(f"{name}_{of}" for of in own.columns))
        last = found[-1] if found else None
        if last is not None and np.array_equal(last.clock_ns, own.clock_ns):
            found[-1] = replace(
                last,
                columns=last.columns + own.columns,
                units=last.units + own.units,
                by_name=last.by_name + own.by_name,
                values=np.hstack([last.values, own.values]),
            )
        else:
            found.append(own)
    held = ", ".join(name for one in found for name in one.columns)
    on_warning(f"{table.path}: each row is of one sensor, which {heading!r} names: brought into the columns {held}")
    return found


def _by_rate(table: Table) -> list[Table]:
    """Cut a table in which slower sensors have readings in every second, third, .. row alone into one for each rate."""
    steps: dict[int, list[int]] = {}
    moving = table.default
    for at, column in enumerate(table.values.T):
        rows = np.flatnonzero(np.isfinite(column))
        step = int(np.median(np.diff(rows))) if len(rows) > 2 else 1
        slow = step > 1 and (np.diff(rows) == step).mean() >= _EVEN and table.columns[at] in moving
        steps.setdefault(step if slow else 1, []).append(at)
    if len(steps) < 2:
        return [table]
    return [
        table.of_columns(places).rows(np.flatnonzero(np.isfinite(table.values[:, places]).any(axis=1)))
        for places in steps.values()
    ]


def _one_clock(table: Table, on_warning: OnWarning) -> Table:
    """Bring readings that stand in rows of their own between those of the accelerations, as of another clock, to the row behind.

    Raises BadInputError if accelerations have rows of their own among each other.
    """
    names, values, t_ns = table.columns, table.values.copy(), table.time_ns
    moves = [table.quantity(name) == ACCELERATION for name in names]
    here = np.isfinite(values)
    lead = moves.index(True) if True in moves else 0
    own = _own_rows(here, lead)
    told = f"{table.path}: {', '.join(names[at] for at in own)} stand in rows without {names[lead]}"
    if own and (not moves[lead] or any(moves[at] for at in own)):
        raise BadInputError(f"{told}: they have clocks of their own; export each sensor to a file of its own")
    lone = here.any(axis=1) & ~here[:, moves].any(axis=1) & moves[lead]
    kept, between = np.flatnonzero(~lone), np.flatnonzero(lone)
    behind = np.searchsorted(kept, between)
    between, behind = between[(behind > 0) & (behind < len(kept))], behind[(behind > 0) & (behind < len(kept))]
    if not between.size or (t_ns is None and not own):
        return table
    if t_ns is not None:
        around_ns = t_ns[kept[behind]] - t_ns[kept[behind - 1]]
        if (around_ns < 1.5 * np.median(np.diff(t_ns[kept]))).mean() < _EVEN:
            return table  # where they stand the accelerations are missing
    others = [at for at in range(len(names)) if here[between, at].any()]
    for at in others:
        from_rows = here[between, at]
        values[kept[behind[from_rows]], at] = values[between[from_rows], at]
    on_warning(
        f"{table.path}: {', '.join(names[at] for at in others)} stand in rows without {names[lead]}, as of another clock; taken "
        "at the next row with it"
    )
    return replace(table, values=values).rows(kept)


def _own_rows(here: NDArray[np.bool_], lead: int) -> list[int]:
    """List the columns that have readings in rows without the leading one, and hardly any in rows with it."""
    counts = here.sum(axis=0)
    return [
        at
        for at in range(here.shape[1])
        if min(counts[at], counts[lead]) > _OWN_ROWS * len(here)
        and (here[:, at] & here[:, lead]).sum() < _OWN_ROWS * min(counts[at], counts[lead])
    ]


@dataclass(frozen=True, eq=False, slots=True)
class _Clock:
    """Times of the rows."""

    time_ns: Annotated[Ticks, "n"] | None = None
    start_ns: int | None = None
    start_text: str = ""
    """Time of the first row as written, where it has no zone."""


def times_in(text: Text, at: int, on_warning: OnWarning, zone: tzinfo | None = None) -> Annotated[Ticks, "n"]:
    """Convert a column of dates or of numbers to times, ns since 1970."""
    if text.dialect.columns[at].role in CALENDAR:
        return _dated(text, [at], zone, on_warning)[0].t_ns
    return _ticks(text, at, on_warning)[0]


def _clock(text: Text, on_warning: OnWarning, zone: tzinfo | None) -> _Clock:
    """Form the times of the rows from the columns that hold them."""
    dialect = text.dialect
    stated = _stated_start(text, zone)
    dated = sorted(dialect.of(Role.STAMP), key=lambda at: stamps.zone_in(dialect.columns[at].name) is None)
    columns = dated[:1] or _date_parts(dialect)
    clocked = dialect.of(Role.CLOCK)[:1]
    if not columns and clocked:
        columns = [*dialect.of(Role.DATE)[:1], *clocked]
    elif dated and clocked and all(map(MIDNIGHT.search, text.cells(columns[0]))):
        columns += clocked
    ticking = dialect.of(Role.TIME)
    if not columns:
        return _ticking(text, ticking[0], stated, on_warning) if ticking else stated
    read, first_text = _dated(text, columns, zone, on_warning)
    if ticking and not read.has_zone and is_since_1970(text.cells(ticking[0])):
        return _ticking(text, ticking[0], stated, on_warning)
    t_ns = _finer(text, ticking[0], read.t_ns, on_warning) if ticking else read.t_ns
    if read.has_date:
        return _Clock(t_ns, int(t_ns[0]), "" if read.has_zone else first_text)
    if stated.start_ns is None:
        on_warning(f"{text.path}: its times of day have no date, which --start states")
    return replace(stated, time_ns=t_ns)


def _date_parts(dialect: Dialect) -> list[int]:
    """List the columns of year, month, day, hour, minute and second; none where dates are written otherwise."""
    places = {dialect.columns[at].name.casefold(): at for at in dialect.of(Role.PART)}
    return [places[name] for name in DATE_PARTS] if places else []


def _dated(text: Text, columns: Sequence[int], zone: tzinfo | None, on_warning: OnWarning) -> tuple[stamps.Stamps, str]:
    """Read the times that stand in columns as dates, as times of day or as both; also the first one as written."""
    path = text.path
    form = "{}-{}-{} {}:{:0>2}:{}" if len(columns) == len(DATE_PARTS) else "{} {}" if len(columns) > 1 else "{}"
    first, *others = map(text.cells, columns)
    days = [MIDNIGHT.sub("", cell) for cell in first] if others else first
    texts = [form.format(*cells) for cells in zip(days, *others, strict=True)]
    heading = text.dialect.columns[columns[-1]]
    try:
        told = f"{heading.name} {heading.unit_text} {text.dialect.zone_text}"
        read = stamps.parse(texts, zone or stamps.zone_in(told), path.name)
    except ValueError as error:
        (row,) = error.args
        if not isinstance(row, int):
            raise
        raise BadInputError(f"{path}: line {text.numbers[row]}: {texts[row][:40]!r} is no date") from None
    if read.has_date:
        _tell_swapped(path, int(read.t_ns[0]), on_warning)
    if read.is_doubtful:
        on_warning(
            f"{path}: {texts[0]!r} is read with the {read.order}; nothing tells whether day and month are exchanged: see --start"
        )
    elif read.order and "name" in read.order:
        on_warning(f"{path}: {texts[0]!r} is read with the {read.order}")
    t_ns = _unwound(path, read.t_ns + _fractions_ns(text, on_warning), (_HOUR_NS, 24 * _HOUR_NS), on_warning)
    return replace(read, t_ns=t_ns), texts[0]


def _finer(text: Text, at: int, t_ns: Annotated[Ticks, "n"], on_warning: OnWarning) -> Annotated[Ticks, "n"]:
    """Take the times of a column of numbers where those of the dates stand still and these rise."""
    if len(t_ns) <= 2 or (np.diff(t_ns) == 0).mean() <= 0.5:
        return t_ns
    finer_ns = _ticking(text, at, _Clock(), on_warning).time_ns
    if finer_ns is None or not (np.diff(finer_ns) > 0).all():
        return t_ns
    on_warning(f"{text.path}: the times are those of column {text.dialect.columns[at].name!r}, which is finer")
    moved: Ticks = t_ns[0] + (finer_ns - finer_ns[0])
    return moved


def _unwound(
    path: Path, t_ns: Annotated[Ticks, "n"], turns_ns: Sequence[int], on_warning: OnWarning
) -> Annotated[Ticks, "n"]:
    """Let times go on where a step back is a whole turn and one step: at midnight, when winter time begins, or of a counter."""
    steps = np.diff(t_ns)
    if not (steps < 0).any() or not (steps > 0).any():
        return t_ns
    usual = int(np.median(steps[steps > 0]))
    gone, places = 0, dict[int, list[int]]()
    added = np.zeros_like(t_ns)
    for at in np.flatnonzero(steps < 0).tolist():
        turn = next((turn for turn in turns_ns if 0 <= int(steps[at]) + turn <= 2 * usual), 0)
        if turn and (turn != _HOUR_NS or _is_by_a_sunday(int(t_ns[at]) + gone)):
            places.setdefault(turn, []).append(at)
            added[at + 1] = turn
            gone += turn
    for turn, rows in places.items():
        more = f", and {len(rows) - 1} times more," if len(rows) > 1 else ""
        on_warning(
            f"{path}: from row {rows[0] + 2}{more} its times are {turn / 1e9:g} s earlier, one turn of their clock; taken to go "
            "on"
        )
    return t_ns + np.cumsum(added)


def _is_by_a_sunday(t_ns: int) -> bool:
    """Test whether it is Sunday in any zone, in the night to which clocks are set back."""
    return any((t_ns + away * _HOUR_NS) // (24 * _HOUR_NS) % 7 == 3 for away in (-12, 0, 12))


def _tell_swapped(path: Path, start_ns: int, on_warning: OnWarning) -> None:
    """Tell that the date in the file's name is the start with day and month exchanged."""
    day = datetime.fromtimestamp(start_ns / 1e9, UTC).date()
    named = re.search(r"(\d{4})-(\d{2})-(\d{2})", path.name)
    if named and day.day != day.month and tuple(map(int, named.groups())) == (day.year, day.day, day.month):
        on_warning(f"{path}: starts on {day}, but its name says {named[0]}: day and month seem swapped; see --start")


def _stated_start(text: Text, zone: tzinfo | None) -> _Clock:
    """Return the time of the first sample that lines above the table state, and how where it has no zone."""
    stated = text.dialect.start_text
    try:
        read = stamps.parse([stated], zone or stamps.zone_in(text.dialect.zone_text), text.path.name)
    except ValueError:  # of no text, too
        return _Clock()
    return _Clock(None, int(read.t_ns[0]), "" if read.has_zone else stated)


def _fractions_ns(text: Text, on_warning: OnWarning) -> Annotated[Ticks, "n"] | int:
    """Return the fractions of a second that stand in a column of their own, ns."""
    at = next(iter(text.dialect.of(Role.FRACTION)), None)
    if at is None:
        return 0
    return np.rint(text.values([at], on_warning)[:, 0]).astype(np.int64) * fraction_ns(text.dialect.columns[at].name)


def _ticking(text: Text, at: int, stated: _Clock, on_warning: OnWarning) -> _Clock:
    """Convert a column of numbers to a clock."""
    column = text.dialect.columns[at]
    t_ns, written = _ticks(text, at, on_warning)
    if written is not None:
        return _Clock(t_ns, int(t_ns[0]), written)
    step = float(np.median(np.abs(np.diff(t_ns)))) * 1e-9 if len(t_ns) > 1 else 0.0
    if column.unit is None and step > 1.0 / _LEAST_RATE_HZ and text.dialect.rate_hz is None:
        on_warning(
            f"{text.path}: column {column.name!r} states no unit and steps by {step:g}: in s that is {1.0 / step:.4g} Hz, "
            f"in ms {1e3 / step:.4g} Hz; taken as s (write the unit into its heading, as '{column.name} [ms]', or give --rate)"
        )
    return replace(stated, time_ns=t_ns)


def _ticks(text: Text, at: int, on_warning: OnWarning) -> tuple[Annotated[Ticks, "n"], str | None]:
    """Convert a column of numbers to times, by its unit, else by its size.

    Where they are dates, the first one is returned as written if it has no zone, else an empty text (s since 1970 are UTC).
    """
    column, path = text.dialect.columns[at], text.path
    if column.unit_text and (column.unit is None or column.unit.quantity != TIME):
        raise BadInputError(
            f"{path}: unknown unit {column.unit_text!r} of column {column.name!r}; give s, ms, us or ns"
        )
    for other in text.dialect.of(Role.TIME)[1:]:
        name = text.dialect.columns[other].name
        on_warning(f"{path}: column {name!r} holds times too and is not used; the times are those of {column.name!r}")
    numbers = text.values([at], on_warning)[:, 0]
    if not np.isfinite(numbers).all():
        bad = int(np.argmax(~np.isfinite(numbers)))
        raise BadInputError(f"{path}: line {text.numbers[bad]}: no time in column {column.name!r}")
    first = float(numbers[0])
    if column.unit is None and (days := _serial_days(numbers)) is not None:
        t_ns, words = days
        on_warning(f"{path}: column {column.name!r} is taken as days {words}")
        return t_ns, f"{first:.6f}"
    low, high = SINCE_1970_S
    factor = (
        column.unit.factor
        if column.unit is not None
        else next((tick for tick in TICKS if low < first * tick < high), 1.0)
    )
    if np.abs(numbers).max() > 4e18 / (factor * 1e9):
        raise BadInputError(f"{path}: column {column.name!r} holds no times: {numbers[np.argmax(np.abs(numbers))]:g}")
    t_ns = _exact_ns(numbers, factor)
    tick_ns = round(factor * 1e9)
    t_ns = _unwound(path, t_ns, (tick_ns << 32, tick_ns << 16), on_warning)
    if not (numbers % 1.0).any():
        t_ns = t_ns + _fractions_ns(text, on_warning)
    if column.unit is None and _SINCE_1904_S[0] < first < _SINCE_1904_S[1]:
        on_warning(f"{path}: column {column.name!r} is taken as seconds since 1904, as in LabVIEW")
        return t_ns - _SINCE_1904_S[2] * 10**9, ""
    return t_ns, "" if low < first * factor < high else None


def _serial_days(numbers: Annotated[Array, "n"]) -> tuple[Annotated[Ticks, "n"], str] | None:
    """Convert numbers that may be days since a time long ago to times, and return since which; None for others."""
    first = float(numbers[0])
    for least, most, zero, words in _SERIAL_DAYS:
        if least < first < most and not first.is_integer() and (np.diff(numbers) < 1.0).all():
            # Days with ten decimals are cut at 10 us.
            t_ns = np.rint((numbers - np.floor(first)) * 86_400e6).astype(np.int64) * 1000
            return t_ns + int(np.floor(first) - zero) * 86_400 * 10**9, words
    return None


def _exact_ns(numbers: Annotated[Array, "n"], factor: float) -> Annotated[Ticks, "n"]:
    """Convert times to ns without losing digits of large ones."""
    ticks = round(factor * 1e9)
    whole = np.floor(numbers)
    return whole.astype(np.int64) * ticks + np.rint((numbers - whole) * ticks).astype(np.int64)


__all__ = ["Text", "cut", "decode", "is_number", "lines_of", "named_columns", "to_tables"]
