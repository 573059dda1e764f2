"""Common form of files that hold named arrays (NPZ, MAT, HDF5): which of them are readings, rate, time, names and unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError
from monitor.runs.readers.table import Array, OnWarning, Table, Ticks
from monitor.runs.readers.units import ACCELERATION, TIME, split_name, unit_of, units_in_names

AnyArray = NDArray[np.generic]
VALUE_BYTES = 8
"""Size of a reading in a table, whatever the type of the array. [bytes; definition: float64]"""
_RATE = ("rate_hz", "fs", "sample_rate_hz", "sample_rate", "samplerate")
_STEP = ("dt",)
_TIME = ("t", "time")
_UNIT = ("unit", "units")
WORDS = ("channels", *_UNIT)
"""Arrays that may hold words."""
_RESERVED = {"samples", *WORDS, *_RATE, *_STEP}


def as_doubles(array: AnyArray) -> AnyArray:
    """Return numbers of floating point as float64, without numpy's warning of a damaged NaN, and others as they are."""
    if array.dtype.kind != "f":
        return array
    with np.errstate(invalid="ignore", over="ignore"):
        return array.astype(np.float64)


def build_table(
    path: Path, kind: str, arrays: Mapping[str, AnyArray], on_warning: OnWarning, units: Mapping[str, str]
) -> Table:
    """Build a table of arrays.

    The readings are `samples` (n, channels), else all vectors and matrices of the same length n, which is that of the time, or
    the longest that there is; the longer side of a matrix is its time, and its columns get the names NAME_1, NAME_2 .. .
    Besides may stand `rate_hz`, `fs` or `dt`, `t` or `time` (s, or as the name says: `t_ms`), `channels` (names) and `unit`
    or `units` (one for all, or one a column), in any case.

    The name of an array may be a path of groups with slashes; its unit is that which the file states.
    """
    told = {_own(name): array for name, array in arrays.items()}
    try:
        columns, stated, values, clock = _readings(path, arrays, told, on_warning, units)
        rate_hz = _rate_hz(told)
    except (ValueError, TypeError, OverflowError) as error:
        raise BadInputError(f"{path}: cannot be used as {kind}: {error}") from error
    named = units_in_names(columns)
    besides = _units(told, len(columns))
    found = tuple(one or beside or behind for one, beside, behind in zip(stated, besides, named, strict=True))
    time_ns, start_ns = (None, None) if clock is None else _times(clock)
    table = Table(
        path=path,
        columns=columns,
        units=found,
        by_name=tuple(bool(behind) and unit == behind for unit, behind in zip(found, named, strict=True)),
        values=values,
        time_ns=time_ns,
        start_ns=start_ns,
        rate_hz=rate_hz,
    )
    chosen = tuple(name for name in columns if not table.unit(name) or table.quantity(name) == ACCELERATION)
    return replace(table, chosen=chosen)


def _readings(
    path: Path,
    arrays: Mapping[str, AnyArray],
    told: Mapping[str, AnyArray],
    on_warning: OnWarning,
    units: Mapping[str, str],
) -> tuple[tuple[str, ...], tuple[str, ...], Annotated[Array, "n columns"], Annotated[Array, "n"] | None]:
    """Return columns, their stated units, their readings, and the times in s; ValueError if they do not fit each other."""
    clock = next((_vector(array) * tick for name, array in told.items() if (tick := _tick_s(name))), None)
    if "samples" in told:
        columns, values = _samples(told)
        if others := ", ".join(name for name, array in arrays.items() if _holds_readings(_own(name), array)):
            on_warning(f"{path}: arrays besides `samples` are left out: {others}")
        stated = (next((unit for name, unit in units.items() if _own(name) == "samples"), ""),) * len(columns)
    else:
        columns, stated, values = _of_one_length(arrays, clock, units, path, on_warning)
    if values.ndim != 2 or values.shape[1] != len(columns) or len(set(columns)) != len(columns):
        raise ValueError(f"samples of shape {values.shape} for channels {', '.join(columns)}")
    if clock is not None and (clock.shape != values.shape[:1] or not (np.abs(clock) < 4e9).all()):
        raise ValueError(f"times of shape {clock.shape} for {len(values)} samples")
    return columns, stated, values, clock


def _times(clock: Annotated[Array, "n"]) -> tuple[Annotated[Ticks, "n"], int | None]:
    """Return times in ns, and the first of them where it is a date."""
    time_ns = np.rint(clock * 1e9).astype(np.int64)
    return time_ns, int(time_ns[0]) if (time_ns[:1] > 10**18).any() else None


def _own(name: str) -> str:
    """Return the name of an array without its groups, in lower case."""
    return name.rpartition("/")[2].casefold()


def _tick_s(name: str) -> float:
    """Return the unit of the times that an array holds by its own name, s; 0 where it holds no times."""
    if name in _TIME:
        return 1.0
    unit = unit_of(split_name(name)[1])
    is_time = unit is not None and unit.quantity == TIME and re.sub(r"[\s_.-]+(in[\s_]+)?[a-zµμ]+$", "", name) in _TIME
    return unit.factor if unit is not None and is_time else 0.0


def _samples(told: Mapping[str, AnyArray]) -> tuple[tuple[str, ...], Annotated[Array, "n columns"]]:
    """Return the names and readings of `samples`, whose other side is the time where the channels' number says so."""
    values = np.asarray(told["samples"], dtype=np.float64)
    values = values[:, None] if values.ndim == 1 else values
    columns = tuple(str(name) for name in np.atleast_1d(told.get("channels", np.empty(0))).ravel())
    columns = columns or tuple(f"a{at + 1}" for at in range(values.shape[-1]))
    turned = values.ndim == 2 and values.shape[1] != len(columns) == values.shape[0]
    return columns, values.T if turned else values


def _units(told: Mapping[str, AnyArray], count: int) -> list[str]:
    """Return the units of columns that stand in an array beside them; empty where none does, or of another number of columns."""
    words = next((list(map(str, told[name].ravel())) for name in _UNIT if name in told), [])
    return words if len(words) == count else (words if len(words) == 1 else [""]) * count


def _rate_hz(told: Mapping[str, AnyArray]) -> float | None:
    """Return the stated rate, Hz; None if none is stated."""
    rate = next((_number(told[name]) for name in _RATE if name in told), None)
    step = next((_number(told[name]) for name in _STEP if name in told), None)
    return rate if rate is not None or not step else round(1.0 / step, 6)


def _number(array: AnyArray) -> float:
    """Return the only number of an array; raise ValueError if there are more."""
    return float(array.item())


def _vector(array: AnyArray) -> Array:
    """Return an array with one long side at most as a vector of numbers; raise ValueError for another."""
    if array.ndim != 1 and array.size != max(array.shape, default=0):
        raise ValueError(f"times of shape {array.shape}")
    return np.asarray(array, dtype=np.float64).ravel()


def _of_one_length(
    arrays: Mapping[str, AnyArray], clock: Array | None, units: Mapping[str, str], path: Path, on_warning: OnWarning
) -> tuple[tuple[str, ...], tuple[str, ...], Annotated[Array, "n columns"]]:
    """Return columns, their units and their readings of all arrays of the same length."""
    found = {name: _along_time(array) for name, array in arrays.items() if _holds_readings(_own(name), array)}
    if not found:
        raise ValueError(f"no array `samples` and no vector or matrix of numbers; it has {', '.join(arrays) or 'none'}")
    length = max(map(len, found.values())) if clock is None else len(clock)
    kept = {name: values for name, values in found.items() if len(values) == length}
    left_out = ", ".join(f"{name} {arrays[name].shape}" for name in found if name not in kept)
    if not kept:
        raise ValueError(f"no array has the {length} samples that the times are for; {left_out}")
    if left_out:
        on_warning(f"{path}: arrays of another length are left out: {left_out}")
    columns = {
        name if values.shape[1] == 1 else f"{name}_{k + 1}": units.get(name, "")
        for name, values in kept.items()
        for k in range(values.shape[1])
    }
    return tuple(columns), tuple(columns.values()), np.hstack(list(kept.values()))


def _holds_readings(name: str, array: AnyArray) -> bool:
    """Test whether an array is a vector or matrix of real numbers that its own name makes no time, rate or the like."""
    is_real = np.issubdtype(array.dtype, np.number) and not np.issubdtype(array.dtype, np.complexfloating)
    return is_real and name not in _RESERVED and not _tick_s(name) and array.ndim in (1, 2) and array.size > 1


def _along_time(array: AnyArray) -> Annotated[Array, "n columns"]:
    """Return a vector or matrix with its longer side as time."""
    columns = array[:, None] if array.ndim == 1 else array
    return np.asarray(columns if columns.shape[0] >= columns.shape[1] else columns.T, dtype=np.float64)
