"""Jobs of the processes of `reprocess`: survey a recording, replay a run of recordings, diagnose a recording."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, RecordingError
from drivers.disk import destination
from drivers.mcap_file import recording_info
from monitor.config import configuration
from monitor.core import UserError, WindowResult, keep_freed, no_empty_folder, write_atomically
from monitor.damage import load_baseline
from monitor.publish import WINDOWS_SCHEMA, Publisher, windows_table
from monitor.runs.archive.inventory import Survey
from monitor.runs.baselines import load_healthy
from monitor.runs.object_storage import address, local_copies
from monitor.runs.recordings import OnWarning, evenly, read_blocks, recorded_spans
from monitor.runs.replay import (
    ResultFiles,
    ending,
    pass_through,
    recorded_content,
    warn_of_losses,
    whole_session,
    with_first_block_read,
)

WINDOWS, RUNS, DIAGNOSES = "windows", "runs", "diagnoses"
"""Folders in the output: the Parquet dataset, the files of each run as a replay writes them, the diagnosis of each recording."""
METADATA_KEY = b"shm-monitor"
"""Key of a Parquet file's metadata that holds its run."""
_ROW_GROUP = 2048
"""Number of windows in a row group, which is written at once."""


@dataclass(frozen=True, slots=True)
class Task:
    """Task of a process: the inputs and the output of one result."""

    name: str
    stream: str
    paths: tuple[Path, ...]
    structure: Path
    baseline: Path | None
    out: Path


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one task."""

    name: str
    paths: tuple[Path, ...]
    error: str | None = None
    """Reason for the failure."""
    made: bool = True
    """False if the result existed already."""
    warnings: list[str] = field(default_factory=list)


class WindowsFile(Publisher):
    """Publisher of the windows of a run to one file of the dataset, row group by row group."""

    def __init__(
        self, scratch: Path, final: Path, stream: str, kept: dict[str, Any], *, row_group: int = _ROW_GROUP
    ) -> None:
        self._scratch, self._final, self._stream, self._row_group = scratch, final, stream, row_group
        schema = WINDOWS_SCHEMA.with_metadata({METADATA_KEY: json.dumps(kept).encode()})
        self._file = pq.ParquetWriter(scratch, schema, compression="zstd")
        self._lines: list[dict[str, Any]] = []

    def window(self, result: WindowResult, line: str) -> None:
        """Add the line of a window; write a row group when it is full."""
        self._lines.append(json.loads(line))
        if len(self._lines) >= self._row_group:
            self._flush()

    def close(self) -> None:
        """Finish the file and move it to the dataset."""
        self._flush()
        self._file.close()
        os.replace(self._scratch, destination(self._final))

    def abandon(self) -> None:
        """Remove the unfinished file."""
        self._file.close()
        self._scratch.unlink(missing_ok=True)

    def _flush(self) -> None:
        """Write the kept lines as a row group."""
        if self._lines:
            self._file.write_table(
                windows_table(self._lines, self._stream).replace_schema_metadata(self._file.schema.metadata)
            )
            self._lines = []


def survey_recording(item: tuple[Path, dict[str, str]]) -> Survey | str:
    """Survey a recording, given with its map of ROS 2 topics; return an error message if it cannot be used."""
    path, topics = item
    try:
        with local_copies([path]) as ((copy,), _):
            info = recording_info(copy, topic_map=topics or None, evenly=evenly)
    except (RecordingError, UserError) as error:
        return str(error)
    channels = info.channels[ACCELERATION]
    return Survey(address(path.parent), channels, info.sample_rate_hz, info.t_start_ns, info.t_end_ns, path)


def replay_run(task: Task) -> Outcome:
    """Replay the recordings of one run, and write the files of a replay and its part of the dataset."""
    keep_freed()
    return _outcome(task, _replay)


def diagnose_recording(task: Task) -> Outcome:
    """Diagnose one recording, and write the diagnosis."""
    return _outcome(task, _diagnose)


def _outcome(task: Task, job: Callable[[Task, list[Path], OnWarning], None]) -> Outcome:
    """Do the job of a task with the files to read, and return what became of it."""
    outcome = Outcome(task.name, task.paths)
    try:
        with threadpool_limits(limits=1), local_copies(task.paths) as (paths, named):
            job(task, paths, lambda text: outcome.warnings.append(named(text)))
    except UserError as error:
        return replace(outcome, error=str(error))
    except OSError as error:
        return replace(outcome, error=f"{error.filename or task.out}: {error.strerror or error}")
    return outcome


def _replay(task: Task, paths: list[Path], on_warning: OnWarning) -> None:
    settings = configuration.load(task.structure)
    healthy = None if task.baseline is None else load_healthy(task.baseline, settings)
    folder = task.out / RUNS / task.name
    source = with_first_block_read(read_blocks(paths, settings, on_warning))
    with no_empty_folder(folder):
        folder.mkdir(parents=True, exist_ok=True)
        kept = {"recordings": list(map(address, task.paths)), "stream": task.stream}
        rows = WindowsFile(folder / "windows.part", task.out / WINDOWS / f"{task.name}.parquet", task.stream, kept)
        written = ResultFiles(folder, mcap=False)  # the dataset holds the windows for tools that read no JSON lines
        spans = recorded_spans(paths, settings)
        session = whole_session(settings, healthy, (rows, written), (task.structure, task.baseline), folder, spans)
        with ending(session, rows.abandon, written.abandon):
            factor = pass_through(session, source, paths, spans, event_suffices=True)
            written.close(session.content(factor) | recorded_content(session, spans) | kept, ())
            rows.close()  # the run counts as done once this file is there, so it comes last
        warn_of_losses(session, spans, on_warning)


def _diagnose(task: Task, paths: list[Path], on_warning: OnWarning) -> None:
    from monitor.runs import diagnose

    settings = configuration.load(task.structure)
    file = task.baseline
    known = None if file is None else load_baseline(file, settings.instrumented(), settings.updating)
    found = diagnose.diagnose(paths, settings, known, on_warning)
    final = task.out / DIAGNOSES / f"{task.name}.json"
    write_atomically(final, json.dumps(found.content, indent=1, allow_nan=False) + "\n")
