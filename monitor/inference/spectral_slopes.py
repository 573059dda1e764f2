"""Slopes of a prediction by its parameters, whitened, as a fit needs them: their information, and their products with residuals.

The whitened slopes have one row for every number in the spectra of every class.  With many channels they take gigabytes, and
most coordinates change the spectra of all classes in proportion.  So the slopes are kept before they are whitened, once for
all classes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array, ComplexArray, compiled
from monitor.inference.arrays import PackedSlopes, Spectra
from monitor.inference.wishart import cholesky, invert_lower

_BINS = 32
"""Bins that are whitened together. [count; cost: their rows stay in the processor's cache]"""
_JOINT = 1e-7
"""Share of the diagonal up to which what stands beside it is zero. [ratio; rounding]"""


class Slopes(ABC):
    """Whitened slopes of a prediction by some of its p parameters, a matrix of rows."""

    information: Annotated[Array, "p p"]
    """Fisher information of the data: the slopes' transpose times the slopes."""

    @abstractmethod
    def along(self, rows: Array) -> Array:
        """Multiply the slopes' transpose by whitened rows, shape (rows,) or (rows, k); shape (p,) or (p, k)."""

    @abstractmethod
    def by(self, chosen: NDArray[np.intp]) -> Slopes:
        """Return the slopes by some of the parameters, whose indices are `chosen`."""


@dataclass(frozen=True, eq=False)
class RowSlopes(Slopes):
    """Slopes that are kept whitened."""

    rows: Annotated[Array, "rows p"]

    @cached_property
    @override
    def information(self) -> Array:  # type: ignore[override]
        return np.asarray(self.rows.T @ self.rows)

    @override
    def along(self, rows: Array) -> Array:
        return np.asarray(self.rows.T @ rows)

    @override
    def by(self, chosen: NDArray[np.intp]) -> RowSlopes:
        return RowSlopes(np.ascontiguousarray(self.rows[:, chosen]))


@dataclass(frozen=True, eq=False)
class JoinedSlopes(Slopes):
    """Slopes by some parameters that are not computed again, then those by the others."""

    frozen: Slopes
    others: RowSlopes
    information: Array

    @classmethod
    def of(cls, frozen: Slopes, others: RowSlopes) -> JoinedSlopes:
        """Join slopes."""
        across = frozen.along(others.rows)
        return cls(frozen, others, np.block([[frozen.information, across], [across.T, others.information]]))

    @override
    def along(self, rows: Array) -> Array:
        return np.concatenate([self.frozen.along(rows), self.others.along(rows)])

    def by(self, chosen: NDArray[np.intp]) -> Slopes:
        """Those of the frozen ones must come first."""
        n = len(self.frozen.information)
        return JoinedSlopes.of(self.frozen.by(chosen[chosen < n]), self.others.by(chosen[chosen >= n] - n))


@dataclass(frozen=True, eq=False)
class SpectralSlopes(Slopes):
    """Slopes of the spectra of all classes, kept before they are whitened."""

    shared: PackedSlopes
    """Slopes of the middle class, see `packed`."""
    scale: Annotated[Array, "classes shared"]
    """Factor from these to the slopes of every class."""
    own: Annotated[Array, "own classes c*c bins"]
    """Slopes by coordinates that change the classes in different ways."""
    order: Annotated[NDArray[np.intp], "p"]
    """Where each parameter stands among the shared and then the own ones."""
    root: Annotated[ComplexArray, "classes c c bins"]
    """Lower triangular matrices that whiten the spectra of a class and bin and weight them by the root of their information."""
    information: Array

    @classmethod
    def at(
        cls, shared: Array, scale: Array, own: Array, order: NDArray[np.intp], spectra: Spectra, root: Array
    ) -> SpectralSlopes:
        """Whiten slopes by predicted spectra; `root` is the root of the information in each class and bin."""
        whitening = whitening_roots(spectra, root)
        information = _information(shared, scale, own, whitening)
        return cls(shared, scale, own, order, whitening, information[np.ix_(order, order)])

    @override
    def along(self, rows: Array) -> Array:
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

    @override
    def by(self, chosen: NDArray[np.intp]) -> SpectralSlopes:
        return replace(self, order=self.order[chosen], information=self.information[np.ix_(chosen, chosen)])


def _information(shared: Array, scale: Array, own: Array, root: ComplexArray) -> Annotated[Array, "p p"]:
    """Compute the information on the shared, then on the own parameters."""
    joint = joint_directions(root)
    if joint is not None:
        return _joint_information(shared, scale, own, *joint)
    (classes, c, _, bins), p = root.shape, len(shared) + len(own)
    weight, out = _twice(c)[:, None], np.zeros((p, p))
    for at in range(0, bins, _BINS):
        some = slice(at, at + _BINS)
        of_shared = _by_bin(shared[..., some])
        for k in range(classes):
            slopes = np.concatenate([of_shared * scale[k], _by_bin(own[:, k, :, some])], axis=2)
            rows = (np.sqrt(weight) * (_congruence(root[k, ..., some]) @ slopes)).reshape(-1, p)
            out += rows.T @ rows
    return out


def joint_directions(
    root: ComplexArray,
) -> tuple[Annotated[ComplexArray, "c c bins"], Annotated[Array, "classes c bins"]] | None:
    """Find directions T in which the spectra of all classes are diagonal, as those of one model at several levels are.

    The weights are those of ``root_k^H root_k = T^H diag(weight_k) T``.  None where there are no such directions.
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
    """Compute as `_information` with slopes that are turned once for all classes, see `joint_directions`."""
    c, bins = directions.shape[1:]
    main = (scale == scale[:, :1]).all(axis=0)
    n, p, classes = np.count_nonzero(main), len(shared) + len(own), range(len(scale))
    order = np.concatenate([np.flatnonzero(main), np.flatnonzero(~main), np.arange(len(shared), p)])
    level, of_scale = scale[:, order[0]], scale[:, order[n : len(shared)]]
    entries = np.array([(i, j) for i in range(c) for j in (*np.repeat(range(i), 2), i)])
    ordered = np.zeros((p, p))
    for at in range(0, bins, _BINS):
        some = slice(at, at + _BINS)
        turning, by_direction = _congruence(directions[..., some]), weight[..., some].swapaxes(1, 2)
        weights = _twice(c) * by_direction[..., entries[:, 0]] * by_direction[..., entries[:, 1]]
        of_first, of_others = (turning @ _by_bin(shared[which, :, some]) for which in (main, ~main))
        of_class = [
            np.concatenate([of_others * of_scale[k], turning @ _by_bin(own[:, k, :, some])], 2) for k in classes
        ]
        alike = (of_first * np.sqrt(np.tensordot(level**2, weights, axes=1))[..., None]).reshape(-1, n)
        ordered[:n, :n] += alike.T @ alike
        across = sum(level[k] * weights[k, ..., None] * of_class[k] for k in classes)
        ordered[:n, n:] += of_first.reshape(-1, n).T @ across.reshape(-1, p - n)
        for k in classes:
            rows = (of_class[k] * np.sqrt(weights[k])[..., None]).reshape(-1, p - n)
            ordered[n:, n:] += rows.T @ rows
    ordered[n:, :n] = ordered[:n, n:].T
    out = np.empty((p, p))
    out[np.ix_(order, order)] = ordered
    return out


def _twice(c: int) -> Annotated[Array, "c*c"]:
    """Return how often each number of a packed matrix stands in the whole one."""
    out = np.full(c * c, 2.0)
    out[np.arange(1, c + 1) ** 2 - 1] = 1.0
    return out


def _by_bin(slopes: PackedSlopes) -> Annotated[Array, "bins c*c p"]:
    """Put packed slopes in an order in which a bin's are next to each other."""
    return np.asarray(slopes.transpose(2, 1, 0).copy())


@compiled(error_model="numpy")
def _congruence(directions: Annotated[ComplexArray, "c c bins"]) -> Annotated[Array, "bins c*c c*c"]:
    """Compute the matrices by which ``T dS T^H`` follows from dS, both packed."""
    c, _, m = directions.shape
    out = np.empty((m, c * c, c * c))
    for f in range(m):
        t = directions[:, :, f]
        for i in range(c):
            for j in range(i + 1):
                row = i * i + 2 * j
                for a in range(c):
                    for b in range(a + 1):
                        column = a * a + 2 * b
                        one, other = t[i, a] * np.conj(t[j, b]), t[i, b] * np.conj(t[j, a])
                        by_real, by_imag = one + other, 1j * (one - other)
                        if a == b:
                            by_real = one
                        out[f, row, column] = by_real.real
                        if a > b:
                            out[f, row, column + 1] = by_imag.real
                        if i > j:
                            out[f, row + 1, column] = by_real.imag
                        if i > j and a > b:
                            out[f, row + 1, column + 1] = by_imag.imag
    return out


@compiled(error_model="numpy")
def whitening_roots(spectra: Spectra, root: Array) -> Annotated[ComplexArray, "classes c c bins"]:
    """Compute ``sqrt(root) L^-1`` with ``S = L L^H``; zero where S is not positive definite."""
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
def _unwhitened(root: Annotated[ComplexArray, "classes c c bins"], rows: Array) -> Annotated[Array, "classes c*c bins"]:
    """Compute the numbers whose products with packed slopes are those of whitened rows with whitened slopes."""
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
