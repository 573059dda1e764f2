"""The commands: exit codes, messages, and the files they leave.

`site.main` runs the entry point in this process; `site.cli` the installed script, where the claim is about a process.
"""

from __future__ import annotations

import inspect
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from typer.models import ArgumentInfo, CommandInfo

from drivers import codec
from drivers.base import ACCELERATION, GROUND
from drivers.mcap_file import McapWriter, read_recordings, recording_info, scan_messages
from monitor.cli.app import app
from monitor.config import configuration
from monitor.damage import Baseline, Update, learn_baseline
from monitor.model import Model, simulate
from tests.support.commands import Done, assert_ok, assert_refused, strict
from tests.support.samples import T0_NS, Cli, Cut, write_blocks

ROS2 = Path(__file__).parents[1] / "data" / "mcap-ros2"
RATE = 200.0
LINE_KEYS = {
    "t_end_ns", "window_s", "frequencies_hz", "frequencies_std_hz", "damping_ratio", "damping_std", "mode_shapes",
    "stiffness_n_per_m", "stiffness_std", "ddi", "ddi_std", "alarm", "skipped",
}  # fmt: skip
ESTIMATES = LINE_KEYS - {"t_end_ns", "window_s", "alarm", "skipped"}
SUMMARY_KEYS = {"windows", "skipped", "alarms", "dropped_samples", "gaps", "realtime_factor"}
EPISODE_KEYS = {"level", "story", "t_first_ns", "t_last_ns", "ddi", "ddi_std", "loss_n_per_m"}


def lines_of(out: Path) -> list[dict]:
    return [strict(line) for line in (out / "results.jsonl").read_text().splitlines()]  # type: ignore[misc]


def summary_of(out: Path) -> dict:
    return strict((out / "summary.json").read_text())  # type: ignore[return-value]


def tree(folder: Path) -> dict[str, int]:
    """Every file below a folder with when it was last written."""
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


class Site:
    """A folder with good inputs, made once; commands run in it, and each test gets its own output folder."""

    def __init__(self, folder: Path, cli: Cli, main: Cli, cut: Cut, frame_text: str) -> None:
        self.folder, self.cli, self.main, self.cut = folder, cli, main, cut
        self.quick = folder / "quick.toml"
        self.quick.write_text(frame_text)
        self.watch = folder / "watch.toml"
        slow = frame_text.replace("window_s = 20.0", "window_s = 60.0").replace("block_rows = 10", "block_rows = 20")
        self.watch.write_text(slow + "\n[alarm]\nalarm_loss = 0.08\nfalse_announcements_per_year = 1\n")
        self.healthy = folder / "healthy.mcap"
        self.done = self.simulate(self.healthy, "--duration", 240, "--seed", 1)
        self._values = np.zeros((0, 3))

    @cached_property
    def baseline(self) -> Path:
        """Of the healthy recording, calibrated when it is first asked for."""
        path = self.folder / "baseline.json"
        done = self.main("calibrate", self.healthy, "--structure", self.watch, "--out", path)
        assert_ok(done)
        assert done.stderr == ""
        return path

    def simulate(self, out: Path, *more: object) -> Done:
        return self.main("simulate", "--structure", self.watch, "--out", out, "--rate", RATE, "--noise", 0.02, *more)

    def values(self, seconds: float) -> np.ndarray:
        """The healthy recording's first seconds."""
        if not self._values.size:
            self._values = np.concatenate([b.samples for b in read_recordings([self.healthy])])
        return self._values[: round(seconds * RATE)].copy()

    def write(self, name: str, values: np.ndarray, **changes: object) -> Path:
        path = self.folder / name
        write_blocks(path, self.cut(values, RATE, [200], **changes))
        return path


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, cli: Cli, main: Cli, cut: Cut, frame_text: str) -> Site:
    made = Site(tmp_path_factory.mktemp("cli"), cli, main, cut, frame_text)
    assert_ok(made.done)
    return made


# --- replay and calibrate on good recordings ---


@pytest.fixture(scope="module")
def plain(site: Site) -> tuple[Done, Path]:
    out = site.folder / "deep" / "plain"
    recording = site.write("plain.mcap", site.values(42))
    return site.main("replay", recording, "--structure", site.quick, "--out", out), out


def test_replay_writes_its_files_and_is_quiet_in_a_pipe(plain: tuple[Done, Path]) -> None:
    done, out = plain
    assert_ok(done)
    assert done.stderr == ""
    files = ["events.jsonl", "live.rrd", "results.jsonl", "results.mcap", "summary.json"]
    assert sorted(p.name for p in out.iterdir()) == files
    assert all(p.stat().st_size > 0 for p in out.iterdir() if p.name != "events.jsonl")  # nothing happened


def test_lines_are_strict_json_with_every_key_of_the_contract(plain: tuple[Done, Path]) -> None:
    lines = lines_of(plain[1])
    assert [line["t_end_ns"] for line in lines] == [T0_NS + (20 + 5 * k) * 10**9 for k in range(5)]
    for line in lines:
        assert line.keys() >= LINE_KEYS
        assert line["window_s"] == 20.0
        assert line["skipped"] is None
        assert np.shape(line["frequencies_hz"]) == np.shape(line["damping_std"]) == (3,)
        assert np.shape(line["mode_shapes"]) == (3, 3, 2)
        assert np.shape(line["ddi"]) == np.shape(line["ddi_std"]) == np.shape(line["stiffness_std"]) == (3,)
        assert min(line["frequencies_std_hz"] + line["stiffness_std"] + line["ddi_std"]) > 0
        assert line["alarm"].keys() >= {"level", "stories", "reason"}
        assert line["alarm"]["level"] == "normal" and line["alarm"]["stories"] == []


def test_the_summary_has_every_key_of_the_contract(plain: tuple[Done, Path]) -> None:
    summary = summary_of(plain[1])
    assert summary.keys() >= SUMMARY_KEYS
    counts = [summary[key] for key in ("windows", "skipped", "alarms", "dropped_samples", "gaps")]
    assert counts == [5, 0, [], 0, 0]
    assert summary["realtime_factor"] > 0  # how fast is for tests/benchmarks


def test_results_mcap_holds_the_same_lines(plain: tuple[Done, Path]) -> None:
    messages = [(t, data.decode()) for topic, t, data in scan_messages(plain[1] / "results.mcap") if "result" in topic]
    lines = (plain[1] / "results.jsonl").read_text().splitlines()
    assert messages == [(strict(line)["t_end_ns"], line) for line in lines]  # type: ignore[index]


@pytest.mark.system
def test_the_script_replays_again_into_the_same_folder_quietly_and_to_the_same_lines(
    site: Site, plain: tuple[Done, Path]
) -> None:
    before = (plain[1] / "results.jsonl").read_bytes()
    done = site.cli("replay", site.folder / "plain.mcap", "--structure", site.quick, "--out", plain[1])
    assert_ok(done)
    assert done.stderr == ""
    assert (plain[1] / "results.jsonl").read_bytes() == before


def test_a_planted_loss_of_a_tenth_is_found_in_its_story_alone(site: Site) -> None:
    before, after = site.folder / "before.mcap", site.folder / "after.mcap"
    assert_ok(site.simulate(before, "--duration", 120, "--seed", 2, "--start", "2026-01-02T00:00:00"))
    late = ("--duration", 150, "--seed", 3, "--start", "2026-01-02T00:02:00", "--damage", "story2=0.1")
    assert_ok(site.simulate(after, *late))
    out = site.folder / "planted"
    arguments = ("--structure", site.watch, "--baseline", site.baseline, "--out", out)
    done = site.main("replay", after, before, *arguments)
    assert_ok(done)
    planted_ns = recording_info(after).t_start_ns
    summary = summary_of(out)
    (episode,) = summary["alarms"]
    assert episode.keys() >= EPISODE_KEYS
    assert (episode["level"], episode["story"], episode["t_last_ns"]) == ("alarm", 2, None)
    assert planted_ns < episode["t_first_ns"] <= planted_ns + 65 * 10**9
    assert episode["ddi"] == pytest.approx(0.10, abs=4 * episode["ddi_std"])
    assert episode["loss_n_per_m"] == pytest.approx(151.5, rel=0.15)
    lines = lines_of(out)
    assert len(lines) == (270 - 60) // 5 + 1
    for line in lines:
        if line["t_end_ns"] <= planted_ns:
            assert line["alarm"]["level"] == "normal"
        assert line["alarm"]["stories"] in ([], [2])
    assert lines[-1]["alarm"]["level"] == "alarm"
    assert "alarm: Story 2 from the top lost" in done.stdout


@pytest.mark.system
def test_the_script_calibrates_to_the_same_baseline(site: Site, tmp_path: Path) -> None:
    again = tmp_path / "again.json"
    assert_ok(site.cli("calibrate", site.healthy, "--structure", site.watch, "--out", again))
    assert again.read_bytes() == site.baseline.read_bytes()
    strict(again.read_text())


def test_an_updating_that_did_not_converge_is_told_last_and_by_the_exit_code(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The updating of each window converges, that to the mean of their modes does not."""

    def unconverged(*arguments: Any, **named: Any) -> tuple[Baseline, Update]:
        baseline, fit = learn_baseline(*arguments, **named)
        return baseline, replace(fit, converged=False)

    monkeypatch.setattr("monitor.runs.calibrate.learn_baseline", unconverged)
    record, out = site.write("brief.mcap", site.values(60)), tmp_path / "b.json"
    for more in ([], ["--json"]):
        done = site.main("calibrate", record, "--structure", site.quick, "--out", out, *more)
        assert done.returncode == 65
        last = done.stderr.strip().splitlines()[-1]
        assert last.startswith(f"error: {out}: the updating did NOT converge") and "quick.toml" in last
        strict(out.read_text())
    assert strict(done.stdout)["converged"] is False


def test_a_rebase_that_did_not_converge_is_told_by_the_exit_code_too(site: Site, tmp_path: Path) -> None:
    drawn, out = tmp_path / "drawn.toml", tmp_path / "b.json"
    drawn.write_text(site.watch.read_text().replace("1514.8507", "1700") + "\n[updating]\nmax_iterations = 1\n")
    done = site.main("calibrate", "--rebase", site.baseline, "--structure", drawn, "--out", out, "--json")
    assert done.returncode == 65 and out.exists() and "did NOT converge" in done.stderr
    assert strict(done.stdout)["converged"] is False


def test_samples_of_all_channels_that_are_not_finite_are_told_and_their_windows_skipped(
    site: Site, tmp_path: Path
) -> None:
    values = site.values(80)
    values[6000:6200] = np.nan  # 30 to 31 s
    values[6500] = np.inf
    done = site.main("replay", site.write("nan.mcap", values), "--structure", site.quick, "--out", tmp_path)
    assert_ok(done)
    (warning,) = done.stderr.splitlines()
    assert warning.startswith("warning: 201 samples")
    lines = lines_of(tmp_path)
    assert len(lines) == 13
    for k, line in enumerate(lines):
        assert line.keys() >= LINE_KEYS
        touched = 5 * k + 20 > 30 and 5 * k < 32.505
        assert (line["skipped"] is not None) == touched
        if touched:
            assert all(line[key] is None for key in ESTIMATES)
            assert line["window_s"] < 20.0
            assert line["alarm"]["level"] == "normal"
    summary = summary_of(tmp_path)
    assert (summary["windows"], summary["dropped_samples"], summary["gaps"]) == (13, 201, 2)
    assert summary["skipped"] == sum(line["skipped"] is not None for line in lines)


def test_results_are_written_even_when_no_window_completes(site: Site, tmp_path: Path) -> None:
    values = site.values(60)
    values[1000::2000] = np.nan  # a hole every 10 s
    done = site.main("replay", site.write("holes.mcap", values), "--structure", site.quick, "--out", tmp_path)
    assert_ok(done)
    lines = lines_of(tmp_path)
    assert len(lines) == 9
    assert all(line["skipped"] for line in lines)


def test_a_truncated_recording_is_used_as_far_as_it_goes_with_a_warning(site: Site, tmp_path: Path) -> None:
    cut = site.folder / "cut.mcap"
    whole = site.healthy.read_bytes()
    cut.write_bytes(whole[: len(whole) * 7 // 10])
    done = site.main("replay", cut, "--structure", site.watch, "--out", tmp_path)
    assert_ok(done)
    (warning,) = done.stderr.splitlines()
    assert warning.startswith("warning: ") and "cut.mcap" in warning
    assert 1 <= len(lines_of(tmp_path)) < 37


def test_replay_at_a_multiple_of_real_time_takes_its_time(site: Site, plain: tuple[Done, Path], tmp_path: Path) -> None:
    arguments = ("--structure", site.quick, "--out", tmp_path, "--speed", "40")
    assert_ok(site.main("replay", site.folder / "plain.mcap", *arguments))
    summary = summary_of(tmp_path)
    assert 10 < summary["realtime_factor"] <= 40.1
    assert (tmp_path / "results.jsonl").read_bytes() == (plain[1] / "results.jsonl").read_bytes()


def test_replay_does_not_wait_for_the_time_between_recordings(site: Site, tmp_path: Path) -> None:
    """Two recordings of 60 s, 90 days apart, at 120 times real time."""
    apart_ns = 90 * 86400 * 10**9
    files = [site.write(f"part{k}.mcap", site.values(60), t0_ns=T0_NS + k * apart_ns) for k in (0, 1)]
    begun = time.monotonic()
    assert_ok(site.main("replay", *files, "--structure", site.quick, "--out", tmp_path, "--speed", "120"))
    assert 120.0 / 120.0 <= time.monotonic() - begun < 60.0
    summary = summary_of(tmp_path)
    assert (summary["windows"], summary["skipped"]) == (18, 0)


# --- bad recordings ---


def _mutilated(site: Site, how: Callable[[bytearray], bytes]) -> Path:
    path = site.folder / "bad.mcap"
    path.write_bytes(how(bytearray((site.folder / "plain.mcap").read_bytes())))
    return path


def _flip(data: bytearray) -> bytes:
    data[len(data) // 2] ^= 4
    return bytes(data)


def _unknown_unit(site: Site) -> Path:
    path = site.folder / "unit.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema(codec.SCHEMA_NAME, "protobuf", codec.SCHEMA_BYTES)
        channel = writer.register_channel(ACCELERATION, "protobuf", schema)
        for block in site.cut(site.values(30), RATE, [200]):
            data = codec.encode(block).replace(b"m/s^2", b"m/s^3")
            writer.add_message(channel, block.t_ns, data, block.t_ns)
        writer.finish()
    return path


def _text(site: Site) -> Path:
    path = site.folder / "text.mcap"
    path.write_text("time,a1,a2,a3\n0,0,0,0\n")
    return path


def _ground_only(site: Site) -> Path:
    path = site.folder / "ground.mcap"
    with McapWriter(path) as writer:
        for block in site.cut(site.values(30)[:, :1], RATE, [200], channels=("ground",)):
            writer.write(type(block)(GROUND, *(getattr(block, n) for n in block.__slots__[1:])))
    return path


BAD_RECORDINGS: dict[str, tuple[Callable[[Site], Path], tuple[str, ...]]] = {
    "empty": (lambda s: _mutilated(s, lambda _: b""), ("bad.mcap", "empty")),
    "cut before the first block": (lambda s: _mutilated(s, lambda d: bytes(d[:400])), ("bad.mcap",)),
    "bit flipped": (lambda s: _mutilated(s, _flip), ("bad.mcap", "damaged at byte")),
    "foreign, controlled": (lambda s: ROS2 / "controlled_data_0.mcap", ("controlled_data_0.mcap", "/acceleration")),
    "foreign, uncontrolled": (lambda s: ROS2 / "uncontrolled_data_0.mcap", ("uncontrolled_data_0.mcap", "import")),
    "text": (_text, ("text.mcap", "no MCAP file", "import")),
    "unknown unit": (_unknown_unit, ("unit.mcap", "m/s^3", "m/s^2")),
    "no acceleration": (_ground_only, ("ground.mcap", "/acceleration")),
    "missing channel": (
        lambda s: s.write("two.mcap", s.values(30)[:, :2], channels=("a1", "a2")),
        ("two.mcap", "a3", "a1, a2"),
    ),
    "nothing finite": (lambda s: s.write("void.mcap", np.full((6000, 3), np.nan)), ("void.mcap", "finite")),
    "one block": (lambda s: s.write("short.mcap", s.values(1)), ("short.mcap", "1.0 s", "20 s")),
    "just too short": (lambda s: s.write("short.mcap", s.values(19.99)), ("short.mcap", "20 s", "window_s")),
}


@pytest.mark.parametrize("case", BAD_RECORDINGS)
def test_bad_recordings_get_one_message_and_leave_nothing(
    site: Site, plain: tuple[Done, Path], case: str, tmp_path: Path
) -> None:
    make, words = BAD_RECORDINGS[case]
    bad = make(site)
    for command in ("replay", "calibrate"):
        assert_refused(site.main(command, bad, "--structure", site.quick, "--out", tmp_path / "out"), {65}, *words)
        assert tree(tmp_path) == {}


def test_a_failed_replay_leaves_the_files_of_an_earlier_one(site: Site, tmp_path: Path) -> None:
    good = site.write("good.mcap", site.values(25))
    assert_ok(site.main("replay", good, "--structure", site.quick, "--out", tmp_path))
    before = tree(tmp_path)
    short = site.write("tiny.mcap", site.values(3))
    assert_refused(site.main("replay", short, "--structure", site.quick, "--out", tmp_path), {65}, "3.0 s")
    assert tree(tmp_path) == before


def test_calibrate_on_noise_alone_says_which_recording_and_why(site: Site, tmp_path: Path) -> None:
    noise = site.write("noise.mcap", np.random.default_rng(0).normal(size=(6000, 3)))
    done = site.main("calibrate", noise, "--structure", site.quick, "--out", tmp_path / "b.json")
    assert_refused(done, {65}, "noise.mcap", "spectral flatness")
    assert tree(tmp_path) == {}


def test_a_gap_that_leaves_too_little_is_not_blamed_on_the_recordings_length(site: Site, tmp_path: Path) -> None:
    """28 s recorded, but the last 14 s are not finite: "record longer" would be no help."""
    values = site.values(28)
    values[2800:] = np.nan
    done = site.main("replay", site.write("half.mcap", values), "--structure", site.quick, "--out", tmp_path / "o")
    assert_refused(done, {65}, "half.mcap", "20 s")
    assert "28.0 s of data" not in done.stderr


# --- missing files, directories, places that cannot be written ---


@pytest.mark.parametrize("kind", ["missing", "directory"])
@pytest.mark.parametrize(
    "command",
    [
        "replay BAD --structure TOML --out OUT",
        "replay REC --structure BAD --out OUT",
        "replay REC --structure TOML --baseline BAD --out OUT",
        "replay REC BAD --structure TOML --out OUT",
        "simulate --structure BAD --out OUT",
        "calibrate REC --structure BAD --out OUT",
    ],
)
def test_missing_files_and_directories_are_66(site: Site, command: str, kind: str, tmp_path: Path) -> None:
    bad = tmp_path / "nowhere.mcap" if kind == "missing" else site.folder
    names = {"BAD": bad, "REC": site.healthy, "TOML": site.quick, "OUT": tmp_path / "out"}
    assert_refused(site.main(*(names.get(word, word) for word in command.split())), {66}, str(bad))
    assert tree(tmp_path) == {}


@pytest.mark.parametrize(
    ("command", "place"),
    [
        ("replay REC", "file"),
        ("replay REC", "file/deeper"),
        ("simulate --duration 5", "folder"),
        ("simulate --duration 5", "file/deeper"),
        ("calibrate REC", "folder"),
        ("calibrate REC", "file/deeper"),
    ],
)
def test_an_output_that_cannot_be_is_refused(site: Site, command: str, place: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    given = [site.write("good.mcap", site.values(25)) if word == "REC" else word for word in command.split()]
    done = site.main(*given, "--structure", site.quick, "--out", tmp_path / place)
    assert_refused(done, {66}, str(tmp_path / place))
    assert (tmp_path / "file").read_text() == "mine"
    assert list(tree(tmp_path)) == ["file"]


@pytest.mark.parametrize("name", ["results.jsonl", "results.mcap", "live.rrd", "summary.json"])
def test_a_result_whose_place_is_taken_by_a_folder_is_refused(site: Site, name: str, tmp_path: Path) -> None:
    short = site.write("good.mcap", site.values(25))
    (tmp_path / name).mkdir()
    done = site.main("replay", short, "--structure", site.quick, "--out", tmp_path)
    if name == "live.rrd" and done.returncode == 0:
        assert "live.rrd" in done.stderr, "a view may fail, but not in silence"
    else:
        assert_refused(done, {66}, name)
    assert not [p for p in tree(tmp_path) if p.endswith(".part")]


# --- bad configurations and baselines ---


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[structure]", "[structure", ("not a TOML file", "line 2")),
        ("0.3253", "-0.3253", ("structure.masses_kg.0",)),
        ("hop_s", "hops", ("processing.hops",)),
    ],
)
@pytest.mark.parametrize("command", ["check", "replay", "calibrate", "simulate"])
def test_a_bad_structure_file_is_78_in_every_command(
    site: Site, command: str, old: str, new: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    bad = site.folder / "bad.toml"
    bad.write_text(site.quick.read_text().replace(old, new, 1))
    recording = [site.healthy] if command in ("replay", "calibrate") else []
    arguments = [bad] if command == "check" else [*recording, "--structure", bad, "--out", tmp_path / "o"]
    assert_refused(site.main(command, *arguments), {78}, "bad.toml", *words)
    assert tree(tmp_path) == {}


def test_check_lists_every_problem_at_once(site: Site) -> None:
    bad = site.folder / "worse.toml"
    text = site.quick.read_text().replace("0.3253", "-1").replace("hop_s = 5.0", "hop_s = -1\ncolour = 3")
    bad.write_text(text + "\n[alarms]\n")
    done = site.main("check", bad)
    assert_refused(done, {78}, "masses_kg.0", "hop_s", "colour", "alarms")
    assert done.stderr.count("worse.toml") == 4


def test_check_of_a_good_file_tells_its_frequencies(site: Site) -> None:
    done = site.main("check", site.quick)
    assert_ok(done)
    assert "no problems" in done.stdout and "5.2, 16.3, 23 Hz" in done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("story", "words"),
    [
        ("290945.11", ("cutoff_hz = 40",)),
        ("29.094511", ("lags of 0.2 s", "rate_hz = 65, cutoff_hz = 26", "block_rows = 22")),
    ],
)
def test_check_warns_of_modes_beyond_the_band(site: Site, story: str, words: tuple[str, ...]) -> None:
    other = site.folder / "other.toml"
    other.write_text(site.quick.read_text().replace("2909.4511", story))
    done = site.main("check", other)
    assert_ok(done)
    assert done.stderr.startswith("warning: ") and all(w in done.stderr for w in words), done.stderr


def _changed(site: Site, **changes: object) -> str:
    return json.dumps({**json.loads(site.baseline.read_text()), **changes})


BAD_BASELINES: dict[str, Callable[[Site], str]] = {
    "empty": lambda s: "",
    "cut": lambda s: s.baseline.read_text()[:500],
    "a list": lambda s: "[]",
    "null": lambda s: "null",
    "another object": lambda s: '{"format": 1}',
    "a later format": lambda s: _changed(s, format=99),
    "words for numbers": lambda s: _changed(s, z=["a", "b"]),
    "ragged": lambda s: _changed(s, z_covariance=[[1.0], [1.0, 2.0]]),
    "one stiffness less": lambda s: _changed(s, stiffness_n_per_m=[1000.0, 1000.0]),
    "a negative mass": lambda s: _changed(s, masses_kg=[-0.3, 0.3, 0.3]),
    "not a number": lambda s: _changed(s, stiffness_n_per_m=[float("nan"), 1000.0, 1000.0]),
    "a short misfit": lambda s: _changed(s, misfit=[0.0]),
    "another covariance": lambda s: _changed(s, z_covariance=[[1.0]]),
    "modes that the model has not": lambda s: _changed(s, model_mode=[0, 1, 7]),
    "gauges that are no channel": lambda s: _changed(s, gauges=[0, 1, 7]),
    "fractions for channels": lambda s: _changed(s, gauges=[0.5, 1, 2]),
    "a key of nobody's": lambda s: _changed(s, colour="red"),
}


@pytest.mark.parametrize("case", BAD_BASELINES)
def test_a_corrupted_baseline_is_65(site: Site, case: str, tmp_path: Path) -> None:
    bad = site.folder / "bad.json"
    bad.write_text(BAD_BASELINES[case](site))
    arguments = ("--structure", site.watch, "--baseline", bad, "--out", tmp_path / "out")
    assert_refused(site.main("replay", site.healthy, *arguments), {65}, "bad.json")
    assert tree(tmp_path) == {}


FOUR_STORIES = {
    "masses_kg = [0.3253, 0.3514, 0.3129]": "masses_kg = [0.3253, 0.3514, 0.3129, 0.3129]",
    "stiffness_n_per_m = [2909.4511, 1514.8507, 1897.6986]": "stiffness_n_per_m = [2909.4511, 1514.8507, 1897.6986, 1897.6986]",
    "story_heights_m = [0.093, 0.093, 0.1]\n": "",
}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({'channel = "a3"': 'channel = "a4"'}, ("channel a3 (floor 3) is there and not here", "a4 (floor 3) is here")),
        ({'[[sensors]]\nchannel = "a3"\nfloor = 3\n': ""}, ("channel a3 (floor 3) is there and not here",)),
        ({'channel = "a1"\nfloor = 1': 'channel = "a1"\nfloor = 2'}, ("channel a1 is on floor 1 there and on floor 2 here",)),
        (FOUR_STORIES, ("3 masses and 3 stiffnesses there, 4 and 4 here",)),
        ({"[processing]": "[processing]\nrate_hz = 90.0"}, ("rate_hz is 100.0 there and 90.0 here",)),
        ({"[processing]": "[processing]\ncutoff_hz = 35.0"}, ("cutoff_hz is 40.0 there and 35.0 here",)),
        ({"0.3514": "0.84"}, ("floor 2 weighs 0.3514 kg there and 0.84 kg here", "--rebase")),
        ({"1514.8507": "1700"}, ("story 2 is drawn with 1515 N/m there and 1700 N/m here", "--rebase")),
        ({"[alarm]": "[updating]\nuse_shapes = false\n[alarm]"}, ("use_shapes",)),
        ({"[alarm]": '[updating]\neigenvalue = "linear"\n[alarm]'}, ("eigenvalue",)),
    ],
    ids=[
        "another channel", "fewer sensors", "another floor", "more stories", "another rate", "another cutoff", "a heavier floor",
        "a stiffer story", "without shapes", "linear eigenvalues",
    ],
)  # fmt: skip
def test_a_baseline_of_another_structure_is_78_with_the_differences(
    site: Site, changes: dict[str, str], words: tuple[str, ...], tmp_path: Path
) -> None:
    """What the baseline's numbers mean must be what the structure file would measure, in every command that takes a baseline."""
    other, text = site.folder / "other.toml", site.watch.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    other.write_text(text)
    arguments = ("--structure", other, "--baseline", site.baseline, "--out", tmp_path / "out")
    for command in ("replay", "diagnose", "reprocess"):
        done = site.main(command, site.healthy, *arguments)
        assert_refused(done, {78}, "baseline.json", *words)
        assert ("--rebase" in done.stderr) == ("--rebase" in words)
    assert tree(tmp_path) == {}


def test_check_and_the_daemon_refuse_another_structures_baseline(site: Site, tmp_path: Path) -> None:
    other = tmp_path / "site.toml"
    source = '[source]\nkind = "mcap"\nfiles = ["rec.mcap"]\n'
    (tmp_path / "b.json").write_text(site.baseline.read_text())
    other.write_text(site.watch.read_text().replace("0.3514", "0.84") + f'[site]\nbaseline = "b.json"\n{source}')
    kept = tree(tmp_path)
    for command in ("check", "run"):
        assert_refused(site.main(command, other), {78}, "b.json", "floor 2 weighs 0.3514 kg there and 0.84 kg here")
    assert tree(tmp_path) == kept


def test_a_changed_drawing_is_rebased_without_recordings(site: Site, tmp_path: Path) -> None:
    """Masses 5 % larger make stiffnesses 5 % larger, since the healthy modes stay; the result belongs to the new drawing."""
    drawn, new = tmp_path / "new.toml", tmp_path / "new.json"
    text = site.watch.read_text()
    for mass in (0.3253, 0.3514, 0.3129):
        text = text.replace(str(mass), str(1.05 * mass))
    drawn.write_text(text)
    done = site.main("calibrate", "--rebase", site.baseline, "--structure", drawn, "--out", new)
    assert_ok(done)
    assert "floor 1 weighs 0.3253 kg there and 0.3416 kg here" in done.stdout and "left out" in done.stdout
    before, after = (json.loads(path.read_text()) for path in (site.baseline, new))
    for key in ("z", "z_covariance", "frequencies_hz", "level_range_m_s2", "recordings"):
        assert after[key] == before[key]
    assert after["reference"] is None and before["reference"] is not None
    np.testing.assert_allclose(after["stiffness_n_per_m"], 1.05 * np.array(before["stiffness_n_per_m"]), rtol=0.01)
    out = tmp_path / "out"
    assert_ok(site.main("replay", site.healthy, "--structure", drawn, "--baseline", new, "--out", out))
    assert {line["alarm"]["level"] for line in lines_of(out)} == {"normal"}
    assert "baseline" not in summary_of(out)["headline"]


def test_a_new_name_alone_is_a_doubt_that_rebasing_removes(site: Site, tmp_path: Path) -> None:
    text = site.watch.read_text()
    named = [tmp_path / f"{name}.toml" for name in ("north", "south")]
    for path in named:
        path.write_text(text.replace("[structure]", f'[structure]\nname = "{path.stem}"'))
    north, south = tmp_path / "north.json", tmp_path / "south.json"
    assert_ok(site.main("calibrate", "--rebase", site.baseline, "--structure", named[0], "--out", north))
    for baseline, state in ((north, "doubtful"), (south, "normal")):
        out = tmp_path / "out"
        assert_ok(site.main("replay", site.healthy, "--structure", named[1], "--baseline", baseline, "--out", out))
        summary = summary_of(out)
        assert (summary["state"] == "doubtful") == (state == "doubtful"), summary["headline"]
        assert ("is of 'north', and this is 'south'" in summary["headline"]) == (state == "doubtful")
        if state == "doubtful":
            assert_ok(site.main("calibrate", "--rebase", north, "--structure", named[1], "--out", south))
            assert json.loads(south.read_text())["reference"] == json.loads(north.read_text())["reference"]


@pytest.mark.parametrize("more", [[], ["REC", "--rebase", "BASE"]], ids=["neither", "both"])
def test_calibrate_takes_recordings_or_a_baseline(site: Site, more: list[str], tmp_path: Path) -> None:
    names = {"REC": site.healthy, "BASE": site.baseline}
    given = [names.get(word, word) for word in more]
    done = site.main("calibrate", *given, "--structure", site.watch, "--out", tmp_path / "b.json")
    assert_refused(done, {2}, "--rebase")


@pytest.mark.parametrize("factor", [9.80665, 1 / 9.80665])
def test_a_recording_in_another_unit_is_asked_about(site: Site, factor: float, tmp_path: Path) -> None:
    """g and m/s^2 differ by 9.8: that is told with a question, and never refused."""
    recording = site.write("unit.mcap", factor * site.values(240))
    out = tmp_path / "out"
    done = site.main("replay", recording, "--structure", site.watch, "--baseline", site.baseline, "--out", out)
    assert_ok(done)
    summary = summary_of(out)
    assert summary["state"] == "doubtful" and "is the unit right" in summary["headline"], summary["headline"]
    words = "stronger" if factor > 1 else "weaker"
    assert words in summary["headline"]


# --- wrong usage ---


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay"],
        ["replay", "healthy.mcap", "--structure", "quick.toml"],
        ["replay", "--structure", "quick.toml", "--out", "o"],
        ["replay", "healthy.mcap", "--structure", "quick.toml", "--out", "o", "--speed", "abc"],
        ["replay", "healthy.mcap", "--structure", "quick.toml", "--out", "o", "--speed", "0"],
        ["replay", "healthy.mcap", "--structure", "quick.toml", "--out", "o", "--speed=-1"],
        ["replay", "healthy.mcap", "--structure", "quick.toml", "--out", "o", "--colour"],
        ["calibrate", "healthy.mcap"],
        ["check"],
        ["simulate", "--out", "o.mcap"],
        ["simulate", "--structure", "quick.toml", "--out", "o.mcap", "--seed", "-1"],
        ["simulate", "--structure", "quick.toml", "--out", "o.mcap", "--duration", "long"],
        ["simulate", "--structure", "quick.toml", "--out", "o.mcap", "--duration", "-5"],
        ["simulate", "--structure", "quick.toml", "--out", "o.mcap", "--dbc", "frame.dbc"],
        ["simulate", "--structure", "quick.toml", "--out", "o.mcap", "--speed", "1.0"],
        ["fleet", "fleet.toml", "--count", "2"],
        ["dance"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_2_and_does_nothing(site: Site, arguments: list[str]) -> None:
    before = tree(site.folder)
    assert_refused(site.main(*arguments, cwd=site.folder), {2})
    assert tree(site.folder) == before


def bare(command: Callable[..., None]) -> list[str]:
    """The least that a command must be given; files that are not there."""
    hints, words = get_type_hints(command, include_extras=True), []
    for name, parameter in inspect.signature(command).parameters.items():
        if parameter.default is parameter.empty:
            info = hints[name].__metadata__[0]
            declared = [text for text in (info.default, *(info.param_decls or ())) if str(text).startswith("--")]
            option = next(iter(declared), f"--{name.replace('_', '-')}")
            words += ["1"] if isinstance(info, ArgumentInfo) else [option, "1"]
    return words


FLOATS = [
    (command, "--" + name.replace("_", "-"))
    for command in app.registered_commands
    for name, hint in get_type_hints(command.callback).items()
    if hint in (float, float | None)
]


@pytest.mark.parametrize(("command", "option"), FLOATS, ids=lambda item: item if isinstance(item, str) else "")
def test_numbers_that_are_not_finite_or_absurd_are_wrong_usage(
    main: Cli, tmp_path: Path, command: CommandInfo, option: str
) -> None:
    name = command.name or command.callback.__name__
    for value in ("nan", "inf", "-inf", "1e300", "-1e300"):
        done = main(name, *bare(command.callback), f"{option}={value}", cwd=tmp_path)
        assert_refused(done, {2}, option)


def test_every_command_with_such_numbers_is_among_them() -> None:
    assert {option for _, option in FLOATS} == {
        "--duration", "--noise", "--rate", "--level-spread", "--shelve", "--every", "--gap", "--scale", "--mass-kg",
        "--false-announcements-per-year",
    }  # fmt: skip


@pytest.mark.parametrize("speed", ["nan", "inf", "1e300", "1e-300"])
def test_no_speed_beyond_reach(main: Cli, tmp_path: Path, speed: str) -> None:
    arguments = ("--structure", "s.toml", "--to", "zenoh:peer:tcp/127.0.0.1:1:a", "--speed", speed)
    assert_refused(main("simulate", *arguments, cwd=tmp_path), {2}, "--speed")


def test_a_path_that_the_machine_refuses_is_one_message(main: Cli, tmp_path: Path) -> None:
    assert_refused(main("status", tmp_path / ("x" * 300)), {66}, "File name too long")


def test_more_than_the_memory_holds_is_one_message(site: Site, tmp_path: Path) -> None:
    arguments = ("--structure", site.quick, "--out", tmp_path / "s.mcap", "--duration", 1e8, "--rate", 1e6)
    assert_refused(site.main("simulate", *arguments), {1}, "too little memory")
    assert tree(tmp_path) == {}


@pytest.mark.system
def test_the_installed_script_gives_the_same_codes(site: Site, tmp_path: Path) -> None:
    """78, 65 for a baseline, and 2, told by the script itself."""
    bad = site.folder / "bad.toml"
    bad.write_text(site.quick.read_text().replace("0.3253", "-0.3253"))
    assert_refused(site.cli("check", bad), {78}, "bad.toml", "masses_kg.0")
    (site.folder / "bad.json").write_text("{")
    arguments = ["replay", site.healthy, "--structure", site.watch, "--out", tmp_path / "o"]
    assert_refused(site.cli(*arguments, "--baseline", site.folder / "bad.json"), {65}, "bad.json")
    assert_refused(site.cli(*arguments, "--speed", "abc"), {2}, "abc")
    assert tree(tmp_path) == {}


def test_help_names_every_command_in_full_and_version_is_a_version(cli: Cli, main: Cli) -> None:
    done = cli("--version")
    assert_ok(done)
    assert done.stdout.strip().replace(".", "").isdigit()
    done = main("--help")
    assert_ok(done)
    listed = done.stdout.partition("Commands:")[2]
    assert "..." not in listed, "a summary is cut off"
    assert all(f" {c.name or c.callback.__name__} " in listed for c in app.registered_commands if c.callback)


def test_help_keeps_what_stands_in_square_brackets(main: Cli) -> None:
    assert "[output] dir" in main("run", "--help").stdout
    assert "NAME=FILE[:COLUMN]" in main("import", "--help").stdout


# --- simulate ---


def short(site: Site, out: Path, *more: object) -> Done:
    return site.main("simulate", "--structure", site.quick, "--out", out, "--duration", 3, "--rate", 128, *more)


def samples(path: Path) -> np.ndarray:
    return np.concatenate([b.samples for b in read_recordings([path], (ACCELERATION,))])


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(site: Site, tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(paths, (5, 5, 6), strict=True):
        assert_ok(short(site, path, "--seed", seed))
    a, b, c = (path.read_bytes() for path in paths)
    assert a == b != c
    assert sorted(tree(tmp_path)) == ["a.mcap", "b.mcap", "c.mcap"]


def test_a_simulated_recording_says_what_it_holds(site: Site, tmp_path: Path) -> None:
    start = "2026-05-06T07:08:09.25+02:00"
    more = ("--excitation", "ground", "--seed", 2, "--duration", 2.5)
    assert_ok(short(site, tmp_path / "s.mcap", "--start", start, *more))
    info = recording_info(tmp_path / "s.mcap")
    assert (info.sample_rate_hz, info.duration_s, info.n_samples) == (128.0, 2.5, 320)
    assert info.channels == {ACCELERATION: ("a1", "a2", "a3"), GROUND: ("ground",)}
    assert info.t_start_ns == 1_778_044_089_250_000_000  # 05:08:09.25 UTC
    with (tmp_path / "s.mcap").open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert metadata.name == "simulated"
    assert (metadata.metadata["seed"], metadata.metadata["excitation"]) == ("2", "ground")


def test_modes_beyond_half_the_rate_are_warned_of(site: Site, tmp_path: Path) -> None:
    """They would fold into the band, where a diagnosis takes them for something that is there."""
    told = short(site, tmp_path / "s.mcap", "--rate", 40).stderr
    assert "warning" in told and "fold into the band" in told and "--rate" in told
    assert "fold" not in short(site, tmp_path / "t.mcap").stderr


def test_by_default_a_recording_lasts_1200_s_at_1024_hz(main: Cli) -> None:
    told = " ".join(main("simulate", "--help").stdout.split())
    assert "1200" in told and "1024" in told


@pytest.mark.parametrize(
    ("option", "value", "effect"),
    [
        ("--damage", "story2=0.2", ("stiffness_change", "story 2", {"relative": -0.2})),
        (
            "--effect",
            "joint_flexibility:frame:girder_to_column_ratio=10",
            ("joint_flexibility", "frame", {"girder_to_column_ratio": 10.0}),
        ),
        ("--effect", "stiffness_change:frame:relative=0.1", ("stiffness_change", "frame", {"relative": 0.1})),
    ],
)
def test_damage_and_effects_are_in_the_motion_and_in_the_metadata(
    site: Site, option: str, value: str, effect: tuple[str, str, dict[str, float]], tmp_path: Path
) -> None:
    from monitor.model import EFFECTS

    path = tmp_path / "s.mcap"
    assert_ok(short(site, path, option, value, "--seed", 4, "--noise", 0.1))
    name, location, parameters = effect
    structure = configuration.load(site.quick).model().structure
    planted = Model(structure, (EFFECTS[name].create(location, parameters),))
    motion = simulate(planted, duration_s=3.0, rate_hz=128.0, noise=0.1, seed=4)
    np.testing.assert_array_equal(samples(path), motion.floors.astype(np.float32))
    with path.open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert strict(metadata.metadata["effects"]) == [{"effect": name, "location": location, **parameters}]


def test_damage_and_effects_add_up(site: Site, tmp_path: Path) -> None:
    more = ("--damage", "story1=0.1", "--damage", "story3=0.3", "--effect", "stiffness_change:story 2:relative=0.5")
    assert_ok(short(site, tmp_path / "s.mcap", *more, "--noise", 0))
    structure = configuration.load(site.quick).model()
    planted = structure.with_stiffness(structure.structure.stiffness_n_per_m * [0.9, 1.5, 0.7])
    motion = simulate(planted, duration_s=3.0, rate_hz=128.0)
    np.testing.assert_allclose(samples(tmp_path / "s.mcap"), motion.floors, atol=1e-4 * motion.floors.std())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--damage", "story4=0.1"], ("story 4",)),
        (["--damage", "story1=1.0"], ("story1=1.0",)),
        (["--damage", "story1=-0.1"], ("story1=-0.1",)),
        (["--damage", "story1=nan"], ("story1=nan",)),
        (["--damage", "roof=0.1"], ("roof=0.1", "storyN=LOSS")),
        (["--effect", "magic:frame:strength=1"], ("magic", "joint_flexibility")),
        (["--effect", "joint_flexibility:story 1:girder_to_column_ratio=1"], ("story 1",)),
        (["--effect", "joint_flexibility:frame:girder_to_column_ratio=much"], ("girder_to_column_ratio=much",)),
        (["--effect", "joint_flexibility:frame:girder_to_column_ratio=nan"], ("girder_to_column_ratio",)),
        (["--effect", "joint_flexibility:frame"], ("girder_to_column_ratio",)),
        (["--effect", "joint_flexibility"], ("joint_flexibility",)),
        (["--effect", "stiffness_change:story 1:relative=-1"], ("relative",)),
        (["--damage", "story1=0.6", "--damage", "story1=0.6"], ("story 1",)),
        (["--excitation", "earthquake"], ("earthquake", "ambient")),
        (["--start", "yesterday"], ("yesterday",)),
        (["--start", "1960-01-01T00:00:00"], ("1960",)),
    ],
    ids=lambda item: " ".join(item) if isinstance(item, list) else "",
)
def test_what_cannot_be_simulated_is_refused(
    site: Site, arguments: list[str], words: tuple[str, ...], tmp_path: Path
) -> None:
    assert_refused(short(site, tmp_path / "s.mcap", *arguments), {2, 78}, *words)
    assert tree(tmp_path) == {}


def test_a_recording_without_a_single_sample_is_refused(site: Site, tmp_path: Path) -> None:
    done = site.simulate(tmp_path / "s.mcap", "--duration", 0.01, "--rate", 1)
    assert_refused(done, {2, 78}, "duration")
    assert tree(tmp_path) == {}


# --- outputs never take the place of inputs; what was not judged is not called healthy ---


@pytest.mark.parametrize(
    ("command", "written"),
    [
        ("replay IN --structure IN --baseline IN --out DIR", "summary.json"),
        ("calibrate IN --structure IN --out FILE", "b.json"),
        ("simulate --structure IN --to zenoh:peer:tcp/127.0.0.1:1:a --dbc IN --out FILE", "r.mcap"),
        ("import IN IN --dbc IN --out FILE", "r.mcap"),
        ("diagnose IN --structure IN --baseline IN --out DIR", "diagnosis.json"),
        ("accept IN --structure IN --baseline IN --out FILE", "s.toml"),
        ("export IN --out FILE", "t.csv"),
        ("reprocess IN --structure IN --baseline IN --out DIR", "surveys.json"),
        ("fleet IN --out FILE", "v.rrd"),
    ],
)
def test_no_command_writes_over_what_it_reads_however_it_is_spelled(
    main: Cli, tmp_path: Path, command: str, written: str
) -> None:
    places = {"FILE": tmp_path / written, "DIR": tmp_path}
    (tmp_path / "deep").mkdir()
    (tmp_path / written).write_text("mine")
    for victim in range(command.count("IN")):
        inputs = [tmp_path / f"input{k}" for k in range(command.count("IN"))]
        inputs[victim] = tmp_path / "deep" / ".." / written
        names = iter(inputs)
        done = main(*(next(names) if word == "IN" else places.get(word, word) for word in command.split()))
        assert (done.returncode, done.stdout) == (2, ""), done.stderr
        assert f"{tmp_path / written} is an input of this command" in done.stderr
        assert (tmp_path / written).read_text() == "mine"
        assert list(tree(tmp_path)) == [written]


def test_a_replay_that_judged_nothing_says_so_and_why(site: Site, tmp_path: Path) -> None:
    values = np.zeros_like(site.values(25))
    done = site.main("replay", site.write("dead.mcap", values), "--structure", site.quick, "--out", tmp_path / "o")
    assert done.returncode == 0
    assert "no reading changes: the logger is dead, or nothing moves by the channels' resolution" in done.stdout
    assert "no alarm" not in done.stdout
    summary = summary_of(tmp_path / "o")
    (why,) = summary["skip_reasons"]
    assert why.startswith("no reading changes") and summary["skip_reasons"][why] == summary["windows"]


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_replay_with_a_dead_channel_judges_the_rest_says_so_and_is_drawn(
    site: Site, tmp_path: Path, value: float
) -> None:
    values = site.values(25)
    values[:, 1] = value
    done = site.main("replay", site.write("dead.mcap", values), "--structure", site.quick, "--out", tmp_path / "o")
    assert done.returncode == 0
    assert "was not written" not in done.stderr + done.stdout
    summary = summary_of(tmp_path / "o")
    assert summary["skipped"] == 0 and [o["channel"] for o in summary["channels_left_out"]] == ["a2"]
    assert any("a2" in sentence for sentence in [summary["headline"], *summary["doubts"]])


def test_masses_in_tonnes_are_told_as_such(site: Site, tmp_path: Path, frame_text: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(frame_text.replace("masses_kg = [0.3253, 0.3514, 0.3129]", "masses_kg = [3e-4, 3e-4, 3e-4]"))
    assert_refused(site.main("check", path), {78}, "kg")
