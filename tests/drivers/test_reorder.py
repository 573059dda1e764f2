"""Blocks sorted by their numbers, and the inbox in which they wait: what is lost is counted, what is full waits."""

from __future__ import annotations

import random
import threading
from collections import Counter
from dataclasses import replace

from drivers.base import SampleBlock
from drivers.inbox import Inbox
from drivers.reorder import Reorder
from tests.support.numbered import T0_NS, N, block


def _through(blocks: list[SampleBlock], hold: int = 4) -> tuple[list[int], Counter[str]]:
    counts: Counter[str] = Counter()
    order = Reorder(counts, hold)
    out = [b for given in blocks for b in order.push(given)] + order.flush()
    return [b.sequence // N for b in out], counts


def test_one_per_cent_dropped_repeated_reordered() -> None:
    draw = random.Random(7)
    blocks, dropped, repeated, swapped = [], [], 0, 0
    for i in range(10_000):
        luck = draw.random()
        if luck < 0.01:
            dropped.append(i)
            continue
        blocks.append(block(i))
        if luck < 0.02:
            blocks.append(block(i))
            repeated += 1
        elif luck < 0.03 and len(blocks) > 1 and blocks[-2].sequence == (i - 1) * N:
            blocks[-2:] = reversed(blocks[-2:])
            swapped += 1
    numbers, counts = _through(blocks)
    assert numbers == [i for i in range(10_000) if i not in set(dropped)]
    assert counts["lost_samples"] == N * len(dropped)
    assert counts["repeated"] == repeated
    assert counts["reordered"] >= swapped - len(dropped)
    assert counts["late"] == counts["restarts"] == 0


def test_a_lying_sequence_neither_stops_the_stream_nor_the_count() -> None:
    lies = [replace(block(5), sequence=2**60 + 1000 * i) for i in range(6)]
    numbers, counts = _through([*[block(i) for i in range(5)], *lies, *[block(i) for i in range(5, 40)]])
    assert numbers[:5] == [0, 1, 2, 3, 4]
    assert numbers[-30:] == list(range(10, 40))
    assert counts["lost_samples"] == 0  # no time passed


def test_one_block_from_the_past_is_thrown_away() -> None:
    numbers, counts = _through(
        [*[block(i) for i in range(300)], replace(block(0), samples=block(0).samples + 1), block(300)]
    )
    assert numbers == list(range(301))
    assert counts["late"] == 1


def test_a_recording_sent_again_is_a_restart() -> None:
    again = [block(i, t0_ns=T0_NS + 10**12) for i in range(300)]
    numbers, counts = _through([*[block(i) for i in range(300)], *again])
    assert numbers == [*range(300), *range(300)]
    assert counts["restarts"] == 1


def test_a_full_inbox_lets_the_sender_wait_and_a_closed_one_takes_nothing() -> None:
    inbox, sent = Inbox[str](100), [b"a" * 60, b"b" * 40, b"c" * 60, b"d" * 1000]

    def put() -> None:
        for data in sent:
            inbox.put("topic", data)

    inbox.open()
    sender = threading.Thread(target=put)
    sender.start()
    waits = []
    for data in sent:  # the third has no room before the first is taken, the fourth none before all are
        sender.join(0.05)
        waits.append(sender.is_alive())
        assert inbox.get(10.0) == ("topic", data)
    sender.join(10.0)
    assert waits == [True, True, True, False] and not sender.is_alive()
    inbox.put("topic", b"left")
    inbox.close()
    inbox.put("topic", b"too late")
    assert [inbox.get(10.0), inbox.get(10.0)] == [("topic", b"left"), None]
