"""What to do in a state of the structure, in one sentence: what a person reads after the headline."""

from __future__ import annotations

from collections.abc import Sequence

from monitor.damage.assessment import State

_ADVICE = {
    State.NORMAL: "Nothing needs to be done.",
    State.NOT_JUDGED: "This is no all-clear: nothing is known of damage now. Mend what the sentence above names.",
    State.ADVISORY: "Wait for the next windows: a change of {place} is seen and not confirmed yet.",
    State.DOUBTFUL: "Check the sensors, cables and clocks that the sentences here name before anyone relies on a number.",
    State.WARNING: "Have {place} inspected: a change is confirmed that is smaller than an alarm's.",
    State.ALARM: "Look at {place} before anyone relies on it; then acknowledge the alarm.",
}
"""Sentence of each state. [words]"""


def advice(state: State, places: Sequence[str] = (), over: Sequence[str] = ()) -> str:
    """Say what to do, at the affected places, the gravest first; at the structure where none is known.

    `over` are the places of alarms that are over and that nobody has acknowledged.

    Examples
    --------
    >>> advice(State.ALARM, ["story 2", "story 1"])
    'Look at story 2 and story 1 before anyone relies on it; then acknowledge the alarm.'
    """
    if state is State.NORMAL and over:
        return f"Acknowledge the alarm of {' and '.join(over[:3])}, which is over: nobody has yet."
    return _ADVICE[state].format(place=" and ".join(places[:3]) or "the structure")
