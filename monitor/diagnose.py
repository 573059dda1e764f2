"""What a simulation gets wrong: the causes that measured data name, or why they name none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from monitor.backbone import backbone, level_dependence, ratios
from monitor.corrected import Corrected
from monitor.diagnosis_settings import DiagnosisSettings
from monitor.doubt import deviations, sure
from monitor.effects import Context, Effect
from monitor.effects.attached_oscillator import AttachedOscillator
from monitor.evidence import Evidence
from monitor.fitting import Fit, fit
from monitor.likelihood import Problem
from monitor.misfit import Misfit, misfits, remainder, strayed, wrong_nats
from monitor.moments import Heard, Moments, heard
from monitor.parallel import each
from monitor.polish import Polished, beside_standing, finish, polish, prepared, settle
from monitor.preparation import FAR, beside_wind, between_samples, exactly
from monitor.reference import Reference
from monitor.results import Array
from monitor.revision import joined, missed, moved, only, revised
from monitor.rivals import probabilities, same, together
from monitor.search import Candidate, best_of_each, judge, rank, starts

_SMALL = 200.0
"""Promised gain, nats, of a small effect."""
_KINDS, _EVERYWHERE, _DRIVEN, _PROMISING = 7, 2, 2, 12
"""Where the ground is measured: kinds of causes that are fitted roughly, those of them at every place, and to the end; and how
many that promise most are fitted roughly, of whatever kind."""
_MOVED = 0.05
"""Relative change of a frequency from which it matters what of the damping stayed."""
_UNSURE = 0.1
"""Share of a gain by which a rough simulation may misjudge it."""
_EVEN = 1.0
"""Nats of a simulation's chance from which rivals are simulated once more."""
_SURE = 3.0
"""Standard deviations of a simulation's chance that a further cause must beat."""
_SWINGS = 0.5
"""Damping ratio below which something swings by itself."""
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
    misfit: tuple[Misfit, ...]
    """What the model without causes got wrong."""
    left_over: tuple[Misfit, ...]
    """What is still wrong with them."""
    tried: tuple[Candidate, ...]
    problem: Problem
    null: Fit
    """The old model form, refitted."""
    final: Fit
    """With the causes (the most probable alternative where the answer is ambiguous)."""
    settings: DiagnosisSettings
    """By which it was judged."""
    rounds: tuple[tuple[Candidate, ...], ...] = field(default=())


@dataclass(frozen=True, eq=False, slots=True)
class _Stage:
    """How far the search has come."""

    problem: Problem
    at: Fit
    null: Fit
    """The model form without causes, fitted."""
    accepted: tuple[Candidate, ...]
    moments: Moments
    """What the accepted laws add to those of a normal process."""
    margin: float
    """Evidence from which a further cause is one, nats."""


def diagnose(evidence: Evidence, reference: Reference, context: Context, settings: DiagnosisSettings) -> Diagnosis:
    """Search the catalogue for what explains a recording.

    After a cause is accepted the search is repeated on the extended model, until nothing is left that it explains.
    """
    problem, null, standing = prepared(evidence, reference, context)
    stage = _Stage(problem, null, null, (), standing, settings.margin)
    rounds: list[tuple[Candidate, ...]] = []
    alternatives: tuple[tuple[Candidate, float], ...] = ()
    while len(stage.accepted) < settings.max_causes:
        stage, tried, due = _searched(stage, settings)
        rounds.append(tuple(p.candidate for p in tried))
        if not tried or tried[0].candidate.evidence < due:
            break
        close = together(tried, settings.rival)
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
    problem, at, accepted = revised(stage.problem, stage.at, stage.accepted, rounds, settings.margin, settings.rival)
    problem, at, accepted, doubt = _finished(problem, at, accepted)
    misfit = misfits(problem, stage.null, settings)
    left_over = (*strayed(problem, at, settings), *misfits(problem, at, settings))
    share = remainder(problem, at, stage.null, misfit, left_over)
    verdict = _verdict(share, left_over, accepted, bool(alternatives), settings)
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


def _searched(stage: _Stage, settings: DiagnosisSettings) -> tuple[_Stage, list[Polished], float]:
    """The stage, fitted anew where the search came upon a better fit without any cause; what may come next, best first; and
    the evidence that it must have."""
    due = _due(stage, settings)
    worth = settings.worth * due / settings.margin
    tried = _round(stage.problem, stage.at, stage.moments, settings, worth)
    better = missed(stage.problem, stage.at, tried) or _otherwise_between(stage, tried, worth)
    if better is None:
        return stage, tried, due
    problem, at = better
    stage = replace(stage, problem=problem, at=at, null=stage.null if stage.accepted else at)
    return stage, _round(problem, at, stage.moments, settings, worth), _due(stage, settings)


def _due(stage: _Stage, settings: DiagnosisSettings) -> float:
    """Evidence that the next cause must have, nats."""
    if stage.problem.evidence.drive is not None:  # most of what is wrong is in the response, which misfits do not count
        return stage.margin
    return max(stage.margin, settings.share * wrong_nats(stage.problem, misfits(stage.problem, stage.at, settings)))


def _otherwise_between(stage: _Stage, tried: list[Polished], worth: float) -> tuple[Problem, Fit] | None:
    """The fit with the ground's motion between its samples that the best candidates ask for; None where that is no other one.

    Without the cause another motion may have made up for it, and with that one a cause of more parameters may look better.
    """
    drive = stage.problem.evidence.drive
    if drive is None or not tried or tried[0].candidate.evidence < worth:
        return None
    likely: list[tuple[float, Evidence]] = []
    for p in tried[:_DRIVEN]:
        before = p.candidate.fit
        problem, at = between_samples(p.problem, before)
        likely.append((p.candidate.evidence + at.log_posterior - before.log_posterior, problem.evidence))
    like = max(likely, key=lambda pair: pair[0])[1]
    assert like.drive is not None
    if like.drive.between == drive.between:
        return None
    problem = replace(stage.problem, evidence=like)
    return problem, fit(problem, stage.at.x, stage.at.effects, iterations=FAR)


def _with(stage: _Stage, best: Polished, settings: DiagnosisSettings) -> _Stage:
    """The stage once a cause is accepted: everything fitted beside it, and what a further one must bring."""
    accepted = (*stage.accepted, best.candidate)
    problem, at = best.problem, best.candidate.fit
    driven = problem.evidence.drive is not None
    problem, at = between_samples(_extended(problem, at), at)
    # Damping is freer now, the motion is known, and how far up the forces reach.
    at = fit(problem, at.x, at.effects)
    if driven and _bent(at):
        problem, at = exactly(problem, at)
    problem, at = beside_wind(problem, at)
    added, margin = best.moments, stage.margin
    if len(accepted) > 1 and _bent(at) and not driven:  # corrected without the newest cause
        made = settle(problem, at)
        problem, at, added = made.problem, made.fit, made.moments
    if best.candidate.effect.nonlinear:
        margin = max(margin, settings.aftermath * best.candidate.gain, settings.margin + _SURE * best.chance)
    return _Stage(problem, at, stage.null, accepted, added, margin)


def _beside(stage: _Stage, tied: Polished, settings: DiagnosisSettings) -> tuple[_Stage, list[Polished]] | None:
    """The stage with what is there whichever of some rivals is the cause, the best one being `tied`, and the candidates among
    which it was found; None where there is nothing, or nothing that is told apart.
    """
    if len(stage.accepted) + 2 > settings.max_causes:
        return None
    there = _with(stage, tied, settings)
    _, tried, due = _searched(there, settings)
    if not tried or tried[0].candidate.evidence < due or len(together(tried, settings.rival)) > 1:
        return None
    found = tried[0].candidate.effect
    if found.nonlinear:  # which is to be simulated with all else that is there
        return None
    alone = judge(stage.problem, stage.at, found)
    return _with(stage, Polished(alone, stage.problem, stage.moments), settings), tried


def _finished(
    problem: Problem, at: Fit, accepted: tuple[Candidate, ...]
) -> tuple[Problem, Fit, tuple[Candidate, ...], Array]:
    """With laws simulated as finely as what is published asks for, and their sizes' doubt; shape (p,)."""
    if not _bent(at) or problem.evidence.drive is not None:
        return problem, at, accepted, np.zeros(at.n_effect)
    near, at = finish(problem, at)
    # What the law's better size leaves of another cause may be nothing.
    kept = [sure(e, std) for e, std in zip(at.effects, deviations(near, at, near.doubt), strict=True)]
    if not any(kept) or all(kept):
        return near, at, accepted, near.doubt
    at, doubt = only(near, at, near.doubt, kept)
    # The last effect of an ambiguous answer was not accepted.
    accepted = tuple(c for c, stays in zip(accepted, kept, strict=False) if stays)
    if not _bent(at):
        return *beside_standing(near, at)[:2], accepted, doubt
    return near, at, accepted, doubt


def _verdict(
    share: float,
    left_over: Sequence[Misfit],
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


def _looked_ahead(close: list[Polished], settings: DiagnosisSettings) -> list[Polished]:
    """Rivals of which each leaves something unexplained, judged with the best second cause beside each."""
    if not misfits(close[0].problem, close[0].candidate.fit, settings):
        return close
    total = []
    for p in close[: settings.tried]:
        second = _round(_extended(p.problem, p.candidate.fit), p.candidate.fit, p.moments, settings, settings.worth)
        more = second[0].candidate.evidence if second else 0.0
        total.append(p.candidate.evidence + (more if more > settings.margin else 0.0))
    best = int(np.argmax(total))
    near = [
        p
        for p, t in zip(close, total, strict=False)
        if t > total[best] - settings.rival or same(p.problem, p.candidate.fit, close[best].candidate.fit)
    ]
    return sorted(near, key=lambda p: p is not close[best])


def _extended(problem: Problem, at: Fit) -> Problem:
    """The problem once its last cause is accepted.

    The motion follows the new model, and damping, which is known for the healthy modes, is known less well of modes that have
    moved: either their ratios stayed, or what dissipates did.
    """
    problem = moved(problem, at)
    before = problem.model(at.x, (*problem.reference.effects(at.x), *at.effects[:-1])).modes().frequencies_hz
    after = problem.model(at.x, (*problem.reference.effects(at.x), *at.effects)).modes().frequencies_hz
    ratios = replace(problem, reference=problem.reference.with_looser_damping(np.log(after / before)))
    known = problem.damped_as_built or isinstance(problem, Corrected) or problem.evidence.drive is not None
    if known or np.abs(np.log(after / before)).max() < _MOVED:
        return ratios
    matrix = replace(ratios, damped_as_built=True)
    return max(ratios, matrix, key=lambda form: fit(form, at.x, at.effects).log_posterior)


def _bent(at: Fit) -> bool:
    return any(e.nonlinear for e in at.effects)


def _round(problem: Problem, at: Fit, added: Moments, settings: DiagnosisSettings, worth: float) -> list[Polished]:
    """The best candidates beside what was accepted, by evidence, of those that promise a gain of `worth`."""
    # What stood at calibration may have changed, but for laws, which are simulated one at a place.
    standing = [e for e in problem.reference.effects(at.x) if e.nonlinear or not e.parameters]
    taken = [(e.name, e.location) for e in (*standing, *at.effects)]
    ranked = [item for item in best_of_each(rank(problem, at, starts(problem, at, taken))) if item[0] > worth]
    choose = _chosen if problem.evidence.drive is None else _driven
    chosen, rough, bar = choose(problem, at, ranked, settings)
    ended = {c.key: c for c in rough}

    def judged(key: tuple[str, str]) -> Candidate:
        return judge(problem, at, chosen[key], bar=bar, rough=ended.get(key))

    fitted = sorted(filter(partial(_is_one, problem), each(judged, chosen)), key=lambda c: -c.evidence)
    return sorted(_polished(problem, at, fitted, added, settings), key=lambda p: -p.candidate.evidence)


def _is_one(problem: Problem, candidate: Candidate) -> bool:
    """Whether a linear cause is what it says: of a size that is beyond doubt not that of none; and, if it swings by itself, does
    so within the band and is not damped at once, for a heavy thing that hardly moves stands for a damper.
    """
    effect, hz = candidate.effect, problem.evidence.band.hz
    if isinstance(effect, AttachedOscillator) and not (
        hz[0] <= effect.frequency_hz <= hz[-1] and effect.damping_ratio < _SWINGS
    ):
        return False
    own = np.sqrt(np.maximum(np.diag(candidate.fit.covariance)[problem.n_nuisance :], 0.0))
    return effect.nonlinear or sure(effect, own[own.size - len(effect.parameters) :])


def _chosen(
    problem: Problem, at: Fit, ranked: list[tuple[float, Effect]], settings: DiagnosisSettings
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


def _roughly(problem: Problem, at: Fit, effects: list[Effect]) -> list[Candidate]:
    """Effects fitted roughly, best first."""

    def rough(effect: Effect) -> Candidate:
        found = judge(problem, at, effect, quick=True)
        return replace(
            found, fit=replace(found.fit, jacobian=np.zeros((0, found.fit.x.size)))
        )  # a megabyte that nobody asks for

    return sorted(each(rough, effects), key=lambda c: -c.evidence)


def _driven(
    problem: Problem, at: Fit, ranked: list[tuple[float, Effect]], _: DiagnosisSettings
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
    problem: Problem, at: Fit, candidates: list[Candidate], added: Moments, settings: DiagnosisSettings
) -> list[Polished]:
    """Candidates as they compare once nonlinear laws near the top were simulated and the moments were heard."""
    # A response to a measured ground is that of the exact laws.
    if not candidates or candidates[0].evidence < settings.margin or problem.evidence.drive is not None:
        return [Polished(c, problem, added) for c in candidates]
    best = candidates[0]
    reach = best.evidence - max(settings.rival, settings.linearization * best.gain)
    doubtful = [c for c in candidates if c.evidence > reach]
    if not any(c.effect.nonlinear for c in doubtful):
        return [Polished(c, problem, added) for c in candidates]
    measured = heard(problem.evidence.segments.values, problem, at)
    bent = [c for c in doubtful if c.effect.nonlinear]
    simulated = {p.candidate.key: p for p in each(partial(polish, problem, at), bent)}
    first = max((simulated[c.key].candidate if c.key in simulated else c).evidence for c in candidates)
    near = [p for p in simulated.values() if p.candidate.evidence > first - _UNSURE * max(p.candidate.gain, _SMALL)]
    finer = each(lambda p: polish(p.problem, at, p.candidate, "fine"), near)
    simulated |= {p.candidate.key: p for p in finer}
    made = _compared(problem, candidates, simulated, added, measured)
    close = together(made, settings.rival)
    tied = [p.candidate.key for p in close if p.chance > _EVEN and len(close) > 1]
    if not tied:
        return made
    finest = each(lambda key: polish(simulated[key].problem, at, simulated[key].candidate, "finest"), tied)
    return _compared(problem, candidates, simulated | {p.candidate.key: p for p in finest}, added, measured)


def _compared(
    problem: Problem,
    candidates: list[Candidate],
    simulated: dict[tuple[str, str], Polished],
    before: Moments,
    measured: Heard,
) -> list[Polished]:
    """Candidates, simulated or not, with what the measured moments say of them against the one whose spectra fit best; `before`
    are the moments that the causes accepted before add."""
    polished = [simulated.get(c.key, Polished(c, problem, before)) for c in candidates]
    turned = [_turned(p, before, measured) for p in polished]
    first = max(turned, key=lambda pair: pair[0].candidate.evidence)[1]
    return [_credited(p, likelihood - first) for p, likelihood in turned]


def _turned(made: Polished, before: Moments, measured: Heard) -> tuple[Polished, float]:
    """A candidate, turned round where the measured moments ask for that, and their log likelihood."""
    as_it_is, mirror = measured.log_likelihood(made.moments, made.spread), made.candidate.effect.mirrored()
    if mirror is None:
        return made, as_it_is
    other = made.moments.mirrored(before)
    turned = measured.log_likelihood(other, made.spread)
    if turned <= as_it_is:
        return made, as_it_is
    old = made.candidate.fit
    candidate = replace(
        made.candidate, effect=mirror, fit=replace(old, effects=(*old.effects[:-1], mirror), x=_mirrored(old, mirror))
    )
    problem = made.problem.mirrored(mirror) if isinstance(made.problem, Corrected) else made.problem
    return replace(made, candidate=candidate, problem=problem, moments=other), turned


def _credited(made: Polished, nats: float) -> Polished:
    """A candidate with so much more evidence."""
    return replace(made, candidate=replace(made.candidate, evidence=made.candidate.evidence + nats))


def _mirrored(fitted: Fit, mirror: Effect) -> Array:
    return joined(fitted.x[: -len(mirror.parameters)], (mirror,))


def _causes(problem: Problem, fitted: Fit, accepted: Sequence[Candidate], doubt: Array) -> tuple[Cause, ...]:
    """The accepted effects with the standard deviations of their parameters."""
    out = []
    for effect, deviation, _ in zip(fitted.effects, deviations(problem, fitted, doubt), accepted, strict=False):
        std = {}
        for p, own in zip(effect.parameters, deviation.tolist(), strict=True):
            value = getattr(effect, p.name)
            std[p.name] = min(own * {"linear": 1.0, "log": value, "inverse": value**2}[p.scale], 1e300)
        out.append(Cause(effect, std))
    return tuple(out)
