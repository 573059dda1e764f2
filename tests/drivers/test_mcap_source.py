"""Recordings as a source: all blocks, in order, at the pace that is asked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.base import ACCELERATION, EndOfStream, RecordingError, RecordingMissingError, SampleBlock, SourceContext
from drivers.mcap_file import McapWriter
from drivers.mcap_source import McapSource
from drivers.registry import source_type
from tests.support.samples import CHANNELS, T0_NS, Cut


@pytest.fixture
def parts(tmp_path: Path, cut: Cut) -> list[SampleBlock]:
    """20 s in two files."""
    made = cut(np.random.default_rng(1).normal(size=(2000, 3)), 100.0)
    for name, some in (("a", made[:8]), ("b", made[8:])):
        with McapWriter(tmp_path / f"{name}.mcap") as writer:
            for block in some:
                writer.write(block)
    return made


class Clock:
    """Time that passes in sleep alone."""

    def __init__(self) -> None:
        self.now_s, self.longest_s = 0.0, 0.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s, self.longest_s = self.now_s + seconds, max(self.longest_s, seconds)


def source(folder: Path, clock: Clock | None = None, **settings: object) -> McapSource:
    made, time = source_type("mcap").Settings(kind="mcap", **settings), clock or Clock()
    return McapSource(made, SourceContext(CHANNELS, folder), clock=time, sleep=time.sleep)


def drain(opened: McapSource) -> list[SampleBlock]:
    got = []
    with pytest.raises(EndOfStream):
        while True:
            block = opened.read(0.01)
            if block is not None:
                got.append(block)
    return got


@pytest.mark.parametrize("files", [["a.mcap", "b.mcap"], ["b.mcap", "a.mcap"], ["*.mcap"], ["FOLDER/*.mcap"]])
def test_all_blocks_in_order_then_the_end(tmp_path: Path, parts: list[SampleBlock], files: list[str]) -> None:
    opened = source(tmp_path, files=[name.replace("FOLDER", str(tmp_path)) for name in files])
    assert not opened.health().connected
    opened.open()
    assert [b.sequence for b in drain(opened)] == [b.sequence for b in parts]
    assert opened.health().counts == {"blocks": 20, "samples": 2000}
    with pytest.raises(EndOfStream):
        opened.read(0.0)
    opened.close()
    opened.close()


def test_it_keeps_the_pace_and_waits_no_longer_than_asked(tmp_path: Path, parts: list[SampleBlock]) -> None:
    clock = Clock()
    opened = source(tmp_path, clock, files=["*.mcap"], speed=2.0)
    opened.open()
    times = []
    while len(times) < len(parts):
        if opened.read(0.3) is not None:
            times.append(clock.now_s)
    np.testing.assert_allclose(times, 0.5 * np.arange(1, 21))  # a block is there when its last sample is
    assert clock.longest_s <= 0.3


def test_months_between_recordings_are_not_waited_for(tmp_path: Path, cut: Cut) -> None:
    clock, samples = Clock(), np.random.default_rng(1).normal(size=(1000, 3))
    degc = SampleBlock("/temperature", T0_NS, 0, 1.0 / 60.0, ("t1",), "degC", np.ones((1, 1), np.float32))
    for name, first_ns in (("a", T0_NS), ("b", T0_NS + 90 * 86400 * 10**9)):
        with McapWriter(tmp_path / f"{name}.mcap") as writer:
            writer.write(replace(degc, t_ns=first_ns))
            for block in cut(samples, 100.0, t0_ns=first_ns):
                writer.write(block)
    opened = source(tmp_path, clock, files=["*.mcap"], speed=1.0)
    opened.open()
    blocks = drain(opened)
    assert sum(b.n_samples for b in blocks if b.topic == ACCELERATION) == 2000
    assert clock.now_s == pytest.approx(
        20.0, abs=0.1
    )  # nor does a reading a minute hold up the accelerations beside it


@pytest.mark.parametrize("files", [["none.mcap"], ["none*.mcap"]])
def test_missing_files_are_no_loss_that_reopening_mends(tmp_path: Path, files: list[str]) -> None:
    with pytest.raises(RecordingMissingError, match="none"):
        source(tmp_path, files=files).open()


def test_damaged_files_are_told(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nonsense" * 10)
    with pytest.raises(RecordingError):
        source(tmp_path, files=["a.mcap"]).open()


@pytest.mark.parametrize("wrong", [{"files": []}, {"files": ["a"], "speed": 0.0}, {"files": ["a"], "spede": 1.0}])
def test_wrong_settings_are_refused(tmp_path: Path, wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        source(tmp_path, **wrong)
