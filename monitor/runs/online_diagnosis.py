"""Requests diagnoses from the results of a running session: decides when one is due, and selects its data."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.core import WindowResult
from monitor.diagnosis import trigger
from monitor.runs.diagnosis_process import DiagnosisQueue
from monitor.runs.recent_blocks import RecentBlocks

_MAX_FINDINGS = 1000
"""Findings kept in memory for the summary; the oldest goes first.  Every finding also has a file of its own."""
FINDING_KEYS = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes", "ddi_effect")
"""Keys of a finding that summary.json repeats."""


class BlockStore(Protocol):
    """Store of the latest blocks of samples, from which a diagnosis takes its span."""

    longest_s: float
    """Length of data that are to be pushed again after a restart, s."""

    def push(self, block: SampleBlock) -> None:
        """Keep a block."""

    def between(self, from_ns: int, to_ns: int) -> Iterable[SampleBlock]:
        """Return the samples taken from `from_ns` to `to_ns` (UTC, ns); another thread may read them."""


def longest_diagnosis_s(config: Configuration) -> float:
    """Return the length of data that a diagnosis may be given, s."""
    return max(config.watch.longest_s, 2.0 * config.processing.window_s)


@dataclass(frozen=True, slots=True)
class OnlineDiagnosisState:
    """Checkpoint state of a session's diagnoses: the episode, the findings, and the requests without a finding."""

    episode: trigger.WatchState
    t_ns: int
    """End of the latest window, UTC."""
    found: tuple[str, ...]
    """Each as JSON."""
    pending: tuple[trigger.Request, ...]
    asked: int
    """Number of requests so far, of which those `pending` have no finding yet."""


class OnlineDiagnosis:
    """Controller of the diagnoses of a session: requests a diagnosis when one is due, and collects the findings.

    `[watch]` of the configuration says when one is due.  It reads `files`, the structure or site file and the baseline, without
    which none is made, and the latest blocks of the store, which is in memory by default.
    """

    def __init__(
        self,
        config: Configuration,
        files: tuple[Path, Path | None] | None,
        folder: Path,
        store: BlockStore | None = None,
    ) -> None:
        self.settings, self._window_s = config.watch, config.processing.window_s
        self._recent = RecentBlocks(longest_diagnosis_s(config)) if store is None else store
        self._episode, self._t_ns = trigger.WatchState(), 0
        self.findings: deque[dict[str, Any]] = deque(maxlen=_MAX_FINDINGS)
        """The latest findings."""
        self._queue = DiagnosisQueue(*files, folder, self.settings.time_limit_s) if files is not None else None

    @property
    def longest_s(self) -> float:
        """Length of data that must be kept again before `restore`, s."""
        return self._recent.longest_s

    @property
    def state(self) -> OnlineDiagnosisState:
        """State for a checkpoint; the recent blocks are not part of it and must be kept again after `restore`."""
        findings = tuple(json.dumps({key: f.get(key) for key in FINDING_KEYS}) for f in self.findings)
        pending, submitted = ((), 0) if self._queue is None else (self._queue.pending, self._queue.submitted)
        return OnlineDiagnosisState(self._episode, self._t_ns, findings, pending, submitted)

    def restore(self, state: OnlineDiagnosisState) -> None:
        """Continue from a checkpoint; pending requests are submitted again with the blocks kept before this call."""
        self._episode, self._t_ns = state.episode, state.t_ns
        self.findings.extend(json.loads(text) for text in state.found)
        if self._queue is not None:
            self._queue.submitted = state.asked - len(state.pending)
            for request in state.pending:
                self._submit(request)

    def keep_block(self, block: SampleBlock) -> None:
        """Keep a block for a later diagnosis."""
        self._recent.push(block)

    def push(self, block: SampleBlock) -> list[dict[str, Any]]:
        """Keep a block for a later diagnosis, and return the findings that became ready."""
        if self._queue is None:
            return []
        self.keep_block(block)
        findings = self._queue.poll()
        self.findings += findings
        return findings

    def window(self, result: WindowResult) -> None:
        """Evaluate the result of a window, and submit a diagnosis if one is due."""
        self._t_ns = result.t_end_ns
        self._episode, request = trigger.step(self._episode, result, self.settings, self._window_s)
        self._submit(request)

    def finish(self, stop: Callable[[], bool] = lambda: False) -> list[dict[str, Any]]:
        """Wait for the last findings, unless `stop` returns True, and return them."""
        self._submit(trigger.finish(self._episode, self._t_ns, self.settings, self._window_s))
        findings = [] if self._queue is None else self._queue.wait(stop)
        self.findings += findings
        return findings

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop the diagnosis that still runs; wait no longer than `timeout_s`."""
        if self._queue is not None:
            self._queue.close(timeout_s)

    def _submit(self, request: trigger.Request | None) -> None:
        """Submit a request, if there is one, with its span of the recent blocks."""
        if request is not None and self._queue is not None:
            self._queue.submit(request, self._recent.between(request.from_ns, request.to_ns))
