"""Blocks of one stream in order of their sequence numbers: no I/O, no clock."""

from __future__ import annotations

from collections import Counter, deque

from drivers.base import SampleBlock

_REMEMBERED = 256
"""Blocks by which a repetition is known."""


def _end(block: SampleBlock) -> int:
    return block.sequence + block.n_samples


class Reorder:
    """Hands blocks on in order and counts what was lost, repeated, reordered, late.

    A block that comes too early waits until those before it have come, or until more than `hold` wait; then the place
    is given up as lost.  Blocks from the past are thrown away, unless `hold` of them follow upon each other while
    nothing else comes: then the publisher has begun anew.

    Parameters
    ----------
    counts : Counter
        Receives the events ``lost_samples``, ``gaps``, ``repeated``, ``reordered``, ``late``, ``restarts`` (in blocks, but
        for the first).
    hold : int
        Blocks that may wait; 0 hands every jump on at once.
    """

    def __init__(self, counts: Counter[str], hold: int = 4) -> None:
        self._counts, self._hold = counts, hold
        self._last: SampleBlock | None = None
        self._recent: deque[tuple[int, int, int]] = deque(maxlen=_REMEMBERED)
        self._early: dict[int, SampleBlock] = {}
        self._past: list[SampleBlock] = []

    def push(self, block: SampleBlock) -> list[SampleBlock]:
        """The blocks that can be handed on now, in order."""
        mark = (block.sequence, block.n_samples, block.t_ns)
        if mark in self._recent:
            self._counts["repeated"] += 1
            return []
        self._recent.append(mark)
        if self._last is None:
            return self._go_on(block)
        due = _end(self._last)
        if _end(block) <= due:
            return self._of_the_past(block)
        if block.sequence > due:
            self._early.setdefault(block.sequence, block)
            return self._give_up() if len(self._early) > self._hold else []
        if self._early and min(self._early) <= _end(block):
            self._counts["reordered"] += 1
        return self._go_on(block)

    def flush(self) -> list[SampleBlock]:
        """What still waits, in order; for the end of the stream."""
        blocks: list[SampleBlock] = []
        while self._early:
            blocks += self._give_up()
        return blocks

    def _go_on(self, block: SampleBlock) -> list[SampleBlock]:
        """Hand on `block` and those that waited for it."""
        self._counts["late"] += len(self._past)
        self._past.clear()
        blocks = [block]
        for sequence in sorted(self._early):
            if sequence > _end(blocks[-1]):
                break
            early = self._early.pop(sequence)
            if _end(early) > _end(blocks[-1]):
                blocks.append(early)
        self._last = blocks[-1]
        return blocks

    def _give_up(self) -> list[SampleBlock]:
        """Go on behind a gap."""
        block = self._early.pop(min(self._early))
        last = self._last
        if last is not None:
            # A sequence number alone may lie; what is missing must be missing from time too.
            elapsed_s = max(0.0, (block.t_ns - last.t_ns) * 1e-9 - last.n_samples / last.sample_rate_hz)
            self._counts["lost_samples"] += min(block.sequence - _end(last), round(elapsed_s * block.sample_rate_hz))
            self._counts["gaps"] += 1
        return self._go_on(block)

    def _of_the_past(self, block: SampleBlock) -> list[SampleBlock]:
        if self._past and _end(self._past[-1]) != block.sequence:
            self._counts["late"] += len(self._past)
            self._past.clear()
        self._past.append(block)
        if len(self._past) < max(1, self._hold):
            return []
        begun, self._past = self._past, []
        self._counts["restarts"] += 1
        blocks = self.flush()
        self._last = begun[-1]
        return blocks + begun
