"""The sentences of a diagnosis: a class in one, no size that chance gives, and a `none` that reassures nobody."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monitor.diagnosis.cross_validation import HeldOutGain
from monitor.diagnosis.drawing_refit import refit, refit_headline
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.wording import (
    class_in_words,
    csd_error_in_words,
    headline,
    in_words,
    law_family,
    not_relied_on,
    separating_measurement,
)
from monitor.model import EFFECTS, FORMS, prior_from_drawing
from tests.examples.brace_stiffness import BraceStiffness
from tests.support.damped_frame import settings

pytestmark = pytest.mark.engine

SITE = settings()
DRAWING = prior_from_drawing(SITE.model(), SITE.instrumented().prior_std, 3)
BASELINE = prior_from_drawing(SITE.model(), SITE.instrumented().prior_std, 3, n_modes=3)
GAIN = HeldOutGain(1.0, 1.5, (0.4, 0.6), heldout="blocks")
NO_GAIN = HeldOutGain(1.0, 1.01, (-0.01, 0.03), heldout="blocks")


def sizes(**parameters: tuple[float, float]) -> dict[str, dict[str, float]]:
    return {name: {"value": value, "std": std} for name, (value, std) in parameters.items()}


def rival(effect: str, location: str, probability: float, **parameters: tuple[float, float]) -> dict[str, Any]:
    return {"effect": effect, "location": location, "probability": probability, "parameters": sizes(**parameters)}


@pytest.mark.parametrize(
    ("rivals", "family", "words"),
    [
        (
            [
                rival("harmonic_excitation", f"floor {i}", p, frequency_hz=(1.43, 0.0005), force_n=(0.4, 0.04))
                for i, p in ((5, 0.2), (4, 0.5), (1, 0.3))
            ],
            None,
            "a machine drives one of floors 1, 4, 5 at 1.4300 ± 0.0010 Hz with 0.400 ± 0.080 N; which one cannot be told",
        ),
        (
            [
                rival("cubic_stiffness", "story 1", 0.6, k3_n_per_m3=(1e7, 1e6)),
                rival("gap_contact", "story 1", 0.4, gap_m=(0.001, 1e-4), contact_stiffness_n_per_m=(900.0, 10.0)),
            ],
            "hardening",
            "story 1 hardens with the level (a cubic spring or a stop)",
        ),
        (
            [
                rival("gap_contact", "story 1", 0.4, gap_m=(0.001, 1e-4), contact_stiffness_n_per_m=(900.0, 10.0)),
                rival("bilinear_stiffness", "story 1", 0.6, relative_drop=(0.1, 0.01)),
            ],
            "asymmetric",
            "story 1 is softer one way than the other (a stop or a crack that opens)",
        ),
        (
            [
                rival("story_damper", "story 3", 0.6, damping_n_s_per_m=(1.1, 0.01)),
                rival("coulomb_friction", "story 2", 0.4, friction_force_n=(0.1, 0.01)),
            ],
            "dissipating",
            "one of stories 2, 3 dissipates more energy than the model does (a viscous damper or dry friction)",
        ),
    ],
)
def test_an_ambiguous_answer_names_the_class(rivals: list[dict[str, Any]], family: str | None, words: str) -> None:
    assert law_family(rivals) == family
    assert class_in_words(rivals, DRAWING) == words


def test_rivals_without_anything_in_common_are_both_stated_and_many_are_counted() -> None:
    two = [
        rival("stiffness_change", "story 3", 0.6, relative=(-0.1, 0.01)),
        rival("base_flexibility", "base", 0.4, stiffness_n_per_m=(2e4, 1e3)),
    ]
    words = class_in_words(two, DRAWING)
    assert words.startswith(
        "these data cannot tell whether story 3 is 10.0 ± 2.0 % softer than the structure file says, or the base"
    )
    assert "%)" not in words  # probabilities stand in the list
    many = [*two, *[rival("sensor_gain", f"channel a{i}", 0.1, gain=(1.1, 0.01)) for i in (1, 2, 3)]]
    assert "one of 3 other causes" in class_in_words(many, DRAWING)
    signs = [rival("stiffness_change", f"story {j}", 0.5, relative=(0.1 * (-1) ** j, 0.01)) for j in (1, 2)]
    assert "softer" in class_in_words(signs, DRAWING) and "stiffer" in class_in_words(signs, DRAWING)


def test_sizes_that_differ_between_the_places_widen_the_interval() -> None:
    rivals = [
        rival("stiffness_change", "story 2", 0.5, relative=(-0.10, 0.001)),
        rival("stiffness_change", "story 3", 0.5, relative=(-0.14, 0.001)),
    ]
    assert "12.0 ± 4.0 % softer" in class_in_words(rivals, DRAWING)


def test_no_effect_states_a_size_that_is_not_different_from_none() -> None:
    """Twice the standard deviation is the limit, for every effect and parameter that has an absent value."""
    places = {"story": "story 2", "floor": "floor 2", "channel": "channel a1", "channels": "channel a1,a3"}
    for name, effect in FORMS.items():
        for kind in effect.places:
            parameters = (
                ["relative"] if (name, kind) == ("added_mass", "frame") else [p.name for p in effect.parameters]
            )
            near = sizes(**{p: (1.0 + 0.0123 * (p == "gain") if p == "gain" else 0.0123, 1.0) for p in parameters})
            words = in_words(name, places.get(kind, kind), near, DRAWING)
            sized = {p for p in parameters if p not in ("frequency_hz",)}  # a frequency has no value of absence
            assert not sized or "±" not in words.split(" Hz")[-1], (name, words)
    assert in_words(
        "harmonic_excitation", "floor 1", sizes(frequency_hz=(2.083, 0.001), force_n=(0.40, 0.405)), DRAWING
    ) == ("a machine drives floor 1 at 2.0830 ± 0.0020 Hz, too weakly to be sized")


def test_percentages_beyond_sense_are_said_in_words() -> None:
    assert "more than 1000 %" in in_words("stiffness_change", "story 1", sizes(relative=(4247.0, 1.0)), DRAWING)
    assert csd_error_in_words(0.5) == "50.0 %"
    assert "%" not in csd_error_in_words(4247.0) and "worse than no prediction" in csd_error_in_words(4247.0)


def said(
    verdict: str, reference: Any, gain: HeldOutGain = GAIN, left_over: Sequence[LackOfFit] = (), **more: Any
) -> str:
    diagnosis: Any = SimpleNamespace(posterior=SimpleNamespace(prior=reference), left_over=left_over)
    blank = {
        "refit": [],
        "other_optima": [],
        "causes": [],
        "alternatives": [],
        "also_fitted": [],
        "ddi_effect": {"with": []},
        "detectable_loss": [],
    }
    return headline(diagnosis, gain, {**blank, "verdict": verdict, **more})


def test_none_says_what_would_have_been_found_and_never_that_nothing_is_wrong() -> None:
    assert (
        said("none", DRAWING) == "The refitted model explains these data; without a baseline nothing is said of damage."
    )
    assert said("none", BASELINE, detectable_loss=[0.012, 0.034]) == (
        "Nothing new beside the healthy data: no loss above 3.4 % in any story (smallest that would have been found)."
    )
    assert "a loss in story 2 would not have been found" in said("none", BASELINE, detectable_loss=[0.012, None])
    for text in (said("none", DRAWING), said("none", BASELINE)):
        assert "wrong" not in text and "undamaged" not in text


SWAP = {
    "effect": "channel_swap",
    "location": "channel a1,a3",
    "parameters": {},
    "says": "channels a1 and a3 are swapped",
}
LOSS = {"effect": "stiffness_change", "location": "story 2", "parameters": {}, "says": "story 2 is softer"}


def test_a_finding_says_what_is_left_of_the_loss_that_it_feigned() -> None:
    left = {"without": [0.03, -0.54], "with": [0.004, -0.001]}
    assert said("named", BASELINE, causes=[SWAP], ddi_effect=left) == (
        "Channels a1 and a3 are swapped; with it taken out no story changed by more than 0.4 %."
    )
    assert "taken out" not in said("named", BASELINE, causes=[LOSS], ddi_effect=left)


def test_a_cause_without_a_gain_says_why_or_stays_out_of_the_headline() -> None:
    short = HeldOutGain(heldout="none: the recording is too short to hold any of it out")
    assert said("named", BASELINE, causes=[LOSS]) == "Story 2 is softer."
    assert "too short" in said("named", BASELINE, short, causes=[LOSS])
    assert "interval of the mean gain includes zero" in said(
        "named", BASELINE, replace(NO_GAIN, nats=30.0), causes=[LOSS]
    )
    assert "what calibration learned would have to have changed" in said(
        "named", BASELINE, replace(NO_GAIN, calibration=0.02), causes=[LOSS]
    )
    rises = replace(GAIN, csd_error_before=0.01, csd_error_after=0.07, csd_error_rises=True)
    assert "cross-spectra is larger (1.0 % -> 7.0 %)" in said("named", BASELINE, rises, causes=[LOSS])
    poor = replace(GAIN, csd_error_before=225.0, csd_error_after=64.0)
    assert "8 times the measured power" in said("named", BASELINE, poor, causes=[LOSS])
    assert "form" not in said("named", BASELINE, replace(poor, csd_error_after=0.9), causes=[LOSS])
    steady = LackOfFit("f = 1 Hz", 9.0, "more")
    late = replace(steady, changes=True)
    assert "changed" not in (words := said("unexplained", BASELINE, NO_GAIN, [steady], causes=[LOSS]))
    assert "softer" not in words
    assert "softer" in said("unexplained", BASELINE, GAIN, [steady], causes=[LOSS])
    assert "changed within the recording" in said("unexplained", BASELINE, NO_GAIN, [late], causes=[LOSS])


def refitted(
    relative: Sequence[float], std: float, tolerance: Sequence[float], left_over: Sequence[LackOfFit] = ()
) -> list[dict[str, Any]]:
    """The comparison of three stiffnesses and three masses that differ from the drawing by `relative`."""
    layout = SimpleNamespace(stiffness=slice(0, 3), masses=slice(3, 6))
    fit = SimpleNamespace(x=DRAWING.mean[:6] + np.log1p(relative), covariance=std**2 * np.eye(6), effects=())
    nothing = SimpleNamespace(
        predict=lambda *_: SimpleNamespace(spectra=np.ones((1, 1, 1, 1))),
        slope_rows=lambda *_: (np.zeros((1, 6)), np.zeros(1), np.zeros(0)),  # so that ranges do not disagree
        normal_prior=lambda *_: (fit.x, np.eye(6)),
        observed=SimpleNamespace(level=np.ones(1), label=np.zeros(1, dtype=int)),
    )
    posterior = SimpleNamespace(layout=layout, prior=DRAWING, **vars(nothing))
    diagnosis: Any = SimpleNamespace(posterior=posterior, final_fit=fit, left_over=left_over)
    return refit(diagnosis, np.array(tolerance), ["story 1", "story 2", "story 3 (hanger)"])


def test_a_refit_beyond_the_stated_tolerance_is_the_headline_before_the_verdict() -> None:
    rows = refitted((0.01, 0.0, -0.191, 0.0, 0.0, 0.0), 0.01, (0.05,) * 6)
    assert [row["location"] for row in rows] == ["story 1", "story 2", "story 3", "floor 1", "floor 2", "floor 3"]
    assert [row["beyond_tolerance"] for row in rows] == [False, False, True, False, False, False]
    assert rows[2]["drawn"] == pytest.approx(1900.0) and rows[2]["refitted"] == pytest.approx(0.809 * 1900.0)
    assert rows[2]["relative"] == pytest.approx(-0.191) and rows[2]["relative_std"] == pytest.approx(0.00809)
    text = said("none", DRAWING, refit=rows)
    assert text.startswith(
        "Story 3 (hanger) is 19.1 ± 1.6 % softer than drawn, beyond the stated tolerance of ± 5 %. The ref"
    )


def test_within_the_tolerance_is_not_beyond_it_and_without_one_every_difference_counts() -> None:
    within = (0.03, 0.0, -0.05, 0.0, 0.02, 0.0)
    assert refit_headline(refitted(within, 0.005, (0.1,) * 6)) == (
        "Refitted, every stiffness and mass is within the drawing's tolerance."
    )
    open_rows = refitted(within, 0.005, (np.nan,) * 6)
    assert [row["beyond_tolerance"] for row in open_rows] == [True, False, True, False, True, False]
    assert refit_headline(open_rows).endswith(
        "floor 2 is 2.0 ± 1.0 % heavier than drawn (the structure file states no tolerance)."
    )
    heavy = refit_headline(refitted((0.0, 0.0, -0.05, 0.0, 0.2, 0.0), 0.005, (np.nan,) * 6))
    assert heavy.startswith("Story 3 (hanger) is 5.00 ± 0.95 % softer")  # stiffnesses come first
    assert open_rows[1]["says"] == "story 2 is as drawn to within 1 %"
    assert refit_headline([]) == ""
    other = LackOfFit(
        "structure of the file", 9.0, "nothing can be said of it", is_explained=True, hides_structure=True
    )
    assert refitted(within, 0.005, (0.1,) * 6, [other]) == []


def test_what_is_not_to_be_relied_on_stands_below_the_headline() -> None:
    doubted = [{**LOSS, "doubt": "not constant"}, {**SWAP, "doubt": "contradicted"}]
    assert "rely" not in said("unexplained", BASELINE, also_fitted=doubted)
    assert not_relied_on({"also_fitted": [*doubted, {**LOSS, "doubt": "no news"}]}) == [
        f"also fitted, not to be relied on, for ranges of frequency or level, or other channels, disagree on it: {LOSS['says']}",
        f"also fitted, not to be relied on, for a sensor that entered no fit contradicts it: {SWAP['says']}",
    ]


def test_a_clock_that_drifts_is_said_before_what_nothing_explains() -> None:
    clock = LackOfFit("clock of channel a2", 9.0, "the delay of channel a2 grows", changes=True, is_explained=True)
    other = LackOfFit("f = 3.0-4.0 Hz, channel a1", 7.0, "more power")
    assert said("unexplained", BASELINE, left_over=[clock]) == "The delay of channel a2 grows."
    assert said("unexplained", BASELINE, left_over=[clock], causes=[SWAP]) == (
        "The delay of channel a2 grows. Besides, channels a1 and a3 are swapped."
    )
    assert said("unexplained", BASELINE, left_over=[clock, other]) == (
        "The delay of channel a2 grows. Something is wrong at 3.0-4.0 Hz, channel a1 that no known effect explains."
    )


def test_the_separating_measurement_speaks_of_the_rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    def alternatives(*pairs: tuple[str, str]) -> list[dict[str, str]]:
        return [{"effect": e, "location": p} for e, p in pairs]

    assert separating_measurement([]) is None
    assert separating_measurement(alternatives(("clock_rate", "frame"))) is None
    base = separating_measurement(alternatives(("base_flexibility", "base"), ("stiffness_change", "story 3")))
    assert base is not None and "footing" in base and "drift" not in base
    uniform = separating_measurement(
        alternatives(("clock_rate", "frame"), ("added_mass", "frame"), ("stiffness_change", "frame"))
    )
    assert uniform is not None and "clock" in uniform and "mass" in uniform
    where = separating_measurement(alternatives(("story_damper", "story 1"), ("story_damper", "story 2")))
    assert where is not None and "story 1 and story 2" in where
    for effect in EFFECTS:
        assert separating_measurement(alternatives((effect, "x"), ("stiffness_change", "story 1")))
    monkeypatch.setitem(EFFECTS, "brace_stiffness", BraceStiffness)
    added = separating_measurement(alternatives(("brace_stiffness", "story 2"), ("stiffness_change", "story 2")))
    assert added == BraceStiffness.separating_measurement
