"""Cross-spectra that a model predicts for a recording's segments: ``S = R T H Q H^H T^H R^H + lines + noise``.

H is the accelerance of the floors, Q the density of the forces, T picks the channels, and R is the frequency response of the
acquisition.  The result is convolved with the kernel of the segments' taper (debiased Whittle), so that it is the expectation
of their mean cross-spectra.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq

from monitor.core import Array, ComplexArray, compiled
from monitor.inference.arrays import Spectrum
from monitor.inference.trial import require_finite
from monitor.model import Condition, Context, Effect, ExtraMode, System, place_index
from monitor.signals import LEAKAGE_OFFSETS, hann_amplitude, leakage

T = TypeVar("T")
_TAPS = leakage()
_FREQUENCY_BLOCK = 64
"""Frequencies whose systems are solved together. [count; cost]"""
_LOWEST_HZ = 0.05
"""Frequency from which the ground's variance is integrated. [Hz; judgement]"""
_LOG_STEPS = 4000
"""Steps of that integral. [count; cost]"""
_N_RESPONSES = 24
"""Frequency responses that are kept. [count; cost: those of the classes of a recording, and some moved ones]"""


@dataclass(frozen=True, eq=False, slots=True)
class Band:
    """Band of frequencies in which model and recording are compared."""

    first: int
    """Index of the first bin."""
    n_bins: int
    bin_hz: float
    """Spacing of the bins, the reciprocal of the segments' length, Hz."""
    gain: Annotated[Array, "bins"]
    """Power gain of the anti-alias filter at the bins."""
    forces_hz: tuple[float, float] = (0.0, np.inf)
    """Frequencies at which the recording shows that the forces begin and end, Hz."""

    def part(self, chosen: slice, forces_hz: tuple[float, float]) -> Band:
        """Return some of the bins, and where the forces begin and end."""
        return Band(self.first + chosen.start, chosen.stop - chosen.start, self.bin_hz, self.gain[chosen], forces_hz)

    def forced(self, hz: Array) -> NDArray[np.bool_]:
        """Select the frequencies (Hz) at which forces act."""
        return np.asarray((hz >= self.forces_hz[0]) & (hz <= self.forces_hz[1]))

    @property
    def hz(self) -> Annotated[Array, "bins"]:
        """Frequencies of the bins, Hz."""
        return np.asarray((self.first + np.arange(self.n_bins)) * self.bin_hz)

    @property
    def fine_hz(self) -> Annotated[Array, "fine"]:
        """Grid of half-bin spacing that extends beyond the band by the width of the taper's kernel, Hz."""
        low, high = LEAKAGE_OFFSETS[0], 2 * (self.n_bins - 1) + LEAKAGE_OFFSETS[-1]
        return np.asarray((2 * self.first + np.arange(low, high + 1)) * (0.5 * self.bin_hz))


@dataclass(frozen=True, eq=False, slots=True)
class Excitation:
    """Excitation of the structure and noise of its sensors, as two-sided power densities."""

    force: Annotated[Array, "n"]
    """White forces on the floors, N^2/Hz."""
    noise: Annotated[Array, "c"]
    """White noise of the channels, (m/s^2)^2/Hz."""
    ground_noise: float = 0.0
    """White noise of a measured ground motion, which the prediction treats as motion, (m/s^2)^2/Hz."""


def modally_damped(mass: Annotated[Array, "n n"], stiffness: Annotated[Array, "n n"], ratios: Array) -> System:
    """Make the linear system with given damping ratios of its modes (kg, N/m).

    Raises LinAlgError if the mass matrix is not positive definite, or an entry is not finite.
    """
    require_finite(mass, stiffness)
    eigenvalues, shapes = eigh(stiffness, mass)
    carried = mass @ shapes
    return System(mass, (carried * (2.0 * ratios * np.sqrt(np.maximum(eigenvalues, 0.0)))) @ carried.T, stiffness)


def extended(system: System, effects: Sequence[Effect], context: Context, condition: Condition) -> System:
    """Add to the system what effects contribute at a condition."""
    for effect in effects:
        system = effect.extend(system, context, condition)
    return system


def cross_spectra(
    system: System,
    effects: Sequence[Effect],
    excitation: Excitation,
    band: Band,
    context: Context,
    condition: Condition,
) -> Spectrum:
    """Compute the expected cross-spectra of the segments."""
    random = random_spectra(system, effects, excitation, band, context, condition)
    return random + line_spectra(system, effects, band, context, condition)


def random_spectra(
    system: System,
    effects: Sequence[Effect],
    excitation: Excitation,
    band: Band,
    context: Context,
    condition: Condition,
) -> Spectrum:
    """Compute the part of the segments' cross-spectra that is random motion and noise."""
    fine, force = band.fine_hz, excitation.force
    answer = seen(system, effects, fine, context, condition)
    mean_force, n_extra = float(force.mean()), answer.shape[2] - force.size - 1
    colour = force_colour(effects, fine * clock_ratio(effects))
    share = sum(e.ground_share for e in effects)
    ground = excitation.ground_noise
    if share > 0.0:
        ground += condition.ground * ground_density(share, system, force, effects, context, condition)
    if any(e.common_force for e in effects):
        shared = answer[:, :, : force.size] @ force_root(force, effects)
        answer = np.concatenate([shared, answer[:, :, force.size :]], axis=2)
        force = np.ones(force.size + 1)
    own = np.ones(n_extra)
    own[: len(system.coupled)] = [mode.force_ratio for mode in system.coupled]
    density = np.column_stack([force * colour[:, None], np.full(fine.size, ground), np.outer(colour, mean_force * own)])
    spectra = blurred_products(answer, density, _TAPS)
    noise = excitation.noise + noise_density(effects, context, condition)
    diagonal = np.arange(noise.size)
    spectra[:, diagonal, diagonal] += noise
    return np.asarray(spectra * band.gain[:, None, None])


def noise_density(effects: Sequence[Effect], context: Context, condition: Condition) -> Annotated[Array, "c"]:
    """Compute the density of the white noise that effects add to the channels, (m/s^2)^2/Hz."""
    variance = sum((e.noise_variance(context, condition) for e in effects), np.zeros(len(context.channels)))
    return np.asarray(variance) / context.rate_hz


def line_spectra(
    system: System, effects: Sequence[Effect], band: Band, context: Context, condition: Condition
) -> Spectrum:
    """Compute the part of the segments' cross-spectra that harmonic forces cause."""
    c, clock = len(context.channels), clock_ratio(effects)
    spectra = np.zeros((band.n_bins, c, c), dtype=complex)
    for line in (line for effect in effects for line in effect.lines()):
        at = np.array([line.frequency_hz / clock])
        y = seen(system, effects, at, context, condition)[0, :, place_index(line.location, context.structure)]
        offset = (band.hz - at) / band.bin_hz
        power = line.force_n**2 / 4.0 * (8.0 / 3.0) / band.bin_hz * hann_amplitude(offset) ** 2
        spectra += power[:, None, None] * np.outer(y, y.conj())
    return np.asarray(spectra * band.gain[:, None, None])


def extra_mode_spectra(
    modes: Sequence[ExtraMode],
    effects: Sequence[Effect],
    force: float,
    band: Band,
    context: Context,
    condition: Condition,
) -> Spectrum:
    """Compute the part of the segments' cross-spectra that extra modes cause.

    `effects` are all of the model; `force` is the mean density of the floors' forces, which is that on every mode, N^2/Hz.
    """
    clock, fine = clock_ratio(effects), band.fine_hz
    answer = recorded(extra_mode_response(modes, clock * fine, context), effects, clock * fine, context, condition)
    density = np.outer(force_colour(effects, clock * fine), np.full(len(modes), force))
    return np.asarray(blurred_products(answer, density, _TAPS) * band.gain[:, None, None])


def clock_ratio(effects: Sequence[Effect]) -> float:
    """Compute the ratio of the true rate to the nominal one."""
    return float(np.prod([e.clock_factor for e in effects]))


def seen(
    system: System, effects: Sequence[Effect], hz: Array, context: Context, condition: Condition
) -> Annotated[ComplexArray, "hz c n+1+extra"]:
    """Compute the frequency response of the recorded channels, with the effects of the acquisition.

    Its columns are for forces on the floors, a ground acceleration, then a force on each coupled and each extra mode.
    `hz` are frequencies by the acquisition's clock.
    """
    true_hz = clock_ratio(effects) * hz
    answer = channel_response(system, true_hz, context)
    modes = [mode for effect in effects for mode in effect.extra_modes(context)]
    if modes:
        answer = np.concatenate([answer, extra_mode_response(modes, true_hz, context)], axis=2)
    return recorded(answer, effects, true_hz, context, condition)


def recorded(
    answer: ComplexArray, effects: Sequence[Effect], hz: Array, context: Context, condition: Condition
) -> ComplexArray:
    """Apply the effects of the acquisition to the true accelerations at the sensors, shape (n_hz, c, columns)."""
    for effect in effects:
        response = effect.response(hz, context, condition)
        if response is not None:
            answer = response @ answer
    return answer


def channel_response(system: System, hz: Array, context: Context) -> Annotated[ComplexArray, "hz c n+1+coupled"]:
    """Compute the frequency response of the true accelerations at the sensors.

    Its columns are for forces on the floors, for a ground acceleration, then for a force on each coupled mode of the system.
    """
    return _response(hz, *_observed(system, context))


def _observed(system: System, context: Context) -> tuple[Array, ...]:
    """List the arrays of a system and of its channels, see `_response`."""
    n = context.structure.n_dofs
    columns = np.insert(system.forced(n), n, -system.inertia, axis=1)
    own = context.sensors, context.structure.rides
    return system.mass, system.damping, system.stiffness, columns, system.sensors(context.sensors), *own


def _response(
    hz: Array,
    mass: Array,
    damping: Array,
    stiffness: Array,
    columns: Array,
    sensors: Array,
    of_floors: Array,
    rides: Array,
) -> ComplexArray:
    """Compute `channel_response`; the ground's column is that after the n floors'.

    `columns` are the forces on the degrees of freedom, `sensors` the shares of these in every channel, `of_floors` those of the
    floors alone, and `rides` the share of the ground's own acceleration that each of the floors has.
    """
    floors = _floor_response(mass, damping, stiffness, columns, hz)
    shares = np.ascontiguousarray(sensors, dtype=float)
    return np.asarray(_at_sensors(floors, shares, rides.size, of_floors @ rides))


def _kept(compute: Callable[..., T]) -> Callable[..., T]:
    """Keep the latest results of a function of arrays, by their numbers: most slopes of a fit move none of them."""

    @lru_cache(maxsize=_N_RESPONSES)
    def of_bytes(*arrays: tuple[bytes, tuple[int, ...]]) -> T:
        return compute(*(np.frombuffer(data).reshape(shape).copy() for data, shape in arrays))

    return lambda *arrays: of_bytes(*((np.asarray(a, dtype=float).tobytes(), np.shape(a)) for a in arrays))


@_kept
def _floor_response(mass: Array, damping: Array, stiffness: Array, columns: Array, hz: Array) -> ComplexArray:
    """Compute the `accelerance` at frequencies in Hz; sensors may move while the system stays."""
    return np.asarray(accelerance(mass, damping, stiffness, 2.0 * np.pi * hz, columns))


@_kept
def _integrated_products(
    colour: Array, rate_hz: float, band_hz: float, *observed: Array
) -> tuple[Annotated[Array, "c n n"], Annotated[Array, "c n n"], Annotated[Array, "c"]]:
    """Integrate the products of the channels' responses to two forces, and their squared responses to the ground.

    The classes of a recording differ by the density of the forces alone, which weights these products.  The first result is over
    all frequencies, the second over those above `band_hz`.  `colour` is the factor on the forces' density at `_integration_hz`.
    """
    hz, n = _integration_hz(rate_hz), observed[-1].size
    answer = _response(hz, *observed).transpose(1, 2, 0)
    weight = 2.0 * hz * np.gradient(np.log(hz))
    forced, coloured = answer[:, :n], weight * colour
    by_pair, above = (
        ((w * forced) @ forced.conj().transpose(0, 2, 1)).real for w in (coloured, coloured * (hz > band_hz))
    )
    return by_pair, above, np.abs(answer[:, n]) ** 2 @ weight


def _integration_hz(rate_hz: float) -> Array:
    """Return the frequencies of the integrals of variance, Hz; equal steps of the logarithm follow the peaks' width."""
    return np.exp(np.linspace(np.log(_LOWEST_HZ), np.log(0.5 * rate_hz), _LOG_STEPS))


def extra_mode_response(modes: Sequence[ExtraMode], hz: Array, context: Context) -> ComplexArray:
    """Compute the frequency response of the true accelerations to a force on each extra mode, (n_hz, c, n_modes)."""
    shapes = np.array([mode.shape for mode in modes]).reshape(len(modes), len(context.channels))
    return np.asarray(oscillator_response(modes, hz)[:, None, :] * shapes.T)


def oscillator_response(modes: Sequence[ExtraMode], hz: Array) -> Annotated[ComplexArray, "hz modes"]:
    """Compute the accelerance of an oscillator of one kilogram with the frequency and the damping of every mode, 1/kg."""
    f, ratio = np.array([(mode.frequency_hz, mode.damping_ratio) for mode in modes]).reshape(-1, 2).T
    squared = (hz**2)[:, None]
    return np.asarray(squared / (squared - f**2 - 2.0j * ratio * f * hz[:, None]))


def force_colour(effects: Sequence[Effect], hz: Array) -> Array:
    """Compute the factor on the power density of the floors' forces, shape (n_hz,)."""
    colour = np.ones(hz.size)
    for effect in effects:
        colour = colour * effect.colour(hz)
    return colour


def force_root(force: Annotated[Array, "n"], effects: Sequence[Effect]) -> Annotated[Array, "n columns"]:
    """Compute a root of the floors' force densities: the forces as sums of independent sources of density one.

    It has one column more than floors where a part of the forces is common to all floors.
    """
    root, common = np.sqrt(force), sum(e.common_force for e in effects)
    if common == 0.0:
        return np.diag(root)
    return np.column_stack([np.diag(np.sqrt(1.0 - common) * root), np.sqrt(common) * root])


def ground_density(
    share: float, system: System, force: Array, effects: Sequence[Effect], context: Context, condition: Condition
) -> float:
    """Find the density of white ground acceleration that causes `share` of the channels' variance, mean over channels.

    The forces, of density `force`, N^2/Hz, cause the rest of the variance.  The result is in (m/s^2)^2/Hz.
    """
    by_force, by_ground, above = variances(system, force, effects, context, condition.band_hz)
    by_force = by_force + (condition.beyond - 1.0) * above
    share = min(share, 0.999)
    if share < 1e-9:
        return 0.0

    def excess(ln_density: float) -> float:
        part = np.exp(ln_density) * by_ground
        return float((part / (part + by_force)).mean()) - share

    middle = float(np.log(by_force.mean() / by_ground.mean()))
    # At these densities every channel has less, or more, than its share; in a trial step they may lie far apart.
    ends = np.log(by_force / by_ground) + np.log(share / (1.0 - share))
    require_finite(middle, ends)
    return float(np.exp(brentq(excess, min(middle - 25.0, ends.min()), max(middle + 25.0, ends.max()), xtol=1e-10)))


def variances(
    system: System, force: Annotated[Array, "n"], effects: Sequence[Effect], context: Context, band_hz: float
) -> tuple[Annotated[Array, "c"], Annotated[Array, "c"], Annotated[Array, "c"]]:
    """Integrate the variance of every channel up to half the source's rate.

    The three are by the forces, by a white ground acceleration of density one, and by the forces above `band_hz`.
    """
    root, colour = force_root(force, effects), force_colour(effects, _integration_hz(context.rate_hz))
    observed = _observed(system, context)
    by_pair, above, by_ground = _integrated_products(colour, context.rate_hz, band_hz, *observed)
    density = root @ root.T
    return (by_pair * density).sum(axis=(1, 2)), by_ground, (above * density).sum(axis=(1, 2))


@compiled(error_model="numpy")
def accelerance(mass: Array, damping: Array, stiffness: Array, omega: Array, right: Array) -> ComplexArray:
    """Compute the accelerance ``-w^2 (K + i w C - w^2 M)^-1 right``, acceleration per force, shape (n_omega, N, columns).

    NaN where a pivot vanishes.  Of a symmetric matrix with a definite imaginary part that happens only without mass.
    """
    size, columns = right.shape
    out = np.empty((omega.size, size, columns), dtype=np.complex128)
    # Each step of the elimination is done for a block of frequencies, since the processor works on several numbers at once.
    re, im = np.empty((2, size, size + columns, _FREQUENCY_BLOCK))
    by_re, by_im = np.empty((2, _FREQUENCY_BLOCK))
    for first in range(0, omega.size, _FREQUENCY_BLOCK):
        w = omega[first : first + _FREQUENCY_BLOCK]
        m = w.size
        for i in range(size):
            for j in range(size):
                for k in range(m):
                    re[i, j, k], im[i, j, k] = stiffness[i, j] - w[k] * w[k] * mass[i, j], w[k] * damping[i, j]
            for j in range(columns):
                for k in range(m):
                    re[i, size + j, k], im[i, size + j, k] = -w[k] * w[k] * right[i, j], 0.0
        for p in range(size):
            for k in range(m):  # the pivot's inverse replaces it; scaled, since squares of small numbers underflow
                x, y = re[p, p, k], im[p, p, k]
                scale = 1.0 / max(abs(x), abs(y))
                x, y = x * scale, y * scale
                scale /= x * x + y * y
                re[p, p, k], im[p, p, k] = x * scale, -y * scale
            for i in range(p + 1, size):
                for k in range(m):
                    by_re[k] = re[i, p, k] * re[p, p, k] - im[i, p, k] * im[p, p, k]
                    by_im[k] = re[i, p, k] * im[p, p, k] + im[i, p, k] * re[p, p, k]
                for j in range(p + 1, size + columns):
                    for k in range(m):
                        re[i, j, k] -= by_re[k] * re[p, j, k] - by_im[k] * im[p, j, k]
                        im[i, j, k] -= by_re[k] * im[p, j, k] + by_im[k] * re[p, j, k]
        for p in range(size - 1, -1, -1):
            for j in range(size, size + columns):
                for i in range(p + 1, size):
                    for k in range(m):
                        re[p, j, k] -= re[p, i, k] * re[i, j, k] - im[p, i, k] * im[i, j, k]
                        im[p, j, k] -= re[p, i, k] * im[i, j, k] + im[p, i, k] * re[i, j, k]
                for k in range(m):
                    x, y = re[p, j, k], im[p, j, k]
                    re[p, j, k] = x * re[p, p, k] - y * im[p, p, k]
                    im[p, j, k] = x * im[p, p, k] + y * re[p, p, k]
                    out[first + k, p, j - size] = complex(re[p, j, k], im[p, j, k])
    return out


@compiled(error_model="numpy")
def _at_sensors(floors: ComplexArray, sensors: Array, ground: int, shares: Array) -> ComplexArray:
    """Compute the sensors' absolute acceleration from that of the degrees of freedom relative to the ground.

    `ground` is the column of the ground, of whose own acceleration every channel has its share.
    """
    n_omega, _, columns = floors.shape
    c, size = sensors.shape
    out = np.zeros((n_omega, c, columns), dtype=np.complex128)
    for k in range(n_omega):
        for s in range(c):
            for i in range(size):
                share = sensors[s, i]
                if share != 0.0:  # most entries are zero
                    for j in range(columns):
                        out[k, s, j] += share * floors[k, i, j]
            out[k, s, ground] += shares[s]
    return out


@compiled(error_model="numpy")
def blurred_products(answer: ComplexArray, density: Annotated[Array, "fine columns"], taps: Array) -> Spectrum:
    """Compute ``answer density answer^H`` on the half-bin grid and convolve it with the taper's kernel into bins."""
    n_fine, c, n = answer.shape
    n_bins = (n_fine - taps.size) // 2 + 1
    fine = np.empty((n_fine, c, c), dtype=np.complex128)
    for k in range(n_fine):
        for a in range(c):
            for b in range(a + 1):
                total = 0j
                for j in range(n):
                    total += density[k, j] * answer[k, a, j] * np.conj(answer[k, b, j])
                fine[k, a, b] = total
    out = np.empty((n_bins, c, c), dtype=np.complex128)
    for k in range(n_bins):
        for a in range(c):
            for b in range(a + 1):
                total = 0j
                for t in range(taps.size):
                    total += taps[t] * fine[2 * k + t, a, b]
                out[k, a, b] = total
                out[k, b, a] = np.conj(total)
    return out
