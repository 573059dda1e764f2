"""The level of motion: RMS drift of the stories, from a window's accelerations and the model's modes."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.model import Model, Modes

_LEAST_M = 1e-15
"""Drift below which a sensor that stands still is not told from another. [m; rounding]"""


def drift_weights(model: Model, sensors: Annotated[Array, "c n"], cutoff_hz: float) -> Annotated[Array, "c c"]:
    """Compute the weights of the accelerations' covariance in the mean square drift, mean over the stories, s^4.

    The accelerations are resolved into the modes below the cutoff, as many as there are channels at most.  A mode's displacement
    is its acceleration over ``omega^2``; modes are taken as uncorrelated.  The model is the drawing: weights and level then do
    not depend on the baseline.  `sensors` is the sensor matrix, channels by floors.
    """
    return _weights(model.modes(), model.structure.drift_matrix(), sensors, cutoff_hz)


def drift_weights_of_some(
    model: Model,
    sensors: Annotated[Array, "c n"],
    channels: tuple[int, ...],
    cutoff_hz: float,
    whole: Annotated[Array, "c c"],
    motion: Annotated[Array, "c c"] | None,
) -> Annotated[Array, "k k"]:
    """Compute the weights with which some of the channels (0 = first) measure the same level as all of them, s^4.

    Fewer channels than modes do not resolve the modes, and acceleration of a high mode, taken for a low one's, is far more
    drift.  So the modes are estimated with the powers that they had at calibration (linear least squares), and the weights are
    scaled to measure the motion at calibration as all channels did.  `whole` are the weights of all channels; `motion` is the
    covariance of the accelerations at calibration, (m/s^2)^2, by default that of modes of equal damping in forces of equal
    strength.
    """
    drifts = model.structure.drift_matrix()
    return _weights_of_some(model.modes(), drifts, sensors, channels, cutoff_hz, whole, motion)


def displacement_weights(
    modes: Modes, channels: tuple[int, ...], motion: Annotated[Array, "c c"] | None
) -> Annotated[Array, "k k"]:
    """Compute the weights of some channels' covariance in the mean square displacement of all channels, s^4, as `drift_weights`.

    Fewer channels than there are measure the same level as all of them (`drift_weights_of_some`).  The modes are as the channels
    show them.
    """
    every = np.eye(len(modes.shapes))
    whole = _weights(modes, every, every, np.inf)
    if len(channels) == len(every):
        return whole
    return _weights_of_some(modes, every, every, channels, np.inf, whole, motion)


def _weights(modes: Modes, displayed: Array, sensors: Array, cutoff_hz: float) -> Annotated[Array, "c c"]:
    """Compute the weights of a mean square of motions that the rows of `displayed` make of the displacements."""
    used = max(1, min(len(sensors), int(np.count_nonzero(modes.frequencies_hz < cutoff_hz))))
    shapes = modes.shapes[:, :used]
    resolved = np.linalg.pinv(sensors @ shapes, rcond=1e-6)
    drift = ((displayed @ shapes) ** 2).mean(axis=0) / modes.eigenvalues[:used] ** 2
    return np.asarray(resolved.T @ (drift[:, None] * resolved))


def _weights_of_some(
    modes: Modes,
    displayed: Array,
    sensors: Array,
    channels: tuple[int, ...],
    cutoff_hz: float,
    whole: Array,
    motion: Array | None,
) -> Annotated[Array, "k k"]:
    """Compute the weights of the mean square in `_weights` by some of the channels (`drift_weights_of_some`)."""
    chosen = list(channels)
    used = max(1, int(np.count_nonzero(modes.frequencies_hz < cutoff_hz)))
    shapes, eigenvalues = modes.shapes[:, :used], modes.eigenvalues[:used]
    seen = sensors @ shapes
    if motion is None:
        power = np.sqrt(eigenvalues)
        motion = (seen * power) @ seen.T
    else:
        resolved = np.linalg.pinv(seen, rcond=1e-6)
        power = np.maximum(np.diag(resolved @ motion @ resolved.T), 0.0)
    shown = seen[chosen]
    resolved = (power[:, None] * shown.T) @ np.linalg.pinv((shown * power) @ shown.T, rcond=1e-9, hermitian=True)
    drift = ((displayed @ shapes) ** 2).mean(axis=0) / eigenvalues**2
    weights = np.asarray(resolved.T @ (drift[:, None] * resolved))
    by_some, by_all = float(np.sum(weights * motion[np.ix_(chosen, chosen)])), float(np.sum(whole * motion))
    if not (by_some > 0.0 and by_all > 0.0):
        return _weights(modes, displayed, sensors[chosen], cutoff_hz)
    return weights * (by_all / by_some)


def level_db(weights: Annotated[Array, "c c"], covariance: Annotated[Array, "c c"]) -> float:
    """Compute the RMS drift, mean over the stories, in dB of 1 m, from the covariance of a window's accelerations, (m/s^2)^2."""
    return float(10.0 * np.log10(max(float(np.sum(weights * covariance)), _LEAST_M**2)))


def drift_m(db: float) -> float:
    """Convert a level in dB to the RMS drift in m.

    Examples
    --------
    >>> drift_m(-120.0)
    1e-06
    """
    return float(10.0 ** (db / 20.0))
