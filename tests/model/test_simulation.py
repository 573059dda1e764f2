"""The simulator: frequencies, noise, damping, effects."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd, lsim

from monitor.model.effects import Context, EffectError, parse_effect
from monitor.model.integration import march
from monitor.model.model import Model
from monitor.model.simulation import level_wander, linear_system, respond, respond_exactly, respond_newmark, simulate
from monitor.model.structures import ShearFrame

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


LAWS = (
    "cubic_stiffness:story 2:k3_n_per_m3=6e7",
    "cubic_stiffness:story 2:k3_n_per_m3=-6e7",
    "gap_contact:story 2:gap_m=0.0014,contact_stiffness_n_per_m=3000",
    "bilinear_stiffness:story 1:relative_drop=0.3",
    "coulomb_friction:story 1:friction_force_n=0.026",
    "coulomb_friction:story 3:friction_force_n=0.17",
    "quadratic_damping:floor 2:coefficient_n_s2_per_m2=16",
)


def planted(*texts: str) -> Model:
    return Model(FRAME.structure, tuple(parse_effect(text) for text in texts))


def white(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3))


def test_stepping_a_linear_model_is_the_exact_recursion() -> None:
    """That of scipy's first-order hold, which is made by a matrix exponential."""
    forces = white(2000)
    model = planted("attached_oscillator:floor 2:mass_kg=0.02,frequency_hz=11,damping_ratio=0.02",
                    "story_damper:story 3:damping_n_s_per_m=2")  # fmt: skip
    system = linear_system(model)
    size, inverse = system.mass.shape[0], np.linalg.inv(system.mass)
    rows = np.hstack([-inverse @ system.stiffness, -inverse @ system.damping])
    whole = np.vstack([np.eye(2 * size)[size:], rows])
    drive = np.vstack([np.zeros((size, 3)), inverse[:, :3]])
    from_rest = np.vstack([np.zeros((1, 3)), forces])
    _, exact, _ = lsim((whole, drive, rows[:3], inverse[:3, :3]), from_rest, np.arange(2001) / 1024.0)
    for made in (march(system, 3, (), forces, 1024.0), respond_exactly(model, forces, 1024.0)):
        np.testing.assert_allclose(made, exact[1:], atol=1e-9)


@pytest.mark.parametrize("text", LAWS)
def test_steps_are_short_enough(text: str) -> None:
    """Halving them changes the motion by less than 0.1 %."""
    model, forces = planted(text), white(20_480)
    system, laws = linear_system(model), model.effects[0].laws(model.structure)
    coarse = respond(model, forces, None, 1024.0)
    fine = march(system, 3, laws, forces, 1024.0, step_hz=8192.0)
    assert (coarse - fine).std() < 1e-3 * fine.std()
    assert (fine - respond_exactly(model, forces, 1024.0)).std() > 0.05 * fine.std(), "the law does nothing"


def test_the_order_of_several_laws_does_not_matter() -> None:
    """The drift and the speed on which each law depends hold the forces of all of them."""
    system, forces = linear_system(FRAME), white(20_480)
    laws = [law for text in LAWS for law in planted(text).effects[0].laws(FRAME.structure)]
    one, other = march(system, 3, laws, forces, 1024.0), march(system, 3, laws[::-1], forces, 1024.0)
    assert len(laws) > 3
    np.testing.assert_allclose(one, other, atol=1e-9 * one.std())


def test_a_stiffness_that_changes_in_time_is_that_stiffness() -> None:
    forces = white(8192)
    warm = respond(
        planted("temperature_stiffness:frame:per_degc=0.002,lag_s=0"), forces, None, 1024.0, np.full(8192, 10.0)
    )
    damping = FRAME.damping_matrix()  # which does not follow the temperature
    stiff = linear_system(planted("stiffness_change:frame:relative=0.02"))
    exact = march(type(stiff)(stiff.mass, damping, stiff.stiffness), 3, (), forces, 1024.0)
    np.testing.assert_allclose(warm, exact, atol=1e-3 * exact.std())


def test_the_lag_of_the_temperature_is_first_order() -> None:
    effect = parse_effect("temperature_stiffness:frame:per_degc=0.01,lag_s=5")
    step = np.where(np.arange(400) >= 100, 1.0, 0.0)
    factor = effect.stiffness_factor(step, 10.0)
    assert factor is not None
    t = (np.arange(400) - 99) / 10.0
    np.testing.assert_allclose(factor - 1.0, 0.01 * np.where(t > 0, 1.0 - np.exp(-t / 5.0), 0.0), atol=1e-12)


def story_force(text: str, largest_m: float = 0.01) -> np.ndarray:
    """Drift and force of the story that the effect is on, shape (2, 2001)."""
    from monitor.model.integration import phi

    effect = parse_effect(text)
    law = effect.laws(FRAME.structure)[0]
    k = FRAME.structure.stiffness_n_per_m[effect.index(FRAME.structure)]
    d = np.linspace(-largest_m, largest_m, 2001)
    return np.array([d, k * d + [phi(int(law.kind), *law.parameters, float(x), 0.0) for x in d]])


@pytest.mark.parametrize("k3", [4e7, 0.5])
def test_a_softening_cubic_is_the_cubic_and_never_runs_away(k3: float) -> None:
    d, force = story_force(f"cubic_stiffness:story 2:k3_n_per_m3={-k3}", 0.01 * np.sqrt(4e7 / k3))
    k = FRAME.structure.stiffness_n_per_m[1]
    near = np.abs(d) < 0.1 * d[-1]  # (d / q)^4 = 7e-4, of a cubic that takes off 3 %
    np.testing.assert_allclose(force[near], (k * d - k3 * d**3)[near], rtol=3e-5, atol=1e-9)
    assert np.diff(force).min() > 0.09 * k * (d[1] - d[0])


def test_one_sided_laws_act_on_their_side() -> None:
    k = FRAME.structure.stiffness_n_per_m[1]
    d, force = story_force("gap_contact:story 2:gap_m=-0.002,contact_stiffness_n_per_m=500")
    np.testing.assert_allclose(force, k * d + 500.0 * np.minimum(d + 0.002, 0.0), atol=1e-9)
    d, force = story_force("gap_contact:story 2:gap_m=0.002,contact_stiffness_n_per_m=500")
    np.testing.assert_allclose(force, k * d + 500.0 * np.maximum(d - 0.002, 0.0), atol=1e-9)
    d, force = story_force("bilinear_stiffness:story 2:relative_drop=0.2")
    np.testing.assert_allclose(force, k * d * np.where(d > 0, 0.8, 1.0), atol=1e-9)


def test_the_hidden_ground_causes_its_share_and_is_not_recorded() -> None:
    model = planted("base_excitation:base:share=0.6")
    both = simulate(model, duration_s=60, rate_hz=256, seed=2)
    forced = simulate(FRAME, duration_s=60, rate_hz=256, seed=2)
    assert both.ground is None
    share = 1.0 - (forced.floors**2).mean(axis=0) / (both.floors**2).mean(axis=0)
    assert share.mean() == pytest.approx(0.6, abs=0.05)


def test_noise_passes_the_sensor_effects_and_each_sensor_has_its_own() -> None:
    context = Context(FRAME.structure, ("top", "same"), np.array([[1.0, 0.0, 0.0]] * 2), 256.0)
    model = planted("sensor_gain:channel same:gain=2")
    said = simulate(model, duration_s=20, rate_hz=256, noise=0.1, seed=2, context=context).floors
    clean = simulate(FRAME, duration_s=20, rate_hz=256, seed=2).floors[:, 0]
    noise = said / [1.0, 2.0] - clean[:, None]
    np.testing.assert_allclose(noise.std(axis=0), 0.1 * clean.std(), rtol=0.05)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 0.05


def test_a_late_channel_is_late() -> None:
    late = simulate(planted("time_offset:channel a2:seconds=0.03125"), duration_s=8, rate_hz=256, seed=2).floors
    clean = simulate(FRAME, duration_s=8, rate_hz=256, seed=2).floors
    np.testing.assert_allclose(late[8:, 1], clean[:-8, 1], atol=1e-9)  # a whole number of samples
    np.testing.assert_array_equal(late[:, [0, 2]], clean[:, [0, 2]])


@pytest.mark.parametrize("text", ["coloured_excitation:frame:corner_hz=8", "base_excitation:base:share=0.5"])
def test_what_the_ground_excitation_leaves_no_room_for_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="ambient"):
        simulate(planted(text), duration_s=1, rate_hz=128, excitation="ground")
