"""A first fit from the recording's own modes: drawings that are far off, and modes that no model in a plane has."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monitor.diagnosis import initial_fit, stepwise_selection
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.lack_of_fit import find_lack_of_fit
from monitor.diagnosis.missing_modes import couple_modes
from monitor.diagnosis.modal_start import find_modal_starts, fit_from_modes, identify_modes
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.stepwise_selection import Search
from monitor.inference import normal_moments, tone_log_odds
from monitor.model import parse_effect
from tests.support.turning_frame import CONTEXT, TORSION, TRUTH, diagnosed, drawn, posterior, spectra

OFF = np.array([1.3, 0.75, 1.25])
"""What the drawing says of the stiffnesses, over the truth."""


def relative_stiffness(x: np.ndarray) -> np.ndarray:
    """Fitted stiffnesses over the true ones, the common scale of the masses, which no output shows, taken out."""
    return np.exp(x[:3] - (x[3:6] - np.log(TRUTH.structure.masses_kg)).mean()) / TRUTH.structure.stiffness_n_per_m


def test_averaged_spectra_show_every_mode_with_its_damping() -> None:
    found = identify_modes(spectra(*TORSION), TRUTH.modes(), CONTEXT.sensors)
    true = np.sort(np.r_[TRUTH.modes().frequencies_hz, 7.4, 17.5])
    assert [m.frequency_hz for m in found] == pytest.approx(true, rel=0.01)
    assert all(0.003 < m.damping_ratio < 0.03 for m in found)


def test_a_drawing_that_is_30_percent_off_leads_to_the_true_stiffnesses() -> None:
    starts = find_modal_starts(posterior(OFF))
    assert relative_stiffness(starts[0].structure) == pytest.approx(np.ones(3), abs=0.05)
    assert not starts[0].missing


def test_modes_that_the_model_lacks_are_no_modes_of_the_model() -> None:
    start = find_modal_starts(posterior(OFF, *TORSION))[0]
    assert relative_stiffness(start.structure) == pytest.approx(np.ones(3), abs=0.05)
    assert [e.values()["frequency_hz"] for e in start.missing] == pytest.approx([7.4, 17.5], rel=0.01)


def test_the_spectra_are_fitted_from_there() -> None:
    fit, evidence = fit_from_modes(posterior(OFF, *TORSION))[0]
    assert relative_stiffness(fit.x) == pytest.approx(np.ones(3), abs=0.01)
    assert evidence < fit.log_posterior
    shape = np.array([fit.effects[0].values()[f"shape_{i}"] for i in (1, 2, 3)])
    assert shape / shape[0] == pytest.approx(np.array([1.0, 0.8, 0.45]), abs=0.06)


@pytest.mark.engine
def test_modes_that_the_model_lacks_are_named_as_such_and_are_not_coupled_where_nothing_is() -> None:
    found = diagnosed(OFF, *TORSION)
    assert found.verdict == "named"
    assert [c.effect.name for c in found.causes] == ["unmodelled_mode"] * 2
    for cause, true in zip(found.causes, TORSION, strict=True):
        value, std = (d["frequency_hz"] for d in (cause.effect.values(), cause.std))
        assert abs(value - true.values()["frequency_hz"]) < 3.0 * std
    assert couple_modes(found.posterior, found.final_fit) is None


@pytest.mark.engine
def test_a_machine_is_no_mode_and_a_mode_no_machine() -> None:
    machine = parse_effect("harmonic_excitation:floor 2:frequency_hz=17.5,force_n=0.6")
    found = diagnosed(np.ones(3), machine)
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [("harmonic_excitation", "floor 2")]
    (line,) = found.final_fit.effects[0].lines()
    assert tone_log_odds(found.posterior, found.final_fit, line) > 10.0
    quiet = diagnosed(np.ones(3), TORSION[1])
    assert [c.effect.name for c in quiet.causes] == ["unmodelled_mode"]


def test_of_two_starts_the_better_fit_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A baseline is fitted from the file, and from where the search ended."""
    better = fit_linearized(spectra(), drawn(OFF), CONTEXT)[1]
    monkeypatch.setattr(initial_fit, "FAR", 0)  # a fit stays where it starts
    worse = fit_linearized(spectra(), drawn(OFF), CONTEXT)[1]
    assert worse.log_posterior < better.log_posterior - 1000.0
    for start in (better.x, worse.x - 0.1):
        found = fit_linearized(spectra(), drawn(OFF), CONTEXT, start)[1]
        assert found.x == pytest.approx(better.x if start is better.x else worse.x)


@pytest.mark.engine
def test_a_drawing_that_is_far_off_is_no_cause() -> None:
    found = diagnosed(OFF)
    assert found.verdict == "none" and not found.causes
    assert not find_lack_of_fit(found.posterior, found.final_fit, found.settings)
    assert relative_stiffness(found.final_fit.x) == pytest.approx(np.ones(3), abs=0.01)
    observed = found.posterior.observed
    assert fit_linearized(observed, drawn(np.ones(3)), CONTEXT)[1].log_likelihood == pytest.approx(
        found.final_fit.log_likelihood, abs=3.0
    )


@pytest.mark.engine
def test_modes_that_all_lie_beside_modes_of_the_model_are_carried_without_being_stated() -> None:
    """So are those of a symmetrical building that turns and sways at nearly the same frequencies."""
    beside = tuple(
        parse_effect(
            f"unmodelled_mode:frame:frequency_hz={1.02 * f},damping_ratio=0.012,shape_1={a},shape_2={b},shape_3={c}"
        )
        for f, (a, b, c) in zip(TRUTH.modes().frequencies_hz[:2], ((1.0, -0.9, 0.5), (0.9, 0.6, -1.0)), strict=True)
    )
    found = diagnosed(np.ones(3), *beside)
    assert found.verdict == "none" and not found.causes
    assert [c.effect.name for c in found.also_fitted] == ["unmodelled_mode"] * 2
    assert not find_lack_of_fit(found.posterior, found.final_fit, found.settings)
    assert relative_stiffness(found.final_fit.x) == pytest.approx(np.ones(3), abs=0.02)


@pytest.mark.parametrize(
    ("lead", "moved", "n_others"), [(-9.0, 0.1, 0), (9.0, 0.1, 0), (-1.0, 0.1, 1), (1.0, 0.1, 1), (1.0, 0.01, 0)]
)
def test_of_two_ways_to_couple_modes_the_evidence_decides(
    monkeypatch: pytest.MonkeyPatch, lead: float, moved: float, n_others: int
) -> None:
    """Coupled at once, modes may lead the structure astray; coupled at last, a mode that only the floors drive is not seen."""
    assert found_of_two_ways(monkeypatch, lead, moved, near=False) == (lead > 0.0, n_others)


def test_the_way_that_ends_near_the_prior_is_followed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert found_of_two_ways(monkeypatch, -1.0, 0.01, near=True) == (True, 0)


def found_of_two_ways(monkeypatch: pytest.MonkeyPatch, lead: float, moved: float, *, near: bool) -> tuple[bool, int]:
    """Whether the search goes on from coupled modes, whose evidence leads, and how many ends it lists besides."""
    at = posterior(OFF, *TORSION)
    end = np.zeros(at.layout.n_nuisance)
    if near:
        end[: at.prior.mean.size] = at.prior.mean
    apart, coupled = (SimpleNamespace(effects=TORSION, log_posterior=1e9, x=end.copy()) for _ in range(2))
    coupled.x[1] += moved
    before: Any = SimpleNamespace(log_posterior=0.0)
    search = Search(DiagnosisSettings(), at, before, before, normal_moments(at), 7.0)
    faked = {
        "find_lack_of_fit": lambda *_: ["something"],
        "fit_from_modes": lambda _: ((apart, 1e9),),
        "_explained_by_one": lambda *_: False,
        "couple_modes": lambda *_: coupled,
        "_follow": lambda search, start: replace(search, fit=start, rounds=((start,),)),
        "log_evidence": lambda _, fit: lead if fit is coupled else 0.0,
    }
    for name, function in faked.items():
        monkeypatch.setattr(stepwise_selection, name, function)
    found = stepwise_selection.start_from_modes(search)
    other = apart if found.fit is coupled else coupled
    assert found.rounds == ((found.fit,),)
    assert all(one is other for one in found.other_optima), "another structure that explains as much"
    return found.fit is coupled, len(found.other_optima)
