"""Reads NumPy archives: `samples` (n, channels) or one array for each channel; `rate_hz`/`fs`, `channels`, `t`, `unit`."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError
from monitor.runs.importers.table import Table

_RATE = ("rate_hz", "fs", "sample_rate_hz")
_TIME = ("t", "time")
_VALUE_BYTES = 8
"""Size of a reading in a table, whatever the type of the array. [bytes; definition: float64]"""
_RESERVED = {"samples", "channels", "unit", *_RATE, *_TIME}


def to_table(path: Path, raw: bytes, most_bytes: int) -> Table:
    """Convert the arrays of an archive to a table of at most `most_bytes`; pickled objects are never loaded.

    Raises
    ------
    BadInputError
        If the archive is damaged, or its arrays do not fit each other.
    """
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            arrays, held = dict[str, NDArray[np.generic]](), 0
            for name in archive.files:
                arrays[name] = array = archive[name]
                held += max(array.nbytes, _VALUE_BYTES * array.size)
                if held > most_bytes:
                    raise ValueError(f"its arrays take more than {most_bytes >> 20} MiB; cut it into several files")
        return _build(path, arrays)
    except (OSError, ValueError, TypeError, KeyError, EOFError, MemoryError, NotImplementedError) as error:
        raise BadInputError(f"{path}: cannot be used as NPZ: {error}") from error
    except (zipfile.BadZipFile, zlib.error, RuntimeError, SyntaxError) as error:
        raise BadInputError(f"{path}: damaged NPZ: {error}") from error


def _build(path: Path, arrays: dict[str, NDArray[np.generic]]) -> Table:
    """Build a table of arrays; raise ValueError if they do not fit each other."""
    if "samples" in arrays:
        values = np.asarray(arrays["samples"], dtype=np.float64)
        values = values[:, None] if values.ndim == 1 else values
        columns = tuple(str(name) for name in np.atleast_1d(arrays["channels"])) if "channels" in arrays else ()
        columns = columns or tuple(f"a{at + 1}" for at in range(values.shape[-1]))
    else:
        columns = tuple(name for name in arrays if name not in _RESERVED and arrays[name].ndim == 1)
        if not columns:
            raise ValueError(f"no array `samples` and no 1-d arrays; it has {', '.join(arrays) or 'none'}")
        values = np.column_stack([np.asarray(arrays[name], dtype=np.float64) for name in columns])
    if values.ndim != 2 or values.shape[1] != len(columns) or len(set(columns)) != len(columns):
        raise ValueError(f"samples of shape {values.shape} for channels {', '.join(columns)}")
    rate = next((float(arrays[name].item()) for name in _RATE if name in arrays), None)
    clock = next((np.asarray(arrays[name], dtype=np.float64) for name in _TIME if name in arrays), None)
    if clock is not None and (clock.shape != values.shape[:1] or not (np.abs(clock) < 4e9).all()):
        raise ValueError(f"times of shape {clock.shape} for {len(values)} samples")
    time_ns = None if clock is None else np.rint(clock * 1e9).astype(np.int64)
    unit = str(arrays["unit"].item()) if "unit" in arrays else ""
    return Table(
        path=path,
        columns=columns,
        units=(unit,) * len(columns),
        values=values,
        default=columns,
        time_ns=time_ns,
        start_ns=int(time_ns[0]) if time_ns is not None and len(time_ns) and time_ns[0] > 10**18 else None,
        rate_hz=rate,
    )
