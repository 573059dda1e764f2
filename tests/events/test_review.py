"""What the page of an event shows: drifts, loops, energy and the first mode over time, from the event's recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

from drivers.mcap_file import read_recordings
from monitor.config import configuration
from monitor.core import Skipped
from monitor.events import Event, Review, Site, review_event
from monitor.pipeline import Pipeline
from tests.events.shaken import (
    MASSES,
    RATE,
    STIFFNESS,
    T0_NS,
    Array,
    Shaken,
    blocks,
    configuration as frame,
    kanai_tajimi,
    shake,
)
from tests.support.short_quake import BEGIN_S, END_S, shaken

RECORDINGS = Path(__file__).parents[2] / "recordings"


def seen(motion: Shaken, *, with_ground: bool = True) -> Review:
    config = frame()
    begin_ns, end_ns = (T0_NS + round(t * 1e9) for t in (BEGIN_S, END_S))
    data = blocks(motion, with_ground=with_ground)
    found = review_event(data, config.front_end(), Pipeline(config).site, begin_ns, end_ns, 0.2)
    assert isinstance(found, Review)
    return found


def test_drifts_over_time_are_those_of_the_simulation() -> None:
    found = seen(shaken())
    t_s = np.arange(len(shaken().drifts)) / RATE - BEGIN_S
    middle = (found.t_s > -20.0) & (found.t_s < 30.0)
    for j in range(3):
        true = np.interp(found.t_s[middle], t_s, shaken().drifts[:, j])
        assert np.abs(found.drift_m[middle, j] - true).max() < 0.05 * np.abs(true).max()


def test_the_energy_dissipated_is_what_the_ground_put_in() -> None:
    found = seen(shaken())
    relative = shaken().drifts @ np.linalg.inv(np.eye(3) - np.eye(3, k=1)).T
    speed = np.gradient(relative, 1.0 / RATE, axis=0)
    part = slice(round(BEGIN_S * RATE), round(END_S * RATE))
    put_in = -(shaken().ground[part, None] * MASSES * speed[part]).sum() / RATE
    moving = 0.5 * (MASSES * speed[part.stop] ** 2).sum()
    assert found.energy_j.sum() == pytest.approx(put_in - moving, rel=0.03)
    assert (found.energy_j > 0.0).all()


def test_a_clock_that_is_late_moves_the_energy_as_the_page_says() -> None:
    late = replace(shaken(), ground=np.roll(shaken().ground, 1))  # by 5 ms
    moved, found = (seen(motion) for motion in (late, shaken()))
    assert moved.energy_j[:2] == pytest.approx(found.energy_j[:2], rel=1e-6)
    assert abs(moved.energy_j[2] - found.energy_j[2]) < 5.0 * found.energy_per_ms_j[2]


def test_the_first_mode_has_the_frequency_and_damping_of_the_simulation() -> None:
    mode = seen(shaken()).first_mode
    strong = mode.level_m > 0.2 * mode.level_m.max()
    assert strong.sum() >= 4
    true_hz = float(frame().instrumented().model.modes().frequencies_hz[0])
    assert mode.hz[strong] == pytest.approx(true_hz, rel=0.003)
    assert mode.damping[strong] == pytest.approx(0.02, abs=0.004)
    assert (np.abs(mode.hz - true_hz) < 4.0 * mode.hz_std).all()
    assert (np.abs(mode.damping - 0.02) < 4.0 * mode.damping_std).all()


def lowest_hz(stiffness: Array) -> float:
    drift = np.eye(3) - np.eye(3, k=1)
    return float(
        np.sqrt(eigh(drift.T @ np.diag(stiffness) @ drift, np.diag(MASSES), eigvals_only=True)[0]) / (2.0 * np.pi)
    )


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_the_change_at_like_levels_is_that_of_the_structure(lost: float) -> None:
    """Story 2 loses stiffness between two quakes; an elastic frame changes nothing, whatever the level."""
    rng, half = np.random.default_rng(1), round(40.0 * RATE)
    quakes = np.zeros(2 * half)
    for k in range(2):
        quakes[k * half + round(5.0 * RATE) :][: round(30.0 * RATE)] += kanai_tajimi(30.0, 1.0, 2.5, rng)
    weak = STIFFNESS * np.array([1.0, 1.0 - lost, 1.0])
    first, state = shake(quakes[:half], rng)
    second, _ = shake(quakes[half:], rng, stiffness=weak, start=state)
    motion = Shaken(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in ("floors", "ground", "drifts")))
    config = frame()
    ends = (T0_NS + round(t * 1e9) for t in (5.0, 75.0))
    found = review_event(blocks(motion), config.front_end(), Pipeline(config).site, *ends, 0.2)
    assert isinstance(found, Review) and found.first_mode is not None and found.first_mode.change is not None
    change, std, low, high = found.first_mode.change
    true = lowest_hz(weak) / lowest_hz(STIFFNESS) - 1.0
    assert change == pytest.approx(true, abs=0.01) and abs(change - true) < 3.0 * std and 0.0 < low < high
    assert std < (0.02 if lost else 0.001)


def test_without_a_ground_there_are_neither_loops_nor_a_first_mode() -> None:
    found = seen(shaken(), with_ground=False)
    assert found.force_n is None and found.first_mode is None and np.isnan(found.energy_j).all()
    assert np.isfinite(found.drift_m[:, :2]).all() and np.isnan(found.drift_m[:, 2]).all()


def test_a_dead_channel_hides_the_drifts_that_need_it() -> None:
    floors = shaken().floors.copy()
    floors[round(35.0 * RATE) : round(40.0 * RATE), 1] = np.nan
    found = seen(replace(shaken(), floors=floors))
    assert np.isnan(found.drift_m[:, :2]).all() and np.isfinite(found.drift_m[:, 2]).all() and found.force_n is None
    assert found.lost[1] == pytest.approx(5.0 / 75.0, rel=0.01) and found.lost[0] == 0.0


def test_a_recording_that_lacks_the_event_is_told() -> None:
    config, later_ns = frame(), T0_NS + 3600 * 10**9
    found = review_event(blocks(shaken()), config.front_end(), Pipeline(config).site, later_ns, later_ns + 10**9, 0.2)
    assert isinstance(found, Skipped)


def test_a_site_is_read_as_it_was_written() -> None:
    site = Pipeline(frame(events={"limits": [{"drift_ratio": 0.1, "says": "clear the house"}]})).site
    again = Site.read(json.loads(json.dumps(site.content())))
    assert again.content() == site.content() and again.settings == site.settings


def test_what_the_first_mode_of_the_shake_table_frame_did() -> None:
    """It falls from 3.79 to 3.67 Hz while its damping rises, and comes back: joints that give with the level."""
    place = RECORDINGS / "mini-shake-table-flexible"
    config = configuration.load(place.with_suffix(".toml"))
    data = list(read_recordings([place.with_suffix(".mcap")]))
    pipeline = Pipeline(config)
    results = [r for block in data for r in pipeline.push(block)]
    (event,) = [r for r in [*results, *pipeline.finish()] if isinstance(r, Event)]
    assert event.revision == 0 and "only 6 s of motion before it" in event.note
    assert 9.0 < (event.begin_ns - data[0].t_ns) * 1e-9 < 11.0
    found = review_event(data, config.front_end(), pipeline.site, event.begin_ns, event.end_ns, event.corner_hz)
    assert isinstance(found, Review) and found.first_mode is not None
    mode = found.first_mode
    strong, weak = mode.level_m > 0.03, (mode.level_m < 0.004) & (mode.hz_std < 0.01)
    assert mode.hz[strong].min() == pytest.approx(3.67, abs=0.01) and mode.hz[weak].max() == pytest.approx(
        3.79, abs=0.02
    )
    assert mode.damping[strong].max() > 0.013 > 0.008 > mode.damping[weak].max()


def test_where_nothing_is_known_but_the_channels_no_mode_and_no_drift_is_told() -> None:
    config = frame()
    known = Pipeline(config).site
    bare = Site.of_channels(config.channels, None, 1.0, known.window_s, known.settings)
    begin_ns, end_ns = (T0_NS + round(t * 1e9) for t in (BEGIN_S, END_S))
    found = review_event(blocks(shaken(), with_ground=True), config.front_end(), bare, begin_ns, end_ns, 0.2)
    assert isinstance(found, Review)
    assert found.first_mode is None and found.force_n is None and found.drift_m.shape[1] == 0
