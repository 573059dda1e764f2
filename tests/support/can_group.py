"""CAN frames of three channels, and a source that hears them on loopback."""

from __future__ import annotations

import itertools
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

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


_names = itertools.count()


def source(folder: Path = DEPLOY, channels: tuple[str, ...] = CHANNELS, **table: object) -> CanSource:
    table = {
        "interface": "virtual",
        "channel": f"test{next(_names)}",
        "dbc": "frame.dbc",
        "sample_rate_hz": RATE,
    } | table
    return CanSource(CanSource.Settings.model_validate(table), SourceContext(channels, folder))


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
