"""Rolling recordings: in order of arrival, within limits, whole after a crash or a full disk."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers import recorder as module
from drivers.base import TEMPERATURE, SampleBlock
from drivers.mcap_file import read_recordings, scan_messages
from drivers.mcap_writer import McapWriter
from drivers.recorder import Recorder, RecorderSettings, unfit
from tests.support.any_block import same
from tests.support.samples import T0_NS, Cut

RATE = 100.0


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def make(folder: Path, clock: Clock, **settings: object) -> Recorder:
    return Recorder(folder, RecorderSettings(**{"min_free_gb": 0.0, **settings}), clock)  # type: ignore[arg-type]


def record(recorder: Recorder, clock: Clock, arrived: list[SampleBlock]) -> list[int]:
    """Write a block each second and end; returns the recorder's place after each."""
    places = [recorder.stamp_ns]
    for block in arrived:
        clock.now += 1.0
        recorder.write(block)
        places.append(recorder.stamp_ns)
    recorder.close()
    return places


def blocks(cut: Cut, seconds: float = 60.0, seed: int = 0) -> list[SampleBlock]:
    return cut(np.random.default_rng(seed).normal(size=(int(seconds * RATE), 3)), RATE)


def recorded(folder: Path) -> list[SampleBlock]:
    return list(read_recordings(sorted(folder.glob("*.mcap"))))


def assert_recorded(folder: Path, wanted: list[SampleBlock]) -> None:
    got = recorded(folder)
    assert len(got) == len(wanted)
    assert all(same(a, b) for a, b in zip(got, wanted, strict=True))


def test_blocks_come_back_as_they_came_late_repeated_and_stepping_clocks_too(
    tmp_path: Path, cut: Cut, clock: Clock
) -> None:
    """Order of arrival is what the results depended on; the files may be named in any order."""
    parts = blocks(cut)
    warm = replace(parts[3], topic=TEMPERATURE, unit="degC", t_ns=T0_NS)
    back = [replace(b, t_ns=b.t_ns - 40 * 10**9) for b in parts[45:]]  # the clock was set back
    arrived = [*parts[:10], parts[12], parts[11], parts[11], warm, *parts[13:45], *back, parts[5]]
    record(make(tmp_path, clock, flush_s=2.0, file_s=7.0), clock, arrived)
    assert len(list(tmp_path.glob("*.mcap"))) > 3
    assert_recorded(tmp_path, arrived)
    got = list(read_recordings(sorted(tmp_path.glob("*.mcap"), reverse=True)))
    assert all(same(a, b) for a, b in zip(got, arrived, strict=True))


def test_names_sort_by_time_and_files_roll_by_length_and_by_size(tmp_path: Path, cut: Cut, clock: Clock) -> None:
    for name, limits in (("s", {"file_s": 10.0}), ("mb", {"file_mb": 0.02})):
        record(make(tmp_path / name, clock, flush_s=1.0, **limits), clock, blocks(cut))
        files = sorted((tmp_path / name).glob("*.mcap"))
        firsts = [next(scan_messages(path))[1] for path in files]
        assert firsts == sorted(firsts)
        assert 4 <= len(files) <= 12
        assert not list((tmp_path / name).glob("*.part"))


def test_the_oldest_files_go_and_others_stay(tmp_path: Path, cut: Cut, clock: Clock) -> None:
    (tmp_path / "notes.mcap").write_bytes(b"mine")
    recorder = make(tmp_path, clock, flush_s=1.0, file_s=5.0, keep_gb=50e3 / 2**30)
    arrived = blocks(cut, 150.0)
    record(recorder, clock, arrived)
    assert recorder.health().removed_files > 5
    assert (tmp_path / "notes.mcap").read_bytes() == b"mine"
    (tmp_path / "notes.mcap").unlink()
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) < 70e3
    got = recorded(tmp_path)
    assert got and all(same(a, b) for a, b in zip(got, arrived[-len(got) :], strict=True))


def test_a_power_cut_costs_no_more_than_flush_s_and_the_next_start_names_the_file(
    tmp_path: Path, cut: Cut, clock: Clock
) -> None:
    arrived = blocks(cut)
    recorder = make(tmp_path / "live", clock, flush_s=5.0)
    for block in arrived[:58]:
        clock.now += 1.0
        recorder.write(block)
    (part,) = (tmp_path / "live").iterdir()
    after = tmp_path / "after"
    after.mkdir()
    (after / part.name).write_bytes(part.read_bytes() + b"\0" * 100)  # what the disk holds at this moment
    (after / "20000101T000000.000000Z-0001.mcap.part").write_bytes(b"")
    (after / "20000101T000000.000000Z-0002.mcap.part").write_bytes(b"what a broken disk holds")
    make(after, clock).close()
    set_aside = "20000101T000000.000000Z-0002.damaged"
    assert sorted(p.name for p in after.iterdir()) == [set_aside, part.name.removesuffix(".part")]
    got = recorded(after)
    assert len(got) >= 53
    assert all(same(a, b) for a, b in zip(got, arrived, strict=False))
    recorder.close()


def test_quiet_sources_are_flushed_by_the_clock(tmp_path: Path, cut: Cut, clock: Clock) -> None:
    recorder = make(tmp_path, clock, flush_s=5.0)
    recorder.write(blocks(cut)[0])
    (part,) = tmp_path.iterdir()
    clock.now = 3.0
    recorder.tick()
    assert part.stat().st_size == 0
    clock.now = 4.5  # early enough for a slow disk to have it in time
    recorder.tick()
    assert len(list(scan_messages(part))) == 1
    recorder.close()


class Disk:
    """What the disk says of itself; full ones take no more."""

    full = False
    free = 2 << 30


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    made, flush = Disk(), McapWriter.flush

    def flush_or_fail(writer: McapWriter) -> None:
        if made.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(writer)

    monkeypatch.setattr(McapWriter, "flush", flush_or_fail)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: made)
    return made


@pytest.mark.parametrize(
    ("cause", "words", "lost"), [("full disk", "space", range(15, 30)), ("little space", "free", range(25))]
)
def test_a_disk_that_is_full_pauses_recording_and_what_was_written_stays(
    tmp_path: Path, cut: Cut, clock: Clock, disk: Disk, cause: str, words: str, lost: range
) -> None:
    arrived, told = blocks(cut), []
    recorder = make(tmp_path, clock, flush_s=2.0 if cause == "full disk" else 1.0, min_free_gb=1.0)
    for k, block in enumerate(arrived):
        if cause == "full disk":
            disk.full = 20 <= k < 40
        else:
            disk.free = (1 << 29) if 20 <= k < 40 else (2 << 30)
        clock.now += 1.0
        recorder.write(block)
        told.append(recorder.health().detail)
    assert words in told[30] and recorder.health().recording
    recorder.close()
    health, got = recorder.health(), recorded(tmp_path)
    assert health.lost_blocks == len(arrived) - len(got) and health.lost_blocks in lost
    assert health.blocks == len(got)
    assert [b.sequence for b in got] == sorted(b.sequence for b in got)
    assert same(got[-1], arrived[-1]) and same(got[0], arrived[0])


@pytest.mark.parametrize(
    "change",
    [
        {"t_ns": -1},
        {"t_ns": 1 << 62},
        {"sequence": (1 << 64) - 1},
        {"sample_rate_hz": 1e9},
        {"unit": "degC"},
        {"topic": "/foreign"},
        {"channels": (), "samples": np.zeros((5, 0), np.float32)},
    ],
)
def test_what_would_spoil_a_recording_is_unfit(cut: Cut, change: dict[str, object]) -> None:
    block = blocks(cut)[0]
    assert unfit(block) is None
    assert unfit(replace(block, **change)) is not None


def test_two_runs_of_the_same_data_do_not_overwrite_each_other(tmp_path: Path, cut: Cut, clock: Clock) -> None:
    for _ in range(2):
        recorder = make(tmp_path, clock)
        recorder.write(blocks(cut)[0])
        recorder.close()
    assert len(list(tmp_path.glob("*.mcap"))) == 2


def test_blocks_of_another_century_misname_no_later_recording_over_a_restart(
    tmp_path: Path, cut: Cut, clock: Clock
) -> None:
    """Names and log times begin anew when the clock was set back, and reading still gives the order of arrival."""
    far = 4_102_444_800 * 10**9  # 2100-01-01
    parts = blocks(cut, 400.0)
    forged = [replace(b, t_ns=far + k * 10**9, sequence=k) for k, b in enumerate(parts[:5])]
    arrived = [*parts[:20], *forged, *parts[20:50]]
    record(make(tmp_path, clock, flush_s=2.0, file_s=30.0), clock, arrived)
    later = parts[50:]
    places = record(make(tmp_path, clock, flush_s=2.0, file_s=30.0), clock, later)
    assert places == sorted(set(places))
    assert_recorded(tmp_path, [*arrived, *later])
    again = list(module.recorded(tmp_path, places[0]))
    assert len(again) == len(later) and all(same(a, b) for (_, a), b in zip(again, later, strict=True))
    assert [place for place, _ in again] == places[1:]
    names = [path.name for path in tmp_path.glob("*.mcap") if path.name.startswith("2100")]
    wrong = sum(len(list(scan_messages(tmp_path / name))) for name in names)
    assert wrong <= 5 + 30 + 60 + 1, "a minute of data tells a clock that was set back from blocks that were delayed"
    right = [path.name for path in tmp_path.glob("*.mcap") if "-c1" in path.name]
    assert len(right) >= 8 and all(name < "2100" for name in right)
    assert make(tmp_path, clock).stamp_ns == places[-1]


def test_late_blocks_now_and_then_begin_no_file(tmp_path: Path, cut: Cut, clock: Clock) -> None:
    far, recorder = 4_102_444_800 * 10**9, make(tmp_path, clock, flush_s=2.0)
    parts = [replace(b, t_ns=far + k * 10**9) if k % 5 == 0 else b for k, b in enumerate(blocks(cut, 200.0))]
    record(recorder, clock, parts)
    assert recorder.health().files == 1


def test_the_oldest_to_arrive_goes_first_whatever_its_name(tmp_path: Path, cut: Cut, clock: Clock) -> None:
    far, parts = 4_102_444_800 * 10**9, blocks(cut, 150.0)
    recorder = make(tmp_path, clock, flush_s=1.0, file_s=20.0, keep_gb=50e3 / 2**30)
    record(recorder, clock, [replace(parts[0], t_ns=far), *parts])
    assert not [path for path in tmp_path.iterdir() if path.name.startswith("2100")]


@pytest.mark.parametrize("cause", ["free space", "full disk"])
def test_a_disk_at_its_limit_is_one_stop_and_one_return(
    tmp_path: Path, cut: Cut, clock: Clock, disk: Disk, cause: str
) -> None:
    """Who is told of each change must not be told for ever."""
    recorder, told = make(tmp_path, clock, flush_s=2.0, min_free_gb=1.0), [True]
    for k, block in enumerate(blocks(cut, 90.0)):
        at_limit = (1 << 30) + (-1 if k % 5 else 1) * (1 << 20)  # other programs write and delete
        disk.free = at_limit if cause == "free space" and 20 <= k < 60 else 2 << 30
        disk.full = cause == "full disk" and 20 <= k < 60
        clock.now += 1.0
        recorder.write(block)
        if recorder.health().recording != told[-1]:
            told.append(recorder.health().recording)
    recorder.close()
    assert told == [True, False, True]


def test_what_a_kill_left_is_on_the_disk_before_anything_goes_on_from_it(
    tmp_path: Path, clock: Clock, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks that were written and not flushed outlast the process; a power cut soon after must not take them back."""
    left = tmp_path / "20260101T000000.000000Z-0001.mcap.part"
    with McapWriter(tmp_path / "whole.mcap", as_arrived=True) as writer:
        for block in cut(np.zeros((500, 3)), RATE):
            writer.write(block)
    (tmp_path / "whole.mcap").rename(left)
    done: list[str] = []
    fsync, replace_ = os.fsync, os.replace

    def note_sync(handle: int) -> None:
        done.append(f"fsync {os.path.basename(os.readlink(f'/proc/self/fd/{handle}'))}")
        fsync(handle)

    def note_name(source: Path, target: Path) -> None:
        done.append(f"rename {source.name}")
        replace_(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_name)
    make(tmp_path, clock)
    assert done[:2] == [f"fsync {left.name}", f"rename {left.name}"]
    assert len(list(read_recordings([left.with_suffix("")]))) == 5


@pytest.mark.parametrize(
    ("finished", "unfinished", "aside"),
    [(5, 3, None), (5, 5, None), (3, 5, None), (5, -3, -3), (3, -5, -5), (0, 3, None)],
)
def test_an_unfinished_recording_replaces_no_finished_one_but_that_with_which_it_begins(
    tmp_path: Path, clock: Clock, cut: Cut, finished: int, unfinished: int, aside: int | None
) -> None:
    """As where a copy of the folder was restored over it; counts of blocks, those below 0 are of other data."""

    def recording(count: int) -> bytes:
        """Flushed after each block, as a power cut leaves it."""
        writer = McapWriter(tmp_path / "made.mcap", as_arrived=True)
        for block in cut(np.full((500, 3), float(count < 0)), RATE)[: abs(count)]:
            writer.write(block)
            writer.flush()
        data = writer.part_path.read_bytes()
        writer.abort()
        return data

    place = tmp_path / "live" / "20260101T000000.000000Z-0001.mcap"
    place.parent.mkdir()
    place.write_bytes(recording(finished))
    place.with_name(place.name + ".part").write_bytes(recording(unfinished))
    make(tmp_path / "live", clock).close()
    found = {path.name: path.read_bytes() for path in place.parent.iterdir()}
    kept = {} if aside is None else {place.with_suffix(".damaged").name: recording(aside)}
    longest = finished if aside is not None else max(finished, unfinished)
    assert found == {place.name: recording(longest)} | kept
