"""What a set of sensors will tell before there are data: which stiffnesses the modes in the band determine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from monitor.core import DIRECTION_WORDS, Array, storey_of, together
from monitor.damage.sequential_test import STRETCHES
from monitor.damage.updating import Observation, predict
from monitor.model import InstrumentedModel

_FORESEEN_SHAPE_STD = 0.03
"""Standard deviation of a component of a shape whose largest is 1. [1; judgement]"""
_LEAST_MOTION = 0.1
"""Motion at the sensors in a mode of unit modal mass, over the largest of any mode, below which they do not see the mode.
[ratio; judgement]"""
_TOLD_STD = 0.05
"""Largest standard deviation of a loss that is told. [ratio; definition: two of them are a loss of 10 %]"""


def foreseen_covariance(site: InstrumentedModel, modes: Sequence[int], span_s: float) -> Annotated[Array, "p p"]:
    """Predict the covariance of the relative changes of stiffness by the modes (0 = lowest) that are in the band.

    `span_s` is the length of the data, s.  A mode under white noise that is observed without error tells the logarithm of its
    eigenvalue with the variance 4 zeta / (omega T): the Fisher information of omega^2 is T var(x) / S, where S is the noise's
    intensity and var(x) = S / (4 zeta omega^3).
    """
    sensors, found = site.sensor_matrix, site.model.modes()
    shapes = found.shapes[:, list(modes)]
    moved = np.abs(sensors @ shapes)
    seen = np.flatnonzero(moved.max(axis=0, initial=0.0) > _LEAST_MOTION * moved.max(initial=1e-300))
    prior = np.diag(site.stiffness_prior_std**-2.0)
    if not seen.size:
        return np.asarray(np.linalg.inv(prior), dtype=np.float64)
    used = tuple(int(modes[k]) for k in seen.tolist())
    gauges = tuple(moved[:, seen].argmax(axis=0).tolist())
    size = len(used) * len(sensors)
    nothing = Observation(np.zeros(size), np.eye(size), np.zeros((0, size)), used, gauges, log=True)
    sensitivity = predict(site.model, sensors, nothing, with_masses=False)[1] * site.model.structure.stiffness_n_per_m
    omega, zeta = np.sqrt(found.eigenvalues[list(used)]), site.model.damping_ratios()[list(used)]
    std = np.append(np.sqrt(4.0 * zeta / (omega * span_s)), np.full(size - len(used), _FORESEEN_SHAPE_STD))
    scaled = sensitivity / std[:, None]
    return np.asarray(np.linalg.inv(prior + scaled.T @ scaled))


def what_sensors_see(site: InstrumentedModel, modes: Sequence[int], names: Sequence[str], window_s: float) -> list[str]:
    """Say which of a building's storeys the sensors tell apart, of which direction only the whole, and what they do not see.

    The data are as long as alarms average, in windows of `window_s`, s.
    """
    covariance = foreseen_covariance(site, modes, STRETCHES[-1] * window_s)
    told = np.sqrt(np.diag(covariance)) <= _TOLD_STD
    directions, says = [DIRECTION_WORDS[place[1]] for place in map(storey_of, names) if place is not None], []
    groups = {words: [j for j, own in enumerate(directions) if own == words] for words in dict.fromkeys(directions)}
    for words, members in groups.items():
        of_data = np.linalg.inv(covariance[np.ix_(members, members)]).sum()
        whole = of_data - (site.stiffness_prior_std[members] ** -2.0).sum() >= _TOLD_STD**-2.0
        which = [names[j] for j in members if told[j]]
        if len(which) == len(members):
            says.append(f"{words}: every storey is told from the others")
        elif which:
            rest = "only as a whole" if whole else "not"
            of_them = together(which, names).replace(f", {words}", "").replace(f" {words}", "")
            says.append(f"{words}: told are {of_them}, the others {rest}")
        elif whole:
            says.append(
                f"{words}: seen as a whole: a loss moves the frequencies, but no storey is told from the others"
            )
        else:
            says.append(f"{words}: not seen")
    return says + [f"{words}: not seen, and not judged" for words in DIRECTION_WORDS.values() if words not in groups]
