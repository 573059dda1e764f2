"""Functions that numba compiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[_Function], _Function]:
    """As ``numba.njit`` that lets other threads run, and kept on the disk where there is a place for it.

    A program that root installed, run by a user without a home, has none unless ``NUMBA_CACHE_DIR`` names one: it compiles again
    in each process, which takes seconds, and says nothing.
    """

    def wrap(function: _Function) -> _Function:
        try:
            made: _Function = njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:
            made = njit(nogil=True, **options)(function)
        return made

    return wrap
