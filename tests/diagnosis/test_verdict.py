"""What is stated of the causes that a search ended with."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import Array
from monitor.diagnosis.constancy import CommonSize
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.verdict import Diagnosis, FittedCauses, judge
from monitor.inference import maximize_posterior
from monitor.model import parse_effect
from tests.diagnosis.jointed_frame import fitted, recorded

pytestmark = pytest.mark.engine

MASS = "added_mass:floor 1:mass_kg=0.06"


USUAL = DiagnosisSettings()
MORE, CROSSTALK = np.array([1.0, 1.1, 1.0]), np.eye(3) + 0.15 * np.eye(3, k=-1)


def judged(reads: Array, settings: DiagnosisSettings = USUAL) -> Diagnosis:
    """A mass that is there and a gain of channel a2, fitted where the channels read the floors so."""
    posterior, null = fitted(recorded(MASS, seed=5, reads=reads, duration_s=200.0, noise=0.05), std=0.01)
    effects = (parse_effect(MASS), parse_effect("sensor_gain:channel a2:gain=0.95"))
    x = np.concatenate([null.x, *(e.coordinates for e in effects)])
    fit = maximize_posterior(posterior, x, effects)
    return judge(FittedCauses(posterior, fit, 2, np.zeros(fit.n_effect)), null, (), settings)


def test_what_ranges_of_frequency_agree_on_is_stated() -> None:
    found = judged(MORE)
    assert (found.verdict, [c.effect.name for c in found.causes]) == ("named", ["added_mass", "sensor_gain"])
    assert found.also_fitted == ()


def test_what_they_disagree_on_is_told_beside_what_nothing_explains() -> None:
    found = judged(CROSSTALK)
    assert found.verdict == "unexplained"
    assert ("sensor_gain", "not constant") in [(c.effect.name, c.doubt) for c in found.also_fitted]
    assert "sensor_gain" not in [c.effect.name for c in found.causes]


@pytest.mark.parametrize("channel", [0, 2])
def test_a_channel_without_which_nothing_is_left_over_is_at_fault(channel: int) -> None:
    """It takes up a share of its neighbour's signal; a change of stiffness had stood in for that."""
    reads = np.eye(3)
    reads[channel, 1] = 0.15
    posterior, null = fitted(recorded(seed=7, reads=reads, duration_s=300.0, noise=0.05), std=0.01)
    loss = (parse_effect("stiffness_change:story 2:relative=-0.05"),)
    fit = maximize_posterior(posterior, np.r_[null.x, loss[0].coordinates], loss)
    found = judge(FittedCauses(posterior, fit, 1, np.zeros(1)), null, (), USUAL)
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert all(cause.doubt for cause in found.also_fitted)
    assert [(m.where, m.is_explained) for m in found.left_over] == [(f"channel a{channel + 1}", True)]


def test_no_channel_is_at_fault_where_the_structure_changed() -> None:
    posterior, null = fitted(
        recorded("cubic_stiffness:story 2:k3_n_per_m3=4e8", seed=7, duration_s=300.0, noise=0.05), std=0.01
    )
    found = judge(FittedCauses(posterior, null, 0, np.zeros(0)), null, (), USUAL)
    assert found.verdict == "unexplained" and not any(m.is_explained for m in found.left_over)


def test_a_sensor_that_entered_no_fit_takes_a_cause_out_of_what_is_stated() -> None:
    found = judged(MORE)
    against = found.contradicted({"sensor_gain"})
    assert (against.verdict, [c.effect.name for c in against.causes]) == ("unexplained", ["added_mass"])
    assert [c.doubt for c in against.also_fitted] == ["contradicted"]
    assert found.contradicted({"joint_flexibility"}) is found


def test_nothing_is_not_said_of_a_recording_that_a_doubted_effect_explains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where bands are too coarse to show what is left over without it, its evidence still speaks."""
    monkeypatch.setattr(CommonSize, "chance_of_none", lambda *_: 1.0)
    found = judged(np.ones(3), DiagnosisSettings(misfit=1e6))
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert [c.doubt for c in found.also_fitted] == ["not constant"] * 2
