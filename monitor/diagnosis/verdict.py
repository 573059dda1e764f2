"""Verdict on a recording: which of the causes that a search ended with are stated, what they leave over, and what that means."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, Self

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.backbone import find_level_dependence, find_ratio_change
from monitor.diagnosis.backward_elimination import fit_subset
from monitor.diagnosis.channel_at_fault import find_channel_at_fault
from monitor.diagnosis.constancy import LinearFit
from monitor.diagnosis.lack_of_fit import (
    LackOfFit,
    find_changed_effects,
    find_lack_of_fit,
    find_other_direction,
    has_coupled_modes,
    knows_direction,
    unexplained_share,
    wrong_bins,
)
from monitor.diagnosis.missing_modes import as_seen, is_credible, is_stated
from monitor.diagnosis.parameter_uncertainty import coordinate_std, is_significant, sizes
from monitor.diagnosis.plan import plan_of
from monitor.diagnosis.score_test import Candidate, candidate_starts, evidence_cost, fit_with, key_of
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import fit_persistent_effects, refine_fit
from monitor.inference import MapEstimate, Posterior, maximize_posterior, tried
from monitor.model import Effect

Verdict = Literal["none", "named", "ambiguous", "unexplained"]
Doubt = Literal["", "no news", "not constant", "contradicted"]
"""Of a fitted effect: it cannot be told from modes that were missing at calibration, ranges of frequency or of level, or other
channels, disagree on its size, or a sensor that entered no fit sees that it is not so."""
Alternatives = tuple[tuple[Candidate, float], ...]
"""Candidates that cannot be told apart, with their probabilities."""


@dataclass(frozen=True, eq=False, slots=True)
class Cause:
    """Effect with the standard deviations of its parameters."""

    effect: Effect
    std: dict[str, float]
    doubt: Doubt = ""
    """Why the effect is fitted and not stated; empty where it is stated."""

    @classmethod
    def of(cls, effect: Effect, deviation: Annotated[Array, "p"], doubt: Doubt = "") -> Self:
        """Make a cause of an effect and the standard deviations of its coordinates."""
        values, own = effect.values(), zip(effect.parameters, deviation.tolist(), strict=True)
        return cls(effect, {p.name: min(std * p.slope(values[p.name]), 1e300) for p, std in own}, doubt)


@dataclass(frozen=True, eq=False, slots=True)
class FittedCauses:
    """Fit with the accepted causes, followed by the most probable alternative where the answer is ambiguous."""

    posterior: Posterior
    fit: MapEstimate
    n_accepted: int
    simulation_std: Annotated[Array, "p"]
    """Standard deviations of the effects' sizes by the simulations' random error."""

    def keep(self, kept: Sequence[bool]) -> Self:
        """Refit with the selected effects only."""
        if all(kept):
            return self
        fit, simulation_std = fit_subset(self.posterior, self.fit, self.simulation_std, kept)
        posterior = self.posterior
        if has_nonlinear(self.fit) and not has_nonlinear(fit):
            posterior, fit, _ = fit_persistent_effects(posterior, fit)
        return replace(
            self, posterior=posterior, fit=fit, n_accepted=sum(kept[: self.n_accepted]), simulation_std=simulation_std
        )


@dataclass(frozen=True, eq=False, slots=True)
class Diagnosis:
    """Result of a diagnosis, with everything that it was judged by."""

    verdict: Verdict
    causes: tuple[Cause, ...]
    alternatives: Alternatives
    misfit: tuple[LackOfFit, ...]
    """Lack of fit of the model without causes."""
    left_over: tuple[LackOfFit, ...]
    """Lack of fit that remains with the causes."""
    candidates: tuple[Candidate, ...]
    """Candidates of the first round."""
    posterior: Posterior
    null_fit: MapEstimate
    """The old model form, refitted."""
    final_fit: MapEstimate
    """Fit with the causes (with the most probable alternative where the answer is ambiguous)."""
    settings: DiagnosisSettings
    rounds: tuple[tuple[Candidate, ...], ...] = field(default=())
    """Candidates of every round of the search."""
    other_optima: tuple[MapEstimate, ...] = field(default=())
    """Fits of other stiffnesses that explain the recording as well."""
    also_fitted: tuple[Cause, ...] = field(default=())
    """Effects of the final fit that are not stated, each with the doubt."""
    simulation_std: Array = field(default_factory=lambda: np.zeros(0))
    """As `FittedCauses.simulation_std`, of the final fit's effects."""

    def without_causes(self, left_over: tuple[LackOfFit, ...]) -> Diagnosis:
        """Withdraw all causes, which leaves the model without them and what it leaves over."""
        withdrawn = replace(self, causes=(), also_fitted=(), alternatives=())
        return replace(withdrawn, left_over=left_over, final_fit=self.null_fit)

    def contradicted(self, names: Collection[str]) -> Diagnosis:
        """Take the causes of these names, which a sensor that entered no fit contradicts, out of what is stated."""
        against = tuple(replace(c, doubt="contradicted") for c in self.causes if c.effect.name in names)
        if not against:
            return self
        causes = tuple(c for c in self.causes if c.effect.name not in names)
        verdict = "unexplained" if self.verdict == "named" else self.verdict
        return replace(self, verdict=verdict, causes=causes, also_fitted=(*self.also_fitted, *against))

    def without_last_cause(self) -> Diagnosis:
        """Withdraw the cause that was found last, or the alternatives of an ambiguous answer, and judge the others anew."""
        found = FittedCauses(
            self.posterior, self.final_fit, len(self.causes) + len(self.also_fitted), self.simulation_std
        )
        n_kept = found.n_accepted - (not self.alternatives)
        found = found.keep([i < n_kept for i in range(len(self.final_fit.effects))])
        judged = judge(found, self.null_fit, (), self.settings)
        return replace(judged, candidates=self.candidates, rounds=self.rounds, other_optima=self.other_optima)


def judge(
    found: FittedCauses,
    null_fit: MapEstimate,
    alternatives: Alternatives,
    settings: DiagnosisSettings,
    *,
    from_elsewhere: bool = False,
) -> Diagnosis:
    """Judge the causes that a search ended with: which are stated, and what they leave over.

    The first of the alternatives, candidates of the last round that cannot be told apart, is in the fit.  Where the search ended
    because the forces act in another direction than at calibration, they come `from_elsewhere`.
    """
    # Beside other causes an effect may have moved to a size that means another one.
    band_hz = found.posterior.observed.band.hz
    plausible = [
        i >= found.n_accepted or e.nonlinear or (e.is_plausible(band_hz) and is_credible(found.posterior, found.fit, i))
        for i, e in enumerate(found.fit.effects)
    ]
    found = found.keep(plausible)
    misfit = find_lack_of_fit(found.posterior, null_fit, settings)
    sought = {key_of(effect) for effect in candidate_starts(found.posterior, null_fit)}
    chance = settings.false_rate / max(1, len(sought))

    def reach_verdict(found: FittedCauses) -> tuple[Verdict, tuple[LackOfFit, ...], tuple[Cause, ...]]:
        left_over, effects = _left_over(found, settings), describe_effects(found, chance)
        share = unexplained_share(found.posterior, found.fit, null_fit, misfit, left_over)
        stated = [cause.effect for cause in effects[: found.n_accepted] if not cause.doubt]
        ambiguous = len(effects) > found.n_accepted
        return _verdict(share, left_over, stated, ambiguous, settings), left_over, effects

    verdict, left_over, effects = reach_verdict(found)
    described = found
    constant = [cause.doubt != "not constant" for cause in effects]
    if not all(constant):  # what ranges disagree on is dropped where other causes explain the recording alone
        rest = found.keep(constant)
        of_rest = reach_verdict(rest)
        # That nothing is there is not said of a recording which an effect explains better.
        if of_rest[0] in ("named", "ambiguous") and all(cause.doubt != "not constant" for cause in of_rest[2]):
            found = described = rest
            verdict, left_over, effects = of_rest
        else:
            verdict = "unexplained"
    if len(found.fit.effects) == found.n_accepted:
        alternatives = ()
    if verdict == "unexplained":
        found = _keep_confirmed_elsewhere(found, settings)
        left_over = _left_over(found, settings)
    direction = find_direction_beside_causes(found, settings) if verdict != "none" or from_elsewhere else None
    if direction is not None:
        found, verdict, alternatives = found.keep([False] * len(found.fit.effects)), "unexplained", ()
        left_over = (direction, *find_lack_of_fit(found.posterior, found.fit, settings))
    channel = _find_channel(found, left_over, settings) if direction is None and verdict == "unexplained" else None
    if channel is not None:
        found = found.keep([i < found.n_accepted for i in range(len(found.fit.effects))])
        alternatives, left_over = (), (channel,)
    # A response shows more than the misfit in bands: the frequency ratios and their dependence on the level.
    posterior, fit = found.posterior, found.fit
    findings = (find_ratio_change(posterior, fit), find_level_dependence(posterior, null_fit))
    still = find_level_dependence(posterior, fit)
    accepted = (effects if found is described else describe_effects(found, chance))[: found.n_accepted]
    if channel is not None:  # they may stand in for what it measures
        accepted = tuple(replace(cause, doubt=cause.doubt or "not constant") for cause in accepted)
    return Diagnosis(
        verdict=verdict,
        causes=tuple(cause for cause in accepted if not cause.doubt),
        also_fitted=tuple(cause for cause in accepted if cause.doubt),
        alternatives=alternatives,
        misfit=(*[m for m in findings if m is not None], *misfit),
        left_over=left_over if still is None else (*left_over, still),
        candidates=(),
        posterior=posterior,
        null_fit=null_fit,
        final_fit=fit,
        settings=settings,
        simulation_std=found.simulation_std,
    )


def _find_channel(found: FittedCauses, left_over: Sequence[LackOfFit], settings: DiagnosisSettings) -> LackOfFit | None:
    """Find the channel without which no cause is needed, unless causes at other places leave nothing over."""
    without = found.keep([False] * len(found.fit.effects))
    channel = find_channel_at_fault(without.posterior, without.fit, settings)
    stands_in = channel is None or left_over or all(e.location == channel.where for e in found.fit.effects)
    return channel if stands_in else None


def _left_over(found: FittedCauses, settings: DiagnosisSettings) -> tuple[LackOfFit, ...]:
    at = found.posterior, found.fit, settings
    return (*find_changed_effects(*at), *find_lack_of_fit(*at))


def refine(posterior: Posterior, fit: MapEstimate, n_accepted: int) -> FittedCauses:
    """Refit with laws simulated as finely as a published result needs, without causes that are no longer significant.

    The fit has the accepted causes, then the most probable alternative where the answer is ambiguous.
    """
    refined = tried(lambda: refine_fit(posterior, fit), None) if posterior.linearizes(fit.effects) else None
    if refined is None or not refined[1].is_possible:
        return FittedCauses(posterior, fit, n_accepted, np.zeros(fit.n_effect))
    near, fit = refined
    # With a better size of the law another cause may be no longer significant.
    fit_std = np.sqrt(np.maximum(np.diag(fit.covariance)[near.layout.effects], 0.0))
    kept = [
        is_significant(e, std)
        for e, std in zip(fit.effects, coordinate_std(near, fit, fit_std, near.simulation_std), strict=True)
    ]
    found = FittedCauses(near, fit, n_accepted, near.simulation_std)
    return found.keep(kept) if any(kept) else found


def _keep_confirmed_elsewhere(found: FittedCauses, settings: DiagnosisSettings) -> FittedCauses:
    """Keep only causes that bands without lack of fit confirm too: in others a search finds tones and laws that do not exist."""
    posterior, fit = found.posterior, found.fit
    wrong = wrong_bins(posterior, fit, settings)
    if not found.n_accepted or not wrong.any() or plan_of(posterior).knows_input:
        return found
    elsewhere = replace(posterior, left_out=wrong)
    whole = maximize_posterior(elsewhere, fit.x, fit.effects)

    def is_confirmed(i: int) -> bool:
        if i >= found.n_accepted:
            return True
        without = fit_with(elsewhere, whole, (*fit.effects[:i], *fit.effects[i + 1 :]))
        gain = whole.log_posterior - without.log_posterior
        return gain - evidence_cost(elsewhere, whole, i) > settings.margin

    return found.keep(parallel_map(is_confirmed, range(len(fit.effects))))


def find_direction_beside_causes(found: FittedCauses, settings: DiagnosisSettings) -> LackOfFit | None:
    """Find that the forces act in another direction than at calibration, by the fit with the sensors' faults and machines alone.

    Other causes may stand in for the direction; an exchanged channel or a machine changes the forces that are fitted without it.
    Where the causes have forced an effect away from what it was at calibration, as a coupled mode, they are not believed either.
    """
    if not knows_direction(found.posterior):
        return None
    if has_coupled_modes(found.posterior) and (changed := find_changed_effects(found.posterior, found.fit, settings)):
        says = f"{changed[0].says}; nothing can be said of the structure beside it"
        return replace(changed[0], says=says, is_explained=True, hides_structure=True)
    found = found.keep([is_independent_of_direction(e) for e in found.fit.effects])
    return find_other_direction(found.posterior, found.fit, settings)


def is_independent_of_direction(effect: Effect) -> bool:
    """Decide if an effect cannot stand in for another direction of the forces: a fault of a sensor, or a machine's line."""
    return effect.family == "sensor" or bool(effect.lines())


def _verdict(
    share: float, left_over: Sequence[LackOfFit], stated: Sequence[Effect], ambiguous: bool, settings: DiagnosisSettings
) -> Verdict:
    """Choose the verdict from the share of lack of fit that is left over, the stated causes and their ambiguity."""
    # The exact form of a nonlinear law far from rest is not known; the small misfit that this leaves is no cause of its own.
    nonlinear = any(effect.nonlinear for effect in stated)
    if left_over and not (nonlinear and share < settings.remainder):
        return "unexplained"
    if ambiguous:
        return "ambiguous"
    return "named" if stated else "none"


def has_nonlinear(fit: MapEstimate) -> bool:
    """Decide if a fit has a nonlinear effect."""
    return any(e.nonlinear for e in fit.effects)


def describe_effects(found: FittedCauses, chance: float) -> tuple[Cause, ...]:
    """Describe all fitted effects with the standard deviations of their parameters, and say why one is not to be stated.

    An effect needs a size on which ranges of frequency and of level agree, and the other channels without each one, or which is
    certain where they do not: by chance they disagree with the probability `chance`, and it is none with the same.
    """
    posterior, fit = found.posterior, found.fit
    if not fit.effects:
        return ()
    linear, these = LinearFit.of(posterior, fit), range(fit.x.size)[posterior.layout.effects]
    common = {j: linear.common_sizes(j) for j in these}
    fit_std = np.array([max(one.std for one in common[j]) for j in these])
    causes = []
    for i, std in enumerate(coordinate_std(posterior, fit, fit_std, found.simulation_std)):
        own = zip(range(fit.x.size)[fit.coordinates_of(i)], sizes(fit.effects[i]), strict=True)
        doubtful = [any(one.is_doubtful(size, chance) for one in common[j]) for j, size in own if size is not None]
        wrong = bool(doubtful) and all(doubtful)
        doubt: Doubt = "no news" if not is_stated(posterior, fit, i) else "not constant" if wrong else ""
        causes.append(Cause.of(*as_seen(posterior, fit, i, std), doubt))
    return tuple(causes)
