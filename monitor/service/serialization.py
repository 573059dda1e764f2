"""Serialization of checkpoints: any frozen dataclass of numbers, text and arrays, restored exactly.

A file has three parts: one line of JSON (format, version, key, checksum of the rest), one line of JSON that holds the value
with each array replaced by its place, and the bytes of the arrays.  Types come from the reader's dataclasses, never from the
file; nothing is pickled.  A file is written completely or not at all.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from drivers.disk import destination, private, sync_folder
from monitor.core import finish, from_plain, partial, to_plain

_log = logging.getLogger(__name__)

FORMAT = "shm-monitor state"
VERSION = 3
"""Version of the state; to be raised, with an entry in `UPGRADES`, when a field is added, removed or changes its meaning."""


def _with_sightings(tree: Any) -> Any:
    """Give a session its windows' modes, of which version 1 kept none."""
    if "session" in tree:
        tree["session"]["pipeline"]["sightings"] = []
    return tree


def _with_corners(tree: Any) -> Any:
    """Give events the drifts at the corners of a plan, of which version 2 knew none."""
    for item in tree["session"]["pipeline"]["events"]["awaiting"] if "session" in tree else ():
        item["event"]["drift_corner_m"] = np.zeros(0)
    return tree


UPGRADES: Mapping[int, Callable[[Any], Any]] = {1: _with_sightings, 2: _with_corners}
"""Version -> function that converts its plain value (`core.to_plain`) to that of the next version."""
_DTYPES = ("<f8", "<c16", "<i8", "<f4", "|b1")
_ARRAY = "@array"
_MOST_BYTES = 1 << 30

T = TypeVar("T")


class CheckpointError(Exception):
    """Error of a checkpoint that cannot be used; the message gives the reason."""


def fingerprint(parts: Mapping[str, Any]) -> str:
    """Compute a checksum of the settings on which a state depends, given as plain values; the order of keys has no effect."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def save(path: Path, key: str, value: object) -> int:
    """Write a value to a file, completely or not at all, and return the number of bytes; the value before is kept as `previous`.

    A reader must give the same `key`, the checksum of the settings.  Where the disk does not accept the file OSError is
    raised, and the last checkpoint is unchanged.
    """
    data, path = to_bytes(key, value), destination(path)
    temporary = partial(path)
    try:
        with open(temporary, "wb", opener=private) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, destination(previous(path)))
        finish(path)
        sync_folder(path.parent)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    return len(data)


def load(path: Path, key: str, cls: type[T]) -> T | None:
    """Load the latest value with this key, else the one before it; None, with the reasons logged, if neither can be used."""
    for place in (path, previous(path)):
        try:
            return from_bytes(_read(place), key, cls)
        except FileNotFoundError:
            continue
        except (OSError, CheckpointError) as error:
            _log.warning("%s: not resumed from: %s", place, error)
    return None


def forget(path: Path) -> None:
    """Remove a value and the one before it; a failure is logged."""
    for place in (path, previous(path)):
        try:
            place.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s: cannot be removed: %s", place, error.strerror)


def previous(path: Path) -> Path:
    """Return the path under which the value before the present one is kept."""
    place = Path(os.path.realpath(path))
    return place.with_name(place.name + ".previous")


def to_bytes(key: str, value: object) -> bytes:
    """Serialize a value as the content of a checkpoint; TypeError tells that a part of it has a type that cannot be stored."""
    arrays: list[bytes] = []
    size = 0

    def pack(item: np.ndarray) -> object:
        nonlocal size
        if item.dtype.str not in _DTYPES:
            raise TypeError(f"cannot be kept: an array of {item.dtype}")
        # The order of the axes in memory is kept, because the rounding of sums depends on it.
        axes = sorted(range(item.ndim), key=lambda axis: -abs(item.strides[axis]))
        data = item.transpose(axes).tobytes()
        place = {_ARRAY: [item.dtype.str, list(item.shape), axes, size]}
        arrays.append(data)
        size += len(data)
        return place

    text = json.dumps(to_plain(value, pack), separators=(",", ":"))
    body = b"".join([text.encode(), b"\n", *arrays])
    head = {"format": FORMAT, "version": VERSION, "key": key, "sha256": hashlib.sha256(body).hexdigest()}
    return json.dumps(head).encode() + b"\n" + body


def from_bytes(
    data: bytes, key: str, cls: type[T], version: int = VERSION, upgrades: Mapping[int, Callable[[Any], Any]] = UPGRADES
) -> T:
    """Restore a value of class `cls`, as it is since `version`, from the content of a checkpoint of that version or before.

    CheckpointError tells that the content is no checkpoint, is damaged, has a newer version or one that cannot be upgraded, or
    belongs to another configuration.
    """
    try:
        line, _, body = data.partition(b"\n")
        head = json.loads(line) if len(line) < 1000 else {}
        if not isinstance(head, dict) or head.get("format") != FORMAT:
            raise CheckpointError("this is no checkpoint")
        if head["sha256"] != hashlib.sha256(body).hexdigest():
            raise CheckpointError("its checksum does not fit: it is damaged")
        written = int(head["version"])
        if written > version:
            raise CheckpointError(f"it was written by a newer program (version {written}, this one knows {version})")
        if head["key"] != key:
            raise CheckpointError("it belongs to another configuration or baseline")
        text, _, arrays = body.partition(b"\n")
        tree = json.loads(text, object_hook=lambda item: _unpack(item, arrays))
        while written < version:
            if written not in upgrades:
                raise CheckpointError(f"it is of version {written}, which cannot be upgraded")
            tree, written = upgrades[written](tree), written + 1
        result = from_plain(cls, tree, _array)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        raise CheckpointError(f"it does not fit this program: {error!r}") from error
    assert isinstance(result, cls)
    return result


def _array(tree: Any, *_: object) -> np.ndarray:
    """Return an array that `_unpack` has put in its place."""
    if not isinstance(tree, np.ndarray):
        raise ValueError(f"{str(tree)[:40]!r} is no array")
    return tree


def _unpack(item: dict[str, Any], arrays: bytes) -> Any:
    """Replace the place of an array by the array itself, with its order of axes in memory."""
    if _ARRAY not in item:
        return item
    dtype, shape, axes, offset = item[_ARRAY]
    if dtype not in _DTYPES or any(not isinstance(n, int) or n < 0 for n in (*shape, offset)):
        raise ValueError(f"an array of {dtype!r}, shape {shape}")
    stored_shape = [shape[a] for a in axes]
    values = np.frombuffer(arrays, dtype, count=int(np.prod(stored_shape, dtype=object)), offset=offset)
    return values.reshape(stored_shape).copy().transpose(np.argsort(axes).tolist())


def _read(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_MOST_BYTES)
