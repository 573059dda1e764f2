"""A joint that slips: the exact law is Bouc and Wen's, and its linearization dissipates what its cycles do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from monitor.core import Array
from monitor.model.effects import parse_effect
from monitor.model.effects.hysteretic_slip import linearized_element, steady_cycle
from monitor.model.integration import slipped
from monitor.model.model import Model
from monitor.model.simulation import respond
from monitor.model.structures import ShearFrame


def driven(drift: Array) -> Array:
    """Force of an element that follows a drift from rest, over its largest, shape (n,)."""
    z, out = 0.0, []
    for moved in np.diff(drift, prepend=0.0):
        z = slipped(z, float(moved))
        out.append(z)
    return np.array(out)


def test_the_element_is_that_of_bouc_and_wen_with_a_sharpness_of_two() -> None:
    t = np.linspace(0.0, 20.0, 20001)
    drift, speed = 1.5 * np.sin(t) + 0.4 * np.sin(4.3 * t), 1.5 * np.cos(t) + 0.4 * 4.3 * np.cos(4.3 * t)

    def rate(at: float, z: Array) -> Array:
        v = float(np.interp(at, t, speed))
        return v - (0.5 * abs(v) * z * abs(z) + 0.5 * v * z**2)

    exact = solve_ivp(rate, (0.0, 20.0), [0.0], t_eval=t, rtol=1e-8, atol=1e-10).y[0]
    np.testing.assert_allclose(driven(drift), exact, atol=2e-3)


@pytest.mark.parametrize("amplitude", [0.3, 1.0, 4.0])
def test_stiffness_and_loss_are_those_of_asteady_cycle(amplitude: float) -> None:
    t = np.linspace(0.0, 12.0 * np.pi, 60001)
    drift, last = amplitude * np.sin(t), t > 10.0 * np.pi
    z = driven(drift)
    secant, loss = (float(x) for x in steady_cycle(np.array(amplitude)))
    step = t[1] - t[0]
    assert secant == pytest.approx((z * np.sin(t))[last].sum() * step / np.pi / amplitude, rel=2e-3)
    dissipated = float((z * np.gradient(drift))[last].sum())
    assert loss == pytest.approx(dissipated / (np.pi * amplitude**2), rel=2e-3, abs=1e-5)


def test_little_motion_slips_nothing_and_much_motion_everything() -> None:
    assert linearized_element(1e-3) == pytest.approx((1.0, 0.0), abs=1e-4)
    secant, loss = linearized_element(300.0)
    assert secant < 1e-3 and loss < 0.01
    losses = [linearized_element(d)[1] for d in (0.1, 1.5, 30.0)]
    assert losses[1] > max(losses[0], losses[2])


def test_a_story_keeps_its_stiffness_at_small_drift_and_loses_the_share_beyond() -> None:
    structure = ShearFrame(np.array([1.0]), np.array([1000.0]), 0.02)
    hz = []
    for force in (1e-3, 30.0):
        model = Model(structure, (parse_effect("hysteretic_slip:story 1:force_n=0.1,relative=0.3"),))
        pull = np.zeros((4000, 1))
        pull[0] = 100.0 * force
        free = respond(model, pull, None, 200.0)[5:, 0]
        hz.append(float(np.abs(np.fft.rfft(free * np.hanning(free.size), n=1 << 18)).argmax()) * 200.0 / (1 << 18))
    natural = np.sqrt(1000.0) / (2.0 * np.pi)
    assert hz[0] == pytest.approx(natural, rel=2e-3)
    assert np.sqrt(0.7) * natural < hz[1] < 0.93 * natural


def test_on_the_frame_every_story_slips_at_one_drift_and_the_forces_follow_the_stiffnesses() -> None:
    structure = ShearFrame(np.array([1.0, 1.0, 1.0]), np.array([1000.0, 2000.0, 3000.0]), 0.02)
    (effect,) = (parse_effect("hysteretic_slip:frame:force_n=4,relative=0.1"),)
    laws = effect.laws(structure)
    np.testing.assert_allclose([law.parameters[0] for law in laws], [2.0, 4.0, 6.0])
    np.testing.assert_allclose([law.parameters[1] for law in laws], 0.02)
    np.testing.assert_array_equal([law.direction for law in laws], structure.drift_matrix())
    (alone,) = parse_effect("hysteretic_slip:story 2:force_n=4,relative=0.1").laws(structure)
    assert alone.parameters == (pytest.approx(4.0), pytest.approx(0.02))
