"""Health of channels that are measured beside those by which the structure is judged, as along other directions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from drivers.base import SampleBlock
from monitor.signals import alignment, sensor_health
from monitor.signals.sensor_health import ChannelHealth, Health, HealthSettings, HealthState


@dataclass(frozen=True, eq=False, slots=True)
class BesideState:
    """State between blocks."""

    names: tuple[str, ...] = ()
    """The channels; other ones begin anew."""
    align: alignment.AlignState = field(default_factory=alignment.start)
    health: HealthState = field(default_factory=HealthState)
    waiting: tuple[Health, ...] = ()
    """Completed spans that are still to be told."""


def step(state: BesideState, block: SampleBlock, used: tuple[str, ...], settings: HealthSettings) -> BesideState:
    """Check the channels of a block that are not among the `used` ones; raises as `alignment.step`."""
    names = tuple(name for name in block.channels if name not in used)
    if names != state.names:
        state = BesideState(names)
    if not names:
        return state
    # With the used channels a time at which all others are not finite is no gap.
    align, pieces = alignment.step(state.align, block, (*names, *used), keep_partial=True)
    health, waiting = state.health, list(state.waiting)
    for piece in pieces:
        own = replace(piece, values=piece.values[:, : len(names)])
        health, found = sensor_health.step(health, own, align.dropped, names, settings, 0.0)
        waiting += found
    return replace(state, align=align, health=health, waiting=tuple(waiting))


def tell(state: BesideState, told: list[Health]) -> tuple[BesideState, list[Health]]:
    """Join the channels to the spans in which the used ones are told, each to the first one that ends no earlier than its own."""
    waiting, joined = list(state.waiting), list[Health]()
    for health in told:
        latest: dict[str, ChannelHealth] = {}
        while waiting and waiting[0].t_end_ns <= health.t_end_ns + 1000:  # times are rounded
            latest |= {c.channel: c for c in waiting.pop(0).channels}
        joined.append(replace(health, channels=(*health.channels, *latest.values())))
    return (state if not told else replace(state, waiting=tuple(waiting))), joined
