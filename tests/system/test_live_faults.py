"""Faults against a running daemon: it stays up, counts what is lost, identifies no window with a hole, ends when told."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
import zenoh

from drivers import codec
from drivers.base import EndOfStream, SampleBlock, SourceHealth
from drivers.can_bus import CanSource
from drivers.mcap_file import read_recordings
from drivers.socketcand_server import SocketcandServer, frame_text
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher
from drivers.zenoh_session import SessionSettings, leave, open_session
from tests.support.can_group import accel, datagram
from tests.support.live_rig import (
    KEY,
    RATE_HZ,
    T0_NS,
    Command,
    Site,
    blocks,
    make_site,
    quantised,
    router_for,
    write,
)  # fmt: skip
from tests.support.site import Daemon, judged_lines
from tests.support.waiting import until
from tests.support.zenoh_router import Router

pytestmark = pytest.mark.system

WINDOW_S, HOP_S = 20.0, 5.0
PROCESSING = {"window_s": WINDOW_S, "hop_s": HOP_S}
QUICK = {"watch": {"diagnose": False}, "recorder": {"flush_s": 1.0}}
S = 10**9


@pytest.fixture(scope="module")
def stream() -> list[SampleBlock]:
    """A minute, as CAN can carry it, in the blocks of a node."""
    return quantised(blocks(60.0, 5, size=128))


@contextmanager
def daemon_at(site: Site) -> Iterator[Command]:
    with site.run() as running:
        running.wait_for("READY")
        yield running


def end_s(line: dict[str, Any]) -> float:
    return float((line["t_end_ns"] - T0_NS) / S)


def demand_holes_skipped(lines: list[dict[str, Any]], holes: Sequence[tuple[float, float]]) -> None:
    """No window with a hole in it is identified, every other one is."""
    assert lines
    for line in lines:
        begin, end = end_s(line) - WINDOW_S, end_s(line)
        broken = any(first < end and last > begin for first, last in holes)
        assert (line["skipped"] == "gap in the data") == broken, (begin, end, line["skipped"])
        assert (line["ddi"] is None) == broken


@contextmanager
def flood_of(send: Callable[[], object]) -> Iterator[None]:
    """Send without a pause while the context lasts."""
    over = threading.Event()
    flooding = threading.Thread(target=lambda: [send() for _ in iter(over.is_set, True)], daemon=True)
    flooding.start()
    yield
    over.set()
    flooding.join()


def demand_whole_end(site: Site, daemon: Command, amid: AbstractContextManager[None] | None = None) -> None:
    """SIGTERM, amid a flood too: exit 0, whole recordings that give the same results again."""
    with amid or nullcontext():
        code, took_s = daemon.stop()
    assert code == 0, daemon.said
    assert took_s < 10.0  # 5 s on a machine with nothing else to do
    assert "Traceback" not in daemon.said
    assert not list(site.out.rglob("*.part"))
    assert judged_lines(site.path, list(read_recordings(site.recordings))) == site.results


def can_messages(stream: Sequence[SampleBlock]) -> list[can.Message]:
    values = np.concatenate([block.samples for block in stream]).astype(float)
    return accel(np.arange(len(values)), values)


@contextmanager
def can_server(site: Site) -> Iterator[SocketcandServer]:
    server = SocketcandServer("127.0.0.1", site.port)
    try:
        yield server
    finally:
        server.close()


def test_can_frames_lost_repeated_swapped_and_a_flood_of_foreign_ones(
    tmp_path: Path, stream: list[SampleBlock]
) -> None:
    site, rng = make_site(tmp_path, "can", PROCESSING, **QUICK), random.Random(1)
    texts = [frame_text(m.arbitration_id, m.is_extended_id, m.timestamp, m.data) for m in can_messages(stream)]
    foreign = b"".join(frame_text(0x200 + k, False, T0_NS / S, bytes(8)) for k in range(20))
    lost = {k for k in range(round(25 * RATE_HZ), round(30 * RATE_HZ)) if rng.random() < 0.01}
    flooded = ((10, 15), (40, 45))  # in the first windows, and where memory is counted
    wire = [
        (texts[k], foreign if any(low <= k / RATE_HZ < high for low, high in flooded) else b"")
        for k in range(len(texts))
        if k not in lost
    ]
    for k in range(1, len(wire) - 20):
        if rng.random() < 0.01:
            wire.insert(k + rng.randrange(1, 10), wire[k])
        elif rng.random() < 0.01:
            other = k + rng.randrange(1, 10)
            wire[k], wire[other] = wire[other], wire[k]
    flood = sum(bool(more) for _, more in wire) * 20
    with can_server(site) as server, daemon_at(site) as daemon:
        assert server.wait_for_client(30.0)
        before = np.inf
        for start in range(0, len(wire), 64):
            if before == np.inf and start > 35 * RATE_HZ:
                # By when compiled code is loaded, which alone takes nearly 100 MB.
                until(lambda: bool(site.results), "a window")
                before = daemon.rss_mb
            server.send(b"".join(text + more for text, more in wire[start : start + 64]))
        until(lambda: len(site.results) == 9, "all windows")
        assert daemon.rss_mb - before < 50.0
        demand_whole_end(site, daemon, flood_of(lambda: server.send(foreign)))
    holes = sorted((k / RATE_HZ, (k + 1) / RATE_HZ) for k in lost)
    demand_holes_skipped(site.results, holes)
    assert site.results[:2] == judged_lines(site.path, stream)[:2]
    counts = site.health["source"]["counts"]
    assert counts["foreign"] >= flood and counts["repeated"] > 300
    assert counts["lost_samples"] == len(lost)
    assert site.summary["gaps"] == len([k for k in lost if k - 1 not in lost])


class Wire:
    """A source on udp_multicast that sends itself its datagrams, each good one after a malformed one, before it reads."""

    def __init__(self, reader: CanSource, send: Callable[[bytes], object], frames: Sequence[bytes]) -> None:
        self._reader, self._send, self._frames = reader, send, list(frames)
        self.opened = self.malformed = 0

    def open(self) -> None:
        self.opened += 1

    def read(self, timeout_s: float) -> SampleBlock | None:
        if not self._frames:
            block = self._reader.read(timeout_s)
            if block is None:
                raise EndOfStream
            return block
        for frame in self._frames[:20]:  # few enough for the socket's buffer
            self._send(b"x" if self.malformed % 2 else frame[:-1])
            self._send(frame)
            self.malformed += 1
        del self._frames[:20]
        return self._reader.read(0.0)

    def health(self) -> SourceHealth:
        return self._reader.health()

    def close(self) -> None:
        pass


def test_malformed_datagrams_beside_every_frame_cost_no_window(
    tmp_path: Path, stream: list[SampleBlock], group: tuple[CanSource, Callable[[bytes], object]]
) -> None:
    site, (reader, send) = make_site(tmp_path, "can", PROCESSING, **QUICK), group
    messages = can_messages(stream)[: round(31 * RATE_HZ)]
    wire = Wire(reader, send, [datagram(message) for message in messages])
    Daemon(site.path, wire).run()
    assert [line["skipped"] for line in site.results] == [None] * 3
    assert site.summary["gaps"] == 0 and site.summary["quality"]["lost_s"] == 0.0
    source = site.health["source"]
    assert wire.opened == 1 and source["lost"] == 0
    assert source["counts"]["undecodable"] == wire.malformed == len(messages)


@pytest.fixture
def zenoh_site(tmp_path: Path) -> Iterator[tuple[Site, Router]]:
    site = make_site(tmp_path, "zenoh", PROCESSING, **QUICK)
    with router_for(site) as router:
        assert router is not None
        yield site, router


@contextmanager
def node_of(site: Site) -> Iterator[ZenohPublisher]:
    publisher = ZenohPublisher(PublisherSettings(key=KEY, connect=(f"tcp/127.0.0.1:{site.port}",)))
    try:
        yield publisher
    finally:
        publisher.close()


@contextmanager
def plain_put(site: Site) -> Iterator[Callable[[bytes], None]]:
    """A publisher of raw bytes."""
    session = open_session(SessionSettings(connect=(f"tcp/127.0.0.1:{site.port}",)), Path())
    yield session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK).put
    leave(session)


def hostile(good: SampleBlock, rng: random.Random) -> list[bytes]:
    """Payloads that are none, contradict themselves or are beyond every limit."""
    whole = codec.encode(good)
    wide = replace(good, channels=tuple(f"c{k}" for k in range(20_000)), samples=np.zeros((1, 20_000), np.float32))
    forged = [
        wide,
        replace(good, sample_rate_hz=1e300),
        replace(good, sample_rate_hz=1e9),
        replace(good, unit="degC"),
        replace(good, channels=("a1", "a1", "a1")),
        replace(good, samples=good.samples[:0]),
        replace(good, sequence=(1 << 64) - 1),
        replace(good, t_ns=1 << 62),
        replace(good, t_ns=-(1 << 60)),
    ]
    texts = [codec.encode(block) for block in forged]
    texts += [rng.randbytes(rng.randrange(1, 3000)) for _ in range(50)]
    texts += [whole[: rng.randrange(8, len(whole) - 1)] for _ in range(50)]
    texts += [whole + b"\x32\xff\xff\xff\xff\x0f", b"\x32\xff\xff\xff\xff\xff\xff\xff\xff\x7f" + whole, b""]
    return texts


def test_zenoh_blocks_lost_repeated_swapped_among_hostile_payloads(
    zenoh_site: tuple[Site, Router], stream: list[SampleBlock]
) -> None:
    (site, _), rng = zenoh_site, random.Random(2)
    lost = {205, 222, 238}  # 25.6 to 29.9 s
    wire = [block for k, block in enumerate(stream) if k not in lost]
    for k in range(1, len(wire) - 10):
        if rng.random() < 0.01:
            wire.insert(k + rng.randrange(1, 4), wire[k])
        elif rng.random() < 0.01:
            wire[k], wire[k + 2] = wire[k + 2], wire[k]
    payloads = hostile(stream[50], rng)
    with daemon_at(site) as daemon, plain_put(site) as put:
        before = np.inf
        for k, block in enumerate(wire):
            if k == len(wire) // 2:  # by when compiled code is loaded, which alone takes nearly 100 MB
                until(lambda: bool(site.results), "a window")
                before = daemon.rss_mb
            put(codec.encode(block))
            put(payloads[k % len(payloads)])
            if k % 10 == 0:
                put(bytes(2 << 20))
        until(lambda: len(site.results) == 9, "all windows")
        assert daemon.rss_mb - before < 50.0
        demand_whole_end(site, daemon, flood_of(lambda: put(b"\xff" * 1000)))
    demand_holes_skipped(site.results, [(k / 8, (k + 1) / 8) for k in sorted(lost)])
    assert site.results[:2] == judged_lines(site.path, stream)[:2]
    counts = site.health["source"]["counts"]
    assert counts["lost_samples"] == 3 * 128 and counts["gaps"] == site.summary["gaps"] == 3
    assert counts["undecodable"] >= len(wire) and counts["oversized"] == -(-len(wire) // 10)
    assert counts["repeated"] > 0 and counts["reordered"] > 0


def test_a_router_and_a_publisher_that_die(zenoh_site: tuple[Site, Router]) -> None:
    site, router = zenoh_site
    stream = blocks(90.0, 6, size=128)
    with daemon_at(site) as daemon:
        with node_of(site) as publisher:
            for block in stream[:160]:
                publisher.send(block)
            router.kill()
            for block in stream[160:240]:
                publisher.send(block)
            router.start()
            daemon.until(lambda: _rejoined(site), "both ends join again")
            for block in stream[240:320]:
                publisher.send(block)
            until(lambda: len(site.results) == 5, "windows up to 40 s")
        assert (
            site.results == judged_lines(site.path, stream)[:5]
        )  # the cache held what the dead router did not pass on
        rest = write(site.path.with_name("rest.mcap"), stream[320:])
        with Command(site.path.with_name("nodes.log"), "emulate", rest, *site.destination, "--speed", "10"):
            until(lambda: len(site.results) >= 6, "the window of 45 s")
        with node_of(site) as publisher:
            for block in stream[480:]:  # from 60 s on
                publisher.send(block)
        until(lambda: len(site.results) == 15, "windows up to 90 s")
        demand_whole_end(site, daemon)
    counts = site.health["source"]["counts"]
    assert counts["links_lost"] >= 1 and counts["sensors_lost"] >= 1 and counts["gaps"] == 1
    recorded = list(read_recordings(site.recordings))
    died = max(b.sequence + b.n_samples for b in recorded if b.sequence < 480 * 128) / RATE_HZ
    assert 45.0 <= died < 60.0
    demand_holes_skipped(site.results, [(died, 60.0)])
    assert site.summary["quality"]["lost_s"] == pytest.approx(60.0 - died, abs=0.01)


def _rejoined(site: Site) -> bool:
    """Whether the daemon is there behind the router."""
    with open_session(SessionSettings(connect=(f"tcp/127.0.0.1:{site.port}",)), Path()) as session:
        return any(True for _ in session.get(f"{KEY}/received", timeout=2.0))
