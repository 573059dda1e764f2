"""The other simulator against the sizes that it promises."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import EFFECTS
from tests.hidden import catalogue, outside, world
from tests.hidden.judge import FAULT
from tests.hidden.truth import PLAIN, Site, healthy


@pytest.mark.engine
def test_recorded_motion_is_as_the_sizes_assume(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world, "wander", lambda duration_s, rng: np.ones(round(duration_s) + 2))
    act, motion = healthy(PLAIN, 1)
    samples = world.record(act, 240.0, 4)[10 * 1024 :]
    assert samples.std(axis=0) == pytest.approx(np.hypot(motion.channel, act.noise), rel=0.04)
    hidden, shaken = catalogue.base_excitation(Site(PLAIN, motion, act, np.random.default_rng(3), 8.0))
    shaken = world.record(shaken, 240.0, 4)[10 * 1024 :]
    share = 1.0 - ((samples.var(axis=0) - act.noise**2) / (shaken.var(axis=0) - act.noise**2)).mean()
    assert share == pytest.approx(hidden.parameters["share"], abs=0.05)


def test_the_level_wanders_as_stated() -> None:
    level = world.wander(400_000.0, np.random.default_rng(2))
    assert (level**2).mean() == pytest.approx(1.0, rel=0.05)
    assert level.std() / level.mean() == pytest.approx(0.35, rel=0.05)


def test_sensors_do_what_they_are_told() -> None:
    act, _ = healthy(PLAIN, 1)
    quiet = world.replace(act, noise=np.zeros(3))
    plain = world.record(quiet, 30.0, 4)
    late = world.record(world.replace(quiet, delay_s=np.array([0.0, 4.0 / 1024.0, 0.0])), 30.0, 4)
    assert late[1000:2000, 1] == pytest.approx(plain[996:1996, 1], abs=1e-3)
    assert late[:, 0] == pytest.approx(plain[:, 0])
    swapped = world.record(world.replace(quiet, order=(2, 1, 0), limit=np.array([np.inf, 1.0, np.inf])), 30.0, 4)
    assert (swapped[:, 0] == plain[:, 2]).all()
    assert np.abs(swapped[:, 1]).max() == 1.0


def test_a_fast_clock_makes_tones_slow() -> None:
    act, _ = healthy(PLAIN, 1)
    tone = world.replace(act, strength=np.zeros(3), line=(0, 11.0, 1.0), clock=0.01, noise=np.zeros(3))
    x = world.record(tone, 120.0, 4)[20 * 1024 :, 0]
    hz = np.fft.rfftfreq(8 * x.size, 1.0 / 1024.0)[np.abs(np.fft.rfft(x * np.hanning(x.size), 8 * x.size)).argmax()]
    assert hz == pytest.approx(11.0 / 1.01, abs=2e-3)


@pytest.mark.parametrize("name", outside.NAMES)
def test_what_is_in_no_catalogue_changes_a_record(name: str) -> None:
    act, motion = healthy(PLAIN, 7)
    near, changed = outside.DRAWS[name](Site(PLAIN, motion, act, np.random.default_rng([7, 103]), 16.0))
    plain, recorded = (world.record(one, 16.0, 7) for one in (act, changed))
    apart = (recorded - plain).std(axis=0) / plain.std(axis=0)
    assert 0.02 < apart.max() < 2.0
    assert {hidden.effect for hidden in near} <= {*EFFECTS, FAULT}
