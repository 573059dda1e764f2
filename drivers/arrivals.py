"""Blocks as they arrive over a network: decoded, within the limits, in order, and counted."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable

from drivers import codec
from drivers.base import SampleBlock
from drivers.limits import BlockLimits, within_limits
from drivers.reorder import Reorder

_EVENTS = ("blocks", "samples", "lost_samples", "gaps", "repeated", "reordered", "late", "restarts", "undecodable",
           "oversized")  # fmt: skip


class Arrivals:
    """Blocks of some topics that arrived, and their counts, to which a transport adds its own `events`."""

    def __init__(
        self,
        topics: Iterable[str],
        limits: BlockLimits,
        hold: int,
        events: Iterable[str],
        decode: Callable[[bytes, str], SampleBlock] = codec.decode,
    ) -> None:
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
        except ValueError:
            self.counts["undecodable"] += 1
        else:
            self._ready.extend(self._orders[topic].push(block))

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
