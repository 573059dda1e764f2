"""Every command ends by the contract on records that no structure makes: one message and an exit code, never a traceback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from monitor.config import configuration
from monitor.model import simulate
from tests.support.samples import Cli, Cut, write_blocks

RATE_HZ = 100.0
ODD: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "all zeros": lambda x: 0.0 * x,
    "all constant": lambda x: 0.0 * x + 1.5,
    "one dead": lambda x: x * [1.0, 0.0, 1.0],
    "one constant": lambda x: x * [1.0, 0.0, 1.0] + [0.0, 9.81, 0.0],
    "two dead": lambda x: x * [0.0, 0.0, 1.0],
    "two equal": lambda x: x[:, [0, 0, 2]],
    "all equal": lambda x: x[:, [0, 0, 0]],
    "one sample": lambda x: x[:1],
    "five samples": lambda x: x[:5],
    "a second": lambda x: x[:100],
    "a channel of NaN": lambda x: np.where(np.arange(3) == 1, np.nan, x),
    "NaN alone": lambda x: np.nan * x,
    "infinite readings": lambda x: np.where(np.arange(len(x))[:, None] % 997 == 0, np.inf, x),
    "one channel": lambda x: x[:, :1],
    "tiny": lambda x: 1e-300 * x,
    "near the smallest": lambda x: 1e-42 * x,
    "huge": lambda x: 1e300 * x,
    "near the largest": lambda x: 1e30 * x,
    "unlike": lambda x: x * [1e-30, 1.0, 1e30],
    "one spike": lambda x: np.where(np.arange(len(x))[:, None] == 4000, 1e30, 0.0 * x),
    "a ramp": lambda x: 1e-3 * np.arange(len(x))[:, None] * [1.0, 2.0, -1.0],
    "a sinusoid": lambda x: np.sin(0.314 * np.arange(len(x)))[:, None] * [1.0, 2.0, 3.0],
}
SLOW = ("two equal", "all equal", "near the largest", "unlike", "a ramp", "a sinusoid")
"""Records on which a search takes its time."""


@pytest.fixture
def write(tmp_path: Path, frame_text: str, cut: Cut) -> Callable[[str], Path]:
    """Writes an odd record, beside a structure file with a model and one without."""
    (tmp_path / "f.toml").write_text(frame_text)
    sensors = frame_text[frame_text.index("[[sensors]]") :].replace("floor", "# floor")
    (tmp_path / "m.toml").write_text('[structure]\nkind = "modal"\n' + sensors)

    def written(kind: str) -> Path:
        model = configuration.load(tmp_path / "f.toml").model()
        x = simulate(model, duration_s=100.0, rate_hz=RATE_HZ, noise=0.03, seed=1).floors
        with np.errstate(all="ignore"):
            odd = ODD[kind](x).astype(np.float32)
        write_blocks(tmp_path / "odd.mcap", cut(odd, RATE_HZ, (1000,), channels=("a1", "a2", "a3")[: odd.shape[1]]))
        return tmp_path

    return written


def ends_by_the_contract(main: Cli, folder: Path, *command: str) -> None:
    done = main(*command, cwd=folder)
    assert done.returncode in (0, 65), (command, done.stderr)
    assert "Traceback" not in done.stderr
    assert done.stderr.count("error:") == (done.returncode == 65)


@pytest.mark.parametrize("kind", ODD)
def test_looks_replays_and_calibrations_of_modes_end_by_the_contract(
    write: Callable[[str], Path], main: Cli, kind: str
) -> None:
    folder = write(kind)
    ends_by_the_contract(main, folder, "look", "odd.mcap")
    ends_by_the_contract(main, folder, "compare", "odd.mcap", "odd.mcap")
    ends_by_the_contract(main, folder, "replay", "odd.mcap", "--structure", "f.toml", "--out", "out")
    ends_by_the_contract(main, folder, "calibrate", "odd.mcap", "--structure", "m.toml", "--out", "m.json")


@pytest.mark.parametrize("kind", [kind for kind in ODD if kind not in SLOW])
def test_calibrations_and_diagnoses_end_by_the_contract(write: Callable[[str], Path], main: Cli, kind: str) -> None:
    folder = write(kind)
    ends_by_the_contract(main, folder, "calibrate", "odd.mcap", "--structure", "f.toml", "--out", "b.json")
    ends_by_the_contract(main, folder, "diagnose", "odd.mcap", "--structure", "f.toml", "--out", "found")
