"""What is said of sensors and stream, and which faults keep a window out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from monitor.core import Gap, WindowResult
from monitor.model import EFFECTS, Model
from monitor.pipeline import Pipeline
from monitor.signals import sensor_health
from monitor.signals.alignment import Piece
from monitor.signals.sensor_health import ChannelHealth, Health, HealthSettings, HealthState
from tests.support.frames import settings_of
from tests.support.samples import CHANNELS, Cut
from tests.support.simulated import PAPER_FRAME, ambient

RATE = 200.0
SETTINGS = HealthSettings()
FRAME = Model(PAPER_FRAME)


def taken(t_ns: int, values: np.ndarray, gap: Gap | None = None, rate_hz: float = RATE) -> Piece:
    return Piece(t_ns, values, gap, rate_hz)


@pytest.fixture(scope="module")
def motion() -> np.ndarray:
    """60 s; the sensors resolve 1 mm/s^2."""
    return np.asarray(np.round(ambient(FRAME, 60.0, RATE, 1, noise=0.05), 3))


def run(*pieces: Piece, dropped: int = 0, keep_s: float = 1e3) -> tuple[HealthState, list[Health]]:
    state, found = HealthState(), []
    for piece in pieces:
        state, new = sensor_health.step(state, piece, dropped, CHANNELS, SETTINGS, keep_s)
        found += new
    return state, found


def cut_up(values: np.ndarray, sizes: list[int]) -> list[Piece]:
    pieces, start, k = [], 0, 0
    while start < len(values):
        part = values[start : start + sizes[k % len(sizes)]]
        pieces.append(taken(round(start / RATE * 1e9), part))
        start, k = start + len(part), k + 1
    return pieces


def channel(values: np.ndarray, which: int = 1) -> ChannelHealth:
    """The second span of one channel."""
    return run(taken(0, values))[1][1].channels[which]


def verdict(values: np.ndarray) -> dict[str, str]:
    state, _ = run(taken(0, values))
    return sensor_health.check(state, 0, round(len(values) / RATE * 1e9), SETTINGS)


@given(sizes=st.lists(st.integers(1, 5000), min_size=1, max_size=6))
@settings(deadline=None, max_examples=25)
def test_spans_do_not_depend_on_how_the_samples_came(motion: np.ndarray, sizes: list[int]) -> None:
    _, whole = run(taken(0, motion))
    _, parts = run(*cut_up(motion, sizes))
    assert [h.channels for h in parts] == [h.channels for h in whole]
    assert [(h.samples, h.availability) for h in parts] == [(2000, 1.0)] * 6
    for h, k in zip(parts, range(6), strict=True):
        assert (h.t_ns, h.t_end_ns) == (pytest.approx(k * 10**10, abs=10), pytest.approx((k + 1) * 10**10, abs=2000))


def test_figures_of_a_good_channel(motion: np.ndarray) -> None:
    told, x = channel(motion), motion[2000:4000, 1]
    assert told.channel == "a2"
    assert told.mean_m_s2 == pytest.approx(x.mean())
    assert told.rms_m_s2 == pytest.approx(x.std())
    assert told.peak_m_s2 == pytest.approx(np.abs(x - x.mean()).max())
    assert (told.spikes, told.clipped) == (0, 0.0) and told.repeated < 0.01


def test_the_noise_floor_is_that_of_white_noise() -> None:
    floors = []
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(scale=0.5, size=(4000, 3))
        floors += [c.noise_floor for h in run(taken(0, noise))[1] for c in h.channels]
    assert np.mean(floors) == pytest.approx(0.5 * np.sqrt(2 / RATE), rel=0.05)


@pytest.mark.parametrize("lost_s", [2.0, 3600.0])
def test_gaps_and_overlaps_are_told(motion: np.ndarray, lost_s: float) -> None:
    after = round((5.0 + lost_s) * 1e9)
    _, told = run(
        taken(0, motion[:1000]), taken(after, motion[1000:], Gap(5 * 10**9, lost_s, "lost")), dropped=7, keep_s=1e9
    )
    assert sum(h.gaps for h in told) == 1 and sum(h.lost_s for h in told) == lost_s
    assert told[0].overlaps == 7 and told[1].overlaps == 0
    assert told[0].availability == pytest.approx(told[0].samples / (told[0].samples + lost_s * RATE))
    assert told[1].availability == 1.0
    assert told[1].t_ns >= after


def test_another_rate_ends_the_span(motion: np.ndarray) -> None:
    _, told = run(taken(0, motion[:100]), taken(10**9, motion[:4000], Gap(0, 0.0, "rate"), 2 * RATE))
    assert [h.samples for h in told] == [100, 4000]
    assert [h.rate_hz for h in told] == [RATE, 2 * RATE]


def test_memory_is_bounded_by_the_window_and_at_any_rate(motion: np.ndarray) -> None:
    state, _ = run(*(taken(k * 10**9, motion[:200]) for k in range(500)), keep_s=50.0)
    assert len(state.spans) <= 7
    state, told = run(taken(0, np.zeros((600_000, 3)), None, 1e6))
    assert len(told) == 2 and state.n < 1 << 18


def test_spikes_are_counted_and_do_not_keep_a_window_out(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[2500:4000:500, 1] += 500.0
    assert channel(spoilt).spikes == 3 and channel(spoilt, 0).spikes == 0
    assert verdict(spoilt) == {}


def test_steps_of_a_coarse_sensor_between_rests_are_no_spikes() -> None:
    x = np.zeros((4000, 3))
    x[::700] = 0.001
    assert channel(x).spikes == 0


@pytest.mark.parametrize("level", [0.002, 0.02, 1.0])
def test_coarse_resolution_is_no_clipping(level: float) -> None:
    floors = ambient(FRAME, 20.0, RATE, 3, noise=0.05)
    coarse = np.round(floors * level / floors.std(), 3)
    told = run(taken(0, coarse))[1]
    assert all(c.clipped == 0.0 for h in told for c in h.channels)


@pytest.mark.parametrize("sigmas", [1.0, 2.0])
def test_a_clipped_channel_is_told_and_left_to_the_diagnosis(motion: np.ndarray, sigmas: float) -> None:
    spoilt = motion.copy()
    limit = round(sigmas * spoilt[:, 1].std(), 3)
    spoilt[:, 1] = spoilt[:, 1].clip(-limit, limit)
    x = spoilt[2000:4000, 1]
    assert channel(spoilt).clipped == pytest.approx(np.mean(np.abs(x) == limit), rel=0.01)
    assert channel(spoilt, 0).clipped == 0.0
    assert verdict(spoilt) == {}


def test_a_channel_mostly_at_its_limits_is_found(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[:, 1] = spoilt[:, 1].clip(-0.05 * spoilt[:, 1].std(), 0.05 * spoilt[:, 1].std())
    found = verdict(spoilt)
    assert set(found) == {"a2"} and found["a2"].startswith("is clipped")


def test_a_channel_that_stays_constant_for_long_is_found(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[4000:8000, 2] = spoilt[4000, 2]
    found = verdict(spoilt)
    assert set(found) == {"a3"} and found["a3"].startswith("is stuck (33 %")
    assert channel(spoilt, 2).repeated < 0.01
    brief = motion.copy()
    brief[4000:5000, 2] = brief[4000, 2]
    assert verdict(brief) == {}


def test_a_structure_at_rest_is_not_stuck(motion: np.ndarray) -> None:
    """All channels constant: a hammer test between two blows, in steps of the sensor's resolution."""
    resting = motion.copy()
    resting[4000:8000] = 0.0
    assert verdict(resting) == {}


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("sensor_gain", {"gain": 0.7}),
        ("sensor_polarity", {}),
        ("time_offset", {"seconds": 0.02}),
        ("sensor_noise", {"rms_m_s2": 2.0}),
        ("sensor_clipping", {"limit_m_s2": 12.0}),
    ],
)
def test_sensor_faults_that_a_diagnosis_explains_keep_their_windows(name: str, parameters: dict[str, float]) -> None:
    effect = EFFECTS[name].create("channel a2", parameters)
    assert verdict(ambient(Model(PAPER_FRAME, (effect,)), 60.0, RATE, 4, noise=0.03)) == {}


def test_the_pipeline_judges_without_a_stuck_channel_and_takes_it_back(frame_text: str, cut: Cut) -> None:
    site = settings_of(frame_text)
    spoilt = ambient(site.model(), 80.0, RATE, 5, noise=0.03)
    spoilt[4000:8000, 0] = 1.0
    pipeline = Pipeline(site)
    found = {5 * r.index: r for b in cut(spoilt, RATE) for r in pipeline.push(b) if isinstance(r, WindowResult)}
    assert all(r.skipped is None for r in found.values())
    left_out = {begin: [gone.channel for gone in r.left_out] for begin, r in found.items()}
    assert left_out[15] == ["a1"] and "stuck" in found[15].left_out[0].reason
    assert left_out[0] == left_out[40] == left_out[60] == []
    modes = found[15].modes
    assert np.isnan(modes.shapes[:, 0]).all() and np.isfinite(modes.shapes[:, 1:]).all()


def test_a_channel_without_finite_samples_is_told_and_its_neighbours_figures_stay(motion: np.ndarray) -> None:
    lost = motion.copy()
    lost[2000:4000, 1] = np.nan
    _, before = run(taken(0, motion))
    _, after = run(taken(0, lost))
    assert after[1].channels[0] == before[1].channels[0] and after[1].channels[2] == before[1].channels[2]
    assert after[1].channels[1].lost == 1.0 and after[0].channels[1].lost == 0.0
    lost[2000:4000, 1] = motion[2000:4000, 1]
    lost[2000:2500, 1] = np.nan
    partly = channel(lost)
    assert partly.lost == 0.25
    assert partly.rms_m_s2 == pytest.approx(motion[2500:4000, 1].std())
