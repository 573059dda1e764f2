"""Independent pieces of one computation, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

_Item = TypeVar("_Item")
_Made = TypeVar("_Made")


def each(function: Callable[[_Item], _Made], items: Iterable[_Item]) -> list[_Made]:
    """``[function(item) for item in items]``, several at once: compiled loops, transforms and draws leave the interpreter free.

    The function must be pure.  It sees the caller's context variables, numpy's handling of errors among them.
    """
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as workers:
        return [made.result() for made in [workers.submit(copy_context().run, function, item) for item in items]]
