"""Diagnose the F-16 ground vibration test against a model identified at its lowest level.

``python -m tests.measured.f16 FOLDER [--force] [--levels 3 5 7] [--out FILE.jsonl]``: FOLDER holds F16_FM_Level1.mat,
..3, ..5, ..7 of the user's own
download (docs/measured.md).  With ``--force`` the shaker's force is a known input, else the accelerations alone are used.
``--single`` tells instead how much of the frequency responses at each level a change at one place alone can explain.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, FORCE, SampleBlock
from monitor.config import Configuration
from monitor.inference import gather
from monitor.runs import diagnose

Array = np.ndarray
LEVELS = (1, 3, 5, 7)
PERIOD_N = 8192
"""Samples of a period of the multisine; the first period holds the transient."""
BAND_HZ = (2.0, 14.5)
"""Band of the forces that the anti-alias filter passes."""
FIRST_GUESS_HZ = (1.0, 3.5, 5.2, 6.6, 7.32, 9.2, 17.0)
"""Peaks of the frequency responses at level 1.  The first mode stands for the aircraft on its supports, the last one for all
beyond the band."""
GUESS_FACTOR = 1.3
"""Factor by which a fitted frequency may differ from its guess."""
DAMPING_RANGE = (1e-3, 0.1)
CHANNELS = ("a1", "a2", "a3")
JOINT = 1, 2
"""Wing's and payload's sensor, at the two sides of the mounting joint."""


@dataclass(frozen=True, eq=False)
class Test:
    """Measured test at one level."""

    force: Array
    """Shape (n,), N."""
    accelerations: Array
    """Shape (n, 3), m/s^2."""
    rate_hz: float

    def blocks(self, *, with_force: bool) -> list[SampleBlock]:
        """Make blocks of the accelerations, and of the force if wanted, without the first period."""
        streams = [(ACCELERATION, CHANNELS, "m/s^2", self.accelerations)]
        streams += [(FORCE, ("f1",), "N", self.force[:, None])] * with_force
        out = []
        for at in range(0, len(self.force) - PERIOD_N, PERIOD_N):
            t_ns = round(at / self.rate_hz * 1e9)
            for topic, channels, unit, samples in streams:
                part = samples[PERIOD_N + at : 2 * PERIOD_N + at].astype(np.float32)
                out.append(SampleBlock(topic, t_ns, at, self.rate_hz, channels, unit, part))
        return out

    def accelerance(self) -> tuple[Array, Array]:
        """Compute frequencies in the band, shape (n_hz,), and accelerances by the force, shape (n_hz, 3), 1/kg."""
        force = self.force.reshape(-1, PERIOD_N)[1:].mean(axis=0)
        floors = self.accelerations.reshape(-1, PERIOD_N, 3)[1:].mean(axis=0)
        hz = np.fft.rfftfreq(PERIOD_N, 1.0 / self.rate_hz)
        chosen = (hz >= BAND_HZ[0]) & (hz <= BAND_HZ[1])
        return hz[chosen], (np.fft.rfft(floors, axis=0) / np.fft.rfft(force)[:, None])[chosen]


def read(path: Path) -> Test:
    """Read one of the benchmark's files."""
    content = loadmat(path)
    return Test(content["Force"][0], content["Acceleration"].T, float(content["Fs"][0, 0]))


def identify_modes(hz: Array, accelerance: Array) -> tuple[Array, Array, Array]:
    """Fit real modes to the accelerances by the force at the first sensor.

    Returns
    -------
    frequencies_hz, damping : ndarray, shape (m,)
    shapes : ndarray, shape (3, m)
        Mass-normalized, 1/sqrt(kg).
    """
    m = len(FIRST_GUESS_HZ)

    def modes(x: Array) -> tuple[Array, Array, Array]:
        return np.exp(x[:m]), np.exp(x[m : 2 * m]), x[2 * m :].reshape(3, m)

    def residual(x: Array) -> Array:
        f, damping, shapes = modes(x)
        r = hz[:, None] / f
        answer = -(r**2) / (1.0 - r**2 + 2j * damping * r)
        left = (answer * shapes[0]) @ shapes.T - accelerance
        scaled = left / np.abs(accelerance).mean(axis=0)
        return np.concatenate([scaled.real.ravel(), scaled.imag.ravel()])

    peak = [np.abs(accelerance[np.abs(hz - f).argmin()]) for f in FIRST_GUESS_HZ]
    shapes = np.array([np.sqrt(0.02 / p[0]) * p for p in peak]).T
    x = np.concatenate([np.log(FIRST_GUESS_HZ), np.full(m, np.log(0.02)), shapes.ravel()])
    frequencies = np.log(FIRST_GUESS_HZ)
    shape_limit = np.full(3 * m, np.inf)
    lower, upper = (
        np.concatenate([frequencies + sign * np.log(GUESS_FACTOR), np.full(m, np.log(z)), sign * shape_limit])
        for sign, z in zip((-1.0, 1.0), DAMPING_RANGE, strict=True)
    )
    return modes(least_squares(residual, x, bounds=(lower, upper), x_scale="jac", max_nfev=4000).x)


def errors_of_single_changes(test: Test, frequencies_hz: Array, damping: Array, shapes: Array) -> dict[str, float]:
    """Fit a change at one place to the frequency responses of a level; return the relative error that each change leaves.

    A change at a place is a spring and a damper, or a mass and a damper, between sensors or at one.  ``all alike`` changes all
    stiffnesses by one factor and all damping ratios by another.
    """
    hz, measured = test.accelerance()
    w = 2.0 * np.pi * hz
    omega = 2.0 * np.pi * frequencies_hz
    unit = np.abs(measured).mean(axis=0)

    def compliance(stiffer: float = 0.0, damped: float = 0.0) -> Array:
        modal = 1.0 / (
            (1.0 + stiffer) * omega**2 - w[:, None] ** 2 + 2j * (1.0 + damped) * damping * omega * w[:, None]
        )
        return np.asarray(np.einsum("im,fm,jm->fij", shapes, modal, shapes))

    def left(changed: Array) -> Array:
        scaled = (-(w[:, None] ** 2) * changed[:, :, 0] - measured) / unit
        return np.concatenate([scaled.real.ravel(), scaled.imag.ravel()])

    whole = compliance()
    whole_size = np.linalg.norm(measured / unit)

    def at(place: Array, impedance: Array) -> Array:  # a change of rank one (Sherman and Morrison)
        seen = whole @ place
        factor = impedance / (1.0 + impedance * (seen @ place))
        return np.asarray(whole - factor[:, None, None] * seen[:, :, None] * seen[:, None, :])

    alone = {f"sensor {i + 1}": row for i, row in enumerate(np.eye(3))}
    one, two, three = alone.values()
    between = {"sensors 2 and 3 (the joint)": two - three, "sensors 1 and 2": one - two, "sensors 1 and 3": one - three}
    out = {"nothing": float(np.linalg.norm(left(whole)) / whole_size)}

    def spring(x: Array, place: Array) -> Array:
        return left(at(place, 1e4 * x[0] + 100j * w * x[1]))

    def mass(x: Array, place: Array) -> Array:
        return left(at(place, -(w**2) * x[0] + 100j * w * x[1]))

    def error(residual: Callable[..., Array], starts: Sequence[tuple[float, float]], *given: Array) -> float:
        return float(min(np.linalg.norm(least_squares(residual, x, args=given).fun) for x in starts) / whole_size)

    for name, place in (between | alone).items():
        out[f"spring and damper, {name}"] = error(spring, ((-0.1, 0.1), (0.1, 0.1), (-0.5, 0.5), (-2.0, 1.0)), place)
    for name, place in alone.items():
        out[f"mass and damper, {name}"] = error(mass, ((0.1, 0.1), (1.0, 0.1), (5.0, 0.5)), place)
    out["all alike"] = error(lambda x: left(compliance(*x)), ((-0.01, 0.1),))
    return out


def structure_file(frequencies_hz: Array, damping: Array, shapes: Array) -> dict[str, Any]:
    """Build the content of a structure file from modes: the first three of m degrees of freedom are the sensors.

    The other degrees of freedom complete the sensors' shapes to a basis, so that the model has exactly these modes.  Two
    stiffnesses are watched: the joint between the sensors 2 and 3, and all else, which scales the whole matrix.
    """
    m = frequencies_hz.size
    unseen = np.linalg.svd(shapes)[2][3:]
    size = np.abs(shapes).max()
    inverse = np.linalg.inv(np.vstack([shapes, size * unseen]))
    mass = inverse.T @ inverse
    stiffness = inverse.T @ np.diag((2.0 * np.pi * frequencies_hz) ** 2) @ inverse
    spring = np.zeros(m)
    spring[list(JOINT)] = 1.0, -1.0
    joint = -float(stiffness[JOINT])
    whole = float(np.trace(stiffness)) / m
    return {
        "structure": {
            "kind": "matrices",
            "name": "F-16, right wing",
            "mass_matrix": mass.tolist(),
            "stiffness_matrix": stiffness.tolist(),
            "stiffness_n_per_m": [abs(joint), whole],
            "stiffness_derivatives": [np.outer(spring, spring).tolist(), (stiffness / whole).tolist()],
            "story_names": ["joint of wing and payload", "all else"],
            "modal_damping_ratio": damping.tolist(),
        },
        "sensors": [{"channel": name, "floor": i} for i, name in enumerate(CHANNELS, start=1)],
        "inputs": [{"channel": "f1", "floor": 1}],
        "processing": {"rate_hz": 50.0, "cutoff_hz": 16.0, "window_s": 100.0},
    }


def main() -> None:
    """Identify, calibrate and diagnose; print what is said of every level."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.f16", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--force", action="store_true", help="use the force as a known input")
    parser.add_argument("--levels", type=int, nargs="+", choices=LEVELS[1:], default=LEVELS[1:])
    parser.add_argument("--single", action="store_true", help="tell what a change at one place alone can explain")
    parser.add_argument("--out", type=Path, help="append a JSON line a level")
    options = parser.parse_args()
    tests = {level: read(options.folder / f"F16_FM_Level{level}.mat") for level in LEVELS}
    hz, accelerance = tests[1].accelerance()
    frequencies_hz, damping, shapes = identify_modes(hz, accelerance)
    for f, z, shape in zip(frequencies_hz, damping, shapes.T, strict=True):
        print(f"mode {f:6.2f} Hz, damping {100 * z:5.2f} %, shape {shape / np.abs(shape).max()}")
    if options.single:
        for level, test in tests.items():
            errors = errors_of_single_changes(test, frequencies_hz, damping, shapes)
            print(f"level {level}:", ", ".join(f"{name} {error:.3f}" for name, error in errors.items()))
        return
    config = Configuration.model_validate(structure_file(frequencies_hz, damping, shapes))
    with threadpool_limits(limits=1):
        prior = diagnose.learn_healthy_prior(
            gather(tests[1].blocks(with_force=options.force), config.front_end()), config
        )
        standing = [(e.name, e.location, e.values()) for e in prior.effects(prior.mean)]
        print("standing at level 1:", standing, flush=True)
        for level in options.levels:
            began = perf_counter()
            blocks = tests[level].blocks(with_force=options.force)
            found, gain = diagnose.diagnose_segments(gather(blocks, config.front_end()), prior, config)
            result = {
                "level": level,
                "verdict": found.verdict,
                "causes": [[c.effect.name, c.effect.location, c.effect.values(), c.std] for c in found.causes],
                "alternatives": [[c.effect.name, c.effect.location, float(p)] for c, p in found.alternatives],
                "left_over": [[m.where, float(m.size), m.says] for m in found.left_over[:5]],
                "nats_a_sample": gain.value,
                "seconds": round(perf_counter() - began, 1),
            }
            print(json.dumps(result), flush=True)
            if options.out is not None:
                with options.out.open("a") as out:
                    out.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
