"""Sites of a process: who is evaluated next, what becomes of one that fails or ends, and what `run` keeps as a host of one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import ACCELERATION, SampleBlock, SourceError
from monitor.core import MissingInputError, WindowResult
from monitor.service import logs
from monitor.service.dataset import site_folders
from monitor.service.host_metrics import HostMetrics
from monitor.service.outlets import Outlet
from monitor.service.schedule import Line, Runner, Schedule, State
from monitor.service.site import Site
from monitor.service.supervisor import ALONE, Host, Policy
from monitor.service.threads import BlockQueue
from tests.support.live_rig import ROOT
from tests.support.samples import Cli, Cut
from tests.support.site import RATE, SITE, Daemon, Scripted, lines, write
from tests.support.waiting import until


def block(seconds: float = 1.0) -> SampleBlock:
    n = round(100 * seconds)
    return SampleBlock(ACCELERATION, 0, 0, 100.0, ("a1",), "m/s^2", np.zeros((n, 1), np.float32))


def runner(name: str, site: Any = None) -> Runner:
    return Runner(name, site, BlockQueue(), lambda: None)


def served(line: Line, places: list[Runner], *, cost_s: float) -> list[str]:
    """Names of the sites in the order in which their blocks are evaluated."""
    order = []
    for one in places:
        line.join(one)
    while (one := line.next()) is not None:
        item = one.queue.take(0.0)
        order.append(one.name)
        line.spend(one, item[1], item[0].n_samples / item[0].sample_rate_hz, cost_s)
        line.join(one)
    return order


def test_who_came_first_is_evaluated_first() -> None:
    places = [runner(name) for name in "abc"]
    for one in (places[2], places[0], places[1]):
        one.queue.put(block())
        time.sleep(0.002)  # the clock of arrivals moves on
    assert served(Line(), places, cost_s=0.0) == ["c", "a", "b"]


def test_a_flood_costs_the_others_one_block() -> None:
    flood, calm = runner("flood"), runner("calm")
    for _ in range(50):
        flood.queue.put(block(10.0))
    time.sleep(0.002)
    for _ in range(3):
        calm.queue.put(block(0.01))
    order = served(Line(), [flood, calm], cost_s=1e-4)
    assert order[:4] == ["flood", "calm", "calm", "calm"]
    assert order.count("flood") == 50  # and nothing of it is lost


def test_blocks_that_cost_much_for_little_data_wait_too() -> None:
    heavy, calm = runner("heavy"), runner("calm")
    for _ in range(5):
        heavy.queue.put(block(0.01))
    calm.queue.put(block())
    assert served(Line(), [heavy, calm], cost_s=5.0)[:2] == ["heavy", "calm"]


def test_the_log_names_a_site_only_while_its_work_is_done() -> None:
    seen = list[str | None]()

    class Failing:
        """A site whose disk is gone."""

        def take(self, *_: object) -> None:
            seen.append(logs.site_name.get())
            raise OSError("no disk")

    schedule, one = Schedule(lambda: 0.0, 0.0, 0.001), runner("tower", Failing())
    one.queue.put(block())
    schedule.tell_arrival(one)
    schedule.turn()
    assert seen == ["tower"] and logs.site_name.get() is None
    assert one.is_over and "no disk" in str(one.error)


@pytest.mark.parametrize("present", State)
def test_the_metrics_say_of_every_state_whether_a_site_is_in_it(present: State) -> None:
    metrics = HostMetrics(("127.0.0.1", 0), lambda: [("tower", present, None)])
    try:
        (family,) = metrics.collect()
    finally:
        metrics.close(1.0)
    assert {sample.labels["is"]: sample.value for sample in family.samples} == {
        state.value: float(state is present) for state in State
    }


def test_a_site_that_cannot_begin_to_read_is_started_again_and_the_others_run_on(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [tmp_path / name / "site.toml" for name in "ab"]
    for path in paths:
        path.parent.mkdir()
        path.write_text(SITE.replace("bench", path.parent.name) + frame_text)
        write(path.parent / "rec.mcap", cut(record[:2600], 128.0))
    begin, failed, hurried = Site.start, [], list[Site]()

    def start(site: Site) -> None:
        if site.settings.site_name == "a" and not failed:
            failed.append(site)
            raise RuntimeError("can't start new thread")
        begin(site)

    monkeypatch.setattr(Site, "start", start)
    monkeypatch.setattr(Site, "ask_to_stop", lambda site: hurried.append(site))
    host = Host(paths, Policy(), clock=lambda: 10.0 * time.monotonic(), say=lambda _: None)
    host.run()
    assert failed and [(one.state, one.error) for one in host.places.values()] == [(State.OVER, None)] * 2
    assert [len(lines(path.parent / "out")) for path in paths] == [1, 1]
    assert not hurried, "where data end, their last diagnosis is waited for"


def test_a_pipe_among_the_site_files_is_told_and_keeps_no_other_from_starting(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    folder, said = tmp_path / "sites", list[str]()
    folder.mkdir()
    (folder / "good.toml").write_text(SITE + frame_text)
    write(folder / "rec.mcap", cut(record[:2600], 128.0))
    os.mkfifo(folder / "a-pipe.toml")

    def say(word: str) -> None:
        said.append(word)
        if len(said) == 1:  # a second signal ends the process at once
            os.kill(os.getpid(), signal.SIGTERM)

    late = threading.Timer(20.0, say, ["late"])
    late.start()
    Host([folder], Policy(), say=say).run()
    late.cancel()
    assert said[0] == "READY" and (folder / "out" / "results.jsonl").exists()
    told = [r.getMessage() for r in caplog.records if r.getMessage().startswith("a-pipe")]
    assert told[0] == f"a-pipe fails: {folder / 'a-pipe.toml'}: is no regular file; name another place"
    assert site_folders([folder]) == {"bench": folder / "out"}


def test_a_pipe_that_is_named_as_site_file_is_one_message(tmp_path: Path, main: Cli) -> None:
    os.mkfifo(tmp_path / "site.toml")
    done = main("host", tmp_path / "site.toml")
    assert done.returncode == 66 and done.stderr.count("\n") == 1 and "site.toml: is no regular file" in done.stderr


def ask_to_end(*_: object) -> None:
    """As systemd does; a second time would end the tests at once."""
    os.kill(os.getpid(), signal.SIGTERM)


def test_a_site_that_fails_ends_run_with_its_error_and_is_not_tried_again(
    site: Path, record: np.ndarray, cut: Cut, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(Outlet):
        def window(self, result: WindowResult, line: str) -> None:
            raise MissingInputError("no such window")

    source = Scripted(cut(record, RATE), hold=threading.Event())
    with pytest.raises(MissingInputError, match="no such window"):
        Daemon(site, source, [Broken()]).run()
    assert (source.opened, source.closed) == (1, 1) and capsys.readouterr().err == "READY\n"
    assert not [r for r in caplog.records if "bench" in r.getMessage()], "the command line tells it once"
    Daemon(site, Scripted([])).run()  # its folder is free


def test_run_says_ready_only_once_its_source_is_open(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A host says it also where it was told why a source is not open."""
    said = list[str]()

    class Shut(Scripted):
        def open(self) -> None:
            super().open()
            if self.opened < 3:
                raise SourceError("no router")
            said.append(capsys.readouterr().err)

    Daemon(site, Shut([])).run()
    assert said == [""] and capsys.readouterr().err == "READY\n"


def test_sighup_has_run_read_its_file_again(site: Path, caplog: pytest.LogCaptureFixture) -> None:
    def script() -> Iterator[None]:
        site.write_text(site.read_text() + "\n[alarm]\nmin_loss = 0.07\n")
        os.kill(os.getpid(), signal.SIGHUP)
        until(lambda: f"reloaded {site}" in caplog.text, "the file is read again")
        yield None

    Daemon(site, Scripted(script())).run()


def test_a_second_sigterm_ends_run_at_once(site: Path, tmp_path: Path) -> None:
    """The first waits for the source, which hangs, and for the parts."""
    command = [sys.executable, "-m", "tests.service.hung_site", str(site)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stderr is not None and process.stderr.readline() == "READY\n"
        process.send_signal(signal.SIGTERM)
        assert process.stderr.readline() == "stopping\n"
        process.send_signal(signal.SIGTERM)
        begun_s = time.monotonic()
        assert process.wait(60.0) == -signal.SIGTERM and time.monotonic() - begun_s < 1.0


@pytest.mark.parametrize("policy", [ALONE, Policy()])
def test_sigterm_ends_a_site_that_waits_for_its_last_diagnosis(site: Path, policy: Policy) -> None:
    waited = list[bool]()

    def finish(is_to_stop: Callable[[], bool]) -> None:
        ask_to_end()
        until(is_to_stop, "it is asked to end")
        waited.append(True)

    def script() -> Iterator[None]:
        until(lambda: host.places[site].state is State.RUNNING, "it runs")
        host.places[site].runner.site.session.finish = finish  # type: ignore[union-attr, assignment, method-assign]
        yield None

    host = Host([site], policy, source=Scripted(script()), say=lambda _: None)
    host.run()
    assert waited == [True]


def test_a_site_that_cannot_start_is_tried_again_after_pauses_that_grow(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "bad.toml").write_text("[site\n")

    def told() -> list[str]:
        return [r.getMessage() for r in caplog.records if "again" in r.getMessage()]

    def clock() -> float:
        if len(told()) == 2 and not ended:
            ended.append(True)
            ask_to_end()
        return time.monotonic()

    ended = list[bool]()
    Host([tmp_path], Policy(), clock=clock, say=lambda _: None).run()
    assert told() == ["bad is started again in 1 s", "bad is started again in 2 s"]
