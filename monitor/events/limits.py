"""The site's limits of an event: which are exceeded where, and the verdict in the site's own words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monitor.core import Array
from monitor.events.event import Event
from monitor.events.settings import LimitTable
from monitor.events.site import Site

NO_LIMIT = "no limit exceeded"


def exceedances(event: Event, site: Site) -> tuple[tuple[int, int], ...]:
    """List every limit exceeded, by its number in the site file, and the story, both from 0."""
    found = []
    for i, limit in enumerate(site.settings.limits):
        least, _, most, _ = compared(event, limit)
        found += [(i, j) for j in np.flatnonzero(np.nan_to_num(least) > most).tolist()]
    return tuple(found)


def judge(event: Event, site: Site) -> Event:
    """Compare an event with the site's limits; the verdict is None where a limit cannot be judged."""
    limits, known, n_judged = site.settings.limits, True, 0
    for limit in limits:
        least, largest, most, _ = compared(event, limit)
        judged = (least > most) | (largest <= most)  # neither where it is not known, or its interval holds the limit
        n_judged += bool(judged.all())
        # A lasting loss is known to a few percent until the revision; where that decides nothing, the drifts decide.
        known = known and bool(judged.all() or (limit.residual_loss is not None and event.revision != 1))
    exceeded = exceedances(event, site)
    words = tuple(_words(event, limits[i], site.names[j], j) for i, j in exceeded)
    verdict = limits[exceeded[0][0]].says if exceeded else NO_LIMIT if known and n_judged else None
    return replace(event, verdict=verdict, exceeded=words)


def _words(event: Event, limit: LimitTable, name: str, j: int) -> str:
    """Say which limit is exceeded in story `j`, from 0."""
    least, largest, most, what = compared(event, limit)
    return f"{limit.says} ({name}: {what} {0.5 * (least[j] + largest[j]):.2g}, limit {most:.2g})"


def compared(event: Event, limit: LimitTable) -> tuple[Array, Array, float, str]:
    """Return the interval of what a limit is about in each story, both ends of shape (n,), the limit, and the quantity's name.

    A drift is compared as it is, a lasting loss with its interval of two standard deviations.
    """
    if limit.drift_ratio is not None:
        return event.drift_ratio, event.drift_ratio, limit.drift_ratio, "drift ratio"
    assert limit.residual_loss is not None
    half = 2.0 * event.loss_std
    return event.loss - half, event.loss + half, limit.residual_loss, "lasting loss"
