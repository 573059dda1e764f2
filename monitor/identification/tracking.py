"""Which mode is which over time: an identity for every mode, kept through crossings, absences and changes."""

from __future__ import annotations

from cmath import phase, rect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from monitor.core import Array, ComplexArray, ModalEstimate, Settings

_DAY_NS = 86_400_000_000_000
"""One day. [ns; definition]"""
_NOISE_RATE = 0.05
"""Weight of one new window in the estimate of a track's scatter: a memory of twenty windows. [ratio; judgement]"""
_ROUNDING = 1e-9
"""Tolerance on the sum of shares that count as windows. [1; rounding]"""
_MIN_FREQUENCY_STD = 1e-5
"""Smallest relative standard deviation of a frequency: nobody measures one better. [ratio; judgement]"""


class TrackSettings(Settings):
    """What makes an observed mode one that was seen before.  A look is a window's length of new data."""

    drift_per_sqrt_day: float = Field(default=0.01, gt=0)
    """Random walk of ln f, one standard deviation after a day: weather and slow change."""
    gate: float = Field(default=4.0, gt=0)
    """Standard deviations within which an observation may be the track's."""
    min_mac: float = Field(default=0.5, ge=0, lt=1)
    """Least likeness of shapes within it."""
    max_change: float = Field(default=0.15, gt=0, lt=1)
    """Largest change of ln f since a track was seen; beyond the gate it is followed by its shape alone."""
    jump_mac: float = Field(default=0.95, gt=0, le=1)
    """Least likeness of shapes beyond the gate."""
    max_std: float = Field(default=0.1, gt=0)
    """Observations with a larger relative standard deviation of frequency are left out."""
    confirm_hits: int = Field(default=4, ge=1)
    """Looks in which a new track must be seen to be confirmed ..."""
    confirm_looks: int = Field(default=10, ge=1)
    """... out of so many since its first."""
    shape_memory: float = Field(default=20.0, ge=1)
    """Looks over which the shape is averaged."""
    lost_hours: float = Field(default=6.0, gt=0)
    """Time unseen after which a confirmed track is called lost; it may come back."""
    death_days: float = Field(default=30.0, gt=0)
    """Time unseen after which a look gives it up; the mode, should it return, is a new one."""


class Status(StrEnum):
    """How far a track can be believed."""

    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"
    LOST = "lost"


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """Modes seen in one window, in any order; m may be 0."""

    frequencies_hz: Array
    """Shape (m,)."""
    frequencies_std_hz: Array
    """Shape (m,)."""
    shapes: ComplexArray
    """Shape (m, c), of any scale and phase; c = 0 where only frequencies are known."""
    window_s: float
    """Length of the data behind them, by which overlapping windows are discounted."""


@dataclass(frozen=True, eq=False, slots=True)
class Track:
    """One mode over time."""

    number: int
    """Identity, from 0 in order of confirmation; -1 until then."""
    first_ns: int
    """When it was first seen, UTC."""
    last_ns: int
    ln_f: float
    """Smoothed ln(f / Hz)."""
    variance: float
    """Of `ln_f` at `last_ns`."""
    noise: float
    """Learned ratio of the observations' variance to the stated one."""
    shape: ComplexArray
    """Shape (c,): running average, unit norm; empty while unknown."""
    hits: float
    misses: float
    """Looks in which it was seen and was not."""

    def variance_at(self, t_ns: int, settings: TrackSettings) -> float:
        """Of ln f: it grows while nothing is seen."""
        return self.variance + settings.drift_per_sqrt_day**2 * (t_ns - self.last_ns) / _DAY_NS

    def status(self, t_ns: int, settings: TrackSettings) -> Status:
        """What the track is at a time."""
        if self.number < 0:
            return Status.TENTATIVE
        lost = t_ns - self.last_ns > settings.lost_hours / 24 * _DAY_NS
        return Status.LOST if lost else Status.CONFIRMED


@dataclass(frozen=True, slots=True)
class TrackState:
    """All tracks, confirmed ones first, by number."""

    tracks: tuple[Track, ...] = ()
    t_ns: int | None = None
    """Time of the last look."""
    next_number: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class TrackedModes:
    """Identities at one time; k tracks are confirmed or lost."""

    observed: NDArray[np.int64]
    """Shape (m,): the track of each observed mode, -1 for none."""
    numbers: NDArray[np.int64]
    """Shape (k,): the tracks, rising."""
    frequencies_hz: Array
    """Shape (k,): smoothed."""
    frequencies_std_hz: Array
    """Shape (k,): grows while a track is unseen."""
    status: tuple[Status, ...]
    """k of them."""
    births: tuple[int, ...]
    """Tracks confirmed by this look."""
    deaths: tuple[int, ...]
    """Tracks given up at this look; they are not among `numbers`."""


def observed(modes: ModalEstimate | None, window_s: float) -> Observed:
    """What a window's modal estimate shows; None for a window in which no mode was found."""
    if modes is None:
        return Observed(np.zeros(0), np.zeros(0), np.zeros((0, 0), complex), window_s)
    return Observed(modes.frequencies_hz, modes.frequencies_std_hz, modes.shapes, window_s)


def step(state: TrackState, seen: Observed, t_ns: int, settings: TrackSettings) -> tuple[TrackState, TrackedModes]:
    r"""Give the modes of one window to the tracks.

    Confirmed tracks choose first, then tentative ones; each by the assignment of largest likelihood of frequency
    (a local level in :math:`\ln f`) and shape [1]_.  What is left starts a new track unless its shape lies in the span
    of the tracks at its frequency: close modes' shapes are determined only as a subspace [2]_, and one mode is often
    found twice.  A track whose frequency jumps is followed by its shape if it takes nobody else's observation.

    Windows that overlap share their data.  A look of which a share w is new counts w, and its variance 1 / w-fold, so
    that one window's length of looks weighs as one window.

    Parameters
    ----------
    t_ns : int
        UTC of the window's end.  If it is not later than the look before, the clock was set back: what is known is then
        taken to be as old as a window is long.

    References
    ----------
    .. [1] Blackman, Popoli, Design and Analysis of Modern Tracking Systems, 1999, chapter 6.
    .. [2] Brincker, Lopez-Aenlle, Mode shape sensitivity of two closely spaced eigenvalues, J. Sound Vib. 334, 2015.
    """
    if state.t_ns is not None and t_ns <= state.t_ns:
        by_ns = t_ns - round(seen.window_s * 1e9) - state.t_ns
        moved = tuple(replace(t, first_ns=t.first_ns + by_ns, last_ns=t.last_ns + by_ns) for t in state.tracks)
        state = replace(state, t_ns=state.t_ns + by_ns, tracks=moved)
    since_s = seen.window_s if state.t_ns is None else (t_ns - state.t_ns) * 1e-9
    weight = min(1.0, since_s / seen.window_s)
    old, fresh = state.tracks, _fresh(seen, t_ns, settings)
    owner = _associate(old, fresh, settings)
    taken = {i: fresh[j] for j, i in owner.items()}
    tracks = [
        _hit(t, taken[i], weight, settings) if i in taken else replace(t, misses=t.misses + weight)
        for i, t in enumerate(old)
    ]
    tracks += [taken[i] for i in range(len(old), len(old) + len(fresh)) if i in taken]
    births = _confirm(tracks, state.next_number, settings)
    identities = np.full(len(seen.frequencies_hz), -1, dtype=np.int64)
    identities[list(owner)] = [tracks[i].number for i in owner.values()]
    # Deaths come last, so that modes outlive an outage of the monitor.
    known = [t for t in tracks if t.number >= 0 and t_ns - t.last_ns <= settings.death_days * _DAY_NS]
    deaths = tuple(t.number for t in tracks if t.number >= 0 and t not in known)
    known.sort(key=lambda t: t.number)
    hopeful = [t for t in tracks if t.number < 0 and t.misses <= settings.confirm_looks - settings.confirm_hits]
    state = TrackState((*known, *hopeful), t_ns, state.next_number + len(births))
    f = np.exp([t.ln_f for t in known])
    std = f * np.sqrt([t.variance_at(t_ns, settings) for t in known])
    numbers = np.array([t.number for t in known], dtype=np.int64)
    status = tuple(t.status(t_ns, settings) for t in known)
    return state, TrackedModes(identities, numbers, f, std, status, births, deaths)


def _fresh(seen: Observed, t_ns: int, settings: TrackSettings) -> dict[int, Track]:
    """The usable observations by their place in `seen`, each as the track that it would start."""
    f, std = np.asarray(seen.frequencies_hz), np.asarray(seen.frequencies_std_hz)
    usable = np.flatnonzero(np.isfinite(f) & (f > 0) & (std <= settings.max_std * f)).tolist()
    if not usable:
        return {}
    shapes = seen.shapes / np.linalg.norm(seen.shapes, axis=1)[:, None]
    fresh = {}
    for j in usable:
        variance = max(float(std[j] / f[j]), _MIN_FREQUENCY_STD) ** 2
        fresh[j] = Track(-1, t_ns, t_ns, log(f[j]), variance, 1.0, shapes[j], 1.0, 0.0)
    return fresh


def _associate(tracks: Sequence[Track], fresh: dict[int, Track], settings: TrackSettings) -> dict[int, int]:
    """The track of each observation that has one, by place; places beyond the tracks are births."""
    owner: dict[int, int] = {}
    free = sorted(fresh, key=lambda j: fresh[j].variance)  # of one mode found twice, the better starts the track
    for confirmed in (True, False):
        rows = [i for i, t in enumerate(tracks) if (t.number >= 0) is confirmed]
        tier = [tracks[i] for i in rows]
        for a, b in _assign(tier, [fresh[j] for j in free], settings):
            owner[free[b]] = rows[a]
        free = [j for j in free if j not in owner and not _explained(fresh[j], tier, settings)]
    born: list[Track] = []
    for j in free:
        if not _explained(fresh[j], born, settings):
            owner[j] = len(tracks) + len(born)
            born.append(fresh[j])
    return owner


def _assign(tracks: Sequence[Track], fresh: Sequence[Track], settings: TrackSettings) -> list[tuple[int, int]]:
    """Pairs of the largest likelihood in all; a shape just like enough weighs as much as a frequency at the gate."""
    if not tracks or not fresh:
        return []
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    difference = np.array([o.ln_f for o in fresh]) - np.array([[t.ln_f] for t in tracks])
    noise = np.array([[t.noise] for t in tracks]) * np.array([o.variance for o in fresh])
    variance = np.array([[t.variance_at(fresh[0].last_ns, settings)] for t in tracks]) + noise
    mac = _likeness(tracks, fresh)
    limit = settings.gate**2
    distance = difference**2 / variance
    unlike = np.where(np.isnan(mac), 0.0, limit * (1.0 - mac) / (1.0 - settings.min_mac))
    alike = ((distance <= limit) & (unlike <= limit)) | (mac >= settings.jump_mac)
    cost = np.minimum(distance, limit) + unlike + np.log(variance / variance.max())
    # Leaving both alone gains nothing, a possible pair something: no good pair is given up for two poor ones.
    gain = np.where(alike & (np.abs(difference) <= settings.max_change), 2.0 * limit + 1.0 - cost, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if gain[i, j] > 0]


def _likeness(tracks: Sequence[Track], fresh: Sequence[Track]) -> Array:
    """Modal assurance criterion, shape (k, m); not a number where a shape is unknown."""
    mac = np.full((len(tracks), len(fresh)), np.nan)
    known = [i for i, t in enumerate(tracks) if t.shape.size == fresh[0].shape.size > 0]
    if known:
        mac[known] = np.abs(np.conj([tracks[i].shape for i in known]) @ np.transpose([o.shape for o in fresh])) ** 2
    return mac


def _explained(seen: Track, tracks: Sequence[Track], settings: TrackSettings) -> bool:
    """Whether the tracks at this observation's frequency span its shape."""
    near = []
    for track in tracks:
        variance = track.variance_at(seen.last_ns, settings) + track.noise * seen.variance
        if (seen.ln_f - track.ln_f) ** 2 <= settings.gate**2 * variance:
            near.append(track.shape)
    if not near or not all(shape.size == seen.shape.size > 0 for shape in near):
        return bool(near)
    basis, _ = np.linalg.qr(np.transpose(near))
    return bool(np.linalg.norm(basis.conj().T @ seen.shape) ** 2 >= settings.min_mac)


def _hit(track: Track, seen: Track, weight: float, settings: TrackSettings) -> Track:
    """The track after an observation: Kalman filter of a local level, its noise learned, its shape averaged."""
    predicted = track.variance_at(seen.last_ns, settings)
    noise, difference = track.noise, seen.ln_f - track.ln_f
    surprise = difference**2 / (predicted + noise * seen.variance)
    if surprise > settings.gate**2:  # a change of the level, not noise
        predicted += difference**2
    else:
        noise *= 1.0 + _NOISE_RATE * weight * (surprise - 1.0)
    gain = predicted / (predicted + noise * seen.variance / weight)
    shape = track.shape if track.shape.size else seen.shape
    if track.shape.size == seen.shape.size > 0:
        share = weight / min(track.hits + weight, settings.shape_memory)
        shape = (1.0 - share) * shape + rect(share, phase(np.vdot(seen.shape, shape))) * seen.shape
        shape = shape / sqrt(np.vdot(shape, shape).real)
    return replace(
        track,
        last_ns=seen.last_ns,
        ln_f=track.ln_f + gain * difference,
        variance=(1.0 - gain) * predicted,
        noise=min(max(noise, 0.01), 100.0),
        shape=shape,
        hits=track.hits + weight,
    )


def _confirm(tracks: list[Track], number: int, settings: TrackSettings) -> tuple[int, ...]:
    """Number the tracks seen often enough, in place, by frequency."""
    due = [i for i, t in enumerate(tracks) if t.number < 0 and t.hits >= settings.confirm_hits - _ROUNDING]
    births = tuple(range(number, number + len(due)))
    for n, i in zip(births, sorted(due, key=lambda i: tracks[i].ln_f), strict=True):
        tracks[i] = replace(tracks[i], number=n)
    return births
