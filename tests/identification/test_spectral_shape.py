"""The spectral shape of stretches: what it does not depend on, how it scatters, and how rarely equals are told apart."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from monitor.identification import Scatter, SpectralShape, least_chance, permute

Array = NDArray[np.float64]
RATE_HZ = 100.0


def motion(
    rng: np.random.Generator, seconds: float, hz: float = 12.0, channels: int = 1, damping: float = 0.03
) -> Array:
    """One mode in noise, at all channels."""
    pole = np.exp(2.0 * np.pi / RATE_HZ * hz * (-damping + 1j))
    force = rng.standard_normal((int((seconds + 5.0) * RATE_HZ), 1))
    x = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], force, axis=0)[-int(seconds * RATE_HZ) :]
    return np.asarray(x / x.std() * np.linspace(1.0, 0.5, channels) + 0.3 * rng.standard_normal((len(x), channels)))


def described(shape: SpectralShape, stretches: list[Array]) -> Array:
    return np.array([shape.describe(stretch) for stretch in stretches])


@pytest.mark.parametrize("channels", [1, 3])
def test_level_and_offset_do_not_count_and_equal_stretches_scatter_by_one(channels: int) -> None:
    rng = np.random.default_rng(1)
    stretches = [motion(rng, 8.0, channels=channels) for _ in range(60)]
    shape = SpectralShape.of(stretches)
    rows = described(shape, stretches)
    assert shape.describe(7.0 * stretches[0] - 3.0) == pytest.approx(rows[0], abs=1e-6)
    variances = rows.var(axis=0, ddof=1)
    assert 0.8 < np.median(variances) < 1.3


@pytest.mark.parametrize("n_first", [4, 6])
def test_permuted_labels_tell_equals_apart_as_rarely_as_they_say(n_first: int) -> None:
    chances = []
    for seed in range(150):
        rng = np.random.default_rng([n_first, seed])
        rows = rng.standard_normal((8, 12)) * np.linspace(0.2, 3.0, 12) * rng.exponential(size=(8, 1))
        chances.append(permute([rows[:, :6], rows[:, 6:]], n_first if n_first < 6 else 2))
    assert np.mean(np.array(chances) <= 0.1) < 0.16
    assert min(chances) == pytest.approx(least_chance(4, 4) if n_first == 4 else least_chance(2, 6))


def test_a_mode_that_moved_by_four_percent_is_told_from_short_records_of_one_channel() -> None:
    rng = np.random.default_rng(2)
    stretches = [motion(rng, 8.0, hz) for hz in (12.0, 11.5) for _ in range(5)]
    shape = SpectralShape.of(stretches)
    parts = [np.array(part) for part in zip(*map(shape.describe_bands, stretches), strict=True)]
    assert permute(parts, 5) == pytest.approx(least_chance(5, 5))


def test_a_further_stretch_of_four_seconds_exceeds_the_learned_scatter_as_rarely_as_stated_and_another_does() -> None:
    rng = np.random.default_rng(3)
    learned = [motion(rng, 4.0) for _ in range(40)]
    shape = SpectralShape.of(learned)
    scatter = Scatter.of(described(shape, learned))
    equal = [scatter.chance(shape.describe(motion(rng, 4.0))) for _ in range(200)]
    assert np.mean(np.array(equal) < 0.05) < 0.1
    other = [scatter.chance(shape.describe(motion(rng, 4.0, 11.0))) for _ in range(20)]
    assert np.mean(np.array(other) < 0.001) > 0.8


def test_what_makes_records_differ_is_in_the_limit_where_whole_records_are_left_out() -> None:
    """Three records of ten stretches, each with a frequency of its own; thirty further records of one stretch."""
    told = []
    for seed in range(3):
        rng = np.random.default_rng([seed, 3])
        hz = 12.0 * (1.0 + 0.03 * rng.standard_normal(33))
        learned = [motion(rng, 4.0, f) for f in hz[:3] for _ in range(10)]
        shape = SpectralShape.of(learned)
        rows, further = described(shape, learned), described(shape, [motion(rng, 4.0, f) for f in hz[3:]])
        scatters = Scatter.of(rows), Scatter.of(rows, np.repeat(np.arange(3), 10))
        told.append([np.mean([scatter.chance(row) < 0.05 for row in further]) for scatter in scatters])
    alone, by_record = np.mean(told, axis=0)
    assert by_record <= 0.1 < alone, told


def test_a_channel_that_does_not_move_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    stretches = [np.column_stack([motion(rng, 8.0), np.zeros(800)]) for _ in range(4)]
    shape = SpectralShape.of(stretches)
    assert np.isfinite(described(shape, stretches)).all()
