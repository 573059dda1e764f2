"""The budget of the recordings of events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from monitor.events import Event, EventSettings
from monitor.runs import EventRecordings


@pytest.mark.parametrize(("kept_gb", "recorded"), [(0.9, True), (1.1, False)])
def test_an_event_is_recorded_until_the_folder_holds_what_it_may(
    tmp_path: Path, kept_gb: float, recorded: bool
) -> None:
    (tmp_path / "events").mkdir()
    with (tmp_path / "events" / "earlier.mcap").open("wb") as file:
        file.truncate(round(kept_gb * 2**30))  # of holes alone
    none = np.zeros(0)
    event = Event("e", 0, 0, 0, (), None, None, None, 0.1, *(none,) * 8, verdict=None)
    name = EventRecordings(tmp_path, EventSettings(keep_gb=1.0)).save(event, {})
    assert (name, (tmp_path / "events" / "e.mcap").exists()) == ("events/e.mcap" if recorded else None, recorded)
