"""What of a recording is left out of a comparison with models, and that it is the same for any cut into blocks."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import BadInputError
from monitor.inference import Segments, classify, gather
from monitor.inference.segments import LeftOut
from monitor.model import Model, simulate
from monitor.signals import FrontEnd, ProcessingSettings
from tests.support.samples import CHANNELS, Cut
from tests.support.simulated import PAPER_FRAME

RATE = 200.0
FRONT_END = FrontEnd(CHANNELS, ProcessingSettings(), segment_s=20.0, n_lags=100)
FRAME = Model(PAPER_FRAME)


@pytest.fixture(scope="module")
def floors() -> np.ndarray:
    moved = simulate(FRAME, duration_s=300.0, rate_hz=RATE, noise=0.05, level_spread=0.35, seed=1).floors
    return np.asarray(moved, dtype=np.float32).astype(float)


def spoilt(floors: np.ndarray, at: tuple[int, ...]) -> np.ndarray:
    x = floors.copy()
    for k in at:
        x[k, 1] += 20.0 * float(x[:, 1].std())
    return x


def test_a_sound_recording_loses_nothing(floors: np.ndarray, cut: Cut) -> None:
    segments = gather(cut(floors, RATE), FRONT_END)
    assert segments.left_out == () and segments.drift is None and segments.t_s.size == 28


@pytest.mark.parametrize("sizes", [(1777,), (100, 3, 9000)])
def test_segments_with_a_spike_are_left_out_however_the_samples_come(
    floors: np.ndarray, cut: Cut, sizes: tuple[int, ...]
) -> None:
    x = spoilt(floors, (20_000, 41_000))
    whole, parts = gather(cut(x, RATE, (len(x),)), FRONT_END), gather(cut(x, RATE, sizes), FRONT_END)
    assert whole.left_out == parts.left_out
    assert (whole.values == parts.values).all()
    (item,) = whole.left_out
    assert (item.kind, item.channel) == ("spike", "a2") and "2 spikes" in item.says
    assert 2.0 <= item.seconds <= 5.0
    assert whole.t_s.size < 28 and whole.samples < gather(cut(floors, RATE), FRONT_END).samples
    for second in (100.0, 205.0):
        assert (np.abs(whole.t_s - second) >= 10.0).all()


def test_the_rest_is_as_it_was(floors: np.ndarray, cut: Cut) -> None:
    sound, rest = gather(cut(floors, RATE), FRONT_END), gather(cut(spoilt(floors, (20_000,)), RATE), FRONT_END)
    kept = np.isin(sound.t_s, rest.t_s)
    assert kept.sum() == rest.t_s.size
    np.testing.assert_allclose(rest.values, sound.values[kept], atol=1e-6 * np.abs(sound.values).max())


def test_too_little_is_left_says_why(floors: np.ndarray, cut: Cut) -> None:
    x = spoilt(floors[:24_000], tuple(range(3000, 24_000, 3000)))
    with pytest.raises(BadInputError, match=r"hold no fault of a sensor.*channel a2 has 7 spikes"):
        gather(cut(x, RATE), FRONT_END)


def test_a_clipped_channel_is_left_to_the_diagnosis(floors: np.ndarray, cut: Cut) -> None:
    x = floors.copy()
    limit = 1.5 * float(x[:, 1].std())
    x[:, 1] = x[:, 1].clip(-limit, limit)
    assert gather(cut(x, RATE), FRONT_END).left_out == ()


def test_hum_and_drift_are_told_with_their_frequencies(floors: np.ndarray, cut: Cut) -> None:
    x, t = floors.copy(), np.arange(len(floors)) / RATE
    x[:, 0] += 0.3 * float(x[:, 0].std()) * np.sin(2.0 * np.pi * 180.1 * t)
    walk = np.random.default_rng(4).standard_normal(len(x)).cumsum()
    x[:, 2] += 2.0 * float(x[:, 2].std()) * (walk - walk.mean()) / walk.std()
    segments = gather(cut(x, RATE), FRONT_END)
    drift, hum = segments.left_out
    assert (drift.kind, drift.channel, hum.kind, hum.channel) == ("drift", "a3", "mains hum", "a1")
    ((low, high),) = hum.hz
    assert low < 19.9 < high and drift.hz[0][0] == pytest.approx(2.0)
    assert segments.drift is not None and (segments.drift[:, 2] > 0.0).all() and not segments.drift[:, :2].any()
    observed = classify(segments)
    assert observed.drift is segments.drift and isinstance(observed.segments, Segments)
    assert isinstance(hum, LeftOut) and "60 Hz" in hum.says and "20" not in hum.channel


def test_a_channel_without_samples_is_named_where_nothing_is_left_to_compare(floors: np.ndarray, cut: Cut) -> None:
    x = floors.copy()
    x[500:, 1] = np.nan
    with pytest.raises(
        BadInputError, match=r"channel a2 has no finite sample in 99 % of it; a diagnosis takes all channels"
    ):
        gather(cut(x, RATE), FRONT_END)
    x[500:] = np.nan
    with pytest.raises(BadInputError, match=r"channel a1 .* channel a2 .* channel a3"):
        gather(cut(x, RATE), FRONT_END)
