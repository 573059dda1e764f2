"""Base of the tables of a site file that the drivers read, and the recorder's: reading it must not load the MCAP libraries."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Settings(BaseModel):
    """Table of a site file: frozen, of known keys and finite numbers alone."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class RecorderSettings(Settings):
    """Table ``[recorder]`` of the site file."""

    enabled: bool = True
    file_mb: float = Field(default=64.0, gt=0)
    """Size at which a new file is begun, in MiB."""
    file_s: float = Field(default=3600.0, gt=0)
    """Length of data at which a new file is begun."""
    keep_gb: float = Field(default=20.0, gt=0)
    """Greatest disk space of all recordings, in GiB; beyond it the oldest files are removed."""
    min_free_gb: float = Field(default=0.2, ge=0)
    """Free disk space below which recording pauses, in GiB, until a file of `file_mb` fits too; no file is removed for it."""
    flush_s: float = Field(default=10.0, gt=0)
    """Length of data that a power cut may lose, or the data of a second of the clock where that is more, as at high speed;
    of strong motion, which is written at once, less."""
