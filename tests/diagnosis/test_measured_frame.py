"""The tutorial's frame: measured, turning as well as swaying, with a channel made to read too little."""

from __future__ import annotations

import lzma
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION
from drivers.mcap_file import read_recordings
from monitor.config import Configuration, configuration
from monitor.damage import load_baseline
from monitor.diagnosis.backbone import find_level_dependence, find_ratio_change
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.score_test import fit_candidate
from monitor.inference import MapEstimate, Posterior, Segments, classify, gather
from monitor.model import StructuralPrior, parse_effect, prior_from_drawing
from monitor.runs import cut_into_blocks, diagnose

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "recordings" / "mini-shake-table-flexible.mcap"
BASELINE = ROOT / "tests" / "data" / "tutorial-baseline" / "baseline.json.xz"
READS = 0.85
"""What the second channel reads, over the truth."""


@pytest.fixture
def low(tmp_path: Path) -> tuple[Segments, StructuralPrior, Configuration]:
    """The recording, the baseline's reference and the structure file."""
    written = re.search(r"cat > frame\.toml <<'TOML'\n(.*?)\nTOML", (ROOT / "docs" / "tutorial.md").read_text(), re.S)
    structure, baseline = tmp_path / "frame.toml", tmp_path / "baseline.json"
    structure.write_text(written[1])
    baseline.write_bytes(lzma.decompress(BASELINE.read_bytes()))
    config = configuration.load_with_model(structure)
    known = load_baseline(baseline, config.instrumented(), config.updating).reference
    assert known is not None and sum(e.name == "unmodelled_mode" for e in known.model.effects) == 4
    blocks = [b for b in read_recordings([RECORDING]) if b.topic == ACCELERATION]
    samples = np.concatenate([b.samples for b in blocks]) * [1.0, READS, 1.0]
    today = cut_into_blocks(ACCELERATION, samples, config.channels, blocks[0].sample_rate_hz, 10**18, 128)
    return gather(today, config.front_end()), known, config


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_channel_that_reads_low_is_named_alone(low: tuple[Segments, StructuralPrior, Configuration]) -> None:
    """Fits that began without the baseline's modes of torsion, or lost their direction, named the other two channels."""
    found, gain = diagnose.diagnose_segments(*low)
    assert found.verdict == "named" and gain.ci95[0] > 0.0
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [("sensor_gain", "channel a2")]
    assert abs(found.causes[0].effect.values()["gain"] - READS) < 3.0 * found.causes[0].std["gain"] < 0.05


@pytest.mark.engine
def test_the_measured_frame_is_no_shear_frame_and_softens_with_the_level() -> None:
    config = configuration.load(ROOT / "recordings" / "mini-shake-table-flexible.toml")
    segments = gather(read_recordings([RECORDING]), config.front_end())
    context = config.instrumented().context(segments.rate_hz)
    problem, null = fit_linearized(
        classify(segments), prior_from_drawing(config.model(), config.instrumented().prior_std, 3), context
    )
    assert problem.observed.drive.between == "smooth"
    joints = fit_candidate(problem, null, parse_effect("joint_flexibility:frame:girder_to_column_ratio=3"))
    assert joints.log_evidence > 100.0
    told = find_ratio_change(problem, joints.fit)
    assert told.says.startswith("frequency ratios: f2/f1 3.0")
    assert _beside_a_reference_with(joints.fit, problem) is None, "the reference has these ratios already"
    softer = find_level_dependence(problem, null)
    assert "falls with the level, from 3.7" in softer.says


def _beside_a_reference_with(fit: MapEstimate, problem: Posterior) -> LackOfFit | None:
    """The change of the ratios where the reference has the fit's structure and effects, and a gain is the only cause."""
    known, gain = problem.prior, parse_effect("sensor_gain:channel a1:gain=1.05")
    mean = np.concatenate([fit.x[problem.layout.structure], *[e.coordinates for e in fit.effects]])
    precision = np.eye(mean.size)
    reference = replace(known, model=replace(known.model, effects=fit.effects), mean=mean, precision=precision)
    later = replace(problem, prior=reference)
    x = problem.layout.with_structure(fit.x[problem.layout.nuisances], mean)
    covariance = 1e-6 * np.eye(x.size + 1)
    same = replace(fit, x=np.concatenate([x, gain.coordinates]), effects=(gain,), covariance=covariance)
    return find_ratio_change(later, same)
