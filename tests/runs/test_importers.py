"""Foreign data become recordings only when nothing about them has to be guessed."""

import csv
import io
import random
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import ACCELERATION, FORCE, GROUND, ROTATION_RATE
from drivers.mcap_file import RecordingInfo, read_recordings
from monitor.core import BadInputError, MissingInputError, utc_ns
from monitor.runs.readers import Options, delimited, import_files
from tests.runs.reading import imported

DATA = Path(__file__).parents[1] / "data"
WHEN_NS = 1_767_323_045 * 10**9


def convert(path: Path, content: str | bytes, **options: object) -> tuple[RecordingInfo, np.ndarray, list[str]]:
    """Import one file of this content; its values come back as m/s^2, with the warnings."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    warnings: list[str] = []
    options.setdefault("start_ns", WHEN_NS)
    options.setdefault("ask_unit", lambda _: "m/s^2")
    out = path.with_suffix(".mcap")
    info = imported([path], out, on_warning=warnings.append, **options)
    return info, samples(out), warnings


def samples(path: Path, topic: str = ACCELERATION) -> np.ndarray:
    return np.concatenate([block.samples for block in read_recordings([path]) if block.topic == topic])


def rows(form: str, count: int = 250) -> str:
    return "".join(form.format(t=k / 100, ms=10 * k, a=k / 1000, b=-k / 1000, k=k) for k in range(count))


RAMP = np.arange(250) / 1000


@pytest.mark.parametrize(
    "content",
    [
        "time,a1,a2\n" + rows("{t},{a},{b}\n"),
        "time;a1;a2\r\n" + rows("{t};{a};{b}\r\n").replace(".", ","),
        "t [ms]\ta1\ta2\n" + rows("{ms}\t{a}\t{b}\n"),
        "# logger 7\n# site: Z\u00fcrich, roof\nTime (s),a1 [m/s\u00b2],a2 [m/s\u00b2]\n" + rows("{t},{a},{b}\n"),
        "sep=;\nZeit [s];a1;a2;\n" + rows("{t};{a};{b}\n").replace(".", ","),
        '"time","a1","a2"\n' + rows('"{t}","{a}","{b}"\n'),
        "sample,t_ms,a1,a2\n" + rows("{k},{ms},{a},{b}\n"),
        "timestamp,a1,a2\n" + rows("2024-02-03T10:00:{t:06.3f}Z,{a},{b}\n"),
        "Datum;a1;a2\n"
        + rows("03.02.2024 10:00:{t:06.3f};{a};{b}\n").replace(".", ",").replace(",02,2024", ".02.2024"),
    ],
    ids=["plain", "german", "tabs", "comments", "sep", "quotes", "counter", "iso", "german-date"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_dialects_of_one_table_give_one_recording(tmp_path: Path, content: str, encoding: str) -> None:
    info, values, warnings = convert(tmp_path / "a.csv", content.encode(encoding))
    assert (info.channels[ACCELERATION], info.sample_rate_hz) == (("a1", "a2"), 100.0)
    assert info.t_start_ns == WHEN_NS and warnings == []
    np.testing.assert_allclose(values, np.column_stack([RAMP, -RAMP]), atol=1e-6)


@pytest.mark.parametrize(
    ("head", "unit", "factor"),
    [
        ("[g]", "m/s^2", 9.80665),
        ("(mg)", "m/s^2", 9.80665e-3),
        ("", "g", 9.80665),
        ("", "gal", 0.01),
        ("", "mg", 9.80665e-3),
    ],
)
def test_units_of_the_header_win_over_the_argument(tmp_path: Path, head: str, unit: str, factor: float) -> None:
    _, values, _ = convert(tmp_path / "a.csv", f"t,a1 {head}\n" + rows("{t},{a}\n"), unit=unit)
    np.testing.assert_allclose(values[:, 0], RAMP * factor, rtol=1e-6)


def test_without_any_time_the_rate_must_be_given(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"a\.csv: no time column.*--rate"):
        convert(tmp_path / "a.csv", "a1,a2\n" + rows("{a},{b}\n"))
    info, values, warnings = convert(tmp_path / "a.csv", rows("{b},{a}\n"), rate_hz=50.0, start_ns=None)
    assert info.sample_rate_hz == 50.0 and info.t_start_ns == 0 and "1970" in warnings[0]
    assert info.channels[ACCELERATION] == ("column1", "column2")
    np.testing.assert_allclose(values[:, 1], RAMP, atol=1e-6)


def test_lost_samples_are_a_jump_of_the_sequence_at_the_right_time(tmp_path: Path) -> None:
    lines = rows("{t},{a}\n").splitlines(keepends=True)
    info, _, warnings = convert(tmp_path / "a.csv", "t,a1\n" + "".join(lines[:120] + lines[127:]))
    assert warnings == ["1 gap between samples: 0.07 s are missing"]
    blocks = list(read_recordings([tmp_path / "a.mcap"]))
    assert [(block.sequence, block.n_samples) for block in blocks] == [(0, 100), (100, 20), (127, 100), (227, 23)]
    assert blocks[2].t_ns == WHEN_NS + 1_270_000_000
    assert (info.sample_rate_hz, info.duration_s) == (100.0, 2.5)


def test_an_irregular_clock_is_refused_unless_the_rate_is_given(tmp_path: Path) -> None:
    chance = random.Random(1)
    times = np.cumsum([chance.uniform(0.005, 0.015) for _ in range(500)])
    content = "t,a1\n" + "".join(f"{t:.6f},{k}\n" for k, t in enumerate(times))
    with pytest.raises(BadInputError, match=r"irregular.*--rate"):
        convert(tmp_path / "a.csv", content)
    info, values, warnings = convert(tmp_path / "a.csv", content, rate_hz=100.0)
    assert (info.n_samples, info.sample_rate_hz) == (500, 100.0) and "irregular" in warnings[0]
    assert values[499, 0] == 499


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("t,a1\n0.00,1\n0.01,oops\n0.02,3\n0.03,4\n", r"line 3: 'oops' in column 2 is no number"),
        ("t,a1\n0.00,bad\n0.01,2\n0.02,3\n0.03,4\n", r"'bad' is no number"),
        ("t,a1\n0.00,1\n0.01,2,9\n0.02,3\n0.03,4\n", r"line 3: 3 cells where 2"),
        ("t,a1 [kN]\n0.00,1\n0.01,2\n0.02,3\n", r"column 'a1' has unit 'kN'; known.*m/s\^2"),
        ("t [weeks],a1\n0.00,1\n0.01,2\n0.02,3\n", r"unknown unit 'weeks'"),
        ("t,a1,a1\n0.00,1,1\n0.01,2,1\n0.02,3,1\n", "same name"),
        ("2024-01-01 00:00:00,1\n2024-13-01 00:00:01,2\n2024-01-01 00:00:02,1\n", r"line 2: '2024-13-01 .* is no date"),
        ("t,a1\n0,1\n", "too few"),
        ("hello\nworld\n", "no rows of numbers"),
        ("", "is empty"),
        (b"\x00\x01\x02", "no text table"),
        (b"\x89MCAP0\r\n", "MCAP recording already"),
        (b"PK\x03\x04broken", "damaged zip"),
        ("t\n0\n1\n2\n", "no column besides"),
    ],
)
def test_what_cannot_be_used_is_named_with_file_and_place(tmp_path: Path, content: str | bytes, reason: str) -> None:
    with pytest.raises(BadInputError, match=rf"a\.csv: .*{reason}"):
        convert(tmp_path / "a.csv", content)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.csv"]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"dbc": Path("frame.dbc")}, "--dbc is for CAN logs"),
        ({"rate_hz": -1.0}, "--rate"),
        ({"rate_hz": 1e-200}, "absurd"),
        ({"channels": {"x": "b"}}, r"'b' names no file; .*a\.csv \(a1, a2\); write FILE:COLUMN, as a:a1"),
        ({"channels": {"x": "a:nope"}}, "no column 'nope'; it has a1, a2"),
        ({"channels": {"x": "a"}}, "name a column: a1, a2"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, options: dict[str, object], reason: str) -> None:
    with pytest.raises(BadInputError, match=reason):
        convert(tmp_path / "a.csv", "time,a1 [g],a2 [g]\n" + rows("{t},{a},{b}\n"), **options)


def test_a_unit_that_no_column_needs_is_told(tmp_path: Path) -> None:
    _, values, told = convert(tmp_path / "a.csv", "time,a1 [g]\n" + rows("{t},{a}\n"), unit="mg")
    _, same, silent = convert(tmp_path / "a.csv", "time,a1 [g]\n" + rows("{t},{a}\n"))
    assert any(text.startswith("--unit mg is not used") for text in told)
    assert not any("--unit" in text for text in silent)
    np.testing.assert_array_equal(values, same)


@pytest.mark.parametrize("name", ["a.blf", "a.asc", "a.log"])
def test_can_logs_need_a_dbc(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadInputError, match="--dbc"):
        convert(tmp_path / name, "(0.0) can0 100#00")


def test_missing_files_and_folders(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.csv", Path("a\0b.csv")):
        with pytest.raises(MissingInputError):
            import_files([path], tmp_path / "out.mcap")
    (tmp_path / "a.csv").write_text("t,a1\n" + rows("{t},{a}\n"))
    with pytest.raises(MissingInputError, match="cannot be written"):
        import_files([tmp_path / "a.csv"], tmp_path)


def test_channels_and_ground_are_picked_and_renamed(tmp_path: Path) -> None:
    content = "time,low,top,table\n" + rows("{t},{a},{b},{k}\n")
    info, values, _ = convert(tmp_path / "a.csv", content, channels={"a1": "a:top", "a2": "a.csv:low"}, ground="table")
    assert info.channels == {ACCELERATION: ("a1", "a2"), GROUND: ("ground",)}
    np.testing.assert_allclose(values, np.column_stack([-RAMP, RAMP]), atol=1e-6)
    np.testing.assert_array_equal(samples(tmp_path / "a.mcap", GROUND)[:, 0], np.arange(250))
    rest, _, _ = convert(tmp_path / "a.csv", content, ground="a:table")
    assert rest.channels[ACCELERATION] == ("low", "top")


def test_a_measured_force_is_no_channel_and_has_its_own_unit(tmp_path: Path) -> None:
    content = "time,low,hammer [kN],note [V]\n" + rows("{t},{a},{k},{b}\n")
    info, _, _ = convert(tmp_path / "a.csv", content, channels={"a1": "low"}, forces={"f1": "hammer"})
    assert info.channels == {ACCELERATION: ("a1",), FORCE: ("f1",), "/note": ("note",)}
    np.testing.assert_allclose(samples(tmp_path / "a.mcap", FORCE)[:, 0], 1e3 * np.arange(250))
    with pytest.raises(BadInputError, match="'note' has unit 'V'; known for force: N, kN, lbf"):
        convert(tmp_path / "a.csv", content, channels={"a1": "low"}, forces={"f1": "note"})


def test_files_with_clocks_are_joined_where_they_overlap(tmp_path: Path) -> None:
    lines = rows("{t},{k}\n").splitlines(keepends=True)
    (tmp_path / "top.csv").write_text("t,acc\n" + "".join(lines[:200]))
    (tmp_path / "low.csv").write_text("t,acc\n" + "".join(lines[50:]))
    warnings: list[str] = []
    files = [tmp_path / "top.csv", tmp_path / "low.csv"]
    info = import_files(files, tmp_path / "o.mcap", Options(start_ns=WHEN_NS), on_warning=warnings.append)
    assert info.channels[ACCELERATION] == ("top", "low") and "150 samples are common" in warnings[0]
    ramp = np.arange(50, 200)
    np.testing.assert_array_equal(samples(tmp_path / "o.mcap"), np.column_stack([ramp, ramp]))


DOT = "sep=,\nDeviceTag:,x\nStartTime: ,2025-03-06_12:26:07_000 PST\n\n"
DOT += "PacketCounter,SampleTimeFine,Acc_X,Acc_Y\n"


def dot(first_tick: int, skip: tuple[int, ...] = ()) -> str:
    """A file of 300 packets at 120 Hz; the first has no acceleration yet."""
    packets = (k for k in range(300) if k not in skip)
    return DOT + "".join(f"{k},{(first_tick + 8333 * k) % 2**32},{k / 100},{-min(k, 1)}\n" for k in packets)


def test_xsens_counts_packets_and_begins_at_its_local_start_time(tmp_path: Path) -> None:
    near_wrap = 2**32 - 100 * 8333
    info, values, warnings = convert(tmp_path / "top.csv", dot(near_wrap, skip=(150, 151)), start_ns=None)
    assert (info.sample_rate_hz, info.channels[ACCELERATION], warnings) == (
        120.0,
        ("Acc_X",),
        [
            f"{tmp_path / 'top.csv'}: from row 101 its times are 4294.97 s earlier, one turn of their clock; taken to go on",
            f"{tmp_path / 'top.csv'}: left out: Acc_Y (--channel and --covariate take columns by name)",
            "1 gap between samples: 0.0166667 s are missing",
        ],
    )
    assert info.t_start_ns == 1_741_292_767 * 10**9 + 8_333_000  # 20:26:07 UTC, one packet later
    blocks = list(read_recordings([tmp_path / "top.mcap"]))
    assert [(block.sequence, block.n_samples) for block in blocks] == [(0, 120), (120, 29), (151, 120), (271, 28)]
    assert values[0, 0] == pytest.approx(0.01) and values[-1, 0] == pytest.approx(2.99)


def test_columns_with_a_unit_of_a_rate_of_rotation_have_a_topic_of_their_own(tmp_path: Path) -> None:
    content = "t,a1 [g],r1 [deg/s],r2 [rad/s],strain [um/m]\n" + rows("{t},{a},{k},{b},{k}\n")
    info, values, warnings = convert(tmp_path / "a.csv", content, unit=None)
    assert dict(info.channels) == {ACCELERATION: ("a1",), ROTATION_RATE: ("r1", "r2"), "/strain": ("strain",)}
    np.testing.assert_allclose(values[:, 0], 9.80665 * RAMP, rtol=1e-6)
    turned = samples(tmp_path / "a.mcap", ROTATION_RATE)
    np.testing.assert_allclose(turned, np.column_stack([np.radians(1000.0 * RAMP), -RAMP]), rtol=1e-6)
    assert warnings == [f"{tmp_path / 'a.csv'}: strain (um/m) is kept as the covariate /strain"]
    chosen, _, _ = convert(tmp_path / "a.csv", content, channels={"top": "a1", "turn": "r2"})
    assert chosen.channels[ACCELERATION] == ("top",) and chosen.channels[ROTATION_RATE] == ("turn",)
    with pytest.raises(BadInputError, match="only rates of rotation are chosen"):
        convert(tmp_path / "a.csv", content, channels={"turn": "r2"})


def test_xsens_gives_its_gyroscope_where_that_is_named(tmp_path: Path) -> None:
    content = dot(0).replace("Acc_Y", "Gyr_Z")
    named = {"a1": "Acc_X", "r1": "Gyr_Z"}
    info, _, _ = convert(tmp_path / "top.csv", content, start_ns=None, channels=named)
    assert dict(info.channels) == {ACCELERATION: ("a1",), ROTATION_RATE: ("r1",)}
    np.testing.assert_allclose(samples(tmp_path / "top.mcap", ROTATION_RATE), np.radians(-1.0), rtol=1e-6)


def test_a_zero_shift_of_summer_time(tmp_path: Path) -> None:
    summer, _, _ = convert(tmp_path / "a.csv", dot(0).replace("PST", "PDT"), start_ns=None)
    winter, _, _ = convert(tmp_path / "b.csv", dot(0), start_ns=None)
    assert winter.t_start_ns - summer.t_start_ns == 3600 * 10**9
    _, _, warnings = convert(tmp_path / "c.csv", dot(0).replace("PST", "XYZ"), start_ns=None)
    assert "XYZ has no zone that is known; taken as UTC" in warnings[0]


@pytest.mark.parametrize(
    ("heading", "ending", "told"),
    [("time", "", 1), ("time", "Z", 0), ("time", "+01:00", 0), ("time [UTC]", "", 0), ("time UTC", "", 0)],
)
def test_times_without_a_zone_are_utc_and_told(tmp_path: Path, heading: str, ending: str, told: int) -> None:
    content = f"{heading},a1,a2\n" + rows("2024-02-03T10:00:{t:06.3f}" + ending + ",{a},{b}\n")
    info, _, warnings = convert(tmp_path / "a.csv", content, start_ns=None)
    begin = "2024-02-03T10:00:00" + (ending if ending == "+01:00" else "Z")
    assert info.t_start_ns == utc_ns(begin)
    assert len(warnings) == told and all("has no zone; taken as UTC" in warning for warning in warnings)


def test_sensors_that_were_not_synchronised_are_refused_with_their_offsets(tmp_path: Path) -> None:
    files = sorted((DATA / "mini-shake-table").glob("*.csv"))
    assert len(files) == 4
    with pytest.raises(BadInputError, match=r"share 0 of 2708.*floor2.csv starts \+790.*ground.csv starts -196"):
        import_files(files, tmp_path / "o.mcap")
    assert not (tmp_path / "o.mcap").exists()


def test_a_plain_csv_named_zip_with_swapped_date_and_strains(tmp_path: Path) -> None:
    (path,) = (DATA / "munich-test-bridge").glob("*.zip")
    for source in (path, tmp_path / path.name):  # the same inside a true archive
        if source != path:
            with zipfile.ZipFile(source, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("folder/" + path.name, path.read_bytes())
        warnings: list[str] = []
        info = import_files([source], tmp_path / "o.mcap", on_warning=warnings.append)
        assert (info.channels[ACCELERATION], info.sample_rate_hz, info.n_samples) == (("ACC01_z",), 100.0, 2000)
        assert len(warnings) == 5 and "seem swapped" in warnings[0]
        assert "its time 2022-11-04 08:36:24.897 has no zone" in warnings[1]
        kept = ("DMS_AS (um/m)", "FRC-01 (kN)", "INC01 (deg)")
        assert all(f"{name} is kept" in told for name, told in zip(kept, warnings[2:], strict=True))
    assert samples(tmp_path / "o.mcap")[0, 0] == pytest.approx(4.93101433676202e-05 * 9.80665)


def test_an_archive_of_several_tables_is_refused_with_their_names(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("one.csv", "t,a\n")
        archive.writestr("two.csv", "t,a\n")
    with pytest.raises(BadInputError, match=r"holds 2 tables.*one.csv, two.csv"):
        convert(tmp_path / "a.zip", buffer.getvalue())


def npz(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("arrays", "names"),
    [
        ({"samples": np.column_stack([RAMP, -RAMP]), "fs": 100.0, "channels": ["u", "v"]}, ("u", "v")),
        ({"samples": np.column_stack([RAMP, -RAMP]), "t": np.arange(250) / 100}, ("a1", "a2")),
        ({"top": RAMP, "low": -RAMP, "rate_hz": 100}, ("top", "low")),
    ],
)
def test_npz_layouts(tmp_path: Path, arrays: dict[str, object], names: tuple[str, ...]) -> None:
    info, values, _ = convert(tmp_path / "a.npz", npz(**arrays))
    assert (info.channels[ACCELERATION], info.sample_rate_hz) == (names, 100.0)
    np.testing.assert_allclose(values, np.column_stack([RAMP, -RAMP]), atol=1e-6)


def test_numbers_that_stand_for_no_reading_are_missing_in_arrays_too(tmp_path: Path) -> None:
    samples = np.sin(np.arange(300.0).reshape(100, 3))
    samples[7, 0], samples[9, 1] = -9999.0, 1e200
    np.savez(tmp_path / "a.npz", samples=samples, rate_hz=100.0)
    told: list[str] = []
    imported([tmp_path / "a.npz"], tmp_path / "a.mcap", on_warning=told.append)
    assert any("a1: 1 readings are missing: -9999 stands for them" in text for text in told)
    assert any("a2: 1 readings are missing: 1e+200 stands for them" in text for text in told)


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"samples": np.array([{"evil": 1}], dtype=object)}, "allow_pickle=False"),
        ({"samples": np.ones((5, 2)), "channels": ["a"], "fs": 1.0}, r"shape \(5, 2\) for channels a"),
        ({"samples": np.ones((5, 2))}, "--rate"),
        ({"fs": 100.0}, "no array `samples`"),
        ({"samples": np.array(["x", "y"])}, "cannot be used"),
    ],
)
def test_npz_that_cannot_be_used(tmp_path: Path, arrays: dict[str, object], reason: str) -> None:
    with pytest.raises(BadInputError, match=reason):
        convert(tmp_path / "a.npz", npz(**arrays))


def test_the_comment_mark_of_numpys_header_is_no_part_of_a_name(tmp_path: Path) -> None:
    rows = "".join(f"{k / 100:.2f},{k},{-k}\n" for k in range(300))
    info, values, _ = convert(tmp_path / "a.csv", "# t,a1,a2\n" + rows)
    assert (info.channels[ACCELERATION], info.sample_rate_hz) == (("a1", "a2"), 100.0)
    np.testing.assert_allclose(values[:, 0], np.arange(300))


def test_an_archive_that_would_fill_the_memory_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "zeros.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("samples.npy", "w", force_zip64=True) as member,
    ):
        member.write(b"\x93NUMPY")
    raw = bytearray(path.read_bytes())
    at = raw.index(b"PK\1\2") + 24  # the size that the directory states
    raw[at : at + 4] = (3 << 30).to_bytes(4, "little")
    path.write_bytes(raw)
    with pytest.raises(BadInputError, match=r"zeros\.npz: would unpack to 3072 MiB or more; at most 256 MiB .* cut it"):
        import_files([path], tmp_path / "out.mcap")


def test_a_table_takes_a_few_times_its_size_of_memory(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "long.csv"
    np.savetxt(path, rng.standard_normal((60_000, 4)), fmt="%.6f", delimiter=",", header="a1,a2,a3,a4")
    raw = path.read_bytes()
    tracemalloc.start()
    try:
        cells = delimited.cut(path, delimited.decode(path, raw), lambda _: None)
        (table,) = delimited.to_tables(cells, lambda _: None)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert table.values.shape == (60_000, 4)
    assert peak < 12 * len(raw), f"{peak / len(raw):.1f} bytes a byte"


@pytest.mark.parametrize("line", [b"0,0\n", b"0.123456,0.223456,0.323456\n"], ids=["short lines", "readings"])
def test_a_small_zip_of_a_large_table_is_refused_by_what_the_table_would_take(tmp_path: Path, line: bytes) -> None:
    """The lines of the first one take 15 times the memory of their characters: 20 MB of them are too many."""
    path = tmp_path / "small.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.csv", "w") as member:
        for _ in range(20 if len(line) == 4 else 260):
            member.write(line * ((1 << 20) // len(line) + 1))
    with pytest.raises(BadInputError, match=r"small\.zip: would unpack to \d+ MiB or more; at most 256 MiB"):
        import_files([path], tmp_path / "out.mcap", Options(rate_hz=100.0))


def test_an_archive_of_small_numbers_is_refused_by_what_its_readings_take(tmp_path: Path) -> None:
    path = tmp_path / "bytes.npz"
    np.savez_compressed(path, samples=np.zeros((1 << 25) + 1, np.int8))
    with pytest.raises(BadInputError, match=r"would unpack to 256 MiB or more"):
        import_files([path], tmp_path / "out.mcap", Options(rate_hz=100.0))


def test_a_table_of_many_columns_is_cut_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cuts, reader = 0, csv.reader  # which cuts lines with quotes

    def counted(*arguments: Any, **named: Any) -> Any:
        nonlocal cuts
        cuts += 1
        return reader(*arguments, **named)

    monkeypatch.setattr("csv.reader", counted)
    content = ",".join(f"a{k}" for k in range(300)) + "\n" + ("0.5," * 299 + '"1"\n') * 200
    info, _, _ = convert(tmp_path / "wide.csv", content, rate_hz=100.0)
    assert len(info.channels[ACCELERATION]) == 300
    assert 200 <= cuts < 5 * 200
