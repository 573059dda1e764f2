"""Results of any run for other programs: what comes out is what results.jsonl holds, in a form that others read."""

from __future__ import annotations

import csv
import json
import math
import re
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import zstandard

from monitor.core import BadInputError, MissingInputError, UserError, WrongUsageError
from monitor.publish import insert, make_tables
from monitor.runs import export
from monitor.runs.exports.export import Rows
from monitor.runs.exports.line_protocol import line, write
from tests.support.samples import Cli

T0_NS = 1_767_225_600_000_000_000
ALL = (0, 1 << 62)
OTHER = {"frequency_hz": 0.0, "frequency_std_hz": 0.1, "damping_ratio": 0.03, "mode_shape": [[1, 0], None], "track": -1}
SHAPES = np.array([[1.0, 0.5 + 0.1j, 0.2], [-0.5, 1.0, 0.3j]])


def window(k: int, **more: Any) -> dict[str, Any]:
    """A line of results whose shapes are turned and scaled at will."""
    turned = SHAPES * (1.0 + k) * np.exp(0.7j * k)
    return {
        "window": k,
        "t_end_ns": T0_NS + k * 10**10,
        "window_s": 400.0,
        "frequencies_hz": [4.9 + 0.1 * k, 15.7],
        "frequencies_std_hz": [0.01, 0.02],
        "damping_ratio": [0.01, 0.02],
        "damping_std": [0.001, 0.002],
        "mode_shapes": [[[z.real, z.imag] for z in shape] for shape in turned],
        "model_modes": [1, 2],
        "mode_tracks": [4, 5],
        "other_modes": [OTHER | {"frequency_hz": f} for f in (7.5, 8.5)],
        "ddi": [0.1, None],
        "alarm": {"level": "normal", "stories": [], "reason": "x", "active": {}},
        "skipped": None,
    } | more


SKIPPED = dict.fromkeys(("frequencies_hz", "damping_ratio", "mode_shapes", "model_modes", "other_modes", "ddi"))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """What `replay --out` leaves; its first month is packed, as a daemon's may be."""
    folder = tmp_path / "run 1"
    folder.mkdir()
    lines = [json.dumps(row) + "\n" for row in (window(0), window(1), window(2, **SKIPPED, skipped="a gap"), window(3))]
    (folder / "results-2025-12.jsonl.zst").write_bytes(zstandard.compress("".join(lines[:2]).encode()))
    (folder / "results.jsonl").write_text("".join(lines[2:]) + '{"half": ')
    episode = {"level": "alarm", "story": None, "t_first_ns": T0_NS, "t_last_ns": None, "ddi": 0.2, "ddi_std": 0.01,
               "loss_n_per_m": 5.0}  # fmt: skip
    (folder / "summary.json").write_text(json.dumps({"alarms": [episode]}))
    return folder


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def test_a_replay_has_the_same_tables_as_a_daemon(run: Path, tmp_path: Path) -> None:
    assert export(run, "windows", tmp_path / "w.parquet", ALL) == 4
    found = pyarrow.parquet.read_table(tmp_path / "w.parquet").to_pydict()
    assert found["window"] == [0, 1, 2, 3] and found["skipped"] == [None, None, "a gap", None]
    assert found["frequencies_hz_1"] == [4.9, 5.0, None, pytest.approx(5.2)] and found["ddi_2"] == [None] * 4
    assert export(run, "alarms", tmp_path / "a.csv", ALL) == 1
    assert table(tmp_path / "a.csv")[0]["story"] == "0"


def test_modes_have_a_row_each_with_their_shape_by_channel(run: Path, tmp_path: Path) -> None:
    span = (T0_NS, T0_NS + 10**10)
    assert export(run, "modes", tmp_path / "m.csv", span, channels=("a1", "a2", "a3")) == 4
    rows = table(tmp_path / "m.csv")
    assert [(r["mode"], r["other"], r["track"], r["frequency_hz"]) for r in rows] == [
        ("1", "", "4", "4.9"), ("2", "", "5", "15.7"), ("", "1", "-1", "7.5"), ("", "2", "-1", "8.5"),
    ]  # fmt: skip
    assert [
        complex(float(rows[0][f"shape_re_{c}"]), float(rows[0][f"shape_im_{c}"])) for c in ("a1", "a2", "a3")
    ] == list(SHAPES[0])
    assert rows[2]["shape_re_a1"] == "1" and rows[2]["shape_re_a2"] == ""  # left out


def test_modes_as_universal_file(run: Path, tmp_path: Path) -> None:
    pyuff = pytest.importorskip("pyuff")
    assert export(run, "modes", tmp_path / "m.uff", ALL, channels=("a1", "a2", "a3")) == 2
    file = pyuff.UFF(str(tmp_path / "m.uff"))
    assert list(file.get_set_types()) == [55, 58, 58, 55, 58, 58]
    shape, frequency, damping, *_ = file.read_sets()
    assert (shape["analysis_type"], shape["mode_n"], list(shape["node_nums"])) == (3, 1, [1, 2, 3])
    assert abs(shape["eig"]) / (2 * math.pi) == pytest.approx(np.mean([4.9, 5.0, 5.2]), rel=1e-5)
    assert -shape["eig"].real / abs(shape["eig"]) == pytest.approx(0.01, rel=1e-5)
    np.testing.assert_allclose(shape["r1"], SHAPES[0], atol=1e-5)  # turned back to the first
    assert shape["id4"].strip() == "nodes: 1=a1 2=a2 3=a3" and shape["id3"].strip() == "01-JAN-26 00:00:00"
    np.testing.assert_allclose(frequency["x"], [0, 10, 30])
    np.testing.assert_allclose(frequency["data"], [4.9, 5.0, 5.2])
    np.testing.assert_allclose(damping["data"], 0.01)


_LINE = re.compile(
    r"(?P<measurement>(?:\\[, ]|[^,\s\\])+)(?P<tags>(?:,(?:\\[,= ]|[^,=\s\\])+=(?:\\[,= ]|[^,=\s\\])+)*)"
    r" (?P<fields>.+) (?P<time>-?\d+)"
)
_FIELD = re.compile(
    r'(?P<name>(?:\\[,= ]|[^,=\s\\])+)=(?:(?P<integer>-?\d+)i|"(?P<text>(?:\\["\\]|[^"\\])*)"'
    r"|(?P<number>-?\d+(?:\.\d+)?(?:e[+-]?\d+)?))(?:,|$)"
)


def parsed(text: str) -> tuple[str, dict[str, str], dict[str, Any], int]:
    """Measurement, tags, fields and time of a line, by the grammar of the protocol's reference."""

    def plain(escaped: str) -> str:
        return re.sub(r"\\(.)", r"\1", escaped)

    found = _LINE.fullmatch(text)
    assert found is not None, text
    tags = dict(map(plain, re.split(r"(?<!\\)=", tag)) for tag in re.split(r"(?<!\\),", found["tags"])[1:])
    fields: dict[str, Any] = {}
    at = 0
    while at < len(found["fields"]):
        field = _FIELD.match(found["fields"], at)
        assert field is not None, text
        at = field.end()
        value: Any = (
            int(field["integer"]) if field["integer"] else plain(field["text"]) if field["text"] is not None else None
        )
        fields[plain(field["name"])] = float(field["number"]) if value is None else value
    return plain(found["measurement"]), tags, fields, int(found["time"])


def test_line_protocol_holds_what_the_table_holds(run: Path, tmp_path: Path) -> None:
    assert export(run, "windows", tmp_path / "w.lp", ALL) == 4
    rows = [parsed(text) for text in (tmp_path / "w.lp").read_text().splitlines()]
    assert [t for *_, t in rows] == [T0_NS + k * 10**10 for k in range(4)]
    assert {name for name, *_ in rows} == {"shm_windows"} and rows[0][1] == {"run": "run 1"}
    assert rows[0][2]["window"] == 0 and isinstance(rows[0][2]["window"], int)
    assert rows[1][2]["frequencies_hz_1"] == 5.0 and rows[2][2]["skipped"] == "a gap"
    assert "ddi_2" not in rows[0][2] and "frequencies_hz_1" not in rows[2][2]
    assert export(run, "modes", tmp_path / "m.lp", ALL) == 12
    keys = [
        (name, tuple(tags.items()), t) for name, tags, _, t in map(parsed, (tmp_path / "m.lp").read_text().splitlines())
    ]
    assert len(set(keys)) == len(keys), "a point of the same tags and time would replace the one before it"


def test_lists_of_integers_and_of_texts_keep_their_type(tmp_path: Path) -> None:
    with closing(sqlite3.connect("")) as database:
        make_tables(database)
        database.execute("ALTER TABLE windows ADD COLUMN ids TEXT")
        database.execute("ALTER TABLE windows ADD COLUMN names TEXT")
        insert(database, "windows", {"t_end_ns": 1, "window": 0})  # a line of before
        insert(database, "windows", {"t_end_ns": 2, "window": 1, "ids": "[4,5]", "names": '["a"]'})
        rows = Rows(database, "windows", ALL, listed={"ids": "INTEGER", "names": "TEXT"})
        assert write(rows.batches(), tmp_path / "w.lp", "windows", rows.time, "run", rows.integers) == 2
    before, after = (parsed(text)[2] for text in (tmp_path / "w.lp").read_text().splitlines())
    assert "ids_1" not in before and after["ids_1"] == 4 and isinstance(after["ids_2"], int) and after["names_1"] == "a"


@pytest.mark.parametrize("text", ["a b,c=d", 'says "no"', "back\\slash", "line\nbreak", "ends in \\", "ü", "\\", '\\"'])
def test_line_protocol_escapes_what_it_must(text: str) -> None:
    made = line(f"m {text}", {f"k {text}": text}, {f"f {text}": text, "x": 1e-300, "n": 3, "gone": math.nan}, -5, {"n"})
    assert made is not None
    name, told = " ".join(text.splitlines()).replace("\\", "/"), " ".join(text.splitlines())
    assert parsed(made) == (f"m {name}", {f"k {name}": name}, {f"f {name}": told, "x": 1e-300, "n": 3}, -5)


def test_what_cannot_be_exported_is_said(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for table, name, error, says in (
        ("gaps", "x.csv", WrongUsageError, "only a daemon keeps it"),
        ("secrets", "x.csv", WrongUsageError, "known: windows"),
        ("windows", "x.uff", WrongUsageError, "--table modes"),
        ("windows", "x.txt", WrongUsageError, "--format"),
    ):
        with pytest.raises(error, match=says):
            export(run, table, tmp_path / name, ALL)
    with pytest.raises(MissingInputError, match=r"no history here and no results\.jsonl"):
        export(tmp_path, "windows", tmp_path / "x.csv", ALL)
    (run / "results.jsonl").write_text('{"t_end_ns": "now"}\n')
    with pytest.raises(BadInputError, match=r"results\.jsonl: line 1 is no line of results"):
        export(run, "modes", tmp_path / "x.csv", ALL)
    (run / "results.jsonl").write_text(json.dumps(window(0)) + "\n")
    monkeypatch.setitem(sys.modules, "pyuff", None)
    with pytest.raises(UserError, match=r"needs the extra formats: pip install 'shm-monitor\[formats\]'"):
        export(run, "modes", tmp_path / "x.uff", ALL)
    assert not list(tmp_path.glob("x.*"))


def test_the_command_exports_a_replay(run: Path, tmp_path: Path, main: Cli, frame_text: str) -> None:
    (tmp_path / "s.toml").write_text(frame_text)
    done = main("export", run, "--out", tmp_path / "m.parquet", "--table", "modes", "--structure", tmp_path / "s.toml")
    assert done.returncode == 0 and done.stdout.startswith("12 rows of modes"), done.stderr
    assert "shape_im_a3" in pyarrow.parquet.read_schema(tmp_path / "m.parquet").names
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps({**summary, "known": {"channels": ["top", "mid", "low"]}}))
    done = main("export", run, "--out", tmp_path / "n.parquet", "--table", "modes")
    assert done.returncode == 0 and "shape_im_low" in pyarrow.parquet.read_schema(tmp_path / "n.parquet").names
    done = main("export", run, "--out", tmp_path / "m.txt", "--format", "influx", "--json")
    assert json.loads(done.stdout) == {
        "rows": 4,
        "table": "windows",
        "format": "influx",
        "out": str(tmp_path / "m.txt"),
    }
