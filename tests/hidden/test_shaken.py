"""The trials on a shaken ground: what is recorded is what the sizes refer to, and a seed gives the same again."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.base import GROUND
from tests.hidden import shaken, tables, trial, world, worlds
from tests.hidden.frame import shaken_motion

FRAME = shaken.structure(3, "shaken_clean")


def test_motion_and_ground_are_recorded_at_the_level_that_sizes_refer_to() -> None:
    frame, density = FRAME.truth.frame, shaken.GROUND_RMS**2 / world.RATE_HZ
    act = world.healthy(frame, 1e-9 * frame.masses, 0.0)
    act = world.replace(act, ground=density, ground_level=np.full(242, 2.0), heard=True)
    samples = world.record(act, 240.0, 5)[10 * 1024 :]
    assert samples[:, :3].std(axis=0) == pytest.approx(shaken_motion(frame, density).scaled(2.0).channel, rel=0.06)
    # The filter before the recorded rate passes 92 % of the band.
    assert samples[:, 3].std() == pytest.approx(2.0 * shaken.GROUND_RMS * np.sqrt(0.92), rel=0.02)


def test_slip_softens_strong_motion_and_leaves_weak_motion() -> None:
    frame, density = FRAME.truth.frame, shaken.GROUND_RMS**2 / world.RATE_HZ
    drift = float(shaken_motion(frame, density).drift.mean())
    plain = world.replace(world.healthy(frame, 1e-9 * frame.masses, 0.0), ground=density, heard=True)
    _, slips = shaken.slipping(plain, frame, (0, 1, 2), 0.3, drift)

    def change(level: float) -> float:
        """Difference that slip makes, relative to the motion."""
        one, other = (
            world.record(world.replace(act, ground_level=np.full(62, level)), 60.0, 5)[:, :3] for act in (plain, slips)
        )
        return float((one - other).std() / one.std())

    assert change(0.01) < 0.02 < 0.2 < change(3.0)


@pytest.mark.parametrize("name", sorted(set(shaken.NAMES)))
def test_a_seed_gives_the_same_trial_again(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shaken, "DURATION_S", 12.0)
    structure = shaken.structure(4, name)
    one, two = (shaken.draw(structure, name, 33, None) for _ in range(2))
    assert one.hidden == two.hidden and one.kind == two.kind
    first, second = one.recording(), two.recording()
    assert all((a.samples == b.samples).all() for a, b in zip(first, second, strict=True))
    assert any(b.topic == GROUND for b in first) is ("unheard" not in name)


@pytest.mark.slow
def test_a_round_on_a_shaken_ground() -> None:
    results = [trial.run(seed, name) for seed, name in worlds.rounds(len(shaken.NAMES), 11, shaken.NAMES)]
    print(tables.report(results))
    single = [r for r in results if r["kind"] == "single"]
    assert all(r["outcome"] == "right" for r in results if r["kind"] == "clean")
    assert sum(r["outcome"] in ("right", "among") for r in single) >= 0.8 * len(single)
