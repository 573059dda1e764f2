"""A real mast: level and temperature explain its frequencies, nothing is announced, and a loss of 1 % is."""

from __future__ import annotations

from tests.statistics.tower import LOSS_DAYS, weeks


def test_a_real_mast_is_healthy_and_one_percent_is_found() -> None:
    found = weeks()
    assert len(found.judge.models) == 4
    assert all(model.explained > 0.5 and model.std < 0.0025 for model in found.judge.models)
    assert found.announced() == 0
    assert sum(v.skipped is None for v in found.healthy) > 0.85 * len(found.healthy)
    delay_h = found.delay_h()
    assert delay_h is not None
    assert delay_h < 24.0 * LOSS_DAYS / 4.0
