"""The daemon: live is replay, bit for bit; what goes wrong is counted and told; it ends when asked, with whole files."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.base import GROUND, TEMPERATURE, SampleBlock, SourceError
from drivers.mcap_file import McapWriter, read_recordings
from drivers.recorder import unfit
from monitor.core import (
    AlarmCondition,
    BadConfigurationError,
    BadInputError,
    Gap,
    Level,
    MissingInputError,
    WindowResult,
)
from monitor.damage import Assessment, State
from monitor.publish import to_json
from monitor.runs import Session
from monitor.service.appended_lines import AppendedLines
from monitor.service.daemon_health import losses, plain
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.metrics import Metrics, MetricsSettings
from monitor.service.requests import Request
from monitor.service.status import look, tell, troubles_of
from monitor.service.threads import BlockQueue
from tests.support.frames import settings_of
from tests.support.full_disk import no_room
from tests.support.results import alarm, damage_reading
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.site import RATE, Daemon, Scripted, Step, health, lines, own, replayed, summary, write
from tests.support.waiting import until


def test_run_gives_what_replay_gives_of_source_and_of_own_recordings(
    site: Path, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    folder = site.parent
    recording = write(folder / "rec.mcap", cut(record, RATE))
    done = main("run", site)
    assert done.returncode == 0 and done.stderr.splitlines() == ["READY"]
    live = (folder / "out" / "results.jsonl").read_bytes()
    assert live.count(b"\n") == 9
    assert replayed(main, site, [recording], folder / "a") == live
    assert replayed(main, site, own(folder / "out"), folder / "b") == live
    told, again = summary(folder / "out"), summary(folder / "a")
    assert told["windows"] == 9
    assert told["frequencies_hz"] == pytest.approx(again["frequencies_hz"])
    assert told["quality"]["samples"] == again["quality"]["samples"]
    assert told.keys() - again.keys() == {"refused_blocks", "unprocessed_blocks", "latency_ms", "alarm"}


@pytest.mark.parametrize("sizes", [[7], [128], [1000, 3]])
def test_live_is_replay_with_losses_repeats_late_blocks_steps_of_the_clock_and_other_topics(
    site: Path, record: np.ndarray, cut: Cut, main: Cli, sizes: list[int]
) -> None:
    blocks = cut(np.concatenate([record, record]), RATE, sizes)
    third = len(blocks) // 3
    warm = np.full((1, 1), 20.0, dtype=np.float32)
    extra = [
        SampleBlock(TEMPERATURE, T0_NS + s * 10**9, s, 1.0, ("t",), "degC", warm + s / 10) for s in range(0, 100, 5)
    ]
    stepped = [replace(b, t_ns=b.t_ns - 5 * 10**9) for b in blocks[2 * third + 4 :]]
    script: list[Step] = [*blocks[:third], blocks[third - 1], blocks[third + 1], blocks[third]]
    script += [*blocks[third + 2 : 2 * third], *stepped]
    for k, item in enumerate(extra):
        script.insert(5 * k, item)
    script.insert(9, replace(blocks[0], topic=GROUND, channels=("g1", "g2", "g3")))
    Daemon(site, Scripted(script)).run()
    out = site.parent / "out"
    live = (out / "results.jsonl").read_bytes()
    assert b"gap in the data" in live and live.count(b'"skipped": null') > 3
    assert summary(out)["gaps"] >= 2 and summary(out)["dropped_samples"] > 0
    assert replayed(main, site, own(out), site.parent / "again") == live


def test_a_lost_source_is_opened_again_with_counts_kept_and_told(site: Path, record: np.ndarray, cut: Cut) -> None:
    blocks = cut(record, RATE)
    source = Scripted([*blocks[:30], SourceError("bus off"), *blocks[33:]])
    daemon = Daemon(site, source)
    daemon.run()
    out = site.parent / "out"
    assert source.opened == 2 and source.closed == 2
    assert health(out)[-1]["source"]["lost"] == 1
    assert health(out)[-1]["source"]["counts"]["blocks"] == len(blocks) - 3
    assert summary(out)["gaps"] == 1
    assert [line["skipped"] for line in lines(out)].count("gap in the data") == 5  # 23.4 to 25.8 s


def test_garbage_is_refused_and_counted_and_changes_nothing(
    site: Path, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    blocks = cut(record, RATE)
    good = blocks[20]
    wide = np.zeros((1, 20_000), dtype=np.float32)
    garbage = [
        replace(good, channels=("x", "y", "z")),
        replace(good, unit="degC"),
        replace(good, topic="/foreign"),
        replace(good, t_ns=1 << 62),
        replace(good, t_ns=-5),
        replace(good, sequence=(1 << 64) - 1),
        replace(good, sample_rate_hz=1e9),
        replace(good, sample_rate_hz=1e-9),
        replace(good, sample_rate_hz=0.5),
        replace(good, channels=tuple(f"c{k}" for k in range(20_000)), samples=wide),
        replace(good, topic=TEMPERATURE),
    ]
    empty = replace(good, samples=good.samples[:0])
    script = [garbage[4], *blocks[:20], *garbage, empty, *blocks[20:]]
    Daemon(site, Scripted(script)).run()
    out = site.parent / "out"
    live = (out / "results.jsonl").read_bytes()
    told = summary(out)
    assert told["refused_blocks"] == len(garbage) + 1
    assert len(health(out)[-1]["refused"]["latest"]) <= 300
    assert told["gaps"] == 0 and told["skipped"] == 0 and told["windows"] == 9
    assert replayed(main, site, [write(site.parent / "rec.mcap", blocks)], site.parent / "a") == live
    assert replayed(main, site, own(out), site.parent / "b") == live


def test_a_changed_rate_starts_over_and_a_forged_time_does_not_stop_it(
    site: Path, record: np.ndarray, cut: Cut, main: Cli
) -> None:
    blocks = cut(record, RATE)
    forged = replace(blocks[0], t_ns=T0_NS + 80 * 365 * 86400 * 10**9, sequence=1 << 61)
    slower = cut(record[::2], RATE / 2, t0_ns=T0_NS + 70 * 10**9)
    Daemon(site, Scripted([*blocks[:50], forged, *blocks[50:], *slower])).run()
    out = site.parent / "out"
    found = lines(out)
    ends_s = [(line["t_end_ns"] - T0_NS) / 1e9 for line in found if line["skipped"] is None]
    assert min(ends_s) == 20.0 and 125.0 <= max(ends_s) <= 130.1
    assert sum(end > 90.0 for end in ends_s) >= 7  # windows of the slower stream alone
    assert replayed(main, site, own(out), site.parent / "again") == (out / "results.jsonl").read_bytes()


def test_a_stream_faster_than_the_monitor_waits_and_loses_nothing(site: Path, record: np.ndarray, cut: Cut) -> None:
    """The reader waits, in bounded memory, while a publisher is slow."""
    most = [0]
    blocks = cut(record, RATE, [3])

    class Slow(Outlet):
        def window(self, result: WindowResult, line: str) -> None:
            time.sleep(0.1)
            most[0] = max(most[0], len(daemon.reader.queue))

    daemon = Daemon(site, Scripted(blocks), [Slow()])
    daemon.run()
    told = summary(site.parent / "out")
    assert told["quality"]["samples"] >= len(record) - round(10 * RATE) and told["gaps"] == 0
    assert told["windows"] == 9
    assert len(blocks) > 2000 and 0 < most[0] <= 1024


def test_queues_are_bounded_in_bytes_and_give_way_when_lifted() -> None:
    block = SampleBlock(GROUND, 0, 0, 1.0, ("g",), "m/s^2", np.zeros((1000, 1), np.float32))
    queue = BlockQueue(100, 10_000)
    giver = threading.Thread(target=lambda: [queue.put(block) for _ in range(5)], daemon=True)
    giver.start()
    until(lambda: len(queue) >= 2, "two fit")
    giver.join(0.1)
    assert giver.is_alive() and len(queue) == 2
    queue.lift()
    giver.join(10.0)
    assert not giver.is_alive() and len(queue) == 5
    queue.close()
    assert [queue.take(0.0) is not None for _ in range(6)] == [True] * 5 + [False]
    assert queue.over


def test_a_full_disk_stops_the_recorder_not_the_monitor(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(McapWriter, "write", full)
    Daemon(site, Scripted(cut(record, RATE))).run()
    out = site.parent / "out"
    assert len(lines(out)) == 9
    recorder = health(out)[-1]["recorder"]
    assert not recorder["recording"] and "space" in recorder["detail"]
    assert recorder["lost_blocks"] > 0


def test_lines_that_the_disk_refuses_come_when_it_takes_them_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room, really = [10_000], os.write

    def write_some(handle: int, data: bytes) -> int:
        if not room[0]:
            raise OSError(28, os.strerror(28))
        done = really(handle, data[: room[0]])
        room[0] -= done
        return done

    monkeypatch.setattr(os, "write", write_some)
    file = AppendedLines(tmp_path / "lines")
    for k in range(200):
        if k == 150:
            room[0] = 10_000
        file.write(f"{k:099d}")
        assert bool(file.failed) == (100 <= k < 150)
    file.close()
    assert [int(line) for line in (tmp_path / "lines").read_text().splitlines()] == list(range(200))
    assert file.dropped == 0


def test_lines_that_find_no_room_to_wait_are_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = AppendedLines(tmp_path / "lines", most_pending_bytes=1000)
    with no_room():
        for k in range(20):
            file.write(f"{k:099d}")
    file.close()
    assert file.dropped == 10 and len((tmp_path / "lines").read_text().splitlines()) == 10
    assert len([r for r in caplog.records if "lines are lost" in r.getMessage()]) == 1


def test_lines_roll_over_to_one_older_file(tmp_path: Path) -> None:
    file = AppendedLines(tmp_path / "lines", most_bytes=1000)
    for k in range(100):
        file.write(f"{k:099d}")
    file.close()
    kept = [int(t) for name in ("lines.1", "lines") for t in (tmp_path / name).read_text().splitlines()]
    assert kept == list(range(100 - len(kept), 100)) and 10 <= len(kept) < 30


@pytest.mark.parametrize("way", ["removed", "moved", "replaced"])
def test_lines_after_the_file_is_gone_are_in_a_file_that_exists(
    tmp_path: Path, way: str, caplog: pytest.LogCaptureFixture
) -> None:
    place, moved = tmp_path / "lines", tmp_path / "lines-old"
    file = AppendedLines(place)
    file.write("one")
    position = file.position
    place.unlink() if way == "removed" else place.rename(moved)
    if way == "replaced":
        place.write_text("made\n")
    file.write("two")
    file.write("three")
    assert file.failed == "" and file.position == place.stat().st_size
    assert place.read_text().splitlines() == [*(["made"] if way == "replaced" else []), "two", "three"]
    assert way == "removed" or moved.read_text() == "one\n"
    place.write_text("")
    file.write("4")
    assert list(file.lines_after(position, 100)) == [b"4", b""], "what was begun anew is read from its beginning"
    file.close()
    assert len([r for r in caplog.records if f"{place}: was removed or moved away" in r.getMessage()]) == 1


def test_lines_of_a_folder_that_was_removed_enter_no_other_one(tmp_path: Path) -> None:
    place = tmp_path / "out" / "lines"
    place.parent.mkdir()
    file = AppendedLines(place)
    file.write("one")
    shutil.rmtree(place.parent)
    file.write("two")
    assert "No such file" in file.failed
    place.parent.mkdir()
    place.write_text("another's\n")
    file.write("three")
    file.close()
    assert place.read_text() == "another's\n" and str(place) in file.failed


def test_a_restart_appends_after_removing_half_a_line(site: Path, record: np.ndarray, cut: Cut) -> None:
    out = site.parent / "out"
    Daemon(site, Scripted(cut(record, RATE))).run()
    first = (out / "results.jsonl").read_bytes()
    (out / "results.jsonl").write_bytes(first + b'{"window": 9, "t_e')
    Daemon(site, Scripted(cut(record, RATE))).run()
    assert (out / "results.jsonl").read_bytes() == first * 2


def test_the_daemon_compiles_before_it_is_ready_and_says_meanwhile_that_it_starts(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = threading.Event()
    said: list[str] = []

    def slow(*_: Any) -> int:
        until(lambda: len(health(site.parent / "out")) >= 3, "the daemon says that it starts")
        told.set()
        said.append(capsys.readouterr().err)
        return 0

    Daemon(site, Scripted([None] * 50), quiet_s=0.05, warm=slow).run()
    assert told.is_set() and said == [""] and capsys.readouterr().err == "READY\n"
    first = health(site.parent / "out")[0]
    assert first["source"]["error"] == "the monitor is starting" and not first["source"]["connected"]


def test_a_start_goes_on_where_something_cannot_be_compiled(site: Path, caplog: pytest.LogCaptureFixture) -> None:
    Daemon(site, Scripted([]), warm=lambda *_: 1 / 0).run()
    assert "not all is compiled" in caplog.text


def test_two_daemons_do_not_share_a_folder(site: Path) -> None:
    first = Daemon(site, Scripted([]))
    with pytest.raises(BadConfigurationError, match="another daemon"):
        Daemon(site, Scripted([]))
    first.run()
    Daemon(site, Scripted([])).run()


def test_another_baseline_is_noted_in_the_ledger(site: Path, record: np.ndarray, cut: Cut, main: Cli) -> None:
    folder = site.parent
    recording = write(folder / "rec.mcap", cut(record, RATE))
    bare = site.read_text()
    for name, more in (("one", []), ("two", [write(folder / "more.mcap", cut(record[:4000], RATE, first=20_000))])):
        done = main("calibrate", recording, *more, "--structure", site, "--out", folder / f"{name}.json")
        assert done.returncode == 0, done.stderr
    for name in ("one", "one", "two"):
        site.write_text(bare.replace('name = "bench"', f'name = "bench"\nbaseline = "{name}.json"'))
        Daemon(site, Scripted([])).run()
    (line,) = (folder / "out" / "ledger.jsonl").read_text().splitlines()
    assert json.loads(line)["files"]["baseline"]["file"].endswith("two.json")
    site.write_text(bare.replace('name = "bench"', 'name = "bench"\nbaseline = "none.json"'))
    with pytest.raises(MissingInputError, match=r"none\.json"):
        Daemon(site, Scripted([]))


def test_what_operators_ask_for_is_done_and_noted(site: Path, record: np.ndarray, cut: Cut) -> None:
    class Desk(Outlet):
        failed: str | None = "router gone"
        dropped: int = 3
        asked = 0
        gaps: list[Gap] = []  # noqa: RUF012

        def gap(self, gap: Gap) -> None:
            self.gaps.append(gap)

        def take_requests(self) -> list[Request]:
            self.asked += 1
            wish = Request(action="shelve", story=2, who="Ada", note="works on floor 2", seconds=1e6)
            return [wish, wish.model_copy(update={"story": 9})] if self.asked == 3 else []

    blocks = cut(record, RATE)
    daemon = Daemon(site, Scripted(blocks[:20] + blocks[25:]), [Desk()])
    daemon.run()
    shelved = daemon.session.pipeline.state.alarm.stories[1].shelved
    assert shelved is not None and "Ada" in shelved.reason
    (line,) = (site.parent / "out" / "ledger.jsonl").read_text().splitlines()
    assert json.loads(line)["who"] == "Ada" and "shelve" in json.loads(line)["what"]
    assert len(Desk.gaps) == 1
    assert health(site.parent / "out")[-1]["failed"] == {"Desk": "router gone"}
    last = health(site.parent / "out")[-1]
    assert last["lost"] == {"Desk": 3}
    outputs = dict(daemon.outputs())
    for k, name in enumerate(("results.jsonl", "health.jsonl", "history"), 1):
        vars(outputs[name])["dropped"] = k
    assert losses(daemon.outputs()) == {"results.jsonl": 1, "health.jsonl": 2, "history": 3, "Desk": 3}
    assert "; 3 lost on the way to Desk" in tell(look(site.parent / "out"))
    metrics = Metrics("bench", MetricsSettings(listen="127.0.0.1:0"))
    try:
        metrics.health_line(last)
        samples = [s for family in metrics.collect() for s in family.samples]
        assert [s.value for s in samples if s.name == "shm_output_lost_total" and s.labels == {"output": "Desk"}] == [3]
    finally:
        metrics.close(1.0)


def test_an_alarm_is_in_the_summary_at_once_and_before_the_last_diagnosis_is_waited_for(
    site: Path, record: np.ndarray, cut: Cut
) -> None:
    """A reader of the web page saw ALARM above "no alarm so far" until the next summary came."""
    told: list[tuple[int, list[str]]] = []

    class Desk(Outlet):
        def summary(self, content: Mapping[str, Any]) -> None:
            told.append((content["windows"], [alarm["level"] for alarm in content["alarms"]]))

    def alarmed(result: Any) -> Any:
        """The fourth window and those after it have an alarm."""
        is_late = isinstance(result, WindowResult) and result.index >= 3
        lost = damage_reading(np.array([0.0, 0.1, 0.0]), 1e-4 * np.eye(3))
        standing = alarm(Level.ALARM, active={2: Level.ALARM}, conditions={2: AlarmCondition.UNACKNOWLEDGED})
        return replace(result, damage=lost, alarm=standing) if is_late else result

    daemon = Daemon(site, Scripted(cut(record, RATE)), [Desk()], quiet_s=1e6)
    push, finish = daemon.session.pipeline.push, daemon.session.finish
    daemon.session.pipeline.push = lambda block: [alarmed(result) for result in push(block)]  # type: ignore[method-assign]
    daemon.session.finish = lambda stop: (told.append((-1, [])), finish(stop))[1]  # type: ignore[method-assign]
    daemon.run()
    assert told[0] == (4, ["alarm"])
    waited = told.index((-1, []))
    assert told[waited - 1] == told[-1] == (9, ["alarm"])


def test_health_is_told_while_the_last_diagnosis_is_awaited(site: Path, record: np.ndarray, cut: Cut) -> None:
    """A diagnosis of more than a minute made `status` and the web page call the daemon silent."""
    told: list[Mapping[str, Any]] = []

    class Desk(Outlet):
        def health_line(self, line: Mapping[str, Any]) -> None:
            told.append(line)

    daemon = Daemon(site, Scripted(cut(record, RATE)), [Desk()], quiet_s=0.0)
    waited: list[int] = []
    daemon.session.finish = lambda stop: waited.extend(len(told) for _ in range(3) if not stop())  # type: ignore[method-assign]
    daemon.run()
    assert np.diff(waited).tolist() == [1, 1] and told[waited[-1] - 1]["source"]["ended"]


def test_stages_and_latency_are_told(site: Path, record: np.ndarray, cut: Cut) -> None:
    Daemon(site, Scripted(cut(record, RATE))).run()
    told = health(site.parent / "out")
    spans = [line for line in told if line["stream"] is not None]
    assert [line["t_ns"] - T0_NS for line in spans] == [k * 10 * 10**9 for k in range(1, 7)]
    assert all([c["channel"] for c in line["channels"]] == ["a1", "a2", "a3"] for line in spans)
    assert all(line["stream"]["availability"] == 1.0 for line in spans)
    assert sum(told[-1]["latency_ms"]["windows"].values()) == 9
    assert told[-1]["failed"] == told[-1]["lost"] == {}
    assert (told[-1]["source"]["ended"], told[-1]["source"]["error"]) == (True, "")
    assert not troubles_of(told[-1]) and "read to its end" in tell(look(site.parent / "out"))


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('kind = "serial"', "source.kind"),
        ('kind = "mcap"', "source.files"),
        ('kind = "mcap"\nfiles = ["a.mcap"]\nspede = 2.0', "source.spede"),
    ],
)
def test_check_and_run_refuse_a_wrong_source(site: Path, main: Cli, table: str, says: str) -> None:
    site.write_text(site.read_text().replace('kind = "mcap"\nfiles = ["rec.mcap"]', table, 1))
    for command in ("check", "run"):
        done = main(command, site)
        assert done.returncode == 78
        assert says in done.stderr and str(site) in done.stderr
    assert not (site.parent / "out").exists()


def test_exit_codes_of_run(site: Path, main: Cli, tmp_path: Path) -> None:
    assert main("run", site).returncode == 66  # rec.mcap is not there
    (site.parent / "rec.mcap").write_bytes(b"nonsense" * 10)
    assert main("run", site).returncode == 65
    assert main("run", tmp_path / "none.toml").returncode == 66
    site.write_text(site.read_text().replace("[source]", "[sauce]"))
    assert main("run", site).returncode == 78


def test_a_signal_in_the_middle_ends_it_with_whole_files(site: Path, record: np.ndarray, cut: Cut, main: Cli) -> None:
    folder = site.parent
    write(folder / "rec.mcap", cut(np.tile(record, (20, 1)), RATE, [64]))
    site.write_text(site.read_text().replace('files = ["rec.mcap"]', 'files = ["rec.mcap"]\nspeed = 60.0'))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(folder / "notify"))
        environment = {**os.environ, "NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "400000"}
        command = [str(Path(sys.executable).with_name("shm-monitor")), "run", str(site)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        assert process.stderr.readline() == "READY\n"
        until(lambda: (folder / "out" / "results.jsonl").read_bytes().count(b"\n") >= 3, "three windows")
        process.terminate()
        _, err = process.communicate(timeout=60.0)
        systemd.setblocking(False)
        told = set()
        with pytest.raises(BlockingIOError):
            while True:
                told.add(systemd.recv(100).decode())
    assert process.returncode == 0, err
    assert {"READY=1", "WATCHDOG=1", "STOPPING=1"} <= told
    out = folder / "out"
    assert not list(out.rglob("*.part"))
    found = lines(out)
    assert 3 <= len(found) < 237
    assert summary(out)["windows"] == len(found)
    read = sum(b.n_samples for b in read_recordings(own(out)))
    assert read / RATE >= (found[-1]["t_end_ns"] - T0_NS) / 1e9
    assert replayed(main, site, own(out), folder / "again") == (out / "results.jsonl").read_bytes()


def test_a_source_that_hangs_does_not_keep_it_from_ending(site: Path, record: np.ndarray, cut: Cut) -> None:
    released = threading.Event()

    class Hanging(Scripted):
        def read(self, timeout_s: float) -> SampleBlock | None:
            block = super().read(timeout_s)
            if block is None and not released.is_set():
                os.kill(os.getpid(), signal.SIGINT)
                released.wait(60.0)
            return block

    Daemon(site, Hanging(cut(record, RATE), hold=released)).run()
    released.set()
    assert len(lines(site.parent / "out")) == 9


def test_without_data_a_line_of_health_comes_at_the_stated_interval(site: Path) -> None:
    """The daemon's clock is the test's: an hour of silence takes no time."""
    now, told_s = [0.0], list[float]()

    class Desk(Outlet):
        def health_line(self, line: Mapping[str, Any]) -> None:
            told_s.append(now[0])
            assert line["t_ns"] is None

    def clock() -> float:
        now[0] += 1.0
        return now[0]

    def silence() -> Iterator[Step]:
        while len(told_s) < 25:
            yield None

    Daemon(site, Scripted(silence()), [Desk()], clock=clock, tick_s=0.001, quiet_s=60.0).run()
    assert all(60.0 <= step <= 65.0 for step in np.diff(told_s)[:-1])
    assert len(health(site.parent / "out")) >= len(told_s)


@pytest.mark.parametrize(("hop_s", "patience_s"), [(5.0, 30.0), (20.0, 40.0)])
def test_a_state_is_no_present_one_once_data_are_late_by_two_hops_or_half_a_minute(
    site: Path, record: np.ndarray, cut: Cut, hop_s: float, patience_s: float
) -> None:
    """Everywhere at once: the state, the summary, the line of health and the metrics; no line of results."""
    said: list[tuple[float, Assessment]] = []
    told: list[Mapping[str, Any]] = []
    seconds, reads = [0.0], [0]
    site.write_text(site.read_text().replace("hop_s = 5.0", f"hop_s = {hop_s}"))
    out, metrics = site.parent / "out", Metrics("bench", None)

    class States(Outlet):
        def state(self, assessment: Assessment) -> None:
            said.append((seconds[0], assessment))

        def health_line(self, line: Mapping[str, Any]) -> None:
            told.append(line)

    def script() -> Iterator[Step]:
        """The clock runs while the source is silent, then data come again."""
        *most, last = cut(record, RATE)
        yield from most
        step_s, rounds = patience_s - 2.0, 5000  # of the clock's readings: first until all that waits is taken
        while not said[-1][1].headline.startswith("No data") and seconds[0] < 1e3:
            before = reads[0]
            until(lambda before=before, n=rounds: reads[0] > before + n, "the loop has gone round several times")
            seconds[0], step_s, rounds = seconds[0] + step_s, 1.0, 300
            yield None
        late_s, late = said[-1]
        assert patience_s <= late_s <= patience_s + 3.0
        assert late.state is State.NOT_JUDGED
        assert re.fullmatch(r"No data since 20\S+ \S+ UTC \(for \d+ s\); before: no baseline.*", late.headline)
        until(lambda: summary(out)["headline"] == late.headline, "a summary that says so")
        assert told[-1]["data_age_s"] >= patience_s
        families = {family.name: family for family in metrics.collect()}
        assert families["shm_data_age_seconds"].samples[0].value == told[-1]["data_age_s"]
        assert [s.value for s in families["shm_state"].samples if s.labels["state"] == "not_judged"] == [1.0]
        assert re.search(
            r"source .*; data until .*, the last \d\d s ago|in the last span, the last \d\d s ago", tell(look(out))
        )
        yield last

    def clock() -> float:
        reads[0] += threading.current_thread() is threading.main_thread()
        return seconds[0]

    Daemon(site, Scripted(script()), [States(), metrics], clock=clock, tick_s=0.001).run()
    assert not said[-1][1].headline.startswith("No data")
    assert not any("no data" in str(line).lower() for line in lines(out))
    content = summary(out)
    assert {key: content[key] for key in said[-1][1].content} == said[-1][1].content


def test_a_drivers_bug_is_not_swallowed(site: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        Daemon(site, Scripted([ZeroDivisionError()])).run()
    assert summary(site.parent / "out")["windows"] == 0


TIMES = st.one_of(st.integers(-(10**9), 10**9), st.sampled_from([-(10**13), 10**13, 2 * 10**18, -(10**18)]))


@given(
    hostile=st.lists(
        st.tuples(
            st.integers(0, 39),
            st.one_of(TIMES, st.none()),
            st.one_of(st.integers(-3, 3000), st.sampled_from([2**61, 2**64 - 1])),
            st.sampled_from([RATE, RATE, 50.0, 7.3, 999_999.0, 1e6, 1e-3, 1e300]),
            st.sampled_from([1.0, np.nan, np.inf, 1e36, 0.0]),
            st.integers(0, 130),
        ),
        max_size=12,
    )
)
@settings(deadline=None, max_examples=15)
def test_no_block_whatever_it_says_ends_the_monitor_or_comes_back_as_nonsense(
    frame_text: str, record: np.ndarray, cut: Cut, tmp_path_factory: pytest.TempPathFactory, hostile: list[Any]
) -> None:
    blocks = cut(record, RATE)[:40]
    session = Session(settings_of(frame_text), None, (), None, tmp_path_factory.getbasetemp() / "findings")
    for k, block in enumerate(blocks):
        for place, t_ns, sequence, rate, factor, n in hostile:
            if place == k:
                samples = (block.samples[:n] * np.float32(factor)).astype(np.float32)
                forged = replace(
                    block,
                    t_ns=block.t_ns + (t_ns or 0),
                    sequence=max(0, block.sequence + sequence),
                    sample_rate_hz=rate,
                    samples=samples,
                )
                if unfit(forged) is None:
                    with contextlib.suppress(BadInputError):
                        session.push(forged)
        session.push(block)
    to_json(plain(session.content(1.0)))
    assert len(session.pipeline.state.health.spans) < 200


def test_lines_that_are_rolled_leave_a_link_in_its_place(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    place = tmp_path / "results.jsonl"
    place.symlink_to("disk/results.jsonl")
    lines = AppendedLines(place)
    lines.write("one")
    lines.roll(tmp_path / "closed.jsonl")
    lines.write("two")
    lines.close()
    assert place.is_symlink() and place.read_text() == "two\n"
    assert (tmp_path / "closed.jsonl").read_text() == "one\n"
