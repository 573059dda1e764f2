"""The level of motion: RMS drift of the stories, from a window's accelerations and the model's modes."""

from __future__ import annotations

import numpy as np

from monitor.core import Array
from monitor.model import Model, Modes

_LEAST_M = 1e-15
"""Drift below which a sensor that stands still is not told from another. [m; rounding]"""


def drift_weights(model: Model, sensors: Array, cutoff_hz: float) -> Array:
    """Compute the weights of the accelerations' covariance in the mean square drift.

    The accelerations are resolved into the modes below the cutoff, as many as there are channels at most.  A mode's
    displacement is its acceleration over ``omega^2``; modes are taken as uncorrelated.

    Parameters
    ----------
    model : Model
        Drawing of the structure.  Weights and level then do not depend on the baseline.
    sensors : ndarray, shape (c, n)
        Sensor matrix: channels by floors.

    Returns
    -------
    ndarray, shape (c, c), s^4
        Mean over the stories of the square drift is the sum of the products with the covariance, (m/s^2)^2.
    """
    return _weights(model.modes(), model.structure.drift_matrix(), sensors, cutoff_hz)


def drift_weights_of_some(
    model: Model, sensors: Array, channels: tuple[int, ...], cutoff_hz: float, whole: Array, motion: Array | None
) -> Array:
    """Compute the weights with which some of the channels measure the same level as all of them.

    Fewer channels than modes do not resolve the modes, and acceleration of a high mode, taken for a low one's, is far more drift.
    So the modes are estimated with the powers that they had at calibration (linear least squares), and the weights are scaled to
    measure the motion at calibration as all channels did.

    Parameters
    ----------
    model : Model
        Drawing of the structure.
    sensors : ndarray, shape (c, n)
        Sensor matrix of all channels.
    channels : tuple of int
        Channels in use (0 = first), k of them.
    whole : ndarray, shape (c, c), s^4
        Weights of all channels (`drift_weights`).
    motion : ndarray, shape (c, c), (m/s^2)^2, optional
        Covariance of the accelerations at calibration.  By default that of modes of equal damping in forces of equal strength.

    Returns
    -------
    ndarray, shape (k, k), s^4
    """
    drifts = model.structure.drift_matrix()
    return _weights_of_some(model.modes(), drifts, sensors, channels, cutoff_hz, whole, motion)


def displacement_weights(modes: Modes, channels: tuple[int, ...], motion: Array | None) -> Array:
    """Compute the weights of some channels' covariance in the mean square displacement of all channels, as `drift_weights`.

    Fewer channels than there are measure the same level as all of them (`drift_weights_of_some`).

    Parameters
    ----------
    modes : Modes
        Modes as the channels show them.
    channels : tuple of int
        Channels in use (0 = first), k of them.
    motion : ndarray, shape (c, c), (m/s^2)^2, optional
        As of `drift_weights_of_some`.

    Returns
    -------
    ndarray, shape (k, k), s^4
    """
    every = np.eye(len(modes.shapes))
    whole = _weights(modes, every, every, np.inf)
    if len(channels) == len(every):
        return whole
    return _weights_of_some(modes, every, every, channels, np.inf, whole, motion)


def _weights(modes: Modes, displayed: Array, sensors: Array, cutoff_hz: float) -> Array:
    """Compute the weights, shape (c, c), of a mean square of motions that the rows of `displayed` make of the displacements."""
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
) -> Array:
    """Compute the weights, shape (k, k), of the mean square in `_weights` by some of the channels (`drift_weights_of_some`)."""
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


def level_db(weights: Array, covariance: Array) -> float:
    """Compute the RMS drift, mean over the stories, in dB of 1 m.

    Parameters
    ----------
    weights : ndarray, shape (c, c)
        See `drift_weights`.
    covariance : ndarray, shape (c, c), (m/s^2)^2
        Covariance of a window's accelerations.
    """
    return float(10.0 * np.log10(max(float(np.sum(weights * covariance)), _LEAST_M**2)))


def drift_m(db: float) -> float:
    """Convert a level in dB to the RMS drift in m.

    Examples
    --------
    >>> drift_m(-120.0)
    1e-06
    """
    return float(10.0 ** (db / 20.0))
