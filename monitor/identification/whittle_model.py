"""Modal model of a window's cross-spectra, ``S = A Q A^H + N``, and its derivatives, averaged over the same pools as the data.

A holds shapes times modal transfer functions of acceleration.  Q is the covariance of the modal forces, whose spectrum may have
a tilt and a curvature (excitation is seldom white over a wide band).  N is the sensors' noise.
Away from the modes the spectrum is smooth, and bins are averaged in pools, so that a wide band costs little.  Hermitian matrices
are packed as their upper triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, ModalEstimate
from monitor.signals import LEAKAGE_OFFSETS, leakage

_FIRST_BIN = 4
"""Lowest bin that is fitted. [bins; not recorded]"""
_MIN_HALF_BINS = 8
"""Least half-width of a mode's band. [bins; not recorded]"""
_POOL_WIDTH = 0.3
"""Width of a group of bins that are averaged, over its distance from the nearest mode. [ratio; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class Point:
    """Parameters of the modal model at one point of the fit: m modes, c channels."""

    ln_f: Annotated[Array, "m"]
    """ln(f / Hz)."""
    ln_damping: Annotated[Array, "m"]
    """ln of the damping ratio."""
    shapes: Annotated[Array, "c m"]
    """Real, 1 at each mode's gauge."""
    forces: Annotated[Array, "m m"]
    """Q, symmetric."""
    noise: Annotated[Array, "c"]
    """Two-sided power spectral density of the noise, (m/s^2)^2/Hz."""
    colour: Annotated[Array, "2"]
    """Tilt and curvature: forces have amplitude ``exp(tilt x + curvature x^2)``, x = ln f about mid-band."""


@dataclass(frozen=True, eq=False, slots=True)
class Layout:
    """Bins of the fit, pools of bins, and numbering of the parameters."""

    first: Annotated[NDArray[np.intp], "pools"]
    """First bin of each pool."""
    sizes: Annotated[NDArray[np.intp], "pools"]
    """Number of bins in each pool."""
    columns: NDArray[np.intp]
    """First column of each parameter in `Spectrum`."""
    nodes_hz: Annotated[Array, "pools taps"]
    """Frequencies over which the true spectrum is averaged with the weights `leakage` for a pool."""
    counts: Annotated[Array, "pairs pools"]
    """Multiplicity of each entry of a packed matrix in a sum of traces over all bins."""
    gauges: tuple[int, ...]
    """Channel at which each mode's shape is 1."""
    free: tuple[tuple[int, int], ...]
    """(mode, channel) of every free shape component."""
    pairs: tuple[tuple[int, int], ...]
    """(row, column) of the upper triangle of Q."""

    @property
    def n_modal(self) -> int:
        """Number of frequencies, damping ratios and free shape components."""
        return 2 * len(self.gauges) + len(self.free)


@dataclass(frozen=True, eq=False, slots=True)
class Spectrum:
    """Model spectrum at a point, and its derivatives by the parameters.

    The derivative by a parameter is the sum over the parameter's columns of ``u v^H`` and its conjugate transpose.  The order of
    parameters is ln f, ln damping, free shape components, Q's upper triangle, ln noise, tilt, curvature.
    """

    value: Annotated[ComplexArray, "pools c c"]
    u: Annotated[Array, "c columns"]
    v: Annotated[ComplexArray, "pools c columns"]


def layout_of(
    modes: ModalEstimate, half_band: float, n_bins: int, bin_hz: float, pool_width: float = _POOL_WIDTH
) -> Layout:
    """Select the bins within `half_band` half-power bandwidths of the modes, and divide them into pools.

    `pool_width` is the widest pool over its distance from the nearest mode; 0 leaves each bin alone.
    """
    number = np.arange(n_bins)
    centre = np.round(modes.frequencies_hz / bin_hz)
    half = np.maximum(_MIN_HALF_BINS, np.round(half_band * 2.0 * modes.damping_ratio * centre))
    distance = np.abs(number[:, None] - centre)
    bins = np.flatnonzero((distance <= half).any(axis=1) & (number >= _FIRST_BIN))
    widest = np.maximum(1, (pool_width * distance.min(axis=1)[bins]).astype(int))
    first: list[int] = []
    for band in np.split(np.arange(bins.size), np.flatnonzero(np.diff(bins) > 1) + 1):
        begin, end = int(band[0]), int(band[-1]) + 1
        while begin < end:
            first.append(begin)
            begin = min(end, begin + int(widest[begin]))
    sizes = np.diff([*first, bins.size])
    # Pooling smooths the spectrum in addition to the taper: one kernel of the taper's form with the sum of both variances
    # represents the two.
    offsets = LEAKAGE_OFFSETS / 2.0
    stretch = np.sqrt(1.0 + (sizes**2 - 1.0) / 12.0 / (leakage() @ offsets**2))
    nodes = np.maximum(0.5, (bins[first] + (sizes - 1.0) / 2.0)[:, None] + offsets * stretch[:, None])
    gauges = tuple(int(g) for g in np.abs(modes.shapes).argmax(axis=1))
    m, c = modes.shapes.shape
    free = tuple((i, j) for i in range(m) for j in range(c) if j != gauges[i])
    pairs = tuple((a, b) for a in range(m) for b in range(a, m))
    i, j = triangle(c)
    single = 2 * m + len(free) + len(pairs) + c
    columns = np.array([*range(single), single, single + m])  # tilt and curvature affect every mode: m columns each
    counts = np.where(i == j, 1.0, 2.0)[:, None] * sizes
    return Layout(bins[first], sizes, columns, nodes * bin_hz, counts, gauges, free, pairs)


def cross_spectra(layout: Layout, segments: tuple[ComplexArray, ...]) -> ComplexArray:
    """Compute each segment's cross-spectra, packed (pairs) and averaged over pools, (m/s^2)^2/Hz."""
    from monitor.identification.whittle_kernels import pool_products  # compiled code takes a while to load

    sums = np.empty((len(segments), len(layout.counts), len(layout.first)), dtype=complex)
    for segment, out in zip(segments, sums, strict=True):
        pool_products(segment, layout.first, layout.sizes, out)
    return sums


def predict(layout: Layout, p: Point) -> Spectrum:
    """Compute the model spectrum at a point of the fit, smoothed by taper and pools, and its derivatives."""
    from monitor.identification.whittle_kernels import modal_products  # compiled code takes a while to load

    (c, m), pools = p.shapes.shape, len(layout.nodes_hz)
    # Shapes do not depend on frequency, so smoothing the modes' products smooths the spectrum and all its derivatives.
    w = 2.0 * np.pi * layout.nodes_hz
    smoothed = modal_products(w, leakage(), 2.0 * np.pi * np.exp(p.ln_f), np.exp(p.ln_damping), p.colour)
    products = smoothed[:, 0]
    at_channels = (p.forces * smoothed).reshape(-1, m) @ p.shapes.T
    half, by_f, by_damping, by_tilt, by_curvature = at_channels.reshape(pools, 5, m, c).swapaxes(0, 1)
    value = p.shapes @ half + np.diag(p.noise)
    mode, channel = [i for i, _ in layout.free], [j for _, j in layout.free]
    first, second = [a for a, _ in layout.pairs], [b for _, b in layout.pairs]
    once = np.where(np.equal(first, second), 0.5, 1.0)  # on the diagonal of Q both halves are the same term
    unit = np.eye(c)
    u = [p.shapes, p.shapes, unit[:, channel], p.shapes[:, first], unit, p.shapes, p.shapes]
    rows = [
        by_f,
        by_damping,
        half[:, mode],
        (once * products[:, first, second])[:, :, None] * p.shapes.T[second],
        np.broadcast_to(0.5 * np.diag(p.noise), (len(value), c, c)),
        by_tilt,
        by_curvature,
    ]
    return Spectrum(value, np.concatenate(u, axis=1), np.concatenate(rows, axis=1).conj().swapaxes(-1, -2))


@cache
def triangle(c: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and columns of the entries of a packed matrix of size c."""
    return np.triu_indices(c)


def upper(matrices: Annotated[ComplexArray, "pools c c"]) -> Annotated[ComplexArray, "pairs pools"]:
    """Pack Hermitian matrices."""
    i, j = triangle(matrices.shape[-1])
    return matrices[:, i, j].T


def packed(layout: Layout, u: Array | ComplexArray, v: ComplexArray) -> ComplexArray:
    """Pack ``u v^H + v u^H``, summed over each parameter's columns, see `pack_columns`."""
    each = packed_columns(u, v)
    tilt, curvature = layout.columns[-2:]  # the only parameters with several columns
    each[tilt], each[tilt + 1] = each[tilt:curvature].sum(axis=0), each[curvature:].sum(axis=0)
    return each[: tilt + 2]


def packed_columns(u: Array | ComplexArray, v: ComplexArray) -> Annotated[ComplexArray, "columns pairs pools"]:
    """Pack ``u v^H + v u^H`` column by column, see `pack_columns`."""
    from monitor.identification.whittle_kernels import pack_columns  # compiled code takes a while to load

    return pack_columns(u, v)


def product(a: ComplexArray, b: ComplexArray) -> Array:
    """Compute the real parts of the inner products of `a[i]` with `b[j]` over all further axes."""
    flat_a, flat_b = (np.ascontiguousarray(x).reshape(len(x), -1).view(float) for x in (a, b))
    return np.asarray(flat_a @ flat_b.T)
