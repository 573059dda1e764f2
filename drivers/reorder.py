"""Sorts the blocks of one stream by their sequence numbers: no I/O, no clock."""

from __future__ import annotations

from collections import Counter, deque

from drivers.base import SampleBlock

_REMEMBERED = 256
"""Number of latest blocks among which a repeated block is recognised."""


class Reorder:
    """Sorter of the blocks of one stream, with counts of lost, repeated, reordered and late blocks.

    A block that arrives too early waits for the blocks before it.  When more than `hold` blocks wait, the missing samples
    count as lost.  Blocks older than the last one released are discarded.  If `hold` such blocks follow one another without
    another block between them, the publisher has restarted its sequence, and they are released.  With `hold` = 0 the block
    after a gap is released at once.

    `counts` receives ``lost_samples`` in samples, ``repeated``, ``reordered`` and ``late`` in blocks, ``gaps`` and ``restarts``
    in events.

    Examples
    --------
    >>> import numpy as np
    >>> order = Reorder(Counter())
    >>> blocks = [SampleBlock("/acceleration", 0, n, 1.0, ("a1",), "m/s^2", np.zeros((1, 1), np.float32)) for n in (0, 2, 1)]
    >>> [[released.sequence for released in order.push(block)] for block in blocks]
    [[0], [], [1, 2]]
    """

    def __init__(self, counts: Counter[str], hold: int = 4) -> None:
        self._counts, self._hold = counts, hold
        self._last: SampleBlock | None = None
        self._recent: deque[tuple[int, int, int]] = deque(maxlen=_REMEMBERED)
        self._early: dict[int, SampleBlock] = {}
        self._past: list[SampleBlock] = []

    @property
    def waiting(self) -> int:
        """Number of blocks that wait for earlier ones."""
        return len(self._early)

    def push(self, block: SampleBlock) -> list[SampleBlock]:
        """Take a block, and return the blocks that can be released now, in order."""
        mark = (block.sequence, block.n_samples, block.t_ns)
        if mark in self._recent:
            self._counts["repeated"] += 1
            return []
        self._recent.append(mark)
        if self._last is None:
            return self._release(block)
        due = self._last.next_sequence
        if block.next_sequence <= due:
            return self._push_past(block)
        if block.sequence > due:
            self._early.setdefault(block.sequence, block)
            return self._skip_gap() if len(self._early) > self._hold else []
        if self._early and min(self._early) <= block.next_sequence:
            self._counts["reordered"] += 1
        return self._release(block)

    def flush(self) -> list[SampleBlock]:
        """Return the blocks that still wait, in order, at the end of the stream."""
        blocks: list[SampleBlock] = []
        while self._early:
            blocks += self._skip_gap()
        return blocks

    def _release(self, block: SampleBlock) -> list[SampleBlock]:
        """Release `block` and the blocks that waited for it."""
        self._counts["late"] += len(self._past)
        self._past.clear()
        blocks = [block]
        for sequence in sorted(self._early):
            if sequence > blocks[-1].next_sequence:
                break
            early = self._early.pop(sequence)
            if early.next_sequence > blocks[-1].next_sequence:
                blocks.append(early)
        self._last = blocks[-1]
        return blocks

    def _skip_gap(self) -> list[SampleBlock]:
        """Count the gap before the first waiting block, and release that block."""
        block = self._early.pop(min(self._early))
        last = self._last
        if last is not None:
            # A sequence number alone may be wrong, so the loss is limited to what the timestamps leave room for.
            elapsed_s = max(0.0, (block.t_ns - last.t_ns) * 1e-9 - last.length_s)
            missing = block.sequence - last.next_sequence
            self._counts["lost_samples"] += min(missing, round(elapsed_s * block.sample_rate_hz))
            self._counts["gaps"] += 1
        return self._release(block)

    def _push_past(self, block: SampleBlock) -> list[SampleBlock]:
        """Take a block older than the last one released; release it only if the publisher has restarted."""
        if self._past and self._past[-1].next_sequence != block.sequence:
            self._counts["late"] += len(self._past)
            self._past.clear()
        self._past.append(block)
        if len(self._past) < max(1, self._hold):
            return []
        restarted, self._past = self._past, []
        self._counts["restarts"] += 1
        blocks = self.flush()
        self._last = restarted[-1]
        return blocks + restarted
