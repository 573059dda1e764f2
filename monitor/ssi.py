"""Stochastic subspace identification from lag sums (paper, section 2, eqs 1-17).

The tall block Hankel matrix of eq. 3 is never formed.  Everything its QR factorization and its SVD would give follows
from its Gram matrix, whose first block row is the window's lag sums and whose other rows follow by displacement:
moving both factors one sample on removes one product at the window's head and adds one at its tail.  That is exact,
and costs the number of block rows rather than the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cholesky, eigh, qr, solve_triangular, svd
from scipy.sparse.linalg import svds

from monitor.results import Array, ComplexArray, LagSums
from monitor.settings import Settings

Indices = NDArray[np.intp]
_RANK_TOLERANCE = 1e-12
_SINGULAR_TOLERANCE = 1e-9
_LARGE = 500
"""Rows from which only the wanted singular triplets are computed."""


class SsiSettings(Settings):
    """How the state-space models are identified."""

    variant: Literal["CVA", "UPC", "PC", "COV"] = "CVA"
    """Weights of Table 1, or COV: covariance-driven, on the lag covariances themselves."""
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


@dataclass(frozen=True, eq=False, slots=True)
class Realisation:
    """What the Gram matrix says about every order at once."""

    observability: Array
    """O_i for the largest order, shape (l i, n_max); order n uses its first n columns (eq. 8)."""
    right: Array
    """Z with O_i = Y_f Y_p^T Z to first order, shape (r i, n_max): how errors of the lag sums enter O_i."""
    singular_values: Array
    """Shape (n_max,)."""
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


def gram(sums: LagSums) -> Array:
    """Gram matrix of the block Hankel matrix of eq. 3 with all channels, shape (2 i l, 2 i l), not normalized."""
    lag_sum = sums.blocks.sum(axis=0)
    lags, channels = lag_sum.shape[0], lag_sum.shape[1]
    # head and tail hold 2 i - 1 samples: what leaves and what enters when both factors move on.
    change = np.einsum("ac,bd->abcd", sums.tail, sums.tail) - np.einsum("ac,bd->abcd", sums.head, sums.head)
    blocks = np.zeros((lags, lags, channels, channels))
    blocks[0] = lag_sum
    for a in range(1, lags):
        blocks[a, a:] = blocks[a - 1, a - 1 : -1] + change[a - 1, a - 1 :]
    upper = blocks.transpose(0, 2, 1, 3).reshape(lags * channels, lags * channels)
    # Blocks below the diagonal are the transposes of those above.
    block_of = np.repeat(np.arange(lags), channels)
    below = block_of[:, None] > block_of[None, :]
    return np.where(below, upper.T, upper)


def realise(sums: LagSums, settings: SsiSettings, past: tuple[int, ...], max_order: int) -> Realisation:
    """Factorize the weighted projection of the future on the past (eqs 5-8, 17).

    Parameters
    ----------
    past : tuple of int
        Reference columns.
    max_order : int
        Largest order wanted; lowered to the number of rows of the past.
    """
    i, l = settings.block_rows, sums.head.shape[1]  # noqa: E741 - the paper's letters
    past_rows = (np.arange(i)[:, None] * l + np.asarray(past)[None, :]).ravel()
    future = slice(i * l, 2 * i * l)
    max_order = min(max_order, len(past_rows) - 1, (i - 1) * l)
    by_covariance = settings.variant == "COV"
    full = np.zeros((0, 0)) if by_covariance and settings.algorithm == 2 else gram(sums)
    g_fp = _toeplitz(sums, i, past) if by_covariance else full[future][:, past_rows]
    if settings.variant in ("COV", "PC"):
        # PC's weight W2 turns the projection into Y_f Y_p^T, up to an orthogonal factor.
        values, right_t = _leading(g_fp, max_order)
        white = right_t[:max_order].T
    else:
        half_pp = _inverse_root(full[np.ix_(past_rows, past_rows)])
        half_ff = _inverse_root(full[future, future]) if settings.variant == "CVA" else None
        weighted = g_fp @ half_pp
        if half_ff is not None:
            weighted = half_ff.T @ weighted
        values, right_t = _leading(weighted, max_order)
        white = half_pp @ right_t[:max_order].T
    # Noise-free data have no more singular values than the structure has states.
    rank = max(2, int(np.count_nonzero(values[:max_order] > _SINGULAR_TOLERANCE * values[0])))
    if rank < max_order and settings.variant == "CVA":
        # Their canonical correlations are all one, which ranks nothing: weigh by energy instead.
        return realise(sums, settings.model_copy(update={"variant": "UPC"}), past, max_order)
    values = values[:rank]
    z = white[:, :rank] / np.sqrt(np.maximum(values, 1e-300))
    states = _state_products(full, past_rows, i, l) if settings.algorithm == 1 else None
    return Realisation(g_fp @ z, z, values, past, l, states)


def _leading(matrix: Array, count: int) -> tuple[Array, Array]:
    """At least the `count` largest singular values, falling, and their right vectors as rows."""
    if min(matrix.shape) < _LARGE:
        _, values, right_t = svd(matrix)
        return values, right_t
    _, values, right_t = svds(matrix, count, v0=np.ones(min(matrix.shape)))  # a given start: the same bits every time
    return values[::-1], right_t[::-1]


def state_spaces(realisation: Realisation, orders: range) -> list[StateSpace]:
    """A, C and their eigenvectors for every order, by algorithm 2 (or 1 where prepared)."""
    l = realisation.n_channels  # noqa: E741
    o = realisation.observability
    if realisation.states is None:
        # Columns of O are nested over orders, so one QR factorization serves all of eq. 12.
        q, r = qr(o[:-l], mode="economic")
        shifted, size = q.T @ o[l:], np.abs(np.diag(r))
        # So are R and its inverse, as far as it has one.
        sound = int(np.argmin(np.append(size >= _SINGULAR_TOLERANCE * size[0], False)))
        inverse = solve_triangular(r[:sound, :sound], np.eye(sound))
    spaces = []
    for n in orders:
        if n > o.shape[1]:
            break
        if realisation.states is None:
            if n > sound:
                break
            a, c = inverse[:n, :n] @ shifted[:n, :n], o[:l, :n]
        else:
            a, c = _algorithm_1(realisation.states, o[:, :n], l)
        poles, vectors = np.linalg.eig(a)
        spaces.append(StateSpace(n, poles.astype(complex), vectors.astype(complex), c @ vectors, a, c))
    return spaces


def continuous(poles: ComplexArray, rate_hz: float) -> tuple[Array, Array]:
    """Frequencies in Hz and damping ratios of discrete-time poles (eqs 14, 15); shapes as `poles`.

    A pole at the origin has no frequency: NaN, which no selection accepts.
    """
    mu = np.log(np.where(poles == 0, np.nan, poles)) * rate_hz
    return np.abs(mu) / (2.0 * np.pi), -mu.real / np.abs(mu)


def _toeplitz(sums: LagSums, i: int, past: tuple[int, ...]) -> Array:
    """Block Toeplitz matrix of lag covariances, future rows by past columns: block (a, b) is R(i + a - b)."""
    lag_sum = sums.blocks.sum(axis=0)[:, list(past)]
    lag = i + np.arange(i)[:, None] - np.arange(i)[None, :]
    blocks = lag_sum[lag]  # (a, b, past channel, future channel)
    return np.asarray(blocks.transpose(0, 3, 1, 2).reshape(i * lag_sum.shape[2], -1))


def _inverse_root(matrix: Array) -> Array:
    """W with W W^T the (pseudo-)inverse of a positive semidefinite matrix.

    Cholesky where the matrix has full rank; an eigenvalue decomposition where it has not (noise-free data).
    """
    try:
        lower = cholesky(matrix, lower=True)
        full_rank = np.square(np.diag(lower)).min() > _RANK_TOLERANCE * np.diag(matrix).max()
    except np.linalg.LinAlgError:
        full_rank = False
    if full_rank:
        return np.asarray(solve_triangular(lower, np.eye(len(matrix)), lower=True).T)
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
