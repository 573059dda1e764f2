"""The chain of hashes of the ledger: what is changed afterwards shows, and an older ledger goes on validly."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from monitor.core import BadInputError, MissingInputError
from monitor.runs.ledger_chain import append_lines, read_head, verify
from tests.support.full_disk import no_room


@pytest.fixture
def ledger(tmp_path: Path) -> Path:
    place = tmp_path / "ledger.jsonl"
    for k in range(3):
        append_lines(place, [{"what": f"line {2 * k + 1}"}, {"what": f"line {2 * k + 2}"}])
    return place


def test_lines_follow_from_one_another(ledger: Path) -> None:
    rows = [json.loads(row) for row in ledger.read_text().splitlines()]
    assert [row["what"] for row in rows] == [f"line {k}" for k in range(1, 7)]
    assert len({row["previous"] for row in rows}) == 6
    head = read_head(ledger)
    assert head is not None and verify(ledger, [head, rows[3]["previous"]]) == 6
    assert append_lines(ledger, [{"what": "line 7"}]) == read_head(ledger)
    assert verify(ledger, [head]) == 7


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda rows: [*rows[:2], rows[2].replace(b"line 3", b"line 9"), *rows[3:]], 4),
        (lambda rows: [*rows[:2], *rows[3:]], 3),
        (lambda rows: rows[1:], 1),
        (lambda rows: [*rows[:4], b'{"what": "forged"}\n', *rows[4:]], 5),
        (lambda rows: [*rows[:4], b"no JSON\n", *rows[4:]], 5),
        (lambda rows: [rows[1], rows[0], *rows[2:]], 1),
    ],
)
def test_the_first_line_that_does_not_follow_is_named(ledger: Path, change, line: int) -> None:  # type: ignore[no-untyped-def]
    ledger.write_bytes(b"".join(change(ledger.read_bytes().splitlines(keepends=True))))
    with pytest.raises(BadInputError, match=rf"ledger\.jsonl: line {line} "):
        verify(ledger)


def test_lines_cut_off_at_the_end_show_by_a_head_that_was_kept(ledger: Path) -> None:
    head = read_head(ledger)
    assert head is not None
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[:4]))
    assert verify(ledger) == 4
    with pytest.raises(BadInputError, match="after line 4 lines are missing"):
        verify(ledger, [head])
    ledger.unlink()
    assert verify(ledger) == 0 and read_head(ledger) is None
    with pytest.raises(BadInputError, match="after line 0"):
        verify(ledger, [head])


def test_an_older_ledger_goes_on_and_is_guarded_from_then_on(tmp_path: Path) -> None:
    place = tmp_path / "ledger.jsonl"
    place.write_text('{"what": "old 1"}\n{"what": "old 2"}\n')
    assert verify(place) == 2
    append_lines(place, [{"what": "new"}])
    append_lines(place, [{"what": "newer"}])
    assert verify(place) == 4
    place.write_text(place.read_text().replace("old 1", "old 7"))
    with pytest.raises(BadInputError, match="line 3 "):
        verify(place)


def test_half_a_line_is_removed_and_a_full_disk_leaves_none(ledger: Path) -> None:
    whole = ledger.read_bytes()
    ledger.write_bytes(whole + b'{"what": "ha')
    assert verify(ledger) == 6
    with no_room("fsync"), pytest.raises(MissingInputError, match=r"ledger\.jsonl: cannot be written: No space"):
        append_lines(ledger, [{"what": "lost"}])
    assert ledger.read_bytes() == whole
    append_lines(ledger, [{"what": "line 7"}])
    assert verify(ledger) == 7
