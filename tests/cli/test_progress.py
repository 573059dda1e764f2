"""How far a long command is: in one line on a terminal, by one line a minute in a pipe."""

from __future__ import annotations

import signal
import time

import pytest

from monitor.cli.progress import ProgressLine, asked_by_timer
from monitor.core import Step


class Watched:
    """A line of progress with a clock that is set, and what it wrote."""

    def __init__(self, *, is_terminal: bool) -> None:
        self.now_s = 0.0
        self.said: list[str] = []
        self.line = ProgressLine(
            "diagnose", is_terminal=is_terminal, clock=lambda: self.now_s, write=lambda text: self.said.append(text)
        )

    def at(self, now_s: float, step: Step | None = None) -> list[str]:
        """Set the clock, tell a step or ask for the line as the timer does, and return what was written."""
        self.now_s, self.said[:] = now_s, []
        self.line.tell() if step is None else self.line(step)
        return list(self.said)


def test_in_a_pipe_a_command_says_one_line_a_minute_and_a_short_one_nothing() -> None:
    pipe = Watched(is_terminal=False)
    reading = Step("reads the recordings", 10.0, 60.0, "min of data", then="looks for causes")
    assert pipe.at(0.0, reading._replace(done=0.0)) == pipe.at(59.0) == []
    told = pipe.at(60.0, reading)
    assert told == [
        "diagnose: reads the recordings, 10 of 60 min of data, 5 min left, 60 s so far; then looks for causes\n"
    ]
    assert pipe.at(119.0, reading._replace(done=20.0)) == []
    assert "20 of 60 min of data, 4 min left" in pipe.at(120.0)[0]
    pipe.line.end()
    assert len(pipe.said) == 1


def test_a_step_without_a_known_total_is_told_with_the_time_that_went_by() -> None:
    pipe = Watched(is_terminal=False)
    pipe.at(30.0, Step("looks for cause 2", then="tests each cause beside the others"))
    assert pipe.at(180.0) == ["diagnose: looks for cause 2, 3 min so far; then tests each cause beside the others\n"]
    assert pipe.at(240.0, Step("", 7.0, 0.0, "rows")) == ["diagnose: 7 rows, 4 min so far\n"]


def test_on_a_terminal_one_line_is_written_anew_and_cleared_at_the_end() -> None:
    screen = Watched(is_terminal=True)
    assert screen.at(0.5, Step("", 1.0, 4.0, "files")) == []
    (shown,) = screen.at(1.5, Step("", 2.0, 4.0, "files"))
    assert (shown[:4], shown[-1]) == ("\r\x1b[K", "\r")
    assert "2 of 4 files, 2 s left" in shown
    assert screen.at(1.6) == []
    screen.line.is_paused = True  # a question stands there
    assert screen.at(9.0) == []
    screen.line.end()
    assert screen.said == ["\r\x1b[K"]


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this system has no such timer")
def test_a_computation_that_tells_nothing_is_asked_by_the_timer_and_another_timer_goes_on_after_it() -> None:
    asked: list[float] = []
    before = signal.getsignal(signal.SIGALRM)
    with asked_by_timer(lambda: asked.append(time.monotonic()), every_s=0.02):
        deadline = time.monotonic() + 5.0
        while len(asked) < 3 and time.monotonic() < deadline:
            sum(range(1000))
    assert len(asked) >= 3
    assert signal.getsignal(signal.SIGALRM) is before
