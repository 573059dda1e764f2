"""Starting point of a fit: the posterior of a recording, and a guess of its excitation from the measured power."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.inference.ambient_posterior import AmbientPosterior
from monitor.inference.driven_posterior import DrivenPosterior
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.posterior import Posterior
from monitor.model import Condition, Context, StructuralPrior

_QUIETEST_QUANTILE = 0.02
"""Quantile of the power over frequency in which noise shows. [ratio; judgement]"""
_NOISE_SHARE = 0.3
"""Share of the power in this quantile that is noise. [ratio; judgement]"""
_LITTLE_NOISE = 10.0
"""How far below that, as a logarithm, the noise lies while the forces' level is found. [1; judgement]"""


def make_posterior(observed: ObservedSpectra, prior: StructuralPrior, context: Context) -> Posterior:
    """Make the posterior of a recording: driven where inputs were measured, else ambient.

    The motion of the classes is not known yet.  Until `linearize` has estimated the motion, all its values are one (m, m/s,
    m/s^2), which is sufficient as long as no effect depends on the motion.
    """
    n, c, stories = context.structure.n_dofs, len(context.channels), context.structure.n_stories
    unknown = Condition(np.ones(stories), np.ones(stories), np.ones(n), np.ones(c))
    kind = DrivenPosterior if observed.drive.inputs else AmbientPosterior
    return kind(observed, prior, context, (unknown,) * observed.counts.size)


def guess_levels(posterior: Posterior) -> tuple[Annotated[Array, "nuisances"], Annotated[Array, "classes"]]:
    """Guess the noise from the least power, and the level of every class from the medians of the power over frequency.

    Medians are robust to peaks at other frequencies than those of the model.  Returned are the prior's start with the guessed
    noise, in which forces and levels are zero, and the measured over the predicted power there with nearly no noise.
    """
    layout, c = posterior.layout, len(posterior.context.channels)
    power = np.einsum("kfaa->kfa", posterior.observed.spectra[:, :, :c, :c]).real
    quiet = float(np.quantile(power.mean(axis=(0, 2)), _QUIETEST_QUANTILE))
    noise = np.log(max(_NOISE_SHARE * quiet, 1e-300))
    x = np.zeros(layout.n_nuisance)
    x[layout.structure], x[layout.noise] = posterior.prior.start, noise - _LITTLE_NOISE
    predicted = np.einsum("kfaa->kfa", posterior.scatter(x, ())[:, :, :c, :c]).real
    x[layout.noise] = noise
    return x, np.asarray(np.median(power / predicted, axis=(1, 2)))
