"""What stands from the start is no news later, whether or not calibration could name it for certain."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from monitor.diagnosis import stepwise_selection
from monitor.diagnosis.simulation_refit import RefittedCandidate
from monitor.inference import Posterior, classify
from monitor.runs import diagnose
from tests.diagnosis.jointed_frame import ANOTHER_DAY, COLOUR, CONFIG, CONTEXT, FORCES, GAINS, PLAIN, learned, recorded

pytestmark = pytest.mark.engine

LOSS = "stiffness_change:story 2:relative=-0.06"


@pytest.mark.parametrize("standing", [(COLOUR, *GAINS), (FORCES,)], ids=["colour and gains", "forces of every day"])
def test_what_calibration_cannot_tell_apart_is_no_news_later(standing: tuple[str, ...]) -> None:
    known = learned(*standing)
    assert ("ambient_forces" in [e.name for e in known.model.effects]) == (standing == (FORCES,))
    another_day = tuple(ANOTHER_DAY if e == FORCES else e for e in standing)
    clean = stepwise_selection.diagnose(classify(recorded(*another_day, seed=2)), known, CONTEXT, CONFIG.diagnosis)
    assert clean.verdict == "none"
    loss = stepwise_selection.diagnose(classify(recorded(*standing, LOSS, seed=3)), known, CONTEXT, CONFIG.diagnosis)
    assert [(c.effect.name, c.effect.location) for c in loss.causes] == [("stiffness_change", "story 2")]
    if standing == (FORCES,):  # which could take up another corner without a word
        other = stepwise_selection.diagnose(
            classify(recorded(FORCES, "coloured_excitation:frame:corner_hz=9", seed=4)),
            known,
            CONTEXT,
            CONFIG.diagnosis,
        )
        assert [c.effect.name for c in other.causes] == ["coloured_excitation"]


def test_forces_of_another_spectrum_are_seen_before_any_cause_is_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    """They fall by 40 dB within the band, so that beside white ones every cause imitates them."""
    narrow = "ambient_forces:frame:common_share=0," + ",".join(
        f"rise_{i}={-2.0 if i > 10 else 0.0}" for i in range(1, 16)
    )
    searched: list[Posterior] = []

    def search(posterior: Posterior, *_: Any) -> list[RefittedCandidate]:
        searched.append(posterior)
        return []

    monkeypatch.setattr(stepwise_selection, "run_selection_round", search)
    known = diagnose.learn_healthy_prior(recorded(narrow, seed=5, config=PLAIN, duration_s=600.0), PLAIN)
    assert [e.name for e in known.model.effects] == ["ambient_forces"]
    assert searched and all("ambient_forces" in [e.name for e in p.prior.model.effects] for p in searched)
    learned = known.mean[: CONFIG.model().structure.n_stories]
    np.testing.assert_allclose(learned, np.log(CONFIG.model().structure.stiffness_n_per_m), atol=0.02)
