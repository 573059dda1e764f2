"""Trigger of a diagnosis by the online results: pure functions in data time.

An alarm says that stiffness was lost; only a diagnosis can say if something else explains the data as well.  A diagnosis is
requested once an episode, when a window's length of data has come since the episode began, because the window that raised
the alarm still holds data from before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from pydantic import Field

from monitor.core import Level, Settings, WindowResult


class WatchSettings(Settings):
    """``[watch]``: diagnosis in the course of a replay or of the daemon."""

    diagnose: bool = True
    """Whether alarms and a bad goodness of fit ask for a diagnosis."""
    misfit: float = Field(default=5.0, gt=1)
    """Goodness of fit of the change (1 when stiffness explains it) from which stiffness explains too little."""
    longest_s: float = Field(default=1200.0, gt=0)
    """Longest span of the latest data that one diagnosis uses."""
    time_limit_s: float = Field(default=300.0, gt=0)
    """A diagnosis that takes longer than this is given up."""


@dataclass(frozen=True, slots=True)
class Request:
    """Request for a diagnosis of a span of data."""

    from_ns: int
    """UTC of the first sample to be judged."""
    to_ns: int
    """UTC of the end of the span."""
    reason: str


@dataclass(frozen=True, slots=True)
class WatchState:
    """State of the trigger: the present episode, and whether a diagnosis of it was requested."""

    begun_ns: int | None = None
    """End of the episode's first window; None between episodes."""
    reason: str = ""
    asked: bool = False
    """Whether the diagnosis of this episode was requested."""
    misfit_since_ns: int | None = None
    """End of the first window of the unbroken run of those that stiffness does not explain."""


def step(
    state: WatchState, result: WindowResult, settings: WatchSettings, window_s: float
) -> tuple[WatchState, Request | None]:
    """Advance the state by one window; return a request when an episode has brought enough data, or ends before."""
    if result.skipped is not None:
        return state, None
    t_ns, window_ns = result.t_end_ns, round(window_s * 1e9)
    explained = result.stiffness is None or result.stiffness.misfit <= settings.misfit
    since_ns = None if explained else min(state.misfit_since_ns or t_ns, t_ns)  # the clock may have been set back
    state = replace(state, misfit_since_ns=since_ns)
    reason = ""
    if result.alarm.level.rank >= Level.WARNING.rank:
        reason = f"{result.alarm.level.value}: {result.alarm.reason}"
    elif since_ns is not None and t_ns - since_ns >= window_ns:
        reason = "the change is none of stiffness alone"
    if not reason:
        request = finish(state, t_ns, settings, window_s)
        return WatchState(misfit_since_ns=since_ns), request
    if state.begun_ns is None:
        return replace(state, begun_ns=t_ns, reason=reason), None
    if t_ns - state.begun_ns < window_ns:
        return replace(state, begun_ns=min(state.begun_ns, t_ns)), None
    return replace(state, asked=True), finish(state, t_ns, settings, window_s)


def finish(state: WatchState, t_ns: int, settings: WatchSettings, window_s: float) -> Request | None:
    """Return the request that is due when the episode or the data end at `t_ns`; None where none is due.

    Examples
    --------
    >>> state = WatchState(begun_ns=400_000_000_000, reason="alarm: story 1")
    >>> request = finish(state, t_ns=900_000_000_000, settings=WatchSettings(), window_s=400.0)
    >>> request.from_ns, request.reason
    (400000000000, 'alarm: story 1')
    """
    if not settings.diagnose or state.begun_ns is None or state.asked:
        return None
    longest_ns, least_ns = (round(s * 1e9) for s in (max(settings.longest_s, window_s), window_s))
    return Request(max(t_ns - longest_ns, min(state.begun_ns, t_ns - least_ns)), t_ns, state.reason)
