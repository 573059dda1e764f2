"""The node emulator and the CAN source, over loopback TCP by the protocol of socketcand."""

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest

from drivers import frames
from drivers.base import ACCELERATION, TEMPERATURE, SampleBlock, SourceContext, SourceError
from drivers.can_bus import CanSource
from drivers.socketcand_server import SocketcandServer, frame_text
from monitor.core import BadConfigurationError, MissingInputError
from monitor.runs import emulate
from tests.support.samples import Cli, Cut, write_blocks
from tests.support.zenoh_router import free_port

DEPLOY = Path(__file__).parents[2] / "deploy"
CHANNELS = ("a1", "a2", "a3")


@pytest.fixture
def server() -> SocketcandServer:
    made = SocketcandServer("127.0.0.1", 0, settle_s=0.1)
    yield made
    made.close()


def error_text(kind: int, t_s: float) -> bytes:
    """An error frame on the wire; `kind` are the kernel's bits, as 0x40 for bus off."""
    return f"< error {kind | 0x20000000:03X} {t_s:.6f} >".encode()


def source(port: int, dbc: str = "frame.dbc", folder: Path = DEPLOY) -> CanSource:
    options = {"host": "127.0.0.1", "port": port}
    table = {"interface": "socketcand", "channel": "can0", "options": options, "dbc": dbc, "sample_rate_hz": 1024.0}
    return CanSource(CanSource.Settings.model_validate(table), SourceContext(CHANNELS, folder))


def receive(reader: CanSource) -> list[SampleBlock]:
    """Everything until the server leaves."""
    blocks = []
    try:
        while True:
            if (block := reader.read(0.5)) is not None:
                blocks.append(block)
    except SourceError:
        reader.close()
    return blocks


def joined(blocks: list[SampleBlock]) -> np.ndarray:
    return np.concatenate([block.samples for block in blocks])


def can_sink(server: SocketcandServer) -> emulate.CanSink:
    layouts = frames.load(DEPLOY / "frame.dbc", CHANNELS)
    return emulate.CanSink(layouts, emulate.transmit_over_tcp(server), server.close)


def test_samples_times_and_numbers_arrive_as_they_were(server: SocketcandServer, cut: Cut) -> None:
    raw = np.random.default_rng(1).integers(-32768, 32768, (70000, 3))
    blocks = cut((raw * 0.001).astype(np.float32), 1024.0, (1024,))
    readers = [source(server.port) for _ in range(2)]  # two clients of one server
    for reader in readers:
        reader.open()
    assert server.wait_for_client(10.0, clients=2)
    got: list[list[SampleBlock]] = [[], []]
    threads = [threading.Thread(target=lambda at=at: got[at].extend(receive(readers[at]))) for at in range(2)]
    for thread in threads:
        thread.start()
    sink = can_sink(server)
    assert emulate.send_when_due(emulate.cut_blocks(blocks, 10), sink, speed=None) == 70000
    sink.close()
    for thread in threads:
        thread.join(30)
    assert sink.saturated == 0
    for found in got:
        np.testing.assert_array_equal(joined(found), np.float32(raw * 0.001))
        for block in found:
            assert block.t_ns == blocks[0].t_ns + round(block.sequence / 1024.0 * 1e9)
    assert readers[0].health().counts["lost_samples"] == 0


def test_error_frames_and_bus_off_and_frames_of_other_clients(server: SocketcandServer) -> None:
    reader = source(server.port)
    reader.open()
    assert server.wait_for_client(5.0)
    with can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=server.port) as other:
        other.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes([1, 0xAB])))
        other.send(can.Message(arbitration_id=256, is_extended_id=False, data=bytes(8)))
        block = None
        deadline = time.monotonic() + 10
        while block is None and time.monotonic() < deadline:
            block = reader.read(0.2)
    assert block is not None and block.n_samples == 1 and reader.health().counts["foreign"] == 1
    server.send(error_text(0x04, 1.0) + error_text(0x40, 1.0))
    with pytest.raises(SourceError, match="bus off"):
        while True:
            reader.read(0.2)
    assert reader.health().counts["error_frames"] == 2
    reader.close()


def test_a_server_that_leaves_and_comes_back(server: SocketcandServer) -> None:
    reader = source(server.port)
    reader.open()
    port = server.port
    server.close()
    with pytest.raises(SourceError, match="closed the connection"):
        while True:
            reader.read(0.2)
    with pytest.raises(SourceError):
        reader.open()
    again = SocketcandServer("127.0.0.1", port, settle_s=0.1)
    reader.open()
    assert again.wait_for_client(5.0) and reader.health().connected
    reader.close()
    again.close()


def test_nonsense_on_the_wire_is_survived(server: SocketcandServer) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as rude:
        rude.sendall(b"\xff\0<<>>< send zz 1 >< rawmode >< send 1 99 >< what >" + b"x" * 10000)
        while rude.recv(1000):
            pass
    reader = source(server.port)
    reader.open()
    assert server.wait_for_client(5.0)
    server.send(
        frame_text(256, False, 5.0, bytes(8)) + b"< frame >" + frame_text(256, False, 5.001, b"\0" * 6 + b"\1\0")
    )
    deadline, n_samples = time.monotonic() + 10, 0
    while n_samples < 2 and time.monotonic() < deadline:
        block = reader.read(0.2)
        n_samples += block.n_samples if block is not None else 0
    assert n_samples == 2 and reader.health().connected and reader.health().counts["undecodable"] == 1
    reader.close()


def test_pieces_end_where_frames_do(cut: Cut) -> None:
    blocks = cut(np.arange(90.0).reshape(30, 3), 100.0, (7, 11), first=3)
    parts = list(emulate.cut_blocks(blocks, 5))
    np.testing.assert_array_equal(joined(parts), joined(blocks))
    assert all(part.sequence // 5 == (part.sequence + part.n_samples - 1) // 5 for part in parts)
    assert all(part.t_ns == blocks[0].t_ns + (part.sequence - 3) * 10_000_000 for part in parts)


def test_values_beyond_the_dbc_are_counted_and_other_topics_left_out(cut: Cut) -> None:
    sent: list[np.ndarray] = []
    sink = emulate.CanSink(
        frames.load(DEPLOY / "frame.dbc", CHANNELS), lambda _l, _t, data: sent.append(data), lambda: None
    )
    emulate.send_when_due(
        [
            *cut(np.array([[40.0, 0.0, -50.0], [1.0, 1.0, 1.0]]), 1024.0),
            SampleBlock(TEMPERATURE, 0, 0, 1.0, ("air",), "degC", np.ones((1, 1), np.float32)),
        ],
        sink,
        speed=None,
    )
    assert sink.saturated == 2 and len(sent) == 1 and len(sent[0]) == 2


def test_fd_frames_wait_until_they_are_full(tmp_path: Path, cut: Cut) -> None:
    parts = "".join(
        f' SG_ a{c}_{k} : {16 * (3 * k + c - 1)}|16@1- (0.001,0) [0|0] "" X\n' for k in range(4) for c in (1, 2, 3)
    )
    (tmp_path / "fd.dbc").write_text(
        'VERSION ""\nBU_: X\nBO_ 5 F: 32 X\n' + parts + ' SG_ counter : 192|16@1+ (1,0) [0|0] "" X\n'
    )
    layouts = frames.load(tmp_path / "fd.dbc", CHANNELS)
    got: list[tuple[list[float], np.ndarray]] = []
    sink = emulate.CanSink(layouts, lambda _l, times, data: got.append((times, data)), lambda: None)
    values = np.arange(99.0).reshape(33, 3) * 0.001
    for block in cut(values, 100.0, (3, 1), first=2):
        sink.send(block)
    sink.close()
    data = np.concatenate([data for _, data in got])
    samples, counters = layouts[0].decode(data.tobytes())
    np.testing.assert_array_equal(samples, np.float32(values[2:30]))
    assert counters.tolist() == list(range(4, 32, 4)) and sink.left_out == 5
    assert got[0][0][0] == pytest.approx(1_767_225_600 + 0.07, abs=1e-6)  # of its last sample


def test_the_pace_is_the_data_s(cut: Cut, monkeypatch: pytest.MonkeyPatch) -> None:
    now, sent = [100.0], []

    class Clock:
        def send(self, block: SampleBlock) -> None:
            sent.append(now[0])

        def close(self) -> None: ...

    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("time.sleep", lambda s: now.__setitem__(0, now[0] + s))
    emulate.send_when_due(cut(np.zeros((1000, 3)), 100.0, (100,)), Clock(), speed=4.0)
    np.testing.assert_allclose(sent, 100.0 + 0.25 * np.arange(1, 11))


@pytest.mark.parametrize(
    ("to", "dbc", "reason"),
    [
        ("can:virtual:x", None, "--dbc"),
        ("can:virtual", "frame.dbc", "expected"),
        ("can:socketcand-server:host:x", "frame.dbc", "expected"),
        ("zenoh:client:key", None, "expected"),
        ("zenoh:client:tcp/127.0.0.1:1:key", "frame.dbc", "--dbc is for CAN"),
        ("zenoh:clinet:tcp/127.0.0.1:1:key", None, "mode|Input"),
        ("smoke:signals", None, "expected"),
        ("can:virtual:x", "none.dbc", "No such file"),
    ],
)
def test_destinations_that_are_none(to: str, dbc: str | None, reason: str) -> None:
    with pytest.raises(BadConfigurationError, match=reason):
        emulate.open_sink(to, CHANNELS, dbc=None if dbc is None else DEPLOY / dbc)


def test_no_client_comes() -> None:
    with pytest.raises(MissingInputError, match="no client"):
        emulate.open_sink("can:socketcand-server:127.0.0.1:0", CHANNELS, dbc=DEPLOY / "frame.dbc", wait_s=0.05)


def test_two_processes(tmp_path: Path, cut: Cut) -> None:
    raw = np.random.default_rng(2).integers(-9000, 9000, (5000, 3))
    write_blocks(tmp_path / "r.mcap", cut((raw * 0.001).astype(np.float32), 1024.0, (1000,)))
    port = free_port()
    to, dbc = f"can:socketcand-server:127.0.0.1:{port}", str(DEPLOY / "frame.dbc")
    script = str(Path(sys.executable).with_name("shm-monitor"))
    command = [script, "emulate", str(tmp_path / "r.mcap"), "--to", to, "--dbc", dbc, "--speed", "max"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None and "waiting for a client" in process.stderr.readline()
        reader = source(port)
        reader.open()
        blocks = receive(reader)
        assert process.wait(20) == 0 and process.stderr.read() == "5000 samples sent\n"
    np.testing.assert_array_equal(joined(blocks), np.float32(raw * 0.001))
    assert blocks[0].topic == ACCELERATION


def test_simulate_sends_to_a_bus(tmp_path: Path, frame_text: str, main: Cli) -> None:
    (tmp_path / "s.toml").write_text(frame_text)
    with can.Bus(interface="virtual", channel="simulated") as bus:
        done = main(
            "simulate", "--structure", tmp_path / "s.toml", "--duration", "2", "--to", "can:virtual:simulated",
            "--dbc", DEPLOY / "frame.dbc", "--speed", "max",
        )  # fmt: skip
        assert done.returncode == 0 and "2048 samples sent" in done.stderr
        count = 0
        while bus.recv(0.1) is not None:
            count += 1
    assert count == 2048 and [path.name for path in tmp_path.iterdir()] == ["s.toml"]
    assert main("simulate", "--structure", tmp_path / "s.toml").returncode == 2
