"""Settings of the service's log."""

from __future__ import annotations

from typing import Literal

from monitor.core import Settings


class LogSettings(Settings):
    """``[log]`` of the site file."""

    format: Literal["text", "json"] = "text"
    """Format of a line: ``key=value`` pairs, or JSON."""
    level: Literal["debug", "info", "warning", "error"] = "warning"
    """Lowest level that is logged."""
