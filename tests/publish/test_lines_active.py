"""The levels of all stories come back from a line of results.jsonl."""

from __future__ import annotations

from monitor.core import Level
from monitor.publish.results.lines import facts_of_line

LINE = {
    "t_end_ns": 1,
    "skipped": None,
    "ddi": [0.12, 0.0, 0.04],
    "ddi_std": [0.01, 0.01, 0.01],
    "loss_n_per_m": None,
    "alarm": {"level": "alarm", "stories": [1], "reason": "", "active": {"1": "alarm", "3": "warning"}},
}


def test_a_story_below_the_highest_level_stays_announced() -> None:
    assert facts_of_line(LINE).active == {1: Level.ALARM, 3: Level.WARNING}
