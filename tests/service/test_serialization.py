"""State on the disk: the same value comes back, bit for bit; anything else is refused with a reason, never guessed at."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from monitor.config import configuration
from monitor.core import WindowResult
from monitor.events import EventState, GroundState
from monitor.model import simulate
from monitor.pipeline import Pipeline, PipelineState
from monitor.publish import to_json, window_line
from monitor.runs import Session, SessionState
from monitor.service import serialization
from monitor.service.restart import Saved
from monitor.service.serialization import CheckpointError, from_bytes, load, previous, save, to_bytes
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


def test_an_older_version_is_upgraded_step_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    old = to_bytes("k", LEAF)
    present = serialization.VERSION
    monkeypatch.setattr(serialization, "VERSION", present + 2)
    monkeypatch.setitem(serialization.UPGRADES, present, lambda tree: tree | {"number": tree["number"] + 10})
    with pytest.raises(CheckpointError, match=f"version {present + 1}, which cannot be upgraded"):
        from_bytes(old, "k", Leaf)
    monkeypatch.setitem(serialization.UPGRADES, present + 1, lambda tree: tree | {"array": tree["array"] * 2.0})
    found = from_bytes(old, "k", Leaf)
    assert found.number == 11 and found.array.tolist() == [0.0, 2.0, 4.0]


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
def test_a_disk_that_refuses_leaves_the_last_one_standing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    place = tmp_path / "c"
    save(place, "k", LEAF)

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, call, full)
    with pytest.raises(OSError, match="space"):
        save(place, "k", replace(LEAF, number=2))
    monkeypatch.undo()
    assert load(place, "k", Leaf).number == 1  # type: ignore[union-attr]
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


def test_objects_and_unknown_types_are_never_written() -> None:
    for value in (np.array([object()]), np.array(["text"]), object()):
        with pytest.raises(TypeError, match="cannot be kept"):
            to_bytes("k", replace(LEAF, array=value))


SPAN_FAULTS = ("resolution_m_s2", "step_m_s2", "drift_m_s2", "held_s", "hum_hz", "mains_hz")
"""What version 4 added to the health of a channel."""


def without_span_faults(state: PipelineState) -> PipelineState:
    """The state as one of an older version is read: the spans' faults are not known."""
    unknown = dict.fromkeys(SPAN_FAULTS[:4], 0.0) | dict.fromkeys(SPAN_FAULTS[4:], None)
    spans = tuple(
        replace(span, channels=tuple(replace(c, **unknown) for c in span.channels))  # type: ignore[arg-type]
        for span in state.health.spans
    )
    return replace(state, health=replace(state.health, spans=spans))


def without_channel_states(state: PipelineState) -> PipelineState:
    """The state as one of a version before 5 is read: which samples single channels lost is not known."""
    run = state.run and replace(state.run, lost=replace(state.run.lost, held=np.zeros(3)))
    return replace(state, run=run)


def as_version(data: bytes, version: int) -> bytes:
    """The checkpoint as an older program wrote it: a summary that counts itself, sums in each block that others tell as well."""
    line, _, body = data.partition(b"\n")
    text, _, arrays = body.partition(b"\n")
    if version < 10:
        tree = json.loads(text)
        events = tree["session"]["pipeline"]["events"]
        pieces = [piece["@array"] for piece in events["kept"]]  # one behind the other
        if pieces:
            dtype, (_, channels), axes, at = pieces[0]
            events["kept"] = {"@array": [dtype, [sum(shape[0] for _, shape, _, _ in pieces), channels], axes, at]}
        else:
            events["kept"] = {"@array": ["<f8", [0, 0], [0, 1], 0]}
        text = json.dumps(tree, separators=(",", ":")).encode()
    if version < 7:
        tree = json.loads(text)
        assert tree["session"]["pipeline"]["events"].pop("alarms") == []
        text = json.dumps(tree, separators=(",", ":")).encode()
    if version < 5:
        tree = json.loads(text)
        pipeline, course = tree["session"]["pipeline"], tree["session"]["summary"]["course"]
        assert pipeline.pop("watch") == {"channels": []} and course.pop("outages") == []
        if pipeline["run"] is not None:
            del pipeline["run"]["lost"], pipeline["run"]["window"]["lost"]
        del pipeline["covariates"], pipeline["learning"], pipeline["events"], pipeline["ground"]
        for key in ("channels", "common", "before"):
            del pipeline["alarm"]["history"][key]
        for span in pipeline["health"]["spans"]:
            for channel in span["channels"]:
                del channel["lost"]
        for name in ("last", "judged"):
            if course[name] is not None:
                del course[name]["left_out"]
        text = json.dumps(tree, separators=(",", ":")).encode()
    if version < 4:
        tree = json.loads(text)
        for span in tree["session"]["pipeline"]["health"]["spans"]:
            span["channels"] = [{k: v for k, v in c.items() if k not in SPAN_FAULTS} for c in span["channels"]]
        text = json.dumps(tree, separators=(",", ":")).encode()
    if version < 3:
        tree = json.loads(text)
        course = tree["session"]["summary"].pop("course")
        assert not course["losses"]
        counts = {name: course[name] for name in ("windows", "skipped", "skip_reasons")}
        summary = tree["session"]["summary"]
        means = [hz for _, (_, hz) in summary.pop("modes")]
        del summary["other_modes"], summary["missing_modes"]
        summary |= counts | {"alarms": [], "frequencies_hz": means or None, "n_frequencies": len(means)}
        text = json.dumps(tree, separators=(",", ":")).encode()
    if version < 2:
        text = re.sub(rb'"shifted":(\{[^}]*\})', rb'"first":\1,"second":\1,"total":\1', text)
    body = text + b"\n" + arrays
    head = json.loads(line) | {"version": version, "sha256": hashlib.sha256(body).hexdigest()}
    return json.dumps(head).encode() + b"\n" + body


@pytest.mark.parametrize("version", [1, 2, 3, 4, 5, 6, 9, 10])
@pytest.mark.parametrize("at", [1, 27, 40])
def test_a_pipeline_goes_on_from_its_state_as_if_nothing_had_been(
    frame_text: str, cut: Cut, tmp_path: Path, at: int, version: int
) -> None:
    path = tmp_path / "s.toml"
    path.write_text(frame_text)
    settings = configuration.load(path)
    blocks = cut(simulate(settings.model(), duration_s=60.0, rate_hz=RATE, noise=0.03, seed=6).floors, RATE)
    del blocks[20]  # a gap, so that a run lies behind another

    def lines(pipeline: Pipeline, some: Any) -> list[str]:
        return [to_json(window_line(r)) for b in some for r in pipeline.push(b) if isinstance(r, WindowResult)]

    one = Pipeline(settings)
    wanted = lines(one, blocks)
    first, second = Session(settings, None, (), None, tmp_path), Session(settings, None, (), None, tmp_path)
    for block in blocks[:at]:
        first.push(block)
    data = to_bytes("k", Saved(first.state, 5, 6))
    assert version <= serialization.VERSION
    saved = from_bytes(as_version(data, version) if version < serialization.VERSION else data, "k", Saved)

    def known(state: PipelineState) -> PipelineState:
        """The state without what the older version did not know."""
        if version < 5:
            state = replace(without_channel_states(state), events=EventState(), ground=GroundState())
        elif version < 10 and state.events.kept:
            state = replace(state, events=replace(state.events, kept=(np.concatenate(state.events.kept),)))
        return without_span_faults(state) if version < 4 else state

    assert same(known(first.state.pipeline), saved.session.pipeline)
    assert saved.session.summary.course.windows == first.windows
    assert version < serialization.VERSION or same(first.state, saved.session)
    second.restore(saved.session)
    done = first.windows
    assert lines(second.pipeline, blocks[at:]) == wanted[done:]
    assert same(known(one.state), known(second.pipeline.state))


def test_what_changes_results_changes_the_key_and_nothing_else_does() -> None:
    assert serialization.fingerprint({"a": 1, "b": [1.0]}) == serialization.fingerprint({"b": [1.0], "a": 1})
    assert serialization.fingerprint({"a": 1}) != serialization.fingerprint({"a": 2})


def test_session_state_is_a_copy(frame_text: str, cut: Cut, tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(frame_text)
    session = Session(configuration.load(path), None, (), None, tmp_path)
    before: SessionState = session.state
    for block in cut(np.random.default_rng(1).standard_normal((4000, 3)), RATE):
        session.push(block)
    assert before.summary.course.windows == 0 and session.windows > 0
