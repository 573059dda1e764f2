"""Alarm of an event that exceeds a limit of the site, in the vocabulary of IEC 62682.

The motion that raised it is over when it is told, so its condition is "returned to normal, unacknowledged": it stays so until
an operator acknowledges it, whatever the data say later, and then is normal.  A later line of the same event that finds another
limit exceeded, or the same in another story, must be acknowledged again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from monitor.core import AlarmCondition
from monitor.events.event import Event
from monitor.events.limits import POSSIBLY

_MOST = 64
"""Most alarms that are kept: those acknowledged first go first, then the oldest. [count; cost]"""


@dataclass(frozen=True, slots=True)
class EventAlarm:
    """Alarm of one event."""

    id: str
    """The event's."""
    exceeded: tuple[str, ...]
    """Every limit exceeded, in words, as the event's latest line that exceeds one says."""
    limits: tuple[tuple[int, int], ...]
    """Every limit that a line of it exceeded and the story, both from 0 (`limits.exceedances`)."""
    unacknowledged: bool = True
    acknowledged_by: str = ""

    @property
    def condition(self) -> AlarmCondition:
        """State in the alarm state diagram of the standard."""
        return AlarmCondition.RETURNED_UNACKNOWLEDGED if self.unacknowledged else AlarmCondition.NORMAL

    @property
    def says(self) -> str:
        """The alarm in one sentence."""
        more = f", and {len(self.exceeded) - 1} more" if len(self.exceeded) > 1 else ""
        first = self.exceeded[0]
        how = "possibly exceeded" if first.startswith(POSSIBLY) else "exceeded"
        return f"event {self.id} {how} a limit of the site: {first.removeprefix(POSSIBLY)}{more}; nobody has acknowledged it"


def follow(
    alarms: tuple[EventAlarm, ...], event: Event, exceeded: Sequence[tuple[int, int]], *, most: int = _MOST
) -> tuple[EventAlarm, ...]:
    """Raise the alarm of an event that exceeds a limit, or raise it again where more is exceeded than before.

    Of the `alarms`, oldest first, no more than `most` are kept.  `exceeded` are limits and stories, from 0.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> first = follow((), SimpleNamespace(id="a", exceeded=("look",)), [(0, 2)])
    >>> seen = acknowledge(first, "a", "Ada")
    >>> [follow(seen, SimpleNamespace(id="a", exceeded=("go",)), [(0, j)])[0].unacknowledged for j in (2, 1)]
    [False, True]
    """
    if not exceeded:
        return alarms
    known = next((a for a in alarms if a.id == event.id), None)
    if known is None:
        new = (*alarms, EventAlarm(event.id, event.exceeded, tuple(exceeded)))
        if len(new) > most:
            oldest = next((a for a in new if not a.unacknowledged), new[0])
            new = tuple(a for a in new if a is not oldest)
        return new
    limits = tuple(sorted({*known.limits, *exceeded}))
    raised = replace(known, exceeded=event.exceeded, limits=limits)
    if limits != tuple(sorted(known.limits)):
        raised = replace(raised, unacknowledged=True, acknowledged_by="")
    return tuple(raised if a is known else a for a in alarms)


def acknowledge(alarms: tuple[EventAlarm, ...], id: str, who: str) -> tuple[EventAlarm, ...]:
    """Acknowledge the alarm of an event.

    Raises
    ------
    ValueError
        No event of this id has an alarm.
    """
    if all(a.id != id for a in alarms):
        waiting = ", ".join(a.id for a in alarms if a.unacknowledged)
        raise ValueError(f"event {id} has no alarm; to be acknowledged: {waiting or 'none'}")
    return tuple(
        replace(a, unacknowledged=False, acknowledged_by=who) if a.id == id and a.unacknowledged else a for a in alarms
    )
