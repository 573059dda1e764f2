"""Loss of stiffness by the quiet motion just before and just after an event, which is known with the final line.

Each mode's peak in the spectrum of its motion is fitted before and after by the same estimator, so that what is wrong with the
estimator, and a machine's line, are in both and cancel.  The stiffness of the stories then follows from the ratios of the modes'
frequencies.  Less than a minute on either side tells a story's stiffness to a few percent: the revision replaces it.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.events.motion import SEARCHED
from monitor.events.record import Record
from monitor.events.site import Site
from monitor.identification import BELL_PARAMETERS, CONVERGED_STDS, fit_bell

_DAMPING = 0.02
"""Damping ratio from which the fit of a peak begins. [ratio; judgement: it has no influence on the converged fit]"""
_STEPS = 20
"""Gauss-Newton steps from the ratios of frequencies to those of stiffness; half the stiffness lost takes five. [count; cost]"""
_NOTHING = 0.5
"""Standard deviation of a loss from which nothing is told. [ratio; definition: its interval then spans the whole stiffness]"""


def early_loss(
    record: Record, site: Site, near_hz: Annotated[Array, "m"]
) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"], str]:
    """Compare the stiffness just after an event with that just before, by the frequencies of all modes.

    The peaks are looked for about `near_hz`.  Return losses and standard deviations relative to the stiffness before, NaN where
    they cannot be told, and why they cannot be, in words; empty where one is told of a story.
    """
    n, strong = site.n_stories, record.strong
    nothing = np.full(n, np.nan)
    if not (site.is_chain and n):
        return nothing, nothing, ""
    if record.still.any():
        return nothing, nothing, "without every sensor no loss is told yet"
    before = _peaks(record.floors[: strong.start], site, near_hz, record.rate_hz)
    after = _peaks(record.floors[strong.stop :], site, near_hz, record.rate_hz)
    ratio, variance = 2.0 * (after[0] - before[0]), 4.0 * (before[1] + after[1])
    told = np.isfinite(ratio)
    if told.sum() < n:
        why = f"the motion beside it shows {told.sum()} of the modes, too few to tell a loss of {n} stories yet"
        return nothing, nothing, why
    return *_losses(ratio[told], variance[told], told, site), ""


def _peaks(
    part: Annotated[Array, "samples c"], site: Site, near_hz: Annotated[Array, "m"], rate_hz: float
) -> tuple[Annotated[Array, "m"], Annotated[Array, "m"]]:
    """Fit each mode's peak in a stretch of motion; return logarithms of frequencies and variances, NaN where none is."""
    n, c = part.shape
    ln_hz, variance = np.full(near_hz.size, np.nan), np.full(near_hz.size, np.nan)
    if n < 2:
        return ln_hz, variance
    used = site.shapes[:c]
    coordinates = (part - part.mean(axis=0)) @ np.linalg.pinv(used)
    power = np.abs(np.fft.rfft(coordinates * np.hanning(n + 1)[:n, None], axis=0)) ** 2
    bin_hz = rate_hz / n
    middles = np.sqrt(near_hz[1:] * near_hz[:-1])  # between neighbouring modes
    lows = np.maximum(SEARCHED[0] * near_hz, np.append(0.0, middles))
    highs = np.minimum(SEARCHED[1] * near_hz, np.append(middles, 0.5 * rate_hz))
    for k in range(len(used)):
        bins = np.arange(max(1, int(np.ceil(lows[k] / bin_hz))), min(len(power), int(highs[k] / bin_hz) + 1))
        if bins.size <= BELL_PARAMETERS:
            continue
        own = power[bins, k]
        if not own.min() > 0.0:
            continue
        start = np.log([bins[own.argmax()] * bin_hz, _DAMPING])
        fitted = fit_bell(own / own.max(), bins.astype(float), bin_hz, start, 1)
        if fitted is not None:
            (ln_hz[k], _), (std, _) = fitted
            variance[k] = std**2
    return ln_hz, variance


def _losses(
    ratio: Annotated[Array, "told"], variance: Annotated[Array, "told"], told: Annotated[Array, "m"], site: Site
) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"]]:
    """Find the losses of stiffness that change the squared frequencies as measured, by weighted least squares.

    Of the modes `told` these are the logarithms of the ratios of squared frequencies, after over before, and their variances.
    """
    n, root = site.n_stories, np.sqrt(site.masses_kg)
    rows = site.drifts / root  # drifts of the stories by the floors' motion times the roots of their masses
    healthy = np.linalg.eigvalsh((rows.T * site.stiffness_n_per_m) @ rows)[: told.size][told]
    ln_kept, nothing = np.zeros(n), np.full(n, np.nan)
    weights = 1.0 / np.sqrt(variance)
    for _ in range(_STEPS):
        stiffness = site.stiffness_n_per_m * np.exp(ln_kept)
        values, vectors = np.linalg.eigh((rows.T * stiffness) @ rows)
        values, vectors = values[: told.size][told], vectors[:, : told.size][:, told]
        # Share of each story in a mode's strain energy: by how much its frequency follows the story's stiffness.
        shares = stiffness * (rows @ vectors).T ** 2 / values[:, None]
        weighted = weights[:, None] * shares
        if np.linalg.matrix_rank(weighted) < n:
            return nothing, nothing
        step = np.linalg.lstsq(weighted, weights * (ratio - np.log(values / healthy)), rcond=None)[0]
        ln_kept = ln_kept + np.clip(step, -1.0, 1.0)
    kept = np.exp(ln_kept)
    std = kept * np.sqrt(np.diag(np.linalg.inv(weighted.T @ weighted)))
    known = (std < _NOTHING) & (np.abs(step) < CONVERGED_STDS * std)
    return np.where(known, 1.0 - kept, np.nan), np.where(known, std, np.nan)
