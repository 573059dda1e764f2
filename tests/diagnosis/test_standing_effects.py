"""Effects that a building has from the start: learned with their sizes, and no news later."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from drivers.base import ACCELERATION
from monitor.diagnosis import diagnose as search
from monitor.inference import Segments, classify, gather
from monitor.model import Model, StructuralPrior, parse_effect, prior_file, simulate
from monitor.runs import cut_into_blocks, diagnose
from tests.diagnosis import jointed_frame
from tests.diagnosis.jointed_frame import TURNING
from tests.support.brisk import briefly
from tests.support.files import through_its_file
from tests.support.frames import shear_frame

pytestmark = pytest.mark.engine

SITE = briefly(shear_frame([9e4, 1e5], [1.6e8, 1.8e8]), cutoff_hz=16.0)
MACHINE = "harmonic_excitation:floor 2:frequency_hz=9.0,force_n=0.15"
BUILDING = SITE.instrumented().context(256.0)


def measured(seed: int, *effects: str, duration_s: float = 300.0) -> Segments:
    """A building's motion."""
    present = tuple(map(parse_effect, effects))
    motion = simulate(
        Model(SITE.model().structure, present),
        duration_s=duration_s,
        rate_hz=256.0,
        noise=0.02,
        level_spread=0.35,
        seed=seed,
        context=BUILDING,
    )
    return gather(cut_into_blocks(ACCELERATION, motion.floors, SITE.channels, 256.0, 10**18, 1000), SITE.front_end())


@cache
def healthy(*standing: str) -> StructuralPrior:
    """The reference of a building that has had some effects from the start."""
    return diagnose.learn_healthy_prior(measured(1, *standing), SITE)


def drift_m() -> float:
    """RMS of the upper story's drift under the simulator's forces of 1 N."""
    model = SITE.model()
    mass, stiffness = model.structural_matrices()
    slopes = np.block(
        [[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(mass, np.hstack([stiffness, model.damping_matrix()]))]]
    )
    b = np.vstack([np.zeros((2, 2)), np.linalg.inv(mass)])
    covariance = solve_continuous_lyapunov(slopes, -b @ b.T / 256.0)
    return float(np.sqrt(np.array([1.0, -1.0]) @ covariance[:2, :2] @ [1.0, -1.0]))


def test_softening_of_every_story_stands_whatever_its_unit() -> None:
    """Coordinates of 1e20 are as good as of one, and classes of level tell softening from a loss."""
    k3 = -0.03 * 1.7e8 / (3.0 * drift_m() ** 2)
    assert abs(k3) > 1e20
    softening = [f"cubic_stiffness:story {j}:k3_n_per_m3={k3:.6g}" for j in (1, 2)]
    known = diagnose.learn_healthy_prior(measured(1, *softening, duration_s=600.0), SITE)
    found = known.effects(known.mean)
    assert {(e.name, e.location) for e in found} == {("cubic_stiffness", f"story {j}") for j in (1, 2)}
    for effect, std in zip(found, known.standing_std, strict=True):
        assert std[0] < 0.4 * abs(k3)
        assert abs(effect.coordinates[0] - k3) < 3.0 * std[0]
    clean = search(classify(measured(2, *softening, duration_s=600.0)), known, BUILDING, SITE.diagnosis)
    assert clean.verdict == "none", [c.effect for c in clean.causes]


def test_a_machine_that_runs_otherwise_today_is_no_news() -> None:
    known = healthy(MACHINE)
    assert [e.name for e in known.model.effects] == ["harmonic_excitation"] and len(known.known_lines_hz) == 1
    today = "harmonic_excitation:floor 2:frequency_hz=9.035,force_n=0.22"
    assert search(classify(measured(2, today)), known, BUILDING, SITE.diagnosis).verdict == "none"
    loss = search(
        classify(measured(3, today, "stiffness_change:story 1:relative=-0.08")), known, BUILDING, SITE.diagnosis
    )
    assert [(c.effect.name, c.effect.location) for c in loss.causes] == [("stiffness_change", "story 1")]


def test_a_fault_beside_a_tie_is_named() -> None:
    """Nothing tells a loss in the lowest story from a soft base; noise of a sensor is noise beside either."""
    known = healthy()
    hidden = ("stiffness_change:story 2:relative=-0.08", "sensor_noise:channel a1:rms_m_s2=3e-6")
    found = search(classify(measured(2, *hidden)), known, BUILDING, SITE.diagnosis)
    assert found.verdict == "ambiguous"
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [("sensor_noise", "channel a1")]
    rivals = {(c.effect.name, c.effect.location) for c, _ in found.alternatives}
    assert rivals >= {("stiffness_change", "story 2"), ("base_flexibility", "base")}


def test_noise_that_stands_may_follow_the_motion() -> None:
    known = healthy("sensor_noise:channel a1:rms_m_s2=3e-6")
    assert [(e.name, e.location) for e in known.model.effects] == [("sensor_noise", "channel a1")]
    louder = measured(2, "sensor_noise:channel a1:rms_m_s2=3.6e-6")
    assert search(classify(louder), known, BUILDING, SITE.diagnosis).verdict == "none"


def test_a_reference_from_its_file_is_the_one_that_was_learned() -> None:
    known = healthy(MACHINE)
    read = through_its_file(known, SITE)
    assert known.n_persistent > 0 and known.known_lines_hz == read.known_lines_hz
    for name in ("mean", "precision", "start", "units"):
        np.testing.assert_allclose(getattr(read, name), getattr(known, name), rtol=1e-14, err_msg=name)
    damaged = prior_file.prior_content(known)
    for far in (1e4, -1e4):
        damaged["mean"][0] = far
        with pytest.raises(ValueError, match="not finite, above zero"):
            prior_file.read_prior(damaged, SITE.model(), SITE.channels)


def test_a_channel_that_reads_low_is_named_in_a_structure_that_turns() -> None:
    """The modes carried from calibration must not bend to what one channel reads, nor the fit start without them."""
    reference = through_its_file(jointed_frame.learned(*TURNING), jointed_frame.CONFIG)
    assert "unmodelled_mode" in [e.name for e in reference.model.effects]
    segments = jointed_frame.recorded(*TURNING, "sensor_gain:channel a2:gain=0.85", seed=2)
    low = search(classify(segments), reference, jointed_frame.CONTEXT, jointed_frame.CONFIG.diagnosis)
    assert [(c.effect.name, c.effect.location) for c in low.causes] == [("sensor_gain", "channel a2")]
    assert abs(low.causes[0].effect.values()["gain"] - 0.85) < 3.0 * low.causes[0].std["gain"] < 0.06
