"""The simulator: frequencies, noise, damping, effects."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd

from monitor.effects import EffectError, parse_effect
from monitor.model import Model
from monitor.simulate import level_wander, respond_exactly, respond_newmark, simulate
from monitor.structures import ShearFrame

FRAME = Model(
    ShearFrame(np.array([0.3253, 0.3514, 0.3129]), np.array([2909.4511, 1514.8507, 1897.6986]), 0.01, np.full(3, 0.1))
)


def decay_frequencies(accelerations: np.ndarray, rate_hz: float, guess: np.ndarray) -> np.ndarray:
    """Damped frequencies of a noise-free decay by a least-squares linear prediction (exact for six poles)."""
    order = 2 * guess.size
    y = accelerations[5:]
    rows = np.stack([y[k : k + len(y) - order].ravel() for k in range(order)], axis=1)
    coefficients = np.linalg.lstsq(rows, -y[order:].ravel(), rcond=None)[0]
    poles = np.roots(np.concatenate([[1.0], coefficients[::-1]]))
    mu = np.log(poles[poles.imag > 0]) * rate_hz
    return np.sort(np.abs(mu)) / (2 * np.pi)


def blow(n: int, rate_hz: float) -> np.ndarray:
    forces = np.zeros((n, 3))
    forces[1, :] = [rate_hz, 0.3 * rate_hz, -0.5 * rate_hz]
    return forces


def test_exact_discretisation_holds_frequencies_to_1e_4() -> None:
    floors = respond_exactly(FRAME, blow(2000, 256.0), 256.0)
    found = decay_frequencies(floors, 256.0, FRAME.modes().frequencies_hz)
    np.testing.assert_allclose(found, FRAME.modes().frequencies_hz, rtol=1e-6)


def test_newmark_lengthens_periods_as_known() -> None:
    f, dt = FRAME.modes().frequencies_hz, 1e-3
    floors = respond_newmark(FRAME, blow(4000, 1000.0), 1000.0)
    # Taken every 4 ms, so that the linear prediction is well conditioned.
    found = decay_frequencies(floors[::4], 250.0, f)
    np.testing.assert_allclose(found, np.arctan(np.pi * f * dt) / (np.pi * dt), rtol=3e-6)


def test_both_integrators_agree_at_a_small_step() -> None:
    rng = np.random.default_rng(0)
    forces = np.repeat(rng.standard_normal((400, 3)), 64, axis=0)
    exact, newmark = (f(FRAME, forces, 6400.0) for f in (respond_exactly, respond_newmark))
    assert np.abs(exact - newmark)[::64].std() < 0.02 * exact.std()


def test_noise_is_a_fraction_of_the_mean_rms_and_the_same_on_every_channel() -> None:
    clean = simulate(FRAME, duration_s=60, rate_hz=512, noise=0.0, seed=3).floors
    noisy = simulate(FRAME, duration_s=60, rate_hz=512, noise=0.1, seed=3).floors
    rms = np.sqrt(((noisy - clean) ** 2).mean(axis=0))
    np.testing.assert_allclose(rms, 0.1 * np.sqrt((clean**2).mean(axis=0)).mean(), rtol=0.02)


def test_ground_motion_drives_absolute_accelerations_as_the_model_says() -> None:
    """Floors over ground, estimated from 400 s, is the model's transmissibility 1 + w^2 (K + i w C - w^2 M)^-1 M 1."""
    motion = simulate(FRAME, duration_s=400, rate_hz=512, excitation="ground", seed=1)
    assert motion.ground is not None
    frequency, cross = csd(motion.ground, motion.floors.T, fs=512, nperseg=8192)
    _, power = csd(motion.ground, motion.ground, fs=512, nperseg=8192)
    for wanted in (2.0, 4.0, 10.0, 14.0):  # between the modes, where leakage is small
        k = int(np.argmin(np.abs(frequency - wanted)))
        w = 2 * np.pi * frequency[k]
        m = FRAME.mass_matrix()
        dynamic = FRAME.stiffness_matrix() + 1j * w * FRAME.damping_matrix() - w**2 * m
        expected = 1 + w**2 * np.linalg.solve(dynamic, m.sum(axis=1))
        np.testing.assert_allclose(cross[:, k] / power[k], expected, atol=0.05 * np.abs(expected).max())


def test_rayleigh_damping_is_met_in_the_first_two_modes() -> None:
    modes = FRAME.modes()
    zeta = np.diag(modes.shapes.T @ FRAME.damping_matrix() @ modes.shapes) / (2 * np.sqrt(modes.eigenvalues))
    np.testing.assert_allclose(zeta[:2], 0.01, rtol=1e-12)


def test_the_wandering_level_has_mean_square_one_and_the_stated_spread() -> None:
    level = level_wander(2_000_000, 20.0, 0.35, np.random.default_rng(0))
    assert (level**2).mean() == pytest.approx(1.0, abs=0.05)
    assert level.std() / level.mean() == pytest.approx(0.35, abs=0.03)


def test_joints_that_hardly_rotate_leave_a_shear_frame_and_soft_ones_couple_third_floors() -> None:
    rigid = Model(FRAME.structure, (parse_effect("joint_flexibility:frame:girder_to_column_ratio=1e7"),))
    np.testing.assert_allclose(rigid.stiffness_matrix(), FRAME.stiffness_matrix(), atol=1e-2)
    soft = Model(
        FRAME.structure, (parse_effect("joint_flexibility:frame:girder_to_column_ratio=10"),)
    ).stiffness_matrix()
    assert soft[0, 2] > 0
    np.testing.assert_allclose(soft, soft.T)
    assert np.linalg.eigvalsh(soft).min() > 0


def test_joint_flexibility_of_one_story_is_the_textbook_portal() -> None:
    """One bay, one story, clamped: k = (24 E I_c / h^3) (6 r + 1) / (6 r + 4), r = (E I_g / L) / (E I_c / h)."""
    k, ratio = 1000.0, 0.7
    model = Model(
        ShearFrame(np.ones(1), np.array([k]), 0.01),
        (parse_effect(f"joint_flexibility:frame:girder_to_column_ratio={ratio}"),),
    )
    expected = k * (6 * ratio + 1) / (6 * ratio + 4)
    assert model.stiffness_matrix()[0, 0] == pytest.approx(expected)


@pytest.mark.parametrize(
    "text",
    ["nothing:story 1:relative=0.1", "stiffness_change:floor 1:relative=0.1", "stiffness_change:story 0:relative=0.1",
     "stiffness_change:story 1:k=0.1", "stiffness_change:story 1:relative=x"],
)  # fmt: skip
def test_effects_that_cannot_be_are_refused(text: str) -> None:
    with pytest.raises(EffectError):
        parse_effect(text)
