"""Settings of the recorder, apart from it: reading them must not load the recording's format."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class RecorderSettings(BaseModel):
    """``[recorder]`` of the site file."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    enabled: bool = True
    file_mb: float = Field(default=64.0, gt=0)
    """A new file is begun when one has this size, in MiB."""
    file_s: float = Field(default=3600.0, gt=0)
    """... or this length of data."""
    keep_gb: float = Field(default=20.0, gt=0)
    """Most disk space for recordings, in GiB; then the oldest go."""
    min_free_gb: float = Field(default=0.2, ge=0)
    """Recording pauses while the disk has less free space, in GiB; nothing is removed for it."""
    flush_s: float = Field(default=10.0, gt=0)
    """Data that a power cut may cost."""
