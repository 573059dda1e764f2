"""Monitoring of many sites in one process: sites are started, ended, and started again where they fail.

One thread evaluates all sites (`monitor.service.schedule`).  Sites are opened by one thread and ended by a few, so that no
site waits for the disk or the network of another.
"""

from __future__ import annotations

import hashlib
import logging
import resource
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

from drivers.disk import destination
from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, InUseError, UserError
from monitor.damage import AnyBaseline
from monitor.runs import warm_up
from monitor.service import logs, systemd
from monitor.service.host_metrics import HostMetrics
from monitor.service.outlets import Outlet
from monitor.service.schedule import TICK_S, Place, Schedule, State, named_in_the_log
from monitor.service.site import Site
from monitor.service.site_store import store_of
from monitor.service.status import has_ended, running
from monitor.service.threads import BlockQueue

_log = logging.getLogger(__name__)

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
        say: Callable[[str], None] = systemd.print_word,
    ) -> None:
        self._clock, self._mine, self._say = clock, mine, say
        self._standby, self._first = standby, first
        self._files = [path for path in places if not path.is_dir()]
        self._folders = [path for path in places if path.is_dir()]
        self._places: dict[Path, Place] = {}
        self._odd: set[Path] = set()
        """Files that were told to be left out, for they are no regular files."""
        self._schedule = Schedule(clock, self._ended, self._fail)
        self._stopping = False
        self._end_s = float("inf")
        self._reload_requested = False
        self._warmed: set[object] = set()
        self._names: dict[str, Place] = {}
        self._enders = ThreadPoolExecutor(_ENDERS, "ender")
        self.metrics = None if metrics is None else HostMetrics(metrics, self._states)

    def run(self) -> None:
        """Monitor until SIGTERM or SIGINT arrives, or, where only files are named, until all sources have ended."""
        with systemd.signals(self._ask_to_stop, self._ask_to_reload):
            _take_all_files()
            self._look()
            opener = threading.Thread(target=self._open_all, name="opener", daemon=True)
            opener.start()
            try:
                self._loop()
            finally:
                self._stopping = True
                self._enders.shutdown(wait=False, cancel_futures=True)
                if self.metrics is not None:
                    self.metrics.close(1.0)

    @property
    def places(self) -> Sequence[Place]:
        """The sites of this host."""
        return list(self._places.values())

    def _states(self) -> dict[str, State]:
        """Return what the host does with each site, by its name."""
        return {place.name: place.state for place in self.places if not (place.is_over and place.is_removed)}

    def _ask_to_stop(self) -> None:
        self._stopping, self._end_s = True, self._clock() + _END_ALL_S
        self._schedule.wake()

    def _ask_to_reload(self) -> None:
        self._reload_requested = True
        self._schedule.wake()

    def _loop(self) -> None:
        """Evaluate the blocks of all sites until all have ended (the main thread's work)."""
        service = systemd.Service(self._clock(), self._say)
        while True:
            now = self._schedule.turn()
            service.at_work(now)
            if not service.is_ready and all(self._is_told(place) for place in self.places):
                self._name_those_away()
                service.tell_ready()
            if self._reload_requested:
                self._reload_requested = False
                for place in self.places:
                    if place.state is State.RUNNING and place.site is not None:
                        place.site.ask_to_reload()
            if self._stopping and service.tell_stopping():
                for place in self.places:
                    self._stop(place)
            if now >= self._end_s:
                late = [place.name for place in self.places if not place.is_over]
                _log.error("not ended within %.0f s: %s", _END_ALL_S, ", ".join(late))
                return
            if all(place.is_over for place in self.places) and (service.is_stopping or not self._folders):
                return

    def _is_told(self, place: Place) -> bool:
        """Return whether READY need not wait for a site."""
        if place.site is not None and place.state is State.RUNNING:
            place.is_told = place.is_told or place.site.reader.opened or place.site.reader.lost > 0
        return place.is_told or place.is_over

    def _name_those_away(self) -> None:
        """Log the sites that do not run, though they do not stand by."""
        tried = [place for place in self.places if place.state is not State.STANDBY]
        away = [p.name for p in tried if p.site is None or not (p.site.reader.opened or p.is_over)]
        if away:
            count = len(self.places)
            _log.warning("%d of %d sites run; tried again: %s", count - len(away), count, ", ".join(away))

    def _ended(self, place: Place) -> None:
        """Have a site end that was evaluated to its end."""
        place.state = State.ENDING
        self._enders.submit(self._end, place, True)

    def _fail(self, place: Place, error: Exception) -> None:
        """End a site that failed, without a checkpoint of what it had reached; it is started again after a pause."""
        if isinstance(error, UserError):  # as the loss of its folder
            _log.error("%s failed: %s", place.name, error)
        else:
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
        except Exception as error:  # noqa: BLE001 - as in `_open`
            _log.exception("%s did not end in order", place.name)
            failure = failure or f"{type(error).__name__}: {error}"
        try:
            site.close()
            site.raise_failure()
        except UserError as error:
            failure = failure or str(error)
            _log.error("%s: %s", place.name, error)
        except Exception as error:  # noqa: BLE001 - as in `_open`
            failure = failure or f"{type(error).__name__}: {error}"
            _log.exception("%s failed", place.name)
        self._schedule.call(partial(self._over, place, failure))

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
                time.sleep(TICK_S)
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
            is_held = running(place.out) is not False or (place.store is not None and place.store.lease.is_held())
        except UserError:  # which is told when it is started
            return True
        place.free_s = None if is_held else now if place.free_s is None else place.free_s
        if is_held and not place.was_held:
            place.was_held = True
            _log.warning("%s stands by: another daemon monitors it", place.name)
        is_taken = place.free_s is not None and (self._first(place.path) or now - place.free_s >= _FREE_S)
        place.is_told = place.is_told or not is_taken
        if is_taken and place.was_held:
            has_read = has_ended(place.out) if place.store is None else place.store.lease.has_ended()
            if has_read:  # by its own account there is nothing to take over
                self._schedule.call(partial(self._over, place, ""))
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
        try:
            settings = configuration.load(place.path)
            self._take_name(place, settings.site_name)
            logs.site_name.set(place.name)
            place.queue = BlockQueue(_MOST_BLOCKS, _MOST_BYTES, partial(self._schedule.tell_arrival, place))
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
                self._schedule.call(partial(self._stand_by, place))
                return
            _log.error("%s does not start: %s", place.name, error)
            self._schedule.call(partial(self._over, place, str(error)))
            return
        except Exception as error:  # noqa: BLE001 - whatever fails of a site may not reach the others
            _log.exception("%s does not start", place.name)
            self._schedule.call(partial(self._over, place, f"{type(error).__name__}: {error}"))
            return
        self._schedule.call(partial(self._opened, place, site))

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

    @named_in_the_log
    def _opened(self, place: Place, site: Site) -> None:
        """Begin to read the source of a site (in the main thread)."""
        place.site, place.state, place.failure = site, State.RUNNING, ""
        place.begun_s = place.credit_s = self._clock()
        try:
            site.start()
        except Exception as error:  # noqa: BLE001 - as in `_open`
            self._fail(place, error)
            return
        self._schedule.add(place)
        if self._stopping or place.is_removed:
            self._stop(place)

    def _look(self) -> None:
        """Look for site files that are new, were changed or are gone."""
        found = dict.fromkeys(self._files)
        for folder in self._folders:
            found |= dict.fromkeys(path for path in sorted(folder.glob("*.toml")) if self._mine(path))
        for path in [*found]:
            try:
                destination(path)
                self._odd.discard(path)
            except OSError as error:  # reading a pipe would wait for ever
                del found[path]
                if path not in self._odd:
                    self._odd.add(path)
                    _log.error("%s is left out: it %s", path, error.strerror)
        for path in found:
            stamp = _stamp(path)
            place = self._places.get(path)
            if place is None:
                self._places[path] = place = Place(path, path.stem, stamp)
                if self._standby:
                    place.state = State.STANDBY
            elif place.stamp != stamp:
                place.stamp = stamp
                self._schedule.call(partial(self._changed, place))
        for path, place in list(self._places.items()):
            if path not in found and not place.is_removed:
                self._schedule.call(partial(self._removed, place))

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
