"""Settings of the service alone: its log, and what it keeps over a restart."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from monitor.core import Settings


class LogSettings(Settings):
    """``[log]`` of the site file."""

    format: Literal["text", "json"] = "text"
    """Format of a line: ``key=value`` pairs, or JSON."""
    level: Literal["debug", "info", "warning", "error"] = "warning"
    """Lowest level that is logged."""


class StateSettings(Settings):
    """``[state]`` of the site file: what is kept over a restart, and for how long."""

    checkpoint_s: float = Field(default=60.0, ge=0)
    """Interval between checkpoints, in data time. 0: no checkpoints, so that only the alarms are kept over a restart."""
    history: bool = True
    """Write the results into the database `history.db`."""
    windows_days: float = Field(default=365.0, gt=0)
    """Age up to which every window is kept; of older windows those with an alarm level other than normal, and one in sixty."""
    health_days: float = Field(default=30.0, gt=0)
    """Age up to which every health span is kept; of older spans those with a gap or missing samples, and one in sixty."""
    keep_days: float = Field(default=3650.0, gt=0)
    """Age from which windows and health spans are removed; alarms, acknowledgements and findings are kept for ever."""
