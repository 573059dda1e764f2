"""Stepwise selection of causes: the causes that measured data name for the errors of a simulation, or why they name none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from monitor.core import BadInputError, OnProgress, Step, parallel_map
from monitor.diagnosis.ambiguity import predict_the_same, probabilities, tied_candidates
from monitor.diagnosis.backward_elimination import eliminate_backward, find_better_null_fit, update_linearization
from monitor.diagnosis.initial_fit import fit_ambient_forces, fit_exact_slopes, fit_ground_interpolation
from monitor.diagnosis.lack_of_fit import find_lack_of_fit, find_other_direction, lack_of_fit_cost
from monitor.diagnosis.missing_modes import (
    couple_modes,
    find_missing_mode,
    find_missing_modes,
    is_beyond_weak_modes,
    lacks_modes,
    uncouple_modes,
)
from monitor.diagnosis.modal_start import fit_from_modes, has_same_structure
from monitor.diagnosis.parameter_uncertainty import DIFFERS_STDS
from monitor.diagnosis.plan import FAR, plan_of
from monitor.diagnosis.score_test import (
    Candidate,
    best_of_each_kind,
    candidate_starts,
    evidence_cost,
    fit_candidate,
    is_far,
    log_evidence,
    parameter_cost,
)
from monitor.diagnosis.selection_round import run_selection_round
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import RefittedCandidate, fit_by_simulation, fit_initial_model
from monitor.diagnosis.verdict import Alternatives, Diagnosis, is_independent_of_direction, judge, refine
from monitor.inference import (
    CorrectedPosterior,
    MapEstimate,
    Moments,
    ObservedSpectra,
    Posterior,
    maximize_posterior,
    tried,
)
from monitor.model import Context, StructuralPrior

_N_GROUND_TESTS = 2
"""Candidates beside which the ground's motion between its samples is tested again. [count; cost]"""
_NO_FREQUENCY = 1.0
"""Stands for the change of a mode that is unstable without the last cause or with it, so that it has no frequency. [ln ratio;
definition: the damping is known to a factor of e then]"""


@dataclass(frozen=True, eq=False, slots=True)
class Search:
    """Search for causes between two steps."""

    settings: DiagnosisSettings
    posterior: Posterior
    fit: MapEstimate
    null_fit: MapEstimate
    """The model form without causes, fitted."""
    moments: Moments
    """Moments that the accepted laws add to those of a normal process."""
    margin: float
    """Log evidence that a further cause needs, nats."""
    accepted: tuple[Candidate, ...] = ()
    rounds: tuple[tuple[Candidate, ...], ...] = ()
    """For every accepted cause the candidates among which it was accepted, then those of the last step."""
    other_optima: tuple[MapEstimate, ...] = ()
    """Fits of other stiffnesses that the data cannot tell from the one returned."""
    alternatives: Alternatives = ()
    from_elsewhere: bool = False
    """Whether the forces act in another direction than at calibration, so that no cause would be stated."""
    has_ended: bool = False
    tested: MapEstimate | None = None
    """Fit of which each cause was tested beside the others."""

    @property
    def is_full(self) -> bool:
        """Whether no further cause is sought."""
        return self.n_counted >= self.settings.max_causes

    @property
    def n_counted(self) -> int:
        """Number of the accepted causes that the search is limited to.

        Modes that the model lacks may be many.  So may sensors' faults where an input was measured, which separates them from all
        else; without one, several of them imitate crosstalk.
        """
        apart = plan_of(self.posterior).knows_input
        return sum(not (c.effect.repeatable or (apart and c.effect.family == "sensor")) for c in self.accepted)

    def threshold(self) -> float:
        """Compute the log evidence that the next cause needs, nats."""
        if plan_of(self.posterior).knows_input:
            return self.margin
        cost = lack_of_fit_cost(self.posterior, find_lack_of_fit(self.posterior, self.fit, self.settings))
        return max(self.margin, self.settings.share * cost)

    def at(self, fit: MapEstimate) -> Search:
        """Go on from another fit, with nonlinear laws linearized at its motion."""
        return replace(self, posterior=update_linearization(self.posterior, fit), fit=fit)

    def among(self, candidates: Sequence[RefittedCandidate], *, again: bool = False) -> Search:
        """Add the candidates of a round; `again`, in place of the last round."""
        shown = tuple(p.candidate.without_slopes() for p in candidates)
        return replace(self, rounds=(*(self.rounds[:-1] if again else self.rounds), shown))

    def step(self) -> Search:
        """Propose causes, judge them and accept the best; the search ends where there is none, or where rivals are tied."""
        search, causes = _propose(self)
        if not causes:
            return replace(search, has_ended=True)
        tied = tied_candidates(causes, self.settings.rival)
        directed = not any(is_independent_of_direction(p.candidate.effect) for p in tied)
        if directed and shows_other_direction(search):
            return replace(search, from_elsewhere=True, has_ended=True)
        if lacks_modes(search.posterior, search.fit):
            tied = _prefer_mode(search, tied)
        if len(tied) > 1:
            tied = _look_ahead(tied, self.settings)
        if len(tied) > 1:
            beside = _accept_beside_tie(search, tied[0])
            return _end_in_tie(search, tied) if beside is None else beside  # the tie comes up again in the last round
        search = _accept(search, tied[0])
        return _add_missing_modes(search) if any(e.repeatable for e in search.fit.effects) else search


def diagnose(
    observed: ObservedSpectra,
    prior: StructuralPrior,
    context: Context,
    settings: DiagnosisSettings,
    on_progress: OnProgress = lambda _: None,
    *,
    wider: StructuralPrior | None = None,
) -> Diagnosis:
    """Search the catalogue of effects for the causes that explain a recording.

    After a cause is accepted the search is repeated on the extended model, until no effect explains more.  A calibration gives a
    `wider` prior too, with persistent effects of the forces, see `_begin`.
    """
    on_progress(Step("fits the model without causes", then="looks for causes"))
    search = _begin(observed, prior, context, settings, wider)
    while not (search.has_ended or search.is_full):
        on_progress(Step(f"looks for cause {len(search.accepted) + 1}", then="tests each cause beside the others"))
        search = search.step()
    on_progress(Step("tests each cause beside the others"))
    rounds, posterior, fit, accepted = search.rounds, search.posterior, search.fit, search.accepted
    if fit is not search.tested:
        posterior, fit, accepted = eliminate_backward(posterior, fit, accepted, rounds, settings.margin, settings.rival)
    causes = refine(posterior, fit, len(accepted))
    found = judge(causes, search.null_fit, search.alternatives, settings, from_elsewhere=search.from_elsewhere)
    return replace(found, candidates=rounds[0] if rounds else (), rounds=rounds, other_optima=search.other_optima)


def _begin(
    observed: ObservedSpectra,
    prior: StructuralPrior,
    context: Context,
    settings: DiagnosisSettings,
    wider: StructuralPrior | None,
) -> Search:
    """Fit the model without causes, then the modes that it lacks.

    The wider prior takes the place of `prior` where it explains more of the misfit than it leaves, beyond what its parameters
    cost and what these modes or one effect of the forces explain: without it every cause would be sought in vain.
    """
    first = _first_stage(observed, prior, context, settings)
    if first is None:
        raise BadInputError(
            "no structure near the structure file's can be fitted to the spectra: look at units and channels with 'look'"
        )
    begun = start_from_modes(first)
    if wider is None or not find_lack_of_fit(begun.posterior, begun.fit, settings):
        return begun
    shaped = _first_stage(observed, wider, context, settings)
    if shaped is None:
        return begun
    cost = parameter_cost(shaped.posterior, wider.mean.size - prior.mean.size)
    gain = shaped.fit.log_posterior - cost - log_evidence(begun.posterior, begun.fit)
    left = lack_of_fit_cost(shaped.posterior, find_lack_of_fit(shaped.posterior, shaped.fit, settings))
    least = max(left, settings.margin)
    if gain > least:  # otherwise the forces' fits decide nothing
        gain -= _gain_by_forces(begun)
    return start_from_modes(shaped) if gain > least else begun


def _first_stage(
    observed: ObservedSpectra, prior: StructuralPrior, context: Context, settings: DiagnosisSettings
) -> Search | None:
    """Fit the model without causes; None where no structure near the prior's can be fitted."""
    begun = tried(lambda: fit_initial_model(observed, prior, context), None)
    if begun is None or not begun[1].is_possible:
        return None
    posterior, fit, moments = begun
    return Search(settings, posterior, fit, fit, moments, settings.margin)


def _gain_by_forces(search: Search) -> float:
    """Fit the effects of the forces; return the log evidence of the best of them, or zero."""
    posterior, fit = search.posterior, search.fit
    starts = [e for e in candidate_starts(posterior, fit) if e.family == "excitation" and not e.repeatable]
    fits = parallel_map(
        lambda effect: fit_candidate(posterior, fit, effect).log_evidence, best_of_each_kind(posterior, fit, starts)
    )
    return max([0.0, *filter(np.isfinite, fits)])


def _propose(search: Search) -> tuple[Search, list[RefittedCandidate]]:
    """Find the further causes, best first, whose log evidence suffices; return the state with the round's candidates too."""
    search, candidates, threshold = _search_once(search)
    causes = sufficient_candidates(search, candidates, threshold)
    if not causes:
        search, causes = prefer_cause_to_coupling(search)
    return search.among(causes if causes and causes[0] not in candidates else candidates), causes


def _search_once(search: Search, least_gain: float = 0.0) -> tuple[Search, list[RefittedCandidate], float]:
    """Run one round of the search, and once more where it came upon a better fit without a further cause.

    Causes of which a gain below `least_gain`, nats, is predicted are not fitted.  Return the state, refitted where a better fit
    was found, further causes, best first, and the log evidence that the next cause needs, nats.
    """
    threshold = search.threshold()
    min_gain = max(search.settings.worth * threshold / search.settings.margin, least_gain)
    candidates = run_selection_round(search.posterior, search.fit, search.moments, search.settings, min_gain)
    better = find_better_null_fit(search.posterior, search.fit, candidates) or _refit_ground_interpolation(
        search, candidates, min_gain
    )
    if better is None:
        return search, candidates, threshold
    posterior, fit = better
    search = replace(search, posterior=posterior, fit=fit, null_fit=search.null_fit if search.accepted else fit)
    candidates = run_selection_round(posterior, fit, search.moments, search.settings, min_gain)
    return search, candidates, search.threshold()


def sufficient_candidates(
    search: Search, candidates: Sequence[RefittedCandidate], threshold: float
) -> list[RefittedCandidate]:
    """Return the candidates, best first, whose log evidence suffices to accept them."""
    at, fit = search.posterior, search.fit
    return [
        p for p in candidates if is_beyond_weak_modes(at, fit, p.candidate.effect, p.candidate.log_evidence, threshold)
    ]


def prefer_cause_to_coupling(search: Search) -> tuple[Search, list[RefittedCandidate]]:
    """Find a cause that explains more, beside modes that are not coupled, than the coupling of these modes explains.

    A mode that is coupled to the floors moves their frequencies, so that couplings may stand in for a cause in the structure.
    Return the state with the modes uncoupled, and the causes, best first; the state as it was, and no cause, where there is none.
    """
    posterior, fit = search.posterior, search.fit
    if not posterior.prior.is_baseline:  # whether they are coupled was decided at the start, see `start_from_modes`
        return search, []
    apart = uncouple_modes(posterior, fit, search.null_fit.x[posterior.layout.nuisances])
    if apart is None:
        return search, []
    before, candidates, threshold = _search_once(search.at(apart))
    causes = [p for p in sufficient_candidates(before, candidates, threshold) if not p.candidate.effect.repeatable]
    if not causes:
        return search, []
    best = causes[0].candidate
    gain = log_evidence(before.posterior, before.fit) + best.log_evidence - log_evidence(posterior, fit)
    return (before, causes) if gain >= search.margin else (search, [])


def start_from_modes(search: Search) -> Search:
    """Fit from the recording's own modes, where the fit from the drawing leaves lack of fit.

    A drawing may be so far off that a fit from it ends in a false optimum, and may lack modes that the recording has.  A baseline
    is neither.  The modes that the model lacks are accepted causes.
    """
    posterior, null_fit = search.posterior, search.fit
    if not _may_be_far_off(posterior) or not find_lack_of_fit(posterior, null_fit, search.settings):
        return search
    found = fit_from_modes(posterior)
    if not found or found[0][1] < null_fit.log_posterior + search.settings.margin:
        return search
    best, evidence = found[0]
    if not best.effects:
        others = tuple(fit for fit, own in found[1:] if own > evidence - search.settings.rival)
        return replace(search.at(best), null_fit=best, other_optima=others)
    # Coupled before all are found, some modes take the others' part, and the structure follows; a mode that only the floors
    # drive is seen by its coupling alone.  So the better start is followed, and the other where that leads far from the prior.
    coupled = couple_modes(posterior, best)
    starts = [best] if coupled is None else [coupled, best]
    if _explained_by_one(search, log_evidence(posterior, starts[0])):
        return search
    ends: list[Search] = []
    for start in starts:
        ends.append(_follow(search, start))
        if not is_far(posterior, ends[-1].fit):
            break
    evidences = [log_evidence(end.posterior, end.fit) for end in ends]
    first = ends[int(np.argmax(evidences))]
    others = tuple(
        end.fit
        for end, own in zip(ends, evidences, strict=True)
        if own > max(evidences) - search.settings.rival and not has_same_structure(posterior, end.fit, first.fit)
    )
    return replace(first, other_optima=others)


def _may_be_far_off(posterior: Posterior) -> bool:
    """Decide if the structure may be far from its prior, with modes to which the recording's own can be compared."""
    # Persistent effects whose size is fitted change what the modes are compared with, unless they are of the forces.
    is_changed = any(e.parameters and e.family != "excitation" for e in posterior.prior.model.effects)
    return not (plan_of(posterior).knows_input or posterior.prior.is_baseline or is_changed)


def _follow(search: Search, start: MapEstimate) -> Search:
    """Remove the modes of a start that others made superfluous, and add those still missing."""
    posterior, gain = search.posterior, start.log_posterior - search.fit.log_posterior
    costs = (evidence_cost(posterior, start, i) for i in range(len(start.effects)))
    accepted = tuple(Candidate(e, start, gain, gain - cost) for e, cost in zip(start.effects, costs, strict=True))
    posterior = update_linearization(posterior, start)
    posterior, fit, accepted = eliminate_backward(
        posterior, start, accepted, [(c,) for c in accepted], search.settings.margin, search.settings.rival
    )
    rounds = tuple((c,) for c in accepted)
    search = replace(search, posterior=posterior, fit=fit, accepted=accepted, rounds=rounds, tested=fit)
    return _add_missing_modes(search) if accepted else search  # where one mode is missing, others are


def _explained_by_one(search: Search, evidence: float) -> bool:
    """Decide if one other cause explains a recording as well as several modes that the model lacks, of log evidence `evidence`.

    A law that depends on the level distorts the peaks of the model, and modes beside them imitate the distortion.
    """
    wanted = evidence - search.settings.margin
    # A score predicts half of a gain, as a rough fit finds, see `Candidate.may_reach`.
    refitted, candidates, _ = _search_once(search, 0.5 * (wanted - search.fit.log_posterior))
    if not candidates or candidates[0].candidate.effect.repeatable:
        return False
    return refitted.fit.log_posterior + candidates[0].candidate.log_evidence > wanted


def _prefer_mode(search: Search, tied: list[RefittedCandidate]) -> list[RefittedCandidate]:
    """Return the mode, where the model lacks modes already and one more ties with the best causes; else these."""
    modes = [p for p in tied if p.candidate.effect.repeatable]
    if not modes and tied[0].candidate.effect.is_narrow:
        found = find_missing_mode(search.posterior, search.fit, search.settings, search.threshold())
        modes = [RefittedCandidate(c, search.posterior, search.moments) for c in found[:1]]
    return modes[:1] or tied


def _add_missing_modes(search: Search) -> Search:
    """Add modes that the model lacks until the highest peak left has another cause or none."""
    while True:
        found = find_missing_modes(search.posterior, search.fit, search.settings, search.threshold())
        if found:
            *others, last = (at_peak[0] for at_peak in found)
            shown = tuple(tuple(c.without_slopes() for c in at_peak) for at_peak in found)
            search = replace(search, accepted=(*search.accepted, *others), rounds=(*search.rounds, *shown))
            search = _accept(search, RefittedCandidate(last, search.posterior, search.moments))
            continue
        # Coupled while others are missing, modes would take the others' part, and the structure would follow.
        coupled = None
        if find_lack_of_fit(search.posterior, search.fit, search.settings):
            coupled = couple_modes(search.posterior, search.fit)
        if coupled is None:
            return search
        search = search.at(coupled)


def _refit_ground_interpolation(
    search: Search, candidates: list[RefittedCandidate], min_gain: float
) -> tuple[Posterior, MapEstimate] | None:
    """Refit with the interpolation of the ground motion that the best candidates prefer; return None where it is the present one.

    Without the cause another interpolation may have compensated for the cause, and with that interpolation a cause with more
    parameters may look better.
    """
    interpolations = {p.observed.drive.between: p for p in search.posterior.other_interpolations()}
    if not interpolations or not candidates or candidates[0].candidate.log_evidence < min_gain:
        return None
    scored = []
    for p in candidates[:_N_GROUND_TESTS]:
        before = p.candidate.fit
        posterior, fit = fit_ground_interpolation(p.posterior, before)
        evidence = p.candidate.log_evidence + fit.log_posterior - before.log_posterior
        scored.append((evidence, posterior.observed.drive.between))
    posterior = interpolations.get(max(scored, key=lambda pair: pair[0])[1], search.posterior)
    if posterior is search.posterior:
        return None
    found = maximize_posterior(posterior, search.fit.x, search.fit.effects, iterations=FAR)
    return (posterior, found) if found.is_possible else None


def _accept(search: Search, best: RefittedCandidate) -> Search:
    """Accept a cause: refit all parameters beside it, and update the evidence that a further cause needs."""
    accepted, margin = (*search.accepted, best.candidate), search.margin
    as_found = best.posterior, best.candidate.fit, best.moments
    refitted = tried(lambda: _refit_accepted(best, n_accepted=len(accepted)), as_found)
    posterior, fit, added = refitted if refitted[1].is_possible else as_found
    if best.candidate.effect.nonlinear:
        error = search.settings.aftermath * best.candidate.delta_log_posterior
        margin = max(margin, error, search.settings.margin + DIFFERS_STDS * best.log_evidence_std)
    return replace(search, posterior=posterior, fit=fit, accepted=accepted, moments=added, margin=margin)


def _refit_accepted(best: RefittedCandidate, n_accepted: int) -> tuple[Posterior, MapEstimate, Moments]:
    """Refit all parameters beside a cause, the last of `n_accepted`; return the moments that the laws add too."""
    posterior, fit = best.posterior, best.candidate.fit
    posterior, fit = fit_ground_interpolation(_extend_posterior(posterior, fit), fit)
    # The damping has a looser prior now, and the motion and the frequency range of the forces are known.
    fit = maximize_posterior(posterior, fit.x, fit.effects)
    posterior, fit = fit_exact_slopes(posterior, fit)
    posterior, fit = fit_ambient_forces(posterior, fit)
    if n_accepted > 1 and posterior.linearizes(fit.effects):  # the present correction lacks the newest cause
        simulated_fit = fit_by_simulation(posterior, fit)
        return simulated_fit.posterior, simulated_fit.fit, simulated_fit.moments
    return posterior, fit, best.moments


def _accept_beside_tie(search: Search, tied: RefittedCandidate) -> Search | None:
    """Search, while rivals are tied, for a cause that is there whichever rival is the true cause.

    The search given is that before any of the rivals, `tied` the best of them.  Return the search with the further cause; None
    where there is no such cause, or where it is itself tied.
    """
    if search.n_counted + 2 > search.settings.max_causes:
        return None
    extended = _accept(search, tied)
    refitted, candidates, threshold = _search_once(extended)
    candidates = sufficient_candidates(refitted, candidates, threshold)
    if not candidates or len(tied_candidates(candidates, search.settings.rival)) > 1:
        return None
    found = candidates[0].candidate.effect
    if found.nonlinear:  # it must be simulated together with the tied cause
        return None
    further_cause = fit_candidate(search.posterior, search.fit, found)
    accepted = _accept(search, RefittedCandidate(further_cause, search.posterior, search.moments))
    return accepted.among(candidates, again=True)


def _end_in_tie(search: Search, tied: list[RefittedCandidate]) -> Search:
    """End a search with causes that cannot be told apart, at the fit of the most probable one."""
    alternatives = tuple(zip((p.candidate for p in tied), probabilities(tied).tolist(), strict=True))
    best = tied[0]
    return replace(search, posterior=best.posterior, fit=best.candidate.fit, alternatives=alternatives, has_ended=True)


def shows_other_direction(search: Search) -> bool:
    """Decide if no cause so far may stand in for another direction of the forces, and they act in another than at calibration."""
    if not all(is_independent_of_direction(e) for e in search.fit.effects):
        return False
    return find_other_direction(search.posterior, search.fit, search.settings) is not None


def _look_ahead(tied: list[RefittedCandidate], settings: DiagnosisSettings) -> list[RefittedCandidate]:
    """Rank tied candidates with the best second cause beside each, where each leaves lack of fit; return those still tied."""
    if not find_lack_of_fit(tied[0].posterior, tied[0].candidate.fit, settings):
        return tied
    looked_at, evidence = tied[: settings.tried], []
    for p in looked_at:
        second = run_selection_round(
            _extend_posterior(p.posterior, p.candidate.fit), p.candidate.fit, p.moments, settings, settings.worth
        )
        second_gain = second[0].candidate.log_evidence if second else 0.0
        evidence.append(p.candidate.log_evidence + (second_gain if second_gain > settings.margin else 0.0))
    best = int(np.argmax(evidence))
    still_tied = [
        p
        for p, t in zip(looked_at, evidence, strict=True)
        if t > evidence[best] - settings.rival
        or predict_the_same(p.posterior, p.candidate.fit, tied[best].candidate.fit)
    ]
    return sorted(still_tied, key=lambda p: p is not tied[best])


def _extend_posterior(posterior: Posterior, fit: MapEstimate) -> Posterior:
    """Update the posterior once its last cause is accepted.

    The motion follows the new model.  Damping is known for the healthy modes, and less well for modes that have moved: either the
    modes kept their damping ratios, or the structure kept its damping matrix.
    """
    posterior = update_linearization(posterior, fit)
    models = (posterior.model(fit.x, posterior.effects(fit.x, effects)) for effects in (fit.effects[:-1], fit.effects))
    before, after = (model.modes().frequencies_hz for model in models)
    change = np.nan_to_num(np.log(after / before), nan=_NO_FREQUENCY)
    ratios = replace(posterior, prior=posterior.prior.with_looser_damping(change))
    known = posterior.damped_as_built or isinstance(posterior, CorrectedPosterior)
    # A measured input shows the damping of modes that have hardly moved since calibration; a drawing knows of no damping.
    plan = plan_of(posterior)
    known |= plan.knows_input and not posterior.prior.is_baseline
    if known or np.abs(change).max() <= plan.damping_shift:
        return ratios
    matrix = replace(ratios, damped_as_built=True)
    return max(ratios, matrix, key=lambda form: maximize_posterior(form, fit.x, fit.effects).log_posterior)
