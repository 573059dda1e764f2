"""Exact (static) condensation of massless degrees of freedom, as finite element models have them at rotations."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array

_MASSLESS = 1e-12
"""Part of the largest mass on the diagonal below which a degree of freedom has none. [ratio; rounding]"""


def condense_massless(
    mass: Array, stiffness: Array, slopes: Annotated[Array, "p N N"] | None = None
) -> tuple[Annotated[Array, "n n"], Annotated[Array, "n n"], Annotated[Array, "p n n"], NDArray[np.intp]]:
    """Condense the degrees of freedom that have no mass; the modes of the others stay as they are.

    Massless degrees of freedom s follow the others r without delay, ``u_s = -K_ss^-1 K_sr u_r``.  So the condensation is exact,
    unlike that of degrees of freedom with mass.  Rows without mass are zero throughout.

    Returned are mass, stiffness and its slopes dK / dk_j of the degrees of freedom with mass, and their numbers from 0.  The
    slopes are those at `stiffness`: the condensed one is linear in k_j only as far as no massless degree of freedom turns or
    moves otherwise when k_j changes.  Raises ValueError if the matrices do not fit each other, a massless degree of freedom is
    coupled by mass, or nothing holds it.

    Examples
    --------
    Two springs in series without a mass between them:

    >>> k = np.array([[3.0, -3.0], [-3.0, 9.0]])
    >>> condense_massless(np.diag([2.0, 0.0]), k)[1]
    array([[2.]])
    """
    count = len(mass)
    slopes = np.zeros((0, count, count)) if slopes is None else np.asarray(slopes, dtype=float)
    if mass.shape != (count, count) or stiffness.shape != (count, count) or slopes.shape[1:] != (count, count):
        raise ValueError(
            f"matrices of shapes {mass.shape}, {stiffness.shape} and {slopes.shape[1:]} do not fit each other"
        )
    scale = np.abs(mass).max(initial=0.0)
    with_mass = np.diag(mass) > _MASSLESS * scale
    kept, left = np.flatnonzero(with_mass), np.flatnonzero(~with_mass)
    if not len(kept) or np.abs(mass[left]).max(initial=0.0) > _MASSLESS * scale:
        raise ValueError("no degree of freedom has mass, or one without a mass on the diagonal is coupled by mass")
    try:
        follow = -np.linalg.solve(stiffness[np.ix_(left, left)], stiffness[np.ix_(left, kept)])
    except np.linalg.LinAlgError as error:
        raise ValueError("a massless degree of freedom is held by no stiffness") from error
    motion = np.zeros((count, len(kept)))  # how all degrees of freedom move with those that are kept
    motion[kept] = np.eye(len(kept))
    motion[left] = follow

    def condensed(matrix: Array) -> Array:
        out: Array = motion.T @ matrix @ motion
        return 0.5 * (out + out.T)

    of_slopes = np.array([condensed(slope) for slope in slopes]).reshape(-1, len(kept), len(kept))
    return mass[np.ix_(kept, kept)], condensed(stiffness), of_slopes, kept
