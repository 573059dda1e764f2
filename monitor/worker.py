"""Diagnoses in a process of their own: neither their time nor their failure touches what asked for them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import McapWriter
from monitor import baseline, config, discrepancy
from monitor.errors import UserError
from monitor.files import demand_place, write_atomically
from monitor.recordings import OnWarning
from monitor.watch import Request

_POLL_S = 0.05
_MOST_BLOCKS = 200_000


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
        while self._seconds - _length_s(self._blocks[0]) > self._longest_s or len(self._blocks) > _MOST_BLOCKS:
            self._seconds -= _length_s(self._blocks.popleft())

    def between(self, from_ns: int, to_ns: int) -> list[SampleBlock]:
        """Blocks that begin within the span."""
        return [b for b in self._blocks if from_ns <= b.t_ns < to_ns]


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
    ``FOLDER/ID.json``; where the diagnosis failed its `verdict` is None and `error` says why.

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
        self._scratch = tempfile.TemporaryDirectory(prefix="shm-diagnosis-")
        self._waiting: deque[_Job] = deque()
        self._running: tuple[_Job, subprocess.Popen[bytes], float] | None = None
        self.asked = 0
        """How many so far; findings are numbered by it."""
        for old in folder.glob("*.json"):
            old.unlink()

    @property
    def pending(self) -> tuple[Request, ...]:
        """What was asked for and is not found yet."""
        running = () if self._running is None else (self._running[0],)
        return tuple(job.request for job in (*running, *self._waiting))

    def ask(self, request: Request, blocks: list[SampleBlock]) -> None:
        """Queue a diagnosis of some blocks."""
        self.asked += 1
        recording = Path(self._scratch.name) / f"{self.asked:03d}.mcap"
        with McapWriter(recording) as writer:
            for block in blocks:
                writer.write(block)
        self._waiting.append(_Job(self.asked, request, recording, recording.with_suffix(".json")))

    def poll(self) -> list[dict[str, Any]]:
        """Findings that became ready; never waits."""
        found = []
        if self._running is not None:
            job, process, began = self._running
            late = time.monotonic() - began > self._time_limit_s
            if late and process.poll() is None:
                process.kill()
                process.wait()
            if process.poll() is not None:
                found.append(self._collect(job, f"took longer than {self._time_limit_s:g} s" if late else ""))
                self._running = None
        if self._running is None and self._waiting:
            job = self._waiting.popleft()
            self._running = job, self._start(job), time.monotonic()
        return found

    def wait(self, stop: Callable[[], bool] = lambda: False) -> list[dict[str, Any]]:
        """Findings of everything that was asked for, or of what is ready when `stop` says so."""
        found = self.poll()
        while self._running is not None and not stop():
            time.sleep(_POLL_S)
            found += self.poll()
        return found

    def close(self) -> None:
        """End what still runs."""
        if self._running is not None:
            self._running[1].kill()
            self._running[1].wait()
        self._running = None
        self._waiting.clear()
        self._scratch.cleanup()

    def _start(self, job: _Job) -> subprocess.Popen[bytes]:
        # A new interpreter, never a fork: threads of this one may hold locks.
        healthy = [] if self._healthy is None else [str(self._healthy)]
        command = [sys.executable, "-m", "monitor.worker", str(job.recording), str(job.result), str(self._structure)]
        with job.recording.with_suffix(".log").open("wb") as log:
            return subprocess.Popen([*command, *healthy], stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def _collect(self, job: _Job, error: str) -> dict[str, Any]:
        finding = {**job.head, "verdict": None, "says": "", "causes": []}
        try:
            finding |= json.loads(job.result.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            log = job.recording.with_suffix(".log").read_text(encoding="utf-8", errors="replace").strip()
            finding["error"] = error or (log.splitlines() or ["ended without a result"])[-1]
        place = self._folder / f"{finding['id']}.json"
        demand_place(place)
        write_atomically(place, json.dumps(finding, indent=1, allow_nan=False) + "\n")
        job.recording.unlink(missing_ok=True)
        return finding


def main(arguments: list[str]) -> int:
    """``python -m monitor.worker RECORDING OUT.json STRUCTURE [BASELINE]``."""
    recording, out, structure, *healthy = map(Path, arguments)
    os.nice(5)
    warn: OnWarning = lambda message: print(message, file=sys.stderr)  # noqa: E731
    try:
        # The recording is one of ours, whatever the site's own were.
        settings = config.load(structure).model_copy(update={"topics": {}})
        known = baseline.load(healthy[0], settings) if healthy else None
        with threadpool_limits(limits=1):
            found = discrepancy.find([recording], settings, known, warn)
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    write_atomically(out, json.dumps(found.content, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
