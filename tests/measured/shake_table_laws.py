"""What law the stories of the shake-table frames follow, straight from the data: secant stiffness and loss by the drift.

    .venv/bin/python -m tests.measured.shake_table_laws [--kind flexible|stiff]

The force of a story is the inertia of the floors above it, its drift the difference of two floors' accelerations integrated
twice, both in a band.  First the secant stiffness and the loss factor at the first mode, by stretches of 2 s, the more the
story drifts; then how much of the force in a wider band different laws leave, each fitted by least squares.  The masses are
those of the structure file, the delays of the sensors' clocks those that ``diagnose`` names.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import ACCELERATION, GROUND
from drivers.mcap_file import read_recordings
from monitor.core import compiled
from tests.measured.sensor_faults import FRAMES, RECORDINGS, configuration

Array = NDArray[np.float64]

RATE_HZ = 120.0
DELAYS_S = {"flexible": (1.8e-3, 0.0, 0.0), "stiff": (1.8e-3, 0.57e-3, 0.0)}
"""By which channels a1, a2 and a3 come late, as ``diagnose`` names them."""
FIRST_BAND_HZ = {"flexible": (2.5, 5.5), "stiff": (5.5, 11.0)}
WIDE_BAND_HZ = {"flexible": (1.2, 25.0), "stiff": (1.2, 45.0)}
STRETCH_N = 240
GROUPS = 8
SLIP_M = 10.0 ** np.arange(-4.4, -1.19, 0.2)
"""Drifts at which elements slip."""
EXPONENT = 0.5
"""Of the shares of elements that slip at all drifts, over the drift."""


@dataclass(frozen=True, eq=False)
class Series:
    """Of every story, from the top: shape (3, n) each."""

    force_n: Array
    drift_m: Array
    velocity_m_s: Array


def accelerations(kind: str) -> Array:
    """Read the floors' and the table's accelerations, shape (4, n), without the delays of the clocks."""
    found: dict[str, list[Array]] = {ACCELERATION: [], GROUND: []}
    for block in read_recordings([RECORDINGS / f"mini-shake-table-{kind}.mcap"]):
        if block.topic in found:
            found[block.topic].append(np.asarray(block.samples, dtype=float))
    floors, ground = (np.concatenate(found[topic]) for topic in (ACCELERATION, GROUND))
    n = min(len(floors), len(ground))
    return np.vstack([floors[:n].T, ground[:n].T])


def in_band(x: Array, band_hz: tuple[float, float], order: int = 0, delay_s: float = 0.0) -> Array:
    """Filter a series to a band, and differentiate it `order` times (a negative order integrates)."""
    hz = np.fft.rfftfreq(x.size, 1.0 / RATE_HZ)
    low, high = band_hz
    rise, fall = np.clip((hz / low - 0.8) / 0.2, 0.0, 1.0), np.clip((1.2 - hz / high) / 0.2, 0.0, 1.0)
    weight = np.sin(0.5 * np.pi * rise * fall) ** 2
    factor = (2j * np.pi * np.where(hz > 0.0, hz, 1.0)) ** order
    return np.fft.irfft(np.fft.rfft(x - x.mean()) * weight * factor * np.exp(2j * np.pi * hz * delay_s), x.size)


def series(kind: str, band_hz: tuple[float, float]) -> Series:
    """Compute forces, drifts and their rates."""
    a, delays = accelerations(kind), (*DELAYS_S[kind], 0.0)
    acceleration, velocity, drift = (
        np.array([in_band(x, band_hz, order, delay) for x, delay in zip(a, delays, strict=True)])
        for order in (0, -1, -2)
    )
    masses = np.asarray(configuration(kind).model().structure.masses_kg)
    force = -np.cumsum(masses[:, None] * acceleration[:3], axis=0)
    return Series(force, drift[:3] - drift[1:], velocity[:3] - velocity[1:])


@compiled()
def slip(drift_m: Array, slip_m: float) -> Array:
    """Integrate an element of unit stiffness that slips (Bouc and Wen, sharpness 2), in as fine steps as it needs."""
    out = np.empty_like(drift_m)
    z, before = 0.0, drift_m[0]
    for i in range(drift_m.size):
        step = (drift_m[i] - before) / slip_m
        before = drift_m[i]
        n = int(abs(step) * 8.0) + 1
        for _ in range(n):
            z += step / n * (1.0 - z * z if z * step > 0.0 else 1.0)
            z = max(-1.0, min(1.0, z))
        out[i] = z * slip_m
    return out


def by_drift(s: Series, j: int) -> None:
    """Print secant stiffness and loss factor of a story, the more it drifts."""
    rows = []
    for first in range(0, s.force_n.shape[1] - STRETCH_N, STRETCH_N // 2):
        at = slice(first, first + STRETCH_N)
        d, v = s.drift_m[j, at], s.velocity_m_s[j, at]
        (k, c), *_ = np.linalg.lstsq(np.column_stack([d, v]), s.force_n[j, at], rcond=None)
        rows.append((np.sqrt(2.0) * d.std(), k, c * v.std() / d.std() / k))
    table = np.array(sorted(rows))
    print(f"story {j + 1}: amplitude of the drift, mm | secant stiffness, N/m | loss factor, %")
    for group in np.array_split(table, GROUPS):
        amplitude, (k, loss) = group[:, 0].mean(), np.median(group[:, 1:], axis=0)
        k_std, loss_std = 1.25 * group[:, 1:].std(axis=0) / np.sqrt(len(group))
        print(f"  {1e3 * amplitude:7.3f} | {k:7.1f} +- {k_std:.1f} | {100.0 * loss:5.2f} +- {100.0 * loss_std:.2f}")


def left_by_laws(s: Series, j: int, band_hz: tuple[float, float]) -> None:
    """Print the part of a story's force, RMS over RMS, that laws leave."""
    d, v = s.drift_m[j], s.velocity_m_s[j]
    inner = slice(STRETCH_N, -STRETCH_N)

    def left(*laws: Array) -> tuple[float, Array]:
        columns = [*s.drift_m, *s.velocity_m_s, *(in_band(x, band_hz) for x in laws)]
        design = np.array(columns).T[inner]
        scale = design.std(axis=0)
        x, *_ = np.linalg.lstsq(design / scale, s.force_n[j, inner], rcond=None)
        rest = s.force_n[j, inner] - design / scale @ x
        return float(rest.std() / s.force_n[j, inner].std()), x / scale

    drag, square, cube = v * np.abs(v), d**2, d**3
    elements = [slip(d, y) for y in SLIP_M]
    everywhere = sum((y / 1e-3) ** EXPONENT * e for y, e in zip(SLIP_M, elements, strict=True))
    one = min(range(SLIP_M.size), key=lambda i: left(square, elements[i])[0])
    with_cube = min(range(SLIP_M.size), key=lambda i: left(square, cube, elements[i])[0])
    at_all, x = left(square, cube, everywhere)
    print(
        f"  left of the force, %: linear {100 * left()[0]:.2f}; square and cube {100 * left(square, cube)[0]:.2f}; "
        f"and drag {100 * left(square, cube, drag)[0]:.2f}\n"
        f"  square and slip at {1e3 * SLIP_M[one]:.1f} mm {100 * left(square, elements[one])[0]:.2f}; "
        f"square, cube and slip at {1e3 * SLIP_M[with_cube]:.1f} mm {100 * left(square, cube, elements[with_cube])[0]:.2f}\n"
        f"  square, cube and slip at all drifts {100 * at_all:.2f}, k2 {x[6]:.3g} N/m^2, k3 {x[7]:.3g} N/m^3; "
        f"and drag {100 * left(square, cube, everywhere, drag)[0]:.2f}"
    )


def main() -> None:
    """Print the laws of every story."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.shake_table_laws", description=__doc__)
    parser.add_argument("--kind", choices=FRAMES, action="append", help="one frame; both by default")
    for kind in parser.parse_args().kind or FRAMES:
        print(kind)
        first, wide = series(kind, FIRST_BAND_HZ[kind]), series(kind, WIDE_BAND_HZ[kind])
        for j in range(3):
            by_drift(first, j)
            left_by_laws(wide, j, WIDE_BAND_HZ[kind])


if __name__ == "__main__":
    main()
