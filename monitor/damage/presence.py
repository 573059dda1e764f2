"""Modes that are missing in windows, and modes that were never there: evidence by the rates learned at calibration.

Healthy windows lack a mode now and then, and show others beside.  How often is learned from windows that share no data, and how
far records differ in it (a mode may not be excited in a whole record).  In service the windows without a mode are counted over
the latest one, two, four ... windows that share no data, and so are those with another mode at one frequency.  Chance
gives such a count by a beta-binomial distribution: its rate is known from so many windows and no more.

References
----------
M. G. Kendall, A. Stuart, The advanced theory of statistics, vol. 1 (1977), section 5.10 (beta-binomial); H. Jeffreys, Theory of
probability (1961), section 3.1 (its prior).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, gammaln, ndtr, ndtri

from monitor.core import Array, ModalEstimate

_STRETCHES = tuple(2**k for k in range(7))
"""Lengths over which windows are counted. [windows; judgement: powers of two as of the means, and to 64: counts tell little]"""


@dataclass(frozen=True, eq=False, slots=True)
class Beside:
    """What the latest windows say beside the vector that is judged: the most improbable of it."""

    z: float
    """Standard normal score that is exceeded as rarely, all that was looked at counted."""
    windows: int
    """Over so many windows that share no data."""
    says: str


@dataclass(frozen=True, eq=False, slots=True)
class Sighting:
    """Modes that a window showed."""

    t_ns: int
    """End of the window, UTC."""
    missing: Annotated[NDArray[np.bool_], "m"]
    """Which of the baseline's modes it lacked."""
    others_hz: Annotated[Array, "k"]
    """Frequencies of the modes that are none of them."""
    chance: float = 1.0
    """How often a healthy window's spectrum is as far from the healthy ones; 1 where that is not judged."""

    @classmethod
    def of(cls, modes: ModalEstimate, wanted: Sequence[int], t_ns: int, chance: float = 1.0) -> Sighting:
        """Note the modes of a window; `wanted` are the numbers of the baseline's."""
        found = modes.model_mode.tolist()
        more = [f for f, k in zip(modes.frequencies_hz.tolist(), found, strict=True) if k not in wanted]
        others = [other.frequency_hz for other in modes.others]
        return cls(t_ns, np.array([k not in found for k in wanted], dtype=bool), np.array([*more, *others]), chance)


@dataclass(frozen=True, eq=False, slots=True)
class Presence:
    """How often healthy windows that share no data lacked each mode, and what others they showed."""

    windows: int
    missing: Annotated[Array, "m"]
    """Number of them without the mode."""
    alike: float
    """Correlation between windows of one record in what is missing."""
    others_hz: Annotated[Array, "k"]
    """Frequencies of the other modes in all of them."""
    band_hz: tuple[float, float]
    """Lowest and highest frequency looked at."""

    @property
    def absent(self) -> Annotated[Array, "m"]:
        """Probability that a window lacks each mode."""
        return np.asarray((self.missing + 0.5) / (self.windows + 1.0))

    @property
    def clutter(self) -> float:
        """Expected number of other modes in a window for each unit of ln f."""
        return (self.others_hz.size + 0.5) / (self.windows + 1.0) / float(np.log(self.band_hz[1] / self.band_hz[0]))

    def chance(self, count: int, of: int, healthy: float) -> float:
        """Compute how often at least `count` of so many windows in a row do what `healthy` of the healthy ones did."""
        rate = (healthy + 0.5) / (self.windows + 1.0)
        weight = 1.0 / (1.0 / (self.windows + 1.0) + self.alike / (1.0 - self.alike))
        a, b, k = rate * weight, (1.0 - rate) * weight, np.arange(count, of + 1)
        ways = gammaln(of + 1.0) - gammaln(k + 1.0) - gammaln(of - k + 1.0)
        return float(np.exp(ways + betaln(a + k, b + of - k) - betaln(a, b)).sum())


def kept(before: tuple[Sighting, ...], newest: Sighting, window_ns: int) -> tuple[Sighting, ...]:
    """Add a window to those that share no data, if it shares none with the last; as many are kept as are ever tested."""
    if before and 0 < newest.t_ns - before[-1].t_ns < window_ns:
        return before
    if before and newest.t_ns <= before[-1].t_ns:  # the clock was set back
        before = ()
    return (*before, newest)[-max(_STRETCHES) :]


def learn_presence(
    sightings: Sequence[Sighting], records: Sequence[int], n_modes: int, band_hz: tuple[float, float]
) -> Presence:
    """Learn it from healthy windows that share no data, each in one of the numbered records."""
    missing = np.array([s.missing for s in sightings], dtype=float).reshape(len(sightings), n_modes)
    others = np.concatenate([s.others_hz for s in sightings]) if sightings else np.zeros(0)
    return Presence(len(sightings), missing.sum(axis=0), _alike(missing, np.asarray(records)), others, band_hz)


def _alike(missing: Annotated[Array, "w m"], records: NDArray[np.intp]) -> float:
    """Estimate the correlation between windows of one record (intraclass, by analysis of variance), of all modes together."""
    names, of = np.unique(records, return_inverse=True)
    n, w = names.size, len(missing)
    if n < 2 or w == n or not missing.any():
        return 0.0
    counts = np.bincount(of)[:, None]
    means = np.zeros((n, missing.shape[1]))
    np.add.at(means, of, missing)
    means /= counts
    between = float((counts * (means - missing.mean(axis=0)) ** 2).sum()) / (n - 1)
    within = float(((missing - means[of]) ** 2).sum()) / (w - n)
    size = (w - float((counts**2).sum()) / w) / (n - 1)
    total = between + (size - 1.0) * within
    return float(np.clip((between - within) / total, 0.0, 1.0 - 1.0 / w)) if total > 0.0 else 0.0


def look(
    presence: Presence,
    before: Sequence[Sighting],
    newest: Sighting,
    reference_hz: Array,
    window_ns: int,
    tolerance: float,
) -> Beside:
    """Test the newest window with those before it, the latest last, that share no data with it.

    `tolerance` is how far the frequencies of one other mode differ between windows, relative to it.
    """
    seen = [newest, *_apart(before, newest, window_ns)]
    bands = float(np.log(presence.band_hz[1] / presence.band_hz[0])) / (2.0 * tolerance)
    tests = len(_STRETCHES) * (presence.missing.size + bands)
    best = Beside(0.0, 1, "")
    for of in _STRETCHES:
        part = seen[:of]
        if len(part) < of:
            break
        for chance, says in (*_gone(presence, part, reference_hz), *_new(presence, part, tolerance)):
            best = max(best, Beside(_score(chance * tests), of, says), key=lambda one: one.z)
    return best


def either(modes: Beside, before: Sequence[Sighting], newest: Sighting, window_ns: int) -> Beside:
    """Return the more improbable of what the modes say and the shape of the spectrum; that there are two counts.

    The shape counts as far as the last window that shares no data with the newest has it too: a transient is in one.
    """
    chances = [s.chance for s in (newest, *_apart(before, newest, window_ns)[:1])]
    shape = _score(2.0 * max(chances)) if len(chances) == 2 else 0.0
    if shape > modes.z:
        return Beside(shape, 2, "the shape of the spectrum changed")
    return replace(modes, z=_score(2.0 * float(ndtr(-modes.z)))) if modes.z > 0.0 else modes


def _score(chance: float) -> float:
    """Return the standard normal score that is exceeded as rarely."""
    return max(0.0, -float(ndtri(min(max(chance, 1e-300), 1.0))))


def _apart(before: Sequence[Sighting], newest: Sighting, window_ns: int) -> list[Sighting]:
    """List the windows that share no data with the newest, the latest first."""
    return [s for s in reversed(before) if newest.t_ns - s.t_ns >= window_ns]


def _gone(presence: Presence, part: Sequence[Sighting], reference_hz: Array) -> list[tuple[float, str]]:
    """List the chance and the words of each mode that is missing in the newest of some windows."""
    counts = np.sum([s.missing for s in part], axis=0)
    return [
        (
            presence.chance(int(counts[i]), len(part), presence.missing[i]),
            f"mode {i + 1} ({reference_hz[i]:.3g} Hz) is missing in {_share(int(counts[i]), len(part))}, in "
            f"{presence.missing[i]:.0f} of {presence.windows} at calibration",
        )
        for i in np.flatnonzero(part[0].missing).tolist()
    ]


def _new(presence: Presence, part: Sequence[Sighting], tolerance: float) -> list[tuple[float, str]]:
    """List the same of each other mode of the newest of some windows."""
    out = []
    for f in part[0].others_hz.tolist():
        count = sum(bool((np.abs(np.log(s.others_hz / f)) < tolerance).any()) for s in part)
        healthy = int((np.abs(np.log(presence.others_hz / f)) < tolerance).sum())
        says = f"{f:.3g} Hz is in {_share(count, len(part))}, in {healthy} of {presence.windows} at calibration"
        out.append((presence.chance(count, len(part), min(healthy, presence.windows)), f"a mode at {says}"))
    return out


def _share(count: int, of: int) -> str:
    """Say in how many of the latest windows."""
    return "the latest window" if of == 1 else f"{count} of the latest {of} windows that share no data"
