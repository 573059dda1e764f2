"""Search for further exact solutions of the updating: frequencies alone may have several."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy.stats import qmc

from monitor.core import Array
from monitor.damage.updating import Observation, UpdatingSettings, update
from monitor.model import Model

_N_STARTS = 64
"""Starting points of the search for other solutions. [count; cost]"""
_LARGEST_START_FACTOR = 4.0
"""Starting points lie between the model's stiffness divided and multiplied by this factor. [ratio; judgement]"""
_SAME_SOLUTION = 1e-3
"""Largest relative distance at which two solutions count as one. [ratio; judgement]"""
_EXACT_RESIDUAL = 1e-6
"""Largest relative residual of a solution that counts as exact. [ratio; judgement]"""


def second_solutions(
    model: Model, sensors: Annotated[Array, "c n"], observation: Observation, settings: UpdatingSettings
) -> Annotated[Array, "solutions p"]:
    """Find stiffnesses other than the model's, N/m, that reproduce the observation exactly, to which the model is updated.

    `sensors` is the sensor matrix, channels by floors.  The solutions are those that Gauss-Newton steps reach from evenly
    spread starting points, nearest first; there may be more.  None is given where there are more stiffnesses than data:
    solutions are then not isolated, and `Update.unseen` has their directions.
    """
    own = model.structure.stiffness_n_per_m
    if observation.z.size < own.size:
        return np.zeros((0, own.size))
    plain = settings.model_copy(update={"penalty": "least_squares"})
    scale = np.ones(observation.z.size) if observation.log else np.abs(observation.z)
    found = [own]
    for point in qmc.Halton(own.size, scramble=False).random(_N_STARTS + 1)[1:]:
        start = own * _LARGEST_START_FACTOR ** (2.0 * point - 1.0)
        fit = update(model.with_stiffness(start), sensors, observation, plain)
        new = all(np.abs(fit.parameters / other - 1.0).max() > _SAME_SOLUTION for other in found)
        if fit.converged and new and np.abs(fit.residual / scale).max() < _EXACT_RESIDUAL:
            found.append(fit.parameters)
    others = np.array(found[1:]).reshape(-1, own.size)
    return np.asarray(others[np.abs(np.log(others / own)).max(axis=1).argsort()])
