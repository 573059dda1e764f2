"""No trial fit ends a search: what leaves the possible has no likelihood."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION
from monitor.core import Array, BadInputError
from monitor.diagnosis.backward_elimination import update_linearization
from monitor.diagnosis.initial_fit import first_guess
from monitor.diagnosis.missing_modes import couple_modes, find_missing_modes
from monitor.diagnosis.score_test import candidate_starts, expected_gains, fit_candidate, fit_with
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.inference import Posterior, classify, gather, make_posterior, maximize_posterior, tried
from monitor.model import Model, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks
from tests.support.frames import shear_frame

RATE = 64.0
N = 3
MEASURED = Path(__file__).parents[1] / "data" / "mini-shake-table"


@pytest.fixture(scope="module")
def measured() -> Array:
    """A measured record of three sensors that were not synchronised, m/s^2."""
    files = (MEASURED / f"flexible-bonus-event-floor{i}.csv" for i in range(1, N + 1))
    columns = [np.loadtxt(file, delimiter=",", skiprows=9, usecols=5) for file in files]
    return np.stack([c[: min(map(len, columns))] for c in columns], axis=1)


def _record(draw: np.random.Generator, model: Model, measured: Array) -> Array:
    """Samples of the frame, of another structure or of none, each channel with a gain of its own."""
    n = int(RATE * draw.uniform(40.0, 60.0))
    match draw.integers(4):
        case 0:
            x = simulate(model, duration_s=n / RATE, rate_hz=RATE, noise=0.05, seed=int(draw.integers(2**31))).floors
        case 1:
            x = np.resize(measured, (n, N))
        case 2:
            x = draw.standard_normal((n, N)).cumsum(axis=0)
        case _:
            x = np.sin(draw.uniform(0.5, 150.0, N) * np.arange(n)[:, None] / RATE) + 1e-3 * draw.standard_normal((n, N))
    return np.asarray(x * np.exp(draw.normal(0.0, draw.choice([0.0, 3.0]), N)))


def _problem(draw: np.random.Generator, measured: Array) -> Posterior:
    """A drawing, near or far from what was recorded, and known well or not at all."""
    drawn = shear_frame([0.33, 0.35, 0.31], [2900.0, 1500.0, 1900.0])
    model = Model(drawn.model().structure)
    processing = drawn.processing.model_copy(update={"rate_hz": RATE, "cutoff_hz": 25.0, "hop_s": 2.0})
    config = drawn.model_copy(
        update={"processing": processing, "refinement": drawn.refinement.model_copy(update={"segment_s": 4.0})}
    )
    blocks = cut_into_blocks(ACCELERATION, _record(draw, model, measured), config.channels, RATE, 10**18, 64)
    off = np.exp(draw.normal(0.0, draw.choice([0.02, 1.0, 4.0]), N))
    far = model.with_stiffness(model.structure.stiffness_n_per_m * off)
    known = prior_from_drawing(far, np.full(2 * N, draw.choice([0.01, 1.0])), N)
    return make_posterior(classify(gather(blocks, config.front_end())), known, config.instrumented().context(RATE))


def _try(draw: np.random.Generator, measured: Array) -> None:
    """Search from a start that may be no structure's at all; a recording in which a channel stands still is refused before."""
    try:
        posterior = _problem(draw, measured)
    except BadInputError as refused:
        assert "does not move" in str(refused)
        return
    x = first_guess(posterior)
    x += draw.normal(0.0, draw.choice([0.0, 1.0, 30.0, 400.0]), x.size)
    fit = maximize_posterior(posterior, x, iterations=4)
    assert fit.is_possible == bool(np.isfinite(fit.log_posterior)) and np.isfinite(fit.covariance).all()
    starts = candidate_starts(posterior, fit)
    expected_gains(posterior, fit, starts)
    chosen = [starts[i] for i in draw.integers(len(starts), size=2)]
    for effect in chosen:
        moved = effect.at(effect.coordinates * np.exp(draw.normal(0.0, 3.0, effect.coordinates.size)))
        candidate = fit_candidate(posterior, fit, moved, quick=True)
        assert np.isfinite(candidate.log_evidence) or not (candidate.fit.is_possible and fit.is_possible)
        update_linearization(posterior, candidate.fit)
        fit_with(posterior, candidate.fit, ())
    if fit.is_possible:
        for modes in find_missing_modes(posterior, fit, DiagnosisSettings(margin=0.1), 0.0):
            assert modes[0].fit.is_possible
            coupled = couple_modes(posterior, modes[0].fit)
            assert coupled is None or coupled.is_possible


@pytest.mark.parametrize("seed", range(2))
def test_no_trial_of_any_structure_recording_or_start_ends_a_search(seed: int, measured: Array) -> None:
    _try(np.random.default_rng(seed), measured)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 600))
def test_no_trial_among_five_hundred_ends_a_search(seed: int, measured: Array) -> None:
    _try(np.random.default_rng(seed), measured)


def test_what_cannot_be_computed_is_impossible_and_a_mistake_is_not_hidden() -> None:
    assert tried(lambda: np.linalg.eigvals(np.full((3, 3), np.nan)), None) is None
    assert tried(lambda: 10.0 ** float("400"), None) is None
    with pytest.raises(ValueError, match="mismatch"):
        tried(lambda: np.ones((2, 3)) @ np.ones((2, 3)), None)


def test_a_fit_whose_start_is_no_structure_has_no_likelihood(measured: Array) -> None:
    posterior = _problem(np.random.default_rng(1), measured)
    x = first_guess(posterior)
    x[posterior.layout.stiffness] = 1e4
    fit = maximize_posterior(posterior, x)
    assert not fit.is_possible and posterior.score(x, ())[0] == -np.inf
    assert expected_gains(posterior, fit, candidate_starts(posterior, fit)) == []
    assert fit_with(posterior, replace(fit, effects=()), ()).is_possible, "from the prior's structure"
