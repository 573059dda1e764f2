"""Reads MATLAB files up to version 7 (those of version 7.3 are HDF5); `arrays.build_table` says which variables are readings."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from monitor.core import BadInputError
from monitor.runs.importers.arrays import VALUE_BYTES, AnyArray, build_table
from monitor.runs.importers.table import OnWarning, Table

MAGIC = b"MATLAB 5.0 MAT-file"
_COMPRESSED = 15
"""Type of an element that holds another one, packed. [1; definition: MAT-file format, level 5]"""
_PIECE_BYTES = 1 << 20
"""Length of the pieces in which an element is unpacked and counted. [bytes; cost]"""
_NUMBERS = {"double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "logical"}
_WORDS = ("unit", "channels")
"""Variables that may hold words."""


def to_table(
    path: Path, raw: bytes, most_bytes: int, demand_room: Callable[[int], None], on_warning: OnWarning
) -> Table:
    """Convert the variables of a file to a table of at most `most_bytes`; structures, functions and objects are never read.

    Parameters
    ----------
    path : Path
        File, for messages.
    raw : bytes
        Its content.
    most_bytes : int
        Most that the file may unpack to.
    demand_room : callable
        Raises BadInputError for more bytes than that.
    on_warning : callable
        Shows a warning to the user.

    Raises
    ------
    BadInputError
        If the file is damaged, would unpack to too much, or its variables do not fit each other.
    """
    from scipy.io import loadmat, whosmat

    if raw.startswith(MAGIC):
        _count_unpacked(path, raw, demand_room)
    try:
        listed = [one for one in whosmat(io.BytesIO(raw)) if not one[0].startswith("__")]
        sizes = {name: int(np.prod(shape, dtype=object)) for name, shape, kind in listed if kind in _NUMBERS}
        demand_room(VALUE_BYTES * sum(sizes.values()))
        words = [name for name, _, kind in listed if kind in ("char", "cell") and name.casefold() in _WORDS]
        content = loadmat(io.BytesIO(raw), variable_names=[*sizes, *words]) if sizes else {}
        arrays = {name: _plain(np.asarray(content[name])) for name in (*sizes, *words) if name in content}
        if not arrays:
            held = ", ".join(f"{name} ({kind})" for name, _, kind in listed) or "nothing"
            raise ValueError(f"it holds no array of numbers but {held}; save the arrays as variables of their own")
        return build_table(path, arrays, on_warning)
    except BadInputError:
        raise
    except Exception as error:
        raise BadInputError(f"{path}: cannot be used as MAT: {error}") from error


def _plain(array: AnyArray) -> AnyArray:
    """Return an array, or the words of a cell array or of the rows of a character array."""
    if array.dtype == object:
        return np.array([str(np.asarray(item).ravel()[0]) if np.size(item) else "" for item in array.ravel()])
    return np.array([str(word).strip() for word in array.ravel()]) if array.dtype.kind == "U" else array


def _count_unpacked(path: Path, raw: bytes, demand_room: Callable[[int], None]) -> None:
    """Unpack the elements piece by piece without keeping them, and raise BadInputError if they are too much or damaged."""
    order = "<" if raw[126:128] == b"IM" else ">"
    at, counted = 128, 0
    while at + 8 <= len(raw):
        kind, size = struct.unpack_from(order + "II", raw, at)
        if kind == _COMPRESSED:
            unpack, data = zlib.decompressobj(), raw[at + 8 : at + 8 + size]
            try:
                while data and not unpack.eof:
                    counted += len(unpack.decompress(data, _PIECE_BYTES))
                    data = unpack.unconsumed_tail
                    demand_room(counted)
            except zlib.error as error:
                raise BadInputError(f"{path}: damaged MAT file: {error}") from error
        at += 8 + size
