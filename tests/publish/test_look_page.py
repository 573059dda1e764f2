"""The page of a quick look: its pictures lie where their axes say."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast
from xml.dom import minidom

import numpy as np
import pytest

from monitor.publish import LookedRecording
from monitor.publish.reports import look_page


@pytest.mark.parametrize("n_bins", [150, 268, 401])
def test_the_rows_of_a_spectrogram_lie_at_their_frequencies(monkeypatch: pytest.MonkeyPatch, n_bins: int) -> None:
    hz, tone = np.arange(n_bins) * 0.125, n_bins // 3
    power = np.full((4, n_bins, 1), 1e-6)
    power[:, tone] = 1.0
    drawn: list[np.ndarray] = []
    monkeypatch.setattr(look_page, "png", lambda level: drawn.append(level) or b"")
    shown = SimpleNamespace(hz=hz, spectrogram=power, spectrogram_s=(0.0, 60.0), channels=("a1",))
    chart = minidom.parseString(f"<p>{look_page.spectrograms(cast(LookedRecording, shown), float(hz[-1]))}</p>")
    labels = [
        (float(text.firstChild.data), float(text.getAttribute("y")) - 4.0)
        for text in chart.getElementsByTagName("text")
        if text.getAttribute("text-anchor") == "end" and text.firstChild.data != "time, s"
    ]
    slope, at_0 = np.polyfit(*zip(*labels, strict=True), 1)
    row = int(drawn[0][:, 0].argmax()) + 0.5
    height = float(chart.getElementsByTagName("image")[0].getAttribute("height")) / len(drawn[0])
    assert row * height == pytest.approx(slope * hz[tone] + at_0, abs=0.5 * height + 0.1)
