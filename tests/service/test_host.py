"""The line of sites: who came first goes first, and a site that sends too much waits behind the others."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION, SampleBlock
from monitor.runs import site_folders
from monitor.service import logs
from monitor.service.host import Host
from monitor.service.host_metrics import HostMetrics
from monitor.service.schedule import Line, Place, State, named_in_the_log
from monitor.service.site import Site
from monitor.service.threads import BlockQueue
from tests.support.samples import Cli, Cut
from tests.support.site import SITE, lines, write


def block(seconds: float = 1.0) -> SampleBlock:
    n = round(100 * seconds)
    return SampleBlock(ACCELERATION, 0, 0, 100.0, ("a1",), "m/s^2", np.zeros((n, 1), np.float32))


def place(name: str) -> Place:
    return Place(Path(f"{name}.toml"), name, None, queue=BlockQueue())


def served(line: Line, places: list[Place], *, cost_s: float) -> list[str]:
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
    places = [place(name) for name in "abc"]
    for one in (places[2], places[0], places[1]):
        one.queue.put(block())  # type: ignore[union-attr]
        time.sleep(0.002)  # the clock of arrivals moves on
    assert served(Line(), places, cost_s=0.0) == ["c", "a", "b"]


def test_a_flood_costs_the_others_one_block() -> None:
    flood, calm = place("flood"), place("calm")
    for _ in range(50):
        flood.queue.put(block(10.0))  # type: ignore[union-attr]
    time.sleep(0.002)
    for _ in range(3):
        calm.queue.put(block(0.01))  # type: ignore[union-attr]
    order = served(Line(), [flood, calm], cost_s=1e-4)
    assert order[:4] == ["flood", "calm", "calm", "calm"]
    assert order.count("flood") == 50  # and nothing of it is lost


def test_blocks_that_cost_much_for_little_data_wait_too() -> None:
    heavy, calm = place("heavy"), place("calm")
    for _ in range(5):
        heavy.queue.put(block(0.01))  # type: ignore[union-attr]
    calm.queue.put(block())  # type: ignore[union-attr]
    assert served(Line(), [heavy, calm], cost_s=5.0)[:2] == ["heavy", "calm"]


def test_the_log_names_a_site_only_while_its_work_is_done() -> None:
    seen = []

    @named_in_the_log
    def work(_host: object, _place: Place) -> None:
        seen.append(logs.site_name.get())
        raise OSError("no disk")

    with pytest.raises(OSError, match="no disk"):
        work(None, place("tower"))  # type: ignore[arg-type]
    assert seen == ["tower"] and logs.site_name.get() is None


@pytest.mark.parametrize("present", State)
def test_the_metrics_say_of_every_state_whether_a_site_is_in_it(present: State) -> None:
    metrics = HostMetrics(("127.0.0.1", 0), lambda: {"tower": present})
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
        if site.out.parent.name == "a" and not failed:
            failed.append(site)
            raise RuntimeError("can't start new thread")
        begin(site)

    monkeypatch.setattr(Site, "start", start)
    monkeypatch.setattr(Site, "ask_to_stop", lambda site: hurried.append(site))
    host = Host(paths, clock=lambda: 10.0 * time.monotonic(), say=lambda _: None)
    host.run()
    assert failed and [(one.is_over, one.failure) for one in host.places] == [(True, "")] * 2
    assert [len(lines(path.parent / "out")) for path in paths] == [1, 1]
    assert not hurried, "where data end, their last diagnosis is waited for"


def test_a_pipe_among_the_site_files_is_left_out_and_told(
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
    Host([folder], say=say).run()
    late.cancel()
    assert said[0] == "READY" and (folder / "out" / "results.jsonl").exists()
    told = [r.getMessage() for r in caplog.records if "a-pipe" in r.getMessage()]
    assert told == [f"{folder / 'a-pipe.toml'} is left out: it is no regular file; name another place"]
    assert site_folders([folder]) == {"bench": folder / "out"}


def test_a_pipe_that_is_named_as_site_file_is_one_message(tmp_path: Path, main: Cli) -> None:
    os.mkfifo(tmp_path / "site.toml")
    done = main("host", tmp_path / "site.toml")
    assert done.returncode == 66 and done.stderr.count("\n") == 1 and "site.toml: is no regular file" in done.stderr
