"""The page of a quick look: its pictures lie where their axes say."""

from __future__ import annotations

from base64 import b64decode
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from monitor.publish import LookedRecording
from monitor.publish.reports import look_page


@pytest.mark.parametrize("n_bins", [150, 268, 401])
def test_the_rows_of_a_spectrogram_lie_at_their_frequencies(n_bins: int) -> None:
    hz, tone = np.arange(n_bins) * 0.125, n_bins // 3
    power = np.full((4, n_bins, 1), 1e-6)
    power[:, tone] = 1.0
    shown = SimpleNamespace(hz=hz, spectrogram=power, spectrogram_s=(0.0, 60.0), channels=("a1",))
    (chart,) = look_page.spectrograms(cast(LookedRecording, shown), float(hz[-1]))
    (picture,) = chart.marks
    levels = np.frombuffer(b64decode(picture["levels"]), dtype=np.uint8).reshape(picture["rows"], picture["columns"])
    low, high = picture["y"]
    assert (low, high) == chart.y and levels.shape[1] == 4
    height = (high - low) / len(levels)
    top_down = int(levels[:, 0].argmax())
    assert high - (top_down + 0.5) * height == pytest.approx(hz[tone], abs=0.5 * height + 0.001)
