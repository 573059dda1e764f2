"""Independent pieces of one computation, on all cores."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from typing import Any, TypeVar

from monitor.core.errors import NoResourcesError

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")

_DIE_WITH_PARENT = 1
"""Linux's PR_SET_PDEATHSIG."""
_SHARES = 8
"""Portions of work for each core, so that none waits long for another."""
_shared: tuple[Callable[[Any], Any], list[Any]]
"""What a forked process works on, in that process."""


def parallel_map(function: Callable[[_Item], _Made], items: Iterable[_Item]) -> list[_Made]:
    """``[function(item) for item in items]``, in forked processes on Linux: interpreted code runs on one core of a process.

    The function must be pure and its results picklable; its items need not be.  One after the other within such a process,
    in any that is one of several, and beside other threads of Python's, whose locks a fork would inherit.

    Raises
    ------
    NoResourcesError
        Where a process cannot be made, or is killed.
    """
    items = list(items)
    cores = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1, len(items))
    if cores < 2 or parent_process() is not None or threading.active_count() > 1:
        return [function(item) for item in items]
    before, shares = set(active_children()), min(_SHARES * cores, len(items))
    workers = ProcessPoolExecutor(cores, get_context("fork"), _begin, (function, items, os.getpid()))
    try:
        # Not by `map`, which cancels what waits where something fails, and of that the pool itself then makes an error.
        made = [workers.submit(_share, range(i, len(items), shares)) for i in range(shares)]
        done = [share.result() for share in made]
        return [done[i % shares][i // shares] for i in range(len(items))]
    except BaseException as error:
        for child in set(active_children()) - before:  # which would be waited for, however long their work
            child.kill()
        if isinstance(error, BrokenProcessPool | OSError):
            raise NoResourcesError(f"a process of the computation could not be made or was killed: {error}") from error
        raise
    finally:
        workers.shutdown()


def _begin(function: Callable[[Any], Any], items: list[Any], parent: int) -> None:
    global _shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to answer
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:  # it had ended by then
        os._exit(1)
    _shared = function, items


def _share(numbers: range) -> list[Any]:
    function, items = _shared
    return [function(items[i]) for i in numbers]
