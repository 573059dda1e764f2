"""A Zenoh router for all tests of this folder, and what talks over it or over an MQTT broker."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.brokers import OverMqtt, OverZenoh
from tests.support.mosquitto import Broker
from tests.support.zenoh_router import Router, free_port


@pytest.fixture(scope="session")
def endpoint() -> Iterator[str]:
    """Where a router listens."""
    made = f"tcp/127.0.0.1:{free_port()}"
    router = Router(made)
    yield made
    router.kill()


@pytest.fixture
def over_zenoh(endpoint: str) -> Iterator[OverZenoh]:
    made = OverZenoh(endpoint)
    yield made
    made.close()


@pytest.fixture
def over_mqtt(tmp_path: Path) -> Iterator[OverMqtt]:
    made = OverMqtt(Broker(tmp_path / "broker"))
    yield made
    made.close()
