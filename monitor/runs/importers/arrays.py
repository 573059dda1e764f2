"""Common form of files that hold named arrays (NPZ, MAT, HDF5): which of them are readings, rate, time, names and unit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError
from monitor.runs.importers.table import TICKS, Array, OnWarning, Table, tick_in_name, units_in_names

AnyArray = NDArray[np.generic]
VALUE_BYTES = 8
"""Size of a reading in a table, whatever the type of the array. [bytes; definition: float64]"""
_RATE = ("rate_hz", "fs", "sample_rate_hz", "sample_rate", "samplerate")
_STEP = ("dt",)
_TIME = ("t", "time")
_RESERVED = {"samples", "channels", "unit", *_RATE, *_STEP}


def build_table(
    path: Path, kind: str, arrays: Mapping[str, AnyArray], on_warning: OnWarning, units: Mapping[str, str]
) -> Table:
    """Build a table of arrays.

    The readings are `samples` (n, channels), else all vectors and matrices of the same length n, which is that of the time, or
    the longest that there is; the longer side of a matrix is its time, and its columns get the names NAME_1, NAME_2 .. .
    Besides may stand `rate_hz`, `fs` or `dt`, `t` or `time` (s, or as the name says: `t_ms`), `channels` (names) and `unit`, in
    any case.

    The name of an array may be a path of groups with slashes; its unit is that which the file states.
    """
    try:
        return _build(path, arrays, on_warning, units)
    except (ValueError, TypeError, OverflowError) as error:
        raise BadInputError(f"{path}: cannot be used as {kind}: {error}") from error


def _build(path: Path, arrays: Mapping[str, AnyArray], on_warning: OnWarning, stated: Mapping[str, str]) -> Table:
    """Build a table of arrays; raise ValueError, TypeError or OverflowError if they do not fit each other."""
    told = {name.rpartition("/")[2].casefold(): array for name, array in arrays.items()}
    clock = next(
        (
            _vector(array) * 1e-9 * (tick_in_name(name)[1] or TICKS["s"])
            for name, array in told.items()
            if _is_time(name)
        ),
        None,
    )
    if "samples" in told:
        values = np.asarray(told["samples"], dtype=np.float64)
        values = values[:, None] if values.ndim == 1 else values
        columns = _names(told["channels"]) if "channels" in told else ()
        columns = columns or tuple(f"a{at + 1}" for at in range(values.shape[-1]))
        unit = next((u for name, u in stated.items() if name.rpartition("/")[2].casefold() == "samples"), "")
        column_units = (unit,) * len(columns)
        if values.ndim == 2 and values.shape[1] != len(columns) == values.shape[0]:
            values = values.T
    else:
        columns, column_units, values = _readings(arrays, None if clock is None else len(clock), stated, on_warning)
    if values.ndim != 2 or values.shape[1] != len(columns) or len(set(columns)) != len(columns):
        raise ValueError(f"samples of shape {values.shape} for channels {', '.join(columns)}")
    if clock is not None and (clock.shape != values.shape[:1] or not (np.abs(clock) < 4e9).all()):
        raise ValueError(f"times of shape {clock.shape} for {len(values)} samples")
    time_ns = None if clock is None else np.rint(clock * 1e9).astype(np.int64)
    whole = str(told["unit"].item()) if "unit" in told and told["unit"].size == 1 else ""
    return Table(
        path=path,
        columns=columns,
        units=tuple(unit or whole or named for unit, named in zip(column_units, units_in_names(columns), strict=True)),
        values=values,
        default=columns,
        time_ns=time_ns,
        start_ns=int(time_ns[0]) if time_ns is not None and len(time_ns) and time_ns[0] > 10**18 else None,
        rate_hz=_rate_hz(told),
    )


def _is_time(name: str) -> bool:
    """Test whether an array is that of the times, by its own name in lower case."""
    return tick_in_name(name)[0] in _TIME


def _rate_hz(told: Mapping[str, AnyArray]) -> float | None:
    """Return the stated rate, Hz; None if none is stated."""
    rate = next((_number(told[name]) for name in _RATE if name in told), None)
    step = next((_number(told[name]) for name in _STEP if name in told), None)
    return rate if rate is not None or not step else round(1.0 / step, 6)


def _number(array: AnyArray) -> float:
    """Return the only number of an array; raise ValueError if there are more."""
    return float(array.item())


def _names(array: AnyArray) -> tuple[str, ...]:
    return tuple(str(name) for name in np.atleast_1d(array).ravel())


def _vector(array: AnyArray) -> Array:
    """Return an array with one long side at most as a vector of numbers; raise ValueError for another."""
    if array.ndim != 1 and array.size != max(array.shape, default=0):
        raise ValueError(f"times of shape {array.shape}")
    return np.asarray(array, dtype=np.float64).ravel()


def _readings(
    arrays: Mapping[str, AnyArray], length: int | None, units: Mapping[str, str], on_warning: OnWarning
) -> tuple[tuple[str, ...], tuple[str, ...], Annotated[Array, "n columns"]]:
    """Return columns, their units and their readings of all arrays of the same length."""
    found: dict[str, Array] = {}
    for name, array in arrays.items():
        numbers = np.issubdtype(array.dtype, np.number) and not np.issubdtype(array.dtype, np.complexfloating)
        own = name.rpartition("/")[2].casefold()
        if not numbers or own in _RESERVED or _is_time(own) or array.ndim not in (1, 2) or array.size < 2:
            continue
        column = array[:, None] if array.ndim == 1 else array
        found[name] = np.asarray(column if column.shape[0] >= column.shape[1] else column.T, dtype=np.float64)
    if not found:
        raise ValueError(f"no array `samples` and no vector or matrix of numbers; it has {', '.join(arrays) or 'none'}")
    length = max(len(values) for values in found.values()) if length is None else length
    left_out = [f"{name} {arrays[name].shape}" for name, values in found.items() if len(values) != length]
    if left_out:
        on_warning(f"arrays of another length are left out: {', '.join(left_out)}")
    kept = {name: values for name, values in found.items() if len(values) == length}
    if not kept:
        raise ValueError(f"no array has the {length} samples that the times are for; {', '.join(left_out)}")
    columns = [
        (name if values.shape[1] == 1 else f"{name}_{k + 1}", units.get(name, ""))
        for name, values in kept.items()
        for k in range(values.shape[1])
    ]
    return tuple(name for name, _ in columns), tuple(unit for _, unit in columns), np.hstack(list(kept.values()))
