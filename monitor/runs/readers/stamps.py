"""Times as people and loggers write them: dates in any order, times of day with AM and PM, zones."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta, timezone, tzinfo
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

Ticks = NDArray[np.int64]

_MONTHS = {
    word: at
    for words in (
        "jan feb mar apr may jun jul aug sep oct nov dec",
        "- fév mär avr mai - - août - okt - dez",
        "ene - - abr - - - ago - - - dic",
    )
    for at, word in enumerate(words.split(), start=1)
}
_DATE = (
    r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{4}-\d{3}|\d{1,2}[-/.]\d{1,2}[-/.]\d{2,4}|\d{1,2}[- .][A-Za-zäéû]{3,9}[- .]\d{2,4}"
    r"|(?:19|20)\d{6}"
)
_CLOCK = r"(?:\d{1,2}:\d{2}[.,]\d{1,9}|\d{1,2}:\d{2}(?::\d{2}(?:[.,:]\d{1,9})?)?(?:\s*[AaPp]\.?[Mm]\.?)?)"
_ZONE = r"(?:\s*(?:Z|UTC|GMT|[+-]\d{2}(?::?\d{2})?|[A-Z]{3,4}|\[[\w/]+\]))?"
DATE = re.compile(_DATE)
CLOCK = re.compile(_CLOCK)
_MINUTES = re.compile(r"\d{1,2}:\d{2}[.,]\d{1,9}")
"""Minutes and seconds, as spreadsheets show them. [pattern]"""
DATED = re.compile(rf"(?:{_DATE})[ T_,;]*\s*(?:{_CLOCK}){_ZONE}")
"""A date with a time of day. [pattern]"""
_PARTS = re.compile(rf"({_DATE})?[ T_,;]*\s*({_CLOCK})?({_ZONE})")
_SPELLINGS = tuple(
    (re.compile(pattern, re.IGNORECASE), plain)
    for pattern, plain in (
        (r"^(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[.,]*\s+", ""),
        (r"^([a-z]{3,9})\.?\s+(\d{1,2}),?\s+(\d{4})", r"\2 \1 \3"),
        (r"^((?:19|20)\d{6})T?([01]\d|2[0-3])([0-5]\d)([0-6]\d)[.,]?(\d{0,8})", r"\1 \2:\3:\4.\g<5>0"),
        (r"(?<=\d\d[ T])(\d{1,2})\.(\d{2})\.(\d{2})", r"\1:\2:\3"),
        (r"^0 days?\s+", ""),
        (r"\b([ap])\.\s*m\.?", r"\1m"),
        (r"(?:오전|上午)\s*([\d:.,]+)", r"\1 AM"),
        (r"(?:오후|下午)\s*([\d:.,]+)", r"\1 PM"),
    )
)
"""How dates and times are written besides, and what is meant. [patterns; ISO 8601, locales]"""
ZONE_HOURS = {
    name: hours
    for hours, names in {
        **{
            0: "Z UTC GMT",
            1: "CET MEZ BST",
            2: "CEST MESZ",
            9: "JST",
            12: "NZST",
            -10: "HST",
            -9: "AKST",
            -8: "PST AKDT",
        },
        **{-7: "MST PDT", -6: "CST MDT", -5: "EST CDT", -4: "EDT"},
    }.items()
    for name in names.split()
}
"""Zones by name, hours ahead of UTC. [h; convention: North American and European ones]"""
_EPOCH = date(1970, 1, 1).toordinal()
_DAY_NS = 86_400 * 10**9


def _plain(text: str) -> str:
    """Write a date or time as most loggers do."""
    for spelt, plain in _SPELLINGS:
        text = spelt.sub(plain, text)
    return text


def form_of(cell: str) -> re.Pattern[str] | None:
    """Return what a cell is: `DATED`, `DATE` or `CLOCK`; None for none of them."""
    forms = (DATED, DATE, CLOCK)
    return next((form for text in (cell, _plain(cell)) for form in forms if form.fullmatch(text)), None)


def is_time(cell: str) -> bool:
    """Test whether a cell is a date, a time of day, or both, and a date that there is."""
    try:
        parse([cell])
    except ValueError:
        return False
    return True


@dataclass(frozen=True, eq=False, slots=True)
class Stamps:
    """Times of the rows of a table."""

    t_ns: Annotated[Ticks, "n"]
    """UTC, ns since 1970; since the first midnight where there is no date."""
    has_date: bool
    has_zone: bool
    """Whether the zone is known."""
    order: str
    """How a date is read, and why; empty where it can be read in one way."""
    is_doubtful: bool
    """Whether day and month could be exchanged."""


def parse(texts: Sequence[str], zone: tzinfo | None = None, hint: str = "") -> Stamps:
    """Convert texts of one form to times; `zone` is theirs where they state none, `hint` has a date in ISO form or none.

    A time of day without a date goes on past midnight.  Raises ValueError, with the index of the text, where one is no time.

    Examples
    --------
    >>> stamps = parse(["3/2/2026 1:59:59.99 PM", "3/2/2026 2:00:00.00 PM"])
    >>> np.diff(stamps.t_ns).tolist(), stamps.order
    ([10000000], 'month first, since the time is of AM and PM')
    """
    out = np.empty(len(texts), dtype=np.int64)
    of_date = np.empty(len(texts), dtype=np.int64)
    dates: dict[str, int] = {}
    zones: dict[str, int | None] = {}
    twelve_hours = False
    at_date = -1
    for at, text in enumerate(texts):
        match = _PARTS.fullmatch(text.strip()) or _PARTS.fullmatch(_plain(text.strip()))
        if match is None or not (match[1] or match[2]):
            raise ValueError(at)
        day, clock, zone_text = match[1], match[2] or "", match[3].strip()
        if day:
            at_date = dates.setdefault(day, len(dates))
        if zone_text not in zones:
            zones[zone_text] = _ahead_ns(zone_text)
        twelve_hours = twelve_hours or (clock[-1:] in "mM." and "m" in clock.casefold())
        of_date[at] = at_date
        out[at] = _clock_ns(clock) - (zones[zone_text] or 0)
    month_first, order, doubtful = _order(list(dates), twelve_hours, hint)
    if dates:
        days = [_day(text, month_first) for text in dates]
        if None in days:
            raise ValueError(int(np.argmax(of_date == days.index(None))))
        # Times before the first date are of the day 0.
        out += np.array([*days, 0], dtype=np.int64)[of_date] * _DAY_NS
    has_zone = any(ahead_ns is not None for ahead_ns in zones.values())
    if not dates:
        turn_ns = _DAY_NS // 24 if _MINUTES.fullmatch(texts[0].strip()) else _DAY_NS
        out += turn_ns * np.concatenate(([0], np.cumsum(np.diff(out) < -turn_ns // 2)))
    elif zone is not None and not has_zone:
        out -= _local_ns(out, zone)
    return Stamps(out, bool(dates), has_zone or zone is not None, order, doubtful)


def _order(dates: Sequence[str], twelve_hours: bool, hint: str) -> tuple[bool, str, bool]:
    """Return whether the month comes first, the reason, and whether it is in doubt; for dates such as 3/2/2026."""
    pairs = [re.fullmatch(r"(\d{1,2})([-/.])(\d{1,2})[-/.]\d{2,4}", text) for text in dates]
    ambiguous = [match for match in pairs if match is not None]
    if not ambiguous:
        return False, "", False
    first, second = ({int(match[k]) for match in ambiguous} for k in (1, 3))
    if max(first) > 12 and all(int(match.string.rpartition(match[2])[2]) <= 31 for match in ambiguous):
        return False, f"day first and the year last, as in {ambiguous[0].string!r}", ambiguous[0][2] != "."
    if max(first) > 12:
        return False, f"day first, as in {ambiguous[0].string!r}", False
    if max(second) > 12:
        return True, f"month first, as in {ambiguous[0].string!r}", False
    if len(second) > 1 == len(first):
        return True, "month first, since the second number counts on", False
    if len(first) > 1 == len(second):
        return False, "day first, since the first number counts on", False
    if ambiguous[0][2] == ".":
        return False, "day first, since points stand between", False
    if twelve_hours:
        return True, "month first, since the time is of AM and PM", False
    if (named := re.search(r"(\d{4})-?(\d{2})-?(\d{2})", hint)) is not None:
        month_and_day, pair = [int(named[2]), int(named[3])], [int(ambiguous[0][1]), int(ambiguous[0][3])]
        if pair == month_and_day:
            return True, "month first, as the file's name says", False
        if pair[::-1] == month_and_day:
            return False, "day first, as the file's name says", False
    return True, "month first", ambiguous[0][1] != ambiguous[0][3]


def _day(text: str, month_first: bool) -> int | None:
    """Return the days since 1970 of a date; None if it is none."""
    if re.fullmatch(r"\d{4}-\d{3}", text):
        return date(int(text[:4]), 1, 1).toordinal() + int(text[5:]) - 1 - _EPOCH
    numbers = [text[:4], text[4:6], text[6:]] if re.fullmatch(r"\d{8}", text) else re.split(r"[-/. ]", text)
    if len(numbers[0]) == 4:
        year, month, day = numbers
    elif month_first and numbers[1].isdigit():
        month, day, year = numbers
    else:
        day, month, year = numbers
    named = _MONTHS.get(month[:3].casefold()) if not month.isdigit() else int(month)
    try:
        full = int(year) + (0 if len(year) == 4 else 2000 if int(year) < 70 else 1900)
        return date(full, named or 0, int(day)).toordinal() - _EPOCH
    except ValueError:
        return None


def _clock_ns(text: str) -> int:
    """Return the time of day, ns; a second may be 60, as before a carry."""
    if not text:
        return 0
    if text[2:3] == ":" == text[5:6] and text[8:9] in (".", "") and (text[9:] + "0").isdigit():
        return ((int(text[:2]) * 60 + int(text[3:5])) * 60 + int(text[6:8])) * 10**9 + int(text[9:18].ljust(9, "0"))
    half = text.casefold().replace(".m", "m").rstrip(".")
    bare = re.sub(r"\s*[ap]\.?m\.?$", "", half)
    parts = re.split(r"[:.,]", bare)
    if _MINUTES.fullmatch(bare):
        parts = ["0", *parts]
    hours, minutes = int(parts[0]), int(parts[1])
    seconds = int(parts[2]) if len(parts) > 2 else 0
    fraction = int(parts[3][:9].ljust(9, "0")) if len(parts) > 3 else 0
    if half != bare:
        hours = hours % 12 + (12 if half.rstrip("m. ").endswith("p") else 0)
    return ((hours * 60 + minutes) * 60 + seconds) * 10**9 + fraction


def _ahead_ns(zone: str) -> int | None:
    """Return by how much a named zone is ahead of UTC, ns; None for one that is not known."""
    if (match := re.fullmatch(r"([+-])(\d{2})(?::?(\d{2}))?", zone)) is not None:
        return (1 if match[1] == "+" else -1) * (int(match[2]) * 60 + int(match[3] or 0)) * 60 * 10**9
    hours = ZONE_HOURS.get(zone.upper())
    return None if hours is None else hours * 3600 * 10**9


def _local_ns(t_ns: Annotated[Ticks, "n"], zone: tzinfo) -> Annotated[Ticks, "n"]:
    """Return by how much the times of a zone are ahead of UTC, ns; that of each hour, since it may change once a night."""
    hours = t_ns // (3600 * 10**9)
    ahead = {}
    for hour in np.unique(hours).tolist():
        local = datetime.fromtimestamp(hour * 3600, UTC).replace(tzinfo=zone)
        ahead[hour] = int((local.utcoffset() or timedelta(0)) / timedelta(microseconds=1)) * 1000
    return np.array([ahead[hour] for hour in hours.tolist()], dtype=np.int64)


def zone_in(heading: str) -> tzinfo | None:
    """Return the zone that a heading names, as in "Time (UTC)"; None without one."""
    if (match := re.search(r"(?:UTC|GMT)(?:\s*offset)?[\s:;,=]*([+-])(\d{1,2})(?::?(\d{2}))?\b", heading)) is not None:
        return zone_named(f"{match[1]}{int(match[2]):02d}:{match[3] or '00'}")
    words = [
        w
        for w in re.findall(r"[A-Za-z]+(?:/\w+)*", heading)
        if w.isupper() or w.casefold() in ("utc", "gmt") or "/" in w
    ]
    return next(
        (zone_named(word) for word in words if (word.upper() in ZONE_HOURS and word != "Z") or "/" in word), None
    )


def zone_named(name: str) -> tzinfo | None:
    """Return the zone of a name, as UTC, +01:00 or Europe/Zurich; None if there is none of it."""
    from zoneinfo import ZoneInfo

    ahead_ns = _ahead_ns(name) if name.upper() in ZONE_HOURS or re.fullmatch(r"[+-]\d{2}:?\d{2}", name) else None
    try:
        return ZoneInfo(name) if ahead_ns is None else timezone(timedelta(microseconds=ahead_ns // 1000))
    except (KeyError, ValueError, OSError):
        return None
