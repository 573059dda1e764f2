"""``[log]`` of the site file."""

from __future__ import annotations

from typing import Literal

from monitor.core import Settings


class LogSettings(Settings):
    """``[log]`` of the site file."""

    format: Literal["text", "json"] = "text"
    """``key=value`` pairs, or JSON."""
    level: Literal["debug", "info", "warning", "error"] = "warning"
