"""Outbox of messages: stored on the disk until every address has received them, by urgency and in bounded number.

The newest message on a story's alarm, an event, the source and so on stands for those before it that an address has not received
either: it is delivered first and tells them in one line.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import threading
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivers.disk import private, sync_folder
from monitor.core import decode, encode, parse_json, set_aside, write_atomically
from monitor.service.outlets.notices import Notice, Told

_log = logging.getLogger(__name__)

VERSION = 1
MOST_MESSAGES = 256
_NUMBER = re.compile(rb'"(?:next_)?id": (\d{1,15})\b')
"""Numbers of messages in a file, damaged or not."""
_NO_TIMES: dict[str, Any] = {"judged_ns": None, "doubt_ns": None}


@dataclass(frozen=True, slots=True)
class Message:
    """Notice with the state of its delivery."""

    id: int
    """Number that increases as long as the file exists; a recipient can recognize repeats by it."""
    when: str
    """Time of creation, UTC, ISO 8601."""
    notice: Notice
    to: tuple[str, ...]
    """Keys of the addresses that have not received it."""

    @property
    def subject(self) -> str:
        """What it tells the state of; of a notice that none supersedes, the message itself."""
        return f"{self.notice.kind} {self.id if self.notice.about is None else self.notice.about}"


class Outbox:
    """Messages to deliver and the state that was announced last, in one file that is replaced as a whole with every change.

    The announced state `told` and the messages change together, so that no crash can make them inconsistent.  Changes are made
    in memory, by any thread, and never wait for the disk; `save` writes them.  A file that cannot be read is renamed.  If the
    disk does not accept the file, the messages stay in memory and `failed` says so.  Beyond `most` messages those that are
    superseded are given up first, then the oldest of the least urgent, and counted in `dropped`.  `tell` is called after each
    change, and when it is stored; `keep` once it is on the disk, to store the file elsewhere too.
    """

    def __init__(
        self,
        path: Path,
        most: int = MOST_MESSAGES,
        tell: Callable[[], None] = lambda: None,
        keep: Callable[[], object] = lambda: None,
    ) -> None:
        self._path, self._most, self._tell, self._keep_elsewhere = path, most, tell, keep
        self._messages: list[Message] = []
        self._next_id = self._stored_id = 1
        self._unsaved = False
        self._lock = threading.RLock()
        self.told = Told()
        self.dropped = 0
        self.failed: str | None = None
        self._load()

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, told: Told, notices: Iterable[Notice], to: Sequence[str]) -> None:
        """Queue notices for the addresses with the keys `to`; `told` is the announced state after the notices."""
        when = datetime.now(UTC).isoformat(timespec="seconds")
        notices = list(notices)
        if not notices and told == self.told:
            return
        with self._lock:
            # Times change with every window; their change alone is not worth a write.
            self._unsaved |= bool(notices) or replace(told, **_NO_TIMES) != replace(self.told, **_NO_TIMES)
            self.told = told
            for notice in notices:
                self._messages += [Message(self._next_id, when, notice, tuple(to))] if to else []
                self._next_id += 1
            self._give_up()
            self._tell()

    def first(self, key: str, but: Collection[str] = (), lately: Sequence[str] = ()) -> Message | None:
        """Return the message that the address `key` is to receive next, of no subject of `but`; None if there is none.

        That is the newest of the most urgent kind.  Urgent kinds take turns, so that many of one kind hold up none of another:
        `lately` lists those that were delivered to the address, the latest last.
        """

        def place(message: Message) -> tuple[bool, int, int, int]:
            notice = message.notice
            turn = lately.index(notice.kind) if notice.kind in lately else -1
            return not notice.urgent, turn, notice.rank, -message.id

        with self._lock:
            return min((m for m in self._messages if key in m.to and m.subject not in but), key=place, default=None)

    def has_stored(self, message: Message) -> bool:
        """Return whether the file knows the number of a message, which no other one gets then, or cannot be written."""
        return message.id < self._stored_id or self.failed is not None

    def superseded(self, message: Message, key: str) -> list[Message]:
        """Return what the address `key` has not received of the earlier messages on the subject of `message`, oldest first."""
        with self._lock:
            return [m for m in self._messages if key in m.to and m.subject == message.subject and m.id < message.id]

    def delivered(self, message: Message, key: str) -> None:
        """Record that the address `key` has received a message, and with it those that it supersedes."""
        with self._lock:
            self._keep(
                replace(m, to=tuple(k for k in m.to if k != key))
                if m.subject == message.subject and m.id <= message.id
                else m
                for m in self._messages
            )

    def only(self, keys: Iterable[str]) -> None:
        """Keep only messages to the addresses with these keys, because the other addresses were removed."""
        known = set(keys)
        with self._lock:
            self._keep(replace(m, to=tuple(k for k in m.to if k in known)) for m in self._messages)

    def save(self) -> None:
        """Write the present messages if the file holds others; one thread at a time may call this."""
        with self._lock:
            if not self._unsaved:
                return
            self._unsaved, next_id = False, self._next_id
            # Times are not stored: while the monitor is off there are no windows, so they mean nothing after a restart.
            told = encode(replace(self.told, **_NO_TIMES))
            head = {"version": VERSION, "next_id": next_id, "told": told}
            lines = [json.dumps(line) for line in (head, *map(encode, self._messages))]
        try:
            write_atomically(self._path, "\n".join(lines) + "\n", private)
            sync_folder(self._path.parent)
            self._keep_elsewhere()
            self.failed, self._stored_id = None, next_id
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror or error}"
            self._unsaved = True
        self._tell()

    def _keep(self, messages: Iterable[Message]) -> None:
        """Replace the messages by those of `messages` that still have an address to go to."""
        kept = [m for m in messages if m.to]
        self._unsaved |= kept != self._messages
        self._messages = kept
        self._tell()

    def _give_up(self) -> None:
        """Remove and count the messages beyond the limit: superseded ones, then of the least urgent kind, the oldest."""
        excess = len(self._messages) - self._most
        if excess <= 0:
            return
        newest = {m.subject: m.id for m in self._messages}
        order = sorted(self._messages, key=lambda m: (m.id == newest[m.subject], -m.notice.rank, m.id))
        gone = {m.id for m in order[:excess]}
        self._messages = [m for m in self._messages if m.id not in gone]
        self.dropped += excess
        _log.error("%s: %d messages wait; %d are given up", self._path, len(self._messages) + excess, excess)

    def _load(self) -> None:
        try:
            text = self._path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror or error}"
            return
        try:
            head, *rows = map(parse_json, text.splitlines())
            if head["version"] != VERSION:
                raise ValueError(f"version {head['version']}")
            told, messages = decode(Told, head["told"] | _NO_TIMES), [decode(Message, row) for row in rows]
            self._next_id, self.told, self._messages = int(head["next_id"]), told, messages
            self._stored_id = self._next_id
            self._give_up()
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            self._next_id = 1 + max(map(int, _NUMBER.findall(text)), default=0)  # no number is given twice
            self._unsaved = True  # the number is stored before another run begins
            self.failed = f"{self._path}: damaged ({error}); set aside"
            _log.error("%s", self.failed)
            with contextlib.suppress(OSError):
                set_aside(self._path)
