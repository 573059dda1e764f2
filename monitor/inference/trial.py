"""Trials of a search: what leaves the possible has no likelihood, and ends no search."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from monitor.core import Array

T = TypeVar("T")
U = TypeVar("U")


def tried(compute: Callable[[], T], impossible: U) -> T | U:
    """Return what a trial computes, or `impossible` where it leads to no structure or to numbers that cannot be computed.

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.inference import tried
    >>> tried(lambda: float(np.linalg.inv(np.zeros((2, 2)))[0, 0]), impossible=-np.inf)
    -inf
    """
    try:
        with np.errstate(all="ignore"):  # what overflows is not finite, and has no likelihood either
            return compute()
    except (np.linalg.LinAlgError, ArithmeticError):
        return impossible


def require_finite(*arrays: Array | float) -> None:
    """Raise LinAlgError unless all numbers are finite: the libraries below tell that in several ways."""
    if not all(np.isfinite(a).all() for a in arrays):
        raise np.linalg.LinAlgError("a number is not finite")
