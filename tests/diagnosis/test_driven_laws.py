"""Laws that soften, under a measured force: found, sized, and told from what resembles them."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.diagnosis.score_test import best_first, fit_candidate, start_beside
from monitor.diagnosis.simulation_refit import fit_initial_model
from monitor.inference import classify, gather
from monitor.model import parse_effect, prior_from_drawing
from monitor.runs import diagnose
from tests.model.pushed_frame import FORCED, pushed

pytestmark = pytest.mark.engine
PLACES = [("frame", 0.6, 0.06), ("story 3", 1.0, 0.12)]


@pytest.mark.parametrize(("place", "force_n", "relative"), PLACES)
def test_slip_fits_best_at_its_place_with_its_size(place: str, force_n: float, relative: float) -> None:
    hidden = f"hysteretic_slip:{place}:force_n={force_n},relative={relative}"
    segments = gather(pushed(hidden, seed=21, duration_s=60.0), FORCED.front_end())
    context = FORCED.instrumented().context(segments.rate_hz)
    known = prior_from_drawing(FORCED.model(), np.full(6, 0.1), 3)
    posterior, null, _ = fit_initial_model(classify(segments), known, context)
    tried = [f"hysteretic_slip:{at}:force_n=1,relative=0.1" for at in ("frame", "story 1", "story 3")]
    tried += ["cubic_stiffness:story 3:k3_n_per_m3=-1e6", "stiffness_change:story 3:relative=-0.05"]
    best, second, *_ = best_first([fit_candidate(posterior, null, parse_effect(effect)) for effect in tried])
    assert best.key == ("hysteretic_slip", place)
    assert best.log_evidence > second.log_evidence + 100.0
    assert best.effect.values()["relative"] == pytest.approx(relative, rel=0.15)
    assert best.effect.values()["force_n"] == pytest.approx(force_n, rel=0.25)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("place", "force_n", "relative"), PLACES)
def test_slip_is_named_at_its_place_with_its_size(place: str, force_n: float, relative: float) -> None:
    hidden = f"hysteretic_slip:{place}:force_n={force_n},relative={relative}"
    segments = gather(pushed(hidden, seed=21), FORCED.front_end())
    known = prior_from_drawing(FORCED.model(), np.full(6, 0.1), 3)
    found, gain = diagnose.diagnose_segments(segments, known, FORCED)
    # The channels' noise differs, as their motion does, which a drawing does not know.
    (cause,) = (c for c in found.causes if c.effect.name != "sensor_noise")
    assert (cause.effect.name, cause.effect.location) == ("hysteretic_slip", place), found.causes
    assert found.verdict == "named" and gain.is_significant and gain.csd_error_after < gain.csd_error_before
    assert cause.effect.values()["relative"] == pytest.approx(relative, rel=0.15)
    assert cause.effect.values()["force_n"] == pytest.approx(force_n, rel=0.25)


def test_a_law_starts_beside_the_stiffness_with_which_the_stories_keep_their_secant() -> None:
    segments = gather(pushed(seed=22), FORCED.front_end())
    context = FORCED.instrumented().context(segments.rate_hz)
    known = prior_from_drawing(FORCED.model(), np.full(6, 0.1), 3)
    posterior, fit, _ = fit_initial_model(classify(segments), known, context)
    effect = parse_effect("hysteretic_slip:frame:force_n=0.3,relative=0.1")
    x = start_beside(posterior, fit.x, effect)
    middle = posterior.conditions[posterior.n_classes // 2]
    wanted = posterior.system(fit.x, ()).stiffness
    beside = effect.extend(posterior.system(x, ()), posterior.context_at(x), middle).stiffness
    assert (posterior.system(x, ()).stiffness.diagonal() > 1.01 * wanted.diagonal()).all()
    np.testing.assert_allclose(beside, wanted, rtol=0.01, atol=1e-6 * np.abs(wanted).max())
