"""Campaigns of trials: the words of a command, a file of results that is gone on with, processes, and trials done once."""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import multiprocessing
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from tests.support.reference import ROOT, once

T = TypeVar("T")
_FOLDERS = ("tests/statistics", "tests/events", "tests/hidden", "tests/damage")
"""What a trial reads besides the code of a reference."""


def words(*kinds: Any, given: Sequence[str] | None = None) -> list[Any]:
    """Read the words of the command, in order; a kind is a type, or the value that stands where no word does."""
    given = sys.argv[1:] if given is None else given
    needed = sum(isinstance(kind, type) for kind in kinds)
    if not needed <= len(given) <= len(kinds):
        sys.exit(f"{needed} to {len(kinds)} words are needed, not {len(given)}")
    types = [kind if isinstance(kind, type) else type(kind) for kind in kinds]
    return [kind(word) for kind, word in zip(types, given, strict=False)] + list(kinds[len(given) :])


def gone_on_with(
    path: Path, keys: Sequence[str], tasks: Iterable[tuple[Any, ...]], trial: Callable[..., dict[str, Any]]
) -> list[dict[str, Any]]:
    """Do the tasks that a file of JSON lines lacks, a line each, and return all its lines; `keys` name the parts of a task."""
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {tuple(row[key] for key in keys) for row in rows}
    path.parent.mkdir(parents=True, exist_ok=True)
    for task in tasks:
        if task not in done:
            rows.append(dict(zip(keys, task, strict=True)) | trial(*task))
            with path.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    return rows


def each(
    trial: Callable[..., T], tasks: Iterable[tuple[Any, ...]], processes: int = 1, *, keep: bool = False
) -> list[T]:
    """Results of a trial for each task, in order, on one thread of linear algebra each.

    Kept ones are there for the next campaign that asks for them, after an interruption too, as long as the code is the same.
    """
    run = _kept if keep else _run
    todo = [(trial.__module__, trial.__name__, task, _checksum() if keep else "") for task in tasks]
    if processes == 1:
        return [run(*one) for one in todo]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        return pool.starmap(run, todo, chunksize=1)


def _run(module: str, name: str, task: tuple[Any, ...], _: str) -> Any:
    with threadpool_limits(limits=1):
        return getattr(importlib.import_module(module), name)(*task)


def _kept(*trial: Any) -> Any:
    return once(_run)(*trial)


@functools.cache
def _checksum() -> str:
    files = [file for folder in _FOLDERS for file in sorted((ROOT / folder).glob("*.py"))]
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()[:16]
