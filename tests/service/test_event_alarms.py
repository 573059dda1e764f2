"""The alarm of an event in a daemon: listed in the status, acknowledged by an operator's request, kept over a restart."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from monitor.damage import StoryState
from monitor.events import Event, EventAlarm
from monitor.runs import ledger, ledger_chain
from monitor.service.history import open_database
from monitor.service.requests import Request
from monitor.service.restart import KeptAlarms
from monitor.service.status import look, tell
from tests.events.shaken import blocks
from tests.service.checkpoint import restored
from tests.service.desk import Desk, ledger_of
from tests.support.quake import shaken
from tests.support.samples import Cli
from tests.support.shaken_site import SITE
from tests.support.site import Daemon, Scripted


@dataclass
class Seen:
    id: str = ""
    state: str = ""


class Operator(Desk):
    """Acknowledges an event once it is told of it, and of one that there was not, if `acts`."""

    def __init__(self, *, acts: bool) -> None:
        super().__init__()
        self.seen, self._acts = Seen(), acts

    def event(self, event: Event, line: str) -> None:
        if event.revision is None:
            self.seen = Seen(event.id, self.present.headline)
            batch = [
                Request(action="acknowledge", event=id, who="Ada", note="went there") for id in (event.id, "never")
            ]
            self.batches += [batch] if self._acts else []


class Waiting(Scripted):
    """Gives what is left when the operator was answered."""

    def __init__(self, script: Sequence[object], desk: Operator) -> None:
        super().__init__([*script, *[None] * 100])  # type: ignore[list-item]
        self._desk = desk

    def read(self, timeout_s: float) -> object:  # type: ignore[override]
        if self._desk.seen.id and self._desk.answers:
            self._script = iter(())
        return super().read(timeout_s)


def run(folder: Path, desk: Operator) -> Path:
    """A daemon on a record with an event; returns the folder that it wrote."""
    (folder / "site.toml").write_text(SITE)
    Daemon(folder / "site.toml", Waiting(blocks(shaken(), n=500), desk), [desk], tick_s=0.01).run()  # type: ignore[arg-type]
    return folder / "out"


def test_it_stands_until_an_operator_acknowledges_it_also_where_the_ledger_cannot_take_its_checksum(
    tmp_path: Path, main: Cli
) -> None:
    (tmp_path / "out" / "ledger.jsonl").mkdir(parents=True)
    desk = Operator(acts=False)
    out = run(tmp_path, desk)
    status = look(out)
    assert (out / "events" / f"{desk.seen.id}.mcap").is_file()
    assert "ledger.jsonl: cannot be written" in status["health"]["failed"]["ledger.jsonl"]
    assert status["state"] == "alarm" and f"vent {desk.seen.id} exceeded a limit" in desk.seen.state
    assert f"vent {desk.seen.id} exceeded a limit" in status["headline"]
    (alarm,) = status["summary"]["event_alarms"]
    assert alarm["condition"] == "returned to normal, unacknowledged" and "go and look" in alarm["exceeded"][0]
    assert tell(status).splitlines()[2] == f"to do     shm-monitor ack SITE.toml --event {desk.seen.id} --who NAME"
    for options in ((), ("--story", "1", "--event", desk.seen.id), ("--event", desk.seen.id, "--reset")):
        assert main("ack", tmp_path / "site.toml", "--who", "Ada", *options).returncode == 2


def test_it_outlasts_a_change_of_the_settings() -> None:
    kept = KeptAlarms((StoryState(),), (EventAlarm("e", ("x",), ((0, 2),)),))
    assert restored(kept) == kept


def test_the_request_is_in_ledger_and_history_and_takes_the_alarm_away_and_the_recording_is_checked(
    tmp_path: Path, main: Cli
) -> None:
    desk = Operator(acts=True)
    out = run(tmp_path, desk)
    first, second = desk.answers
    assert first.refusal is None and "event never has no alarm" in str(second.refusal)
    lines = ledger_of(tmp_path / "site.toml")
    assert [line["what"] for line in lines if not line["files"]] == [
        f"acknowledge alarm of event {desk.seen.id}: went there"
    ]
    status = look(out)
    (alarm,) = status["summary"]["event_alarms"]
    assert (alarm["condition"], alarm["by"]) == ("normal", "Ada")
    assert status["state"] != "alarm" and "\nto do " not in tell(status)
    rows = open_database(out / "state" / "history.db").execute("SELECT story, note FROM requests").fetchall()
    assert [tuple(row) for row in rows] == [(None, f"event {desk.seen.id}: went there")]
    (line,) = [line for line in lines if line["files"]]
    noted, recording = line["files"]["recording"], out / "events" / f"{desk.seen.id}.mcap"
    assert noted == {"file": f"events/{recording.name}", "sha256": hashlib.sha256(recording.read_bytes()).hexdigest()}
    assert status["ledger_head"] == status["health"]["ledger_head"]
    done = main("status", out, "--verify")
    assert "2 lines, the chain is whole" in done.stdout and "event recordings unchanged: 1" in done.stdout
    recording.write_bytes(recording.read_bytes()[:-1] + b"x")
    done = main("status", out, "--verify")
    assert done.returncode == 65 and str(recording) in done.stderr and done.stderr.count("\n") == 1
    recording.unlink()
    done = main("status", out, "--verify")
    assert done.returncode == 12 and "event recordings" not in done.stdout


def test_the_last_line_of_health_names_the_last_line_of_a_slow_ledger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = ledger_chain.append_lines

    def slow(*what: Any) -> str:
        time.sleep(0.4)
        return append(*what)

    monkeypatch.setattr(ledger_chain, "append_lines", slow)
    status = look(run(tmp_path, Operator(acts=True)))
    assert status["ledger_head"] == status["health"]["ledger_head"] is not None


def test_a_recording_that_was_written_again_is_as_its_later_line_says(tmp_path: Path) -> None:
    place, recording = tmp_path / "ledger.jsonl", tmp_path / "events" / "e.mcap"
    recording.parent.mkdir()
    for text in (b"first", b"second"):
        recording.write_bytes(text)
        entry = ledger.recording_entry("events/e.mcap", hashlib.sha256(text).hexdigest())
        ledger_chain.append_lines(place, [{"files": 3}, entry])
        assert ledger.verify_recordings(place) == 1
