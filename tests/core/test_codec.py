"""One codec: what is written is what is read, and what does not fit is refused by its place."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import pytest

from monitor.core import Array, decode, encode


@dataclass(frozen=True, eq=False)
class Bearing:
    name: str
    stiffness: Annotated[float, 0.0]
    knots: Annotated[Array, "j"]
    slopes: Annotated[Array, "j+2"]


@dataclass(frozen=True, eq=False)
class Bridge:
    kind: Literal["beam", "arch"]
    bearings: tuple[Bearing, ...]
    masses: Annotated[Array, "n", 0.0]
    modes: Annotated[Array, "m n"]
    span: tuple[float, float]
    motion: Annotated[Array, "c c"] | None = None
    levels: dict[str, float] = field(default_factory=dict)


WHOLE = Bridge(
    "beam",
    (Bearing("left", 2.0, np.array([1.0]), np.ones(3)), Bearing("right", 3.0, np.zeros(0), np.ones(2))),
    np.array([1.0, 2.0]),
    np.arange(6.0).reshape(3, 2),
    (0.0, 4.5),
    None,
    {"day": 1.5},
)


def test_what_is_written_is_read() -> None:
    tree = json.loads(json.dumps(encode(WHOLE)))
    assert json.loads(json.dumps(encode(decode(Bridge, tree)))) == tree
    assert "levels" not in encode(WHOLE, omit=("levels",))
    assert decode(Bridge, encode(WHOLE, omit=("levels",)), {"levels": {}}).levels == {}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": "mast"}, "kind: 'mast' is none of beam, arch"),
        ({"masses": [1.0]}, "modes: 2 values along n, 1 are expected"),
        ({"masses": [1.0, 0.0]}, "masses: not all values are above 0"),
        ({"masses": [1.0, "2"]}, "masses: not all values are numbers"),
        ({"masses": [True, True]}, "masses: not all values are numbers"),
        ({"masses": [1.0, float("inf")]}, "masses: not all values are finite"),
        ({"masses": 1.0}, "masses: 0 axes, 1 are expected"),
        ({"modes": [[1.0, 2.0], [1.0]]}, "modes: its rows are of different lengths"),
        ({"motion": [[1.0, 2.0]]}, "motion: 2 values along c, 1 are expected"),
        ({"span": [0.0]}, "span: 1 values, 2 are expected"),
        ({"span": [0.0, float("nan")]}, "span[1]: nan is not finite"),
        ({"span": [0.0, True]}, "span[1]: 'True' is no number"),
        ({"levels": {"day": "high"}}, "levels.day: 'high' is no number"),
        ({"bearings": [{"name": "left"}]}, "bearings[0]: a Bearing has other fields"),
        ({"bearings": {}}, "bearings: '{}' is no list"),
        ({"colour": "red"}, "colour is not known"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_place(change: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(says)}$"):
        decode(Bridge, encode(WHOLE) | change)


def test_lengths_of_one_value_say_nothing_of_its_neighbour_and_those_known_from_outside_are_demanded() -> None:
    tree = encode(WHOLE)
    tree["bearings"][1]["slopes"] = [1.0]
    with pytest.raises(ValueError, match=r"bearings\[1\]\.slopes: 1 values along j\+2, 2 are expected"):
        decode(Bridge, tree)
    with pytest.raises(ValueError, match="masses: 2 values along n, 3 are expected"):
        decode(Bridge, encode(WHOLE), n=3)
    with pytest.raises(ValueError, match="bridge: '3' is no object"):
        decode(Bridge, 3, place="bridge")
    with pytest.raises(ValueError, match=r"bridge\.bearings is missing"):
        decode(Bridge, {}, place="bridge")
