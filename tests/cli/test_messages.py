"""What a newcomer gets wrong: each slip gives one message with the remedy, the right exit code, and leaves nothing behind."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.samples import T0_NS, Cli, Cut, write_blocks


@pytest.fixture
def folder(tmp_path: Path, frame_text: str) -> Path:
    (tmp_path / "frame.toml").write_text(frame_text)
    rows = "".join(f"{k / 100:.2f},{(-1) ** k},{k % 3},{k % 5}\n" for k in range(400))
    (tmp_path / "d.csv").write_text("t,roof,mid,low\n" + rows)
    return tmp_path


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("rooof", "'rooof' names no file, did you mean 'roof'?"),
        ("d:rooof", "d.csv: no column 'rooof', did you mean 'roof'?"),
        ("d.cvs:low", "did you mean 'd.csv:low'?"),
    ],
)
def test_a_misspelt_column_is_told_the_name_most_like_it(folder: Path, main: Cli, place: str, told: str) -> None:
    done = main("import", "d.csv", "--channel", f"a1={place}", "--out", "x.mcap", cwd=folder)
    assert done.returncode == 65 and told in done.stderr
    assert "roof, mid, low" in done.stderr


@pytest.mark.parametrize("command", [("import", "d.csv", "--out", "x.mcap"), ("look", "d.csv")])
def test_an_unknown_unit_of_an_option_is_wrong_usage(folder: Path, main: Cli, command: tuple[str, ...]) -> None:
    done = main(*command, "--unit", "furlong", cwd=folder)
    assert done.returncode == 2 and "--unit 'furlong': known for acceleration: m/s^2" in done.stderr


def test_a_structure_file_in_the_place_of_a_baseline_is_told_so_and_the_reverse(folder: Path, main: Cli) -> None:
    (folder / "x.mcap").touch()
    given = ("x.mcap", "--structure", "frame.toml", "--baseline", "frame.toml", "--out", "out")
    for command in ("replay", "diagnose"):
        done = main(command, *given, cwd=folder)
        assert done.returncode == 65 and "frame.toml: a structure file, and no baseline" in done.stderr
        assert "calibrate" in done.stderr
    (folder / "b.json").write_text('{"format": 1}')
    done = main("check", "b.json", cwd=folder)
    assert done.returncode == 78 and "b.json: not a TOML file" in done.stderr and "--baseline" in done.stderr


def test_a_report_of_a_missing_folder_says_so_before_it_asks_for_a_page(folder: Path, main: Cli) -> None:
    for more in ([], ["--out", "r.html"], ["--event", "last"]):
        done = main("report", "ABSENT", *more, cwd=folder)
        assert done.returncode == 66
        assert "ABSENT: there is no such folder; give the one that 'replay --out'" in done.stderr


def test_a_command_that_fails_leaves_no_empty_folder(folder: Path, main: Cli) -> None:
    channels = [word for name in ("a1=roof", "a2=mid", "a3=low") for word in ("--channel", name)]
    assert main("import", "d.csv", *channels, "--out", "short.mcap", cwd=folder).returncode == 0
    for command in ("replay", "diagnose"):
        done = main(command, "short.mcap", "--structure", "frame.toml", "--out", "out", cwd=folder)
        assert done.returncode == 65, done.stderr
        assert not (folder / "out").exists(), command
    (folder / "out").mkdir()
    assert main("replay", "short.mcap", "--structure", "frame.toml", "--out", "out", cwd=folder).returncode == 65
    assert (folder / "out").is_dir(), "it was there before"


def test_a_replay_notes_what_its_recordings_cover_and_names_those_that_overlap(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    (tmp_path / "s.toml").write_text(frame_text)
    for name, begin_s in (("early.mcap", 0), ("late.mcap", 50), ("next-day.mcap", 86400)):
        write_blocks(tmp_path / name, cut(record, 128.0, t0_ns=T0_NS + begin_s * 10**9))
    done = main("replay", "next-day.mcap", "early.mcap", "--structure", "s.toml", "--out", "apart", cwd=tmp_path)
    assert done.returncode == 0 and "overlap" not in done.stderr
    summary = json.loads((tmp_path / "apart/summary.json").read_text())
    lines = [json.loads(line) for line in (tmp_path / "apart/results.jsonl").read_text().splitlines()]
    judged = sum(line["skipped"] is None for line in lines)
    assert 0 < judged < len(lines), "those that hold some of the day between say nothing"
    assert (summary["windows"], summary["skipped"], summary["windows_not_due"]) == (judged, 0, len(lines) - judged)
    assert (
        f"{judged} windows, 0 skipped" in done.stdout and "could not be judged" not in done.stdout + summary["headline"]
    )
    assert not any("could not be judged" in doubt for doubt in summary["doubts"])
    assert summary["realtime_factor"] < 0.2 * 86400, "two minutes of data, not a day"
    told = main("report", "apart", "--out", "r.html", "--json", cwd=tmp_path)
    assert [json.loads(told.stdout)[key] for key in ("windows", "windows_due", "judged")] == [judged] * 3
    recorded = summary["recorded"]
    begins = [T0_NS, T0_NS + 86400 * 10**9]
    assert [span["file"] for span in recorded] == ["early.mcap", "next-day.mcap"]
    assert [(span["t_begin_ns"], span["t_end_ns"]) for span in recorded] == [(t, t + 60 * 10**9) for t in begins]
    done = main("replay", "late.mcap", "early.mcap", "--structure", "s.toml", "--out", "twice", cwd=tmp_path)
    assert done.returncode == 0
    assert "early.mcap and late.mcap overlap by 10 s" in done.stderr and "leave out" in done.stderr


def test_a_wrong_unit_and_a_baseline_whose_updating_did_not_converge_are_doubted(
    folder: Path, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    long = np.concatenate([record, record[: 20 * 128]])  # what a diagnosis can start from takes 70 s
    for name, factor in (("r.mcap", 1.0), ("g.mcap", 9.80665)):
        write_blocks(folder / name, cut(factor * long, 128.0))
    given = ("--structure", "frame.toml", "--baseline", "b.json")
    assert main("calibrate", "r.mcap", *given[:2], "--out", "b.json", cwd=folder).returncode == 0
    assert main("diagnose", "r.mcap", *given, "--out", "found", cwd=folder).stderr == ""
    healthy = json.loads((folder / "b.json").read_text())
    (folder / "c.json").write_text(json.dumps(healthy | {"reference": None}))
    bare = main("diagnose", "r.mcap", *given[:2], "--baseline", "c.json", "--out", "bare", cwd=folder)
    assert bare.returncode == 65 and "c.json: holds nothing for a diagnosis" in bare.stderr
    (folder / "b.json").write_text(json.dumps(healthy | {"converged": False}))
    site = '[site]\nbaseline = "b.json"\n[source]\nkind = "mcap"\nfiles = ["r.mcap"]\n[output]\ndir = "site"\n'
    (folder / "site.toml").write_text((folder / "frame.toml").read_text() + site)
    said = "the updating of the baseline b.json did not converge"
    for command in (("check", "site.toml"), ("diagnose", "g.mcap", *given, "--out", "found")):
        done = main(*command, cwd=folder)
        assert done.returncode == 0 and said in done.stderr, done.stderr
    assert "times stronger than at calibration: is the unit right" in done.stderr
    assert json.loads((folder / "found/diagnosis.json").read_text())["doubts"][0].startswith(said)
    assert said in (folder / "found/report.html").read_text()
    assert main("replay", "r.mcap", *given, "--out", "out", cwd=folder).returncode == 0
    assert main("run", "site.toml", cwd=folder).returncode == 0
    for summary in ("out/summary.json", "site/summary.json"):
        found = json.loads((folder / summary).read_text())
        assert found["state"] == "doubtful" and said[4:] in found["headline"]


def test_a_sensor_that_is_not_in_the_recording_is_named_with_both_remedies(folder: Path, main: Cli) -> None:
    given = ("d.csv", "--unit", "g", "--start", "2026-01-01")
    assert main("import", *given, "--channel", "a1=roof", "--out", "d.mcap", cwd=folder).returncode == 0
    done = main("replay", "d.mcap", "--structure", "frame.toml", "--out", "out", cwd=folder)
    assert done.returncode == 65 and "channel a2, a3 of the structure file is not in the data" in done.stderr
    assert "name the channels alike, or take what was not measured out of the structure file" in done.stderr


def test_a_recording_in_which_no_window_lies_is_named(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    (tmp_path / "s.toml").write_text(frame_text)
    for name, part, begin_s in (
        ("long", record, 0),
        ("short", record[: 10 * 128], 3000),
        ("other", record[:1280], 9000),
    ):
        write_blocks(tmp_path / f"{name}.mcap", cut(part, 128.0, t0_ns=T0_NS + begin_s * 10**9))
    done = main("replay", "long.mcap", "short.mcap", "--structure", "s.toml", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0 and "short.mcap: 10 s in one piece hold no window of 20 s" in done.stderr
    assert "long.mcap" not in done.stderr
    done = main("replay", "short.mcap", "other.mcap", "--structure", "s.toml", "--out", "none", cwd=tmp_path)
    assert done.returncode == 65 and "10.0 s of usable data" in done.stderr and "one window takes 20 s" in done.stderr


@pytest.mark.parametrize("kind", ["shear_frame", "modal"])
def test_calibrate_and_compare_state_no_modes_of_less_than_20_s_as_look_does(
    folder: Path, main: Cli, frame_text: str, kind: str
) -> None:
    text = frame_text.replace("window_s = 20.0", "window_s = 5.0").replace("hop_s = 5.0", "hop_s = 2.5")
    (folder / "f.toml").write_text(text)
    simulated = ("simulate", "--structure", "f.toml", "--duration", "15", "--rate", "200", "--out", "s.mcap")
    assert main(*simulated, cwd=folder).returncode == 0
    if kind == "modal":
        sensors = text[text.index("[[sensors]]") :]
        (folder / "f.toml").write_text('[structure]\nkind = "modal"\n' + sensors.replace("floor", "# floor"))
    for command in (
        ("calibrate", "s.mcap", "--structure", "f.toml", "--out", "b.json"),
        ("look", "s.mcap"),
    ):
        done = main(*command, cwd=folder)
        assert done.returncode == 65
        assert done.stderr.count("\n") == 1
        assert "too short to state modes" in done.stderr
        assert "20 s" in done.stderr
    assert not (folder / "b.json").exists()
    compared = main("compare", "s.mcap", "s.mcap", cwd=folder)
    assert compared.returncode == 0
    assert "too short to state modes" in compared.stdout
    assert "20 s" in compared.stdout
    assert "mode 1" not in compared.stdout
    assert "cannot say whether they differ" in compared.stdout
