"""First-order uncertainty of identified modes, from the scatter of the window's blocks.

The lag sums of each block deviate from the mean over the window.  The influence of a block is the first-order change of
frequency, damping and shape that its deviation causes.  The sum of squares of the influences is the covariance of the estimate.
To first order the weights of Table 1 do not matter: with ``O = Y_f Y_p^T Z`` an error of the lag sums enters as
``dO = d(Y_f Y_p^T) Z``.

References
----------
E. Reynders, R. Pintelon, G. De Roeck, Uncertainty bounds on modal parameters obtained from stochastic subspace
identification, Mechanical Systems and Signal Processing 22 (2008) 948-969; M. Doehler, L. Mevel, Efficient
multi-order uncertainty computation for stochastic subspace identification, MSSP 38 (2013) 346-366.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.lib.stride_tricks import as_strided

from monitor.core import Array, ComplexArray, LagSums
from monitor.identification.ssi import Realisation, StateSpace


def mode_deviations(
    sums: LagSums, realisation: Realisation, space: StateSpace, chosen: list[int], shapes: ComplexArray, rate_hz: float
) -> Annotated[Array, "blocks m 2+2c"]:
    """Compute the influence of every block on ln f, damping ratio, real and imaginary part of the shape of the chosen modes.

    `chosen` are the indices of the modes' poles in `space`, `shapes` the normalized shapes, one component exactly 1.
    """
    l, observability = realisation.n_channels, realisation.observability[:, : space.order]  # noqa: E741 - the paper's letters
    pole, modes = space.poles[chosen][:, None], np.arange(len(chosen))
    d_ov = _observability_influence(sums, realisation, space.right[:, chosen])
    # w_j^H dA v_q, shape (m, n, n_blocks), as A v_q = pole v_q
    moved = np.linalg.solve(space.right, observability[:-l].T) @ (d_ov[:, l:] - pole[..., None] * d_ov[:, :-l])
    mu = np.log(pole) * rate_hz
    d_mu = moved[modes, chosen] * rate_hz / pole
    d_ln_f = (mu.conjugate() * d_mu).real / np.abs(mu) ** 2
    d_damping = (mu.real * d_ln_f - d_mu.real) / np.abs(mu)
    apart = pole - space.poles
    apart[modes, chosen] = np.inf
    d_shape = d_ov[:, :l] + space.shapes @ (moved / apart[..., None])
    gauge = np.abs(shapes - 1.0).argmin(axis=1)
    at_gauge = space.shapes[gauge, chosen][:, None, None]
    d_shape = (d_shape - shapes[..., None] * d_shape[modes, gauge][:, None]) / at_gauge
    influence = np.concatenate([d_ln_f[:, None], d_damping[:, None], d_shape.real, d_shape.imag], axis=1)
    return np.ascontiguousarray(influence.transpose(2, 0, 1))


def _observability_influence(sums: LagSums, realisation: Realisation, states: ComplexArray) -> ComplexArray:
    """Compute dO of every block, the last axis, times m state vectors, the first."""
    from monitor.identification.kernels import scatter  # compiled code takes a while to load

    past, n_blocks, m = np.array(realisation.past), len(sums.products), states.shape[1]
    by_lag = scatter(sums.products, sums.shifted, sums.mean, sums.counts, past)
    z = realisation.right[:, : len(states)] @ np.concatenate([states.real, states.imag], axis=1)
    # The mean of the n_blocks blocks was subtracted: the squares are corrected for this degree of freedom.
    z *= np.sqrt(n_blocks / (n_blocks - 1.0)) if n_blocks > 1 else 1.0
    back = z.T.reshape(2 * m, -1, past.size)[:, ::-1].reshape(2 * m, -1)
    # Block (a, b) of d(Y_f Y_p^T) is the deviation at lag i + a - b, transposed: row a needs i consecutive lags from lag a + 1.
    lags = by_lag.reshape(len(by_lag) * past.size, -1)
    (down, along), i = lags.strides, back.shape[1] // past.size
    product = back @ as_strided(lags, (i, back.shape[1], lags.shape[1]), (down * past.size, down, along))
    parts = product.transpose(1, 0, 2).reshape(2, m, -1, n_blocks)
    return np.asarray(parts[0] + 1j * parts[1])
