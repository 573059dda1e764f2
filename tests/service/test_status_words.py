"""What the status says to a person: the affected story first, and the command that acknowledges its alarm."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from monitor.service.status import look, tell

ALARM = {
    "level": "alarm",
    "stories": [1, 3],
    "active": {"1": "warning", "3": "alarm"},
    "conditions": {
        "1": "active, acknowledged",
        "2": "returned to normal, unacknowledged",
        "3": "active, unacknowledged",
    },
}


def written(folder: Path, **summary: Any) -> Path:
    """Write what a monitor that runs no longer left."""
    (folder / "state").mkdir()
    health = {"wall_ns": time.time_ns(), "source": {"connected": True}, "recorder": None, "failed": {}}
    (folder / "health.jsonl").write_text(json.dumps(health) + "\n")
    state = {"state": "alarm", "headline": "Story 3 lost 20 %.", "doubts": []}
    (folder / "summary.json").write_text(json.dumps(state | summary))
    return folder


def test_the_affected_story_comes_first_and_each_alarm_has_the_command_that_acknowledges_it(tmp_path: Path) -> None:
    event = {"id": "e 1", "condition": "active, unacknowledged"}
    known = {"names": ["roof", "middle", "cellar"]}
    found = look(written(tmp_path, alarm=ALARM, event_alarms=[event], known=known), "my site.toml")
    rows = tell(found).splitlines()
    assert rows[1].startswith("alarm     alarm; ")
    at = [rows[1].index(name) for name in ("cellar", "roof", "middle")]
    assert at == sorted(at)
    assert found["acknowledge"] == [
        "shm-monitor ack 'my site.toml' --story 3 --who NAME",
        "shm-monitor ack 'my site.toml' --story 2 --who NAME",
        "shm-monitor ack 'my site.toml' --event 'e 1' --who NAME",
    ]
    assert rows[2] == "to do     " + "; ".join(found["acknowledge"])


def test_where_nothing_waits_for_a_person_nothing_is_to_be_done(tmp_path: Path) -> None:
    conditions = {"1": "active, acknowledged", "2": "latched, acknowledged", "3": "shelved"}
    found = look(
        written(tmp_path, alarm=ALARM | {"conditions": conditions}, event_alarms=[{"id": "e", "condition": "normal"}])
    )
    assert found["acknowledge"] == []
    assert "to do" not in tell(found)
    assert [row.split()[0] for row in tell(found).splitlines()][:3] == ["state", "doubts", "monitor"]


def test_a_damaged_summary_asks_for_nothing(tmp_path: Path) -> None:
    for alarm in ({"conditions": 3}, {"conditions": {"x": "active, unacknowledged"}, "active": {}}, 7):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        assert look(written(folder, alarm=alarm))["acknowledge"] == []
