"""Healthy prior: the model that calibration fits for later diagnoses, and the initial lack of fit of that model."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from scipy.linalg import block_diag

from monitor.core import Array
from monitor.diagnosis.lack_of_fit import estimate_model_discrepancy
from monitor.diagnosis.plan import plan_of
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import fit_initial_model
from monitor.inference import ObservedSpectra, ParameterLayout
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
    observed: ObservedSpectra,
    known: StructuralPrior,
    context: Context,
    settings: DiagnosisSettings,
    start: Annotated[Array, "nuisances"] | None = None,
) -> tuple[StructuralPrior, Annotated[Array, "nuisances"]]:
    """Learn the prior of later diagnoses from healthy data and from the prior of the structure file.

    First the model form alone is fitted.  Then the stiffnesses are held, and persistent effects of the structure are held as well
    as they are known.  A symmetric correction of the stiffness matrix within the modes in the band takes up the remaining lack of
    fit, together with the mass ratios.  So the data determine every free direction, and the posterior is close to normal.  Bands
    that contradict the model even so are kept, and count less from then on.  Where the healthy recording could judge a part of
    its band only, later diagnoses compare in that part only: beyond it the modes are still the drawing's.  Return the prior, and
    the parameters of the model form alone.  `start` are parameters of another fit, see `fit_linearized`.
    """
    _, first_fit, _ = fit_initial_model(observed, known, context, start)
    layout = ParameterLayout.of(known)
    x = first_fit.x[layout.structure]
    model = known.model.with_stiffness(np.exp(x[layout.stiffness])).with_masses(np.exp(x[layout.masses]))
    n_modes = int(np.count_nonzero(model.modes().frequencies_hz < observed.band.hz[-1]))
    basis = correction_basis(model, n_modes)
    persistent = known.effects(x)
    effects = np.concatenate([[], *[e.coordinates for e in persistent]])
    sizes, noise = layout.persistent, layout.channel_noise
    # The correction could replace these effects, and their sizes would then drift far.
    structural = [e.family == "structure" and not e.conditional for e in persistent for _ in e.parameters]
    held = np.where(structural, 1.0 / np.diag(first_fit.covariance)[sizes], 0.0)
    mean = np.concatenate([x[: layout.correction.start], np.zeros(basis.shape[0]), effects])
    k, m, d, c, _ = known.sizes
    masses, damped_and_noisy = known.precision[layout.masses, layout.masses], slice(layout.damping.start, noise.stop)
    prior = block_diag(
        np.eye(k) / _FIXED_STD**2,
        masses + 1.0 / (m * _FIXED_STD) ** 2,  # the data do not show their common scale: fixed for now
        known.precision[damped_and_noisy, damped_and_noisy],
        np.eye(basis.shape[0]) / _CORRECTION_STD**2,
        known.precision[sizes, sizes] + np.diag(held),
    )
    band = observed.band
    judged_hz = None if band.n_bins == observed.segments.whole.n_bins else (float(band.hz[0]), float(band.hz[-1]))
    wider = replace(known, mean=mean, precision=prior, basis=basis, judged_hz=judged_hz)
    at_first_fit = np.concatenate([mean, first_fit.x[layout.structure.stop :]])
    posterior, fitted, _ = fit_initial_model(observed, wider, context, at_first_fit)
    discrepancy, covariance = estimate_model_discrepancy(posterior, fitted, settings), fitted.covariance
    if discrepancy is not None:
        wider = replace(wider, error=discrepancy)
        posterior = replace(posterior, prior=wider)
        slopes = posterior.linearized(fitted.x, (), posterior.predict(fitted.x, ()))[0]
        covariance = inverse(slopes.information + posterior.normal_prior(fitted.x, ())[1])
    structure, forces = posterior.layout.structure, fitted.x[posterior.layout.forces]
    precision = inverse(covariance[structure, structure])
    learnt = replace(
        wider,
        mean=fitted.x[structure],
        precision=0.5 * (precision + precision.T),
        ln_forces=None if plan_of(posterior).knows_input else forces - forces.mean(),
    )
    # As the baseline's file holds it, so that a diagnosis from the file is the same.
    learnt = replace(learnt, model=replace(learnt.model, effects=learnt.effects(learnt.mean)))
    learnt = learnt.with_looser_damping(np.full(d, _DAMPING_DRIFT)).with_looser_noise(np.full(c, _NOISE_DRIFT))
    learnt = learnt.with_unseen_scale(float(np.sqrt(np.linalg.inv(masses).sum()) / m))
    return learnt, first_fit.x
