"""Which effect explains what the model leaves over: a score test ranks every candidate, a fit judges the best of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import get_args

import numpy as np

from monitor.driven import Between
from monitor.effects import EFFECTS, Condition, Context, Effect, EffectError, locations
from monitor.evidence import Evidence
from monitor.excitation import told_by_quiet
from monitor.fitting import Fit, fit, inverse
from monitor.forward import Prediction
from monitor.likelihood import Problem
from monitor.motion import conditions
from monitor.parallel import each
from monitor.reference import Reference
from monitor.results import Array

FAR = 40
"""Iterations of a first fit to driven motion, whose phases tell more and lead on a longer way."""
_HEAVY, _LIGHTER, _HELD_DAMPING = 0.05, 0.015, 1e4
"""Damping ratios at which that fit begins and goes on, and the precision that holds the former."""
_ROUGHLY = 4
"""Iterations by which ways of the ground between its samples, and kinds of causes, are compared."""
_QUICKLY, _LONG, _BRIEFLY = 5, 15, 6
"""Iterations of a rough fit without a measured ground, of one to the end, and of one beside a held structure."""
_FINE, _COARSE = 0.02, 0.3
"""Nats that the last step of a fit may promise; driven motion tells causes apart by hundreds."""
_STATIONARY = ("sensor_clipping",)
"""Effects whose linearization takes samples for normal, which an earthquake's are not."""
_DRAGGED = -20.0
"""Log prior below which the model without the effect was dragged far from what was known, where a fit starts better."""
_MORE = 3.0
"""Nats that a rough fit may leave in any case."""
_HELD = 1e8
"""Precision that holds the structure while an effect's size is found."""
_FORCED, _MODEL_ERROR = 1e-3, 0.5
"""With the ground measured: power that forces cause, and error of the model, as shares of what is seen, at the start."""
_SLIGHT = 0.01
"""Share of an effect's first size at which its slope is taken."""
_MIN_STEP, _MAX_STEP = 0.05, 20.0
"""How far from its start size an effect is first tried, as factors."""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """One effect at one place, fitted."""

    effect: Effect
    fit: Fit
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


def prepare(evidence: Evidence, reference: Reference, context: Context) -> tuple[Problem, Fit]:
    """The problem without extra effects, fitted, with the motion of every class known.

    Nonlinear laws are made linear at the motion of the fitted model, so the fit is made twice where standing effects
    need it.
    """
    n, c = context.structure.n_dofs, len(context.channels)
    if evidence.drive is not None:
        reference = reference.with_any_noise()
    unknown = Condition(
        np.ones(context.structure.n_stories), np.ones(context.structure.n_stories), np.ones(n), np.ones(c)
    )
    plain = replace(
        reference,
        model=replace(reference.model, effects=()),
        mean=reference.mean[: reference.mean.size - reference.n_standing],
    )
    plain = replace(plain, precision=reference.precision[: plain.mean.size, : plain.mean.size])
    problem = Problem(evidence, plain, context, (unknown,) * evidence.counts.size)
    null = fit(problem, _first_guess(problem)) if evidence.drive is None else _from_afar(problem)
    problem, null = between_samples(problem, null)
    problem = replace(problem, conditions=conditions(problem, null.x, ()))
    if not reference.n_standing:
        return beside_wind(problem, null)
    x = np.concatenate([null.x[: plain.mean.size], reference.mean[plain.mean.size :], null.x[plain.mean.size :]])
    for _ in range(2):
        problem = replace(problem, reference=reference)
        null = fit(problem, x)
        x = null.x
        problem = replace(problem, conditions=conditions(problem, x, ()))
    return beside_wind(problem, null)


def beside_wind(problem: Problem, at: Fit) -> tuple[Problem, Fit]:
    """With the forces that the quiet tells, where the ground was measured."""
    if problem.evidence.drive is None:
        return problem, at
    first, n = problem.reference.mean.size, problem.context.structure.n_dofs
    x = told_by_quiet(problem, at.x, at.effects)
    problem = replace(problem, wind=x[first : first + n])
    return problem, fit(problem, x, at.effects, iterations=FAR)


def _from_afar(problem: Problem) -> Fit:
    """The first fit to driven motion, whose phases lead back from nearby only: with heavy damping first, for wide peaks."""
    known, x = problem.reference, _first_guess(problem)
    k, m, d, *_ = known.sizes
    modes = np.arange(k + m, k + m + d)
    mean, precision = known.mean.copy(), known.precision.copy()
    mean[modes] = np.log(_HEAVY)
    precision[modes, modes] += _HELD_DAMPING
    wide = replace(problem, reference=replace(known, mean=mean, precision=precision))
    near = fit(wide, np.concatenate([mean, x[mean.size :]]), iterations=_LONG).x
    near[modes] = np.log(_LIGHTER)
    return fit(problem, near, iterations=FAR)


def between_samples(problem: Problem, at: Fit) -> tuple[Problem, Fit]:
    """With the ground's motion between its samples that explains the floors best, where the ground was measured."""
    drive = problem.evidence.drive
    if drive is None:
        return problem, at
    tried = [(problem, at)]
    for between in get_args(Between):
        if between != drive.between:
            other = replace(problem, evidence=replace(problem.evidence, drive=replace(drive, between=between)))
            tried.append((other, fit(other, at.x, at.effects, iterations=_ROUGHLY)))
    problem, best = max(tried, key=lambda pair: pair[1].log_posterior)
    return problem, at if best is at else fit(problem, best.x, best.effects, iterations=FAR)


def _first_guess(problem: Problem) -> Array:
    """Nuisances as known before, forces and noise from the power of the spectra."""
    e, n = problem.evidence, problem.context.structure.n_dofs
    c = len(problem.context.channels)
    power = np.einsum("kfaa->kfa", e.spectra[:, :, :c, :c]).real
    noise = np.log(max(0.3 * float(np.quantile(power.mean(axis=(0, 2)), 0.02)), 1e-300))
    x = np.concatenate([problem.reference.mean, np.zeros(n), np.zeros(problem.n_classes), [noise - 10.0]])
    predicted = np.einsum("kfaa->kfa", problem.scatter(x, ())[:, :, :c, :c]).real
    # Medians over frequency: peaks that do not lie where they should must not set the level.
    ratio = np.median(power / predicted, axis=(1, 2))
    p = problem.reference.mean.size
    x[p : p + n] = np.log(ratio.mean())
    x[p + n : p + n + problem.n_classes] = np.log(ratio / ratio.mean())
    x[-1] = noise
    if e.power is not None:
        x[p : p + n] += np.log(_FORCED)
        x[p + n : p + n + problem.n_classes] = np.log(power / e.power).mean(axis=(1, 2)) + 2.0 * np.log(_MODEL_ERROR)
    return x


def starts(problem: Problem, null: Fit, taken: Iterable[tuple[str, str]] = ()) -> list[Effect]:
    """A small size of every effect at every place, and of every shape that must be tried.

    Where a law bends already, no other is tried: it would only mend what is not known of the first one's form.
    """
    typical = problem.conditions[problem.n_classes // 2]
    bent = {(name, e.location) for e in null.effects if e.nonlinear for name, kind in EFFECTS.items() if kind.nonlinear}
    skip, found = {*taken, *bent}, peaks(problem, null)
    out: list[Effect] = []
    for name, kind in EFFECTS.items():
        if problem.evidence.drive is not None and (kind.family == "excitation" or name in _STATIONARY):
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


def peaks(problem: Problem, null: Fit, n: int = 3) -> Array:
    """Frequencies at which the measured power exceeds the model's the most, Hz; of lines, to a small part of a bin."""
    c = problem.evidence.spectra.shape[-1]
    shape = (problem.n_classes, problem.evidence.band.n_bins, c * c)
    diagonal = np.cumsum([1, *(2 * np.arange(1, c) + 1)]) - 1
    over = null.residual.reshape(shape)[:, :, diagonal].sum(axis=(0, 2)).copy()
    here, band = problem.predict(null.x, null.effects), problem.evidence.band
    power = np.einsum("k,kfaa->f", problem.evidence.counts, here.data - here.spectra).real
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


def rank(problem: Problem, null: Fit, candidates: list[Effect]) -> list[tuple[float, Effect]]:
    """Gain that the score test promises for every start, best first; each effect moved to the size that it suggests.

    A fit that went far to explain what it cannot hides what would explain it; so effects are tried beside what was known, too.
    """
    promised = _promised(problem, null, candidates)
    if _dragged(problem, null):
        held, rest = _at_rest(problem, null)
        lost = null.log_posterior - rest.log_posterior
        promised += [(gain - lost, effect) for gain, effect in _promised(held, rest, candidates)]
    return sorted(promised, key=lambda item: -item[0])


def _promised(problem: Problem, null: Fit, candidates: list[Effect]) -> list[tuple[float, Effect]]:
    """As `rank`, about one fit: the change of the spectra that a small effect makes, less what the nuisances explain, is
    compared with the residual.
    """
    here = problem.predict(null.x, null.effects)
    mean, precision = problem.prior(null.x, null.effects)
    tangent = null.jacobian
    normal = inverse(tangent.T @ tangent + precision)
    residual = np.concatenate([null.residual, null.mean_residual])
    # The nuisances' own slope is that of the posterior: what pulls them from what was known before speaks for an effect.
    own_slope = tangent.T @ residual - precision @ (null.x - mean)
    tangent, driven = np.asfortranarray(tangent), problem.evidence.drive is not None

    def promised(effect: Effect) -> list[tuple[float, Effect]]:
        moved = problem.predict(null.x, (*null.effects, effect))
        # What it gains as it stands, once the levels have followed: for starts that happen to lie near the truth.
        whole = problem.log_likelihood(moved.spectra, moved.data, levelled=True) - null.log_likelihood
        if not effect.proportional:
            return [(whole, effect)]
        # The phases of a driven response turn far between two fits: whole changes rank better there (docs/measured-frames.md).
        v = change(problem, here, moved) if driven else _slope(problem, null, here, effect)
        along = tangent.T @ v
        information, score = float(v @ v - along @ normal @ along), float(v @ residual - along @ normal @ own_slope)
        grown = None if information < 1e-9 else _grown(effect, score / information)
        return [(whole, effect)] if grown is None else [(whole, effect), (0.5 * score**2 / information, grown)]

    return list(chain.from_iterable(each(promised, candidates)))


def _slope(problem: Problem, null: Fit, here: Prediction, effect: Effect) -> Array:
    """Whitened change by an effect, in proportion to what next to nothing of it makes: where noise is little, even a small
    effect's change is far from a straight line."""
    slight = _sized(effect, _SLIGHT ** (1.0 / effect.order))
    assert slight is not None, "nearer to nothing than one that is possible"
    return np.asarray(change(problem, here, problem.predict(null.x, (*null.effects, slight))) / _SLIGHT)


def _dragged(problem: Problem, null: Fit) -> bool:
    """Whether a fit went far from what was known before, whose response is not told by phases."""
    return problem.evidence.drive is None and null.log_prior < _DRAGGED


def _at_rest(problem: Problem, null: Fit, *more: Effect) -> tuple[Problem, Fit]:
    """The problem with its structure held where it was known to be, fitted; with further effects."""
    known = problem.reference
    held = replace(problem, reference=replace(known, precision=known.precision + _HELD * np.eye(known.mean.size)))
    x = np.concatenate([known.mean, null.x[known.mean.size :]])
    return held, fit(held, x, (*null.effects, *more), iterations=_BRIEFLY)


def change(problem: Problem, here: Prediction, there: Prediction) -> Array:
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


def judge(
    problem: Problem,
    null: Fit,
    effect: Effect,
    *,
    quick: bool = False,
    bar: float = -np.inf,
    rough: Candidate | None = None,
) -> Candidate:
    """Fit an effect beside the nuisances; with less care, once it is seen that it does not reach the evidence `bar`.

    Where the fit runs away and ends below a `rough` one, it is made again from there.
    """
    driven = problem.evidence.drive is not None
    # Driven motion tells so much that a cause bends the other slopes at once.
    frozen = null.jacobian[:, : problem.n_nuisance] if quick and not driven else None
    few, many = (_ROUGHLY, FAR) if driven else (_QUICKLY, _LONG)
    fitted = partial(fit, problem, iterations=few if quick else many, tolerance=_COARSE if driven else _FINE)
    found = evidence_of(problem, null, fitted(null.x, (*null.effects, effect), frozen=frozen))
    if not quick and _dragged(problem, null):
        near = _at_rest(problem, null, effect)[1]
        if found.may_reach(bar) or sum(problem.score(near.x, near.effects)) > found.fit.log_posterior:
            other = evidence_of(problem, null, fit(problem, near.x, near.effects, iterations=_LONG))
            found = max(found, other, key=lambda c: c.evidence)
    if rough is not None and found.evidence < rough.evidence:
        again = evidence_of(problem, null, fitted(rough.fit.x, rough.fit.effects))
        found = max(found, again, key=lambda c: c.evidence)
    return found


def evidence_of(problem: Problem, null: Fit, fitted: Fit, n_more: int | None = None) -> Candidate:
    """What a fit gains by its last effect, or by `n_more` parameters."""
    effect = fitted.effects[-1]
    n_more = len(effect.parameters) if n_more is None else n_more
    gain = fitted.log_posterior - null.log_posterior
    n = problem.evidence.counts.sum() * problem.evidence.band.n_bins * problem.evidence.weight
    return Candidate(effect, fitted, gain, gain - 0.5 * n_more * np.log(n))
