"""One worker does what is left to it in order, within bounds, whatever fails; by hand it does the same without a thread."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from monitor.core import BoundedQueue, Full, Retry, Work, Worker
from monitor.core.worker import Hand


@dataclass
class Clock:
    """Clock that a test sets."""

    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


@dataclass
class Bench:
    """Workers by hand, and what they did."""

    clock: Clock
    hand: Hand
    did: list[object] = field(default_factory=list)

    def worker(self, work: Work[object], queue: BoundedQueue[object] | None = None, **how: object) -> Worker[object]:
        made = Worker("bench", work, queue, **how)  # type: ignore[arg-type]
        made.start()
        return made

    def go_on(self, seconds: float = 0.0) -> None:
        """Do all that is due up to a time from now on."""
        end_s = self.clock.now_s + seconds
        while True:
            while self.hand.step():
                continue
            due_s = self.clock.now_s + self.hand.due_in_s
            if due_s > end_s:
                break
            self.clock.now_s = due_s
        self.clock.now_s = end_s


@pytest.fixture
def bench() -> Iterator[Bench]:
    clock = Clock()
    with Worker.by_hand(clock) as hand:
        yield Bench(clock, hand)


def failing(did: list[object], times: int, error: Exception) -> Callable[[object], None]:
    """Return a function that fails so many times, then notes what it is given."""
    left = [times]

    def do(item: object) -> None:
        left[0] -= 1
        if left[0] >= 0:
            raise error
        did.append(item)

    return do


def test_items_are_done_in_their_order_and_the_last_ones_before_the_end(bench: Bench) -> None:
    did = bench.did
    ends = Work(did.append, open=lambda: did.append("open"), finish=lambda: did.append("finish"))
    worker = bench.worker(ends)
    for k in range(3):
        worker.put(k)
    assert did == []
    assert worker.close(1.0) and worker.over
    assert did == ["open", 0, 1, 2, "finish"]


def test_of_items_with_one_key_the_latest_takes_the_place_of_the_first(bench: Bench) -> None:
    worker = bench.worker(Work(bench.did.append))
    for key, item in (("a", 1), ("b", 2), ("a", 3)):
        worker.put(item, key)
    bench.go_on()
    assert bench.did == [3, 2] and worker.dropped == 0


@pytest.mark.parametrize(("full", "kept"), [(Full.REFUSE, [0, 1]), (Full.OLDEST, [3, 4])])
def test_what_finds_no_room_is_counted_and_logged_once(
    bench: Bench, full: Full, kept: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    worker = bench.worker(Work(bench.did.append), BoundedQueue(2, full=full))
    for k in range(5):
        worker.put(k)
    bench.go_on()
    assert bench.did == kept and worker.dropped == 3
    assert [r.levelno for r in caplog.records] == [logging.WARNING]


def test_an_offer_that_finds_no_room_is_refused_and_not_counted(bench: Bench) -> None:
    worker = bench.worker(Work(bench.did.append), BoundedQueue(1))
    assert worker.offer(1) and not worker.offer(2)
    assert worker.dropped == 0


def test_a_single_item_of_any_size_fits_an_empty_queue() -> None:
    queue = BoundedQueue[bytes](10, 100, Full.REFUSE, size=len)
    assert queue.put(b"x" * 1000) and not queue.put(b"y")
    assert queue.take(0.0) is not None and queue.put(b"y")


def test_an_error_costs_its_item_and_is_told_until_another_is_done(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    worker = bench.worker(Work(failing(bench.did, 2, ValueError("no such colour"))))
    worker.put(1)
    worker.put(2)
    bench.go_on()
    assert worker.failed == "ValueError: no such colour" and len(caplog.records) == 1
    worker.put(3)
    bench.go_on()
    assert worker.failed is None and bench.did == [3]


def test_an_error_that_is_tried_again_costs_nothing_and_the_pauses_grow(bench: Bench) -> None:
    tries: list[object] = []
    refuse = failing(bench.did, 4, OSError("away"))

    def do(item: object) -> None:
        tries.append(bench.clock.now_s)
        refuse(item)

    work = Work(do, open=lambda: None, shut=lambda: tries.append("shut"))
    worker = bench.worker(work, retry=Retry((OSError,), 1.0, 4.0))
    worker.put("a")
    bench.go_on(6.9)
    assert worker.failed is not None and bench.did == []
    bench.go_on(5.0)
    assert tries == [0.0, "shut", 1.0, "shut", 3.0, "shut", 7.0, "shut", 11.0]
    assert bench.did == ["a"] and worker.failed is None


def test_after_a_success_the_pauses_begin_anew(bench: Bench) -> None:
    tries: list[float] = []

    def idle() -> float:
        tries.append(bench.clock.now_s)
        if len(tries) not in {3, 5}:
            raise OSError("away")
        return 10.0

    worker = bench.worker(Work(idle=idle), retry=Retry((OSError,), 1.0, 4.0))
    bench.go_on(14.0)
    assert tries == [0.0, 1.0, 3.0, 13.0, 14.0] and worker.failed is None


def test_what_is_to_end_is_tried_once_more_and_not_again(bench: Bench) -> None:
    worker = bench.worker(Work(failing(bench.did, 9, OSError("away"))), retry=Retry((OSError,)))
    worker.put("a")
    bench.go_on(1.0)
    assert worker.close(1.0) and bench.did == []


def test_a_worker_that_an_error_ends_tells_it_and_takes_nothing_more(bench: Bench) -> None:
    shut: list[bool] = []
    work = Work(failing(bench.did, 1, ValueError("odd")), shut=lambda: shut.append(worker.over))
    worker = bench.worker(work, ends_on_error=True)
    worker.put(1)
    worker.put(2)
    bench.go_on()
    assert worker.over and shut == [True] and bench.did == [] and not worker.put(3)
    assert worker.failed == "ValueError: odd" and isinstance(worker.failure, ValueError)


def test_it_is_idle_when_it_asked_to_be_and_when_it_is_woken(bench: Bench) -> None:
    called: list[float] = []

    def idle() -> float | None:
        called.append(bench.clock.now_s)
        return 5.0 if len(called) < 3 else None

    worker = bench.worker(Work(bench.did.append, idle))
    bench.go_on(20.0)
    assert called == [0.0, 5.0, 10.0]
    worker.wake(2.0)
    bench.go_on(10.0)
    assert called[3:] == [22.0]


def test_to_end_at_once_leaves_what_waits(bench: Bench) -> None:
    worker = bench.worker(Work(bench.did.append, finish=lambda: bench.did.append("finish")))
    worker.put(1)
    worker.ask_to_end(at_once=True)
    assert worker.join(1.0) and bench.did == ["finish"]


def test_in_a_thread_what_was_left_is_settled_and_a_full_queue_makes_wait() -> None:
    did: list[int] = []
    goes_on = threading.Event()

    def do(item: int) -> None:
        goes_on.wait(10.0)
        did.append(item)

    worker = Worker("bench", Work(do), BoundedQueue[int](1))
    worker.start()
    worker.put(0)
    putting = threading.Thread(target=lambda: [worker.put(k) for k in (1, 2)], daemon=True)
    putting.start()
    assert not worker.settle(0.0)
    goes_on.set()
    putting.join(10.0)
    assert worker.settle(10.0) and did == [0, 1, 2]
    assert worker.close(10.0)


class Panic(BaseException):
    """What a library in Rust raises where it would end the process."""


@pytest.mark.parametrize("error", [Panic("index out of bounds"), SystemExit(3)], ids=["panic", "exit"])
def test_a_thread_does_not_end_without_a_word_whatever_is_raised(error: BaseException) -> None:
    did: list[int] = []

    def do(item: int) -> None:
        if item == 0:
            raise error
        did.append(item)

    worker = Worker("bench", Work(do))
    worker.start()
    worker.put(0)
    assert worker.settle(10.0)
    assert worker.failed == f"RuntimeError: {type(error).__name__}: {error}"
    worker.put(1)
    assert worker.close(10.0) and did == [1]


def test_a_thread_that_waits_without_end_is_idle_soon_after_it_was_woken() -> None:
    called = threading.Semaphore(0)
    worker = Worker("bench", Work[None](idle=called.release))
    worker.start()
    assert called.acquire(timeout=10.0)
    worker.wake(0.01)
    assert called.acquire(timeout=10.0)
    assert worker.close(10.0)


def test_a_piece_that_does_not_answer_is_told_and_not_waited_for_beyond_the_deadline() -> None:
    clock, begun, goes_on = Clock(), threading.Event(), threading.Event()

    def do(_: object) -> None:
        begun.set()
        goes_on.wait(10.0)

    worker = Worker("bench", Work(do), clock=clock)
    worker.start()
    worker.put(1)
    assert begun.wait(10.0)
    assert not worker.close(0.01) and worker.failed == "not finished within 0.01 s"
    clock.now_s = 7.0
    assert worker.failed == "does not answer for 7 s"
    goes_on.set()
    assert worker.join(10.0)
