"""Killed at any moment, the daemon goes on where it was: what it wrote is a replay of what it recorded."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import sqlite3
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import read_recordings
from drivers.recorder import recorded
from monitor.config import configuration
from monitor.core import Gap, Level
from monitor.damage import AlarmSettings, AlarmState, StoryState, alarm as alarms, load_baseline
from monitor.events import Event
from monitor.model import simulate
from monitor.publish import facts_of_line
from monitor.runs import Session
from monitor.service import serialization
from monitor.service.appended_lines import AppendedLines
from monitor.service.daemon_health import plain
from monitor.service.restart import Checkpointer, Saved
from monitor.service.threads import Recording
from tests.events.shaken import blocks
from tests.support.frames import settings_of, shear_frame_text
from tests.support.live_rig import Command
from tests.support.live_site import RATE, SIZE, LiveDaemon, save_stream
from tests.support.quake import shaken
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.shaken_site import SITE as SHAKEN_SITE
from tests.support.site import (
    SITE as BARE_SITE,
    Daemon,
    Endless,
    Scripted,
    Told,
    lines,
    own,
    replayed,
    run_until,
    summary,
    write,
)
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system

SITE = """
[site]
name = "bench"
baseline = "baseline.json"

[source]
kind = "mcap"
files = ["rec.mcap"]
speed = 60.0

[output]
dir = "out"

[recorder]
min_free_gb = 0.0
flush_s = 1.0
file_s = 100.0

[watch]
diagnose = false

[alarm]
latching = true

[state]
checkpoint_s = 20.0
"""
FAST_S, STEADY_S = 0.01, 0.0625
"""Between two blocks of half a second: 50 times real time; and 8 times, at which the recorder can keep to its `flush_s`."""
Bench = tuple[Path, np.ndarray]


@pytest.fixture(scope="module")
def bench(frame_text: str, tmp_path_factory: pytest.TempPathFactory, cut: Cut, main: Cli) -> Bench:
    """A baseline, and a record in which story 2 softens and recovers."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "s.toml").write_text(frame_text)
    weak = frame_text.replace("1514.8507", "900.0")
    healthy, damaged = (
        simulate(settings_of(text).model(), duration_s=seconds, rate_hz=RATE, noise=0.03, seed=seed).floors
        for text, seconds, seed in ((frame_text, 400.0, 6), (weak, 90.0, 7))
    )
    write(folder / "healthy.mcap", cut(healthy, RATE))
    options = ("--structure", folder / "s.toml", "--out", folder / "baseline.json")
    done = main("calibrate", folder / "healthy.mcap", *options)
    assert done.returncode == 0, done.stderr
    return folder / "baseline.json", np.concatenate([healthy[: round(90 * RATE)], damaged])


@pytest.fixture
def site(tmp_path: Path, frame_text: str, bench: Bench) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(SITE + frame_text)
    shutil.copy(bench[0], tmp_path / "baseline.json")
    return path


@dataclass
class Toll:
    """What the kills cost."""

    lives_s: list[tuple[float, float]] = field(default_factory=list)
    """Where in the stream each began to take it, and where it was killed."""
    lost_s: list[float] = field(default_factory=list)
    not_replayed: int = 0
    windows: int = 0
    episodes: int = 0


def last_level(results: Path) -> str:
    """Of the last whole line."""
    if not results.exists():
        return ""
    with results.open("rb") as file:
        file.seek(max(0, results.stat().st_size - 20_000))
        _, _, last = file.read().rpartition(b"\n")[0].rpartition(b"\n")
    return str(json.loads(last)["alarm"]["level"]) if last else ""


def kill_at_a_change(daemon: LiveDaemon, within_s: float) -> None:
    """At once when an alarm comes, grows or goes, and its line has just been written."""
    results = daemon.out / "results.jsonl"
    deadline, level = time.monotonic() + within_s, last_level(results)
    while time.monotonic() < deadline and last_level(results) == level:
        time.sleep(0.001)
    daemon.kill()


def lines_by_number(out: Path) -> dict[int, str]:
    """Each window once, in order."""
    texts = (out / "results.jsonl").read_text().splitlines()
    numbers = [json.loads(text)["window"] for text in texts]
    assert numbers == sorted(set(numbers))
    return dict(zip(numbers, texts, strict=True))


def kept_s(out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Where the blocks of the recordings begin and end in the stream, s; each is there once."""
    blocks = list(read_recordings(own(out)))
    begin = np.array([b.t_ns - T0_NS for b in blocks]) * 1e-9
    end = begin + np.array([b.n_samples for b in blocks]) / RATE
    assert np.all(begin[1:] > end[:-1] - 1e-6)
    return begin, end


def last_loss(live: dict[int, str], alarm: dict[str, Any]) -> float:
    """Loss of an alarm's story in the last line at the alarm's level that bears it out, by two standard deviations.

    A smaller loss than makes an `alarm` only holds one.  Without such a line it is that of the first line at the level.
    """
    j, until = alarm["story"] - 1, alarm["t_last_ns"] or np.inf
    least = AlarmSettings().alarm_loss if alarm["level"] == "alarm" else 0.0
    parsed = [json.loads(text) for text in live.values()]
    during = [line for line in parsed if alarm["t_first_ns"] <= line["t_end_ns"] < until and line["ddi"] is not None]
    first, *later = [line for line in during if line["alarm"]["level"] == alarm["level"]]
    stated = [line for line in later if line["ddi"][j] >= max(least, 2 * line["ddi_std"][j])]
    return float((stated or [first])[-1]["ddi"][j])


def alarms_in_history(out: Path) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(out / "state" / "history.db")) as database:
        rows = database.execute(
            "SELECT nullif(story, 0), t_first_ns, t_last_ns, level FROM alarms ORDER BY t_first_ns, story"
        )
        return rows.fetchall()


def check(site: Path, main: Cli, toll: Toll) -> None:
    """The results are a replay of the recordings, but for windows told of samples that were lost with a crash."""
    out, again = site.parent / "out", site.parent / "again"
    assert not list(out.rglob("*.damaged*")) and not list(out.rglob("*.part"))
    replayed(main, site, own(out), again, "--baseline", site.parent / "baseline.json")
    live, wanted_lines = lines_by_number(out), lines_by_number(again)
    assert wanted_lines.keys() <= live.keys()
    begin, end = kept_s(out)
    toll.lost_s = [taken - max(first, end[end <= taken + 1e-6].max()) for first, taken in toll.lives_s]
    level = "normal"
    for number, text in live.items():
        line = json.loads(text)
        if text != wanted_lines.get(number):
            t_s = (line["t_end_ns"] - T0_NS) * 1e-9
            assert np.any((end[:-1] < t_s) & (t_s <= begin[1:] + 1e-3)), line
            assert line["alarm"]["level"] == level  # nothing that an operator would miss
            toll.not_replayed += 1
        level = line["alarm"]["level"]
    told, wanted = (plain(summary(folder)) for folder in (out, again))
    same = ("gaps", "frequencies_hz", "quality", "dropped_samples")
    assert {k: told[k] for k in same} == {k: wanted[k] for k in same}
    # The lines that a crash left without their samples are compared above; the summary counts them as they stand, and takes
    # the size of an alarm from the last of its lines.
    course = ("story", "level", "t_first_ns", "t_last_ns")
    assert [{k: a[k] for k in course} for a in told["alarms"]] == [{k: a[k] for k in course} for a in wanted["alarms"]]
    for alarm in told["alarms"]:
        assert alarm["ddi"] == pytest.approx(last_loss(live, alarm), rel=1e-8)
    reasons = [
        re.sub(r" \([^()]*\)", "", why) for text in live.values() if (why := json.loads(text)["skipped"]) is not None
    ]
    assert (told["windows"], told["skipped"], told["skip_reasons"]) == (len(live), len(reasons), dict(Counter(reasons)))
    episodes = [(a["story"], a["t_first_ns"], a["t_last_ns"], a["level"]) for a in told["alarms"]]
    assert alarms_in_history(out) == sorted(episodes, key=lambda e: (e[1], e[0] or 0))
    assert episodes
    check_state(site)
    toll.windows, toll.episodes = len(live), len(episodes)


def check_state(site: Path) -> None:
    """What the last checkpoint holds is bit for bit what all recordings up to it give, counted as the results say."""
    settings = configuration.load(site)
    session = Session(
        settings,
        load_baseline(site.parent / "baseline.json", settings.instrumented(), settings.updating),
        (),
        None,
        site.parent,
    )
    session.stated = {
        number: facts_of_line(json.loads(text)) for number, text in lines_by_number(site.parent / "out").items()
    }
    file = (site.parent / "out" / "state" / "checkpoint").read_bytes()
    saved = serialization.from_bytes(file, json.loads(file.partition(b"\n")[0])["key"], Saved)
    with threadpool_limits(limits=1):
        for stamp_ns, block in recorded(site.parent / "out" / "recordings", 0):
            if stamp_ns <= saved.stamp_ns:
                session.push(block)
    for name in ("pipeline", "summary", "quality"):
        known, wanted = (serialization.to_bytes("", getattr(state, name)) for state in (saved.session, session.state))
        assert known == wanted, name


def run_with_kills(
    site: Path, stream: np.ndarray, main: Cli, kills: int, seed: int, pace_s: float, longest_s: float
) -> Toll:
    """Each fifth kill comes while the daemon starts, each tenth when an alarm changes, if one does in a while."""
    folder, draw, toll = site.parent, random.Random(seed), Toll()
    save_stream(folder, stream)
    daemon, taken, missed = LiveDaemon(folder, pace_s), 0, 0
    try:
        daemon.wait_for_windows(3)
        for number in range(kills):
            if number % 10 == 8:
                kill_at_a_change(daemon, 2.0 * longest_s)
            else:
                time.sleep(draw.uniform(0.0, 0.5 if number % 5 == 4 else longest_s))
                assert daemon.code is None, daemon.said
                daemon.kill()
            first, taken = taken + missed, daemon.given
            toll.lives_s.append((min(first, taken) * SIZE / RATE, taken * SIZE / RATE))
            missed = draw.choice([0, 0, 0, 0, 3, 20, 20, 100])
            daemon = LiveDaemon(folder, pace_s, missed)
            if number % 5 != 3:  # the next kill comes while it starts
                daemon.until(lambda d=daemon, taken=taken: d.given > taken, "a block")
        before = len(daemon.windows)
        daemon.wait_for_windows(before + 4)
        assert daemon.stop()[0] == 0
    finally:
        daemon.kill()
    assert "not resumed" not in daemon.said and "Traceback" not in daemon.said
    check(site, main, toll)
    return toll


def test_ten_kills(site: Path, bench: Bench, main: Cli) -> None:
    toll = run_with_kills(site, bench[1], main, 10, 1, FAST_S, 1.0)
    assert toll.windows > 20


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_two_hundred_kills(site: Path, bench: Bench, main: Cli) -> None:
    text = site.read_text().replace("flush_s = 1.0", "flush_s = 10.0")
    site.write_text(text.replace("latching = true", "latching = false"))  # so that many come and go
    toll = run_with_kills(site, bench[1], main, 200, int(os.environ.get("SEED", "2")), STEADY_S, 8.0)
    lost = sorted(toll.lost_s)
    print(
        f"{len(lost)} kills, {toll.windows} windows, {toll.episodes} alarms, {toll.not_replayed} windows told of lost samples; "
        f"lost of the stream: median {lost[len(lost) // 2]:.1f} s, most {lost[-1]:.1f} s of data"
    )
    assert toll.episodes >= 2
    assert lost[-1] <= 10.0 + 1.0  # besides `flush_s`, what was on its way


@pytest.mark.parametrize("checkpoint_s", [20.0, 1e4])
def test_a_recording_as_source_goes_on_and_nothing_shows(
    site: Path, bench: Bench, cut: Cut, main: Cli, checkpoint_s: float
) -> None:
    """Also where the first checkpoint is not due before the end."""
    site.write_text(site.read_text().replace("checkpoint_s = 20.0", f"checkpoint_s = {checkpoint_s}"))
    folder, draw = site.parent, random.Random(3)
    recording = write(folder / "rec.mcap", cut(bench[1], RATE))
    out, again = folder / "out", folder / "again"
    for _ in range(3):
        with Command(folder / "log", "run", site) as daemon:
            count = len(lines(out))
            daemon.until(lambda count=count: len(lines(out)) >= count + 2, "two more windows")
            time.sleep(draw.uniform(0.0, 0.3))
    with Command(folder / "log", "run", site) as daemon:
        daemon.finish(120.0)
    wanted = replayed(main, site, [recording], again, "--baseline", bench[0])
    assert (out / "results.jsonl").read_bytes() == wanted
    told, wanted_summary = plain(summary(out)), plain(summary(again))
    assert told["alarms"] and all(told[key] == wanted_summary[key] for key in ("alarms", "quality"))
    assert not (out / "state" / "checkpoint").exists()  # the recording is over: the next one begins anew


def test_the_summary_counts_what_the_results_say_where_a_power_cut_lost_samples(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut
) -> None:
    """The lines of five windows are on the disk, the samples from which they were made are not."""
    site, out = tmp_path / "site.toml", tmp_path / "out"
    site.write_text(BARE_SITE + frame_text)
    blocks = cut(record, RATE)
    run_until(site, blocks[: len(blocks) * 2 // 3], 4)
    kept = {path: path.read_bytes() for path in [*out.glob("state/checkpoint"), *out.glob("recordings/*.mcap")]}
    run_until(site, blocks[len(blocks) * 2 // 3 :], 9)
    for path in [*out.glob("state/checkpoint*"), *out.glob("recordings/*")]:
        path.unlink()
    for path, data in kept.items():
        path.write_bytes(data)
    later = [replace(b, t_ns=b.t_ns + 60 * 10**9, sequence=b.sequence + len(record)) for b in blocks]
    Daemon(site, Scripted(later)).run()
    found, told = lines(out), summary(out)
    assert [line["window"] for line in found] == list(range(len(found))) and len(found) > 12
    assert all(line["skipped"] is None for line in found[:9])
    assert told["windows"] == len(found)
    assert told["skipped"] == sum(line["skipped"] is not None for line in found) > 0
    assert sum(told["skip_reasons"].values()) == told["skipped"]


def test_lines_of_which_a_kill_took_the_samples_are_written_once_whatever_ends_between(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut
) -> None:
    """After the kill a run is told to end before these samples come again, and stores its state."""
    site, out = tmp_path / "site.toml", tmp_path / "out"
    site.write_text(BARE_SITE + frame_text)
    blocks = cut(record, RATE)
    run_until(site, blocks[: len(blocks) * 2 // 3], 4)
    kept = {path: path.read_bytes() for path in [*out.glob("state/checkpoint"), *out.glob("recordings/*.mcap")]}
    run_until(site, blocks[len(blocks) * 2 // 3 :], 9)
    wanted = (out / "results.jsonl").read_bytes()
    for path in [*out.glob("state/checkpoint*"), *out.glob("recordings/*")]:
        path.unlink()
    for path, data in kept.items():
        path.write_bytes(data)
    run_until(site, [], 0)
    Daemon(site, Scripted(blocks[len(blocks) * 2 // 3 :])).run()
    assert (out / "results.jsonl").read_bytes() == wanted


def test_a_daemon_that_serves_a_view_is_resumed_too(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    """The view is fed while the recordings are caught up with, before there is a source."""
    site, out = tmp_path / "site.toml", tmp_path / "out"
    site.write_text(BARE_SITE.replace('dir = "out"', f'dir = "out"\nserve = "127.0.0.1:{free_port()}"') + frame_text)
    blocks = cut(record, RATE)
    run_until(site, blocks[: len(blocks) * 2 // 3], 4)
    kept = (out / "state" / "checkpoint").read_bytes()
    run_until(site, blocks[len(blocks) * 2 // 3 :], 9)
    (out / "state" / "checkpoint").write_bytes(kept)  # as if the power had gone before the last one
    session = run_until(site, [], 9).session
    assert "not resumed" not in caplog.text
    assert session.windows == len(lines(out)) >= 9


class Preliminary(Told):
    """Notes events of which it is told at once, and gaps."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[str] = []
        self.gaps: list[Gap] = []

    def event(self, event: Event, line: str) -> None:
        if event.revision is None:
            self.events.append(event.id)

    def gap(self, gap: Gap) -> None:
        self.gaps.append(gap)


@pytest.mark.parametrize("numbered_anew", [False, True])
def test_blocks_that_a_cache_sends_again_after_a_restart_are_taken_once(tmp_path: Path, numbered_anew: bool) -> None:
    """Two minutes with a quake come again, more than the minute after which late data are a clock that was set back."""
    site, out, told = tmp_path / "site.toml", tmp_path / "out", Preliminary()
    text = SHAKEN_SITE.replace("[recorder]\nenabled = false", "[recorder]\nmin_free_gb = 0.0")
    site.write_text(text + "[processing]\nwindow_s = 20.0\nhop_s = 5.0\n[identification]\nblock_rows = 10\n")
    stream = blocks(shaken())
    first = len(stream) * 4 // 5
    before = Endless(stream[:first], 20)
    before.daemon = Daemon(site, before, [told])
    before.daemon.run()
    assert len(told.events) == 1 and len(lines(out)) >= 20
    again = [replace(b, sequence=b.sequence + 7) for b in stream] if numbered_anew else stream
    Daemon(site, Scripted(again), [told]).run()
    assert told.events == [line["id"] for line in lines(out, "events.jsonl") if line["revision"] == 0]
    assert not told.gaps
    assert [line["window"] for line in lines(out)] == list(range(len(lines(out))))
    recorded_n = Counter(b.topic for b in read_recordings(own(out)))
    assert recorded_n == Counter(b.topic for b in stream)
    floors = [b for b in stream[:first] if b.topic == ACCELERATION]
    assert summary(out)["dropped_samples"] == sum(b.n_samples for b in floors)


def test_blocks_that_come_again_cut_otherwise_contribute_their_new_samples_alone(tmp_path: Path) -> None:
    site, out, told = tmp_path / "site.toml", tmp_path / "out", Preliminary()
    text = "[processing]\nwindow_s = 20.0\nhop_s = 5.0\n[identification]\nblock_rows = 10\n"
    site.write_text(SHAKEN_SITE + text)
    stream = blocks(shaken(), with_ground=False)
    first = Endless(stream[: len(stream) * 4 // 5], 20)
    first.daemon = Daemon(site, first, [told])
    first.daemon.run()
    Daemon(site, Scripted(blocks(shaken(), with_ground=False, n=70)), [told]).run()
    assert len(told.events) == 1 and not told.gaps
    whole = Session(configuration.load(site), None, (), None, tmp_path)
    for block in stream:
        whole.push(block)
    assert [line["window"] for line in lines(out)] == list(range(whole.windows))
    assert summary(out)["dropped_samples"] == 50 * (len(stream) * 4 // 5)


@pytest.mark.parametrize("checkpoint_s", [0.0, 20.0])
def test_an_acknowledged_alarm_stays_so_with_and_without_checkpoints(
    tmp_path: Path, frame_text: str, checkpoint_s: float
) -> None:
    path = tmp_path / "site.toml"
    path.write_text(f"[state]\ncheckpoint_s = {checkpoint_s}\n[recorder]\nenabled = false\n{frame_text}")
    settings, out = configuration.load(path), tmp_path / "out"
    (out / "state").mkdir(parents=True)
    raised = StoryState(Level.WARNING, since_ns=T0_NS, unacknowledged=True)

    block = SampleBlock("/temperature", T0_NS, 0, 1.0, ("t",), "degC", np.zeros((1, 1), np.float32))

    def raise_it(state: AlarmState) -> AlarmState:
        return replace(state, stories=(state.stories[0], raised, *state.stories[2:]))

    def alarm_of_story_2(change: Callable[[AlarmState], AlarmState] | None) -> StoryState:
        """As a new process finds it; then it is changed, as the data or an operator would."""
        recording, results = Recording(out / "recordings", settings.recorder), AppendedLines(out / "results.jsonl")
        keeper = Checkpointer(out, settings, None, recording, results)
        session = Session(settings, None, (), None, tmp_path)
        keeper.resume(lambda: session, lambda _: None)
        recording.flush(10.0)
        found = session.pipeline.state.alarm.stories[1]
        if change is not None:
            session.alter_alarm(change)
            keeper.took(session, block)
            if checkpoint_s:
                keeper.save(session)
        recording.close(10.0)
        results.close()
        return found

    assert alarm_of_story_2(raise_it) == StoryState()
    assert alarm_of_story_2(lambda state: alarms.acknowledge(state, 2, "ann")) == raised
    assert alarm_of_story_2(None) == replace(raised, unacknowledged=False, acknowledged_by="ann")
    assert (out / "state" / "checkpoint").exists() == bool(checkpoint_s)


@pytest.mark.parametrize(
    ("then", "found"),
    [
        ("shear_frame", (Level.NORMAL, Level.WARNING, Level.ALARM)),
        ("four stories", (Level.NORMAL, Level.WARNING, Level.ALARM, Level.NORMAL, Level.NORMAL)),
        ("modal", (Level.NORMAL, Level.ALARM)),  # the spectrum, and the whole
    ],
)
def test_alarms_that_stand_outlast_another_number_of_stories(
    tmp_path: Path, frame_text: str, then: str, found: tuple[Level, ...]
) -> None:
    """Of three stories, the third of which is then gone, or is one of four, or of a site that judges modes alone."""
    out = tmp_path / "out"
    (out / "state").mkdir(parents=True)
    texts = {
        "shear_frame": shear_frame_text([1.0] * 2, [1e4] * 2),
        "four stories": shear_frame_text([1.0] * 4, [1e4] * 4),
        "modal": '[structure]\nkind = "modal"\n[[sensors]]\nchannel = "a1"\n',
    }

    def alarms_of(text: str, change: Callable[[AlarmState], AlarmState]) -> AlarmState:
        """As a new process finds them; then they are changed."""
        path = tmp_path / "site.toml"
        path.write_text(f"[recorder]\nenabled = false\n{text}")
        settings = configuration.load(path)
        recording, results = Recording(out / "recordings", settings.recorder), AppendedLines(out / "results.jsonl")
        keeper = Checkpointer(out, settings, None, recording, results)
        session = Session(settings, None, (), None, tmp_path)
        keeper.resume(lambda: session, lambda _: None)
        recording.flush(10.0)
        state = session.pipeline.state.alarm
        session.alter_alarm(change)
        keeper.save(session)
        recording.close(10.0)
        results.close()
        return state

    def raise_two(state: AlarmState) -> AlarmState:
        first, _, _, whole = state.stories
        warning, alarm = (
            StoryState(level, since_ns=T0_NS, unacknowledged=True) for level in (Level.WARNING, Level.ALARM)
        )
        return replace(state, stories=(first, warning, alarm, whole))

    alarms_of(frame_text, raise_two)
    state = alarms_of(texts[then], lambda state: state)
    assert tuple(s.level for s in state.stories) == found
    assert any(s.level is Level.ALARM and s.unacknowledged for s in state.stories)
    assert alarms_of(texts[then], lambda state: state).stories == state.stories
