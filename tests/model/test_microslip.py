"""A joint of which more and more slips: the exact law dissipates and softens as its linearization says."""

from __future__ import annotations

from itertools import pairwise
from math import gamma

import numpy as np
import pytest

from monitor.model.effects import parse_effect
from monitor.model.effects.microslip import Microslip
from monitor.model.integration import slider_stiffness
from monitor.model.model import Model
from monitor.model.simulation import respond
from monitor.model.structures import ShearFrame

STRUCTURE = ShearFrame(np.array([1.0]), np.array([1000.0]), 0.001)


def free_decay(effect: str, first_m_s2: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency, Hz, damping ratio and amplitude of the drift, m, of each two cycles of a free decay."""
    model = Model(STRUCTURE, (parse_effect(effect),))
    pull, rate = np.zeros((8000, 1)), 400.0
    pull[:20] = first_m_s2
    motion = respond(model, pull, None, rate)[20:, 0]
    up = np.flatnonzero((motion[:-1] < 0.0) & (motion[1:] >= 0.0))
    at = (up + motion[up] / (motion[up] - motion[up + 1])) / rate
    hz = 2.0 / (at[2:] - at[:-2])
    peak = np.array([np.abs(motion[a:b]).max() for a, b in pairwise(up)])
    damping = np.log(peak[:-2] / peak[2:]) / (4.0 * np.pi)
    return hz[: damping.size], damping, (peak[1:-1] / (2.0 * np.pi * hz[: damping.size]) ** 2)


@pytest.mark.parametrize("exponent", [0.3, 0.7])
def test_a_free_decay_stiffens_and_rings_longer_as_it_dies_away(exponent: float) -> None:
    relative = 0.03
    hz, damping, drift = free_decay(f"microslip:story 1:relative_at_1mm={relative},exponent={exponent}", 10.0)
    # The linearization is a mean over amplitudes; that of one amplitude is:

    mean = gamma(2.0 + 0.5 * exponent)
    secant, loss = (
        np.array([Microslip("story 1", relative, exponent).linearized(d / np.sqrt(2.0)) for d in drift]).T / mean
    )
    natural = np.sqrt(1000.0) / (2.0 * np.pi)
    slow = secant < 0.08  # where the amplitude hardly falls within the two cycles
    np.testing.assert_allclose((1.0 - (hz / natural) ** 2)[slow], secant[slow], rtol=0.05, atol=2e-4)
    np.testing.assert_allclose((damping - 0.001)[slow], 0.5 * (loss / (1.0 - secant))[slow], rtol=0.12, atol=1e-4)
    assert drift[slow].max() > 10.0 * drift.min()


def test_the_sliders_together_lose_the_power_of_the_drift_and_never_more_than_all() -> None:
    held = slider_stiffness(1000.0, 0.02, 0.4)
    assert (held >= 0.0).all()
    assert slider_stiffness(1000.0, 0.4, 0.9).sum() == pytest.approx(1000.0)


def test_on_the_frame_every_story_loses_the_same_share_at_one_drift() -> None:
    structure = ShearFrame(np.array([1.0, 1.0, 1.0]), np.array([1000.0, 2000.0, 3000.0]), 0.02)
    laws = parse_effect("microslip:frame:relative_at_1mm=0.05,exponent=0.4").laws(structure)
    assert [law.parameters for law in laws] == [(k, 0.05, 0.4) for k in (1000.0, 2000.0, 3000.0)]
    np.testing.assert_array_equal([law.direction for law in laws], structure.drift_matrix())
    assert (
        parse_effect("microslip:story 2:relative_at_1mm=0.05,exponent=0.4").laws(structure)[0].parameters[0] == 2000.0
    )
