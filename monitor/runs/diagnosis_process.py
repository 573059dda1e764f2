"""Runs diagnoses in separate processes, so that neither their run time nor their failure affects the session.

``python -m monitor.runs.diagnosis_process`` is such a process.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from threadpoolctl import threadpool_limits

from drivers.base import SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import configuration
from monitor.core import UserError, Work, Worker, demand_place, parse_json, write_atomically
from monitor.damage import load_baseline
from monitor.diagnosis import Request
from monitor.runs.recordings import OnWarning

_log = logging.getLogger(__name__)

_POLL_S = 0.05
"""Interval, s, at which `DiagnosisQueue.wait` polls the findings."""
_WRITE_PAUSE_S = 50e-6
"""Pause between two blocks written, s: the evaluation of new samples, which needs the interpreter too, has priority."""
_NICENESS = 5
"""Niceness that a diagnosis adds to its own, so that the session on the same cores has priority."""
_OOM_SCORE = "500"
"""Adjustment of the kernel's out-of-memory score, half of the greatest: the diagnosis is killed before the session."""


@dataclass(frozen=True, slots=True)
class _Job:
    """Diagnosis with the files that its process reads and writes."""

    number: int
    request: Request
    recording: Path
    result: Path

    @property
    def request_keys(self) -> dict[str, Any]:
        """Keys of a finding that come from its request."""
        r = self.request
        return {"id": f"{self.number:03d}", "t_ns": r.to_ns, "from_ns": r.from_ns, "reason": r.reason}


class DiagnosisQueue:
    """Queue of diagnoses, which run one after the other, each in a new process, for `time_limit_s` at most.

    Every request gives one finding, a dict: the content of diagnosis.json with `id`, `t_ns`, `from_ns` and `reason`, kept as
    ``FOLDER/ID.json``.  If the diagnosis failed, `verdict` is None and `error` gives the reason.  The caller never waits for
    a disk: a thread writes the recording that the process reads, waits for the process and keeps the finding.  Findings of an
    earlier run are removed from the folder.
    """

    def __init__(self, structure: Path, healthy: Path | None, folder: Path, time_limit_s: float) -> None:
        self._structure, self._healthy, self._folder = structure, healthy, folder
        self._time_limit_s = time_limit_s
        self._scratch = tempfile.TemporaryDirectory(prefix="shm-diagnosis-", ignore_cleanup_errors=True)
        self._ready: SimpleQueue[tuple[int, dict[str, Any]]] = SimpleQueue()
        self._pending: dict[int, Request] = {}
        self.submitted = 0
        """Number of requests so far; a finding's id is the number of its request."""
        self._process: subprocess.Popen[bytes] | None = None
        self._worker = Worker("diagnoser", Work(self._do))
        self._worker.start()
        for old in folder.glob("*.json"):
            old.unlink()

    @property
    def pending(self) -> tuple[Request, ...]:
        """Requests that have no finding yet."""
        return tuple(self._pending.values())

    def submit(self, request: Request, blocks: Iterable[SampleBlock]) -> None:
        """Queue a diagnosis of the blocks, which the queue's thread reads; never waits."""
        self.submitted += 1
        self._pending[self.submitted] = request
        recording = Path(self._scratch.name) / f"{self.submitted:03d}.mcap"
        self._worker.put((_Job(self.submitted, request, recording, recording.with_suffix(".json")), blocks))

    def poll(self) -> list[dict[str, Any]]:
        """Return the findings that became ready; never waits."""
        found = []
        with contextlib.suppress(Empty):
            while True:
                number, finding = self._ready.get_nowait()
                del self._pending[number]
                found.append(finding)
        return found

    def wait(self, stop: Callable[[], bool] = lambda: False) -> list[dict[str, Any]]:
        """Wait for the findings of all requests, or until `stop` returns True, and return them."""
        found = self.poll()
        while self._pending and not stop():
            self._worker.wait_for(lambda: not self._ready.empty(), _POLL_S)
            found += self.poll()
        return found

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop the diagnosis that still runs; wait no longer than `timeout_s`."""
        self._worker.ask_to_end(at_once=True)
        if self._process is not None:
            self._process.kill()
        self._worker.join(timeout_s)
        self._scratch.cleanup()

    def _do(self, item: tuple[_Job, Iterable[SampleBlock]]) -> None:
        job, blocks = item
        try:
            error = self._run(job, blocks)
        except OSError as failure:
            error = f"{failure.filename or job.recording}: {failure.strerror or failure}"
        except Exception as failure:  # noqa: BLE001 - whatever fails, each request has a finding: `wait` waits for it
            _log.exception("diagnosis %03d: its data cannot be given to it", job.number)
            error = f"{type(failure).__name__}: {failure}"
        if not self._worker.queue.is_closed:
            self._ready.put((job.number, self._collect(job, error)))

    def _run(self, job: _Job, blocks: Iterable[SampleBlock]) -> str:
        """Run one diagnosis in a process, and return why it failed, or an empty text."""
        with McapWriter(job.recording) as writer:
            for block in blocks:
                writer.write(block)
                time.sleep(_WRITE_PAUSE_S)
        # A new interpreter, never a fork, because threads of this one may hold locks.
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
        if self._worker.queue.is_closed:  # `close` may have run before the process existed
            process.kill()
        try:
            process.wait(self._time_limit_s)
            return ""
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return f"took longer than {self._time_limit_s:g} s"

    def _collect(self, job: _Job, error: str) -> dict[str, Any]:
        """Read the result of a job, keep it as a finding's file, and return the finding."""
        finding = {**job.request_keys, "verdict": None, "says": "", "causes": []}
        try:
            finding |= parse_json(job.result.read_bytes())
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
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        lines = []
    return (lines or ["ended without a result"])[-1]


def main(arguments: list[str]) -> int:
    """Diagnose one recording: ``python -m monitor.runs.diagnosis_process RECORDING OUT.json STRUCTURE [BASELINE]``.

    The exit code is 0, or that of the error, which is printed on standard error.
    """
    recording, out, structure, *healthy = map(Path, arguments)
    os.nice(_NICENESS)
    with contextlib.suppress(OSError):  # not Linux, or not allowed
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE, encoding="ascii")
    warn: OnWarning = lambda message: print(message, file=sys.stderr)  # noqa: E731
    try:
        # The recording was written by `DiagnosisQueue`: a topic map of the site's own recordings does not apply.
        settings = configuration.load(structure).model_copy(update={"topics": {}})
        known = load_baseline(healthy[0], settings.instrumented(), settings.updating) if healthy else None
        with threadpool_limits(limits=1):
            from monitor.runs import diagnose  # loads the compiler: only where a diagnosis runs

            found = diagnose.diagnose([recording], settings, known, warn)
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    write_atomically(out, json.dumps(found.content, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
