"""What went wrong lately at a source that is at work: a line of the log a minute, and words for whoever asks."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

_SAY_EVERY_S = 60.0
"""Shortest time between two lines of the log about what went wrong, such as refused blocks. [s; judgement]"""


class Recent:
    """Teller of what goes wrong again and again, as with each block of a foreign publisher; `clock` never goes back (s).

    Examples
    --------
    >>> recent = Recent(clock=iter([0.0, 59.0, 60.0]).__next__)
    >>> recent.tell("a block is refused")
    >>> recent.latest, recent.latest
    ('a block is refused', '')
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._said_s = float("-inf")
        self._latest: tuple[str, float] = "", float("-inf")

    def tell(self, words: str) -> None:
        """Keep what went wrong, and log it unless something was logged less than a minute ago."""
        now_s, words = self._clock(), " ".join(words.split())[:300]  # a foreign writer may have named what it liked
        self._latest = words, now_s
        if now_s - self._said_s >= _SAY_EVERY_S:
            self._said_s = now_s
            _log.warning("%s", words)

    @property
    def latest(self) -> str:
        """What went wrong last, within a minute; empty if nothing did."""
        words, told_s = self._latest
        return words if self._clock() - told_s < _SAY_EVERY_S else ""
