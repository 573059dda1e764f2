"""The command for features: what it writes, and what it says of a table that is not as it should be."""

from __future__ import annotations

import gzip
import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from monitor.core import BadInputError, utc_ns
from monitor.damage import FeatureTable
from monitor.publish import LINE_SCHEMA
from monitor.runs import Options, features, zone_named
from tests.runs.logger_files import workbook
from tests.support.samples import Cli

ROWS = 400


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(3)
    degc = 10.0 + 8.0 * np.sin(np.arange(ROWS) / 20.0)
    hz = 4.0 * np.exp(-0.001 * degc + 0.002 * rng.standard_normal(ROWS))
    hz[350:] *= 0.97
    lines = ["time,f1,temperature"]
    lines += [f"{1_700_000_000 + 3600 * k},{f:.6f},{t:.3f}" for k, (f, t) in enumerate(zip(hz, degc, strict=True))]
    lines[20], lines[21], lines[22] = "1700068400,,10.0", "yesterday,4.0,10.0", "1700075600,4.0"
    path = tmp_path_factory.mktemp("features") / "f.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def call(main: Cli, table: Path, out: Path, **changed: str):
    options = {"time": "time", "features": "f1", "covariates": "temperature", "train-until": "2023-11-23T00:00:00"}
    options |= changed
    return main("features", table, *[x for k, v in options.items() for x in (f"--{k}", v)], "--out", out, "--json")


def test_a_table_is_judged_and_bad_rows_are_told_by_line(table: Path, main: Cli, tmp_path: Path) -> None:
    done = call(main, table, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "line 22: " in done.stderr and "line 23: 2 fields of 3" in done.stderr and "line 21" not in done.stderr
    lines = [json.loads(line) for line in (tmp_path / "out/results.jsonl").read_text().splitlines()]
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert json.loads(done.stdout) == {**summary, "out": str(tmp_path / "out")}
    keys = {"t_end_ns", "residual_sigma", "feature_change", "feature_change_std", "alarm", "years", "skipped"}
    assert keys < set(lines[0]) == set(LINE_SCHEMA["properties"])
    assert {"level", "features", "reason"} < set(lines[0]["alarm"])
    assert lines[-1]["alarm"]["level"] == "warning" and lines[-1]["alarm"]["features"] == ["f1"]
    first = next(line["t_end_ns"] for line in lines if line["alarm"]["level"] != "normal")
    assert first * 1e-9 >= 1_700_000_000 + 3600 * 350
    assert summary["features"][0]["variance_explained"] > 0.5
    assert done.returncode == 0 and summary["state"] == "warning"
    size, half = (
        float(x) for x in re.findall(r"f1 ([-.\d]+) ± ([.\d]+) %, warning since 2023-11-29", summary["headline"])[0]
    )
    assert abs(size + 3.0) < 1.5 * half < 1.0
    assert [(a["part"], a["level"], a["t_first_ns"]) for a in summary["alarms"]] == [(1, "warning", first)]


def test_times_without_a_zone_are_of_the_zone_that_is_named(tmp_path: Path) -> None:
    path = tmp_path / "f.csv"
    path.write_text("time,f1,air\n" + "".join(f"2026-01-{k:02d} 12:00:00,4.0{k},{k}.0\n" for k in range(1, 21)))
    options = Options(time="time", zone=zone_named("+01:00"))
    assert features.read_table(path, options, ["f1"], ["air"], print).t_ns[0] == utc_ns("2026-01-01T11:00:00")
    assert features.read_table(path, replace(options, start_ns=7), ["f1"], ["air"], print).t_ns[0] == 7


@pytest.mark.parametrize(
    ("changed", "code", "words"),
    [
        ({"features": "f9"}, 65, "no column f9; the columns are time, f1, temperature"),
        ({"train-until": "2023-11-15T00:00:00"}, 65, "healthy readings"),
        ({"train-until": "2033-01-01T00:00:00"}, 65, "nothing to judge"),
        ({"train-until": "soon"}, 2, "--train-until"),
        ({"features": ","}, 2, "at least one column"),
    ],
)
def test_what_cannot_be_done_is_said(
    table: Path, main: Cli, tmp_path: Path, changed: dict[str, str], code: int, words: str
) -> None:
    done = call(main, table, tmp_path / "out", **changed)
    assert done.returncode == code
    assert words in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="module")
def judged(table: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of results: as the table is, and with a feature that does not change."""
    folder = tmp_path_factory.mktemp("judged")
    healthy = folder / "healthy.csv"
    head, *rows = table.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    later = [
        f"{t},{float(f) / (0.97 if k >= 350 else 1.0) if k > 25 else f},{c}"
        for k, (t, f, c) in enumerate(cells[23:], 23)
    ]
    healthy.write_text("\n".join([head, *later]))
    until_ns, options = utc_ns("2023-11-23T00:00:00"), Options(time="time")
    for path, out in ((table, "changed"), (healthy, "healthy")):
        features.features(path, options, ["f1"], ["temperature"], until_ns, folder / out)
    return folder / "changed", folder / "healthy"


def test_a_report_draws_each_feature_with_what_was_announced_and_no_sensors(
    judged: tuple[Path, Path], main: Cli, tmp_path: Path
) -> None:
    done = main("report", judged[0], "--out", tmp_path / "r.html", "--json")
    assert done.returncode == 0, done.stderr
    told, page = json.loads(done.stdout), (tmp_path / "r.html").read_text()
    assert (told["state"], told["alarms"], told["findings"]) == ("warning", 1, 0)
    assert "f1 -" in told["headline"] and "warning since 2023-11-29" in told["headline"]
    assert "f1: change since the healthy time, less what covariates explain, %" in page
    assert "f1: each reading less what covariates explain, in healthy standard deviations" in page
    assert "shm-monitor ack" not in page and "noise floor" not in page and "No diagnosis so far" not in page
    assert 0.9 < told["judged"] / told["windows_due"] <= 1.0
    done = main("report", judged[1], "--out", tmp_path / "h.html", "--json")
    assert json.loads(done.stdout)["headline"] == "No change of f1 beyond what the covariates explain."


def test_a_view_shows_the_change_and_the_reading_of_each_feature_and_the_state(judged: tuple[Path, Path]) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    shown = {c.entity_path: c.to_record_batch() for c in chunk.RrdReader(judged[0] / "live.rrd").stream()}
    assert {"/modes/change/1", "/modes/sigma/1", "/trust/covariate/temperature/value", "/state/lamp"} <= shown.keys()
    assert not any(path.startswith(("/frame/stories", "/ddi/story")) for path in shown)


def test_two_folders_of_features_are_compared_by_what_the_covariates_leave(
    judged: tuple[Path, Path], main: Cli, tmp_path: Path
) -> None:
    def compared(*folders: Path) -> dict:
        done = main("compare", *folders, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    late = tmp_path / "late"
    late.mkdir()
    lines = (judged[0] / "results.jsonl").read_text().splitlines(keepends=True)
    (late / "results.jsonl").write_text("".join(lines[-50:]))
    (late / "summary.json").write_text((judged[0] / "summary.json").read_text())
    said = compared(judged[1], late)
    assert said["differs"] and said["tests"][0]["what"].startswith("f1: ") and said["tests"][0]["significant"]
    assert compared(judged[1], judged[1])["differs"] is False


def told_table(content: str | bytes, tmp_path: Path, time: str = "time") -> tuple[FeatureTable, str]:
    path, told = tmp_path / "f.csv", list[str]()
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return features.read_table(path, Options(time=time), ["f1"], ["air"], told.append), "\n".join(told)


@pytest.mark.parametrize(
    ("form", "comma", "sep", "head"),
    [
        ("{:%d.%m.%Y %H:%M}", True, ";", "time;f1;air"),
        ("{:%m/%d/%Y %I:%M:%S %p}", False, ",", '"time","f1","air"'),
        ("{:%Y-%m-%dT%H:%M:%S+00:00}", False, "\t", "sep=\t\nBridge 7\ntime\tf1\tair"),
        ("{:%Y/%m/%d %H:%M:%S}", False, ",", "time,f1,air,remark"),
    ],
)
def test_a_table_is_read_in_the_dialect_in_which_it_is_written(
    form: str, comma: bool, sep: str, head: str, tmp_path: Path
) -> None:
    moments = [datetime(2026, 3, 1, tzinfo=UTC) + timedelta(hours=k) for k in range(60)]
    rows = [[form.format(m), f"{4.0 + k / 100:.3f}", f"{k / 4:.2f}"] for k, m in enumerate(moments)]
    rows = [[cell.replace(".", ",") if comma and at else cell for at, cell in enumerate(row)] for row in rows]
    rows[5][1], rows[6][2] = "---", "NaN"
    tail = f"{sep}all well" if "remark" in head else ""
    table, _ = told_table(head + "\n" + "".join(sep.join(row) + tail + "\r\n" for row in rows), tmp_path)
    assert table.t_ns.tolist() == [int(m.timestamp()) * 10**9 for m in moments]
    expected = 4.0 + np.arange(60) / 100
    expected[5] = np.nan
    assert table.features["f1"] == pytest.approx(expected, nan_ok=True)
    assert np.isnan(table.covariates["air"][6])


def test_what_stands_for_no_reading_is_missing_and_zeros_far_from_all_others_are_doubted(tmp_path: Path) -> None:
    rows = [[str(1_700_000_000 + 3600 * k), f"{4.0 + k % 7 / 100:.3f}", f"{k / 4 - 5:.2f}"] for k in range(60)]
    rows[9][1], rows[12][1], rows[20][2] = "0.0", "-9999", "0"
    table, told = told_table("time,f1,air\n" + "".join(",".join(row) + "\n" for row in rows), tmp_path)
    assert "f1: 1 readings are exactly 0, and no other is near it" in told and "air:" not in told
    assert np.isnan(table.features["f1"][12]) and "-9999" in told and table.features["f1"][9] == 0.0


def test_rows_that_cannot_be_read_are_left_out_wherever_they_stand(tmp_path: Path) -> None:
    rows = [f"2026-03-{k + 1:02d},4.0{k},5.0" for k in range(28)]
    rows[0], rows[3], rows[8], rows[9] = "soon,4.0,5.0", "2026-02-30,4.0,5.0", "2026-03-09,4.0.1,5.0", "2026-03-10,4.0"
    table, told = told_table("time,f1,air\n" + "\n".join(rows), tmp_path)
    assert table.t_ns.size == 24
    assert (
        "line 2: 'soon' is no time; line 5: '2026-02-30' is no time; line 10: '4.0.1' is no number; line 11: 2 f"
        in told
    )


def test_a_workbook_a_packed_table_and_arrays_are_read_as_the_table_is(tmp_path: Path) -> None:
    rows = [[f"2026-03-{k + 1:02d} 06:00:00", 4.0 + k / 100 if k != 3 else "", 5.0 - k] for k in range(28)]
    head = ["time", "f1", "air"]
    text = "".join(",".join(map(str, row)) + "\n" for row in [head, *rows])
    expected, _ = told_table(text, tmp_path)
    (tmp_path / "f.csv.gz").write_bytes(gzip.compress(text.encode()))
    workbook(tmp_path / "f.xlsx", [head, *rows])
    seconds = expected.t_ns * 1e-9
    np.savez(tmp_path / "f.npz", time=seconds, f1=expected.features["f1"], air=expected.covariates["air"])
    for name in ("f.csv.gz", "f.xlsx", "f.npz"):
        found = features.read_table(tmp_path / name, Options(time="time"), ["f1"], ["air"], print)
        assert found.t_ns.tolist() == expected.t_ns.tolist(), name
        assert found.features["f1"] == pytest.approx(expected.features["f1"], nan_ok=True), name
        assert found.covariates["air"] == pytest.approx(expected.covariates["air"]), name
    with pytest.raises(BadInputError, match="no column f9; the columns are"):
        features.read_table(tmp_path / "f.npz", Options(time="time"), ["f9"], ["air"], print)


@pytest.mark.parametrize(
    ("content", "code"), [(None, 66), (b"\xff\xfe\x00", 65), (b"", 65), (b"time,f1,temperature\n", 65)]
)
def test_what_is_no_table_is_refused(main: Cli, tmp_path: Path, content: bytes | None, code: int) -> None:
    path = tmp_path / "x.csv"
    if content is not None:
        path.write_bytes(content)
    done = call(main, path, tmp_path / "out")
    assert (done.returncode, "Traceback" in done.stderr) == (code, False)
    assert "x.csv" in done.stderr
