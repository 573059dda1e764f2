"""First-order uncertainty of identified modes, from the scatter of the window's blocks.

Each block's lag sums deviate a little from the window's mean; carried through the identification to first order, each
deviation moves frequency, damping and shape of a mode by so much.  The sum of squares of those influences is the
covariance of the estimate.  To first order the weights of Table 1 do not matter: with ``O = Y_f Y_p^T Z`` an error of
the lag sums enters as ``dO = d(Y_f Y_p^T) Z``.

References
----------
E. Reynders, R. Pintelon, G. De Roeck, Uncertainty bounds on modal parameters obtained from stochastic subspace
identification, Mechanical Systems and Signal Processing 22 (2008) 948-969; M. Doehler, L. Mevel, Efficient
multi-order uncertainty computation for stochastic subspace identification, MSSP 38 (2013) 346-366.
"""

from __future__ import annotations

import numpy as np

from monitor.results import Array, ComplexArray, LagSums
from monitor.ssi import Realisation, StateSpace

_GATHERED = 1 << 24
"""Numbers held at once."""


def mode_deviations(
    sums: LagSums,
    realisation: Realisation,
    space: StateSpace,
    chosen: list[int],
    shapes: ComplexArray,
    rate_hz: float,
) -> Array:
    """Influence of every block on the chosen modes.

    Parameters
    ----------
    chosen : list of int
        Indices of the modes' poles in `space`.
    shapes : ndarray, shape (m, c)
        The normalized shapes, one component exactly 1.

    Returns
    -------
    ndarray, shape (n_blocks, m, 2 + 2 c)
        Of ln f, damping ratio, real and imaginary part of the shape.
    """
    n, l = space.order, realisation.n_channels  # noqa: E741 - the paper's letters
    observability = realisation.observability[:, :n]
    d_o = _observability_deviations(sums, realisation, n)
    d_a = observability[:-l].T @ (d_o[:, l:] - d_o[:, :-l] @ space.a)
    left = np.linalg.inv(space.right)
    deviations = np.empty((d_o.shape[0], len(chosen), 2 + 2 * l))
    for row, q in enumerate(chosen):
        moved = left @ (d_a @ space.right[:, q]).T  # (n, n_blocks): w_j^H dA v_q
        pole = space.poles[q]
        mu = np.log(pole) * rate_hz
        d_mu = moved[q] * rate_hz / pole
        d_ln_f = (mu.conjugate() * d_mu).real / abs(mu) ** 2
        deviations[:, row, 0] = d_ln_f
        deviations[:, row, 1] = -d_mu.real / abs(mu) + mu.real / abs(mu) * d_ln_f
        apart = pole - space.poles
        apart[q] = 1.0
        moved = moved / apart[:, None]
        moved[q] = 0.0
        d_shape = d_o[:, :l] @ space.right[:, q] + (space.shapes @ moved).T
        gauge = int(np.argmin(np.abs(shapes[row] - 1.0)))
        scale = space.shapes[gauge, q]
        d_shape = (d_shape - shapes[row] * d_shape[:, gauge, None]) / scale
        deviations[:, row, 2 : 2 + l] = d_shape.real
        deviations[:, row, 2 + l :] = d_shape.imag
    return deviations


def _observability_deviations(sums: LagSums, realisation: Realisation, n: int) -> Array:
    """dO of every block, shape (n_blocks, l i, n)."""
    from monitor.kernels import about_mean  # compiled code takes a while to load

    past = list(realisation.past)
    l, r = realisation.n_channels, len(past)  # noqa: E741
    i = realisation.right.shape[0] // r
    n_blocks = len(sums.products)
    mean = sums.total / sums.counts.sum()
    # A mean of n_blocks blocks has been taken out, so the squares fall short by that degree of freedom.
    inflate = np.sqrt(n_blocks / (n_blocks - 1.0)) if n_blocks > 1 else 1.0
    about = about_mean(sums.products, sums.first, sums.second, sums.mean, sums.counts)
    deviation = (about - sums.counts[:, None, None, None] * mean) * inflate
    # Block (a, b) of d(Y_f Y_p^T) is the deviation at lag i + a - b, transposed: a convolution over past blocks.
    by_lag = deviation[:, 1:, past].transpose(0, 3, 1, 2)  # (blocks, l, lag - 1, r)
    flipped = by_lag[:, :, ::-1].reshape(n_blocks, l, -1)  # windows over it run along increasing b
    views = np.lib.stride_tricks.sliding_window_view(flipped, i * r, axis=2)[:, :, ::-r]  # (blocks, l, i, i r)
    ordered = views.transpose(0, 2, 1, 3)  # gathered group by group: with many channels it is large
    group = max(1, _GATHERED // (i * l * i * r))
    z = realisation.right[:, :n]
    parts = [ordered[b : b + group].reshape(-1, i * r) @ z for b in range(0, n_blocks, group)]
    return np.concatenate(parts).reshape(n_blocks, i * l, n)
