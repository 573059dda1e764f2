"""Drift of a sensor: a slow wander that one channel has alone, and its power density in the compared band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.signals.channel_faults import FALSE_RATE
from monitor.signals.welch import MAIN_LOBE_BINS

_EXPONENTS = (1, 2, 3, 4)
"""Exponents with which the power of a drift falls: flicker noise, a random walk, and their integrals. [1; definition]"""
_ROUNDS = 20
"""Rounds of reweighted least squares. [count; cost]"""


@dataclass(frozen=True, eq=False, slots=True)
class Drift:
    """Drift of one channel."""

    channel: int
    exponent: int
    """Exponent with which its power falls as the frequency rises; 2 for a random walk."""
    density: Annotated[Array, "bins"]
    """Power density of the drift in the band, (m/s^2)^2/Hz."""
    ruled: Annotated[NDArray[np.bool_], "bins"]
    """Mask of the band's bins in which the drift is more than half of the channel's power."""


def find_drift(transforms: Annotated[ComplexArray, "segments bins c"], first: int) -> tuple[Drift, ...]:
    """Find the channels whose drift reaches into the compared band.

    Below the band, the part of a channel that no other channel shares is white noise, and where the sensor drifts also a power
    law of the frequency.  The law is fitted there and continued into the band.  Too few bins or segments show none.

    Parameters
    ----------
    transforms
        From 0 Hz up to the band's end, Hann taper.
    first
        First bin of the band.
    """
    n, n_bins, c = transforms.shape
    if first < MAIN_LOBE_BINS + c or n <= 2 * c:
        return ()
    own, unshared = _spectra(transforms)
    # A constant offset reaches the bins of the main lobe at 0 Hz.
    below, found, degrees = np.arange(MAIN_LOBE_BINS, first), [], n - c + 1
    for channel in range(c):
        alone = unshared[MAIN_LOBE_BINS:first, channel]
        if not (alone > 0.0).all():
            continue
        white = _log_likelihood(alone, np.full(alone.size, alone.mean()), degrees)
        laws = [_fit(alone, (below / first) ** -float(s), degrees) for s in _EXPONENTS]
        best = int(np.argmax([fit for fit, _ in laws]))
        fit, size = laws[best]
        if fit - white > np.log(c * len(_EXPONENTS) / FALSE_RATE):
            density = size * (np.arange(first, n_bins) / first) ** -float(_EXPONENTS[best])
            found.append(Drift(channel, _EXPONENTS[best], density, density > 0.5 * own[first:, channel]))
    return tuple(found)


def density(drifts: Sequence[Drift], n_bins: int, n_channels: int) -> Annotated[Array, "bins c"] | None:
    """Collect the power density of all channels' drift in the band, (m/s^2)^2/Hz; None where none drifts."""
    if not drifts:
        return None
    out = np.zeros((n_bins, n_channels))
    for drift in drifts:
        out[:, drift.channel] = drift.density
    return out


def _fit(power: Array, law: Array, degrees: int) -> tuple[float, float]:
    """Fit white noise and a law of given form to a spectrum by maximum likelihood; return log likelihood and size of the law."""
    columns = np.stack([np.ones(law.size), law], axis=1)
    model = np.full(power.size, power.mean())
    size = np.zeros(2)
    for _ in range(_ROUNDS):  # the standard deviation of a power is in proportion to itself
        weighted = columns / model[:, None]
        size = np.linalg.lstsq(weighted, power / model, rcond=None)[0]
        if size.min() < 0.0:  # neither noise nor law can be negative
            kept = int(size.argmax())
            one = weighted[:, kept]
            size = np.where(np.arange(2) == kept, (one @ (power / model)) / (one @ one), 0.0)
        model = np.maximum(columns @ size, np.finfo(float).tiny)
    return _log_likelihood(power, model, degrees), float(size[1])


def _log_likelihood(power: Array, model: Array, degrees: int) -> float:
    """Compute the log likelihood of powers that are the means of `degrees` exponentially distributed ones, nats."""
    return float(-degrees * (np.log(model) + power / model).sum())


def _spectra(transforms: ComplexArray) -> tuple[Annotated[Array, "bins c"], Annotated[Array, "bins c"]]:
    """Compute each channel's power density, and of that what is not coherent with the other channels."""
    spectra = np.einsum("ska,skb->kab", transforms, transforms.conj()) / transforms.shape[0]
    own = np.einsum("kaa->ka", spectra).real
    scale = np.sqrt(np.maximum(own, np.finfo(float).tiny))
    coherence = spectra / (scale[:, :, None] * scale[:, None, :])
    inverse = np.linalg.inv(coherence + 1e-12 * np.eye(transforms.shape[2]))
    return own, own / np.einsum("kaa->ka", inverse).real
