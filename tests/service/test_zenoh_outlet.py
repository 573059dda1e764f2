"""What the monitor says over Zenoh, and what it is asked: all of it arrives, none of it holds the monitor up."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from drivers.zenoh_session import SessionSettings, open_session
from monitor.core import WHOLE, Gap, Level
from monitor.damage import Assessment, State, alarm
from monitor.service.outlets.zenoh import ZenohOut, ZenohOutSettings
from monitor.service.requests import MAX_REQUEST_BYTES, Answer, Request, apply
from tests.service.answering import Monitor
from tests.support.results import T0_NS, damage_reading, window
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port

SITE = "shm/tower-1"


@pytest.fixture(scope="module")
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def router(endpoint: str) -> Iterator[Router]:
    process = Router(endpoint)
    yield process
    process.kill()


@pytest.fixture
def out(endpoint: str, router: Router, person: zenoh.Session) -> Iterator[ZenohOut]:
    """The monitor's, once others see it."""
    made = ZenohOut("tower 1", ZenohOutSettings(connect=(endpoint,), max_requests=3))
    until(lambda: ask(person, "state"), "the monitor is there")
    yield made
    made.close()


@pytest.fixture(scope="module")
def person(endpoint: str, router: Router) -> Iterator[zenoh.Session]:
    session = open_session(SessionSettings(connect=(endpoint,)), Path())
    yield session
    session.close()


def ask(session: zenoh.Session, key: str, payload: str | bytes | None = None) -> Any:
    """The answer to a query; None where nobody answers."""
    for reply in session.get(f"{SITE}/{key}", payload=payload, timeout=5.0):
        if reply.ok is not None:
            return json.loads(reply.ok.payload.to_bytes())
    return None


def listen(session: zenoh.Session) -> list[tuple[str, str]]:
    """All that is published for the site from now on: key below the prefix, and text."""
    seen: list[tuple[str, str]] = []
    session.declare_subscriber(
        f"{SITE}/*", lambda s: seen.append((str(s.key_expr).rpartition("/")[2], s.payload.to_string()))
    )
    until(lambda: ask(session, "state"), "the monitor answers, and so has heard of the subscriber")
    return seen


def test_results_as_in_the_file_and_alarms_when_they_change(out: ZenohOut, person: zenoh.Session) -> None:
    seen = listen(person)
    windows = [window(k, Level(level)) for k, level in enumerate(["normal", "normal", "warning", "warning", "normal"])]
    for result, line in windows:
        out.window(result, line)
    out.gap(Gap(T0_NS, 0.125, "128 samples missing"))
    out.health_line({"connected": True, "counts": {"lost_samples": 128}})
    until(lambda: len(seen) == 5 + 3 + 2, "everything")
    assert [text for key, text in seen if key == "results"] == [line for _, line in windows]
    alarms = [json.loads(text) for key, text in seen if key == "alarm"]
    assert [a["level"] for a in alarms] == ["normal", "warning", "normal"]
    assert alarms[1]["active"] == {"2": "warning"}
    assert alarms[1]["conditions"] == {"2": "active, unacknowledged"}
    assert [json.loads(text)["duration_s"] for key, text in seen if key == "gap"] == [0.125]


def test_the_state_is_the_latest_of_everything(out: ZenohOut, person: zenoh.Session) -> None:
    seen, lost = listen(person), Assessment(State.ALARM, "Story 2 lost 12 %.", ("A doubt.",))
    nothing = dict.fromkeys(("results", "alarm", "health", "gap", "finding", "event"))
    state = {"state": "not_judged", "headline": "No window of data yet.", "doubts": []}
    assert ask(person, "state") == state | nothing
    out.state(lost)
    until(lambda: seen, "the state is published")
    assert [(key, json.loads(text)) for key, text in seen] == [("state", lost.content)]
    assert ask(person, "state") == lost.content | nothing
    for k in range(3):
        result, line = window(k, Level.ALARM)
        out.window(result, line)
    state = ask(person, "state")
    assert state["results"] == json.loads(line)
    assert state["alarm"]["level"] == "alarm"


def test_what_was_said_last_arrives_even_if_the_monitor_ends_at_once(out: ZenohOut, person: zenoh.Session) -> None:
    seen = listen(person)
    for k in range(20):
        out.window(*window(k))
    out.close()
    until(lambda: [text for key, text in seen if key == "results"] == [window(k)[1] for k in range(20)], "all of them")


def test_the_monitor_shows_that_it_lives(out: ZenohOut, person: zenoh.Session) -> None:
    def alive() -> list[str]:
        return [str(r.ok.key_expr) for r in person.liveliness().get(f"{SITE}/alive/*", timeout=5.0) if r.ok]

    until(lambda: alive() == [f"{SITE}/alive/monitor"], "the token")
    out.close()
    until(lambda: not alive(), "its end")


def test_requests_reach_the_alarms(out: ZenohOut, person: zenoh.Session) -> None:
    wishes = [
        {"action": "acknowledge", "story": 2, "who": "Ann"},
        {"action": "shelve", "story": 1, "who": "Bob", "note": "crane at work", "seconds": 3600},
    ]
    state = _alarmed()
    with Monitor(out) as monitor:
        for wish in wishes:
            assert ask(person, "ack", json.dumps(wish)) == {"accepted": True, "reason": None}
            assert len(monitor.applied) == 1 + wishes.index(wish), "it is answered after it was applied"
    for request in monitor.applied:
        state = apply(state, request, T0_NS)
    assert state.stories[1].acknowledged_by == "Ann"
    assert not state.stories[1].unacknowledged
    assert state.stories[0].shelved == alarm.Shelving(T0_NS + 3600 * 10**9, "crane at work (Bob)")
    assert out.take_requests() == []


def test_unfit_requests_are_refused_with_the_reason(out: ZenohOut, person: zenoh.Session) -> None:
    good = {"action": "acknowledge", "story": 1, "who": "Ann"}
    for wrong, says in [
        ("no json", "JSON"),
        (json.dumps(good | {"action": "explode"}), "action"),
        (json.dumps(good | {"story": -1}), "story"),
        (json.dumps(good | {"who": ""}), "who"),
        (json.dumps(good | {"more": 1}), "more"),
        (json.dumps(good | {"action": "shelve"}), "shelving needs"),
        (json.dumps(good) + " " * MAX_REQUEST_BYTES, "bytes"),
    ]:
        answer = ask(person, "ack", wrong)
        assert not answer["accepted"]
        assert says in answer["reason"]
    assert not ask(person, "ack")["accepted"]
    answers: list[Any] = []
    for _ in range(3):
        person.get(f"{SITE}/ack", handler=answers.append, payload=json.dumps(good))
    assert ask(person, "ack", json.dumps(good)) == {"accepted": False, "reason": "too many requests wait"}
    assert len(out.take_requests()) == 3 and not answers
    out.answer_requests([Answer(), Answer("the disk is full", again=True), Answer()])
    until(lambda: len(answers) == 3, "each is answered")
    found = [json.loads(reply.ok.payload.to_bytes()) for reply in answers]
    assert [answer["reason"] for answer in found if not answer["accepted"]] == ["the disk is full"]


def test_a_flood_of_requests_is_refused_at_once(out: ZenohOut, person: zenoh.Session) -> None:
    wish = json.dumps({"action": "acknowledge", "story": 2, "who": "Mallory"})
    with Monitor(out) as monitor:
        answers = [ask(person, "ack", wish) for _ in range(200)]
        assert [answer["accepted"] for answer in answers[:12]] == [True] * 10 + [False] * 2
        assert "too many requests of Mallory" in answers[-1]["reason"] and len(monitor.applied) < 20
        assert ask(person, "ack", wish.replace("Mallory", "Ann"))["accepted"]


def test_a_request_before_the_first_data_is_refused(out: ZenohOut, person: zenoh.Session) -> None:
    with Monitor(out, refuse="no data have come yet"):
        answer = ask(person, "ack", json.dumps({"action": "acknowledge", "story": 2, "who": "Ann"}))
    assert answer == {"accepted": False, "reason": "no data have come yet"}


def test_a_request_for_a_story_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ValueError, match="no story 4"):
        apply(_alarmed(), Request(action="acknowledge", story=4, who="Ann"), T0_NS)
    assert apply(_alarmed(), Request(action="acknowledge", story=WHOLE, who="Ann"), T0_NS).stories[1].unacknowledged


def _alarmed() -> alarm.AlarmState:
    """Three stories, the second with an alarm that nobody has seen yet."""
    state, settings = alarm.start(3), alarm.AlarmSettings()
    loss = np.array([0.0, 0.2, 0.0])
    for k in range(3):
        reading = damage_reading(loss, np.diag([1e-6] * 3))
        state, _ = alarm.step(state, reading, T0_NS + k * 10**10, settings)
    assert state.stories[1].unacknowledged
    return state


def test_nothing_waits_for_a_router_that_is_not_there() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    out = ZenohOut("tower 1", ZenohOutSettings(connect=(endpoint,), connect_timeout_s=0.2), queue_size=8)
    try:
        until(lambda: out.failed is not None, "the failure shows")
        for k in range(20):
            out.window(*window(k))
        assert out.dropped == 13  # 20 windows and one alarm, 8 of them kept
        router = Router(endpoint)
        until(lambda: out.failed is None, "it joins when the router has come")
        session = open_session(SessionSettings(connect=(endpoint,)), Path())
        until(lambda: (ask(session, "state") or {}).get("results"), "the state")
        session.close()
        router.kill()
    finally:
        out.close()


def test_results_after_a_router_restart_arrive(out: ZenohOut, router: Router, person: zenoh.Session) -> None:
    seen = listen(person)
    router.kill()
    router.start()
    until(lambda: ask(person, "state"), "the monitor is there again")
    until(lambda: (out.window(*window(1)), time.sleep(0.1), seen)[-1], "results")


_FROZEN = """
import sys, time
from pathlib import Path
from drivers.zenoh_session import SessionSettings, open_session
session = open_session(SessionSettings(connect=(sys.argv[1],)), Path())
subscriber = session.declare_subscriber(sys.argv[2])
print("listening", flush=True)
sys.stdin.readline()
"""


def test_a_frozen_subscriber_holds_nobody_up(endpoint: str, out: ZenohOut, person: zenoh.Session) -> None:
    seen = listen(person)
    command = [sys.executable, "-c", _FROZEN, endpoint, f"{SITE}/*"]
    frozen = subprocess.Popen(
        command, cwd=Path(__file__).parents[2], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert frozen.stdout.readline() == "listening\n"
    os.kill(frozen.pid, signal.SIGSTOP)
    filler = "x" * 100_000
    for k in range(200):  # far more than sockets and queues between here and there hold
        out.health_line({"k": k, "filler": filler})
    # A congested link drops messages by design: one of the flood may be lost, those that come after it may not.

    def passes() -> bool:
        out.health_line({"k": "later"})
        time.sleep(0.1)
        return bool(seen) and json.loads(seen[-1][1])["k"] == "later"

    until(passes, "messages after the flood pass the frozen subscriber by")
    assert out.failed is None
    os.kill(frozen.pid, signal.SIGKILL)
    frozen.communicate()
