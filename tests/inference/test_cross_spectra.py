"""Cross-spectra: of a building that turns, and at the edge of what a search may try."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag, eigh

from monitor.inference import Band
from monitor.inference.cross_spectra import (
    Excitation,
    accelerance,
    channel_response,
    cross_spectra,
    extended,
    ground_density,
)
from monitor.model import EFFECTS, Condition, Context, Model, ShearFrame, System, simulate
from tests.support.turning_frame import CONTEXT, COUPLED, RATE, REST, TRUTH


def test_the_grounds_density_is_found_where_one_story_has_next_to_no_stiffness() -> None:
    """As in a trial step: the channels' shares of the ground then differ by many powers of ten."""
    frame = Model(ShearFrame(np.full(3, 0.15), np.array([400.0, 4e-7, 400.0]), 0.01))
    context = Context(frame.structure, ("a1", "a2", "a3"), np.eye(3), 100.0)
    condition = Condition(np.ones(3), np.ones(3), np.ones(3), np.ones(3), beyond=1e-3)
    force = np.array([2.4e-5, 6e-10, 2.2e-9])
    mass, stiffness = frame.structural_matrices()
    system = System(mass, frame.damping_matrix(), stiffness)
    density = ground_density(0.999, system, force, (), context, condition)
    assert np.isfinite(density)
    assert density > 0.0


def coupled_system() -> System:
    mass, stiffness = TRUTH.structural_matrices()
    return extended(System(mass, TRUTH.damping_matrix(), stiffness), (COUPLED,), CONTEXT, REST)


def test_simulation_and_spectra_agree() -> None:
    motion = simulate(Model(TRUTH.structure, (COUPLED,)), duration_s=1200.0, rate_hz=RATE, seed=3, context=CONTEXT)
    n, bins = round(10.0 * RATE), slice(20, 250)  # 2 to 25 Hz
    parts = motion.floors[: len(motion.floors) // n * n].reshape(-1, n, 3) * np.hanning(n)[:, None]
    x = np.fft.rfft(parts, axis=1)[:, bins] / np.sqrt(RATE * 0.375 * n)
    measured = np.einsum("sfa,sfb->fab", x, x.conj()) / len(x)
    band = Band(20, 230, 0.1, np.ones(230))
    expected = cross_spectra(
        coupled_system(), (COUPLED,), Excitation(np.full(3, 1.0 / RATE), np.zeros(3)), band, CONTEXT, REST
    )
    whitened = np.linalg.solve(np.linalg.cholesky(expected), measured)
    power = (
        np.einsum("faa->f", np.linalg.solve(np.linalg.cholesky(expected), whitened.conj().swapaxes(1, 2))).real / 3.0
    )
    assert power.reshape(-1, 23).mean(axis=1) == pytest.approx(np.ones(10), abs=0.06)


def test_modes_with_eccentricities_and_arms_are_a_building_that_turns() -> None:
    """Floors whose masses lie off the middle, where bracing and forces are: the same spectra, by its own equations of motion."""
    off, radius, lever, turning, n = np.array([0.03, -0.02, 0.04]), 0.12, 0.05, 1.7, 3
    mass, stiffness = TRUTH.structural_matrices()
    # The floors' middles sway, then all turn; the bracing resists each about the middle.
    masses = np.block([[mass, mass @ np.diag(-off)], [np.diag(-off) @ mass, mass @ np.diag(radius**2 + off**2)]])
    springs = block_diag(stiffness, turning * radius**2 * stiffness)
    # The middle's motion by that of the centre of mass.
    to_centre = np.block([[np.eye(n), np.diag(off)], [np.zeros((n, n)), np.eye(n)]])
    about_mass = to_centre.T @ springs @ to_centre
    inertia = (to_centre.T @ masses @ to_centre)[n:, n:]
    squared, turns = eigh(about_mass[n:, n:], inertia)
    mean = float(TRUTH.structure.masses_kg.mean())
    system, turns = System(mass, TRUTH.damping_matrix(), about_mass[:n, :n]), turns * np.sqrt(mean)
    for f, turn in zip(np.sqrt(squared) / (2.0 * np.pi), turns.T, strict=True):
        values = {"frequency_hz": float(f), "damping_ratio": 0.02, "force_ratio": 0.3}
        for name, of in (
            ("shape", (off + lever) * turn / mean),
            ("eccentricity", np.linalg.solve(stiffness, about_mass[:n, n:] @ turn)),
            ("force_arm", off * turn),
        ):
            values |= {f"{name}_{j + 1}": float(value) for j, value in enumerate(of)}
        system = EFFECTS["unmodelled_mode"].create("frame", values).extend(system, CONTEXT, REST)
    hz = np.linspace(1.0, 25.0, 40)
    seen = channel_response(system, hz, CONTEXT)
    # In the coordinates of the building: the forces act at the middles, the sensors are beside them.
    back = np.linalg.inv(to_centre)
    damping = block_diag(
        TRUTH.damping_matrix(), np.linalg.inv(turns).T @ np.diag(0.04 * np.sqrt(squared) * mean) @ np.linalg.inv(turns)
    )
    damping = back.T @ damping @ back
    for k, w in enumerate(2.0 * np.pi * hz):
        moved = np.linalg.inv(masses + damping / (1j * w) - springs / w**2)
        sensors = np.hstack([np.eye(n), lever * np.eye(n)])
        assert seen[k, :, :n] == pytest.approx(sensors @ moved[:, :n], rel=1e-9)


def test_an_attached_mass_that_a_fit_lets_go_to_nothing_changes_no_response() -> None:
    mass, stiffness = (
        np.diag([2.0, 1.0, 1e-300]),
        np.array([[300.0, -100.0, 0.0], [-100.0, 100.0, 0.0], [0.0, 0.0, 9e-297]]),
    )
    damping, omega = 0.01 * stiffness, np.linspace(1.0, 60.0, 50)
    whole = accelerance(mass, damping, stiffness, omega, np.eye(3)[:, :2])
    alone = accelerance(mass[:2, :2].copy(), damping[:2, :2].copy(), stiffness[:2, :2].copy(), omega, np.eye(2))
    np.testing.assert_allclose(whole[:, :2], alone, rtol=1e-12)
