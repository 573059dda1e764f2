"""Settings of the recognition of events, and the site's own limits."""

from __future__ import annotations

from pydantic import Field, model_validator

from monitor.core import Settings


class LimitTable(Settings):
    """``[[events.limits]]``: one limit of the site's engineer, with the engineer's words for what to do beyond it."""

    drift_ratio: float | None = Field(default=None, gt=0)
    """Peak drift of a story over its height beyond which the limit is exceeded; needs `story_heights_m`."""
    residual_loss: float | None = Field(default=None, gt=0, lt=1)
    """Lasting loss of a story's stiffness, by ambient motion before and after, beyond which the limit is exceeded."""
    says: str = Field(min_length=1, max_length=200)
    """What is told when the limit is exceeded, as ``"inspect the joints of this story"``."""

    @model_validator(mode="after")
    def _one_quantity(self) -> LimitTable:
        """Refuse a limit of nothing, or of two quantities."""
        if (self.drift_ratio is None) == (self.residual_loss is None):
            raise ValueError("a limit states either drift_ratio or residual_loss")
        return self


class EventSettings(Settings):
    """``[events]``: recognition of strong motion of the whole structure, and what is told of it."""

    enabled: bool = True
    """Recognize events."""
    skip_windows: bool = True
    """Judge no window that holds an event: it is skipped, by name."""
    ratio_on: float = Field(default=4.0, gt=1)
    """Amplitude over that of the long-term average from which motion is an event."""
    ratio_off: float = Field(default=2.0, gt=1)
    """Amplitude over that of the long-term average below which an event ends."""
    level_m_s2: float | None = Field(default=None, gt=0)
    """Peak acceleration of more than half of the floors from which motion is an event, whatever the ambient motion."""
    pre_s: float = Field(default=30.0, ge=1)
    """Length of data before an event that is kept with it."""
    merge_s: float = Field(default=10.0, ge=2, le=30)
    """Quiet time that ends an event; motion that begins again earlier belongs to it."""
    post_s: float = Field(default=40.0, ge=2, le=50)
    """Time after the end of an event after which its final line is written."""
    longest_s: float = Field(default=300.0, ge=30)
    """Longest event; longer motion is cut there."""
    revision_s: float = Field(default=3600.0, ge=60)
    """Length of ambient motion before, and after, from which the lasting loss is told."""
    keep_gb: float = Field(default=1.0, gt=0)
    """Greatest disk space of the events' own recordings and pages, in GiB; beyond it new events have no recording."""
    limits: tuple[LimitTable, ...] = ()
    """Limits of the site; there is no default."""

    @property
    def reach_s(self) -> float:
        """Greatest length of data that the description of an event needs, s."""
        return self.pre_s + self.longest_s + self.post_s + self.merge_s

    @model_validator(mode="after")
    def _consistent(self) -> EventSettings:
        """Refuse thresholds in the wrong order."""
        if self.ratio_off >= self.ratio_on:
            raise ValueError("ratio_off must lie below ratio_on")
        if self.post_s < self.merge_s:
            raise ValueError("post_s must be at least merge_s")
        return self
