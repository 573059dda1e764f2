"""A measured ground motion is the input: what the floors answer tells the model's errors, with the drawing alone before it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.base import ACCELERATION, GROUND
from monitor.config import Configuration
from monitor.core import Array, BadInputError
from monitor.diagnosis import DiagnosisSettings, diagnose, score
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.inference import Posterior, Segments, classify, gather, linearize, make_posterior
from monitor.model import Model, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks
from tests.model.pushed_frame import FORCED, T0_NS, pushed
from tests.support.frames import shear_frame

pytestmark = pytest.mark.engine

RATE = 1000.0


def settings(**changes: object) -> Configuration:
    processing = {"rate_hz": 50.0, "cutoff_hz": 20.0, "window_s": 60.0, "hop_s": 5.0}
    return shear_frame([0.33, 0.35, 0.31], [2900.0, 1500.0, 1900.0], structure=changes, processing=processing)


DRAWING = settings(masses_kg=[0.335, 0.345, 0.31], stiffness_n_per_m=[2800.0, 1550.0, 1950.0])
CONTEXT = DRAWING.instrumented().context(RATE)


def recorded(
    *effects: str, seed: int, earlier_s: float = 0.0, hole_s: int | None = None, rate_hz: float = RATE, **limits: Any
) -> Segments:
    """A frame on a shaken ground; the ground's recording may begin earlier, and both may lack a second."""
    model = Model(settings().model().structure, tuple(parse_effect(e) for e in effects))
    motion = simulate(
        model, duration_s=120.0, rate_hz=rate_hz, excitation="ground", noise=0.01, level_spread=0.5, seed=seed
    )
    late, second = round(earlier_s * rate_hz), round(rate_hz)
    streams = []
    for topic, x, names, start in (
        (GROUND, motion.ground[:, None], ("g",), 0),
        (ACCELERATION, motion.floors, DRAWING.channels, late),
    ):
        blocks = list(cut_into_blocks(topic, x, names, rate_hz, T0_NS, second))[start // second :]
        streams += [b for i, b in enumerate(blocks) if hole_s is None or i != hole_s - start // second]
    return gather(streams, DRAWING.front_end(), **limits)


@pytest.mark.parametrize(
    ("effects", "name", "parameter"),
    [
        pytest.param((), None, None, marks=pytest.mark.slow),
        (("joint_flexibility:frame:girder_to_column_ratio=6",), "joint_flexibility", 6.0),
    ],
)
def test_a_driven_frame_tells_its_cause(effects: tuple[str, ...], name: str | None, parameter: float | None) -> None:
    segments = recorded(*effects, seed=11)
    known = prior_from_drawing(DRAWING.model(), DRAWING.instrumented().prior_std, 3)
    found = diagnose(classify(segments), known, CONTEXT, DiagnosisSettings())
    assert [c.effect.name for c in found.causes] == ([] if name is None else [name])
    assert not found.alternatives
    if parameter is not None:
        assert next(iter(found.causes[0].effect.values().values())) == pytest.approx(parameter, rel=0.05)


def test_of_a_long_recording_the_strongest_minutes_are_used_and_the_response_to_what_came_before_stays() -> None:
    whole = recorded(seed=12, rate_hz=200.0)
    part = recorded(seed=12, rate_hz=200.0, most_driven=12, lead_s=30.0)
    assert part.t_s.size == part.values.shape[0] == part.drive.first.size == 12 < whole.t_s.size
    first = int(np.searchsorted(whole.t_s, part.t_s[0]))
    same = slice(first, first + 12)
    np.testing.assert_array_equal(part.values, whole.values[same])
    power = whole.drive.power(whole.band)
    assert power[same].sum() == max(power[i : i + 12].sum() for i in range(power.size - 11))
    assert sum(run.length for run in part.drive.runs) < 0.7 * sum(run.length for run in whole.drive.runs)
    answers = []
    for segments in (whole, part):
        problem, _ = fit_linearized(
            classify(segments), prior_from_drawing(settings().model(), np.full(6, 1e-3), 3), CONTEXT
        )
        answers.append(problem.mean(problem.prior.mean, ()))
    np.testing.assert_allclose(answers[1], answers[0][same], atol=3e-3 * float(np.abs(answers[0]).max()))


def windy(*effects: str, share: float, seed: int) -> Segments:
    """A frame on a shaken ground in wind that makes a share of the motion's variance; every sensor has noise of its own."""
    model = Model(settings().model().structure, tuple(parse_effect(e) for e in effects))
    shaken, blown = (
        simulate(model, duration_s=90.0, rate_hz=200.0, excitation=kind, level_spread=spread, seed=seed + more)
        for kind, spread, more in (("ground", 0.5, 0), ("ambient", 0.3, 1000))
    )
    ground, rng = shaken.ground, np.random.default_rng(seed)
    floors = shaken.floors + blown.floors * np.sqrt(share / (1.0 - share) * shaken.floors.var() / blown.floors.var())
    floors += 0.02 * floors.std(axis=0) * rng.standard_normal(floors.shape)
    ground = ground + 0.002 * ground.std() * rng.standard_normal(ground.size)
    streams = [(GROUND, ground[:, None], ("g",)), (ACCELERATION, floors, DRAWING.channels)]
    return gather(
        [b for t, x, names in streams for b in cut_into_blocks(t, x, names, 200.0, T0_NS, 200)], DRAWING.front_end()
    )


@pytest.mark.parametrize("share", [pytest.param(0.003, marks=pytest.mark.slow), 0.1])
def test_wind_beside_a_measured_ground_is_no_cause_and_hides_none(share: float) -> None:
    known, context = prior_from_drawing(settings().model(), np.full(6, 1e-3), 3), replace(CONTEXT, rate_hz=200.0)
    clean = diagnose(classify(windy(share=share, seed=21)), known, context, DiagnosisSettings())
    assert (clean.verdict, clean.causes) == ("none", ())
    lost = windy("stiffness_change:story 2:relative=-0.05", share=share, seed=22)
    found = diagnose(classify(lost), known, context, DiagnosisSettings())
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.effect.name, cause.effect.location) == ("stiffness_change", "story 2")
    assert cause.effect.values()["relative"] == pytest.approx(-0.05, abs=3.0 * cause.std["relative"])
    assert cause.std["relative"] < 0.01


def test_how_the_ground_moves_between_samples_is_asked_again_beside_a_cause() -> None:
    evidence = classify(recorded("added_mass:floor 3:mass_kg=0.06", seed=25, rate_hz=200.0))
    known, context = prior_from_drawing(settings().model(), np.full(6, 1e-3), 3), replace(CONTEXT, rate_hz=200.0)
    drive = fit_linearized(evidence, known, context)[0].observed.drive
    assert drive.between == "held", "another motion makes up for some of the mass"
    found = diagnose(evidence, known, context, DiagnosisSettings())
    assert found.posterior.observed.drive.between != "held"
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [("added_mass", "floor 3")]
    assert found.causes[0].effect.values()["mass_kg"] == pytest.approx(0.06, rel=0.02)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 512.0])
def test_how_the_ground_moves_between_slow_samples_is_found_and_no_cause_made_of_it(rate_hz: float) -> None:
    segments = recorded(seed=15, rate_hz=rate_hz)  # the simulation's ground runs straight
    known = prior_from_drawing(DRAWING.model(), DRAWING.instrumented().prior_std, 3)
    context = replace(CONTEXT, rate_hz=rate_hz)
    problem, null = fit_linearized(classify(segments), known, context)
    assert problem.observed.drive.between == "straight"
    left = problem.predict(null.x, ()).left
    assert left is not None
    assert (np.abs(left) ** 2).sum() < 2e-3 * (np.abs(segments.values) ** 2).sum()


def test_a_nonlinear_law_answers_as_the_simulation_does() -> None:
    law = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=4e8")
    problem, x = _true_problem(recorded("cubic_stiffness:story 2:k3_n_per_m3=4e8", seed=16))
    power = (np.abs(problem.observed.segments.values) ** 2).sum()
    at = np.concatenate([x, law.coordinates])
    exact, linear = problem.mean(at, (law,)), problem.mean(at, (law,), laws="linearized")
    assert exact is not None
    assert linear is not None
    coarse = problem.mean(at, (law,), laws="coarse")
    assert coarse is not None and 0.0 < (np.abs(exact - coarse) ** 2).sum() < 1e-4 * (np.abs(exact) ** 2).sum()
    left, rough = ((np.abs(problem.observed.segments.values - m) ** 2).sum() / power for m in (exact, linear))
    assert left < 0.02
    assert left < 0.2 * rough


def test_the_response_explains_the_floors_and_a_wrong_frame_does_not() -> None:
    segments = recorded(seed=12)
    true, off = (score(segments, c.model(), CONTEXT) for c in (settings(), DRAWING))
    assert true.csd_error < 5e-3
    assert true.csd_error < off.csd_error
    assert true.log_score_per_sample > off.log_score_per_sample + 1.0


def test_a_ground_that_began_earlier_and_a_hole_in_both_change_nothing() -> None:
    """Each stretch without a hole is answered from its own beginning, at its own place in the ground's recording."""
    problem, x = _true_problem(recorded(seed=13, earlier_s=2.0, hole_s=70))
    assert np.unique(problem.observed.drive.run).size == 2
    mean = problem.mean(x, ())
    assert mean is not None
    left = np.abs(problem.observed.segments.values - mean) ** 2
    share = left.mean(axis=(1, 2)) / (np.abs(mean) ** 2).mean(axis=(1, 2))
    assert np.median(share) < 0.01
    assert share.max() < 0.3  # a stretch begins with motion that came before it


def test_drifts_follow_the_measured_ground() -> None:
    problem, x = _true_problem(recorded(seed=14))
    motion = simulate(
        settings().model(), duration_s=120.0, rate_hz=RATE, excitation="ground", noise=0.0, level_spread=0.5, seed=14
    )
    floors = motion.floors - motion.ground[:, None]
    spectrum = np.fft.rfft(floors, axis=0)
    hz = np.fft.rfftfreq(len(floors), 1.0 / RATE)
    spectrum[hz < 0.3] = 0.0
    spectrum[1:] /= -((2.0 * np.pi * hz[1:]) ** 2)[:, None]
    drift = np.fft.irfft(spectrum, n=len(floors), axis=0) @ CONTEXT.structure.drift_matrix().T
    (condition,) = linearize(problem, x, ())
    np.testing.assert_allclose(condition.drift_m, drift.std(axis=0), rtol=0.15)


def _true_problem(segments: Segments) -> tuple[Posterior, Array]:
    """The true structure's problem, fitted so closely to what is known that it stays true."""
    known = prior_from_drawing(settings().model(), np.full(6, 1e-6), 3)
    problem, null = fit_linearized(classify(segments), known, CONTEXT)
    return problem, null.x


def unexplained_share(segments: Segments, config: Configuration) -> float:
    """Share of the floors' power that the response of the drawn model to the known inputs leaves."""
    known = prior_from_drawing(config.model(), np.full(6, 1e-3), 3)
    problem = make_posterior(classify(segments), known, config.instrumented().context(segments.rate_hz))
    x = np.zeros(problem.layout.n_nuisance)
    x[problem.layout.structure] = known.mean
    left = segments.values - problem.mean(x, ())
    return float((np.abs(left) ** 2).sum() / (np.abs(segments.values) ** 2).sum())


@pytest.mark.parametrize("ground", [False, True])
def test_the_response_to_a_measured_force_is_known(ground: bool) -> None:
    blocks = pushed(seed=3, ground=ground, late_s=7 * ground)
    segments = gather(blocks, FORCED.front_end())
    assert {(one.name, one.floor) for one in segments.drive.inputs} == {("shaker", 2)} | (
        {("ground", None)} if ground else set()
    )
    # What is left are the forces that were not measured, a thirtieth of the amplitude, and the course between the samples.
    assert unexplained_share(segments, FORCED) < 0.02
    elsewhere = FORCED.model_copy(update={"inputs": (FORCED.inputs[0].model_copy(update={"floor": 1}),)})
    assert unexplained_share(gather(blocks, elsewhere.front_end()), elsewhere) > 0.2


def test_a_force_tells_the_masses_which_no_output_shows() -> None:
    known = prior_from_drawing(FORCED.model(), np.full(6, 0.1), 3)
    _, fit = fit_linearized(
        classify(
            gather(
                pushed("added_mass:frame:relative=0.08", "stiffness_change:frame:relative=0.08", seed=4),
                FORCED.front_end(),
            )
        ),
        known,
        FORCED.instrumented().context(256.0),
    )
    np.testing.assert_allclose(np.exp(fit.x[:6] - known.mean[:6]), 1.08, atol=0.01)


def test_a_force_that_the_structure_file_does_not_name_is_no_input() -> None:
    unnamed = FORCED.model_copy(update={"inputs": ()})
    assert gather(pushed(seed=3), unnamed.front_end()).drive.inputs == ()
    other = FORCED.model_copy(update={"inputs": (FORCED.inputs[0].model_copy(update={"channel": "hammer"}),)})
    with pytest.raises(
        BadInputError, match=r"/force: channel hammer of the structure file is not in the data, which has shaker"
    ):
        gather(pushed(seed=3), other.front_end())


def test_where_the_inputs_end_inside_the_band_nothing_beyond_is_judged() -> None:
    segments = gather(pushed(seed=5, below_hz=15.0), FORCED.front_end())
    assert segments.whole.hz[-1] > 30.0 and 12.0 < segments.band.hz[-1] < 15.0
