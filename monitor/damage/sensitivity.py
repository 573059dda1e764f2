"""Derivatives of a model's modes by its parameters (eqs 18-20)."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.model import Modes


def fox_kapoor(
    modes: Modes, d_k: Annotated[Array, "p n n"], d_m: Annotated[Array, "p n n"] | None = None
) -> tuple[Annotated[Array, "n p"], Annotated[Array, "n n p"]]:
    """Compute the derivatives of eigenvalues (eq. 20) and of mode shapes (eq. 19, expanded in the modes).

    All n modes are needed, of unit modal mass.  `d_shapes[i]` is the derivative of mode i, floors by parameters, at unit modal
    mass.  `d_k` and `d_m` are the derivatives of the stiffness and mass matrices by p parameters; masses are constant without
    `d_m`.

    References
    ----------
    R. L. Fox, M. P. Kapoor, Rates of change of eigenvalues and eigenvectors, AIAA Journal 6 (1968) 2426-2429.
    """
    phi, lam = modes.shapes, modes.eigenvalues
    mixed, diagonal = phi.T @ d_k @ phi, np.arange(lam.size)
    own: Array | float = 0.0
    if d_m is not None:
        m_modal = phi.T @ d_m @ phi
        mixed -= lam * m_modal
        own = -0.5 * m_modal[:, diagonal, diagonal]
    d_lambda = mixed[:, diagonal, diagonal].T
    apart = lam[None, :] - lam[:, None]  # lambda_i - lambda_r at (r, i)
    # Shapes of coincident modes are determined only up to a rotation; the term between them is left out.
    apart[np.abs(apart) < 1e-9 * lam] = np.inf
    coefficients = mixed / apart
    coefficients[:, diagonal, diagonal] = own
    return d_lambda, (phi @ coefficients).transpose(2, 1, 0)
