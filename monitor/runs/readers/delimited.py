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

from monitor.core import BadInputError
from monitor.runs.readers import stamps
from monitor.runs.readers.dialect import CALENDAR, Dialect, Role, guess, is_missing, is_number, split
from monitor.runs.readers.table import Array, OnWarning, Table, Ticks, without_fillers
from monitor.runs.readers.units import ACCELERATION, TIME

_CHUNK_CELLS = 1 << 15
"""Cells of the rows that are converted to numbers together. [count; cost: they take 3 MB]"""
_LOOK_ALIKES = {0xA0: " ", 0x202F: " ", 0x2009: " ", 0x2212: "-"}
"""Characters that stand for a space between groups of digits, or for a minus. [characters; typography]"""
_SINCE_1970_S = (3e8, 3.6e9)
"""Seconds since 1970 that are a date, of 1979 to 2084. [s; judgement]"""
_SINCE_1904_S = (3.6e9, 4.4e9, 2_082_844_800)
"""Seconds since 1904 that are a date: least, most, that of 1970. [s; 2018 to 2043; LabVIEW]"""
_MOST_SENSORS = 256
"""Most sensors that a column may name. [count; judgement]"""
_CHANNEL_NAME = re.compile(r"^(ch|chan|channel|sensor|node|axis|kanal|device|id|no|nr)\b", re.IGNORECASE)
_OWN_ROWS = 0.1
"""Share of rows with readings of both, below which two columns have rows of their own. [ratio; judgement]"""
_HOUR_NS = 3600 * 10**9
"""An hour. [ns; definition]"""
_SERIAL_DAYS = (
    (3e4, 8e4, 25_569.0, "since 1900, as in spreadsheets"),
    (7.2e5, 8e5, 719_529.0, "since year 0, as in MATLAB"),
)
"""Days that are a date: least, most, that of 1970, and in words. [days; 1982 to 2119]"""
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


def to_table(text: Text, on_warning: OnWarning, zone: tzinfo | None = None) -> Table:
    """Convert a text to a table on its own clock (errors as of `cut`)."""
    dialect, path = text.dialect, text.path
    readings = dialect.of(Role.READING)
    if not readings:
        raise BadInputError(f"{path}: no column besides time and counter")
    if left := [dialect.columns[at].name for at in dialect.of(Role.TEXT)]:
        on_warning(f"{path}: left out, since they hold no numbers: {', '.join(left)}")
    names = [dialect.columns[at].name for at in readings]
    if len(set(names)) != len(names):
        raise BadInputError(f"{path}: columns of the same name in the header: {', '.join(names)}")
    clock = _clock(text, on_warning, zone)
    if clock.time_ns is not None and (np.diff(clock.time_ns) <= 0).any():
        _demand_columns(text, clock.time_ns)
    values = text.values(readings, on_warning)
    moves = [(unit := dialect.columns[at].unit) is not None and unit.quantity == ACCELERATION for at in readings]
    counters = dialect.of(Role.COUNTER)
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
    keep = _one_clock(path, names, moves, table.values, on_warning)
    return table if keep is None else table.rows(keep)


def _demand_columns(text: Text, t_ns: Annotated[Ticks, "n"]) -> None:
    """Refuse a table in which each sensor has rows of its own at the same times, named in a column."""
    for at in text.dialect.of(Role.TEXT, Role.COUNTER, Role.READING):
        column = text.dialect.columns[at]
        if column.unit is not None or (column.role is Role.READING and _CHANNEL_NAME.search(column.name) is None):
            continue
        cells = text.cells(at)
        names = sorted(set(cells))
        if not 1 < len(names) <= min(_MOST_SENSORS, len(cells) // 2):
            continue
        labels = np.array(cells)
        times = [t_ns[labels == name] for name in names]
        if all(len(own) == len(times[0]) > 1 and (own == times[0]).all() and own[0] < own[-1] for own in times):
            raise BadInputError(
                f"{text.path}: each time stands {len(names)} times, for {', '.join(names[:4])} in column {column.name!r}; "
                "bring the readings of each into a column of its own"
            )


def _one_clock(
    path: Path, names: Sequence[str], moves: Sequence[bool], values: Annotated[Array, "n c"], on_warning: OnWarning
) -> Annotated[Ticks, "m"] | None:
    """Return the rows of the accelerations where other columns have rows of their own, as of another clock; else None.

    Raises BadInputError if accelerations have rows of their own among each other.
    """
    here = np.isfinite(values)
    counts = here.sum(axis=0)
    lead = moves.index(True) if True in moves else 0
    apart = [
        at
        for at in range(len(names))
        if min(counts[at], counts[lead]) > _OWN_ROWS * len(values)
        and (here[:, at] & here[:, lead]).sum() < _OWN_ROWS * min(counts[at], counts[lead])
    ]
    if not apart:
        return None
    told = f"{path}: {', '.join(names[at] for at in apart)} stand in rows without {names[lead]}"
    if not moves[lead] or any(moves[at] for at in apart):
        raise BadInputError(f"{told}: they have clocks of their own; export each sensor to a file of its own")
    beside = [at for at in range(len(names)) if at not in apart]
    on_warning(f"{told}, as of another clock; these rows are left out")
    return np.flatnonzero(here[:, beside].any(axis=1))


@dataclass(frozen=True, eq=False, slots=True)
class _Clock:
    """Times of the rows."""

    time_ns: Annotated[Ticks, "n"] | None
    start_ns: int | None
    start_text: str
    """Time of the first row as written, where it has no zone."""


def times_in(text: Text, at: int, on_warning: OnWarning) -> Annotated[Ticks, "n"]:
    """Convert a column of dates or of numbers to times, ns since 1970."""
    if text.dialect.columns[at].role in CALENDAR:
        return _dated(text, [at], None, on_warning)[0].t_ns
    return _ticks(text, at, on_warning)[0]


def _clock(text: Text, on_warning: OnWarning, zone: tzinfo | None) -> _Clock:
    """Form the times of the rows from the columns that hold them."""
    dialect = text.dialect
    stated = _stated_start(text, zone)
    columns = dialect.of(Role.STAMP)[:1]
    if not columns and (clocked := dialect.of(Role.CLOCK)[:1]):
        columns = [*dialect.of(Role.DATE)[:1], *clocked]
    ticking = dialect.of(Role.TIME)
    if not columns:
        return _ticking(text, ticking[0], stated, on_warning) if ticking else _Clock(None, *stated)
    read, first_text = _dated(text, columns, zone, on_warning)
    t_ns = _finer(text, ticking[0], read.t_ns, on_warning) if ticking else read.t_ns
    if read.has_date:
        return _Clock(t_ns, int(t_ns[0]), "" if read.has_zone else first_text)
    if stated[0] is None:
        on_warning(f"{text.path}: its times of day have no date, which --start states")
    return _Clock(t_ns, *stated)


def _dated(text: Text, columns: Sequence[int], zone: tzinfo | None, on_warning: OnWarning) -> tuple[stamps.Stamps, str]:
    """Read the times that stand in columns as dates, as times of day or as both; also the first one as written."""
    path = text.path
    texts = [" ".join(cells) for cells in zip(*map(text.cells, columns), strict=True)]
    heading = text.dialect.columns[columns[-1]]
    try:
        read = stamps.parse(texts, zone or stamps.zone_in(f"{heading.name} {heading.unit_text}"), path.name)
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
    finer_ns = _ticking(text, at, (None, ""), on_warning).time_ns
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


def _stated_start(text: Text, zone: tzinfo | None) -> tuple[int | None, str]:
    """Return the time of the first sample that lines above the table state, and how where it has no zone; None without."""
    stated = text.dialect.start_text
    if not stated:
        return None, ""
    try:
        read = stamps.parse([stated], zone, text.path.name)
    except ValueError:
        return None, ""
    return int(read.t_ns[0]), "" if read.has_zone else stated


def _fractions_ns(text: Text, on_warning: OnWarning) -> Annotated[Ticks, "n"] | int:
    """Return the fractions of a second that stand in a column of their own, ns."""
    at = next(iter(text.dialect.of(Role.FRACTION)), None)
    if at is None:
        return 0
    micro = text.dialect.columns[at].name.casefold().startswith(("u", "micro"))
    return np.rint(text.values([at], on_warning)[:, 0]).astype(np.int64) * (1000 if micro else 10**6)


def _ticking(text: Text, at: int, stated: tuple[int | None, str], on_warning: OnWarning) -> _Clock:
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
    return _Clock(t_ns, *stated)


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
    low, high = _SINCE_1970_S
    factor = (
        column.unit.factor
        if column.unit is not None
        else next((tick for tick in (1.0, 1e-3, 1e-6, 1e-9) if low < first * tick < high), 1.0)
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


__all__ = ["Text", "cut", "decode", "is_number", "lines_of", "times_in", "to_table"]
