"""What takes results."""

from __future__ import annotations

from typing import Any

from monitor.core import Gap, Samples, WindowResult
from monitor.signals import Health


class Publisher:
    """Takes results; what a kind of publisher has no use for passes by."""

    def samples(self, samples: Samples) -> None:
        """Conditioned samples."""

    def gap(self, gap: Gap) -> None:
        """Samples are missing."""

    def window(self, result: WindowResult, line: str) -> None:
        """Everything said about a window; `line` is its line of results.jsonl."""

    def health(self, health: Health) -> None:
        """The sensors in a span."""

    def finding(self, finding: dict[str, Any]) -> None:
        """A diagnosis is there."""
