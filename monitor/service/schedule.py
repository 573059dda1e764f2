"""Which of many sites is evaluated next: blocks in the order of a virtual clock, and a look after each site meanwhile.

All is done by the thread that calls `Schedule.turn`; other threads say that a block came.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from heapq import heappop, heappush

from drivers.base import SampleBlock
from monitor.service import logs
from monitor.service.site import Site
from monitor.service.threads import BlockQueue

_PACE = 8.0
"""Multiple of real time up to which the blocks of a site keep the place in line that their arrival gave them. [1; judgement: four
topics at once, and what a sensor kept while its link was broken]"""
_STEPS = 8
"""Most sites that are looked after between two blocks. [1; cost: a fraction of a millisecond each]"""


class State(Enum):
    """What is done with a site."""

    WAITING = "waiting"
    """To be started, or started again after a failure."""
    STANDBY = "standby"
    """To be started when nobody else monitors it."""
    RUNNING = "running"
    ENDING = "ending"
    OVER = "over"


@dataclass(eq=False)
class Runner:
    """A site that runs, and its place in line; `ended` is called once it is evaluated no more."""

    name: str
    site: Site
    queue: BlockQueue[SampleBlock]
    ended: Callable[[], None]
    begun_s: float = float("inf")
    credit_s: float = 0.0
    """Time from which its next block is due by the data before it."""
    stepped_s: float = float("-inf")
    in_line: bool = False
    is_opened: bool = False
    is_over: bool = False
    """Whether it is evaluated no more."""
    error: Exception | None = None
    """What failed of it."""


@dataclass
class Line:
    """Sites with blocks that wait, in the order in which they are due.

    A block is due when it came, but no earlier than the data before it allow at `_PACE` times real time, or than the time that
    these cost: so a site that sends too much waits behind the others, and costs them one block at most.

    References
    ----------
    Zhang, L. (1990). VirtualClock: a new traffic control algorithm for packet switching networks. ACM SIGCOMM.
    """

    _heap: list[tuple[float, int, Runner]] = field(default_factory=list)
    _numbers: Iterable[int] = field(default_factory=itertools.count)

    def join(self, runner: Runner) -> bool:
        """Put a site in line for its next block; return whether one waits."""
        if runner.in_line:  # looked at first, for it needs no lock
            return True
        if (first_s := runner.queue.first_s) is None:
            return False
        runner.in_line = True
        heappush(self._heap, (max(first_s, runner.credit_s), next(iter(self._numbers)), runner))
        return True

    def next(self) -> Runner | None:
        """Take the site that is due first out of the line; None if none waits."""
        if not self._heap:
            return None
        _, _, runner = heappop(self._heap)
        runner.in_line = False
        return runner

    @staticmethod
    def spend(runner: Runner, arrived_s: float, data_s: float, cost_s: float) -> None:
        """Note that a block of `data_s` that came at `arrived_s` was evaluated in `cost_s`, all in s."""
        runner.credit_s = max(runner.credit_s, arrived_s) + max(data_s / _PACE, cost_s)

    def __len__(self) -> int:
        return len(self._heap)


class Schedule:
    """Work of the thread that evaluates all sites.

    Requests, health and summary of a site are looked after every `step_s`, or, where that is 0, after each block and each wait
    for one, which lasts `tick_s` at most.
    """

    def __init__(self, clock: Callable[[], float], step_s: float, tick_s: float) -> None:
        self._clock, self._step_s, self._tick_s = clock, step_s, tick_s
        self._line = Line()
        self._arrived: deque[Runner] = deque()
        """Sites whose queues changed; any thread appends."""
        self._wake = threading.Event()
        self._rounds: deque[Runner] = deque()

    def add(self, runner: Runner) -> None:
        """Look after a site from now on (in any thread)."""
        runner.begun_s = runner.credit_s = self._clock()
        self._rounds.append(runner)

    def tell_arrival(self, runner: Runner) -> None:
        """Say that the queue of a site changed (in any thread)."""
        self._arrived.append(runner)
        if not self._wake.is_set():  # else the next wait ends at once, after which this is taken
            self._wake.set()

    def wake(self) -> None:
        """End the present wait (in any thread, but in no signal handler, which could wait for itself)."""
        self._wake.set()

    def turn(self) -> float:
        """Evaluate the block that is due first, or wait for one; look after some sites, and return the time, s."""
        if not self._line and not self._is_step_due():
            self._wake.wait(self._tick_s)
            self._wake.clear()
        while self._arrived:
            self._go_on(self._arrived.popleft())
        if (runner := self._line.next()) is not None:
            self._evaluate(runner)
        now = self._clock()
        for _ in range(min(_STEPS, len(self._rounds))):
            if now - self._rounds[0].stepped_s < self._step_s:
                break
            self._step(self._rounds.popleft(), now)
        return now

    def _is_step_due(self) -> bool:
        """Return whether a site is to be looked after though no block comes."""
        due_s = max(self._step_s, self._tick_s)
        return bool(self._rounds) and self._clock() - self._rounds[0].stepped_s >= due_s

    def _go_on(self, runner: Runner) -> None:
        """Put a site in line if a block of it waits; end it if its queue is over."""
        if not runner.is_over and not self._line.join(runner) and runner.queue.over:
            self.end(runner)

    def _evaluate(self, runner: Runner) -> None:
        """Evaluate the next block of a site."""
        if runner.is_over or (item := runner.queue.take(0.0)) is None:
            return
        begun_s = self._clock()
        if self._is_done(runner, partial(runner.site.take, *item)):
            block, arrived_s = item
            self._line.spend(runner, arrived_s, block.n_samples / block.sample_rate_hz, self._clock() - begun_s)
            self._go_on(runner)

    def _step(self, runner: Runner, now: float) -> None:
        """Look after requests, health and summary of a site."""

        def work() -> None:
            if runner.site.reader.opened and not runner.is_opened:
                runner.is_opened = True
                runner.site.tell_open()
            runner.site.step(now)

        runner.stepped_s = now
        if not runner.is_over and self._is_done(runner, work):
            self._rounds.append(runner)

    def _is_done(self, runner: Runner, work: Callable[[], None]) -> bool:
        """Do work for a site; where that fails, tell it, evaluate the site no more, and return False."""
        before = logs.site_name.set(runner.name)
        try:
            work()
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            self.end(runner, error)
        finally:
            logs.site_name.reset(before)
        return not runner.is_over

    @staticmethod
    def end(runner: Runner, error: Exception | None = None) -> None:
        """Evaluate a site no more."""
        runner.error, runner.is_over = error, True
        runner.ended()
