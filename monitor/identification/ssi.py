"""Stochastic subspace identification from lag sums (paper, section 2, eqs 1-17).

The tall block Hankel matrix of eq. 3 is never formed.  All results of its QR factorization and its SVD follow from its Gram
matrix.  The first block row of the Gram matrix is the window's lag sums, and the other rows follow by displacement: a shift of
both factors by one sample removes one product at the window's head and adds one at its tail.  That is exact, and its cost
depends on the number of block rows, not on the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import eigh, lapack, svd

from monitor.core import Array, ComplexArray, LagSums, Settings

Indices = NDArray[np.intp]
_RANK_TOLERANCE = 1e-12
"""Singular values, and differences of their squares, below this share of the largest are zero. [ratio; rounding]"""
_SINGULAR_TOLERANCE = 1e-9
"""Smallest ratio of the eigenvalues of a weight that can be inverted. [ratio; rounding]"""
_SQUARED_TOLERANCE = 1e-4
"""Smallest squared singular value, over the largest, that is found as an eigenvalue. [ratio; rounding]"""
_OUT_OF_BAND_NOISE = 0.03
"""Power of the noise that weights are formed with beyond the lowpass, over the channel's power. [ratio; judgement]"""
_MAX_CVA_CHANNELS = 10
"""Most channels for which `auto` is CVA; the cost of its weights grows with their cube. [channels; simulation: with
more channels the orders of CVA are biased]"""
_MIN_SPARSE_ROWS = 500
"""Rows from which only the wanted singular triplets are computed. [rows; cost]"""


class SsiSettings(Settings):
    """``[identification]``: stochastic subspace identification of state-space models."""

    variant: Literal["auto", "CVA", "UPC", "PC", "COV"] = "auto"
    """Weights of Table 1, or COV: covariance-driven, from the lag covariances. auto: CVA up to ten channels, else COV."""
    algorithm: Literal[1, 2] = 2
    """1: from the state sequences (eqs 9-11); 2: from the observability matrix (eqs 12, 13)."""
    block_rows: int = Field(default=25, ge=4, le=200)
    """Number i of block rows, for past and future each."""
    max_order: int = Field(default=30, ge=4)
    """Largest state-space order; every even order from 2 is identified."""
    reference_channels: tuple[str, ...] = ()
    """Reference channels, which make up the past; all channels when empty."""
    uncertainty: bool = True
    """Compute the uncertainty of the modes.  Without it identification takes a third of the time, but damage is not assessed:
    the significance of a change is then unknown."""

    def used(self, n_channels: int) -> Literal["CVA", "UPC", "PC", "COV"]:
        """Return the variant used for so many channels.

        Examples
        --------
        >>> SsiSettings().used(5), SsiSettings().used(20)
        ('CVA', 'COV')
        """
        if self.variant != "auto":
            return self.variant
        return "CVA" if n_channels <= _MAX_CVA_CHANNELS else "COV"


@dataclass(frozen=True, eq=False, slots=True)
class Realisation:
    """Observability matrix for all orders, from the Gram matrix."""

    observability: Annotated[Array, "li n_max"]
    """O_i for the largest order; order n uses its first n columns (eq. 8).  The basis of the states is arbitrary.  It is chosen
    so that the columns without the last block row are orthonormal, which solves eq. 12 for every order at once."""
    right: Annotated[Array, "ri n_max"]
    """Z with O_i = Y_f Y_p^T Z to first order; it propagates errors of the lag sums to O_i."""
    singular_values: Array
    """At least n_max."""
    past: tuple[int, ...]
    """Numbers of the channels that make up the past."""
    n_channels: int
    states: tuple[Array, Array, Array] | None
    """Algorithm 1 only: Gram matrices of the projections (X_i X_i^T, X_i+1 X_i^T, Y_i X_i^T before O_i^+)."""


@dataclass(frozen=True, eq=False, slots=True)
class StateSpace:
    """State-space matrices A and C of one order, with eigenvalues and eigenvectors of A (eq. 14)."""

    order: int
    poles: Annotated[ComplexArray, "n"]
    """Discrete-time eigenvalues."""
    right: Annotated[ComplexArray, "n n"]
    """Right eigenvectors."""
    shapes: Annotated[ComplexArray, "l n"]
    """C times the eigenvectors (eq. 16)."""
    a: Array
    c: Array


@dataclass(frozen=True, eq=False, slots=True)
class PoleTable:
    """Poles above the real axis of all orders, one row each, by order."""

    orders: tuple[int, ...]
    """All orders identified, with or without poles in the table."""
    space: Annotated[Indices, "poles"]
    """Index of the pole's order in `orders`."""
    value: Annotated[ComplexArray, "poles"]
    """Discrete-time eigenvalue."""
    frequency: Annotated[Array, "poles"]
    """Hz."""
    damping: Annotated[Array, "poles"]
    """Damping ratio."""
    shape: Annotated[ComplexArray, "poles l"]
    """Mode shape of unit norm."""


def gram(sums: LagSums) -> Array:
    """Compute the Gram matrix of the block Hankel matrix of eq. 3 with all l channels, 2 i l rows, not normalized."""
    from monitor.identification.kernels import displaced  # compiled code takes a while to load

    return displaced(sums.total, sums.head, sums.tail)


def realise(
    sums: LagSums, settings: SsiSettings, past: tuple[int, ...], max_order: int, cutoff: float = 0.5
) -> Realisation:
    """Factorize the weighted projection of the future on the past (eqs 5-8, 17).

    `past` are the numbers of the reference channels, `cutoff` the cutoff of the lowpass of the samples in cycles per sample.  The
    largest order is lowered where the matrices have fewer rows.
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
    # Noise-free data have only as many singular values as the structure has states.
    rank = max(2, int(np.count_nonzero(values[:max_order] > _SINGULAR_TOLERANCE * values[0])))
    if rank < max_order and variant == "CVA":
        # The canonical correlations of noise-free data are all one and give no order of states: weigh by energy instead.
        return realise(sums, settings.model_copy(update={"variant": "UPC"}), past, max_order, cutoff)
    values = values[:rank]
    z = white[:, :rank] / np.sqrt(np.maximum(values, 1e-300))
    states = _state_products(full, past_rows, i, l) if settings.algorithm == 1 else None
    o, z = _orthonormalize(g_fp @ z, z, l)
    return Realisation(o, z, values, past, l, states)


@lru_cache(maxsize=8)
def _past_rows(i: int, l: int, past: tuple[int, ...]) -> Indices:  # noqa: E741
    """Return the rows of the Hankel matrix's upper half that belong to the reference channels."""
    return np.asarray((np.arange(i)[:, None] * l + np.asarray(past)[None, :]).ravel())


def _orthonormalize(o: Array, z: Array, l: int) -> tuple[Array, Array]:  # noqa: E741
    """Transform O and Z, (l i, n) and (r i, n), to the basis of `Realisation`, up to the first dependent column.

    The first columns still belong to the lower orders.
    """
    r, reflectors, *_ = lapack.dgeqrf(o[:-l])
    q, *_ = lapack.dorgqr(r, reflectors)
    size = np.abs(r.diagonal())
    weak = np.flatnonzero(size < _SINGULAR_TOLERANCE * size[0])
    sound = int(weak[0]) if weak.size else size.size
    inverse, _ = lapack.dtrtri(r[:sound, :sound] * _upper(sound))  # the lower triangle holds the reflectors
    return np.concatenate([q[:, :sound], o[-l:, :sound] @ inverse]), z[:, :sound] @ inverse


@lru_cache(maxsize=8)
def _upper(n: int) -> Array:
    """Return the mask of the upper triangle with diagonal: 1 there, else 0."""
    return np.triu(np.ones((n, n)))


def _leading(matrix: Array, count: int) -> tuple[Array, Array]:
    """Compute at least the `count` largest singular values, decreasing, and `count` right singular vectors, as columns."""
    if min(matrix.shape) < _MIN_SPARSE_ROWS:
        # Where squaring loses no more than a few digits, the symmetric problem takes less than half the time.
        reflected, diagonal, off_diagonal, scales, _ = lapack.dsytrd(matrix.T @ matrix, lower=1)
        squares, failed = lapack.dsterf(diagonal, off_diagonal)
        apart = np.diff(squares[-count - 1 :]).min()
        if not failed and squares[-count] > _SQUARED_TOLERANCE * squares[-1] and apart > _RANK_TOLERANCE * squares[-1]:
            from monitor.identification.eigen import tridiagonal_vectors  # compiled code takes a while to load

            vectors = tridiagonal_vectors(diagonal, off_diagonal, squares[: -count - 1 : -1]).T
            others, *_ = lapack.dormqr("L", "N", reflected[1:, :-1], scales, vectors[1:], 64 * count)
            return np.sqrt(squares[: -count - 1 : -1]), np.concatenate([vectors[:1], others])
        _, values, right_t = svd(matrix)
        return values, right_t[:count].T
    from scipy.sparse.linalg import svds  # takes a quarter of a second to load

    _, values, right_t = svds(matrix, count, v0=np.ones(min(matrix.shape)))  # fixed start vector: reproducible bits
    return values[::-1], right_t[::-1].T


def poles(
    realisation: Realisation,
    orders: range,
    rate_hz: float,
    band_hz: tuple[float, float] = (0.0, np.inf),
    damping: tuple[float, float] = (-np.inf, np.inf),
) -> PoleTable:
    """Compute the poles of every order within bounds of frequency (Hz) and damping ratio.

    Orders above the number of states of the data are left out.
    """
    from monitor.identification.eigen import upper_poles  # compiled code takes a while to load

    identified = tuple(n for n in orders if n <= realisation.observability.shape[1])
    radian = 2.0 * np.pi / rate_hz
    region = (radian * band_hz[0], radian * band_hz[1], *damping)
    if realisation.states is None or not identified:
        largest = max(identified, default=0)
        space, value, logarithm, shape = upper_poles(*_matrices(realisation, largest), identified, region)
    else:
        found = [upper_poles(*_matrices(realisation, n), (n,), region) for n in identified]
        space = np.concatenate([k + spaces for k, (spaces, *_) in enumerate(found)])
        value, logarithm, shape = (np.concatenate(parts) for parts in list(zip(*found, strict=True))[1:])
    return PoleTable(identified, space, value, *continuous(logarithm, rate_hz), shape)


def state_space(realisation: Realisation, order: int) -> StateSpace:
    """Compute A, C and all eigenvectors of one order."""
    a, c = _matrices(realisation, order)
    values, vectors = np.linalg.eig(a)
    return StateSpace(order, values.astype(complex), vectors.astype(complex), c @ vectors, a, c)


def _matrices(realisation: Realisation, order: int) -> tuple[Annotated[Array, "n n"], Annotated[Array, "l n"]]:
    """Compute A and C of one order.

    By algorithm 2 A and C of a lower order are the leading parts of those of a higher one.  Algorithm 1 is used where its
    products are in the realisation.
    """
    l, o = realisation.n_channels, realisation.observability[:, :order]  # noqa: E741
    if realisation.states is None:
        return o[:-l].T @ o[l:], o[:l]
    return _algorithm_1(realisation.states, o, l)


def continuous(logarithm: ComplexArray, rate_hz: float) -> tuple[Array, Array]:
    """Convert logarithms of discrete-time poles to frequencies in Hz and damping ratios (eqs 14, 15), of the same shape.

    Examples
    --------
    >>> hz, damping = continuous(np.array([-0.002 + 0.2j]), rate_hz=100.0)
    >>> round(float(hz[0]), 3), round(float(damping[0]), 3)
    (3.183, 0.01)
    """
    size = np.abs(logarithm)
    return size * (rate_hz / (2.0 * np.pi)), -logarithm.real / size


def _toeplitz(sums: LagSums, i: int, past: tuple[int, ...]) -> Annotated[Array, "li ri"]:
    """Form the block Toeplitz matrix of lag covariances: block (a, b) is R(i + a - b)."""
    lag_sum = sums.total[:, list(past)]
    lag = i + np.arange(i)[:, None] - np.arange(i)[None, :]
    blocks = lag_sum[lag]  # (a, b, past channel, future channel)
    return np.asarray(blocks.transpose(0, 3, 1, 2).reshape(i * lag_sum.shape[2], -1))


def _weight(gram: Array, n_channels: int, cutoff: float) -> Array:
    """Compute W with W W^T the inverse of a Gram matrix to which white noise beyond the lowpass's cutoff is added.

    Without the noise almost no power remains between the cutoff and half the rate, and the canonical correlations there are
    all one.  States of that empty band would rank before the structure's, and an order that truncates them biases the modes.
    The weights change only the ranking of the states.  Within the band they are those of Table 1.
    """
    if cutoff >= 0.5:
        return _inverse_root(gram)
    filled, i = gram.copy(), len(gram) // n_channels
    blocks = filled.reshape(i, n_channels, i, n_channels)
    for c in range(n_channels):
        blocks[:, c, :, c] += gram[c, c] * _out_of_band_covariance(i, cutoff)
    return _inverse_root(filled)


@lru_cache(maxsize=8)
def _out_of_band_covariance(i: int, cutoff: float) -> Array:
    """Compute the covariance of i samples of white noise beyond the cutoff, of power `_OUT_OF_BAND_NOISE`."""
    lag = np.abs(np.arange(i)[:, None] - np.arange(i))
    within = 2.0 * cutoff * np.sinc(2.0 * cutoff * lag)
    return np.asarray(_OUT_OF_BAND_NOISE * ((lag == 0) - within) / (1.0 - 2.0 * cutoff))


def _inverse_root(matrix: Array) -> Array:
    """Compute W with W W^T the (pseudo-)inverse of a positive semidefinite matrix.

    W follows from Cholesky where the matrix has full rank, else (noise-free data) from an eigenvalue decomposition.
    """
    upper, failed = lapack.dpotrf(matrix)
    if not failed and upper.diagonal().min() ** 2 > _RANK_TOLERANCE * matrix.diagonal().max():
        return np.asarray(lapack.dtrtri(upper)[0])
    values, vectors = eigh(matrix)  # the pseudo-inverse of eq. 5
    inverse = np.where(values > _RANK_TOLERANCE * values[-1], 1.0 / np.sqrt(np.abs(values) + 1e-300), 0.0)
    return np.asarray(vectors * inverse)


def _state_products(full: Array, past_rows: Indices, i: int, l: int) -> tuple[Array, Array, Array]:  # noqa: E741
    """Compute the products of projections and outputs that algorithm 1 needs (eqs 9-11), independent of the state basis."""
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
    """Solve eq. 11 for A and C by least squares from the state sequences."""
    inverse, inverse_minus = np.linalg.pinv(o), np.linalg.pinv(o[:-l])
    now_now = inverse @ states[0] @ inverse.T
    next_now = inverse_minus @ states[1] @ inverse.T
    output_now = states[2] @ inverse.T
    solution = np.linalg.solve(now_now.T, np.vstack([next_now, output_now]).T).T
    n = o.shape[1]
    return solution[:n], solution[n:]
