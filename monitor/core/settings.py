"""Base of all settings: frozen, unknown keys refused, every problem reported."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Settings of one stage stand beside the stage; `monitor.config.configuration` reads them from TOML."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
