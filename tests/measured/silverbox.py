"""Diagnosis of the Silverbox, a measured circuit that behaves as a mass on a hardening spring.

    .venv/bin/python -m tests.measured.silverbox SNLS80mV.mat [--part multisine|arrow|all] [--input] [--twin SEED]

The user's own download of the data (nonlinearbenchmark.org) is read; it is no part of the repository.  The output voltage is
taken for a displacement in m, differentiated twice in the frequency domain and stretched in time ten times, so that the
circuit is a structure of 1 kg at 6.83 Hz.  Its forces end at 20 Hz (multisine) or fall from 18 Hz on (arrow).  Input and output
together give k3 / k = 3.98 per square meter.  With ``--input`` the input voltage is the measured force, in N by the static
compliance of the quietest samples; then the output of the arrow is predicted from its input and the structure file that
``diagnose`` writes.  With ``--twin`` a simulation of that law, under random noise of the input's spectrum and level, takes the
place of the measurement: what an estimate from these data can be at best.

References
----------
T. Wigren, J. Schoukens, Three free data sets for development and benchmarking in nonlinear system identification, European
Control Conference (2013).
"""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.ndimage import uniform_filter1d
from scipy.signal import resample_poly
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, FORCE, SampleBlock
from monitor.config import Configuration
from monitor.diagnosis import content, fitted_model, structure_text
from monitor.inference import gather
from monitor.model import Model, prior_from_drawing
from monitor.runs import cut_into_blocks, diagnose

RATE_HZ = 1e7 / 2**14 / 10.0
"""Rate of the samples, stretched in time. [Hz]"""
PARTS = {"arrow": slice(0, 40_000), "multisine": slice(41_000, None), "all": slice(None)}
"""Samples of filtered noise whose level rises, and of ten multisines."""
RATIO = 3.98
"""k3 / k from input and output. [1/m^2]"""
DRAWN_HZ = 6.8
FINER = 16
"""Steps of the integration for a sample."""
LEVEL_S = 20.0
"""Of the moving average that tells the input's level."""
QUIET = slice(4_000, 12_000)
"""Samples of the arrow at a low level."""


def drawing(cutoff_hz: float, *, with_input: bool) -> str:
    """Write the structure file: one mass on one spring."""
    stiffness = (2.0 * np.pi * DRAWN_HZ) ** 2
    text = f"""
    [structure]
    kind = "shear_frame"
    masses_kg = [1.0]
    stiffness_n_per_m = [{stiffness:.6f}]
    damping_ratio = 0.05
    [[sensors]]
    channel = "a1"
    floor = 1
    [processing]
    cutoff_hz = {cutoff_hz}
    """
    text += (
        """
    [[inputs]]
    channel = "f1"
    floor = 1
    """
        * with_input
    )
    return text


def read_back(text: str) -> Configuration:
    """Read a structure file."""
    return Configuration.model_validate(tomllib.loads(text))


def voltages(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read input and output without their means, shape (n_samples,) each, V."""
    content = loadmat(path)
    return tuple(content[name].ravel().astype(float) - content[name].mean() for name in ("V1", "V2"))


def acceleration(y: np.ndarray) -> np.ndarray:
    """Differentiate the output twice, shape (n_samples,), m/s^2."""
    omega = 2.0 * np.pi * np.fft.rfftfreq(y.size, 1.0 / RATE_HZ)
    return np.fft.irfft(-(omega**2) * np.fft.rfft(y), n=y.size)


def linear_fit(u: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Fit 1 kg y'' + c y' + k y = a u to quiet samples below 10 Hz; return a (N/V), k and c."""
    hz = np.fft.rfftfreq(y[QUIET].size, 1.0 / RATE_HZ)
    taper = np.hanning(y[QUIET].size)
    low = (hz > 1.0) & (hz < 10.0)
    forced, moved, pulled = (np.fft.rfft(taper * x[QUIET])[low] for x in (u, y, acceleration(y)))
    a = np.column_stack([forced, -moved, -2j * np.pi * hz[low] * moved])
    x, *_ = np.linalg.lstsq(np.concatenate([a.real, a.imag]), np.r_[pulled.real, pulled.imag], rcond=None)
    a, k, c = map(float, x)
    return a, k, c


def surrogate(u: np.ndarray, seed: int) -> np.ndarray:
    """Draw random noise with the spectrum and the level of the input over time, shape (n_samples,), V."""
    n = round(LEVEL_S * RATE_HZ)
    level = np.sqrt(np.maximum(uniform_filter1d(u**2, n), 1e-12))
    density = uniform_filter1d(np.abs(np.fft.rfft(u / level)) ** 2, round(u.size / (10.0 * RATE_HZ)))
    noise = np.fft.rfft(np.random.default_rng(seed).standard_normal(u.size))
    shaped = np.fft.irfft(noise * np.sqrt(density), n=u.size)
    return level * shaped / shaped.std()


def predicted(force: np.ndarray, model: Model) -> np.ndarray:
    """Integrate the displacement of the extended structure under a force, shape (n_samples,), m."""
    structure = model.structure
    mass, k = float(structure.masses_kg[0]), float(structure.stiffness_n_per_m[0])
    k3 = sum(e.values().get("k3_n_per_m3", 0.0) for e in model.effects)
    c = 2.0 * float(model.modal_damping[0]) * np.sqrt(k * mass)
    c += sum(e.values().get("damping_n_s_per_m", 0.0) for e in model.effects)
    return integrated(force, mass, c, k, k3)


def integrated(force: np.ndarray, mass: float, c: float, k: float, k3: float) -> np.ndarray:
    """Integrate the displacement of a mass on a cubic spring under a force, shape (n_samples,), m."""
    fine = resample_poly(force, FINER, 1)
    h, x, v = 1.0 / (FINER * RATE_HZ), 0.0, 0.0
    out = np.empty(fine.size)
    for i, f in enumerate(fine):  # leapfrog, damping at the half step
        out[i] = x
        v = ((1.0 - 0.5 * h * c / mass) * v + h / mass * (f - k * x - k3 * x**3)) / (1.0 + 0.5 * h * c / mass)
        x += h * v
    return out[::FINER]


def main() -> None:
    """Print band, verdict, causes and the cubic stiffness for every cutoff."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.silverbox")
    parser.add_argument("file", type=Path)
    parser.add_argument("--part", choices=PARTS, default="multisine")
    parser.add_argument("--cutoff", type=float, nargs="+", default=[40.0, 15.0], help="[processing] cutoff_hz")
    parser.add_argument("--input", action="store_true", help="use the input as a measured force")
    parser.add_argument("--twin", type=int, metavar="SEED", help="simulate the known law under a random input instead")
    options = parser.parse_args()
    u, y = voltages(options.file)
    newton, k, c = linear_fit(u, y)
    if options.twin is not None:
        u = surrogate(u, options.twin)
        y = integrated(newton * u, 1.0, c, k, RATIO * k)
    part, force = PARTS[options.part], newton * u
    for cutoff_hz in options.cutoff:
        drawn = drawing(cutoff_hz, with_input=options.input)
        config = read_back(drawn)
        blocks: list[SampleBlock] = [
            *cut_into_blocks(ACCELERATION, acceleration(y)[part, None], config.channels, RATE_HZ, 10**18, 512)
        ]
        if options.input:
            blocks += cut_into_blocks(FORCE, force[part, None], ("f1",), RATE_HZ, 10**18, 512, unit="N")
        segments = gather(sorted(blocks, key=lambda b: b.t_ns), config.front_end())
        prior = prior_from_drawing(config.model(), config.instrumented().prior_std, len(config.channels))
        with threadpool_limits(limits=1):
            found, gain = diagnose.diagnose_segments(segments, prior, config)
        told = content(found, gain, (), {})
        print(f"cutoff {cutoff_hz:g} Hz: {told['verdict']}; {told['says']}")
        print(f"  band {told['band']}")
        print(f"  family {told['family']}, log odds {told['family_log_odds']}; held-out gain {gain.nats:.0f} nats")
        for c in told["causes"] + told["alternatives"]:
            print(f"  {c['effect']} {c['location']} {c.get('probability', '')} {c['says']}")
        for k, candidates in enumerate(found.rounds, 1):
            for c in candidates[:4]:
                print(f"    round {k}: {c.effect.name} {c.effect.location}: log evidence {c.log_evidence:.1f}")
        for m in told["left_over"][:4]:
            print(f"    left over: {m['where']}: {m['size']:.1f}")
        stiffness = found.posterior.context_at(found.final_fit.x).structure.stiffness_n_per_m[0]
        for c in told["causes"] + told["alternatives"]:
            k3 = c["parameters"].get("k3_n_per_m3")
            if k3 is not None:
                value, std = k3["value"] / stiffness, k3["std"] / stiffness
                print(f"  k3 / k = {value:.3f} +- {std:.3f} per m^2; true {RATIO}")
        if options.input:
            arrow = PARTS["arrow"]
            for name, fit in (("updated", found.null_fit), ("extended", found.final_fit)):
                written = structure_text(drawn, fitted_model(found.posterior, fit))
                error = predicted(force[arrow], read_back(written).model()) - y[arrow]
                print(f"  arrow predicted by the {name} structure: RMSE {1e3 * np.sqrt(np.mean(error**2)):.2f} mV")


if __name__ == "__main__":
    main()
