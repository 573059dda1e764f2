"""What the monitor says over MQTT: all of it arrives, late comers see the latest, none of it holds the monitor up."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.mqtt_session import BrokerSettings, Connection, Message
from monitor.core import Gap, Level
from monitor.damage import Assessment, State
from monitor.service.outlets.mqtt import MqttOut, MqttOutSettings
from tests.support.mosquitto import Broker
from tests.support.results import T0_NS, window
from tests.support.waiting import until

pytestmark = pytest.mark.system
SITE = "shm/tower-1"
NAMES = ("results", "alarm", "state", "health", "gap", "finding", "event", "alive")


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    made = Broker(tmp_path / "broker")
    yield made
    made.kill()


class Person:
    """Someone who reads everything, what is retained too."""

    def __init__(self, broker: Broker, name: str) -> None:
        self.seen: list[tuple[str, str, bool]] = []
        settings = BrokerSettings(host="127.0.0.1", port=broker.port)
        self._connection = Connection(
            settings,
            Path(),
            name,
            subscriptions=tuple(f"{SITE}/{name}" for name in NAMES),
            on_message=self._on_message,
            retained=True,
            session_s=3600,
        )
        self._connection.open()

    def _on_message(self, message: Message) -> None:
        self.seen.append((message.topic.rpartition("/")[2], message.payload.decode(), message.retain))
        self._connection.acknowledge(message.mid)

    def of(self, name: str) -> list[str]:
        return [text for topic, text, _ in self.seen if topic == name]

    def close(self) -> None:
        self._connection.close()


def test_results_as_in_the_file_alarms_when_they_change_and_the_latest_for_those_who_come_later(broker: Broker) -> None:
    person = Person(broker, "person")
    out = MqttOut("tower 1", MqttOutSettings(host="127.0.0.1", port=broker.port))
    windows = [window(k, Level(level)) for k, level in enumerate(["normal", "normal", "warning", "warning", "normal"])]
    for result, line in windows:
        out.window(result, line)
    out.gap(Gap(T0_NS, 0.125, "128 samples missing"))
    out.health_line({"connected": True, "counts": {"lost_samples": 128}})
    lost = Assessment(State.ALARM, "Story 2 lost 12 %.", ("A doubt.",))
    out.state(lost)
    out.close()
    until(lambda: person.of("alive") == ["true", "false"], f"everything; there is {person.seen}")
    assert person.of("results") == [line for _, line in windows]
    assert [json.loads(text)["level"] for text in person.of("alarm")] == ["normal", "warning", "normal"]
    assert [json.loads(text)["duration_s"] for text in person.of("gap")] == [0.125]
    late = Person(broker, "late")
    until(lambda: len(late.seen) == 4, f"what is retained; there is {late.seen}")
    assert json.loads(late.of("state")[0]) == lost.content
    assert json.loads(late.of("health")[0])["connected"] and late.of("alive") == ["false"]
    for one in (person, late):
        one.close()


def test_nothing_waits_for_a_broker_that_is_not_there_and_it_is_joined_when_it_comes(broker: Broker) -> None:
    broker.stop()
    out = MqttOut("tower 1", MqttOutSettings(host="127.0.0.1", port=broker.port), queue_size=8)
    try:
        until(lambda: out.failed is not None, "the failure shows")
        for k in range(20):
            out.window(*window(k))
        assert out.dropped == 13  # 20 windows and one alarm, 8 of them kept
        broker.start()
        person = Person(broker, "person")
        until(lambda: len(person.of("results")) == 8, "what was kept")
        assert out.failed is None
        broker.stop()
        until(lambda: out.failed is not None, "the loss shows")
        out.window(*window(30))
        broker.start()
        until(lambda: window(30)[1] in person.of("results"), "what was said meanwhile")
        person.close()
    finally:
        out.close()


def test_a_monitor_that_dies_is_told_by_the_broker(broker: Broker) -> None:
    person = Person(broker, "person")
    program = (
        "import time; from monitor.service.outlets.mqtt import MqttOut, MqttOutSettings\n"
        f"out = MqttOut('tower 1', MqttOutSettings(host='127.0.0.1', port={broker.port})); time.sleep(60.0)"
    )
    with subprocess.Popen([sys.executable, "-c", program]) as monitor:
        until(lambda: person.of("alive") == ["true"], "it is there")
        monitor.kill()
    until(lambda: person.of("alive") == ["true", "false"], "its end")
    person.close()
