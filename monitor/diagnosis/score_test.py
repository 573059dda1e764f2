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

_QUICKLY, _BRIEFLY = 5, 6
"""Iterations of a rough fit without a measured ground, and of one beside a held structure."""
_FINE = 0.02
"""Nats that the last step of a fit may promise where the ground was not measured."""
_DRAGGED = -20.0
"""Log prior below which the model without the effect was dragged far from what was known, where a fit starts better."""
_MORE = 3.0
"""Nats that a rough fit may leave in any case."""
_HELD = 1e8
"""Precision that holds the structure while an effect's size is found."""
_SLIGHT = 0.01
"""Share of an effect's first size at which its slope is taken."""
_MIN_STEP, _MAX_STEP = 0.05, 20.0
"""How far from its start size an effect is first tried, as factors."""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """One effect at one place, fitted."""

    effect: Effect
    fit: MapEstimate
    gain: float
    """Log posterior above the model without it, nats."""
    evidence: float
    """The gain less half the logarithm of the information for every parameter."""

    @property
    def key(self) -> tuple[str, str]:
        """Name and place."""
        return self.effect.name, self.effect.location

    def may_reach(self, bar: float) -> bool:
        """Whether a better fit may have the evidence `bar`: one found half of the whole gain, or all but a little."""
        return self.evidence + max(self.gain, _MORE) > bar


def candidate_starts(problem: Posterior, null: MapEstimate, taken: Iterable[tuple[str, str]] = ()) -> list[Effect]:
    """A small size of every effect at every place, and of every shape that must be tried.

    Where a law bends already, no other is tried: it would only mend what is not known of the first one's form.
    """
    typical = problem.conditions[problem.n_classes // 2]
    bent = {(name, e.location) for e in null.effects if e.nonlinear for name, kind in EFFECTS.items() if kind.nonlinear}
    skip, found = {*taken, *bent}, peaks(problem, null)
    out: list[Effect] = []
    for name, kind in EFFECTS.items():
        if problem.observed.drive is not None and (kind.family == "excitation" or kind.stationary_only):
            continue  # the input is measured; another one would only excuse what the model's response lacks
        for place in (p for k in kind.places for p in locations(k, problem.context)):
            if (name, place) not in skip:
                out.extend(kind.starts(place, problem.context, typical))
                near = (kind.at_frequency(place, float(f), problem.context, typical) for f in found)
                out.extend(e for e in near if e is not None)
    return [e for e in out if _possible(e, problem.context)]


def _possible(effect: Effect, context: Context) -> bool:
    """Whether the structure is one that the effect can act on."""
    try:
        effect.check(context.structure, context.channels)
    except EffectError:
        return False
    return True


def peaks(problem: Posterior, null: MapEstimate, n: int = 3) -> Array:
    """Frequencies at which the measured power exceeds the model's the most, Hz; of lines, to a small part of a bin."""
    c = problem.observed.spectra.shape[-1]
    shape = (problem.n_classes, problem.observed.band.n_bins, c * c)
    diagonal = np.cumsum([1, *(2 * np.arange(1, c) + 1)]) - 1
    over = null.residual.reshape(shape)[:, :, diagonal].sum(axis=(0, 2)).copy()
    here, band = problem.predict(null.x, null.effects), problem.observed.band
    power = np.einsum("k,kfaa->f", problem.observed.counts, here.data - here.spectra).real
    found = []
    for _ in range(n):
        at = int(over.argmax())
        found.append(band.hz[at] + band.bin_hz * _off_the_bin(power, at))
        over[max(0, at - 4) : at + 5] = -np.inf
    return np.array(found)


def _off_the_bin(power: Array, at: int) -> float:
    """Where a line lies about the bin that it is strongest in, in bins, by its share in the next one (Hann's taper)."""
    beside = power[max(0, at - 1) : at + 2 : 2]
    if power[at] <= 0.0 or beside.size < 2:
        return 0.0
    ratio = np.sqrt(np.clip(beside.max() / power[at], 0.25, 1.0))
    return float((2.0 * ratio - 1.0) / (ratio + 1.0) * (1 if beside[1] > beside[0] else -1))


def rank_by_score(problem: Posterior, null: MapEstimate, candidates: list[Effect]) -> list[tuple[float, Effect]]:
    """Gain that the score test promises for every start, best first; each effect moved to the size that it suggests.

    A fit that went far to explain what it cannot hides what would explain it; so effects are tried beside what was known, too.
    """
    promised = _promised(problem, null, candidates)
    if _far_from_prior(problem, null):
        held, rest = _at_rest(problem, null)
        lost = null.log_posterior - rest.log_posterior
        promised += [(gain - lost, effect) for gain, effect in _promised(held, rest, candidates)]
        shaped = [e for e in candidates if e.parameters and not e.proportional]  # whose size no score test tells
        promised += parallel_map(partial(_fitted_at_rest, problem, null), shaped)
    return sorted(promised, key=lambda item: -item[0])


def _promised(problem: Posterior, null: MapEstimate, candidates: list[Effect]) -> list[tuple[float, Effect]]:
    """As `rank_by_score`, about one fit: the change of the spectra that a small effect makes, less what the nuisances explain, is
    compared with the residual.
    """
    here = problem.predict(null.x, null.effects)
    mean, precision = problem.normal_prior(null.x, null.effects)
    tangent = null.jacobian
    normal = inverse(tangent.T @ tangent + precision)
    residual = np.concatenate([null.residual, null.mean_residual])
    # The nuisances' own slope is that of the posterior: what pulls them from what was known before speaks for an effect.
    own_slope = tangent.T @ residual - precision @ (null.x - mean)
    tangent, driven = np.asfortranarray(tangent), problem.observed.drive is not None

    def promised(effect: Effect) -> list[tuple[float, Effect]]:
        if effect.proportional and not driven:
            out, v = [], _slope(problem, null, here, effect)
        else:
            moved = problem.predict(null.x, (*null.effects, effect))
            # What it gains as it stands, once the levels have followed: for starts that happen to lie near the truth.
            whole = problem.log_likelihood(moved.spectra, moved.data, levelled=True) - null.log_likelihood
            out = [(whole, effect)]
            if not effect.proportional:
                return out
            # Phases of a driven response turn far between two fits: whole changes rank better there (docs/measured-frames.md).
            v = change(problem, here, moved)
        along = tangent.T @ v
        information, score = float(v @ v - along @ normal @ along), float(v @ residual - along @ normal @ own_slope)
        grown = None if information < 1e-9 else _grown(effect, score / information)
        return out if grown is None else [*out, (0.5 * score**2 / information, grown)]

    return list(chain.from_iterable(parallel_map(promised, candidates)))


def _slope(problem: Posterior, null: MapEstimate, here: Prediction, effect: Effect) -> Array:
    """Whitened change by an effect, in proportion to what next to nothing of it makes: where noise is little, even a small
    effect's change is far from a straight line."""
    slight = _sized(effect, _SLIGHT ** (1.0 / effect.order))
    assert slight is not None, "nearer to nothing than one that is possible"
    return np.asarray(change(problem, here, problem.predict(null.x, (*null.effects, slight))) / _SLIGHT)


def _far_from_prior(problem: Posterior, null: MapEstimate) -> bool:
    """Whether a fit went far from what was known before, whose response is not told by phases."""
    return problem.observed.drive is None and null.log_prior < _DRAGGED


def _at_rest(problem: Posterior, null: MapEstimate, *more: Effect) -> tuple[Posterior, MapEstimate]:
    """The problem with its structure held where it was known to be, fitted; with further effects."""
    known = problem.prior
    held = replace(problem, prior=replace(known, precision=known.precision + np.diag(_HELD / known.units**2)))
    x = problem.layout.with_structure(null.x, known.mean)
    return held, maximize_posterior(held, x, (*null.effects, *more), iterations=_BRIEFLY)


def _fitted_at_rest(problem: Posterior, null: MapEstimate, effect: Effect) -> tuple[float, Effect]:
    """What an effect gains, fitted with the structure where it was known to be and then beside it; and the effect."""
    near = _at_rest(problem, null, effect)[1]
    near = maximize_posterior(problem, near.x, near.effects, iterations=_BRIEFLY)
    return near.log_posterior - null.log_posterior, near.effects[-1]


def change(problem: Posterior, here: Prediction, there: Prediction) -> Array:
    """Whitened change from one prediction to another."""
    change, _ = problem.whitened(here.spectra, (there.spectra - here.spectra)[None], here.data)
    if here.left is None or there.left is None:
        return change[:, 0]
    mean, _ = problem.mean_rows(here, (here.left - there.left)[None])
    return np.concatenate([change, mean])[:, 0]


def _grown(effect: Effect, amount: float) -> Effect | None:
    """The effect with its amplitude times `amount`, as far as one goes, or None where that is not possible physically."""
    size = float(np.clip(abs(amount) ** (1.0 / effect.order), _MIN_STEP, _MAX_STEP))
    return _sized(effect, float(np.copysign(size, amount)))


def _sized(effect: Effect, factor: float) -> Effect | None:
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


def fit_best(
    problem: Posterior,
    null: MapEstimate,
    effect: Effect,
    *,
    quick: bool = False,
    bar: float = -np.inf,
    rough: Candidate | None = None,
) -> Candidate:
    """Fit an effect beside the nuisances; with less care, once it is seen that it does not reach the evidence `bar`.

    Where the fit runs away and ends below a `rough` one, it is made again from there.
    """
    driven = problem.observed.drive is not None
    # Driven motion tells so much that a cause bends the other slopes at once.
    frozen = null.jacobian[:, problem.layout.nuisances] if quick and not driven else None
    few, many = (ROUGHLY, FAR) if driven else (_QUICKLY, LONG)
    fitted = partial(
        maximize_posterior, problem, iterations=few if quick else many, tolerance=COARSE if driven else _FINE
    )
    found = score_candidate(problem, null, fitted(null.x, (*null.effects, effect), frozen=frozen))
    if not quick and _far_from_prior(problem, null):
        near = _at_rest(problem, null, effect)[1]
        likely = found.may_reach(bar) or sum(problem.score(near.x, near.effects)) > found.fit.log_posterior
        if likely or not effect.proportional:
            other = score_candidate(problem, null, maximize_posterior(problem, near.x, near.effects, iterations=LONG))
            found = max(found, other, key=lambda c: c.evidence)
    if rough is not None and found.evidence < rough.evidence:
        again = score_candidate(problem, null, fitted(rough.fit.x, rough.fit.effects))
        found = max(found, again, key=lambda c: c.evidence)
    return found


def score_candidate(problem: Posterior, null: MapEstimate, fitted: MapEstimate, n_more: int | None = None) -> Candidate:
    """What a fit gains by its last effect, or by `n_more` parameters."""
    effect = fitted.effects[-1]
    n_more = len(effect.parameters) if n_more is None else n_more
    gain = fitted.log_posterior - null.log_posterior
    return Candidate(effect, fitted, gain, gain - parameter_cost(problem, n_more))


def parameter_cost(problem: Posterior, n_more: int) -> float:
    """Half the logarithm of the information for every parameter, nats."""
    n = problem.observed.counts.sum() * problem.observed.band.n_bins * problem.observed.weight
    return 0.5 * n_more * float(np.log(n))
