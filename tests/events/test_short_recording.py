"""A recording of an earthquake that is shorter than a window is replayed for its event; one without an event is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.events.shaken import blocks, shake
from tests.support.quake import ground, shaken
from tests.support.samples import Cli, write_blocks
from tests.support.short_quake import STRUCTURE


def test_its_event_is_told_without_a_window(tmp_path: Path, main: Cli) -> None:
    recording, site, out = tmp_path / "quake.mcap", tmp_path / "frame.toml", tmp_path / "out"
    site.write_text(STRUCTURE)
    write_blocks(recording, blocks(shaken(), n=200))
    done = main("replay", recording, "--structure", site, "--out", out)
    assert done.returncode == 0 and "0 windows" in done.stdout and "Go and look; largest acceleration" in done.stdout
    (line,) = (json.loads(row) for row in (out / "events.jsonl").read_text().splitlines())
    assert line["revision"] == 0 and line["verdict"] == "go and look"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["windows"] == 0 and summary["event_alarms"][0]["id"] == line["id"] in done.stdout
    assert main("report", out, "--event", "last").returncode == 0 and (out / "events" / f"{line['id']}.html").is_file()


def test_without_an_event_it_is_refused_as_too_short(tmp_path: Path, main: Cli) -> None:
    recording, site = tmp_path / "quiet.mcap", tmp_path / "frame.toml"
    site.write_text(STRUCTURE)
    write_blocks(recording, blocks(shake(ground(100.0), np.random.default_rng(1))[0], n=200))
    done = main("replay", recording, "--structure", site, "--out", tmp_path / "out")
    assert done.returncode == 65 and "one window takes 400 s" in done.stderr
    assert not (tmp_path / "out" / "events.jsonl").exists()
