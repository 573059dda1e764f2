"""How well causes' sizes are known: by the fit, by simulations' chance, and by what the model's form leaves open."""

from __future__ import annotations

import numpy as np

from monitor.core import Array
from monitor.inference import MapEstimate, Posterior
from monitor.model import Effect, JointFlexibility

_FORM = 2.0
"""What is not known of a story's stiffness, over the RMS of the relative correction that the drawing's form needs."""
_GIRDERS = 0.25
"""What is not known of a story's change beside flexible joints, times their girder-to-column ratio: half of what it matters
whether girders changed with the columns (frames like the paper's)."""
_LINE = 0.02
"""How well a line's frequency is read, of a bin."""
_SURE = 2.0
"""Standard deviations from nothing that a size must have to be one."""


def deviations(problem: Posterior, at: MapEstimate, doubt: Array) -> list[Array]:
    """Standard deviations of every effect's coordinates, shape (p,) each; `doubt` are those by simulation, of all of them."""
    first, out = 0, []
    own = np.sqrt(np.maximum(np.diag(at.covariance)[problem.layout.effects], 0.0))
    for effect in at.effects:
        these = slice(first, first + len(effect.parameters))
        out.append(np.hypot(own[these], np.hypot(doubt[these], form_variance(problem, at, effect))))
        first = these.stop
    return out


def is_significant(effect: Effect, deviation: Array) -> bool:
    """Whether a size is beyond doubt not that of no effect; what has no size always is."""
    away = [
        abs(x - (p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0)) >= _SURE * std
        for p, x, std in zip(effect.parameters, effect.coordinates, deviation, strict=True)
        if p.absent is not None
    ]
    return all(away)


def form_variance(problem: Posterior, at: MapEstimate, effect: Effect) -> Array:
    """What the model's form leaves open of an effect's coordinates, as standard deviations, shape (p,).

    A size relative to a story's stiffness is known no better than that stiffness, which a frame that is no shear frame blurs;
    where joints are flexible, girders may have changed with the columns or not.
    How softening goes on beyond the third order is not known: with a fifth order like that of tanh, a size would differ by
    twice the relative softening.  A strong line is read off the taper's leakage, into bins that are otherwise another
    model's.  The rest is `Effect.form_std`.
    """
    size = np.abs(effect.coordinates)
    if effect.name == "harmonic_excitation":
        return np.array([_LINE * problem.observed.band.bin_hz / effect.lines()[0].frequency_hz, 0.0])
    if effect.name in ("bilinear_stiffness", "stiffness_change") and effect.location.startswith("story"):
        correction = at.x[problem.layout.correction]
        rms = float(np.sqrt((correction**2).mean())) if correction.size else 0.0
        beside = (*problem.prior.effects(at.x), *at.effects)
        flexible = sum(1.0 / e.girder_to_column_ratio for e in beside if isinstance(e, JointFlexibility))
        girders = _GIRDERS * min(flexible, 1.0) if effect.name == "stiffness_change" else 0.0
        return np.asarray(np.hypot(effect.form_std, size * np.hypot(_FORM * rms, girders)))
    if effect.name == "cubic_stiffness" and effect.coordinates[0] < 0.0:
        drift = problem.conditions[problem.n_classes // 2].drift_m[effect.index]
        stiffness = problem.context_at(at.x).structure.stiffness_n_per_m[effect.index]
        return np.asarray(np.hypot(effect.form_std, size * 3.0 * size * drift**2 / stiffness))
    return effect.form_std
