"""Reprocesses archives: replays many recordings, each run of them once, in several processes or on a cluster (Dask).

The results of a run equal those of `replay` for its recordings.  They get their final names when they are whole, and existing
results are not computed again, so that an interrupted command continues where it stopped.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import dask
import pyarrow.parquet as pq
from dask.callbacks import Callback

from monitor.config import configuration as config
from monitor.core import (
    MissingInputError,
    OnProgress,
    Step,
    UserError,
    os_errors_of,
    parse_json,
    spare_inputs,
    write_atomically,
)
from monitor.runs.archive.inventory import Run, Survey, file_version, fingerprint, group_into_runs
from monitor.runs.archive.jobs import (
    DIAGNOSES,
    METADATA_KEY,
    RUNS,
    WINDOWS,
    Outcome,
    Task,
    diagnose_recording,
    replay_run,
    survey_recording,
)
from monitor.runs.baselines import load_healthy
from monitor.runs.object_storage import address

Job = TypeVar("Job")
Done = TypeVar("Done")
_SURVEYS = "surveys.json"
Work = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""Function that applies a function to all jobs in parallel, and returns the results in order."""


def reprocess(
    recordings: Sequence[Path],
    structure: Path,
    baseline: Path | None,
    out: Path,
    *,
    diagnose: bool = False,
    longest_gap_s: float | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    on_progress: OnProgress = lambda _: None,
) -> list[Outcome]:
    """Replay all recordings without results, and `diagnose` each by itself if asked; alarms request their diagnoses in any case.

    Recordings of one folder are replayed together over gaps of at most `longest_gap_s`, by default the length of a window.
    The work is done by the workers of the Dask scheduler at an address, which see the same files, else by `workers` processes
    on this machine, by default one for each core.
    Outcomes are those of every run and diagnosis, and of every recording that cannot be read.

    Raises WrongUsageError if a result would overwrite an input, and BadConfigurationError or MissingInputError if the structure
    file or the baseline cannot be used.
    """
    spare_inputs([out / _SURVEYS], [*recordings, structure, baseline])
    settings = config.load_with_model(structure) if diagnose else config.load(structure)
    if baseline is not None:
        load_healthy(baseline, settings)
    inputs = settings.model_dump_json(exclude={"output", "source"})
    configuration = fingerprint(inputs, "" if baseline is None else baseline.read_text(encoding="utf-8"))
    with os_errors_of(out, "cannot be written: "):
        for folder in (WINDOWS, RUNS, DIAGNOSES):
            (out / folder).mkdir(parents=True, exist_ok=True)

    with _open_workers(scheduler, workers, on_progress) as work:
        surveys, failed = _survey_recordings(recordings, settings.topics, out, work)
        gap_s = settings.processing.window_s if longest_gap_s is None else longest_gap_s
        wanted = group_into_runs(surveys, gap_s)
        tasks = [_task(run.name(configuration), run.stream, run.paths, structure, baseline, out) for run in wanted]
        outcomes = _compute_missing(replay_run, tasks, [out / WINDOWS / f"{task.name}.parquet" for task in tasks], work)
        if diagnose:
            single = [Run(s.folder, (s.path,), (s.version,), s.t_start_ns, s.t_end_ns) for s in surveys]
            tasks = [_task(one.name(configuration), one.stream, one.paths, structure, baseline, out) for one in single]
            outcomes += _compute_missing(
                diagnose_recording, tasks, [out / DIAGNOSES / f"{task.name}.json" for task in tasks], work
            )
        _remove_superseded(
            out, {run.name(configuration): run for run in wanted}, failed=[o.name for o in outcomes if o.error]
        )
    return failed + outcomes


def _task(name: str, stream: str, paths: tuple[Path, ...], structure: Path, baseline: Path | None, out: Path) -> Task:
    return Task(name, stream, paths, structure.resolve(), baseline and baseline.resolve(), out.resolve())


def _compute_missing(
    function: Callable[[Task], Outcome], tasks: Sequence[Task], results: Sequence[Path], work: Work
) -> list[Outcome]:
    """Compute the results that do not exist."""
    existing = [Outcome(t.name, t.paths, made=False) for t, r in zip(tasks, results, strict=True) if r.exists()]
    return existing + work(function, [t for t, r in zip(tasks, results, strict=True) if not r.exists()])


@contextmanager
def _open_workers(scheduler: str | None, workers: int | None, on_progress: OnProgress) -> Iterator[Work]:
    """Open the workers: this process if one is enough, several processes on this machine, or a cluster."""
    count = workers or os.cpu_count() or 1
    if scheduler is not None:
        from distributed import Client, as_completed

        try:
            client = Client(scheduler, timeout="30s")
        except (OSError, ValueError) as error:
            raise MissingInputError(f"--scheduler {scheduler}: cannot be reached: {error}") from error

        def on_cluster(function: Callable[[Job], Done], jobs: Sequence[Job]) -> list[Done]:
            futures = client.map(function, jobs, pure=False)
            for number, _ in enumerate(as_completed(futures), start=1):
                on_progress(Step("", number, len(jobs), "jobs"))
            return list(client.gather(futures))

        with client:
            yield on_cluster
        return
    # New interpreters, never forks, because threads of this one may hold locks.
    with ProcessPoolExecutor(count, get_context("spawn")) as pool:
        options = {"scheduler": "sync"} if count == 1 else {"scheduler": "processes", "pool": pool, "chunksize": 1}

        def on_this_machine(function: Callable[[Job], Done], jobs: Sequence[Job]) -> list[Done]:
            number = iter(range(1, len(jobs) + 1))
            with Callback(posttask=lambda *_: on_progress(Step("", next(number, len(jobs)), len(jobs), "jobs"))):
                return list(dask.compute(*[dask.delayed(function, pure=False)(job) for job in jobs], **options))

        yield on_this_machine


def _survey_recordings(
    recordings: Sequence[Path], topics: dict[str, str], out: Path, work: Work
) -> tuple[list[Survey], list[Outcome]]:
    """Survey each recording once, and keep the surveys in ``surveys.json``; return surveys and failures."""
    kept_in = out / _SURVEYS
    try:
        kept: dict[str, Any] = parse_json(kept_in.read_bytes())
    except (OSError, ValueError):
        kept = {}
    surveys, failed, new = [], [], []
    for path in recordings:
        try:
            known = kept.get(key := file_version(path))
        except OSError as error:
            failed.append(Outcome(str(path), (path,), f"{path}: cannot be opened: {error.strerror}"))
            continue
        except UserError as error:
            failed.append(Outcome(address(path), (path,), str(error)))
            continue
        if known is None:
            new.append((key, path))
        else:
            as_made = {"channels": tuple(known["channels"]), "path": Path(known["path"]), "version": key}
            surveys.append(Survey(**{**known, **as_made}))
    surveyed = work(survey_recording, [(path, topics) for _, path in new])
    for (key, path), found in zip(new, surveyed, strict=True):
        if isinstance(found, str):
            failed.append(Outcome(str(path), (path,), found))
        else:
            surveys.append(replace(found, version=key))
            kept[key] = asdict(found) | {"path": str(path)}
    write_atomically(kept_in, json.dumps(kept, indent=0) + "\n")
    return surveys, failed


def _remove_superseded(out: Path, now: dict[str, Run], failed: list[str]) -> None:
    """Remove files of the dataset whose recordings are part of another run now, so that no window is in it twice."""
    covered = {address(path) for name, run in now.items() if name not in failed for path in run.paths}
    for file in (out / WINDOWS).glob("*.parquet"):
        if file.stem not in now:
            metadata = pq.read_schema(file).metadata or {}
            if covered & set(json.loads(metadata.get(METADATA_KEY, b"{}")).get("recordings", ())):
                file.unlink()
                shutil.rmtree(out / RUNS / file.stem, ignore_errors=True)
