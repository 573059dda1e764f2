"""Tracking of modes over time: every mode has an identity, kept through crossings, absences and changes."""

from __future__ import annotations

from cmath import phase, rect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import log, sqrt
from typing import Annotated

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
    """``[tracking]``: criteria by which an observed mode is assigned to a track.  A look is one window's length of new data."""

    drift_per_sqrt_day: float = Field(default=0.01, gt=0)
    """Random walk of ln f by weather and slow change, as the standard deviation after one day."""
    gate: float = Field(default=4.0, gt=0)
    """Gate: largest distance in frequency at which an observation is assigned to a track, in standard deviations."""
    min_mac: float = Field(default=0.5, ge=0, lt=1)
    """Least modal assurance criterion of shapes within the gate."""
    max_change: float = Field(default=0.15, gt=0, lt=1)
    """Largest change of ln f since the last observation of a track; beyond the gate the shape alone decides."""
    jump_mac: float = Field(default=0.95, gt=0, le=1)
    """Least modal assurance criterion of shapes beyond the gate."""
    max_std: float = Field(default=0.1, gt=0)
    """Observations with a larger relative standard deviation of frequency are left out."""
    confirm_hits: int = Field(default=4, ge=1)
    """A new track is confirmed when it was observed in this many looks ..."""
    confirm_looks: int = Field(default=10, ge=1)
    """... out of this many since its first."""
    shape_memory: float = Field(default=20.0, ge=1)
    """Looks over which the shape is averaged."""
    lost_hours: float = Field(default=6.0, gt=0)
    """Time without an observation after which a confirmed track is lost; it may be observed again."""
    death_days: float = Field(default=30.0, gt=0)
    """Time without an observation after which a track is deleted; a mode that returns later gets a new identity."""


class Status(StrEnum):
    """Status of a track."""

    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"
    LOST = "lost"


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """Modes observed in one window, in any order; m may be 0."""

    frequencies_hz: Annotated[Array, "m"]
    frequencies_std_hz: Annotated[Array, "m"]
    shapes: Annotated[ComplexArray, "m c"]
    """Of any scale and phase; c = 0 where only frequencies are known.  A channel that is left out is NaN."""
    window_s: float
    """Length of the window, s; the weight of an overlapping window is its share of new data."""


@dataclass(frozen=True, eq=False, slots=True)
class Track:
    """Track of one mode over time."""

    number: int
    """Identity, from 0 in order of confirmation; -1 until confirmed."""
    first_ns: int
    """Time of the first observation, UTC."""
    last_ns: int
    ln_f: float
    """Smoothed ln(f / Hz)."""
    variance: float
    """Variance of `ln_f` at `last_ns`."""
    noise: float
    """Estimated ratio of the observations' variance to their stated variance."""
    shape: ComplexArray
    """Running average, unit norm; empty while unknown, NaN at channels that were left out ever since."""
    hits: float
    """Number of looks with an observation of the track."""
    misses: float
    """Number of looks without an observation of the track."""

    def variance_at(self, t_ns: int, settings: TrackSettings) -> float:
        """Predict the variance of ln f at a time (UTC); it grows without observations."""
        return self.variance + settings.drift_per_sqrt_day**2 * (t_ns - self.last_ns) / _DAY_NS

    def status(self, t_ns: int, settings: TrackSettings) -> Status:
        """Return the status of the track at a time (UTC)."""
        if self.number < 0:
            return Status.TENTATIVE
        lost = t_ns - self.last_ns > settings.lost_hours / 24 * _DAY_NS
        return Status.LOST if lost else Status.CONFIRMED


@dataclass(frozen=True, slots=True)
class TrackState:
    """State of the tracking between looks: all tracks, confirmed ones first, by number."""

    tracks: tuple[Track, ...] = ()
    t_ns: int | None = None
    """Time of the last look, UTC."""
    next_number: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class TrackedModes:
    """Identities of the m observed modes, and the k confirmed or lost tracks, after one look."""

    observed: Annotated[NDArray[np.int64], "m"]
    """Number of the track of each observed mode, -1 for none."""
    numbers: Annotated[NDArray[np.int64], "k"]
    """Numbers of the tracks, increasing."""
    frequencies_hz: Annotated[Array, "k"]
    """Smoothed frequencies."""
    frequencies_std_hz: Annotated[Array, "k"]
    """Standard deviations of the smoothed frequencies, which grow without observations."""
    status: tuple[Status, ...]
    births: tuple[int, ...]
    """Tracks confirmed by this look."""
    deaths: tuple[int, ...]
    """Tracks deleted by this look; they are not among `numbers`."""


def observed(modes: ModalEstimate | None, window_s: float) -> Observed:
    """Convert a window's modes, then its other modes, to an observation; None stands for a window without modes.

    Examples
    --------
    >>> state, tracked = step(TrackState(), observed(None, window_s=400.0), 0, TrackSettings())
    >>> tracked.numbers.size
    0
    """
    if modes is None:
        return Observed(np.zeros(0), np.zeros(0), np.zeros((0, 0), complex), window_s)
    if not modes.others:
        return Observed(modes.frequencies_hz, modes.frequencies_std_hz, modes.shapes, window_s)
    f, std, shapes = zip(*((o.frequency_hz, o.frequency_std_hz, o.shape) for o in modes.others), strict=True)
    return Observed(
        np.concatenate([modes.frequencies_hz, f]),
        np.concatenate([modes.frequencies_std_hz, std]),
        np.concatenate([modes.shapes, shapes]),
        window_s,
    )


def step(state: TrackState, seen: Observed, t_ns: int, settings: TrackSettings) -> tuple[TrackState, TrackedModes]:
    r"""Assign the modes of one window, which ends at `t_ns` (UTC), to the tracks, and update the tracks.

    Observations are assigned to confirmed tracks first, then to tentative ones, each time by the assignment of largest
    likelihood of frequency (a local level in :math:`\ln f`) and shape [1]_.  An observation that is left starts a new track,
    unless its shape lies in the span of the tracks at its frequency: shapes of close modes are determined only as a
    subspace [2]_, and one mode is often found twice.  A track whose frequency jumps is matched by its shape, if the
    observation does not belong to another track.

    Windows that overlap share their data.  A window of which a share w is new counts as w looks, with the variance
    multiplied by 1 / w, so that overlapping windows of one window's length of new data weigh as one window.  Where the window's
    end is not later than the last look, the clock was set back; the time since is then taken to be the length of a window.

    References
    ----------
    .. [1] Blackman, Popoli, Design and Analysis of Modern Tracking Systems, 1999, chapter 6.
    .. [2] Brincker, Lopez-Aenlle, Mode shape sensitivity of two closely spaced eigenvalues, J. Sound Vib. 334, 2015.
    """
    state = _with_clock_of(state, seen.window_s, t_ns)
    since_s = seen.window_s if state.t_ns is None else (t_ns - state.t_ns) * 1e-9
    fresh = _candidate_tracks(seen, t_ns, settings)
    owner = _associate(state.tracks, fresh, settings)
    tracks = _updated(state.tracks, fresh, owner, min(1.0, since_s / seen.window_s), settings)
    births = _confirm(tracks, state.next_number, settings)
    identities = np.full(len(seen.frequencies_hz), -1, dtype=np.int64)
    identities[list(owner)] = [tracks[i].number for i in owner.values()]
    # Tracks are deleted after the update, so that modes survive an outage of the monitor.
    confirmed = sorted((t for t in tracks if t.number >= 0), key=lambda t: t.number)
    known = [t for t in confirmed if t_ns - t.last_ns <= settings.death_days * _DAY_NS]
    deaths = tuple(t.number for t in confirmed if t not in known)
    tentative = [t for t in tracks if t.number < 0 and t.misses <= settings.confirm_looks - settings.confirm_hits]
    state = TrackState((*known, *tentative), t_ns, state.next_number + len(births))
    f = np.exp([t.ln_f for t in known])
    std = f * np.sqrt([t.variance_at(t_ns, settings) for t in known])
    numbers = np.array([t.number for t in known], dtype=np.int64)
    status = tuple(t.status(t_ns, settings) for t in known)
    return state, TrackedModes(identities, numbers, f, std, status, births, deaths)


def _with_clock_of(state: TrackState, window_s: float, t_ns: int) -> TrackState:
    """Move a state's times with a clock that was set back before a window that ends at `t_ns`."""
    if state.t_ns is None or t_ns > state.t_ns:
        return state
    by_ns = t_ns - round(window_s * 1e9) - state.t_ns
    moved = tuple(replace(t, first_ns=t.first_ns + by_ns, last_ns=t.last_ns + by_ns) for t in state.tracks)
    return replace(state, t_ns=state.t_ns + by_ns, tracks=moved)


def _updated(
    old: Sequence[Track], fresh: dict[int, Track], owner: dict[int, int], weight: float, settings: TrackSettings
) -> list[Track]:
    """Update the tracks by the observations that they own, count the misses of the others, and append the new tracks."""
    taken = {i: fresh[j] for j, i in owner.items()}
    tracks = [
        _update_track(t, taken[i], weight, settings) if i in taken else replace(t, misses=t.misses + weight)
        for i, t in enumerate(old)
    ]
    return tracks + [taken[i] for i in range(len(old), len(old) + len(fresh)) if i in taken]


def _candidate_tracks(seen: Observed, t_ns: int, settings: TrackSettings) -> dict[int, Track]:
    """Form the track that each usable observation would start, by its index in `seen`."""
    f, std = np.asarray(seen.frequencies_hz), np.asarray(seen.frequencies_std_hz)
    usable = np.flatnonzero(np.isfinite(f) & (f > 0) & (std <= settings.max_std * f)).tolist()
    if not usable:
        return {}
    shapes = seen.shapes / np.sqrt(np.nansum(np.abs(seen.shapes) ** 2, axis=1))[:, None]
    fresh = {}
    for j in usable:
        variance = max(float(std[j] / f[j]), _MIN_FREQUENCY_STD) ** 2
        fresh[j] = Track(-1, t_ns, t_ns, log(f[j]), variance, 1.0, shapes[j], 1.0, 0.0)
    return fresh


def _associate(tracks: Sequence[Track], fresh: dict[int, Track], settings: TrackSettings) -> dict[int, int]:
    """Map the index of each assigned observation to that of its track; indices beyond the tracks are new tracks."""
    owner: dict[int, int] = {}
    free = sorted(fresh, key=lambda j: fresh[j].variance)  # of one mode found twice, the more precise starts the track
    for confirmed in (True, False):
        rows = [i for i, t in enumerate(tracks) if (t.number >= 0) is confirmed]
        tier = [tracks[i] for i in rows]
        for a, b in _assign(tier, [fresh[j] for j in free], settings):
            owner[free[b]] = rows[a]
        free = [j for j in free if j not in owner and not _is_explained(fresh[j], tier, settings)]
    born: list[Track] = []
    for j in free:
        if not _is_explained(fresh[j], born, settings):
            owner[j] = len(tracks) + len(born)
            born.append(fresh[j])
    return owner


def _assign(tracks: Sequence[Track], fresh: Sequence[Track], settings: TrackSettings) -> list[tuple[int, int]]:
    """List the pairs (track, observation) of largest total likelihood.

    The cost of a shape at `min_mac` equals the cost of a frequency at the gate.
    """
    if not tracks or not fresh:
        return []
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    difference = np.array([o.ln_f for o in fresh]) - np.array([[t.ln_f] for t in tracks])
    noise = np.array([[t.noise] for t in tracks]) * np.array([o.variance for o in fresh])
    variance = np.array([[t.variance_at(fresh[0].last_ns, settings)] for t in tracks]) + noise
    mac = _mac(tracks, fresh)
    limit = settings.gate**2
    distance = difference**2 / variance
    unlike = np.where(np.isnan(mac), 0.0, limit * (1.0 - mac) / (1.0 - settings.min_mac))
    alike = ((distance <= limit) & (unlike <= limit)) | (mac >= settings.jump_mac)
    cost = np.minimum(distance, limit) + unlike + np.log(variance / variance.max())
    # No assignment has the gain 0, a possible pair a positive one: a good pair is not exchanged for two poor ones.
    gain = np.where(alike & (np.abs(difference) <= settings.max_change), 2.0 * limit + 1.0 - cost, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if gain[i, j] > 0]


def _mac(tracks: Sequence[Track], fresh: Sequence[Track]) -> Annotated[Array, "k m"]:
    """Compute the modal assurance criterion of tracks and observations; NaN where a shape is unknown."""
    mac = np.full((len(tracks), len(fresh)), np.nan)
    known = [i for i, t in enumerate(tracks) if t.shape.size == fresh[0].shape.size > 0]
    if not known:
        return mac
    a, b = np.array([tracks[i].shape for i in known]), np.array([o.shape for o in fresh])
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return _partial_mac(mac, known, a, b)
    mac[known] = np.abs(np.conj(a) @ b.T) ** 2
    return mac


def _partial_mac(mac: Array, known: Sequence[int], a: ComplexArray, b: ComplexArray) -> Array:
    """Fill in the criterion of shapes by the channels that both have; one channel alone tells nothing."""
    for i, track in zip(known, a, strict=True):
        for j, seen in enumerate(b):
            common = np.isfinite(track) & np.isfinite(seen)
            if common.sum() > 1:
                power = np.vdot(track[common], track[common]).real * np.vdot(seen[common], seen[common]).real
                mac[i, j] = abs(np.vdot(track[common], seen[common])) ** 2 / max(power, 1e-300)
    return mac


def _is_explained(seen: Track, tracks: Sequence[Track], settings: TrackSettings) -> bool:
    """Check that the tracks at the frequency of an observation span its shape."""
    near = []
    for track in tracks:
        variance = track.variance_at(seen.last_ns, settings) + track.noise * seen.variance
        if (seen.ln_f - track.ln_f) ** 2 <= settings.gate**2 * variance:
            near.append(track.shape)
    if not near or not all(shape.size == seen.shape.size > 0 for shape in near):
        return bool(near)
    common = np.isfinite(seen.shape) & np.isfinite(near).all(axis=0)
    if not common.any():
        return True
    basis, _ = np.linalg.qr(np.transpose(near)[common])
    own = seen.shape[common]
    return bool(np.linalg.norm(basis.conj().T @ own) ** 2 >= settings.min_mac * np.linalg.norm(own) ** 2)


def _update_track(track: Track, seen: Track, weight: float, settings: TrackSettings) -> Track:
    """Update a track by an observation: Kalman filter of a local level with estimated noise, and average of the shape."""
    predicted = track.variance_at(seen.last_ns, settings)
    noise, difference = track.noise, seen.ln_f - track.ln_f
    innovation = difference**2 / (predicted + noise * seen.variance)
    if innovation > settings.gate**2:  # a change of the level, not noise
        predicted += difference**2
    else:
        noise *= 1.0 + _NOISE_RATE * weight * (innovation - 1.0)
    gain = predicted / (predicted + noise * seen.variance / weight)
    shape = track.shape if track.shape.size else seen.shape
    if track.shape.size == seen.shape.size > 0:
        share = weight / min(track.hits + weight, settings.shape_memory)
        shape = _averaged(shape, seen.shape, share)
    return replace(
        track,
        last_ns=seen.last_ns,
        ln_f=track.ln_f + gain * difference,
        variance=(1.0 - gain) * predicted,
        noise=min(max(noise, 0.01), 100.0),
        shape=shape,
        hits=track.hits + weight,
    )


def _averaged(shape: ComplexArray, seen: ComplexArray, share: float) -> ComplexArray:
    """Average a track's shape with an observed one, of weight `share`; channels that are left out are NaN."""
    here, there = np.isfinite(shape), np.isfinite(seen)
    if here.all() and there.all():
        shape = (1.0 - share) * shape + rect(share, phase(np.vdot(seen, shape))) * seen
        return np.asarray(shape / sqrt(np.vdot(shape, shape).real))
    common = here & there
    if not common.any():
        return shape
    # The observed shape in the scale and phase of the track's; a channel that only one of them has is taken from that one.
    seen = seen * (np.vdot(seen[common], shape[common]) / np.vdot(seen[common], seen[common]).real)
    shape = np.where(common, (1.0 - share) * shape + share * seen, np.where(there, seen, shape))
    return np.asarray(shape / sqrt(np.nansum(np.abs(shape) ** 2)))


def _confirm(tracks: list[Track], number: int, settings: TrackSettings) -> tuple[int, ...]:
    """Number the tracks observed often enough, in place, by frequency; return the new numbers."""
    due = [i for i, t in enumerate(tracks) if t.number < 0 and t.hits >= settings.confirm_hits - _ROUNDING]
    births = tuple(range(number, number + len(due)))
    for n, i in zip(births, sorted(due, key=lambda i: tracks[i].ln_f), strict=True):
        tracks[i] = replace(tracks[i], number=n)
    return births
