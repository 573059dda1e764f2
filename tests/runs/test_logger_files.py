"""Files as loggers write them are read with the right rate, unit, columns, start and readings, and what is odd is told."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.base import ACCELERATION, TEMPERATURE
from drivers.mcap_file import read_recordings
from monitor.config import configuration
from monitor.core import BadInputError
from monitor.runs import look
from monitor.runs.archive.inventory import Survey
from monitor.runs.archive.jobs import survey_recording
from monitor.runs.readers import ImportedChannel, explain_table
from monitor.runs.recordings import read_topics, recorded_spans
from tests.runs.hostile import forked
from tests.runs.logger_files import (
    START,
    START_NS,
    G,
    LoggerFile,
    cosmos,
    geocsv,
    lines,
    lvm,
    motion,
    odd_tables,
    odd_times,
    packed,
    records,
    tables,
    workbook,
)
from tests.runs.reading import imported
from tests.support.ros2 import record
from tests.support.samples import Cli

FILES = {one.name: one for one in (*tables(), *odd_tables(), *odd_times(), *packed(), *records())}
COSMOS = cosmos(motion(100.0)[:, 0])
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


LONG_OF_TWO_RATES = "time,sensor,acc [g]\n" + "".join(
    f"{t:.2f},{name},{value}\n"
    for t, name, value in sorted(
        [(k / 100, "roof", k % 7) for k in range(100)] + [(k / 50, "low", k) for k in range(50)]
    )
)


@pytest.mark.parametrize("order", ["by time", "by sensor"])
def test_rows_of_each_sensor_become_columns(order: str, tmp_path: Path) -> None:
    places = [(k, name) for k in range(100) for name in ("roof", "low")]
    places = places if order == "by time" else sorted(places, key=lambda one: one[1])
    table = "time,sensor,acc [g]\n" + "".join(f"{k / 100},{n},{k % 7 if n == 'roof' else k % 5}\n" for k, n in places)
    (tmp_path / "a.csv").write_text(table)
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap")
    assert info.sample_rate_hz == 100.0 and set(info.channels[ACCELERATION]) == {"roof", "low"}
    block = next(iter(read_recordings([tmp_path / "o.mcap"])))
    roof = block.samples[:, block.channels.index("roof")] / G
    np.testing.assert_allclose(roof[:20], np.arange(20) % 7, rtol=1e-5)


def test_of_several_rates_those_that_are_named_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(LONG_OF_TWO_RATES)
    told: list[str] = []
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap", channels={"a1": "low"}, on_warning=told.append)
    assert (info.sample_rate_hz, info.n_samples) == (50.0, 50)
    assert any("no --channel names a column of roof" in text for text in told)


def test_times_of_each_sensor_are_told_where_they_lie_apart(tmp_path: Path) -> None:
    rows = "".join(f"{k / 100:.3f},{k % 7},{k / 100 + 0.003:.3f},{k % 5}\n" for k in range(100))
    (tmp_path / "a.csv").write_text("t1 [s],ax [g],t2 [s],ay [g]\n" + rows)
    told: list[str] = []
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap", on_warning=told.append)
    assert (info.sample_rate_hz, info.channels[ACCELERATION]) == (100.0, ("ax", "ay"))
    assert any("sampled up to 0.3 of a sample apart" in text for text in told)


def test_readings_of_a_slower_sensor_between_those_of_the_others_stay(tmp_path: Path) -> None:
    rows = [(k / 100, f"{k / 100},{k % 7},") for k in range(300)] + [
        (k + 0.0037, f"{k + 0.0037},,{20 + k}") for k in range(3)
    ]
    (tmp_path / "a.csv").write_text("t,ax [g],air [degC]\n" + "".join(f"{row}\n" for _, row in sorted(rows)))
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap")
    assert (info.sample_rate_hz, info.n_samples) == (100.0, 300)
    blocks = [one for one in read_recordings([tmp_path / "o.mcap"]) if one.topic == TEMPERATURE]
    air = np.concatenate([one.samples[:, 0] for one in blocks])
    assert {int(at): float(air[at]) for at in np.flatnonzero(np.isfinite(air))} == {1: 20.0, 101: 21.0, 201: 22.0}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("t,a1 [V],a2 [V]\n" + "".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(50)), "has unit 'V'.*--unit"),
        ("t [parsec],a1\n0.00,1\n0.01,2\n0.02,3\n", "unknown unit 'parsec'"),
        ("a,b\nx,y\nu,v\n", "no rows of numbers"),
        (",,,\n;;\n", "no rows of numbers"),
        ("Date,a1 [g]\n31/31/2026 10:00:00,1\n31/31/2026 10:00:01,2\n31/31/2026 10:00:02,3\n", "is no date"),
        (lvm("One", 3), "line 218: .*it holds several records; cut it"),
        (
            "t,ax [g],ay [g]\n" + "".join(f"{k / 100},{k % 7},{k % 5},1,1\n" for k in range(50)),
            "3 headings stand above 5 columns",
        ),
        (
            "t,ax [g],bx [g]\n" + "".join(f"{k / 100},{k % 7},\n{k / 100 + 0.003},,{k % 5}\n" for k in range(50)),
            "bx stand in rows without ax: they have clocks of their own",
        ),
        (
            "t,a,b\n" + "".join(f"0,{k:02d},0,{k % 7},0,{k % 5}\n" for k in range(50)),
            "is the comma .* a decimal mark too",
        ),
        (
            "Time,a [g]\n" + "".join(f"{46083.39367 + k // 86 * 1e-5:.5f},{k % 7}\n" for k in range(500)),
            "too coarse for 500 samples",
        ),
        (LONG_OF_TWO_RATES, r"several rates: low 50 Hz, roof 100 Hz; .*name them by --channel"),
        (
            "t,ax [g],ay [g]\n" + "".join(f"{k / 100},{k % 7},{k % 5 if k % 2 == 0 else ''}\n" for k in range(100)),
            r"several rates: ax 100 Hz, ay 50 Hz; .*name them by --channel",
        ),
        (
            "t1 [s],ax [g],t2 [s],ay [g]\n"
            + "".join(f"{k / 100},{k % 7},{f'{k / 50},{k % 5}' if k < 50 else ','}\n" for k in range(100)),
            r"several rates: ax 100 Hz, ay 50 Hz; .*name them by --channel",
        ),
        ("t;a [g]\n1.000;0,5\n1.010;0,4\n1.020;0,3\n1.030;0,2\n", "column 1 may be 10.0 or 1.0.0"),
        (
            "t,x,unit,y,unit\n" + "".join(f"{k / 100},{k % 7},g,{k % 5},mg\n" for k in range(50)),
            "columns of units state g and mg",
        ),
        ("t,b [0.001 g/count]\n0.00,1\n0.01,2\n0.02,3\n0.03,3\n", "unit '0.001 g/count'"),
        (COSMOS[:5000], "behind line 45: 216 numbers stand there, not 600; the file is cut or damaged"),
        (COSMOS[:2000], "behind line 25: 50 numbers stand there, not 100; the file is cut or damaged"),
        (COSMOS.replace("Corrected acceleration", "Response spectra"), "holds response spectra, which are no samples"),
        (cosmos(motion(100.0)[:, 0], step_ms=20.0), "600 samples in 6 s do not agree with the stated"),
        (geocsv("Sample", "g", ["1"] * 9, sample_rate_hz="fast"), "line 1: its head is damaged: .*'fast'"),
        (
            geocsv("Sample", "g", ["1"] * 9) + "# dataset: GeoCSV 2.0\n",
            "line 15: a head without readings; the file is cut",
        ),
        (
            2 * geocsv("Sample", "g", ["1", "2"], sid="XX", sample_rate_hz=9),
            "a.csv: several columns would be channel 'a_XX'",
        ),
        (geocsv("T, Sample", "s, g", ["0, 1", "1, 2", "2"]), "line 8: 1 cells where 2 are expected"),
        (geocsv("Sample", "V", ["1"] * 9, sample_rate_hz=9), "column 'Sample' has unit 'V'"),
    ],
    ids=[
        "volts",
        "tick",
        "words",
        "marks alone",
        "date",
        "segments",
        "headings",
        "own rows",
        "two commas",
        "coarse days",
        "long",
        "slower sensor",
        "times of each",
        "points",
        "two units",
        "scaled counts",
        "cut COSMOS",
        "COSMOS cut in its head",
        "COSMOS spectra",
        "COSMOS step",
        "GeoCSV rate",
        "GeoCSV cut in its head",
        "GeoCSV series of one name",
        "GeoCSV cut in a row",
        "GeoCSV volts",
    ],
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


@pytest.mark.parametrize("heading", ["a1 [V]", "a1_mV"])
def test_what_is_told_of_a_channel_is_the_unit_as_which_it_was_read(heading: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"t,{heading}\n" + "".join(f"{k / 100},{k % 7}\n" for k in range(50)))
    taken: list[ImportedChannel] = []
    imported(
        [tmp_path / "a.csv"],
        tmp_path / "o.mcap",
        unit="g",
        channels={"top": heading.partition(" ")[0]},
        on_channel=taken.append,
    )
    assert [(one.unit, one.stated, one.by_name) for one in taken] == [("g", False, False)]


def test_day_and_month_that_could_be_exchanged_are_told(tmp_path: Path) -> None:
    rows = lines([f"3/2/2026 14:00:{k / 100:05.2f}" for k in range(300)], motion(100.0, 300))
    (tmp_path / "a.csv").write_text("Date,a1 (g),a2 (g),a3 (g)\n" + rows)
    told: list[str] = []
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap", on_warning=told.append)
    assert info.t_start_ns == START_NS and any("day and month are exchanged" in text for text in told)


def test_a_year_of_two_digits_that_may_stand_first_is_told(tmp_path: Path) -> None:
    rows = lines([f"26/03/02 14:00:{k / 100:05.2f}" for k in range(300)], motion(100.0, 300))
    (tmp_path / "a.csv").write_text("Date,a1 (g),a2 (g),a3 (g)\n" + rows)
    told: list[str] = []
    imported([tmp_path / "a.csv"], tmp_path / "o.mcap", on_warning=told.append)
    assert any("day first and the year last" in text and "exchanged" in text for text in told)


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


TOPICS = {"/i1": "a1", "/i2": "a2"}


def jittered(path: Path, rate_hz: float, seed: int) -> Path:
    """ROS 2 topics whose stamps jitter by 1.5 ms, with a pause of 20 s."""
    chance, stamps = np.random.default_rng(seed), {}
    for topic in TOPICS:
        t = np.sort(np.arange(3000) / rate_hz + chance.normal(scale=1.5e-3, size=3000))
        t[1500:] += 20.0
        stamps[topic] = [1_700_000_000 * 10**9 + round(x * 1e9) for x in t]
    return record(path, stamps)


def test_what_is_told_of_ros_2_topics_is_by_all_stamps_too(tmp_path: Path) -> None:
    settings = configuration.load(Path("recordings/frame.toml")).model_copy(update={"topics": TOPICS})
    paths = [jittered(tmp_path / f"{seed}.mcap", 98.7, seed) for seed in range(8)]
    assert len(recorded_spans(paths, settings)) == 8
    for path in paths:
        found = survey_recording((path, TOPICS))
        assert isinstance(found, Survey) and found.rate_hz == pytest.approx(98.7, rel=5e-5)


def test_the_rate_of_ros_2_topics_is_that_of_all_stamps_and_jitter_loses_no_row(tmp_path: Path) -> None:
    rate_hz = 98.7
    path = jittered(tmp_path / "a.mcap", rate_hz, 4)
    blocks = list(read_topics([path], (ACCELERATION,), lambda _: None, topic_map=TOPICS))
    assert blocks[0].sample_rate_hz == pytest.approx(rate_hz, rel=5e-5)
    assert sum(block.n_samples for block in blocks) == 3000
    jumps = [b.sequence - a.sequence - a.n_samples for a, b in pairwise(blocks)]
    assert sum(jump != 0 for jump in jumps) == 1 and sum(jumps) == pytest.approx(20.0 * rate_hz, abs=1.0)


def test_a_workbook_is_read_as_a_table(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    rows = [
        ["Time (s)", "a1 (g)", "a2 (g)", "a3 (g)"],
        *([k / 100, *row] for k, row in enumerate((motion(100.0) / 9.80665).tolist())),
    ]
    workbook(tmp_path / "a.xlsx", rows)
    info = imported([tmp_path / "a.xlsx"], tmp_path / "o.mcap")
    assert (info.sample_rate_hz, info.channels[ACCELERATION], info.n_samples) == (100.0, ("a1", "a2", "a3"), 600)


@pytest.mark.parametrize(
    ("told", "unit", "factor"),
    [
        ("IN UNITS OF G", "g", 9.80665),
        ("IN UNITS OF CM/S/S", "cm/s^2", 0.01),
        ("(G)", "g", 9.80665),
        ("", "m/s^2", 1.0),
    ],
)
def test_a_peer_record_is_in_the_unit_that_it_states_whatever_its_station_is_called(
    told: str, unit: str, factor: float, tmp_path: Path
) -> None:
    head = f"PEER NGA STRONG MOTION DATABASE RECORD\nLoma Prieta, Gilroy Array, 90\nACCELERATION TIME SERIES {told}\n"
    values = motion(100.0)[:, 0] / factor
    (tmp_path / "a.AT2").write_text(head + "NPTS= 600, DT= .0100 SEC\n" + "\n".join(f"{v:.7E}" for v in values) + "\n")
    taken: list[ImportedChannel] = []
    imported([tmp_path / "a.AT2"], tmp_path / "o.mcap", on_channel=taken.append)
    samples = np.concatenate([b.samples[:, 0] for b in read_recordings([tmp_path / "o.mcap"])])
    np.testing.assert_allclose(samples, motion(100.0)[:, 0], rtol=1e-5, atol=1e-6)
    assert [(one.unit, one.stated) for one in taken] == [(unit, bool(told))]


def test_tdms_states_names_units_rate_and_start(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    told = {
        "wf_increment": 0.005,
        "wf_start_offset": 0.0,
        "wf_start_time": np.datetime64("2026-03-02T14:00:00"),
        "unit_string": "g",
    }
    values = motion(200.0) / 9.80665
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as file:
        file.write_segment([nptdms.ChannelObject("Log", f"a{k + 1}", values[:, k], properties=told) for k in range(3)])
    taken: list[ImportedChannel] = []
    info = imported([tmp_path / "a.tdms"], tmp_path / "o.mcap", on_channel=taken.append)
    assert (info.sample_rate_hz, info.t_start_ns, info.n_samples) == (200.0, START_NS, 600)
    assert [(one.name, one.unit) for one in taken] == [("a1", "g"), ("a2", "g"), ("a3", "g")]


def test_a_tdms_channel_of_words_is_told_to_be_left_out(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    told = {"wf_increment": 0.01, "unit_string": "g"}
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as file:
        file.write_segment(
            [
                nptdms.ChannelObject("Log", "a1", motion(100.0)[:, 0], properties=told),
                nptdms.ChannelObject("Log", "notes", ["begun", "ended"]),
            ]
        )
    warned: list[str] = []
    imported([tmp_path / "a.tdms"], tmp_path / "o.mcap", start_ns=0, on_warning=warned.append)
    assert [one.rpartition(": ")[2] for one in warned] == ["notes"]


@pytest.fixture
def copied() -> Iterator[None]:
    """Read what is read apart in a copy of this process, which has asammdf already."""
    with forked():
        yield


def test_the_head_of_a_geocsv_says_what_a_column_is_and_not_its_cells(tmp_path: Path) -> None:
    head: dict[str, object] = {"sample_rate_hz": 100, "start_time": "2026-03-02T14:00:00Z"}
    (tmp_path / "a.csv").write_text(geocsv("Sample", "counts", [str(k) for k in range(300)], sid="XX_A__HNZ", **head))
    info = imported([tmp_path / "a.csv"], tmp_path / "o.mcap", scale=1e-5)
    assert (info.channels[ACCELERATION], info.n_samples, info.t_start_ns) == (("XX_A__HNZ",), 300, START_NS)


def mdf(path: Path, *more: list[tuple[str, str, Any, float]], start: datetime = START, version: str = "4.10") -> Path:
    """A file with three channels of acceleration in g at 100 Hz, and more groups of channels: name, unit, samples and rate."""
    asammdf = pytest.importorskip("asammdf")
    held = [(f"a{k + 1}", "g", column, 100.0) for k, column in enumerate(motion(100.0).T / 9.80665)]
    with asammdf.MDF(version=version) as file:
        file.start_time = start
        for group in (held, *more):
            file.append(
                [
                    asammdf.Signal(np.asarray(x), np.arange(len(x)) / hz, unit, name, encoding="utf-8")
                    for name, unit, x, hz in group
                ]
            )
        return Path(file.save(path, compression=2))


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize(
    ("version", "start"),
    [("4.10", START), ("4.10", START.astimezone(timezone(timedelta(hours=2)))), ("3.30", START)],
)
def test_mdf_states_names_units_rate_and_start(version: str, start: datetime, tmp_path: Path) -> None:
    taken, told, path = list[ImportedChannel](), list[str](), mdf(tmp_path / "a.mf4", start=start, version=version)
    info = imported([path], tmp_path / "o.mcap", on_channel=taken.append, on_warning=told.append)
    assert (info.sample_rate_hz, info.t_start_ns, info.n_samples) == (pytest.approx(100.0), START_NS, 600)
    assert [(one.name, one.unit, one.stated) for one in taken] == [(f"a{k}", "g", True) for k in (1, 2, 3)]
    samples = np.concatenate([block.samples for block in read_recordings([tmp_path / "o.mcap"])])
    np.testing.assert_allclose(samples, motion(100.0), rtol=1e-6, atol=1e-6)
    assert not told


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("version", ["4.10", "3.10", "2.14"])
def test_a_start_of_an_mdf_without_a_zone_is_that_of_the_option(version: str, tmp_path: Path) -> None:
    path = mdf(tmp_path / "a.mf4", start=START.replace(tzinfo=None), version=version)
    told: list[str] = []
    info = imported([path], tmp_path / "o.mcap", on_warning=told.append)
    assert info.t_start_ns == START_NS and any("2026-03-02 14:00:00 has no zone" in text for text in told)
    zone = timezone(timedelta(hours=2))
    assert imported([path], tmp_path / "z.mcap", zone=zone).t_start_ns == START_NS - 7200 * 10**9


@pytest.mark.usefixtures("copied")
def test_groups_of_an_mdf_keep_their_clocks_and_what_holds_no_readings_is_told(tmp_path: Path) -> None:
    air: list[Any] = [
        ("air", "degC", np.linspace(10.0, 12.0, 600), 100.0),
        ("state", "", np.array([b"on"] * 600), 100.0),
    ]
    told: list[str] = []
    info = imported([mdf(tmp_path / "a.mf4", air)], tmp_path / "o.mcap", on_warning=told.append)
    assert info.channels["/temperature"] == ("air",)
    assert any(text.endswith("left out, since they are words or arrays: state") for text in told)
    slow = mdf(tmp_path / "slow.mf4", [("b", "g", np.arange(30.0), 5.0)])
    with pytest.raises(BadInputError, match=r"several rates: a1, a2, a3 100 Hz, b 5 Hz.*--channel"):
        imported([slow], tmp_path / "o.mcap")
    assert imported([slow], tmp_path / "o.mcap", channels={"b": "b"}).sample_rate_hz == 5.0


@pytest.mark.usefixtures("copied")
def test_readings_that_an_mdf_marks_as_invalid_are_missing(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF() as file:
        file.start_time = START
        bad = np.arange(600) % 100 == 7
        t = np.arange(600) / 100.0
        file.append([asammdf.Signal(motion(100.0)[:, 0], t, "m/s^2", "a1", invalidation_bits=bad)])
        file.save(tmp_path / "a.mf4")
    imported([tmp_path / "a.mf4"], tmp_path / "o.mcap")
    samples = np.concatenate([block.samples[:, 0] for block in read_recordings([tmp_path / "o.mcap"])])
    assert np.array_equal(np.isnan(samples), bad)


@pytest.mark.usefixtures("copied")
def test_frames_of_a_bus_in_an_mdf_are_no_samples_and_need_a_dbc(tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    with can.MF4Writer(tmp_path / "a.mf4") as log:
        for k in range(9):
            log(can.Message(arbitration_id=1, data=[k] * 8, timestamp=1.7e9 + k / 100, is_extended_id=False))
    with pytest.raises(BadInputError, match="holds no channel of numbers; frames of a bus are read with --dbc"):
        imported([tmp_path / "a.mf4"], tmp_path / "o.mcap")


@pytest.mark.parametrize(
    ("form", "suffix"), [("SAC", "sac"), ("SLIST", "asc"), ("TSPAIR", "txt"), ("GSE2", "gse2"), ("MSEED", "x")]
)
def test_formats_of_seismology_are_read(form: str, suffix: str, tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy")
    counts = np.round(1e5 * motion(100.0)[:, 0]).astype(np.int32)
    head = {
        "network": "XX",
        "station": "ROOF",
        "channel": "HNZ",
        "sampling_rate": 100.0,
        "starttime": obspy.UTCDateTime(ns=START_NS),
    }
    data = counts.astype(np.float32) if form == "SAC" else counts
    obspy.Stream([obspy.Trace(data, head)]).write(str(tmp_path / f"a.{suffix}"), format=form)
    options = {"unit": "gal"} if form == "SAC" else {"scale": 1e-5}
    info = imported([tmp_path / f"a.{suffix}"], tmp_path / "o.mcap", **options)
    samples = np.concatenate([b.samples for b in read_recordings([tmp_path / "o.mcap"])])[:, 0]
    assert (info.sample_rate_hz, info.t_start_ns, info.n_samples) == (100.0, START_NS, 600)
    assert samples == pytest.approx(counts * (1e-2 if form == "SAC" else 1e-5), rel=1e-5)
