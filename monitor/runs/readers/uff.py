"""Reads universal files: the time responses among their datasets 58 and 58b, with their names, units and times."""

from __future__ import annotations

from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadInputError, import_extra
from monitor.runs.readers.arrays import VALUE_BYTES
from monitor.runs.readers.base import LINE_BYTES, File
from monitor.runs.readers.own_process import Arrays, Told, demand_room
from monitor.runs.readers.table import Table

_MARK = b"    -1"
_TIME_RESPONSE = 1
_ACCELERATION, _FORCE = 12, 13
"""Specific data types. [1; definition: universal dataset 58]"""
_SI = 1
"""Units code of dataset 164. [1; definition: m, N, kg]"""
_DIRECTIONS = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
_FUNCTIONS = {0: "general function", 2: "autospectrum", 3: "cross-spectrum", 4: "frequency response", 6: "coherence",
              9: "power spectral density"}  # fmt: skip
_DATES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S")
_NONE = ("", "NONE", "none")


class Uff:
    """Universal files; a channel is named by its node and direction (``12z``) or its label."""

    name = "UFF"

    def is_mine(self, file: File) -> bool:
        """Test whether the first lines are those of a universal file."""
        first, _, rest = file.raw[:200].lstrip(b"\r\n").partition(b"\n")
        return first.rstrip() == _MARK.rstrip() and rest[:6].strip().isdigit()

    def read(self, file: File) -> list[Table]:
        """Convert the time responses; BadConfigurationError without the library pyuff."""
        import_extra("pyuff", f"{file.path}: a universal file (UFF)")
        file.demand_room(len(file.raw) + LINE_BYTES * file.raw.count(b"\n"))
        if file.raw.count(_MARK) % 2:
            raise BadInputError(f"{file.path}: damaged UFF: its last dataset has no end; the file was cut")
        arrays, told = file.read_apart(__name__, self.name)
        si = told.pop("si")
        functions = [{**of, "data": arrays[f"y{key}"], "x": arrays[f"x{key}"]} for key, of in told.items()]
        try:
            return [_build(file, functions, si)]
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise BadInputError(f"{file.path}: cannot be used as UFF: {error}") from error


def read(path: Path, most_bytes: int) -> tuple[Arrays, Told]:
    """Read the datasets 58 of a file: their arrays, and the other fields of each as JSON."""
    import pyuff

    file = pyuff.UFF(str(path))
    kinds = [int(kind) for kind in file.get_set_types()]
    si = any(file.read_sets([k]).get("units_code") == _SI for k, kind in enumerate(kinds) if kind == 164)
    arrays: Arrays = {}
    told: Told = {"si": si}
    held = 0
    for k, kind in enumerate(kinds):
        if kind == 58:
            function = file.read_sets([k])
            arrays[f"y{k}"], arrays[f"x{k}"] = np.asarray(function.pop("data")), np.asarray(function.pop("x"))
            held += 2 * VALUE_BYTES * arrays[f"y{k}"].size
            demand_room(held, most_bytes)
            told[str(k)] = {key: value for key, value in function.items() if isinstance(value, str | int | float)}
    return arrays, told


def _build(file: File, functions: list[dict[str, Any]], si: bool) -> Table:
    """Build a table of the time responses; raise ValueError if they do not fit each other."""
    responses = _responses(functions)
    if others := _kinds([one for one in functions if not _is_response(one)]):
        file.on_warning(f"{file.path}: left out, since only time responses are samples: {others}")
    first = responses[0]
    names = [_label(f) for f in responses]
    columns = tuple(
        name if names.count(name) == 1 else f"{name}_{names[: at + 1].count(name)}" for at, name in enumerate(names)
    )
    x = np.asarray(first["x"], dtype=np.float64)
    if not (np.abs(x) < 4e9).all():
        raise ValueError("its times are absurd")
    even = bool(first["abscissa_spacing"])
    if even and not first["abscissa_inc"] > 0:
        raise ValueError(f"a step of {first['abscissa_inc']} s between samples")
    start_ns, start_text = _start(first, float(x[0]) if len(x) else 0.0, file.options.zone)
    return Table(
        path=file.path,
        columns=columns,
        units=tuple(_unit(f, si) for f in responses),
        values=np.column_stack([f["data"] for f in responses]).astype(np.float64),
        time_ns=None if even else np.rint(1e9 * x).astype(np.int64),
        start_ns=start_ns,
        start_text=start_text,
        rate_hz=_rounded(1.0 / float(first["abscissa_inc"])) if even else None,
    )


def _responses(functions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the time responses; raise ValueError if there is none, or their times differ."""
    responses = list(filter(_is_response, functions))
    if not responses:
        held = _kinds(functions) or "no dataset 58"
        raise ValueError(f"it holds no time response (dataset 58 of function type 1) but {held}")
    first = responses[0]
    for other in responses:
        if len(other["data"]) != len(first["data"]) or not np.allclose(other["x"], first["x"], rtol=0, atol=1e-6):
            raise ValueError(
                f"{_label(first)} has {len(first['data'])} samples and {_label(other)} {len(other['data'])}, or other times; "
                "save those of one rate and length together"
            )
    return responses


def _is_response(function: dict[str, Any]) -> bool:
    """Test whether a function is a time response."""
    return bool(function["func_type"] == _TIME_RESPONSE and np.isrealobj(function["data"]))


def _kinds(functions: list[dict[str, Any]]) -> str:
    """Name the kinds of functions."""
    return ", ".join(sorted({_FUNCTIONS.get(f["func_type"], f"type {f['func_type']}") for f in functions}))


def _rounded(rate_hz: float) -> float:
    """Return the whole number that a rate means: the step has six digits in the file."""
    return float(round(rate_hz)) if round(rate_hz) and abs(rate_hz / round(rate_hz) - 1) < 1e-5 else round(rate_hz, 6)


def _label(function: dict[str, Any]) -> str:
    """Return the name of a channel: entity, node and direction, else what labels its ordinate or the dataset."""
    node, direction = int(function["rsp_node"]), int(function["rsp_dir"])
    entity, label = (str(function.get(key, "")).strip() for key in ("rsp_ent_name", "ordinate_axis_lab"))
    if node or (direction and entity in _NONE):
        place = f"{node}{'-' if direction < 0 else ''}{_DIRECTIONS.get(abs(direction), '')}"
        return place if entity in _NONE else f"{entity}{place}"
    return next((t for t in (entity, label, str(function["id1"]).strip()) if t not in _NONE), "a")


def _unit(function: dict[str, Any], si: bool) -> str:
    """Return the unit of a channel: its label, or SI where dataset 164 says so; empty where none is stated."""
    label = str(function.get("ordinate_axis_units_lab", "")).strip().replace("\ufffd", "²")
    if label not in _NONE:
        return label
    return {_ACCELERATION: "m/s^2", _FORCE: "N"}.get(int(function["ordinate_spec_data_type"]), "") if si else ""


def _start(function: dict[str, Any], begun_s: float, zone: tzinfo | None) -> tuple[int | None, str]:
    """Return the time of the first sample that the dataset states, UTC in ns since 1970, and how where no zone is known.

    None, and empty, where it states none.
    """
    text = str(function["id3"]).strip()
    for form in _DATES:
        try:
            moment = datetime.strptime(text, form).replace(tzinfo=zone or UTC)
        except ValueError:
            continue
        return round(moment.timestamp()) * 10**9 + round(1e9 * begun_s), "" if zone else text
    return None, ""
