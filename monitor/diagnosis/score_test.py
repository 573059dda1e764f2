"""Which effect explains what the model leaves over: a score test ranks every candidate, a fit judges the best of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.initial_fit import COARSE, FAR, LONG, ROUGHLY
from monitor.inference import MapEstimate, Posterior, Prediction, maximize_posterior
from monitor.model import EFFECTS, Context, Effect, EffectError, inverse, locations

_MAX_STEPS_ROUGH = 5
"""Most iterations of a rough fit without a measured ground. [iterations; cost]"""
_MAX_STEPS_HELD = 6
"""Most iterations of a rough fit beside a structure that is held. [iterations; cost]"""
_AMBIENT_TOLERANCE_NATS = 0.02
"""Expected gain of the next step at which a fit ends where the ground was not measured. [nats; judgement]"""
_MIN_LOG_PRIOR = -20.0
"""Log prior below which the model without the effect lies so far from its prior that a fit starts better from the
prior. [nats; judgement]"""
_ROUGH_FIT_NATS = 3.0
"""Gain that a rough fit may miss. [nats; judgement]"""
_HELD_STRUCTURE_PRECISION = 1e8
"""Precision that holds the structure while an effect's size is found. [1; rounding]"""
_RELATIVE_DIFFERENCE = 0.01
"""Share of an effect's first size over which its slope is taken. [ratio; judgement]"""
_MIN_START_FACTOR = 0.05
"""Smallest factor on an effect's start size at which it is first tried. [ratio; judgement]"""
_MAX_START_FACTOR = 20.0
"""Largest such factor. [ratio; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """One effect at one place, fitted."""

    effect: Effect
    fit: MapEstimate
    delta_log_posterior: float
    """Log posterior above the model without it, nats."""
    log_evidence: float
    """The gain less half the logarithm of the information for every parameter."""

    @property
    def key(self) -> tuple[str, str]:
        """Name and place."""
        return self.effect.name, self.effect.location

    def may_reach(self, min_log_evidence: float) -> bool:
        """Whether a better fit may have the evidence `bar`: one found half of the whole gain, or all but a little."""
        return self.log_evidence + max(self.delta_log_posterior, _ROUGH_FIT_NATS) > min_log_evidence


def candidate_starts(
    posterior: Posterior, null_fit: MapEstimate, excluded: Iterable[tuple[str, str]] = ()
) -> list[Effect]:
    """A small size of every effect at every place, and of every shape that must be tried.

    Where a law bends already, no other is tried: it would only mend what is not known of the first one's form.
    """
    typical = posterior.conditions[posterior.n_classes // 2]
    nonlinear = {
        (name, e.location) for e in null_fit.effects if e.nonlinear for name, kind in EFFECTS.items() if kind.nonlinear
    }
    skip, found = {*excluded, *nonlinear}, find_excess_peaks(posterior, null_fit)
    out: list[Effect] = []
    for name, kind in EFFECTS.items():
        if posterior.observed.drive is not None and (kind.family == "excitation" or kind.stationary_only):
            continue  # the input is measured; another one would only excuse what the model's response lacks
        for place in (p for k in kind.places for p in locations(k, posterior.context)):
            if (name, place) not in skip:
                out.extend(kind.starts(place, posterior.context, typical))
                near = (kind.at_frequency(place, float(f), posterior.context, typical) for f in found)
                out.extend(e for e in near if e is not None)
    return [e for e in out if _is_applicable(e, posterior.context)]


def _is_applicable(effect: Effect, context: Context) -> bool:
    """Whether the structure is one that the effect can act on."""
    try:
        effect.check(context.structure, context.channels)
    except EffectError:
        return False
    return True


def find_excess_peaks(posterior: Posterior, null_fit: MapEstimate, n: int = 3) -> Array:
    """Frequencies at which the measured power exceeds the model's the most, Hz; of lines, to a small part of a bin."""
    c = posterior.observed.spectra.shape[-1]
    shape = (posterior.n_classes, posterior.observed.band.n_bins, c * c)
    diagonal = np.cumsum([1, *(2 * np.arange(1, c) + 1)]) - 1
    over = null_fit.residual.reshape(shape)[:, :, diagonal].sum(axis=(0, 2)).copy()
    here, band = posterior.predict(null_fit.x, null_fit.effects), posterior.observed.band
    power = np.einsum("k,kfaa->f", posterior.observed.counts, here.data - here.spectra).real
    found = []
    for _ in range(n):
        i = int(over.argmax())
        found.append(band.hz[i] + band.bin_hz * _line_offset(power, i))
        over[max(0, i - 4) : i + 5] = -np.inf
    return np.array(found)


def _line_offset(power: Array, i: int) -> float:
    """Where a line lies about the bin that it is strongest in, in bins, by its share in the next one (Hann's taper)."""
    beside = power[max(0, i - 1) : i + 2 : 2]
    if power[i] <= 0.0 or beside.size < 2:
        return 0.0
    ratio = np.sqrt(np.clip(beside.max() / power[i], 0.25, 1.0))
    return float((2.0 * ratio - 1.0) / (ratio + 1.0) * (1 if beside[1] > beside[0] else -1))


def rank_by_score(posterior: Posterior, null_fit: MapEstimate, candidates: list[Effect]) -> list[tuple[float, Effect]]:
    """Gain that the score test promises for every start, best first; each effect moved to the size that it suggests.

    A fit that went far to explain what it cannot hides what would explain it; so effects are tried beside what was known, too.
    """
    promised = _expected_gains(posterior, null_fit, candidates)
    if _far_from_prior(posterior, null_fit):
        held, rest = _fit_at_prior(posterior, null_fit)
        lost = null_fit.log_posterior - rest.log_posterior
        promised += [(gain - lost, effect) for gain, effect in _expected_gains(held, rest, candidates)]
        shaped = [e for e in candidates if e.parameters and not e.proportional]  # whose size no score test tells
        promised += parallel_map(partial(_gain_from_prior, posterior, null_fit), shaped)
    return sorted(promised, key=lambda item: -item[0])


def _expected_gains(
    posterior: Posterior, null_fit: MapEstimate, candidates: list[Effect]
) -> list[tuple[float, Effect]]:
    """As `rank_by_score`, about one fit: the change of the spectra that a small effect makes, less what the nuisances explain, is
    compared with the residual.
    """
    here = posterior.predict(null_fit.x, null_fit.effects)
    mean, precision = posterior.normal_prior(null_fit.x, null_fit.effects)
    tangent = null_fit.jacobian
    normal = inverse(tangent.T @ tangent + precision)
    residual = np.concatenate([null_fit.residual, null_fit.mean_residual])
    # The nuisances' own slope is that of the posterior: what pulls them from what was known before speaks for an effect.
    own_slope = tangent.T @ residual - precision @ (null_fit.x - mean)
    tangent, driven = np.asfortranarray(tangent), posterior.observed.drive is not None

    def promised(effect: Effect) -> list[tuple[float, Effect]]:
        if effect.proportional and not driven:
            out, v = [], _whitened_slope(posterior, null_fit, here, effect)
        else:
            moved = posterior.predict(null_fit.x, (*null_fit.effects, effect))
            # What it gains as it stands, once the levels have followed: for starts that happen to lie near the truth.
            whole = posterior.log_likelihood(moved.spectra, moved.data, levelled=True) - null_fit.log_likelihood
            out = [(whole, effect)]
            if not effect.proportional:
                return out
            # Phases of a driven response turn far between two fits: whole changes rank better there (docs/measured-frames.md).
            v = whitened_change(posterior, here, moved)
        along = tangent.T @ v
        information, score = float(v @ v - along @ normal @ along), float(v @ residual - along @ normal @ own_slope)
        grown = None if information < 1e-9 else _scale_amplitude(effect, score / information)
        return out if grown is None else [*out, (0.5 * score**2 / information, grown)]

    return list(chain.from_iterable(parallel_map(promised, candidates)))


def _whitened_slope(posterior: Posterior, null_fit: MapEstimate, here: Prediction, effect: Effect) -> Array:
    """Whitened change by an effect, in proportion to what next to nothing of it makes: where noise is little, even a small
    effect's change is far from a straight line."""
    slight = _scale_size(effect, _RELATIVE_DIFFERENCE ** (1.0 / effect.order))
    assert slight is not None, "nearer to nothing than one that is possible"
    return np.asarray(
        whitened_change(posterior, here, posterior.predict(null_fit.x, (*null_fit.effects, slight)))
        / _RELATIVE_DIFFERENCE
    )


def _far_from_prior(posterior: Posterior, null_fit: MapEstimate) -> bool:
    """Whether a fit went far from what was known before, whose response is not told by phases."""
    return posterior.observed.drive is None and null_fit.log_prior < _MIN_LOG_PRIOR


def _fit_at_prior(posterior: Posterior, null_fit: MapEstimate, *more: Effect) -> tuple[Posterior, MapEstimate]:
    """The problem with its structure held where it was known to be, fitted; with further effects."""
    known = posterior.prior
    held = replace(
        posterior, prior=replace(known, precision=known.precision + np.diag(_HELD_STRUCTURE_PRECISION / known.units**2))
    )
    x = posterior.layout.with_structure(null_fit.x, known.mean)
    return held, maximize_posterior(held, x, (*null_fit.effects, *more), iterations=_MAX_STEPS_HELD)


def _gain_from_prior(posterior: Posterior, null_fit: MapEstimate, effect: Effect) -> tuple[float, Effect]:
    """What an effect gains, fitted with the structure where it was known to be and then beside it; and the effect."""
    near = _fit_at_prior(posterior, null_fit, effect)[1]
    near = maximize_posterior(posterior, near.x, near.effects, iterations=_MAX_STEPS_HELD)
    return near.log_posterior - null_fit.log_posterior, near.effects[-1]


def whitened_change(posterior: Posterior, here: Prediction, there: Prediction) -> Array:
    """Whitened change from one prediction to another."""
    change, _ = posterior.whitened(here.spectra, (there.spectra - here.spectra)[None], here.data)
    if here.left is None or there.left is None:
        return change[:, 0]
    mean, _ = posterior.mean_rows(here, (here.left - there.left)[None])
    return np.concatenate([change, mean])[:, 0]


def _scale_amplitude(effect: Effect, amount: float) -> Effect | None:
    """The effect with its amplitude times `amount`, as far as one goes, or None where that is not possible physically."""
    size = float(np.clip(abs(amount) ** (1.0 / effect.order), _MIN_START_FACTOR, _MAX_START_FACTOR))
    return _scale_size(effect, float(np.copysign(size, amount)))


def _scale_size(effect: Effect, factor: float) -> Effect | None:
    """The effect with its size times `factor`, or None where its bounds do not let it."""
    x = effect.coordinates
    for i, p in enumerate(effect.parameters):
        if p.absent is not None:
            zero = p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0
            x[i] = zero + factor * (x[i] - zero)
            if abs(p.coordinate(p.value(x[i])) - x[i]) > 1e-6 * abs(x[i]) + 1e-12:
                return None
    return effect.at(x)


def best_of_each(ranked: list[tuple[float, Effect]]) -> list[tuple[float, Effect]]:
    """The best start of every effect and place."""
    seen: set[tuple[str, str]] = set()
    out = []
    for gain, effect in ranked:
        if (effect.name, effect.location) not in seen:
            seen.add((effect.name, effect.location))
            out.append((gain, effect))
    return out


def fit_candidate(
    posterior: Posterior,
    null_fit: MapEstimate,
    effect: Effect,
    *,
    quick: bool = False,
    min_log_evidence: float = -np.inf,
    rough: Candidate | None = None,
) -> Candidate:
    """Fit an effect beside the nuisances; with less care, once it is seen that it does not reach the evidence `bar`.

    Where the fit runs away and ends below a `rough` one, it is made again from there.
    """
    driven = posterior.observed.drive is not None
    # Driven motion tells so much that a cause bends the other slopes at once.
    frozen = null_fit.jacobian[:, posterior.layout.nuisances] if quick and not driven else None
    few, many = (ROUGHLY, FAR) if driven else (_MAX_STEPS_ROUGH, LONG)
    fitted = partial(
        maximize_posterior,
        posterior,
        iterations=few if quick else many,
        tolerance=COARSE if driven else _AMBIENT_TOLERANCE_NATS,
    )
    found = score_candidate(posterior, null_fit, fitted(null_fit.x, (*null_fit.effects, effect), frozen=frozen))
    if not quick and _far_from_prior(posterior, null_fit):
        near = _fit_at_prior(posterior, null_fit, effect)[1]
        likely = (
            found.may_reach(min_log_evidence) or sum(posterior.score(near.x, near.effects)) > found.fit.log_posterior
        )
        if likely or not effect.proportional:
            other = score_candidate(
                posterior, null_fit, maximize_posterior(posterior, near.x, near.effects, iterations=LONG)
            )
            found = max(found, other, key=lambda c: c.log_evidence)
    if rough is not None and found.log_evidence < rough.log_evidence:
        again = score_candidate(posterior, null_fit, fitted(rough.fit.x, rough.fit.effects))
        found = max(found, again, key=lambda c: c.log_evidence)
    return found


def score_candidate(
    posterior: Posterior, null_fit: MapEstimate, fitted: MapEstimate, n_more: int | None = None
) -> Candidate:
    """What a fit gains by its last effect, or by `n_more` parameters."""
    effect = fitted.effects[-1]
    n_more = len(effect.parameters) if n_more is None else n_more
    gain = fitted.log_posterior - null_fit.log_posterior
    return Candidate(effect, fitted, gain, gain - parameter_cost(posterior, n_more))


def parameter_cost(posterior: Posterior, n_more: int) -> float:
    """Half the logarithm of the information for every parameter, nats."""
    n = posterior.observed.counts.sum() * posterior.observed.band.n_bins * posterior.observed.weight
    return 0.5 * n_more * float(np.log(n))
