"""One event of a shaken frame, reviewed, and its page."""

from __future__ import annotations

from functools import cache

from monitor.events import Event, Review, Site, review_event
from monitor.pipeline import Pipeline
from monitor.publish import EventPage
from monitor.publish.reports.event_report import event_sheet
from tests.events.shaken import blocks, configuration
from tests.support.pages import Page
from tests.support.short_quake import shaken

LIMITS = [{"drift_ratio": 0.0005, "says": "inspect <this> story"}, {"residual_loss": 0.05, "says": "call the engineer"}]


@cache
def told() -> tuple[Event, Site, Review]:
    config = configuration(events={"limits": LIMITS})
    pipeline = Pipeline(config)
    events = [e for b in blocks(shaken()) for e in pipeline.push(b) if isinstance(e, Event)]
    (event,) = [e for e in [*events, *pipeline.finish()] if e.revision == 0]
    found = review_event(
        blocks(shaken()), config.front_end(), pipeline.site, event.begin_ns, event.end_ns, event.corner_hz
    )
    assert isinstance(found, Review)
    return event, pipeline.site, found


def page(event: Event, site: Site | None, seen: Review | None) -> Page:
    told = EventPage("house", event, "events/x.mcap", "ab" * 32, site, seen, "The samples are not kept.")
    return Page(event_sheet(told).html())
