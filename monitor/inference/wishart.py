"""Compiled kernels of the complex Wishart likelihood, for one small matrix per class and bin."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, compiled
from monitor.inference.arrays import Spectra, SpectraSlopes


@compiled(part=True, error_model="numpy")
def cholesky(a: Annotated[ComplexArray, "c c"], out: Annotated[ComplexArray, "c c"]) -> bool:
    """Compute the lower Cholesky factor of a matrix into `out`; return False where it is not positive definite."""
    c = a.shape[0]
    for j in range(c):
        total = a[j, j].real
        for k in range(j):
            total -= out[j, k].real ** 2 + out[j, k].imag ** 2
        if not total > 0.0:
            return False
        root = np.sqrt(total)
        out[j, j] = root
        for i in range(j + 1, c):
            value = a[i, j]
            for k in range(j):
                value -= out[i, k] * np.conj(out[j, k])
            out[i, j] = value / root
    return True


@compiled(error_model="numpy")
def log_det_and_trace(spectra: Spectra, data: Spectra) -> tuple[Array, Array]:
    """Compute ``ln det S`` and ``tr(S^-1 data)`` of every class and bin; infinity and zero where S is not positive definite."""
    classes, bins, c, _ = spectra.shape
    log_det, trace = np.full((classes, bins), np.inf), np.zeros((classes, bins))
    lower = np.zeros((c, c), dtype=np.complex128)
    inverse = np.zeros((c, c), dtype=np.complex128)
    for k in range(classes):
        for f in range(bins):
            if not cholesky(spectra[k, f], lower):
                continue
            invert_lower(lower, inverse)
            total = 0.0
            for i in range(c):
                total += np.log(lower[i, i].real)
            log_det[k, f], total = 2.0 * total, 0.0
            for i in range(c):
                for a in range(i + 1):
                    for b in range(i + 1):
                        total += (inverse[i, a] * data[k, f, a, b] * np.conj(inverse[i, b])).real
            trace[k, f] = total
    return log_det, trace


@compiled(part=True, error_model="numpy")
def invert_lower(lower: Annotated[ComplexArray, "c c"], out: Annotated[ComplexArray, "c c"]) -> None:
    """Invert a lower triangular matrix into `out`."""
    c = lower.shape[0]
    for j in range(c):
        out[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, c):
            total = 0j
            for k in range(j, i):
                total -= lower[i, k] * out[k, j]
            out[i, j] = total / lower[i, i]


@compiled(error_model="numpy")
def definite(matrices: Spectra) -> Annotated[NDArray[np.bool_], "classes bins"]:
    """Find the Hermitian matrices that are positive definite."""
    classes, bins, c, _ = matrices.shape
    out = np.empty((classes, bins), dtype=np.bool_)
    lower = np.zeros((c, c), dtype=np.complex128)
    for k in range(classes):
        for f in range(bins):
            out[k, f] = cholesky(matrices[k, f], lower)
    return out


@compiled(error_model="numpy")
def grown_by(spectra: Spectra, relative: Spectra) -> Spectra:
    """Compute ``S + L dS L^H`` with ``S = L L^H`` of every class and bin; NaN where S is not positive definite."""
    classes, bins, c, _ = spectra.shape
    out = spectra.copy()
    lower = np.zeros((c, c), dtype=np.complex128)
    half = np.empty((c, c), dtype=np.complex128)
    for k in range(classes):
        for f in range(bins):
            if not cholesky(spectra[k, f], lower):
                out[k, f] = np.nan
                continue
            for i in range(c):
                for b in range(c):
                    total = 0j
                    for a in range(i + 1):
                        total += lower[i, a] * relative[k, f, a, b]
                    half[i, b] = total
            for i in range(c):
                for j in range(c):
                    for b in range(j + 1):
                        out[k, f, i, j] += half[i, b] * np.conj(lower[j, b])
    return out


@compiled(error_model="numpy")
def whiten(spectra: Spectra, slopes: SpectraSlopes, root: Array) -> Array:
    """Compute ``root L^-1 dS L^-H`` with ``S = L L^H`` as real rows, one column a slope; zeros where S is not positive definite.

    `root` is the root of the information in each class and bin.
    """
    p, classes, bins, c, _ = slopes.shape
    out = np.empty((classes * bins * c * c, p))
    lower = np.zeros((c, c), dtype=np.complex128)
    inverse = np.zeros((c, c), dtype=np.complex128)
    half = np.empty((c, c), dtype=np.complex128)
    for k in range(classes):
        for f in range(bins):
            row = (k * bins + f) * c * c
            if not cholesky(spectra[k, f], lower):
                out[row : row + c * c] = 0.0
                continue
            invert_lower(lower, inverse)
            for q in range(p):
                for i in range(c):
                    for b in range(i + 1):  # the upper triangle follows from symmetry
                        total = 0j
                        for a in range(i + 1):
                            total += inverse[i, a] * slopes[q, k, f, a, b]
                        half[i, b] = total
                at = row
                for i in range(c):
                    for j in range(i + 1):
                        total = 0j
                        for b in range(j + 1):
                            total += half[i, b] * np.conj(inverse[j, b])
                        if i == j:
                            out[at, q] = root[k, f] * total.real
                            at += 1
                        else:
                            out[at, q] = root[k, f] * np.sqrt(2.0) * total.real
                            out[at + 1, q] = root[k, f] * np.sqrt(2.0) * total.imag
                            at += 2
    return out
