"""Channels in use: which channels a window is judged with, and which are left out until they are well again.

A channel is left out of a window in which it lost samples, does not move, is stuck or clipped (`sensor_health`), or does not
show the motion that its neighbours show (`neighbours`).  It is taken back with the first window in which it is well throughout.
If it fails again within a day, it has to be well for one window more, then three, then seven, up to a day: a loose cable is
told a few times a day, not every few minutes (as routes of a network that come and go are damped).

References
----------
C. Villamizar, R. Chandra, R. Govindan, BGP route flap damping, RFC 2439 (1998).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from monitor.core import LeftOutChannel, Window
from monitor.signals import window_quality
from monitor.signals.neighbours import silent_channels
from monitor.signals.sensor_health import HealthSettings

_LONGEST_WAIT_NS = 86_400_000_000_000
"""Time within which a fault counts as a relapse, and longest time for which a channel has to be well: a day. [ns; judgement]"""


@dataclass(frozen=True, slots=True)
class ChannelState:
    """State of one channel between windows."""

    fault: str = ""
    """What was wrong in the latest window in which it was not well, as in `LeftOutChannel.reason`; empty while it is in use."""
    since_ns: int = 0
    """End of the first window without it, or of the first with it again, UTC."""
    well_since_ns: int | None = None
    """End of the first window of the present unbroken run in which it was well, while it is left out; None if it is not."""
    relapses: int = 0
    """Number of times it failed within a day of its return, one after the other."""


@dataclass(frozen=True, slots=True)
class WatchState:
    """State of all channels between windows; empty before the first fault."""

    channels: tuple[ChannelState, ...] = ()


def find_faults(
    window: Window, unhealthy: Mapping[str, str], channels: tuple[str, ...], settings: HealthSettings
) -> dict[int, str]:
    """Find the channels that a window cannot use, from its own data alone: each (0 = first) with its `LeftOutChannel.reason`.

    Parameters
    ----------
    unhealthy
        Channels that are stuck or clipped, by their names, and why (`sensor_health.check`).
    """
    found = {c: "lost samples" for c in window.lost}
    found |= {c: "does not move" for c in window_quality.still_channels(window.sums) if c not in found}
    found |= {c: unhealthy[name] for c, name in enumerate(channels) if name in unhealthy and c not in found}
    left = tuple(c for c in range(len(channels)) if c not in found)
    silent = silent_channels(window.sums, left, settings.min_gain, settings.min_explained)
    for c, (explained, _) in silent.items():
        is_noise = explained < settings.min_explained
        found[c] = "is noise or drifts" if is_noise else "lost the motion that the other channels show"
    return found


def step(
    state: WatchState, found: Mapping[int, str], channels: tuple[str, ...], t_ns: int, window_s: float
) -> tuple[WatchState, tuple[int, ...], tuple[LeftOutChannel, ...]]:
    """Decide which channels the window that ends at `t_ns` (UTC) is judged with, and which not.

    Parameters
    ----------
    found
        What is wrong with each channel (0 = first) in this window (`find_faults`).

    Examples
    --------
    >>> state, in_use, left_out = step(WatchState(), {1: "does not move"}, ("a1", "a2"), 400, 400.0)
    >>> in_use, left_out[0].channel
    ((0,), 'a2')
    >>> step(state, {}, ("a1", "a2"), 410, 400.0)[1]
    (0, 1)
    """
    if not found and not any(c.fault for c in state.channels):
        return state, tuple(range(len(channels))), ()
    before = state.channels or (ChannelState(),) * len(channels)
    now = tuple(_follow(c, found.get(k, ""), t_ns, round(window_s * 1e9)) for k, c in enumerate(before))
    left_out = tuple(
        LeftOutChannel(name, c.fault, c.since_ns) for name, c in zip(channels, now, strict=True) if c.fault
    )
    return WatchState(now), tuple(k for k, c in enumerate(now) if not c.fault), left_out


def _follow(channel: ChannelState, fault: str, t_ns: int, window_ns: int) -> ChannelState:
    """Take in what is wrong with a channel in the next window; empty: nothing."""
    if not channel.fault:
        if not fault:
            return channel
        again = channel.since_ns > 0 and t_ns - channel.since_ns < _LONGEST_WAIT_NS
        return ChannelState(fault, t_ns, relapses=channel.relapses + 1 if again else 0)
    if fault:
        return replace(channel, fault=fault, well_since_ns=None)
    well_since_ns = t_ns if channel.well_since_ns is None else channel.well_since_ns
    wait_ns = min((2**channel.relapses - 1) * window_ns, _LONGEST_WAIT_NS)
    if t_ns - well_since_ns < wait_ns:
        return replace(channel, well_since_ns=well_since_ns)
    return ChannelState("", t_ns, relapses=channel.relapses)
