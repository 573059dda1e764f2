"""Compilation of functions by numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(*, part: bool = False, **options: Any) -> Callable[[_Function], _Function]:
    """Compile a function by ``numba.njit`` (`options`) without the interpreter lock, and cache the result on disk where possible.

    A `part` is called by other compiled functions.  It is compiled with each of them, never read from the disk: numba puts one
    that it has just compiled into its caller, and one from the disk it does not, so that the last digits of the caller's results
    may depend on what earlier processes left there.

    There is no cache where neither the package nor the user has a writable folder, unless ``NUMBA_CACHE_DIR`` names one: for
    example a program that root installed, run by a user without a home.  The function is then compiled again in each process,
    which takes seconds, without a message.
    """

    def wrap(function: _Function) -> _Function:
        try:
            result: _Function = njit(cache=not part, nogil=True, **options)(function)
        except RuntimeError:
            result = njit(nogil=True, **options)(function)
        return result

    return wrap
