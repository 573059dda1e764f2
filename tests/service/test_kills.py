"""Cut off at any operation, taken over, restored and copied: no line and no alarm is lost, and none comes twice unnoticed."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings, strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from threadpoolctl import threadpool_limits

from tests.service.kills import LEAST, Story, campaign, hits_of, table
from tests.service.lives import undisturbed
from tests.support.reference import place

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    with threadpool_limits(limits=1):
        yield


def test_sixty_kills_and_takeovers_lose_nothing_and_tell_nothing_twice_without_its_number() -> None:
    rows = campaign(range(4), [])
    kills, tally = (sum((Counter(row[name]) for row in rows), Counter()) for name in ("kills", "tally"))
    assert [row["faults"] for row in rows] == [[]] * 4, table(rows)
    assert kills.total() >= 60 and tally["takeovers"] >= 5, table(rows)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_two_thousand_kills_at_every_point_of_commit() -> None:
    """Goes on where it stopped, as long as the code is the same."""
    file = place() / "kills.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    rows = campaign(range(10**6), rows, 2000, file)
    print(table(rows))
    tally = sum((Counter(row["tally"]) for row in rows), Counter())
    assert not any(row["faults"] for row in rows)
    assert min(hits_of(rows).values()) >= LEAST
    assert tally["takeovers"] >= 50 and tally["restores"] >= 20


class SiteLife(RuleBasedStateMachine):
    """What may happen to the monitors of a site, in any order; at the end the stream is over, and everybody heard all of it."""

    def __init__(self) -> None:
        super().__init__()
        self._undo = ExitStack()
        self._folder = Path(tempfile.mkdtemp(prefix="shm-life-"))
        self.story: Story | None = None

    @initialize(seed=st.integers(0, 2**32))
    def begin(self, seed: int) -> None:
        self.story = Story(self._folder, undisturbed(), seed, Counter(), {})
        self._undo.enter_context(self.story.world.disk.watched())

    @rule()
    def is_killed(self) -> None:
        self._story.kill()

    @rule()
    def ends(self) -> None:
        self._story.end()

    @rule()
    def is_backed_up(self) -> None:
        self._story.back_up()

    @rule(share=st.sampled_from([0.0, 0.1, 0.3]))
    def storage_fails_now_and_then(self, share: float) -> None:
        self._story.world.bucket.unsure = share

    @precondition(lambda self: self._has_store)
    @rule()
    def storage_is_away(self) -> None:
        self._story.away()

    @precondition(lambda self: self._has_store)
    @rule()
    def another_machine_goes_on(self) -> None:
        self._story.take_over()

    @precondition(lambda self: self._has_store)
    @rule()
    def another_machine_goes_on_and_the_first_wakes(self) -> None:
        self._story.wake()

    @precondition(lambda self: self._has_store)
    @rule()
    def a_second_monitor_begins_on_a_copy(self) -> None:
        self._story.copy()

    @precondition(lambda self: self._has_store and self._story.backups > 0)
    @rule()
    def is_restored(self) -> None:
        self._story.restore()

    @invariant()
    def no_fault_is_known(self) -> None:
        if self.story is not None:
            assert self.story.world.faults + self.story.world.bucket.faults == []

    def teardown(self) -> None:
        try:
            if self.story is not None:
                self.story.world.finish(self.story.at)
                assert self.story.world.faults == []
        finally:
            self._undo.close()
            shutil.rmtree(self._folder)

    @property
    def _story(self) -> Story:
        assert self.story is not None
        return self.story

    @property
    def _has_store(self) -> bool:
        return self.story is not None and self.story.world.with_store


def whatever_happens(examples: int, steps: int) -> None:
    slow = [HealthCheck.too_slow, HealthCheck.data_too_large]
    run_state_machine_as_test(
        SiteLife,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=slow,
        ),
    )


def test_whatever_happens_to_a_site_all_is_told_and_written_once() -> None:
    whatever_happens(3, 8)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_whatever_happens_to_many_sites_all_is_told_and_written_once() -> None:
    whatever_happens(150, 20)
