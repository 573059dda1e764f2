"""Drawing of the state of the structure: its colour, its headline with what else holds, and its course over time."""

from __future__ import annotations

import numpy as np
import rerun as rr

from monitor.core import utc
from monitor.damage import Assessment, State
from monitor.publish.viewer.rows import Rows, Strips
from monitor.publish.viewer.scene import AMBER, GREEN, GREY, RED, Colour

COLOURS: dict[State, Colour] = {
    State.NORMAL: GREEN,
    State.NOT_JUDGED: GREY,
    State.ADVISORY: (220, 215, 100),
    State.DOUBTFUL: (225, 150, 90),
    State.WARNING: AMBER,
    State.ALARM: RED,
}
"""Colours of the states; green is for `normal` alone."""
PLAIN: Colour = (200, 200, 200)
"""Colour of the other events."""
_LOG_LEVELS = {State.WARNING: "WARN", State.ALARM: "CRITICAL"}
_NOTHING_YET = Assessment(State.NOT_JUDGED, "Nothing yet: still loading, or no window of data so far.")
LAMP = (100.0, 4.0)
"""Width and height of the bar in the colour of the state. [units of its view; judgement]"""


class StateDrawing:
    """Drawing of the state into one recording, in the worker's thread; `live` where viewers watch.

    Otherwise all states but the first one, "nothing yet", are sent at the end: a file that is still loading must not show the
    state of its beginning as that of its end.
    """

    def __init__(self, stream: rr.RecordingStream, *, live: bool) -> None:
        self._stream, self._live, self._rows = stream, live, Rows(stream)
        self._present: Assessment | None = None
        self._drawn: Assessment | None = None
        self._t_ns: int | None = None
        """Time of the latest data."""

    def begin(self) -> None:
        """Draw the names and the colours of the states."""
        configuration = rr.StateConfiguration(
            values=[state.value for state in COLOURS],
            labels=[state.words for state in COLOURS],
            colors=list(COLOURS.values()),
        )
        self._stream.log("/state", configuration, static=True)

    def reached(self, t_ns: int) -> None:
        """Take note that there are data up to a time, UTC in ns; without a state, say that there is none yet."""
        self._t_ns = t_ns
        if self._present is None:
            self._present = _NOTHING_YET
            self.draw(t_ns)
            self._rows.send()

    def take(self, assessment: Assessment) -> None:
        """Take a new state.

        Viewers that watch see it at once, since no window may follow, as where the source is silent; in a file it is drawn with
        the next window.
        """
        self._present = assessment
        if self._live and self._t_ns is not None:
            self.draw(self._t_ns)
            self._rows.send()

    @property
    def changed(self) -> bool:
        """Whether a state of another name waits to be drawn."""
        return self._present is not None and (self._drawn is None or self._present.state is not self._drawn.state)

    def draw(self, t_ns: int) -> None:
        """Draw the present state at a time, UTC in ns; viewers that join late need it at every window."""
        self._t_ns, present = t_ns, self._present
        if present is None or (present == self._drawn and not self._live):
            return
        self._rows.at(t_ns)
        self._rows.text("/state", state_markdown(present))
        bar = Strips([np.array([(0.0, 0.0), (LAMP[0], 0.0)])])
        self._rows.add(
            "/state/lamp", rr.LineStrips2D, strips=bar, colors=[COLOURS[present.state]], radii=[0.5 * LAMP[1]]
        )
        if self.changed:
            self._rows.add("/state", rr.StateChange, state=[present.state.value])
            if present is not _NOTHING_YET:
                self._log(t_ns, present)
        self._drawn = present

    def _log(self, t_ns: int, present: Assessment) -> None:
        """Write a change of state into the list of events."""
        level = _LOG_LEVELS.get(present.state, "INFO")
        body = event_text(t_ns, f"{present.state.words.upper()}: {present.headline}")
        self._rows.add("/events", rr.TextLog, text=[body], level=[level], color=[COLOURS[present.state]])

    def send(self) -> None:
        """Send what was drawn to viewers that watch."""
        if self._live:
            self._rows.send()

    def finish(self) -> None:
        """Draw the state that a diagnosis after the last window left, and send the remaining states."""
        if self._t_ns is not None:
            self.draw(self._t_ns)
        self._rows.send()


def event_text(t_ns: int, text: str) -> str:
    """Write an event with its time in full, for which the viewer's own column is too narrow.

    Examples
    --------
    >>> event_text(1_700_000_000_000_000_000, "results again")
    '2023-11-14 22:13:20 UTC  results again'
    """
    return f"{utc(t_ns, seconds=True)} UTC  {text}"


def state_markdown(assessment: Assessment) -> str:
    """Write the state in capitals, its headline and what else holds, in Markdown.

    Examples
    --------
    >>> print(state_markdown(Assessment(State.DOUBTFUL, "Channels a1 and a3 are swapped.", ("No loss above 2 %.",))))
    # DOUBTFUL
    ### Channels a1 and a3 are swapped.
    <BLANKLINE>
    - No loss above 2 %.
    """
    doubts = "".join(f"\n- {doubt}" for doubt in assessment.doubts)
    if not doubts and assessment.state not in (State.NOT_JUDGED, State.DOUBTFUL):
        doubts = "\nNothing makes this doubtful."
    return f"# {assessment.state.words.upper()}\n### {assessment.headline}\n" + doubts
