"""Blocks on the disk: a diagnosis gets what it would get from memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.recorder import RecorderSettings
from monitor.runs import RecentBlocks
from monitor.service.recorded_blocks import RecordedBlocks
from monitor.service.threads import Recording
from tests.support.samples import T0_NS, Cut


@pytest.mark.parametrize("file_s", [3600.0, 15.0])  # one file that is being written, and several before it
def test_the_disk_gives_what_memory_gives(tmp_path: Path, cut: Cut, file_s: float) -> None:
    record = np.random.default_rng(1).normal(size=(8000, 3)).astype(np.float32)
    recording = Recording(tmp_path, RecorderSettings(min_free_gb=0.0, file_s=file_s, flush_s=1.0))
    memory, disk = RecentBlocks(40.0), RecordedBlocks(tmp_path, recording, 40.0)
    for block in cut(record, 100.0, (100, 37)):
        recording.write(block)
        memory.push(block)
    begin_ns, end_ns = T0_NS + 30_250_000_000, T0_NS + 71_500_000_000
    kept = memory.between(begin_ns, end_ns)
    read = list(disk.between(begin_ns, end_ns))
    recording.close(60.0)
    assert len(kept) > 50
    assert [(b.t_ns, b.sequence, b.samples.tobytes()) for b in read] == [
        (b.t_ns, b.sequence, b.samples.tobytes()) for b in kept
    ]


def test_a_recorder_that_does_not_answer_is_told(tmp_path: Path) -> None:
    recording = Recording(tmp_path, RecorderSettings(min_free_gb=0.0))
    disk = RecordedBlocks(tmp_path, recording, 40.0)
    recording.then = lambda _: False  # type: ignore[method-assign]
    with pytest.raises(OSError, match="does not answer"):
        list(disk.between(0, 1))
    recording.close(60.0)
