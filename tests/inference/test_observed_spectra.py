"""Into which classes of level a recording's segments are divided."""

from __future__ import annotations

import numpy as np

from monitor.inference import classify, gather
from monitor.model import Model, simulate
from monitor.signals import FrontEnd, ProcessingSettings
from tests.support.samples import CHANNELS, Cut
from tests.support.simulated import PAPER_FRAME

RATE = 200.0
FRONT_END = FrontEnd(CHANNELS, ProcessingSettings(), segment_s=20.0, n_lags=100)
FRAME = Model(PAPER_FRAME)


def classes(level: np.ndarray, cut: Cut) -> list[np.ndarray]:
    """List the middles of the segments of each class, s, of steady motion times a level."""
    floors = simulate(FRAME, duration_s=1200.0, rate_hz=RATE, noise=0.02, level_spread=0.0, seed=3).floors
    observed = classify(gather(cut(floors * level[:, None], RATE), FRONT_END))
    assert (
        observed.counts.tolist() == [m.size for m in observed.members]
        and observed.counts.sum() == observed.segments.t_s.size
    )
    assert sorted(np.concatenate(observed.members)) == list(range(observed.segments.t_s.size))
    return [observed.segments.t_s[m] for m in observed.members]


def test_a_gust_is_a_class_of_its_own(cut: Cut) -> None:
    level = np.ones(240_000)
    level[150_000:190_000] = 5.0  # a sixth of the recording: a fifth of the segments by rank would hold weak ones too
    *others, strongest = classes(level, cut)
    assert ((strongest > 740.0) & (strongest < 960.0)).all()
    assert all(((t < 760.0) | (t > 940.0)).all() for t in others)


def test_segments_of_a_steady_recording_are_shared_out(cut: Cut) -> None:
    found = classes(np.ones(240_000), cut)
    assert len(found) == 5 and min(t.size for t in found) >= 12
