"""Registry of source kinds; a driver is imported only when its kind is requested."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

SOURCES = {
    "can": "drivers.can_bus:CanSource",
    "mcap": "drivers.mcap_source:McapSource",
    "mqtt": "drivers.mqtt:MqttSource",
    "zenoh": "drivers.zenoh_bus:ZenohSource",
}
"""Kind -> module and class (see `drivers.base.Source`)."""
GROUP = "shm_monitor.sources"
"""Entry point group through which other distributions add kinds."""


class UnknownSourceError(ValueError):
    """No driver has this source kind."""


def source_type(kind: str) -> Any:
    """Import the driver class of a source kind; raises `UnknownSourceError`, which lists the known kinds."""
    if kind in SOURCES:
        module, _, name = SOURCES[kind].partition(":")
        return getattr(import_module(module), name)
    outside = {point.name: point for point in entry_points(group=GROUP)}
    if kind in outside:
        return outside[kind].load()
    raise UnknownSourceError(f"unknown kind {kind!r}; known: {', '.join(sorted([*SOURCES, *outside]))}")
