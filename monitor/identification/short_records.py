"""Intervals of the modes of a record too short for its own blocks to tell its scatter: that of the fitted modes' own motion.

A few blocks do not tell how much they scatter, and a mode that rings on from one into the next makes them alike.  So the motion
of the identified modes, with the forces and the noise that fit the record best, is simulated over many records as long, and their
lag sums go through the same linearized estimate (a parametric bootstrap to first order).  The result depends on the estimated
damping, and so is uncertain itself: intervals are those of Student's t, with degrees of freedom by Satterthwaite.  Where the
record's own blocks scatter significantly more, as with gusts or blows, theirs is stated, with the blocks' degrees of freedom.

References
----------
B. Efron, R. Tibshirani, An introduction to the bootstrap, 1993, section 6.5; F. E. Satterthwaite, An approximate distribution of
estimates of variance components, Biometrics Bulletin 2 (1946) 110-114.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from monitor.core import Array, LagSums, ModalEstimate, Window
from monitor.identification.whittle import WEAK_STD, score_weights, starting_point
from monitor.identification.whittle_model import Layout, Point, cross_spectra, layout_of, predict, product, upper
from monitor.signals import WindowGrid, windows

RECORDS = 48
"""Simulated records. [count; judgement: a standard deviation is then known within a tenth, which its interval allows for]"""
_FITS = 6
"""Steps of scoring of forces and noise. [count; cost: two or three are enough where the modes fit]"""
_LEAST_FORCE = 1e-3
"""Least eigenvalue of the forces' covariance over the largest. [ratio; as in `whittle`]"""
_LEAD = 10.0
"""Decay times of the slowest mode before the first record. [count; what is left of the start is 5e-5]"""
_LEAST_DEGREES = 1.0
"""Degrees of freedom of an interval, at least. [1; definition: one number about zero; below, Student's t has no scale]"""
_CONFIDENCE = 0.95
"""Confidence of the intervals and of the test for more scatter. [1; convention]"""


def own_motion(window: Window, modes: ModalEstimate, half_band: float) -> LagSums | None:
    """Simulate the motion of modes over `RECORDS` records as long as the window; None where no forces and noise fit."""
    if not window.segments:
        return None
    layout = layout_of(modes, half_band, len(window.segments[0]), window.segment_bin_hz)
    data = cross_spectra(layout, window.segments).mean(axis=0)
    try:
        point = _with_forces(layout, starting_point(layout, modes, data), data, len(window.segments))
    except np.linalg.LinAlgError:
        return None
    block_n, n_lags = int(window.sums.counts[0]), window.sums.products.shape[1]
    n = RECORDS * len(window.sums.counts) * block_n
    samples = _motion(point, n, window.rate_hz)
    if not np.isfinite(samples).all():
        return None
    grid = WindowGrid(window.rate_hz, n, block_n, n_lags, segment_s=0.0)
    ((simulated),) = windows.step(grid, windows.start(grid, samples.shape[1], index=0), samples, 0)[1]
    return simulated.sums if isinstance(simulated, Window) else None


def _with_forces(layout: Layout, point: Point, data: Annotated[Array, "pairs pools"], n_segments: int) -> Point:
    """Fit forces and noise to the mean cross-spectra by maximum likelihood; frequencies, damping and shapes stay."""
    from monitor.identification.whittle_kernels import inverses  # compiled code takes a while to load

    n_pairs = len(layout.pairs)
    part = slice(layout.n_modal, layout.n_modal + n_pairs + point.noise.size)
    rows, columns = np.array(layout.pairs).T
    for _ in range(_FITS):
        model = predict(layout, point)
        weights, information = score_weights(layout, inverses(model.value), model)
        score = product((data - upper(model.value))[None], weights)[0]
        normal = information[part, part].copy()
        noise = np.arange(n_pairs, len(normal))
        normal[noise, noise] += 1.0 / (WEAK_STD**2 * n_segments)
        step = np.linalg.solve(normal, score[part])
        forces = point.forces.copy()
        forces[rows, columns] += step[:n_pairs]
        forces[columns, rows] = forces[rows, columns]
        values, vectors = np.linalg.eigh(forces)
        forces = (vectors * np.maximum(values, _LEAST_FORCE * values[-1])) @ vectors.T
        point = replace(point, forces=forces, noise=point.noise * np.exp(np.clip(step[n_pairs:], -1.0, 1.0)))
    return point


def _motion(point: Point, n: int, rate_hz: float) -> Annotated[Array, "n c"]:
    """Simulate accelerations by white forces and noise; each mode is an exactly sampled resonator."""
    from scipy.signal import lfilter  # takes a third of a second to load

    hz, damping, rng = np.exp(point.ln_f), np.exp(point.ln_damping), np.random.default_rng(0)
    lead = round(min(_LEAD / (2.0 * np.pi * (hz * damping).min()) * rate_hz, n))
    values, vectors = np.linalg.eigh(point.forces)
    forces = rng.standard_normal((n + lead, hz.size)) @ (vectors * np.sqrt(np.maximum(values, 0.0) * rate_hz)).T
    poles = np.exp(2.0 * np.pi * hz / rate_hz * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    modal = [
        lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * p.real, abs(p) ** 2], f) for p, f in zip(poles, forces.T, strict=True)
    ]
    noise = np.sqrt(point.noise * rate_hz) * rng.standard_normal((n + lead, point.noise.size))
    return np.asarray((np.transpose(modal) @ point.shapes.T + noise)[lead:])


def stated(
    found: ModalEstimate, own: Annotated[Array, "blocks m 2+2c"], simulated: Annotated[Array, "k m 2+2c"] | None
) -> ModalEstimate:
    """Give an estimate the deviations of simulated records, or its own blocks' where these scatter significantly more.

    They are enlarged so that 1.96 standard deviations are Student's 95 % interval; without simulated ones all are `own`.
    """
    from scipy.special import fdtri  # takes a while to load

    n_own = max(1, len(own) - 1)
    widened = own * _students(n_own)
    if simulated is None:
        return replace(found, deviations=widened)
    # The records follow each other: the blocks of each are summed up, and each record is an estimate of its own.
    rows = simulated.reshape(RECORDS, -1, *simulated.shape[1:]).sum(axis=1) / np.sqrt(RECORDS)
    of_model, of_blocks = (rows**2).sum(axis=0), (own**2).sum(axis=0)
    degrees = np.maximum(1.0 / (0.5 * of_model[:, 1] / found.damping_ratio**2 + 1.0 / (RECORDS - 1.0)), _LEAST_DEGREES)
    more = of_blocks[:, :2] > of_model[:, :2] * fdtri(n_own, degrees, _CONFIDENCE)[:, None]
    more = more[:, [0, 1, *[0] * (own.shape[2] - 2)]]  # the shape's follow the frequency's
    rows = rows * _students(degrees)[:, None]
    size = max(len(rows), len(own))
    rows, widened = (np.pad(part, ((0, size - len(part)), (0, 0), (0, 0))) for part in (rows, widened))
    return replace(found, deviations=np.where(more, widened, rows))


def stated_refined(found: ModalEstimate) -> ModalEstimate:
    """Enlarge a refined estimate's deviations by what a short record adds: it tells damping, on which they depend, only roughly.

    One over the variance of ln damping is the number of independent data under a mode's peak: a share of them goes into the
    parameters fitted to them, by which the scatter about the fit is too small (HC2 of MacKinnon and White, see `whittle`; damping
    has its correction there).
    """
    variance = (found.damping_std / found.damping_ratio) ** 2
    m, c = found.shapes.shape
    fitted = 2 + (c - 1) + (m + 1) / 2 + (c + 2) / m
    factors = np.repeat(_students(2.0 / variance)[:, None], 2 + 2 * c, axis=1)
    factors[:, np.arange(2 + 2 * c) != 1] /= np.sqrt(1.0 - np.minimum(0.5, fitted * variance))[:, None]
    return replace(found, deviations=found.deviations * factors)


def _students(degrees: Array | float) -> Array:
    """Return Student's 95 % interval over that of the normal distribution."""
    from scipy.special import stdtrit  # takes a while to load

    likely = 0.5 + 0.5 * _CONFIDENCE
    return np.asarray(stdtrit(np.maximum(degrees, _LEAST_DEGREES), likely) / stdtrit(np.inf, likely))
