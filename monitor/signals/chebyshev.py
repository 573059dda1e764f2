"""The Chebyshev type I lowpass (paper, section 4), designed without SciPy's signal processing.

``scipy.signal`` draws in most of SciPy, which takes longer to load than the first window takes to compute.

References
----------
A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing, 3rd edition, 2010, section 7.2 and appendix B.
"""

from __future__ import annotations

from math import asinh, sqrt
from typing import Annotated

import numpy as np

from monitor.core import Array


def chebyshev_lowpass(order: int, ripple_db: float, cutoff_hz: float, rate_hz: float) -> Annotated[Array, "order/2 6"]:
    """Design a digital Chebyshev type I lowpass of even order by the bilinear transform.

    It is to the last bit that of ``scipy.signal.cheby1``.  The sections are ``b0 b1 b2 a0 a1 a2``, the one with poles nearest
    the unit circle last.  `ripple_db` is the largest attenuation in the passband.

    Examples
    --------
    >>> sections = chebyshev_lowpass(8, 0.05, 40.0, 1024.0)
    >>> sections.shape
    (4, 6)
    >>> gain_at_0 = sections[:, :3].sum(axis=1) / sections[:, 3:].sum(axis=1)
    >>> round(float(-20.0 * np.log10(gain_at_0.prod())), 6)  # at 0 Hz an even order has the full ripple as attenuation
    0.05
    """
    ripple = sqrt(10.0 ** (0.1 * ripple_db) - 1.0)
    angles = np.pi * np.arange(-order + 1.0, order, 2.0) / (2 * order)
    analog = -np.sinh(1.0 / order * asinh(1.0 / ripple) + 1j * angles)
    gain = np.prod(-analog).real / sqrt(1.0 + ripple**2)
    warped = 4.0 * np.tan(np.pi * (cutoff_hz / (rate_hz / 2.0)) / 2.0)  # the bilinear transform at a rate of 2
    analog = warped * analog
    gain = gain * float(warped) ** order * (1.0 / np.prod(4.0 - analog)).real
    poles = (4.0 + analog) / (4.0 - analog)
    upper = poles[poles.imag > 0.0]
    upper = upper[np.argsort(-np.abs(1.0 - np.abs(upper)))]
    sections = np.array([[1.0, 2.0, 1.0, *np.poly([pole, pole.conj()]).real] for pole in upper])
    sections[0, :3] *= gain
    return sections
