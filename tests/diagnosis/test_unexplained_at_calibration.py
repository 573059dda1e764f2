"""What no effect explains at calibration is no news later."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import Array
from monitor.diagnosis import stepwise_selection
from monitor.diagnosis.cross_validation import HeldOutGain
from monitor.diagnosis.files import content as content_of
from monitor.diagnosis.verdict import Diagnosis
from monitor.inference import classify
from monitor.model import StructuralPrior
from monitor.runs import diagnose
from tests.diagnosis.jointed_frame import CONFIG, CONTEXT, recorded

pytestmark = pytest.mark.engine

STANDING_CROSSTALK = 0.3
"""So much of the first channel's signal is in the last one's, which no effect explains."""
LOSS = "stiffness_change:story 2:relative=-0.06"


def mixed(crosstalk: float) -> Array:
    return np.eye(3) + crosstalk * np.outer([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def unexplained() -> StructuralPrior:
    """Learned without the effects that explain less than 100 nats of the misfit, which take most of the time."""
    certain = CONFIG.model_copy(update={"diagnosis": CONFIG.diagnosis.model_copy(update={"margin": 100.0})})
    return diagnose.learn_healthy_prior(recorded(seed=1, reads=mixed(STANDING_CROSSTALK)), certain)


def diagnosed(
    prior: StructuralPrior, seed: int, *effects: str, crosstalk: float = STANDING_CROSSTALK, max_causes: int = 2
) -> Diagnosis:
    """Diagnose a later recording of the same frame."""
    segments = recorded(*effects, seed=seed, reads=mixed(crosstalk))
    few = CONFIG.diagnosis.model_copy(update={"max_causes": max_causes})
    return stepwise_selection.diagnose(classify(segments), prior, CONTEXT, few)


def test_what_nothing_explains_at_calibration_is_no_news_later(unexplained: StructuralPrior) -> None:
    assert unexplained.error is not None
    clean = diagnosed(unexplained, 2)
    assert clean.verdict == "none", [c.effect for c in clean.causes]
    said = content_of(clean, HeldOutGain(), (), {"without": [], "with": []})
    low, high = said["standing_misfit"]["bands_hz"][0]
    assert f"{low:.1f}-{high:.1f}" in said["standing_misfit"]["says"] and "healthy" in said["says"]


def test_a_loss_is_named_beside_what_nothing_explains(unexplained: StructuralPrior) -> None:
    loss = diagnosed(unexplained, 3, LOSS)
    assert [(c.effect.name, c.effect.location) for c in loss.causes] == [("stiffness_change", "story 2")]
    size, std = loss.causes[0].effect.values()["relative"], loss.causes[0].std["relative"]
    assert abs(size + 0.06) < 2.0 * std < 0.04


def test_a_change_of_what_nothing_explains_is_news(unexplained: StructuralPrior) -> None:
    assert diagnosed(unexplained, 4, crosstalk=0.45, max_causes=1).verdict == "unexplained"
