"""Monitoring of many sites in one process: which site is evaluated next, and what becomes of one that fails.

One thread evaluates all sites.  Sites are opened by one thread and ended by a few, so that no site waits for the disk or the
network of another.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import resource
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from functools import wraps
from heapq import heappop, heappush
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from drivers.base import SampleBlock
from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, InUseError, UserError
from monitor.damage import AnyBaseline
from monitor.runs import warm_up
from monitor.service import logs, systemd
from monitor.service.host_metrics import HostMetrics
from monitor.service.outlets import Outlet
from monitor.service.site import Site
from monitor.service.site_store import SiteStore, store_of
from monitor.service.status import has_ended, running
from monitor.service.threads import BlockQueue

_log = logging.getLogger(__name__)

_PACE = 8.0
"""Multiple of real time up to which the blocks of a site keep the place in line that their arrival gave them. [1; judgement: four
topics at once, and what a sensor kept while its link was broken]"""
_STEP_S = 2.0
"""Interval at which requests, health and summary of a site are looked after. [s; cost: at 1 s 8 % of its thread]"""
_STEPS = 8
"""Most sites that are looked after between two blocks. [1; cost: a fraction of a millisecond each]"""
_TICK_S = 0.2
"""Longest wait for a block. [s; judgement]"""
_LOOK_S = 2.0
"""Interval at which the folders and the site files are looked at. [s; judgement]"""
_RETRY_S = (1.0, 300.0)
"""First and longest pause before a site that failed is started again. [s; judgement]"""
_FREE_S = 10.0
"""Time for which nobody monitors a site of another machine's share before it is taken. [s; judgement: a restart takes less]"""
_ENDERS = 8
"""Threads that end sites: each waits for the disk most of the time. [1; judgement]"""
_END_ALL_S = 60.0
"""Time in which all sites end after the stop signal; the process ends then in any case. [s; judgement]"""
_MOST_BLOCKS, _MOST_BYTES = 1024, 2 << 20
"""Bounds of the queue of a site; beyond them its source waits. [1, bytes; cost]"""


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


_P = ParamSpec("_P")
_R = TypeVar("_R")
_SiteWork = Callable[Concatenate["Host", Place, _P], _R]


def named_in_the_log(work: _SiteWork[_P, _R]) -> _SiteWork[_P, _R]:
    """Decorate the work for one site: while it lasts, the lines of the log carry the site's name."""

    @wraps(work)
    def named(host: Host, place: Place, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        before = logs.site_name.set(place.name)
        try:
            return work(host, place, *args, **kwargs)
        finally:
            logs.site_name.reset(before)

    return named


class Host:
    """Monitoring service of many sites.

    A site that cannot be started, or fails, is told by its name and started again after a pause that grows; the others run on.

    Parameters
    ----------
    places : sequence of Path
        Site files, and folders: each ``*.toml`` of a folder is a site, from when it appears until it is removed.
    metrics : (str, int), optional
        Host and port of the endpoint for Prometheus.
    mine : callable
        Whether a file of a folder is one of this process's, where several share a folder.
    standby : bool
        Whether a site that another daemon monitors stands by, and is taken over when that daemon is gone.
    first : callable
        Whether a site is taken as soon as nobody monitors it; any other only when nobody has for some seconds.
    say : callable
        Takes the word READY.

    Raises
    ------
    MissingInputError
        The port of the metrics cannot be opened.
    """

    def __init__(
        self,
        places: Sequence[Path],
        metrics: tuple[str, int] | None = None,
        *,
        mine: Callable[[Path], bool] = lambda _: True,
        standby: bool = False,
        first: Callable[[Path], bool] = lambda _: True,
        clock: Callable[[], float] = time.monotonic,
        say: Callable[[str], None] = lambda word: print(word, file=sys.stderr, flush=True),
    ) -> None:
        self._clock, self._mine, self._say = clock, mine, say
        self._standby, self._first = standby, first
        self._files = [path for path in places if not path.is_dir()]
        self._folders = [path for path in places if path.is_dir()]
        self._places: dict[Path, Place] = {}
        self._line = Line()
        self._arrived: deque[Place] = deque()
        """Sites whose queues changed; any thread appends."""
        self._done: deque[Callable[[], None]] = deque()
        """What other threads want done by the main thread; any thread appends."""
        self._wake = threading.Event()
        self._stopping = self._is_ready = False
        self._end_s = float("inf")
        self._reload_requested = False
        self._rounds: deque[Place] = deque()
        self._warmed: set[object] = set()
        self._names: dict[str, Place] = {}
        self._enders = ThreadPoolExecutor(_ENDERS, "ender")
        self.metrics = None if metrics is None else HostMetrics(metrics, self._states)

    def run(self) -> None:
        """Monitor until SIGTERM or SIGINT arrives, or, where only files are named, until all sources have ended."""
        previous = {number: signal.signal(number, self._request_stop) for number in (signal.SIGTERM, signal.SIGINT)}
        previous[signal.SIGHUP] = signal.signal(signal.SIGHUP, self._request_reload)
        _take_all_files()
        self._look()
        opener = threading.Thread(target=self._open_all, name="opener", daemon=True)
        opener.start()
        try:
            self._loop()
        finally:
            self._stopping = True
            for number, handler in previous.items():
                signal.signal(number, handler)
            self._enders.shutdown(wait=False, cancel_futures=True)
            if self.metrics is not None:
                self.metrics.close(1.0)

    @property
    def places(self) -> Sequence[Place]:
        """The sites of this host."""
        return list(self._places.values())

    def _states(self) -> dict[str, str]:
        """Return what the host does with each site, by its name."""
        return {place.name: place.state.value for place in self.places if not (place.is_over and place.is_removed)}

    def _request_stop(self, number: int, _: object) -> None:
        """Handle SIGTERM and SIGINT: end all sites."""
        self._stopping, self._end_s = True, self._clock() + _END_ALL_S
        self._wake.set()
        signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once

    def _request_reload(self, number: int, _: object) -> None:
        """Handle SIGHUP: read all site files again."""
        self._reload_requested = True
        self._wake.set()

    def _loop(self) -> None:
        """Evaluate the blocks of all sites until all have ended (the main thread's work)."""
        is_stopping = False
        watchdog_s, notified_s = systemd.watchdog_s(), self._clock()
        while True:
            if not (self._line or self._is_step_due(self._clock())):
                self._wake.wait(_TICK_S)
            self._wake.clear()
            while self._done:
                self._done.popleft()()
            while self._arrived:
                self._go_on(self._arrived.popleft())
            if (place := self._line.next()) is not None:
                self._evaluate(place)
            now = self._clock()
            self._step(now)
            if watchdog_s is not None and now - notified_s >= watchdog_s:
                notified_s = now
                systemd.notify("WATCHDOG=1")
            if not self._is_ready and all(self._is_told(place) for place in self.places):
                self._tell_ready()
            if self._reload_requested:
                self._reload_requested = False
                for place in self._running():
                    place.site.ask_to_reload()  # type: ignore[union-attr]
            if self._stopping and not is_stopping:
                is_stopping = True
                systemd.notify("STOPPING=1")
                for place in self.places:
                    self._stop(place)
            if now >= self._end_s:
                late = [place.name for place in self.places if not place.is_over]
                _log.error("not ended within %.0f s: %s", _END_ALL_S, ", ".join(late))
                return
            if all(place.is_over for place in self.places) and (is_stopping or not self._folders):
                return

    def _running(self) -> list[Place]:
        return [place for place in self.places if place.state is State.RUNNING]

    def _is_told(self, place: Place) -> bool:
        """Return whether READY need not wait for a site."""
        if place.site is not None and place.state is State.RUNNING:
            place.is_told = place.is_told or place.site.reader.opened or place.site.reader.lost > 0
        return place.is_told or place.is_over

    def _tell_ready(self) -> None:
        self._is_ready = True
        away = [
            place.name
            for place in self.places
            if place.state is not State.STANDBY
            and (place.site is None or not (place.site.reader.opened or place.is_over))
        ]
        if away:
            _log.warning(
                "%d of %d sites run; tried again: %s", len(self.places) - len(away), len(self.places), ", ".join(away)
            )
        self._say("READY")
        systemd.notify("READY=1")

    def _go_on(self, place: Place) -> None:
        """Put a site in line if a block of it waits; end it if its queue is over."""
        if place.queue is None or place.state not in {State.RUNNING, State.ENDING} or self._line.join(place):
            return
        if place.queue.over:
            queue, place.queue = place.queue, None
            assert queue is not None
            place.state = State.ENDING
            self._enders.submit(self._end, place, True)

    @named_in_the_log
    def _evaluate(self, place: Place) -> None:
        """Evaluate the next block of a site."""
        if place.queue is None or place.site is None or (item := place.queue.take(0.0)) is None:
            return
        begun_s = self._clock()
        try:
            place.site.take(*item)
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            self._fail(place, error)
            return
        block, arrived_s = item
        self._line.spend(place, arrived_s, block.n_samples / block.sample_rate_hz, self._clock() - begun_s)
        self._go_on(place)

    def _is_step_due(self, now: float) -> bool:
        """Return whether it is time to look after a site."""
        return bool(self._rounds) and now - self._rounds[0].stepped_s >= _STEP_S

    def _step(self, now: float) -> None:
        """Look after requests, health and summaries of the sites for which it is time."""
        for _ in range(_STEPS):
            if not self._is_step_due(now):
                return
            place = self._rounds.popleft()
            if place.site is None or place.queue is None:
                continue
            self._step_site(place, place.site, now)

    @named_in_the_log
    def _step_site(self, place: Place, site: Site, now: float) -> None:
        """Look after one site."""
        place.stepped_s = now
        try:
            if site.reader.opened and not place.is_opened:
                place.is_opened = True
                site.tell_open()
            site.step(now)
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            self._fail(place, error)
        else:
            self._rounds.append(place)

    def _fail(self, place: Place, error: Exception) -> None:
        """End a site that failed, without a checkpoint of what it had reached; it is started again after a pause."""
        _log.error("%s failed", place.name, exc_info=error)
        place.failure = f"{type(error).__name__}: {error}"
        place.queue, place.state = None, State.ENDING
        self._enders.submit(self._end, place, False)

    def _stop(self, place: Place) -> None:
        """Have a site end in order: its source closes, what has arrived is evaluated, and a checkpoint is kept."""
        if place.state in {State.WAITING, State.STANDBY}:
            place.state = State.OVER
        elif place.state is State.RUNNING and place.site is not None:
            place.state = State.ENDING
            place.site.ask_to_stop()
            self._enders.submit(place.site.stop_reading)

    # What follows, but for `_over` and `_opened`, is done by other threads.

    def _call(self, job: Callable[[], None]) -> None:
        """Have the main thread do a job."""
        self._done.append(job)
        self._wake.set()

    @named_in_the_log
    def _end(self, place: Place, in_order: bool) -> None:
        """Finish and close a site (in a thread that may wait)."""
        site = place.site
        assert site is not None
        failure = place.failure
        try:
            if self._stopping or place.is_removed:
                site.ask_to_stop()  # its time to end begins now
            if in_order:
                site.finish()
        except Exception as error:  # noqa: BLE001 - as in `_evaluate`
            _log.exception("%s did not end in order", place.name)
            failure = failure or f"{type(error).__name__}: {error}"
        try:
            site.close()
            site.raise_failure()
        except UserError as error:
            failure = failure or str(error)
            _log.error("%s: %s", place.name, error)
        except Exception as error:  # noqa: BLE001 - as in `_evaluate`
            failure = failure or f"{type(error).__name__}: {error}"
            _log.exception("%s failed", place.name)
        self._call(lambda: self._over(place, failure))

    def _over(self, place: Place, failure: str) -> None:
        """Note that a site was closed, and when it is started again."""
        if place.site is not None:  # else the copy goes on to watch for another monitor
            place.out = place.store = None
        place.site, place.failure, place.is_told = None, failure, True
        place.in_line = place.is_opened = False
        if self._names.get(place.name) is place:
            del self._names[place.name]
            if self.metrics is not None:
                self.metrics.remove(place.name)
        if not failure or self._stopping or place.is_removed:
            place.state = State.OVER
            if place.is_removed and self._places.get(place.path) is place:
                del self._places[place.path]
            return
        if self._clock() - place.begun_s > _RETRY_S[1]:
            place.pause_s = 0.0
        self._wait(place)

    @named_in_the_log
    def _wait(self, place: Place) -> None:
        """Have a site started again after a pause."""
        place.pause_s = min(max(_RETRY_S[0], 2.0 * place.pause_s), _RETRY_S[1])
        place.due_s, place.state = self._clock() + place.pause_s, State.WAITING
        _log.warning("%s is started again in %.0f s", place.name, place.pause_s)

    def _open_all(self) -> None:
        """Start sites when they are due, and look for new and removed files (the opener's work)."""
        looked_s = self._clock()
        while not self._stopping:
            now = self._clock()
            if now - looked_s >= _LOOK_S:
                looked_s = now
                with suppress(OSError):  # a folder that cannot be read now
                    self._look()
            waiting = self._due(now)
            if not waiting:
                time.sleep(_TICK_S)
                continue
            for place in waiting:
                if self._stopping:
                    return
                place.due_s = float("inf")
                self._open(place)
                if self._clock() - looked_s >= _LOOK_S:
                    break

    def _due(self, now: float) -> list[Place]:
        """List the sites that are to be started now (in the opener's thread)."""
        due = [place for place in self.places if place.due_s <= now]
        waiting = [place for place in due if place.state is State.WAITING]
        return waiting + [place for place in due if place.state is State.STANDBY and self._is_free(place, now)]

    @named_in_the_log
    def _is_free(self, place: Place, now: float) -> bool:
        """Look whether nobody monitors a site that stands by."""
        place.due_s = now + _LOOK_S
        try:
            if place.out is None:
                self._find_folder(place, configuration.load(place.path))
            assert place.out is not None
            if place.store is not None:
                place.due_s = now + max(_LOOK_S, place.store.every_s)
            is_held = running(place.out) is not False or (place.store is not None and place.store.is_held())
        except UserError:  # which is told when it is started
            return True
        place.free_s = None if is_held else now if place.free_s is None else place.free_s
        if is_held and not place.was_held:
            place.was_held = True
            _log.warning("%s stands by: another daemon monitors it", place.name)
        is_taken = place.free_s is not None and (self._first(place.path) or now - place.free_s >= _FREE_S)
        place.is_told = place.is_told or not is_taken
        if is_taken and place.was_held:
            has_read = has_ended(place.out) if place.store is None else place.store.has_ended()
            if has_read:  # by its own account there is nothing to take over
                self._call(lambda: self._over(place, ""))
                return False
        return is_taken

    def _find_folder(self, place: Place, settings: Configuration) -> None:
        """Note the output folder of a site, and its copy in object storage."""
        place.out = place.path.resolve().parent / settings.output.dir
        place.store = store_of(settings, place.out, self._clock)

    @named_in_the_log
    def _stand_by(self, place: Place) -> None:
        """Have a site wait until nobody else monitors it (in the main thread)."""
        place.queue, place.is_told, place.free_s = None, True, None
        place.state, place.due_s = State.OVER if self._stopping else State.STANDBY, self._clock() + _LOOK_S
        if self.metrics is not None:
            self.metrics.remove(place.name)

    @named_in_the_log
    def _open(self, place: Place) -> None:
        """Start a site."""
        try:
            settings = configuration.load(place.path)
            self._take_name(place, settings.site_name)
            logs.site_name.set(place.name)
            place.queue = BlockQueue(_MOST_BLOCKS, _MOST_BYTES, lambda: self._tell_arrival(place))
            if place.out is None:
                self._find_folder(place, settings)
            outlets: tuple[Outlet, ...] = () if self.metrics is None else (self.metrics.outlet(place.name),)
            site = Site(
                place.path,
                outlets=outlets,
                clock=self._clock,
                queue=place.queue,
                warm=self._warm_up,
                lean=True,
                viewer=False,
                store=place.store,
            )
        except UserError as error:
            if self._standby and isinstance(error, InUseError):  # that daemon was faster
                self._call(lambda: self._stand_by(place))
                return
            says = str(error)
            _log.error("%s does not start: %s", place.name, says)
            self._call(lambda: self._over(place, says))
            return
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            failure = f"{type(error).__name__}: {error}"
            _log.exception("%s does not start", place.name)
            self._call(lambda: self._over(place, failure))
            return
        self._call(lambda: self._opened(place, site))

    def _take_name(self, place: Place, name: str) -> None:
        """Give a site its name; raise BadConfigurationError where another site has it."""
        other = self._names.setdefault(name, place)
        if other is not place:
            raise BadConfigurationError(
                f"{place.path}: the name {name!r} is that of {other.path}; give each site a [site] name of its own"
            )
        place.name = name

    def _warm_up(self, settings: Configuration, healthy: AnyBaseline | None) -> None:
        """Compile what the windows of a site need, once for all sites alike."""
        alike = (settings.structure.kind, settings.refinement.enabled, healthy is None)
        if alike not in self._warmed:
            warm_up(settings, healthy)
            self._warmed.add(alike)

    def _tell_arrival(self, place: Place) -> None:
        self._arrived.append(place)
        self._wake.set()

    @named_in_the_log
    def _opened(self, place: Place, site: Site) -> None:
        """Begin to read the source of a site (in the main thread)."""
        place.site, place.state, place.failure = site, State.RUNNING, ""
        place.begun_s = place.credit_s = self._clock()
        try:
            site.start()
        except Exception as error:  # noqa: BLE001 - as in `_evaluate`
            self._fail(place, error)
            return
        self._rounds.append(place)
        if self._stopping or place.is_removed:
            self._stop(place)

    def _look(self) -> None:
        """Look for site files that are new, were changed or are gone."""
        found = dict.fromkeys(self._files)
        for folder in self._folders:
            found |= dict.fromkeys(path for path in sorted(folder.glob("*.toml")) if self._mine(path))
        for path in found:
            stamp = _stamp(path)
            place = self._places.get(path)
            if place is None:
                self._places[path] = place = Place(path, path.stem, stamp)
                if self._standby:
                    place.state = State.STANDBY
            elif place.stamp != stamp:
                place.stamp = stamp
                self._call(lambda place=place: self._changed(place))  # type: ignore[misc]
        for path, place in list(self._places.items()):
            if path not in found and not place.is_removed:
                self._call(lambda place=place: self._removed(place))  # type: ignore[misc]

    def _changed(self, place: Place) -> None:
        """Read the file of a running site again; look at one that waits at once (in the main thread)."""
        if place.state is State.RUNNING and place.site is not None:
            place.site.ask_to_reload()
        elif place.state in {State.WAITING, State.STANDBY}:
            place.due_s, place.pause_s, place.out, place.store = float("-inf"), 0.0, None, None

    def _removed(self, place: Place) -> None:
        """End the site of a file that is gone (in the main thread)."""
        if place.is_removed:
            return
        place.is_removed = True
        _log.warning("%s ends: %s is gone", place.name, place.path)
        self._stop(place)
        if place.is_over:
            self._over(place, "")


def is_of_share(path: Path, number: int, count: int) -> bool:
    """Return whether a site file is of share `number` of `count`, by its name alone, and whatever worker has it.

    Examples
    --------
    >>> [is_of_share(Path("a.toml"), k, 2) for k in (1, 2)]
    [False, True]
    """
    # Another hash than that of the workers: else all sites of a share might be one worker's.
    return int.from_bytes(hashlib.sha256(path.name.encode()).digest()) % count == number - 1


def _take_all_files() -> None:
    """Raise the number of files that this process may open to what it is allowed: a site has some ten."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return time of change (ns) and size of a file; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
