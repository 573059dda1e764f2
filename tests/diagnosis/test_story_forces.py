"""The law of every story straight from the data, where the input is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monitor.diagnosis.simulation_refit import fit_initial_model
from monitor.diagnosis.story_forces import StoryLaw, story_laws
from monitor.inference import MapEstimate, Posterior, Segments, classify, gather
from monitor.model import Effect, parse_effect, prior_from_drawing
from tests.model.pushed_frame import FORCED, pushed

pytestmark = pytest.mark.engine


@cache
def linear(ground: bool) -> tuple[StoryLaw, ...]:
    return laws(*linear_fit(ground))


@cache
def linear_fit(ground: bool) -> tuple[Posterior, MapEstimate]:
    return fitted(gather(pushed(seed=8, ground=ground), FORCED.front_end()))


def fitted(segments: Segments) -> tuple[Posterior, MapEstimate]:
    """A model that was fitted without any cause."""
    known = prior_from_drawing(FORCED.model(), np.full(6, 0.1), 3)
    return fit_initial_model(classify(segments), known, FORCED.instrumented().context(segments.rate_hz))[:2]


def laws(posterior: Posterior, fit: MapEstimate, *causes: Effect) -> tuple[StoryLaw, ...]:
    diagnosis: Any = SimpleNamespace(posterior=posterior, final_fit=replace(fit, effects=causes), null_fit=fit)
    return story_laws(diagnosis)


@pytest.mark.parametrize("ground", [False, True])
def test_a_linear_frame_has_the_stiffness_of_its_model_at_every_level(ground: bool) -> None:
    for law, k in zip(linear(ground), (2900.0, 1500.0, 1900.0), strict=True):
        assert "changes with the level as the model does, to within" in law.says
        np.testing.assert_allclose(law.stiffness_n_per_m, k, rtol=0.03)
        np.testing.assert_allclose(law.stiffness_n_per_m, law.model_stiffness_n_per_m, rtol=0.02)
        assert law.drift_m[1] > law.drift_m[0] > 0.0 and (law.stiffness_std > 0.0).all()


def test_what_a_sensor_does_is_taken_out_of_forces_and_drifts() -> None:
    found = laws(*linear_fit(False), parse_effect("sensor_gain:channel a2:gain=2"))
    for law, plain in zip(found, linear(ground=False), strict=True):
        np.testing.assert_allclose(law.model_stiffness_n_per_m, plain.model_stiffness_n_per_m, rtol=0.02)
        assert not np.allclose(law.stiffness_n_per_m, plain.stiffness_n_per_m, rtol=0.05), (
            "the channel has no such gain"
        )


def test_the_loop_has_the_story_s_force_and_drift() -> None:
    law = linear(ground=False)[1]
    for loop in (law.measured, law.before, law.after):
        k = float(loop.force_n @ loop.drift_m / (loop.drift_m @ loop.drift_m))
        assert k == pytest.approx(1500.0, rel=0.03)
    rms = float(np.sqrt(np.mean(law.measured.drift_m**2)))
    assert law.drift_m[0] < rms < 2.0 * law.drift_m[1]
    np.testing.assert_allclose(law.measured.force_n, law.after.force_n, atol=0.2 * np.abs(law.after.force_n).max())


@pytest.mark.parametrize(
    ("effect", "story", "words"),
    [
        ("cubic_stiffness:story 2:k3_n_per_m3=4e6", 2, "hardens by"),
        ("hysteretic_slip:story 3:force_n=2,relative=0.25", 3, "softens by"),
    ],
)
def test_the_law_that_is_missing_is_seen_in_its_story_alone(effect: str, story: int, words: str) -> None:
    found = laws(*fitted(gather(pushed(effect, seed=9), FORCED.front_end())))
    assert [law.story for law in found if words in law.says] == [story], [law.says for law in found]


def test_without_a_known_input_or_with_a_floor_without_a_sensor_nothing_is_said() -> None:
    unnamed = FORCED.model_copy(update={"inputs": ()})
    segments = gather(pushed(seed=8), unnamed.front_end())
    assert not segments.drive.inputs and laws(*fitted(segments)) == ()
