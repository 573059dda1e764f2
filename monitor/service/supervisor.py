"""The process of one site or of many: each site file has a worker that starts its site, ends it, and tries again where it fails.

Sites are opened one after the other and ended a few at a time; in between the main thread evaluates them (`Schedule`).
"""

from __future__ import annotations

import logging
import resource
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import SampleBlock
from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, InUseError, Retry, UserError, Work, Worker, demand_file
from monitor.damage import AnyBaseline
from monitor.runs import warm_up
from monitor.service import logs, systemd
from monitor.service.schedule import Runner, Schedule, State
from monitor.service.site import Site
from monitor.service.site_store import store_of
from monitor.service.status import has_ended, running
from monitor.service.threads import BlockQueue

if TYPE_CHECKING:
    from monitor.service.host_metrics import HostMetrics
    from monitor.service.outlets.metrics import Metrics

_log = logging.getLogger(__name__)

_TICK_S = 0.2
"""Longest wait for a block. [s; judgement]"""
_STEP_S = 2.0
"""Interval at which requests, health and summary of one of many sites are looked after. [s; cost: at 1 s 8 % of its thread]"""
_LOOK_S = 2.0
"""Interval at which folders, site files and sites that stand by are looked at. [s; judgement]"""
_RETRY_S = (1.0, 300.0)
"""First and longest pause before a site that failed is started again. [s; judgement]"""
_FREE_S = 10.0
"""Time for which nobody monitors a site of another machine's share before it is taken. [s; judgement: a restart takes less]"""
_ENDERS = 8
"""Most sites that end at a time: each waits for the disk most of the time. [1; judgement]"""
_END_ALL_S = 60.0
"""Time in which all sites end after the stop signal; the process ends then in any case. [s; judgement]"""
_MOST_BLOCKS, _MOST_BYTES, _MOST_BYTES_ALONE = 1024, 2 << 20, 8 << 20
"""Bounds of the queue of a site; beyond them its source waits. [1, bytes, bytes; cost]"""
Stamp = tuple[int, int] | None
"""Time of change (ns) and size of a file; None where there is none."""


@dataclass(frozen=True, slots=True)
class Policy:
    """How the sites of a process are treated."""

    shared: bool = True
    """Whether sites share the process: what fails of one is told in the log and tried again, files are watched, and sites spare
    memory and processor for each other.  Else there is one, and its error ends the process."""
    standby: bool = False
    """Whether a site that another daemon monitors stands by, and is taken over when that daemon is gone."""
    first: Callable[[Path], bool] = lambda _: True
    """Whether a site that stands by is taken as soon as nobody monitors it; any other only after `_FREE_S`."""
    mine: Callable[[Path], bool] = lambda _: True
    """Whether a file of a folder is one of this process's, where several share a folder."""


ALONE = Policy(shared=False)


class Standby:
    """Whether others monitor a site, by the lock of its output folder and by the copy of that in object storage.

    The copy remembers since when another monitor has not been heard of, and `free_s` since when there is none.
    """

    def __init__(self, path: Path, settings: Configuration, clock: Callable[[], float]) -> None:
        self._clock, self._out = clock, path.resolve().parent / settings.output.dir
        self.store = store_of(settings, self._out, clock)
        self.every_s = max(_LOOK_S, 0.0 if self.store is None else self.store.every_s)
        self._free_s: float | None = None
        self.was_held = False

    def look(self) -> float | None:
        """Return for how long nobody has monitored the site, s; None while somebody does."""
        is_held = running(self._out) is not False or (self.store is not None and self.store.lease.is_held())
        self.was_held, now = self.was_held or is_held, self._clock()
        self._free_s = None if is_held else now if self._free_s is None else self._free_s
        return None if self._free_s is None else now - self._free_s

    def has_ended(self) -> bool:
        """Return whether the monitor that was seen at work has read its source to the end: there is nothing to take over."""
        return self.was_held and (has_ended(self._out) if self.store is None else self.store.lease.has_ended())


class Place:
    """One site file, and what becomes of its site."""

    def __init__(self, path: Path, host: Host, stamp: Stamp) -> None:
        self.path, self.name, self.stamp, self._host = path, path.stem, stamp, host
        self.state = State.STANDBY if host.policy.standby else State.WAITING
        self.runner: Runner | None = None
        self.error: Exception | None = None
        """Why it does not run; None if it does."""
        self.metrics: Metrics | None = None
        """Its metrics, where the host shows them."""
        self._is_told = False
        self._is_changed = self.is_removed = False
        """Whether its file was changed since it was read, or is gone."""
        self._standby: Standby | None = None
        self._retry = Retry((), *_RETRY_S)
        self.worker: Worker[None] = Worker(f"site {self.name}", Work(idle=self._step), clock=host.clock)

    @property
    def is_over(self) -> bool:
        """Whether the process need not wait for it: nothing more is to be done, or it is to end and does not run."""
        return self.state is State.OVER or (self._is_to_end and self.runner is None)

    @property
    def is_told(self) -> bool:
        """Whether READY need not wait for it: its source is open, or, where it is tried again, it was said why not."""
        reader = None if self.runner is None else self.runner.site.reader
        if reader is not None and (reader.opened or (reader.lost and self._host.policy.shared)):
            self._is_told = True
        return self._is_told

    def change(self) -> None:
        """Have the changed site file read: at once where the site waits to be started."""
        if (runner := self.runner) is not None:
            runner.site.ask_to_reload()
        else:
            self._is_changed = True
            self.worker.wake()

    def remove(self) -> None:
        """End the site, whose file is gone."""
        _log.warning("%s ends: %s is gone", self.name, self.path)
        self.is_removed = True
        if (runner := self.runner) is not None:
            runner.site.ask_to_stop()
        self.worker.wake()
        self._forget()

    def open(self) -> None:
        """Open the site."""
        (settings, standby), host, shared = self._load(), self._host, self._host.policy.shared
        for other in host.present:
            if other.name == settings.site_name and other.runner is not None:
                says = f"the name {other.name!r} is that of {other.path}; give each site a [site] name of its own"
                raise BadConfigurationError(f"{self.path}: {says}")
        self.name = settings.site_name
        if shared:
            logs.site_name.set(self.name)
        self.metrics = None if host.metrics is None else host.metrics.outlet(self.name)
        given = {"outlets": () if self.metrics is None else (self.metrics,), "warm": host.warm_up, **host.options}
        most_bytes = _MOST_BYTES if shared else _MOST_BYTES_ALONE
        queue: BlockQueue[SampleBlock] = BlockQueue(
            _MOST_BLOCKS, most_bytes, lambda: host.schedule.tell_arrival(runner)
        )
        how: dict[str, Any] = {"clock": host.clock, "queue": queue, "store": standby.store}
        site = Site(self.path, lean=shared, viewer=not shared, **how, **given)
        self.runner = runner = Runner(self.name, site, queue, self.worker.wake)

    def _load(self) -> tuple[Configuration, Standby]:
        """Read the site file."""
        self._is_changed = False
        demand_file(self.path)  # reading a pipe would wait for ever
        settings = configuration.load(self.path)
        self._standby = self._standby or Standby(self.path, settings, self._host.clock)
        return settings, self._standby

    # What follows is the worker's: each returns after how many seconds it is to go on; None: when it is woken.

    def _step(self) -> float | None:
        """Do what is next."""
        logs.site_name.set(self.name)
        runner = self.runner
        if runner is not None and runner.is_over:
            return self._end(runner)
        if runner is not None and self.state is not State.WAITING:  # it is evaluated
            if self._is_to_end and self.state is State.RUNNING:
                self.state = State.ENDING
                runner.site.stop_reading()
            return None
        if runner is None and self._is_to_end:
            return self._leave()
        if self._is_changed:
            self._standby = None
            self._retry.worked()
        if (left_s := self._retry.due_s - self._host.clock()) > 0.0:
            return left_s
        return self._watch() if self.state is State.STANDBY else self._begin()

    @property
    def _is_to_end(self) -> bool:
        return self._host.is_stopping or self.is_removed

    def _watch(self) -> float | None:
        """Start a site that stands by once nobody else monitors it."""
        try:
            _, standby = self._load()
            was_held, free_s = standby.was_held, standby.look()
            if standby.was_held and not was_held:
                _log.warning("%s stands by: another daemon monitors it", self.name)
            if free_s is None or (free_s < _FREE_S and not self._host.policy.first(self.path)):
                self._is_told = True
                return standby.every_s
            if standby.has_ended():
                return self._leave()
        except UserError as error:
            _log.debug("%s", error)  # it is told when the site is started
        return self._begin()

    def _begin(self) -> float | None:
        """Open the site, unless it is, and have it evaluated."""
        self.error = None
        try:
            if self.runner is None:
                with self._host.opening:
                    if self._is_to_end:
                        return 0.0
                    self.open()
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            self._note(error)
            return self._wait()
        runner = self.runner
        assert runner is not None
        self.state = State.RUNNING
        try:
            runner.site.start()
        except Exception as error:  # noqa: BLE001 - as above
            self._host.schedule.end(runner, error)
        else:
            self._host.schedule.add(runner)
        if self._is_changed:
            self._is_changed = False
            runner.site.ask_to_reload()
        if self._is_to_end:
            runner.site.ask_to_stop()
        return 0.0

    def _end(self, runner: Runner) -> float | None:
        """End the site: in order, or, where it failed, without a checkpoint of what it had reached."""
        self.state = State.ENDING
        if runner.error is not None:
            self._note(runner.error)
        if not self._host.ending.acquire(blocking=False):
            self._host.ending.acquire()
            if self._is_to_end:
                runner.site.ask_to_stop()  # it waited for its turn: its time to end begins now
        try:
            works = runner.site.finish, runner.site.close, runner.site.raise_failure
            for work in works if runner.error is None else works[1:]:
                try:
                    work()
                except Exception as error:  # noqa: BLE001 - as in `_begin`
                    self._note(error)
        finally:
            self._host.ending.release()
        if self._host.clock() - runner.begun_s > _RETRY_S[1]:
            self._retry.worked()
        self._standby = None  # its copy was closed
        return self._wait()

    def _note(self, error: Exception) -> None:
        """Keep why the site does not run; where it is started again the log tells it, else who waits for its end."""
        if self._host.policy.shared and error is not self.error:
            unexpected = not isinstance(error, UserError)  # others are such as the loss of its folder
            _log.error("%s fails: %s", self.name, error, exc_info=error if unexpected else None)
        self.error = self.error or error

    def _wait(self) -> float | None:
        """Have a site that failed started again after a pause, or stand by for who was faster; else leave."""
        if self._host.policy.shared:
            self.runner, self.metrics, self._is_told = None, None, True
        if self.error is None or self._is_to_end or not self._host.policy.shared:
            return self._leave()
        if self._host.policy.standby and isinstance(self.error, InUseError):
            self.state = State.STANDBY
            return _LOOK_S
        pause_s = self._retry.again(self._host.clock())
        self.state = State.WAITING
        _log.warning("%s is started again in %.0f s", self.name, pause_s)
        return pause_s

    def _leave(self) -> float | None:
        """Do nothing more."""
        self.state = State.OVER
        self._forget()
        self.worker.ask_to_end()
        self._host.schedule.wake()
        return None

    def _forget(self) -> None:
        """Make room for another site of the same file, if this one has ended and its file was gone."""
        if self.is_removed and self.state is State.OVER:
            self._host.places.pop(self.path, None)


class Host:
    """Monitoring service of one site or of many, in one process.

    `places` are site files, and folders, of which each ``*.toml`` is a site from when it appears until it is removed; `metrics`
    are host and port of the endpoint for Prometheus; `say` takes the word READY; other `options` are those of each `Site`.  A
    site that is alone is open when this returns.

    MissingInputError tells that the port of the metrics cannot be opened; of a site that is alone, `Site` says what else.
    """

    def __init__(
        self,
        places: Sequence[Path],
        policy: Policy,
        metrics: tuple[str, int] | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        tick_s: float = _TICK_S,
        say: Callable[[str], None] = systemd.print_word,
        **options: Any,
    ) -> None:
        self.policy, self.clock, self._say, self.options = policy, clock, say, options
        self.schedule = Schedule(clock, _STEP_S if policy.shared else 0.0, tick_s)
        self._named, self._folders = [p for p in places if not p.is_dir()], [p for p in places if p.is_dir()]
        self.places: dict[Path, Place] = {}
        self._stop_s = float("inf")
        self.opening, self.ending = threading.Lock(), threading.Semaphore(_ENDERS)
        self._warmed: set[object] = set()
        self.metrics: HostMetrics | None = None
        if metrics is not None:
            from monitor.service.host_metrics import HostMetrics  # its library is loaded only where it is asked for

            self.metrics = HostMetrics(metrics, lambda: [(one.name, one.state, one.metrics) for one in self.present])
        if not policy.shared:
            self.places = {path: Place(path, self, None) for path in self._named}
            for place in self.places.values():
                place.open()

    def run(self) -> None:
        """Monitor until SIGTERM or SIGINT arrives, or, where only files are named, until all sources have ended.

        The error of a site that is alone is raised.
        """
        looker: Worker[None] = Worker(
            "site files", Work(idle=self._look), retry=Retry((OSError,), _LOOK_S, _LOOK_S), clock=self.clock
        )
        with systemd.signals(self._ask_to_stop, self._ask_to_reload):
            _take_all_files()
            for place in self.present:
                place.worker.start()
            if self.policy.shared:
                self._look()
                looker.start()
            try:
                self._loop()
            finally:
                looker.ask_to_end(at_once=True)
                if self.metrics is not None:
                    self.metrics.close(1.0)
        for place in self.places.values():
            if place.error is not None and not self.policy.shared:
                raise place.error

    def _loop(self) -> None:
        """Evaluate the blocks of all sites until all have ended."""
        service = systemd.Service(self.clock(), self._say)
        while (self._folders and not self.is_stopping) or not all(place.is_over for place in self.present):
            now = self.schedule.turn()
            service.at_work(now)
            if "READY" not in service.told and all(place.is_told for place in self.present):
                service.tell("READY")
            if self.is_stopping and service.tell("STOPPING"):
                for place in self.present:
                    place.worker.wake()
            if now >= self._stop_s + _END_ALL_S:
                late = [place.name for place in self.present if not place.is_over]
                _log.error("not ended within %.0f s: %s", _END_ALL_S, ", ".join(late))
                return

    # Signal handlers: they may wait for no lock.

    def _ask_to_stop(self) -> None:
        self._stop_s = self.clock()
        for site in self._open_sites:
            site.ask_to_stop()

    def _ask_to_reload(self) -> None:
        for site in self._open_sites:
            site.ask_to_reload()

    @property
    def _open_sites(self) -> Sequence[Site]:
        return [runner.site for place in self.present if (runner := place.runner) is not None]

    # What the workers of all places use.

    @property
    def is_stopping(self) -> bool:
        """Whether all sites are to end, and none is to be opened."""
        return self._stop_s < float("inf")

    @property
    def present(self) -> Sequence[Place]:
        """The places now: workers add and remove some."""
        return list(self.places.values())

    def warm_up(self, settings: Configuration, healthy: AnyBaseline | None) -> None:
        """Compile what the windows of a site need, once for all sites alike."""
        alike = (settings.structure.kind, settings.refinement.enabled, healthy is None)
        if alike not in self._warmed:
            warm_up(settings, healthy)
            self._warmed.add(alike)

    def _look(self) -> float:
        """Take note of site files that are new, were changed or are gone; return after how many seconds to look again."""
        found = dict.fromkeys(self._named)
        for folder in self._folders:
            found |= dict.fromkeys(path for path in sorted(folder.glob("*.toml")) if self.policy.mine(path))
        for path in found:
            stamp, place = _stamp(path), self.places.get(path)
            if place is None:
                self.places[path] = place = Place(path, self, stamp)
                place.worker.start()
            elif place.stamp != stamp:
                place.stamp = stamp
                place.change()
        for place in self.present:
            if place.path not in found and not place.is_removed:
                place.remove()
        return _LOOK_S


def _stamp(path: Path) -> Stamp:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _take_all_files() -> None:
    """Raise the number of files that this process may open to what it is allowed: a site has some ten."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
