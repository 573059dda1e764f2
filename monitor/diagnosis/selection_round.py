"""One round of a search: what may explain what is left is ranked, fitted, simulated where its law bends, and compared."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from monitor.core import parallel_map
from monitor.diagnosis.ambiguity import tied_candidates
from monitor.diagnosis.backward_elimination import joined
from monitor.diagnosis.parameter_uncertainty import is_significant
from monitor.diagnosis.score_test import Candidate, best_of_each, candidate_starts, fit_best, rank_by_score
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import RefittedCandidate, refit_by_simulation
from monitor.inference import CorrectedPosterior, MapEstimate, MeasuredMoments, Moments, Posterior, measure_moments
from monitor.model import Effect

_SMALL = 200.0
"""Promised gain, nats, of a small effect."""
_KINDS, _EVERYWHERE, _DRIVEN, _PROMISING = 7, 2, 2, 12
"""Where the ground is measured: kinds of causes that are fitted roughly, those of them at every place, and to the end; and how
many that promise most are fitted roughly, of whatever kind."""
_UNSURE = 0.1
"""Share of a gain by which a rough simulation may misjudge it."""
_EVEN = 1.0
"""Nats of a simulation's chance from which rivals are simulated once more."""


def run_selection_round(
    problem: Posterior, at: MapEstimate, added: Moments, settings: DiagnosisSettings, worth: float
) -> list[RefittedCandidate]:
    """The best candidates beside what was accepted, by evidence, of those that promise a gain of `worth`.

    Parameters
    ----------
    at : MapEstimate
        With the causes that were accepted.
    added : Moments
        What these add to the moments of a normal process.
    worth : float
        Nats that the score test must promise.
    """
    # What stood at calibration may have changed, but for laws, which are simulated one at a place.
    standing = [e for e in problem.prior.effects(at.x) if e.nonlinear or not e.parameters]
    taken = [(e.name, e.location) for e in (*standing, *at.effects)]
    ranked = [
        item
        for item in best_of_each(rank_by_score(problem, at, candidate_starts(problem, at, taken)))
        if item[0] > worth
    ]
    choose = _chosen if problem.observed.drive is None else _driven
    chosen, rough, bar = choose(problem, at, ranked, settings)
    ended = {c.key: c for c in rough}

    def judged(key: tuple[str, str]) -> Candidate:
        return fit_best(problem, at, chosen[key], bar=bar, rough=ended.get(key))

    fitted = sorted(filter(partial(_is_one, problem), parallel_map(judged, chosen)), key=lambda c: -c.evidence)
    return sorted(_polished(problem, at, fitted, added, settings), key=lambda p: -p.candidate.evidence)


def _is_one(problem: Posterior, candidate: Candidate) -> bool:
    """Whether a linear cause is what it says: of a size that is beyond doubt not that of none; and, if it swings by itself, does
    so within the band and is not damped at once, for a heavy thing that hardly moves stands for a damper.
    """
    effect = candidate.effect
    if not effect.is_plausible(problem.observed.band.hz):
        return False
    own = np.sqrt(np.maximum(np.diag(candidate.fit.covariance)[problem.layout.effects], 0.0))
    return effect.nonlinear or is_significant(effect, own[own.size - len(effect.parameters) :])


def _chosen(
    problem: Posterior, at: MapEstimate, ranked: list[tuple[float, Effect]], settings: DiagnosisSettings
) -> tuple[dict[tuple[str, str], Effect], list[Candidate], float]:
    """Effects worth a fit to the end, by name and place; the rough fits; the evidence below which a cause does not matter."""
    rough = _roughly(problem, at, [e for _, e in ranked[: settings.ranked]])
    bar = max(rough[0].evidence - settings.rival, settings.margin) if rough else 0.0
    near = [c for c in rough if c.may_reach(bar)]
    # Of a small effect, rivals gain nearly as much, and none may be passed over.
    small = len(ranked) > 0 and ranked[0][0] < _SMALL
    chosen = {c.key: c.effect for c in (near if small else near[: settings.tried])}
    # A rough fit may fail from far away, so the score test's own favourites are fitted too.
    return {(e.name, e.location): e for _, e in ranked[: settings.favourites]} | chosen, rough, bar


def _roughly(problem: Posterior, at: MapEstimate, effects: list[Effect]) -> list[Candidate]:
    """Effects fitted roughly, best first."""

    def rough(effect: Effect) -> Candidate:
        found = fit_best(problem, at, effect, quick=True)
        return replace(
            found, fit=replace(found.fit, jacobian=np.zeros((0, found.fit.x.size)))
        )  # a megabyte that nobody asks for

    return sorted(parallel_map(rough, effects), key=lambda c: -c.evidence)


def _driven(
    problem: Posterior, at: MapEstimate, ranked: list[tuple[float, Effect]], _: DiagnosisSettings
) -> tuple[dict[tuple[str, str], Effect], list[Candidate], float]:
    """As `_chosen` where the ground is measured: the best few of all kinds, and the best one's kind at every place.

    A response tells kinds apart by so much that few need a closer look, but its score test promises too much to most.
    """
    kinds = list(dict.fromkeys(effect.name for _, effect in ranked))
    first = {name: next(e for _, e in ranked if e.name == name) for name in kinds[:_KINDS]}
    near = [
        e
        for i, (_, e) in enumerate(ranked)
        if i < _PROMISING or e.name in kinds[:_EVERYWHERE] or e is first.get(e.name)
    ]
    rough = _roughly(problem, at, near)
    chosen = {c.key: c.effect for c in rough[:_DRIVEN]}
    same = [e for _, e in ranked if rough and e.name == rough[0].effect.name]
    return {(e.name, e.location): e for e in same} | chosen, rough, -np.inf


def _polished(
    problem: Posterior, at: MapEstimate, candidates: list[Candidate], added: Moments, settings: DiagnosisSettings
) -> list[RefittedCandidate]:
    """Candidates as they compare once nonlinear laws near the top were simulated and the moments were heard."""
    # A response to a measured ground is that of the exact laws.
    if not candidates or candidates[0].evidence < settings.margin or problem.observed.drive is not None:
        return [RefittedCandidate(c, problem, added) for c in candidates]
    best = candidates[0]
    reach = best.evidence - max(settings.rival, settings.linearization * best.gain)
    doubtful = [c for c in candidates if c.evidence > reach]
    if not any(c.effect.nonlinear for c in doubtful):
        return [RefittedCandidate(c, problem, added) for c in candidates]
    measured = measure_moments(problem.observed.segments.values, problem, at)
    bent = [c for c in doubtful if c.effect.nonlinear]
    simulated = {p.candidate.key: p for p in parallel_map(partial(refit_by_simulation, problem, at), bent)}
    first = max((simulated[c.key].candidate if c.key in simulated else c).evidence for c in candidates)
    near = [p for p in simulated.values() if p.candidate.evidence > first - _UNSURE * max(p.candidate.gain, _SMALL)]
    finer = parallel_map(lambda p: refit_by_simulation(p.problem, at, p.candidate, "fine"), near)
    simulated |= {p.candidate.key: p for p in finer}
    made = _compared(problem, candidates, simulated, added, measured)
    close = tied_candidates(made, settings.rival)
    tied = [p.candidate.key for p in close if p.chance > _EVEN and len(close) > 1]
    if not tied:
        return made
    finest = parallel_map(
        lambda key: refit_by_simulation(simulated[key].problem, at, simulated[key].candidate, "finest"), tied
    )
    return _compared(problem, candidates, simulated | {p.candidate.key: p for p in finest}, added, measured)


def _compared(
    problem: Posterior,
    candidates: list[Candidate],
    simulated: dict[tuple[str, str], RefittedCandidate],
    before: Moments,
    measured: MeasuredMoments,
) -> list[RefittedCandidate]:
    """Candidates, simulated or not, with what the measured moments say of them against the one whose spectra fit best; `before`
    are the moments that the causes accepted before add."""
    polished = [simulated.get(c.key, RefittedCandidate(c, problem, before)) for c in candidates]
    turned = [_turned(p, before, measured) for p in polished]
    first = max(turned, key=lambda pair: pair[0].candidate.evidence)[1]
    return [_credited(p, likelihood - first) for p, likelihood in turned]


def _turned(made: RefittedCandidate, before: Moments, measured: MeasuredMoments) -> tuple[RefittedCandidate, float]:
    """A candidate, turned round where the measured moments ask for that, and their log likelihood."""
    as_it_is, mirror = measured.log_likelihood(made.moments, made.spread), made.candidate.effect.mirrored()
    if mirror is None:
        return made, as_it_is
    other = made.moments.mirrored(before)
    turned = measured.log_likelihood(other, made.spread)
    if turned <= as_it_is:
        return made, as_it_is
    old = made.candidate.fit
    x = joined(old.x[: -len(mirror.parameters)], (mirror,))
    candidate = replace(made.candidate, effect=mirror, fit=replace(old, effects=(*old.effects[:-1], mirror), x=x))
    problem = made.problem.mirrored(mirror) if isinstance(made.problem, CorrectedPosterior) else made.problem
    return replace(made, candidate=candidate, problem=problem, moments=other), turned


def _credited(made: RefittedCandidate, nats: float) -> RefittedCandidate:
    """A candidate with so much more evidence."""
    return replace(made, candidate=replace(made.candidate, evidence=made.candidate.evidence + nats))
