"""Names of a structure's members in sentences."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

_STORY = re.compile(r"\b(story) (\d+)\b(?! \()", re.IGNORECASE)
_SENTENCES = frozenset({"says", "separating_measurement", "headline", "reason"})
"""Keys whose values are sentences."""


def name_stories(text: str, names: Sequence[str]) -> str:
    """Put the names of the stories, from the first one on, into a finished sentence.

    ``story 3`` becomes ``story 3 (girder)``, as people call it; nothing changes where there are no names.  A name of another
    form, as ``mode 3``, takes the place of ``story 3``.

    Examples
    --------
    >>> name_stories("Story 2 lost 10 %, story 1 nothing.", ["story 1", "story 2 (left bearing)"])
    'Story 2 (left bearing) lost 10 %, story 1 nothing.'
    """

    def named(match: re.Match[str]) -> str:
        j = int(match[2])
        if not 1 <= j <= len(names):
            return match[0]
        name = names[j - 1]
        return match[1] + name.removeprefix("story") if name.startswith("story") else name

    return _STORY.sub(named, text)


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
