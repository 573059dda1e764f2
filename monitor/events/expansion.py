"""Drifts of stories that no sensors enclose: as many of the model's modes as there are sensors follow from these, the others
from the measured ground.

With modal coordinates q'' + 2 z w q' + w^2 q = -g a of a ground that moves by a, every mode's motion follows from the ground and
the model.  That of the lowest modes, of which the sensors tell more than the model does, is replaced by what the sensors
measure.  How wrong the whole is, the sensors tell as well: each is left out in turn, and its motion estimated from the others.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.events.motion import integrated, peak_drifts
from monitor.events.record import Record, relative_motion
from monitor.events.site import Site


def expanded_drifts(record: Record, site: Site) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"]]:
    """Estimate the largest drift of each story and its standard deviation, m.

    The standard deviation joins that of the integration, the share by which the estimate of a sensor's motion from the ground and
    the other sensors is wrong at worst, and by how much leaving a sensor out changes the drift itself at most.
    """
    assert record.ground is not None
    rate_hz, everything = record.rate_hz, np.ones(len(site.channels), dtype=bool)
    floors = _floors(record, site, everything)
    drift, std, _ = peak_drifts(floors @ site.drifts.T, rate_hz, record.corners_hz, record.strong)
    corner_hz, wrong, changed = float(record.corners_hz[0]), 0.0, np.zeros(len(site.drifts))
    measured = relative_motion(record, site)
    for left_out in range(len(everything)):
        others = everything.copy()
        others[left_out] = False
        estimated = _floors(record, site, others)
        missed = estimated @ site.sensors[left_out] - measured[:, left_out]
        columns = np.column_stack([measured[:, left_out], missed, (estimated - floors) @ site.drifts.T])
        moved, error, *changes = np.abs(integrated(columns, rate_hz, corner_hz, 2)[record.strong]).max(axis=0)
        wrong, changed = max(wrong, float(error / moved)), np.maximum(changed, changes)
    return drift, np.sqrt(std**2 + (wrong * drift) ** 2 + changed**2)


def _floors(record: Record, site: Site, used: Annotated[NDArray[np.bool_], "c"]) -> Annotated[Array, "samples floors"]:
    """Estimate the accelerations of all floors relative to the ground by the channels `used`, m/s^2."""
    assert record.ground is not None
    modal = _driven_modes(record.ground, record.rate_hz, site)
    seen = site.sensors[used] @ site.floor_shapes
    n_seen = int(np.linalg.matrix_rank(seen[:, : used.sum()])) if used.any() else 0
    if n_seen:
        measured = relative_motion(record, site)[:, used]
        measured = measured - measured[: max(record.strong.start, 1)].mean(axis=0)
        modal[:, :n_seen] = (measured - modal[:, n_seen:] @ seen[:, n_seen:].T) @ np.linalg.pinv(seen[:, :n_seen]).T
    return np.asarray(modal @ site.floor_shapes.T)


def _driven_modes(ground: Annotated[Array, "samples"], rate_hz: float, site: Site) -> Annotated[Array, "samples m"]:
    """Compute the modes' accelerations relative to the ground that drives them."""
    n = ground.size
    s = 2j * np.pi * np.fft.rfftfreq(2 * n, 1.0 / rate_hz)[:, None]
    w, shares = 2.0 * np.pi * site.modes_hz, site.masses_kg @ site.floor_shapes
    response = -shares * s**2 / (s**2 + 2.0 * site.damping * w * s + w**2)
    driven = np.fft.rfft(ground - ground.mean(), 2 * n)[:, None] * response
    return np.asarray(np.fft.irfft(driven, 2 * n, axis=0)[:n])
