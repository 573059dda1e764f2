"""Sample blocks over Zenoh: nothing lost that can be kept, everything lost counted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
import zenoh

from drivers.base import EndOfStream
from drivers.zenoh_session import Callbacks, SessionSettings, open_session
from tests.support.brokers import OverZenoh
from tests.support.numbered import PATIENCE_S, T0_NS, N, block, take
from tests.support.waiting import until
from tests.support.zenoh_router import free_port


def test_a_late_reader_gets_what_the_cache_holds(over_zenoh: OverZenoh) -> None:
    publisher = over_zenoh.publisher()
    for i in range(50):
        publisher.send(block(i))
    assert take(over_zenoh.source(), 50) == list(range(50))


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_slow_reader_holds_the_publisher_up_and_loses_nothing(mode: str, over_zenoh: OverZenoh) -> None:
    """More than the inbox, the sockets and the router's queues hold, from another process at full speed."""
    count, n = 1500, 4096
    place, where = over_zenoh.place, {}
    if mode == "peer":
        place = f"tcp/127.0.0.1:{free_port()}"
        where = {"connect": (), "listen": (place,)}
    source = over_zenoh.source(queue_bytes=1 << 18, history_blocks=0, mode=mode, **where)
    sender = _sender(over_zenoh.key, place, count, n, mode)
    numbers: list[int] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(numbers) < count and time.monotonic() < deadline:
        got = source.read(0.2)
        if got is not None:
            numbers.append(got.sequence // n)
            time.sleep(0.0005)
    assert numbers == list(range(count))
    sender.communicate(timeout=PATIENCE_S)
    assert sender.returncode == 0
    assert source.health().counts["lost_samples"] == 0


def test_a_publisher_ends_when_its_reader_has_taken_everything(over_zenoh: OverZenoh) -> None:
    source, publisher = over_zenoh.source(queue_bytes=1 << 12), over_zenoh.publisher()
    for i in range(400):
        publisher.send(block(i))
    ending = threading.Thread(target=publisher.close, args=(PATIENCE_S,))
    ending.start()
    ending.join(0.1)
    assert ending.is_alive()
    assert take(source, 400) == list(range(400))
    ending.join(PATIENCE_S)
    assert not ending.is_alive()


_SENDER = """
import sys, time, zenoh
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher
from tests.support.numbered import block
key, endpoint, count, n, mode, wait = sys.argv[1:]
publisher = ZenohPublisher(PublisherSettings(key=key, mode=mode, connect=(endpoint,)))
while not list(publisher._session.get(key + "/received", timeout=1.0)):
    time.sleep(0.01)  # a peer connects in the background; full speed leaves no time for that
for i in range(int(count)):
    publisher.send(block(i, int(n)))
if wait:
    sys.stdin.readline()
publisher.close(60)
"""


def _sender(key: str, endpoint: str, count: int, n: int, mode: str, wait: str = "") -> subprocess.Popen[str]:
    command = [sys.executable, "-c", _SENDER, key, endpoint, str(count), str(n), mode, wait]
    root = Path(__file__).parents[2]
    return subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_callbacks_have_ended_when_a_session_is_left(endpoint: str) -> None:
    """Zenoh goes on calling back what it holds after an entity is undeclared, which an ending interpreter does not survive."""
    called, callbacks = Counter[str](), Callbacks()

    def slow(_: zenoh.Sample) -> None:
        time.sleep(0.002)
        called["slow"] += 1

    with open_session(SessionSettings(connect=(endpoint,)), Path()) as session:
        subscriber = session.declare_subscriber("a/key", callbacks.of(slow))
        for _ in range(200):
            session.put("a/key", b"")
        until(lambda: called["slow"] > 0, "a call")
        subscriber.undeclare()
    callbacks.join()
    after = called["slow"]
    time.sleep(0.05)
    assert called["slow"] == after == 200


def test_a_killed_publisher_is_noticed_and_its_successor_is_read(over_zenoh: OverZenoh) -> None:
    source = over_zenoh.source()
    first = _sender(over_zenoh.key, over_zenoh.place, 10, N, "client", "wait")
    assert take(source, 10) == list(range(10))
    until(lambda: "alive/sensor" in source.health().detail, "the sensor is alive")
    os.kill(first.pid, signal.SIGKILL)
    first.communicate()
    until(lambda: source.health().counts["sensors_lost"] == 1, "the sensor's death")
    second = over_zenoh.publisher()
    for i in range(10):  # counts from 0 again, ten minutes later
        second.send(block(i, t0_ns=T0_NS + 600 * 10**9))
    assert take(source, 10) == list(range(10))
    assert source.health().counts["restarts"] == 1


def test_what_was_under_way_at_the_end_is_still_read(over_zenoh: OverZenoh) -> None:
    source, publisher = over_zenoh.source(), over_zenoh.publisher()
    for i in (0, 1, 3, 4):  # 2 never comes, so 3 and 4 wait for it
        publisher.send(block(i))
    assert take(source, 2) == [0, 1]
    publisher.close()
    source.close()
    assert take(source, 2) == [3, 4]
    with pytest.raises(EndOfStream):
        source.read(0.0)
    assert source.health().counts["lost_samples"] == N
    assert not source.health().connected


def test_what_a_publisher_sent_before_it_reached_its_reader_is_fetched(over_zenoh: OverZenoh) -> None:
    place = f"tcp/127.0.0.1:{free_port()}"
    publisher = over_zenoh.publisher(mode="peer", connect=(place,))
    for i in range(20):
        publisher.send(block(i))
    assert take(over_zenoh.source(mode="peer", connect=(), listen=(place,)), 20) == list(range(20))


def test_without_a_router_the_source_listens_itself(over_zenoh: OverZenoh) -> None:
    place = f"tcp/127.0.0.1:{free_port()}"
    source = over_zenoh.source(mode="peer", connect=(), listen=(place,))
    publisher = over_zenoh.publisher(mode="peer", connect=(place,))
    for i in range(20):
        publisher.send(block(i))
    assert take(source, 20) == list(range(20))
