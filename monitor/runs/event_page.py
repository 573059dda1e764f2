"""The page of one event, from the folder of a replay or a daemon: its line, and its recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION, GROUND, RecordingError, RecordingMissingError
from drivers.mcap_file import read_metadata, read_recordings
from monitor.core import BadInputError, MissingInputError, Skipped, WrongUsageError, parse_json, sha256
from monitor.events import Event, Review, Site, review_event
from monitor.publish import EVENTS, EventPage, last_told, read_event, write_event
from monitor.runs.event_recordings import ABOUT, FOLDER
from monitor.signals import FrontEnd, ProcessingSettings

LAST = "last"
"""Word for the latest event. [name; contract]"""
_MOST_NAMED = 20
"""Most events that a message names. [count; judgement]"""


def page_of(folder: Path, id: str) -> Path:
    """Return the place of an event's page, beside its recording."""
    return folder / FOLDER / f"{id}.html"


def read_event_line(folder: Path, wanted: str) -> dict[str, Any]:
    """Read the highest revision of an event, by its id or ``last``, from events.jsonl.

    Raises MissingInputError if there is no events.jsonl or no event in it, and WrongUsageError if there is no such event; the
    message lists those that there are.
    """
    path = folder / EVENTS
    try:
        lines = last_told(path)
    except OSError as error:
        says = f"{path}: {error.strerror}; name a folder of 'replay --out' or of [output] dir"
        raise MissingInputError(says) from error
    if not lines:
        raise MissingInputError(f"{path}: no event was recognized")
    latest = max(lines.values(), key=lambda line: int(line["t_begin_ns"]))
    if wanted != LAST and wanted not in lines:
        known = sorted(lines)[-_MOST_NAMED:]
        raise WrongUsageError(f"--event {wanted}: no such event; there are {', '.join(known)}, and {LAST}")
    return latest if wanted == LAST else lines[wanted]


def write_event_page(folder: Path, line: Mapping[str, Any], out: Path) -> Event:
    """Write the page of an event (as of `read_event_page`) and return the event.

    Raises BadInputError if the line or the recording is damaged, OSError if the page cannot be written.
    """
    page = read_event_page(folder, line)
    write_event(out, page)
    return page.event


def write_event_motion(page: EventPage, out: Path) -> None:
    """Write the motion of an event for the Rerun viewer.

    Raises MissingInputError if no drifts are known: there are no samples of the event, or no chain of stories, or a building.
    """
    if page.site is None or page.review is None:
        raise MissingInputError(f"event {page.event.id} cannot be shown in motion. {page.why_not}")
    if not np.isfinite(page.review.drift_m).any():
        raise MissingInputError(f"event {page.event.id} cannot be shown in motion: no story's drift is known")
    if page.event.drift_corner_m.size:
        raise MissingInputError(
            f"event {page.event.id} cannot be shown in motion: it is not drawn of a building; the event's page has the drifts"
        )
    from monitor.publish import write_motion  # it needs the extra `viewer`

    write_motion(out, page.name, page.event, page.site, page.review)


def read_event_page(folder: Path, line: Mapping[str, Any]) -> EventPage:
    """Read what the page of an event shows, from the folder of the results and the event's line of events.jsonl.

    Raises BadInputError if the line or the recording is damaged.
    """
    try:
        event = read_event(line)
    except (KeyError, TypeError, ValueError) as error:
        raise BadInputError(f"{folder / EVENTS}: not as the monitor writes it ({error!r})") from error
    recording, site, seen, name = line.get("recording"), None, None, ""
    path, why_not = None if recording is None else folder / str(recording), "The event's samples are not kept."
    if path is not None:
        name, site, found = _read_recording(path, event)
        why_not = f"{found.reason[:1].upper()}{found.reason[1:]}." if isinstance(found, Skipped) else ""
        seen = None if isinstance(found, Skipped) else found
    checksum = None if path is None or not path.exists() else sha256(path)
    return EventPage(name or folder.resolve().name, event, recording, checksum, site, seen, why_not)


def _read_recording(path: Path, event: Event) -> tuple[str, Site | None, Review | Skipped]:
    """Read an event's recording: the site's name (empty where it has none), what its files said, and the motion over time."""
    try:
        about = read_metadata(path, ABOUT)
        if about is None:
            return "", None, Skipped("the event's recording does not say of which structure it is")
        site = Site.read(parse_json(about["site"].encode()))
        processing = ProcessingSettings.model_validate_json(about["processing"])
        front_end = FrontEnd(site.channels, processing, segment_s=0.0, n_lags=0)
        blocks = read_recordings([path], (ACCELERATION, GROUND))
        seen = review_event(blocks, front_end, site, event.begin_ns, event.end_ns, event.corner_hz)
        return about.get("name", ""), site, seen
    except RecordingMissingError:
        return "", None, Skipped(f"the event's recording {path.name} is not there")
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        raise BadInputError(f"{path}: damaged, or not as the monitor writes it ({error})") from error
