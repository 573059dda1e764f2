"""Emulator and daemon as two processes, over CAN, Zenoh and MQTT: nothing lost, live is replay, bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.live import measure, wrong
from tests.support.debian import demand

pytestmark = pytest.mark.system


@pytest.mark.parametrize("kind", ["can", "zenoh", "mqtt"])
def test_live_is_replay_of_the_source_and_of_what_was_recorded(kind: str, tmp_path: Path) -> None:
    if kind == "mqtt":
        demand("mosquitto")
    found = measure(tmp_path, kind, seconds=40.0, speed=8.0, window_s=20.0, calibration_s=60.0)
    assert found["windows"] == found["judged"] == 5
    assert found["exit_code"] == 0
    # Latency, load and the time to end are the benchmark's to judge, at real pace on a quiet machine.
    assert [name for name in wrong(found) if not any(t in name for t in ("latency", "core", "within"))] == []
