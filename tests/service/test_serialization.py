"""State on the disk: the same value comes back, bit for bit; anything else is refused with a reason, never guessed at."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from monitor.core import WindowResult
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.publish import to_json, window_line
from monitor.runs import Session, SessionState
from monitor.service.restart import Saved
from monitor.service.serialization import (
    UPGRADES,
    VERSION,
    CheckpointError,
    fingerprint,
    from_bytes,
    load,
    previous,
    save,
    to_bytes,
)
from tests.support.frames import settings_of
from tests.support.full_disk import no_room
from tests.support.samples import Cut

RATE = 128.0


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Leaf:
    number: int
    value: float
    name: str
    flag: bool
    colour: Colour
    ratio: Fraction
    array: NDArray[np.float64]


@dataclass(frozen=True)
class Tree:
    leaves: tuple[Leaf, ...]
    pair: tuple[int, NDArray[np.complex128]]
    maybe: Leaf | None
    table: dict[int, float]
    words: list[str]


FLOATS = st.floats(allow_nan=True, allow_infinity=True, width=64)
ARRAYS = hnp.arrays(
    st.sampled_from([np.float64, np.complex128, np.int64, np.float32, np.bool_]),
    hnp.array_shapes(min_dims=0, min_side=0),
)
LEAVES = st.builds(
    Leaf,
    number=st.integers(-(2**80), 2**80),
    value=FLOATS,
    name=st.text(st.characters(exclude_categories=("Cs",))),
    flag=st.booleans(),
    colour=st.sampled_from(Colour),
    ratio=st.fractions(),
    array=ARRAYS.map(lambda a: a.T) | ARRAYS,
)
TREES = st.builds(
    Tree,
    leaves=st.lists(LEAVES, max_size=3).map(tuple),
    pair=st.tuples(st.integers(), hnp.arrays(np.complex128, (2, 3))),
    maybe=st.none() | LEAVES,
    table=st.dictionaries(st.integers(), FLOATS, max_size=3),
    words=st.lists(st.text(st.characters(exclude_categories=("Cs",))), max_size=3),
)


def same(a: Any, b: Any) -> bool:
    """Equal to the bit, types and the order of axes in memory included."""
    if isinstance(a, np.ndarray):
        alike = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return alike and (a.size < 2 or a.flags.f_contiguous == b.flags.f_contiguous)
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, n), getattr(b, n)) for n in a.__dataclass_fields__)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, float):
        return isinstance(b, float) and (a.hex() == b.hex())
    return bool(a == b)


@given(TREES)
@settings(deadline=None, max_examples=100)
def test_what_comes_back_is_the_same_to_the_bit(tree: Tree) -> None:
    assert same(tree, from_bytes(to_bytes("k", tree), "k", Tree))


@given(data=st.binary(max_size=200), at=st.integers(0, 10_000), cut=st.integers(0, 10_000))
@settings(deadline=None, max_examples=300)
def test_damage_anywhere_is_refused_and_nothing_else_happens(data: bytes, at: int, cut: int) -> None:
    leaf = Leaf(1, 2.0, "x", True, Colour.RED, Fraction(1, 3), np.arange(30.0))
    whole = to_bytes("k", leaf)
    for bad in (
        data,
        whole[: cut % len(whole)],
        whole[: at % len(whole)] + data + whole[at % len(whole) + len(data) :],
    ):
        if bad != whole:
            try:
                found = from_bytes(bad, "k", Leaf)
            except CheckpointError:
                continue
            assert same(found, leaf)  # only the head's spacing differs


def head_with(data: bytes, **changes: Any) -> bytes:
    line, _, body = data.partition(b"\n")
    return json.dumps(json.loads(line) | changes).encode() + b"\n" + body


LEAF = Leaf(1, 2.0, "x", True, Colour.RED, Fraction(1, 3), np.arange(3.0))


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "fit this program"),
        (b"\x80\x04\x95pickle", "fit this program"),
        (b"{}\n", "no checkpoint"),
        (to_bytes("other", LEAF), "another configuration"),
        (head_with(to_bytes("k", LEAF), version=99), "newer program"),
        (head_with(to_bytes("k", LEAF), version=0), "cannot be upgraded"),
        (to_bytes("k", LEAF)[:-1], "damaged"),
        (to_bytes("k", replace(LEAF, number="one")), "fit this program"),
        (to_bytes("k", Tree((), (1, np.zeros(2, complex)), None, {}, [])), "other fields"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, data: bytes, says: str
) -> None:
    with pytest.raises(CheckpointError, match=says):
        from_bytes(data, "k", Leaf)
    (tmp_path / "c").write_bytes(data)
    with caplog.at_level(logging.WARNING):
        assert load(tmp_path / "c", "k", Leaf) is None
    assert "not resumed from" in caplog.text and str(tmp_path / "c") in caplog.text


def test_an_older_version_is_upgraded_step_by_step() -> None:
    old, present = to_bytes("k", LEAF), VERSION
    upgrades: dict[int, Callable[[Any], Any]] = {present: lambda tree: tree | {"number": tree["number"] + 10}}
    with pytest.raises(CheckpointError, match=f"version {present + 1}, which cannot be upgraded"):
        from_bytes(old, "k", Leaf, present + 2, upgrades)
    upgrades[present + 1] = lambda tree: tree | {"number": 2 * tree["number"], "array": tree["array"] * 2.0}
    found = from_bytes(old, "k", Leaf, present + 2, upgrades)
    assert found.number == 22 and found.array.tolist() == [0.0, 2.0, 4.0]


def test_a_session_of_version_1_begins_to_count_its_windows_modes_and_kept_alarms_stay_as_they_are() -> None:
    old = {"session": {"pipeline": {"run": None}}}
    assert UPGRADES[1](old)["session"]["pipeline"] == {"run": None, "sightings": []}
    assert UPGRADES[1]({"stories": []}) == {"stories": []}


def test_the_one_before_is_used_when_the_last_is_damaged(tmp_path: Path) -> None:
    place = tmp_path / "c"
    save(place, "k", LEAF)
    save(place, "k", replace(LEAF, number=2))
    assert load(place, "k", Leaf).number == 2  # type: ignore[union-attr]
    place.write_bytes(place.read_bytes()[:-3])
    assert load(place, "k", Leaf).number == 1  # type: ignore[union-attr]
    place.unlink()  # as between the two renames
    assert load(place, "k", Leaf).number == 1  # type: ignore[union-attr]
    previous(place).unlink()
    assert load(place, "k", Leaf) is None


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_refuses_leaves_the_last_one_standing(tmp_path: Path, call: str) -> None:
    place = tmp_path / "c"
    save(place, "k", LEAF)
    with no_room(call), pytest.raises(OSError, match="space"):
        save(place, "k", replace(LEAF, number=2))
    assert load(place, "k", Leaf).number == 1  # type: ignore[union-attr]
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


def test_objects_and_unknown_types_are_never_written() -> None:
    for value in (np.array([object()]), np.array(["text"]), object()):
        with pytest.raises(TypeError, match="cannot be kept"):
            to_bytes("k", replace(LEAF, array=value))


@pytest.mark.parametrize("at", [1, 27, 40])
def test_a_pipeline_goes_on_from_its_state_as_if_nothing_had_been(
    frame_text: str, cut: Cut, tmp_path: Path, at: int
) -> None:
    settings = settings_of(frame_text)
    blocks = cut(simulate(settings.model(), duration_s=60.0, rate_hz=RATE, noise=0.03, seed=6).floors, RATE)
    del blocks[20]  # a gap, so that a run lies behind another

    def lines(pipeline: Pipeline, some: Any) -> list[str]:
        return [to_json(window_line(r)) for b in some for r in pipeline.push(b) if isinstance(r, WindowResult)]

    one = Pipeline(settings)
    wanted = lines(one, blocks)
    first, second = Session(settings, None, (), None, tmp_path), Session(settings, None, (), None, tmp_path)
    for block in blocks[:at]:
        first.push(block)
    saved = from_bytes(to_bytes("k", Saved(first.state, 5, 6)), "k", Saved)
    assert same(Saved(first.state, 5, 6), saved)
    second.restore(saved.session)
    done = first.windows
    assert lines(second.pipeline, blocks[at:]) == wanted[done:]
    assert same(one.state, second.pipeline.state)


def test_what_changes_results_changes_the_key_and_nothing_else_does() -> None:
    assert fingerprint({"a": 1, "b": [1.0]}) == fingerprint({"b": [1.0], "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 2})


def test_session_state_is_a_copy(frame_text: str, cut: Cut, tmp_path: Path) -> None:
    session = Session(settings_of(frame_text), None, (), None, tmp_path)
    before: SessionState = session.state
    for block in cut(np.random.default_rng(1).standard_normal((4000, 3)), RATE):
        session.push(block)
    assert before.summary.course.windows == 0 and session.windows > 0


@dataclass(frozen=True)
class Count:
    count: int


def test_a_linked_checkpoint_stays_a_link_and_keeps_the_one_before(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    place = tmp_path / "checkpoint"
    place.symlink_to("disk/checkpoint")
    for count in (1, 2, 3):
        save(place, "key", Count(count))
    assert place.is_symlink() and load(place, "key", Count) == Count(3)
    (tmp_path / "disk" / "checkpoint").write_bytes(b"damaged")
    assert load(place, "key", Count) == Count(2)
