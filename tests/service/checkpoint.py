"""A value as a daemon finds it after a restart."""

from __future__ import annotations

from typing import TypeVar

from monitor.service.serialization import from_bytes, to_bytes

T = TypeVar("T")


def restored(value: T) -> T:
    """The value, written to a checkpoint and read from it."""
    return from_bytes(to_bytes("k", value), "k", type(value))
