"""Compiled kernels of a window's way: loops that numpy would spread over dozens of small arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.compiled import compiled
from monitor.results import Array, ComplexArray


@compiled()
def pool_products(x: ComplexArray, first: NDArray[np.intp], sizes: NDArray[np.intp], out: ComplexArray) -> None:
    """Cross-spectra of one segment, shape (n_bins, c), means over pools of bins, packed, into shape (pairs, pools)."""
    c = x.shape[1]
    for p in range(first.size):
        begin, size = first[p], sizes[p]
        pair = 0
        for i in range(c):
            for j in range(i, c):
                total = 0j
                for k in range(begin, begin + size):
                    total += x[k, i] * np.conj(x[k, j])
                out[pair, p] = total / size
                pair += 1


@compiled()
def pack_columns(u: Array | ComplexArray, v: ComplexArray) -> ComplexArray:
    """Upper triangles of ``u v^H + v u^H`` of every column, shapes (pools or 1, c, columns) to (columns, pairs, pools)."""
    pools, c, columns = v.shape
    out = np.empty((columns, c * (c + 1) // 2, pools), dtype=np.complex128)
    for p in range(pools):
        up, vp = u[p if len(u) > 1 else 0], v[p]
        pair = 0
        for i in range(c):
            for j in range(i, c):
                for k in range(columns):
                    out[k, pair, p] = up[i, k] * np.conj(vp[j, k]) + vp[i, k] * np.conj(up[j, k])
                pair += 1
    return out
