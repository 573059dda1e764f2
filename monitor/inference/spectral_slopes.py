"""Slopes of a prediction by its parameters, whitened, as a fit needs them: their information, and their products with residuals.

The whitened slopes have one row for every number in the spectra of every class.  With many channels they take gigabytes, and
most coordinates change the spectra of all classes in proportion.  So the slopes are kept before they are whitened, once for
all classes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, compiled
from monitor.inference.wishart import cholesky, invert_lower

_BINS = 32
"""Bins that are whitened together. [count; cost: their rows stay in the processor's cache]"""
_JOINT = 1e-7
"""Share of the diagonal up to which what stands beside it is zero. [ratio; rounding]"""


class Slopes(ABC):
    """Whitened slopes of a prediction by some of its parameters, a matrix of shape (rows, p)."""

    information: Array
    """Fisher information of the data: the slopes' transpose times the slopes, shape (p, p)."""

    @abstractmethod
    def along(self, rows: Array) -> Array:
        """Multiply the slopes' transpose by whitened rows, shape (rows,) or (rows, k); shape (p,) or (p, k)."""

    @abstractmethod
    def by(self, chosen: NDArray[np.intp]) -> Slopes:
        """Return the slopes by some of the parameters, whose indices are `chosen`."""


@dataclass(frozen=True, eq=False)
class RowSlopes(Slopes):
    """Slopes that are kept whitened."""

    rows: Array
    """Shape (rows, p)."""

    @cached_property
    def information(self) -> Array:  # type: ignore[override]
        """See `Slopes.information`."""
        return np.asarray(self.rows.T @ self.rows)

    def along(self, rows: Array) -> Array:
        """See `Slopes.along`."""
        return np.asarray(self.rows.T @ rows)

    def by(self, chosen: NDArray[np.intp]) -> RowSlopes:
        """See `Slopes.by`."""
        return RowSlopes(np.ascontiguousarray(self.rows[:, chosen]))


@dataclass(frozen=True, eq=False)
class JoinedSlopes(Slopes):
    """Slopes by some parameters that are not computed again, then those by the others."""

    frozen: Slopes
    others: RowSlopes
    information: Array
    """See `Slopes.information`."""

    @classmethod
    def of(cls, frozen: Slopes, others: RowSlopes) -> JoinedSlopes:
        """Join slopes."""
        across = frozen.along(others.rows)
        return cls(frozen, others, np.block([[frozen.information, across], [across.T, others.information]]))

    def along(self, rows: Array) -> Array:
        """See `Slopes.along`."""
        return np.concatenate([self.frozen.along(rows), self.others.along(rows)])

    def by(self, chosen: NDArray[np.intp]) -> Slopes:
        """See `Slopes.by`.  Those of the frozen ones must come first."""
        n = len(self.frozen.information)
        return JoinedSlopes.of(self.frozen.by(chosen[chosen < n]), self.others.by(chosen[chosen >= n] - n))


@dataclass(frozen=True, eq=False)
class SpectralSlopes(Slopes):
    """Slopes of the spectra of all classes, kept before they are whitened."""

    shared: Array
    """Slopes of the middle class, see `packed`, shape (n_shared, c * c, n_bins)."""
    scale: Array
    """Factor from these to the slopes of every class, shape (classes, n_shared)."""
    own: Array
    """Slopes by coordinates that change the classes in different ways, shape (n_own, classes, c * c, n_bins)."""
    order: NDArray[np.intp]
    """Where each parameter stands among the shared and then the own ones, shape (p,)."""
    root: ComplexArray
    """Lower triangular matrices that whiten the spectra of a class and bin and weight them by the root of their information,
    shape (classes, c, c, n_bins)."""
    information: Array
    """See `Slopes.information`."""

    @classmethod
    def at(
        cls, shared: Array, scale: Array, own: Array, order: NDArray[np.intp], spectra: ComplexArray, root: Array
    ) -> SpectralSlopes:
        """Whiten slopes by predicted spectra.

        Parameters
        ----------
        spectra : ndarray, shape (classes, n_bins, c, c)
        root : ndarray, shape (classes, n_bins)
            Root of the information in each bin.
        """
        whitening = _whitening(spectra, root)
        information = _information(shared, scale, own, whitening)
        return cls(shared, scale, own, order, whitening, information[np.ix_(order, order)])

    def along(self, rows: Array) -> Array:
        """See `Slopes.along`."""
        columns = rows[:, None] if rows.ndim == 1 else rows
        changes = np.empty((columns.shape[1], len(self.root), *self.shared.shape[1:]))
        for change, column in zip(changes, columns.T, strict=True):
            change[:] = _unwhitened(self.root, np.ascontiguousarray(column))
        (k, classes), n = changes.shape[:2], self.shared[0].size
        shared = self.shared.reshape(-1, n) @ changes.reshape(k * classes, n).T
        shared = np.einsum("pkc,cp->pk", shared.reshape(len(shared), k, classes), self.scale)
        own = self.own.reshape(-1, classes * n) @ changes.reshape(k, classes * n).T
        out = np.concatenate([shared, own])[self.order]
        return out[:, 0] if rows.ndim == 1 else out

    def by(self, chosen: NDArray[np.intp]) -> SpectralSlopes:
        """See `Slopes.by`."""
        return replace(self, order=self.order[chosen], information=self.information[np.ix_(chosen, chosen)])


def _information(shared: Array, scale: Array, own: Array, root: ComplexArray) -> Array:
    """Compute the information on the shared, then on the own parameters, shape (p, p)."""
    joint = _joint_directions(root)
    if joint is not None:
        return _joint_information(shared, scale, own, *joint)
    n, p, (classes, c, _, bins) = len(shared), len(shared) + len(own), root.shape
    out = np.zeros((p, p))
    re, im = np.ascontiguousarray(root.real), np.ascontiguousarray(root.imag)
    ones = np.ones(len(own))
    for first in range(0, bins, _BINS):
        rows = np.empty((p, c * c, min(_BINS, bins - first)))
        for k in range(classes):
            _whiten(re[k], im[k], shared, scale[k], first, rows[:n])
            _whiten(re[k], im[k], own[:, k], ones, first, rows[n:])
            flat = rows.reshape(p, -1)
            out += flat @ flat.T
    return out


def _joint_directions(root: ComplexArray) -> tuple[ComplexArray, Array] | None:
    """Find directions in which the spectra of all classes are diagonal, as those of one model at several levels are.

    Returns
    -------
    directions : ndarray, shape (c, c, n_bins)
        T, with ``root_k^H root_k = T^H diag(weight_k) T``.
    weight : ndarray, shape (classes, c, n_bins)
        None instead of both where there are no such directions.
    """
    roots = np.moveaxis(root, -1, 1)
    compared = np.abs(roots).max(axis=(0, 2, 3)) > 0.0
    roots = roots[:, compared]
    try:
        inverse = np.linalg.inv(roots[0])
    except np.linalg.LinAlgError:  # a bin of one class alone is left out
        return None
    over_first = roots @ inverse
    relative = over_first.conj().swapaxes(-1, -2) @ over_first
    vectors = np.linalg.eigh(relative[-1])[1]
    diagonal = vectors.conj().swapaxes(-1, -2) @ relative @ vectors
    weight = np.einsum("kfaa->kaf", diagonal).real
    apart = np.abs(diagonal - np.einsum("kaf,ab->kfab", weight, np.eye(weight.shape[1]))).max(initial=0.0, axis=(2, 3))
    if not (apart <= _JOINT * weight.max(axis=1)).all():
        return None
    c, bins = root.shape[1], root.shape[-1]
    directions, weights = np.zeros((c, c, bins), dtype=complex), np.zeros((len(root), c, bins))
    directions[..., compared] = np.moveaxis(vectors.conj().swapaxes(-1, -2) @ roots[0], 0, -1)
    weights[..., compared] = weight
    return directions, weights


def _joint_information(shared: Array, scale: Array, own: Array, directions: ComplexArray, weight: Array) -> Array:
    """Compute as `_information` with slopes that are turned once for all classes, see `_joint_directions`."""
    c, bins = directions.shape[1:]
    main = (scale == scale[:, :1]).all(axis=0)
    first, others = np.flatnonzero(main), np.flatnonzero(~main)
    level, classes = scale[:, first[0]], range(len(scale))
    order = np.concatenate([first, others, np.arange(len(shared), len(shared) + len(own))])
    n, p = first.size, order.size
    re, im = np.ascontiguousarray(directions.real), np.ascontiguousarray(directions.imag)
    rows, columns = np.tril_indices(c)
    twice = np.repeat([(i, j) for i, j in zip(rows, columns, strict=True)], np.where(rows == columns, 1, 2), axis=0)
    factor = np.where(twice[:, 0] == twice[:, 1], 1.0, 2.0)[:, None]
    ordered = np.zeros((p, p))
    for at in range(0, bins, _BINS):
        m = min(_BINS, bins - at)

        def turned(slopes: Array, at: int = at, m: int = m) -> Array:
            out = np.empty((len(slopes), c * c, m))
            _turn(re, im, slopes, at, out)
            return out

        weights = factor * weight[:, twice[:, 0], at : at + m] * weight[:, twice[:, 1], at : at + m]
        of_first, of_others = turned(shared[first]), turned(shared[others])
        of_class = [np.concatenate([of_others * scale[k, others, None, None], turned(own[:, k])]) for k in classes]
        alike = (of_first * np.sqrt(np.tensordot(level**2, weights, axes=1))).reshape(n, -1)
        ordered[:n, :n] += alike @ alike.T
        across = sum(level[k] * weights[k] * of_class[k] for k in classes)
        ordered[:n, n:] += of_first.reshape(n, -1) @ across.reshape(p - n, -1).T
        for k in classes:
            ordered[n:, n:] += (of_class[k] * weights[k]).reshape(p - n, -1) @ of_class[k].reshape(p - n, -1).T
    ordered[n:, :n] = ordered[:n, n:].T
    out = np.empty((p, p))
    out[np.ix_(order, order)] = ordered
    return out


@compiled(error_model="numpy")
def _turn(re: Array, im: Array, slopes: Array, first: int, out: Array) -> None:
    """Compute ``T dS T^H`` of packed slopes of some bins, packed.

    Parameters
    ----------
    re, im : ndarray, shape (c, c, n_bins)
        T.
    slopes : ndarray, shape (p, c * c, n_bins)
    first : int
        First bin.
    out : ndarray, shape (p, c * c, m)
    """
    p, _, m = out.shape
    c = re.shape[0]
    half_re, half_im = np.empty((2, c, m))
    t_re, t_im = np.empty(m), np.empty(m)
    for q in range(p):
        for i in range(c):
            for b in range(c):
                for k in range(m):
                    half_re[b, k], half_im[b, k] = 0.0, 0.0
                for a in range(c):
                    if a == b:
                        at = b * b + 2 * b
                        for k in range(m):
                            s = slopes[q, at, first + k]
                            half_re[b, k] += re[i, a, first + k] * s
                            half_im[b, k] += im[i, a, first + k] * s
                    else:
                        at = max(a, b) * max(a, b) + 2 * min(a, b)
                        sign = 1.0 if a > b else -1.0
                        for k in range(m):
                            x, y = slopes[q, at, first + k], sign * slopes[q, at + 1, first + k]
                            half_re[b, k] += re[i, a, first + k] * x - im[i, a, first + k] * y
                            half_im[b, k] += re[i, a, first + k] * y + im[i, a, first + k] * x
            for j in range(i + 1):
                for k in range(m):
                    t_re[k], t_im[k] = 0.0, 0.0
                for b in range(c):
                    for k in range(m):
                        x, y = re[j, b, first + k], -im[j, b, first + k]
                        t_re[k] += half_re[b, k] * x - half_im[b, k] * y
                        t_im[k] += half_re[b, k] * y + half_im[b, k] * x
                at = i * i + 2 * j
                for k in range(m):
                    out[q, at, k] = t_re[k]
                if i > j:
                    for k in range(m):
                        out[q, at + 1, k] = t_im[k]


@compiled(error_model="numpy")
def _whitening(spectra: ComplexArray, root: Array) -> ComplexArray:
    """Compute ``sqrt(root) L^-1`` with ``S = L L^H``, shape (classes, c, c, n_bins); zero where S is not positive definite."""
    classes, bins, c, _ = spectra.shape
    out = np.zeros((classes, c, c, bins), dtype=np.complex128)
    lower = np.zeros((c, c), dtype=np.complex128)
    inverse = np.zeros((c, c), dtype=np.complex128)
    for k in range(classes):
        for f in range(bins):
            if not cholesky(spectra[k, f], lower):
                continue
            invert_lower(lower, inverse)
            for i in range(c):
                for j in range(i + 1):
                    out[k, i, j, f] = np.sqrt(root[k, f]) * inverse[i, j]
    return out


@compiled(error_model="numpy")
def _whiten(re: Array, im: Array, slopes: Array, scale: Array, first: int, out: Array) -> None:
    """Whiten packed slopes of some bins into real rows, as `whiten` does.

    Parameters
    ----------
    re, im : ndarray, shape (c, c, n_bins)
        See `SpectralSlopes.root`.
    slopes : ndarray, shape (p, c * c, n_bins)
    scale : ndarray, shape (p,)
    first : int
        First bin.
    out : ndarray, shape (p, c * c, m)
    """
    p, _, m = out.shape
    c = re.shape[0]
    half_re, half_im = np.empty((2, c, m))
    t_re, t_im = np.empty(m), np.empty(m)
    for q in range(p):
        for i in range(c):
            for b in range(i + 1):  # the upper triangle follows from symmetry
                for k in range(m):
                    half_re[b, k], half_im[b, k] = 0.0, 0.0
                for a in range(i + 1):
                    if a == b:
                        at = b * b + 2 * b
                        for k in range(m):
                            s = slopes[q, at, first + k]
                            half_re[b, k] += re[i, a, first + k] * s
                            half_im[b, k] += im[i, a, first + k] * s
                    else:
                        at = max(a, b) * max(a, b) + 2 * min(a, b)
                        sign = 1.0 if a > b else -1.0
                        for k in range(m):
                            x, y = slopes[q, at, first + k], sign * slopes[q, at + 1, first + k]
                            half_re[b, k] += re[i, a, first + k] * x - im[i, a, first + k] * y
                            half_im[b, k] += re[i, a, first + k] * y + im[i, a, first + k] * x
            for j in range(i + 1):
                for k in range(m):
                    t_re[k], t_im[k] = 0.0, 0.0
                for b in range(j + 1):
                    for k in range(m):
                        x, y = re[j, b, first + k], -im[j, b, first + k]
                        t_re[k] += half_re[b, k] * x - half_im[b, k] * y
                        t_im[k] += half_re[b, k] * y + half_im[b, k] * x
                at = i * i + 2 * j
                if i == j:
                    for k in range(m):
                        out[q, at, k] = scale[q] * t_re[k]
                else:
                    factor = np.sqrt(2.0) * scale[q]
                    for k in range(m):
                        out[q, at, k] = factor * t_re[k]
                        out[q, at + 1, k] = factor * t_im[k]


@compiled(error_model="numpy")
def _unwhitened(root: ComplexArray, rows: Array) -> Array:
    """Compute the numbers whose products with packed slopes are those of whitened rows with whitened slopes.

    Parameters
    ----------
    root : ndarray, shape (classes, c, c, n_bins)
        See `SpectralSlopes.root`.
    rows : ndarray, shape (classes * n_bins * c * c,)

    Returns
    -------
    ndarray, shape (classes, c * c, n_bins)
    """
    classes, c, _, bins = root.shape
    out = np.empty((classes, c * c, bins))
    inner = np.empty((c, c), dtype=np.complex128)
    half = np.empty((c, c), dtype=np.complex128)
    lower = np.empty((c, c), dtype=np.complex128)
    for k in range(classes):
        for f in range(bins):
            at = (k * bins + f) * c * c
            for i in range(c):
                for j in range(i):
                    inner[i, j] = complex(rows[at], rows[at + 1]) / np.sqrt(2.0)
                    inner[j, i] = np.conj(inner[i, j])
                    at += 2
                inner[i, i] = rows[at]
                at += 1
                for j in range(i + 1):
                    lower[i, j] = root[k, i, j, f]
            for i in range(c):
                for b in range(c):
                    total = 0j
                    for a in range(b, c):
                        total += inner[i, a] * lower[a, b]
                    half[i, b] = total
            for i in range(c):
                for j in range(i + 1):
                    total = 0j
                    for a in range(i, c):
                        total += np.conj(lower[a, i]) * half[a, j]
                    if i == j:
                        out[k, i * i + 2 * i, f] = total.real
                    else:
                        out[k, i * i + 2 * j, f] = 2.0 * total.real
                        out[k, i * i + 2 * j + 1, f] = 2.0 * total.imag
    return out
