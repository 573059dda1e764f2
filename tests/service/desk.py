"""Who asks the daemon for something, and what it writes down."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from monitor.service import Request
from monitor.service.outlets.base import Outlet
from monitor.service.requests import Answer


class Desk(Outlet):
    """Makes its next request when the one before was answered, and keeps the answers."""

    def __init__(self, *batches: Sequence[Request]) -> None:
        self.batches = list(batches)
        self.answers: list[Answer] = []
        self.asked = 0

    def take_requests(self) -> Sequence[Request]:
        if len(self.answers) < self.asked or not self.batches:
            return ()
        batch = self.batches.pop(0)
        self.asked += len(batch)
        return batch

    def answer_requests(self, answers: Sequence[Answer]) -> None:
        self.answers += answers


def ledger_of(path: Path) -> list[dict[str, Any]]:
    place = path.parent / "out" / "ledger.jsonl"
    return [json.loads(row) for row in place.read_text().splitlines()] if place.is_file() else []
