"""Supervision of a thread: how long its present piece of work takes."""

from __future__ import annotations

import time
from collections.abc import Callable

_ANSWER_S = 5.0
"""Length of one piece of work from which its thread counts as one that does not answer. [s; half of the ten seconds within which
a failure is told]"""


class Busy:
    """Stopwatch of a thread's present piece of work, by which others see that the thread does not answer.

    The thread does each piece of its work ``with busy:``, or between `begin` and `end`; any thread may ask `overdue`.  The clock
    counts seconds and never goes back.

    Examples
    --------
    >>> times = iter([0.0, 4.0, 7.4])
    >>> busy = Busy(lambda: next(times))
    >>> with busy:
    ...     busy.overdue, busy.overdue
    (None, 'does not answer for 7 s')
    >>> busy.overdue is None
    True
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._begun_s: float | None = None

    def begin(self) -> None:
        """Begin a piece of work."""
        self._begun_s = self._clock()

    def end(self) -> None:
        """End a piece of work; without one this has no effect."""
        self._begun_s = None

    def __enter__(self) -> None:
        """Begin a piece of work."""
        self.begin()

    def __exit__(self, *_: object) -> None:
        """End a piece of work."""
        self.end()

    @property
    def overdue(self) -> str | None:
        """Words that say for how long the thread has not answered; None while it does."""
        begun_s = self._begun_s
        seconds = 0.0 if begun_s is None else self._clock() - begun_s
        return f"does not answer for {seconds:.0f} s" if seconds >= _ANSWER_S else None
