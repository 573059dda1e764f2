"""Stochastic subspace identification from lag sums (paper, section 2, eqs 1-17).

The tall block Hankel matrix of eq. 3 is never formed.  Everything its QR factorization and its SVD would give follows
from its Gram matrix, whose first block row is the window's lag sums and whose other rows follow by displacement:
moving both factors one sample on removes one product at the window's head and adds one at its tail.  That is exact,
and costs the number of block rows rather than the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import eigh, lapack, svd

from monitor.core import Array, ComplexArray, LagSums, Settings

Indices = NDArray[np.intp]
_RANK_TOLERANCE = 1e-12
"""Singular values below this share of the largest are zero. [ratio; rounding]"""
_SINGULAR_TOLERANCE = 1e-9
"""Smallest ratio of the eigenvalues of a weight that can be inverted. [ratio; rounding]"""
_SQUARED_TOLERANCE = 1e-4
"""Smallest squared singular value, over the largest, that is found as an eigenvalue. [ratio; rounding]"""
_MIN_SQUARED_DISTANCE = 1e-12
"""Smallest distance of two such squares, over the largest. [ratio; rounding]"""
_OUT_OF_BAND_NOISE = 0.03
"""Power of the noise that weights are formed with beyond the lowpass, over the channel's power. [ratio; judgement]"""
_MAX_CVA_CHANNELS = 10
"""Most channels for which `auto` is CVA; the cost of its weights grows with their cube. [channels; simulation: with
more channels the orders of CVA are biased]"""
_MIN_SPARSE_ROWS = 500
"""Rows from which only the wanted singular triplets are computed. [rows; cost]"""


class SsiSettings(Settings):
    """How the state-space models are identified."""

    variant: Literal["auto", "CVA", "UPC", "PC", "COV"] = "auto"
    """Weights of Table 1, or COV: covariance-driven, on the lag covariances. auto: CVA up to ten channels, else COV."""
    algorithm: Literal[1, 2] = 2
    """1: from the state sequences (eqs 9-11); 2: from the observability matrix (eqs 12, 13)."""
    block_rows: int = Field(default=25, ge=4, le=200)
    """Number i of block rows, past and future each."""
    max_order: int = Field(default=30, ge=4)
    """Largest state-space order; every even one from 2 is identified."""
    reference_channels: tuple[str, ...] = ()
    """Channels that make up the past; all when empty."""
    uncertainty: bool = True
    """Without it modes alone are told, at a third of the cost: a change of unknown significance is not judged."""

    def used(self, n_channels: int) -> Literal["CVA", "UPC", "PC", "COV"]:
        """The variant for so many channels."""
        if self.variant != "auto":
            return self.variant
        return "CVA" if n_channels <= _MAX_CVA_CHANNELS else "COV"


@dataclass(frozen=True, eq=False, slots=True)
class Realisation:
    """What the Gram matrix says about every order at once."""

    observability: Array
    """O_i for the largest order, shape (l i, n_max); order n uses its first n columns (eq. 8).  The states' basis is free: in
    this one the columns without the last block row are orthonormal, which solves eq. 12 for every order at once."""
    right: Array
    """Z with O_i = Y_f Y_p^T Z to first order, shape (r i, n_max): how errors of the lag sums enter O_i."""
    singular_values: Array
    """Shape (at least n_max,)."""
    past: tuple[int, ...]
    """Columns that make up the past."""
    n_channels: int
    states: tuple[Array, Array, Array] | None
    """Algorithm 1 only: Gram matrices of the projections (X_i X_i^T, X_i+1 X_i^T, Y_i X_i^T before O_i^+)."""


@dataclass(frozen=True, eq=False, slots=True)
class StateSpace:
    """A and C of one order with their eigenvectors (eq. 14)."""

    order: int
    poles: ComplexArray
    """Discrete-time eigenvalues, shape (n,)."""
    right: ComplexArray
    """Right eigenvectors, shape (n, n)."""
    shapes: ComplexArray
    """C times the eigenvectors, shape (l, n) (eq. 16)."""
    a: Array
    c: Array


@dataclass(frozen=True, eq=False, slots=True)
class PoleTable:
    """Poles of all orders above the real axis, one row each, by order."""

    orders: tuple[int, ...]
    """All that were identified, whether they have poles here or not."""
    space: Indices
    """Index in `orders`."""
    value: ComplexArray
    """Discrete-time eigenvalue."""
    frequency: Array
    """Hz."""
    damping: Array
    """Ratio."""
    shape: ComplexArray
    """Unit norm, shape (n_poles, l)."""


def gram(sums: LagSums) -> Array:
    """Gram matrix of the block Hankel matrix of eq. 3 with all channels, shape (2 i l, 2 i l), not normalized."""
    from monitor.identification.kernels import displaced  # compiled code takes a while to load

    return displaced(sums.total, sums.head, sums.tail)


def realise(
    sums: LagSums, settings: SsiSettings, past: tuple[int, ...], max_order: int, cutoff: float = 0.5
) -> Realisation:
    """Factorize the weighted projection of the future on the past (eqs 5-8, 17).

    Parameters
    ----------
    past : tuple of int
        Reference columns.
    max_order : int
        Largest order wanted; lowered to the number of rows of the past.
    cutoff : float
        Of the lowpass that the samples went through, cycles per sample.
    """
    i, l = settings.block_rows, sums.head.shape[1]  # noqa: E741 - the paper's letters
    past_rows, future = _past_rows(i, l, past), slice(i * l, 2 * i * l)
    max_order = min(max_order, len(past_rows) - 1, (i - 1) * l)
    variant = settings.used(l)
    by_covariance = variant == "COV"
    full = np.zeros((0, 0)) if by_covariance and settings.algorithm == 2 else gram(sums)
    earlier = slice(0, i * l) if past == tuple(range(l)) else past_rows  # a slice copies nothing
    g_fp = _toeplitz(sums, i, past) if by_covariance else full[future, earlier]
    if variant in ("COV", "PC"):
        # PC's weight W2 turns the projection into Y_f Y_p^T, up to an orthogonal factor.
        values, white = _leading(g_fp, max_order)
    else:
        half_pp = _weight(full[earlier][:, earlier], len(past), cutoff)
        weighted = g_fp @ half_pp
        if variant == "CVA":
            weighted = _weight(full[future, future], l, cutoff).T @ weighted
        values, right = _leading(weighted, max_order)
        white = half_pp @ right
    # Noise-free data have no more singular values than the structure has states.
    rank = max(2, int(np.count_nonzero(values[:max_order] > _SINGULAR_TOLERANCE * values[0])))
    if rank < max_order and variant == "CVA":
        # Their canonical correlations are all one, which ranks nothing: weigh by energy instead.
        return realise(sums, settings.model_copy(update={"variant": "UPC"}), past, max_order, cutoff)
    values = values[:rank]
    z = white[:, :rank] / np.sqrt(np.maximum(values, 1e-300))
    states = _state_products(full, past_rows, i, l) if settings.algorithm == 1 else None
    o, z = _orthonormal(g_fp @ z, z, l)
    return Realisation(o, z, values, past, l, states)


@lru_cache(maxsize=8)
def _past_rows(i: int, l: int, past: tuple[int, ...]) -> Indices:  # noqa: E741
    """Rows of the Hankel matrix's upper half that belong to the reference columns."""
    return np.asarray((np.arange(i)[:, None] * l + np.asarray(past)[None, :]).ravel())


def _orthonormal(o: Array, z: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """O and Z in the basis of `Realisation`, as far as the columns are independent; they stay nested over orders."""
    r, reflectors, *_ = lapack.dgeqrf(o[:-l])
    q, *_ = lapack.dorgqr(r, reflectors)
    size = np.abs(r.diagonal())
    weak = np.flatnonzero(size < _SINGULAR_TOLERANCE * size[0])
    sound = int(weak[0]) if weak.size else size.size
    inverse, _ = lapack.dtrtri(r[:sound, :sound] * _upper(sound))  # below lie the reflectors
    return np.concatenate([q[:, :sound], o[-l:, :sound] @ inverse]), z[:, :sound] @ inverse


@lru_cache(maxsize=8)
def _upper(n: int) -> Array:
    """1 on the diagonal and above, else 0."""
    return np.triu(np.ones((n, n)))


def _leading(matrix: Array, count: int) -> tuple[Array, Array]:
    """At least the `count` largest singular values, falling, and as many right vectors, as columns."""
    if min(matrix.shape) < _MIN_SPARSE_ROWS:
        # Where squares lose no more than a few digits, the symmetric problem takes less than half the time.
        reflected, diagonal, beside, scales, _ = lapack.dsytrd(matrix.T @ matrix, lower=1)
        squares, failed = lapack.dsterf(diagonal, beside)
        apart = np.diff(squares[-count - 1 :]).min()
        if (
            not failed
            and squares[-count] > _SQUARED_TOLERANCE * squares[-1]
            and apart > _MIN_SQUARED_DISTANCE * squares[-1]
        ):
            from monitor.identification.eigen import tridiagonal_vectors  # compiled code takes a while to load

            turned = tridiagonal_vectors(diagonal, beside, squares[: -count - 1 : -1]).T
            others, *_ = lapack.dormqr("L", "N", reflected[1:, :-1], scales, turned[1:], 64 * count)
            return np.sqrt(squares[: -count - 1 : -1]), np.concatenate([turned[:1], others])
        _, values, right_t = svd(matrix)
        return values, right_t[:count].T
    from scipy.sparse.linalg import svds  # takes a quarter of a second to load

    _, values, right_t = svds(matrix, count, v0=np.ones(min(matrix.shape)))  # a given start: the same bits every time
    return values[::-1], right_t[::-1].T


def poles(
    realisation: Realisation,
    orders: range,
    rate_hz: float,
    band_hz: tuple[float, float] = (0.0, np.inf),
    damping: tuple[float, float] = (-np.inf, np.inf),
) -> PoleTable:
    """The poles of every order, as far as the data have states, within the bounds of frequency and damping ratio."""
    from monitor.identification.eigen import upper_poles  # compiled code takes a while to load

    told = tuple(n for n in orders if n <= realisation.observability.shape[1])
    radian = 2.0 * np.pi / rate_hz
    region = (radian * band_hz[0], radian * band_hz[1], *damping)
    if realisation.states is None or not told:
        space, value, logarithm, shape = upper_poles(*_matrices(realisation, max(told, default=0)), told, region)
    else:
        found = [upper_poles(*_matrices(realisation, n), (n,), region) for n in told]
        space = np.concatenate([k + spaces for k, (spaces, *_) in enumerate(found)])
        value, logarithm, shape = (np.concatenate(parts) for parts in list(zip(*found, strict=True))[1:])
    return PoleTable(told, space, value, *continuous(logarithm, rate_hz), shape)


def state_space(realisation: Realisation, order: int) -> StateSpace:
    """A, C and all eigenvectors of one order."""
    a, c = _matrices(realisation, order)
    values, vectors = np.linalg.eig(a)
    return StateSpace(order, values.astype(complex), vectors.astype(complex), c @ vectors, a, c)


def _matrices(realisation: Realisation, order: int) -> tuple[Array, Array]:
    """A and C by algorithm 2, where those of a lower order are their leading parts, or by algorithm 1 where prepared."""
    l, o = realisation.n_channels, realisation.observability[:, :order]  # noqa: E741
    if realisation.states is None:
        return o[:-l].T @ o[l:], o[:l]
    return _algorithm_1(realisation.states, o, l)


def continuous(logarithm: ComplexArray, rate_hz: float) -> tuple[Array, Array]:
    """Frequencies in Hz and damping ratios of discrete-time poles by their logarithms (eqs 14, 15); shapes as those."""
    size = np.abs(logarithm)
    return size * (rate_hz / (2.0 * np.pi)), -logarithm.real / size


def _toeplitz(sums: LagSums, i: int, past: tuple[int, ...]) -> Array:
    """Block Toeplitz matrix of lag covariances, future rows by past columns: block (a, b) is R(i + a - b)."""
    lag_sum = sums.total[:, list(past)]
    lag = i + np.arange(i)[:, None] - np.arange(i)[None, :]
    blocks = lag_sum[lag]  # (a, b, past channel, future channel)
    return np.asarray(blocks.transpose(0, 3, 1, 2).reshape(i * lag_sum.shape[2], -1))


def _weight(gram: Array, n_channels: int, cutoff: float) -> Array:
    """W with W W^T the inverse of a Gram matrix in which white noise fills what a lowpass has taken.

    Where next to nothing is left up to half the rate, canonical correlations are all one: states of that nothing come before the
    structure's, and an order that cuts through them biases the modes.  What the states are does not depend on the
    weights, only which come first; within the band these are those of Table 1.
    """
    if cutoff >= 0.5:
        return _inverse_root(gram)
    filled, i = gram.copy(), len(gram) // n_channels
    blocks = filled.reshape(i, n_channels, i, n_channels)
    for c in range(n_channels):
        blocks[:, c, :, c] += gram[c, c] * _beyond(i, cutoff)
    return _inverse_root(filled)


@lru_cache(maxsize=8)
def _beyond(i: int, cutoff: float) -> Array:
    """Covariances at i moments of white noise beyond the cutoff, of power `_OUT_OF_BAND_NOISE`, shape (i, i)."""
    lag = np.abs(np.arange(i)[:, None] - np.arange(i))
    within = 2.0 * cutoff * np.sinc(2.0 * cutoff * lag)
    return np.asarray(_OUT_OF_BAND_NOISE * ((lag == 0) - within) / (1.0 - 2.0 * cutoff))


def _inverse_root(matrix: Array) -> Array:
    """W with W W^T the (pseudo-)inverse of a positive semidefinite matrix.

    Cholesky where the matrix has full rank; an eigenvalue decomposition where it has not (noise-free data).
    """
    upper, failed = lapack.dpotrf(matrix)
    if not failed and upper.diagonal().min() ** 2 > _RANK_TOLERANCE * matrix.diagonal().max():
        return np.asarray(lapack.dtrtri(upper)[0])
    values, vectors = eigh(matrix)  # the pseudo-inverse of eq. 5
    inverse = np.where(values > _RANK_TOLERANCE * values[-1], 1.0 / np.sqrt(np.abs(values) + 1e-300), 0.0)
    return np.asarray(vectors * inverse)


def _state_products(full: Array, past_rows: Indices, i: int, l: int) -> tuple[Array, Array, Array]:  # noqa: E741
    """Products of projections and outputs that algorithm 1 needs (eqs 9-11), free of the state basis."""
    future = np.arange(i * l, 2 * i * l)
    later = future[l:]
    now = future[:l]
    past_plus = np.concatenate([past_rows, i * l + past_rows[past_rows < l]])

    def g(rows: Indices, columns: Indices) -> Array:
        return np.asarray(full[np.ix_(rows, columns)])

    root, root_plus = _inverse_root(g(past_rows, past_rows)), _inverse_root(g(past_plus, past_plus))
    b = g(future, past_rows) @ root @ root.T
    b_plus = g(later, past_plus) @ root_plus @ root_plus.T
    return (
        np.asarray(b @ g(past_rows, future)),
        np.asarray(b_plus @ g(past_plus, past_rows) @ b.T),
        np.asarray(g(now, past_rows) @ b.T),
    )


def _algorithm_1(states: tuple[Array, Array, Array], o: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """Least squares for A and C from the state sequences (eq. 11)."""
    inverse, inverse_minus = np.linalg.pinv(o), np.linalg.pinv(o[:-l])
    now_now = inverse @ states[0] @ inverse.T
    next_now = inverse_minus @ states[1] @ inverse.T
    output_now = states[2] @ inverse.T
    solution = np.linalg.solve(now_now.T, np.vstack([next_now, output_now]).T).T
    n = o.shape[1]
    return solution[:n], solution[n:]
