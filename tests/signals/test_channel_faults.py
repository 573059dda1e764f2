"""Brief faults of one channel are found and named; motion of the structure, however sudden, is none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from monitor.model import EFFECTS, ExcitationKind, Model, ShearFrame
from monitor.signals import Conditioner
from monitor.signals.channel_faults import CELL, Fault, RawFacts, find_faults
from tests.support.simulated import PAPER_FRAME, ambient

RATE = 200.0
Spoil = Callable[[np.ndarray, float, np.random.Generator], None]


def motion(*effects: object, excitation: ExcitationKind = "ambient", seed: int = 1) -> np.ndarray:
    """120 s with 5 % noise."""
    how = {"noise": 0.05, "level_spread": 0.35, "excitation": excitation}
    return ambient(Model(PAPER_FRAME, effects), 120.0, RATE, seed, **how)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def floors() -> np.ndarray:
    return motion()


def found(x: np.ndarray) -> tuple[Fault, ...]:
    design = Conditioner.design(RATE, 100.0, 40.0)
    values = design.step_block(design.start(x.shape[1]), x)[1]
    n = round(CELL * RATE / design.rate_hz)
    return find_faults(
        [values], [[RawFacts.of(x[a : a + n], x[max(0, a - 2) : a]) for a in range(0, len(x) - n + 1, n)]]
    )


def spike(x: np.ndarray, rms: float, rng: np.random.Generator) -> None:
    x[10_500] += 12.0 * rms


def step(x: np.ndarray, rms: float, rng: np.random.Generator) -> None:
    x[10_500:] += 2.0 * rms


def dropout(x: np.ndarray, rms: float, rng: np.random.Generator) -> None:
    x[10_450:10_550] = 0.0


def held(x: np.ndarray, rms: float, rng: np.random.Generator) -> None:
    x[10_450:10_550] = x[10_450]


def burst(x: np.ndarray, rms: float, rng: np.random.Generator) -> None:
    x[10_450:10_550] += rms * rng.standard_normal(100)


@pytest.mark.parametrize("channel", [0, 1, 2])
@pytest.mark.parametrize(
    ("spoil", "kind"),
    [(spike, "spike"), (step, "offset step"), (dropout, "dropout"), (held, "dropout"), (burst, "noise burst")],
)
def test_a_fault_of_one_channel_is_found_where_it_is(floors: np.ndarray, spoil: Spoil, kind: str, channel: int) -> None:
    x = floors.copy()
    spoil(x[:, channel], float(x[:, channel].std()), np.random.default_rng(3))
    faults = found(x)
    assert {(f.kind, f.channel) for f in faults} == {(kind, channel)}
    at = round(10_500 * 100.0 / RATE)
    assert all(f.begin - CELL <= at <= f.end + CELL for f in faults)
    assert any(f.begin <= at <= f.end for f in faults)


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_found_in_sound_records(seed: int) -> None:
    assert found(motion(seed=seed)) == ()


def test_hammer_blows_are_motion() -> None:
    assert found(motion(excitation="impulse")) == ()


def test_a_sudden_earthquake_is_motion(floors: np.ndarray) -> None:
    x = floors.copy()
    quake = motion(excitation="ground", seed=5)[:14_000]
    x[10_000:] += 20.0 * quake * x.std() / quake.std()
    assert found(x) == ()


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("sensor_gain", {"gain": 0.7}),
        ("sensor_noise", {"rms_m_s2": 2.0}),
        ("time_offset", {"seconds": 0.01}),
        ("sensor_polarity", {}),
    ],
)
def test_what_a_diagnosis_explains_is_left_to_it(name: str, parameters: dict[str, float]) -> None:
    assert found(motion(EFFECTS[name].create("channel a2", parameters))) == ()


def test_a_change_that_lasts_is_no_brief_fault(floors: np.ndarray) -> None:
    x = floors.copy()
    x[12_000:, 1] *= 0.5
    lasting = [f for f in found(x) if f.end - f.begin > 3 * CELL]
    assert lasting == []


def test_what_all_channels_have_is_no_fault_of_one(floors: np.ndarray) -> None:
    assert found(floors[:, :1]) == ()
    still = floors.copy()
    still[10_000:10_600] = 0.0
    assert {f.kind for f in found(still)} <= {"dropout"}


def test_a_dead_channel_or_a_short_record_is_no_error(floors: np.ndarray) -> None:
    x = floors.copy()
    x[:, 0] = 1.0
    assert found(x) == ()
    assert found(floors[:500]) == ()


def test_many_channels_are_judged_by_a_few_neighbours() -> None:
    tower = Model(ShearFrame(np.full(8, 0.3), np.full(8, 4000.0), 0.01))
    many = ambient(tower, 120.0, RATE, 1, noise=0.05)
    assert found(many) == ()
    spike(many[:, 5], float(many[:, 5].std()), np.random.default_rng(0))
    assert {(f.kind, f.channel) for f in found(many)} == {("spike", 5)}
