"""diagnosis.json and the structure files of a diagnosis: complete, strict, and nothing of the input lost."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag

from monitor.config import configuration
from monitor.core import BadConfigurationError
from monitor.diagnosis.cross_validation import HeldOutGain
from monitor.diagnosis.files import content, effects_text, model_from_plain, model_to_plain, structure_text
from monitor.diagnosis.fold_refit import fitted_model
from monitor.diagnosis.healthy_prior import learn_prior
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.predictive_score import score
from monitor.diagnosis.score_test import Candidate
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.verdict import Cause, Diagnosis
from monitor.inference import Segments, classify, maximize_posterior
from monitor.model import Model, ModelDiscrepancy, parse_effect, prior_file, prior_from_drawing
from tests.support.commands import KEYS
from tests.support.damped_frame import DAMPER, context_of, recorded, settings
from tests.support.files import through_its_file
from tests.support.frames import shear_frame_text

pytestmark = pytest.mark.engine

TEXT = """# The drawing.
[structure]
kind = "shear_frame"   # no shear frame, really
masses_kg = [0.33, 0.35, 0.31]
stiffness_n_per_m = [2900.0, 1500.0, 1900.0]  # by hand

[site]
name = "lab"  # second floor

[[sensors]]
channel = "a1"
floor = 1
[[sensors]]
channel = "a2"
floor = 2
[[sensors]]
channel = "a3"
floor = 3

[[effects]]  # known since long
effect = "added_mass"
location = "floor 2"
parameters = { mass_kg = 0.01 }
"""


@pytest.fixture(scope="module")
def damped() -> Segments:
    return recorded((parse_effect(DAMPER),), seed=51)


@pytest.fixture(scope="module")
def named(damped: Segments) -> Diagnosis:
    site = settings()
    problem, null = fit_linearized(
        classify(damped), prior_from_drawing(site.model(), site.instrumented().prior_std, 3), context_of(site)
    )
    final = maximize_posterior(problem, null.x, (parse_effect(DAMPER),))
    cause = Cause(final.effects[0], {"damping_n_s_per_m": 0.1})
    tried = (Candidate(final.effects[0], final, 50.0, 45.0),)
    misfit = (LackOfFit("f = 5.0-6.0 Hz, channel a1", 9.0, "less power"),)
    return Diagnosis("named", (cause,), (), misfit, (), tried, problem, null, final, DiagnosisSettings())


def plain(diagnosis: Diagnosis, gain: HeldOutGain | None = None) -> dict:
    out = content(diagnosis, gain or HeldOutGain(), (), {"without": [], "with": []})
    return json.loads(json.dumps(out, allow_nan=False))


def test_a_named_cause_has_its_size_and_every_key_is_there(named: Diagnosis) -> None:
    out = plain(named, HeldOutGain(1.0, 1.5, (0.4, 0.6), csd_error_before=0.2, csd_error_after=0.1, heldout="blocks"))
    assert out.keys() >= KEYS
    assert out["cause"] == out["causes"][0]
    assert (out["cause"]["effect"], out["cause"]["location"]) == ("story_damper", "story 1")
    assert out["cause"]["parameters"]["damping_n_s_per_m"]["value"] == pytest.approx(1.5, rel=0.3)
    assert out["gain"]["log_score_per_sample"] == {"before": 1.0, "after": 1.5, "gain": 0.5, "ci95": [0.4, 0.6]}
    assert out["gain"]["csd_error"] == {"before": 0.2, "after": 0.1}
    assert out["tried"] == [{"effect": "story_damper", "location": "story 1", "log_evidence_over_none": 45.0}]


def test_nothing_found_is_null_empty_and_zero(named: Diagnosis) -> None:
    out = plain(replace(named, verdict="none", causes=(), misfit=(), candidates=(), final_fit=named.null_fit))
    assert out["cause"] is None
    assert all(out[key] == [] for key in ("causes", "alternatives", "misfit", "standing", "tried"))
    assert out["gain"]["log_score_per_sample"] == {"before": 0.0, "after": 0.0, "gain": 0.0, "ci95": [0.0, 0.0]}


def test_rivals_are_listed_with_what_would_tell_them_apart(named: Diagnosis) -> None:
    rivals = tuple(
        (Candidate(parse_effect(f"sensor_gain:channel {c}:gain=1.1"), named.final_fit, 9.0, 9.0), 0.5)
        for c in ("a1", "a2")
    )
    out = plain(replace(named, verdict="ambiguous", causes=(), alternatives=rivals))
    assert out["cause"] is None
    assert sum(a["probability"] for a in out["alternatives"]) == pytest.approx(1.0)
    assert out["separating_measurement"]


def test_rivals_of_one_family_have_its_odds_against_all_else(named: Diagnosis) -> None:
    def candidate(effect: str, evidence: float) -> Candidate:
        return Candidate(parse_effect(effect), named.final_fit, evidence, evidence)

    cubic = candidate("cubic_stiffness:story 2:k3_n_per_m3=8e7", 20.0)
    stop = candidate("gap_contact:story 2:gap_m=0.001,contact_stiffness_n_per_m=900", 20.0)
    mass = candidate("added_mass:floor 1:mass_kg=0.01", 12.0)
    found = replace(named, verdict="ambiguous", causes=(), alternatives=((cubic, 0.5), (stop, 0.5)))
    out = plain(replace(found, rounds=((cubic, stop, mass),)))
    assert out["family"] == "hardening"
    assert out["family_log_odds"] == pytest.approx(np.log(2.0) + 8.0, abs=1e-3)
    assert plain(named)["family_log_odds"] is None


def test_the_band_is_all_of_processings_where_nothing_ends_in_it(named: Diagnosis) -> None:
    band = plain(named)["band"]
    assert band["judged_hz"] == band["processing_hz"]
    assert band["says"] == []


def test_what_is_not_judged_is_said_with_its_reason(named: Diagnosis) -> None:
    e = named.posterior.observed
    ended = replace(e.segments, band=replace(e.band, forces_hz=(0.0, 21.0))).within((3.0, 18.0))
    prior = replace(named.posterior.prior, judged_hz=(3.0, 36.0))
    posterior = replace(named.posterior, observed=replace(e, segments=ended), prior=prior)
    below, above = plain(replace(named, posterior=posterior))["band"]["says"]
    assert below.startswith("below 3.0 Hz nothing is judged: the recording that the baseline was learned from")
    assert above.startswith("above 18.0 Hz nothing is judged: the power of all channels ends at 21.0 Hz")


def test_what_is_not_determined_stays_finite(named: Diagnosis) -> None:
    cause = replace(named.causes[0], std={"damping_n_s_per_m": np.inf})
    assert np.isfinite(plain(replace(named, causes=(cause,)))["causes"][0]["parameters"]["damping_n_s_per_m"]["std"])


def test_an_effect_that_has_vanished_is_stated_and_no_error(named: Diagnosis) -> None:
    """Joints as stiff as the number range goes, where a fit takes their flexibility to 0. Calibration once failed on it."""
    rigid = parse_effect("joint_flexibility:frame:girder_to_column_ratio=20").at(np.zeros(1))
    for deviation, std in ((0.0, 0.0), (1e-3, 1e297), (np.inf, 1e300)):
        cause = Cause.of(rigid, np.array([deviation]))
        assert cause.std == {"girder_to_column_ratio": pytest.approx(std)}
        told = plain(replace(named, causes=(cause,)))["causes"][0]["parameters"]["girder_to_column_ratio"]
        assert told["value"] > 1e9 and np.isfinite([told["value"], told["std"]]).all()


def test_the_shape_of_a_coupled_mode_has_one_component_a_channel(named: Diagnosis) -> None:
    """Neither its force nor its couplings belong to it: the report puts a channel's name to each component."""
    mode = parse_effect(
        "unmodelled_mode:frame:frequency_hz=9,damping_ratio=0.01,shape_1=0.5,shape_2=-0.25,shape_3=0.1,force_ratio=4,"
        "eccentricity_1=0.1,eccentricity_2=0,eccentricity_3=-0.1,force_arm_1=0,force_arm_2=0.1,force_arm_3=0"
    )
    cause = Cause(mode, dict.fromkeys(mode.values(), 0.01))
    (told,) = plain(replace(named, causes=(cause,)))["causes"]
    assert [part["value"] for part in told["shape"]] == pytest.approx([1.0, -0.5, 0.2])
    assert told["parameters"].keys() == {"frequency_hz", "damping_ratio"}


def loaded(folder: Path, text: str) -> configuration.Configuration:
    path = folder / "s.toml"
    path.write_text(text)
    return configuration.load(path)


def test_a_structure_file_keeps_tables_and_comments_and_holds_the_model(tmp_path: Path) -> None:
    before = loaded(tmp_path, TEXT).model()
    fitted = replace(
        before.with_stiffness(np.array([2800.0, 1510.0, 1903.123456])).with_masses(np.array([0.34, 0.36, 0.32])),
        effects=(parse_effect("added_mass:floor 2:mass_kg=0.012"), parse_effect("sensor_gain:channel a2:gain=1.05")),
        correction=np.array([[1.0, -2.0, 0.0], [-2.0, 3.0, 0.0], [0.0, 0.0, -4.0]]),
        modal_damping=np.array([0.01, 0.02, 0.03]),
    )
    text = structure_text(TEXT, fitted)
    for comment in ("# The drawing.", "# no shear frame, really", "# by hand", "# second floor", "# known since long"):
        assert comment in text
    after = loaded(tmp_path, text)
    assert after.site.name == "lab"
    model = after.model()
    assert model.effects == fitted.effects
    np.testing.assert_allclose(model.stiffness_matrix(), fitted.stiffness_matrix(), rtol=1e-9)
    np.testing.assert_allclose(model.mass_matrix(), fitted.mass_matrix(), rtol=1e-9)
    np.testing.assert_allclose(model.damping_matrix(), fitted.damping_matrix(), rtol=1e-8)
    again = model_from_plain(json.loads(json.dumps(model_to_plain(fitted, None))), before)
    np.testing.assert_allclose(again.stiffness_matrix(), fitted.stiffness_matrix(), rtol=1e-9)


def test_an_effect_is_added_once() -> None:
    effect = parse_effect("sensor_polarity:channel a2:")
    text = effects_text(effects_text(TEXT, (effect,)), (effect,))
    assert text.count("sensor_polarity") == 1
    assert effects_text(TEXT, ()) == TEXT


def test_two_changes_of_one_story_add_up_in_the_file_too(tmp_path: Path) -> None:
    text = (
        shear_frame_text([1.0, 1.0], [1e4, 1e4])
        + """
[[effects]]
effect = "stiffness_change"
location = "story 2"
parameters = { relative = -0.1 }
"""
    )
    first, second = (parse_effect(f"stiffness_change:story 2:relative={x}") for x in (-0.1, -0.15))
    model = loaded(tmp_path, effects_text(text, (first, second))).model()
    np.testing.assert_allclose(model.structural_matrices()[1], [[1e4, -1e4], [-1e4, 1.75e4]])


def test_matrices_are_written_out_where_the_input_names_files(tmp_path: Path) -> None:
    site = settings()
    drawn = site.model().structure
    slopes = drawn.stiffness_derivatives()
    np.savez(
        tmp_path / "m.npz",
        mass_matrix=drawn.mass_matrix(),
        stiffness_matrix=drawn.stiffness_matrix(),
        stiffness_derivatives=slopes,
    )
    sensors = "".join(f'[[sensors]]\nchannel = "a{i}"\nfloor = {i}\n' for i in (1, 2, 3))
    text = (
        '[structure]\nkind = "matrices"\nstiffness_n_per_m = [2900.0, 1500.0, 1900.0]\n'
        + "".join(f'{k} = "m.npz"\n' for k in ("mass_matrix", "stiffness_matrix", "stiffness_derivatives"))
        + sensors
    )
    fitted = loaded(tmp_path, text).model().with_stiffness(np.array([2800.0, 1500.0, 1900.0]))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    model = loaded(elsewhere, structure_text(text, fitted)).model()
    np.testing.assert_allclose(model.stiffness_matrix(), fitted.stiffness_matrix(), rtol=1e-9)


def test_the_file_scores_what_the_fit_does(tmp_path: Path, named: Diagnosis, damped: Segments) -> None:
    site = settings()
    bare = TEXT[: TEXT.index("[[effects]]")]
    fitted = fitted_model(named.posterior, named.final_fit)
    from_file = loaded(tmp_path, structure_text(bare, fitted))
    one = score(damped, fitted, context_of(site))
    other = score(damped, from_file.model(), context_of(from_file))
    assert other.log_score_per_sample == pytest.approx(one.log_score_per_sample, abs=1e-6)
    assert other.csd_error == pytest.approx(one.csd_error, abs=1e-6)


def test_a_mode_that_the_fit_damps_beyond_swinging_can_be_read_again(tmp_path: Path, damped: Segments) -> None:
    """A fit to an earthquake that hardly moves the highest mode may end there, and the file that it writes is to be judged."""
    site = settings()
    bare = TEXT[: TEXT.index("[[effects]]")]
    fitted = replace(site.model(), effects=(), modal_damping=np.array([0.01, 0.02, 1.02]))
    from_file = loaded(tmp_path, structure_text(bare, fitted))
    one, other = score(damped, fitted, context_of(site)), score(damped, from_file.model(), context_of(from_file))
    assert other.log_score_per_sample == pytest.approx(one.log_score_per_sample, abs=1e-6)


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("modal_damping_ratio = [0.01, 0.02]", "modal_damping_ratio"),
        ("modal_damping_ratio = [0.01, 0.02, 0.0]", "modal_damping_ratio"),
        ("stiffness_correction_n_per_m = [[1.0, 2.0], [2.0, 1.0]]", "stiffness_correction_n_per_m"),
        ("stiffness_correction_n_per_m = [[1, 2, 0], [0, 1, 0], [0, 0, 1]]", "not symmetric"),
        ("stiffness_correction_n_per_m = [[-9000, 0, 0], [0, 0, 0], [0, 0, 0]]", "would not stand"),
    ],
)
def test_a_wrong_correction_or_damping_is_a_problem_of_the_file(tmp_path: Path, line: str, word: str) -> None:
    with pytest.raises(BadConfigurationError, match=word):
        loaded(tmp_path, TEXT.replace("[site]", f"{line}\n[site]"))


def test_diagnosis_settings_are_checked_with_the_rest(tmp_path: Path) -> None:
    assert loaded(tmp_path, TEXT + "\n[diagnosis]\nmargin = 9.0\n").diagnosis.margin == 9.0
    with pytest.raises(BadConfigurationError, match=r"diagnosis\.margin"):
        loaded(tmp_path, TEXT + "\n[diagnosis]\nmargin = -1.0\n")
    with pytest.raises(BadConfigurationError, match=r"diagnosis\.magrin"):
        loaded(tmp_path, TEXT + "\n[diagnosis]\nmagrin = 9.0\n")


def test_a_reference_survives_the_baseline_file(damped: Segments) -> None:
    site = settings()
    model = Model(site.model().structure, (parse_effect(DAMPER),))
    known = prior_from_drawing(model, site.instrumented().prior_std, 3)
    learnt, _ = learn_prior(classify(damped), known, context_of(site), site.diagnosis)
    again = through_its_file(learnt, site)
    assert again.error is None
    assert learnt.judged_hz is None, "the whole band was judged"
    narrow = through_its_file(replace(learnt, judged_hz=(2.0, 18.5)), site)
    assert narrow.judged_hz == (2.0, 18.5)
    assert again.ln_forces.tolist() == learnt.ln_forces.tolist() and abs(learnt.ln_forces.sum()) < 1e-9
    assert np.abs(learnt.ln_forces).max() < 1.0, "the floors are pushed alike"
    plain = prior_file.prior_content(learnt) or {}
    with pytest.raises(ValueError, match="forces"):
        prior_file.read_prior(plain | {"ln_forces": [0.0, 1.0]}, site.model(), site.channels)
    wrong = ModelDiscrepancy(np.array([2.0, 2.25]), np.full((2, 3, 3), 0.1 - 0.2j), np.array([0.0, 0.01]))
    doubted = through_its_file(replace(learnt, error=wrong), site)
    np.testing.assert_array_equal(doubted.error.relative, wrong.relative)
    assert doubted.error.doubtful_hz() == [[2.125, 2.375]]
    assert doubted.error.at(np.array([1.8, 2.1, 2.3, 2.4]))[1].tolist() == [0, 1]
    content = prior_file.prior_content(replace(learnt, error=wrong)) or {}
    with pytest.raises(ValueError, match=r"reference\.error\.variance"):
        prior_file.read_prior(content | {"error": content["error"] | {"variance": [0.0]}}, site.model(), site.channels)
    assert [e.name for e in again.effects(again.mean)] == ["story_damper"]
    for name in ("mean", "precision", "basis"):
        np.testing.assert_array_equal(getattr(again, name), getattr(learnt, name))
    accepted = Model(site.model().structure, (parse_effect("sensor_gain:channel a2:gain=1.05"),))
    wider = prior_file.read_prior(prior_file.prior_content(learnt), accepted, site.channels)
    assert [e.name for e in wider.effects(wider.mean)] == ["story_damper", "sensor_gain"]
    with pytest.raises(ValueError, match=r"reference\.mean"):
        prior_file.read_prior(prior_file.prior_content(learnt), site.model(), ("a1", "a2"))


def test_a_size_in_large_units_that_stands_is_not_said_to_be_certain(named: Diagnosis) -> None:
    law, known = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=8e7"), named.posterior.prior
    standing = replace(
        known,
        model=replace(known.model, effects=(law,)),
        mean=np.append(known.mean, law.coordinates),
        precision=block_diag(known.precision, np.eye(1) / 3e6**2),
    )
    (told,) = plain(replace(named, posterior=replace(named.posterior, prior=standing)))["standing"]
    assert told["parameters"]["k3_n_per_m3"]["std"] == pytest.approx(np.hypot(3e6, 0.1 * 8e7), rel=1e-6)
