"""Command `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, BadParameter, Option

from monitor.cli.common import Json, say, time_ns, warn
from monitor.cli.progress import progress
from monitor.core import MissingInputError, demand_place, require_extra, spare_inputs

_INPUTS = ("results.jsonl", "summary.json", "health.jsonl", "health.jsonl.1", "ledger.jsonl")


def report(
    folder: Annotated[
        Path,
        Argument(metavar="DIR", help="Folder of 'replay --out', of [output] dir, or DIR/runs/NAME of 'reprocess'."),
    ],
    out: Annotated[
        Path | None, Option(metavar="REPORT.html", help="Page to write; of an event by default DIR/events/ID.html.")
    ] = None,
    start: Annotated[
        str | None, Option("--from", metavar="T", help="UTC, ISO 8601; the first window's by default.")
    ] = None,
    end: Annotated[str | None, Option("--to", metavar="T", help="UTC, ISO 8601; the last window's by default.")] = None,
    event: Annotated[
        str | None, Option(metavar="ID", help="Report one event of events.jsonl instead; 'last' for the latest.")
    ] = None,
    motion: Annotated[
        Path | None,
        Option(metavar="FILE.rrd", help="With --event: the frame's motion too, in slow motion for the viewer."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Report a period of a run as one page.  It shows availability, damage, alarms, modes, quality and findings.

    A window belongs to the period in which it ends.  With --event it is the page of one event: motion of the floors, drifts
    against the site's limits, frequencies, loops, and what remains of the stiffness.
    """
    if not folder.is_dir():
        remedy = "give the one that 'replay --out' or [output] dir names"
        raise MissingInputError(f"{folder}: there is no such folder; {remedy}")
    if not (folder / "results.jsonl").exists() and (run := next(folder.glob("runs/*/results.jsonl"), None)) is not None:
        raise MissingInputError(
            f"{folder}: the runs of a 'reprocess', which are reported one by one; give one of {folder / 'runs'}, as {run.parent}"
        )
    if event is not None:
        if start is not None or end is not None:
            raise BadParameter("--event goes without --from and --to")
        _report_event(folder, event, out, motion, as_json)
    elif motion is not None:
        raise BadParameter("--motion goes with --event")
    elif out is None:
        raise BadParameter("missing: name the page to write", param_hint="--out")
    else:
        _report_period(folder, out, start, end, as_json)


def _report_event(folder: Path, wanted: str, out: Path | None, motion: Path | None, as_json: bool) -> None:
    """Write the page of one event, and its motion where a file for that is named."""
    from monitor.publish import EVENTS, event_text, write_event
    from monitor.runs import page_of, read_event_line, read_event_page, write_event_motion

    line = read_event_line(folder, wanted)
    place = out or page_of(folder, line["id"])
    wanted_files = [place] if motion is None else [place, motion]
    spare_inputs(wanted_files, [folder / EVENTS, *([folder / str(line["recording"])] if line.get("recording") else [])])
    if motion is not None:
        require_extra("viewer", "--motion")
    for path in wanted_files:
        demand_place(path)
    with progress("report", "reads the event's recording"):
        page = read_event_page(folder, line)
        write_event(place, page)
    event = page.event
    content = {"report": str(place), "id": event.id, "revision": event.revision, "verdict": event.verdict}
    text = f"{event.id}: {event_text(event, page.names)}\nreport in {place}"
    if motion is not None:
        write_event_motion(page, motion)
        content["motion"] = str(motion)
        text += f"\nmotion in {motion}: shm-monitor view {motion}"
    say(text, {**content, "exceeded": list(event.exceeded)}, as_json)


def _report_period(folder: Path, out: Path, start: str | None, end: str | None, as_json: bool) -> None:
    """Write the page of a period."""
    from monitor.publish import closed_files, read_period, write_period

    from_ns, to_ns = time_ns("--from", start), time_ns("--to", end)
    if from_ns is not None and to_ns is not None and from_ns >= to_ns:
        raise BadParameter("--from is not before --to")
    spare_inputs([out], [*(folder / name for name in _INPUTS), *closed_files(folder)])
    with progress("report", "reads the results"):
        period = read_period(folder, from_ns, to_ns)
        demand_place(out)
        write_period(out, period)
    r, said, judged, findings = period.results, period.assessment, sum(period.results.judged), len(period.findings)
    if r.damaged:
        warn(f"{folder / 'results.jsonl'}: unreadable lines left out: {r.damaged}")
    content = {
        "report": str(out),
        **said.content,
        "from_ns": r.grid.from_ns,
        "to_ns": r.grid.to_ns,
        "windows": r.course.windows,
        "windows_due": r.due,
        "judged": judged,
        "alarms": period.alarms,
        "events": len(period.events),
        "findings": findings,
    }
    text = f"{judged} of {r.due} windows judged, alarms: {period.alarms}, findings: {findings}"
    say(f"{text}\n{said.state.words}: {said.headline}\nreport in {out}", content, as_json)
