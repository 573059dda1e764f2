"""Maximum-likelihood refinement of modes on a window's own cross-spectra (debiased Whittle).

Started from the subspace estimate, a modal model ``S = A Q A^H + N`` is fitted to the segments' cross-spectra near the
modes: A holds shapes times modal transfer functions of acceleration, Q is the covariance of the modal forces, N the
sensors' noise, and every segment has its own level, so that wind that wanders costs no information.  Fisher scoring reaches
the statistical limit in two or three steps; the information matrix then weighs the updating, and each segment's score gives its
influence on the estimate, hence the covariance.

References
----------
P. Whittle, Estimation and information in stationary time series, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al.,
The debiased Whittle likelihood, Biometrika 106 (2019) 251-266.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from monitor.results import Array, ComplexArray, ModalEstimate, Window
from monitor.settings import Settings
from monitor.spectrum import LEAKAGE_OFFSETS, leakage, overlap_correlation

_TAPS = len(LEAKAGE_OFFSETS)
_LN_NOISE_STD = 3.0


class RefinementSettings(Settings):
    """Maximum-likelihood refinement of the subspace estimate."""

    enabled: bool = True
    segment_s: float = Field(default=20.0, gt=0)
    """Length of the segments whose cross-spectra are averaged; rounded to whole blocks."""
    half_band: float = Field(default=3.0, gt=0)
    """Spectra are fitted this many of its half-power bandwidths either side of each mode, and at least 8 bins."""
    max_iterations: int = Field(default=8, ge=1)
    tolerance: float = Field(default=0.3, gt=0)
    """Converged when no parameter moves by more than this many of its standard deviations."""
    min_segments: int = Field(default=6, ge=3)


@dataclass(frozen=True, eq=False, slots=True)
class _Parameters:
    """A point of the fit."""

    ln_f: Array
    ln_damping: Array
    shapes: Array
    """Shape (c, m), real, 1 at each mode's gauge."""
    forces: Array
    """Q, shape (m, m), symmetric."""
    noise: Array
    """Shape (c,), two-sided density."""


@dataclass(frozen=True, eq=False, slots=True)
class _Layout:
    """Which bins are fitted and how parameters are numbered."""

    bins: NDArray[np.intp]
    """Indices of the bins."""
    fine_hz: Array
    """Half-bin grid, one run a band."""
    runs: tuple[tuple[int, int], ...]
    """(first point on the fine grid, number of bins) of each band."""
    gauges: tuple[int, ...]
    free: tuple[tuple[int, int], ...]
    """(mode, channel) of every free shape component."""
    pairs: tuple[tuple[int, int], ...]
    """Upper triangle of Q."""

    @property
    def n_modal(self) -> int:
        return 2 * len(self.gauges) + len(self.free)


def refine(window: Window, modes: ModalEstimate, settings: RefinementSettings) -> ModalEstimate:
    """The maximum-likelihood estimate near a subspace estimate.

    Returns
    -------
    ModalEstimate
        The subspace estimate itself where there are too few segments or the scoring does not settle nearby.
    """
    if not settings.enabled or window.segments.shape[0] < settings.min_segments:
        return modes
    layout = _layout(window, modes, settings)
    x = window.segments[:, layout.bins]
    outer: ComplexArray = np.asarray(x[:, :, :, None] * x[:, :, None, :].conj())  # (segments, bins, c, c)
    level = np.ones(outer.shape[0])
    try:
        point = _start(layout, modes, outer.mean(axis=0))
        for iteration in range(settings.max_iterations):
            spectrum, slopes = _model(layout, point)
            inverse: ComplexArray = np.asarray(np.linalg.inv(spectrum))
            level = _levels(inverse, outer)
            mean = np.tensordot(1.0 / level, outer, axes=1) / level.size
            information, score = _scoring(inverse, slopes, mean - spectrum)
            # Next to none may be known of a noise that hides below the response: a wide prior keeps it in bounds.
            noise = np.arange(len(information) - point.noise.size, len(information))
            information[noise, noise] += 1.0 / (_LN_NOISE_STD**2 * level.size)
            scale = 1.0 / np.sqrt(np.diag(information))
            covariance = scale[:, None] * np.linalg.inv(information * scale[:, None] * scale) * scale
            if not (np.isfinite(covariance).all() and np.diag(covariance).min() > 0):
                return modes
            step = covariance @ score
            moved = np.abs(step) / np.sqrt(np.diag(covariance) / level.size)
            point = _moved(layout, point, step)
            if iteration and moved[: layout.n_modal].max() < settings.tolerance:
                scores = _influence(inverse, slopes, outer, level)
                return _estimate(layout, point, modes, covariance, scores, window.first_segment)
    except np.linalg.LinAlgError:
        return modes
    return modes


def _layout(window: Window, modes: ModalEstimate, settings: RefinementSettings) -> _Layout:
    bin_hz = window.segment_bin_hz
    wanted = np.zeros(window.segments.shape[1], dtype=bool)
    for f, damping in zip(modes.frequencies_hz, modes.damping_ratio, strict=True):
        centre, half = round(f / bin_hz), max(8, round(settings.half_band * 2.0 * damping * f / bin_hz))
        wanted[max(centre - half, 4) : centre + half + 1] = True
    bins = np.flatnonzero(wanted)
    starts = np.flatnonzero(np.diff(bins, prepend=-10) > 1)
    fine: list[Array] = []
    runs = []
    for begin, end in zip(starts, [*starts[1:], bins.size], strict=True):
        first, n = bins[begin], end - begin
        runs.append((sum(len(f) for f in fine), int(n)))
        fine.append((2 * first + np.arange(LEAKAGE_OFFSETS[0], 2 * n - 1 + LEAKAGE_OFFSETS[-1])) * bin_hz / 2.0)
    gauges = tuple(int(g) for g in np.abs(modes.shapes).argmax(axis=1))
    m, c = modes.shapes.shape
    free = tuple((i, j) for i in range(m) for j in range(c) if j != gauges[i])
    pairs = tuple((a, b) for a in range(m) for b in range(a, m))
    return _Layout(bins, np.concatenate(fine), tuple(runs), gauges, free, pairs)


def _blurred(layout: _Layout, fine: ComplexArray) -> ComplexArray:
    """Blur a spectrum on the fine grid (axis -3) into the bins."""
    weights = leakage()
    parts = []
    for first, n in layout.runs:
        taps = [fine[..., first + tap : first + tap + 2 * n - 1 : 2, :, :] for tap in range(_TAPS)]
        part = weights[_TAPS // 2] * taps[_TAPS // 2]
        for tap in range(_TAPS // 2):  # the kernel is symmetric
            part += weights[tap] * (taps[tap] + taps[-1 - tap])
        parts.append(part)
    return np.concatenate(parts, axis=-3)


def _transfer(layout: _Layout, ln_f: Array, ln_damping: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Modal transfer functions of acceleration and their derivatives by ln f and ln damping, shape (n_fine, m)."""
    w = 2.0 * np.pi * layout.fine_hz[:, None]
    omega, damping = 2.0 * np.pi * np.exp(ln_f), np.exp(ln_damping)
    cross = 2j * damping * omega * w
    denominator = omega**2 - w**2 + cross
    g = -(w**2) / denominator
    return g, -g * (2.0 * omega**2 + cross) / denominator, -g * cross / denominator


def _model(layout: _Layout, p: _Parameters, *, linear_only: bool = False) -> tuple[ComplexArray, ComplexArray]:
    """Blurred spectrum, shape (bins, c, c), and its derivatives, shape (parameters, bins, c, c).

    Parameters are numbered ln f, ln damping, free shape components, Q's upper triangle, noise; with `linear_only` the
    last two kinds alone, in which the spectrum is linear.
    """
    m, c = len(layout.gauges), p.noise.size
    g, g_f, g_d = _transfer(layout, p.ln_f, p.ln_damping)
    a = p.shapes * g[:, None, :]
    aq = a @ p.forces
    halves = []
    if not linear_only:
        moved = np.zeros((layout.n_modal, g.shape[0], c), dtype=complex)  # the column of A that a parameter moves
        for i in range(m):
            moved[i] = p.shapes[:, i] * g_f[:, i, None]
            moved[m + i] = p.shapes[:, i] * g_d[:, i, None]
        for row, (i, j) in enumerate(layout.free, start=2 * m):
            moved[row, :, j] = g[:, i]
        mode_of = [*range(m), *range(m), *(i for i, _ in layout.free)]
        halves.append(moved[:, :, :, None] * aq.conj().transpose(2, 0, 1)[mode_of][:, :, None, :])
    first, second = [x for x, _ in layout.pairs], [y for _, y in layout.pairs]
    columns = a.transpose(2, 0, 1)
    force_half = columns[first][:, :, :, None] * columns[second].conj()[:, :, None, :]
    # On the diagonal of Q both halves are the same term.
    force_half *= np.where(np.equal(first, second), 0.5, 1.0)[:, None, None, None]
    halves += [force_half, (0.5 * aq @ a.conj().transpose(0, 2, 1))[None]]
    blurred = _blurred(layout, np.concatenate(halves))
    blurred = blurred + blurred.conj().swapaxes(-1, -2)
    noise = np.zeros((c, c, c), dtype=complex)
    noise[range(c), range(c), range(c)] = p.noise
    spectrum = blurred[-1] + noise.sum(axis=0)
    slopes = np.concatenate([blurred[:-1], np.broadcast_to(noise[:, None], (c, *spectrum.shape))])
    return spectrum, slopes


def _start(layout: _Layout, modes: ModalEstimate, mean: ComplexArray) -> _Parameters:
    """Modes from the subspace estimate; forces and noise, in which the spectrum is linear, by weighted least squares."""
    m, c = modes.shapes.shape
    gauge = modes.shapes[np.arange(m), list(layout.gauges)]
    power = np.einsum("kaa->a", mean).real / mean.shape[0]
    p = _Parameters(
        np.log(modes.frequencies_hz),
        np.log(modes.damping_ratio),
        (modes.shapes / gauge[:, None]).real.T,
        np.eye(m),
        0.01 * power,
    )
    weight = np.linalg.inv(mean + 0.05 * np.einsum("kaa->k", mean).real[:, None, None] * np.eye(c) / c)
    information, projection = _scoring(weight, _model(layout, p, linear_only=True)[1], mean)
    x = np.linalg.solve(information, projection)
    n_pairs = len(layout.pairs)
    forces = np.zeros((m, m))
    for (i, j), value in zip(layout.pairs, x[:n_pairs], strict=True):
        forces[i, j] = forces[j, i] = value
    values, vectors = np.linalg.eigh(forces)
    forces = (vectors * np.maximum(values, 1e-3 * values[-1])) @ vectors.T
    # The noise's slope is by its logarithm, so its coefficient is a factor.
    return replace(p, forces=forces, noise=p.noise * np.clip(x[n_pairs:], 1e-2, 1e2))


def _levels(inverse: ComplexArray, outer: ComplexArray) -> Array:
    """Maximum-likelihood level of every segment, shape (segments,), mean 1."""
    level = np.tensordot(outer, inverse.swapaxes(-1, -2), axes=3).real
    return np.asarray(level / level.mean())


def _scoring(inverse: ComplexArray, slopes: ComplexArray, residual: ComplexArray) -> tuple[Array, Array]:
    """Fisher information and score of one segment's worth of data."""
    white = inverse @ slopes
    flat = white.reshape(len(white), -1)
    information = flat @ white.swapaxes(-1, -2).reshape(len(white), -1).T
    score = flat @ (inverse @ residual).swapaxes(-1, -2).reshape(-1)
    return information.real, score.real


def _moved(layout: _Layout, p: _Parameters, step: Array) -> _Parameters:
    """A scoring step, bounded so that a bad start cannot run away."""
    m, n_free = len(layout.gauges), len(layout.free)
    shapes, forces = p.shapes.copy(), p.forces.copy()
    for (i, j), value in zip(layout.free, step[2 * m :], strict=False):
        shapes[j, i] += value
    for (i, j), value in zip(layout.pairs, step[2 * m + n_free :], strict=False):
        forces[i, j] += value
        forces[j, i] = forces[i, j]
    noise = p.noise * np.exp(np.clip(step[-p.noise.size :], -1.0, 1.0))
    ln_damping = p.ln_damping + np.clip(step[m : 2 * m], -0.5, 0.5)
    return _Parameters(p.ln_f + np.clip(step[:m], -0.02, 0.02), ln_damping, shapes, forces, noise)


def _influence(inverse: ComplexArray, slopes: ComplexArray, outer: ComplexArray, level: Array) -> Array:
    """Score of every segment, shape (segments, parameters)."""
    curve = inverse @ slopes @ inverse
    flat = curve.swapaxes(-1, -2).reshape(len(curve), -1)
    scores = (outer.reshape(level.size, -1) @ flat.T).real / level[:, None]
    return np.asarray(scores - scores.mean(axis=0))


def _estimate(
    layout: _Layout, p: _Parameters, modes: ModalEstimate, covariance: Array, scores: Array, first_segment: int
) -> ModalEstimate:
    """Frequencies, damping and real shapes of the fit with influences; imaginary parts stay the subspace estimate's."""
    m, c = modes.shapes.shape
    n = layout.n_modal
    n_segments = scores.shape[0]
    psi = scores @ covariance[:, :n] / n_segments
    # A mean has been taken out, and neighbours share half their samples: each adds its share to the variance.
    psi *= np.sqrt(n_segments / (n_segments - 1.0) * (1.0 + 2.0 * overlap_correlation()))
    factor = np.linalg.cholesky(covariance[:n, :n] / n_segments).T

    def spread(rows: Array) -> Array:
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
        deviations=spread(psi),
        first=first_segment,
        weight_factor=spread(factor),
        refined=True,
    )
