"""Names of members in sentences."""

from __future__ import annotations

from monitor.core import name_stories, name_stories_in

NAMES = ("story 1 (girder, left)", "story 2 (pier)")


def test_every_story_of_a_sentence_is_named_once() -> None:
    told = name_stories("story 2 lost 3 %, Story 1 nothing, story 12 is unknown, stories 1 and 2", NAMES)
    assert told == "story 2 (pier) lost 3 %, Story 1 (girder, left) nothing, story 12 is unknown, stories 1 and 2"
    assert name_stories(told, NAMES) == told, "a name is not added twice"
    assert name_stories("story 1 lost 3 %", ("story 1",)) == "story 1 lost 3 %", "without names nothing changes"
    assert name_stories("story 1 lost 3 %", ()) == "story 1 lost 3 %"


def test_names_enter_sentences_and_no_places() -> None:
    cause = {"effect": "stiffness_change", "location": "story 2", "says": "story 2 is softer"}
    content = {"says": "Story 1 is softer.", "causes": [cause], "separating_measurement": None, "gain": {"gain": 0.5}}
    named = name_stories_in(content, NAMES)
    assert named["says"] == "Story 1 (girder, left) is softer."
    assert named["causes"] == [{**cause, "says": "story 2 (pier) is softer"}]
    assert (named["separating_measurement"], named["gain"]) == (None, {"gain": 0.5})
