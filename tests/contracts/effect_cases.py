"""One of every effect, at the size that hidden tests plant, on the paper's frame under ambient forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.inference import Band
from monitor.model import Condition, Context, Effect, Model, ShearFrame, System, parse_effect, simulate
from monitor.signals import SegmentDesign, transform
from tests.inference.spectral_form import expected

STRUCTURE = ShearFrame(
    np.array([0.3253, 0.3514, 0.3129]), np.array([2909.4511, 1514.8507, 1897.6986]), 0.01, np.array([0.093, 0.093, 0.1])
)
RATE_HZ = 1024.0
CONTEXT = Context(STRUCTURE, ("a1", "a2", "a3"), np.eye(3), RATE_HZ, boxes=((0, 1),))
DESIGN = SegmentDesign(RATE_HZ, 20480, 721)  # 20 s
BAND = Band(40, 680, DESIGN.step_hz, np.ones(680))  # 2 to 36 Hz

# Under white forces of 1 N at 1024 Hz the stories drift by 0.45, 0.93, 0.89 mm and 0.052, 0.061, 0.052 m/s (RMS), the
# floors move by 0.065, 0.058, 0.052 m/s and the channels show 5.1, 5.0, 5.8 m/s^2.
CASES = (
    "stiffness_change:story 2:relative=-0.04",
    "stiffness_change:frame:relative=0.05",
    "added_mass:floor 2:mass_kg=0.02",
    "added_mass:frame:relative=0.05",
    "temperature_stiffness:frame:per_degc=-0.002,lag_s=0",
    "cubic_stiffness:story 2:k3_n_per_m3=3.5e7",
    "cubic_stiffness:story 3:k3_n_per_m3=-3e7",
    "gap_contact:story 2:gap_m=0.0016,contact_stiffness_n_per_m=1500",
    "gap_contact:story 3:gap_m=-0.0013,contact_stiffness_n_per_m=1000",
    "bilinear_stiffness:story 1:relative_drop=0.2",
    "coulomb_friction:story 2:friction_force_n=0.04",
    "quadratic_damping:floor 1:coefficient_n_s2_per_m2=16",
    "story_damper:story 2:damping_n_s_per_m=1",
    "base_flexibility:base:stiffness_n_per_m=28000",
    "joint_flexibility:frame:girder_to_column_ratio=5",
    "gravity_softening:frame:factor=1.2",
    "attached_oscillator:floor 1:mass_kg=0.02,frequency_hz=12,damping_ratio=0.02",
    "harmonic_excitation:floor 2:frequency_hz=11.3,force_n=0.5",
    "coloured_excitation:frame:corner_hz=8",
    "base_excitation:base:share=0.5",
    "sensor_gain:channel a2:gain=1.1",
    "sensor_polarity:channel a3",
    "channel_swap:channel a1,a3",
    "sensor_rotation:channel a1,a2:angle_deg=20",
    "time_offset:channel a2:seconds=0.002",
    "clock_rate:frame:relative=0.01",
    "sensor_clipping:channel a1:limit_m_s2=7.5",
    "sensor_noise:channel a3:rms_m_s2=2",
    "unmodelled_mode:frame:frequency_hz=9.5,damping_ratio=0.012,shape_1=0.8,shape_2=-0.3,shape_3=0.5",
    "hysteretic_slip:story 2:force_n=0.3,relative=0.2",
    "ambient_forces:frame:common_share=0.3," + ",".join(f"rise_{i}={(-0.4, 0.3, -0.6)[i % 3]}" for i in range(1, 16)),
)


def measured(
    effects: tuple[Effect, ...], duration_s: float, seed: int, excess_degc: float = 0.0
) -> tuple[ComplexArray, Array]:
    """Mean cross-spectra of a simulated recording in the band, shape (680, 3, 3), and the channels' RMS."""
    excess = np.full(round(duration_s * RATE_HZ), excess_degc)
    motion = simulate(
        Model(STRUCTURE, effects),
        duration_s=duration_s,
        rate_hz=RATE_HZ,
        seed=seed,
        context=CONTEXT,
        excess_degc=excess,
    )
    starts = range(DESIGN.n // 2, len(motion.floors) - DESIGN.n, DESIGN.n // 2)  # the first ones are still at rest
    rows = np.array([transform(DESIGN, motion.floors[i : i + DESIGN.n])[40:720] for i in starts])
    return np.einsum("sfa,sfb->fab", rows, rows.conj()) / len(rows), np.sqrt((motion.floors**2).mean(axis=0))


def predicted(effects: tuple[Effect, ...], rms: Array, excess_degc: float = 0.0) -> ComplexArray:
    """What the spectral faces say of `measured`, at the channels' RMS and the motion that they bring about themselves."""
    model = Model(STRUCTURE, effects)
    system = base = system_of(model)
    for _ in range(8):
        condition = replace(condition_of(system, excess_degc), channel_m_s2=rms)
        system = base
        for effect in effects:
            system = effect.extend(system, CONTEXT, condition)
    return expected(system, effects, 1.0 / RATE_HZ, BAND, CONTEXT, condition)


def system_of(model: Model) -> System:
    mass, stiffness = model.structural_matrices()
    return System(mass, model.damping_matrix(), stiffness)


def condition_of(system: System, excess_degc: float = 0.0) -> Condition:
    """Motion of a system under white forces of 1 N at the source's rate."""
    hz = np.concatenate([np.arange(0.02, 40.0, 0.02), np.arange(40.0, RATE_HZ / 2.0, 0.5)])
    step, w = np.gradient(hz)[:, None, None], 2.0 * np.pi * hz[:, None, None]
    answer = np.linalg.inv(system.stiffness + 1j * w * system.damping - w**2 * system.mass)[:, :3, :3]
    drift = STRUCTURE.drift_matrix() @ answer

    def rms(response: ComplexArray) -> Array:
        return np.asarray(np.sqrt(2.0 / RATE_HZ * (step * np.abs(response) ** 2).sum(axis=(0, 2))))

    return Condition(rms(drift), rms(w * drift), rms(w * answer), rms(w**2 * answer), lambda lag_s: excess_degc)


def misfit(measured: ComplexArray, predicted: ComplexArray) -> Array:
    """Measured over predicted, whitened, less one, in bands of 1 Hz: shape (34, 3, 3)."""
    root = np.linalg.inv(np.linalg.cholesky(predicted))
    white = root @ measured @ root.conj().swapaxes(1, 2) - np.eye(3)
    return np.asarray(white.reshape(34, 20, 3, 3).mean(axis=1))


def parse(text: str) -> tuple[Effect, ...]:
    """The effect, once its place was checked."""
    effect = parse_effect(text)
    effect.check(STRUCTURE, CONTEXT.channels)
    return (effect,)
