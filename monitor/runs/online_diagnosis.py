"""Diagnoses that results ask for: which data they are given, and what they found."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.core import WindowResult
from monitor.diagnosis import trigger
from monitor.runs.diagnosis_process import Diagnoser, Recent

_MOST_FINDINGS = 1000
FINDING_KEYS = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")
"""What a summary keeps of a finding."""


@dataclass(frozen=True, slots=True)
class WatcherState:
    """Diagnoses: which episode is watched, what is known, and what is still to be made."""

    episode: trigger.WatchState
    t_ns: int
    found: tuple[str, ...]
    """Findings, each as JSON."""
    pending: tuple[trigger.Request, ...]
    asked: int


class Watcher:
    """Asks for a diagnosis where the results call for one."""

    def __init__(self, config: Configuration, files: tuple[Path, Path | None] | None, folder: Path) -> None:
        self.settings, self._window_s = config.watch, config.processing.window_s
        self.longest_s = max(self.settings.longest_s, 2.0 * self._window_s)
        """Length of data that a diagnosis may be given."""
        self._recent = Recent(self.longest_s)
        self._state, self._t_ns = trigger.WatchState(), 0
        self.found: deque[dict[str, Any]] = deque(maxlen=_MOST_FINDINGS)
        """The latest findings."""
        self._diagnoser = Diagnoser(*files, folder, self.settings.time_limit_s) if files is not None else None

    @property
    def state(self) -> WatcherState:
        """What to restore; blocks are to be remembered again besides."""
        found = tuple(json.dumps({key: f[key] for key in FINDING_KEYS}) for f in self.found)
        pending, asked = ((), 0) if self._diagnoser is None else (self._diagnoser.pending, self._diagnoser.asked)
        return WatcherState(self._state, self._t_ns, found, pending, asked)

    def restore(self, state: WatcherState) -> None:
        """Go on from there; what was being diagnosed is asked for anew, of the blocks remembered."""
        self._state, self._t_ns = state.episode, state.t_ns
        self.found.extend(json.loads(text) for text in state.found)
        if self._diagnoser is not None:
            self._diagnoser.asked = state.asked - len(state.pending)
            for request in state.pending:
                self._ask(request)

    def remember(self, block: SampleBlock) -> None:
        """Keep a block for a diagnosis."""
        self._recent.push(block)

    def saw(self, block: SampleBlock) -> list[dict[str, Any]]:
        """Keep a block for a diagnosis; findings that became ready."""
        if self._diagnoser is None:
            return []
        self.remember(block)
        found = self._diagnoser.poll()
        self.found += found
        return found

    def window(self, result: WindowResult) -> None:
        """Follow the results."""
        self._t_ns = result.t_end_ns
        self._state, request = trigger.step(self._state, result, self.settings, self._window_s)
        self._ask(request)

    def finish(self, stop: Callable[[], bool] = lambda: False) -> list[dict[str, Any]]:
        """Wait for the last findings, unless `stop` says otherwise."""
        self._ask(trigger.finish(self._state, self._t_ns, self.settings, self._window_s))
        found = [] if self._diagnoser is None else self._diagnoser.wait(stop)
        self.found += found
        return found

    def close(self, timeout_s: float = 5.0) -> None:
        """End what still runs; waits no longer than `timeout_s`."""
        if self._diagnoser is not None:
            self._diagnoser.close(timeout_s)

    def _ask(self, request: trigger.Request | None) -> None:
        if request is not None and self._diagnoser is not None:
            self._diagnoser.ask(request, self._recent.between(request.from_ns, request.to_ns))
