"""Refit of a model form of a diagnosis to a part of the recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.diagnosis.initial_fit import fit_exact_slopes
from monitor.diagnosis.plan import plan_of
from monitor.diagnosis.verdict import Diagnosis
from monitor.inference import ExcitationStart, MapEstimate, ObservedSpectra, Posterior, linearize, maximize_posterior
from monitor.model import Model

_MIN_DAMPING = 1e-9
"""Least damping ratio of a fitted model. [1; rounding]"""


def refit_form(
    part: ObservedSpectra, whole: Diagnosis, form: MapEstimate, classes: Annotated[NDArray[np.intp], "k"]
) -> tuple[Model, ExcitationStart]:
    """Fit a model form to a part of a recording.

    The fit starts from that to the whole recording, which is close: from far away the phases of a response do not lead to the
    optimum, and all else converges sooner.  The correction that simulation adds to a linearized law is also that of the whole
    recording, since it belongs to the law and not to the data.  The correction is simulated anew where the persistent laws are
    nonlinear, so that both forms are treated alike, and where the classes differ in more than the vibration level.  The part is
    weighted as the whole recording, `form` is the fit of the form to the whole, and `classes` has for each class of the part the
    same class of the whole.  Return the form, fitted to the part, and its excitation in the classes of the whole recording.
    """
    own = posterior = whole.posterior.part(part, classes)
    # A class of the whole recording that the part does not have is taken to be as the nearest one.
    nearest = np.abs(classes[:, None] - np.arange(whole.posterior.n_classes)).argmin(axis=0)
    layout, effects = whole.posterior.layout, form.effects
    by_level = not (part.by_temperature or whole.posterior.observed.by_temperature)
    shared = by_level and not any(e.nonlinear for e in posterior.prior.model.effects)
    start = ExcitationStart.at(whole.posterior, form.x).select(classes)
    x = np.concatenate([form.x[layout.structure], start.vector, form.x[layout.effects]])
    plan = plan_of(posterior)
    if not plan.knows_input and any(e.conditional for e in posterior.effects(x, effects)):
        own = replace(posterior, conditions=linearize(replace(posterior, offset=None), x, effects))
    own, fit = fit_exact_slopes(own, maximize_posterior(own, x, effects, iterations=plan.part_steps))
    excitation = ExcitationStart.at(own, fit.x, own.beyond(fit.x, fit.effects) if shared else None)
    return fitted_model(own, fit), excitation.select(nearest)


def fitted_model(posterior: Posterior, fit: MapEstimate) -> Model:
    """Build the model at a fit, with persistent and extra effects and with the modal damping ratios of the fit."""
    effects = posterior.effects(fit.x, fit.effects)
    model, damping = posterior.model(fit.x, effects), posterior.system(fit.x, effects).damping
    modes = model.modes()
    modal = np.einsum("ai,ab,bi->i", modes.shapes, damping, modes.shapes)
    ratios = modal / (2.0 * np.sqrt(np.maximum(modes.eigenvalues, 1e-12)))
    return replace(model, modal_damping=np.maximum(ratios, _MIN_DAMPING))  # rounding may leave less than nothing
