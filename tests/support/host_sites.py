"""Sites of one host and the frames that reach them."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np

from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.model import simulate
from tests.support.frames import settings_of
from tests.support.samples import Cli, Cut

RATE = 128.0

SITE = """
[site]
name = "{name}"
baseline = "../baseline.json"

[source]
kind = "mcap"
files = ["../{recording}.mcap"]
{speed}

[output]
dir = "out-{name}"

[recorder]
min_free_gb = 0.0
flush_s = 1.0

[watch]
diagnose = false

[state]
checkpoint_s = 5.0
"""


class Frames:
    """Recordings of a frame, sound or with a weak story 2, and the baseline of the sound one, in a folder."""

    def __init__(self, folder: Path, frame_text: str, cut: Cut, main: Cli) -> None:
        self._folder, self._cut = folder, cut
        (folder / "s.toml").write_text(frame_text)
        texts = frame_text, frame_text.replace("1514.8507", "900.0")
        self.sound, self.weak = (partial(self._move, settings_of(text)) for text in texts)
        self.write("healthy", self.sound(400.0, 6))
        options = ("--structure", folder / "s.toml", "--out", folder / "baseline.json")
        done = main("calibrate", folder / "healthy.mcap", *options)
        assert done.returncode == 0, done.stderr

    @staticmethod
    def _move(settings: Configuration, seconds: float, seed: int) -> np.ndarray:
        return simulate(settings.model(), duration_s=seconds, rate_hz=RATE, noise=0.03, seed=seed).floors

    def write(self, name: str, *floors: np.ndarray) -> None:
        """Write motions one after the other into one recording."""
        with McapWriter(self._folder / f"{name}.mcap") as writer:
            for block in self._cut(np.concatenate(floors), RATE):
                writer.write(block)


def site(folder: Path, frame_text: str, name: str, recording: str, speed: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(SITE.format(name=name, recording=recording, speed=speed) + frame_text)
    return path


def results(folder: Path, name: str) -> bytes:
    file = folder / f"out-{name}" / "results.jsonl"
    return file.read_bytes() if file.exists() else b""


def alarms(folder: Path, name: str) -> list[object]:
    return list(json.loads((folder / f"out-{name}" / "summary.json").read_text())["alarms"])
