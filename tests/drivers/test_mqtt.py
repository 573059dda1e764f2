"""Sample blocks over MQTT: what the broker took is not lost, nothing is believed that is no block."""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.base import ACCELERATION, EndOfStream, SourceContext, SourceError
from drivers.mqtt import MqttSettings, MqttSource, decode
from monitor.config import configuration, security_check
from monitor.core import BadConfigurationError
from tests.support.brokers import OverMqtt
from tests.support.certificates import certify
from tests.support.mosquitto import Broker
from tests.support.numbered import CHANNELS, block, take
from tests.support.waiting import until

TOPIC = "shm/test-frame/acceleration"
broker_test = pytest.mark.system


@broker_test
def test_the_broker_keeps_what_an_absent_reader_has_not_taken(over_mqtt: OverMqtt) -> None:
    source, publisher = over_mqtt.source(), over_mqtt.publisher()
    for i in range(10):
        publisher.send(block(i))
    assert take(source, 5) == [0, 1, 2, 3, 4]
    source.close()  # what arrived together is acknowledged together: some that were read may come again, none is lost
    with pytest.raises(EndOfStream):
        source.read(0.0)
    for i in range(10, 100):
        publisher.send(block(i))
    publisher.close()
    over_mqtt.stop()
    over_mqtt.start()
    source.open()
    came = take(source, 95)
    while came[-1] < 99:
        came += take(source, 1)
    assert came == list(range(came[0], 100)) and came[0] <= 5
    assert source.health().counts["sessions_lost"] == 0


@broker_test
def test_an_unread_message_is_sent_again_and_of_those_read_no_more_than_were_under_way(over_mqtt: OverMqtt) -> None:
    """The broker's next message may cross the reader's leaving, which then takes the last acknowledgements with it."""
    source, publisher = over_mqtt.source(in_flight=4), over_mqtt.publisher()
    for i in range(12):
        publisher.send(block(i))
    assert take(source, 6) == list(range(6))
    publisher.close()
    source.close()
    other = over_mqtt.source()
    came = take(other, 6)
    while came[-1] < 11:
        came += take(other, 1)
    assert came == list(range(came[0], 12)) and 6 - 4 <= came[0] <= 6
    assert other.read(0.2) is None


@broker_test
def test_a_broker_that_sends_one_at_a_time_does_not_stop_at_a_gap(over_mqtt: OverMqtt) -> None:
    source, publisher = over_mqtt.source(in_flight=1), over_mqtt.publisher()
    for i in (0, 1, 3, 4, 5, 6, 7, 8):  # 2 never comes, and four wait for it
        publisher.send(block(i))
    publisher.close()
    assert take(source, 8) == [0, 1, 3, 4, 5, 6, 7, 8]
    assert source.health().counts["gaps"] == 1


@broker_test
def test_a_retained_message_of_the_past_is_not_taken_for_data(over_mqtt: OverMqtt) -> None:
    over_mqtt.put(over_mqtt.encode(block(0)), retain=True)
    assert over_mqtt.source().read(0.5) is None


@contextlib.contextmanager
def secured(folder: Path, **how: Any) -> Iterator[Callable[..., MqttSource]]:
    """A broker that lets not everybody in, and what makes a source of it."""
    broker = Broker(folder / "broker", **how)
    at = {"host": "127.0.0.1", "port": broker.port, "topic": TOPIC, "connect_timeout_s": 1.0}
    try:
        yield lambda **table: MqttSource(MqttSettings.model_validate(at | table), SourceContext(CHANNELS, folder))
    finally:
        broker.kill()


@broker_test
def test_user_and_password(tmp_path: Path) -> None:
    (tmp_path / "right").write_text("secret 1\n")
    (tmp_path / "wrong").write_text("guess\n")
    with secured(tmp_path, users={"monitor": "secret 1"}) as source:
        good = source(user="monitor", password_file="right")
        good.open()
        assert good.health().connected
        good.close()
        refused = source(user="monitor", password_file="wrong")
        with pytest.raises(SourceError, match=r"127\.0\.0\.1:\d+ refuses user 'monitor': Not authorized"):
            refused.open()
        assert not refused.health().connected
        assert "guess" not in repr(vars(refused)) + refused.health().detail
        with pytest.raises(ValueError, match="password_file: absent: no such file"):
            source(user="monitor", password_file="absent")
        (tmp_path / "right").write_bytes(b"\xff")
        with pytest.raises(SourceError, match=r"right: the password cannot be read: it is no text"):
            good.open()


@broker_test
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # paho leaves a refused connection unclosed
def test_only_a_broker_of_the_right_authority_is_trusted(tmp_path: Path) -> None:
    ours, _ = certify(tmp_path, "ca", "our authority", None), certify(tmp_path, "other", "another authority", None)
    for name in ("broker", "monitor"):
        certify(tmp_path, name, name, ours)
    files = [f"cafile {tmp_path}/ca.pem", f"certfile {tmp_path}/broker.pem", f"keyfile {tmp_path}/broker.key"]
    mine = {"certificate": "monitor.pem", "private_key": "monitor.key"}
    with secured(tmp_path, lines=[*files, "require_certificate true"]) as source:
        good = source(tls={"root_ca": "ca.pem", **mine})
        good.open()
        assert good.health().connected
        good.close()
        for wrong, says in (
            ({"root_ca": "other.pem", **mine}, "CERTIFICATE_VERIFY_FAILED"),
            ({"root_ca": "ca.pem"}, r"127\.0\.0\.1:\d+"),
            ({"root_ca": "absent.pem"}, r"absent\.pem: cannot be used for TLS"),
        ):
            with pytest.raises(SourceError, match=says):
                source(tls=wrong).open()


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
        settings = MqttSettings(host="127.0.0.1", port=port, topic=TOPIC, connect_timeout_s=0.2)
        source = MqttSource(settings, SourceContext(CHANNELS))
        with pytest.raises(SourceError, match=f"127.0.0.1:{port}"):
            source.open()
            while source.read(0.2) is None:
                pass
        source.close()
        thread.join()


@pytest.mark.parametrize(
    ("farewell", "says"),
    [
        (b"\xe0\x01\x8e", "another client came by the same client_id 'reader'; each needs its own"),
        (
            b"",
            "it ended without a reason, as where another client came by the same client_id 'reader' or the broker stopped",
        ),
    ],
)
def test_a_client_of_the_same_name_is_told_as_the_reason_of_a_lost_connection(farewell: bytes, says: str) -> None:
    """A broker says that the session is taken over, as MQTT 5 has it, or just ends the connection, as mosquitto 2.0.11."""
    opened = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with server.accept()[0] as peer:
                peer.recv(1000)
                peer.sendall(b"\x20\x03\x00\x00\x00")  # it accepts
                asked = peer.recv(1000)
                peer.sendall(b"\x90\x04" + asked[2:4] + b"\x00\x01")  # and takes the subscription
                opened.wait(10.0)
                peer.sendall(farewell)

        thread = threading.Thread(target=serve)
        thread.start()
        at = {"host": "127.0.0.1", "port": server.getsockname()[1], "topic": TOPIC, "client_id": "reader"}
        source = MqttSource(MqttSettings.model_validate(at), SourceContext(CHANNELS))
        source.open()
        opened.set()
        until(lambda: source.read(0.0) is None and not source.health().connected, "the loss is noticed")
        health = source.health()
        source.close()
        thread.join()
    assert health.counts["links_lost"] == 1
    for words in (health.detail, health.trouble):
        assert says in words


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
