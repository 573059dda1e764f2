"""``[state]`` of the site file."""

from __future__ import annotations

from pydantic import Field

from monitor.core import Settings


class StateSettings(Settings):
    """What outlasts a restart, and for how long."""

    checkpoint_s: float = Field(default=60.0, ge=0)
    """A checkpoint is written this often, in data time; 0: none, and every start begins anew but for the alarms."""
    history: bool = True
    """Keep `history.db`."""
    windows_days: float = Field(default=365.0, gt=0)
    """Every window is kept this long; of older ones those that announce something, and one in sixty."""
    health_days: float = Field(default=30.0, gt=0)
    """Every health span is kept this long; of older ones those with a gap, and one in sixty."""
    keep_days: float = Field(default=3650.0, gt=0)
    """Nothing of windows and spans is kept longer; alarms, acknowledgements and findings are kept for ever."""
