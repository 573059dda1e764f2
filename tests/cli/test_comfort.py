"""For people and for programs: one JSON object where asked, completion, progress on a terminal only, errors with the mend."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import rerun as rr
from typer.main import get_command

from monitor.cli import view
from monitor.cli.app import app
from monitor.core import GAP, Skipped, WrongUsageError
from tests.support.samples import Cli
from tests.support.strangers import listening as addresses
from tests.support.waiting import until

MODULE = [sys.executable, "-m", "monitor"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, frame_text: str) -> Path:
    folder = tmp_path_factory.mktemp("comfort")
    (folder / "s.toml").write_text(frame_text)
    (folder / "d.csv").write_text("a1 [g];a2 [g]\n" + "0.1;0.2\n" * 300)
    return folder


def test_every_command_answers_with_one_json_object(site: Path, main: Cli) -> None:
    def told(*arguments: object) -> dict:
        done = main(*arguments, "--json", cwd=site)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout, parse_constant=pytest.fail)

    assert told("check", "s.toml")["channels"] == ["a1", "a2", "a3"]
    simulate = ("simulate", "--structure", "s.toml", "--out", "r.mcap", "--duration", 45, "--rate", 200)
    assert told(*simulate)["duration_s"] == 45.0
    assert told("import", "d.csv", "--rate", 100, "--out", "d.mcap")["channels"] == {"/acceleration": ["a1", "a2"]}
    healthy = told("calibrate", "r.mcap", "--structure", "s.toml", "--out", "b.json")
    assert (healthy["windows"], len(healthy["stiffness_n_per_m"])) == (6, 3)
    replayed = told("replay", "r.mcap", "--structure", "s.toml", "--baseline", "b.json", "--out", "out")
    assert replayed == {**json.loads((site / "out/summary.json").read_text()), "events": [], "out": "out"}
    looked = told("look", "r.mcap")
    assert looked["rate_hz"] == 200.0
    compared = told("compare", "r.mcap", "r.mcap")
    assert compared["significant"] == 0
    assert told("report", "out", "--out", "r.html")["windows"] == 6


def test_every_command_that_answers_knows_json(main: Cli) -> None:
    wordless = {"run", "host", "warm", "emulate", "view", "demo", "evaluate"}  # evaluate prints JSON anyway
    listed = set(get_command(app).commands)
    assert {"replay", "calibrate"} <= listed
    for command in listed - wordless:
        assert "--json" in main(command, "--help").stdout, command


def test_the_shell_completes_commands_and_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    variable = "_SHM_MONITOR_COMPLETE"

    def told(instruction: str, words: str = "", at: int = 0) -> str:
        for name, value in ((variable, instruction), ("COMP_WORDS", f"shm-monitor {words}"), ("COMP_CWORD", str(at))):
            monkeypatch.setenv(name, value)
        with pytest.raises(SystemExit):
            app([], prog_name="shm-monitor")
        return capsys.readouterr().out

    assert all(variable in told(f"source_{shell}") for shell in ("bash", "zsh", "fish"))
    assert told("complete_bash", "repl", 1).split() == ["replay"]
    assert told("complete_bash", "replay --str", 2).split() == ["--structure"]


def on_a_terminal(arguments: list[str], folder: Path) -> bytes:
    """What a command writes to a terminal."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(arguments, stdout=theirs, stderr=theirs, cwd=folder, env={**os.environ, "TERM": "xterm",
                          "PYTHONPATH": str(Path(__file__).parents[2])}) as process:  # fmt: skip
        os.close(theirs)
        said = b""
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            said += part
        process.wait(60)
    os.close(ours)
    return said


def test_progress_is_shown_on_a_terminal_and_a_short_command_is_quiet_in_a_pipe(site: Path, main: Cli) -> None:
    long = ("simulate", "--structure", "s.toml", "--out", "long.mcap", "--duration", 110, "--rate", 200)
    assert main(*long, cwd=site).returncode == 0
    arguments = ["replay", "long.mcap", "--structure", "s.toml", "--out", "long"]
    shown = on_a_terminal([*MODULE, *arguments, "--speed", "45"], site)
    assert re.search(rb"[12] of 2 min of data, \d+ s left, \d s so far\r", shown), shown
    quiet = main(*arguments, cwd=site)
    assert (quiet.stderr, "\x1b" in quiet.stdout) == ("", False)


@pytest.mark.parametrize(
    ("arguments", "code", "mend"),
    [
        (["view", "nowhere"], 66, "replay --out DIR"),
        (["view", "."], 66, "leaves one"),
        (["view", "s.toml", "--web", "--port", "-1"], 2, "--port"),
        (["view", "s.toml", "--port", "8000"], 2, "--web"),
        (["replay", "nowhere.mcap", "--structure", "s.toml", "--out", "o"], 66, "nowhere.mcap"),
        (["replay", "r.mcap", "--out", "o"], 2, "'look REC' needs none"),
        (["report", ".", "--out", "x.html"], 66, "replay --out"),
        (["report", "."], 2, "--out"),
        (["report", ".", "--event", "last"], 66, "replay --out"),
        (["report", ".", "--event", "last", "--from", "2026-01-01"], 2, "--from"),
    ],
)
def test_errors_name_the_mend(site: Path, main: Cli, arguments: list[str], code: int, mend: str) -> None:
    done = main(*arguments, cwd=site)
    assert (done.returncode, mend in done.stderr) == (code, True), done.stderr
    assert "Traceback" not in done.stderr


def test_the_native_viewer_listens_on_loopback_and_on_a_port_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "live.rrd").touch()

    def replace(_: str, arguments: list[str]) -> None:
        raise SystemExit(arguments[1:])

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr("os.execv", replace)
    with pytest.raises(SystemExit) as ended:
        view.view(str(tmp_path))
    assert ended.value.code == [str(tmp_path / "live.rrd"), "--bind", "127.0.0.1", "--port", "auto"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have a screen")
def test_without_a_screen_the_browser_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "live.rrd").touch()
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(WrongUsageError, match=r"no screen here .*--web"):
        view.view(str(tmp_path))


def test_a_gap_is_told_with_what_helps() -> None:
    """Every window that holds it is lost; a reason of another kind stays as it is."""
    assert Skipped(GAP).mend == "gap in the data; a shorter [processing] window_s loses less to each"
    assert Skipped("dead").mend == "dead"


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_the_viewers_server_ends_with_the_command_and_listens_on_loopback_only(tmp_path: Path, ending: int) -> None:
    stream = rr.RecordingStream("nothing")
    stream.save(tmp_path / "live.rrd")
    stream.log("/x", rr.Scalars(1.0))
    stream.flush()
    stream.disconnect()
    command = [*MODULE, "view", str(tmp_path), "--web", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        found = re.match(
            r"http://127\.0\.0\.1:(\d+)/\?url=rerun%2Bhttp%3A%2F%2F127\.0\.0\.1%3A(\d+)", process.stdout.readline()
        )
        ports = [int(found[1]), int(found[2])]
        until(lambda: all(addresses(port) == {"0100007F"} for port in ports), "both servers, on loopback only")
        process.send_signal(ending)
        try:
            assert process.wait(20) == 0
        finally:
            process.kill()
    until(lambda: not any(addresses(port) for port in ports), "no server")
