"""Simulated feature series that have what measured ones have, each of a seed and with its truth.

    ln f = ln f0 + s (warm slope * T above 0 degC + frost slope * T below) + what level and wind do, more in warm air
         + common factors + what was not measured + a level of the day + AR(1) + white noise of heavy tails + a change put in

T is the air's temperature behind a first-order lag, s the share of a mode.  The noise is larger in frost.  Modes are not found in
some rows, more of them in calm hours, and now and then another mode is taken for one.  There are no waveforms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from monitor.core import Array
from monitor.damage import FeatureTable

HOUR_NS = 3_600_000_000_000
START_NS = 1_760_000_000_000_000_000
"""Time of the first reading, early in October. [ns UTC; choice]"""
HOW = ("one", "all", "slow")
"""What a change is of: one feature, all alike, or one that loses a little more every hour. [names]"""


@dataclass(frozen=True)
class Nature:
    """What a site has; all sizes of ln f, one standard deviation where they are random."""

    hours: int
    """Readings, one an hour."""
    learned: int
    """Readings before the first that is judged."""
    changed: int
    """First reading that a change is put into."""
    hz: tuple[float, ...] = (3.9, 5.1, 9.8, 12.7)
    shares: tuple[float, ...] = (1.0, 0.9, 1.2, 0.7)
    """Share of each mode in what temperature does."""
    covariates: tuple[str, ...] = ("air_temperature",)
    """Which of air_temperature, deck_temperature, soil_temperature, level, wind are told."""
    mean_c: float = 8.0
    season_c: float = 11.0
    day_c: float = 4.0
    weather_c: float = 4.0
    lag_h: float = 5.0
    """First-order lag of the structure behind the air."""
    warm_slope: float = -0.0006
    frost_slope: float = -0.005
    """Per K below 0 degC: several times that above."""
    noise: float = 0.0015
    """White noise of one reading, of a Student t distribution with four degrees of freedom."""
    frost_noise: float = 5.0
    """Noise in frost over that above it."""
    slow: float = 0.0008
    """AR(1) noise of each mode, 0.9 an hour."""
    day: float = 0.0008
    """Level of a day, drawn anew every day."""
    factors: float = 0.001
    """Two common factors of all modes, AR(1) over 12 h."""
    wandering: float = 0.001
    """What was not measured: it wanders over three weeks and moves all modes."""
    softening: float = 0.0
    """Per unit of level (the logarithm of the motion), at the mean temperature."""
    interaction: float = 0.04
    """Share by which a kelvin raises it."""
    wind: float = 0.0
    """Per unit of wind, quadratic, of odd modes."""
    missing: tuple[float, ...] = (0.05, 0.05, 0.1, 0.25)
    """Share of the rows in which a mode is not found, more of them in calm hours."""
    outliers: float = 0.001
    """Share of the readings that are of another mode."""
    pauses: float = 0.02
    """Share of the hours in which the logger stood still, some 12 h each."""
    blind: float = 0.01
    """Share of the hours in which the first covariate is missing, some 12 h each."""


BRIDGE = Nature(11_000, 5_500, 9_000)
HOUSE = Nature(720, 432, 600, (1.9, 2.2, 6.1, 7.4), (1.0, 1.0, 1.1, 0.9), mean_c=15.0, season_c=4.0, outliers=0.003)
NATURES: Mapping[str, Nature] = {
    "bridge": BRIDGE,
    "bridge, three temperatures": replace(
        BRIDGE, covariates=("air_temperature", "deck_temperature", "soil_temperature")
    ),
    "bridge, no covariate": replace(BRIDGE, covariates=()),
    "bridge, learned in the warm half": replace(BRIDGE, learned=2_500, changed=9_000, season_c=-11.0),
    "144 hours learned": replace(
        HOUSE, hours=240, learned=144, changed=192, missing=(0.05, 0.05, 0.1, 0.1), wandering=0.0
    ),
    "mast": replace(
        HOUSE,
        covariates=("air_temperature", "level"),
        softening=-0.0015,
        wind=-0.0006,
        noise=0.001,
        missing=(0.05, 0.1, 0.25, 0.4),
    ),
    "mast, wind not measured": replace(HOUSE, softening=-0.0015, wind=-0.0006),
    "palace": replace(
        BRIDGE,
        hours=18_720,
        learned=7_500,
        changed=13_500,
        mean_c=16.0,
        season_c=9.0,
        noise=0.003,
        wandering=0.003,
        missing=(0.1, 0.2, 0.4, 0.4),
        outliers=0.01,
    ),
}
"""The simulators by name."""


@dataclass(frozen=True, eq=False)
class Series:
    """A series, and what is true of it."""

    table: FeatureTable
    learned_until_ns: int
    changed_from_ns: int
    expected: Annotated[Array, "w k"]
    """ln f without noise of a reading, before the change and the loss of readings."""
    scatter: Annotated[Array, "w"]
    """Standard deviation of the noise of one reading."""
    change: Annotated[Array, "w k"]
    """What was put into ln f."""


def series(name: str, seed: int, change: float = 0.0, how: str = "one") -> Series:
    """Simulate a series by its name; `change` is the share of the frequency that is lost, as 0.01."""
    return of_nature(NATURES[name], seed, change, how)


def years(name: str, count: float, seed: int, change: float = 0.0, days: int = 0) -> Series:
    """Simulate so many healthy years after what is learned, and days with a change in the first feature after that."""
    nature = NATURES[name]
    changed = nature.learned + round(8766 * count)
    return of_nature(replace(nature, hours=changed + 24 * days, changed=changed), seed, change)


def of_nature(nature: Nature, seed: int, change: float = 0.0, how: str = "one") -> Series:
    """Simulate a series of a site."""
    rng = np.random.default_rng(seed)
    w, k = nature.hours, len(nature.hz)
    air = _air(nature, rng)
    deck = _behind(air, nature.lag_h)
    level = _wander(rng, w, 15.0) + 0.7 * np.sin(2 * np.pi * np.arange(w) / 24.0)
    wind = np.abs(0.8 * level + _wander(rng, w, 8.0))
    frozen = np.clip(-deck / 2.0, 0.0, 1.0)
    law = nature.warm_slope * np.maximum(deck, 0.0) + nature.frost_slope * np.minimum(deck, 0.0)
    factors = np.column_stack([_wander(rng, w, 12.0), _wander(rng, w, 12.0)]) @ rng.standard_normal((2, k))
    expected = np.log(nature.hz) + np.outer(law, nature.shares)
    expected += nature.softening * (level * (1.0 + nature.interaction * (deck - nature.mean_c)))[:, None]
    expected += nature.wind * np.outer(wind**2, np.arange(k) % 2)
    expected += nature.factors * factors
    expected += nature.wandering * np.outer(_wander(rng, w, 500.0), rng.uniform(0.5, 1.5, k))
    expected += nature.day * rng.standard_normal((w // 24 + 1, k))[np.arange(w) // 24]
    expected += nature.slow * np.column_stack([_wander(rng, w, 10.0) for _ in range(k)])
    scatter = nature.noise * (1.0 + (nature.frost_noise - 1.0) * frozen)
    noise = scatter[:, None] * rng.standard_t(4.0, (w, k)) / np.sqrt(2.0)
    put_in = _change(nature, change, how)
    values = np.exp(expected + noise + put_in)
    other = rng.random((w, k)) < nature.outliers
    values[other] *= np.broadcast_to(1.0 + rng.choice([-1.0, 1.0], k) * rng.uniform(0.03, 0.1, k), (w, k))[other]
    calm = -np.argsort(np.argsort(level)) / w + 0.5
    values[rng.random((w, k)) < np.clip(np.array(nature.missing) * (1.0 + 1.6 * calm[:, None]), 0.0, 1.0)] = np.nan
    known = {
        "air_temperature": air + 0.2 * rng.standard_normal(w),
        "deck_temperature": deck + 0.2 * rng.standard_normal(w),
        "soil_temperature": _behind(air, 400.0) + 0.1 * rng.standard_normal(w),
        "level": level + 0.1 * rng.standard_normal(w),
        "wind": wind + 0.1 * rng.standard_normal(w),
    }
    told = {name: known[name] for name in nature.covariates}
    for values_told in list(told.values())[:1]:
        values_told[_stretches(rng, w, nature.blind)] = np.nan
    kept = ~_stretches(rng, w, nature.pauses)
    t_ns = START_NS + HOUR_NS * np.arange(w)
    table = FeatureTable(
        t_ns[kept],
        {f"f{j + 1}": column[kept] for j, column in enumerate(values.T)},
        {name: column[kept] for name, column in told.items()},
    )
    return Series(
        table,
        int(t_ns[nature.learned - 1]),
        START_NS + HOUR_NS * nature.changed,
        expected[kept],
        scatter[kept],
        put_in[kept],
    )


def records(seed: int, change: float = 0.0, *, order: int = 10, learned: int = 20, later: int = 40) -> Series:
    """Simulate AR coefficients of records of some seconds, one after the other; the second half of the later ones is changed.

    Each record has its own speed and load: the frequencies of its three modes scatter by 2 %, their damping by a fifth.  The
    coefficients scatter beyond that as those that are estimated from 1600 samples do.  `change` is that of the first mode.
    """
    rng = np.random.default_rng(seed)
    w = learned + later
    lost = np.where(np.arange(w) < learned + later // 2, 0.0, change)
    expected = np.array([_ar(rng, order, loss) for loss in lost])
    # The estimate's covariance is the inverse of the samples' autocovariance over their number, the innovations of unit variance.
    covariance = _inverse_autocovariance(expected[:learned].mean(axis=0)) / 1600.0
    values = expected + rng.multivariate_normal(np.zeros(order), covariance, w)
    t_ns = START_NS + 8_000_000_000 * np.arange(w)
    return Series(
        FeatureTable(t_ns, {f"a{j + 1}": column for j, column in enumerate(values.T)}, {}),
        int(t_ns[learned - 1]),
        int(t_ns[learned + later // 2]),
        expected,
        np.full(w, float(np.sqrt(np.trace(covariance) / order))),
        np.outer(lost, np.ones(order)),
    )


def _air(nature: Nature, rng: np.random.Generator) -> Annotated[Array, "w"]:
    """Simulate the air's temperature: season from October on, day and night, weather of some days."""
    hour = np.arange(nature.hours)
    season = nature.season_c * np.cos(2 * np.pi * (hour / 24.0 - 105.0) / 365.25)
    swing = nature.day_c * np.exp(0.4 * _wander(rng, nature.hours, 72.0))
    day = -swing * np.cos(2 * np.pi * (hour - 3.0) / 24.0)
    return np.asarray(nature.mean_c - season + day + nature.weather_c * _wander(rng, nature.hours, 96.0))


def _wander(rng: np.random.Generator, w: int, hours: float) -> Annotated[Array, "w"]:
    """Simulate an AR(1) process of unit variance that forgets in so many hours."""
    keep = np.exp(-1.0 / hours)
    pushes = np.sqrt(1.0 - keep**2) * rng.standard_normal(w)
    pushes[0] = rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -keep], pushes))


def _behind(x: Array, hours: float) -> Annotated[Array, "w"]:
    """Apply a first-order lag."""
    keep = np.exp(-1.0 / hours)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x, zi=[keep * x[0]])[0])


def _stretches(rng: np.random.Generator, w: int, share: float) -> Annotated[NDArray[np.bool_], "w"]:
    """Draw stretches of 12 h that make up about this share of the hours."""
    begun = np.r_[np.zeros(12), rng.random(w) < share / 12.0]
    return np.asarray(np.convolve(begun, np.ones(12))[12 : 12 + w] > 0.0)


def _change(nature: Nature, change: float, how: str) -> Annotated[Array, "w k"]:
    """Form what is put into ln f."""
    size = np.zeros((nature.hours, len(nature.hz)))
    if how not in HOW:
        raise ValueError(f"{how!r} is none of {HOW}")
    after = np.arange(nature.hours) - nature.changed
    growth = np.clip(after / max(nature.hours - nature.changed, 1), 0.0, 1.0) if how == "slow" else after >= 0
    size[:, slice(None) if how == "all" else slice(0, 1)] = (growth * np.log1p(-change))[:, None]
    return size


def _ar(rng: np.random.Generator, order: int, loss: float) -> Annotated[Array, "order"]:
    """Compute the coefficients that predict a record from its past: three modes, the rest of the poles small."""
    turn = 2 * np.pi * np.array([0.06, 0.15, 0.31]) * (1.0 + 0.02 * rng.standard_normal(3))
    turn[0] *= 1.0 - loss
    damping = np.array([0.03, 0.02, 0.02]) * np.exp(0.2 * rng.standard_normal(3))
    poles = np.exp(-damping * turn + 1j * turn)
    rest = 0.3 * np.exp(2j * np.pi * (np.arange(order - 6) + 0.5) / max(order - 6, 1))
    return np.asarray(-np.poly(np.r_[poles, poles.conj(), rest]).real[1:])


def _inverse_autocovariance(ar: Array) -> Annotated[Array, "order order"]:
    """Compute the inverse of the autocovariance of as many samples as coefficients (Gohberg and Semencul 1972)."""
    a = np.r_[1.0, -ar]
    k = ar.size
    lower = np.array([[a[i - j] if i >= j else 0.0 for j in range(k)] for i in range(k)])
    upper = np.array([[a[k - i + j] if i >= j else 0.0 for j in range(k)] for i in range(k)])
    return np.asarray(lower @ lower.T - upper @ upper.T)
