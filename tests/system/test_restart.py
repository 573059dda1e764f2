"""Killed at any moment, the daemon goes on where it was: what it wrote is a replay of what it recorded."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from drivers.base import SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from drivers.recorder import recorded
from monitor.config import configuration
from monitor.core import Level
from monitor.damage import AlarmState, StoryState, load_baseline
from monitor.damage.alarm import acknowledge
from monitor.model import simulate
from monitor.publish import facts_of_line
from monitor.runs import Session
from monitor.service import Daemon, serialization
from monitor.service.appended_lines import AppendedLines
from monitor.service.daemon_health import plain
from monitor.service.restart import Checkpointer, Saved
from monitor.service.threads import Recording
from tests.support.live_site import RATE, SIZE, forked, given
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.site import SITE as BARE_SITE
from tests.support.site import Scripted, run_until
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


@pytest.fixture(scope="module")
def floors(frame_text: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    """A healthy record, and one in which story 2 softens and recovers."""
    path = tmp_path_factory.mktemp("s") / "s.toml"
    path.write_text(frame_text)
    model = configuration.load(path).model()
    weak = path.with_name("weak.toml")
    weak.write_text(frame_text.replace("1514.8507", "900.0"))
    healthy = simulate(model, duration_s=400.0, rate_hz=RATE, noise=0.03, seed=6).floors
    damaged = simulate(configuration.load(weak).model(), duration_s=90.0, rate_hz=RATE, noise=0.03, seed=7).floors
    return healthy, np.concatenate([healthy[: round(90 * RATE)], damaged])


@pytest.fixture
def site(tmp_path: Path, frame_text: str, floors: tuple[np.ndarray, np.ndarray], cut: Cut, main: Cli) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(SITE + frame_text)
    with McapWriter(tmp_path / "healthy.mcap") as writer:
        for block in cut(floors[0], RATE):
            writer.write(block)
    done = main("calibrate", tmp_path / "healthy.mcap", "--structure", path, "--out", tmp_path / "baseline.json")
    assert done.returncode == 0, done.stderr
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


def start(site: Path, *arguments: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", *map(str, arguments)]
    with (site.parent / "log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, cwd=Path(__file__).parents[2])


def kill(process: subprocess.Popen[bytes], after_s: float) -> None:
    time.sleep(after_s)
    process.send_signal(signal.SIGKILL)
    process.wait()


def last_level(results: Path) -> str:
    """Of the last whole line."""
    if not results.exists():
        return ""
    with results.open("rb") as file:
        file.seek(max(0, results.stat().st_size - 20_000))
        _, _, last = file.read().rpartition(b"\n")[0].rpartition(b"\n")
    return str(json.loads(last)["alarm"]["level"]) if last else ""


def kill_at_a_change(process: BaseProcess, results: Path, within_s: float) -> None:
    """At once when an alarm comes, grows or goes, and its line has just been written."""
    deadline, level = time.monotonic() + within_s, last_level(results)
    while time.monotonic() < deadline and last_level(results) == level:
        time.sleep(0.001)
    process.kill()
    process.join()


def wait_for_lines(path: Path, count: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline and (not path.exists() or path.read_bytes().count(b"\n") < count):
        assert process.poll() is None
        time.sleep(0.05)


def lines(path: Path) -> dict[int, str]:
    """By window; each once, in order."""
    texts = (path / "results.jsonl").read_text().splitlines()
    numbers = [json.loads(text)["window"] for text in texts]
    assert numbers == sorted(set(numbers))
    return dict(zip(numbers, texts, strict=True))


def own(out: Path) -> list[Path]:
    return sorted((out / "recordings").glob("*.mcap"))


def kept_s(out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Where the blocks of the recordings begin and end in the stream, s; each is there once."""
    blocks = list(read_recordings(own(out)))
    begin = np.array([b.t_ns - T0_NS for b in blocks]) * 1e-9
    end = begin + np.array([b.n_samples for b in blocks]) / RATE
    assert np.all(begin[1:] > end[:-1] - 1e-6)
    return begin, end


def last_loss(live: dict[int, str], alarm: dict[str, Any]) -> float:
    """Loss of an alarm's story in the last line at the alarm's level where the loss is beyond two standard deviations.

    Without such a line it is that of the alarm's first.
    """
    j, until = alarm["story"] - 1, alarm["t_last_ns"] or np.inf
    parsed = [json.loads(text) for text in live.values()]
    during = [line for line in parsed if alarm["t_first_ns"] <= line["t_end_ns"] < until and line["ddi"] is not None]
    stated = [
        line for line in during if line["alarm"]["level"] == alarm["level"] and line["ddi"][j] > 2 * line["ddi_std"][j]
    ]
    return float((stated or during[:1])[-1]["ddi"][j])


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
    done = main("replay", *own(out), "--structure", site, "--baseline", site.parent / "baseline.json", "--out", again)
    assert done.returncode == 0, done.stderr
    live, replayed = lines(out), lines(again)
    assert replayed.keys() <= live.keys()
    begin, end = kept_s(out)
    toll.lost_s = [taken - max(first, end[end <= taken + 1e-6].max()) for first, taken in toll.lives_s]
    level = "normal"
    for number, text in live.items():
        line = json.loads(text)
        if text != replayed.get(number):
            t_s = (line["t_end_ns"] - T0_NS) * 1e-9
            assert np.any((end[:-1] < t_s) & (t_s <= begin[1:] + 1e-3)), line
            assert line["alarm"]["level"] == level  # nothing that an operator would miss
            toll.not_replayed += 1
        level = line["alarm"]["level"]
    told, wanted = (plain(json.loads((p / "summary.json").read_text())) for p in (out, again))
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
    session.stated = {number: facts_of_line(json.loads(text)) for number, text in lines(site.parent / "out").items()}
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
    """Each fifth kill comes while the daemon starts, each tenth when an alarm changes, if one does in a while.

    The daemons are forked from a process that has imported all there is, so that most of a life is work.
    """
    folder, draw, toll = site.parent, random.Random(seed), Toll()
    np.save(folder / "stream.npy", stream.astype(np.float32))
    position, results = folder / "position", folder / "out" / "results.jsonl"
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.support.live_site"])

    def begin(missed: int) -> BaseProcess:
        arguments = [str(a) for a in (site, folder / "stream.npy", position, pace_s, missed)]
        process = processes.Process(target=forked, args=(folder / "log", arguments))
        process.start()
        return process

    process, taken, missed = begin(0), 0, 0
    wait_for(lambda: results.exists() and results.read_bytes().count(b"\n") >= 3, process, folder)
    for number in range(kills):
        if number % 10 == 8:
            kill_at_a_change(process, results, 2.0 * longest_s)
        else:
            time.sleep(draw.uniform(0.0, 0.5 if number % 5 == 4 else longest_s))
            assert process.is_alive(), (folder / "log").read_text()
            process.kill()
            process.join()
        first, taken = taken + missed, given(position)
        toll.lives_s.append((min(first, taken) * SIZE / RATE, taken * SIZE / RATE))
        missed = draw.choice([0, 0, 0, 0, 3, 20, 20, 100])
        process = begin(missed)
        if number % 5 != 3:  # the next kill comes while it starts
            wait_for(lambda taken=taken: given(position) > taken, process, folder)
    time.sleep(2.0)
    process.terminate()
    process.join(60.0)
    assert process.exitcode == 0
    check(site, main, toll)
    return toll


def wait_for(condition: Callable[[], bool], process: BaseProcess, folder: Path) -> None:
    deadline = time.monotonic() + 120.0
    while not condition():
        assert process.is_alive() and time.monotonic() < deadline, (folder / "log").read_text()
        time.sleep(0.01)


def test_ten_kills(site: Path, floors: tuple[np.ndarray, np.ndarray], main: Cli) -> None:
    toll = run_with_kills(site, floors[1], main, 10, 1, FAST_S, 1.0)
    log = (site.parent / "log").read_text()
    assert "not resumed" not in log and "Traceback" not in log
    assert toll.windows > 20


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_two_hundred_kills(site: Path, floors: tuple[np.ndarray, np.ndarray], main: Cli) -> None:
    text = site.read_text().replace("flush_s = 1.0", "flush_s = 10.0")
    site.write_text(text.replace("latching = true", "latching = false\nclear_s = 10.0"))  # so that many come and go
    toll = run_with_kills(site, floors[1], main, 200, int(os.environ.get("SEED", "2")), STEADY_S, 8.0)
    log = (site.parent / "log").read_text()
    lost = sorted(toll.lost_s)
    print(
        f"{len(lost)} kills, {toll.windows} windows, {toll.episodes} alarms, {toll.not_replayed} windows told of lost samples; "
        f"lost of the stream: median {lost[len(lost) // 2]:.1f} s, most {lost[-1]:.1f} s of data"
    )
    assert "not resumed" not in log and "Traceback" not in log
    assert toll.episodes >= 2
    assert lost[-1] <= 10.0 + 1.0  # besides `flush_s`, what was on its way


@pytest.mark.parametrize("checkpoint_s", [20.0, 1e4])
def test_a_recording_as_source_goes_on_and_nothing_shows(
    site: Path, floors: tuple[np.ndarray, np.ndarray], cut: Cut, main: Cli, checkpoint_s: float
) -> None:
    """Also where the first checkpoint is not due before the end."""
    site.write_text(site.read_text().replace("checkpoint_s = 20.0", f"checkpoint_s = {checkpoint_s}"))
    folder, draw = site.parent, random.Random(3)
    with McapWriter(folder / "rec.mcap") as writer:
        for block in cut(floors[1], RATE):
            writer.write(block)
    out, healthy = folder / "out", folder / "baseline.json"
    for _ in range(3):
        process = start(site, "monitor", "run", site)
        count = (out / "results.jsonl").read_bytes().count(b"\n") if (out / "results.jsonl").exists() else 0
        wait_for_lines(out / "results.jsonl", count + 2, process)
        kill(process, draw.uniform(0.0, 0.3))
    assert start(site, "monitor", "run", site).wait(120.0) == 0
    done = main("replay", folder / "rec.mcap", "--structure", site, "--baseline", healthy, "--out", folder / "again")
    assert done.returncode == 0, done.stderr
    assert (out / "results.jsonl").read_bytes() == (folder / "again" / "results.jsonl").read_bytes()
    told, wanted = (plain(json.loads((p / "summary.json").read_text())) for p in (out, folder / "again"))
    assert told["alarms"] and told["alarms"] == wanted["alarms"] and told["quality"] == wanted["quality"]
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
    found = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    told = json.loads((out / "summary.json").read_text())
    assert [line["window"] for line in found] == list(range(len(found))) and len(found) > 12
    assert all(line["skipped"] is None for line in found[:9])
    assert told["windows"] == len(found)
    assert told["skipped"] == sum(line["skipped"] is not None for line in found) > 0
    assert sum(told["skip_reasons"].values()) == told["skipped"]


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
        recording, lines = Recording(out / "recordings", settings.recorder), AppendedLines(out / "results.jsonl")
        keeper = Checkpointer(out, settings, None, recording, lines)
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
        lines.close()
        return found

    assert alarm_of_story_2(raise_it) == StoryState()
    assert alarm_of_story_2(lambda state: acknowledge(state, 2, "ann")) == raised
    assert alarm_of_story_2(None) == replace(raised, unacknowledged=False, acknowledged_by="ann")
    assert (out / "state" / "checkpoint").exists() == bool(checkpoint_s)
