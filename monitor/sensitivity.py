"""Derivatives of a model's modes by its parameters (eqs 18-20)."""

from __future__ import annotations

import numpy as np

from monitor.model import Modes
from monitor.results import Array


def fox_kapoor(modes: Modes, d_k: Array, d_m: Array) -> tuple[Array, Array]:
    """Derivatives of eigenvalues (eq. 20) and mode shapes (eq. 19, expanded in the modes).

    Parameters
    ----------
    d_k, d_m : ndarray, shape (p, n, n)

    Returns
    -------
    d_lambda : ndarray, shape (n, p)
    d_shapes : ndarray, shape (n, n, p)
        ``d_shapes[i]`` is the derivative of mode i, floors by parameters, at unit modal mass.

    References
    ----------
    R. L. Fox, M. P. Kapoor, Rates of change of eigenvalues and eigenvectors, AIAA Journal 6 (1968) 2426-2429.
    """
    phi, lam = modes.shapes, modes.eigenvalues
    k_modal, m_modal = phi.T @ d_k @ phi, phi.T @ d_m @ phi
    mixed = k_modal - lam[None, None, :] * m_modal
    d_lambda = np.einsum("pii->ip", mixed)
    apart = lam[None, :] - lam[:, None]  # lambda_i - lambda_r at (r, i)
    # Modes that coincide may mix at will; their mixing is left out.
    apart[np.abs(apart) < 1e-9 * lam] = np.inf
    coefficients = mixed / apart
    diagonal = np.arange(lam.size)
    coefficients[:, diagonal, diagonal] = -0.5 * m_modal[:, diagonal, diagonal]
    return d_lambda, (phi @ coefficients).transpose(2, 1, 0)
