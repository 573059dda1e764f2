"""Uncertainty of modes identified from one free decay in white sensor noise.

A decay has no stationary blocks from whose scatter the uncertainty could be estimated.  But its model is explicit, a sum of
damped sinusoids.  The covariance follows from the linearized least-squares fit of that sum, and the noise from the residual.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from monitor.core import Array, ModalEstimate

_SETTLING_S = 0.3
"""Time after a blow during which the lowpass still rings. [s; impulse response of the lowpass]"""


def with_decay_deviations(modes: ModalEstimate, values: Annotated[Array, "samples c"], rate_hz: float) -> ModalEstimate:
    """Compute the deviations of modes (each shape with one component exactly 1) from the conditioned free decay they are of."""
    skip = round(_SETTLING_S * rate_hz)
    y = values[skip:]
    t = np.arange(skip, values.shape[0]) / rate_hz
    omega = 2.0 * np.pi * modes.frequencies_hz
    poles = omega * (-modes.damping_ratio + 1j * np.sqrt(1.0 - modes.damping_ratio**2))
    waves = np.exp(np.outer(t, poles))
    basis = np.concatenate([waves.real, -waves.imag], axis=1)  # y = Re(waves a) = basis [Re a; Im a]
    coefficients = np.linalg.lstsq(basis, y, rcond=None)[0]
    m, c = modes.frequencies_hz.size, y.shape[1]
    amplitude = coefficients[:m] + 1j * coefficients[m:]  # (m, c)
    noise = y - basis @ coefficients
    sigma = np.sqrt((noise**2).sum() / (noise.size - 2 * m * (c + 1)))
    # Unknowns: Re and Im of every amplitude, then of every pole; all channels share the poles.
    jacobian = np.zeros((y.size, 2 * m * c + 2 * m))
    for channel in range(c):
        rows = slice(channel * t.size, (channel + 1) * t.size)
        columns = np.arange(2 * m) * c + channel
        jacobian[rows, columns] = basis
        slope = t[:, None] * waves * amplitude[:, channel]
        jacobian[rows, 2 * m * c :] = np.concatenate([slope.real, -slope.imag], axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    factor = sigma * np.linalg.pinv(jacobian / scale).T / scale  # one row a datum; squares sum to the covariance
    # The R factor of its QR decomposition has the same sums of squares in few rows.
    factor = np.asarray(np.linalg.qr(factor, mode="r"))
    d_amplitude = (factor[:, : m * c] + 1j * factor[:, m * c : 2 * m * c]).reshape(-1, m, c)
    d_pole = factor[:, 2 * m * c : 2 * m * c + m] + 1j * factor[:, 2 * m * c + m :]
    gauge = np.abs(modes.shapes - 1.0).argmin(axis=1)
    at_gauge = amplitude[np.arange(m), gauge]
    d_shape = (d_amplitude - modes.shapes * d_amplitude[:, np.arange(m), gauge][:, :, None]) / at_gauge[:, None]
    d_ln_f = (poles.conjugate() * d_pole).real / omega**2
    d_damping = -d_pole.real / omega - modes.damping_ratio * d_ln_f
    deviations = np.concatenate([d_ln_f[:, :, None], d_damping[:, :, None], d_shape.real, d_shape.imag], axis=2)
    return replace(modes, deviations=deviations)
