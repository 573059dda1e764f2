"""Clipped channels beside a measured ground: seen in the samples, named, and their segments left out of the search."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monitor.diagnosis.observed_causes import add_observed_causes
from monitor.inference import CorrectedPosterior, DrivenPosterior
from monitor.model import Condition
from tests.support.vibration import CONFIG, RATE_HZ, segments, vibration

ONES = np.ones(3)


@dataclass(frozen=True)
class Found:
    """What `add_observed_causes` reads of a diagnosis."""

    posterior: Any
    verdict: str = "none"
    causes: tuple[Any, ...] = ()


def found(piled: list[bool], *, ground: bool = True, known: tuple[Any, ...] = ()) -> Any:
    peak, condition = np.array([4.0, 5.0, 6.0]), Condition(ONES, ONES, ONES, ONES)
    kind: Any = DrivenPosterior if ground else CorrectedPosterior
    return Found(
        kind(
            observed=None,
            context=CONFIG.instrumented().context(RATE_HZ),
            conditions=[Condition(ONES, ONES, ONES, ONES, condition.excess_degc, peak, np.array(piled))],
            prior=SimpleNamespace(model=SimpleNamespace(effects=known)),
        )
    )


def test_samples_that_pile_up_beside_a_measured_ground_are_named_as_clipping() -> None:
    named = add_observed_causes(found([False, True, False]))
    (cause,) = named.causes
    assert named.verdict == "named"
    assert (cause.effect.name, cause.effect.location) == ("sensor_clipping", "channel a2")
    assert cause.effect.limit_m_s2 == pytest.approx(5.0) and 0.0 < cause.std["limit_m_s2"] < 0.01


def test_clipping_is_added_neither_without_a_pile_nor_where_it_is_known_nor_where_the_search_finds_it() -> None:
    effect = add_observed_causes(found([False, True, False])).causes[0].effect
    for given in (
        found([False, False, False]),
        found([False, True, False], known=(effect,)),
        found([False, True, False], ground=False),
    ):
        assert add_observed_causes(given) is given


def test_segments_that_reach_the_limit_are_left_out() -> None:
    samples = vibration(0, 60.0)  # twice the level in its later half
    limit = 1.01 * np.abs(samples[: len(samples) // 2, 1]).max()
    cut = samples.copy()
    cut[:, 1] = np.clip(cut[:, 1], -limit, limit)
    ground = np.random.default_rng(3).standard_normal((len(samples), 1))
    given = segments(cut, ground)
    rest = given.without_clipped()
    assert 6 <= rest.t_s.size < given.t_s.size
    assert rest.peaks[:, 1].max() < limit and rest.drive.located.size == rest.t_s.size
    assert segments(samples, ground).without_clipped().t_s.size == given.t_s.size


def test_where_all_segments_are_clipped_all_are_kept() -> None:
    samples = vibration(0, 60.0)
    samples = np.clip(samples, -0.3 * samples.std(axis=0), 0.3 * samples.std(axis=0))
    given = segments(samples, np.random.default_rng(3).standard_normal((len(samples), 1)))
    assert given.without_clipped() is given
