"""What operators ask of the alarms, as JSON: parsed where it arrives, applied where the alarms are."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from monitor.core import Settings
from monitor.damage import alarm

MAX_REQUEST_BYTES = 4096


class Request(Settings):
    """One request of an operator; ``story`` 0 is the structure as a whole.

    Text is for people: it is kept and shown, never interpreted.
    """

    action: Literal["acknowledge", "reset", "shelve", "unshelve"]
    story: int = Field(ge=0, le=1000)
    who: str = Field(min_length=1, max_length=100)
    note: str = Field(default="", max_length=1000)
    """Shelving needs one: its reason."""
    seconds: float = Field(default=0.0, ge=0, le=30 * 86400)
    """How long to shelve."""

    @model_validator(mode="after")
    def _complete(self) -> Request:
        if self.action == "shelve" and not (self.note.strip() and self.seconds > 0):
            raise ValueError("shelving needs a note and seconds")
        return self


def apply(state: alarm.AlarmState, request: Request, t_ns: int) -> alarm.AlarmState:
    """The alarms' state after a request; `t_ns` is the end of the latest window.

    Raises
    ------
    ValueError
        If there is no such story.
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
