"""The mean of many windows' modes, with its covariance."""

from __future__ import annotations

import numpy as np

from monitor.core import Array, ModalEstimate
from monitor.damage.updating import Observation, UpdatingSettings, observe


def mean_observation(windows: list[ModalEstimate], settings: UpdatingSettings) -> Observation:
    """Average the observations of several windows, all with the same modes of the model in the same order.

    Windows that overlap share data.  Their influences are added before squaring, so that the covariance of the mean counts
    shared data once.  The gauges are those of the first window.
    """
    gauges = observe(windows[0], settings).gauges
    observations = [observe(m, settings, gauges if settings.use_shapes else None) for m in windows]
    influence: dict[tuple[bool, int], Array] = {}
    for m, o in zip(windows, observations, strict=True):
        for b, row in enumerate(o.deviations):
            place = (m.refined, m.first + b)
            influence[place] = influence.get(place, 0.0) + row / len(windows)
    deviations = np.array(list(influence.values()))
    last = observations[-1]
    # The weights between components are those of a window; their common scale follows from the scatter of the data.
    shape_of_weight = np.mean([o.weight for o in observations], axis=0)
    shrink = np.mean((deviations**2).sum(axis=0) * np.diag(shape_of_weight)) if len(windows) > 1 else 1.0
    return Observation(
        z=np.mean([o.z for o in observations], axis=0),
        weight=shape_of_weight / shrink,
        deviations=deviations,
        model_mode=last.model_mode,
        gauges=gauges,
        log=last.log,
    )
