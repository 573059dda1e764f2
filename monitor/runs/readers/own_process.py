"""Reads a file in a process of its own, with a library that a damaged file may make crash, wait for ever, or take all memory.

A reader's module calls `File.read_apart` where it converts a file; that process calls the module's function `read`.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from monitor.core import BadInputError
from monitor.runs.readers.arrays import AnyArray, as_doubles

_TOLD = "/told of the arrays"
"""Name of what the process tells besides the arrays; no array's name begins with a slash."""
LEAST_S, _BYTES_PER_S = 30.0, 1e6
"""Longest time of reading, and bytes of the file for each second more. [s, bytes; judgement]"""
_PROGRAM_BYTES = 4 << 30
"""Addresses of the process besides the arrays. [bytes; measured: libraries take some 2 GB]"""

Arrays = dict[str, AnyArray]
Told = dict[str, Any]
"""What is told of each array, such as its unit, as plain values."""
Read = Callable[[Path, int], tuple[Arrays, Told]]
"""Reads the arrays of a file, of at most so many bytes, and what it tells of each."""


def read_apart(module: str, kind: str, path: Path, most_bytes: int, least_s: float) -> tuple[Arrays, Told]:
    """Let a module's function `read` read the arrays of a file in a process of its own; return them and what is told of them.

    A small file is read for `least_s` at most.
    """
    with TemporaryDirectory() as folder:
        out = Path(folder, "arrays.npz")
        limit_s = least_s + path.stat().st_size / _BYTES_PER_S
        try:
            done = subprocess.run(
                [sys.executable, "-W", "ignore", "-m", __name__, module, str(path), str(out), str(most_bytes)],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=limit_s,
                check=False,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            )
        except subprocess.TimeoutExpired:
            raise BadInputError(f"{path}: damaged {kind}: its reading did not end within {limit_s:.0f} s") from None
        if done.returncode == BadInputError.exit_code:
            reason = done.stdout.strip() or "it cannot be read"
            raise BadInputError(f"{path}: cannot be used as {kind}: {reason}")
        if done.returncode:
            raise BadInputError(f"{path}: damaged {kind}: its reading failed (exit code {done.returncode})")
        with np.load(out, allow_pickle=False) as archive:
            arrays = {name: as_doubles(archive[name]) for name in archive.files if name != _TOLD}
            return arrays, json.loads(str(archive[_TOLD]))


def demand_room(size: int, most_bytes: int) -> None:
    """Raise ValueError if a file unpacks to more bytes than it may."""
    if size > most_bytes:
        raise ValueError(
            f"would unpack to {size >> 20} MiB or more; at most {most_bytes >> 20} MiB are read: "
            "cut it into several files, or unpack it and import what it holds"
        )


def hand_over(read: Read, path: str, out: str, most_bytes: str) -> int:
    """Read a file and write its arrays as NPZ (the process that `read_apart` starts); return the exit code."""
    room = 4 * int(most_bytes) + _PROGRAM_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (room, room))
    try:
        arrays, told = read(Path(path), int(most_bytes))
    except Exception as error:  # noqa: BLE001 - libraries raise whatever a damaged file makes them say
        print(error)  # not to standard error, to which libraries write too
        return BadInputError.exit_code
    content: dict[str, Any] = {**arrays, _TOLD: np.array(json.dumps(told, default=float))}
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:  # not np.savez: an array may be called `file`
        for name, array in content.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return 0


if __name__ == "__main__":
    sys.exit(hand_over(import_module(sys.argv[1]).read, *sys.argv[2:]))
