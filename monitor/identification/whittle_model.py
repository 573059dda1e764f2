"""The modal model of a window's cross-spectra: ``S = A Q A^H + N`` with its slopes, pooled as the data are.

A holds shapes times modal transfer functions of acceleration, Q is the covariance of the modal forces, whose spectrum
may slope and bend (excitation is seldom white over a wide band), N the sensors' noise.
Away from the modes, where the spectrum is smooth, bins are pooled, so that a wide band costs little.  Hermitian matrices are
packed as their upper triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

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
    """A point of the fit."""

    ln_f: Array
    ln_damping: Array
    shapes: Array
    """Shape (c, m), real, 1 at each mode's gauge."""
    forces: Array
    """Q, shape (m, m), symmetric."""
    noise: Array
    """Shape (c,), two-sided density."""
    colour: Array
    """Shape (2,), tilt and curvature: forces have amplitude ``exp(tilt x + curvature x^2)``, x = ln f about mid-band."""


@dataclass(frozen=True, eq=False, slots=True)
class Layout:
    """Which bins are fitted, how they are pooled, and how parameters are numbered."""

    first: NDArray[np.intp]
    """First bin of each pool."""
    sizes: NDArray[np.intp]
    """Bins in each pool."""
    columns: NDArray[np.intp]
    """Where each parameter's columns begin in `Spectrum`."""
    nodes_hz: Array
    """Shape (pools, taps): a pool's spectrum is the mean of the true one over these, weighed by `leakage`."""
    counts: Array
    """Shape (pairs, pools): how often each entry of a packed matrix counts in a sum of traces over all bins."""
    gauges: tuple[int, ...]
    free: tuple[tuple[int, int], ...]
    """(mode, channel) of every free shape component."""
    pairs: tuple[tuple[int, int], ...]
    """Upper triangle of Q."""

    @property
    def n_modal(self) -> int:
        """Number of frequencies, damping ratios and free shape components."""
        return 2 * len(self.gauges) + len(self.free)


@dataclass(frozen=True, eq=False, slots=True)
class Spectrum:
    """The model at a point; its slope by a parameter is the sum over its columns of ``u v^H`` and the conjugate transposes.

    Parameters are numbered ln f, ln damping, free shape components, Q's upper triangle, ln noise, tilt, curvature.
    """

    value: ComplexArray
    """Shape (pools, c, c)."""
    u: Array
    """Shape (c, columns)."""
    v: ComplexArray
    """Shape (pools, c, columns)."""


def layout_of(modes: ModalEstimate, half_band: float, n_bins: int, bin_hz: float) -> Layout:
    """Bins within `half_band` half-power bandwidths of the modes, in pools.

    Parameters
    ----------
    n_bins : int
        Bins there are, from 0 Hz up, `bin_hz` apart.
    """
    number = np.arange(n_bins)
    centre = np.round(modes.frequencies_hz / bin_hz)
    half = np.maximum(_MIN_HALF_BINS, np.round(half_band * 2.0 * modes.damping_ratio * centre))
    distance = np.abs(number[:, None] - centre)
    bins = np.flatnonzero((distance <= half).any(axis=1) & (number >= _FIRST_BIN))
    widest = np.maximum(1, (_POOL_WIDTH * distance.min(axis=1)[bins]).astype(int))
    first: list[int] = []
    for band in np.split(np.arange(bins.size), np.flatnonzero(np.diff(bins) > 1) + 1):
        begin, end = int(band[0]), int(band[-1]) + 1
        while begin < end:
            first.append(begin)
            begin = min(end, begin + int(widest[begin]))
    sizes = np.diff([*first, bins.size])
    # A pool blurs besides the taper: one kernel of the taper's form and of both their spreads stands for the two.
    offsets = LEAKAGE_OFFSETS / 2.0
    stretch = np.sqrt(1.0 + (sizes**2 - 1.0) / 12.0 / (leakage() @ offsets**2))
    nodes = np.maximum(0.5, (bins[first] + (sizes - 1.0) / 2.0)[:, None] + offsets * stretch[:, None])
    gauges = tuple(int(g) for g in np.abs(modes.shapes).argmax(axis=1))
    m, c = modes.shapes.shape
    free = tuple((i, j) for i in range(m) for j in range(c) if j != gauges[i])
    pairs = tuple((a, b) for a in range(m) for b in range(a, m))
    i, j = triangle(c)
    single = 2 * m + len(free) + len(pairs) + c
    columns = np.array([*range(single), single, single + m])  # the forces' colour moves every mode
    counts = np.where(i == j, 1.0, 2.0)[:, None] * sizes
    return Layout(bins[first], sizes, columns, nodes * bin_hz, counts, gauges, free, pairs)


def cross_spectra(layout: Layout, segments: tuple[ComplexArray, ...]) -> ComplexArray:
    """Every segment's cross-spectra, means over pools, packed, shape (segments, pairs, pools)."""
    from monitor.identification.whittle_kernels import pool_products  # compiled code takes a while to load

    sums = np.empty((len(segments), len(layout.counts), len(layout.first)), dtype=complex)
    for segment, out in zip(segments, sums, strict=True):
        pool_products(segment, layout.first, layout.sizes, out)
    return sums


def predict(layout: Layout, p: Point) -> Spectrum:
    """The spectrum that a point of the fit gives, blurred by taper and pools, and its slopes."""
    from monitor.identification.whittle_kernels import modal_products  # compiled code takes a while to load

    (c, m), pools = p.shapes.shape, len(layout.nodes_hz)
    # Shapes are constant over frequency, so blurring the modes' products blurs the spectrum and all its slopes.
    w = 2.0 * np.pi * layout.nodes_hz
    blurred = modal_products(w, leakage(), 2.0 * np.pi * np.exp(p.ln_f), np.exp(p.ln_damping), p.colour)
    products = blurred[:, 0]
    carried = (p.forces * blurred).reshape(-1, m) @ p.shapes.T
    half, by_f, by_damping, by_tilt, by_curvature = carried.reshape(pools, 5, m, c).swapaxes(0, 1)
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
    """Rows and columns of the entries of a packed matrix of size c."""
    return np.triu_indices(c)


def upper(matrices: ComplexArray) -> ComplexArray:
    """Pack Hermitian matrices, shape (pools, c, c) to (pairs, pools)."""
    i, j = triangle(matrices.shape[-1])
    return matrices[:, i, j].T


def packed(layout: Layout, u: Array | ComplexArray, v: ComplexArray) -> ComplexArray:
    """Packed ``u v^H + v u^H`` from columns of shape (.., c, columns), shape (parameters, pairs, pools)."""
    each = packed_columns(u, v)
    tilt, curvature = layout.columns[-2:]  # the only ones of several columns
    each[tilt], each[tilt + 1] = each[tilt:curvature].sum(axis=0), each[curvature:].sum(axis=0)
    return each[: tilt + 2]


def packed_columns(u: Array | ComplexArray, v: ComplexArray) -> ComplexArray:
    """The same, column by column, shape (columns, pairs, pools)."""
    from monitor.identification.whittle_kernels import pack_columns  # compiled code takes a while to load

    return pack_columns(u, v)


def product(a: ComplexArray, b: ComplexArray) -> Array:
    """Real parts of the inner products of the rows of `a` with those of `b`, shape (n_a, n_b)."""
    flat_a, flat_b = (np.ascontiguousarray(x).reshape(len(x), -1).view(float) for x in (a, b))
    return np.asarray(flat_a @ flat_b.T)
