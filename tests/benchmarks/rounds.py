"""Interleaved rounds: whatever the machine does meanwhile, it does to all that is compared."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Cost:
    """CPU times of one thing."""

    name: str
    seconds: list[float]

    @property
    def median(self) -> float:
        """Seconds."""
        return float(np.median(self.seconds))

    @property
    def fastest(self) -> float:
        """Seconds: of all rounds the one that others on the machine disturbed least."""
        return min(self.seconds)

    def row(self, base: Cost | None = None, unit: float = 1e3) -> str:
        """A line of a Markdown table: median, quartiles, fastest, and the median ratio to `base` with its quartiles."""
        low, high = np.quantile(self.seconds, [0.25, 0.75])
        text = f"| {self.name} | {unit * self.median:.3g} ({unit * low:.3g}-{unit * high:.3g}) | {unit * self.fastest:.3g} |"
        if base is None:
            return text
        ratio = self.over(base)
        return f"{text} {ratio[1]:.3g} ({ratio[0]:.3g}-{ratio[2]:.3g}) |"

    def over(self, base: Cost) -> list[float]:
        """Quartiles of this over `base`, round by round where both took part in all, else of the medians."""
        if len(self.seconds) == len(base.seconds):
            return [float(q) for q in np.quantile(np.divide(self.seconds, base.seconds), [0.25, 0.5, 0.75])]
        low, middle, high = np.quantile(np.divide(self.seconds, base.median), [0.25, 0.5, 0.75])
        return [float(low), float(middle), float(high)]


def interleaved(things: Mapping[str, Callable[[], object]], rounds: int, least_s: float = 0.0) -> dict[str, Cost]:
    """CPU time of everything, in turn, after one round that does not count; each is called over and over for `least_s`, as work
    that goes on, or once, as work that is come upon when others' has emptied the caches."""
    taken: dict[str, list[float]] = {name: [] for name in things}
    for number in range(rounds + 1):
        for name, thing in things.items():
            begin, calls, spent = time.process_time(), 0, 0.0
            while not calls or spent < least_s:
                thing()
                calls, spent = calls + 1, time.process_time() - begin
            if number:
                taken[name].append(spent / calls)
    return {name: Cost(name, seconds) for name, seconds in taken.items()}
