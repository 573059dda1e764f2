"""Publisher of results as a Rerun recording: a file, a server that viewers join, or both.

The only clock is the data's: all results lie on the timeline ``time``, in UTC.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import ClockHealth
from monitor.core import BoundedQueue, Full, Gap, Samples, WindowResult, Work, Worker
from monitor.damage import Assessment
from monitor.events import Event
from monitor.publish.base import Publisher
from monitor.publish.viewer.scene import FILE_BLOCK_S, LIVE_BLOCK_S, Clocks, Scene
from monitor.signals import Health

if TYPE_CHECKING:
    from monitor.publish.viewer.output import Output
    from monitor.publish.viewer.picture import Item, ResultDrawing

_log = logging.getLogger(__name__)


class RerunPublisher(Publisher):
    """Publisher of results to a file, to viewers that join, or both; no method waits for a viewer or raises.

    The file is written beside itself as ``.part`` and renamed by `close`; viewers join at the address and port `serve`.  A full
    queue of `queue_size` blocks and results makes the caller wait if `lossless` (replay to a file), else it drops and counts
    (daemon).  Errors of any kind, such as an unwritable file or a taken port, show in `failed` and are logged once.
    """

    def __init__(
        self, scene: Scene, *, file: Path | None, serve: tuple[str, int] | None, lossless: bool, queue_size: int = 256
    ) -> None:
        self._scene, self._file, self._serve = scene, file, serve
        self._timeout_s, self._queue_size = 10.0, queue_size
        self._held: list[Item] = []
        """What came before the first result: no viewer can join, so Rerun, which takes a second to load, waits for it."""
        self._output: Output | None = None
        self._picture: ResultDrawing | None = None
        self._cancelled, self._late = False, ""
        queue = BoundedQueue["Item"](queue_size, full=Full.WAIT if lossless else Full.REFUSE)
        work = Work(self._draw, open=None if serve is None else self._begin, finish=self._finish, shut=self._shut)
        self._worker = Worker("the Rerun view", work, queue, ends_on_error=True)
        self._worker.start()

    @property
    def dropped(self) -> int:
        """Number of blocks, results and gaps that found the queue full."""
        return self._worker.dropped

    @property
    def failed(self) -> str | None:
        """Reason why nothing is published any more; None without an error."""
        return self._late or self._worker.failed

    def samples(self, samples: Samples) -> None:
        """Publish conditioned samples, m/s^2, in blocks of any size."""
        self._worker.put(replace(samples, values=samples.values.copy()))  # the caller may reuse its buffer

    def window(self, result: WindowResult, line: str) -> None:
        """Publish the result of a window."""
        self._worker.put(result)

    def event(self, event: Event, line: str) -> None:
        """Publish what is told of an event."""
        self._worker.put(event)

    def gap(self, gap: Gap) -> None:
        """Publish that samples are missing."""
        self._worker.put(gap)

    def health(self, health: Health) -> None:
        """Publish the sensors' health in a span."""
        self._worker.put(health)

    def state(self, assessment: Assessment) -> None:
        """Publish the present state of the structure."""
        self._worker.put(assessment)

    def clocks(self, t_ns: int, clocks: Sequence[ClockHealth]) -> None:
        """Publish the state of the sensor nodes' clocks at a time."""
        self._worker.put(Clocks(t_ns, tuple(clocks)))

    def finding(self, finding: dict[str, Any]) -> None:
        """Publish the finding of a diagnosis."""
        self._worker.put(finding)

    def close(self, timeout_s: float = 10.0) -> None:
        """Publish the waiting results, and finish the file; give up after `timeout_s`."""
        self._timeout_s = timeout_s
        if not self._worker.close(timeout_s):
            self._cancelled, self._late = True, f"not finished within {timeout_s:g} s"
            self._worker.ask_to_end(at_once=True)
            _log.error("the Rerun view is %s", self._late)

    def abort(self, timeout_s: float = 10.0) -> None:
        """Stop at once and leave no file."""
        self._cancelled = True
        self._worker.ask_to_end(at_once=True)
        self._worker.join(timeout_s)

    def _begin(self) -> None:
        from monitor.publish.viewer.output import Output
        from monitor.publish.viewer.picture import ResultDrawing

        self._output = Output(self._scene.name, self._file, self._serve)
        block_s = LIVE_BLOCK_S if self._serve else FILE_BLOCK_S
        picture = self._picture = ResultDrawing(self._scene, self._output.stream, block_s, thin=self._file is not None)
        picture.begin()
        for early in self._held:
            picture.draw(early)
        self._held.clear()

    def _draw(self, item: Item) -> None:
        if self._picture is not None:
            self._picture.draw(item)
            return
        self._held.append(item)
        if len(self._held) >= self._queue_size or not isinstance(item, Samples | Health | Assessment):
            self._begin()

    def _finish(self) -> None:
        """Draw what is left, and give the file its name, unless it is not to be left."""
        if self._cancelled:
            return
        if self._picture is None:
            self._begin()
        assert self._output is not None
        assert self._picture is not None
        self._picture.finish()
        if not self._cancelled:
            self._output.close(self._timeout_s)

    def _shut(self) -> None:
        if self._output is not None:
            self._output.abandon()
