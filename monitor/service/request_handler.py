"""Handling of the operators' requests: ledger first, then the state of the alarms, then the answer.

The requests that wait at one time are one batch: one write to the ledger, one change of the state, one checkpoint.  Files are
written in other threads, and no step waits for them, so a slow disk delays the answer and never the evaluation.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from monitor.core import MissingInputError, name_stories
from monitor.runs import Session, ledger, ledger_chain
from monitor.service.history import History
from monitor.service.outlets import Outlet
from monitor.service.requests import Answer, Request, apply, apply_to_events
from monitor.service.restart import Checkpointer
from monitor.service.threads import Chores

_log = logging.getLogger(__name__)

_WAIT_S = 2.0
"""Time from which a disk counts as one that does not answer.  A request in the ledger is then answered without a checkpoint.
[s; judgement]"""
_TOLD_S = 60.0
"""Time for which a refused write to the ledger is told: only the next request shows whether it can be written again.
[s; judgement]"""


class RequestHandler:
    """Handler of the requests of all outlets, one batch at a time.

    The ledger at `place` is written in the thread of `chores`; `keeper` writes the checkpoint that follows a change; each applied
    request is stored in the history.  `head` is the hash of the ledger's last line as last written or read by this process, None
    without a line.
    """

    dropped = 0  # no request is lost: one that cannot be noted is refused

    def __init__(
        self,
        outlets: Sequence[Outlet],
        place: Path,
        chores: Chores,
        keeper: Checkpointer,
        history: History,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._outlets, self._place, self._chores = outlets, place, chores
        self._keeper, self._history, self._clock = keeper, history, clock
        self._batch: _Batch | None = None
        self._error, self._failed_s = "", 0.0
        self.read_head()

    @property
    def failed(self) -> str | None:
        """Why the ledger is not written at present, or could not be within the last minute; None if all is well."""
        batch = self._batch
        if batch is not None and not batch.written and self._clock() - batch.begun_s > _WAIT_S:
            return f"{self._place}: the disk does not answer"
        return self._error if self._error and self._clock() - self._failed_s < _TOLD_S else None

    def read_head(self) -> None:
        """Read the ledger's head, after something else has written there."""
        self.head = ledger_chain.read_head(self._place)

    def step(self, session: Session, *, timed: bool) -> None:
        """Do what can be done now for the present batch, or begin the next one; waits for nothing.

        A request is `timed` by the clock of data that have come; until then requests wait or are refused.
        """
        if not timed:
            for outlet in self._outlets:
                outlet.refuse_requests(
                    "no data have come yet, by whose clock it would be timed; ask again when they do"
                )
        elif self._batch is None:
            self._begin(session)
        elif self._batch.written:
            self._go_on(session, self._batch)

    def finish(self, session: Session, timeout_s: float) -> None:
        """Apply the batch whose ledger lines are being written, if they are within `timeout_s`; `close` answers it."""
        batch = self._batch
        if batch is not None and not batch.applied:
            self._chores.settle(timeout_s)
            if batch.written:
                self._apply(session, batch)

    def close(self) -> None:
        """Answer the present batch as far as it was applied; the rest is left unanswered."""
        if self._batch is not None and self._batch.applied:
            self._answer(self._batch)

    def note_recording(self, name: str, checksum: str) -> None:
        """Have the SHA-256 of an event's recording written into the ledger."""
        self._chores.do(f"ledger: {name}", partial(self._note_recording, name, checksum))

    def _note_recording(self, name: str, checksum: str) -> None:
        try:
            self.head = ledger_chain.append_lines(self._place, [ledger.recording_entry(name, checksum)])
        except MissingInputError as error:
            _log.error("the checksum of %s is not noted: %s", name, error)
            self._error, self._failed_s = str(error), self._clock()

    def _begin(self, session: Session) -> None:
        """Take the requests that wait, and have those that change something written into the ledger."""
        now, items = session.pipeline.state, []
        state, events = now.alarm, now.events.alarms
        for outlet in self._outlets:
            for request in outlet.take_requests():
                item = _Item(outlet, request)
                items.append(item)
                try:
                    new, new_events = apply(state, request, session.now_ns), apply_to_events(events, request)
                except ValueError as error:
                    _log.warning("request of %s: %s", request.who, error)
                    item.answer = Answer(str(error))
                else:
                    item.changes = new.stories != state.stories or new_events != events
                    state, events = new, new_events
        batch = _Batch(items, self._clock())
        if any(item.changes for item in items):
            self._batch = batch
            names = session.story_names
            entries = [_entry(item.request, names) for item in items if item.changes]
            self._chores.do("ledger", partial(self._write, batch, entries))
        else:
            self._answer(batch)

    def _write(self, batch: _Batch, entries: Sequence[dict[str, Any]]) -> None:
        try:
            self.head = ledger_chain.append_lines(self._place, entries)
        except MissingInputError as error:
            batch.error = str(error)
        batch.written = True

    def _go_on(self, session: Session, batch: _Batch) -> None:
        """Apply a batch that is in the ledger, have a checkpoint written, and answer once it is on the disk."""
        if not batch.applied:
            self._apply(session, batch)
        if batch.error:
            self._answer(batch)
        elif self._keeper.busy and self._clock() - batch.begun_s < _WAIT_S:
            return
        elif batch.saved:
            self._answer(batch)
        else:
            batch.saved = True
            self._keeper.save(session)

    def _apply(self, session: Session, batch: _Batch) -> None:
        """Change the alarms as a written batch asks; refuse what could not be written."""
        batch.applied, self._error, self._failed_s = True, batch.error, self._clock()
        if batch.error:
            _log.error("requests are refused: %s", batch.error)
        for item in batch.items:
            if item.changes and batch.error:
                item.answer = Answer(f"nothing was changed: {batch.error}", again=True)
            elif item.changes:
                session.alter_alarm(partial(apply, request=item.request, t_ns=session.now_ns))
                session.alter_events(partial(apply_to_events, request=item.request))
                self._history.request(session.now_ns, item.request.model_dump())

    def _answer(self, batch: _Batch) -> None:
        self._batch = None
        for outlet in self._outlets:
            answers = [item.answer for item in batch.items if item.outlet is outlet]
            if answers:
                outlet.answer_requests(answers)


@dataclass(slots=True)
class _Item:
    """Request with its answer, which stands once its batch is answered."""

    outlet: Outlet
    request: Request
    answer: Answer = field(default_factory=Answer)
    changes: bool = False
    """Whether the request changes the state of an alarm."""


@dataclass(slots=True)
class _Batch:
    """Requests that were taken together."""

    items: list[_Item]
    begun_s: float
    written: bool = False
    """Whether the ledger has been written, or could not be; the thread of the chores sets it last."""
    error: str = ""
    applied: bool = False
    saved: bool = False


def _entry(request: Request, story_names: Sequence[str]) -> dict[str, Any]:
    place = f"event {request.event}" if request.story is None else name_stories(f"story {request.story}", story_names)
    says = f"{request.action} alarm of {place}: {request.note}"
    return ledger.entry({"says": says, "causes": []}, {}, request.who)
