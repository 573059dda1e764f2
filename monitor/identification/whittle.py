"""Maximum-likelihood refinement of modes on a window's own cross-spectra (debiased Whittle).

From the subspace estimate as starting point, a modal model (`whittle_model`) is fitted to the segments' cross-spectra near the
modes.  Every segment has its own excitation level, so that a varying wind costs no information.  Fisher scoring reaches the
statistical limit in two or three steps.  The information matrix gives the weights of the updating.  The covariance of the
estimate has the form of the inverse information and the size of the scatter of the segments' scores.  As far as the form of the
scatter differs significantly, the covariance follows the scatter in form too.

References
----------
P. Whittle, Estimation and information in stationary time series, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al.,
The debiased Whittle likelihood, Biometrika 106 (2019) 251-266; O. Ledoit, M. Wolf, A well-conditioned estimator for
large-dimensional covariance matrices, Journal of Multivariate Analysis 88 (2004) 365-411; J. G. MacKinnon, H. White, Some
heteroskedasticity-consistent covariance matrix estimators with improved finite sample properties, Journal of Econometrics 29
(1985) 305-325.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from monitor.core import Array, ComplexArray, ModalEstimate, Settings, Window
from monitor.identification.whittle_model import (
    Layout,
    Point,
    Spectrum,
    cross_spectra,
    layout_of,
    packed,
    packed_columns,
    predict,
    product,
    triangle,
    upper,
)
from monitor.signals import overlap_correlation

WEAK_STD = 3.0
"""Prior standard deviation of a parameter that the data hardly determine. [1; not recorded]"""
_MAX_START_RATIO = 20.0
"""Power of the data over the model's from which no fit is tried. [ratio; simulation: between 1 and 2 where a start
leads anywhere]"""
_MAX_ENTRIES = 4_000_000
"""Largest size of the spectrum's slopes. [count; cost: some twenty channels with eight modes]"""


class RefinementSettings(Settings):
    """``[refinement]``: maximum-likelihood refinement of the subspace estimate."""

    enabled: bool = True
    segment_s: float = Field(default=20.0, gt=0)
    """Length of the segments whose cross-spectra are averaged; rounded to whole blocks.  Modes whose half-power bandwidth
    (2 x damping ratio x frequency) is below 1.5 / `segment_s` get too narrow an interval of damping: make it longer for them."""
    half_band: float = Field(default=12.0, gt=0)
    """Half-width of the fitted band about each mode, in half-power bandwidths of the mode; at least 8 bins."""
    max_iterations: int = Field(default=8, ge=1)
    tolerance: float = Field(default=0.3, gt=0)
    """Convergence when no modal parameter changes by more than this many of its standard deviations."""
    min_segments: int = Field(default=6, ge=3)


def refine(window: Window, modes: ModalEstimate, settings: RefinementSettings) -> ModalEstimate:
    """Refine a subspace estimate, the starting point, by maximum likelihood, with deviations.

    The subspace estimate itself is returned where there are too few segments, where so many channels would make the scoring too
    slow, or where the scoring does not converge near the start.
    """
    from monitor.identification.whittle_kernels import inverses  # compiled code takes a while to load

    if not settings.enabled or len(window.segments) < settings.min_segments:
        return modes
    layout = layout_of(modes, settings.half_band, len(window.segments[0]), window.segment_bin_hz)
    if layout.columns.size * layout.counts.size > _MAX_ENTRIES:
        return modes
    data = cross_spectra(layout, window.segments)
    n_segments, n_modal = len(data), layout.n_modal
    try:
        point = starting_point(layout, modes, data.mean(axis=0))
        for iteration in range(settings.max_iterations):
            model = predict(layout, point)
            inverse = inverses(model.value)
            level = _levels(layout, inverse, data)
            if level.mean() > _MAX_START_RATIO:  # the response is not of these modes: the scoring would diverge
                return modes
            level /= level.mean()
            weights, information = score_weights(layout, inverse, model)
            mean = np.tensordot(1.0 / level, data, axes=1) / n_segments
            score = product((mean - upper(model.value))[None], weights)[0]
            # Noise far below the response is hardly determined by the data: a wide prior bounds it.
            weak = np.arange(n_modal + len(layout.pairs), len(information))
            information[weak, weak] += 1.0 / (WEAK_STD**2 * n_segments)
            if not np.diag(information).min() > 0.0:  # more modes than the channels can distinguish
                return modes
            scale = 1.0 / np.sqrt(np.diag(information))
            covariance = scale[:, None] * np.linalg.inv(information * scale[:, None] * scale) * scale
            if not (np.isfinite(covariance).all() and np.diag(covariance).min() > 0):
                return modes
            step = covariance @ score
            step_stds = np.abs(step) / np.sqrt(np.diag(covariance) / n_segments)
            point = take_step(layout, point, step)
            if iteration and step_stds[:n_modal].max() < settings.tolerance:
                scores = product(data, weights) / level[:, None]
                influence = (scores - scores.mean(axis=0)) @ covariance[:, :n_modal] / n_segments
                rows, factor = shrunk_uncertainty(influence, covariance[:n_modal, :n_modal] / n_segments)
                damping = slice(point.ln_f.size, 2 * point.ln_f.size)
                rows[:, damping] *= _leverage(rows[:, damping], len(information) / point.ln_f.size)
                return _estimate(layout, point, modes, rows, factor, window.first_segment)
    except np.linalg.LinAlgError:
        return modes
    return modes


def score_weights(layout: Layout, inverse: ComplexArray, model: Spectrum) -> tuple[ComplexArray, Array]:
    """Compute the weights of a packed spectrum in its score by each parameter, and a segment's Fisher information."""
    weights = packed(layout, inverse @ model.u, inverse @ model.v) * layout.counts
    return weights, product(weights, packed(layout, model.u[None], model.v))


def starting_point(layout: Layout, modes: ModalEstimate, mean: Annotated[ComplexArray, "pairs pools"]) -> Point:
    """Compute the starting point: modes from the subspace estimate, forces and noise by weighted least squares.

    The spectrum is linear in forces and noise.  `mean` is the mean packed cross-spectrum.
    """
    from monitor.identification.whittle_kernels import inverses  # compiled code takes a while to load

    m, c = modes.shapes.shape
    gauge = modes.shapes[np.arange(m), list(layout.gauges)]
    i, j = triangle(c)
    power = mean[i == j].real
    shapes, noise = (modes.shapes / gauge[:, None]).real.T, 0.01 * (power @ layout.sizes) / layout.sizes.sum()
    p = Point(np.log(modes.frequencies_hz), np.log(modes.damping_ratio), shapes, np.eye(m), noise, np.zeros(2))
    rough = np.zeros((mean.shape[1], c, c), dtype=complex)
    rough[:, i, j] = mean.T
    rough[:, j, i] = mean.conj().T
    rough[:, range(c), range(c)] = (power + 0.05 * power.mean(axis=0)).T
    model, inverse = predict(layout, p), inverses(rough)
    linear = slice(layout.n_modal, layout.columns[-2])
    u, v = model.u[:, linear], model.v[:, :, linear]
    weights = packed_columns(inverse @ u, inverse @ v) * layout.counts
    x = np.linalg.solve(product(weights, packed_columns(u[None], v)), product(mean[None], weights)[0])
    n_pairs = len(layout.pairs)
    forces = np.zeros((m, m))
    for (a, b), entry in zip(layout.pairs, x[:n_pairs], strict=True):
        forces[a, b] = forces[b, a] = entry
    values, vectors = np.linalg.eigh(forces)
    forces = (vectors * np.maximum(values, 1e-3 * values[-1])) @ vectors.T
    # The derivative is by the logarithm of the noise, so its coefficient is a factor.
    return replace(p, forces=forces, noise=p.noise * np.clip(x[n_pairs:], 1e-2, 1e2))


def _levels(layout: Layout, inverse: ComplexArray, data: ComplexArray) -> Annotated[Array, "segments"]:
    """Estimate the excitation level of each segment by maximum likelihood, relative to the model's."""
    weight = upper(inverse) * layout.counts
    return np.asarray(product(data, weight[None])[:, 0] / (inverse.shape[-1] * layout.sizes.sum()))


def take_step(layout: Layout, p: Point, step: Array) -> Point:
    """Add a scoring step to a point, with bounds so that the scoring cannot diverge from a bad start."""
    m, n_free = len(layout.gauges), len(layout.free)
    shapes, forces = p.shapes.copy(), p.forces.copy()
    for (i, j), value in zip(layout.free, step[2 * m :], strict=False):
        shapes[j, i] += value
    for (i, j), value in zip(layout.pairs, step[2 * m + n_free :], strict=False):
        forces[i, j] += value
        forces[j, i] = forces[i, j]
    ln_noise, colour = np.split(np.clip(step[2 * m + n_free + len(layout.pairs) :], -1.0, 1.0), [p.noise.size])
    ln_f, ln_damping = p.ln_f + np.clip(step[:m], -0.02, 0.02), p.ln_damping + np.clip(step[m : 2 * m], -0.5, 0.5)
    return Point(ln_f, ln_damping, shapes, forces, p.noise * np.exp(ln_noise), p.colour + colour)


def shrunk_uncertainty(influence: Annotated[Array, "segments n"], covariance: Array) -> tuple[Array, Array]:
    """Compute rows of influence whose squares sum to the shrunk covariance, and a factor of the model's covariance.

    In coordinates where the model's covariance, by the information matrix and correct up to a factor, is the identity, the
    covariance of the segments' scatter is shrunk towards a multiple of the identity.  The shrinkage is the ratio of its sampling
    error to its departure from that multiple (Ledoit and Wolf).  A covariance estimated from some 40 segments alone would give
    the damage index the long tails of Student's t.
    """
    n_segments = len(influence)
    factor = np.linalg.cholesky(covariance)
    # The mean was subtracted, and neighbouring segments share half their samples: both increase the variance.
    inflate = np.sqrt(n_segments / (n_segments - 1.0) * (1.0 + 2.0 * overlap_correlation()))
    white = inflate * np.linalg.solve(factor, influence.T).T
    values, vectors = np.linalg.eigh(white.T @ white)
    departure = ((values - values.mean()) ** 2).sum()
    sampling = ((white**2).sum(axis=1) ** 2).sum() - (values**2).sum() / n_segments
    share = min(1.0, sampling / max(departure, 1e-300))
    # Fewer segments than parameters do not span all directions: only those spanned are rescaled.
    spanned = values > 1e-9 * values[-1]
    values, vectors = values[spanned], vectors[:, spanned]
    turn = np.sqrt(1.0 - share + share * values.mean() / values)
    return np.asarray(white @ (vectors * turn) @ vectors.T @ factor.T), np.asarray(factor.T)


def _leverage(rows: Annotated[Array, "segments m"], n_fitted: float) -> Annotated[Array, "m"]:
    """Compute the leverage correction of the deviations of ln damping (HC3 of MacKinnon and White).

    One over the variance of ln damping is the number of independent data under the mode's peak.  `n_fitted` parameters a mode are
    fitted to these data, which to second order increases the error.
    """
    return np.asarray(1.0 / (1.0 - np.minimum(0.5, n_fitted * (rows**2).sum(axis=0))))


def _estimate(
    layout: Layout, p: Point, modes: ModalEstimate, rows: Array, factor: Array, first_segment: int
) -> ModalEstimate:
    """Form the estimate of a fit: frequencies, damping and real shapes; imaginary parts stay the subspace estimate's."""
    m, c = modes.shapes.shape

    def spread(rows: Annotated[Array, "n modal"]) -> Annotated[Array, "n m 2+2c"]:
        """Arrange rows by modal parameter as deviations."""
        out = np.zeros((rows.shape[0], m, 2 + 2 * c))
        out[:, :, 0] = rows[:, :m]
        out[:, :, 1] = rows[:, m : 2 * m] * np.exp(p.ln_damping)
        for column, (i, j) in enumerate(layout.free):
            out[:, i, 2 + j] = rows[:, 2 * m + column]
        return out

    return replace(
        modes,
        frequencies_hz=np.exp(p.ln_f),
        damping_ratio=np.exp(p.ln_damping),
        shapes=p.shapes.T + 1j * modes.shapes.imag,
        deviations=spread(rows),
        first=first_segment,
        weight_factor=spread(factor),
        refined=True,
    )
