"""Sample blocks over a Zenoh router or an MQTT broker: bit for bit, nothing lost, nothing believed that is no block."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.base import TEMPERATURE, SampleBlock, SourceContext, SourceError
from drivers.mqtt import MqttSettings, MqttSource
from drivers.zenoh_bus import ZenohSettings, ZenohSource
from monitor.config import configuration
from tests.support.any_block import same
from tests.support.brokers import OverMqtt, OverZenoh
from tests.support.mosquitto import PATIENCE_S, Broker
from tests.support.numbered import CHANNELS, T0_NS, N, block, take
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port

MQTT, JSON = (pytest.param(form, marks=pytest.mark.system) for form in ("protobuf", "json"))


@pytest.fixture
def bus(request: pytest.FixtureRequest, endpoint: str, tmp_path: Path) -> Iterator[OverZenoh | OverMqtt]:
    is_zenoh = request.param == "zenoh"
    made = OverZenoh(endpoint) if is_zenoh else OverMqtt(Broker(tmp_path / "broker"), request.param)
    yield made
    made.close()


@pytest.fixture
def bus_alone(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[OverZenoh | OverMqtt]:
    """With a router or broker that no other test uses, stopped."""
    place, is_zenoh = f"tcp/127.0.0.1:{free_port()}", request.param == "zenoh"
    made = OverZenoh(place, Router(place)) if is_zenoh else OverMqtt(Broker(tmp_path / "broker"))
    made.stop()
    yield made
    made.close()
    made.stop()


def assert_same(got: SampleBlock | None, sent: SampleBlock) -> None:
    assert got is not None and same(got, sent) and got.samples.tobytes() == sent.samples.tobytes()


@pytest.mark.parametrize("bus", ["zenoh", MQTT, JSON], indirect=True)
def test_blocks_of_our_publishers_and_of_others_are_heard_bit_for_bit(bus: OverZenoh | OverMqtt) -> None:
    """Accelerations of a stranger, then ours, then other quantities by their own keys."""
    values = np.random.default_rng(1).normal(size=(N, 3)).astype(np.float32)
    values[3, 1] = np.nan
    source = bus.source(**bus.with_others)
    bus.put(bus.encode(replace(block(0), samples=values)))
    assert_same(source.read(PATIENCE_S), replace(block(0), samples=values))
    publisher = bus.publisher(**bus.with_others)
    for i in range(1, 100):
        publisher.send(block(i))
    assert take(source, 99) == list(range(1, 100))
    assert source.health().counts["samples"] == 100 * N
    others = [SampleBlock(TEMPERATURE, T0_NS, 0, 1.0, ("t1",), "degC", np.full((1, 1), 20.0, np.float32))]
    if isinstance(bus, OverMqtt):
        others.append(SampleBlock("/wind", T0_NS, 0, 1.0, ("speed",), "m/s", np.full((1, 1), 3.5, np.float32)))
    for one in others:
        publisher.send(one)
        assert_same(source.read(PATIENCE_S), one)
    publisher.close()


def brings_nothing(bus: OverMqtt) -> bool:
    """Whether nothing that was sent comes again; what comes is acknowledged."""
    source = bus.source()
    block = source.read(0.3)
    while source.read(0.3) is not None:
        pass
    undecodable = source.health().counts["undecodable"]
    source.close()
    return block is None and undecodable == 0


@pytest.mark.parametrize("bus", ["zenoh", MQTT], indirect=True)
def test_hostile_payloads_are_counted_and_the_stream_goes_on(bus: OverZenoh | OverMqtt) -> None:
    source, good = bus.source(max_payload_bytes=4096, max_channels=8), bus.encode(block(0))
    rates = (float("nan"), float("inf"), -float("inf"), 0.0, -5.0, 1e-320, 1e300, 1e9)
    bad = [
        b"",
        b"\xff" * 100,
        b"{}",
        good[:-1],
        good[:2] + b"\xff\xff\xff\xff\x07" + good[3:],
        *(good.replace(struct.pack("<d", block(0).sample_rate_hz), struct.pack("<d", rate)) for rate in rates),
        bus.encode(replace(block(0), sequence=2**63)),
        bus.encode(replace(block(0), t_ns=-1)),
        bus.encode(replace(block(0), unit="degC")),
        bus.encode(replace(block(0), channels=("a1", "a1", "a3"))),
        bus.encode(replace(block(0), samples=np.empty((0, 3), np.float32))),
        bus.encode(replace(block(0), channels=tuple("abcdefghi"), samples=np.zeros((4, 9), np.float32))),
    ]
    for payload in [*bad, bus.encode(block(0, 1000)), *(bus.encode(block(i)) for i in range(3))]:
        bus.put(payload)
    assert take(source, 3) == [0, 1, 2]
    counts = source.health().counts
    assert (counts["undecodable"], counts["oversized"]) == (len(bad), 1)
    assert source.read(0.05) is None
    if isinstance(bus, OverMqtt):  # broken ones are acknowledged too
        source.close()
        # A broker that is told of the next connection first forgets what it has not read from the last one.
        assert any(brings_nothing(bus) for _ in range(3))


@pytest.mark.parametrize("bus_alone", ["zenoh", MQTT], indirect=True)
def test_a_restart_loses_nothing_and_a_source_that_found_nobody_may_try_again(bus_alone: OverZenoh | OverMqtt) -> None:
    bus = bus_alone
    with pytest.raises(SourceError, match=bus.place):
        bus.source(connect_timeout_s=0.2)
    bus.start()
    source, publisher = bus.source(), bus.publisher()
    for i in range(20):
        publisher.send(block(i))
    assert take(source, 10) == list(range(10))
    bus.stop()
    until(lambda: not source.health().connected, "the loss is noticed")
    assert any(words in source.health().detail for words in ("no router", "lost", "no MQTT broker"))
    for i in range(20, 60):
        publisher.send(block(i))
    bus.start()
    until(lambda: source.health().connected, "the source is back")
    for i in range(60, 90):
        publisher.send(block(i))
    assert take(source, 80) == list(range(10, 90))
    counts = source.health().counts
    assert (counts["lost_samples"], counts["links_lost"], counts.get("sessions_lost", 0)) == (0, 1, 0)
    publisher.close(PATIENCE_S)


def test_nobody_there_is_an_error_that_names_the_place() -> None:
    port = free_port()
    over_zenoh = ZenohSettings(key="a/b", connect=(f"tcp/127.0.0.1:{port}",), connect_timeout_s=0.2)
    over_mqtt = MqttSettings(host="127.0.0.1", port=port, topic="a/b", connect_timeout_s=0.2)
    context = SourceContext(CHANNELS)
    for source, says in (
        (ZenohSource(over_zenoh, context), f"tcp/127.0.0.1:{port}"),
        (MqttSource(over_mqtt, context), f"no MQTT broker at 127.0.0.1:{port}"),
    ):
        with pytest.raises(SourceError, match=says):
            source.open()
        source.close()


GOOD: dict[type, dict[str, Any]] = {
    ZenohSettings: {"kind": "zenoh", "key": "shm/a/b", "mode": "client", "connect": ["tcp/127.0.0.1:7447"]},
    MqttSettings: {"kind": "mqtt", "host": "gateway", "topic": "shm/a/b"},
}


@pytest.mark.parametrize(
    ("kind", "wrong", "says"),
    [
        (ZenohSettings, {"key": "shm/**"}, "key"),
        (ZenohSettings, {"key": "shm/x/@alive"}, "key"),
        (ZenohSettings, {"connect": ()}, "client needs"),
        (ZenohSettings, {"mode": "peer", "connect": ()}, "nothing could ever arrive"),
        (ZenohSettings, {"connect": ("tls/gateway:7447",)}, "tls"),
        (ZenohSettings, {"connect": ("gateway:7447",)}, "connect"),
        (ZenohSettings, {"multicast": True}, "multicast"),
        (MqttSettings, {"topic": "shm/#"}, "topic"),
        (MqttSettings, {"topic": "$SYS/x"}, "topic"),
        (MqttSettings, {"format": "xml"}, "format"),
        (MqttSettings, {"password_file": "p"}, "needs `user`"),
        (MqttSettings, {"tls": {"certificate": "c.pem"}}, "go together"),
        (MqttSettings, {"in_flight": 1000}, "in_flight"),
        (MqttSettings, {"password": "p"}, "password"),
        (MqttSettings, {"host": "mqtt://gateway"}, "name or an address alone"),
        (MqttSettings, {"host": "u:p@gateway"}, "name or an address alone"),
        (MqttSettings, {"host": "gateway:1883"}, "name or an address alone"),
    ],
)
def test_bad_settings_are_refused(kind: Any, wrong: dict[str, object], says: str) -> None:
    kind.model_validate(GOOD[kind])
    with pytest.raises(ValidationError, match=says):
        kind.model_validate(GOOD[kind] | wrong)


@pytest.mark.parametrize("name", ["zenoh", "mqtt"])
def test_the_example_site_file_is_sound(name: str) -> None:
    assert configuration.load(Path(__file__).parents[2] / "deploy" / f"{name}.toml").channels == CHANNELS
