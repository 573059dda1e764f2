"""Operators' requests on alarms, as JSON: validated where they arrive, applied by the thread that owns the alarms."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from monitor.core import Settings
from monitor.damage import alarm

MAX_REQUEST_BYTES = 4096


class Request(Settings):
    """Request of an operator on the alarm of one story; ``story`` 0 is the structure as a whole.

    Text is for people: it is stored and shown, never interpreted.

    Examples
    --------
    >>> request = Request(action="shelve", story=2, who="A. Smith", note="test of the crane", seconds=3600.0)
    >>> Request.model_validate_json(request.model_dump_json()) == request
    True
    """

    action: Literal["acknowledge", "reset", "shelve", "unshelve"]
    story: int = Field(ge=0, le=1000)
    who: str = Field(min_length=1, max_length=100)
    note: str = Field(default="", max_length=1000)
    """Reason; shelving needs one."""
    seconds: float = Field(default=0.0, ge=0, le=30 * 86400)
    """Duration of shelving, s."""

    @model_validator(mode="after")
    def _complete(self) -> Request:
        if self.action == "shelve" and not (self.note.strip() and self.seconds > 0):
            raise ValueError("shelving needs a note and seconds")
        return self


def apply(state: alarm.AlarmState, request: Request, t_ns: int) -> alarm.AlarmState:
    """Apply a request to the state of the alarms and return the new state.

    Parameters
    ----------
    state : AlarmState
        Present state of the alarms.
    request : Request
        Request of an operator.
    t_ns : int
        End of the latest window, UTC, ns since 1970; shelving counts from it.

    Raises
    ------
    ValueError
        There is no such story.
    """
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
