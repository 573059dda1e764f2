"""Units as people write them: in a heading's brackets, behind a name, in a row of their own."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import NamedTuple

G_M_S2 = 9.80665
"""Standard gravity. [m/s^2; definition]"""
ACCELERATION, ROTATION, FORCE, TIME = "acceleration", "a rate of rotation", "force", "time"


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of a quantity."""

    symbol: str
    """As it is told."""
    quantity: str
    factor: float
    """To the unit in which the quantity is kept: m/s^2, rad/s, N, s, degC; 1 for any other."""
    offset: float = 0.0
    """Added after scaling."""


_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254, "ft": 0.3048}
"""Lengths, m. [definition: SI, international inch and foot]"""
_PER_S2 = r"(?:/\(?s(?:\^?2|/s)\)?|\*?s\^?-2|_s_?2|ps2|s2|/s/s)"
_PER_LENGTH = re.compile(rf"({'|'.join(sorted(_LENGTHS, key=len, reverse=True))})\*?{_PER_S2}")
_GRAVITY = re.compile(r"(m|milli|u|micro|%)?-?_?(?:g(?:'?s|n|_n|_?0|rav|ravity|-?force)?)")
_PARTS = {"": 1.0, "m": 1e-3, "milli": 1e-3, "u": 1e-6, "micro": 1e-6, "%": 1e-2}
_FIXED = {
    spelt: Unit(symbol, quantity, factor, offset)
    for spellings, symbol, quantity, factor, offset in (
        ("gal gals", "Gal", ACCELERATION, 1e-2, 0.0),
        ("mgal", "mGal", ACCELERATION, 1e-5, 0.0),
        ("rad/s", "rad/s", ROTATION, 1.0, 0.0),
        ("mrad/s", "mrad/s", ROTATION, 1e-3, 0.0),
        ("deg/s dps", "deg/s", ROTATION, radians(1.0), 0.0),
        ("mdeg/s", "mdeg/s", ROTATION, radians(1e-3), 0.0),
        ("n", "N", FORCE, 1.0, 0.0),
        ("kn", "kN", FORCE, 1e3, 0.0),
        ("lbf", "lbf", FORCE, 4.4482216152605, 0.0),
        ("s", "s", TIME, 1.0, 0.0),
        ("ms msec millis", "ms", TIME, 1e-3, 0.0),
        ("us micros", "us", TIME, 1e-6, 0.0),
        ("ns", "ns", TIME, 1e-9, 0.0),
        ("min", "min", TIME, 60.0, 0.0),
        ("h hours", "h", TIME, 3600.0, 0.0),
        ("days", "days", TIME, 86400.0, 0.0),
        ("degc celsius c", "degC", "temperature", 1.0, 0.0),
        ("k kelvin", "K", "temperature", 1.0, -273.15),
        ("degf", "degF", "temperature", 5.0 / 9.0, -32.0 * 5.0 / 9.0),
    )
    for spelt in spellings.split()
}
"""Units that are written in one way. [definition; conventions of loggers]"""
_OTHERS = {
    spelt: quantity
    for quantity, spellings in {
        "voltage": "v mv uv mv/v volt volts",
        "speed": "m/s km/h mph knots kn/h mm/s cm/s in/s",
        "displacement": "m cm mm um in ft",
        "strain": "um/m ue ustrain microstrain strain m/m mm/m",
        "counts": "counts count lsb adc digits raw",
        "pressure": "pa hpa kpa mpa bar mbar psi",
        "share": "% %rh rh percent",
        "angle": "deg rad mrad mdeg",
        "quantity": "ma a hz khz w/m2 w/m^2 kg knm nm rpm rn ut db",
    }.items()
    for spelt in spellings.split()
}
"""Units of quantities that are kept as they are."""


_SPELLINGS = tuple(
    (re.compile(pattern), plain)
    for pattern, plain in (
        ("⁻²", "-2"),
        ("â²|²", "^2"),
        ("[µμ]", "u"),
        ("°", "deg"),
        (r"\*\*", "^"),
        (r"[{}()$\\]", ""),
        ("[·⋅×]", "*"),
        (r"\bseconds?\b|\bsec\b|(?<=[/*])sec", "s"),
        (r"\b(milli|micro|nano)seconds?\b", lambda m: f"{'mun'[('milli', 'micro', 'nano').index(m[1])]}s"),
        (r"degrees?", "deg"),
        (r"met(er|re)s?", "m"),
        (r"inch(es)?", "in"),
        (r"\bfeet\b", "ft"),
        (r"\bsquared?\b|(?<=s )sq\b", "^2"),
        (r"[\s_]+per[\s_]+", "/"),
    )
)
"""How units are spelt, and what is meant."""


def unit_of(text: str) -> Unit | None:
    """Return the unit that a text means; None if it means none that is known.

    Examples
    --------
    >>> [unit_of(t).factor for t in ("m/sec^2", "cm s-2", "ft/s²", "g's", "milli-g")]
    [1.0, 0.01, 0.3048, 9.80665, 0.00980665]
    >>> unit_of("V").quantity, unit_of("floor")
    ('voltage', None)
    """
    bare = text.strip().strip("[](){}").strip().casefold().removeprefix("in ")
    for spelt, plain in _SPELLINGS:
        bare = spelt.sub(plain, bare)
    tight = re.sub(r"[\s.]+", "", bare)
    if (match := _PER_LENGTH.fullmatch(tight)) is not None:
        length = match[1]
        return Unit(f"{length}/s^2", ACCELERATION, _LENGTHS[length])
    if (match := _GRAVITY.fullmatch(tight)) is not None:
        part = match[1] or ""
        return Unit(f"{part[:1]}g", ACCELERATION, _PARTS[part] * G_M_S2)
    if tight in _FIXED:
        return _FIXED[tight]
    return Unit(text.strip(), _OTHERS[tight], 1.0) if tight in _OTHERS else None


_BRACKETS = re.compile(r"(.*?)\s*[\[({]((?:[^\[\](){}]|\([^()]*\))*)[\])}]\s*(.*)")
_ALONE = frozenset({"c", "k", "h", "n", "m", "v", "a", "in", "min", "s"})
"""Units that a name may end with by chance."""
_LONGEST = 40
"""Longest unit that a name may end with. [characters; judgement: "metres per second squared" has 25]"""


class Heading(NamedTuple):
    """Heading of a column, split."""

    name: str
    unit: str
    """As it is written or meant; empty where the heading states none."""
    is_by_name: bool
    """Whether the unit is part of the name, and not in brackets."""


def split_name(heading: str) -> Heading:
    """Split a heading into name and unit.

    Examples
    --------
    >>> [tuple(split_name(heading)) for heading in ("Mid span [g]", "ax_g", "time_ms", "roof")]
    [('Mid span', 'g', False), ('ax_g', 'g', True), ('time_ms', 'ms', True), ('roof', '', False)]
    """
    heading = re.sub(r"\^\{(-?\d)\}", r"^\1", heading.strip())
    if (
        (match := _BRACKETS.fullmatch(heading)) is not None
        and (match[1] or match[3])
        and not match[2].strip().isdigit()
    ):
        name = " ".join(part for part in (match[1].rstrip(" ,:-"), match[3]) if part)
        return Heading(name, match[2].strip(" -").removeprefix("in "), False)
    # The longest end that is a unit: "a m s-2" ends with "m s-2", not with "s-2".
    for match in re.finditer(r"[\s_/:.,-]+(?:in[\s_]+)?", heading):
        end = heading[match.end() :]
        if len(end) > _LONGEST:
            continue
        unit = unit_of(end) or unit_of(end.replace("_", "/"))
        if match.start() and unit is not None:
            by_chance = unit.quantity not in (ACCELERATION, ROTATION, TIME) and end.casefold() in _ALONE
            if not by_chance:
                return Heading(heading, end if end.casefold() == unit.symbol.casefold() else unit.symbol, True)
    return Heading(heading, "", False)


def split_names(headings: Sequence[str]) -> list[Heading]:
    """Split the headings of one table: a single letter is no unit where another heading differs in that letter alone."""
    shared = Counter(heading.strip()[:-1] for heading in headings)
    return [
        Heading(one.name, "", False) if one.is_by_name and len(one.unit) == 1 and shared[one.name[:-1]] > 1 else one
        for one in map(split_name, headings)
    ]


def units_in_names(headings: Sequence[str]) -> list[str]:
    """Return the unit that each heading of a table ends with, without brackets; empty where it ends with none.

    Examples
    --------
    >>> units_in_names(["ax_g", "acc_y_mg", "Accel in g", "roof", "a_m_s2"]), units_in_names(["ch_f", "ch_g"])
    (['g', 'mg', 'g', '', 'm/s^2'], ['', ''])
    """
    return [one.unit if one.is_by_name else "" for one in split_names(headings)]
