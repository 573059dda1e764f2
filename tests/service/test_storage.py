"""One budget for the whole output folder, and closed months of results that are read as before."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from drivers.base import SampleBlock
from drivers.settings import RecorderSettings
from monitor.config import OutputSettings
from monitor.publish import closed_files, month_file, pack_month, read_lines, read_period
from monitor.runs import Session
from monitor.service import restart
from monitor.service.storage import ResultsFile, Storage
from monitor.service.threads import Recording
from tests.service.killed import killed
from tests.support.full_disk import no_room
from tests.support.samples import Cli, Cut
from tests.support.site import RATE, Daemon, Scripted, all_lines, replayed, write

S = 10**9
TURN_NS = 1_769_904_000 * S
"""2026-02-01, UTC."""
Blocks = Callable[[float], list[SampleBlock]]


@pytest.fixture
def blocks(record: np.ndarray, cut: Cut) -> list[SampleBlock]:
    """Two minutes, the middle of which is the turn of the month."""
    return cut(np.concatenate([record, record]), RATE, t0_ns=TURN_NS - 60 * S)


@pytest.fixture
def monthly(site: Path) -> Path:
    site.write_text(site.read_text().replace('dir = "out"', 'dir = "out"\npack_months = true'))
    return site


def storage_of(daemon: Daemon) -> Storage:
    return cast(Storage, dict(daemon.outputs())["storage"])


def run(path: Path, script: Sequence[SampleBlock]) -> Path:
    daemon = Daemon(path, Scripted(script))
    daemon.run()
    storage_of(daemon).tidy()
    return path.parent / "out"


def test_a_closed_month_is_packed_and_read_as_before(monthly: Path, blocks: list[SampleBlock], main: Cli) -> None:
    out = run(monthly, blocks)
    assert [path.name for path in closed_files(out)] == ["results-2026-01.jsonl.zst"]
    whole = replayed(main, monthly, [write(monthly.parent / "rec.mcap", blocks)], monthly.parent / "again")
    assert b"".join(all_lines(out)) == whole
    now = (out / "results.jsonl").read_bytes()
    assert whole.endswith(now) and b"".join(read_lines(closed_files(out)[0])) + now == whole
    ends = [json.loads(line)["t_end_ns"] for line in now.splitlines()]
    assert min(ends) >= TURN_NS and len(ends) < whole.count(b"\n")
    one, two = (read_period(folder, None, None).results for folder in (out, monthly.parent / "again"))
    assert (one.course, one.judged, one.begun_ns, one.hop_s) == (two.course, two.judged, two.begun_ns, two.hop_s)
    for folder in (out, monthly.parent / "again"):
        (folder / "state").mkdir(exist_ok=True)
        done = main("report", folder, "--out", monthly.parent / "page.html", "--json")
        assert json.loads(done.stdout)["windows"] == whole.count(b"\n")
    assert main("export", out, "--out", monthly.parent / "w.csv").stdout.startswith(f"{whole.count(b'%c' % 10)} rows")


def test_without_the_setting_all_months_stay_in_one_file(site: Path, blocks: list[SampleBlock]) -> None:
    out = run(site, blocks)
    assert not closed_files(out) and (out / "results.jsonl").read_bytes().count(b"\n") > 20


@pytest.mark.parametrize(
    ("at_s", "saved"), [(58.0, 3), (58.0, 8), (66.0, 7), (66.0, 9), (71.0, 3), (71.0, 8), (90.0, 7), (90.0, 9)]
)
def test_a_restart_at_the_turn_of_the_month_writes_each_window_once(
    monthly: Path, blocks: list[SampleBlock], at_s: float, saved: int
) -> None:
    """The latest checkpoint is that of a certain number of windows, as after kill -9."""
    cut_at = sum(b.t_ns < TURN_NS + (at_s - 60.0) * S for b in blocks)

    def took(keeper: restart.Checkpointer, session: Session, block: SampleBlock) -> None:
        if session.windows == saved and not keeper.busy:
            keeper.save(session)

    with killed() as patch:
        patch.setattr(restart.Checkpointer, "took", took)
        out = run(monthly, blocks[:cut_at])
    run(monthly, blocks[cut_at:])
    windows = [json.loads(line)["window"] for line in all_lines(out)]
    assert windows == list(range(len(windows))) and len(windows) > 20


def test_results_that_were_moved_away_do_not_keep_it_from_starting(site: Path, blocks: list[SampleBlock]) -> None:
    out = site.parent / "out"
    half = len(blocks) // 2
    with killed():
        Daemon(site, Scripted(blocks[:half])).run()
    before = (out / "results.jsonl").read_bytes()
    os.replace(out / "results.jsonl", out / "results-old.jsonl")
    (out / "ledger.jsonl").write_text('{"what": "old"}\n')
    os.replace(out / "ledger.jsonl", out / "ledger-old.jsonl")
    Daemon(site, Scripted(blocks[half:])).run()
    windows = [json.loads(line)["window"] for line in (out / "results.jsonl").read_bytes().splitlines()]
    assert windows and windows[-1] > before.count(b"\n") and windows == sorted(set(windows))


def test_a_month_is_packed_once_and_goes_on_if_its_time_comes_again(tmp_path: Path) -> None:
    place = month_file(tmp_path, TURN_NS - 1)
    assert place.name == "results-2026-01.jsonl"
    for text in (b"1\n2\n", b"3\n"):
        place.write_bytes(text)
        pack_month(place)
    (packed,) = closed_files(tmp_path)
    place.write_bytes(b"3\n")  # the power went between packing and removing
    pack_month(place)
    assert list(read_lines(packed)) == [b"1\n", b"2\n", b"3\n"] and not place.exists()


def test_a_month_that_ends_while_the_disk_refuses_lines_is_closed_later(tmp_path: Path) -> None:
    file = ResultsFile(tmp_path / "results.jsonl", by_month=True)

    def line(k: int) -> tuple[str, int]:
        t_ns = TURN_NS + (k - 3) * S
        return json.dumps({"t_end_ns": t_ns, "window": k}), t_ns

    with no_room():
        for k in range(2, 4):
            file.write_window(*line(k))
    file.flush()
    for k in range(4, 6):
        file.write_window(*line(k))
    file.close()
    assert [json.loads(text)["window"] for text in all_lines(tmp_path)] == [2, 3, 4, 5]


def fill(out: Path, files: dict[str, int]) -> None:
    for name, size in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(b"x" * size)


@pytest.mark.parametrize(
    ("keep", "left", "closed", "says"),
    [(10_000, 10_000 - 4_600, 2, None), (4_000, 4_000 - 3_600, 1, None), (1_000, 0, 0, "without recordings, keep_gb")],
)
def test_recordings_go_first_then_closed_months_and_what_does_not_fit_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: int, left: int, closed: int, says: str | None
) -> None:
    given: list[int] = []
    monkeypatch.setattr(Recording, "limit", lambda _, most: given.append(most))
    recording = Recording(tmp_path / "recordings", RecorderSettings(min_free_gb=0.0))
    fill(tmp_path, {"recordings/20260101T000000.000000Z-0001.mcap": 5000, "results-2026-01.jsonl.zst": 1000})
    fill(tmp_path, {"results-2026-02.jsonl.zst": 1000, "results.jsonl": 2000, "state/history.db": 600})
    storage = Storage(tmp_path, OutputSettings(keep_gb=keep / 2**30), recording)
    storage.tidy()
    recording.close(5.0)
    assert given == [left] and len(closed_files(tmp_path)) == closed
    assert storage.failed is None if says is None else says in str(storage.failed)


def test_the_whole_folder_stays_within_its_budget(site: Path, record: np.ndarray, cut: Cut) -> None:
    text = site.read_text().replace('dir = "out"', f'dir = "out"\nkeep_gb = {1_000_000 / 2**30}')
    site.write_text(text.replace("[recorder]", "[recorder]\nfile_s = 30.0\nflush_s = 1.0"))
    blocks = cut(np.tile(record, (20, 1)), RATE, [1280])
    fill(site.parent / "out", {"findings/old.json": 600_000})
    daemon = Daemon(site, Scripted(blocks))
    storage_of(daemon).tidy()
    daemon.run()
    out = site.parent / "out"
    total = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    recordings = sum(path.stat().st_size for path in (out / "recordings").iterdir())
    assert json.loads((out / "health.jsonl").read_text().splitlines()[-1])["recorder"]["removed_files"] > 0
    others = total - recordings
    assert recordings < 450_000 < 600_000 < others, "recordings have what the rest left of the budget"
