"""Publisher of results as a Rerun recording: a file, a server that viewers join, or both.

The only clock is the data's: all results lie on the timeline ``time``, in UTC.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import ClockHealth
from monitor.core import Gap, Samples, WindowResult
from monitor.damage import Assessment
from monitor.events import Event
from monitor.publish.base import Publisher
from monitor.publish.viewer.queue import Worker
from monitor.publish.viewer.scene import FILE_BLOCK_S, LIVE_BLOCK_S, Clocks, Scene
from monitor.signals import Health

if TYPE_CHECKING:
    from monitor.publish.viewer.picture import Item


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
        self._worker: Worker[Item] = Worker("rerun", self._run, queue_size, lossless)

    @property
    def dropped(self) -> int:
        """Number of blocks, results and gaps that found the queue full."""
        return self._worker.dropped

    @property
    def failed(self) -> str | None:
        """Reason why nothing is published any more; None without an error."""
        return self._worker.failed

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
        self._worker.close(timeout_s)

    def abort(self, timeout_s: float = 10.0) -> None:
        """Stop at once and leave no file."""
        self._worker.close(timeout_s, cancel=True)

    def _run(self, take: Callable[[], Item | None]) -> None:
        """Do the work of the thread: open, draw until the queue is closed, finish."""
        held: list[Item] = []
        if self._serve is None:  # no viewer can join: Rerun, which takes a second to load, waits for something to draw
            held = self._until_first_result(take)
            if self._worker.cancelled:
                return
        from monitor.publish.viewer.output import Output
        from monitor.publish.viewer.picture import ResultDrawing

        output = Output(self._scene.name, self._file, self._serve)
        try:
            block_s = LIVE_BLOCK_S if self._serve else FILE_BLOCK_S
            picture = ResultDrawing(self._scene, output.stream, block_s, thin=self._file is not None)
            picture.begin()
            for early in held:
                picture.draw(early)
            while (item := take()) is not None:
                picture.draw(item)
            picture.finish()
            if not self._worker.cancelled:
                output.close(self._timeout_s)
        finally:
            output.abandon()

    def _until_first_result(self, take: Callable[[], Item | None]) -> list[Item]:
        """Hold what comes before the first result, no more than the queue's size."""
        held: list[Item] = []
        while len(held) < self._queue_size and (item := take()) is not None:
            held.append(item)
            if not isinstance(item, Samples | Health | Assessment):
                break
        return held
