"""The limit of the alarm's statistic: as rare as stated, by Student's t, and with readings that overlap, down to 0.1 a year."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, t

from monitor.core import Array
from monitor.damage import AlarmSettings, sequential_test
from monitor.damage.common_change import LOCAL_LOSS_CREDIT
from monitor.damage.limits import Scores, announcements, as_normal, as_student, freedom_of_sum, limit
from monitor.damage.sequential_test import STRETCHES

YEAR_H = 365.25 * 24.0


@pytest.mark.parametrize("freedom", [4.0, 8.0, 17.0, 143.0, 1e4, np.inf])
@pytest.mark.parametrize("rare", [1e-2, 1e-4, 1e-7])
def test_the_score_of_few_degrees_of_freedom_is_as_rare_and_never_counts_more(freedom: float, rare: float) -> None:
    score, exact = t.isf(rare, min(freedom, 1e9)), norm.isf(rare)
    assert exact - 0.14 <= as_normal(score, freedom) <= exact + 0.005
    assert as_normal(as_student(exact, freedom), freedom) == pytest.approx(exact)


def test_the_freedom_of_a_sum_lies_between_that_of_the_greater_variance_and_that_of_both() -> None:
    own, common = np.array([1.0, 1.0, 1.0]), np.array([0.0, 1.0, 100.0])
    assert freedom_of_sum((own, common), (40.0, 4.0)) == pytest.approx([40.0, 14.55, 4.08], abs=0.01)


def test_readings_that_share_no_data_are_counted_by_the_tail_of_the_normal_distribution() -> None:
    for u in (3.0, 4.0, 5.0):
        assert announcements(u, 1, (1,), 3600.0, 1.0) == pytest.approx(norm.sf(u) * YEAR_H, rel=0.1)


def test_short_and_long_training_have_the_false_announcements_of_the_limit() -> None:
    """Hourly readings whose deviation 17 or 1000 degrees of freedom tell; a year of each, two hundred times."""
    rng, least_z = np.random.default_rng(5), limit(2.0, Scores(0, 1), LOCAL_LOSS_CREDIT, (1,), 3600.0, 1.0)
    for freedom in (17.0, 1000.0):
        stated = np.sqrt(rng.chisquare(freedom, (200, 1)) / freedom)
        z = as_normal(rng.standard_normal((200, round(YEAR_H))) / stated, freedom)
        assert 1.5 <= float((z >= least_z).sum(axis=1).mean()) <= 2.5


def test_more_parts_looks_and_sides_raise_the_limit_and_a_rarer_announcement_does() -> None:
    settings = AlarmSettings()
    hourly = settings.limit(Scores(0, 1), 3600.0, 3600.0)
    assert hourly == settings.limit(Scores(0, 1), 8.0, 3600.0), "records of seconds, one an hour"
    higher = (Scores(0, 10), 3600.0, 3600.0), (Scores(0, 1, 2), 3600.0, 3600.0), (Scores(0, 1), 3600.0, 600.0)
    assert all(settings.limit(*args) > hourly for args in higher)
    assert AlarmSettings(false_announcements_per_year=1.0).limit(Scores(0, 1), 3600.0, 3600.0) < hourly


def test_less_must_differ_from_others_only_where_these_show_no_change_alike() -> None:
    std, contrast = 0.001, 5.0 * np.sqrt(1.5)  # five standard deviations from the mean of two others
    for alike, waived in ((0.0, LOCAL_LOSS_CREDIT), (15.0, 0.0), (-15.0, 0.0)):
        means = std * (alike + np.array([contrast, 0.0, 0.0]))
        z, _ = sequential_test.statistic(means[None], std**2 * np.eye(3)[None], 0.0)
        assert z[0, 0] == pytest.approx(min(alike + contrast, 5.0 + waived))


def tilted(u: float, parts: int, step: float, windows: int, rng: np.random.Generator) -> float:
    """An unbiased estimate of the probability that the statistic reaches u within some windows: of one rare course of readings.

    One of the scores is lifted by u, and the course counts by how much more probable that made it (Adler, Blanchet, Liu, Ann.
    Appl. Probab. 22 (2012) 1167-1214).
    """
    a_window = round(1.0 / step)
    looks, before = windows * a_window, max(STRETCHES) * a_window
    moves = rng.standard_normal((looks + before, parts)) / np.sqrt(a_window)
    part, stretch, look = rng.integers(parts), int(rng.choice(STRETCHES)), int(rng.integers(looks))
    end = before + look + 1
    moves[end - stretch * a_window : end, part] += u / a_window / np.sqrt(stretch)
    total = np.vstack([np.zeros(parts), np.cumsum(moves, axis=0)])
    now = np.arange(before + 1, before + 1 + looks)
    means = np.stack([(total[now] - total[now - s * a_window]) / s for s in STRETCHES], axis=1)
    scores = means * np.sqrt(STRETCHES)[:, None]
    more_probable = np.exp(u * scores - 0.5 * u * u).mean()
    at = np.flatnonzero((scores >= u).any(axis=(1, 2)))
    return float(highest(means[at], parts) >= u) / more_probable if at.size else 0.0


def highest(means: Array, parts: int) -> float:
    covariance = np.eye(parts) / np.reshape(STRETCHES, (-1, 1, 1))
    model_form = AlarmSettings().model_form
    return max(float(sequential_test.statistic(rows, covariance, model_form)[0].max()) for rows in means)


@pytest.mark.parametrize(("parts", "step", "windows"), [(1, 0.025, 24), (3, 0.025, 24), (3, 1.0, 96), (10, 0.1, 48)])
def test_at_a_tenth_of_an_announcement_a_year_so_many_there_are(parts: int, step: float, windows: int) -> None:
    """By importance sampling of hours of readings of 400 s; in 30 years of plain ones there would be three."""
    rng, trials = np.random.default_rng([9, parts]), 400
    least_z = limit(0.1, Scores(parts, 0), LOCAL_LOSS_CREDIT, STRETCHES, 400.0, step)
    found = np.array([tilted(least_z, parts, step, windows, rng) for _ in range(trials)])
    per_year = YEAR_H * 9.0 / windows
    error = found.std() / np.sqrt(trials) * per_year
    assert error < 0.02
    assert abs(found.mean() * per_year - 0.1) < 0.02 + 2.5 * error
