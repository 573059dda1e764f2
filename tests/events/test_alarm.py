"""The alarm of an event: raised with the first line that exceeds a limit, there until acknowledged, raised again by more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.core import AlarmCondition
from monitor.events import Event
from monitor.events.alarm import EventAlarm, acknowledge, follow
from monitor.events.limits import exceedances
from monitor.pipeline import Pipeline
from tests.events.shaken import blocks, configuration
from tests.support.quake import shaken

LOW, HIGH = {"drift_ratio": 1e-5, "says": "go and look"}, {"drift_ratio": 0.5, "says": "clear the house"}
LOST = {"residual_loss": 0.05, "says": "call the engineer"}


def test_it_is_raised_with_the_first_line_and_not_again_by_the_same_limit() -> None:
    pipeline, told = Pipeline(configuration(events={"limits": [HIGH, LOW]})), list[Event]()
    for block in blocks(shaken(), n=500):
        assert bool(pipeline.state.events.alarms) is bool(told)
        new = [r for r in pipeline.push(block) if isinstance(r, Event)]
        if new and not told:
            (raised,) = pipeline.state.events.alarms
            assert new[0].revision is None and raised.condition is AlarmCondition.RETURNED_UNACKNOWLEDGED
            assert (
                raised.limits == ((1, 0), (1, 1), (1, 2))
                and "go and look (story 1 from the top: drift ratio" in raised.says
            )
            seen = acknowledge((raised,), new[0].id, "Ada")
            pipeline.state = replace(pipeline.state, events=replace(pipeline.state.events, alarms=seen))
        told += new
    (final,) = pipeline.state.events.alarms
    assert [e.revision for e in told] == [None, 0] and final.condition is AlarmCondition.NORMAL
    assert final.acknowledged_by == "Ada" and final.exceeded == told[1].exceeded


def test_without_a_limit_exceeded_there_is_none() -> None:
    for limits in ([], [HIGH]):
        pipeline = Pipeline(configuration(events={"limits": limits}))
        told = [r for b in blocks(shaken(), n=500) for r in pipeline.push(b) if isinstance(r, Event)]
        assert len(told) == 2 and pipeline.state.events.alarms == ()


def test_a_lasting_loss_found_an_hour_later_must_be_acknowledged_anew() -> None:
    pipeline = Pipeline(configuration(events={"limits": [LOW, LOST]}))
    final = [r for b in blocks(shaken(), n=500) for r in pipeline.push(b) if isinstance(r, Event)][-1]
    seen = acknowledge(pipeline.state.events.alarms, final.id, "Ada")
    revised = replace(final, revision=1, loss=np.array([0.0, 0.2, 0.01]))
    found = exceedances(revised, pipeline.site)
    assert found == ((0, 0), (0, 1), (0, 2), (1, 1))
    (again,) = follow(seen, revised, found)
    assert again.unacknowledged and again.acknowledged_by == ""


def test_no_other_event_is_acknowledged() -> None:
    alarms = EventAlarm("a", ("x",), ((0, 0),)), EventAlarm("b", ("x",), ((0, 0),))
    one = acknowledge(alarms, "b", "Ada")
    assert [a.unacknowledged for a in one] == [True, False] and acknowledge(one, "b", "Eve") == one
    with pytest.raises(ValueError, match=r"event c has no alarm; to be acknowledged: a$"):
        acknowledge(one, "c", "Ada")


def test_of_too_many_the_acknowledged_go_first() -> None:
    alarms = tuple(EventAlarm(str(i), ("x",), ((0, 0),)) for i in range(64))
    event = replace(_any_event(), id="new", exceeded=("y",))
    assert [a.id for a in follow(acknowledge(alarms, "7", "Ada"), event, [(0, 0)])] == [
        *(str(i) for i in range(64) if i != 7),
        "new",
    ]
    assert follow(alarms, event, [(0, 0)])[0].id == "1"
    assert len(follow(alarms[:8], event, [(0, 0)])) == 9 > len(follow(alarms[:8], event, [(0, 0)], most=8)) == 8


def _any_event() -> Event:
    none = np.zeros(0)
    return Event("e", 0, 0, 0, (), None, None, None, 0.1, *(none,) * 8, verdict=None)
