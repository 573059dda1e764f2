"""What calibration learns of the healthy structure for later diagnoses: its model, and what that model misses from the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from monitor.core import Array
from monitor.diagnosis.lack_of_fit import estimate_model_discrepancy
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import fit_initial_model
from monitor.inference import ObservedSpectra, ParameterLayout, Posterior
from monitor.model import Context, StructuralPrior, correction_basis, inverse

_FIXED_STD = 1e-4
"""Standard deviation of what is held at its value. [1; rounding]"""
_CORRECTION_STD = 0.1
"""Prior standard deviation of the correction of the stiffness matrix that no effect explains. [1; not recorded]"""
_DAMPING_DRIFT = 0.05
"""Relative change of a mode's damping from calibration that needs no cause. [ratio; judgement]"""
_NOISE_DRIFT = 0.2
"""Relative change of a channel's noise density over the others' that needs no cause: a channel's noise may follow its
motion. [ratio; judgement]"""


def learn_prior(
    observed: ObservedSpectra, known: StructuralPrior, context: Context, settings: DiagnosisSettings
) -> tuple[StructuralPrior, Array]:
    """The reference that healthy evidence makes of what was known before.

    First the model form alone is fitted.  Then its stiffnesses stay, standing effects of the structure stay as well as they are
    known, and a symmetric correction within the modes in the band, with the masses' ratios, takes up what it misses.  So every
    direction that is left free is one that data fix, and the posterior is close to normal.  What even so contradicts the model
    in some bands is kept, and they count less from then on.

    Returns
    -------
    StructuralPrior
    ndarray, shape (e,)
        The correction, relative to the modes' stiffness.
    """
    _, form, _ = fit_initial_model(observed, known, context)
    layout = ParameterLayout.of(known)
    x = form.x[layout.structure]
    model = known.model.with_stiffness(np.exp(x[layout.stiffness])).with_masses(np.exp(x[layout.masses]))
    n_modes = int(np.count_nonzero(model.modes().frequencies_hz < observed.band.hz[-1]))
    basis = correction_basis(model, n_modes)
    standing = known.effects(x)
    effects = np.concatenate([[], *[e.coordinates for e in standing]])
    sizes, noise = layout.persistent, layout.channel_noise
    # The correction could take the place of these, and their sizes drift far beside it.
    like = [e.family == "structure" and not e.conditional for e in standing for _ in e.parameters]
    held = np.where(like, 1.0 / np.diag(form.covariance)[sizes], 0.0)
    mean = np.concatenate([x[: layout.correction.start], np.zeros(basis.shape[0]), effects])
    k, m, d, c, _ = known.sizes
    masses, damped_and_noisy = known.precision[layout.masses, layout.masses], slice(layout.damping.start, noise.stop)
    prior = block_diag(
        np.eye(k) / _FIXED_STD**2,
        masses + 1.0 / (m * _FIXED_STD) ** 2,  # their common scale cannot be seen: fixed for now
        known.precision[damped_and_noisy, damped_and_noisy],
        np.eye(basis.shape[0]) / _CORRECTION_STD**2,
        known.precision[sizes, sizes] + np.diag(held),
    )
    wider = replace(known, mean=mean, precision=prior, basis=basis)
    posterior, fitted, _ = fit_initial_model(observed, wider, context)
    wrong, covariance = estimate_model_discrepancy(posterior, fitted, settings), fitted.covariance
    if wrong is not None:
        wider = replace(wider, error=wrong)
        covariance = _covariance(replace(posterior, prior=wider), fitted.x)
    structure = posterior.layout.structure
    precision = inverse(covariance[structure, structure])
    learnt = replace(wider, mean=fitted.x[structure], precision=0.5 * (precision + precision.T))
    learnt = learnt.with_looser_damping(np.full(d, _DAMPING_DRIFT)).with_looser_noise(np.full(c, _NOISE_DRIFT))
    learnt = learnt.with_unseen_scale(float(np.sqrt(np.linalg.inv(masses).sum()) / m))
    return learnt, learnt.mean[ParameterLayout.of(learnt).correction]


def _covariance(posterior: Posterior, x: Array) -> Array:
    """Of parameters that were fitted to more than the problem now trusts, shape (p, p)."""
    rows = posterior.jacobian(x, (), posterior.predict(x, ()))[0]
    return inverse(rows.T @ rows + posterior.normal_prior(x, ())[1])
