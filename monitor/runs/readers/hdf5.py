"""Reads HDF5 files, MATLAB's of version 7.3 among them; `arrays.build_table` says which datasets are readings."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import import_extra
from monitor.runs.readers.arrays import VALUE_BYTES, WORDS, AnyArray, build_table
from monitor.runs.readers.base import File
from monitor.runs.readers.own_process import demand_room
from monitor.runs.readers.table import Table

MAGIC = b"\x89HDF\r\n\x1a\n"
_USER_BLOCKS = (0, 512, 1024, 2048)
"""Lengths of what may stand before it; MATLAB writes a header of 512. [bytes; definition: HDF5 superblock]"""
_MOST_OBJECTS = 10_000
"""Most groups and datasets of a file. [1; judgement]"""
_DEFLATE, _SHUFFLE, _CHECKSUM, _LZF = 1, 2, 3, 32000
"""Filters of chunks. [1; definition: registered filters of HDF5]"""
_LZF_RATIO = 132
"""Most that LZF unpacks a byte to. [ratio; definition: two bytes stand for at most 264]"""


class Hdf5:
    """HDF5.

    A dataset's attribute `unit` or `units` is its unit; attributes `rate_hz`, `fs` or `dt` of the file are read too.  What lies
    in other files (external links and storage, virtual datasets) is never read.
    """

    name = "HDF5"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format, with MATLAB's header or without."""
        return any(file.raw.startswith(MAGIC, at) for at in _USER_BLOCKS)

    def read(self, file: File) -> list[Table]:
        """Convert the datasets; BadConfigurationError without the library h5py."""
        import_extra("h5py", f"{file.path}: HDF5 (MAT 7.3)")
        arrays, units = file.read_apart(__name__, self.name)
        return [build_table(file.path, self.name, arrays, file.on_warning, units)]


def read(path: Path, most_bytes: int) -> tuple[dict[str, AnyArray], dict[str, str]]:
    """Read the arrays of a file and their units; raise ValueError if they would take more than `most_bytes`."""
    h5py = import_extra("h5py", "HDF5")
    with h5py.File(path, "r") as file:
        arrays: dict[str, AnyArray] = {name: np.asarray(value) for name, value in file.attrs.items()}
        units, held = dict[str, str](), 0
        for name, dataset in _datasets(h5py, file):
            told = dataset.attrs.get("unit", dataset.attrs.get("units", ""))
            units[name] = told.decode() if isinstance(told, bytes) else str(told)
            if dataset.dtype.kind in "iufb":
                held += max(VALUE_BYTES, dataset.dtype.itemsize) * dataset.size
                demand_room(held, most_bytes)
                _demand_honest_chunks(name, dataset, most_bytes)
                arrays[name] = _readings(dataset)
            elif name.rpartition("/")[2].casefold() in WORDS and dataset.size < _MOST_OBJECTS:
                words = dataset.asstr()[()] if h5py.check_string_dtype(dataset.dtype) else np.empty(0)
                arrays[name] = np.asarray(words).astype(str)
    return {name: array for name, array in arrays.items() if array.dtype.kind in "iufbU"}, units


def _datasets(h5py: Any, file: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets that the file itself holds, by their path; MATLAB's own groups (#refs#) are left out."""
    waiting, count = [("", file)], 0
    seen = set()
    while waiting:
        prefix, group = waiting.pop(0)
        for name in group:
            count += 1
            if count > _MOST_OBJECTS:
                raise ValueError(f"more than {_MOST_OBJECTS} groups and datasets")
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink) or name.startswith("#"):
                continue
            child = group[name]
            address = h5py.h5o.get_info(child.id).addr
            if address in seen:  # a group that holds itself has no end
                continue
            seen.add(address)
            place = f"{prefix}{name}"
            if isinstance(child, h5py.Group):
                waiting.append((f"{place}/", child))
            elif isinstance(child, h5py.Dataset):
                if child.external is not None or child.is_virtual:
                    raise ValueError(f"dataset {place} lies in other files; copy it into this one")
                yield place, child


def _readings(dataset: Any) -> AnyArray:
    """Return the numbers of a dataset, or the word that MATLAB stored in it as numbers of its characters."""
    numbers = np.asarray(dataset[()])
    is_text = bool(dataset.attrs.get("MATLAB_class", b"") == b"char")
    return np.array("".join(map(chr, numbers.ravel()[:80]))) if is_text else numbers


def _demand_honest_chunks(name: str, dataset: Any, most_bytes: int) -> None:
    """Raise ValueError if a packed chunk unpacks to more than it holds, all of which the library would keep."""
    if dataset.chunks is None:
        return
    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
    strange = [code for code in filters if code not in (_DEFLATE, _SHUFFLE, _CHECKSUM, _LZF)]
    if strange:
        raise ValueError(f"dataset {name} is packed by filter {strange[0]}; pack it by gzip, or not at all")
    size = int(np.prod(dataset.chunks, dtype=object)) * dataset.dtype.itemsize
    demand_room(size, most_bytes)
    for k in range(dataset.id.get_num_chunks()):
        stored = dataset.id.get_chunk_info(k)
        if _LZF in filters:
            demand_room(_LZF_RATIO * stored.size, most_bytes)
        if _DEFLATE in filters and not stored.filter_mask:
            data = dataset.id.read_direct_chunk(stored.chunk_offset)[1]
            if len(zlib.decompressobj().decompress(data, size + 1)) > size:
                raise ValueError(f"a chunk of dataset {name} unpacks to more than its {size} bytes")
