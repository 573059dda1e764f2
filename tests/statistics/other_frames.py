"""Diagnosis of frames of other kinds: one to seven stories, floors without a sensor, 100 to 512 Hz.

    .venv/bin/python -m tests.statistics.other_frames [TRIALS] [SEED]

Each trial draws a frame, a drawing that misses its stiffness by up to 10 % and its masses by 5 %, and one effect or none; the
monitor's own simulator makes a healthy and an affected record of 20 minutes, thinned to the frame's rate.  (`tests.hidden`
has the other simulator, of a three-story frame.)
"""

from __future__ import annotations

import time
import tomllib

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.signal import resample_poly
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from monitor.config import Configuration
from monitor.model import Context, Model, channel_motion, parse_effect, simulate
from monitor.runs import cut_into_blocks
from tests.hidden import engine
from tests.support.campaign import words

LEAST_HZ = 1000.0
"""Of the simulation: forces are white up to half of it."""


def drawing(stiffness: np.ndarray, masses: np.ndarray, floors: list[int], damping_ratio: float = 0.01) -> str:
    """A structure file."""
    sensors = "".join(f'[[sensors]]\nchannel = "a{f}"\nfloor = {f}\n' for f in floors)
    return (
        f'[structure]\nkind = "shear_frame"\nname = "frame"\nmasses_kg = {masses.tolist()}\n'
        f"stiffness_n_per_m = {stiffness.tolist()}\nstory_heights_m = {[3.0] * masses.size}\n"
        f"damping_ratio = {damping_ratio}\n{sensors}"
    )


def drawn_effect(model: Model, first_hz: float, floors: list[int], rng: np.random.Generator) -> str:
    """An effect of a size that should be found, as `--effect` takes it; empty for none."""
    structure, n = model.structure, model.structure.n_dofs
    story, floor, channel = rng.integers(1, n + 1), rng.integers(1, n + 1), rng.choice(floors)
    k, m = structure.stiffness_n_per_m[story - 1], structure.masses_kg[floor - 1]
    rate_hz = LEAST_HZ
    everywhere = Context(structure, tuple(map(str, range(n))), np.eye(n), rate_hz)
    moved = channel_motion(model, rng.standard_normal((20_000, n)), None, rate_hz, everywhere)
    w = 2.0 * np.pi * np.maximum(rfftfreq(20_000, 1.0 / rate_hz), 0.3 * first_hz)[:, None]
    displaced, speed = (irfft(rfft(moved, axis=0) * by, axis=0, n=20_000) for by in (-1.0 / w**2, -1j / w))
    drift = np.diff(displaced, axis=1, prepend=0.0).std(axis=0)[story - 1]
    own = 2.0 * 0.01 * np.sqrt(structure.stiffness_n_per_m[0] * m)
    sign = rng.choice([-1, 1])
    texts = [
        "",
        f"stiffness_change:story {story}:relative={-rng.uniform(0.03, 0.15)}",
        f"added_mass:floor {floor}:mass_kg={rng.uniform(0.04, 0.15) * m}",
        f"story_damper:story {story}:damping_n_s_per_m={rng.uniform(1.0, 4.0) * own}",
        f"quadratic_damping:floor {floor}:coefficient_n_s2_per_m2={rng.uniform(1.0, 3.0) * own / speed.std(axis=0)[floor - 1]}",
        f"cubic_stiffness:story {story}:k3_n_per_m3={sign * rng.uniform(0.03, 0.1) * k / 3.0 / drift**2}",
        f"coulomb_friction:story {story}:friction_force_n={rng.uniform(0.03, 0.15) * k * drift}",
        f"joint_flexibility:frame:girder_to_column_ratio={rng.uniform(3.0, 12.0)}",
        f"base_flexibility:base:stiffness_n_per_m={rng.uniform(5.0, 20.0) * structure.stiffness_n_per_m[0]}",
        f"attached_oscillator:floor {floor}:mass_kg={0.04 * m},"
        f"frequency_hz={rng.uniform(0.8, 2.0) * first_hz},damping_ratio=0.02",
        f"harmonic_excitation:floor {floor}:frequency_hz={rng.uniform(1.5, 3.0) * first_hz},force_n={rng.uniform(0.1, 0.3)}",
        f"sensor_gain:channel a{channel}:gain={1.0 + sign * rng.uniform(0.03, 0.15)}",
        f"time_offset:channel a{channel}:seconds={rng.uniform(0.0025, 0.0125)}",
        f"sensor_noise:channel a{channel}:rms_m_s2={rng.uniform(0.1, 0.3) * moved.std()}",
        f"sensor_polarity:channel a{channel}:",
        f"channel_swap:channel a{floors[0]},a{floors[-1]}:" if len(floors) > 1 else "",
    ]
    return str(rng.choice(texts))


def trial(rng: np.random.Generator) -> tuple[bool, str]:
    """Whether the answer holds the truth, and a line on it."""
    n, first_hz = int(rng.integers(1, 8)), rng.uniform(1.0, 5.0)
    masses, scatter = 10.0 * rng.uniform(0.8, 1.2, n), rng.uniform(0.8, 1.2, n)
    stiffness = scatter * 10.0 * (np.pi * first_hz / np.sin(np.pi / 2.0 / (2 * n + 1))) ** 2
    floors = list(range(1, n + 1)) if n <= 3 or rng.random() < 0.5 else sorted({1, (n + 1) // 2, n})
    rate_hz, spread = float(rng.choice([100.0, 128.0, 200.0, 256.0, 512.0])), float(rng.choice([0.0, 0.35]))
    text = drawing(stiffness, masses, floors, damping_ratio=round(rng.uniform(0.006, 0.02), 4))
    config = Configuration.model_validate(tomllib.loads(text))
    model, up = config.model(), int(np.ceil(LEAST_HZ / rate_hz))
    effect = drawn_effect(model, first_hz, floors, rng)
    context = Context(model.structure, config.channels, config.instrumented().sensor_matrix, rate_hz * up)

    def record(effects: tuple[str, ...]) -> np.ndarray:
        affected = Model(model.structure, tuple(parse_effect(e) for e in effects))
        motion = simulate(
            affected, duration_s=1200.0, rate_hz=rate_hz * up, noise=0.05, level_spread=spread,
            seed=int(rng.integers(2**31)), context=context,
        )  # fmt: skip
        return np.asarray(resample_poly(motion.floors, 1, up, window=("kaiser", 8.0)))

    def blocks(samples: np.ndarray) -> list[SampleBlock]:
        return list(cut_into_blocks(ACCELERATION, samples, config.channels, rate_hz, 0, 1024))

    seen = drawing(stiffness * rng.uniform(0.9, 1.1, n), masses * rng.uniform(0.95, 1.05, n), floors)
    baseline = engine.calibrate(seen, blocks(record(())))
    began = time.perf_counter()
    answer = engine.answer(baseline, blocks(record((effect,) if effect else ())))
    took_s = time.perf_counter() - began
    said = [(c["effect"], c["location"]) for c in answer["causes"]]
    rivals = [(a["effect"], a["location"]) for a in answer["alternatives"]]
    truth = tuple(effect.split(":")[:2])
    right = said == [truth] or (answer["verdict"] == "ambiguous" and truth in rivals) if effect else not said + rivals
    frame = f"{n} stories, sensors {floors}, {rate_hz:g} Hz, first {first_hz:.2f} Hz, spread {spread:g}"
    return right, f"{frame}: {effect or 'nothing'} -> {answer['verdict']} {said or rivals} ({took_s:.1f} s)"


def main() -> None:
    """Print a line a trial, then how many were right."""
    trials, seed = words(30, 1)
    right = 0
    with threadpool_limits(limits=1):
        for number in range(trials):
            good, line = trial(np.random.default_rng([seed, number]))
            right += good
            print("right" if good else "wrong", line, flush=True)
    print(f"{right} of {trials} right")


if __name__ == "__main__":
    main()
