"""Rounding of numbers that are written for people and for files."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def rounded(value: Any, digits: int = 9) -> Any:
    """Round the floats of nested lists, mappings and arrays to significant digits; one that is not finite becomes None.

    Nine digits exceed the precision of the data and keep lines short.

    Examples
    --------
    >>> rounded({"ddi": np.array([0.1234567891, np.nan]), "window": 3})
    {'ddi': [0.123456789, None], 'window': 3}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: rounded(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part, digits) for part in value]
    return value
