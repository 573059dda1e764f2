"""The shipped router configuration: who shows no certificate of ours stays out, and nobody does another's part."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from drivers import codec
from drivers.base import SourceContext, SourceError
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher, ZenohSettings, ZenohSource
from drivers.zenoh_session import SessionSettings, open_session
from monitor.service import ZenohOutSettings
from monitor.service.outlets.zenoh import ZenohOut
from tests.service.answering import Monitor
from tests.support.certificates import certify
from tests.support.numbered import CHANNELS, block, take
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port

pytestmark = pytest.mark.system

SITE = "shm/lab-frame"
DEPLOY = Path(__file__).parents[2] / "deploy"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("tls")
    ours, other = certify(place, "ca", "our authority", None), certify(place, "other", "another authority", None)
    for name in ("router", "sensor", "monitor", "viewer", "operator", "stranger"):
        certify(place, name, name, ours)
    certify(place, "forged", "sensor", other)
    return place


@pytest.fixture(scope="module")
def endpoint(folder: Path) -> Iterator[str]:
    """The shipped configuration with our port and certificates, else untouched."""
    place = f"tls/127.0.0.1:{free_port()}"
    tls = {
        "root_ca_certificate": f"{folder}/ca.pem",
        "listen_certificate": f"{folder}/router.pem",
        "listen_private_key": f"{folder}/router.key",
        "enable_mtls": True,
    }
    options = (f"listen/endpoints={json.dumps([place])}", f"transport/link/tls={json.dumps(tls)}")
    router = Router(str(DEPLOY / "zenoh-router.json5"), *options)
    yield place
    router.kill()


As = Callable[[str], dict[str, object]]


@pytest.fixture
def as_(endpoint: str) -> As:
    """Settings for one who shows this certificate."""

    def make(name: str) -> dict[str, object]:
        tls = {"root_ca": "ca.pem", "certificate": f"{name}.pem", "private_key": f"{name}.key"}
        return {"connect": (endpoint,), "tls": tls, "connect_timeout_s": 2.0}

    return make


@pytest.fixture
def join(as_: As, folder: Path) -> Iterator[Callable[[str], zenoh.Session]]:
    made: list[zenoh.Session] = []

    def make(name: str) -> zenoh.Session:
        made.append(open_session(SessionSettings.model_validate(as_(name)), folder))
        return made[-1]

    yield make
    for session in made:
        session.close()


@pytest.fixture
def source(as_: As, folder: Path) -> Iterator[ZenohSource]:
    settings = ZenohSettings.model_validate({"key": f"{SITE}/acceleration", **as_("monitor")})
    made = ZenohSource(settings, SourceContext(CHANNELS, folder))
    made.open()
    yield made
    made.close()


def test_the_sensor_is_heard_with_cache_and_token(source: ZenohSource, as_: As, folder: Path) -> None:
    settings = PublisherSettings.model_validate({"key": f"{SITE}/acceleration", **as_("sensor")})
    publisher = ZenohPublisher(settings, folder)
    for i in range(20):
        publisher.send(block(i))
    assert take(source, 20) == list(range(20))
    until(lambda: f"{SITE}/alive/sensor" in source.health().detail, "its token")
    source.close()
    source.open()  # asks the sensor's cache
    until(lambda: (source.read(0.05), source.health().counts["repeated"] == 20)[-1], "what the cache holds")
    publisher.close()


def test_one_of_another_authority_stays_out(as_: As, folder: Path) -> None:
    with pytest.raises(SourceError, match="Unable to connect"):
        open_session(SessionSettings.model_validate(as_("forged")), folder)


def test_a_missing_certificate_is_named(as_: As, folder: Path) -> None:
    with pytest.raises(SourceError, match=r"nobody\.pem: no such file"):
        open_session(SessionSettings.model_validate(as_("nobody")), folder)


@pytest.mark.parametrize("name", ["stranger", "viewer", "operator"])
def test_only_the_sensor_may_send_samples(source: ZenohSource, join: Callable[[str], zenoh.Session], name: str) -> None:
    spoofer, sensor = join(name), join("sensor")
    for _ in range(20):
        spoofer.put(f"{SITE}/acceleration", codec.encode(block(7)), congestion_control=zenoh.CongestionControl.BLOCK)
    _passed(spoofer)
    sensor.put(f"{SITE}/acceleration", codec.encode(block(0)))
    assert take(source, 1) == [0]
    assert source.read(0.2) is None


def test_the_sensor_may_not_speak_for_the_monitor(join: Callable[[str], zenoh.Session]) -> None:
    seen: list[str] = []
    viewer, sensor, monitor = join("viewer"), join("sensor"), join("monitor")
    subscriber = viewer.declare_subscriber(f"{SITE}/alarm", lambda sample: seen.append(sample.payload.to_string()))
    until(lambda: (monitor.put(f"{SITE}/alarm", "true"), time.sleep(0.05), seen)[-1], "the monitor's own alarm")
    sensor.put(f"{SITE}/alarm", "false")
    _passed(sensor)
    count = seen.count("true")
    until(lambda: (monitor.put(f"{SITE}/alarm", "true"), seen.count("true") > count)[-1], "an alarm after the spoof")
    assert "false" not in seen
    subscriber.undeclare()


def test_only_operators_may_acknowledge(join: Callable[[str], zenoh.Session], as_: As, folder: Path) -> None:
    out = ZenohOut("lab-frame", ZenohOutSettings.model_validate(as_("monitor")), folder)
    wish = json.dumps({"action": "acknowledge", "story": 1, "who": "Ann"})

    def ask(session: zenoh.Session, key: str, payload: str | None = None) -> list[str]:
        replies = session.get(f"{SITE}/{key}", payload=payload, timeout=5.0)
        return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]

    viewer, operator = join("viewer"), join("operator")
    for session in (viewer, operator):
        until(lambda session=session: ask(session, "state"), "both see the state")
    answers: list[str] = []
    with Monitor(out) as monitor:
        until(lambda: answers.extend(ask(operator, "ack", wish)) or answers, "the operator is answered")
        assert [json.loads(answer)["accepted"] for answer in answers] == [True]
        assert [request.who for request in monitor.applied] == ["Ann"]
        assert ask(viewer, "ack", wish) == []
        assert [request.who for request in monitor.applied] == ["Ann"]
    out.close()


def _passed(session: zenoh.Session) -> None:
    """Wait until the router has dealt with all that the session sent before."""
    for _ in session.get(f"{SITE}/state", timeout=5.0):
        pass
