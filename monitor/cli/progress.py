"""Shows how far a long command is: on a terminal in one line that is written anew, in a pipe by one line a minute."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from monitor.core import Step

_PIPE_EVERY_S = 60.0
"""Time between two lines in a pipe; a shorter command says nothing there. [s; convention: one line a minute in a log]"""
_TERMINAL_EVERY_S = 1.0
"""Time between two looks of the line on a terminal. [s; convention]"""


class ProgressLine:
    """Says how far a command is, each time it is due; `clock` is in s, `write` takes what is shown."""

    def __init__(
        self, command: str, *, is_terminal: bool, clock: Callable[[], float], write: Callable[[str], object]
    ) -> None:
        self._command, self._is_terminal, self._clock, self._write = command, is_terminal, clock, write
        self._every_s = _TERMINAL_EVERY_S if is_terminal else _PIPE_EVERY_S
        self._step = self._first = Step("")
        self._began_s = self._step_began_s = self._told_s = clock()
        self._is_shown = False
        self.is_paused = False
        """Whether nothing is said, as while a question is asked."""

    def __call__(self, step: Step) -> None:
        """Take the step at which the command is."""
        if step.does != self._step.does or step.done < self._step.done:
            self._first, self._step_began_s = step, self._clock()
        self._step = step
        self.tell()

    def tell(self) -> None:
        """Write a line if it is time for one."""
        now_s = self._clock()
        if self.is_paused or now_s - self._told_s < self._every_s:
            return
        self._told_s, self._is_shown = now_s, self._is_terminal
        line = f"{self._command}: {self._words(now_s)}"
        # On a terminal the next output begins on this line and overwrites it.
        self._write(f"\r\x1b[K{line}\r" if self._is_terminal else f"{line}\n")

    def end(self) -> None:
        """Clear the line of a terminal."""
        if self._is_shown:
            self._write("\r\x1b[K")

    def _words(self, now_s: float) -> str:
        """Say what is done, of how much, how long the rest of the step takes, and what comes then."""
        step, parts = self._step, [self._step.does] if self._step.does else []
        if step.total >= step.done > 0.0:
            parts.append(f"{step.done:.0f} of {step.total:.0f} {step.unit}")
            if (gained := step.done - self._first.done) > 0.0:
                left_s = (now_s - self._step_began_s) * (step.total - step.done) / gained
                parts.append(f"{_length(left_s)} left")
        elif step.done > 0.0:
            parts.append(f"{step.done:.0f} {step.unit}")
        parts.append(f"{_length(now_s - self._began_s)} so far")
        return ", ".join(parts) + (f"; then {step.then}" if step.then else "")


@contextmanager
def progress(command: str, does: str = "") -> Iterator[ProgressLine]:
    """Show on standard error how far a command is, until the block ends; within it the line takes each step.

    A step that takes long without coming further is told too: the system's timer asks for the line.
    """
    line = ProgressLine(command, is_terminal=sys.stderr.isatty(), clock=time.monotonic, write=_write)
    line(Step(does))
    with asked_by_timer(line.tell):
        try:
            yield line
        finally:
            line.end()


@contextmanager
def asked_by_timer(tell: Callable[[], None], every_s: float = _TERMINAL_EVERY_S) -> Iterator[None]:
    """Call a function every `every_s` until the block ends, in the main thread, between two steps of the interpreter."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, lambda *_: tell())
    timer = signal.setitimer(signal.ITIMER_REAL, every_s, every_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)
        signal.signal(signal.SIGALRM, before)


def _write(text: str) -> None:
    """Write to standard error past its buffer, in the midst of whose use the timer may ask."""
    with suppress(OSError):  # nobody reads it any more
        os.write(2, text.encode())


def _length(seconds: float) -> str:
    """Say a length of time.

    Examples
    --------
    >>> _length(59.0), _length(150.0), _length(9000.0)
    ('59 s', '2 min', '2.5 h')
    """
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
