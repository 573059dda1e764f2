"""The held-out gain and the score behind it: more for the truth, nothing for a cause that is not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.base import ACCELERATION
from monitor.diagnosis.cross_validation import (
    HeldOut,
    HeldOutGain,
    calibration_nats,
    confirm_on_held_out,
    confirms,
    without_any_cause,
)
from monitor.diagnosis.fold_refit import fitted_model
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.predictive_score import score
from monitor.diagnosis.score_test import Candidate
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import refine_fit
from monitor.diagnosis.verdict import Cause, Diagnosis
from monitor.inference import Segments, classify, gather, maximize_posterior
from monitor.model import Effect, Model, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks, diagnose
from tests.support.brisk import brisk
from tests.support.damped_frame import DAMPER, RATE, context_of, recorded, settings

pytestmark = pytest.mark.engine


def explained_by(effect: Effect, segments: Segments) -> Diagnosis:
    """What an engine that believes in `effect` would say."""
    config = settings()
    reference = prior_from_drawing(config.model(), config.instrumented().prior_std, 3)
    problem, null = fit_linearized(classify(segments), reference, context_of(config))
    final = maximize_posterior(problem, null.x, (effect,))
    return Diagnosis("named", (), (), (), (), (), problem, null, final, DiagnosisSettings())


@pytest.fixture(scope="module")
def damped() -> Segments:
    return recorded((parse_effect(DAMPER),), seed=41)


@pytest.fixture(scope="module")
def clean() -> Segments:
    return recorded((), seed=42)


def test_the_truth_scores_above_a_drawing_that_is_off(clean: Segments) -> None:
    config, off = settings(), settings(stiffness_n_per_m=[2900.0, 1500.0, 2000.0])
    true, wrong = (score(clean, c.model(), context_of(c)) for c in (config, off))
    assert true.log_score_per_sample > wrong.log_score_per_sample + 0.01
    assert true.csd_error < 0.5 * wrong.csd_error
    assert true.samples == wrong.samples == pytest.approx(39_000, abs=1000)


def test_a_score_does_not_depend_on_the_unit_of_force_or_mass(clean: Segments) -> None:
    """Twice the masses and stiffnesses move as the forces allow: only the level changes, and that is fitted."""
    twice = settings(masses_kg=[0.66, 0.70, 0.62], stiffness_n_per_m=[5800.0, 3000.0, 3800.0])
    one, other = (score(clean, c.model(), context_of(c)) for c in (settings(), twice))
    assert other.log_score_per_sample == pytest.approx(one.log_score_per_sample, abs=1e-5)


def test_a_measured_ground_is_the_input() -> None:
    """With the ground measured the model predicts the floors; a wrong one cannot hide behind a fitted level."""
    config = settings()
    motion = simulate(config.model(), duration_s=200.0, rate_hz=RATE, excitation="ground", noise=0.02, seed=5)
    blocks = [
        *cut_into_blocks("/acceleration/ground", motion.ground[:, None], ("g",), RATE, 10**18, 100),
        *cut_into_blocks(ACCELERATION, motion.floors, config.channels, RATE, 10**18, 100),
    ]
    segments = gather(blocks, config.front_end())
    assert segments.drive.inputs
    true = score(segments, config.model(), context_of(config))
    heavier = settings(masses_kg=[0.36, 0.35, 0.31])
    assert true.csd_error < 0.2
    assert score(segments, heavier.model(), context_of(heavier)).log_score_per_sample < true.log_score_per_sample


def test_a_level_dependent_law_is_judged_at_the_level_that_the_model_shows(clean: Segments) -> None:
    config = settings()
    model = replace(config.model(), effects=(parse_effect("cubic_stiffness:story 2:k3_n_per_m3=1e9"),))
    with_cubic = score(clean, model, context_of(config))
    assert np.isfinite(with_cubic.nats).all()
    assert with_cubic.log_score_per_sample < score(clean, config.model(), context_of(config)).log_score_per_sample


def test_a_true_cause_gains_on_data_that_it_was_not_fitted_to(damped: Segments) -> None:
    found = explained_by(parse_effect(DAMPER), damped)
    gain = HeldOut.of(damped, found).gain_over(found.null_fit)
    assert 0.0 < gain.ci95[0] < gain.value < gain.ci95[1]
    assert gain.value == pytest.approx(gain.after - gain.before)
    assert "blocks" in gain.heldout and not gain.csd_error_rises
    assert confirm_on_held_out(damped, found) == (found, gain)


def test_each_cause_must_gain_beside_those_before_it(damped: Segments) -> None:
    """A false last cause neither hides behind the gain of the true one nor takes the true one with it."""
    alone = explained_by(parse_effect(DAMPER), damped)
    effects = (parse_effect(DAMPER), parse_effect("sensor_gain:channel a2:gain=1.02"))
    both = maximize_posterior(alone.posterior, alone.null_fit.x, effects)
    causes = tuple(Cause.of(effect, np.ones(1)) for effect in both.effects)
    together = replace(alone, causes=causes, final_fit=both)
    assert HeldOut.of(damped, together).gain_over(together.null_fit).is_significant
    found = replace(alone, causes=causes, final_fit=both, simulation_std=np.zeros(2), rounds=((), ()))
    settled, gain = confirm_on_held_out(damped, found)
    assert [c.effect.name for c in settled.causes] == ["story_damper"]
    assert settled.final_fit.log_posterior == pytest.approx(alone.final_fit.log_posterior, abs=0.01)
    assert gain.nats > 0.0 and settled.rounds == found.rounds


def test_alternatives_are_withdrawn_before_what_stands_beside_them(damped: Segments) -> None:
    alone = explained_by(parse_effect(DAMPER), damped)
    effects = (parse_effect(DAMPER), parse_effect("sensor_gain:channel a2:gain=1.02"))
    both = maximize_posterior(alone.posterior, alone.null_fit.x, effects)
    rivals = ((Candidate(both.effects[1], both, 9.0, 9.0), 0.6), (Candidate(both.effects[1], both, 9.0, 8.0), 0.4))
    cause = Cause.of(both.effects[0], np.ones(1))
    found = replace(
        alone, verdict="ambiguous", causes=(cause,), alternatives=rivals, final_fit=both, simulation_std=np.zeros(2)
    )
    settled = found.without_last_cause()
    assert [c.effect.name for c in settled.causes] == ["story_damper"]
    assert settled.verdict != "ambiguous" and settled.alternatives == ()


def test_the_gain_is_what_the_fitted_models_score(damped: Segments) -> None:
    config = settings()
    found = explained_by(parse_effect(DAMPER), damped)
    gain = HeldOut.of(damped, found).gain_over(found.null_fit)
    before, after = (
        score(damped, fitted_model(found.posterior, at), context_of(config)).log_score_per_sample
        for at in (found.null_fit, found.final_fit)
    )
    assert gain.before == pytest.approx(before, abs=0.02)
    assert gain.after == pytest.approx(after, abs=0.02)
    assert gain.value == pytest.approx(after - before, rel=0.25)


def test_a_cause_that_is_not_there_gains_nothing_and_is_not_named(clean: Segments) -> None:
    found = explained_by(parse_effect("sensor_gain:channel a2:gain=1.02"), clean)
    gain = HeldOut.of(clean, found).gain_over(found.null_fit)
    assert gain.ci95[0] <= 0.0
    settled, stated = confirm_on_held_out(clean, found)
    assert stated == HeldOutGain()
    assert (settled.verdict, settled.causes, settled.final_fit) == ("none", (), found.null_fit)
    beside = replace(found, verdict="unexplained", misfit=(LackOfFit("f = 1 Hz", 9.0, "more"),))
    loss, nothing_held_out = replace(gain, before=1.0, after=0.9999), HeldOutGain()
    effects = found.final_fit.effects
    assert not confirms(replace(beside, causes=(Cause.of(effects[0], np.ones(1)),)), effects, loss)
    assert without_any_cause(beside).left_over == beside.misfit
    assert confirms(beside, effects, replace(loss, after=1.0001)) and confirms(beside, effects, nothing_held_out)


def test_what_the_old_form_would_change_of_the_calibration_counts(clean: Segments) -> None:
    found = explained_by(parse_effect("sensor_gain:channel a2:gain=1.02"), clean)
    assert HeldOut.of(clean, found).gain_over(found.null_fit).calibration == 0.0  # a drawing is no data
    learnt = replace(found.posterior.prior, basis=np.zeros((1, 3, 3)))
    far = found.null_fit.x.copy()
    far[0] += 5.0 * learnt.units[0]
    moved = replace(found, posterior=replace(found.posterior, prior=learnt), null_fit=replace(found.null_fit, x=far))
    nats = calibration_nats(moved, moved.null_fit)
    assert nats == pytest.approx(
        learnt.log_density(found.final_fit.x[: learnt.mean.size]) - learnt.log_density(far[: learnt.mean.size])
    )
    none_held_out = HeldOutGain(1.0, 1.0001, (-0.0002, 0.0004))
    assert not none_held_out.is_significant and replace(none_held_out, calibration=41.0 / 1e4).is_significant


def test_an_ambiguous_answer_needs_the_gain_of_its_best_alternative(clean: Segments) -> None:
    found = explained_by(parse_effect("harmonic_excitation:floor 1:frequency_hz=7,force_n=0.001"), clean)
    rivals = tuple((Candidate(e, found.final_fit, 9.0, 9.0), 1.0) for e in found.final_fit.effects)
    ambiguous = replace(found, verdict="ambiguous", alternatives=rivals)
    loss = HeldOutGain(1.0, 0.9988, (-0.0030, 0.0005), heldout="blocks")
    assert not confirms(ambiguous, found.final_fit.effects, loss)
    withdrawn = without_any_cause(ambiguous)
    assert (withdrawn.verdict, withdrawn.alternatives, withdrawn.final_fit) == ("none", (), found.null_fit)
    assert without_any_cause(replace(ambiguous, misfit=(LackOfFit("f = 1 Hz", 9.0, "more"),))).verdict == "unexplained"
    assert confirms(ambiguous, found.final_fit.effects, replace(loss, ci95=(0.0005, 0.0030)))


def test_too_short_a_recording_holds_nothing_out(clean: Segments) -> None:
    found = explained_by(parse_effect(DAMPER), clean)
    gain = HeldOut.of(clean.part(np.arange(clean.t_s.size) < 3), found).gain_over(found.null_fit)
    assert (gain.value, gain.ci95) == (0.0, (0.0, 0.0))
    assert "too short" in gain.withheld
    assert confirms(found, found.final_fit.effects, gain)  # the headline says why there is no gain


def test_a_law_that_bends_is_judged_at_the_motion_that_it_makes() -> None:
    """Its correction by simulation is that of the whole recording: laid on another motion's spectra it would harm."""
    stiffening = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=1e8")
    segments = recorded((stiffening,), seed=43)
    found = explained_by(stiffening, segments)
    posterior, final_fit = refine_fit(found.posterior, found.final_fit)
    fitted = replace(found, posterior=posterior, final_fit=final_fit)
    gain = HeldOut.of(segments, fitted).gain_over(fitted.null_fit)
    assert gain.ci95[0] > 0.0
    assert gain.csd_error_after < 0.5 * gain.csd_error_before


def test_what_a_swinging_gain_leaves_over_is_not_made_up_by_tones_and_oscillators() -> None:
    """They explain its sidebands beside a mode, where the model stays wrong, and nothing elsewhere."""
    config = brisk(settings())
    context = context_of(config)
    motion = simulate(
        Model(context.structure),
        duration_s=1200.0,
        rate_hz=RATE,
        noise=0.02,
        level_spread=0.35,
        seed=61,
        context=context,
    )
    swing = 1.0 + 0.3 * np.sin(2.0 * np.pi * np.arange(len(motion.floors))[:, None] / RATE / 240.0) * [0.0, 0.0, 1.0]
    seen = cut_into_blocks(ACCELERATION, motion.floors * swing, config.channels, RATE, 10**18, 100)
    known = prior_from_drawing(config.model(), np.full(6, 0.002), 3)
    found, _ = diagnose.diagnose_segments(gather(seen, config.front_end()), known, config)
    assert found.verdict == "unexplained"
    accepted = {round_[0].effect.name for round_ in found.rounds if round_}
    peaks = {"harmonic_excitation", "attached_oscillator", "unmodelled_mode"}
    assert accepted & peaks  # the search comes upon them
    assert not {c.effect.name for c in found.causes} & peaks
