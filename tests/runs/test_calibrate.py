"""What calibrate says where nothing can be learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from monitor.config import configuration
from monitor.core import BadInputError
from monitor.runs import calibrate
from tests.support.samples import Cut, write_blocks


def test_where_no_window_is_good_the_reason_is_that_of_the_last_one(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut
) -> None:
    (tmp_path / "s.toml").write_text(frame_text)
    stuck = record[: 40 * 128].copy()
    stuck[500:, 1] = 0.0
    blocks = cut(stuck[:400], 128.0) + cut(stuck[500:], 128.0, first=500)  # a gap within the first window
    path = write_blocks(tmp_path / "r.mcap", blocks)
    with pytest.raises(BadInputError, match=r"no window could be identified, the last because: .*a2"):
        calibrate.calibrate([path], configuration.load(tmp_path / "s.toml"))
