"""Parallel map: independent items of one computation on all cores."""

from __future__ import annotations

import ctypes
import gc
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
_Result = TypeVar("_Result")

_DIE_WITH_PARENT = 1
"""Linux's PR_SET_PDEATHSIG."""
_SHARES = 8
"""Portions of work for each core; several, so that no core is idle for long at the end."""
_shared: tuple[Callable[[Any], Any], list[Any]]
"""Function and items of the computation, in a forked process."""


def parallel_map(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Compute ``[function(item) for item in items]``, in forked processes on Linux.

    Interpreted code of one process runs on one core only, hence the processes.  The function must be pure and its results
    picklable; its items need not be picklable.  The items are computed one after the other in a child process, where other
    Python threads run (a fork would inherit their locks), and where only one core is available.  Raises NoResourcesError if a
    process cannot be made, or is killed.

    Examples
    --------
    >>> parallel_map(abs, [-1])
    [1]
    """
    items = list(items)
    cores = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1, len(items))
    if cores < 2 or parent_process() is not None or threading.active_count() > 1:
        return [function(item) for item in items]
    before, shares = set(active_children()), min(_SHARES * cores, len(items))
    workers = ProcessPoolExecutor(cores, get_context("fork"), _begin, (function, items, os.getpid()))
    gc.freeze()  # a child collects nothing of its parent: the end of a lost Zenoh session waits for threads that no child has
    try:
        # Not by `map`: on a failure it cancels the waiting work, and the pool then reports an error of its own.
        futures = [workers.submit(_compute_share, range(i, len(items), shares)) for i in range(shares)]
        done = [share.result() for share in futures]
        return [done[i % shares][i // shares] for i in range(len(items))]
    except BaseException as error:
        for child in set(active_children()) - before:  # otherwise the shutdown waits until their work is done
            child.kill()
        if isinstance(error, BrokenProcessPool | OSError):
            raise NoResourcesError(f"a process of the computation could not be made or was killed: {error}") from error
        raise
    finally:
        gc.unfreeze()
        workers.shutdown()


def _begin(function: Callable[[Any], Any], items: list[Any], parent: int) -> None:
    """Initialize a forked process: it ends with its parent and leaves interrupts to it."""
    global _shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interrupts
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:  # the parent ended before the line above
        os._exit(1)
    _shared = function, items


def _compute_share(numbers: range) -> list[Any]:
    """Compute the items of one portion of work, in a forked process."""
    function, items = _shared
    return [function(items[i]) for i in numbers]
