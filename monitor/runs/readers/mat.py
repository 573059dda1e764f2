"""Reads MATLAB files up to version 7 (those of version 7.3 are HDF5); `arrays.build_table` says which variables are readings."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np

from monitor.runs.readers.arrays import VALUE_BYTES, WORDS, AnyArray, build_table
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import demand_room
from monitor.runs.readers.table import Table

MAGIC = b"MATLAB 5.0 MAT-file"
_COMPRESSED = 15
"""Type of an element that holds another one, packed. [1; definition: MAT-file format, level 5]"""
_PIECE_BYTES = 1 << 20
"""Length of the pieces in which an element is unpacked and counted. [bytes; cost]"""
_NUMBERS = {"double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "logical"}


class Mat:
    """MATLAB files up to version 7."""

    name = "MAT"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format, by its suffix too, since version 4 has no mark."""
        return file.raw.startswith(MAGIC) or file.suffix == ".mat"

    def read(self, file: File) -> list[Table]:
        """Convert the variables; structures, functions and objects are never read."""
        arrays, units = file.read_apart(__name__, self.name)
        return [build_table(file.path, self.name, arrays, file.on_warning, units)]


def read(path: Path, most_bytes: int) -> tuple[dict[str, AnyArray], dict[str, str]]:
    """Read the arrays of a file; raise ValueError if they would take more than `most_bytes`, or if there are none."""
    from scipy.io import loadmat, whosmat

    raw = path.read_bytes()
    if raw.startswith(MAGIC):
        _count_unpacked(raw, most_bytes)
    listed = [one for one in whosmat(io.BytesIO(raw)) if not one[0].startswith("__")]
    sizes = {name: int(np.prod(shape, dtype=object)) for name, shape, kind in listed if kind in _NUMBERS}
    demand_room(VALUE_BYTES * sum(sizes.values()), most_bytes)
    words = [name for name, _, kind in listed if kind in ("char", "cell") and name.casefold() in WORDS]
    content = loadmat(io.BytesIO(raw), variable_names=[*sizes, *words]) if sizes else {}
    arrays = {name: _plain(np.asarray(content[name])) for name in (*sizes, *words) if name in content}
    if not arrays:
        held = ", ".join(f"{name} ({kind})" for name, _, kind in listed) or "nothing"
        raise ValueError(f"it holds no array of numbers but {held}; save the arrays as variables of their own")
    return arrays, {}


def _plain(array: AnyArray) -> AnyArray:
    """Return an array, or the words of a cell array or of the rows of a character array."""
    if array.dtype == object:
        return np.array([str(np.asarray(item).ravel()[0]) if np.size(item) else "" for item in array.ravel()])
    return np.array([str(word).strip() for word in array.ravel()]) if array.dtype.kind == "U" else array


def _count_unpacked(raw: bytes, most_bytes: int) -> None:
    """Unpack the elements piece by piece without keeping them, and raise ValueError if they are too much."""
    order = "<" if raw[126:128] == b"IM" else ">"
    at, counted = 128, 0
    while at + 8 <= len(raw):
        kind, size = struct.unpack_from(order + "II", raw, at)
        if kind == _COMPRESSED:
            unpack, data = zlib.decompressobj(), raw[at + 8 : at + 8 + size]
            while data and not unpack.eof:
                counted += len(unpack.decompress(data, _PIECE_BYTES))
                data = unpack.unconsumed_tail
                demand_room(counted, most_bytes)
        at += 8 + size
