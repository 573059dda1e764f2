"""Sample blocks over MQTT: what the broker took is not lost, nothing is believed that is no block."""

from __future__ import annotations

import json
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.base import ACCELERATION, TEMPERATURE, EndOfStream, SampleBlock, SourceContext, SourceError
from drivers.mqtt import MqttPublisher, MqttSettings, MqttSource, PublisherSettings, decode, encode
from drivers.mqtt_session import BrokerSettings, Connection
from monitor.config import configuration, security_check
from monitor.core import BadConfigurationError
from tests.support.certificates import certify
from tests.support.mosquitto import PATIENCE_S, Broker
from tests.support.numbered import CHANNELS, T0_NS, N, block
from tests.support.waiting import until

TOPIC = "shm/test-frame/acceleration"
broker_test = pytest.mark.system


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    made = Broker(tmp_path / "broker")
    yield made
    made.kill()


Make = Callable[..., MqttSource]


@pytest.fixture
def listen(broker: Broker) -> Iterator[Make]:
    """Makes an open source."""
    made: list[MqttSource] = []

    def make(**options: object) -> MqttSource:
        chosen = {"host": "127.0.0.1", "port": broker.port, "topic": TOPIC} | options
        source = MqttSource(MqttSettings.model_validate(chosen), SourceContext(CHANNELS))
        made.append(source)
        source.open()
        return source

    yield make
    for source in made:
        source.close()


@pytest.fixture
def node(broker: Broker) -> Callable[..., MqttPublisher]:
    def make(**options: object) -> MqttPublisher:
        chosen = {"host": "127.0.0.1", "port": broker.port, "topic": TOPIC} | options
        return MqttPublisher(PublisherSettings.model_validate(chosen))

    return make


def take(source: MqttSource, count: int) -> list[int]:
    """Numbers of the next blocks."""
    numbers: list[int] = []

    def more() -> bool:
        got = source.read(0.2)
        if got is not None:
            numbers.append(got.sequence // N)
        return len(numbers) >= count

    until(more, f"{count} blocks; there are {numbers}")
    return numbers


@broker_test
@pytest.mark.parametrize("form", ["protobuf", "json"])
def test_blocks_arrive_bit_for_bit_in_both_forms(form: str, listen: Make, node: Callable[..., MqttPublisher]) -> None:
    topics = {"/temperature": "shm/test-frame/temperature", "/wind": "shm/test-frame/wind"}
    source, publisher = listen(format=form, topics=topics), node(format=form, topics=topics)
    values = np.random.default_rng(1).normal(size=(N, 3)).astype(np.float32)
    values[3, 1] = np.nan
    sent = [
        replace(block(0), samples=values),
        SampleBlock(TEMPERATURE, T0_NS, 0, 1.0, ("t1",), "degC", np.full((1, 1), 20.0, np.float32)),
        SampleBlock("/wind", T0_NS, 0, 1.0, ("speed",), "m/s", np.full((1, 1), 3.5, np.float32)),
    ]
    for one in sent:
        publisher.send(one)
    publisher.close()
    for one in sent:
        got = source.read(PATIENCE_S)
        assert got is not None
        assert got.samples.tobytes() == one.samples.tobytes()
        assert replace(got, samples=one.samples) == replace(one, samples=one.samples) or (
            (got.topic, got.t_ns, got.sequence, got.sample_rate_hz, got.channels, got.unit)
            == (one.topic, one.t_ns, one.sequence, one.sample_rate_hz, one.channels, one.unit)
        )


@broker_test
def test_the_broker_keeps_what_an_absent_reader_has_not_taken(
    broker: Broker, listen: Make, node: Callable[..., MqttPublisher]
) -> None:
    source, publisher = listen(), node()
    for i in range(10):
        publisher.send(block(i))
    assert take(source, 5) == [0, 1, 2, 3, 4]
    source.close()  # whoever read block 4 may not have kept it yet: it comes again
    with pytest.raises(EndOfStream):
        source.read(0.0)
    for i in range(10, 100):
        publisher.send(block(i))
    publisher.close()
    broker.stop()
    broker.start()
    source.open()
    numbers = take(source, 95)
    assert numbers == list(range(5, 100))
    assert source.health().counts["sessions_lost"] == 0


@broker_test
def test_a_restart_of_the_broker_loses_nothing_that_it_acknowledged(
    broker: Broker, listen: Make, node: Callable[..., MqttPublisher]
) -> None:
    source, publisher = listen(), node()
    for i in range(50):
        publisher.send(block(i))
    assert take(source, 20) == list(range(20))
    broker.stop()
    until(lambda: not source.health().connected, "the loss is noticed")
    assert "lost" in source.health().detail or "no MQTT broker" in source.health().detail
    broker.start()
    for i in range(50, 90):
        publisher.send(block(i))
    publisher.close(PATIENCE_S)
    assert take(source, 70) == list(range(20, 90))
    until(lambda: source.health().connected, "it is back")
    counts = source.health().counts
    assert (counts["lost_samples"], counts["links_lost"], counts["sessions_lost"]) == (0, 1, 0)


@broker_test
def test_an_unread_message_is_sent_again_and_one_that_was_read_is_not(
    broker: Broker, listen: Make, node: Callable[..., MqttPublisher]
) -> None:
    source, publisher = listen(in_flight=4), node()
    for i in range(12):
        publisher.send(block(i))
    assert take(source, 6) == list(range(6))
    publisher.close()
    source.close()
    other = listen()
    assert take(other, 6) == list(range(6, 12))
    assert other.read(0.2) is None


@broker_test
def test_a_broker_that_sends_one_at_a_time_does_not_stop_at_a_gap(
    listen: Make, node: Callable[..., MqttPublisher]
) -> None:
    source, publisher = listen(in_flight=1), node()
    for i in (0, 1, 3, 4, 5, 6, 7, 8):  # 2 never comes, and four wait for it
        publisher.send(block(i))
    publisher.close()
    assert take(source, 8) == [0, 1, 3, 4, 5, 6, 7, 8]
    assert source.health().counts["gaps"] == 1


@broker_test
def test_hostile_messages_are_counted_and_the_stream_goes_on(
    broker: Broker, listen: Make, node: Callable[..., MqttPublisher]
) -> None:
    source = listen(max_payload_bytes=4096, max_channels=8)
    good = encode(block(0), "protobuf")
    bad = [
        b"",
        b"\xff" * 100,
        good[:-1],
        b"{}",
        encode(replace(block(0), sample_rate_hz=1e9), "protobuf"),
        encode(replace(block(0), unit="degC"), "protobuf"),
        encode(replace(block(0), channels=("a1", "a1", "a3")), "protobuf"),
        encode(replace(block(0), samples=np.empty((0, 3), np.float32)), "protobuf"),
    ]
    connection = Connection(BrokerSettings(host="127.0.0.1", port=broker.port), Path(), "somebody else")
    connection.open()
    for payload in (*bad, encode(block(0, 1000), "protobuf")):
        assert connection.wait_until_published(connection.publish(TOPIC, payload), PATIENCE_S)
    connection.close()
    publisher = node()
    for i in range(3):
        publisher.send(block(i))
    publisher.close()
    assert take(source, 3) == [0, 1, 2]
    counts = source.health().counts
    assert (counts["undecodable"], counts["oversized"]) == (len(bad), 1)
    assert source.read(0.2) is None
    source.close()
    again = listen()
    assert again.read(0.5) is None  # broken ones are acknowledged too
    assert again.health().counts["undecodable"] == 0


@broker_test
def test_a_retained_message_of_the_past_is_not_taken_for_data(broker: Broker, listen: Make) -> None:
    connection = Connection(BrokerSettings(host="127.0.0.1", port=broker.port), Path(), "somebody else")
    connection.open()
    identifier = connection.publish(TOPIC, encode(block(0), "protobuf"), retain=True)
    assert connection.wait_until_published(identifier, PATIENCE_S)
    connection.close()
    assert listen().read(0.5) is None


@broker_test
def test_user_and_password(tmp_path: Path) -> None:
    broker = Broker(tmp_path / "broker", users={"monitor": "secret 1"})
    try:
        (tmp_path / "right").write_text("secret 1\n")
        (tmp_path / "wrong").write_text("guess\n")
        table = {"host": "127.0.0.1", "port": broker.port, "topic": TOPIC, "user": "monitor"}

        def source(**more: object) -> MqttSource:
            return MqttSource(MqttSettings.model_validate(table | more), SourceContext(CHANNELS, tmp_path))

        good = source(password_file="right")
        good.open()
        assert good.health().connected
        good.close()
        refused = source(password_file="wrong")
        with pytest.raises(SourceError, match=rf"127\.0\.0\.1:{broker.port} refuses user 'monitor': Not authorized"):
            refused.open()
        assert not refused.health().connected
        with pytest.raises(ValueError, match="password_file: absent: no such file"):
            source(password_file="absent")
        (tmp_path / "right").write_bytes(b"\xff")
        with pytest.raises(SourceError, match=r"right: the password cannot be read: it is no text"):
            good.open()
        assert "guess" not in repr(refused._settings) + refused.health().detail
    finally:
        broker.kill()


@broker_test
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # paho leaves a refused connection unclosed
def test_only_a_broker_of_the_right_authority_is_trusted(tmp_path: Path) -> None:
    ours, _ = certify(tmp_path, "ca", "our authority", None), certify(tmp_path, "other", "another authority", None)
    for name in ("broker", "monitor"):
        certify(tmp_path, name, name, ours)
    files = [f"cafile {tmp_path}/ca.pem", f"certfile {tmp_path}/broker.pem", f"keyfile {tmp_path}/broker.key"]
    broker = Broker(tmp_path / "broker", lines=[*files, "require_certificate true"])
    try:

        def source(**tls: str) -> MqttSource:
            table = {"host": "127.0.0.1", "port": broker.port, "topic": TOPIC, "tls": tls}
            return MqttSource(MqttSettings.model_validate(table), SourceContext(CHANNELS, tmp_path))

        mine = {"certificate": "monitor.pem", "private_key": "monitor.key"}
        good = source(root_ca="ca.pem", **mine)
        good.open()
        assert good.health().connected
        good.close()
        for wrong, says in (
            ({"root_ca": "other.pem", **mine}, "CERTIFICATE_VERIFY_FAILED"),
            ({"root_ca": "ca.pem"}, rf"127\.0\.0\.1:{broker.port}"),
            ({"root_ca": "absent.pem"}, r"absent\.pem: cannot be used for TLS"),
        ):
            with pytest.raises(SourceError, match=says):
                source(**wrong).open()
    finally:
        broker.kill()


def test_no_broker_is_an_error_that_names_it(unused_tcp_port: int) -> None:
    settings = MqttSettings(host="127.0.0.1", port=unused_tcp_port, topic=TOPIC, connect_timeout_s=1.0)
    source = MqttSource(settings, SourceContext(CHANNELS))
    with pytest.raises(SourceError, match=f"no MQTT broker at 127.0.0.1:{unused_tcp_port}"):
        source.open()
    source.close()


@pytest.fixture
def unused_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize(
    "answer", [b"\x20\x03\x00\x00\x00\x30\x03\x00\xff\xff", b"HTTP/1.1 400 Bad Request\r\n\r\n", b""]
)
def test_what_speaks_no_mqtt_is_an_error_and_no_traceback(answer: bytes) -> None:
    """The first says that it accepts, and sends a publication whose topic is longer than the packet."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with server.accept()[0] as peer:
                peer.recv(1000)
                peer.sendall(answer)
                peer.settimeout(10.0)
                try:
                    peer.recv(1000)
                except OSError:
                    return

        thread = threading.Thread(target=serve)
        thread.start()
        port = server.getsockname()[1]
        settings = MqttSettings(host="127.0.0.1", port=port, topic=TOPIC, connect_timeout_s=0.5)
        source = MqttSource(settings, SourceContext(CHANNELS))
        with pytest.raises(SourceError, match=f"127.0.0.1:{port}"):
            source.open()
            while source.read(0.5) is None:
                pass
        source.close()
        thread.join()


GOOD = {"t_ns": 5, "sequence": 0, "sample_rate_hz": 100, "channels": ["a1"], "unit": "m/s^2", "samples": [[1], [2.5]]}


@pytest.mark.parametrize(
    "wrong",
    [
        {"t_ns": "now"},
        {"t_ns": 5.5},
        {"sequence": -1},
        {"sample_rate_hz": 0},
        {"channels": "a1"},
        {"samples": [[1, 2]]},
        {"samples": [1, 2]},
        {"samples": [["1"]]},
        {"samples": [[True]]},
        {"unit": "V"},
        {"unit": None},
    ],
)
def test_json_that_is_no_block_is_refused(wrong: dict[str, object]) -> None:
    assert decode(json.dumps(GOOD).encode(), ACCELERATION, "json").samples.tolist() == [[1.0], [2.5]]
    with pytest.raises(ValueError, match=r"Message|must|row|unit"):
        decode(json.dumps(GOOD | wrong).encode(), ACCELERATION, "json")


@pytest.mark.parametrize("text", [b"", b"[", b"[" * 100_000, b'{"t_ns": 1}', b"\xff", b'{"samples": [[NaN]]}'])
def test_what_is_no_json_is_refused(text: bytes) -> None:
    with pytest.raises(ValueError, match="Message"):
        decode(text, ACCELERATION, "json")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"topic": "shm/#"}, "topic"),
        ({"topic": "$SYS/x"}, "topic"),
        ({"format": "xml"}, "format"),
        ({"password_file": "p"}, "needs `user`"),
        ({"tls": {"certificate": "c.pem"}}, "go together"),
        ({"in_flight": 1000}, "in_flight"),
        ({"password": "p"}, "password"),
    ],
)
def test_bad_settings_are_refused(wrong: dict[str, object], says: str) -> None:
    good = {"kind": "mqtt", "host": "gateway", "topic": TOPIC}
    assert MqttSettings.model_validate(good | {"tls": True}).where == "gateway:8883"
    with pytest.raises(ValidationError, match=says):
        MqttSettings.model_validate(good | wrong)


def test_without_the_library_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    for name in ("drivers.mqtt", "drivers.mqtt_session"):
        monkeypatch.delitem(sys.modules, name)
    path = Path(__file__).parents[2] / "deploy" / "mqtt.toml"
    with pytest.raises(BadConfigurationError, match=r"^[^\n]*needs the extra mqtt: pip install 'shm-monitor\[mqtt\]'$"):
        configuration.load(path)


def test_check_warns_of_a_password_that_all_may_read_and_of_a_broker_without_tls(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "deploy" / "mqtt.toml").read_text()
    path = tmp_path / "site.toml"
    (tmp_path / "mqtt.password").write_text("x")
    (tmp_path / "mqtt.password").chmod(0o644)

    path.write_text(
        text.replace('host = "127.0.0.1"', 'host = "gateway"\nuser = "m"\npassword_file = "mqtt.password"', 1)
    )
    found = security_check.warnings(path, configuration.load(path))
    assert [line.partition(":")[0] for line in found] == ["source.host", "source.password_file"]
    (tmp_path / "mqtt.password").chmod(0o600)
    path.write_text(path.read_text().replace('kind = "mqtt"', 'kind = "mqtt"\ntls = true'))
    assert security_check.warnings(path, configuration.load(path)) == []


def test_the_example_site_file_is_sound() -> None:
    found = configuration.load(Path(__file__).parents[2] / "deploy" / "mqtt.toml")
    assert found.channels == CHANNELS
