"""Hosts of two machines that share nothing but object storage: one goes on where the other was lost."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.statistics.host_kills import Sink, outbox
from tests.support.host_sites import Frames, alarms, results, site as site_file
from tests.support.live_rig import Command
from tests.support.object_storage import object_storage
from tests.support.samples import Cli, Cut
from tests.support.waiting import until

pytestmark = pytest.mark.system

LONG_S = 180.0
NOTIFY = """
[notify]
urls = ["json://127.0.0.1:{port}"]
most_per_hour = 1000
"""


class Link:
    """Connections through a port of this machine to another one, until they are cut."""

    def __init__(self, port: int) -> None:
        self._to, self._is_cut = port, False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, is_cut: bool) -> None:
        """End all connections and allow none; or allow them again."""
        self._is_cut = is_cut
        if is_cut:
            for one in self._open:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            near, _ = self._server.accept()
            if self._is_cut:
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", self._to))
            self._open += [near, far]
            for a, b in ((near, far), (far, near)):
                threading.Thread(target=self._pass_on, args=(a, b), daemon=True).start()

    @staticmethod
    def _pass_on(a: socket.socket, b: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := a.recv(1 << 16):
                b.sendall(data)
        for one in (a, b):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


@pytest.fixture(scope="module")
def server() -> Iterator[int]:
    """Port of a storage with the bucket `city`."""
    with object_storage("city") as port:
        yield port


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, frame_text: str, cut: Cut, main: Cli) -> Path:
    """A baseline, a recording in which story 2 softens and recovers, and what `run` makes of it."""
    folder = tmp_path_factory.mktemp("bench")
    frames = Frames(folder, frame_text, cut, main)
    frames.write("r", frames.sound(40.0, 10), frames.weak(50.0, 20), frames.sound(120.0, 30))
    assert main("run", site(folder / "run", frame_text, Sink())).returncode == 0
    return folder


def site(machine: Path, frame_text: str, sink: Sink, store: str = "", speed: str = "") -> Path:
    """Write the file of the site `tower` into a folder of a machine."""
    path = site_file(machine, frame_text, "tower", "r", speed)
    path.write_text(path.read_text().replace("[output]", f"[output]\n{store}") + NOTIFY.format(port=sink.port))
    return path


def numbered(sink: Sink) -> dict[int, str]:
    """Title of each message by its number, which it has however often it came."""
    found: dict[int, str] = {}
    for _, number, title in sink.taken:
        assert found.setdefault(number, title) == title, (number, title, found)
    return found


def are_those_of_run(sink: Sink, machine: Path, run: Path) -> bool:
    """Whether there are as many messages as of `run`, each with a number of its own, and none is lost."""
    (last, waiting), (expected, _) = outbox(machine / "out-tower"), outbox(run / "out-tower")
    return last == expected >= 3 and {*numbered(sink)} | waiting == {*range(1, last + 1)}


@pytest.fixture
def machines(
    bench: Path, tmp_path: Path, frame_text: str, server: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[list[Command], list[Path], Link, Sink]]:
    """Two hosts with folders of their own, the first with a link that can be cut, and the address that takes their messages."""
    link, sink = Link(server), Sink()
    store = f'store = "s3://city/{tmp_path.name.strip("_").replace("_", "-")}"\nstore_every_s = 1.0'
    folders = [bench / f"{tmp_path.name}-{name}" for name in ("a", "b")]
    folders[1].mkdir()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server}")
    hosts = [Command(folders[1] / "host.log", "host", folders[1], "--standby")]  # without a site as yet
    try:
        hosts[0].wait_for("READY")
        site(folders[0], frame_text, sink, store, "speed = 8.0")
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{link.port}")
        hosts.insert(0, Command(folders[0] / "host.log", "host", folders[0], "--standby"))
        until(lambda: results(folders[0], "tower"), "a window")
        site(folders[1], frame_text, sink, store, "speed = 8.0")
        hosts[1].wait_for("tower stands by")
        yield hosts, folders, link, sink
    finally:
        for host in hosts:
            host.kill()


def test_another_machine_goes_on_when_the_first_dies(
    machines: tuple[list[Command], list[Path], Link, Sink], bench: Path
) -> None:
    hosts, folders, _, sink = machines
    until(lambda: sink.taken, "an alarm")
    assert hosts[0].stop(signal.SIGKILL)[0] == -signal.SIGKILL
    expected = results(bench / "run", "tower")
    until(lambda: results(folders[1], "tower") == expected, "all windows, bit for bit, as of `run`", LONG_S)
    until(lambda: are_those_of_run(sink, folders[1], bench / "run"), "all messages with their numbers")
    until(lambda: alarms(folders[1], "tower") == alarms(bench / "run", "tower") != [], "the summary of the end")


def test_a_machine_that_is_cut_off_goes_on_until_it_hears_that_another_one_has_the_site(
    machines: tuple[list[Command], list[Path], Link, Sink], bench: Path
) -> None:
    hosts, folders, link, sink = machines
    link.cut(True)
    hosts[0].wait_for("monitoring goes on, and another machine may take the site over meanwhile")
    until(lambda: "store" in _failed(folders[0]), "the line of health says so")
    until(lambda: results(folders[1], "tower"), "the other one takes the site")
    before = len(results(folders[0], "tower"))
    until(lambda: len(results(folders[0], "tower")) > before, "both judge")
    link.cut(False)
    hosts[0].wait_for("taken over by the monitor of")
    until(lambda: "tower stands by" in hosts[0].said, "the first stands by")
    expected = results(bench / "run", "tower")
    until(lambda: results(folders[1], "tower") == expected, "all windows, bit for bit, as of `run`", LONG_S)
    assert expected.startswith(results(folders[0], "tower")), "what both judged is the same"
    until(
        lambda: are_those_of_run(sink, folders[1], bench / "run"),
        "all messages; those that came from both have one number",
    )


def _failed(machine: Path) -> dict[str, str]:
    whole, _, _ = (machine / "out-tower" / "health.jsonl").read_text().rpartition("\n")
    return dict(json.loads(whole.splitlines()[-1])["failed"])


def test_a_second_run_of_a_site_ends_and_a_bad_address_is_told(
    bench: Path, tmp_path: Path, frame_text: str, server: int, main: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server}")
    store = 'store = "s3://city/second"\nstore_every_s = 1.0'
    first, second = (site(bench / name, frame_text, Sink(), store, "speed = 8.0") for name in ("first", "second"))
    running = Command(tmp_path / "log", "run", first)
    try:
        running.wait_for("READY")
        done = main("run", second)
        assert done.returncode == 78 and "the monitor of" in done.stderr and "is at work" in done.stderr, done.stderr
        assert running.stop()[0] == 0
    finally:
        running.kill()
    for text, code, says in (
        ("ftp://city/x", 78, "is no address as s3://"),
        ("s3://nobody/x", 66, "bucket does not exist"),
    ):
        path = site(bench / says[:2], frame_text, Sink(), f'store = "{text}"')
        done = main("run", path)
        assert done.returncode == code and says in done.stderr, done.stderr
        assert "Traceback" not in done.stderr
