"""Every way in, as a function of bytes that may refuse them in the ways it promises and in no other.

`TARGETS` is run with seeded mutations in the tests (`test_targets`) and guided by coverage with ``python -m tests.fuzz.run``.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import json
import logging
import math
import os
import socket
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import can
import numpy as np
import zenoh
from can.interfaces.udp_multicast.bus import UdpMulticastBus
from can.interfaces.udp_multicast.utils import pack_message

from drivers import codec, frames, mqtt, zenoh_bus
from drivers.base import (
    ACCELERATION,
    GROUND,
    TEMPERATURE,
    EndOfStream,
    RecordingError,
    SampleBlock,
    SourceContext,
    SourceError,
)
from drivers.can_bus import CanSource
from drivers.can_open import CanSettings
from drivers.limits import BlockLimits, within_limits
from drivers.mcap_file import McapWriter, read_recordings
from drivers.mqtt import MqttSettings, MqttSource
from drivers.recorder import recorded, recover, unfit
from drivers.ros2_imu import decode_imu
from drivers.socketcand_client import SocketcandBus
from drivers.socketcand_server import frame_text
from drivers.zenoh_bus import ZenohSettings, ZenohSource
from monitor.config import configuration
from monitor.core import BadInputError, UserError
from monitor.damage import load_baseline, save_baseline
from monitor.runs import Session, ledger
from tests.fuzz.files import FILES, Target, imported_file, placed, scratch, written
from tests.runs.hostile import imu_topics
from tests.service import hostile
from tests.support.frame_text import THREE_STORIES
from tests.support.ros2 import record

ROOT = Path(__file__).parents[2]
T0_NS = 1_767_225_600_000_000_000
CHANNELS = ("a1", "a2", "a3")
STRUCTURE = THREE_STORIES + "\n[processing]\nwindow_s = 20.0\nhop_s = 5.0\n"


@functools.cache
def _settings() -> configuration.Configuration:
    return configuration.load(placed("structure.toml", STRUCTURE.encode()))


def block(k: int = 0, n: int = 16, **changes: Any) -> SampleBlock:
    """The k-th of a stream."""
    values = np.sin(np.arange(3 * n, dtype=np.float32).reshape(n, 3) + k)
    made = SampleBlock(ACCELERATION, T0_NS + k * n * 10**7, k * n, 100.0, CHANNELS, "m/s^2", values)
    return replace(made, **changes)


def sound(got: SampleBlock) -> None:
    """A block that a driver hands on is what it says, whatever it was made from."""
    assert got.samples.ndim == 2 and got.samples.shape == (got.n_samples, len(got.channels))
    assert got.samples.dtype == np.float32 and got.n_samples > 0
    assert math.isfinite(got.sample_rate_hz) and got.sample_rate_hz > 0 and got.t_ns >= 0


# --- messages ----------------------------------------------------------------------------------------------------------


def _protobuf(data: bytes) -> None:
    with contextlib.suppress(ValueError):
        got = codec.decode(data, ACCELERATION)
        assert got.samples.shape == (got.n_samples, len(got.channels)) and got.channels
        assert codec.decode(codec.encode(got), ACCELERATION).samples.shape == got.samples.shape
        sound(limited := within_limits(got, BlockLimits()))
        assert limited.sample_rate_hz <= 100e3


def _protobuf_seeds() -> list[bytes]:
    return [
        codec.encode(block()),
        codec.encode(block(1, 1, channels=("t",), samples=np.ones((1, 1), np.float32), unit="degC")),
        codec.encode(block(n=128)),
    ]


def _cdr(data: bytes) -> None:
    for axis in "xyz":
        with contextlib.suppress(ValueError, struct.error):
            decode_imu(data, "/imu", axis)


def _cdr_seeds() -> list[bytes]:
    def message(order: str, frame: bytes) -> bytes:
        head = struct.pack(order + "iII", 1_767_225_600, 5, len(frame)) + frame
        values = struct.pack(order + "37d", *range(37))
        return bytes([0, order == "<", 0, 0]) + head.ljust(-(-len(head) // 8) * 8, b"\0") + values

    return [message("<", b"imu\0"), message(">", b"link_7\0"), message("<", b"")]


def _zenoh(data: bytes) -> None:
    """Keys and payloads, as a stream: each begins with its length."""
    keys = {1: "shm/a/ground", 2: "shm/a/temperature"}
    places = {"ground_key": keys[1], "temperature_key": keys[2], "connect": ("tcp/127.0.0.1:1",)}
    with (
        patch.object(zenoh_bus, "open_session") as session,
        patch.object(zenoh_bus, "Callbacks") as callbacks,
        patch.object(zenoh.ext, "declare_advanced_subscriber") as subscribe,
    ):
        callbacks.return_value.of = lambda function: function
        source = ZenohSource(ZenohSettings(key="shm/a/b", **cast(Any, places)), SourceContext(CHANNELS, Path()))
        source.open()
    heard = {call.args[1]: call.args[2] for call in subscribe.call_args_list}
    heard["alive"] = session().liveliness().declare_subscriber.call_args.args[1]
    while data:
        size, data = 1 + int.from_bytes(data[:2], "big"), data[2:]
        message, data = data[:size], data[size:]
        kind, key, payload = zenoh.SampleKind.PUT, keys.get(message[0] if message else 0, "shm/a/b"), message
        if message[:1] == b"\xff":
            kind = kind if len(message) % 2 else zenoh.SampleKind.DELETE
            key, payload = "alive", message[1:]
        sample = SimpleNamespace(key_expr=payload.decode("latin-1"), kind=kind, payload=zenoh.ZBytes(payload))
        heard[key](sample)
        while (got := source.read(0.0)) is not None:
            sound(got)
    assert all(isinstance(n, int) for n in source.health().counts.values())
    source.close()
    with contextlib.suppress(EndOfStream):
        while (got := source.read(0.0)) is not None:
            sound(got)


def _zenoh_seeds() -> list[bytes]:
    def stream(*messages: bytes) -> bytes:
        return b"".join((len(m) - 1).to_bytes(2, "big") + m for m in messages)

    blocks = [codec.encode(block(k)) for k in range(6)]
    return [
        stream(*blocks[:3]),
        stream(blocks[0], blocks[2], blocks[1], blocks[1], blocks[4]),
        stream(b"\xffshm/a/alive/x", blocks[0], b"\xffshm/a/alive/xy"),
        stream(codec.encode(block(0, sequence=(1 << 63) - 1)), codec.encode(block(1, t_ns=1 << 61))),
    ]


def _mqtt_json(data: bytes) -> None:
    source = MqttSource(MqttSettings(host="127.0.0.1", topic="a/b", format="json"), SourceContext(CHANNELS, Path()))
    with patch.object(mqtt, "Connection") as connection:
        source.open()
    connection.return_value.configure_mock(ended=False, generation=1, lost=0, sessions_lost=0)
    message = SimpleNamespace(topic="a/b", payload=data, retain=False, qos=1, mid=1)
    connection.call_args_list[0].kwargs["on_message"](message)
    got = source.read(0.0)
    if got is not None:
        sound(got)
        assert source.read(0.0) is None
    counts = source.health().counts
    assert counts["blocks"] == (got is not None) == 1 - counts["undecodable"]


def _request_seeds() -> list[bytes]:
    shelve = {"action": "shelve", "story": 0, "who": "bo", "note": "works", "seconds": 3600.0}
    others = [{"action": "acknowledge", "story": 1, "who": "ann"}, {"action": "reset", "story": 3, "who": "x"}]
    return [json.dumps(row).encode() for row in (shelve, *others)]


# --- the CAN bus -------------------------------------------------------------------------------------------------------


_connected: list[Any] = []
"""The bus that the next CAN source opens."""


@functools.cache
def _new_can_source(interface: str) -> CanSource:
    settings = CanSettings(
        interface="virtual",
        channel="x",
        dbc=str(ROOT / "deploy" / "frame.dbc"),
        sample_rate_hz=1024.0,
        block_samples=16,
    )
    settings = settings.model_copy(update={"interface": interface})
    return CanSource(settings, SourceContext(CHANNELS, ROOT), connect=lambda *_: _connected[0])


def _read_all(bus: Any, interface: str = "virtual") -> None:
    source = copy.deepcopy(_new_can_source(interface))  # reading the DBC takes longer than all the rest
    _connected[:] = [bus]
    source.open()
    with contextlib.suppress(SourceError):
        for _ in range(200):
            got = source.read(0.0)
            if got is None:
                break
            sound(got)
    source.close()
    with contextlib.suppress(SourceError, EndOfStream):
        while (got := source.read(0.0)) is not None:
            sound(got)
    counts = source.health().counts
    assert all(n >= 0 for n in counts.values())


def _unconnected(kind: type[Any], **fields: object) -> Any:
    """A bus of python-can that has not been connected."""
    bus = kind.__new__(kind)
    vars(bus).update(fields, channel="x", channel_info="x", _filters=None, _is_shutdown=False, _periodic_tasks=[])
    return bus


class _Frames:
    """A bus that gives what it was given; 22 bytes a frame."""

    state = can.BusState.ACTIVE

    def __init__(self, data: bytes) -> None:
        self._data = data

    def recv(self, timeout: float) -> can.Message | None:
        raw, self._data = self._data[:22], self._data[22:]
        if len(raw) < 22:
            return None
        flags, length, frame_id, time = struct.unpack_from("<BBId", raw)
        return can.Message(
            timestamp=time,
            arbitration_id=frame_id & 0x1FFFFFFF,
            is_extended_id=bool(flags & 1),
            is_error_frame=flags & 14 == 2,
            is_remote_frame=flags & 14 == 4,
            data=raw[14 : 14 + length % 9],
        )

    def shutdown(self) -> None:
        pass


@functools.cache
def _frames_of(count: int) -> list[tuple[float, bytes]]:
    (layout,) = frames.load(ROOT / "deploy" / "frame.dbc", CHANNELS)
    samples = np.sin(np.arange(3.0 * count).reshape(count, 3))
    rows, _ = layout.encode(samples, np.arange(count))
    return [(1.7e9 + k / 1024, row.tobytes()) for k, row in enumerate(rows)]


def _can_seeds() -> list[bytes]:
    def raw(rows: Sequence[tuple[float, bytes]]) -> bytes:
        return b"".join(struct.pack("<BBId", 0, 8, 256, t) + data for t, data in rows)

    rows = _frames_of(80)
    return [raw(rows), raw(rows[:20] + rows[40:60]), raw([(math.nan, rows[0][1]), (-1e300, rows[1][1]), *rows[2:30]])]


def _socketcand(data: bytes) -> None:
    ours, theirs = socket.socketpair()
    bus = _unconnected(SocketcandBus, _SocketCanDaemonBus__socket=ours, _SocketCanDaemonBus__tcp_tune=False)
    with theirs:
        theirs.sendall(data[:60_000])
        theirs.shutdown(socket.SHUT_WR)
        _read_all(bus, "socketcand")


def _socketcand_seeds() -> list[bytes]:
    texts = [frame_text(256, False, t, data) for t, data in _frames_of(40)]
    return [b"".join(texts), b"< error 40 1.5 >" + b"".join(texts[:5]), b"< frame 100 1 >< frame zz 1 00 >" + texts[0]]


class _Datagrams:
    """What takes the place of a udp_multicast socket: datagrams that each begin with their length."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def recv(self, timeout: float | None = None) -> tuple[bytes, object, float] | None:
        size, self._data = int.from_bytes(self._data[:2], "big"), self._data[2:]
        one, self._data = self._data[:size], self._data[size:]
        return (one, None, 1.7e9) if size else None

    def shutdown(self) -> None:
        pass


def _udp_multicast(data: bytes) -> None:
    bus = _unconnected(UdpMulticastBus, _multicast=_Datagrams(data), _can_protocol=can.CanProtocol.CAN_FD)
    _read_all(bus, "udp_multicast")


def _udp_multicast_seeds() -> list[bytes]:
    def stream(messages: list[can.Message]) -> bytes:
        packed = [pack_message(message) for message in messages]
        return b"".join(len(one).to_bytes(2, "big") + one for one in packed)

    good = [can.Message(timestamp=t, arbitration_id=256, is_extended_id=False, data=row) for t, row in _frames_of(20)]
    off = can.Message(is_error_frame=True, arbitration_id=0x40, data=bytes(8))
    return [stream(good), stream([good[0], off, *good[1:]])]


def _can_log(data: bytes) -> None:
    text = placed("a.log", data)
    settings = CanSettings(
        interface="log", channel=str(text), dbc=str(ROOT / "deploy" / "frame.dbc"), sample_rate_hz=1024.0
    )
    source = CanSource(settings, SourceContext(CHANNELS, ROOT))
    with contextlib.suppress(SourceError, EndOfStream):
        source.open()
        while (got := source.read(0.0)) is not None:
            sound(got)
    source.close()


def _can_log_seeds() -> list[bytes]:
    return ["".join(f"({t:.6f}) can0 100#{data.hex().upper()}\n" for t, data in _frames_of(40)).encode()]


# --- files -------------------------------------------------------------------------------------------------------------


def _mcap(data: bytes) -> None:
    path = placed("a.mcap", data)
    with contextlib.suppress(RecordingError):
        for got in read_recordings([path]):
            sound(got)


def _ros2(data: bytes) -> None:
    with contextlib.suppress(RecordingError, UserError):
        for got in imu_topics(placed("ros2.mcap", data)):
            sound(got)


def _ros2_seeds() -> list[bytes]:
    stamps = {topic: [T0_NS + at + k * 10**7 for k in range(40)] for at, topic in enumerate(("/i1", "/i2"))}
    return [record(scratch() / "ros2-seed.mcap", stamps).read_bytes()]


def _crash_file(data: bytes) -> None:
    """What a crash of the recorder may have left."""
    folder = scratch() / "recordings"
    folder.mkdir(exist_ok=True)
    (folder / "20260101T000000.000000Z-0001.mcap.part").write_bytes(data)
    recover(folder)
    for _, got in recorded(folder, 0):
        assert got.samples.dtype == np.float32
    for left in folder.iterdir():
        left.unlink()


def _mcap_seeds() -> list[bytes]:
    path, made = scratch() / "seed.mcap", []
    for count in (1, 4):
        with McapWriter(path, as_arrived=True) as writer:
            for k in range(count):
                writer.write(block(k), T0_NS + k)
                writer.flush()
        made.append(path.read_bytes())
    return [*made, made[1][:-60], made[1][: len(made[1]) // 2]]


def _toml(data: bytes) -> None:
    path = placed("site.toml", data)
    with contextlib.suppress(UserError):
        settings = configuration.load(path)
        settings.model().modes()


def _toml_seeds() -> list[bytes]:
    names = ("site", "can", "zenoh", "mqtt", "mcap")
    return [STRUCTURE.encode(), *((ROOT / "deploy" / f"{name}.toml").read_bytes() for name in names)]


def _write_log(path: Path) -> None:
    with can.Logger(path) as writer:
        for t, row in _frames_of(40):
            writer(can.Message(timestamp=t, arbitration_id=256, is_extended_id=False, data=row, channel=1))


DBC = {"rate_hz": 1024.0, "dbc": ROOT / "deploy" / "frame.dbc"}


# --- state -------------------------------------------------------------------------------------------------------------


def _session() -> Session:
    return Session(_settings(), None, (), None, scratch())


@functools.cache
def _checkpoint_seeds() -> list[bytes]:
    session, made = _session(), []
    for k in range(3):
        made.append(hostile.checkpoint_body(session, T0_NS + k, k))
        session.push(block(k, 200))
    return made


def _baseline(data: bytes) -> None:
    path = placed("baseline.json", data)
    with contextlib.suppress(UserError):
        load_baseline(path, _settings().instrumented(), _settings().updating)


@functools.cache
def _baseline_seeds() -> list[bytes]:
    from monitor.model import simulate
    from monitor.runs import calibrate, cut_into_blocks

    settings = _settings()
    floors = simulate(settings.model(), duration_s=60.0, rate_hz=100.0, noise=0.03, seed=1).floors
    recording = scratch() / "healthy.mcap"
    with McapWriter(recording) as writer:
        for one in cut_into_blocks(ACCELERATION, floors, CHANNELS, 100.0, T0_NS, 1000):
            writer.write(one)
    save_baseline(calibrate.calibrate([recording], settings)[0], scratch() / "learned.json")
    return [(scratch() / "learned.json").read_bytes()]


def _finding(data: bytes) -> None:
    path = placed("finding.json", data)
    with contextlib.suppress(UserError):
        finding, settings = ledger.read_finding(path), _settings()
        for with_baseline in (False, True):
            ledger.extended_structure_text(path, finding, STRUCTURE, settings, with_baseline=with_baseline)


def _finding_seeds() -> list[bytes]:
    cause: dict[str, Any] = {"effect": "cubic_stiffness", "location": "story 2"}
    cause["parameters"] = {"k3_n_per_m3": {"value": 3.9e8, "std": 7e6}}
    whole = {"verdict": "named", "says": "x", "causes": [cause], "cause": cause, "since_calibration": True}
    return [json.dumps(whole).encode(), json.dumps({**whole, "model": {}}).encode()]


def _outbox_seeds() -> list[bytes]:
    place = Path(placed("outbox.jsonl", b""))
    hostile.write_outbox(place)
    return [place.read_bytes()]


# --- the pipeline ------------------------------------------------------------------------------------------------------


class _Stream:
    """One session for many inputs, as a daemon has; begun anew now and then."""

    def __init__(self) -> None:
        self.session, self._taken = _session(), 0

    def push(self, data: bytes) -> None:
        self._taken += 1
        if self._taken % 500 == 0:
            self.session = _session()
        topic = (ACCELERATION, TEMPERATURE, GROUND)[len(data) % 3]
        with contextlib.suppress(ValueError, BadInputError):
            got = codec.decode(data, topic)
            if unfit(got) is None:
                self.session.push(got)
        with contextlib.suppress(BadInputError):
            self.session.push(block(self._taken, 64))  # good ones still come


@functools.cache
def _stream() -> _Stream:
    return _Stream()


TARGETS: dict[str, Target] = {
    "protobuf": Target(_protobuf, _protobuf_seeds, 0.2),
    "cdr": Target(_cdr, _cdr_seeds, 0.13),
    "request": Target(lambda data: hostile.request(data, T0_NS), _request_seeds, 0.14),
    "can": Target(lambda data: _read_all(_Frames(data)), _can_seeds, 0.06, 4000),
    "socketcand": Target(_socketcand, _socketcand_seeds, 0.06, 4000),
    "udp_multicast": Target(_udp_multicast, _udp_multicast_seeds, 0.02, 8000),
    "can_log": Target(_can_log, _can_log_seeds, 0.02, 4000),
    "zenoh": Target(_zenoh, _zenoh_seeds, 0.08),
    "mqtt_json": Target(_mqtt_json, lambda: [mqtt.encode(block(k, 4), "json") for k in range(2)], 0.02),
    "request_file": Target(lambda data: hostile.request_file(scratch() / "requests", data), _request_seeds, 0.03),
    "mcap": Target(_mcap, _mcap_seeds, 0.05),
    "crash_file": Target(_crash_file, _mcap_seeds, 0.02),
    "toml": Target(_toml, _toml_seeds, 0.03),
    "ros2": Target(_ros2, _ros2_seeds, 0.02),
    **FILES,
    **{kind: imported_file(f".{kind}", written(f".{kind}", _write_log), **DBC) for kind in ("asc", "blf", "trc")},
    "checkpoint": Target(hostile.checkpoint, _checkpoint_seeds, 0.03),
    "baseline": Target(_baseline, _baseline_seeds, 0.02),
    "finding": Target(_finding, _finding_seeds, 0.02),
    "outbox": Target(lambda data: hostile.outbox(placed("outbox.jsonl", data)), _outbox_seeds, 0.02),
    "pipeline": Target(lambda data: _stream().push(data), _protobuf_seeds, 0.01),
}


def quiet() -> None:
    """Refusals are logged by the thousand; what is not made from the input need not be read again each time."""
    logging.disable(logging.CRITICAL)
    frames.load = functools.cache(frames.load)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
