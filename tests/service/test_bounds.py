"""What a sender on an open bus may cost: rows, lines and disk stay within bounds, and what is refused is counted."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import SampleBlock
from monitor.service.status import look, tell
from tests.service.killed import killed
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.site import RATE, Daemon, Scripted, lines, own, replayed

ZENOH = 'kind = "zenoh"\nkey = "a/b"\nmode = "peer"\nlisten = ["tcp/127.0.0.1:0"]'


def scraps(number: int) -> list[SampleBlock]:
    """Blocks of two samples, each with a gap of eight before it."""
    values = np.random.default_rng(0).normal(size=(2, 3)).astype(np.float32)
    return [
        SampleBlock(
            "/acceleration", T0_NS + round(k * 10 / RATE * 1e9), 10 * k, RATE, ("a1", "a2", "a3"), "m/s^2", values
        )
        for k in range(number)
    ]


def gaps(out: Path) -> int:
    with closing(sqlite3.connect(out / "state" / "history.db")) as database:
        return int(database.execute("SELECT count(*) FROM gaps").fetchone()[0])


def test_scraps_with_gaps_between_them_fill_no_database(site: Path) -> None:
    Daemon(site, Scripted(scraps(3000))).run()
    assert gaps(site.parent / "out") == 1


def test_a_stream_faster_than_max_pace_is_cut_counted_and_told(
    site: Path, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    """An hour of data at once brings ten minutes of windows."""
    text = site.read_text().replace('kind = "mcap"\nfiles = ["rec.mcap"]', f"{ZENOH}\nmax_pace = 2.0")
    site.write_text(text)
    blocks = cut(np.tile(record, (60, 1)), RATE, [1280])
    Daemon(site, Scripted(blocks)).run()
    out = site.parent / "out"
    last_s = (lines(out)[-1]["t_end_ns"] - T0_NS) * 1e-9
    assert 500.0 < last_s < 900.0, "ten minutes at once, and two seconds for each of this run"
    found = look(out)
    refused = found["health"]["refused"]
    assert refused["blocks"] == json.loads((out / "summary.json").read_text())["refused_blocks"] > 250
    assert "max_pace = 2" in refused["latest"] and f"{refused['blocks']} blocks refused" in tell(found)
    assert caplog.text.count("a block is refused") == 1


def test_blocks_of_another_century_are_set_aside_and_the_rest_goes_on(site: Path, record: np.ndarray, cut: Cut) -> None:
    text = site.read_text().replace('kind = "mcap"\nfiles = ["rec.mcap"]', f"{ZENOH}\nmax_ahead_s = 3600.0")
    blocks = cut(record, RATE)
    site.write_text(text)
    forged = [replace(b, t_ns=4_102_444_800 * 10**9 + k * 10**9) for k, b in enumerate(blocks[:5])]
    Daemon(site, Scripted([*blocks[:20], *forged, *blocks[20:]])).run()
    out = site.parent / "out"
    assert look(out)["health"]["refused"]["blocks"] == 5
    assert len(lines(out)) == 9 and all(line["skipped"] is None for line in lines(out))
    assert not [path for path in (out / "recordings").iterdir() if path.name.startswith("2100")]


def test_a_restart_after_blocks_of_another_century_is_a_replay_of_all_recordings(
    site: Path, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    """Without bounds the stream jumps there and back; recordings are named by the right time again, and keep their order."""
    blocks = cut(np.tile(record, (5, 1)), RATE, [128])
    forged = [replace(b, t_ns=4_102_444_800 * 10**9 + k * 10**9) for k, b in enumerate(blocks[:5])]
    arrived = [*blocks[:60], *forged, *blocks[60:]]
    with killed():
        Daemon(site, Scripted(arrived[:240])).run()
    Daemon(site, Scripted(arrived[240:])).run()
    out = site.parent / "out"
    names = sorted(path.name for path in (out / "recordings").glob("*.mcap"))
    assert [name[:4] for name in names if "-c1" in name] == ["2026", "2026"]
    found = lines(out)
    assert [line["window"] for line in found] == sorted({line["window"] for line in found})
    assert sum(line["skipped"] is None for line in found[-20:]) > 10
    assert replayed(main, site, own(out), site.parent / "again") == (out / "results.jsonl").read_bytes()
