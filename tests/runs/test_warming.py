"""What a window needs is compiled before the daemon is READY."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from monitor.config import configuration
from monitor.model import simulate
from monitor.runs import warm_up
from tests.support.commands import ended
from tests.support.frames import shear_frame
from tests.support.samples import Cli, Cut, write_blocks

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
    structure.write_text(frame_text)
    healthy = configuration.load(structure).model()
    damaged = healthy.with_stiffness(healthy.structure.stiffness_n_per_m * [1.0, 0.7, 1.0])
    lost = simulate(damaged, duration_s=60.0, rate_hz=128.0, noise=0.03, seed=7).floors
    for place, values in ((tmp_path / "healthy.mcap", record), (recording, np.concatenate([record, lost]))):
        write_blocks(place, cut(values, 128.0))
    if with_baseline:
        baseline = str(tmp_path / "baseline.json")
        done = main("calibrate", tmp_path / "healthy.mcap", "--structure", structure, "--out", baseline)
        assert done.returncode == 0, done.stderr
    done = ended(sys.executable, "-c", COUNT, structure, recording, baseline, tmp_path, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    warm, after, windows, state = json.loads(done.stdout)
    assert windows > 10 and len(warm) > 10 and (state == "alarm") is with_baseline
    assert after == warm
    assert not with_baseline or "monitor.damage.kernels.beside_each_other" in warm


def test_a_window_of_each_kind_is_judged() -> None:
    """With and without refinement; without a site file those of a small frame."""
    assert warm_up() == 6
    assert warm_up(configuration.load(RECORDINGS / "mini-shake-table-flexible.toml")) >= 2


def test_a_structure_with_fewer_sensors_than_floors_is_warmed_up_too() -> None:
    processing = {"window_s": 100.0, "hop_s": 50.0}
    assert warm_up(shear_frame([0.3] * 4, [2500.0] * 4, (1, 2, 4), processing=processing)) > 0
