"""Operators' requests: in the ledger before they act, refused while it cannot be written, few a minute from one asker."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import SampleBlock
from monitor.runs import ledger_chain
from monitor.service import restart
from monitor.service.outlets import inbox
from monitor.service.outlets.inbox import Inbox
from monitor.service.requests import Answer, RateLimit, Request
from monitor.service.status import look
from tests.service.desk import Desk, ledger_of
from tests.support.damages import DAMAGES
from tests.support.samples import Cli, Cut
from tests.support.site import RATE, SITE, Daemon, Scripted

SHELVE = Request(action="shelve", story=2, who="Ada", note="while the disk is full", seconds=2_592_000.0)
UNSHELVE = Request(action="unshelve", story=2, who="Ada")


class Answered(Scripted):
    """A source that ends when every request was answered, or after some seconds."""

    def __init__(self, script: Sequence[SampleBlock], desk: Desk) -> None:
        super().__init__([*script, *[None] * 500])
        self._desk = desk

    def read(self, timeout_s: float) -> SampleBlock | None:
        done = self.given >= 1 and not self._desk.batches and len(self._desk.answers) == self._desk.asked
        return super().read(timeout_s) if not done else self._end()

    def _end(self) -> SampleBlock | None:
        self._script = iter(())
        return super().read(0.0)


def run(path: Path, blocks: Sequence[SampleBlock], *batches: Sequence[Request], **options: Any) -> tuple[Daemon, Desk]:
    desk = Desk(*batches)
    daemon = Daemon(path, Answered(blocks, desk), [desk], tick_s=0.01, **options)
    daemon.run()
    return daemon, desk


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory, frame_text: str, record: np.ndarray, cut: Cut) -> Path:
    """A folder whose ledger has two requests; tests use copies."""
    folder = tmp_path_factory.mktemp("asked")
    (folder / "site.toml").write_text(SITE + frame_text)
    run(folder / "site.toml", cut(record, RATE)[:5], [SHELVE], [UNSHELVE])
    return folder


def test_what_the_ledger_cannot_take_is_refused_and_changes_nothing(site: Path, record: np.ndarray, cut: Cut) -> None:
    (site.parent / "out" / "ledger.jsonl").mkdir(parents=True)
    ahead_s = [0.0]
    daemon, desk = run(site, cut(record, RATE)[:5], [SHELVE], clock=lambda: time.monotonic() + ahead_s[0])
    (answer,) = desk.answers
    assert answer.again and "ledger.jsonl: cannot be written" in str(answer.refusal)
    assert daemon.session.pipeline.state.alarm.stories[1].shelved is None
    health = look(site.parent / "out")["health"]
    assert "ledger.jsonl" in health["failed"]["ledger.jsonl"] and health["ledger_head"] is None
    handler = dict(daemon.outputs())["ledger.jsonl"]
    assert handler.failed is not None
    ahead_s[0] = 61.0
    assert handler.failed is None, "a trouble of long ago is none of the present"


@pytest.mark.parametrize("damage", DAMAGES)
def test_whatever_the_ledger_holds_a_request_is_answered(
    tmp_path: Path, asked: Path, record: np.ndarray, cut: Cut, main: Cli, damage: str
) -> None:
    """Applied, unless it is no file; what was damaged is found by a check of the chain, or was no line of it yet."""
    shutil.copytree(asked, tmp_path, dirs_exist_ok=True)
    place = tmp_path / "out" / "ledger.jsonl"
    DAMAGES[damage](place)
    daemon, desk = run(tmp_path / "site.toml", cut(record, RATE)[:5], [SHELVE])
    (answer,) = desk.answers
    shelved = daemon.session.pipeline.state.alarm.stories[1].shelved
    if damage in {"a folder", "a dangling link"}:
        assert answer.again and "ledger.jsonl: cannot be written" in str(answer.refusal) and shelved is None
    else:
        assert answer.refusal is None and shelved is not None and b"Ada" in place.read_bytes().splitlines()[-1]
    done = main("status", place.parent, "--verify")
    assert done.returncode in {12, 65, 66} and done.stderr.count("\n") <= 1, done


def test_an_answer_comes_after_the_ledger_and_what_changes_nothing_is_not_written(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    saves = []
    really = restart.Checkpointer.save
    monkeypatch.setattr(restart.Checkpointer, "save", lambda k, s: (saves.append(s.now_ns), really(k, s))[-1])
    nobody = Request(action="acknowledge", story=2, who="Eve")
    absent = nobody.model_copy(update={"story": 9})
    blocks = cut(record, RATE)[:5]
    run(site, blocks, [UNSHELVE])
    idle = len(saves)
    saves.clear()
    daemon, desk = run(site, blocks, [nobody, absent, *[SHELVE, UNSHELVE] * 20, SHELVE], [nobody] * 64)
    assert [a.refusal is None for a in desk.answers] == [True, False, *[True] * (41 + 64)]
    assert "no story 9" in str(desk.answers[1].refusal) and not desk.answers[1].again
    assert len(ledger_of(site)) == 41 and ledger_chain.verify(site.parent / "out" / "ledger.jsonl") == 41
    assert len(saves) == idle + 1, "one checkpoint a batch that changes something"
    assert daemon.session.pipeline.state.alarm.stories[1].shelved is not None


def test_what_was_accepted_outlasts_a_kill_at_that_moment(site: Path, record: np.ndarray, cut: Cut) -> None:
    """A copy of the folder at the moment of the answer is what a kill would leave."""
    out, left = site.parent / "out", site.parent / "left"

    class Copying(Desk):
        def answer_requests(self, answers: Sequence[Answer]) -> None:
            super().answer_requests(answers)
            for part in ("state", "recordings"):
                shutil.copytree(out / part, left / part)
            for name in ("ledger.jsonl", "results.jsonl"):
                shutil.copy(out / name, left / name)

    desk, blocks = Copying([SHELVE]), cut(record, RATE)
    left.mkdir()
    Daemon(site, Answered(blocks[:5], desk), [desk]).run()
    assert [answer.refusal for answer in desk.answers] == [None]
    site.write_text(site.read_text().replace('dir = "out"', 'dir = "left"'))
    daemon = Daemon(site, Scripted(blocks[5:8]))
    shelved = daemon.session.pipeline.state.alarm.stories[1].shelved
    daemon.run()
    assert shelved is not None and "while the disk is full (Ada)" in shelved.reason
    assert (left / "ledger.jsonl").read_text().count("Ada") == 1


def test_one_asker_has_ten_requests_at_once_and_ten_a_minute() -> None:
    now = [0.0]
    limit = RateLimit(lambda: now[0])
    accepted = 0
    for k in range(20_000):  # twenty seconds
        now[0] = k * 1e-3
        accepted += limit.refusal("Ann") is None
    assert accepted == 13
    assert limit.refusal("Bob") is None, "the other asker is not held up"
    assert sum(limit.refusal(f"name {k}") is None for k in range(1000)) == 6, "names do not multiply the rate"
    now[0] += 61.0
    assert sum(limit.refusal("Ann") is None for _ in range(20)) == 10


def test_a_flood_of_files_waits_and_the_other_asker_does_not(tmp_path: Path) -> None:
    now = [0.0]
    box = Inbox(tmp_path / "requests", lambda: now[0])
    for _ in range(30):
        inbox.leave_request(tmp_path / "requests", SHELVE)
    inbox.leave_request(tmp_path / "requests", UNSHELVE.model_copy(update={"who": "Bob"}))
    taken = box.take_requests()
    assert [r.who for r in taken] == [*["Ada"] * 10, "Bob"]
    box.answer_requests([*[Answer()] * 9, Answer("the disk is full", again=True), Answer("no story 9")])
    left = os.listdir(tmp_path / "requests")
    assert sum(name.endswith(".json") for name in left) == 31 - 9 - 1
    (refused,) = [name for name in left if not name.endswith(".json")]
    assert inbox.take_refusal(tmp_path / "requests" / refused.replace(".refused", ".json")) == "no story 9"
    now[0] = 6.5
    assert len(box.take_requests()) == 1


def test_a_note_that_no_daemon_would_read_is_refused_where_it_is_written() -> None:
    with pytest.raises(ValueError, match=r"4096 bytes at most: shorten the note"):
        Request(
            action="acknowledge", story=1, who="\N{BUILDING CONSTRUCTION}" * 9, note="\N{BUILDING CONSTRUCTION}" * 1000
        )
    assert Request(action="acknowledge", story=1, who="Ada", note="ü" * 1000).note


def test_refusals_that_nobody_takes_do_not_pile_up_and_a_taken_one_is_gone(tmp_path: Path) -> None:
    folder = tmp_path / "requests"
    asked = [
        inbox.leave_request(folder, Request(action="acknowledge", event="never", who=f"asker {k % 8}"))
        for k in range(70)
    ]
    now = [0.0]
    box = Inbox(folder, lambda: now[0], every_s=0.0)
    while any(place.exists() for place in asked):
        now[0] += 60.0
        box.answer_requests([Answer(f"refused at {now[0]:g} s")] * len(box.take_requests()))
    assert len(os.listdir(folder)) == 64
    says = [inbox.take_refusal(place) for place in asked]
    assert says[:6] == [None] * 6 and all(text is not None and text.startswith("refused at") for text in says[6:])
    assert not os.listdir(folder) and inbox.take_refusal(asked[-1]) is None


def test_status_shows_the_head_and_checks_the_chain(tmp_path: Path, asked: Path, main: Cli) -> None:
    out = shutil.copytree(asked / "out", tmp_path / "out")
    found = json.loads(main("status", out, "--json").stdout)
    assert len(found["ledger_head"]) == 64 and found["health"]["ledger_head"] == found["ledger_head"]
    done = main("status", out, "--verify")
    assert done.returncode == 12 and "2 lines, the chain is whole" in done.stdout
    rows = (out / "ledger.jsonl").read_text().splitlines(keepends=True)
    for changed, says in (([rows[0].replace("Ada", "Bob"), rows[1]], "line 2 "), (rows[:1], "after line 1 ")):
        (out / "ledger.jsonl").write_text("".join(changed))
        done = main("status", out, "--verify")
        assert done.returncode == 65 and says in done.stderr and done.stderr.count("\n") == 1
