"""Restart of the daemon: whose the folder is, baseline in use, checkpoints, and catching up from the recordings."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from drivers.base import ACCELERATION, SampleBlock
from drivers.disk import PRIVATE_FOLDER, private
from drivers.recorder import recorded
from monitor.config import Configuration
from monitor.core import (
    BadConfigurationError,
    BadInputError,
    os_errors_of,
    parse_json,
    set_aside,
    sha256,
    write_atomically,
)
from monitor.damage import StoryState, WindowFacts, alarm
from monitor.events import EventAlarm
from monitor.pipeline import PipelineState
from monitor.publish import facts_of_line, read_line
from monitor.runs import Session, SessionState, ledger
from monitor.service import serialization
from monitor.service.appended_lines import AppendedLines
from monitor.service.threads import Recording

_log = logging.getLogger(__name__)

_KEYED = (
    "sensors",
    "effects",
    "processing",
    "health",
    "identification",
    "selection",
    "refinement",
    "tracking",
    "updating",
    "temperature",
    "covariates",
    "compensation",
    "events",
)
"""Tables of the site file on which the results depend, besides the structure.  Limits of alarm, quality and watch may change."""
_MOST_LINES_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class Saved:
    """Content of a checkpoint."""

    session: SessionState
    stamp_ns: int
    """Log time of the latest block that the state includes, ns; later blocks are read from the recordings."""
    results_bytes: int
    """Position at the end of results.jsonl: its length in bytes, or a position of `ResultsFile`."""


@dataclass(frozen=True, slots=True)
class KeptAlarms:
    """States of the alarms, stored separately from the checkpoint because they survive a change of the configuration."""

    stories: tuple[StoryState, ...]
    events: tuple[EventAlarm, ...] = ()


def _alarms_of(state: PipelineState) -> KeptAlarms:
    return KeptAlarms(state.alarm.stories, state.events.alarms)


class Checkpointer:
    """Writer of checkpoints, which also resumes a session from the latest one.

    The recorder's thread writes a checkpoint when all blocks that the state includes are on the disk.  So the recordings
    always continue where the checkpoint ends.  With ``checkpoint_s = 0`` only the alarms are written, when they change.
    `key` is the checksum of all that the results depend on; a checkpoint with another one is not resumed from.  `written` has the
    windows, by their indices, whose lines a previous run wrote after its last checkpoint; they are not published again.  While
    `resuming`, blocks are read from the recordings, not from the source.
    """

    dropped = 0  # no checkpoint counts as lost: a newer one replaces one that could not be written

    def __init__(
        self, out: Path, config: Configuration, healthy: Path | None, recording: Recording, lines: AppendedLines
    ) -> None:
        self._out, self._config, self._recording, self._lines = out, config, recording, lines
        tables = config.model_dump(mode="json", include={*_KEYED})
        # Labels and witnesses change no number.
        of_sensors = {"channel", "floor", "axis", "position_m"}
        tables["sensors"] = [s.model_dump(mode="json", include=of_sensors) for s in config.floor_sensors]
        structure = config.structure.model_dump(mode="json", exclude={"name"})
        baseline = None if healthy is None else sha256(healthy)
        self.key = serialization.fingerprint({"tables": tables, "structure": structure, "baseline": baseline})
        self._alarm_key = ""
        self._place, self._alarms = out / "state" / "checkpoint", out / "state" / "alarms"
        self._seconds, self._due, self._busy = 0.0, False, False
        self._last: KeptAlarms | None = None
        self._resumed_at = 0
        """Position of the lines of windows that a previous run wrote and that are still to come again."""
        self.written: dict[int, WindowFacts] = {}
        self.resuming = False
        self.failed: str | None = None

    def resume(self, begin: Callable[[], Session], known: Callable[[dict[str, Any]], None]) -> int:
        """Begin a session, restore the state in which the previous run stopped, and return the end of the samples processed then.

        That is UTC, ns since 1970; 0 without a usable checkpoint.  Then only the alarms are restored: an announced alarm stays
        active until the data, or an operator, end it.  `known` receives each line of results.jsonl since the checkpoint.
        """
        saved = serialization.load(self._place, self.key, Saved) if self._config.state.checkpoint_s else None
        session = begin()
        # Alarms are identified by the numbers of their stories, or of their modes: they outlast any change of the configuration.
        kinds = [serialization.fingerprint({"alarms of": kind}) for kind in ("stories", "modes")]
        self._alarm_key, other_key = kinds if self._config.has_model else kinds[::-1]
        if saved is not None:
            self._resumed_at = saved.results_bytes
            for line, facts in self._lines_since(saved.results_bytes):
                self.written[line["window"]] = facts
                known(line)
            session.stated = dict(self.written)
            self.resuming = True
            try:
                self._catch_up(session, saved)
                return session.now_ns
            except Exception:  # noqa: BLE001 - whatever is wrong with the old state, monitoring must go on
                _log.exception("%s: not resumed from; monitoring begins anew", self._place)
                session.online_diagnosis.close()
                session = begin()
                self.written.clear()
            finally:
                self.resuming = False
        kept = serialization.load(self._alarms, self._alarm_key, KeptAlarms)
        alike = kept is not None
        if kept is None and self._alarms.exists():
            kept = serialization.load(self._alarms, other_key, KeptAlarms)
        if kept is not None:
            stories = kept.stories
            session.alter_alarm(lambda state: alarm.carry_over(state, stories, alike=alike))
            session.alter_events(lambda _: kept.events)
        self.save(session)  # so that a run that ends before its first regular checkpoint is resumed too
        return 0

    @property
    def busy(self) -> bool:
        """Whether a checkpoint is being written."""
        return self._busy

    def took(self, session: Session, block: SampleBlock) -> None:
        """Count a block whose results were published, and write a checkpoint if one is due."""
        every_s = self._config.state.checkpoint_s
        self._seconds += block.n_samples / block.sample_rate_hz if block.topic == ACCELERATION else 0.0
        is_time = self._seconds >= every_s if every_s else self._last != _alarms_of(session.pipeline.state)
        if self._due or is_time:
            self.save(session)

    def save(self, session: Session) -> None:
        """Write a checkpoint in the background; with ``checkpoint_s = 0`` only the alarms."""
        self._due = bool(self._busy or self._lines.failed)
        if self._due:
            return
        self._busy, self._seconds, self._last = True, 0.0, _alarms_of(session.pipeline.state)
        position = self._resumed_at if session.stated else self._lines.position
        if not self._recording.then(partial(self._write, session.state, position)):
            self._busy, self._due = False, True

    def forget(self) -> None:
        """Remove the checkpoint after the end of the stream, so that the next run begins anew."""
        for place in (self._place, self._alarms):
            self._recording.then(partial(self._forget, place))

    def _forget(self, place: Path, _: int) -> None:
        serialization.forget(place)

    def _write(self, state: SessionState, results_bytes: int, stamp_ns: int) -> None:
        try:
            self._lines.sync()
            if self._lines.failed:
                raise OSError(self._lines.failed)
            serialization.save(self._alarms, self._alarm_key, _alarms_of(state.pipeline))
            if self._config.state.checkpoint_s:
                serialization.save(self._place, self.key, Saved(state, stamp_ns, results_bytes))
            self.failed = None
        except OSError as error:
            self.failed = f"{self._place}: {error.strerror or error}"
            _log.warning("no checkpoint: %s", self.failed)
        finally:
            self._busy = False

    def _catch_up(self, session: Session, saved: Saved) -> None:
        """Restore the checkpoint and process the blocks recorded since.

        Blocks from shortly before the checkpoint are kept for diagnoses and events, which may need them.
        """
        folder, restored = self._out / "recordings", False
        from_ns = max(0, saved.stamp_ns - round(session.longest_s * 1e9))
        for stamp_ns, block in recorded(folder, from_ns) if self._config.recorder.enabled else ():
            if stamp_ns <= saved.stamp_ns:
                session.keep_block(block)
                continue
            if not restored:
                session.restore(saved.session)
                restored = True
            with contextlib.suppress(BadInputError):
                session.push(block)
        if not restored:
            session.restore(saved.session)

    def _lines_since(self, position: int) -> list[tuple[dict[str, Any], WindowFacts]]:
        """Read the windows' lines of results.jsonl after a position; damaged ones are left out, with a message."""
        found, damaged = [], 0
        for text in filter(bytes.strip, self._lines.lines_after(position, _MOST_LINES_BYTES)):
            try:
                line = {"window": None} | read_line(text)
                if line["window"] is not None:
                    found.append((line, facts_of_line(line)))
            except (ValueError, KeyError, TypeError, IndexError):
                damaged += 1
        if damaged:
            _log.warning("%s: %d damaged lines are left out", self._out / "results.jsonl", damaged)
        return found


def note_baseline(out: Path, site: Path, healthy: Path | None) -> None:
    """Record in the ledger that the baseline differs from that of the previous run."""
    place = out / "state" / "baseline.json"
    present = {"baseline_sha256": None if healthy is None else sha256(healthy)}
    try:
        previous = parse_json(place.read_bytes())
    except FileNotFoundError:
        previous = None
    except ValueError as error:
        previous = None
        _log.warning("%s: %s; set aside as %s", place, error, set_aside(place).name)
    if previous == present:
        return
    if previous is not None:
        finding = {"says": "monitoring goes on from another baseline", "causes": []}
        ledger.append_entry(out / "results.jsonl", finding, {"site": site, "baseline": healthy}, None)
    write_atomically(place, json.dumps(present) + "\n", private)


def make_private(folder: Path, out: Path) -> None:
    """Make the folder of the state of the output folder `out`, which its owner alone may enter, whatever the umask.

    One that is there keeps its mode.  MissingInputError tells that it cannot be made.
    """
    with os_errors_of(out, "cannot be written: "):
        folder.mkdir(PRIVATE_FOLDER, parents=True, exist_ok=True)


def note_site(state: Path, settings: Configuration) -> None:
    """Note in the folder `state` the name of the site whose it is; one that cannot be read is replaced.

    BadConfigurationError tells that another site writes there, unless the settings say that this one was named so (`formerly`).
    """
    name, place, found = settings.site.name or settings.structure.name, state / "site.json", ""
    try:
        found = str(parse_json(place.read_bytes())["site"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        if not isinstance(error, FileNotFoundError):
            _log.warning("%s: %s; the folder is taken for this site's", place, error)
    if name and found and found not in {name, settings.site.formerly}:
        raise BadConfigurationError(
            f"{state.parent}: the site {found!r} writes here; name another dir under [output], or, where {name!r} is the "
            f"same site, formerly = {json.dumps(found)} under [site]"
        )
    if name and found != name:
        try:
            write_atomically(place, json.dumps({"site": name}) + "\n", private)
        except OSError as error:
            _log.warning("%s: not written: %s", place, error.strerror)
