"""What a fit leaves over, and what is tried to explain it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from monitor.diagnosis.lack_of_fit import drift_bands, find_changed_effects
from monitor.diagnosis.score_test import candidate_starts, line_offset
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.inference import MapEstimate, Posterior
from monitor.model import parse_effect
from monitor.signals import hann_amplitude
from tests.diagnosis.jointed_frame import posed

pytestmark = pytest.mark.engine


@pytest.fixture(scope="module")
def shaken() -> tuple[Posterior, MapEstimate]:
    return posed(parse_effect("stiffness_change:story 1:relative=0.001"))


def test_wind_that_moves_from_floor_to_floor_is_no_drift(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    e = problem.observed
    late = e.segments.t_s > np.median(e.segments.t_s)
    values = e.segments.values.copy()
    rng = np.random.default_rng(3)
    for half, factors in ((late, [0.6, 1.0, 1.5]), (~late, [1.5, 1.0, 0.6])):
        x = null.x.copy()
        x[problem.layout.forces] += 2.0 * np.log(factors)
        spectra = problem.scatter(x, ())
        for k, members in enumerate(e.members):
            these = members[half[members]]
            root = np.linalg.cholesky(spectra[k])
            white = rng.standard_normal((2, len(these), *root.shape[:2])) / np.sqrt(2.0)
            values[these] = np.einsum("fab,sfb->sfa", root, white[0] + 1j * white[1])
    made = replace(problem, observed=replace(e, segments=replace(e.segments, values=values)))
    assert np.abs(drift_bands(made, null)).max() < 6.0


def test_a_line_is_found_between_its_bins() -> None:
    bins = np.arange(20.0)
    for at in (10.0, 10.24, 9.76, 10.49):
        power = np.asarray(hann_amplitude(bins - at)) ** 2
        k = int(power.argmax())
        assert k + line_offset(power, k) == pytest.approx(at, abs=1e-6)
    assert line_offset(-np.ones(5), 2) == 0.0
    assert line_offset(np.array([1.0, 0.5]), 0) == 0.0


def test_what_stood_at_calibration_and_changed_is_told(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    joints, known = parse_effect("joint_flexibility:frame:girder_to_column_ratio=10"), problem.prior
    mean = np.append(known.mean, joints.coordinates)
    standing = replace(
        known,
        model=replace(known.model, effects=(joints,)),
        mean=mean,
        precision=block_diag(known.precision, np.eye(1) / 0.002**2),
    )
    there = replace(problem, prior=standing)
    for ratio, told in ((9.9, []), (6.0, ["joint flexibility of frame"])):
        x = problem.layout.with_structure(null.x, np.append(null.x[problem.layout.structure], 1.0 / ratio))
        assert [m.where for m in find_changed_effects(there, replace(null, x=x), DiagnosisSettings())] == told


def test_where_a_law_bends_no_other_is_tried(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    law = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=1e6")
    tried = {
        (e.name, e.location)
        for e in candidate_starts(problem, replace(null, effects=(law,)), [("cubic_stiffness", "story 2")])
    }
    assert ("gap_contact", "story 2") not in tried
    assert {("gap_contact", "story 1"), ("stiffness_change", "story 2")} <= tried
