"""Rate of a stream by its timestamps, from all of its runs: one straight line through stamps against counted samples."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

_MEMORY_S = 3600.0
"""Time over which the rate is estimated; older stamps fade. [s; convention: as the hour within which a loss is to be seen]"""


@dataclass(frozen=True, slots=True)
class StreamClock:
    """Sums of a least-squares line through the differences between stamps and counted time; the runs have one slope."""

    weight: float = 0.0
    """Of the blocks of the present run; 0 before the first."""
    mean_s: float = 0.0
    """Mean counted time of these blocks since the run's first sample."""
    mean_offset_s: float = 0.0
    """Mean of their stamps minus the counted time."""
    square: float = 0.0
    """Sum of squares of the counted times about their mean, over all runs, s^2."""
    product: float = 0.0
    """Sum of their products with the offsets about theirs, s^2."""

    @property
    def ratio(self) -> float:
        """Rate by the stamps over the stated rate, to a millionth; 1 where nothing is known."""
        slope = self.product / self.square if self.square > 0.0 else 0.0
        return round(1.0 / (1.0 + slope), 6) if slope > -0.5 else 2.0

    def begin(self) -> StreamClock:
        """Begin a run, whose first block lies on its own line."""
        return StreamClock(1.0, 0.0, 0.0, self.square, self.product)

    def add(self, counted_s: float, offset_s: float, length_s: float) -> StreamClock:
        """Add a block of the present run.

        `counted_s` is the counted time of its first sample since the run's first, `offset_s` its stamp minus that time,
        `length_s` the counted time since the block before.

        Examples
        --------
        >>> clock = StreamClock().begin()
        >>> for k in range(1, 400):  # stamps say 98 Hz, the stream 100
        ...     clock = clock.add(float(k), k * (100.0 / 98.0 - 1.0), 1.0)
        >>> clock.ratio
        0.98
        """
        kept = exp(-length_s / _MEMORY_S)
        before = kept * self.weight
        weight = before + 1.0
        away_s, away_offset_s = counted_s - self.mean_s, offset_s - self.mean_offset_s
        share = before / weight
        return StreamClock(
            weight,
            self.mean_s + away_s / weight,
            self.mean_offset_s + away_offset_s / weight,
            kept * self.square + share * away_s * away_s,
            kept * self.product + share * away_s * away_offset_s,
        )
