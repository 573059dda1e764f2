"""People are told: what changed, once, in order, whatever fails on the way; and never an address in a log."""

from __future__ import annotations

import ast
import json
import logging
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monitor.core import Alarm, AlarmCondition, Level, Skipped, WindowResult
from monitor.damage import Assessment, State
from monitor.service.daemon_health import losses
from monitor.service.outlets import delivery_workers, notices
from monitor.service.outlets.notices import Notice, NoticeSettings, Told, of_finding, of_health, of_window
from monitor.service.outlets.notify import Addresses, Notifier, NotifySettings, addresses
from monitor.service.outlets.outbox import Outbox
from tests.support.hooks import Drip, Hook
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
    source = {"connected": data, "error": "" if data else "bus off", "detail": ""}
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
    assert said == [Notice("doubtful", False, "doubtful", "Goodness of fit 31.\nA doubt.")]
    back = [(window(100), WELL), (window(110), DOUBTFUL), *((window(t), WELL) for t in (120, 130, 140, 150))]
    assert [n.title for n in told_of(back, told)[1]] == ["no longer doubtful: normal"]


def test_an_alarm_speaks_for_the_doubts_beside_it() -> None:
    lost = Assessment(State.WARNING, "Story 2 lost 5 %.", ("Goodness of fit 31.",))
    told, said = told_of([(window(10.0 * k, s2=Level.WARNING), lost) for k in range(9)])
    assert said == [Notice("alarm", False, "warning: story 2", "Story 2 lost 5 %.\nGoodness of fit 31.")]
    assert [n.title for n in told_of([(window(90), WELL)], told)[1]] == ["cleared: story 2"]


def test_that_nothing_would_have_been_seen_is_told_as_long_as_that_nothing_was_judged() -> None:
    young = [(window(10.0 * k), UNSEEN) for k in range(300)]
    assert told_of([*young, (window(3000), WELL)])[1] == []
    course = [(window(10.0 * k), UNSEEN) for k in range(500)] + [(window(5000), WELL)]
    assert told_of(course)[1] == [
        Notice("blind", False, "not judged", UNSEEN.headline),
        Notice("blind", True, "judged again", WELL.headline),
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


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delivery_workers, "_RESEND_S", (0.05, 0.2))


def notifier(place: Path, *urls: str, **settings: Any) -> Notifier:
    place.parent.mkdir(exist_ok=True)
    return Notifier("lab", NotifySettings(**settings), Addresses(urls), place)


def test_messages_arrive_once_in_order_after_failures(tmp_path: Path, hook: Hook) -> None:
    hook.status = 503
    one = notifier(tmp_path / "outbox.jsonl", hook.url)
    one.window(window(0, s2=Level.ADVISORY), "")
    until(lambda: hook.tries >= 3, "tried again")
    assert one.failed
    one.window(window(10, s2=Level.WARNING), "")
    one.window(window(20), "")
    hook.status = 200
    wanted = ["[lab] advisory: story 2", "[lab] warning: story 2", "[lab] cleared: story 2"]
    until(lambda: len(hook.got) >= 3, "all have come")
    one.close(5.0)
    assert hook.titles == wanted
    assert [item["type"] for item in hook.got] == ["warning", "warning", "success"]
    assert one.failed is None


def test_a_message_that_is_always_refused_does_not_hold_up_those_behind_it(
    tmp_path: Path, hook: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery_workers, "_SET_ASIDE", 3)
    hook.refuses = "advisory"
    one = notifier(tmp_path / "outbox.jsonl", hook.url)
    for level in (Level.ADVISORY, Level.WARNING, Level.ALARM):
        one.window(window(0, s2=level), "")
    until(lambda: len(hook.got) == 2, "those behind it")
    assert hook.titles == ["[lab] warning: story 2", "[lab] alarm: story 2"]
    until(lambda: one.failed, "the refused one is told")
    hook.refuses = None
    until(lambda: len(hook.got) == 3, "the refused one, tried without end")
    one.close(5.0)
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 0


def test_a_restart_neither_loses_nor_doubles(tmp_path: Path, hook: Hook) -> None:
    place = tmp_path / "outbox.jsonl"
    hook.status = 503
    one = notifier(place, hook.url)
    one.window(window(0, s2=Level.WARNING), "")
    until(lambda: hook.tries, "tried")
    one.close(5.0)
    hook.status = 200
    again = notifier(place, hook.url)
    again.window(window(10, s2=Level.WARNING), "")  # stands as before: not told again
    until(lambda: hook.got, "delivered")
    again.close(5.0)
    last = notifier(place, hook.url)
    last.window(window(20), "")
    until(lambda: len(hook.got) == 2, "its end")
    last.close(5.0)
    assert hook.titles == ["[lab] warning: story 2", "[lab] cleared: story 2"]


def test_one_that_is_out_holds_up_no_other(tmp_path: Path, hook: Hook) -> None:
    one = notifier(tmp_path / "outbox.jsonl", "json://127.0.0.1:9/away", hook.url)
    for level in (Level.ADVISORY, Level.WARNING, Level.ALARM):
        one.window(window(0, s2=level), "")
    until(lambda: len(hook.got) == 3, "the other has all")
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 3
    one.change(NotifySettings(), Addresses((hook.url,)))
    until(lambda: one.failed is None, "forgotten")
    one.window(window(10), "")
    until(lambda: len(hook.got) == 4, "goes on")
    one.close(5.0)
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 0


def test_no_more_than_asked_for_in_an_hour(tmp_path: Path, hook: Hook) -> None:
    one = notifier(tmp_path / "outbox.jsonl", hook.url, most_per_hour=2)
    for t in range(5):
        one.window(window(t, s2=Level.WARNING) if t % 2 == 0 else window(t), "")
    until(lambda: len(hook.got) == 2, "two came")
    one.close(5.0)
    assert len(hook.got) == 2
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 3


def test_mail(tmp_path: Path) -> None:
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
        one = notifier(tmp_path / "outbox.jsonl", f"mailto://127.0.0.1:{port}?from=shm@lab.test&to=ann@lab.test")
        one.window(window(0, s2=Level.ALARM), "")
        until(lambda: letters, "a letter")
        one.close(5.0)
    finally:
        box.stop()
    assert letters[0].rcpt_tos == ["ann@lab.test"]
    assert b"alarm: story 2" in letters[0].content


def test_a_heartbeat_carries_the_head_of_the_ledger() -> None:
    assert delivery_workers._with_head("http://a.test/beat", None) == "http://a.test/beat"
    assert delivery_workers._with_head("http://a.test/beat", "ab12") == "http://a.test/beat?ledger=ab12"
    assert (
        delivery_workers._with_head("http://a.test/b?status=up#x", "ab12") == "http://a.test/b?status=up&ledger=ab12#x"
    )


def test_the_heart_beats_while_windows_come_and_no_longer(tmp_path: Path, hook: Hook) -> None:
    beat = Addresses((), f"http://127.0.0.1:{hook.server_port}/beat")
    one = Notifier("lab", NotifySettings(heartbeat_s=0.05), beat, tmp_path / "outbox.jsonl")
    one.health_line(health())
    time.sleep(0.2)
    assert hook.beats == 0
    for count in range(1, 4):
        one.window(window(10.0 * count), "")
        until(lambda n=count: hook.beats >= n, "a beat")
        time.sleep(0.1)
    beats = hook.beats
    for _ in range(5):
        one.health_line(health(data=False))
        time.sleep(0.05)
    one.close(5.0)
    assert hook.beats == beats


def test_no_address_is_ever_written(
    tmp_path: Path, hook: Hook, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("HUSH", "hush-hush")
    settings = NotifySettings(urls=("json://127.0.0.1:9/${HUSH}",), heartbeat_url="http://127.0.0.1:9/${HUSH}")
    to = addresses(settings, tmp_path)
    assert to.urls == ("json://127.0.0.1:9/hush-hush",)
    hook.status = 500
    one = Notifier("lab", settings, replace(to, urls=(*to.urls, hook.url)), tmp_path / "outbox.jsonl")
    one.window(window(0, s2=Level.ALARM), "")
    until(lambda: hook.tries, "tried")
    until(lambda: one.failed, "failed")
    one.close(5.0)
    logging.getLogger("urllib3").setLevel(logging.NOTSET)
    written = "".join(r.getMessage() for r in caplog.records if r.name.startswith(("monitor", "apprise")))
    kept = (tmp_path / "outbox.jsonl").read_text()
    assert "alarm: story 2" in written and "not heard" in written
    for text in (written, kept, str(one.failed), repr(to), repr(one)):
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
    notifier = Notifier("bench", NotifySettings(), Addresses(), place)
    assert notifier.dropped == 0
    notifier._outbox = box
    assert losses([("Notifier", notifier)]) == {"Notifier": 15}
    assert len([r for r in caplog.records if "given up" in r.getMessage()]) == 15
    box.save()
    again = Outbox(place, most=10)
    assert again.told.levels == {24: Level.WARNING}
    first = again.first("a")
    assert first is not None and first.notice.title == "15" and first.id == 16
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


@pytest.mark.parametrize("wrong", [[1], "text", {"a": {}}, 1 << 80])
def test_times_that_somebody_wrote_into_the_outbox_end_no_window(tmp_path: Path, wrong: object) -> None:
    """They are not stored, so that none is read."""
    place = tmp_path / "outbox.jsonl"
    one = notifier(place)
    one.window(window(0, s2=Level.WARNING), "")
    one.close(5.0)
    head, *rows = place.read_text().splitlines()
    content = json.loads(head)
    content["told"] |= {"judged_ns": wrong, "doubt_ns": wrong}
    place.write_text("\n".join([json.dumps(content), *rows]) + "\n")
    again = notifier(place)
    again.window(window(10, s2=Level.WARNING), "")
    assert again.failed is None and again._begun().told.levels == {2: Level.WARNING}
    again.close(5.0)


@pytest.fixture
def drip() -> Iterator[Drip]:
    server = Drip()
    yield server
    server.close()


def test_an_address_that_drips_holds_up_no_other_and_is_told_of(
    tmp_path: Path, hook: Hook, drip: Drip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery_workers, "_DEADLINE_S", 5.0)  # its process imports a library: a second of a core
    one = notifier(tmp_path / "outbox.jsonl", f"json://{drip.address}/hush-hush", hook.url)
    for level in (Level.ADVISORY, Level.WARNING, Level.ALARM):
        one.window(window(0, s2=level), "")
    until(lambda: len(hook.got) == 3, "the other has all")
    until(lambda: drip.calls >= 2, "the attempt ended, and there is another")
    assert re.fullmatch(r"delivery to address 1 \(json\) has taken \d+ s", str(one.failed))
    begun = time.monotonic()
    one.close(1.0)
    assert time.monotonic() - begun < 5.0
    until(lambda: not any(t.name.startswith("notify") for t in threading.enumerate()), "its worker ends")
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 3 and one.dropped == 0


def test_a_heartbeat_that_drips_holds_up_no_message(
    tmp_path: Path, hook: Hook, drip: Drip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery_workers, "_DEADLINE_S", 5.0)
    to = Addresses((hook.url,), f"http://{drip.address}/hush-hush")
    one = Notifier("lab", NotifySettings(heartbeat_s=0.05), to, tmp_path / "outbox.jsonl")
    one.window(window(0), "")
    until(lambda: drip.calls, "a beat")
    one.window(window(10, s2=Level.ALARM), "")
    until(lambda: hook.got, "delivered")
    until(lambda: one.failed, "told")
    assert re.fullmatch(r"heartbeat not heard for \d+ s", str(one.failed))
    one.close(1.0)


@pytest.mark.parametrize("says", [True, False])
def test_the_heartbeat_says_whether_messages_get_out(tmp_path: Path, hook: Hook, says: bool) -> None:
    beat = f"http://127.0.0.1:{hook.server_port}/"
    blocked = f"{beat}blocked" if says else None
    to = Addresses(("json://127.0.0.1:9/away",), f"{beat}well", blocked)
    one = Notifier("lab", NotifySettings(heartbeat_s=0.05), to, tmp_path / "outbox.jsonl")
    one.window(window(0), "")
    until(lambda: "/well" in hook.paths, "all is well")
    one.window(window(10, s2=Level.ALARM), "")
    until(lambda: one.failed, "not delivered")
    time.sleep(0.5)  # a beat of before may be on its way
    hook.paths.clear()
    for count in range(3):
        one.window(window(20.0 + count, s2=Level.ALARM), "")
        if says:
            until(lambda n=count: len(hook.paths) > n, "a beat")
    time.sleep(0.0 if says else 0.5)
    assert set(hook.paths) == ({"/blocked"} if says else set())
    one.change(NotifySettings(heartbeat_s=0.05), Addresses((), f"{beat}well", blocked))
    hook.paths.clear()
    one.window(window(30, s2=Level.ALARM), "")
    until(lambda: "/well" in hook.paths, "well again")
    one.close(5.0)


def test_alarms_go_before_housekeeping(tmp_path: Path, hook: Hook) -> None:
    hook.status = 503
    one = notifier(tmp_path / "outbox.jsonl", hook.url)
    one.health_line(health(recording=False))
    until(lambda: hook.tries, "tried")
    one.health_line(health())
    one.window(window(0, s2=Level.ALARM), "")
    one.window(window(10), "")
    hook.status = 200
    until(lambda: len(hook.got) == 4, "all have come")
    one.close(5.0)
    wanted = ["alarm: story 2", "cleared: story 2", "recorder stopped", "recorder goes on"]
    assert hook.titles == [f"[lab] {title}" for title in wanted]


def test_housekeeping_leaves_half_of_the_hour_s_messages_to_alarms(tmp_path: Path, hook: Hook) -> None:
    one = notifier(tmp_path / "outbox.jsonl", hook.url, most_per_hour=4)
    for k in range(6):
        one.health_line(health(recording=k % 2 == 1))
    until(lambda: len(hook.got) == 2, "half")
    for level in (Level.ADVISORY, Level.WARNING, Level.ALARM):
        one.window(window(0, s2=level), "")
    until(lambda: len(hook.got) == 4, "the other half")
    one.close(5.0)
    assert hook.titles[2:] == ["[lab] advisory: story 2", "[lab] warning: story 2"]
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 5


def test_a_full_outbox_gives_up_housekeeping_first_and_counts_it(tmp_path: Path) -> None:
    box = Outbox(tmp_path / "outbox.jsonl", most=4)
    for k in range(4):
        box.add(Told(), [Notice("alarm", False, f"a{k}", ""), Notice("recorder", False, f"r{k}", "")], ["a"])
    assert box.dropped == 4
    box.save()
    again, titles = Outbox(tmp_path / "outbox.jsonl"), []
    while (message := again.first("a")) is not None:
        titles.append(message.notice.title)
        again.delivered(message, "a")
    assert titles == ["a0", "a1", "a2", "a3"]


def test_every_kind_of_notice_has_its_place(tmp_path: Path) -> None:
    made = {node.args[0].value for node in ast.walk(ast.parse(Path(str(notices.__file__)).read_text()))
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Notice"
            and isinstance(node.args[0], ast.Constant)}  # fmt: skip
    assert made == {*notices.URGENT, *notices.HOUSEKEEPING}
    later = Notice("of a later version", False, "", "")
    assert all(Notice(kind, False, "", "").rank < later.rank for kind in made)


def test_what_changes_while_an_address_hangs_is_told_or_counted(
    tmp_path: Path, drip: Drip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery_workers, "_DEADLINE_S", 60.0)
    one = notifier(tmp_path / "outbox.jsonl", f"json://{drip.address}/x")
    for k in range(300):  # more than wait
        one.window(window(2.0 * k, s2=Level.ALARM), "")
        one.window(window(2.0 * k + 1.0), "")
    assert one.dropped == 600 - 256
    one.close(0.2)
    assert len(Outbox(tmp_path / "outbox.jsonl")) == 256


def test_a_disk_that_hangs_holds_up_no_message(tmp_path: Path, hook: Hook, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = threading.Event()
    monkeypatch.setattr("monitor.service.outlets.outbox.write_atomically", lambda *_: answers.wait(60.0))
    one = notifier(tmp_path / "outbox.jsonl", hook.url)
    for level in (Level.ADVISORY, Level.WARNING, Level.ALARM):
        one.window(window(0, s2=level), "")
    until(lambda: len(hook.got) == 3, "delivered")
    answers.set()
    one.close(5.0)


def test_an_address_and_a_disk_that_do_not_answer_are_told_within_ten_seconds(
    tmp_path: Path, drip: Drip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the clock that the notifier is given; a delivery itself has 30 s."""
    answers, now = threading.Event(), [100.0]
    monkeypatch.setattr("monitor.service.outlets.outbox.write_atomically", lambda *_: answers.wait(60.0))
    to = Addresses((f"json://{drip.address}/x",))
    one = Notifier("lab", NotifySettings(), to, tmp_path / "outbox.jsonl", lambda: now[0])
    one.window(window(0, s2=Level.ALARM), "")
    until(lambda: drip.calls, "a delivery has begun")
    assert one.failed is None
    now[0] += 6.0
    assert one.failed == "does not answer for 6 s; address 1 (json) does not answer for 6 s"
    answers.set()
    until(lambda: one.failed == "address 1 (json) does not answer for 6 s", "the disk answers")
    one.close(0.2)


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
    assert second == "address 2 (json): refused, or not reached (exit code 1)"
    assert third.startswith("heartbeat: taken after") and hook.paths == ["/hush"]
    assert "apprise -vv" in why
    assert hook.titles == ["[lab] test"] and "hush" not in done.stdout + done.stderr
    table(hook.url)
    told = main("notify", site, "--test", "--json")
    assert told.returncode == 0 and json.loads(told.stdout)["addresses"][0]["exit_code"] == 0
    table()
    assert main("notify", site, "--test").returncode == 78
    assert main("notify", site).returncode == 2
