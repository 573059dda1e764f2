"""Diagnoses in a process of their own: neither their time nor their failure touches what asked for them."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import configuration
from monitor.core import UserError, demand_place, write_atomically
from monitor.damage import load_baseline
from monitor.diagnosis import Request
from monitor.runs.recordings import OnWarning

_log = logging.getLogger(__name__)

_POLL_S = 0.05
_BREATH_S = 50e-6
"""Between two blocks written: the evaluation, which wants the interpreter too, goes first."""
_MOST_BLOCKS = 200_000
_SPARE_S = 30.0
"""Kept besides: a request comes when the block that completes its window has come, which may be a long one."""


class Recent:
    """The latest blocks as they came, for a diagnosis."""

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
        self._seconds = 0.0
        self._blocks: deque[SampleBlock] = deque()

    def push(self, block: SampleBlock) -> None:
        """Keep a block, forget those too old: by the length of data since, as clocks may stand still or be set back."""
        self._blocks.append(block)
        self._seconds += _length_s(block)
        while (
            self._seconds - _length_s(self._blocks[0]) > self._longest_s + _SPARE_S or len(self._blocks) > _MOST_BLOCKS
        ):
            self._seconds -= _length_s(self._blocks.popleft())

    def between(self, from_ns: int, to_ns: int) -> list[SampleBlock]:
        """Samples taken within the span, however they were cut."""
        return [b for block in self._blocks if (b := _within(block, from_ns, to_ns)).n_samples]


def _within(block: SampleBlock, from_ns: int, to_ns: int) -> SampleBlock:
    """The block's samples of the span."""
    first, end = (
        min(max(ceil(round((t - block.t_ns) * 1e-9 * block.sample_rate_hz, 6)), 0), block.n_samples)
        for t in (from_ns, to_ns)
    )
    if end - first == block.n_samples:
        return block
    t_ns = block.t_ns + round(first / block.sample_rate_hz * 1e9)
    return replace(block, t_ns=t_ns, sequence=block.sequence + first, samples=block.samples[first:end])


def _length_s(block: SampleBlock) -> float:
    return block.n_samples / block.sample_rate_hz if block.topic == ACCELERATION else 0.0


@dataclass(frozen=True, slots=True)
class _Job:
    number: int
    request: Request
    recording: Path
    result: Path

    @property
    def head(self) -> dict[str, Any]:
        r = self.request
        return {"id": f"{self.number:03d}", "t_ns": r.to_ns, "from_ns": r.from_ns, "reason": r.reason}


class Diagnoser:
    """Runs the diagnoses that are asked for, one after the other, each in a new process.

    Every request gives one finding, a dict: diagnosis.json's content with `id`, `t_ns`, `from_ns` and `reason`, kept as
    ``FOLDER/ID.json``; where the diagnosis failed its `verdict` is None and `error` says why.  Whoever asks never waits for
    a disk: a thread writes what the process reads, waits for it and keeps what it found.

    Parameters
    ----------
    structure, healthy : Path
        Structure file, and baseline if there is one.
    folder : Path
        For the findings; those of an earlier run are removed.
    """

    def __init__(self, structure: Path, healthy: Path | None, folder: Path, time_limit_s: float) -> None:
        self._structure, self._healthy, self._folder = structure, healthy, folder
        self._time_limit_s = time_limit_s
        self._scratch = tempfile.TemporaryDirectory(prefix="shm-diagnosis-", ignore_cleanup_errors=True)
        self._jobs: SimpleQueue[tuple[_Job, list[SampleBlock]] | None] = SimpleQueue()
        self._ready: SimpleQueue[tuple[int, dict[str, Any]]] = SimpleQueue()
        self._pending: dict[int, Request] = {}
        self.asked = 0
        """How many so far; findings are numbered by it."""
        self._process: subprocess.Popen[bytes] | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="diagnoser", daemon=True)
        self._thread.start()
        for old in folder.glob("*.json"):
            old.unlink()

    @property
    def pending(self) -> tuple[Request, ...]:
        """What was asked for and is not found yet."""
        return tuple(self._pending.values())

    def ask(self, request: Request, blocks: list[SampleBlock]) -> None:
        """Queue a diagnosis of some blocks."""
        self.asked += 1
        self._pending[self.asked] = request
        recording = Path(self._scratch.name) / f"{self.asked:03d}.mcap"
        self._jobs.put((_Job(self.asked, request, recording, recording.with_suffix(".json")), blocks))

    def poll(self) -> list[dict[str, Any]]:
        """Findings that became ready; never waits."""
        found = []
        with contextlib.suppress(Empty):
            while True:
                number, finding = self._ready.get_nowait()
                del self._pending[number]
                found.append(finding)
        return found

    def wait(self, stop: Callable[[], bool] = lambda: False) -> list[dict[str, Any]]:
        """Findings of everything that was asked for, or of what is ready when `stop` says so."""
        found = self.poll()
        while self._pending and not stop():
            time.sleep(_POLL_S)
            found += self.poll()
        return found

    def close(self, timeout_s: float = 5.0) -> None:
        """End what still runs; waits no longer than `timeout_s`."""
        self._over.set()
        self._jobs.put(None)
        if self._process is not None:
            self._process.kill()
        self._thread.join(timeout_s)
        self._scratch.cleanup()

    def _work(self) -> None:
        while (item := self._jobs.get()) is not None and not self._over.is_set():
            job, blocks = item
            try:
                error = self._run(job, blocks)
            except OSError as failure:
                error = f"{failure.filename or job.recording}: {failure.strerror or failure}"
            if not self._over.is_set():
                self._ready.put((job.number, self._collect(job, error)))

    def _run(self, job: _Job, blocks: list[SampleBlock]) -> str:
        """Let a process diagnose; why it came to nothing, or an empty text."""
        with McapWriter(job.recording) as writer:
            for block in blocks:
                writer.write(block)
                time.sleep(_BREATH_S)
        # A new interpreter, never a fork: threads of this one may hold locks.
        healthy = [] if self._healthy is None else [str(self._healthy)]
        command = [
            sys.executable,
            "-m",
            "monitor.runs.diagnosis_process",
            str(job.recording),
            str(job.result),
            str(self._structure),
        ]
        with job.recording.with_suffix(".log").open("wb") as log:
            process = subprocess.Popen([*command, *healthy], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self._process = process
        if self._over.is_set():  # `close` may have come before it was there to be ended
            process.kill()
        try:
            process.wait(self._time_limit_s)
            return ""
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return f"took longer than {self._time_limit_s:g} s"

    def _collect(self, job: _Job, error: str) -> dict[str, Any]:
        finding = {**job.head, "verdict": None, "says": "", "causes": []}
        try:
            finding |= json.loads(job.result.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            finding["error"] = error or _last_line(job.recording.with_suffix(".log"))
        place = self._folder / f"{finding['id']}.json"
        try:
            demand_place(place)
            write_atomically(place, json.dumps(finding, indent=1, allow_nan=False) + "\n")
            job.recording.unlink(missing_ok=True)
        except (OSError, UserError) as failure:
            _log.warning("%s is not kept: %s", place, failure)
        return finding


def _last_line(log: Path) -> str:
    """The last thing that a diagnosis said."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        lines = []
    return (lines or ["ended without a result"])[-1]


def main(arguments: list[str]) -> int:
    """``python -m monitor.runs.diagnosis_process RECORDING OUT.json STRUCTURE [BASELINE]``."""
    recording, out, structure, *healthy = map(Path, arguments)
    os.nice(5)
    with contextlib.suppress(OSError):  # where memory runs out, the diagnosis goes, not the monitor
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
    warn: OnWarning = lambda message: print(message, file=sys.stderr)  # noqa: E731
    try:
        # The recording is one of ours, whatever the site's own were.
        settings = configuration.load(structure).model_copy(update={"topics": {}})
        known = load_baseline(healthy[0], settings.instrumented(), settings.updating) if healthy else None
        with threadpool_limits(limits=1):
            from monitor.runs import diagnose  # and its compiler: only where a diagnosis is made

            found = diagnose.find([recording], settings, known, warn)
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    write_atomically(out, json.dumps(found.content, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
