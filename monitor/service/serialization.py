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
from monitor.events import EventState, GroundState

_log = logging.getLogger(__name__)

FORMAT = "shm-monitor state"


def _without_doubled_sums(tree: Any) -> Any:
    """Upgrade from version 1: remove sums of a window's blocks that follow from other fields."""
    run = tree["session"]["pipeline"]["run"] if "session" in tree else None
    for block in run["window"]["blocks"] if run is not None else ():
        block["shifted"] = block.pop("second")
        del block["first"], block["total"]
    return tree


def _with_course(tree: Any) -> Any:
    """Upgrade from version 2, whose summary counted windows and episodes itself."""
    if "session" in tree:
        summary = tree["session"]["summary"]
        losses = [episode | {"story": episode["story"] or 0} for episode in summary.pop("alarms")]
        counts = {name: summary.pop(name) for name in ("windows", "skipped", "skip_reasons")}
        unknown = dict.fromkeys(("last", "judged", "misfit_since_ns", "unexplained", "rms_range"))
        summary["course"] = {**counts, "recent": [], "losses": losses, **unknown}
        means, n = summary.pop("frequencies_hz") or [], summary.pop("n_frequencies")
        summary |= {"modes": [[k, [n, hz]] for k, hz in enumerate(means, 1)], "other_modes": [], "missing_modes": []}
        findings = tree["session"]["watcher"]
        findings["found"] = [json.dumps({"ddi_effect": None} | json.loads(text)) for text in findings["found"]]
    return tree


def _with_span_faults(tree: Any) -> Any:
    """Upgrade from version 3, whose health of a channel had neither resolution nor steps, drift, dropouts and hum."""
    if "session" in tree:
        new = {
            "resolution_m_s2": 0.0,
            "step_m_s2": 0.0,
            "drift_m_s2": 0.0,
            "held_s": 0.0,
            "hum_hz": None,
            "mains_hz": None,
        }
        for span in tree["session"]["pipeline"]["health"]["spans"]:
            span["channels"] = [channel | new for channel in span["channels"]]
    return tree


def _with_events_covariates_and_left_out_channels(tree: Any) -> Any:
    """Upgrade from version 4, which had temperature alone, no events, and no windows without one of the channels.

    The stage of events begins anew, and so does the sequential test: what its windows had in common is not known.
    """
    if "session" in tree:
        pipeline = tree["session"]["pipeline"]
        pipeline |= {"events": plain(EventState()), "ground": plain(GroundState()), "covariates": [], "learning": None}
        pipeline["watch"] = {"channels": []}
        if (run := pipeline["run"]) is not None:
            n_channels = run["window"]["samples"].shape[1]
            run["lost"] = {"held": np.zeros(n_channels), "pending": np.zeros(n_channels, dtype=bool)}
            run["window"]["lost"] = []
        history = pipeline["alarm"]["history"]
        n = history["ddi"].shape[1]
        history |= {name: history[name][:0] for name in ("t_ns", "ddi", "variance")}
        history |= {"common": np.zeros((0, n, n)), "memory_s": 0.0, "channels": [], "before": None}
        for span in pipeline["health"]["spans"]:
            span["channels"] = [channel | {"lost": 0.0} for channel in span["channels"]]
        course = tree["session"]["summary"]["course"]
        course["outages"] = []
        for name in ("last", "judged"):
            if course[name] is not None:
                course[name]["left_out"] = []
    return tree


def _with_modes_alone(tree: Any) -> Any:
    """Upgrade from version 5, which knew no structure without a model."""
    if "session" in tree:
        tree["session"]["pipeline"]["alarm"]["shapes"] = None
        course = tree["session"]["summary"]["course"]
        for part in (course["last"], course["judged"], *course["losses"]):
            if part is not None:
                part["modal"] = False
    return tree


def _with_alarms_of_events(tree: Any) -> Any:
    """Upgrade from version 6, in which an event that exceeded a limit had no alarm."""
    if "session" in tree:
        tree["session"]["pipeline"]["events"]["alarms"] = []
    elif "stories" in tree:
        tree["events"] = []
    return tree


def _with_common_change(tree: Any) -> Any:
    """Upgrade from version 7, whose covariates' law did not hold what the stories do together."""
    pipeline: dict[str, Any] = tree["session"]["pipeline"] if "session" in tree else {"learning": None}
    if (learning := pipeline["learning"]) is not None:
        n, modes_alone = len(learning["law"]["mixing"]), pipeline["alarm"]["shapes"] is not None
        learning["law"]["common"] = None if modes_alone else {"square": np.zeros((n, n)), "windows": 0}
    return tree


def _with_range_of_common_change(tree: Any) -> Any:
    """Upgrade from version 8, which did not keep how far the stories went together: 0 until it is seen again."""
    learning = tree["session"]["pipeline"]["learning"] if "session" in tree else None
    if learning is not None and (common := learning["law"]["common"]) is not None:
        n = len(common["square"])
        common["lowest"] = np.zeros((2, n + 2, n))
    return tree


def _with_kept_pieces(tree: Any) -> Any:
    """Upgrade from version 9, in which the events' latest samples were one array."""
    if "session" in tree:
        events = tree["session"]["pipeline"]["events"]
        events["kept"] = [events["kept"]] if len(events["kept"]) else []
    return tree


VERSION = 10
"""Version of the state; to be raised, with an entry in `UPGRADES`, when a field is added, removed or changes its meaning."""
UPGRADES: dict[int, Callable[[Any], Any]] = {
    1: _without_doubled_sums,
    2: _with_course,
    3: _with_span_faults,
    4: _with_events_covariates_and_left_out_channels,
    5: _with_modes_alone,
    6: _with_alarms_of_events,
    7: _with_common_change,
    8: _with_range_of_common_change,
    9: _with_kept_pieces,
}
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


def from_bytes(data: bytes, key: str, cls: type[T]) -> T:
    """Restore a value of class `cls` from the content of a checkpoint.

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
        version = int(head["version"])
        if version > VERSION:
            raise CheckpointError(f"it was written by a newer program (version {version}, this one knows {VERSION})")
        if head["key"] != key:
            raise CheckpointError("it belongs to another configuration or baseline")
        text, _, arrays = body.partition(b"\n")
        tree = json.loads(text, object_hook=lambda item: _unpack(item, arrays))
        while version < VERSION:
            if version not in UPGRADES:
                raise CheckpointError(f"it is of version {version}, which cannot be upgraded")
            tree, version = UPGRADES[version](tree), version + 1
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
