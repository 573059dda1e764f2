"""What operators have: status, requests, reload, metrics, logs, and warnings of open doors."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from monitor.config import LogSettings, configuration, security_check
from monitor.core import BadConfigurationError, MissingInputError
from monitor.model import simulate
from monitor.service import logs
from monitor.service.logs import LineFormatter
from monitor.service.outlets import inbox
from monitor.service.outlets.inbox import Inbox
from monitor.service.outlets.metrics import reason_class
from monitor.service.reload import changed
from monitor.service.requests import Answer, Request
from monitor.service.status import look
from monitor.service.threads import Chores
from tests.support.live_site import RATE
from tests.support.samples import Cli
from tests.support.strangers import as_a_stranger
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

DEPLOY = Path(__file__).parents[2] / "deploy"
SITE = """
[site]
name = "bench"

[source]
kind = "mcap"
files = ["rec.mcap"]

[output]
dir = "out"

[output.metrics]
listen = "127.0.0.1:{port}"

[recorder]
min_free_gb = 0.0

[log]
format = "json"

[watch]
diagnose = false

[alarm]
alarm_loss = 0.10
"""


@dataclass
class Running:
    site: Path
    port: int
    process: subprocess.Popen[bytes]

    @property
    def log(self) -> str:
        return (self.site.parent / "log").read_text()


@pytest.fixture(scope="module")
def running(frame_text: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A daemon on an endless stream, twenty times as fast as the clock."""
    folder, port = tmp_path_factory.mktemp("site"), free_port()
    site = folder / "site.toml"
    site.write_text(SITE.format(port=port) + frame_text)
    floors = simulate(configuration.load(site).model(), duration_s=60.0, rate_hz=RATE, noise=0.03, seed=6).floors
    np.save(folder / "stream.npy", floors.astype(np.float32))
    arguments = [site, folder / "stream.npy", folder / "position", 0.025, 0, 0.5]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.live_site", *map(str, arguments)],
            stderr=log,
            cwd=Path(__file__).parents[2],
        )
    yield_ = Running(site, port, process)
    try:
        until(lambda: (folder / "out" / "results.jsonl").exists() or process.poll() is not None, "a folder")
        until(lambda: (folder / "out" / "results.jsonl").read_text(), "a first window")
        until(lambda: (folder / "out" / "health.jsonl").read_text(), "health is told")
        yield yield_
    finally:
        process.kill()
        process.wait()


def test_status_tells_in_ten_lines(running: Running, main: Cli) -> None:
    out = running.site.parent / "out"
    until(lambda: "% against the structure file" in main("status", out).stdout, "a judged window")
    until(lambda: "No baseline to compare with" in main("status", out).stdout.splitlines()[0], "a state of windows")
    until(lambda: "available" in main("status", out).stdout, "a line of health")
    for place in (running.site, out):
        done = main("status", place)
        assert done.returncode == 11, done.stdout + done.stderr
        rows = done.stdout.splitlines()
        assert len(rows) <= 12 and rows[0].startswith("state     NOT JUDGED: No baseline to compare with")
        assert "running, up" in rows[1] and rows[1].endswith("; all parts work") and "100.00 % available" in done.stdout
        assert "% against the structure file" in done.stdout and "no baseline, so none can be raised" in done.stdout
    found = json.loads(main("status", out, "--json").stdout)
    assert found["running"] and found["exit_code"] == 11 and found["health"]["source"]["connected"]
    assert (found["state"], found["monitor"], found["doubts"]) == ("not_judged", "running", [])


def test_a_request_is_applied_and_noted(running: Running, main: Cli) -> None:
    ledger = running.site.parent / "out" / "ledger.jsonl"
    done = main("ack", running.site, "--story", 2, "--who", "ann", "--note", "works on the roof", "--shelve", 2)
    assert done.returncode == 0 and "applied" in done.stdout, done.stdout + done.stderr
    assert "works on the roof" in ledger.read_text() and "ann" in ledger.read_text()
    until(lambda: "shelved" in main("status", running.site).stdout, "status knows")
    assert main("ack", running.site, "--story", 2, "--who", "ann", "--unshelve").returncode == 0
    for wrong in (
        ("--story", 9, "--who", "x"),
        ("--story", 1, "--who", "x", "--shelve", 2),
        ("--story", 1, "--who", "x", "--reset", "--unshelve"),
    ):
        done = main("ack", running.site, *wrong)
        assert done.returncode == 2 and done.stderr.startswith("error"), done.stderr


def test_a_request_that_the_daemon_refuses_is_not_called_applied(running: Running, main: Cli) -> None:
    done = main("ack", running.site, "--event", "20260101T000000Z", "--who", "ann", "--json")
    assert done.returncode == 2 and not done.stdout, done.stdout + done.stderr
    assert "refused: event 20260101T000000Z has no alarm; to be acknowledged: none" in done.stderr
    assert not list((running.site.parent / "out" / "state" / "requests").iterdir())


def test_metrics_are_there_and_few(running: Running) -> None:
    def scrape() -> dict[str, float]:
        with urllib.request.urlopen(f"http://127.0.0.1:{running.port}/metrics", timeout=10.0) as answer:
            text = answer.read().decode()
        return {
            s.name + "".join(f"|{v}" for v in s.labels.values()): s.value
            for family in text_string_to_metric_families(text)
            for s in family.samples
        }

    until(lambda: scrape().get("shm_windows_total", 0) > 0, "windows are counted")
    seen = scrape()
    assert seen["shm_source_connected"] == seen["shm_recorder_recording"] == 1
    assert seen["shm_state|not_judged"] == 1 and sum(v for name, v in seen.items() if "shm_state|" in name) == 1
    assert seen["shm_latency_seconds_bucket|+Inf"] > 0 and seen["shm_samples_total"] > 0
    assert len(seen) < 150


def test_a_skipped_window_s_reason_has_its_class() -> None:
    reasons = {
        "gap in the data": "gap",
        "channel a1 does not move": "dead_channel",
        "channel a1 is stuck (20 % of the window)": "stuck_channel",
        "channel a1 is clipped (60 % of its samples)": "clipped_channel",
        "response too close to the noise (spectral flatness 0.97)": "noise",
        "every mode of the model lies beyond the band; check the units of masses and stiffness": "beyond_band",
        "mode 2 (5.67 Hz by the model): no stable pole near it": "modes",
        "no order shows every mode": "modes",
        "model updating did not converge with mode 3 (5.67 Hz by the model, 6.68 Hz in the data)": "updating",
        "whatever comes": "other",
    }
    assert {reason: reason_class(reason) for reason in reasons} == reasons


def test_a_changed_threshold_is_taken_over_and_nothing_else(running: Running) -> None:
    text = running.site.read_text()
    try:
        running.site.write_text(text.replace("alarm_loss = 0.10", "alarm_loss = 0.20"))
        running.process.send_signal(signal.SIGHUP)
        until(lambda: "reloaded" in running.log, "it is read again")
        running.site.write_text(text.replace("hop_s = 5.0", "hop_s = 2.0"))
        running.process.send_signal(signal.SIGHUP)
        until(lambda: "not reloaded" in running.log, "it is refused")
        assert "[processing] changed" in running.log
        running.site.write_text("[[")
        running.process.send_signal(signal.SIGHUP)
        until(lambda: running.log.count("not reloaded") == 2, "it is refused")
    finally:
        running.site.write_text(text)
    assert running.process.poll() is None
    for row in running.log.splitlines():
        if row != "READY":
            assert json.loads(row)["site"] == "bench"


def test_the_end_is_told(running: Running, main: Cli) -> None:
    running.process.terminate()
    assert running.process.wait(30.0) == 0
    done = main("status", running.site)
    assert done.returncode == 12 and "not running" in done.stdout
    assert done.stdout.startswith("state     NOT JUDGED: The monitor does not run since 20")
    rows = dict(row.split(maxsplit=1) for row in done.stdout.splitlines())
    assert re.match(r"ended at 20[-0-9]+ [0-9:]+ UTC, 0 blocks lost", rows["recorder"])
    assert re.match(r"ended at 20[-0-9]+ [0-9:]+ UTC; (data until 20|no data in)", rows["source"])
    assert main("status", running.site.parent / "nothing").returncode == 66
    with pytest.raises(MissingInputError, match="no daemon has written"):
        look(running.site.parent)


def test_status_takes_only_lines_that_are_the_monitor_s(tmp_path: Path, main: Cli) -> None:
    (tmp_path / "state").mkdir()
    own = json.dumps({"t_end_ns": 1_767_225_600 * 10**9, "skipped": "gap in the data"})
    for last, says in (
        ("{}", "none yet"),
        (f"{own}\n[1]", "gap in the data"),
        (f'{own}\n{{"a": 1}}', "gap in the data"),
    ):
        for name in ("results.jsonl", "health.jsonl"):
            (tmp_path / name).write_text(last + "\n")
        done = main("status", tmp_path)
        assert done.returncode == 12 and says in done.stdout, done.stdout + done.stderr


def test_a_request_to_a_site_that_never_ran_is_refused_and_leaves_nothing(
    tmp_path: Path, frame_text: str, main: Cli
) -> None:
    (tmp_path / "site.toml").write_text(SITE.format(port=1) + frame_text)
    done = main("ack", tmp_path / "site.toml", "--story", 1, "--who", "ann")
    assert done.returncode == 66 and "no daemon has written here" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["site.toml"]


def test_only_some_tables_may_change(tmp_path: Path, frame_text: str) -> None:
    path = tmp_path / "site.toml"
    path.write_text(SITE.format(port=1) + frame_text)
    now = configuration.load(path)
    path.write_text(path.read_text().replace("diagnose = false", "diagnose = true"))
    assert changed(path, now).watch.diagnose
    path.write_text(path.read_text().replace('name = "bench"', 'name = "other"'))
    with pytest.raises(BadConfigurationError, match=r"\[site\] changed"):
        changed(path, now)


@pytest.mark.parametrize("key", ["longest_s", "time_limit_s"])
def test_what_diagnoses_were_begun_with_needs_a_restart(tmp_path: Path, frame_text: str, key: str) -> None:
    path = tmp_path / "site.toml"
    path.write_text(SITE.format(port=1) + frame_text)
    now = configuration.load(path)
    path.write_text(path.read_text().replace("diagnose = false", f"diagnose = false\n{key} = 900.0\nmisfit = 7.0"))
    with pytest.raises(BadConfigurationError, match=rf": \[watch\] {key} changed; restart"):
        changed(path, now)
    path.write_text(path.read_text().replace(f"{key} = 900.0\n", ""))
    assert changed(path, now).watch.misfit == 7.0


def taken(box: Inbox) -> Sequence[Request]:
    """The requests in a folder, each answered as applied."""
    requests = box.take_requests()
    box.answer_requests([Answer()] * len(requests))
    return requests


def test_files_that_are_no_requests_are_removed_unread(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder, box = tmp_path / "requests", Inbox(tmp_path / "requests")
    inbox.leave_request(folder, Request(action="reset", story=1, who="ann"))
    secret = tmp_path / "secret"
    secret.write_text('{"action": "reset", "story": 1, "who": "mallory"}')
    (folder / "1.json").symlink_to(secret)
    os.mkfifo(folder / "2.json")
    (folder / "3.json").write_bytes(b"x" * 5000)
    (folder / "4.json").write_bytes(b'{"action": "rm"}')
    (folder / "5.txt").write_text("not mine")
    assert [r.who for r in taken(box)] == ["ann"]
    box.close(1.0)
    assert sorted(p.name for p in folder.iterdir()) == ["5.txt"] and secret.exists()
    assert caplog.text.count("no request") == 4


def test_a_folder_that_does_not_answer_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a look at it nor the removal of what was answered; then each request is taken once."""
    answers, names, unlink = threading.Event(), os.listdir, Path.unlink
    folder, worker = tmp_path / "requests", Chores("requests")
    box = Inbox(folder, worker=worker)

    def listed(place: Path) -> list[str]:
        answers.wait(60.0)
        return names(place)

    def removed(path: Path, missing_ok: bool = False) -> None:
        answers.wait(60.0)
        unlink(path, missing_ok)

    monkeypatch.setattr(os, "listdir", listed)
    monkeypatch.setattr(Path, "unlink", removed)
    inbox.leave_request(folder, Request(action="reset", story=1, who="ann"))
    begun_s = time.monotonic()
    assert list(box.take_requests()) == []
    answers.set()
    found: list[Request] = []
    until(lambda: found.extend(box.take_requests()) or found, "taken")
    answers.clear()
    box.answer_requests([Answer()] * len(found))
    assert list(box.take_requests()) == [] and time.monotonic() - begun_s < 30.0
    answers.set()
    box.close(10.0)
    assert len(found) == 1 and not names(folder)


def test_a_job_that_fails_is_told_and_those_after_it_are_done(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    worker = Chores("chores")
    worker.do("bad", (tmp_path / "nowhere").read_text)  # type: ignore[arg-type]
    worker.write(tmp_path / "good", "text")
    worker.close(30.0)
    assert (tmp_path / "good").read_text() == "text"
    (told,) = caplog.messages
    assert told.startswith("chores: FileNotFoundError: ")


def test_a_request_that_cannot_be_removed_is_applied_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied")

    box = Inbox(tmp_path / "requests", every_s=0.0)
    monkeypatch.setattr(Path, "unlink", refused)
    inbox.leave_request(tmp_path / "requests", Request(action="reset", story=1, who="ann"))
    assert [len(taken(box)) for _ in range(4)] == [1, 0, 0, 0]
    inbox.leave_request(tmp_path / "requests", Request(action="reset", story=2, who="ann"))
    assert [[r.story for r in taken(box)] for _ in range(3)] == [[2], [], []]
    assert caplog.text.count("cannot be removed") == 2


@pytest.mark.skipif(os.geteuid() != 0, reason="only root asks for others")
def test_what_root_asks_belongs_to_the_daemon(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    os.chown(state, 12345, 12346)
    before = os.umask(0o077)
    try:
        place = inbox.leave_request(state / "requests", Request(action="reset", story=1, who="ann"))
    finally:
        os.umask(before)
    for path in (place.parent, place):
        assert (path.stat().st_uid, path.stat().st_gid) == (12345, 12346), path
    assert place.stat().st_mode & 0o777 == 0o644


def test_what_a_stranger_may_not_read_is_told_and_no_wrong_usage(tmp_path: Path, frame_text: str, main: Cli) -> None:
    closed = tmp_path / "closed"
    site = closed / "site.toml"
    closed.mkdir()
    site.write_text(SITE.format(port=1) + frame_text)
    commands = [
        ("status", site),
        ("status", closed),
        ("ack", site, "--story", 1, "--who", "x"),
        ("check", site),
        ("export", closed, "--out", tmp_path / "a.csv"),
        ("report", closed, "--out", tmp_path / "r"),
        ("replay", site, "--structure", DEPLOY / "mcap.toml", "--out", tmp_path / "o"),
        ("calibrate", DEPLOY / "frame.dbc", "--structure", site, "--out", tmp_path / "b.json"),
        ("run", site),
    ]
    for command in commands:  # everything is imported while that is allowed
        main(*command)
    for path in (closed, tmp_path):
        path.chmod(0o700)
    try:
        with as_a_stranger():
            done = [main(*command) for command in commands]
    finally:
        closed.chmod(0o755)
    assert [d.returncode for d in done] == [66] * len(commands), done
    assert all("ermission denied" in d.stderr for d in done), done


@pytest.mark.parametrize("style", ["text", "json"])
def test_an_event_is_one_line_whatever_it_holds(style: str) -> None:
    formatter = LineFormatter(style, "bench")  # type: ignore[arg-type]
    text = 'two\nlines\x1b[2J\u2028 "quoted" = ' + "x" * 10_000
    record = logging.LogRecord("a.b", logging.WARNING, "", 0, "%s", (text,), None)
    row = formatter.format(record)
    assert row.isprintable() and len(row) < 6000
    record.msg, record.args = "lost 12.4 ± 0.7 m/s² in Übergeschoß", ()
    told = formatter.format(record)
    assert record.msg in (told if style == "text" else json.loads(told)["message"])
    assert "site=bench" in row if style == "text" else json.loads(row)["message"].startswith("two\nlines")


def test_the_end_of_a_thread_is_one_line(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    logs.begin(LogSettings(), "bench")
    thread = threading.Thread(target=Path("/nowhere/two\nlines").read_text, name="t")
    thread.start()
    thread.join()
    row = capfd.readouterr().err
    assert row.count("\n") == 1 and "thread t ended" in row and "FileNotFoundError" in row


def test_open_doors_are_named(tmp_path: Path, frame_text: str, main: Cli) -> None:
    path = tmp_path / "site.toml"
    text = SITE.format(port=1) + frame_text
    path.write_text(text)
    assert not security_check.warnings(path, configuration.load(path))
    urls = tmp_path / "urls"
    urls.write_text("")
    urls.chmod(0o644)
    text = text.replace("127.0.0.1:1", "0.0.0.0:9464").replace('dir = "out"', 'dir = "out"\nserve = "0.0.0.0:9876"')
    text = text.replace(
        'kind = "mcap"\nfiles = ["rec.mcap"]', 'kind = "zenoh"\nkey = "a/b"\nmode = "peer"\nlisten = ["tcp/[::]:7447"]'
    )
    path.write_text('notify = {url_file = "urls"}\n' + text)
    found = security_check.warnings(path, configuration.load(path))
    assert [w.partition(":")[0] for w in found] == [
        "output.serve",
        "output.metrics",
        "source.listen",
        "notify.url_file",
    ]
    done = main("check", path)
    assert done.returncode == 0 and done.stderr.count("warning") >= 4
