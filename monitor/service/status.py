"""Status of a daemon, read from its output folder without changing anything there."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

from monitor.core import AlarmCondition, Level, MissingInputError, name_stories, parse_json, tail_lines, utc
from monitor.damage import Assessment, State, outdated
from monitor.publish import EVENTS, read_line
from monitor.runs import ledger, ledger_chain
from monitor.service.boot import boot_time

HEALTHY, ALARM, TROUBLE, DOWN = 0, 10, 11, 12
"""Exit codes: the state is normal and the monitor works; advisory, warning or alarm; doubtful, not judged or a part does not
work; the monitor does not run, or is silent."""
_SILENT_S = 60.0
"""Age of the latest health line beyond which a daemon counts as silent; one is written at least every 10 s."""
_AHEAD_S = 5.0
"""Greatest lead of a health line on the wall clock that counts as a small correction of that clock. [s; judgement]"""
_TAIL_BYTES = 1 << 20
_OPTIONAL = {"doubts": "doubts", "to do": "acknowledge", "web": "web"}
"""Row of the status -> key without whose value it is left out. [none; definition]"""
_DAMAGED = (TypeError, ValueError, KeyError, AttributeError, IndexError, OverflowError, OSError)
"""Errors that a value of a wrong type, in a damaged file, may cause. [none; definition]"""


def running(out: Path) -> bool | None:
    """Return whether a running daemon holds the lock of the output folder; None for a user who may not know."""
    try:
        handle = os.open(out / "state" / "lock", os.O_RDONLY | os.O_CLOEXEC)
    except PermissionError:
        return None
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)  # this also releases the lock
    return False


def has_ended(out: Path) -> bool:
    """Return whether the latest daemon of the output folder has read its source to the end."""
    health = _last_line(out / "health.jsonl", _read_health)
    return bool((health or {}).get("source", {}).get("ended"))


def demand_state(out: Path) -> None:
    """Check that a daemon has written into the folder.

    Raises
    ------
    MissingInputError
        No daemon has ever written there.
    """
    if not (out / "state").is_dir():
        raise MissingInputError(f"{out}: no daemon has written here; give a site file, or the dir of its [output]")


def look(out: Path, site: str = "SITE.toml") -> dict[str, Any]:
    """Read the status of a daemon from its output folder, as `status --json` prints it; `site` is the file that `ack` takes.

    Raises
    ------
    MissingInputError
        There is no such folder, or no daemon has ever written there.
    """
    demand_state(out)
    health = _last_line(out / "health.jsonl", _read_health) or _last_line(out / "health.jsonl.1", _read_health)
    age_s = None if health is None else _age_s(health)
    is_heard, is_locked = age_s is not None and age_s <= _SILENT_S, running(out)
    is_running = is_heard if is_locked is None else is_locked
    summary = _read(out / "summary.json")
    result = _last_line(out / "results.jsonl", partial(read_line, defaults={"alarm": {}}))
    assessment, troubles = read_assessment(summary or {}), troubles_of(health) if is_running else []
    code, process = exit_code(assessment.state, troubles), "running"
    if not (is_running and is_heard):
        code, process = DOWN, "silent" if is_running else "not running"
        says = "is silent" if is_running else "does not run"
        since = "" if health is None else f" since {utc(health['wall_ns'])} UTC"
        until_ns = None if result is None else int(result["t_end_ns"])
        assessment = outdated(assessment, f"the monitor {says}{since}", until_ns)
    return {
        **assessment.content,
        "monitor": process,
        "exit_code": code,
        "troubles": troubles,
        "acknowledge": _acknowledge(summary or {}, site),
        "dir": str(out),
        "running": is_running,
        "silent_s": age_s,
        "summary": summary,
        "health": health,
        "web": (health or {}).get("web") if is_running else None,
        "result": result,
        "event": _last_line(out / EVENTS, _read_event),
        "ledger_head": ledger_chain.read_head(out / ledger.LEDGER),
    }


def verify_ledger(out: Path) -> tuple[int, int]:
    """Check the ledger in a daemon's output folder, and return its number of lines and of event recordings that are as it says.

    Raises
    ------
    BadInputError
        The chain is broken, lacks the line that the daemon named last, or a recording of an event is another than it says.
    MissingInputError
        The ledger, or a recording that it names, cannot be read.
    """
    health = _last_line(out / "health.jsonl", _read_named_head, last=None)  # lines of a start name none
    lines = ledger_chain.verify(out / ledger.LEDGER, [] if health is None else [health["ledger_head"]])
    return lines, ledger.verify_recordings(out / ledger.LEDGER)


def read_assessment(content: Mapping[str, Any]) -> Assessment:
    """Read the state of the structure from a summary or an answer.

    Where an older monitor does not say it, it is that of the alarm, or else `not_judged`.
    """
    try:
        state = State(content["state"])
        return Assessment(state, str(content["headline"]), tuple(map(str, content.get("doubts") or ())))
    except (KeyError, ValueError, TypeError):
        alarm = content.get("alarm")
        level = str(alarm.get("level")) if isinstance(alarm, dict) else None
        if isinstance(alarm, dict) and level in {State.ADVISORY, State.WARNING, State.ALARM}:
            return Assessment(State(level), str(alarm.get("reason") or "An alarm stands."))
        return Assessment(State.NOT_JUDGED, "The monitor has not said its state.")


def exit_code(state: State, troubles: Collection[str]) -> int:
    """Return the exit code for the state of a structure whose monitor runs, and for what does not work of the monitor."""
    if state in {State.ADVISORY, State.WARNING, State.ALARM}:
        return ALARM
    return TROUBLE if troubles or state is not State.NORMAL else HEALTHY


def tell(status: dict[str, Any]) -> str:
    """Format the status of a daemon in ten lines, the state first; doubts, what is to be done and the page have one more each."""
    summary, health, result = (status[k] or {} for k in ("summary", "health", "result"))
    parts = health.get("source"), health.get("recorder"), summary.get("quality")
    source, recorder, quality = (part or {} for part in parts)
    makers: dict[str, Callable[[], str]] = {
        "state": lambda: f"{State(status['state']).words.upper()}: {status['headline']}",
        "doubts": lambda: " ".join(status["doubts"]),
        "monitor": lambda: _monitor(status, health),
        "source": lambda: _source(source, health, status),
        "quality": lambda: _quality(quality, health),
        "windows": lambda: f"{summary.get('windows', 0)}, {summary.get('skipped', 0)} skipped; {_latest(result)}",
        "modes": lambda: _pairs(result.get("frequencies_hz"), result.get("frequencies_std_hz"), "Hz", 1.0),
        **_changes(summary, result),
        "alarm": lambda: name_stories(_alarm(summary.get("alarm"), result), _names(summary)) + _reference(result)[1],
        "to do": lambda: "; ".join(status["acknowledge"]),
        "recorder": lambda: _recorder(recorder, health, status),
        "findings": lambda: _findings(summary.get("findings") or []),
        "event": lambda: last_event(status["event"]) or "none",
        "web": lambda: str(status["web"]),
    }
    if status["acknowledge"]:  # what calls for a person comes first
        makers = {name: makers[name] for name in ("state", "alarm", "to do")} | makers
    absent = {name for name, key in _OPTIONAL.items() if not status.get(key)}
    rows = [(name, _readable(make)) for name, make in makers.items() if name not in absent]
    return "\n".join(f"{name:<9} {text}" for name, text in rows)


def _readable(make: Callable[[], str]) -> str:
    """Make the text of a row, or say that what it is made of is damaged."""
    try:
        return make()
    except _DAMAGED:
        return "cannot be read: the file is damaged"


def _monitor(status: dict[str, Any], health: dict[str, Any]) -> str:
    up_s = health.get("uptime_s")
    last_line = "not heard of" if status["silent_s"] is None else f"heard of {status['silent_s']:.0f} s ago"
    up = f", up {up_s / 3600:.1f} h" if status["running"] and up_s is not None else ""
    lost = "".join(f"; {n} lost on the way to {name}" for name, n in health.get("lost", {}).items())
    refused = health.get("refused") or {}
    blocked = f"; blocked: {'; '.join(status['troubles'])}" if status["troubles"] else ""
    turned_away = (
        f"; blocks refused: {refused['blocks']}, the latest: {refused['latest']}" if refused.get("blocks") else ""
    )
    is_at_work = status["monitor"] == "running"
    works = "; all parts work" if is_at_work and not (blocked or turned_away or lost) else ""
    return f"{status['monitor']}{up}, {last_line}{blocked}{turned_away}{lost}{works}"


def _source(source: dict[str, Any], health: dict[str, Any], status: dict[str, Any]) -> str:
    says = source.get("says") or "not known"
    at_work = says if status["monitor"] == "running" or source.get("ended") else _last_heard(health, status)
    trouble = f"{source['trouble']}; " if source.get("connected") and source.get("trouble") else ""
    return f"{at_work}; {trouble}{_delay(health, status['silent_s'])}"


def _last_heard(health: dict[str, Any], status: dict[str, Any]) -> str:
    """Say when a monitor that does not run, or is silent, spoke last: what its parts do since then is not known."""
    if "wall_ns" not in health:
        return "not at work"
    return f"{'not heard of since' if status['running'] else 'ended at'} {_utc(health['wall_ns'])}"


def _reference(result: dict[str, Any]) -> tuple[str, str]:
    """Say what losses refer to without a baseline, and what that means for alarms; empty texts with one."""
    if not str((result.get("alarm") or {}).get("reason")).startswith("no baseline"):
        return "", ""
    return " against the structure file", "; no baseline, so none can be raised"


def _names(summary: dict[str, Any]) -> list[str]:
    return list((summary.get("known") or {}).get("names") or ())


def _changes(summary: dict[str, Any], result: dict[str, Any]) -> dict[str, Callable[[], str]]:
    """Return the row of what was lost, or without a model of how the frequencies changed."""
    known = summary.get("known")
    if not isinstance(known, dict) or known.get("n_modes") is None:
        return {"loss": lambda: _pairs(result.get("ddi"), result.get("ddi_std"), "%" + _reference(result)[0], 100.0)}
    unit = "% of each frequency"
    return {"change": lambda: _pairs(result.get("frequency_change"), result.get("frequency_change_std"), unit, 100.0)}


def _findings(found: list[dict[str, Any]]) -> str:
    return f"{len(found)}; latest: {found[-1].get('says') or found[-1].get('reason')}" if found else "none"


def _read_event(text: bytes) -> dict[str, Any]:
    """Read a line of events.jsonl; raise ValueError if it is none."""
    line = parse_json(text)
    if not isinstance(line, dict) or not isinstance(line.get("id"), str):
        raise ValueError("it has no id")
    return line


def last_event(event: Mapping[str, Any] | None) -> str:
    """State an event by its line: when, the verdict, and the largest drift; empty where there was none."""
    if event is None:
        return ""
    drifts = [(value, j) for j, value in enumerate(event["drift_peak_m"], 1) if value is not None]
    least = "at least " if event.get("saturated") or event.get("cut") else ""
    largest = f"; largest drift {least}{1e3 * max(drifts)[0]:.3g} mm in story {max(drifts)[1]}" if drifts else ""
    return f"{event['id']}: {event['verdict'] or 'no limit was judged'}{largest}"


def _acknowledge(summary: Mapping[str, Any], site: str) -> list[str]:
    """Return the command that acknowledges each alarm of a story or an event that waits for it, the gravest first."""
    try:
        alarm = summary.get("alarm") or {}
        waiting = [story for story in _by_level(alarm) if alarm["conditions"][story].endswith("unacknowledged")]
        of = [f"--story {int(story)}" for story in waiting]
        normal = AlarmCondition.NORMAL.value
        events = [e["id"] for e in summary.get("event_alarms") or () if e["condition"] != normal]
        of += [f"--event {quote(str(id))}" for id in events]
    except _DAMAGED:
        return []
    return [f"shm-monitor ack {quote(site)} {which} --who NAME" for which in of]


def _by_level(alarm: Mapping[str, Any]) -> list[str]:
    """List the stories that have an alarm, the gravest first."""
    levels = list(map(str, Level))
    return sorted(alarm.get("conditions", {}), key=lambda j: -levels.index(alarm["active"].get(j, Level.NORMAL)))


def _age_s(health: dict[str, Any]) -> float | None:
    """Return the time since a health line was written, s; None if it is not known.

    Within one run of the machine the clock that nobody sets tells the age.  A line of an earlier run is at least as old as this
    one, whatever the wall clock says; without either a line that lies ahead of the wall clock is of no known age.
    """
    boot_id, boot_s = boot_time()
    wall_s = (time.time_ns() - health["wall_ns"]) * 1e-9
    if "boot_s" not in health:  # this system does not tell
        return wall_s if wall_s >= -_AHEAD_S else None
    age_s = boot_s - health["boot_s"] if health["boot_id"] == boot_id else max(wall_s, boot_s)
    return age_s if age_s >= 0.0 else None


def troubles_of(health: Mapping[str, Any] | None) -> list[str]:
    """List what does not work by a line of health: the source, the recorder, outputs; each once.

    A source that is read to its end is no fault.

    Examples
    --------
    >>> troubles_of({"source": {"connected": False, "says": "lost (bus off); tried again in 8 s; 1 times lost"}})
    ['source: lost (bus off); tried again in 8 s; 1 times lost']
    >>> troubles_of({"source": {"connected": False, "error": "", "ended": True}})
    []
    """
    if not health:
        return []
    source, recorder = health.get("source") or {}, health.get("recorder")
    at_work = source.get("connected") or source.get("ended")
    troubles = {} if at_work else {"source": source.get("says") or "not connected"}
    troubles |= {} if recorder is None or recorder.get("recording") else {"recorder": recorder.get("detail")}
    return [f"{name}: {why}" for name, why in (troubles | (health.get("failed") or {})).items()]


def _delay(health: dict[str, Any], silent_s: float | None) -> str:
    t_ns, age_s = health.get("t_ns"), health.get("data_age_s")
    until = "no data in the last span" if t_ns is None else f"data until {_utc(t_ns)}"
    return until if age_s is None or silent_s is None else f"{until}, the last {age_s + silent_s:.0f} s ago"


def _quality(quality: dict[str, Any], health: dict[str, Any]) -> str:
    share = quality.get("availability")
    refused = (health.get("refused") or {}).get("blocks", 0)
    return (
        f"{'nothing received' if share is None else f'{100 * share:.2f} % available'}, {quality.get('gaps', 0)} gaps, "
        f"{quality.get('lost_s', 0.0):.1f} s lost, {refused} blocks refused, queue {health.get('queue', 0)}"
    )


def _latest(result: dict[str, Any]) -> str:
    if not result:
        return "none yet"
    fit = "" if result.get("misfit") is None else f", goodness of fit {result['misfit']:.2f}"
    return f"latest {_utc(result['t_end_ns'])}: {result['skipped'] or 'judged'}{fit}"


def _pairs(values: list[float] | None, stds: list[float] | None, unit: str, scale: float) -> str:
    """Format values with their standard deviations, scaled to `unit`."""
    if not values or not stds:
        return "the latest window says nothing"
    known = [(v, s) for v, s in zip(values, stds, strict=False) if v is not None and s is not None]
    texts = (f"{scale * v:.3f} +- {scale * s:.3f}" for v, s in known)
    return ", ".join(texts) + f" {unit}"


def _alarm(alarm: dict[str, Any] | None, result: dict[str, Any]) -> str:
    if alarm is None:
        return str((result.get("alarm") or {}).get("level", "nothing known"))
    names = {"0": "the whole structure"}
    parts = [
        f"{names.get(j, f'story {j}')} {alarm['active'].get(j, 'normal')} ({condition})"
        for j in _by_level(alarm)
        for condition in [alarm["conditions"][j]]
    ]
    return "; ".join([str(alarm["level"]), *parts])


def _recorder(recorder: dict[str, Any], health: dict[str, Any], status: dict[str, Any]) -> str:
    if not recorder:
        return "off"
    state = "recording" if recorder["recording"] else f"PAUSED: {recorder['detail']}"
    state = state if status["monitor"] == "running" else _last_heard(health, status)
    free = health.get("disk_free_bytes")
    return f"{state}, {recorder['lost_blocks']} blocks lost, {'?' if free is None else f'{free / 2**30:.1f}'} GiB free"


def _utc(t_ns: int) -> str:
    return f"{utc(t_ns, seconds=True)} UTC"


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return _read_object(path.read_bytes())
    except (OSError, ValueError):
        return None


def _read_object(text: bytes) -> dict[str, Any]:
    """Read a JSON object that can be written again; raise ValueError if it is none."""
    content = parse_json(text)
    json.dumps(content, allow_nan=False)  # 1e999 is read as an infinity
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")
    return content


def _read_health(text: bytes) -> dict[str, Any]:
    """Read a line of health.jsonl; raise ValueError if it is none."""
    line = _read_object(text)
    kinds = {"wall_ns": int, "source": dict, "recorder": dict | None, "failed": dict}
    fits = all(isinstance(line.get(key, ""), kind) for key, kind in kinds.items())
    if not (fits and 0 <= line["wall_ns"] < 1 << 62):
        raise ValueError("it is no line of health")
    if "boot_s" in line and not (isinstance(line["boot_s"], float | int) and isinstance(line.get("boot_id"), str)):
        raise ValueError("its time since the start of the machine is none")
    return line


def _read_named_head(text: bytes) -> dict[str, Any]:
    """Read a line of health.jsonl that names the ledger's head; raise ValueError if it is none."""
    line = _read_health(text)
    if not isinstance(line.get("ledger_head"), str):
        raise ValueError("it names no head of the ledger")
    return line


def _last_line(path: Path, read: Callable[[bytes], dict[str, Any]], *, last: int | None = 2) -> dict[str, Any] | None:
    """Read the last complete line that can be read; None if it is not one of the `last` lines (None: of the file's end)."""
    rows = tail_lines(path, _TAIL_BYTES)
    for row in reversed(rows if last is None else rows[-last:]):
        try:
            return read(row)
        except ValueError:
            continue
    return None
