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
import types
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from drivers.disk import sync_folder
from monitor.core import finish, partial

_log = logging.getLogger(__name__)

FORMAT = "shm-monitor state"
VERSION = 1
"""Version of the state; to be raised, with an entry in `UPGRADES`, when a field is added, removed or changes its meaning."""
UPGRADES: Mapping[int, Callable[[Any], Any]] = {}
"""Version -> function that converts its plain value (`plain`) to that of the next version."""
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
    """Write a value to a file, completely or not at all; the value before it is kept beside it, as `previous`.

    Parameters
    ----------
    path : Path
        File to write.
    key : str
        Checksum of the settings (`fingerprint`), which a reader must give too.
    value : object
        Frozen dataclass of numbers, text and arrays.

    Returns
    -------
    int
        Number of bytes written.

    Raises
    ------
    OSError
        The disk does not accept the file; the last checkpoint is then unchanged.
    """
    data, temporary = to_bytes(key, value), partial(path)
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, previous(path))
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
    return path.with_name(path.name + ".previous")


def to_bytes(key: str, value: object) -> bytes:
    """Serialize a value as the content of a checkpoint.

    Raises
    ------
    TypeError
        A part of the value has a type that cannot be stored.
    """
    arrays: list[bytes] = []
    size = 0

    def pack(item: object) -> object:
        nonlocal size
        if isinstance(item, np.generic):
            return item.item()
        if not isinstance(item, np.ndarray) or item.dtype.str not in _DTYPES:
            raise TypeError(f"cannot be kept: {type(item).__name__} {getattr(item, 'dtype', '')}")
        # The order of the axes in memory is kept, because the rounding of sums depends on it.
        axes = sorted(range(item.ndim), key=lambda axis: -abs(item.strides[axis]))
        data = item.transpose(axes).tobytes()
        place = {_ARRAY: [item.dtype.str, list(item.shape), axes, size]}
        arrays.append(data)
        size += len(data)
        return place

    text = json.dumps(plain(value), default=pack, separators=(",", ":"))
    body = b"".join([text.encode(), b"\n", *arrays])
    head = {"format": FORMAT, "version": VERSION, "key": key, "sha256": hashlib.sha256(body).hexdigest()}
    return json.dumps(head).encode() + b"\n" + body


def from_bytes(
    data: bytes,
    key: str,
    cls: type[T],
    version: int = VERSION,
    upgrades: Mapping[int, Callable[[Any], Any]] = UPGRADES,
) -> T:
    """Restore a value of class `cls`, as it is since `version`, from the content of a checkpoint of that version or before.

    Raises
    ------
    CheckpointError
        The content is no checkpoint, is damaged, has a newer version or one that cannot be upgraded, or belongs to another
        configuration.
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
        result = build(cls, tree)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        raise CheckpointError(f"it does not fit this program: {error!r}") from error
    assert isinstance(result, cls)
    return result


def plain(value: object) -> Any:
    """Convert a value to dicts, lists, numbers, text and arrays; a dataclass becomes a dict, a dict a list of pairs."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.init}
    if isinstance(value, dict):
        return [[plain(k), plain(v)] for k, v in value.items()]
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Fraction):
        return str(value)
    return value


def build(hint: Any, tree: Any) -> Any:
    """Rebuild a value of the type `hint` from its plain form; the inverse of `plain`.

    Raises
    ------
    ValueError
        The tree does not fit the type.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type):
        wanted = _fields(hint)
        if not isinstance(tree, dict) or tree.keys() != wanted.keys():
            raise ValueError(f"{hint.__name__} has other fields")
        return hint(**{name: build(kind, tree[name]) for name, kind in wanted.items()})
    if origin in (Union, types.UnionType):
        if tree is None and type(None) in arguments:
            return None
        (kind,) = (a for a in arguments if a is not type(None))
        return build(kind, tree)
    if hint is np.ndarray or origin is np.ndarray:
        return _checked(tree, np.ndarray)
    if origin in (tuple, list, dict):
        return _collection(origin, arguments, _checked(tree, list))
    if hint is Fraction or (isinstance(hint, type) and issubclass(hint, Enum)):
        return hint(_checked(tree, str))
    return _checked(tree, (float, int) if hint is float else hint)


def _collection(origin: Any, arguments: tuple[Any, ...], items: list[Any]) -> Any:
    if origin is dict:
        return {build(arguments[0], k): build(arguments[1], v) for k, v in items}
    if origin is list or arguments[-1] is Ellipsis:
        return origin(build(arguments[0], item) for item in items)
    return tuple(build(kind, item) for kind, item in zip(arguments, items, strict=True))


def _checked(tree: Any, kind: Any) -> Any:
    """Return the value if it has the type `kind`, else raise ValueError; a bool is no number."""
    if not isinstance(tree, kind) or (isinstance(tree, bool) and kind is not bool):
        raise ValueError(f"{str(tree)[:40]!r} is no {kind}")
    return tree


@cache
def _fields(cls: type) -> dict[str, Any]:
    """Return the types of the fields that the constructor of a dataclass takes, by name."""
    hints = get_type_hints(cls)
    return {f.name: hints[f.name] for f in fields(cls) if f.init}


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
