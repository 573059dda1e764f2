"""The tutorial's frame: measured, turning as well as swaying, with a channel made to read too little."""

from __future__ import annotations

import lzma
import re
from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION
from drivers.mcap_file import read_recordings
from monitor.config import configuration
from monitor.damage import load_baseline
from monitor.inference import gather
from monitor.runs import cut_into_blocks
from monitor.runs.diagnose import diagnose_segments

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "recordings" / "mini-shake-table-flexible.mcap"
BASELINE = ROOT / "tests" / "data" / "tutorial-baseline" / "baseline.json.xz"

pytestmark = pytest.mark.engine


@pytest.mark.timeout(900)
def test_a_channel_that_reads_low_is_named_alone(tmp_path: Path) -> None:
    """Fits that began without the baseline's modes of torsion, or lost their direction, named the other two channels."""
    written = re.search(r"cat > frame\.toml <<'TOML'\n(.*?)\nTOML", (ROOT / "docs" / "tutorial.md").read_text(), re.S)
    assert written is not None
    structure, baseline = tmp_path / "frame.toml", tmp_path / "baseline.json"
    structure.write_text(written[1])
    baseline.write_bytes(lzma.decompress(BASELINE.read_bytes()))
    config = configuration.load_with_model(structure)
    known = load_baseline(baseline, config.instrumented(), config.updating).reference
    assert known is not None and sum(e.name == "unmodelled_mode" for e in known.model.effects) == 4
    blocks = [b for b in read_recordings([RECORDING]) if b.topic == ACCELERATION]
    samples = np.concatenate([b.samples for b in blocks]) * [1.0, 0.85, 1.0]
    today = cut_into_blocks(ACCELERATION, samples, config.channels, blocks[0].sample_rate_hz, 10**18, 128)
    found, gain = diagnose_segments(gather(today, config.front_end()), known, config)
    assert found.verdict == "named" and gain.ci95[0] > 0.0
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [("sensor_gain", "channel a2")]
    assert abs(found.causes[0].effect.values()["gain"] - 0.85) < 3.0 * found.causes[0].std["gain"] < 0.05
