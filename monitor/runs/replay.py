"""Replays recordings through the pipeline, and writes the results as files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

from drivers.base import SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.core import OnProgress, WindowResult, demand_place, os_errors_of, write_atomically
from monitor.damage import AnyBaseline
from monitor.events import Event
from monitor.publish import EVENTS, LINE_SCHEMA, LinesFile, Publisher, between_recordings, event_text, to_json
from monitor.runs.event_recordings import EventRecordings
from monitor.runs.recordings import (
    OnWarning,
    Progress,
    RecordedSpan,
    overlaps,
    push_block,
    read_blocks,
    recorded_spans,
    without_window,
)
from monitor.runs.session import Session
from monitor.runs.viewer import close_view, open_viewer

__all__ = [
    "RESULT_FILES",
    "ResultFiles",
    "ending",
    "pass_through",
    "recorded_content",
    "replay",
    "warn_of_losses",
    "whole_session",
    "with_first_block_read",
]

RESULT_FILES = ("results.jsonl", EVENTS, "results.mcap", "live.rrd", "summary.json")
"""Files that `replay` writes to its folder."""


class ResultFiles(Publisher):
    """Publisher to the files of a replay; each takes its final name when it is whole, after the last window."""

    def __init__(self, out: Path, *, mcap: bool = True) -> None:
        for name in RESULT_FILES:
            demand_place(out / name)
        self._out = out
        self._lines = LinesFile(out / "results.jsonl")
        self._events = LinesFile(out / EVENTS)
        self._results = McapWriter(out / "results.mcap") if mcap else None
        self.told: dict[str, dict[str, str]] = {}
        """What was told last of each event, by its id."""

    def window(self, result: WindowResult, line: str) -> None:
        """Write the line of a window."""
        self._lines.write(line)
        if self._results is not None:
            self._results.write_json("/results", result.t_end_ns, line, LINE_SCHEMA)

    def event(self, event: Event, line: str) -> None:
        """Write the line of an event, but for a preliminary one."""
        if event.revision is not None:
            self._events.write(line)
            self.told[event.id] = {"id": event.id, "says": event_text(event)}

    def close(self, summary: dict[str, Any], findings: Iterable[dict[str, Any]]) -> None:
        """Finish all files and write summary.json; MissingInputError if the folder cannot be written."""
        with os_errors_of(self._out, "cannot be written: "):
            self._lines.close()
            self._events.close()
            if self._results is not None:
                for finding in findings:
                    self._results.write_json("/findings", finding["t_ns"], to_json(finding))
                self._results.close()
            write_atomically(self._out / "summary.json", to_json(summary) + "\n")

    def abandon(self) -> None:
        """Remove the unfinished files."""
        self._lines.abandon()
        self._events.abandon()
        if self._results is not None:
            self._results.abort()


def replay(
    paths: list[Path],
    config: Configuration,
    baseline: AnyBaseline | None,
    out: Path,
    *,
    speed: float | None = None,
    serve: tuple[str, int] | None = None,
    files: tuple[Path, Path | None] | None = None,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> dict[str, Any]:
    """Run recordings through the pipeline, write `RESULT_FILES` and return the content of summary.json, and the events.

    No alarm is raised without a baseline, and no diagnosis is made without `files`, the structure file and the baseline's.
    `speed` is a multiple of real time, by default as fast as possible; `serve` is an address and a port at which Rerun
    viewers may connect during the replay.

    Raises MissingInputError or BadInputError if the recordings are too short for one window and hold no event, lack channels,
    or cannot be read.
    """
    pieces = {} if speed is None else {"longest_s": 0.0}  # viewers want samples as they were taken
    source = with_first_block_read(
        read_blocks(paths, config, on_warning, **pieces)
    )  # bad input shows before any output is begun
    spans = recorded_spans(paths, config)
    written = ResultFiles(out)
    view = open_viewer(config, baseline, file=out / "live.rrd", serve=serve, lossless=True, on_warning=on_warning)
    publishers = (written,) if view is None else (written, view)
    session = whole_session(config, baseline, publishers, files, out, spans)
    with ending(session, written.abandon, *([] if view is None else [view.abort])):
        factor = pass_through(session, source, paths, spans, speed=speed, on_progress=on_progress, event_suffices=True)
        content = session.content(factor) | recorded_content(session, spans)
        written.close(content, session.online_diagnosis.findings)
        close_view(view, out / "live.rrd", on_warning)
    warn_of_losses(session, spans, on_warning)
    return content | {"events": list(written.told.values())}


def whole_session(
    config: Configuration,
    baseline: AnyBaseline | None,
    publishers: Sequence[Publisher],
    files: tuple[Path, Path | None] | None,
    out: Path,
    spans: list[RecordedSpan],
) -> Session:
    """Make the session of a whole run, with the findings and the recordings of events in the folder `out`."""
    recordings, findings = EventRecordings(out, config.events), out / "findings"
    between = between_recordings(span._asdict() for span in spans)
    return Session(config, baseline, publishers, files, findings, whole=True, recordings=recordings, between=between)


@contextmanager
def ending(session: Session, *abandon: Callable[[], None]) -> Iterator[None]:
    """Abandon the outputs of a session if an error leaves the block, and stop its diagnoses in any case."""
    try:
        yield
    except BaseException:
        for give_up in abandon:
            give_up()
        raise
    finally:
        session.online_diagnosis.close()


def with_first_block_read(source: Iterator[SampleBlock]) -> Iterator[SampleBlock]:
    """Read the first block at once, so that bad input raises its error here; return the iterator of all blocks."""
    return chain([first] if (first := next(source, None)) is not None else [], source)


def pass_through(
    session: Session,
    source: Iterable[SampleBlock],
    paths: list[Path],
    spans: list[RecordedSpan],
    *,
    speed: float | None = None,
    on_progress: OnProgress = lambda _: None,
    event_suffices: bool = False,
) -> float:
    """Push all blocks through a session and wait for the findings; return the length of the data over the run time.

    `speed` is a multiple of real time, by default as fast as possible; time without samples is not waited for. Recordings
    shorter than a window are welcome if `event_suffices` and they hold an event, as those of earthquakes do.
    """
    progress, started = Progress(on_progress, spans=spans), time.monotonic()
    for block in source:
        progress.add(block)
        if speed is not None:
            time.sleep(max(0.0, started + progress.data_s / speed - time.monotonic()))
        push_block(session, block, paths)
    factor = progress.data_s / max(time.monotonic() - started, 1e-9)
    session.finish()
    if not (event_suffices and session.events):
        progress.require_window(session.pipeline, session.windows, paths)
    return factor


def recorded_content(session: Session, spans: list[RecordedSpan]) -> dict[str, Any]:
    """Return the keys of summary.json on what the recordings cover, from which a report counts the windows due."""
    return {
        "recorded": [span._asdict() for span in spans],
        "window_s": session.config.processing.window_s,
        "windows_not_due": session.not_due,
    }


def warn_of_losses(session: Session, spans: list[RecordedSpan], on_warning: OnWarning) -> None:
    """Warn of failed diagnoses, dropped samples and recordings of which nothing is judged, which do not end the replay."""
    for finding in session.online_diagnosis.findings:
        if "error" in finding:
            on_warning(f"finding {finding['id']} ({finding['reason']}) came to nothing: {finding['error']}")
    if session.dropped:
        on_warning(f"{session.dropped} samples were repeated, late or not finite and were dropped")
    processing = session.config.processing
    for says in without_window(spans, processing.window_s, processing.hop_s):
        on_warning(says)
    if double := overlaps(spans):
        on_warning(f"{'; '.join(double)}: samples of one stream alone are judged; leave out the other recording")
