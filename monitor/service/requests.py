"""Operators' requests on alarms, as JSON: validated where they arrive, applied by the thread that owns the alarms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Literal

from pydantic import Field, model_validator

from monitor.core import Settings
from monitor.damage import alarm
from monitor.events import EventAlarm, alarm as event_alarm

MAX_REQUEST_BYTES = 4096
_BURST = 10.0
"""Requests that one asker may make at once. [1; judgement: more than a person does in a minute]"""
_PER_S = 10.0 / 60.0
"""Requests a second that one asker may make for long. [1/s; judgement: ten a minute]"""
_MOST_ASKERS = 8
"""Most askers at a time: names are what the askers say, and must not multiply the rate without end. [1; judgement]"""


class Request(Settings):
    """Request of an operator on the alarm of one story, or of one event; ``story`` 0 is the structure as a whole.

    Text is for people: it is stored and shown, never interpreted.

    Examples
    --------
    >>> request = Request(action="shelve", story=2, who="A. Smith", note="test of the crane", seconds=3600.0)
    >>> Request.model_validate_json(request.model_dump_json()) == request
    True
    """

    action: Literal["acknowledge", "reset", "shelve", "unshelve"]
    story: int | None = Field(default=None, ge=0, le=1000)
    event: str | None = Field(default=None, min_length=1, max_length=64, pattern=r"^[0-9A-Za-z.:_-]+$")
    """Id of the event, in place of a story; its alarm can be acknowledged and nothing else."""
    who: str = Field(min_length=1, max_length=100)
    note: str = Field(default="", max_length=1000)
    """Reason; shelving needs one."""
    seconds: float = Field(default=0.0, ge=0, le=30 * 86400)
    """Duration of shelving, s."""

    @model_validator(mode="after")
    def _complete(self) -> Request:
        if (self.story is None) == (self.event is None):
            raise ValueError("a request names either a story or an event")
        if self.event is not None and self.action != "acknowledge":
            raise ValueError("the alarm of an event can only be acknowledged: the motion is over")
        if self.action == "shelve" and not (self.note.strip() and self.seconds > 0):
            raise ValueError("shelving needs a note and seconds")
        if len(self.model_dump_json().encode()) > MAX_REQUEST_BYTES:
            raise ValueError(f"a request has {MAX_REQUEST_BYTES} bytes at most: shorten the note")
        return self


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer to a request."""

    refusal: str | None = None
    """Reason why it was not applied; None if it was, or if everything was already as it asks."""
    again: bool = False
    """Whether the same request may be accepted later."""


class RateLimit:
    """Limit on the rate of requests: a token bucket for each asker.

    Examples
    --------
    >>> limit = RateLimit(clock=lambda: 0.0)
    >>> [limit.refusal("Ann") is None for _ in range(11)]
    [True, True, True, True, True, True, True, True, True, True, False]
    >>> limit.refusal("Bob") is None
    True
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self._full_s: dict[str, float] = {}
        """Asker -> time at which the bucket is full again."""

    def refusal(self, who: str) -> str | None:
        """Take a token for a request of `who`; return the reason if there is none, else None."""
        now = self._clock()
        for asker, full_s in list(self._full_s.items()):
            if full_s <= now:
                del self._full_s[asker]
        if who not in self._full_s and len(self._full_s) >= _MOST_ASKERS:
            return f"too many askers at a time; {_MOST_ASKERS} are the most within a minute"
        full_s = max(self._full_s.get(who, now), now) + 1.0 / _PER_S
        if full_s - now > _BURST / _PER_S + 1e-9:
            return f"too many requests of {who}; {_BURST:.0f} at once and {60.0 * _PER_S:.0f} a minute are the most"
        self._full_s[who] = full_s
        return None


def apply(state: alarm.AlarmState, request: Request, t_ns: int) -> alarm.AlarmState:
    """Apply a request to the state of the alarms and return the new state; ValueError tells that there is no such story.

    Shelving counts from `t_ns`, the end of the latest window, UTC, ns since 1970.
    """
    if request.story is None:
        return state
    match request.action:
        case "acknowledge":
            return alarm.acknowledge(state, request.story, request.who)
        case "reset":
            return alarm.reset(state, request.story)
        case "unshelve":
            return alarm.unshelve(state, request.story)
        case "shelve":
            reason = f"{request.note} ({request.who})"
            return alarm.shelve(state, request.story, t_ns + round(request.seconds * 1e9), reason)


def apply_to_events(alarms: tuple[EventAlarm, ...], request: Request) -> tuple[EventAlarm, ...]:
    """Apply a request to the alarms of events and return the new ones; ValueError tells that the event has no alarm."""
    return alarms if request.event is None else event_alarm.acknowledge(alarms, request.event, request.who)
