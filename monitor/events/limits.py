"""The site's limits of an event: which are exceeded where, and the verdict in the site's own words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.events.event import Event
from monitor.events.settings import LimitTable
from monitor.events.site import Site

NO_LIMIT = "no limit exceeded"
POSSIBLY = "possibly exceeded: "
"""Begin of what is said where a drift that is a lower bound lies below a limit. [words; definition]"""


@dataclass(frozen=True, eq=False, slots=True)
class Compared:
    """What a limit is compared with, in each story; NaN where it is not known."""

    what: str
    limit: float
    value: Annotated[Array, "n"]
    least: Annotated[Array, "n"]
    """Beyond the limit, it is exceeded: the drift itself, and the lower end of the loss's interval."""
    largest: Annotated[Array, "n"]
    """Within the limit, it is not exceeded: the upper end of the interval of two standard deviations; infinite where `value` is a
    lower bound."""

    @property
    def possibly(self) -> Annotated[NDArray[np.bool_], "n"]:
        """Stories in which the limit may be exceeded, as their drift is a lower bound (`Event.is_bound`)."""
        return np.asarray(np.isposinf(self.largest) & ~(self.least > self.limit))


def compared(event: Event, limit: LimitTable) -> Compared:
    """Return what a limit is compared with."""
    if limit.drift_ratio is not None:
        drift, std = event.drift_m, event.drift_std_m
        shares = np.divide(std, drift, out=np.zeros_like(drift), where=drift > 0.0)
        largest = event.drift_ratio * (1.0 + 2.0 * shares)
        largest = np.where(event.is_bound & np.isfinite(event.drift_ratio), np.inf, largest)
        return Compared("drift ratio", limit.drift_ratio, event.drift_ratio, event.drift_ratio, largest)
    assert limit.residual_loss is not None
    half = 2.0 * event.loss_std
    return Compared("lasting loss", limit.residual_loss, event.loss, event.loss - half, event.loss + half)


def exceedances(event: Event, site: Site) -> tuple[tuple[int, int], ...]:
    """List every limit exceeded, then every one possibly exceeded, by its number in the site file, and the story, both from 0."""
    sure, possible = list[tuple[int, int]](), list[tuple[int, int]]()
    for i, limit in enumerate(site.settings.limits):
        c = compared(event, limit)
        sure += [(i, j) for j in np.flatnonzero(np.nan_to_num(c.least) > c.limit).tolist()]
        possible += [(i, j) for j in np.flatnonzero(c.possibly).tolist()]
    return (*sure, *possible)


def judge(event: Event, site: Site) -> Event:
    """Compare an event with the site's limits; the verdict is None where a limit cannot be judged."""
    limits, known, n_judged = site.settings.limits, True, 0
    for limit in limits:
        c = compared(event, limit)
        judged = (c.least > c.limit) | (c.largest <= c.limit)  # neither where it is not known, or its interval holds it
        n_judged += bool(judged.all())
        # A lasting loss is known to a few percent until the revision; where that decides nothing, the drifts decide.
        known = known and bool(judged.all() or (limit.residual_loss is not None and event.revision != 1))
    exceeded = exceedances(event, site)
    words = tuple(_words(event, limits[i], site.names[j], j) for i, j in exceeded)
    verdict = NO_LIMIT if known and n_judged else None
    if exceeded:
        i, j = exceeded[0]
        verdict = (POSSIBLY if compared(event, limits[i]).possibly[j] else "") + limits[i].says
    return replace(event, verdict=verdict, exceeded=words)


def _words(event: Event, limit: LimitTable, name: str, j: int) -> str:
    """Say which limit is exceeded in story `j`, from 0."""
    c = compared(event, limit)
    begin, least = POSSIBLY if c.possibly[j] else "", "at least " if np.isposinf(c.largest[j]) else ""
    return f"{begin}{limit.says} ({name}: {c.what} {least}{c.value[j]:.2g}, limit {c.limit:.2g})"
