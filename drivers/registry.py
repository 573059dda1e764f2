"""Kinds of sources by name; a driver is imported only when it is asked for."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

SOURCES = {
    "can": "drivers.can_bus:CanSource",
    "mcap": "drivers.mcap_source:McapSource",
    "zenoh": "drivers.zenoh_bus:ZenohSource",
}
"""Kind -> module and class (see `drivers.base.Source`)."""
GROUP = "shm_monitor.sources"
"""Entry point group through which other distributions add kinds."""


class UnknownSourceError(ValueError):
    """No driver has that name."""


def source_type(kind: str) -> Any:
    """The driver class of a kind.

    Raises
    ------
    UnknownSourceError
        The message lists the kinds there are.
    """
    if kind in SOURCES:
        module, _, name = SOURCES[kind].partition(":")
        return getattr(import_module(module), name)
    outside = {point.name: point for point in entry_points(group=GROUP)}
    if kind in outside:
        return outside[kind].load()
    raise UnknownSourceError(f"unknown kind {kind!r}; known: {', '.join(sorted([*SOURCES, *outside]))}")
