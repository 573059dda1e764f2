"""Imports foreign data: CSV of any dialect, Xsens DOT, zipped CSV, NPZ, MAT, HDF5, UFF, MiniSEED, K-NET, CAN logs."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from drivers.base import ACCELERATION, FORCE, GROUND, ROTATION_RATE, UNIT_OF, RecordingError, SampleBlock
from drivers.mcap_file import McapWriter, RecordingInfo, recording_info
from drivers.mcap_records import MAGIC
from monitor.core import BadInputError, MissingInputError, OnProgress, Step, WrongUsageError
from monitor.runs.importers import can_log, clocks, csv_table, hdf5, mat, npz, own_process, seismic, uff, xsens_dot
from monitor.runs.importers.table import (
    UNITS,
    Array,
    OnWarning,
    Table,
    Ticks,
    meant_instead,
    sample_numbers,
    unit_factor,
    units_in_names,
)

__all__ = ["ImportedChannel", "acceleration_unit", "doubt_unit", "import_files"]
GRAVITY_TOLERANCE = 0.03
"""Distance of a mean from 1, relative, within which it may be gravity. [1; judgement: a sensor's offset and its tilt]"""
_GRAVITY_UNITS = ("m/s^2", "g", "mg", "gal")
"""Units of which a constant part of the size of gravity tells. [names; as of --unit]"""
_UNPACKED_BYTES = 1 << 28
"""Most that any archive may unpack to, however small it is. [bytes; as a chunk of an MCAP file, `drivers.mcap_records`]"""
_UNPACKED_RATIO = 16
"""Most that a larger archive may unpack to, over its own size. [ratio; judgement: digits pack to a half or a fifth]"""
_MOST_UNPACKED_BYTES = 1 << 31
"""Most that an archive of any size may unpack to. [bytes; judgement]"""
_LINE_BYTES = 57
"""Memory that a line of text takes besides its characters, which counts as unpacked. [bytes; measured: CPython 3.11]"""
_PIECE_BYTES = 1 << 20
"""Length of the pieces in which an archive is unpacked and counted. [bytes; cost]"""


def acceleration_unit(text: str) -> bool:
    """Return whether a text is a unit of acceleration."""
    return unit_factor(text) is not None


@dataclass(frozen=True, slots=True)
class ImportedChannel:
    """What was taken for a channel."""

    topic: str
    name: str
    source: str
    """As FILE:COLUMN."""
    unit: str
    """Of the column."""
    stated: bool
    """Whether the file states the unit."""
    by_name: bool
    """Whether it does so in the column's name."""
    mean: float
    """Mean of the finite readings, in the unit of the topic."""
    rms: float
    """About their mean, in the unit of the topic."""


def import_files(
    files: list[Path],
    out: Path,
    *,
    rate_hz: float | None = None,
    unit: str | None = None,
    channels: dict[str, str] | None = None,
    ground: str | None = None,
    forces: dict[str, str] | None = None,
    start_ns: int | None = None,
    unknown_start_ns: int | None = None,
    dbc: Path | None = None,
    bus: str | None = None,
    scale: float | None = None,
    inventory: Path | None = None,
    align: bool = False,
    ask_unit: Callable[[Sequence[str]], str] | None = None,
    on_warning: OnWarning = lambda _: None,
    on_channel: Callable[[ImportedChannel], None] = lambda _: None,
    on_progress: OnProgress = lambda _: None,
    unpacked_bytes: int = _UNPACKED_BYTES,
    reader_s: float = own_process.LEAST_S,
) -> RecordingInfo:
    """Write the readings of `files`, sampled at the same time, as one recording, and return the content of the recording.

    Parameters
    ----------
    rate_hz
        Sample rate.  Required if no file states it; overrides the rate of a time column.
    unit
        Unit of columns whose header states none, and of no other: m/s^2, g, mg, gal.  Without it `ask_unit` is asked for it,
        else m/s^2 is taken with a warning.
    channels
        Channel name -> "FILE" or "FILE:COLUMN", with FILE by name or stem.  By default the channels are the columns of a
        single file, or the stems of several files.  Columns with a unit of a rate of rotation go to the topic
        ``/rotation_rate``.
    ground
        "FILE" or "FILE:COLUMN" of the base motion.
    forces
        Name of a measured force -> "FILE" or "FILE:COLUMN".
    start_ns
        UTC of the first sample, ns since 1970; by default the time stated in a file.
    unknown_start_ns
        The same where no file states a time; by default 1970, with a warning.
    dbc
        DBC file that describes the frames of CAN logs.
    bus
        Bus of a CAN log of several, as the log names it.
    scale
        m/s^2 of a count of MiniSEED; other files beside it are not scaled.
    inventory
        StationXML with the sensitivities of MiniSEED; other files beside it are not scaled.
    align
        Shift the clocks of the files so that their readings fit each other (`clocks.align`).
    ask_unit
        Asks the user for the unit of columns, given as "FILE:COLUMN".
    on_channel
        Told of each channel that was written; not of those of a CAN log.
    unpacked_bytes
        Most that any archive may unpack to, however small it is.
    reader_s
        Longest time in which a small file is read by a process of its own (HDF5, MAT, MiniSEED, K-NET).

    Raises
    ------
    BadInputError
        If the data cannot be used.
    MissingInputError
        If a file cannot be read, or `out` cannot be written.
    WrongUsageError
        If `unit` is no unit of acceleration.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table = Path(folder, "a.csv")
    ...     _ = table.write_text("t,a1 [g]\\n0.00,0.1\\n0.01,0.2\\n0.02,0.1\\n")
    ...     info = import_files([table], Path(folder, "a.mcap"), start_ns=0)
    >>> info.sample_rate_hz, info.channels["/acceleration"]
    (100.0, ('a1',))
    """
    if rate_hz is not None and not (np.isfinite(rate_hz) and rate_hz > 0):
        raise BadInputError(f"--rate {rate_hz}: must be a positive number of Hz")
    if unit is not None and unit_factor(unit) is None:
        raise WrongUsageError(f"--unit {unit!r}: known for acceleration: {', '.join(UNITS)}")
    if scale is not None and not (np.isfinite(scale) and scale != 0.0):
        raise BadInputError(f"--scale {scale}: must be a number of m/s^2 a count, not 0")
    try:
        if any(map(can_log.is_log, files)):
            if align:
                raise BadInputError(
                    f"{files[0]}: --align is for several files with clocks of their own; this is a CAN log"
                )
            can_log.check_options(files, dbc, channels or forces, ground, start_ns)
            assert dbc is not None
            return can_log.import_log(files[0], out, dbc=dbc, rate_hz=rate_hz, bus=bus, on_warning=on_warning)
        if bus is not None:
            raise BadInputError(f"--bus {bus} is for CAN logs; {files[0]} is none by its name")
        if dbc is not None:
            raise BadInputError(f"{dbc}: --dbc is for CAN logs; {files[0]} is none by its name")
        tables, counts = [], False
        for number, path in enumerate(files):
            on_progress(Step(f"reads {path.name}", number, len(files), "files", then="writes the recording"))
            raw = _read(path)
            counts = counts or seismic.holds_counts(raw)
            most = _most_unpacked(raw, unpacked_bytes)
            tables.append(_to_table(path, raw, most, on_warning, scale, inventory, reader_s))
        if (scale is not None or inventory is not None) and not counts:
            raise BadInputError(
                f"{', '.join(map(str, files))}: --scale and --inventory are for MiniSEED, and none is here; "
                "K-NET states its own scale, and --unit is for the others"
            )
        if align:
            leading = {name: _find_column(tables, place) for name, place in (channels or {}).items()}
            moving = [(table, column) for table, column in leading.values() if not table.turns(column)]
            tables = clocks.align(tables, moving, on_warning)
        tables, clock = clocks.join(tables, on_warning)
        pushed = {name: _find_column(tables, reference) for name, reference in (forces or {}).items()}
        chosen, base = _choose_columns(tables, channels, ground, list(pushed.values()))
        turning = {name: pair for name, pair in chosen.items() if pair[0].turns(pair[1])}
        chosen = {name: pair for name, pair in chosen.items() if name not in turning}
        if not chosen:
            raise BadInputError(
                f"{files[0]}: only rates of rotation are chosen; name a column of acceleration too, with --channel"
            )
        rate, numbers = _timing(tables, clock, rate_hz, on_warning)
        start_ns = _start_ns(tables, unknown_start_ns, on_warning) if start_ns is None else start_ns
        # The time of the last sample must fit 64-bit nanoseconds, which a damaged counter violates.
        if not 1e-3 <= rate <= 1e7 or start_ns + numbers[-1] * 1e9 / rate > 4e18:
            raise BadInputError(f"{files[0]}: {rate} Hz and {numbers[-1]} samples in all are absurd")
        bare = _without_unit(chosen, base)
        if unit is not None and not bare:
            on_warning(
                f"--unit {unit} is not used: the files state the unit of every column, or --scale and --inventory do"
            )
        is_taken = bool(bare) and unit is None and ask_unit is None
        unit = unit or (ask_unit(bare) if bare and ask_unit is not None else "m/s^2")
        samples = np.column_stack([table.acceleration(column, unit) for table, column in chosen.values()])
        _warn_of_missing(samples, numbers, rate, on_warning)
        streams = {ACCELERATION: (tuple(chosen), samples)}
        if base is not None:
            streams[GROUND] = (("ground",), base[0].acceleration(base[1], unit)[:, None])
        if pushed:
            streams[FORCE] = (
                tuple(pushed),
                np.column_stack([table.force(column) for table, column in pushed.values()]),
            )
        if turning:
            streams[ROTATION_RATE] = (
                tuple(turning),
                np.column_stack([table.rotation_rate(column) for table, column in turning.values()]),
            )
        on_progress(Step("writes the recording"))
        _write(out, streams, rate, numbers, start_ns)
        grounds = {} if base is None else {"ground": base}
        topics = ((ACCELERATION, chosen), (GROUND, grounds), (FORCE, pushed), (ROTATION_RATE, turning))
        taken = [
            _channel(topic, name, column, streams[topic][1][:, at], unit)
            for topic, columns_of in topics
            for at, (name, column) in enumerate(columns_of.items())
        ]
        for one in taken:
            on_channel(one)
        if is_taken:
            on_warning(doubt_unit(taken))
        return recording_info(out)
    except OSError as error:
        raise MissingInputError(f"{out}: cannot be written: {error.strerror or error}") from error
    except RecordingError as error:
        raise BadInputError(str(error)) from error


def _channel(topic: str, name: str, place: _Column, readings: Array, unit: str) -> ImportedChannel:
    """Form what is told of a channel; `unit` is that of a column of acceleration whose file states none."""
    table, column = place
    stated = table.unit(column)
    finite = readings[np.isfinite(readings)]
    with np.errstate(over="ignore", invalid="ignore"):
        level = (float(finite.mean()), float(finite.std())) if len(finite) else (0.0, 0.0)
    mean, rms = (value if np.isfinite(value) else 0.0 for value in level)
    taken = stated or ("N" if topic == FORCE else unit)
    by_name = bool(stated) and units_in_names([column]) == [stated]
    return ImportedChannel(topic, name, f"{table.path.name}:{column}", taken, bool(stated), by_name, mean, rms)


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
        f"{rms:.3g} m/s^2 ({rms / UNITS['g']:.3g} g{', more than gravity' if rms > UNITS['g'] else ''}); "
        f"if they are g, {rms * UNITS['g']:.3g} m/s^2"
    )
    for one in bare:
        shown = next(
            (u for u in _GRAVITY_UNITS if abs(abs(one.mean) * UNITS[u] / UNITS["g"] - 1.0) < GRAVITY_TOLERANCE), None
        )
        if shown is not None:
            return f"{text}; the mean of {one.name} is {one.mean:.4g}, which is gravity in {shown}"
    return text


def _without_unit(chosen: dict[str, _Column], base: _Column | None) -> list[str]:
    """List the columns whose file states no unit."""
    columns = [*chosen.values(), *([] if base is None else [base])]
    return [f"{table.path.name}:{column}" for table, column in columns if not table.unit(column)]


def _warn_of_missing(
    samples: Annotated[Array, "n c"], numbers: Annotated[Ticks, "n"], rate_hz: float, on_warning: OnWarning
) -> None:
    """Warn of `samples` that are not finite, and of jumps in their `numbers`."""
    if not np.isfinite(samples).all():
        on_warning(f"{np.count_nonzero(~np.isfinite(samples))} samples are missing or no finite numbers")
    gaps, lost = np.count_nonzero(np.diff(numbers) > 1), int(numbers[-1]) + 1 - len(numbers)
    if gaps:
        on_warning(f"{gaps} {'gap' if gaps == 1 else 'gaps'} between samples: {lost / rate_hz:.6g} s are missing")


def _read(path: Path) -> bytes:
    """Read a file; raise MissingInputError if it cannot be read."""
    try:
        if not path.is_file():
            raise MissingInputError(f"{path}: {'is no file' if path.exists() else 'does not exist'}")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise MissingInputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _to_table(
    path: Path,
    raw: bytes,
    most: int,
    on_warning: OnWarning,
    scale: float | None,
    inventory: Path | None,
    reader_s: float,
) -> Table:
    """Detect the format of a file by its content, and convert it to a table."""
    if raw.startswith(b"LOGG"):
        raise BadInputError(f"{path}: is a CAN log; name it with the suffix .blf")
    if raw.startswith(MAGIC):
        raise BadInputError(f"{path}: is an MCAP recording already; use it as it is")
    if seismic.is_seismic(raw):
        return _require_samples(seismic.to_table(path, raw, most, scale, inventory, on_warning, reader_s))
    demand_room = partial(_demand_room, path, most=most)
    if hdf5.is_hdf5(raw):
        return _require_samples(hdf5.to_table(path, most, on_warning, reader_s))
    if raw.startswith(mat.MAGIC) or path.suffix.casefold() == ".mat":
        return _require_samples(mat.to_table(path, most, on_warning, reader_s))
    if uff.is_uff(raw):
        demand_room(len(raw) + _LINE_BYTES * raw.count(b"\n"))
        return _require_samples(uff.to_table(path, raw, on_warning))
    if raw.startswith(b"PK\x03\x04"):
        members = _zip_members(path, raw, most)
        if all(name.endswith(".npy") for name in members):
            return _require_samples(npz.to_table(path, raw, most, on_warning))
        raw = _unzip(path, raw, members, most)
    cells = csv_table.cut_into_cells(path, csv_table.decode_text(path, raw), on_warning)
    dialect = xsens_dot if xsens_dot.is_xsens(cells) else csv_table
    return _require_samples(dialect.to_table(cells, on_warning))


def _require_samples(table: Table) -> Table:
    """Return the table if it has at least two samples; raise BadInputError otherwise."""
    if len(table.values) < 2:
        raise BadInputError(f"{table.path}: {len(table.values)} samples are too few")
    return table


def _zip_members(path: Path, raw: bytes, most: int) -> list[str]:
    """List the names of the files in a zip archive; raise BadInputError if it is damaged or states too much to unpack."""
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise BadInputError(f"{path}: damaged zip archive: {error}") from error
    # zipfile unpacks no more of a member than the archive states, whatever is packed.
    _demand_room(path, sum(member.file_size for member in members), most)
    return [member.filename for member in members if not member.filename.endswith("/")]


def _unzip(path: Path, raw: bytes, members: list[str], most: int) -> bytes:
    """Unpack the only table of a zip archive."""
    tables = [name for name in members if ".csv" in name.lower()] or members
    if len(tables) != 1:
        raise BadInputError(f"{path}: holds {len(tables)} tables; unpack it and name one: {', '.join(tables)}")
    data, counted = bytearray(), 0
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive, archive.open(tables[0]) as member:
            while piece := member.read(_PIECE_BYTES):
                data += piece
                counted += len(piece) + _LINE_BYTES * piece.count(b"\n")
                _demand_room(path, counted, most)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        raise BadInputError(f"{path}: damaged or encrypted zip archive: {error}") from error
    return bytes(data)


def _most_unpacked(raw: bytes, least: int) -> int:
    """Return what an archive may unpack to, bytes."""
    return min(_MOST_UNPACKED_BYTES, max(least, _UNPACKED_RATIO * len(raw)))


def _demand_room(path: Path, size: int, most: int) -> None:
    """Raise BadInputError if an archive unpacks to more bytes than it may."""
    if size > most:
        raise BadInputError(
            f"{path}: would unpack to {size >> 20} MiB or more; at most {most >> 20} MiB are read: cut it into several files, or "
            "unpack it and import what it holds"
        )


_Column = tuple[Table, str]


def _choose_columns(
    tables: list[Table], channels: dict[str, str] | None, ground: str | None, forces: list[_Column]
) -> tuple[dict[str, _Column], _Column | None]:
    """Choose the column of each channel, by the channel's name, and the column of the base motion; no force is a channel."""
    base = _find_column(tables, ground) if ground else None
    if channels:
        return {name: _find_column(tables, reference) for name, reference in channels.items()}, base
    rest = [(table, column) for table in tables for column in table.default]
    if len(tables) == 1:
        rest += [(tables[0], c) for c in tables[0].columns if c not in tables[0].default and tables[0].turns(c)]
    inputs = forces if base is None else [base, *forces]
    rest = [pair for pair in rest if pair not in inputs]
    if len(tables) > 1:
        rest = [pair for pair in rest if all(pair[0] is not table for table, _ in inputs)]
    names = [column if len(tables) == 1 else table.names[0] for table, column in rest]
    if len(set(names)) != len(names):
        raise BadInputError(
            f"several columns would be channel {max(names, key=names.count)!r}; name each: --channel NAME=FILE:COLUMN"
        )
    if not rest:
        raise BadInputError(f"{tables[0].path}: no column is left for the floors besides the ground")
    return dict(zip(names, rest, strict=True)), base


def _find_column(tables: list[Table], reference: str) -> _Column:
    """Find the column that "FILE", "FILE:COLUMN" or, with a single file, "COLUMN" denotes."""
    exact = [(table, None) for table in tables if reference in table.names]
    parts = [
        (table, reference[len(name) + 1 :])
        for table in tables
        for name in dict.fromkeys(table.names)
        if reference.startswith(name + ":")
    ]
    found = exact or parts[:1]
    if not found and len(tables) == 1 and reference in tables[0].columns:
        return tables[0], reference
    if len(found) != 1:
        what = "names several files" if found else "names no file"
        files_text = ", ".join(f"{table.path} ({', '.join(table.columns)})" for table in tables)
        meant = "" if found else meant_instead(reference, [name for table in tables for name in _references(table)])
        raise BadInputError(
            f"{reference!r} {what}{meant}; the files, with their columns, are {files_text}; "
            f"write FILE:COLUMN, as {tables[0].names[0]}:{tables[0].columns[0]}"
        )
    table, column = found[0]
    if column is None:
        if len(table.default) != 1:
            raise BadInputError(f"{table.path}: name a column: {', '.join(table.columns)}")
        column = table.default[0]
    return table, column


def _references(table: Table) -> list[str]:
    """List what may denote a file or a column of it."""
    return [*table.names, *table.columns, *(f"{name}:{column}" for name in table.names for column in table.columns)]


def _timing(
    tables: list[Table], clock: Ticks | None, rate_hz: float | None, on_warning: OnWarning
) -> tuple[float, Ticks]:
    """Return the sample rate in Hz and the number of every sample, shape (n,)."""
    count = len(tables[0].values)
    stated = rate_hz or next((table.rate_hz for table in tables if table.rate_hz), None)
    if clock is None:
        if stated is None:
            raise BadInputError(f"{tables[0].path}: no time column tells the rate; give --rate HZ")
        return stated, np.arange(count)
    try:
        rate, numbers = sample_numbers(tables[0].path, clock)
    except BadInputError:
        if stated is None:
            raise
        on_warning(f"{tables[0].path}: the time column is irregular and not used; samples run at {stated} Hz")
        return stated, np.arange(count)
    counter = tables[0].index
    if counter is not None:
        if np.diff(counter).min() < 1:
            raise BadInputError(f"{tables[0].path}: the packet counter does not rise; export it again")
        numbers = counter - counter[0]
    if stated is not None and abs(stated / rate - 1) > 0.01:
        on_warning(f"{tables[0].path}: the time column says {rate} Hz; {stated} Hz is used")
    return stated or rate, numbers


def _start_ns(tables: list[Table], unknown_ns: int | None, on_warning: OnWarning) -> int:
    """Return the time of the first sample as the files state it, UTC in ns since 1970; `unknown_ns`, or 0, where no file does."""
    for table in tables:
        if table.start_ns is not None and table.start_ns >= 0:
            if table.start_text:
                on_warning(f"{table.path}: its time {table.start_text} has no zone; taken as UTC (see --start)")
            return table.start_ns
    if unknown_ns is None:
        on_warning("no file tells when it was recorded; the recording begins in 1970 (see --start)")
    return unknown_ns or 0


def _write(
    out: Path,
    streams: dict[str, tuple[tuple[str, ...], Annotated[Array, "n c"]]],
    rate: float,
    numbers: Ticks,
    start_ns: int,
) -> None:
    """Write channels and samples of each topic in blocks of at most one second; a lost sample ends a block."""
    limit = max(1, round(rate))
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    with McapWriter(out) as writer:
        for run in np.split(np.arange(len(numbers)), breaks):
            for first in range(0, len(run), limit):
                rows = run[first : first + limit]
                number = int(numbers[rows[0]])
                t_ns = start_ns + round(number * 1e9 / rate)
                for topic, (channels, values) in streams.items():
                    with np.errstate(over="ignore"):  # beyond float32: infinite, as the pipeline expects
                        block = values[rows].astype(np.float32)
                    writer.write(SampleBlock(topic, t_ns, number, rate, channels, UNIT_OF[topic], block))
