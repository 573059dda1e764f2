"""What a simulation gets wrong: the causes that measured data name, or why they name none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.ambiguity import probabilities, same, tied_candidates
from monitor.diagnosis.backbone import backbone, level_dependence, ratios
from monitor.diagnosis.backward_elimination import joined, moved, only, revise_candidates, simulate_what_was_missed
from monitor.diagnosis.initial_fit import FAR, beside_wind, between_samples, exactly
from monitor.diagnosis.lack_of_fit import (
    LackOfFit,
    find_lack_of_fit,
    find_level_dependence,
    remainder,
    wrong_bins,
    wrong_nats,
)
from monitor.diagnosis.parameter_uncertainty import deviations, is_significant
from monitor.diagnosis.score_test import Candidate, fit_best, parameter_cost
from monitor.diagnosis.selection_round import run_selection_round
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import (
    RefittedCandidate,
    fit_by_simulation,
    fit_initial_model,
    fit_persistent_effects,
    refine_fit,
)
from monitor.inference import CorrectedPosterior, MapEstimate, Moments, ObservedSpectra, Posterior, maximize_posterior
from monitor.model import Context, Effect, StructuralPrior

_LIKELY = 2
"""Candidates that are asked how a measured ground moved between its samples."""
_MOVED = 0.05
"""Relative change of a frequency from which it matters what of the damping stayed."""
_SURE = 3.0
"""Standard deviations of a simulation's chance that a further cause must beat."""
Verdict = Literal["none", "named", "ambiguous", "unexplained"]


@dataclass(frozen=True, eq=False, slots=True)
class Cause:
    """An effect with what is known of its size."""

    effect: Effect
    std: dict[str, float]
    """Standard deviation of each parameter."""


@dataclass(frozen=True, eq=False, slots=True)
class Diagnosis:
    """The answer, and everything that it was judged by."""

    verdict: Verdict
    causes: tuple[Cause, ...]
    alternatives: tuple[tuple[Candidate, float], ...]
    """Candidates that cannot be told apart, with their probabilities."""
    misfit: tuple[LackOfFit, ...]
    """What the model without causes got wrong."""
    left_over: tuple[LackOfFit, ...]
    """What is still wrong with them."""
    tried: tuple[Candidate, ...]
    problem: Posterior
    null: MapEstimate
    """The old model form, refitted."""
    final: MapEstimate
    """With the causes (the most probable alternative where the answer is ambiguous)."""
    settings: DiagnosisSettings
    """By which it was judged."""
    rounds: tuple[tuple[Candidate, ...], ...] = field(default=())


@dataclass(frozen=True, eq=False, slots=True)
class _Stage:
    """How far the search has come."""

    problem: Posterior
    at: MapEstimate
    null: MapEstimate
    """The model form without causes, fitted."""
    accepted: tuple[Candidate, ...]
    moments: Moments
    """What the accepted laws add to those of a normal process."""
    margin: float
    """Evidence from which a further cause is one, nats."""


def diagnose(
    evidence: ObservedSpectra, reference: StructuralPrior, context: Context, settings: DiagnosisSettings
) -> Diagnosis:
    """Search the catalogue for what explains a recording.

    After a cause is accepted the search is repeated on the extended model, until nothing is left that it explains.
    """
    problem, null, standing = fit_initial_model(evidence, reference, context)
    stage = _Stage(problem, null, null, (), standing, settings.margin)
    rounds: list[tuple[Candidate, ...]] = []
    alternatives: tuple[tuple[Candidate, float], ...] = ()
    while len(stage.accepted) < settings.max_causes:
        stage, tried, due = _searched(stage, settings)
        rounds.append(tuple(p.candidate for p in tried))
        if not tried or tried[0].candidate.evidence < due:
            break
        close = tied_candidates(tried, settings.rival)
        if len(close) > 1:
            close = _looked_ahead(close, settings)
        beside = _beside(stage, close[0], settings) if len(close) > 1 else None
        if beside is not None:  # the tie comes up again, last
            stage, tried = beside
            rounds[-1] = tuple(p.candidate for p in tried)
            continue
        if len(close) > 1:
            alternatives = tuple(zip((p.candidate for p in close), probabilities(close).tolist(), strict=True))
            stage = replace(stage, problem=close[0].problem, at=close[0].candidate.fit)
            break
        stage = _with(stage, close[0], settings)
    problem, at, accepted = revise_candidates(
        stage.problem, stage.at, stage.accepted, rounds, settings.margin, settings.rival
    )
    problem, at, accepted, doubt = _finished(problem, at, accepted)
    misfit = find_lack_of_fit(problem, stage.null, settings)
    left_over = (*find_level_dependence(problem, at, settings), *find_lack_of_fit(problem, at, settings))
    share = remainder(problem, at, stage.null, misfit, left_over)
    verdict = _verdict(share, left_over, accepted, bool(alternatives), settings)
    if verdict == "unexplained":
        problem, at, accepted, doubt = _sure_elsewhere(problem, at, accepted, doubt, settings)
        left_over = (*find_level_dependence(problem, at, settings), *find_lack_of_fit(problem, at, settings))
    # A response shows more than bands do: what the modes' ratios and their dependence on the level say.
    plain = (ratios(problem, at), level_dependence(backbone(problem, stage.null)))
    still = level_dependence(backbone(problem, at))
    return Diagnosis(
        verdict=verdict,
        causes=_causes(problem, at, accepted, doubt),
        alternatives=alternatives,
        misfit=(*[m for m in plain if m is not None], *misfit),
        left_over=left_over if still is None else (*left_over, still),
        tried=rounds[0] if rounds else (),
        problem=problem,
        null=stage.null,
        final=at,
        settings=settings,
        rounds=tuple(rounds),
    )


def _searched(stage: _Stage, settings: DiagnosisSettings) -> tuple[_Stage, list[RefittedCandidate], float]:
    """The stage, fitted anew where the search came upon a better fit without any cause; what may come next, best first; and
    the evidence that it must have."""
    due = _due(stage, settings)
    worth = settings.worth * due / settings.margin
    tried = run_selection_round(stage.problem, stage.at, stage.moments, settings, worth)
    better = simulate_what_was_missed(stage.problem, stage.at, tried) or _otherwise_between(stage, tried, worth)
    if better is None:
        return stage, tried, due
    problem, at = better
    stage = replace(stage, problem=problem, at=at, null=stage.null if stage.accepted else at)
    return stage, run_selection_round(problem, at, stage.moments, settings, worth), _due(stage, settings)


def _due(stage: _Stage, settings: DiagnosisSettings) -> float:
    """Evidence that the next cause must have, nats."""
    if stage.problem.observed.drive is not None:  # most of what is wrong is in the response, which misfits do not count
        return stage.margin
    return max(
        stage.margin, settings.share * wrong_nats(stage.problem, find_lack_of_fit(stage.problem, stage.at, settings))
    )


def _otherwise_between(
    stage: _Stage, tried: list[RefittedCandidate], worth: float
) -> tuple[Posterior, MapEstimate] | None:
    """The fit with the ground's motion between its samples that the best candidates ask for; None where that is no other one.

    Without the cause another motion may have made up for it, and with that one a cause of more parameters may look better.
    """
    drive = stage.problem.observed.drive
    if drive is None or not tried or tried[0].candidate.evidence < worth:
        return None
    likely: list[tuple[float, ObservedSpectra]] = []
    for p in tried[:_LIKELY]:
        before = p.candidate.fit
        problem, at = between_samples(p.problem, before)
        likely.append((p.candidate.evidence + at.log_posterior - before.log_posterior, problem.observed))
    like = max(likely, key=lambda pair: pair[0])[1]
    assert like.drive is not None
    if like.drive.between == drive.between:
        return None
    problem = replace(stage.problem, observed=like)
    return problem, maximize_posterior(problem, stage.at.x, stage.at.effects, iterations=FAR)


def _with(stage: _Stage, best: RefittedCandidate, settings: DiagnosisSettings) -> _Stage:
    """The stage once a cause is accepted: everything fitted beside it, and what a further one must bring."""
    accepted = (*stage.accepted, best.candidate)
    problem, at = best.problem, best.candidate.fit
    driven = problem.observed.drive is not None
    problem, at = between_samples(_extended(problem, at), at)
    # Damping is freer now, the motion is known, and how far up the forces reach.
    at = maximize_posterior(problem, at.x, at.effects)
    if driven and _has_nonlinear(at):
        problem, at = exactly(problem, at)
    problem, at = beside_wind(problem, at)
    added, margin = best.moments, stage.margin
    if len(accepted) > 1 and _has_nonlinear(at) and not driven:  # corrected without the newest cause
        made = fit_by_simulation(problem, at)
        problem, at, added = made.problem, made.fit, made.moments
    if best.candidate.effect.nonlinear:
        margin = max(margin, settings.aftermath * best.candidate.gain, settings.margin + _SURE * best.chance)
    return _Stage(problem, at, stage.null, accepted, added, margin)


def _beside(
    stage: _Stage, tied: RefittedCandidate, settings: DiagnosisSettings
) -> tuple[_Stage, list[RefittedCandidate]] | None:
    """The stage with what is there whichever of some rivals is the cause, the best one being `tied`, and the candidates among
    which it was found; None where there is nothing, or nothing that is told apart.
    """
    if len(stage.accepted) + 2 > settings.max_causes:
        return None
    there = _with(stage, tied, settings)
    _, tried, due = _searched(there, settings)
    if not tried or tried[0].candidate.evidence < due or len(tied_candidates(tried, settings.rival)) > 1:
        return None
    found = tried[0].candidate.effect
    if found.nonlinear:  # which is to be simulated with all else that is there
        return None
    alone = fit_best(stage.problem, stage.at, found)
    return _with(stage, RefittedCandidate(alone, stage.problem, stage.moments), settings), tried


def _finished(
    problem: Posterior, at: MapEstimate, accepted: tuple[Candidate, ...]
) -> tuple[Posterior, MapEstimate, tuple[Candidate, ...], Array]:
    """With laws simulated as finely as what is published asks for, and their sizes' doubt; shape (p,)."""
    if not _has_nonlinear(at) or problem.observed.drive is not None:
        return problem, at, accepted, np.zeros(at.n_effect)
    near, at = refine_fit(problem, at)
    # What the law's better size leaves of another cause may be nothing.
    kept = [is_significant(e, std) for e, std in zip(at.effects, deviations(near, at, near.doubt), strict=True)]
    if not any(kept):
        return near, at, accepted, near.doubt
    return _kept(near, at, accepted, near.doubt, kept)


def _kept(
    problem: Posterior, at: MapEstimate, accepted: tuple[Candidate, ...], doubt: Array, kept: Sequence[bool]
) -> tuple[Posterior, MapEstimate, tuple[Candidate, ...], Array]:
    """With some of the effects alone."""
    if all(kept):
        return problem, at, accepted, doubt
    bent = _has_nonlinear(at)
    at, doubt = only(problem, at, doubt, kept)
    # The last effect of an ambiguous answer was not accepted.
    accepted = tuple(c for c, stays in zip(accepted, kept, strict=False) if stays)
    if bent and not _has_nonlinear(at):
        return *fit_persistent_effects(problem, at)[:2], accepted, doubt
    return problem, at, accepted, doubt


def _sure_elsewhere(
    problem: Posterior, at: MapEstimate, accepted: tuple[Candidate, ...], doubt: Array, settings: DiagnosisSettings
) -> tuple[Posterior, MapEstimate, tuple[Candidate, ...], Array]:
    """Beside something unexplained with those causes alone that other bands show too: in its own it makes up tones, oscillators
    and laws that are none.
    """
    wrong = wrong_bins(problem, at, settings)
    if not accepted or not wrong.any() or problem.observed.drive is not None:
        return problem, at, accepted, doubt
    elsewhere = replace(problem, left_out=wrong)
    whole = maximize_posterior(elsewhere, at.x, at.effects)

    def shown(i: int) -> bool:
        if i >= len(accepted):
            return True
        others = (*at.effects[:i], *at.effects[i + 1 :])
        without = maximize_posterior(elsewhere, joined(whole.x[problem.layout.nuisances], others), others)
        gain = whole.log_posterior - without.log_posterior
        return gain - parameter_cost(elsewhere, len(at.effects[i].parameters)) > settings.margin

    return _kept(problem, at, accepted, doubt, parallel_map(shown, range(len(at.effects))))


def _verdict(
    share: float,
    left_over: Sequence[LackOfFit],
    accepted: Sequence[Candidate],
    ambiguous: bool,
    settings: DiagnosisSettings,
) -> Verdict:
    # The exact form of a nonlinear law far from rest is not known; what little that leaves is no cause of its own.
    bent = any(c.effect.nonlinear for c in accepted)
    if left_over and not (bent and share < settings.remainder):
        return "unexplained"
    if ambiguous:
        return "ambiguous"
    return "named" if accepted else "none"


def _looked_ahead(close: list[RefittedCandidate], settings: DiagnosisSettings) -> list[RefittedCandidate]:
    """Rivals of which each leaves something unexplained, judged with the best second cause beside each."""
    if not find_lack_of_fit(close[0].problem, close[0].candidate.fit, settings):
        return close
    total = []
    for p in close[: settings.tried]:
        second = run_selection_round(
            _extended(p.problem, p.candidate.fit), p.candidate.fit, p.moments, settings, settings.worth
        )
        more = second[0].candidate.evidence if second else 0.0
        total.append(p.candidate.evidence + (more if more > settings.margin else 0.0))
    best = int(np.argmax(total))
    near = [
        p
        for p, t in zip(close, total, strict=False)
        if t > total[best] - settings.rival or same(p.problem, p.candidate.fit, close[best].candidate.fit)
    ]
    return sorted(near, key=lambda p: p is not close[best])


def _extended(problem: Posterior, at: MapEstimate) -> Posterior:
    """The problem once its last cause is accepted.

    The motion follows the new model, and damping, which is known for the healthy modes, is known less well of modes that have
    moved: either their ratios stayed, or what dissipates did.
    """
    problem = moved(problem, at)
    before = problem.model(at.x, (*problem.prior.effects(at.x), *at.effects[:-1])).modes().frequencies_hz
    after = problem.model(at.x, (*problem.prior.effects(at.x), *at.effects)).modes().frequencies_hz
    ratios = replace(problem, prior=problem.prior.with_looser_damping(np.log(after / before)))
    known = problem.damped_as_built or isinstance(problem, CorrectedPosterior) or problem.observed.drive is not None
    if known or np.abs(np.log(after / before)).max() < _MOVED:
        return ratios
    matrix = replace(ratios, damped_as_built=True)
    return max(ratios, matrix, key=lambda form: maximize_posterior(form, at.x, at.effects).log_posterior)


def _has_nonlinear(at: MapEstimate) -> bool:
    return any(e.nonlinear for e in at.effects)


def _causes(problem: Posterior, fitted: MapEstimate, accepted: Sequence[Candidate], doubt: Array) -> tuple[Cause, ...]:
    """The accepted effects with the standard deviations of their parameters."""
    out = []
    for effect, deviation, _ in zip(fitted.effects, deviations(problem, fitted, doubt), accepted, strict=False):
        std = {}
        for p, own in zip(effect.parameters, deviation.tolist(), strict=True):
            value = getattr(effect, p.name)
            std[p.name] = min(own * {"linear": 1.0, "log": value, "inverse": value**2}[p.scale], 1e300)
        out.append(Cause(effect, std))
    return tuple(out)
