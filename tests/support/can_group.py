"""CAN frames of three channels, and a source that hears them on loopback."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import can
import msgpack
import numpy as np
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from drivers import frames
from drivers.base import SourceContext, SourceError
from drivers.can_bus import CanSource

DEPLOY = Path(__file__).parents[2] / "deploy"
CHANNELS = ("a1", "a2", "a3")
T0 = 1_767_225_600.0
RATE = 1024.0


def source(
    folder: Path = DEPLOY, channels: tuple[str, ...] = CHANNELS, bus: SilentBus | None = None, **table: object
) -> CanSource:
    """A source of the shipped layout; with a `bus` it hears that one, and has its time."""
    table = {"interface": "virtual", "channel": "nobody's", "dbc": "frame.dbc", "sample_rate_hz": RATE} | table
    more: dict[str, Any] = {} if bus is None else {"clock": bus.clock, "connect": lambda *_: bus}
    return CanSource(CanSource.Settings.model_validate(table), SourceContext(channels, folder), **more)


class SilentBus:
    """A bus that gives what it is told to, and fails as it is told to; in its silence nothing passes but its own time."""

    state = can.BusState.ACTIVE

    def __init__(self, items: Iterable[can.Message | Exception] = ()) -> None:
        self.items, self.now_s = deque(items), 0.0

    def clock(self) -> float:
        return self.now_s

    def recv(self, timeout: float) -> can.Message | None:
        if not self.items:
            self.now_s += timeout
            return None
        item = self.items.popleft()
        if isinstance(item, Exception):
            raise item
        return item

    def shutdown(self) -> None: ...


def accel(sequence: np.ndarray, values: np.ndarray | None = None, t0: float = T0) -> list[can.Message]:
    """Frames of the shipped layout."""
    (layout,) = frames.load(DEPLOY / "frame.dbc", CHANNELS)
    data, _ = layout.encode(row_values(sequence) if values is None else values, sequence % 65536)
    return [
        can.Message(timestamp=t0 + k / RATE, arbitration_id=256, is_extended_id=False, data=row.tobytes())
        for k, row in zip(sequence.tolist(), data, strict=True)
    ]


def row_values(sequence: np.ndarray) -> np.ndarray:
    """Samples that tell their number."""
    return np.column_stack([sequence % 1000, sequence // 1000 % 1000, -(sequence % 777)]) * 0.001


@pytest.fixture
def group() -> Iterator[tuple[CanSource, Callable[[bytes], object]]]:
    """A source on udp_multicast, and what sends it a datagram over loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    reader = source(interface="udp_multicast", channel="239.74.163.2", options={"port": port})
    try:
        reader.open()
    except SourceError as error:
        pytest.skip(f"no multicast here: {error}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        yield reader, lambda data: sender.sendto(data, ("127.0.0.1", port))
    reader.close()


def datagram(message: can.Message, **forged: object) -> bytes:
    """A frame as udp_multicast sends it, with forged fields."""
    fields = msgpack.unpackb(pack_message(message)) | forged
    return bytes(msgpack.packb(fields))
