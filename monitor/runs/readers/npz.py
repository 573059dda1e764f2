"""Reads NumPy archives; `arrays.build_table` says which arrays are readings."""

from __future__ import annotations

import io

import numpy as np

from monitor.core import BadInputError
from monitor.runs.readers.arrays import VALUE_BYTES, AnyArray, as_doubles, build_table
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import demand_room
from monitor.runs.readers.table import Table


def read_tables(file: File) -> list[Table]:
    """Convert the arrays of an archive; pickled objects are never loaded.

    Raises BadInputError if the archive is damaged, or its arrays do not fit each other.
    """
    try:
        with np.load(io.BytesIO(file.raw), allow_pickle=False) as archive:
            arrays, held = dict[str, AnyArray](), 0
            for name in archive.files:
                array = archive[name]
                if not isinstance(array, np.ndarray):  # numpy hands over as bytes what has no header of an array
                    raise ValueError(f"{name!r} is no array")
                arrays[name] = as_doubles(array)
                held += max(array.nbytes, VALUE_BYTES * array.size)
                demand_room(held, file.most_bytes)
    except Exception as error:
        raise BadInputError(f"{file.path}: cannot be used as NPZ: {error}") from error
    return [build_table(file.path, "NPZ", arrays, file.on_warning, {})]
