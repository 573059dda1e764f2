"""Sample blocks over Zenoh: nothing lost that can be kept, everything lost counted, nothing believed."""

from __future__ import annotations

import os
import random
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers import codec
from drivers.base import ACCELERATION, TEMPERATURE, EndOfStream, SampleBlock, SourceContext, SourceError
from drivers.reorder import Reorder
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher, ZenohSettings, ZenohSource
from drivers.zenoh_session import Callbacks, SessionSettings, open_session
from monitor.config import configuration as config
from tests.support.numbered import CHANNELS, KEY, PATIENCE_S, T0_NS, N, block, take
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def router(endpoint: str) -> Iterator[Router]:
    process = Router(endpoint)
    yield process
    process.kill()


Make = Callable[..., ZenohSource]


@pytest.fixture
def listen(endpoint: str) -> Iterator[Make]:
    """Makes an open source."""
    made: list[ZenohSource] = []

    def make(**options: object) -> ZenohSource:
        chosen = {"key": KEY, "mode": "client", "connect": (endpoint,)} | options
        source = ZenohSource(ZenohSettings.model_validate(chosen), SourceContext(CHANNELS))
        made.append(source)
        source.open()
        return source

    yield make
    for source in made:
        source.close()


@pytest.fixture
def node(endpoint: str) -> Iterator[Callable[..., ZenohPublisher]]:
    made: list[ZenohPublisher] = []

    def make(**options: object) -> ZenohPublisher:
        publisher = ZenohPublisher(PublisherSettings.model_validate({"key": KEY, "connect": (endpoint,)} | options))
        made.append(publisher)
        return publisher

    yield make
    for publisher in made:
        publisher.close(0.1)


@pytest.fixture
def foreign(endpoint: str) -> Iterator[Callable[[bytes], None]]:
    """Puts raw bytes by a plain publisher that is none of ours."""
    session = open_session(SessionSettings(connect=(endpoint,)), Path())
    plain = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)

    def put(data: bytes) -> None:
        """Once somebody listens: what is put before is nobody's."""
        deadline = time.monotonic() + PATIENCE_S
        while not plain.matching_status.matching and time.monotonic() < deadline:
            time.sleep(0.01)
        plain.put(data)

    yield put
    session.close()


@pytest.mark.usefixtures("router")
def test_both_plain_and_advanced_publishers_are_heard_bit_for_bit(
    listen: Make, node: Callable[..., ZenohPublisher], foreign: Callable[[bytes], None]
) -> None:
    source = listen()
    sent = replace(block(0), samples=np.random.default_rng(1).normal(size=(N, 3)).astype(np.float32))
    foreign(codec.encode(sent))
    got = source.read(PATIENCE_S)
    assert got is not None
    assert got.samples.tobytes() == sent.samples.tobytes()
    assert (got.t_ns, got.sequence, got.channels, got.topic) == (sent.t_ns, 0, CHANNELS, ACCELERATION)
    publisher = node()
    for i in range(1, 100):
        publisher.send(block(i))
    assert take(source, 99) == list(range(1, 100))
    assert source.health().counts["samples"] == 100 * N


@pytest.mark.usefixtures("router")
def test_a_late_reader_gets_what_the_cache_holds(listen: Make, node: Callable[..., ZenohPublisher]) -> None:
    publisher = node()
    for i in range(50):
        publisher.send(block(i))
    assert take(listen(), 50) == list(range(50))


@pytest.mark.usefixtures("router")
def test_temperature_comes_by_its_own_key(listen: Make, node: Callable[..., ZenohPublisher]) -> None:
    keys = {"temperature_key": "shm/test-frame/temperature"}
    source, publisher = listen(**keys), node(**keys)
    publisher.send(SampleBlock(TEMPERATURE, T0_NS, 0, 1.0, ("t1",), "degC", np.full((1, 1), 20.0, np.float32)))
    got = source.read(PATIENCE_S)
    assert got is not None
    assert (got.topic, got.unit) == (TEMPERATURE, "degC")


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_slow_reader_holds_the_publisher_up_and_loses_nothing(mode: str, listen: Make, endpoint: str) -> None:
    """More than the inbox, the sockets and the router's queues hold, from another process at full speed."""
    count, n = 1500, 4096
    router = Router(endpoint) if mode == "client" else None
    where = {"connect": (endpoint,)} if mode == "client" else {"connect": (), "listen": (endpoint,)}
    source = listen(queue_bytes=1 << 18, history_blocks=0, mode=mode, **where)
    sender = _sender(endpoint, count, n, mode)
    numbers: list[int] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(numbers) < count and time.monotonic() < deadline:
        got = source.read(0.2)
        if got is not None:
            numbers.append(got.sequence // n)
            time.sleep(0.0005)
        assert source._inbox._n_bytes <= 1 << 18
    assert numbers == list(range(count))
    sender.communicate(timeout=PATIENCE_S)
    assert sender.returncode == 0
    assert source.health().counts["lost_samples"] == 0
    if router is not None:
        router.kill()


@pytest.mark.usefixtures("router")
def test_a_publisher_ends_when_its_reader_has_taken_everything(
    listen: Make, node: Callable[..., ZenohPublisher]
) -> None:
    source, publisher = listen(queue_bytes=1 << 12), node()
    for i in range(400):
        publisher.send(block(i))
    ending = threading.Thread(target=publisher.close, args=(PATIENCE_S,))
    ending.start()
    ending.join(0.3)
    assert ending.is_alive()
    assert take(source, 400) == list(range(400))
    ending.join(PATIENCE_S)
    assert not ending.is_alive()


_SENDER = """
import sys, time
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher
from tests.support.numbered import KEY, block
endpoint, count, n, mode, wait = sys.argv[1:]
publisher = ZenohPublisher(PublisherSettings(key=KEY, mode=mode, connect=(endpoint,)))
while not list(publisher._session.get(KEY + "/received", timeout=1.0)):
    time.sleep(0.01)  # a peer connects in the background; full speed leaves no time for that
for i in range(int(count)):
    publisher.send(block(i, int(n)))
if wait:
    sys.stdin.readline()
publisher.close(60)
"""


def _sender(endpoint: str, count: int, n: int, mode: str, wait: str = "") -> subprocess.Popen[str]:
    command = [sys.executable, "-c", _SENDER, endpoint, str(count), str(n), mode, wait]
    root = Path(__file__).parents[2]
    return subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_a_router_that_dies_and_returns_costs_nothing_that_the_cache_holds(
    router: Router, listen: Make, node: Callable[..., ZenohPublisher]
) -> None:
    source, publisher = listen(), node()
    for i in range(20):
        publisher.send(block(i))
    assert take(source, 20) == list(range(20))
    router.kill()
    until(lambda: not source.health().connected, "the loss of the router is noticed")
    assert "no router" in source.health().detail
    for i in range(20, 120):
        publisher.send(block(i))
    router.start()
    until(lambda: source.health().connected, "the source is back")
    for i in range(120, 140):
        publisher.send(block(i))
    assert take(source, 120) == list(range(20, 140))
    health = source.health()
    assert health.counts["lost_samples"] == 0
    assert health.counts["links_lost"] == 1


@pytest.mark.usefixtures("router")
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


@pytest.mark.usefixtures("router")
def test_a_killed_publisher_is_noticed_and_its_successor_is_read(listen: Make, endpoint: str) -> None:
    source = listen()
    first = _sender(endpoint, 10, N, "client", "wait")
    assert take(source, 10) == list(range(10))
    until(lambda: "alive/sensor" in source.health().detail, "the sensor is alive")
    os.kill(first.pid, signal.SIGKILL)
    first.communicate()
    until(lambda: source.health().counts["sensors_lost"] == 1, "the sensor's death")
    second = ZenohPublisher(PublisherSettings(key=KEY, connect=(endpoint,)))
    for i in range(10):  # counts from 0 again, ten minutes later
        second.send(block(i, t0_ns=T0_NS + 600 * 10**9))
    assert take(source, 10) == list(range(10))
    assert source.health().counts["restarts"] == 1
    second.close()


@pytest.mark.usefixtures("router")
def test_what_was_under_way_at_the_end_is_still_read(listen: Make, node: Callable[..., ZenohPublisher]) -> None:
    source, publisher = listen(), node()
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


@pytest.mark.usefixtures("router")
def test_hostile_payloads_are_counted_and_the_stream_goes_on(listen: Make, foreign: Callable[[bytes], None]) -> None:
    source = listen(max_payload_bytes=4096, max_channels=8)
    good = codec.encode(block(0))
    bad = [
        b"",
        b"\xff" * 100,
        good[:-1],
        good[:2] + b"\xff\xff\xff\xff\x07" + good[3:],
        codec.encode(replace(block(0), sample_rate_hz=1e9)),
        codec.encode(replace(block(0), sequence=2**63)),
        codec.encode(replace(block(0), t_ns=-1)),
        codec.encode(replace(block(0), unit="degC")),
        codec.encode(replace(block(0), channels=("a1", "a1", "a3"))),
        codec.encode(replace(block(0), samples=np.empty((0, 3), np.float32))),
        codec.encode(replace(block(0), channels=tuple("abcdefghi"), samples=np.zeros((4, 9), np.float32))),
    ]
    for payload in bad:
        foreign(payload)
    foreign(codec.encode(block(0, 1000)))
    for i in range(3):
        foreign(codec.encode(block(i)))
    assert take(source, 3) == [0, 1, 2]
    counts = source.health().counts
    assert counts["undecodable"] == len(bad)
    assert counts["oversized"] == 1


@given(st.data())
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_fuzzed_payloads_never_raise(data: st.DataObject) -> None:
    source = ZenohSource(ZenohSettings(key=KEY, connect=("tcp/127.0.0.1:1",)), SourceContext(CHANNELS))
    payload = bytearray(codec.encode(block(data.draw(st.integers(0, 2**40)))))
    for _ in range(data.draw(st.integers(0, 8))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    source._accept(ACCELERATION, bytes(payload[: data.draw(st.integers(0, len(payload)))]))
    for got in source._ready:
        assert got.n_samples > 0
        assert 0 < got.sample_rate_hz <= 100e3
    assert len(source._ready) + source.health().counts["undecodable"] == 1


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"key": "shm/**"}, "key"),
        ({"key": "shm/x/@alive"}, "key"),
        ({"connect": ()}, "client needs"),
        ({"mode": "peer", "connect": ()}, "nothing could ever arrive"),
        ({"connect": ("tls/gateway:7447",)}, "tls"),
        ({"connect": ("gateway:7447",)}, "connect"),
        ({"multicast": True}, "multicast"),
    ],
)
def test_bad_settings_are_refused(wrong: dict[str, object], says: str) -> None:
    good = {"kind": "zenoh", "key": KEY, "mode": "client", "connect": ["tcp/127.0.0.1:7447"]}
    ZenohSettings.model_validate(good)
    with pytest.raises(ValidationError, match=says):
        ZenohSettings.model_validate(good | wrong)


def test_the_example_site_file_is_sound() -> None:
    configuration = config.load(Path(__file__).parents[2] / "deploy" / "zenoh.toml")
    assert configuration.channels == CHANNELS


def test_no_router_is_an_error_that_names_it_and_may_be_tried_again(listen: Make, endpoint: str) -> None:
    with pytest.raises(SourceError, match=endpoint):
        listen(connect_timeout_s=0.2)
    router = Router(endpoint)
    assert listen().health().connected
    router.kill()


def test_without_a_router_the_source_listens_itself(endpoint: str) -> None:
    source = ZenohSource(ZenohSettings(key=KEY, mode="peer", listen=(endpoint,)), SourceContext(CHANNELS))
    source.open()
    publisher = ZenohPublisher(PublisherSettings(key=KEY, mode="peer", connect=(endpoint,)))
    for i in range(20):
        publisher.send(block(i))
    assert take(source, 20) == list(range(20))
    publisher.close()
    source.close()


def _through(blocks: list[SampleBlock], hold: int = 4) -> tuple[list[int], Counter[str]]:
    counts: Counter[str] = Counter()
    order = Reorder(counts, hold)
    out = [b for given in blocks for b in order.push(given)] + order.flush()
    return [b.sequence // N for b in out], counts


def test_one_per_cent_dropped_repeated_reordered() -> None:
    draw = random.Random(7)
    blocks, dropped, repeated, swapped = [], [], 0, 0
    for i in range(10_000):
        luck = draw.random()
        if luck < 0.01:
            dropped.append(i)
            continue
        blocks.append(block(i))
        if luck < 0.02:
            blocks.append(block(i))
            repeated += 1
        elif luck < 0.03 and len(blocks) > 1 and blocks[-2].sequence == (i - 1) * N:
            blocks[-2:] = reversed(blocks[-2:])
            swapped += 1
    numbers, counts = _through(blocks)
    assert numbers == [i for i in range(10_000) if i not in set(dropped)]
    assert counts["lost_samples"] == N * len(dropped)
    assert counts["repeated"] == repeated
    assert counts["reordered"] >= swapped - len(dropped)
    assert counts["late"] == counts["restarts"] == 0


def test_a_lying_sequence_neither_stops_the_stream_nor_the_count() -> None:
    lies = [replace(block(5), sequence=2**60 + 1000 * i) for i in range(6)]
    numbers, counts = _through([*[block(i) for i in range(5)], *lies, *[block(i) for i in range(5, 40)]])
    assert numbers[:5] == [0, 1, 2, 3, 4]
    assert numbers[-30:] == list(range(10, 40))
    assert counts["lost_samples"] == 0  # no time passed


def test_one_block_from_the_past_is_thrown_away() -> None:
    numbers, counts = _through(
        [*[block(i) for i in range(300)], replace(block(0), samples=block(0).samples + 1), block(300)]
    )
    assert numbers == list(range(301))
    assert counts["late"] == 1


def test_a_recording_sent_again_is_a_restart() -> None:
    again = [block(i, t0_ns=T0_NS + 10**12) for i in range(300)]
    numbers, counts = _through([*[block(i) for i in range(300)], *again])
    assert numbers == [*range(300), *range(300)]
    assert counts["restarts"] == 1


@pytest.mark.parametrize("rate", [float("nan"), float("inf"), -float("inf"), 0.0, -5.0, 1e-320, 1e300])
def test_an_absurd_rate_is_refused(rate: float) -> None:
    source = ZenohSource(ZenohSettings(key="shm/a/b", connect=("tcp/127.0.0.1:1",)), SourceContext(("a1",)))
    good = SampleBlock("/acceleration", 0, 0, 100.0, ("a1",), "m/s^2", np.zeros((1, 1), np.float32))
    source._accept("/acceleration", codec.encode(good).replace(struct.pack("<d", 100.0), struct.pack("<d", rate)))
    assert not source._ready and source.health().counts["undecodable"] == 1
