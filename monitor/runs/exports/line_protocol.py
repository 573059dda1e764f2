"""InfluxDB line protocol: one line a row, of measurement, tags, fields and time in ns."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

_TAGS = ("mode", "other", "story")
"""Columns by which rows of one time differ: they are tags, else a row would replace the one before it."""


def write(
    batches: Iterable[Mapping[str, list[Any]]], out: Path, table: str, time: str, run: str, integers: Collection[str]
) -> int:
    """Write rows, given as batches of column -> values, as measurement ``shm_TABLE`` with the tag ``run``; return their number.

    `time` names the column of the time, ns since 1970, and `integers` those of integers.
    """
    count = 0
    with out.open("w", encoding="utf-8", newline="\n") as file:
        for batch in batches:
            for values in zip(*batch.values(), strict=True):
                row = dict(zip(batch, values, strict=True))
                tags = {"run": run} | {name: str(row.pop(name)) for name in _TAGS if row.get(name) is not None}
                text = line(f"shm_{table}", tags, row, row.pop(time), integers)
                if text is not None:
                    file.write(text + "\n")
                    count += 1
    return count


def line(
    measurement: str, tags: Mapping[str, str], fields: Mapping[str, Any], t_ns: int, integers: Collection[str] = ()
) -> str | None:
    """Write one line; fields that are None or not finite are left out, and None is returned where no field is left.

    Examples
    --------
    >>> line("shm windows", {"run": "a,b=c"}, {"f 1": 4.5, "n": 3, "says": 'a "b"', "none": None}, 7, {"n"})
    'shm\\\\ windows,run=a\\\\,b\\\\=c f\\\\ 1=4.5,n=3i,says="a \\\\"b\\\\"" 7'
    """
    texts = {name: _value(value, name in integers) for name, value in fields.items()}
    told = [f"{_key(name)}={text}" for name, text in texts.items() if text is not None]
    if not told:
        return None
    tagged = (f"{_key(name)}={_key(value)}" for name, value in tags.items() if value)
    head = ",".join([_escaped(measurement, ", "), *tagged])
    return f"{head} {','.join(told)} {t_ns}"


def _value(value: Any, integer: bool) -> str | None:
    """Write the value of a field; None for a value that the protocol cannot hold."""
    if isinstance(value, str):
        return '"' + _one_line(value).replace("\\", "\\\\").replace('"', '\\"') + '"'
    if value is None or not math.isfinite(value):
        return None
    return f"{int(value)}i" if integer else repr(float(value))


def _key(text: str) -> str:
    """Escape a name or the value of a tag."""
    return _escaped(text, ",= ")


def _escaped(text: str, marks: str) -> str:
    """Escape the marks; a backslash, which readers take in different ways there, becomes a slash."""
    text = _one_line(text).replace("\\", "/") or "_"
    return "".join(f"\\{letter}" if letter in marks else letter for letter in text)


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())
