"""Commands of operators, by the folders and addresses that they are given: no daemon runs here."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.support.hooks import Hook
from tests.support.samples import T0_NS, Cli


@pytest.mark.parametrize(("answer", "code"), [(200, 0), (500, 1)])
def test_a_test_message_that_all_have_taken_is_code_0_and_one_refused_is_1(
    tmp_path: Path, frame_text: str, main: Cli, answer: int, code: int
) -> None:
    site = tmp_path / "site.toml"
    with Hook() as hook:
        hook.status = answer
        site.write_text(f'{frame_text}\n[notify]\nheartbeat_url = "http://127.0.0.1:{hook.server_port}/beat"\n')
        done = main("notify", site, "--test", "--json")
        hook.shutdown()
    assert done.returncode == json.loads(done.stdout)["exit_code"] == code and hook.paths == ["/beat"]


def test_status_tells_of_the_ledger_s_chain_only_where_that_is_asked(tmp_path: Path, main: Cli) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "ledger.jsonl").write_text('{"what": "a"}\n{"what": "b"}\n')
    for asked in ([], ["--verify"]):
        done = main("status", tmp_path, *asked)
        assert done.returncode == 12 and ("2 lines, the chain is whole" in done.stdout) == bool(asked)


def test_an_export_of_a_folder_takes_its_channels_and_all_times_by_default(tmp_path: Path, main: Cli) -> None:
    shapes = {"model_modes": [1], "frequencies_hz": [4.9], "mode_shapes": [[[1.0, 0.0], [0.5, 0.0]]]}
    alarm = {"level": "normal", "stories": [], "reason": "", "active": {}}
    line = {"window": 0, "t_end_ns": T0_NS, "skipped": None, "alarm": alarm, **shapes}
    (tmp_path / "results.jsonl").write_text(json.dumps(line) + "\n")
    (tmp_path / "summary.json").write_text(json.dumps({"alarms": [], "known": {"channels": ["roof", "mid"]}}))
    out = tmp_path / "m.csv"
    for more, rows in ((), 1), (("--from", "2026-01-01T00:00:01"), 0), (("--to", "2026-01-01"), 0):
        done = main("export", tmp_path, "--out", out, "--table", "modes", "--json", *more)
        assert done.returncode == 0 and json.loads(done.stdout)["rows"] == rows, (more, done.stderr)
        assert ("shape_re_roof" in out.read_text() and "shape_im_mid" in out.read_text()) == bool(rows)


def test_a_share_is_the_number_of_this_machine_and_that_of_all(
    tmp_path: Path, main: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Any] = []

    class Noted:
        def __init__(self, *_: object, share: tuple[int, int], **__: object) -> None:
            begun.append(share)

        def run(self) -> None: ...

    monkeypatch.setattr("monitor.service.HostWorkers", Noted)
    assert main("host", tmp_path, "--standby", "--share", "2/3", "--workers", "2").returncode == 0
    assert begun == [(2, 3)]


def test_a_taken_port_of_the_viewer_is_told_in_words(tmp_path: Path, main: Cli) -> None:
    pytest.importorskip("rerun_cli")
    (tmp_path / "live.rrd").touch()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = main("view", tmp_path, "--web", "--port", port)
    assert done.returncode == 66 and f"127.0.0.1:{port}: Address already in use" in done.stderr
