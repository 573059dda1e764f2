"""What the owner of a site sees of its parts: a name, what is wrong, what is lost, what is due, and an end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


class Way(Protocol):
    """Something that may be blocked: a source, a file, the viewer, an outlet."""

    @property
    def failed(self) -> str | None:
        """Reason for which it is blocked; None or empty if it is not."""

    @property
    def dropped(self) -> int:
        """Number of items lost since the start because too many waited."""


class Component(Protocol):
    """Part of a site, which owns the times at which it has something to do."""

    @property
    def name(self) -> str:
        """Its name in lines of health."""

    @property
    def way(self) -> Way | None:
        """What may be blocked; None if nothing may."""

    def step(self, now: float) -> None:
        """Do what is due at `now`, s; wait for nothing."""

    def close(self, timeout_s: float) -> None:
        """End, for at most `timeout_s`."""


@dataclass(frozen=True, slots=True)
class Part:
    """Component of what may be blocked, if anything may, and of what is to be done."""

    name: str = ""
    way: Way | None = None
    on_step: Callable[[float], object] | None = None
    on_close: Callable[[float], object] | None = None

    def step(self, now: float) -> None:
        """Do what is due at `now`, s."""
        if self.on_step is not None:
            self.on_step(now)

    def close(self, timeout_s: float) -> None:
        """End, for at most `timeout_s`."""
        if self.on_close is not None:
            self.on_close(timeout_s)


class Every:
    """Step that does a job every `every_s`, the first time so long after `begun_s`."""

    def __init__(self, every_s: float, job: Callable[[], object], begun_s: float) -> None:
        self._every_s, self._job, self._done_s = every_s, job, begun_s

    def __call__(self, now: float) -> None:
        """Do the job if it is due at `now`, s."""
        if now - self._done_s >= self._every_s:
            self._done_s = now
            self._job()
