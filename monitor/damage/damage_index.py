"""The damage detection index: relative stiffness lost in each story since the baseline (paper, section 4)."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import numpy as np

from monitor.core import Array, DamageReading, ModalEstimate, StiffnessEstimate
from monitor.damage.baseline import Baseline
from monitor.damage.covariate_law import Effect
from monitor.damage.covariates import TEMPERATURE
from monitor.damage.updating import UNSEEN, Observation, Update, UpdatingSettings, observe, update
from monitor.model import Model, ShearFrame

_TOLERATED_MISFIT = 2.0
"""Goodness of fit up to which the damage index is taken as it is: twice its expectation. [ratio; chi-square with six
degrees of freedom: exceeded by chance in 6 % of windows]"""


def step(
    modes: ModalEstimate,
    reference: Model,
    baseline: Baseline | None,
    sensors: Annotated[Array, "c n"],
    settings: UpdatingSettings,
    effect: Effect | None = None,
    prior_std: Annotated[Array, "p"] | None = None,
) -> tuple[StiffnessEstimate, DamageReading]:
    """Update the stiffness to a window's modes and compute its loss since the baseline.

    With a baseline the update starts from the baseline's model, and its target is the measured modes minus the baseline's
    misfit.  A model with a systematic error then still gives the right change.  To first order the loss is ``gain (z -
    z_baseline)``, and its covariance contains that of both.

    Parameters
    ----------
    modes : ModalEstimate
        With a baseline, those of `baseline` in its order.
    reference : Model
        The baseline's model, or the structure file's where there is no baseline.
    sensors : ndarray
        Sensor matrix: channels by floors.
    effect : Effect, optional
        What the covariates explain of the window's stiffness (`CovariateLaw.expected`).  The loss refers to the healthy
        stiffness under them.
    prior_std : ndarray, optional
        Prior standard deviation of each stiffness, relative to the reference; by default `settings.parameter_std` for all.  It
        determines directions that the modes do not observe, and bounds their uncertainty.
    """
    observation = observe(modes, settings, baseline.gauges if baseline is not None else None)
    if baseline is not None:
        observation, reference = baseline.target(observation), _as_built(reference)
    if prior_std is None:
        prior_std = np.full(reference.structure.n_stories, settings.parameter_std)
    fit = update(reference, sensors, observation, settings, prior_std=prior_std)
    z_covariance = observation.deviations.T @ observation.deviations
    if baseline is None:
        misfit, uncertain = 1.0, z_covariance
    else:
        uncertain = z_covariance + baseline.z_covariance
        misfit = _misfit_of_change(fit, observation, uncertain)
    # Where stiffness explains the change badly (a window across the onset, another cause), the noise understates its error.
    widened = max(1.0, misfit / _TOLERATED_MISFIT)
    scatter = None if baseline is None else baseline.scatter
    effect_covariance = np.zeros((fit.parameters.size, fit.parameters.size))
    if scatter is not None:
        effect_covariance += np.diag(scatter.beyond * (1.0 + 1.0 / scatter.records))
    if effect is not None:
        effect_covariance += effect.covariance
        reference = reference.with_stiffness(reference.structure.stiffness_n_per_m * (1.0 + effect.relative))
    healthy = reference.structure.stiffness_n_per_m
    estimate = StiffnessEstimate(
        stiffness_n_per_m=fit.parameters,
        covariance=widened * (fit.gain @ z_covariance @ fit.gain.T) + fit.prior_left,
        converged=fit.converged,
        iterations=fit.iterations,
        misfit=misfit,
        mode_misfit=_mode_misfit(fit.residual, observation),
    )
    covariance = widened * (fit.gain @ uncertain @ fit.gain.T) + fit.prior_left
    common = np.zeros_like(covariance) if baseline is None else fit.gain @ baseline.z_covariance @ fit.gain.T
    common = common + fit.prior_left  # averaging does not lessen the uncertainty of unobserved directions
    is_chain = isinstance(reference.structure, ShearFrame)
    healthy_k, now_k = reference.stiffness_matrix(), fit.model.stiffness_matrix()
    ddi = 1.0 - fit.parameters / healthy
    form = 0.0 if baseline is None else baseline.model_form
    form_covariance = (form * np.abs(ddi).max()) ** 2 * np.eye(ddi.size)
    reading = DamageReading(
        loss=ddi,
        covariance=covariance / np.outer(healthy, healthy) + effect_covariance + form_covariance,
        model_form=form,
        ddi_sequential=sequential_reading(healthy_k, now_k) if is_chain else ddi,
        loss_n_per_m=healthy - fit.parameters,
        common_covariance=common / np.outer(healthy, healthy) + effect_covariance,
        freedom=np.inf if scatter is None else scatter.freedom,
        temperature_effect=None if effect is None else effect.parts.get(TEMPERATURE),
        covariate_effect={} if effect is None else dict(effect.parts),
        unidentified=tuple(int(j) + 1 for j in np.flatnonzero(fit.identifiable < 1.0 - UNSEEN**2)),
    )
    return estimate, reading


_as_built = lru_cache(maxsize=4)(Model.as_built)
"""`Model.as_built`, cached: one model object for all windows, so that updating reuses its modes."""


def _mode_misfit(residual: Annotated[Array, "d"], observation: Observation) -> Annotated[Array, "m"]:
    """Compute the squared residual of each mode's frequency and shape over their variances."""
    m = len(observation.model_mode)
    square = residual**2 / np.maximum((observation.deviations**2).sum(axis=0), 1e-300)
    return np.asarray(square[:m] + square[m:].reshape(m, -1).sum(axis=1))


def _misfit_of_change(fit: Update, observation: Observation, covariance: Array) -> float:
    """Compute the weighted squared residual of the updated change over its expectation from both covariances."""
    left_over = np.eye(fit.residual.size) - fit.sensitivity @ fit.gain
    expected = float(np.trace(observation.weight @ left_over @ covariance @ left_over.T))
    return float(fit.residual @ observation.weight @ fit.residual) / max(expected, 1e-300)


def sequential_reading(healthy: Annotated[Array, "n n"], now: Annotated[Array, "n n"]) -> Annotated[Array, "n"]:
    """Compute the DDI from two stiffness matrices of a shear frame, N/m, in the paper's sequence.

    Story j < n alone determines the term K[j, j+1] = -k_j; the last story follows from K[n, n] less story n - 1.

    Examples
    --------
    >>> healthy = np.array([[2.0, -2.0], [-2.0, 6.0]])  # the upper story has 2 N/m, the lower 4 N/m
    >>> sequential_reading(healthy, np.array([[2.0, -2.0], [-2.0, 5.0]]))  # the lower story lost a quarter
    array([0.  , 0.25])
    """
    n = healthy.shape[0]
    before, after = -np.diag(healthy, 1), -np.diag(now, 1)
    above = (before[-1], after[-1]) if n > 1 else (0.0, 0.0)
    before, after = np.append(before, healthy[-1, -1] - above[0]), np.append(after, now[-1, -1] - above[1])
    return np.asarray(1.0 - after / before)
