"""Blocks as they arrive over a network: decoded, within the limits, in order, and counted."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable

from drivers import codec
from drivers.base import SampleBlock
from drivers.limits import BlockLimits, within_limits
from drivers.recent import Recent
from drivers.reorder import Reorder

_EVENTS = ("blocks", "samples", "lost_samples", "gaps", "repeated", "reordered", "late", "restarts", "undecodable",
           "oversized")  # fmt: skip


class Arrivals:
    """Blocks of some topics that arrived, and their counts, to which a transport adds its own `events`.

    What is refused is told with its reason by `recent`.
    """

    def __init__(
        self,
        topics: Iterable[str],
        limits: BlockLimits,
        hold: int,
        events: Iterable[str],
        decode: Callable[[bytes, str], SampleBlock] = codec.decode,
        recent: Recent | None = None,
    ) -> None:
        self.recent = Recent() if recent is None else recent
        self.counts: Counter[str] = Counter(dict.fromkeys((*_EVENTS, *events), 0))
        self._limits, self._hold, self._decode = limits, hold, decode
        self._orders = {topic: Reorder(self.counts, hold) for topic in topics}
        self._ready: deque[SampleBlock] = deque()

    @property
    def ready(self) -> bool:
        """Whether a block can be taken."""
        return bool(self._ready)

    @property
    def holds(self) -> bool:
        """Whether some block was not taken yet, also one that waits for an earlier one."""
        return self.ready or any(order.waiting for order in self._orders.values())

    def add(self, topic: str, data: bytes) -> None:
        """Decode a payload, and release the blocks that can be."""
        try:
            block = within_limits(self._decode(data, topic), self._limits)
        except ValueError as error:
            self._refuse("undecodable", topic, str(error))
        else:
            self._ready.extend(self._orders[topic].push(block))

    def refuse_oversized(self, topic: str, n_bytes: int) -> None:
        """Count a message that is too large to be decoded."""
        self._refuse("oversized", topic, f"{n_bytes} bytes, where max_payload_bytes = {self._limits.max_payload_bytes}")

    def _refuse(self, event: str, topic: str, reason: str) -> None:
        """Count a refused block or message, and tell why."""
        self.counts[event] += 1
        n = self.counts["undecodable"] + self.counts["oversized"]
        self.recent.tell(f"a block of {topic} is refused, {n} so far: {reason}")

    def take(self) -> SampleBlock:
        """Remove and return the first block that is ready."""
        block = self._ready.popleft()
        self.counts["blocks"] += 1
        self.counts["samples"] += block.n_samples
        return block

    def flush(self) -> bool:
        """Release the blocks that still wait for earlier ones; False if nothing is ready then."""
        for order in self._orders.values():
            self._ready.extend(order.flush())
        return self.ready

    def forget(self) -> None:
        """Forget all blocks, but not their counts."""
        self._orders = {topic: Reorder(self.counts, self._hold) for topic in self._orders}
        self._ready.clear()
