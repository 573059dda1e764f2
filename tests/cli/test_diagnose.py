"""The commands diagnose, evaluate and accept, and the findings of a replay."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from drivers.mcap_file import scan_messages
from monitor.config import configuration
from tests.support.commands import KEYS, assert_ok, assert_refused, strict
from tests.support.samples import Cli

pytestmark = pytest.mark.engine

Done = subprocess.CompletedProcess[str]
FILES = {"diagnosis.json", "report.html", "structure.updated.toml", "structure.extended.toml", "diagnosis.rrd"}


class Site:
    """A structure file, a recording with a louder second channel, and their diagnosis."""

    def __init__(self, folder: Path, main: Cli, frame_text: str) -> None:
        self.main, self.out = main, folder / "found"
        self.structure, self.recording = folder / "s.toml", folder / "loud.mcap"
        tight = "stiffness_range_n_per_m = [[2880, 2940], [1500, 1530], [1880, 1915]]\n"
        tight += "masses_range_kg = [[0.324, 0.327], [0.350, 0.353], [0.311, 0.315]]\n"
        self.structure.write_text(frame_text.replace("damping_ratio", tight + "damping_ratio") + "# the end\n")
        self.simulate(self.recording, "--effect", "sensor_gain:channel a2:gain=1.3", "--seed", 61)
        self.done = main("diagnose", self.recording, "--structure", self.structure, "--out", self.out)

    def simulate(self, out: Path, *more: object) -> Path:
        given = ("--duration", 240, "--rate", 100, "--noise", 0.03, "--structure", self.structure)
        assert_ok(self.main("simulate", "--out", out, *given, *more))
        return out

    def evaluate(self, recording: Path, structure: Path) -> dict:
        done = self.main("evaluate", recording, "--structure", structure)
        assert_ok(done)
        out = strict(done.stdout)
        assert isinstance(out, dict)
        return out


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, main: Cli, frame_text: str) -> Site:
    return Site(tmp_path_factory.mktemp("diagnose"), main, frame_text)


@pytest.mark.representative
def test_a_wrong_gain_is_named_and_five_files_are_left(site: Site) -> None:
    assert_ok(site.done)
    assert {p.name for p in site.out.iterdir()} == FILES
    found = strict((site.out / "diagnosis.json").read_text())
    assert isinstance(found, dict)
    assert found.keys() >= KEYS
    assert found["verdict"] == "named"
    assert (found["cause"]["effect"], found["cause"]["location"]) == ("sensor_gain", "channel a2")
    assert found["cause"]["parameters"]["gain"]["value"] == pytest.approx(1.3, abs=0.03)
    assert found["gain"]["log_score_per_sample"]["ci95"][0] > 0.0
    assert found["says"] in site.done.stdout


def test_the_extended_file_holds_the_cause_and_scores_better_on_new_data(site: Site, tmp_path: Path) -> None:
    updated, extended = (site.out / f"structure.{name}.toml" for name in ("updated", "extended"))
    assert "# the end" in extended.read_text()
    assert [e.name for e in configuration.load(extended).model().effects] == ["sensor_gain"]
    assert configuration.load(updated).model().effects == ()
    new = site.simulate(tmp_path / "new.mcap", "--effect", "sensor_gain:channel a2:gain=1.3", "--seed", 62)
    before, after = (site.evaluate(new, path) for path in (updated, extended))
    assert before.keys() == {"log_score_per_sample", "csd_error", "samples", "band_hz"}
    assert before["band_hz"] == after["band_hz"], "two scores on one recording may be subtracted"
    assert before["samples"] == after["samples"]
    assert after["log_score_per_sample"] > before["log_score_per_sample"]
    assert after["csd_error"] < before["csd_error"]


def test_without_a_baseline_a_softer_story_is_the_headline_before_the_verdict(
    site: Site, tmp_path: Path, frame_text: str
) -> None:
    """The refit takes up a loss of 20 %, so the verdict is `none`: the model explains the data, as refitted."""
    site.structure, before = tmp_path / "open.toml", site.structure
    site.structure.write_text(frame_text)
    try:
        soft = site.simulate(tmp_path / "soft.mcap", "--damage", "story2=0.2", "--seed", 63)
    finally:
        site.structure = before
    out = tmp_path / "found"
    done = site.main("diagnose", soft, "--structure", tmp_path / "open.toml", "--out", out)
    assert_ok(done)
    found = strict((out / "diagnosis.json").read_text())
    assert isinstance(found, dict)
    assert found["verdict"] == "none"
    row = found["refit"][1]
    assert (row["location"], row["beyond_tolerance"], row["tolerance"]) == ("story 2", True, None)
    assert row["relative"] == pytest.approx(-0.2, abs=3.0 * row["relative_std"]) and row["relative_std"] < 0.1
    assert (
        found["says"].startswith("Story 2 from the top is ") and "softer than drawn" in found["says"].partition(";")[0]
    )
    assert found["says"].endswith("without a baseline nothing is said of damage.")
    assert "refitted: story 2 from the top is" in done.stdout and "Nothing wrong" not in done.stdout


def test_accepting_writes_the_file_and_the_ledger(site: Site, tmp_path: Path) -> None:
    out = tmp_path / "accepted.toml"
    finding = site.out / "diagnosis.json"
    assert_ok(site.main("accept", finding, "--structure", site.structure, "--out", out, "--by", "A. Person"))
    assert out.read_text() == (site.out / "structure.extended.toml").read_text()
    (line,) = [json.loads(text) for text in (tmp_path / "ledger.jsonl").read_text().splitlines()]
    assert line["who"] == "A. Person"
    assert line["causes"][0]["effect"] == "sensor_gain"
    assert set(line["files"]) == {"finding", "structure", "out"}
    assert all(len(entry["sha256"]) == 64 for entry in line["files"].values())
    assert_ok(site.main("accept", finding, "--structure", site.structure, "--out", out))
    assert len((tmp_path / "ledger.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"verdict": "ambiguous"}, ("ambiguous", "no cause to accept")),
        ({"verdict": None}, ("no cause to accept",)),
        ({"model": {}}, ("not a finding of this structure",)),
        ({"causes": [{"effect": "sensor_gain", "location": "channel b9", "parameters": {}}]}, ("not a finding",)),
    ],
)
def test_only_a_named_cause_of_this_structure_is_accepted(
    site: Site, tmp_path: Path, change: dict, words: tuple[str, ...]
) -> None:
    finding = tmp_path / "finding.json"
    finding.write_text(json.dumps({**json.loads((site.out / "diagnosis.json").read_text()), **change}))
    done = site.main("accept", finding, "--structure", site.structure, "--out", tmp_path / "out.toml")
    assert_refused(done, {65}, "finding.json", *words)
    assert [p.name for p in tmp_path.iterdir()] == ["finding.json"]


def test_inputs_are_checked_before_anything_is_written(site: Site, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "out")
    given = ("--structure", site.structure)
    short = site.simulate(tmp_path / "short.mcap", "--duration", 30)
    assert_refused(site.main("diagnose", tmp_path / "no.mcap", *given, *out), {66}, "no.mcap")
    assert_refused(site.main("diagnose", site.recording, *given, "--baseline", tmp_path / "b", *out), {66})
    assert_refused(site.main("diagnose", short, *given, *out), {65}, "short.mcap", "30 s", "at least")
    assert_refused(site.main("evaluate", short, *given), {65}, "short.mcap")
    assert_refused(site.main("evaluate", site.recording, "--structure", tmp_path / "no.toml"), {66}, "no.toml")
    done = site.main("accept", tmp_path / "no.json", *given, "--out", tmp_path / "s.toml")
    assert_refused(done, {66}, "no.json")
    own = site.main("accept", site.out / "diagnosis.json", *given, "--out", site.structure)
    assert own.returncode == 2
    assert "name another place" in own.stderr
    assert not [p for p in tmp_path.rglob("*") if p.is_file() and p.name != "short.mcap"]


@pytest.mark.slow
def test_an_alarm_of_a_replay_carries_the_verdict(tmp_path: Path, main: Cli, frame_text: str) -> None:
    structure = tmp_path / "s.toml"
    slow = frame_text.replace("window_s = 20.0", "window_s = 100.0").replace("block_rows = 10", "block_rows = 20")
    structure.write_text(slow + "\n[watch]\nlongest_s = 300.0\n")

    def simulated(name: str, *more: object) -> Path:
        given = ("--rate", 100, "--noise", 0.03, "--structure", structure)
        assert_ok(main("simulate", "--out", tmp_path / name, *given, *more))
        return tmp_path / name

    healthy = simulated("h.mcap", "--duration", 600, "--seed", 1)
    first = simulated("1.mcap", "--duration", 200, "--seed", 2)
    second = ("--start", "2026-01-01T00:03:20", "--damage", "story2=0.12")
    after = simulated("2.mcap", "--duration", 400, "--seed", 3, *second)
    baseline = tmp_path / "b.json"
    assert_ok(main("calibrate", healthy, "--structure", structure, "--out", baseline))
    told = []
    for out in (tmp_path / "one", tmp_path / "two"):
        given = ("--structure", structure, "--baseline", baseline, "--out", out)
        assert_ok(main("replay", first, after, *given))
        summary = json.loads((out / "summary.json").read_text())
        (finding,) = summary["findings"]
        assert finding["verdict"] == "named"
        assert (finding["causes"][0]["effect"], finding["causes"][0]["location"]) == ("stiffness_change", "story 2")
        assert summary["alarms"][0]["verdict"] == finding["says"]
        topics = [json.loads(data) for topic, _, data in scan_messages(out / "results.mcap") if topic == "/findings"]
        assert topics == [json.loads((out / "findings" / "001.json").read_text())]
        told.append(topics)
    assert told[0] == told[1]
    extended = tmp_path / "extended.toml"
    given = ("--structure", structure, "--baseline", baseline, "--out", extended)
    assert_ok(main("accept", tmp_path / "one" / "findings" / "001.json", *given))
    out = tmp_path / "accepted"
    assert_ok(main("replay", first, after, "--structure", extended, "--baseline", baseline, "--out", out))
    last = json.loads((out / "results.jsonl").read_text().splitlines()[-1])
    assert abs(last["ddi"][1]) < 0.02  # the loss is known by now
