"""What a window needs is compiled before the daemon is READY."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monitor.config import configuration
from monitor.model import simulate
from monitor.runs import warm_up
from monitor.service import Daemon
from tests.support.frames import shear_frame
from tests.support.samples import Cli, Cut, write_blocks
from tests.support.site import SITE, Scripted, health
from tests.support.waiting import until

ROOT = Path(__file__).parents[2]
RECORDINGS = ROOT / "recordings"
COUNT = """
import gc, json, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from drivers.mcap_file import read_recordings
from monitor.config import configuration
from monitor.damage import load_baseline
from monitor.runs import Session, warm_up

def compiled():
    found = [item for item in gc.get_objects() if isinstance(item, Dispatcher)]
    return {f"{d.py_func.__module__}.{d.__name__}": len(d.signatures) for d in found if d.signatures}

structure, recording, baseline, folder = sys.argv[1:]
settings = configuration.load(Path(structure))
known = load_baseline(Path(baseline), settings.instrumented(), settings.updating) if baseline else None
warm_up(settings, known)
warm = compiled()
session = Session(settings, known, (), None, Path(folder))
for block in read_recordings([Path(recording)]):
    session.push(block)
print(json.dumps([warm, compiled(), session.windows, session.present.state]))
"""


@pytest.mark.parametrize("with_baseline", [False, True])
def test_no_window_compiles_anything(
    main: Cli, tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut, with_baseline: bool
) -> None:
    """Up to an alarm; in a process of its own: here other tests have compiled everything already."""
    structure, recording, baseline = tmp_path / "frame.toml", tmp_path / "r.mcap", ""
    structure.write_text(frame_text + "[alarm]\nconfirm_s = 5.0\n")
    healthy = configuration.load(structure).model()
    damaged = healthy.with_stiffness(healthy.structure.stiffness_n_per_m * [1.0, 0.7, 1.0])
    lost = simulate(damaged, duration_s=60.0, rate_hz=128.0, noise=0.03, seed=7).floors
    for place, values in ((tmp_path / "healthy.mcap", record), (recording, np.concatenate([record, lost]))):
        write_blocks(place, cut(values, 128.0))
    if with_baseline:
        baseline = str(tmp_path / "baseline.json")
        done = main("calibrate", tmp_path / "healthy.mcap", "--structure", structure, "--out", baseline)
        assert done.returncode == 0, done.stderr
    arguments = [str(structure), str(recording), baseline, str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", COUNT, *arguments], capture_output=True, text=True, cwd=ROOT, check=True
    )
    warm, after, windows, state = json.loads(done.stdout)
    assert windows > 10 and len(warm) > 10 and (state == "alarm") is with_baseline
    assert after == warm
    assert not with_baseline or "monitor.damage.kernels.beside_each_other" in warm


def test_a_window_of_each_kind_is_judged() -> None:
    """With and without refinement; without a site file those of a small frame."""
    assert warm_up() == 6
    assert warm_up(configuration.load(RECORDINGS / "mini-shake-table-flexible.toml")) >= 2


def test_the_daemon_compiles_before_it_is_ready_and_says_meanwhile_that_it_starts(
    tmp_path: Path, frame_text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site.toml"
    site.write_text(SITE + frame_text)
    told = threading.Event()
    said: list[str] = []

    def slow(*_: Any) -> int:
        until(lambda: len(health(tmp_path / "out")) >= 3, "the daemon says that it starts")
        told.set()
        said.append(capsys.readouterr().err)
        return 0

    monkeypatch.setattr("monitor.service.daemon.warm_up", slow)
    Daemon(site, Scripted([None] * 50), quiet_s=0.05).run()
    assert told.is_set() and said == [""] and capsys.readouterr().err == "READY\n"
    first = health(tmp_path / "out")[0]
    assert first["source"]["error"] == "the monitor is starting" and not first["source"]["connected"]


def test_a_start_goes_on_where_something_cannot_be_compiled(
    tmp_path: Path, frame_text: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    site = tmp_path / "site.toml"
    site.write_text(SITE + frame_text)
    monkeypatch.setattr("monitor.service.daemon.warm_up", lambda *_: 1 / 0)
    Daemon(site, Scripted([])).run()
    assert "not all is compiled" in caplog.text


def test_a_structure_with_fewer_sensors_than_floors_is_warmed_up_too() -> None:
    processing = {"window_s": 100.0, "hop_s": 50.0}
    assert warm_up(shear_frame([0.3] * 4, [2500.0] * 4, (1, 2, 4), processing=processing)) > 0
