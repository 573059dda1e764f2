"""A seeded sample of hostile input to every way in: refused as promised, never a crash.  The whole run is `tests.fuzz.run`."""

from __future__ import annotations

import contextlib
import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from tests.fuzz.files import APART, FILES
from tests.fuzz.targets import TARGETS

_FORMATS = (*FILES, "ros2", "can_log", "asc", "blf", "trc")
_TOKENS = (*b'-1 1e999 NaN null " < > \x80'.split(), b"\n", b"\xff" * 8, b"\0" * 8, b"[" * 3000, b"9" * 400)


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    with caplog.at_level("CRITICAL"):
        yield


def mutated(data: bytes, seeds: list[bytes], draw: random.Random) -> bytes:
    """A few changes: bits, bytes, numbers, pieces cut, doubled, moved and taken from elsewhere."""
    bad = bytearray(data)
    for _ in range(draw.choice([1, 1, 2, 4, 16])):
        at, size = draw.randrange(len(bad) + 1), draw.choice([1, 2, 4, 8, 64, 1000])
        match draw.randrange(7):
            case 0 if at < len(bad):
                bad[at] ^= 1 << draw.randrange(8)
            case 1:
                bad[at : at + size] = draw.randbytes(size)
            case 2:
                del bad[at : at + size]
            case 3:
                bad[at:at] = bad[at : at + size]
            case 4:
                bad[at:at] = draw.choice(_TOKENS)
            case 5:
                other = draw.choice(seeds)
                begin = draw.randrange(len(other) + 1)
                bad[at : at + size] = other[begin : begin + size]
            case _:
                bad = bad[:at]
    return bytes(bad[:20_000])


def _mutate(name: str, count: int) -> None:
    """Read what is right, what is nothing, and mutations."""
    target, draw = TARGETS[name], random.Random(f"{name} {count}")
    seeds = target.seeds()
    for data in (*seeds, b"", b"\n", b"{}", b"[]"):
        target.run(data)
    for _ in range(count):
        target.run(mutated(draw.choice(seeds), seeds, draw))


@pytest.mark.parametrize("name", [name for name in TARGETS if name not in _FORMATS])
def test_mutations_of_what_is_right(name: str) -> None:
    target = TARGETS[name]
    _mutate(name, max(target.least, round(3000 * target.share)))


@pytest.mark.system
@pytest.mark.parametrize("name", _FORMATS)
def test_200_mutated_files_of_each_format_are_read_or_refused_within_bounds(name: str) -> None:
    _mutate(name, max(200, TARGETS[name].least))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", _FORMATS)
def test_2000_mutated_files_of_each_format_are_read_or_refused_within_bounds(name: str) -> None:
    _mutate(name, 2000)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_right_is_read(name: str) -> None:
    """Else its mutations would all be refused for one reason."""
    target = FILES[name]
    assert any(target.run(data) for data in target.seeds())


@pytest.mark.system
@pytest.mark.parametrize("name", APART)
def test_a_few_mutated_files_are_read_or_refused_by_a_process_of_its_own(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.fuzz.files.forked", lambda apart: contextlib.nullcontext())
    _mutate(name, 3)


@pytest.mark.parametrize("where", ["preamble", "heading", "units"])
@pytest.mark.parametrize("word", ["_a", "date ", "9", " ", '"'])
def test_a_long_line_takes_a_time_that_grows_with_it_and_no_faster(word: str, where: str) -> None:
    line = (word * 20_000)[:20_000]
    above = {"preamble": f"{line}\nt,a", "heading": f"t,{line}", "units": f"t,a\ns,{line}"}[where]
    begun = time.process_time()
    FILES["csv"].run((above + "".join(f"\n{k / 100},0.{k:03d}" for k in range(50))).encode())
    assert time.process_time() - begun < 2.0


@pytest.mark.parametrize("name", TARGETS)
def test_anything_at_all(name: str) -> None:
    target = TARGETS[name]

    @settings(
        max_examples=min(25, target.least),
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.one_of(st.binary(max_size=3000), st.text(max_size=500).map(str.encode)))
    def run(data: bytes) -> None:
        target.run(data)

    run()


@pytest.mark.parametrize("path", sorted((Path(__file__).parent / "found").iterdir()), ids=lambda p: p.name)
def test_what_the_guided_search_once_found(path: Path) -> None:
    TARGETS[path.name.partition("-")[0]].run(path.read_bytes())
