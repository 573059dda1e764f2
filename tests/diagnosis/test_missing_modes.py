"""Modes that the model lacks: those beyond doubt are found together, each beside its rivals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monitor.diagnosis.detectable_loss import detectable_losses
from monitor.diagnosis.initial_fit import FAR, first_guess
from monitor.diagnosis.missing_modes import cost_of_weak_modes, find_missing_modes, is_beyond_weak_modes
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import fit_initial_model
from monitor.diagnosis.stepwise_selection import Search, prefer_cause_to_coupling, sufficient_candidates
from monitor.inference import join_coordinates, maximize_posterior
from monitor.model import Effect, StructuralPrior, parse_effect
from tests.support.turning_frame import CONTEXT, TORSION, posterior

pytestmark = pytest.mark.engine

MACHINE = parse_effect("harmonic_excitation:floor 2:frequency_hz=17.5,force_n=0.6")
THIRD = parse_effect("unmodelled_mode:frame:frequency_hz=11.9,damping_ratio=0.012,shape_1=0.7,shape_2=0.9,shape_3=-0.6")


def found_beside(known: Effect, *others: Effect, threshold: float = 10.0) -> tuple[list[float], list[int]]:
    """Frequencies of the modes that are found beside a known one, and how many effects the fit of each has."""
    at = posterior(np.ones(3), known, *others)
    fit = maximize_posterior(at, first_guess(at), (known,), iterations=FAR)
    found = find_missing_modes(at, fit, DiagnosisSettings(), threshold)
    modes = [at_peak[0] for at_peak in found]
    assert all(c.effect.name == "unmodelled_mode" for c in modes)
    return [c.effect.values()["frequency_hz"] for c in modes], [len(c.fit.effects) for c in modes]


def test_modes_beyond_doubt_are_found_together() -> None:
    hz, together = found_beside(TORSION[0], TORSION[1], THIRD)
    assert sorted(hz) == pytest.approx([11.9, 17.5], rel=0.01)
    assert together == [3, 3]


def test_a_machine_is_not_taken_for_a_mode() -> None:
    assert found_beside(TORSION[0], MACHINE) == ([], [])


def test_a_mode_that_explains_too_little_is_left_out() -> None:
    assert found_beside(TORSION[0], TORSION[1], threshold=1e6) == ([], [])


def test_beside_missing_modes_another_cause_needs_what_a_weak_mode_may_leave() -> None:
    at = posterior(np.ones(3), TORSION[0])
    with_mode, without = (
        maximize_posterior(at, first_guess(at), effects, iterations=1) for effects in (TORSION[:1], ())
    )
    loss = parse_effect("stiffness_change:story 2:relative=-0.05")
    needed = cost_of_weak_modes(at, with_mode, loss)
    assert needed > DiagnosisSettings().margin, "the cost of a frequency, a damping ratio and three components"
    assert cost_of_weak_modes(at, with_mode, THIRD) == cost_of_weak_modes(at, without, loss) == 0.0

    def of(effect: Effect, log_evidence: float) -> Any:
        return SimpleNamespace(candidate=SimpleNamespace(effect=effect, log_evidence=log_evidence))

    candidates = [of(loss, 10.0 + needed - 0.1), of(THIRD, 10.1), of(THIRD, 9.9)]
    stage: Any = SimpleNamespace(posterior=at, fit=with_mode)
    assert sufficient_candidates(stage, candidates, 10.0) == candidates[1:2]
    stage.fit = without
    assert sufficient_candidates(stage, candidates, 10.0) == candidates[:2]


@pytest.mark.parametrize(("lost", "is_baseline"), [(0.05, True), (0.05, False), (0.0, True)])
def test_beside_a_baseline_a_cause_must_have_its_evidence_beside_a_further_mode(
    monkeypatch: pytest.MonkeyPatch, lost: float, is_baseline: bool
) -> None:
    loss = parse_effect("stiffness_change:story 2:relative=-0.05")
    at = posterior(np.ones(3), TORSION[0], *([loss] if lost else []))
    at = replace(at, prior=replace(at.prior, precision=1e4 * at.prior.precision))  # as calibration knows the structure
    monkeypatch.setattr(StructuralPrior, "is_baseline", is_baseline)
    fit = maximize_posterior(at, first_guess(at), TORSION[:1], iterations=FAR)
    beyond = 10.0 + cost_of_weak_modes(at, fit, loss)
    assert is_beyond_weak_modes(at, fit, loss, beyond - 0.1, 10.0) is bool(lost and is_baseline)
    assert is_beyond_weak_modes(at, fit, loss, beyond, 10.0) and not is_beyond_weak_modes(at, fit, loss, 9.9, 10.0)


def test_beside_missing_modes_only_a_larger_loss_would_have_been_found(monkeypatch: pytest.MonkeyPatch) -> None:
    at, margin = posterior(np.ones(3), TORSION[0]), DiagnosisSettings().margin
    at = replace(at, prior=replace(at.prior, precision=1e4 * at.prior.precision))  # as calibration knows the structure
    fit = maximize_posterior(at, first_guess(at), TORSION[:1], iterations=FAR)
    beside = detectable_losses(at, fit, margin)
    monkeypatch.setattr("monitor.diagnosis.detectable_loss.cost_of_weak_modes", lambda *_: 0.0)
    alone = detectable_losses(at, fit, margin)
    assert all(a is not None and b is not None and 0.0 < a < b < 0.2 for a, b in zip(alone, beside, strict=True))


@pytest.mark.parametrize(("lost", "is_baseline"), [(0.08, True), (0.08, False), (0.0, True)])
def test_a_loss_is_preferred_to_couplings_that_explain_less(
    monkeypatch: pytest.MonkeyPatch, lost: float, is_baseline: bool
) -> None:
    """Modes that calibration did not see moved the frame's frequencies by their couplings, and no loss was left."""
    loss = parse_effect(f"stiffness_change:story 2:relative={-lost}")
    at, settings = posterior(np.ones(3), TORSION[0], *([loss] if lost else [])), DiagnosisSettings()
    known = replace(at.prior, precision=1e4 * at.prior.precision)  # as calibration knows the structure
    monkeypatch.setattr(StructuralPrior, "is_baseline", is_baseline)
    at, null_fit, moments = fit_initial_model(at.observed, known, CONTEXT)
    coupled = TORSION[0].coupled(CONTEXT)
    assert coupled is not None
    x = join_coordinates(null_fit.x, (coupled,))
    fit = maximize_posterior(at, x, (coupled,), iterations=FAR)
    search = Search(settings, at, fit, null_fit, moments, settings.margin)
    apart, causes = prefer_cause_to_coupling(search)
    if not (lost and is_baseline):
        assert apart is search and not causes
        return
    best = causes[0].candidate
    assert (best.effect.name, best.effect.location) == ("stiffness_change", "story 2")
    assert best.effect.values()["relative"] == pytest.approx(-lost, abs=0.01)
    (mode,) = apart.fit.effects
    assert mode.coupled(CONTEXT) is not None and mode.values()["frequency_hz"] == pytest.approx(7.4, rel=0.01)
