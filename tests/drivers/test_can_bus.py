"""CAN buses as sources: virtual ones, the socketcan code over a local socket, and whatever frames may bring."""

import contextlib
import re
import socket
import struct
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.socketcan import socketcan
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from drivers import frames
from drivers.base import EndOfStream, SampleBlock, SourceError
from drivers.can_bus import CanSource
from drivers.frames import FrameError
from drivers.registry import source_type
from drivers.socketcand_server import SocketcandServer, frame_text
from tests.support.can_group import CHANNELS, DEPLOY, RATE, T0, SilentBus, accel, datagram, row_values, source
from tests.support.waiting import until


def heard(bus: SilentBus, reader: CanSource) -> list[SampleBlock]:
    """All blocks of a bus, however long its frames give none."""
    blocks = []
    while (block := reader.read(0.3)) is not None or bus.items:
        blocks += [block] if block is not None else []
    return blocks


def until_failure(reader: CanSource, reason: str, timeout_s: float = 0.2) -> list[SampleBlock]:
    """Blocks before the source fails."""
    blocks = []
    with pytest.raises(SourceError, match=reason):
        while True:
            blocks.append(reader.read(timeout_s))
    return [block for block in blocks if block is not None]


def take(reader: CanSource, samples: int) -> list[SampleBlock]:
    """The next blocks of this many samples together."""
    blocks: list[SampleBlock] = []

    def more() -> bool:
        block = reader.read(0.05)
        blocks.extend([block] if block is not None else [])
        return sum(b.n_samples for b in blocks) >= samples

    if samples:
        until(more, f"{samples} samples")
    return blocks


def opened(bus: SilentBus, *place: Any, **table: object) -> CanSource:
    reader = source(*place, bus=bus, **table)
    reader.open()
    return reader


def indices(blocks: list[SampleBlock]) -> list[int]:
    return [k for block in blocks for k in range(block.sequence, block.sequence + block.n_samples)]


def counted(reader: CanSource, *names: str) -> list[int]:
    return [reader.health().counts[name] for name in names]


def error_frame(kind: int, second: int = 0) -> can.Message:
    return can.Message(is_error_frame=True, arbitration_id=kind, data=bytes([0, second, 0, 0, 0, 0, 0, 0]))


def test_a_virtual_bus_gives_blocks_and_is_closed_twice() -> None:
    reader = source(channel="ours")
    with can.Bus(interface="virtual", channel="ours", preserve_timestamps=True) as sender:
        reader.open()
        assert reader.health().connected
        for message in accel(np.arange(300)):
            sender.send(message)
        sender.send(can.Message(arbitration_id=0x700, is_extended_id=False))
        blocks = take(reader, 300)
    assert sorted({block.n_samples for block in blocks}) == [44, 128]
    assert [(b.t_ns, b.sequence) for b in blocks] == [
        (1_767_225_600_000_000_000 + k * 125_000_000, k * 128) for k in range(3)
    ]
    np.testing.assert_array_equal(np.concatenate([b.samples for b in blocks]), np.float32(row_values(np.arange(300))))
    reader.close()
    reader.close()
    assert not reader.health().connected and reader.health().counts["samples"] == 300
    with pytest.raises(SourceError, match="not open"):
        reader.read(0.01)


@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 10**6), block=st.integers(1, 300))
def test_one_frame_in_a_hundred_lost_repeated_or_swapped(seed: int, block: int) -> None:
    rng = np.random.default_rng(seed)
    sent = np.arange(65000, 67000)  # the counter wraps
    messages = accel(sent)
    stream, kept = [], set()
    for k, message in zip(sent.tolist(), messages, strict=True):
        fate = rng.random()
        if fate < 0.01 and k > 65000:
            continue
        kept.add(k)
        stream.append(message)
        if fate < 0.02:
            stream.append(message)
        elif fate < 0.03 and len(stream) > 9:
            stream.insert(-int(rng.integers(1, 8)), stream.pop())
    first = int.from_bytes(stream[0].data[6:8], "little")
    bus = SilentBus(stream)
    blocks = heard(bus, opened(bus, block_samples=block))
    found = indices(blocks)
    expected = sorted(k for k in kept if k >= first)
    assert found == expected[: len(found)] and len(found) >= len(expected) - 33
    np.testing.assert_array_equal(np.concatenate([b.samples for b in blocks]), np.float32(row_values(np.array(found))))
    for b in blocks:
        assert b.t_ns == blocks[0].t_ns + round((b.sequence - blocks[0].sequence) / RATE * 1e9)


def test_everything_else_is_counted() -> None:
    good = accel(np.arange(100))
    bus = SilentBus(
        [
            *good[:50],
            can.Message(arbitration_id=256, is_extended_id=True, data=bytes(8)),
            can.Message(arbitration_id=3, is_extended_id=False, data=bytes(8)),
            can.Message(arbitration_id=256, is_extended_id=False, data=bytes(7)),
            can.Message(arbitration_id=256, is_extended_id=False, is_remote_frame=True, dlc=8),
            error_frame(0x04, 1),
            error_frame(0x20),
            *good[50:],
        ]
    )
    reader = opened(bus)
    assert indices(heard(bus, reader)) == list(range(100))
    assert counted(reader, "foreign", "undecodable", "error_frames", "overruns") == [2, 2, 2, 1]


@pytest.mark.parametrize(
    ("trouble", "reason"),
    [(error_frame(0x40), "bus off"), (can.CanOperationError("Network is down"), "Network is down")],
)
def test_a_lost_bus_is_reopened_and_leaves_a_gap_of_its_length(trouble: can.Message | Exception, reason: str) -> None:
    bus = SilentBus([*accel(np.arange(8000)), trouble])  # and then silence
    reader = opened(bus)
    assert indices(until_failure(reader, reason)) == list(range(8000))
    assert not reader.health().connected and reason in reader.health().detail
    away = 2 * 65536 + 500  # the counter wraps twice meanwhile
    bus.items.extend(accel(np.arange(8000 + away, 10000 + away)))
    reader.open()
    after = heard(bus, reader)
    assert indices(after) == list(range(8001 + away, 10000 + away))
    assert after[0].t_ns == round(T0) * 10**9 + round((8001 + away) / RATE * 1e9)
    assert reader.health().counts["samples"] == 8000 + 1999


def test_bus_off_is_not_believed_while_frames_come() -> None:
    bus = SilentBus(m for good in accel(np.arange(3000)) for m in (good, error_frame(0x40)))
    bus.items.append(can.Message(arbitration_id=0x123, is_extended_id=False))
    reader = opened(bus)
    assert indices(heard(bus, reader)) == list(range(3000))
    assert heard(bus, reader) == [] and reader.health().connected
    assert counted(reader, "bus_off", "error_frames") == [0, 3000]


def test_bus_off_is_believed_at_once_if_the_controller_says_so() -> None:
    bus = SilentBus([*accel(np.arange(50)), error_frame(2), *accel(np.arange(50, 60))])
    bus.state = can.BusState.ERROR
    reader = opened(bus)
    assert indices(until_failure(reader, "bus off")) == list(range(50))
    assert counted(reader, "bus_off") == [1]


def test_malformed_datagrams_are_counted_and_close_nothing(group: tuple[CanSource, Callable[[bytes], object]]) -> None:
    reader, send = group
    good = accel(np.arange(640))
    forged: list[dict[str, object]] = [
        {"arbitration_id": 256.5},
        {"is_extended_id": [1]},
        {"arbitration_id": 64.0, "is_error_frame": True},
        {"data": 1 << 40},
        {"data": "text"},
        {"dlc": -1},
        {"unknown": 1},
        {"check": False},
    ]
    found, n_bad = [], 0
    for k, message in enumerate(good):
        for bad in (b"x", b"", bytes([0xC1]), datagram(message, **forged[k % len(forged)])):
            send(bad)
            n_bad += 1
        send(datagram(message))
        if k % 20 == 19 and (block := reader.read(0.0)) is not None:
            found.append(block)
    found += take(reader, 640 - len(indices(found)))
    counts = reader.health().counts
    assert indices(found) == list(range(640)) and counts["lost_samples"] == 0 and reader.health().connected
    assert counts["undecodable"] + counts["foreign"] == n_bad and counts["foreign"] == 80  # of an extended identifier


def test_a_flood_of_malformed_datagrams_leaves_the_good_frames(
    group: tuple[CanSource, Callable[[bytes], object]],
) -> None:
    """The flood is as fast as the reader: what the kernel drops for lack of room is not the reader's."""
    reader, send = group
    found: list[SampleBlock | None] = []
    for k, message in enumerate(accel(np.arange(128)), start=1):
        for _ in range(100):
            send(b"flood")
        send(datagram(message))
        while reader.health().counts["undecodable"] < 100 * k and len(found) < 100_000:
            found.append(reader.read(0.001))
    blocks = [block for block in found if block is not None]
    blocks += take(reader, 128 - len(indices(blocks)))
    assert indices(blocks) == list(range(128)) and counted(reader, "undecodable") == [12_800]


def test_malformed_messages_of_a_socketcand_server_are_counted_and_close_nothing() -> None:
    bad = [
        b"< frame zz 1 00 >", b"< frame 100 >", b"< error >", b"< frame 100 1.0 0 >", b"\xff\xfe >", b">", b"< hi >",
        b"< frame " + bytes(900) + b">",
    ]  # fmt: skip
    with socket.create_server(("127.0.0.1", 0)) as server:
        options = {"host": "127.0.0.1", "port": server.getsockname()[1]}
        reader = source(interface="socketcand", channel="can0", options=options)
        opening = threading.Thread(target=reader.open)
        opening.start()
        with server.accept()[0] as probe:
            probe.sendall(b"< hi >")
        peer, _ = server.accept()
        with peer:
            peer.settimeout(10.0)
            peer.sendall(b"< hi >")
            for asked in (b"< open can0 >", b"< rawmode >"):
                assert peer.recv(100) == asked
                peer.sendall(b"< ok >")
            opening.join()
            for k, message in enumerate(accel(np.arange(384))):
                peer.sendall(bad[k % len(bad)] + frame_text(256, False, message.timestamp, message.data))
            found = take(reader, 384)
            peer.sendall(b"< error 20000040 1.0 >")
            for message in accel(np.arange(384, 512)):
                peer.sendall(frame_text(256, False, message.timestamp, message.data))
            found += take(reader, 128)
            assert reader.health().connected
        until_failure(reader, "closed the connection")
    reader.close()
    assert indices(found) == list(range(512))
    assert counted(reader, "undecodable", "bus_off", "error_frames") == [384, 0, 1]


def test_a_socketcand_server_that_does_not_answer_is_told_and_tried_again_and_frames_beside_its_answer_are_read() -> (
    None
):
    """The server greets and is silent; when it is tried again it sends the first frames in one packet with its answer."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        options = {"host": "127.0.0.1", "port": server.getsockname()[1], "answer_s": 0.05}
        reader = source(interface="socketcand", channel="can0", options=options)
        frames_at_once = b"".join(frame_text(256, False, m.timestamp, m.data) for m in accel(np.arange(384)))

        def serve() -> None:
            for answers in ((), (b"< ok >", b"< ok >" + frames_at_once[:-7])):
                with server.accept()[0] as probe:
                    probe.sendall(b"< hi >")
                with server.accept()[0] as peer:
                    peer.settimeout(10.0)
                    peer.sendall(b"< hi >")
                    for answer in answers:
                        peer.recv(100)
                        peer.sendall(answer)
                    if answers:
                        peer.sendall(frames_at_once[-7:])
                    while peer.recv(100):
                        continue

        serving = threading.Thread(target=serve)
        serving.start()
        with pytest.raises(SourceError, match=r"the server does not answer: no '< ok >' within 0\.05 s"):
            reader.open()
        assert not reader.health().connected
        reader.open()
        assert indices(take(reader, 384)) == list(range(384)) and counted(reader, "undecodable") == [0]
        reader.close()
        serving.join()


@pytest.mark.parametrize("by", [1, 2, 5, 31, 32])
@pytest.mark.parametrize("size", [7, 128])
def test_a_counter_that_is_set_back_by_a_few_counts_leaves_a_gap(by: int, size: int) -> None:
    after = np.arange(500, 1000)
    bus = SilentBus([*accel(np.arange(500)), *accel(after - by, row_values(after), T0 + by / RATE)])
    reader = opened(bus, block_samples=size)
    blocks = heard(bus, reader)
    true = np.concatenate([np.rint(1000 * b.samples[:, 0] + 1e6 * b.samples[:, 1]).astype(int) for b in blocks])
    assert true.tolist() == [*range(500), *range(501, len(true) + 1)] and len(true) > 950
    found = np.array(indices(blocks))
    assert np.flatnonzero(np.diff(found) != 1).tolist() == [499]  # one gap, there
    assert counted(reader, "restarts", "repeated", "stray") == [1, 0, 0]


def test_frames_that_come_again_in_a_burst_are_repeated_and_one_with_another_content_is_stray() -> None:
    good = accel(np.arange(2000))
    bus = SilentBus([*good[:1000], *good[968:1000], *good[1000:]])
    reader = opened(bus)
    assert indices(heard(bus, reader))[:1900] == list(range(1900))
    assert counted(reader, "restarts", "repeated", "stray") == [0, 32, 0]
    (forged,) = accel(np.array([990]), row_values(np.array([5])))
    bus = SilentBus([*good[:1000], forged, *good[1000:]])
    reader = opened(bus)
    assert indices(heard(bus, reader))[:1900] == list(range(1900))
    assert counted(reader, "restarts", "repeated", "stray") == [0, 0, 1]


@pytest.mark.parametrize(
    ("interface", "error", "told"),
    [
        ("slcan", IndexError("string index out of range"), True),
        ("slcan", ValueError("invalid literal"), True),
        ("serial", struct.error("unpack requires 4 bytes"), True),
        ("serial", can.CanOperationError("could not read from serial"), False),
        ("socketcan", ValueError("filedescriptor out of range in select()"), False),
        ("slcan", OSError("cable out"), False),
    ],
)
def test_an_adapter_s_broken_line_is_no_broken_adapter(interface: str, error: Exception, told: bool) -> None:
    good = accel(np.arange(256))
    bus = SilentBus([*good[:100], error, *good[100:]])
    reader = opened(bus, interface=interface)
    if told:
        assert indices(heard(bus, reader)) == list(range(256)) and counted(reader, "undecodable") == [1]
    else:
        until_failure(reader, str(error)[:10])


@pytest.mark.parametrize("bad", [float("nan"), -1.0, 1e300, float("inf")])
def test_bad_times_are_counted_and_the_counter_goes_on(bad: float) -> None:
    bus = SilentBus(accel(np.arange(5000)))
    for k in [*range(3), *range(1000, 1500)]:
        bus.items[k].timestamp = bad
    reader = opened(bus)
    assert indices(heard(bus, reader)) == list(range(3, 5000))
    assert counted(reader, "untimed", "bad_times", "steps") == [3, 503, 0]


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.builds(
            can.Message,
            timestamp=st.floats(),
            arbitration_id=st.sampled_from([256, 257, 0x40, 4]),
            is_extended_id=st.booleans(),
            is_remote_frame=st.booleans(),
            is_error_frame=st.booleans(),
            data=st.binary(max_size=64),
            is_fd=st.booleans(),
        ),
        max_size=60,
    )
)
def test_no_frame_can_break_it(messages: list[can.Message]) -> None:
    bus = SilentBus(messages)
    reader = opened(bus, block_samples=8)
    blocks = []
    while bus.items:
        try:
            blocks.append(reader.read(0.01))
        except SourceError:
            reader.open()
    reader.health()
    found = indices([b for b in blocks if b])
    assert found == sorted(set(found))


def test_a_flood_of_foreign_frames_keeps_memory_and_order() -> None:
    strange = [can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(8))] * 9
    bus = SilentBus(m for good in accel(np.arange(2000)) for m in (good, *strange))
    reader = opened(bus)
    tracemalloc.start()
    found = [k for block in iter(lambda: reader.read(0.3), None) for k in indices([block])]
    kept_bytes = tracemalloc.get_traced_memory()[0] - sum(map(sys.getsizeof, [found, *found]))
    tracemalloc.stop()
    assert found == list(range(2000)) and counted(reader, "foreign") == [18000]
    assert kept_bytes < 60_000, "neither frames nor samples are kept; 18,000 frames would take 800 kB"


def test_fd_frames_with_a_counter_of_frames(tmp_path: Path) -> None:
    parts = [
        f' SG_ a{c}_{k} : {16 * (3 * k + c - 1)}|16@1- (0.001,0) [0|0] "m/s^2" X\n'
        for k in range(10)
        for c in (1, 2, 3)
    ]
    text = 'VERSION ""\nBU_: X\nBO_ 5 F: 64 X\n' + "".join(parts) + ' SG_ counter : 480|16@1+ (1,0) [0|0] "" X\n'
    (tmp_path / "fd.dbc").write_text(text)
    (layout,) = frames.load(tmp_path / "fd.dbc", CHANNELS)
    for counts, step in ("frames", 1), ("samples", 10):
        data, _ = layout.encode(row_values(np.arange(6000)), np.arange(600) * step % 65536)
        messages = [
            can.Message(
                timestamp=T0 + (10 * k + 9) / RATE,
                arbitration_id=5,
                is_extended_id=False,
                is_fd=True,
                data=row.tobytes(),
            )
            for k, row in enumerate(data)
        ]
        del messages[100:103]
        bus = SilentBus(messages)
        reader = opened(bus, tmp_path, dbc="fd.dbc", fd=True, counter_counts=counts)
        blocks = heard(bus, reader)
        assert indices(blocks) == [*range(1000), *range(1030, 6000)]
        assert blocks[0].t_ns == round(T0 * 1e9)
        assert reader.health().counts["lost_samples"] == 30


def nodes(folder: Path, shift: float, ppm: float = 0.0, offset: int = 0, seconds: float = 8.0) -> list[can.Message]:
    """Two nodes; the second samples `shift` samples later, `ppm` faster, and counts from `offset`."""
    (folder / "two.dbc").write_text(
        'VERSION ""\nBU_: X\n'
        + "".join(
            f'BO_ {at} N{at}: 4 X\n SG_ a{at} : 0|16@1- (0.001,0) [0|0] "m/s^2" X\n SG_ counter : 16|16@1+ (1,0) [0|0] "" X\n\n'
            for at in (1, 2)
        )
    )
    rng, out = np.random.default_rng(0), []
    for at in (1, 2):
        k = np.arange(round(seconds * RATE))
        t = T0 + (k + (at == 2) * shift) / RATE / (1 + (at == 2) * ppm * 1e-6) + rng.exponential(5e-5, len(k))
        (layout,) = frames.load(folder / "two.dbc", (f"a{at}",))
        data, _ = layout.encode(0.001 * (k % 1000)[:, None], (k + (at == 2) * offset) % 65536)
        out += [
            can.Message(timestamp=s, arbitration_id=at, is_extended_id=False, data=row.tobytes())
            for s, row in zip(t.tolist(), data, strict=True)
        ]
    return sorted(out, key=lambda message: message.timestamp)


def two(folder: Path, messages: list[can.Message], **table: object) -> tuple[CanSource, Callable[[], np.ndarray]]:
    """A source of two nodes, and what reads all their samples."""
    bus = SilentBus(messages)
    reader = opened(bus, folder, ("a2", "a1"), dbc="two.dbc", **table)
    return reader, lambda: np.concatenate([b.samples for b in heard(bus, reader) if b.channels == ("a2", "a1")])


def test_nodes_that_sample_together_are_joined_by_their_counters(tmp_path: Path) -> None:
    reader, read = two(tmp_path, nodes(tmp_path, 0.3))
    samples = read()
    assert len(samples) > 8000
    np.testing.assert_array_equal(samples[:, 0], samples[:, 1])
    assert [c.node for c in reader.health().clocks] == ["N2", "N1"] and "N1 -0.3" in reader.health().detail


@pytest.mark.parametrize(("shift", "ppm", "offset"), [(3.0, 0.0, 0), (0.0, 0.0, 500), (0.0, 300.0, 0)])
def test_nodes_that_do_not_are_refused(tmp_path: Path, shift: float, ppm: float, offset: int) -> None:
    _, read = two(tmp_path, nodes(tmp_path, shift, ppm, offset))
    with pytest.raises(SourceError, match="not synchronised"):
        read()


def test_or_shifted_by_whole_samples_if_asked(tmp_path: Path) -> None:
    reader, read = two(tmp_path, nodes(tmp_path, 3.2, offset=500), realign=True)
    samples = read()
    both = samples[np.isfinite(samples).all(axis=1)]
    np.testing.assert_allclose((both[:, 0] - both[:, 1]) % 1.0, 0.997, atol=1e-4)  # a1 is taken three samples earlier
    assert len(both) > 7000 and "-0.2" in reader.health().detail


def test_a_drifting_node_that_is_realigned_leaves_holes(tmp_path: Path) -> None:
    reader, read = two(tmp_path, nodes(tmp_path, 0.0, ppm=300.0, seconds=20.0), realign=True)
    samples = read()
    assert reader.health().counts["realigned"] >= 3
    apart = np.rint(1000 * (samples[:, 0] - samples[:, 1])) % 1000
    edges = np.flatnonzero(np.diff(np.where(np.isnan(apart), -1, apart)) != 0)
    assert np.isnan(samples[edges]).any(axis=1).sum() * 2 >= len(edges) > 0  # no change of shift without a hole


def test_a_node_whose_frames_come_half_a_second_late_is_waited_for(tmp_path: Path) -> None:
    messages = sorted(nodes(tmp_path, 0.0), key=lambda m: m.timestamp + 0.5 * (m.arbitration_id == 2))
    reader, read = two(tmp_path, messages)
    samples = read()
    assert len(samples) > 8000 and np.isfinite(samples).all() and counted(reader, "unmatched") == [0]


def test_a_dead_node_is_missing_not_invented(tmp_path: Path) -> None:
    reader, read = two(tmp_path, [m for m in nodes(tmp_path, 0.0) if m.arbitration_id == 2 or m.timestamp < T0 + 5])
    samples = read()
    assert np.isnan(samples[:, 1]).any() and np.isfinite(samples[:, 0]).all()
    assert counted(reader, "unmatched") == [np.isnan(samples[:, 1]).sum()]


def test_a_frame_that_a_client_of_our_server_sends_reaches_the_others_as_it_is() -> None:
    server = SocketcandServer("127.0.0.1", 0, settle_s=0.0)
    address = ("127.0.0.1", server.port)
    with (
        contextlib.closing(server),
        socket.create_connection(address) as one,
        socket.create_connection(address) as other,
    ):
        for client in (one, other):
            client.settimeout(10.0)
            client.sendall(b"< rawmode >")
            heard = b""
            while not heard.endswith(b"< ok >"):
                heard += client.recv(100)
        assert server.wait_for_client(10.0, clients=2)
        one.sendall(b"< send 1A2 3 0A FF 10 >")
        heard = other.recv(100)
    assert re.fullmatch(rb"< frame 1A2 [\d.]+ 0AFF10 >", heard), heard


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """The other end of what python-can takes for a kernel CAN socket."""

    class KernelSocket(socket.socket):
        def setsockopt(self, level: int, *rest: object) -> None:
            if level != socketcan.constants.SOL_CAN_RAW:
                super().setsockopt(level, *rest)  # type: ignore[call-overload]

    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    kernel = KernelSocket(socket.AF_UNIX, socket.SOCK_DGRAM, 0, near.detach())
    monkeypatch.setattr(socketcan, "create_socket", lambda: kernel)
    monkeypatch.setattr(socketcan, "bind_socket", lambda *_: None)
    yield far
    far.close()
    kernel.close()


def raw(frame_id: int, data: bytes) -> bytes:
    return struct.pack("=IBB2x8s", frame_id, len(data), 0, data)


def test_the_socketcan_path_with_error_frames_and_bus_off(wire: socket.socket) -> None:
    reader = source(interface="socketcan", channel="can0", block_samples=16)
    reader.open()
    for message in accel(np.arange(96)):
        wire.send(raw(256, bytes(message.data)))
    wire.send(raw(0x20000004, bytes([0, 1, 0, 0, 0, 0, 0, 0])))
    wire.send(raw(0x123, bytes(8)))
    now = time.time()
    blocks = take(reader, 96)
    assert indices(blocks) == list(range(96)) and abs(blocks[0].t_ns * 1e-9 - now) < 5.0
    wire.send(raw(0x20000040, bytes(8)))
    until_failure(reader, "bus off")
    assert counted(reader, "error_frames", "overruns", "bus_off", "foreign") == [2, 1, 1, 1]
    reader.close()


def test_no_such_bus() -> None:
    for table in {"interface": "no_such"}, {"interface": "socketcand", "options": {"host": "127.0.0.1", "port": 9}}:
        with pytest.raises(SourceError):
            source(**table).open()
    with pytest.raises(SourceError, match="needs options"):
        source(interface="socketcand").open()


def test_settings() -> None:
    assert source_type("can") is CanSource
    with pytest.raises(ValidationError):
        source(sample_rate=5)
    with pytest.raises(ValidationError):
        source(sample_rate_hz=float("inf"))
    with pytest.raises(FrameError, match="no signal 'b9'"):
        source(channels=("b9",))


def test_a_log_file_is_a_source(tmp_path: Path) -> None:
    with can.Logger(tmp_path / "x.log") as log:
        for message in accel(np.arange(500)):
            log(message)
    blocks = []
    reader = source(tmp_path, interface="log", channel="x.log", dbc=str(DEPLOY / "frame.dbc"))
    reader.open()
    with pytest.raises(EndOfStream):
        while True:
            blocks.append(reader.read(0.1))
    assert indices([b for b in blocks if b]) == list(range(500))
