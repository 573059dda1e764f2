"""Files of any format become one recording: read, put on one clock, chosen, converted, written."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np

from drivers.base import ACCELERATION, FORCE, GROUND, ROTATION_RATE, TEMPERATURE, UNIT_OF, RecordingError, SampleBlock
from drivers.mcap_file import McapWriter, RecordingInfo, recording_info
from drivers.mcap_records import MAGIC
from monitor.core import BadInputError, OnProgress, Step, WrongUsageError, os_errors_of, utc
from monitor.runs.readers import clocks, formats, units
from monitor.runs.readers.base import File, Limits, Options, demand_file, read_bytes
from monitor.runs.readers.mdf import MAGIC as MDF_MAGIC
from monitor.runs.readers.table import KNOWN_UNITS, Array, OnWarning, Table, Ticks, in_order, in_si, meant_instead
from monitor.runs.readers.units import G_M_S2, unit_of
from monitor.signals import SampleClock, sample_clock

GRAVITY_TOLERANCE = 0.03
"""Distance of a mean from 1, relative, within which it may be gravity. [1; judgement: a sensor's offset and its tilt]"""
_GRAVITY_UNITS = ("m/s^2", "g", "mg", "gal")
"""Units of which a constant part of the size of gravity tells. [names; as of --unit]"""
_RATES_HZ = (5.0, 1e5)
"""Rates outside which a rate is doubted. [Hz; judgement: buildings, and impacts on machines]"""
_LEVELS_M_S2 = (1e-9 * G_M_S2, 100.0 * G_M_S2)
"""Levels outside which a unit is doubted. [m/s^2; judgement: below any sensor's noise, above any building's motion]"""
_CONTRADICTED = 1e-3
"""Difference, relative, from which a stated rate and that of the stamps are told to differ. [1; judgement: a poor clock's
tolerance, ten times]"""


_PLAIN, _LIMITS = Options(), Limits()


@dataclass(frozen=True, slots=True)
class ImportedChannel:
    """What was taken for a channel."""

    topic: str
    name: str
    source: str
    """As FILE:COLUMN."""
    unit: str
    """As which the column was read."""
    stated: bool
    """Whether the file states this unit."""
    by_name: bool
    """Whether it does so in the column's name."""
    mean: float
    """Mean of the finite readings, in the unit of the topic."""
    rms: float
    """About their mean, in the unit of the topic."""


Place = tuple[Table, str]
"""A column of a table."""
OnChannel = Callable[[ImportedChannel], None]
AskUnit = Callable[[Sequence[str]], str]
_QUANTITY = {
    ACCELERATION: units.ACCELERATION,
    GROUND: units.ACCELERATION,
    FORCE: units.FORCE,
    ROTATION_RATE: units.ROTATION,
}
"""Topic -> quantity of its columns."""


@dataclass(frozen=True, eq=False, slots=True)
class _Stream:
    """Columns of one topic, and their readings in its unit."""

    topic: str
    unit: str
    places: dict[str, Place]
    values: Annotated[Array, "n c"]


def acceleration_unit(text: str) -> bool:
    """Return whether a text is a unit of acceleration."""
    unit = unit_of(text)
    return unit is not None and unit.quantity == units.ACCELERATION


def import_files(
    files: list[Path],
    out: Path,
    options: Options = _PLAIN,
    *,
    ask_unit: AskUnit | None = None,
    on_warning: OnWarning = lambda _: None,
    on_channel: OnChannel = lambda _: None,
    on_progress: OnProgress = lambda _: None,
    limits: Limits = _LIMITS,
) -> RecordingInfo:
    """Write the readings of `files`, sampled at the same time, as one recording, and return the content of the recording.

    Parameters
    ----------
    ask_unit
        Asks the user for the unit of columns, given as "FILE:COLUMN", where neither files nor options state it; without it,
        m/s^2 is taken with a warning.
    on_channel
        Told of each channel that was written; not of those of a CAN log.

    Raises
    ------
    BadInputError
        If the data cannot be used.
    MissingInputError
        If a file cannot be read, or `out` cannot be written.
    WrongUsageError
        If the option `unit` is no unit of acceleration.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table = Path(folder, "a.csv")
    ...     _ = table.write_text("t,a1 [g]\\n0.00,0.1\\n0.01,0.2\\n0.02,0.1\\n")
    ...     info = import_files([table], Path(folder, "a.mcap"), Options(start_ns=0))
    >>> info.sample_rate_hz, info.channels["/acceleration"]
    (100.0, ('a1',))
    """
    from monitor.runs.readers import can_log  # its libraries take long to load, and a recording needs no import

    _check(options)
    if any(map(can_log.is_log, files)) and (options.dbc is not None or not _is_table(files[0])):
        return can_log.import_log(files, out, options, on_warning)
    for option, value in ((f"--bus {options.bus}", options.bus), ("--dbc", options.dbc)):
        if value is not None:
            raise BadInputError(f"{option} is for CAN logs; {files[0]} is none by its name")
    tables, clock = clocks.join(_read(files, options, limits, on_warning, on_progress), on_warning)
    rate, numbers = _timing(tables, clock, options, on_warning)
    start_ns = _start_ns(tables, options, on_warning)
    # The time of the last sample must fit 64-bit nanoseconds, which a damaged counter violates.
    if not 1e-3 <= rate <= 1e7 or start_ns + int(numbers[-1]) * 1e9 / rate > 4e18:
        raise BadInputError(f"{files[0]}: {rate} Hz and {numbers[-1]} samples in all are absurd")
    streams, unit, is_taken = _streams(tables, options, ask_unit, on_warning)
    _warn_of_missing(streams[0].values, numbers, rate, on_warning)
    on_progress(Step("writes the recording"))
    try:
        with os_errors_of(out, "cannot be written: "):
            _write(out, streams, rate, numbers, start_ns)
        info = recording_info(out)
    except RecordingError as error:
        raise BadInputError(f"{files[0]}: {error}") from error
    taken = [_taken(stream, name, at, unit) for stream in streams for at, name in enumerate(stream.places)]
    for one in taken:
        on_channel(one)
    if is_taken:
        on_warning(doubt_unit(taken))
    for doubt in _doubts(rate, taken):
        on_warning(f"{files[0]}: {doubt}")
    return info


def are_recordings(paths: Sequence[Path]) -> bool:
    """Check whether files are recordings, and not files of other formats; BadInputError where they are of both kinds."""
    kinds = set()
    for path in paths:
        with os_errors_of(path), path.open("rb") as file:
            kinds.add(file.read(len(MAGIC)) == MAGIC or path.suffix == ".mcap")
    if len(kinds) > 1:
        raise BadInputError(f"{', '.join(map(str, paths))}: are recordings and other files; give one kind at a time")
    return kinds.pop()


@contextmanager
def as_recordings(
    paths: Sequence[Path],
    options: Options = _PLAIN,
    on_warning: OnWarning = lambda _: None,
    *,
    ask_unit: AskUnit | None = None,
    on_channel: OnChannel = lambda _: None,
) -> Iterator[list[Path]]:
    """Give recordings as they are, and files of any other format as one recording that lasts as long as the block.

    Errors within the block name the files (errors as `import_files`).
    """
    if are_recordings(paths):
        if given := options.given():
            raise BadInputError(
                f"{paths[0]}: is a recording, which states all that is to be known of it: leave {', '.join(given)} out"
            )
        yield list(paths)
        return
    with TemporaryDirectory() as folder:
        out = Path(folder, f"{paths[0].stem}.mcap")
        import_files(list(paths), out, options, ask_unit=ask_unit, on_warning=on_warning, on_channel=on_channel)
        try:
            yield [out]
        except BadInputError as error:
            raise BadInputError(str(error).replace(str(out), ", ".join(map(str, paths)))) from error


def _check(options: Options) -> None:
    """Refuse options that mean nothing."""
    if options.rate_hz is not None and not (np.isfinite(options.rate_hz) and options.rate_hz > 0):
        raise BadInputError(f"--rate {options.rate_hz}: must be a positive number of Hz")
    if options.unit is not None and not acceleration_unit(options.unit):
        raise WrongUsageError(f"--unit {options.unit!r}: known for acceleration: {KNOWN_UNITS[units.ACCELERATION]}")
    if options.scale is not None and not (np.isfinite(options.scale) and options.scale != 0.0):
        raise BadInputError(f"--scale {options.scale}: must be a number of m/s^2 a count, not 0")


def _is_table(path: Path) -> bool:
    """Test whether a file with the suffix of a CAN log is a table of text all the same, or an MDF, which may hold samples."""
    demand_file(path)
    with os_errors_of(path, "cannot be read: "), path.open("rb") as file:
        raw = file.read(4096)
    first = raw.partition(b"\n")[0].strip()
    logged = first.lower().startswith((b"date ", b"(", b";$fileversion", b"base ")) or b"\0" in raw
    return (bool(raw.strip()) and not logged) or raw.startswith(MDF_MAGIC)


def _read(
    files: list[Path], options: Options, limits: Limits, on_warning: OnWarning, on_progress: OnProgress
) -> list[Table]:
    """Read all files, join those that follow one another in time, or align them; leave out those of which no column is named."""
    tables: list[Table] = []
    for number, path in enumerate(files):
        on_progress(Step(f"reads {path.name}", number, len(files), "files", then="writes the recording"))
        found = formats.read(File(path, read_bytes(path), options, limits, on_warning))
        tables += [in_order(table, on_warning) for table in found]
    counted = any(table.is_scaled or "counts" in map(table.quantity, table.columns) for table in tables)
    if (options.scale is not None or options.inventory is not None) and not counted:
        raise BadInputError(
            f"{', '.join(map(str, files))}: --scale and --inventory are for counts, as for MiniSEED, and none is here; "
            "K-NET states its own scale, and --unit is for the others"
        )
    if not options.align:
        return _in_use(clocks.follow(tables, on_warning), options, on_warning)
    tables = _in_use(tables, options, on_warning)
    leading = _named(tables, options.channels).values()
    return clocks.align(tables, [place for place in leading if not _turns(place)], on_warning)


def _in_use(tables: list[Table], options: Options, on_warning: OnWarning) -> list[Table]:
    """Leave out the tables of which no column is named, where the user names the channels, and tell it."""
    if not options.channels:
        return tables
    of = [_named(tables, options.channels), *_inputs(tables, options)]
    used = {id(table) for named in of for table, _ in named.values()}
    for table in tables:
        if id(table) not in used:
            on_warning(f"{table.path}: left out: no --channel names a column of {', '.join(table.columns)}")
    return [table for table in tables if id(table) in used]


def _turns(place: Place) -> bool:
    """Test whether a column holds a rate of rotation."""
    return place[0].quantity(place[1]) == units.ROTATION


def _named(tables: list[Table], references: dict[str, str] | None) -> dict[str, Place]:
    """Find the columns of an option, by the names that it gives them."""
    return {name: find_column(tables, reference) for name, reference in (references or {}).items()}


def _inputs(tables: list[Table], options: Options) -> tuple[dict[str, Place], dict[str, Place], dict[str, Place]]:
    """Find the columns of base motion, forces and covariates, by their names."""
    ground = {"ground": options.ground} if options.ground else None
    return _named(tables, ground), _named(tables, options.forces), _named(tables, options.covariates)


def _streams(
    tables: list[Table], options: Options, ask_unit: AskUnit | None, on_warning: OnWarning
) -> tuple[list[_Stream], str, bool]:
    """Choose the columns of each topic and convert them; also the unit of those that state none, and whether it was taken."""
    base, forces, covariates = _inputs(tables, options)
    chosen = _named(tables, options.channels) or _choose(
        tables, options, [*base.values(), *forces.values()], covariates
    )
    turning = {name: place for name, place in chosen.items() if _turns(place)}
    moving = {name: place for name, place in chosen.items() if name not in turning}
    if not moving:
        raise BadInputError(
            f"{tables[0].path}: only rates of rotation are chosen; name a column of acceleration too, with --channel"
        )
    unit, is_taken = _unit_of_others([*moving.values(), *base.values()], options, ask_unit, on_warning)
    topics = {ACCELERATION: moving, GROUND: base, FORCE: forces, ROTATION_RATE: turning}
    streams = [
        _Stream(topic, UNIT_OF[topic], places, _converted(places, topic, unit, options))
        for topic, places in topics.items()
        if places
    ]
    used = [place for places in topics.values() for place in places.values()]
    return streams + _others(tables, covariates, used, on_warning), unit, is_taken


def _unit_of_others(
    places: list[Place], options: Options, ask_unit: AskUnit | None, on_warning: OnWarning
) -> tuple[str, bool]:
    """Return the unit of columns whose file states none of acceleration, and whether it was taken for granted."""
    bare = [f"{table.path.name}:{column}" for table, column in places if not table.unit(column)]
    if options.unit is None:
        return (ask_unit(bare), False) if bare and ask_unit is not None else ("m/s^2", bool(bare))
    strange = [c for t, c in places if t.unit(c) and t.quantity(c) not in (units.ACCELERATION, "counts")]
    if strange:
        on_warning(
            f"--unit {options.unit} is taken for {', '.join(strange)}, whose stated unit is no known one of acceleration"
        )
    elif not bare:
        on_warning(
            f"--unit {options.unit} is not used: the files state the unit of every column, or --scale and --inventory do"
        )
    return options.unit, False


def _converted(places: dict[str, Place], topic: str, unit: str, options: Options) -> Annotated[Array, "n c"]:
    """Convert columns to the unit of their topic; `unit` is that of accelerations whose file states none."""
    values = []
    for table, column in places.values():
        quantity, stated = _QUANTITY[topic], table.quantity(column)
        if quantity != units.ACCELERATION:
            values.append(table.converted(column, quantity, UNIT_OF[topic]))
        elif stated != "counts":
            values.append(table.converted(column, quantity, unit, options.unit if stated != quantity else None))
        elif options.scale is not None:
            values.append(table.values[:, table.columns.index(column)] * options.scale)
        else:
            raise BadInputError(f"{table.path}: {column} holds counts; give --scale M/S^2-A-COUNT, or --inventory")
    return np.column_stack(values)


def _others(
    tables: list[Table], covariates: dict[str, Place], used: list[Place], on_warning: OnWarning
) -> list[_Stream]:
    """Keep what is no acceleration: named covariates, and columns of another quantity, each as a topic of its own."""
    left_out: list[str] = []
    kept = dict(covariates)
    used = [*used, *covariates.values()]
    for table, column in ((one, name) for one in tables for name in one.columns):
        if (table, column) in used:
            continue
        if table.quantity(column) in ("", units.ACCELERATION, "counts"):
            left_out.append(f"{table.path.name}:{column}" if len(tables) > 1 else column)
        else:
            kept[f"{table.names[0]}_{column}" if column in kept else column] = (table, column)
    if left_out:
        on_warning(
            f"{tables[0].path}: left out: {', '.join(left_out)} (--channel and --covariate take columns by name)"
        )
    streams: dict[str, _Stream] = {}
    for name, (table, column) in kept.items():
        stated, values = unit_of(table.unit(column)), table.values[:, [table.columns.index(column)]]
        unit = table.unit(column) or "1"
        if stated is not None and stated.quantity == "temperature":
            values, unit = in_si(values, stated), UNIT_OF[TEMPERATURE]
        topic = _free_topic(name, unit, streams)
        streams[topic] = _Stream(topic, unit, {name: (table, column)}, values)
        if name not in covariates:
            on_warning(f"{table.path}: {column} ({unit}) is kept as the covariate {topic}")
    return list(streams.values())


def _free_topic(name: str, unit: str, taken: Iterable[str]) -> str:
    """Return the topic of a covariate: of the first temperature /temperature, of any other its name, which no other has."""
    if unit == UNIT_OF[TEMPERATURE] and TEMPERATURE not in taken:
        return TEMPERATURE
    topic = f"/{_slug(name)}"
    numbered = (f"{topic}_{number}" for number in count(2))
    return next(one for one in chain([topic], numbered) if one not in taken and one not in UNIT_OF)


def _slug(name: str) -> str:
    """Return a name as part of a topic."""
    return re.sub(r"[^a-z0-9]+", "_", name.casefold()).strip("_") or "covariate"


def _choose(
    tables: list[Table], options: Options, inputs: list[Place], covariates: dict[str, Place]
) -> dict[str, Place]:
    """Choose the columns of accelerations and their names where the user names none.

    Of several files, one that holds a base motion or a force holds no floor.
    """
    taken = [*inputs, *covariates.values()]
    rest = [(table, column) for table in tables for column in table.default]
    if len(tables) > 1:
        taken += [(table, column) for table, _ in inputs for column in table.columns]
    else:
        every = [(tables[0], column) for column in tables[0].columns]
        rest += [place for place in every if place not in rest and _turns(place)]
        rest = every if options.unit and not set(rest) - set(taken) else rest
    rest = [place for place in rest if place not in taken]
    if not rest:
        raise _none_left(tables[0], is_taken=bool(taken))
    return _named_apart(rest, len(tables) == 1)


def _none_left(table: Table, *, is_taken: bool) -> BadInputError:
    """Return the error that no column holds accelerations; raise it where the columns are of another quantity."""
    if not is_taken:
        table.converted(next(filter(table.unit, table.columns), table.columns[0]), units.ACCELERATION, "m/s^2")
    return BadInputError(
        f"{table.path}: no column is left for the floors besides the ground; it has {', '.join(table.columns)}"
    )


def _named_apart(places: list[Place], of_one_file: bool) -> dict[str, Place]:
    """Name columns: of several files by the file, unless it has several or holds a component of a record."""
    columns, files = [column for _, column in places], [table.names[0] for table, _ in places]
    both = [f"{file}_{column}" for file, column in zip(files, columns, strict=True)]
    for names in (columns,) if of_one_file else (files, columns, both):
        if len(set(names)) == len(names):
            return dict(zip(names, places, strict=True))
    name = max(both, key=both.count)
    path = places[both.index(name)][0].path
    raise BadInputError(f"{path}: several columns would be channel {name!r}; name each: --channel NAME=FILE:COLUMN")


def find_column(tables: list[Table], reference: str) -> Place:
    """Find the column that "FILE", "FILE:COLUMN" or, with a single file, "COLUMN" denotes; BadInputError if there is none."""
    whole = [table for table in tables if reference in table.names]
    if len(whole) == 1:
        if len(whole[0].default) != 1:
            raise BadInputError(f"{whole[0].path}: name a column: {', '.join(whole[0].columns)}")
        return whole[0], whole[0].default[0]
    one_file = len({table.path for table in tables}) == 1
    found = [place for table in tables for place in _denoted(table, reference, one_file)]
    if found and not whole:
        table, column = next((place for place in found if place[1] in place[0].columns), found[0])
        table.unit(column)  # or there is no such column
        return table, column
    raise BadInputError(f"{reference!r} {_says_unknown(tables, reference, is_ambiguous=bool(whole))}")


def _says_unknown(tables: list[Table], reference: str, *, is_ambiguous: bool) -> str:
    """Say why a reference denotes no column, and how to write it."""
    held = ", ".join(f"{table.path} ({', '.join(table.columns)})" for table in tables)
    known = [text for t in tables for n in t.names for text in (n, *t.columns, *(f"{n}:{c}" for c in t.columns))]
    what = "names several files" if is_ambiguous else f"names no file{meant_instead(reference, known)}"
    return (
        f"{what}; the files, with their columns, are {held}; "
        f"write FILE:COLUMN, as {tables[0].names[0]}:{tables[0].columns[0]}"
    )


def _denoted(table: Table, reference: str, one_file: bool) -> list[Place]:
    """Return what "FILE:COLUMN" denotes if it names the file, and of a single file what "COLUMN" does."""
    found = [(table, reference[len(name) + 1 :]) for name in table.names if reference.startswith(f"{name}:")]
    return [*found, (table, reference)] if one_file and reference in table.columns else found


def _timing(
    tables: list[Table], clock: Ticks | None, options: Options, on_warning: OnWarning
) -> tuple[float, Annotated[Ticks, "n"]]:
    """Return the sample rate in Hz and the number of every sample; what contradicts what is told."""
    path, count = tables[0].path, len(tables[0].values)
    by_file = next((table.rate_hz for table in tables if table.rate_hz), None)
    stated = options.rate_hz or by_file
    if clock is None:
        if stated is None:
            raise BadInputError(f"{path}: no time column tells the rate; give --rate HZ")
        return stated, np.arange(count)
    try:
        found = sample_clock(clock)
    except BadInputError as error:
        if stated is None:
            raise BadInputError(f"{path}: the time column is irregular: {error}; give --rate HZ") from error
        on_warning(f"{path}: the time column is irregular and not used ({error}); samples run at {stated:g} Hz")
        return stated, np.arange(count)
    numbers = _counted(tables[0], found, on_warning)
    _tell_clock(path, found, on_warning)
    if stated is None:
        return found.rate_hz, numbers
    if abs(stated / found.rate_hz - 1.0) <= max(_CONTRADICTED, 3.0 * found.rate_std_hz / found.rate_hz):
        return stated, numbers
    whose = "--rate says" if options.rate_hz else "the file states"
    on_warning(
        f"{path}: the time column says {found.rate_hz:.6g} +- {max(found.rate_std_hz, 1e-6):.2g} Hz, {whose} {stated:g} Hz; "
        f"{'--rate' if options.rate_hz else 'the time column'} is used: where it is wrong, so is every frequency by "
        f"{100.0 * abs(stated / found.rate_hz - 1.0):.2g} %"
    )
    return (stated if options.rate_hz else found.rate_hz), numbers


def _counted(table: Table, clock: SampleClock, on_warning: OnWarning) -> Annotated[Ticks, "n"]:
    """Return the samples' numbers by the device's counter, where it has one that agrees with the clock, else by the clock."""
    if table.index is None:
        return clock.numbers
    counter: Ticks = table.index - table.index[0]
    if np.diff(counter).min(initial=1) < 1:
        raise BadInputError(f"{table.path}: the packet counter does not rise; export it again")
    length = int(clock.numbers[-1]) + 1
    if abs(int(counter[-1]) + 1 - length) > max(1, length // 1000) and clock.pauses:
        on_warning(
            f"{table.path}: the counter goes on by {counter[-1]}, the times by {clock.numbers[-1]} samples; the times count"
        )
        return clock.numbers
    return counter


def _tell_clock(path: Path, clock: SampleClock, on_warning: OnWarning) -> None:
    """Tell how far the stamps scatter, where that matters, and that the samples are taken as evenly spaced."""
    step_s = 1.0 / clock.rate_hz
    if clock.jitter_s > max(0.05 * step_s, 0.6 * clock.resolution_s):
        on_warning(
            f"{path}: the stamps scatter by {1e3 * clock.jitter_s:.3g} ms about {clock.rate_hz:.6g} +- "
            f"{clock.rate_std_hz:.2g} Hz; the samples are taken as evenly spaced"
        )


def _start_ns(tables: list[Table], options: Options, on_warning: OnWarning) -> int:
    """Return the time of the first sample, UTC in ns since 1970; tell which files' times are taken as UTC, where it matters."""
    starts = [(table.start_ns, table) for table in tables if table.start_ns is not None and table.start_ns >= 0]
    bare = [(start_ns, table) for start_ns, table in starts if table.start_text]
    mixed = len(bare) < len(starts)  # a zone shifts some of the files against the others
    for start_ns, table in bare if mixed else bare[: options.start_ns is None]:
        on_warning(
            f"{table.path}: its time {table.start_text} has no zone{' that is known' * table.start_text[-1:].isalpha()}; taken "
            f"as UTC: {utc(start_ns, seconds=True)} (see --start and --timezone)"
        )
    if options.start_ns is not None or starts:
        return starts[0][0] if options.start_ns is None else options.start_ns
    if options.unknown_start_ns is None:
        on_warning("no file tells when it was recorded; the recording begins in 1970 (see --start)")
    return options.unknown_start_ns or 0


def _taken(stream: _Stream, name: str, at: int, unit: str) -> ImportedChannel:
    """Form what is told of a channel; `unit` is that of a column of acceleration whose file states none of acceleration."""
    table, column = stream.places[name]
    readings = stream.values[:, at]
    finite = readings[np.isfinite(readings)]
    with np.errstate(over="ignore", invalid="ignore"):
        level = (float(finite.mean()), float(finite.std())) if len(finite) else (0.0, 0.0)
    mean, rms = (value if np.isfinite(value) else 0.0 for value in level)
    moves = stream.topic in (ACCELERATION, GROUND)
    of_other = moves and table.quantity(column) not in (units.ACCELERATION, "counts")  # which --unit stands for
    stated = "" if of_other else table.unit(column)
    taken = stated or (unit if moves else stream.unit)
    by_name = bool(stated) and table.is_by_name(column)
    return ImportedChannel(stream.topic, name, f"{table.path.name}:{column}", taken, bool(stated), by_name, mean, rms)


def doubt_unit(channels: Sequence[ImportedChannel]) -> str:
    """Say what it means that the columns whose file states no unit are taken as m/s^2, and what unit gravity shows.

    Examples
    --------
    >>> text = doubt_unit([ImportedChannel("/acceleration", "a1", "a.csv:a1", "m/s^2", False, False, 0.999, 0.02)])
    >>> text.partition(" (see --unit): ")[2]
    'the RMS is then up to 0.02 m/s^2 (0.00204 g); if they are g, 0.196 m/s^2; the mean of a1 is 0.999, which is gravity in g'
    """
    bare = [one for one in channels if not one.stated and one.topic in (ACCELERATION, GROUND)]
    rms = max(one.rms for one in bare)
    text = (
        f"no unit is stated of {', '.join(one.source for one in bare)}; taken as m/s^2 (see --unit): the RMS is then up to "
        f"{rms:.3g} m/s^2 ({rms / G_M_S2:.3g} g{', more than gravity' if rms > G_M_S2 else ''}); "
        f"if they are g, {rms * G_M_S2:.3g} m/s^2"
    )
    for one in bare:
        for name in _GRAVITY_UNITS:
            known = unit_of(name)
            assert known is not None
            if abs(abs(one.mean) * known.factor / G_M_S2 - 1.0) < GRAVITY_TOLERANCE:
                return f"{text}; the mean of {one.name} is {one.mean:.4g}, which is gravity in {name}"
    return text


def _doubts(rate_hz: float, taken: Sequence[ImportedChannel]) -> list[str]:
    """Say what is absurd of a rate and of levels, with the likely cause."""
    doubts = []
    if rate_hz < _RATES_HZ[0]:
        doubts.append(f"{rate_hz:.4g} Hz is too slow for vibrations: are the times in ms, or means over seconds?")
    if rate_hz > _RATES_HZ[1]:
        doubts.append(f"{rate_hz:.4g} Hz is too fast for a structure: are the times in another unit?")
    low, high = _LEVELS_M_S2
    for one in taken:
        if one.topic in (ACCELERATION, GROUND) and one.rms > 0.0 and not low < one.rms < high:
            size = "more than 100 g" if one.rms > high else "below any sensor's noise"
            doubts.append(
                f"{one.name}: an RMS of {one.rms:.3g} m/s^2 is {size}: is the unit {one.unit}, or are these counts or volts?"
            )
    return doubts


def _warn_of_missing(
    samples: Annotated[Array, "n c"], numbers: Annotated[Ticks, "n"], rate_hz: float, on_warning: OnWarning
) -> None:
    """Warn of `samples` that are not finite, and of jumps in their `numbers`."""
    if not np.isfinite(samples).all():
        on_warning(f"{np.count_nonzero(~np.isfinite(samples))} samples are missing or no finite numbers")
    gaps, lost = np.count_nonzero(np.diff(numbers) > 1), int(numbers[-1]) + 1 - len(numbers)
    if gaps:
        on_warning(f"{gaps} {'gap' if gaps == 1 else 'gaps'} between samples: {lost / rate_hz:.6g} s are missing")


def _write(out: Path, streams: Sequence[_Stream], rate: float, numbers: Annotated[Ticks, "n"], start_ns: int) -> None:
    """Write channels and samples of each topic in blocks of at most one second; a lost sample ends a block."""
    limit = max(1, round(rate))
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    with McapWriter(out) as writer:
        for run in np.split(np.arange(len(numbers)), breaks):
            for first in range(0, len(run), limit):
                rows = run[first : first + limit]
                number = int(numbers[rows[0]])
                t_ns = start_ns + round(number * 1e9 / rate)
                for stream in streams:
                    with np.errstate(over="ignore"):  # beyond float32: infinite, as the pipeline expects
                        block = stream.values[rows].astype(np.float32)
                    writer.write(
                        SampleBlock(stream.topic, t_ns, number, rate, tuple(stream.places), stream.unit, block)
                    )
