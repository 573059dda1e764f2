"""Recordings of ROS 2 Imu topics, as rmw writes them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from mcap.writer import Writer


def imu(t_ns: int, xyz: tuple[float, float, float], frame: bytes = b"imu", order: str = "<") -> bytes:
    """One message as rmw writes it, padding counted from behind the four-byte header."""
    head = struct.pack(order + "iII", *divmod(t_ns, 10**9), len(frame) + 1) + frame + b"\0"
    head += bytes(-len(head) % 8)
    doubles = [float(-at) for at in range(37)]
    doubles[25:28] = xyz
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + head + struct.pack(order + "37d", *doubles)


def record(path: Path, stamps: dict[str, list[int]], value: Callable[[str, int], float] = lambda *_: 0.0) -> Path:
    """Topics written one after the other, so that the file's order is not time's."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=20_000)
        writer.start("ros2")
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"")
        for topic, times in stamps.items():
            channel = writer.register_channel(topic, "cdr", schema)
            for t_ns in times:
                writer.add_message(channel, t_ns + 1000, imu(t_ns, (value(topic, t_ns), 1.0, 2.0)), t_ns)
        writer.finish()
    return path
