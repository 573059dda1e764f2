"""Reads NumPy archives; `arrays.build_table` says which arrays are readings."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from monitor.core import BadInputError
from monitor.runs.importers.arrays import VALUE_BYTES, AnyArray, build_table
from monitor.runs.importers.table import OnWarning, Table


def to_table(path: Path, raw: bytes, most_bytes: int, on_warning: OnWarning) -> Table:
    """Convert the arrays of an archive to a table of at most `most_bytes`; pickled objects are never loaded."""
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            arrays, held = dict[str, AnyArray](), 0
            for name in archive.files:
                array = archive[name]
                if not isinstance(array, np.ndarray):  # numpy hands over as bytes what has no header of an array
                    raise ValueError(f"{name!r} is no array")
                arrays[name] = array
                held += max(array.nbytes, VALUE_BYTES * array.size)
                if held > most_bytes:
                    raise ValueError(f"its arrays take more than {most_bytes >> 20} MiB; cut it into several files")
    except Exception as error:
        raise BadInputError(f"{path}: cannot be used as NPZ: {error}") from error
    return build_table(path, "NPZ", arrays, on_warning, {})
