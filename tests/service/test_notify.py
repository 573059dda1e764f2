"""People are told: what changed, once, in order, whatever fails on the way; and never an address in a log."""

from __future__ import annotations

import ast
import json
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monitor.core import Alarm, AlarmCondition, Level, Skipped, WindowResult, Worker
from monitor.damage import Assessment, State
from monitor.service.daemon_health import losses
from monitor.service.outlets import notices
from monitor.service.outlets.delivery_workers import Deliveries, DeliveryProcess, send_test
from monitor.service.outlets.notices import Notice, NoticeSettings, Told, of_finding, of_health, of_window
from monitor.service.outlets.notify import Addresses, Notifier, NotifySettings, addresses
from monitor.service.outlets.outbox import Outbox
from tests.support.hooks import Drip, Hook
from tests.support.results import damage_reading
from tests.support.samples import Cli
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

SETTINGS = NoticeSettings()
WELL = Assessment(State.NORMAL, "No loss above 2.3 % in any story.")


def window(t_s: float, skipped: str | None = None, shelved: tuple[int, ...] = (), **levels: Level) -> WindowResult:
    """``s2=Level.WARNING``: what is announced of story 2."""
    active = {int(name[1:]): level for name, level in levels.items()}
    conditions = {j: AlarmCondition.UNACKNOWLEDGED for j in active} | dict.fromkeys(shelved, AlarmCondition.SHELVED)
    level = max(active.values(), key=lambda x: x.rank, default=Level.NORMAL)
    alarm = Alarm(level, tuple(active), "story 2 lost 5 %", active, conditions)
    reason = None if skipped is None else Skipped(skipped)
    return WindowResult(0, round(t_s * 1e9), 20.0, None, None, None, alarm, reason)


def health(*, data: bool = True, recording: bool | None = True) -> dict[str, Any]:
    recorder = None if recording is None else {"recording": recording, "detail": "" if recording else "disk full"}
    source = {"connected": data, "says": "connected" if data else "lost (bus off)", "detail": ""}
    return {"stream": {} if data else None, "source": source, "recorder": recorder}


def titles(results: list[WindowResult], settings: NoticeSettings = SETTINGS, told: Told = Told()) -> list[str]:  # noqa: B008
    said = []
    for result in results:
        told, notices = of_window(told, result, WELL, settings)
        said += [notice.title for notice in notices]
    return said


def test_alarms_are_told_when_they_rise_and_when_they_are_over_and_never_twice() -> None:
    rising = [window(0), window(10, s2=Level.ADVISORY), window(20, s2=Level.WARNING), window(30, s2=Level.WARNING)]
    assert titles(rising) == ["advisory: story 2", "warning: story 2"]
    sinking = [window(40, s2=Level.ADVISORY), window(50, s2=Level.WARNING), window(60), window(70)]
    assert titles(rising + sinking) == ["advisory: story 2", "warning: story 2", "cleared: story 2"]
    both = [window(0, s0=Level.ADVISORY, s1=Level.ALARM)]
    assert titles(both) == ["advisory: the whole structure", "alarm: story 1"]


def test_an_alarm_whose_story_is_gone_is_told_as_the_whole_structure_s_and_not_as_cleared() -> None:
    """After the site file has fewer stories, or modes alone: `damage.alarm.carry_over`."""
    reading, told = damage_reading(np.zeros(2), np.eye(2)), Told({3: Level.ALARM, 2: Level.WARNING})
    course = [replace(window(0, s0=Level.ALARM, s2=Level.WARNING), damage=reading), replace(window(10), damage=reading)]
    titles_of = [notice.title for notice in told_of([(result, WELL) for result in course], told)[1]]
    assert titles_of == ["alarm: the whole structure", "cleared: the whole structure", "cleared: story 2"]


def test_an_alarm_is_titled_by_the_name_of_its_story() -> None:
    names = ("storey 1 (ground to 1st floor), along y", "storey 2 (1st to 2nd floor), along y")
    (notice,) = of_window(Told(), window(0, s2=Level.ALARM), WELL, SETTINGS, names)[1]
    assert (notice.title, notice.about) == (f"alarm: {names[1]}", names[1])


def test_only_levels_that_are_asked_for() -> None:
    course = [window(0, s1=Level.ADVISORY), window(10), window(20, s1=Level.ALARM), window(30)]
    assert titles(course, NoticeSettings(level=Level.WARNING)) == ["alarm: story 1", "cleared: story 1"]


def test_shelving_is_neither_news_nor_the_end() -> None:
    course = [window(0, s2=Level.WARNING), window(10, shelved=(2,)), window(20, s2=Level.WARNING), window(30)]
    assert titles(course) == ["warning: story 2", "cleared: story 2"]


def test_skipped_windows_change_nothing_until_they_last() -> None:
    course = [window(0, s2=Level.WARNING), *(window(t, skipped="gap in the data") for t in range(10, 3600, 10))]
    assert titles(course) == ["warning: story 2"]
    longer = [*course, window(3600, "gap in the data"), window(3610, "gap in the data"), window(3620, s2=Level.WARNING)]
    assert titles(longer) == ["warning: story 2", "not judged", "judged again"]
    assert titles(course, told=Told(judged_ns=-round(1e13))) == ["warning: story 2"]


def test_source_and_recorder() -> None:
    told, said = Told(), []
    for line, silent_s in [
        (health(), 0.0),
        (health(data=False), 299.0),
        (health(data=False), 300.0),
        (health(data=False, recording=False), 310.0),
        (health(data=False, recording=False), 320.0),
        (health(), 0.0),
        (health(recording=None), 0.0),
    ]:
        told, notices = of_health(told, line, silent_s, SETTINGS)
        said += [(notice.title, notice.good) for notice in notices]
    lost, back = ("source lost", False), ("source is back", True)
    assert said == [lost, ("recorder stopped", False), back, ("recorder goes on", True)]
    assert (
        of_health(Told(), health(data=False), 300.0, SETTINGS)[1][0].text == "no data for 5 min; source lost (bus off)"
    )


def test_a_source_that_is_connected_and_sends_nothing_is_not_called_lost() -> None:
    line = health()
    line["source"]["detail"] = "connected with 127.0.0.1:1883"
    _, (notice,) = of_health(Told(), line, 300.0, SETTINGS)
    assert (notice.title, notice.text) == ("no data", "no data for 5 min, though connected with 127.0.0.1:1883")


def test_the_end_of_the_recordings_is_no_loss_of_the_source() -> None:
    line = health(data=False)
    line["source"]["ended"] = True
    assert of_health(Told(), line, 4000.0, SETTINGS)[1] == []


def told_of(course: list[tuple[WindowResult, Assessment]], told: Told = Told()) -> tuple[Told, list[Notice]]:  # noqa: B008
    said: list[Notice] = []
    for result, present in course:
        told, notices = of_window(told, result, present, SETTINGS)
        said += notices
    return told, said


DOUBTFUL = Assessment(State.DOUBTFUL, "Goodness of fit 31.", ("A doubt.",))
UNSEEN = Assessment(State.NOT_JUDGED, "No loss would have been seen.")


def test_a_doubt_is_told_once_it_has_lasted_a_window_s_length_and_so_is_its_end() -> None:
    one = [(window(0), WELL), (window(10), DOUBTFUL), (window(20), WELL), (window(30), DOUBTFUL), (window(40), WELL)]
    assert told_of(one)[1] == []
    told, said = told_of([(window(10.0 * k), DOUBTFUL) for k in range(9)])
    assert said == [Notice("doubtful", False, "doubtful", "Goodness of fit 31.\nA doubt.", "structure")]
    back = [(window(100), WELL), (window(110), DOUBTFUL), *((window(t), WELL) for t in (120, 130, 140, 150))]
    assert [n.title for n in told_of(back, told)[1]] == ["no longer doubtful: normal"]


def test_an_alarm_speaks_for_the_doubts_beside_it() -> None:
    lost = Assessment(State.WARNING, "Story 2 lost 5 %.", ("Goodness of fit 31.",))
    told, said = told_of([(window(10.0 * k, s2=Level.WARNING), lost) for k in range(9)])
    assert said == [Notice("alarm", False, "warning: story 2", "Story 2 lost 5 %.\nGoodness of fit 31.", "story 2")]
    assert [n.title for n in told_of([(window(90), WELL)], told)[1]] == ["cleared: story 2"]


def test_that_nothing_would_have_been_seen_is_told_as_long_as_that_nothing_was_judged() -> None:
    young = [(window(10.0 * k), UNSEEN) for k in range(300)]
    assert told_of([*young, (window(3000), WELL)])[1] == []
    course = [(window(10.0 * k), UNSEEN) for k in range(500)] + [(window(5000), WELL)]
    assert told_of(course)[1] == [
        Notice("blind", False, "not judged", UNSEEN.headline, "structure"),
        Notice("blind", True, "judged again", WELL.headline, "structure"),
    ]


def test_findings() -> None:
    found = {"verdict": "named", "says": "story 2 lost 6 %"}
    assert [n.text for n in of_finding(Told(), found, WELL, SETTINGS)[1]] == ["story 2 lost 6 %"]
    assert of_finding(Told(), {"verdict": None, "says": ""}, WELL, SETTINGS) == (Told(), [])
    assert of_finding(Told(), found, WELL, NoticeSettings(findings=False)) == (Told(), [])


def test_a_finding_that_makes_the_state_doubtful_is_one_message() -> None:
    doubtful = Assessment(State.DOUBTFUL, "Diagnosis 001: channels a1 and a3 are swapped (a proposal until accepted).")
    found = {"verdict": "named", "says": "channels a1 and a3 are swapped."}
    told, (notice,) = of_finding(Told(), found, doubtful, SETTINGS)
    assert notice.text == f"doubtful: {doubtful.headline}"
    assert told_of([(window(10.0 * k), doubtful) for k in range(9)], told)[1] == []


@pytest.fixture
def hook() -> Iterator[Hook]:
    server = Hook()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def drip() -> Iterator[Drip]:
    server = Drip()
    yield server
    server.close()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "outbox.jsonl"


QUICK = (0.02, 0.08)
"""Pauses before a message is tried again, s."""


class Clerk:
    """Delivers in the test's own process: keeps the jobs, and refuses those that it is told to."""

    def __init__(self) -> None:
        self.refuses: Callable[[dict[str, Any]], bool] = lambda job: False
        self.done: list[dict[str, Any]] = []
        self.tries = 0

    def run(self, job: Mapping[str, Any]) -> int:
        self.tries += 1
        if self.refuses(dict(job)):
            return 1
        self.done.append(dict(job))
        return 0

    def stop(self) -> None: ...

    @property
    def titles(self) -> list[str]:
        return [job["title"].removeprefix("[lab] ") for job in self.done if "title" in job]

    @property
    def paths(self) -> list[str]:
        """Of the heartbeats."""
        return [job["url"].removeprefix(BEAT) for job in self.done if "title" not in job]

    def notifier(self, place: Path, *urls: str, beats: tuple[str | None, ...] = (), **settings: Any) -> Notifier:
        deliveries = Deliveries(lambda: self, QUICK, set_aside=3)
        return Notifier("lab", NotifySettings(**settings), Addresses(urls, *beats), place, deliveries=deliveries)


BEAT, ONE, OTHER = "http://beat.test/", "json://one.test", "json://other.test"


@pytest.fixture
def clerk() -> Clerk:
    return Clerk()


def notifier(place: Path, to: Addresses, deadline_s: float = 30.0, **settings: Any) -> Notifier:
    """One whose deliveries are processes, as in service."""
    deliveries = Deliveries(lambda: DeliveryProcess(deadline_s), QUICK)
    return Notifier("lab", NotifySettings(**settings), to, place, deliveries=deliveries)


def tell(one: Notifier, *levels: Level, t_s: float = 0.0) -> None:
    """Tell of story 2 alone, or of three stories at once."""
    for level in levels:
        one.window(window(t_s, s2=level), "")
    if not levels:
        one.window(window(t_s, s1=Level.ADVISORY, s2=Level.WARNING, s3=Level.ALARM), "")


def test_messages_arrive_once_after_failures_also_across_restarts(place: Path, clerk: Clerk) -> None:
    clerk.refuses = lambda job: True
    one = clerk.notifier(place, ONE)
    tell(one, Level.ADVISORY)
    until(lambda: clerk.tries >= 2 and one.failed, "tried again")
    one.close(5.0)
    again = clerk.notifier(place, ONE)
    tell(again, Level.ADVISORY, t_s=10.0)  # it stands as before: not told again
    clerk.refuses = lambda job: False
    until(lambda: clerk.titles == ["advisory: story 2"], "after the restart")
    tell(again, Level.WARNING, t_s=20.0)
    until(lambda: len(clerk.titles) == 2, "the next")
    again.window(window(30), "")
    until(lambda: len(clerk.titles) == 3 and again.failed is None, "all have come")
    again.close(5.0)
    assert clerk.titles == ["advisory: story 2", "warning: story 2", "cleared: story 2"]
    assert [job["type"] for job in clerk.done] == ["warning", "warning", "success"]
    assert "superseded" not in "".join(job["body"] for job in clerk.done)
    assert len(Outbox(place)) == 0


def test_after_an_outage_the_newest_state_goes_first_and_tells_what_it_supersedes_in_one_line(
    place: Path, clerk: Clerk
) -> None:
    clerk.refuses = lambda job: job["url"] == ONE
    one = clerk.notifier(place, ONE, OTHER, most_per_hour=200)
    for k in range(50):
        tell(one, Level.WARNING, t_s=20.0 * k)
        until(lambda n=2 * k + 1: len(clerk.titles) == n, "the other has it")
        one.window(window(20.0 * k + 10.0), "")
        until(lambda n=2 * k + 2: len(clerk.titles) == n, "the other has it")
    one.close(5.0)
    clerk.done.clear()
    again = clerk.notifier(place, ONE, OTHER)
    again.window(window(2000.0, s1=Level.ALARM), "")
    until(lambda: clerk.done, "the other has it")
    clerk.refuses = lambda job: False
    until(lambda: len(clerk.done) == 3, "both know all")
    again.close(5.0)
    assert {job["url"] for job in clerk.done[:2]} == {ONE, OTHER}
    assert clerk.titles == ["alarm: story 1", "alarm: story 1", "cleared: story 2"]
    _, line, sent = clerk.done[2]["body"].split("\n")
    assert line.startswith("Not delivered since ") and sent.endswith("message 100")
    assert line.endswith("superseded by this: 50 x warning: story 2; 49 x cleared: story 2")
    assert len(Outbox(place)) == 0


def delivered_in_order(box: Outbox, lately: tuple[str, ...] = ()) -> list[str]:
    """Titles as the address `a` is to receive them."""
    titles = []
    while (message := box.first("a", lately=lately)) is not None:
        titles.append(message.notice.title)
        lately = (*(kind for kind in lately if kind != message.notice.kind), message.notice.kind)
        box.delivered(message, "a")
    return titles


def test_many_events_hold_up_no_alarm_and_the_newest_of_them_goes_first(place: Path) -> None:
    box = Outbox(place)
    for k in range(100):
        for told in ("preliminary", "measured"):
            box.add(Told(), [Notice("event", False, f"{told} {k}", "", f"e{k}")], ["a"])
    box.add(Told(), [Notice("alarm", False, "alarm: story 1", "", "story 1")], ["a"])
    titles = delivered_in_order(box)
    assert titles[:3] == ["measured 99", "alarm: story 1", "measured 98"] and len(titles) == 101


def test_a_standing_alarm_is_not_given_up_for_the_many_of_another_story(place: Path) -> None:
    box = Outbox(place, most=10)
    box.add(Told(), [Notice("alarm", False, "alarm: story 1", "", "story 1")], ["a"])
    box.add(Told(), [Notice("source", False, "source lost", "", "source")], ["a"])
    for k in range(25):
        box.add(Told(), [Notice("alarm", False, f"{k}", "", "story 2")], ["a"])
    assert len(box) == 10 and box.dropped == 17
    assert delivered_in_order(box) == ["24", "alarm: story 1", "source lost"]


def test_a_message_that_is_always_refused_does_not_hold_up_those_behind_it(place: Path, clerk: Clerk) -> None:
    clerk.refuses = lambda job: "alarm" in job["title"]
    one = clerk.notifier(place, ONE)
    tell(one)
    until(lambda: len(clerk.titles) == 2, "those behind it")
    assert clerk.titles == ["warning: story 2", "advisory: story 1"]
    until(lambda: one.failed, "the refused one is told")
    clerk.refuses = lambda job: False
    until(lambda: len(clerk.titles) == 3 and one.failed is None, "the refused one, tried without end")
    one.close(5.0)
    assert len(Outbox(place)) == 0


def test_one_that_takes_nothing_holds_up_no_other_and_is_forgotten_when_removed(place: Path, clerk: Clerk) -> None:
    clerk.refuses = lambda job: job["url"] == ONE
    one = clerk.notifier(place, ONE, OTHER)
    tell(one)
    until(lambda: len(clerk.titles) == 3 and clerk.tries > 20, "the other has all, this one was tried often")
    until(lambda: len(Outbox(place)) == 3, "stored")
    one.change(NotifySettings(), Addresses((OTHER,)))
    until(lambda: one.failed is None, "forgotten")
    one.window(window(10), "")
    until(lambda: len(clerk.titles) == 6, "goes on")
    one.close(5.0)
    assert len(Outbox(place)) == 0


@pytest.mark.parametrize("most", [2, 4])
def test_no_more_than_asked_for_in_an_hour_and_half_of_them_for_alarms(place: Path, clerk: Clerk, most: int) -> None:
    one = clerk.notifier(place, ONE, most_per_hour=most)
    for k in range(6):
        one.health_line(health(recording=k % 2 == 1))
        due = min(k + 1, most // 2)
        until(lambda n=due: len(clerk.titles) == n, "half")
    tell(one)
    until(lambda: len(clerk.titles) == most, "the other half")
    one.close(5.0)
    assert clerk.titles[most // 2 :] == ["alarm: story 3", "warning: story 2"][: most // 2]
    assert len(Outbox(place)) == 9 - most


def test_mail(place: Path) -> None:
    from aiosmtpd.controller import Controller

    letters: list[Any] = []

    class Box:
        async def handle_DATA(self, server: Any, session: Any, envelope: Any) -> str:
            letters.append(envelope)
            return "250 OK"

    port = free_port()
    box = Controller(Box(), hostname="127.0.0.1", port=port)
    box.start()
    try:
        one = notifier(place, Addresses((f"mailto://127.0.0.1:{port}?from=shm@lab.test&to=ann@lab.test",)))
        tell(one, Level.ALARM)
        until(lambda: letters, "a letter")
        one.close(5.0)
    finally:
        box.stop()
    assert letters[0].rcpt_tos == ["ann@lab.test"]
    assert b"alarm: story 2" in letters[0].content


@pytest.mark.parametrize(
    ("url", "told"), [("beat", "beat?ledger=ab12"), ("b?status=up#x", "b?status=up&ledger=ab12#x"), ("beat", "beat")]
)
def test_a_heartbeat_carries_the_head_of_the_ledger(place: Path, clerk: Clerk, url: str, told: str) -> None:
    one = clerk.notifier(place, beats=(BEAT + url,))
    one.health_line(health() | {"ledger_head": "ab12" if "ledger" in told else None})
    one.window(window(0), "")
    until(lambda: clerk.paths == [told], "a beat")
    one.close(5.0)


def test_the_heart_beats_while_windows_come_and_no_longer(place: Path, clerk: Clerk) -> None:
    one = clerk.notifier(place, beats=(f"{BEAT}well",), heartbeat_s=0.01)
    one.health_line(health())
    time.sleep(0.05)
    assert clerk.paths == []
    for count in range(1, 4):
        one.window(window(10.0 * count), "")
        until(lambda n=count: len(clerk.paths) == n, "a beat")
    for _ in range(5):
        one.health_line(health(data=False))
        time.sleep(0.02)
    one.close(5.0)
    assert len(clerk.paths) == 3


def test_a_heartbeat_comes_from_a_process_and_no_address_is_ever_written(
    tmp_path: Path, place: Path, hook: Hook, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("HUSH", "hush-hush")
    beat = f"http://127.0.0.1:{hook.server_port}/${{HUSH}}"
    settings = NotifySettings(urls=("json://127.0.0.1:9/${HUSH}",), heartbeat_url=beat)
    to = addresses(settings, tmp_path)
    assert to.urls == ("json://127.0.0.1:9/hush-hush",)
    hook.status = 500
    one = notifier(place, replace(to, urls=(*to.urls, hook.url)))
    tell(one, Level.ALARM)
    until(lambda: hook.tries and hook.paths, "tried")
    until(lambda: str(one.failed).count("has taken") == 2 and "not heard" in str(one.failed), "failed")
    one.close(5.0)
    logging.getLogger("urllib3").setLevel(logging.NOTSET)
    written = "".join(r.getMessage() for r in caplog.records if r.name.startswith(("monitor", "apprise")))
    assert "alarm: story 2" in written and "not heard" in written and hook.paths[0] == "/hush-hush"
    for text in (written, place.read_text(), str(one.failed), repr(to), repr(one)):
        assert "hush-hush" not in text and "127.0.0.1" not in text


def test_addresses_from_file_and_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOWHERE", raising=False)
    (tmp_path / "urls").write_text("# ours\n\njson://127.0.0.1:9/a\njson://127.0.0.1:9/a\n")
    assert addresses(NotifySettings(url_file=Path("urls")), tmp_path).urls == ("json://127.0.0.1:9/a",)
    (tmp_path / "urls").write_text("secret-nonsense\n")
    bad = NotifySettings(
        urls=("json://${NOWHERE}", "secret-too"), url_file=Path("urls"), heartbeat_url="file:///secret-three"
    )
    with pytest.raises(ValueError, match="NOWHERE") as caught:
        addresses(bad, tmp_path)
    says = str(caught.value)
    assert "mailtos://USER:PASSWORD@HOST?from=ADDRESS&to=ADDRESS" in says
    e_mail = "mailtos://shm:pw@mail.example.org?from=shm@example.org&to=ann@example.org"
    assert addresses(NotifySettings(urls=(e_mail,)), tmp_path).urls == (e_mail,), "of the form that is named"
    assert "urls[0]" in says and "urls[1]" in says and "url_file line 1" in says and "heartbeat_url" in says
    assert "secret" not in says
    with pytest.raises(ValueError, match="none"):
        addresses(NotifySettings(url_file=Path("none")), tmp_path)


def test_the_outbox_is_bounded_and_survives_damage_and_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "outbox.jsonl"
    box = Outbox(place, most=10)
    for k in range(25):
        box.add(Told(levels={k: Level.WARNING}), [Notice("alarm", False, f"{k}", "")], ["a", "b"])
    assert len(box) == 10 and box.dropped == 15
    assert len([r for r in caplog.records if "given up" in r.getMessage()]) == 15
    box.save()
    again = Outbox(place, most=10)
    assert again.told.levels == {24: Level.WARNING}
    first = again.first("a")
    assert first is not None and first.notice.title == "24" and first.id == 25
    again.delivered(first, "a")
    assert len(again) == 10 and again.first("b") == replace(first, to=("b",))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("monitor.service.outlets.outbox.write_atomically", full)
        again.add(Told(), [Notice("alarm", True, "kept", "")], ["a"])
        again.save()
        assert again.failed is not None and "space" in again.failed
    again.add(Told(lost=True), [], ["a"])
    again.save()
    assert again.failed is None and len(Outbox(place)) == 10
    for damage in (b"", b"{", b'{"version": 9}\n', b"[]\n", b"\xff\xfe", np.random.default_rng(1).bytes(300)):
        place.write_bytes(damage)
        fresh = Outbox(place)
        assert len(fresh) == 0 and fresh.told == Told()
        assert fresh.failed and not place.exists()


def test_after_damage_no_message_gets_a_number_that_another_one_had(tmp_path: Path) -> None:
    place = tmp_path / "outbox.jsonl"
    box = Outbox(place)
    for k in range(3):
        box.add(Told(), [Notice("alarm", False, f"{k}", "")], ["a"])
    box.save()
    place.write_bytes(place.read_bytes()[:-20])
    Outbox(place).save()  # of a run that has no message to tell
    box = Outbox(place)
    assert box.failed is None
    box.add(Told(), [Notice("alarm", False, "new", "")], ["a"])
    first = box.first("a")
    assert first is not None and first.id > 3


@pytest.mark.parametrize("wrong", [[1], "text", {"a": {}}, 1 << 80])
def test_times_that_somebody_wrote_into_the_outbox_end_no_window(place: Path, clerk: Clerk, wrong: object) -> None:
    """They are not stored, so that none is read."""
    one = clerk.notifier(place)
    tell(one, Level.WARNING)
    one.close(5.0)
    head, *rows = place.read_text().splitlines()
    content = json.loads(head)
    content["told"] |= {"judged_ns": wrong, "doubt_ns": wrong}
    place.write_text("\n".join([json.dumps(content), *rows]) + "\n")
    again = clerk.notifier(place)
    tell(again, Level.WARNING, t_s=10.0)
    assert again.failed is None
    again.close(5.0)
    assert Outbox(place).told.levels == {2: Level.WARNING}


def test_an_address_or_a_heartbeat_that_drips_holds_up_no_other_and_is_told_of(
    place: Path, hook: Hook, drip: Drip
) -> None:
    """A delivery's process imports a library, a second of a core, and is ended at its deadline."""
    to = Addresses((f"json://{drip.address}/hush-hush", hook.url), f"http://{drip.address}/hush-hush")
    one = notifier(place, to, deadline_s=3.0, heartbeat_s=0.05)
    tell(one)
    until(lambda: len(hook.got) == 3, "the other has all")
    assert hook.titles[0] == "[lab] alarm: story 3" and hook.got[0]["type"] == "warning"
    until(lambda: str(one.failed).count(" has taken ") == 1 and "not heard" in str(one.failed), "both are told")
    told = r"heartbeat not heard for \d+ s; delivery to address 1 \(json\) has taken \d+ s"
    assert re.fullmatch(told, str(one.failed))
    until(lambda: drip.calls >= 3, "there is another attempt")
    begun = time.monotonic()
    one.close(1.0)
    assert time.monotonic() - begun < 5.0
    until(lambda: not any(t.name.startswith("notify") for t in threading.enumerate()), "its worker ends")
    assert len(Outbox(place)) == 3 and one.dropped == 0


@pytest.mark.parametrize("says", [True, False])
def test_the_heartbeat_says_whether_messages_get_out(place: Path, clerk: Clerk, says: bool) -> None:
    beats = (f"{BEAT}well", f"{BEAT}blocked" if says else None)
    clerk.refuses = lambda job: "title" in job
    one = clerk.notifier(place, ONE, beats=beats, heartbeat_s=0.01)
    one.window(window(0), "")
    until(lambda: clerk.paths == ["well"], "all is well")
    tell(one, Level.ALARM, t_s=10.0)
    until(lambda: one.failed, "not delivered")
    time.sleep(0.1)  # a beat of before may be on its way
    clerk.done.clear()
    for count in range(3):
        tell(one, Level.ALARM, t_s=20.0 + count)
        if says:
            until(lambda n=count: len(clerk.paths) > n, "a beat")
    time.sleep(0.0 if says else 0.1)
    assert set(clerk.paths) == ({"blocked"} if says else set())
    one.change(NotifySettings(heartbeat_s=0.01), Addresses((), *beats))
    clerk.done.clear()
    tell(one, Level.ALARM, t_s=30.0)
    until(lambda: "well" in clerk.paths, "well again")
    one.close(5.0)


def test_alarms_go_before_housekeeping(place: Path, clerk: Clerk) -> None:
    clerk.refuses = lambda job: True
    one = clerk.notifier(place, ONE)
    one.health_line(health(recording=False))
    until(lambda: clerk.tries, "tried")
    one.health_line(health())
    tell(one, Level.ALARM)
    one.window(window(10), "")
    clerk.refuses = lambda job: False
    until(lambda: len(clerk.titles) == 2, "all have come")
    one.close(5.0)
    assert clerk.titles == ["cleared: story 2", "recorder goes on"]


def test_a_full_outbox_gives_up_housekeeping_first_and_counts_it(tmp_path: Path) -> None:
    box = Outbox(tmp_path / "outbox.jsonl", most=4)
    for k in range(4):
        box.add(Told(), [Notice("alarm", False, f"a{k}", ""), Notice("recorder", False, f"r{k}", "")], ["a"])
    assert box.dropped == 4
    box.save()
    assert delivered_in_order(Outbox(tmp_path / "outbox.jsonl")) == ["a3", "a2", "a1", "a0"]


def test_every_kind_of_notice_has_its_place() -> None:
    made = {node.args[0].value for node in ast.walk(ast.parse(Path(str(notices.__file__)).read_text()))
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Notice"
            and isinstance(node.args[0], ast.Constant)}  # fmt: skip
    assert made == {*notices.URGENT, *notices.HOUSEKEEPING}
    later = Notice("of a later version", False, "", "")
    assert all(Notice(kind, False, "", "").rank < later.rank for kind in made)


def test_what_changes_while_an_address_hangs_is_told_or_counted(place: Path, drip: Drip) -> None:
    one = notifier(place, Addresses((f"json://{drip.address}/x",)))
    for k in range(300):  # more than wait
        tell(one, Level.ALARM, t_s=2.0 * k)
        one.window(window(2.0 * k + 1.0), "")
    assert losses([("Notifier", one)]) == {"Notifier": 600 - 256}
    one.close(0.2)
    assert len(Outbox(place)) == 256


def test_a_disk_that_hangs_holds_up_no_message(place: Path, clerk: Clerk, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = threading.Event()
    monkeypatch.setattr("monitor.service.outlets.outbox.write_atomically", lambda *_: answers.wait(60.0))
    one = clerk.notifier(place, ONE)
    tell(one)
    until(lambda: len(clerk.titles) == 3, "delivered")
    answers.set()
    one.close(5.0)


def test_no_message_leaves_before_its_number_is_stored_so_that_no_other_gets_it_after_a_kill(
    place: Path, clerk: Clerk
) -> None:
    """The disk is waited for, but for half a second at most."""
    now = [0.0]
    settings, to, deliveries = NotifySettings(), Addresses((ONE,)), Deliveries(lambda: clerk)
    with Worker.by_hand(lambda: now[0]) as hand:
        one = Notifier("lab", settings, to, place, lambda: now[0], deliveries)
        tell(one, Level.ADVISORY)
        storing = next(worker for worker in hand.workers if worker.name == "outbox")
        address = next(worker for worker in hand.workers if worker.name == "notify 1")
        while address.step():
            continue
        assert clerk.titles == []  # killed here, the number is that of another message
        storing.step()
        while address.step():
            continue
        assert len(clerk.titles) > 0
        known = len(clerk.titles)
        tell(one, Level.ALARM, t_s=60.0)
        address.step()
        now[0] += 0.6
        address.step()
        assert len(clerk.titles) == known + 1, "a disk that hangs holds up nothing"


def test_no_message_leaves_before_the_copy_of_the_folder_has_its_number(place: Path, clerk: Clerk) -> None:
    """Else a machine that takes over, and does not know of it, gives the number to another message."""
    kept: list[tuple[int, list[str]]] = []

    def keep() -> None:
        kept.append((len(Outbox(place)), clerk.titles))

    with Worker.by_hand(lambda: 0.0) as hand:
        to, deliveries = Addresses((ONE,)), Deliveries(lambda: clerk)
        one = Notifier("lab", NotifySettings(), to, place, lambda: 0.0, deliveries, keep)
        tell(one, Level.ADVISORY)
        for worker in hand.workers[::-1]:
            while worker.step():
                continue
        for worker in hand.workers:
            while worker.step():
                continue
    assert kept[0] == (1, []) and clerk.titles == ["advisory: story 2"]


def test_an_address_and_a_disk_that_do_not_answer_are_told_within_ten_seconds(
    place: Path, clerk: Clerk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the clock that the notifier is given; a delivery itself has 30 s."""
    disk, address, now = threading.Event(), threading.Event(), [100.0]
    monkeypatch.setattr("monitor.service.outlets.outbox.write_atomically", lambda *_: disk.wait(60.0))
    clerk.refuses = lambda job: not address.wait(60.0)
    to, deliveries = Addresses((ONE,)), Deliveries(lambda: clerk)
    one = Notifier("lab", NotifySettings(), to, place, lambda: now[0], deliveries)
    tell(one, Level.ALARM)

    def has_begun() -> bool:
        now[0] += 0.01  # for a while the message waits for the disk
        return clerk.tries > 0

    until(has_begun, "a delivery has begun")
    assert one.failed is None
    now[0] += 6.0
    told = re.fullmatch(r"does not answer for \d s; address 1 \(json\) does not answer for \d s", one.failed or "")
    assert told is not None, one.failed
    disk.set()
    until(lambda: str(one.failed).startswith("address 1 (json) does not answer"), "the disk answers")
    address.set()
    one.close(0.2)


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_an_address_that_sends_on_to_another_place_has_taken_nothing(hook: Hook, status: int) -> None:
    hook.status, hook.location = status, f"http://127.0.0.1:{hook.server_port}/{Hook.ELSEWHERE}"
    host = f"127.0.0.1:{hook.server_port}"
    urls = [f"{kind}://{host}/here{asks}" for kind in ("json", "xml", "form") for asks in ("", "?redirect=yes")]
    trials = send_test(urls, [f"http://{host}/beat"], "lab")
    assert [trial.exit_code for trial in trials] == [1] * 7
    assert set(hook.paths) == {"/beat"}, "nothing went to the other place"
    assert hook.got == []


@pytest.mark.system
def test_the_command_tells_what_became_of_a_test_message_at_every_address(
    tmp_path: Path, hook: Hook, main: Cli, frame_text: str
) -> None:
    site, away = tmp_path / "site.toml", f"json://127.0.0.1:{free_port()}/hush-hush"
    beat = f"http://127.0.0.1:{hook.server_port}/hush"

    def table(*urls: str, beat: str = "") -> None:
        heartbeat = f'heartbeat_url = "{beat}"' if beat else ""
        site.write_text(f'{frame_text}\n[site]\nname = "lab"\n[notify]\nurls = {json.dumps(urls)}\n{heartbeat}\n')

    table(hook.url, away, beat=beat)
    done = main("notify", site, "--test")
    assert done.returncode == 1, done.stderr
    first, second, third, why = done.stdout.splitlines()
    assert re.fullmatch(r"address 1 \(json\): taken after [\d.]+ s \(exit code 0\)", first)
    assert second == "address 2 (json): refused, redirected, or not reached (exit code 1)"
    assert third.startswith("heartbeat: taken after") and hook.paths == ["/hush"]
    assert "apprise -vv" in why
    assert hook.titles == ["[lab] test"] and "hush" not in done.stdout + done.stderr
    table(hook.url)
    told = main("notify", site, "--test", "--json")
    assert told.returncode == 0 and json.loads(told.stdout)["addresses"][0]["exit_code"] == 0
    table()
    assert main("notify", site, "--test").returncode == 78
    assert main("notify", site).returncode == 2
