"""Bounds on what a live source may claim: the pace of its data, and their time, against the clocks of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable

from pydantic import Field

from drivers.base import SampleBlock
from drivers.settings import Settings

_BURST_S = 600.0
"""Length of data that may come at once, as from a sensor's cache after a broken link. [s; judgement]"""
_SANE_NS = 1_735_689_600_000_000_000
"""2025-01-01: a clock of this machine before it was never set. [ns; judgement]"""


class LiveSettings(Settings):
    """Bounds that the ``[source]`` table of a live source may set; without them a stream may run at any speed and time."""

    max_pace: float | None = Field(default=None, gt=1)
    """Greatest pace of the data's clock as a multiple of this machine's, over ten minutes; faster blocks are refused."""
    max_ahead_s: float | None = Field(default=None, gt=0)
    """Greatest time by which a block may be ahead of this machine's clock; others are refused, once the clock is set at all."""


class LiveBounds:
    """Judge of blocks by the bounds of the settings.

    The data's clock of each topic draws on an allowance, which grows with this machine's clock at `max_pace` up to ten minutes.
    A gap draws its length, for it costs as much to evaluate as the windows that it spoils; no block draws more than
    all of the allowance, so that after a jump of the clock a stream is accepted again in time.  `clock` never goes back (s).
    """

    def __init__(
        self,
        settings: LiveSettings,
        clock: Callable[[], float] = time.monotonic,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._settings, self._clock, self._utc_ns = settings, clock, utc_ns
        self._streams: dict[str, tuple[int, float, float]] = {}
        """Topic -> end of the latest block accepted, ns; allowance left then, s; and when that was, s."""

    def refusal(self, block: SampleBlock) -> str | None:
        """Return the reason why a block is refused, or None and draw on the allowance of its topic."""
        return self._ahead(block) or self._too_fast(block)

    def _ahead(self, block: SampleBlock) -> str | None:
        most_s, now_ns = self._settings.max_ahead_s, self._utc_ns()
        if most_s is None or now_ns < _SANE_NS:
            return None
        ahead_s = (block.t_ns - now_ns) * 1e-9
        if ahead_s <= most_s:
            return None
        return f"{block.topic} is {ahead_s:.0f} s ahead of this machine's clock, max_ahead_s = {most_s:g}"

    def _too_fast(self, block: SampleBlock) -> str | None:
        pace = self._settings.max_pace
        if pace is None:
            return None
        now_s, end_ns = self._clock(), block.t_ns + round(block.length_s * 1e9)
        last_ns, left_s, then_s = self._streams.get(block.topic, (block.t_ns, _BURST_S, now_s))
        left_s = min(_BURST_S, left_s + pace * (now_s - then_s))
        drawn_s = min(_BURST_S, max(block.length_s, (end_ns - last_ns) * 1e-9))
        if drawn_s > left_s:
            return f"{block.topic} comes faster than the clock allows, max_pace = {pace:g}"
        self._streams[block.topic] = end_ns, left_s - drawn_s, now_s
        return None
