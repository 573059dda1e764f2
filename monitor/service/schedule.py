"""Which of many sites is evaluated next: blocks in the order of a virtual clock, and a look after each site meanwhile.

All is done by the thread that calls `Schedule.turn`; other threads say that a block came, or leave it a job.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum
from functools import wraps
from heapq import heappop, heappush
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from drivers.base import SampleBlock
from monitor.service import logs
from monitor.service.site import Site
from monitor.service.site_store import SiteStore
from monitor.service.threads import BlockQueue

_PACE = 8.0
"""Multiple of real time up to which the blocks of a site keep the place in line that their arrival gave them. [1; judgement: four
topics at once, and what a sensor kept while its link was broken]"""
_STEP_S = 2.0
"""Interval at which requests, health and summary of a site are looked after. [s; cost: at 1 s 8 % of its thread]"""
_STEPS = 8
"""Most sites that are looked after between two blocks. [1; cost: a fraction of a millisecond each]"""
TICK_S = 0.2
"""Longest wait for a block. [s; judgement]"""


class State(Enum):
    """What the host does with a site."""

    WAITING = "waiting"
    """To be started, or started again after a failure."""
    STANDBY = "standby"
    """To be started when nobody else monitors it."""
    RUNNING = "running"
    ENDING = "ending"
    OVER = "over"


@dataclass(eq=False)
class Place:
    """One site file, and what the host knows of its site."""

    path: Path
    name: str
    """Name of the site; that of the file until it was read."""
    stamp: tuple[int, int] | None
    """Time of change (ns) and size of the file when it was last looked at; None where it could not be."""
    state: State = State.WAITING
    site: Site | None = None
    queue: BlockQueue[SampleBlock] | None = None
    due_s: float = float("-inf")
    """When a waiting site is started."""
    pause_s: float = 0.0
    """Latest pause before it was started again; 0 if it has not failed lately."""
    begun_s: float = 0.0
    failure: str = ""
    """Why it does not run; empty if it does."""
    is_told: bool = False
    """Whether READY need not wait for it: its source is open, or it was said why not."""
    is_opened: bool = False
    out: Path | None = None
    """Output folder of its site; None before it was looked for."""
    store: SiteStore | None = None
    """Copy of its output folder in object storage, which remembers since when another monitor has not been heard of."""
    free_s: float | None = None
    """Since when nobody monitors a site that stands by; None while somebody does."""
    was_held: bool = False
    """Whether another daemon was seen to monitor a site that stands by."""
    is_removed: bool = False
    """Whether its file is gone, so that it is not started again."""
    credit_s: float = 0.0
    """Time from which its next block is due by the data before it."""
    in_line: bool = False
    stepped_s: float = 0.0

    @property
    def is_over(self) -> bool:
        """Whether nothing more is to be done for it."""
        return self.state is State.OVER


@dataclass
class Line:
    """Sites with blocks that wait, in the order in which they are due.

    A block is due when it came, but no earlier than the data before it allow at `_PACE` times real time, or than the time that
    these cost: so a site that sends too much waits behind the others, and costs them one block at most.

    References
    ----------
    Zhang, L. (1990). VirtualClock: a new traffic control algorithm for packet switching networks. ACM SIGCOMM.
    """

    _heap: list[tuple[float, int, Place]] = field(default_factory=list)
    _numbers: Iterable[int] = field(default_factory=itertools.count)

    def join(self, place: Place) -> bool:
        """Put a site in line for its next block; return whether one waits."""
        assert place.queue is not None
        first_s = place.queue.first_s
        if first_s is None or place.in_line:
            return place.in_line
        place.in_line = True
        heappush(self._heap, (max(first_s, place.credit_s), next(iter(self._numbers)), place))
        return True

    def next(self) -> Place | None:
        """Take the site that is due first out of the line; None if none waits."""
        if not self._heap:
            return None
        _, _, place = heappop(self._heap)
        place.in_line = False
        return place

    @staticmethod
    def spend(place: Place, arrived_s: float, data_s: float, cost_s: float) -> None:
        """Note that a block of `data_s` that came at `arrived_s` was evaluated in `cost_s`, all in s."""
        place.credit_s = max(place.credit_s, arrived_s) + max(data_s / _PACE, cost_s)

    def __len__(self) -> int:
        return len(self._heap)


_T = TypeVar("_T")
_P = ParamSpec("_P")
_R = TypeVar("_R")
_SiteWork = Callable[Concatenate[_T, Place, _P], _R]


def named_in_the_log(work: _SiteWork[_T, _P, _R]) -> _SiteWork[_T, _P, _R]:
    """Decorate the work for one site: while it lasts, the lines of the log carry the site's name."""

    @wraps(work)
    def named(of: _T, place: Place, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        before = logs.site_name.set(place.name)
        try:
            return work(of, place, *args, **kwargs)
        finally:
            logs.site_name.reset(before)

    return named


class Schedule:
    """Work of the thread that evaluates all sites, of which `ended` and `failed` take those that are evaluated no more."""

    def __init__(
        self, clock: Callable[[], float], ended: Callable[[Place], None], failed: Callable[[Place, Exception], None]
    ) -> None:
        self._clock, self._ended, self._failed = clock, ended, failed
        self._line = Line()
        self._arrived: deque[Place] = deque()
        """Sites whose queues changed; any thread appends."""
        self._jobs: deque[Callable[[], None]] = deque()
        """What other threads want done; any thread appends."""
        self._wake = threading.Event()
        self._rounds: deque[Place] = deque()

    def add(self, place: Place) -> None:
        """Look after a site from now on."""
        self._rounds.append(place)

    def tell_arrival(self, place: Place) -> None:
        """Say that the queue of a site changed (in any thread)."""
        self._arrived.append(place)
        self.wake()

    def call(self, job: Callable[[], None]) -> None:
        """Have a job done by the thread that evaluates (in any thread)."""
        self._jobs.append(job)
        self.wake()

    def wake(self) -> None:
        """End the present wait for a block (in any thread, or a signal handler)."""
        self._wake.set()

    def turn(self) -> float:
        """Do the jobs that wait, evaluate the block that is due first, look after some sites, and return the time, s.

        If nothing waits, it waits up to `TICK_S` for a block or a job.
        """
        if not (self._line or self._is_step_due(self._clock())):
            self._wake.wait(TICK_S)
        self._wake.clear()
        while self._jobs:
            self._jobs.popleft()()
        while self._arrived:
            self._go_on(self._arrived.popleft())
        if (place := self._line.next()) is not None:
            self._evaluate(place)
        now = self._clock()
        for _ in range(_STEPS):
            if not self._is_step_due(now):
                break
            place = self._rounds.popleft()
            if place.site is not None and place.queue is not None:
                self._step(place, place.site, now)
        return now

    def _go_on(self, place: Place) -> None:
        """Put a site in line if a block of it waits; end it if its queue is over."""
        if place.queue is None or place.state not in {State.RUNNING, State.ENDING} or self._line.join(place):
            return
        if place.queue.over:
            place.queue = None
            self._ended(place)

    @named_in_the_log
    def _evaluate(self, place: Place) -> None:
        """Evaluate the next block of a site."""
        if place.queue is None or place.site is None or (item := place.queue.take(0.0)) is None:
            return
        begun_s = self._clock()
        try:
            place.site.take(*item)
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            self._failed(place, error)
            return
        block, arrived_s = item
        self._line.spend(place, arrived_s, block.n_samples / block.sample_rate_hz, self._clock() - begun_s)
        self._go_on(place)

    def _is_step_due(self, now: float) -> bool:
        """Return whether it is time to look after a site."""
        return bool(self._rounds) and now - self._rounds[0].stepped_s >= _STEP_S

    @named_in_the_log
    def _step(self, place: Place, site: Site, now: float) -> None:
        """Look after requests, health and summary of a site."""
        place.stepped_s = now
        try:
            if site.reader.opened and not place.is_opened:
                place.is_opened = True
                site.tell_open()
            site.step(now)
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            self._failed(place, error)
        else:
            self._rounds.append(place)
