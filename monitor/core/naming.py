"""Names of a structure's members in sentences."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

_STORY = re.compile(r"\b(story) (\d+)\b(?! \(| from the top)", re.IGNORECASE)
_PLACE = re.compile(r"\b(storey|floor) (\d+) (x|y|torsion)\b", re.IGNORECASE)
DIRECTION_WORDS = {"x": "along x", "y": "along y", "torsion": "in torsion"}
"""Directions of a building's storeys and floors, in words. [words]"""
_STOREY = re.compile(rf"storey (\d+)(?: \(.*\))?, ({'|'.join(DIRECTION_WORDS.values())})")
_STORY_WORD = re.compile(r"\b([Ss]t)(ory|ories)\b")
_SENTENCES = frozenset({"says", "separating_measurement", "headline", "reason"})
"""Keys whose values are sentences."""


def name_stories(text: str, names: Sequence[str]) -> str:
    """Put the names of the stories, from the first one on, into a finished sentence.

    ``story 3`` becomes ``story 3 (girder)``, as people call it; nothing changes where there are no names.  A name of another
    form, as ``mode 3``, takes the place of ``story 3``.  The places of a building, as ``storey 2 y``, are put into words.

    Examples
    --------
    >>> name_stories("Story 2 lost 10 %, story 1 nothing.", ["story 1", "story 2 (left bearing)"])
    'Story 2 (left bearing) lost 10 %, story 1 nothing.'
    >>> name_stories("storey 1 y is softer", ["storey 1 (ground to 1st floor), along y"])
    'storey 1 (ground to 1st floor), along y is softer'
    """

    def named(match: re.Match[str]) -> str:
        name = story_name(int(match[2]), names)
        if name.startswith("story"):
            return match[1] + name.removeprefix("story")
        return name[0].upper() + name[1:] if match[1][0].isupper() else name

    def placed(match: re.Match[str]) -> str:
        kind, number, direction = match[1], match[2], DIRECTION_WORDS[match[3]]
        ends = f"storey {number} (", f"), {direction}"
        own = (name for name in names if name.startswith(ends[0]) and name.endswith(ends[1]))
        name = next(own, "") if kind.lower() == "storey" else ""
        return kind + name.removeprefix("storey") if name else f"{kind} {number}, {direction}"

    return storey_words(_PLACE.sub(placed, _STORY.sub(named, text)), names)


def storey_words(text: str, names: Sequence[str]) -> str:
    """Call the stories of a building, by their names, storeys.

    Examples
    --------
    >>> storey_words("all stories alike", ["storey 1 (ground to 1st floor), along y"]), storey_words("every story", [])
    ('all storeys alike', 'every story')
    """
    if not names or storey_of(names[0]) is None:
        return text
    return _STORY_WORD.sub(lambda match: match[1] + ("oreys" if match[2] == "ories" else "orey"), text)


def story_name(number: int, names: Sequence[str]) -> str:
    """Return what people call a story, from 1: its name, or its number where it has none.

    Examples
    --------
    >>> story_name(2, ["story 1 (deck)", "story 2 (pier)"]), story_name(3, [])
    ('story 2 (pier)', 'story 3')
    """
    return names[number - 1] if 0 < number <= len(names) else f"story {number}"


def storey_of(name: str) -> tuple[int, str] | None:
    """Return the number of a building's storey and its direction by its name; None for a story or a mode.

    Examples
    --------
    >>> storey_of("storey 2 (1st to 2nd floor), along y"), storey_of("story 2 (girder)")
    ((2, 'y'), None)
    """
    match = _STOREY.fullmatch(name)
    return match and (int(match[1]), next(d for d, words in DIRECTION_WORDS.items() if words == match[2]))


def together(some: Sequence[str], every: Sequence[str]) -> str:
    """Name some of the stories; of a building those of a direction at once.

    Examples
    --------
    >>> along_y = [f"storey {j} ({j - 1} to {j}), along y" for j in (1, 2, 3)]
    >>> together(along_y, along_y), together(along_y[1:], along_y), together(["story 2", "story 4"], [])
    ('all storeys along y', 'storeys 2, 3 along y', 'story 2, story 4')
    """
    single, of = [], defaultdict(list)
    for name in some:
        place = storey_of(name)
        of[name if place is None else place[1]].append(name)
    for direction, names in of.items():
        numbers = [str(place[0]) for name in names if (place := storey_of(name))]
        if len(numbers) < 2:
            single += names
            continue
        all_of_it = sum(name.endswith(DIRECTION_WORDS[direction]) for name in every)
        which = "all storeys" if len(numbers) == all_of_it else f"storeys {', '.join(numbers)}"
        single.append(f"{which} {DIRECTION_WORDS[direction]}")
    return ", ".join(single)


def floor_name(floor: int) -> str:
    """Return the number of a floor above the ground as people say it.

    Examples
    --------
    >>> [floor_name(j) for j in (1, 2, 3, 4, 11, 21)]
    ['1st', '2nd', '3rd', '4th', '11th', '21st']
    """
    ending = "th" if floor % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(floor % 10, "th")
    return f"{floor}{ending}"


def name_stories_in(content: Any, names: Sequence[str]) -> Any:
    """Put the names of the stories into the sentences of nested results; names of places (`location`) stay as they are.

    Examples
    --------
    >>> name_stories_in({"location": "story 1", "causes": [{"says": "story 1 is softer"}]}, ["story 1 (deck)"])
    {'location': 'story 1', 'causes': [{'says': 'story 1 (deck) is softer'}]}
    """
    if isinstance(content, dict):
        return {
            key: name_stories(value, names)
            if key in _SENTENCES and isinstance(value, str)
            else name_stories_in(value, names)
            for key, value in content.items()
        }
    return [name_stories_in(item, names) for item in content] if isinstance(content, list) else content
