"""Work on all cores comes back as if it had been done by one."""

from __future__ import annotations

import time
import warnings

import numpy as np
import pytest

from monitor.parallel import each


def test_results_stand_in_the_order_of_the_items() -> None:
    def slow(n: int) -> int:
        time.sleep(0.01 * (5 - n))
        return n * n

    assert each(slow, range(5)) == [0, 1, 4, 9, 16]
    assert each(slow, []) == []


def test_the_callers_handling_of_errors_holds() -> None:
    def overflow(x: float) -> float:
        return float(np.float64(x) * 1e308)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with np.errstate(over="ignore"):
            assert each(overflow, [10.0, 1.0]) == [np.inf, 1e308]
        with np.errstate(over="raise"), pytest.raises(FloatingPointError):
            each(overflow, [10.0])


def test_what_an_item_raises_reaches_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        each(lambda n: 1 / n, [1, 0, 2])
