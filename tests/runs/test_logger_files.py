"""Files as loggers write them are read with the right rate, unit, columns, start and readings, and what is odd is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION
from drivers.mcap_file import read_recordings
from monitor.core import BadInputError
from monitor.runs import look
from monitor.runs.readers import ImportedChannel, explain_table
from tests.runs.logger_files import START_NS, LoggerFile, lines, motion, packed, tables
from tests.runs.reading import imported
from tests.support.samples import Cli

FILES = {one.name: one for one in (*tables(), *packed())}
_STAMP_NS = 2_000_000
"""Serial days are cut at some microseconds, stamps at milliseconds. [ns]"""


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_read_as_it_is_meant(name: str, tmp_path: Path) -> None:
    file = FILES[name]
    place, told, taken = tmp_path / file.name, list[str](), list[ImportedChannel]()
    place.write_bytes(file.content)
    info = imported(
        [place], tmp_path / "o.mcap", on_warning=told.append, on_channel=taken.append, **(file.options or {})
    )
    samples = np.concatenate([b.samples for b in read_recordings([tmp_path / "o.mcap"]) if b.topic == ACCELERATION])
    true = motion(file.rate_hz)[:, : file.columns]
    assert info.sample_rate_hz == pytest.approx(file.rate_hz, rel=1e-4 if "scatter" in file.says else 2e-5)
    assert samples.shape == true.shape and float(np.nanstd(samples - true)) < 2e-4
    if file.options is None:
        assert {one.unit for one in taken if one.topic == ACCELERATION} == {file.unit}
    if file.start_ns is not None:
        assert abs(info.t_start_ns - file.start_ns) < _STAMP_NS
    assert file.says in " ".join(told)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("t,a1 [V],a2 [V]\n" + "".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(50)), "has unit 'V'.*--unit"),
        ("t [parsec],a1\n0.00,1\n0.01,2\n0.02,3\n", "unknown unit 'parsec'"),
        ("a,b\nx,y\nu,v\n", "no rows of numbers"),
        ("Date,a1 [g]\n31/31/2026 10:00:00,1\n31/31/2026 10:00:01,2\n31/31/2026 10:00:02,3\n", "is no date"),
    ],
    ids=["volts", "tick", "words", "date"],
)
def test_what_cannot_be_meant_is_refused_plainly(content: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(BadInputError, match=reason):
        imported([tmp_path / "a.csv"], tmp_path / "o.mcap")


def test_volts_are_taken_as_acceleration_when_the_user_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,a1 [V]\n" + "".join(f"{k / 100},{k % 7}\n" for k in range(50)))
    told: list[str] = []
    imported([tmp_path / "a.csv"], tmp_path / "o.mcap", unit="g", channels={"top": "a1"}, on_warning=told.append)
    assert any("--unit g is taken for a1" in text for text in told)


def test_day_and_month_that_could_be_exchanged_are_told(tmp_path: Path) -> None:
    rows = lines([f"3/2/2026 14:00:{k / 100:05.2f}" for k in range(300)], motion(100.0, 300))
    (tmp_path / "a.csv").write_text("Date,a1 (g),a2 (g),a3 (g)\n" + rows)
    told: list[str] = []
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap", on_warning=told.append)
    assert info.t_start_ns == START_NS and any("day and month are exchanged" in text for text in told)


def test_files_of_following_days_are_joined_in_time_and_files_of_one_time_are_channels(tmp_path: Path) -> None:
    values = motion(100.0)
    for name, begin in (("day1.csv", 0), ("day2.csv", 300)):
        stamps = [f"2026-03-02 14:00:{(begin + k) / 100:05.2f}" for k in range(300)]
        (tmp_path / name).write_text(
            "time,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + lines(stamps, values[begin : begin + 300])
        )
    told: list[str] = []
    info = imported([tmp_path / "day2.csv", tmp_path / "day1.csv"], tmp_path / "o.mcap", on_warning=told.append)
    assert (info.n_samples, info.duration_s, info.t_start_ns) == (600, 6.0, START_NS)
    assert any("follow one another in time" in text for text in told)
    (tmp_path / "roof.csv").write_text("time,a (m/s^2)\n" + lines([f"{k / 100}" for k in range(300)], values[:300, :1]))
    (tmp_path / "base.csv").write_text(
        "time,a (m/s^2)\n" + lines([f"{k / 100}" for k in range(300)], values[:300, 1:2])
    )
    beside = imported([tmp_path / "roof.csv", tmp_path / "base.csv"], tmp_path / "b.mcap")
    assert beside.channels[ACCELERATION] == ("roof", "base")


def test_a_time_without_a_unit_that_gives_an_absurd_rate_is_doubted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,a1 (g)\n" + "".join(f"{5 * k},{k % 7}\n" for k in range(300)))
    told: list[str] = []
    imported([tmp_path / "a.csv"], tmp_path / "o.mcap", on_warning=told.append)
    assert any("in s that is 0.2 Hz, in ms 200 Hz" in text for text in told)


def test_the_guess_is_explained_with_reasons(tmp_path: Path) -> None:
    file: LoggerFile = FILES["toa5.dat"]
    (tmp_path / "a.dat").write_bytes(file.content)
    rows = explain_table(tmp_path / "a.dat")
    assert {what for what, *_ in rows} >= {"delimiter", "decimal mark", "first row", "column 1", "column 5"}
    assert all(why for *_, why in rows)
    assert any("'RECORD': counter of samples" in value for _, value, _ in rows)


def test_a_logger_file_is_replayed_as_the_recording_that_import_makes_of_it(
    tmp_path: Path, main: Cli, frame_text: str
) -> None:
    values = np.random.default_rng(5).normal(scale=0.1, size=(12_000, 3))
    (tmp_path / "log.csv").write_text(
        "t,a1 (g),a2 (g),a3 (g)\n" + lines([f"{k / 100:.2f}" for k in range(12_000)], values)
    )
    (tmp_path / "s.toml").write_text(frame_text)
    imported([tmp_path / "log.csv"], tmp_path / "log.mcap")
    for name in ("log.csv", "log.mcap"):
        done = main("replay", tmp_path / name, "--structure", tmp_path / "s.toml", "--out", tmp_path / name[-3:])
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "csv" / "results.jsonl").read_text() == (tmp_path / "cap" / "results.jsonl").read_text()


def test_readings_that_stand_twice_are_told_and_feign_no_mode(tmp_path: Path) -> None:
    values = np.repeat(motion(100.0, 4000), 2, axis=0)
    (tmp_path / "a.csv").write_text(
        "t,a1 [m/s^2],a2 [m/s^2],a3 [m/s^2]\n" + lines([f"{k / 200:.4f}" for k in range(8000)], values)
    )
    found = look.look([tmp_path / "a.csv"])
    assert any("each reading stands 2 times in a row: the sensors deliver 100 Hz" in doubt for doubt in found.doubts)
    assert all(mode.frequency_hz < 50.0 for mode in found.modes)
