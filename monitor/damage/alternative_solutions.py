"""Other stiffnesses that fit as well: frequencies alone may have several exact solutions."""

from __future__ import annotations

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


def second_solutions(model: Model, sensors: Array, observation: Observation, settings: UpdatingSettings) -> Array:
    """Stiffnesses far from the model's that reproduce the observation exactly.

    Parameters
    ----------
    model : Model
        Updated to the observation: its own solution is left out.
    sensors : ndarray, shape (c, n)
        Picks the sensors out of the floors.
    observation : Observation

    Returns
    -------
    ndarray, shape (n_solutions, p), N/m
        Nearest first; those that Gauss-Newton steps reach from evenly spread starts, so not surely all.  None where
        there are more stiffnesses than data: then solutions are no points, and `Update.unseen` tells their directions.
    """
    here = model.structure.stiffness_n_per_m
    if observation.z.size < here.size:
        return np.zeros((0, here.size))
    plain = settings.model_copy(update={"penalty": "least_squares"})
    scale = np.ones(observation.z.size) if observation.log else np.abs(observation.z)
    found = [here]
    for point in qmc.Halton(here.size, scramble=False).random(_N_STARTS + 1)[1:]:
        start = here * _LARGEST_START_FACTOR ** (2.0 * point - 1.0)
        fit = update(model.with_stiffness(start), sensors, observation, plain)
        new = all(np.abs(fit.parameters / other - 1.0).max() > _SAME_SOLUTION for other in found)
        if fit.converged and new and np.abs(fit.residual / scale).max() < _EXACT_RESIDUAL:
            found.append(fit.parameters)
    others = np.array(found[1:]).reshape(-1, here.size)
    return np.asarray(others[np.abs(np.log(others / here)).max(axis=1).argsort()])
