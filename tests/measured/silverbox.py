"""Diagnosis of the Silverbox, a measured circuit that behaves as a mass on a hardening spring, from its output alone.

    .venv/bin/python -m tests.measured.silverbox SNLS80mV.mat [--part multisine|arrow|all] [--cutoff 40 15]

The user's own download of the data (nonlinearbenchmark.org) is read; it is no part of the repository.  The output voltage is
taken for a displacement in m, differentiated twice in the frequency domain and stretched in time ten times, so that the
circuit is a structure of 1 kg at 6.83 Hz.  Its forces end at 20 Hz (multisine) or fall from 18 Hz on (arrow).  Input and output
together give k3 / k = 3.98 per square meter; nothing of the input is used here.

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
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION
from monitor.config.configuration import Configuration
from monitor.diagnosis import content
from monitor.inference.segments import gather
from monitor.runs import diagnose
from monitor.runs.synthetic_recording import cut_into_blocks

RATE_HZ = 1e7 / 2**14 / 10.0
"""Rate of the samples, stretched in time. [Hz]"""
PARTS = {"arrow": slice(0, 40_000), "multisine": slice(41_000, None), "all": slice(None)}
"""Samples of filtered noise whose level rises, and of ten multisines."""
RATIO = 3.98
"""k3 / k from input and output. [1/m^2]"""
DRAWN_HZ = 6.8


def drawing(cutoff_hz: float) -> Configuration:
    """Make the structure file: one mass on one spring."""
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
    return Configuration.model_validate(tomllib.loads(text))


def acceleration(path: Path, part: str) -> np.ndarray:
    """Differentiate the output twice, shape (n_samples, 1), m/s^2."""
    y = loadmat(path)["V2"].ravel().astype(float)
    omega = 2.0 * np.pi * np.fft.rfftfreq(y.size, 1.0 / RATE_HZ)
    return np.fft.irfft(-(omega**2) * np.fft.rfft(y - y.mean()), n=y.size)[PARTS[part], None]


def main() -> None:
    """Print band, verdict, causes and the cubic stiffness for every cutoff."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.silverbox")
    parser.add_argument("file", type=Path)
    parser.add_argument("--part", choices=PARTS, default="multisine")
    parser.add_argument("--cutoff", type=float, nargs="+", default=[40.0, 15.0], help="[processing] cutoff_hz")
    options = parser.parse_args()
    samples = acceleration(options.file, options.part)
    for cutoff_hz in options.cutoff:
        config = drawing(cutoff_hz)
        blocks = cut_into_blocks(ACCELERATION, samples, config.channels, RATE_HZ, 10**18, 512)
        segments = gather(blocks, config.front_end())
        with threadpool_limits(limits=1):
            found, gain = diagnose.diagnose_segments(segments, diagnose._drawing_prior(config), config)
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
                print(f"  k3 / k = {value:.2f} +- {std:.2f} per m^2; true {RATIO}")


if __name__ == "__main__":
    main()
