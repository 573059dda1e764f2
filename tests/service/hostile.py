"""Ways into the daemon for bytes that may be anything: requests, checkpoints, messages that wait."""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path

from pydantic import ValidationError

from monitor.core import Level
from monitor.damage import alarm
from monitor.runs import Session
from monitor.service import Request, serialization
from monitor.service.outlets.inbox import Inbox
from monitor.service.outlets.notices import Notice, Told
from monitor.service.outlets.outbox import Outbox
from monitor.service.requests import Answer, apply
from monitor.service.restart import Saved


def request(data: bytes, t_ns: int) -> None:
    with contextlib.suppress(ValidationError):
        asked = Request.model_validate_json(data[:4096])
        with contextlib.suppress(ValueError):
            state = apply(alarm.start(3), asked, t_ns)
            assert len(state.stories) == 4
        assert json.loads(json.dumps(asked.model_dump(), allow_nan=False))


def request_file(folder: Path, data: bytes) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "1.json").write_bytes(data)
    box = Inbox(folder)
    requests = box.take_requests()
    assert all(isinstance(asked, Request) for asked in requests)
    box.answer_requests([Answer()] * len(requests))
    box.close(0.0)
    assert not list(folder.iterdir())


def checkpoint(data: bytes) -> None:
    """The body may be anything: its checksum fits, as a file has that somebody made to harm."""
    head = {"format": serialization.FORMAT, "version": serialization.VERSION, "key": "k"}
    head["sha256"] = hashlib.sha256(data).hexdigest()
    for raw in (data, json.dumps(head).encode() + b"\n" + data):
        with contextlib.suppress(serialization.CheckpointError):
            serialization.from_bytes(raw, "k", Saved)


def checkpoint_body(session: Session, t_ns: int, windows: int) -> bytes:
    return serialization.to_bytes("k", Saved(session.state, t_ns, windows)).partition(b"\n")[2]


def write_outbox(path: Path) -> None:
    """Write an outbox with one message and an announced alarm."""
    path.unlink()
    box = Outbox(path)
    box.add(Told(levels={1: Level.ALARM}), [Notice("alarm", False, "t", "x")], ["k"])
    box.save()


def outbox(path: Path) -> None:
    box = Outbox(path)
    box.first("k")
    assert len(box) <= 256
    for left in path.parent.glob(path.name + "*"):
        left.unlink()
