"""Score test for effects: it ranks every candidate by the lack of fit that it may explain; a fit judges the best of them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Annotated

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.initial_fit import first_guess, fit_exact_slopes
from monitor.diagnosis.plan import FAR, LONG, plan_of
from monitor.inference import (
    MapEstimate,
    Posterior,
    Prediction,
    join_coordinates,
    maximize_posterior,
    tone_log_odds,
    tried,
    unfitted,
)
from monitor.model import EFFECTS, Context, Effect, EffectError, Peak, System, inverse

_log = logging.getLogger(__name__)

_FAR_PROBABILITY = 1e-3
"""Share of structures that lie as far from their prior as one from which other starts are tried. [ratio; judgement: in vain for
one in a thousand]"""
_ROUGH_FIT_NATS = 3.0
"""Gain that a rough fit may miss. [nats; judgement]"""
_HELD_STRUCTURE_PRECISION = 1e8
"""Precision that holds the structure while an effect's size is found. [1; rounding]"""
_LEAST_VARIANCE = 1e-12
"""Least variance of a pattern's coordinate, over that of its prior. [ratio; rounding]"""
_RELATIVE_DIFFERENCE = 0.01
"""Share of an effect's first size over which its slope is taken. [ratio; judgement]"""
_MIN_START_FACTOR = 0.05
"""Smallest factor on an effect's start size at which it is first tried. [ratio; judgement]"""
_MAX_START_FACTOR = 20.0
"""Largest such factor. [ratio; judgement]"""
_MAX_SECANT_CHANGE = 0.9
"""Share of a story's stiffness that a law may take away where a fit starts. [ratio; judgement: the rest is positive]"""

Key = tuple[str, str]
"""Name and place of an effect."""
Ranked = list[tuple[float, Effect]]
"""Effects with the gain that is predicted of each, nats."""


def key_of(effect: Effect) -> Key:
    """Return the name and the place of an effect."""
    return effect.name, effect.location


def fit_with(posterior: Posterior, fit: MapEstimate, effects: tuple[Effect, ...]) -> MapEstimate:
    """Fit with other effects, beginning at the nuisances of a fit and at the effects' own sizes.

    Where no structure is there without the others, the fit begins at the prior's.
    """
    x = fit.x[posterior.layout.nuisances]
    found = maximize_posterior(posterior, join_coordinates(x, effects), effects)
    if found.is_possible:
        return found
    x = posterior.layout.with_structure(x, posterior.prior.mean)
    return maximize_posterior(posterior, join_coordinates(x, effects), effects)


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """Effect at one place, fitted."""

    effect: Effect
    fit: MapEstimate
    delta_log_posterior: float
    """Log posterior above that of the model without the effect, nats."""
    log_evidence: float
    """Gain `delta_log_posterior` less half the logarithm of the information for every parameter, nats."""

    @property
    def key(self) -> Key:
        """Name and place of the effect."""
        return key_of(self.effect)

    def without_slopes(self) -> Candidate:
        """Return the candidate with a fit from which no further search can start."""
        return replace(self, fit=self.fit.without_slopes())

    def may_reach(self, min_log_evidence: float) -> bool:
        """Decide if a better fit may reach an evidence: a rough one finds half of the gain, or all but `_ROUGH_FIT_NATS`."""
        return self.log_evidence + max(self.delta_log_posterior, _ROUGH_FIT_NATS) > min_log_evidence


def best_first(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Rank candidates by evidence, without those whose evidence is not finite: such a fit failed and explains nothing."""
    finite = []
    for c in candidates:
        if np.isfinite(c.log_evidence):
            finite.append(c)
        else:
            _log.info("%s at %s is left out: its evidence is %s", *c.key, c.log_evidence)
    return sorted(finite, key=lambda c: -c.log_evidence)


def candidate_starts(posterior: Posterior, null_fit: MapEstimate, excluded: Iterable[Key] = ()) -> list[Effect]:
    """List the starts of the search: every effect at every place with a small size, and every shape that must be tried.

    Where a nonlinear law is in the model already, no other is tried at its place: it would only compensate for the unknown form
    of the first one.  Effects of the names and places `excluded` are not tried.
    """
    context, typical = posterior.context, posterior.conditions[posterior.n_classes // 2]
    occupied = {e.location for e in null_fit.effects if e.nonlinear}
    skip, peaks = set(excluded), find_excess_peaks(posterior, null_fit)
    out: list[Effect] = []
    for kind in filter(plan_of(posterior).tries, EFFECTS.values()):
        for place in kind.places_in(context):
            if kind.repeatable or ((kind.name, place) not in skip and not (kind.nonlinear and place in occupied)):
                out += kind.starts(place, context, typical)
                out += filter(None, (at_peak(kind, place, peak, posterior) for peak in peaks))
    return [e for e in out if _is_applicable(e, context) and e.is_plausible(posterior.observed.band.hz)]


def at_peak(kind: type[Effect], place: str, peak: Peak, posterior: Posterior) -> Effect | None:
    """Make the first size of an effect at a peak; None where it has no frequency, or the peak has no power."""
    typical = posterior.conditions[posterior.n_classes // 2]
    return tried(lambda: kind.at_peak(place, peak, posterior.context, typical), None)


def _is_applicable(effect: Effect, context: Context) -> bool:
    try:
        effect.check(context.structure, context.channels)
    except EffectError:
        return False
    return True


def find_excess_peaks(
    posterior: Posterior, null_fit: MapEstimate, n: int = 3, others: Sequence[MapEstimate] = ()
) -> list[Peak]:
    """Find the n peaks at which the measured power exceeds the model's most.

    The frequency of a spectral line is interpolated to a small part of a bin.  `others` are fits with a further effect each:
    where one of them explains the power, it is no excess.
    """
    c = posterior.observed.spectra.shape[-1]
    shape = (posterior.n_classes, posterior.observed.band.n_bins, c * c)
    diagonal = np.cumsum([1, *(2 * np.arange(1, c) + 1)]) - 1
    residuals = [f.residual for f in (null_fit, *others) if f.residual.size]  # a fit without a likelihood has none
    if not residuals:
        return []
    excess = np.min([r.reshape(shape)[:, :, diagonal].sum(axis=(0, 2)) for r in residuals], axis=0)
    prediction, band = posterior.predict(null_fit.x, null_fit.effects), posterior.observed.band
    spectra = np.tensordot(posterior.observed.counts, prediction.data - prediction.spectra, axes=1)
    power = np.einsum("faa->f", spectra).real
    found = []
    for _ in range(n):
        i = int(excess.argmax())
        values, vectors = np.linalg.eigh(spectra[max(0, i - 1) : i + 2].sum(axis=0).real)
        amplitude = vectors[:, -1] * np.sqrt(max(values[-1], 0.0) / posterior.observed.counts.sum())
        found.append(Peak(float(band.hz[i] + band.bin_hz * line_offset(power, i)), amplitude))
        excess[max(0, i - 4) : i + 5] = -np.inf
    return found


def line_offset(power: Annotated[Array, "bins"], i: int) -> float:
    """Interpolate the frequency of a spectral line from its power in two neighbouring bins, in segments with Hann's taper.

    Return its distance from bin i, in which the line is strongest, bins.
    """
    neighbours = power[max(0, i - 1) : i + 2 : 2]
    if power[i] <= 0.0 or neighbours.size < 2:
        return 0.0
    ratio = np.sqrt(np.clip(neighbours.max() / power[i], 0.25, 1.0))
    return float((2.0 * ratio - 1.0) / (ratio + 1.0) * (1 if neighbours[1] > neighbours[0] else -1))


def rank_by_score(posterior: Posterior, null_fit: MapEstimate, excluded: Iterable[Key], n_beside_prior: int) -> Ranked:
    """Rank the starts by the gain that the score test predicts, nats, best first, each moved to the predicted size.

    Those `excluded` are left out.  A fit that went far from its prior to explain what it cannot explain hides the effect that
    would.  So effects are tried beside the prior's structure too, of which the best `n_beside_prior` are fitted from there.
    """
    excluded = tuple(excluded)
    gains = expected_gains(posterior, null_fit, candidate_starts(posterior, null_fit, excluded))
    if far_from_prior(posterior, null_fit):
        held, rest = _fit_at_prior(posterior, null_fit)
        candidates = candidate_starts(held, rest, excluded)  # other peaks are in excess there
        lost = null_fit.log_posterior - rest.log_posterior
        at_prior = sorted(((g - lost, e) for g, e in expected_gains(held, rest, candidates)), key=lambda item: -item[0])
        # No score test tells what a law that is not proportional to its size, or has none, may gain once the structure is free,
        # nor what a law gains whose size is large beside that structure.
        shaped = [e for e in candidates if e.parameters and not e.proportional]
        sizeless = {e.name: e for _, e in reversed(at_prior) if not e.parameters}
        large = best_of_each([item for item in at_prior if item[1].parameters and item[1].proportional])
        tried = [*shaped, *sizeless.values(), *(e for _, e in large[:n_beside_prior])]
        gains += at_prior + _gains_from_prior(posterior, null_fit, tried)
    return sorted((item for item in gains if np.isfinite(item[0])), key=lambda item: -item[0])


def expected_gains(posterior: Posterior, null_fit: MapEstimate, candidates: list[Effect]) -> Ranked:
    """Predict the gain of every start about one fit, nats; leave out those of which none can be predicted.

    The change of the spectra by a small effect, less the part that the nuisances explain, is compared with the residual.
    """
    return tried(lambda: _expected_gains(posterior, null_fit, candidates), []) if null_fit.is_possible else []


def _expected_gains(posterior: Posterior, null_fit: MapEstimate, candidates: list[Effect]) -> Ranked:
    """As `expected_gains`; raises where something cannot be computed, see `tried`."""
    prediction = posterior.predict(null_fit.x, null_fit.effects)
    mean, precision = posterior.normal_prior(null_fit.x, null_fit.effects)
    tangent = null_fit.slopes
    normal = inverse(null_fit.information + precision)
    residual = np.concatenate([null_fit.residual, null_fit.mean_residual])
    # The nuisances' slope is that of the posterior, since a pull away from their prior is evidence of an effect.
    nuisance_slope = tangent.along(residual) - precision @ (null_fit.x - mean)
    by_slope = plan_of(posterior).starts_anywhere

    def predict_gain(effect: Effect) -> Ranked:
        if effect.proportional and by_slope:
            out, v = [], whitened_slope(posterior, null_fit, prediction, effect)
        else:
            start = start_beside(posterior, null_fit.x, effect)
            moved = posterior.predict(start, (*null_fit.effects, effect))
            # Gain at the start size with refitted levels, for starts that happen to lie near the truth.
            whole = posterior.log_likelihood(moved.spectra, moved.data, levelled=True) - null_fit.log_likelihood
            out = [(whole, effect)]
            if not effect.proportional:
                return out
            v = posterior.whitened_change(prediction, moved)
        along = tangent.along(v)
        information = float(v @ v - along @ normal @ along)
        score = float(v @ residual - along @ normal @ nuisance_slope)
        scaled = None if information < 1e-9 else _scale_amplitude(effect, score / information)
        if scaled is None:
            return out
        gain = 0.5 * score**2 / information
        if scaled.is_narrow and by_slope:
            # A peak may rise so far above the model's power that the gain is nowhere near quadratic.
            moved = posterior.predict(null_fit.x, (*null_fit.effects, scaled))
            gain = min(gain, posterior.log_likelihood(moved.spectra, levelled=True) - null_fit.log_likelihood)
        return [*out, (gain, scaled)]

    gains = chain.from_iterable(parallel_map(lambda effect: tried(lambda: predict_gain(effect), ()), candidates))
    return [(gain, effect) for gain, effect in gains if np.isfinite(gain)]


def best_of_each_kind(posterior: Posterior, null_fit: MapEstimate, starts: list[Effect]) -> list[Effect]:
    """Keep of every kind of effect the start, of any place, of which the score test predicts the largest gain."""
    gains = sorted(expected_gains(posterior, null_fit, starts), key=lambda item: item[0])
    return list({effect.name: effect for _, effect in gains}.values())


def whitened_slope(
    posterior: Posterior, null_fit: MapEstimate, prediction: Prediction, effect: Effect
) -> Annotated[Array, "rows"]:
    """Compute the whitened change of the spectra by a small size of an effect, over that size as a share of the start size.

    Where noise is low, even a small effect's change is far from linear.  The prediction is that of the fit.
    """
    slight = _scale_size(effect, _RELATIVE_DIFFERENCE ** (1.0 / effect.order))
    assert slight is not None, "nearer to nothing than one that is possible"
    return np.asarray(
        posterior.whitened_change(prediction, posterior.predict(null_fit.x, (*null_fit.effects, slight)))
        / _RELATIVE_DIFFERENCE
    )


def far_from_prior(posterior: Posterior, null_fit: MapEstimate) -> bool:
    """Decide if a fit went far from the structure's prior, so that effects are tried beside the prior too.

    Modes that the model lacks lead a fit there for good: beside the prior's structure they are other modes.
    """
    if not plan_of(posterior).starts_anywhere or any(effect.repeatable for effect in null_fit.effects):
        return False
    return is_far(posterior, null_fit)


def is_far(posterior: Posterior, fit: MapEstimate) -> bool:
    """Decide if the structure of a fit is improbable by its prior: as few as one in a thousand lie as far."""
    from scipy.special import chdtrc  # takes a while to load

    at, n_held = posterior.prior.mean.copy(), _n_held(posterior)
    at[:n_held] = fit.x[:n_held]
    return bool(chdtrc(n_held, -2.0 * posterior.prior.log_density(at)) < _FAR_PROBABILITY)


def _n_held(posterior: Posterior) -> int:
    """Count the first parameters that are held at their prior: all that persists.

    Where calibration fits the forces' spectrum, the spectrum and the sensors' noise, of which a structure file says nothing, may
    lie far from their prior although the structure does not.
    """
    prior, layout = posterior.prior, posterior.layout
    persistent = prior.model.effects
    is_site = bool(persistent) and all(effect.family == "excitation" for effect in persistent)
    return int(layout.channel_noise.start if is_site and not prior.is_baseline else layout.structure.stop)


def _fit_at_prior(posterior: Posterior, null_fit: MapEstimate, *more: Effect) -> tuple[Posterior, MapEstimate]:
    """Fit with the structure held at its prior mean, with further effects if given; return the held posterior and the fit."""
    known, n_held = posterior.prior, _n_held(posterior)
    tight = np.zeros(known.mean.size)
    tight[:n_held] = _HELD_STRUCTURE_PRECISION / known.units[:n_held] ** 2
    held = replace(posterior, prior=replace(known, precision=known.precision + np.diag(tight)))
    effects = (*null_fit.effects, *more)
    starts = [null_fit.x[posterior.layout.nuisances].copy(), first_guess(posterior)]
    for start in starts:
        start[:n_held] = known.mean[:n_held]
    x = max(starts, key=lambda start: sum(held.score(join_coordinates(start, effects), effects)))
    unused = null_fit.slopes.by(np.arange(n_held))  # of what does not move
    return held, maximize_posterior(held, x, effects, iterations=FAR, frozen=unused)


def _gains_from_prior(posterior: Posterior, null_fit: MapEstimate, effects: list[Effect]) -> Ranked:
    """Fit effects with the structure at its prior mean, then roughly with it free; return gains, nats."""

    def fitted(effect: Effect) -> MapEstimate:
        near = _fit_at_prior(posterior, null_fit, effect)[1]
        return maximize_posterior(
            posterior, near.x, near.effects, iterations=plan_of(posterior).rough_steps, keep_slopes=False
        )

    return [(fit.log_posterior - null_fit.log_posterior, fit.effects[-1]) for fit in parallel_map(fitted, effects)]


def _scale_amplitude(effect: Effect, amount: float) -> Effect | None:
    """Scale an effect's amplitude by `amount`, limited to the range of start factors; return None where its bounds forbid it."""
    size = float(np.clip(abs(amount) ** (1.0 / effect.order), _MIN_START_FACTOR, _MAX_START_FACTOR))
    return _scale_size(effect, float(np.copysign(size, amount)))


def _scale_size(effect: Effect, factor: float) -> Effect | None:
    """Scale an effect's size by `factor`; return None where its bounds forbid it."""
    x = effect.coordinates
    for i, p in enumerate(effect.parameters):
        if p.absent is not None:
            zero = p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0
            x[i] = zero + factor * (x[i] - zero)
            if abs(p.coordinate(p.value(x[i])) - x[i]) > 1e-6 * abs(x[i]) + 1e-12:
                return None
    return effect.at(x)


def best_of_each(ranked: Ranked) -> Ranked:
    """Keep the best start of every effect and place."""
    best: dict[Key, tuple[float, Effect]] = {}
    for item in ranked:
        best.setdefault(key_of(item[1]), item)
    return list(best.values())


def fit_candidate(
    posterior: Posterior,
    null_fit: MapEstimate,
    effect: Effect,
    *,
    quick: bool = False,
    min_log_evidence: float = -np.inf,
    rough: Candidate | None = None,
) -> Candidate:
    """Fit an effect, given at its start size, together with the nuisances.

    Where the fit diverges and ends below a rough one of the same effect, it is repeated from that.  A `quick` fit is rough, for a
    ranking; no further search can start from it.  A candidate below `min_log_evidence`, nats, does not matter, and its fit is not
    repeated from the prior.  The evidence is minus infinity where the fit leads to a structure that cannot be computed.
    """
    fit = unfitted(posterior, null_fit.x, (*null_fit.effects, effect))
    nothing = Candidate(effect, fit, -np.inf, -np.inf)
    if not null_fit.is_possible:
        return nothing
    is_integrated = effect.nonlinear and not posterior.linearizes((effect,))
    of_kind = _fit_driven_law if is_integrated else partial(_fit_candidate, min_log_evidence=min_log_evidence)
    return tried(lambda: of_kind(posterior, null_fit, effect, rough, quick=quick), nothing)


def _fitting(posterior: Posterior, *, quick: bool) -> partial[MapEstimate]:
    """Return `maximize_posterior` with the limits of a quick fit, or of one that is followed to its end."""
    plan = plan_of(posterior)
    steps = plan.rough_steps if quick else plan.full_steps
    return partial(maximize_posterior, posterior, iterations=steps, tolerance=plan.tolerance, keep_slopes=not quick)


def _fit_candidate(
    posterior: Posterior,
    null_fit: MapEstimate,
    effect: Effect,
    rough: Candidate | None,
    *,
    quick: bool,
    min_log_evidence: float,
) -> Candidate:
    """As `fit_candidate`; raises where something cannot be computed, see `tried`."""
    plan, fitted = plan_of(posterior), _fitting(posterior, quick=quick)
    frozen = null_fit.slopes if quick and plan.starts_anywhere else None
    start = null_fit.x, (*null_fit.effects, effect)
    if rough is not None and plan.starts_anywhere and rough.delta_log_posterior > 0.0:
        start = rough.fit.x, rough.fit.effects
    found = score_candidate(posterior, null_fit, fitted(*start, frozen=frozen))
    if not quick and far_from_prior(posterior, null_fit):
        near = _fit_at_prior(posterior, null_fit, effect)[1]
        better = (
            found.may_reach(min_log_evidence) or sum(posterior.score(near.x, near.effects)) > found.fit.log_posterior
        )
        if better or not effect.proportional:
            other = maximize_posterior(posterior, near.x, near.effects, iterations=FAR)
            found = max(found, score_candidate(posterior, null_fit, other), key=lambda c: c.log_evidence)
    if rough is not None and found.log_evidence < rough.log_evidence:
        repeated = score_candidate(posterior, null_fit, fitted(rough.fit.x, rough.fit.effects))
        found = max(found, repeated, key=lambda c: c.log_evidence)
    return found


def _fit_driven_law(
    posterior: Posterior, null_fit: MapEstimate, effect: Effect, rough: Candidate | None, *, quick: bool
) -> Candidate:
    """As `_fit_candidate`, with a nonlinear law, where the motion follows from a measured input.

    The slopes are those of the exact laws.  With those of the linearized laws most fits of softening laws end at once.
    """
    x, effects = start_beside(posterior, null_fit.x, effect), (*null_fit.effects, effect)
    if rough is not None:
        x, effects = rough.fit.x, rough.fit.effects
    exact = posterior.with_exact_slopes(x, effects)
    fit = _fitting(exact, quick=quick)(x, effects)
    if not quick:
        fit = fit_exact_slopes(exact, fit)[1]
    return score_candidate(posterior, null_fit, fit)


def start_beside(posterior: Posterior, x: Annotated[Array, "p"], effect: Effect) -> Annotated[Array, "p"]:
    """Return the parameters with which a fit beside an effect starts.

    The fit without the effect has the stories' secant stiffness at the recording's level.  Where the motion follows from a
    measured input, a frequency off by a percent is far from any fit.  So a nonlinear law starts beside the stiffness with which
    it has that secant.
    """
    if not effect.nonlinear or posterior.linearizes((effect,)):
        return x
    context, layout = posterior.context_at(x), posterior.layout
    n, k = context.structure.n_dofs, context.structure.stiffness_n_per_m
    nothing = System(np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)))
    change = effect.extend(nothing, context, posterior.conditions[posterior.n_classes // 2]).stiffness
    springs = np.stack([np.outer(row, row).ravel() for row in context.structure.drift_matrix()], axis=1)
    added = np.linalg.lstsq(springs, change.ravel(), rcond=None)[0] / k
    out = x.copy()
    out[layout.stiffness] -= np.log1p(np.clip(added, -_MAX_SECANT_CHANGE, None))
    return out


def fit_roughly(posterior: Posterior, null_fit: MapEstimate, effects: Sequence[Effect]) -> list[Candidate]:
    """Fit effects roughly, each alone, best first."""
    return best_first(parallel_map(partial(fit_candidate, posterior, null_fit, quick=True), effects))


def refine_rough_fit(posterior: Posterior, null_fit: MapEstimate, rough: Candidate) -> Candidate:
    """Fit an effect that a rough fit brought near its size, together with the nuisances."""
    fitted = maximize_posterior(posterior, rough.fit.x, rough.fit.effects, iterations=LONG)
    return score_candidate(posterior, null_fit, fitted)


def score_candidate(posterior: Posterior, null_fit: MapEstimate, fitted: MapEstimate, i: int = -1) -> Candidate:
    """Compute the gain of a fit by its effect i, as a candidate."""
    gain = fitted.log_posterior - null_fit.log_posterior
    return Candidate(fitted.effects[i], fitted, gain, gain - evidence_cost(posterior, fitted, i))


def with_tone_evidence(posterior: Posterior, candidate: Candidate) -> Candidate:
    """Add to a machine's evidence what its steady amplitude tells, which a random motion of the same spectrum has not."""
    lines = candidate.effect.lines()
    if not lines or plan_of(posterior).knows_input or not np.isfinite(candidate.log_evidence):
        return candidate
    odds = tried(lambda: sum(tone_log_odds(posterior, candidate.fit, line) for line in lines), -np.inf)
    return replace(candidate, log_evidence=candidate.log_evidence + odds)


def log_evidence(posterior: Posterior, fit: MapEstimate) -> float:
    """Compute the log evidence of a fit: its log posterior less the costs of its effects' parameters, nats."""
    return fit.log_posterior - sum(evidence_cost(posterior, fit, i) for i in range(len(fit.effects)))


def evidence_cost(posterior: Posterior, fit: MapEstimate, i: int = -1) -> float:
    """Compute what the parameters of effect i of a fit cost in log evidence, nats.

    A parameter of unknown order costs half the logarithm of the information (G. Schwarz, Annals of Statistics 6 (1978) 461).
    What forms a pattern, as the components of a mode's shape, costs what the data narrow its prior by (Laplace's approximation):
    a weak mode's shape, of which the data tell little, costs little.  An effect with a prior of its size costs what it says.
    """
    i = range(len(fit.effects))[i]
    these = fit.coordinates_of(i)
    known_cost = fit.effects[i].size_cost(fit.covariance[these, these])
    if known_cost is not None:
        return known_cost
    std = fit.effects[i].pattern_std
    known = np.flatnonzero(np.isfinite(std))
    cost = parameter_cost(posterior, std.size - known.size)
    if known.size == 0:
        return cost
    own = these.start + known
    covariance = fit.covariance[np.ix_(own, own)] / np.outer(std[known], std[known])
    variances = tried(lambda: np.linalg.eigvalsh(covariance), np.full(known.size, _LEAST_VARIANCE))
    return cost - 0.5 * float(np.log(np.clip(variances, _LEAST_VARIANCE, 1.0)).sum())


def parameter_cost(posterior: Posterior, n_more: int) -> float:
    """Compute half the logarithm of the information for each of `n_more` parameters, summed, nats."""
    n = posterior.observed.counts.sum() * posterior.observed.band.n_bins * posterior.observed.weight
    return 0.5 * n_more * float(np.log(n))
