"""Second opinion on modes: frequency-spatial domain decomposition, which fits the spectrum of one mode at a time.

The channels are combined by the singular vector of the spectral matrix at the mode's peak.  The power spectrum of the combination
is that of a system with one degree of freedom near the peak, and is fitted by the Whittle likelihood.

References
----------
R. Brincker, L. Zhang, P. Andersen, Modal identification of output-only systems using frequency domain decomposition, Smart
Materials and Structures 10 (2001) 441-445; L. Zhang, T. Wang, Y. Tamura, A frequency-spatial domain decomposition (FSDD) method
for operational modal analysis, Mechanical Systems and Signal Processing 24 (2010) 1227-1239.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monitor.core import Array, ComplexArray, ModalEstimate, Skipped
from monitor.signals import LEAKAGE_OFFSETS, bin_correlation, leakage, overlap_correlation

_LEAST_ALIKE = 0.8
"""Modal assurance criterion between the singular vectors of a bin and of the peak, from which the bin belongs to the mode. [1;
Brincker and others (2001)]"""
_HALF_BAND = 6.0
"""Half-width of the fitted band, in half-power bandwidths of the mode. [1; judgement]"""
BELL_PARAMETERS = 4
"""Parameters of a fitted bell: frequency, damping, size, noise; a fit takes more bins. [count; definition]"""
_MAX_ITERATIONS = 50
"""Most steps of scoring. [count; cost]"""
CONVERGED_STDS = 0.01
"""A fit has converged when no parameter changes by more than this many of its standard deviations. [1; judgement]"""
_MAX_STEP = 0.3
"""Largest change of a parameter in one step. [1; judgement]"""


@dataclass(frozen=True, slots=True)
class SingleMode:
    """Frequency and damping of one mode by itself."""

    frequency_hz: float
    frequency_std_hz: float
    damping_ratio: float
    damping_std: float
    mac: float
    """Modal assurance criterion between the singular vector at the peak and the shape of the first opinion."""


def fit_single_modes(
    segments: Sequence[ComplexArray], bin_hz: float, modes: ModalEstimate
) -> tuple[SingleMode | Skipped, ...]:
    """Fit each mode's peak in the spectral matrix by itself; skipped where there is no peak, or no bell about it.

    The transforms are of half-overlapping segments (`Window.segments`), the first opinion `modes` says where to look.
    """
    transforms = np.array(segments)
    return tuple(
        _fit(transforms, bin_hz, float(f), float(d), shape)
        for f, d, shape in zip(modes.frequencies_hz, modes.damping_ratio, modes.shapes, strict=True)
    )


def _fit(
    transforms: ComplexArray, bin_hz: float, hz: float, damping: float, shape: ComplexArray
) -> SingleMode | Skipped:
    """Fit the peak near a mode of known frequency, damping and shape."""
    centre = round(hz / bin_hz)
    bandwidth = 2.0 * damping * hz / bin_hz
    half = max(BELL_PARAMETERS, int(np.ceil(_HALF_BAND * bandwidth)))
    low, high = max(1, centre - half), min(transforms.shape[1] - 1, centre + half)
    if centre > high or high - low < 2 * BELL_PARAMETERS - 2:
        return Skipped("the peak lies at the edge of the band")
    part = transforms[:, low : high + 1]
    values, vectors = np.linalg.eigh(np.einsum("ska,skb->kab", part, part.conj()) / len(part))  # ascending
    near = np.arange(max(0, centre - low - 2 - int(bandwidth)), min(high - low, centre - low + 2 + int(bandwidth)) + 1)
    peak = int(near[values[near, -1].argmax()])
    unit = shape / np.linalg.norm(shape)
    # Of two close modes the weaker one is a later singular vector.
    macs = np.abs(unit.conj() @ vectors[peak]) ** 2
    vector = vectors[peak, :, int(macs.argmax())]
    alike = (np.abs(np.einsum("a,kab->kb", vector.conj(), vectors)) ** 2).max(axis=1) > _LEAST_ALIKE
    begin, end = peak, peak
    while begin > 0 and alike[begin - 1]:
        begin -= 1
    while end < len(alike) - 1 and alike[end + 1]:
        end += 1
    if end - begin < BELL_PARAMETERS:
        return Skipped("no bell of one shape about the peak")
    power = np.abs(part[:, begin : end + 1] @ vector.conj()) ** 2
    bins = np.arange(low + begin, low + end + 1, dtype=float)
    fitted = fit_bell(power.mean(axis=0), bins, bin_hz, np.log([hz, damping]), len(power))
    if fitted is None:
        return Skipped("the fit of the peak does not converge")
    (ln_f, ln_damping), (f_std, damping_std) = fitted
    f, d = float(np.exp(ln_f)), float(np.exp(ln_damping))
    return SingleMode(f, f * f_std, d, d * damping_std, float(macs.max()))


def fit_bell(power: Array, bins: Array, bin_hz: float, start: Array, n_segments: int) -> tuple[Array, Array] | None:
    """Fit ln f, ln damping, ln of the bell's size and ln noise to a spectrum by Fisher scoring.

    `power` is the mean power of half-overlapping segments with a Hann taper, in any unit, at the bins with the numbers `bins`;
    `start` holds the logarithms of frequency (Hz) and damping ratio from which the search begins.  The result is ln f and ln
    damping, and their standard deviations; None if the scoring does not converge.
    """
    nodes = (bins[:, None] + LEAKAGE_OFFSETS / 2.0) * bin_hz

    def log_model(x: Array) -> Array:
        """Compute the logarithm of the spectrum, blurred by the taper."""
        f, damping, size, noise = np.exp(x)
        ratio = (nodes / f) ** 2
        bell = ratio**2 / ((1.0 - ratio) ** 2 + 4.0 * damping**2 * ratio)
        return np.asarray(np.log((size * bell + noise) @ leakage()))

    def slopes(x: Array) -> Array:
        """Compute the derivatives of `log_model`."""
        step = np.cbrt(np.finfo(float).eps)  # least sum of rounding and curvature
        moved = [log_model(x + h) - log_model(x - h) for h in step * np.eye(BELL_PARAMETERS)]
        return np.asarray(np.array(moved) / (2.0 * step))

    x = np.array([*start, 0.0, np.log(power.min())])
    x[2] = np.log(power.max()) - log_model(np.array([*start, 0.0, -50.0])).max()
    information = n_segments / (1.0 + 2.0 * overlap_correlation()) / bin_correlation()
    for _ in range(_MAX_ITERATIONS):
        d = slopes(x)
        normal = information * d @ d.T + np.diag([0.0, 0.0, 0.0, 1e-2])  # noise far below the bell is hardly determined
        if not (np.isfinite(normal).all() and np.linalg.cond(normal) < 1e12):
            return None
        step = np.linalg.solve(normal, information * d @ (power / np.exp(log_model(x)) - 1.0))
        std = np.sqrt(np.diag(np.linalg.inv(normal)))
        x = x + np.clip(step, -_MAX_STEP, _MAX_STEP)
        if np.abs(step[:2] / std[:2]).max() < CONVERGED_STDS:
            inside = bins[0] * bin_hz < np.exp(x[0]) < bins[-1] * bin_hz
            return (x[:2], std[:2]) if inside and x[1] < 0.0 else None
    return None
