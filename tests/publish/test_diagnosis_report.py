"""The diagnosis's page and view say what was found, whole, by themselves and in safety."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from monitor.diagnosis import DiagnosisSettings, HeldOutGain, StoryLaw, content as content_of, diagnose, in_words
from monitor.inference import classify
from monitor.model import EFFECTS, FORMS, interval, parse_effect
from monitor.publish.reports.comparison import compare, level_dependence
from monitor.publish.reports.diagnosis_report import diagnosis_sheet, write_report
from monitor.publish.viewer.diagnosis_view import write_view
from tests.diagnosis import jointed_frame
from tests.diagnosis.jointed_frame import COLOUR, FORCES, GAINS
from tests.diagnosis.searched import CONFIG, GAIN, LOSS, REFERENCE, Case, recorded, searched, stated
from tests.support.pages import Page, marks

pytestmark = pytest.mark.engine

"""Known so well that its stiffnesses cannot take up a cause."""


@pytest.fixture(scope="module")
def cases() -> dict[str, Case]:
    return {
        "named": searched((LOSS,), (LOSS, "added_mass:floor 3:mass_kg=0.01"), "named", causes=1),
        "none": searched((), ("added_mass:floor 3:mass_kg=0.01",), "none"),
        "ambiguous": searched(
            ("stiffness_change:story 3:relative=-0.1",),
            ("stiffness_change:story 3:relative=-0.05", "base_flexibility:base:stiffness_n_per_m=20000"),
            "ambiguous",
        ),
        "unexplained": searched(
            ("harmonic_excitation:floor 1:frequency_hz=11,force_n=0.5",),
            ("sensor_noise:channel a1:rms_m_s2=0.1",),
            "unexplained",
        ),
    }


def parsed(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def page(*parts: Any) -> Page:
    return Page(diagnosis_sheet(*parts).html())


def test_the_page_of_each_verdict_is_whole(cases: dict[str, Case], tmp_path: Path) -> None:
    sentences = {
        "named": r"^Story 2 is (9|10)\.\d+ ± 0\.20 % softer than the structure file says\.$",
        "none": r"^The refitted model explains these data; without a baseline nothing is said of damage\.$",
        "ambiguous": r"^These data cannot tell whether story 3 .*, or the base gives way .*\.$",
        "unexplained": r"^Something is wrong at 1[01]\.\d-1[12]\.\d Hz, channel.* that no known effect explains\.$",
    }
    for verdict, case in cases.items():
        path = tmp_path / f"{verdict}.html"
        write_report(path, case.diagnosis, case.content, case.segments)
        assert path.stat().st_size < 3_000_000
        root = parsed(path)
        text = root.words
        assert re.search(sentences[verdict], root.headline), verdict
        assert all(channel in text for channel in CONFIG.channels)
        assert ("To tell them apart" in text) == (verdict == "ambiguous")
        assert (GAIN.heldout in text) == (verdict in ("named", "ambiguous"))
        told = [*case.content["causes"], *case.content["alternatives"]]
        assert all(EFFECTS[c["effect"]].signature in text for c in told) and (" shows: " in text) == bool(told)
        spectra = [root.chart(f"{name}: {what}") for name in CONFIG.channels for what in ("power", "measured /")]
        lines = [mark for chart in spectra for mark in marks(chart, "line")]
        assert len(lines) == 3 * (5 if case.diagnosis.final_fit.effects else 3)
        for line in lines:
            y = np.array(line["y"], dtype=float)
            assert len(y) > 20 and np.isfinite(y).all() and np.ptp(y) > 0.0
        maps = [marks(root.chart(f"Misfit {when}"), "grid") for when in ("before", "after")[: len(lines) // 7]]
        assert all(grid["signed"] and set(grid["levels"]) != {"A"} for (grid,) in maps)


def test_what_makes_the_baseline_doubtful_stands_below_the_verdict(cases: dict[str, Case]) -> None:
    case = cases["none"]
    plain, doubtful = (page(case.diagnosis, case.content | more, case.segments) for more in ({}, {"doubts": ["a < b"]}))
    assert not [tag for tag, given in plain.tags if given.get("class") == "doubts"]
    assert doubtful.words.index(doubtful.headline) < doubtful.words.index("a < b") < doubtful.words.index("How to read")


def test_the_many_rows_of_the_witnesses_take_few_lines_on_a_narrow_page(cases: dict[str, Case]) -> None:
    case = cases["none"]
    mode = {"of": "mode_1", "frequency_hz": 5.0, "ratio": 0.4, "std": 0.01, "coherence": 0.9}
    mode |= {"predicted_before": None, "predicted": None}
    told = {"channel": "g1", "verdict": None, "says": "nothing", "unit": "rad/m", "modes": [mode]}
    shown = page(case.diagnosis, case.content | {"witness": [told]}, case.segments)
    (row,) = shown.table("coherence")
    assert row.count("") == 2
    assert "folds flows" in [given.get("class") for tag, given in shown.tags if tag == "table"]


def test_what_was_fitted_without_being_stated_is_said(cases: dict[str, Case], tmp_path: Path) -> None:
    best = cases["none"].diagnosis.candidates[0]
    also = (replace(stated(best.effect), doubt="no news"),)
    diagnosis = replace(cases["none"].diagnosis, also_fitted=also, final_fit=best.fit)
    case = Case(diagnosis, cases["none"].segments)
    write_report(tmp_path / "page.html", case.diagnosis, case.content, case.segments)
    text = parsed(tmp_path / "page.html").words
    (own,) = case.content["also_fitted"]
    assert case.content["causes"] == [] and own["effect"] == "added_mass" and own["says"] in case.content["says"]
    assert "Also fitted, not stated" in text and "nats a sample" not in text


def test_the_page_shows_where_the_misfit_was_and_that_the_cause_removes_it(cases: dict[str, Case]) -> None:
    c = compare(cases["named"].diagnosis, cases["named"].segments)
    assert np.abs(c.z_before).max() > c.limit > np.abs(c.z_after).max()
    before, after = (float((np.abs(r - 1.0) > c.chance).mean()) for r in (c.ratio_before, c.ratio_after))
    assert after < 0.08 < before  # chance leaves about one in twenty outside
    together = {m.says.partition(" (")[0] for m in cases["named"].diagnosis.misfit if " and " in m.where}
    assert "they move together in phase otherwise than in the model" in together
    shown = page(cases["named"].diagnosis, cases["named"].content, cases["named"].segments)
    assert "above 0: the cause predicts better" in shown.words


def test_what_is_not_judged_is_drawn_shaded_and_said_why() -> None:
    segments, context = recorded()
    narrow = replace(segments, band=replace(segments.band, forces_hz=(0.0, 22.0))).within((2.0, 20.0))
    shown = {}
    for name, part in (("whole", segments), ("narrow", narrow)):
        found = diagnose(classify(part), REFERENCE, context, DiagnosisSettings(worth=1e9))
        shown[name] = page(found, content_of(found, HeldOutGain(), (), {"without": [], "with": []}), part)
    shaded = {name: marks(one.chart("a1: power"), "shade", "unjudged") for name, one in shown.items()}
    assert shaded["narrow"] and "above 20.0 Hz nothing is judged" in shown["narrow"].words
    assert not shaded["whole"] and "nothing is judged" not in shown["whole"].words


@pytest.mark.parametrize("standing", [(COLOUR, *GAINS), (FORCES,)], ids=["colour and gains", "forces of every day"])
def test_the_forces_that_stand_are_drawn_where_their_spectrum_was_learned(standing: tuple[str, ...]) -> None:
    segments = jointed_frame.recorded(*standing, seed=2)
    prior, context = jointed_frame.learned(*standing), jointed_frame.CONTEXT
    found = diagnose(classify(segments), prior, context, DiagnosisSettings(worth=1e9))
    shown = page(found, content_of(found, HeldOutGain(), (), {"without": [], "with": []}), segments)
    title = "forces on the floors at calibration"
    is_drawn = any(name.startswith(title) for name in shown.titles.values())
    assert (is_drawn, "rise_1" in shown.words) == (standing == (FORCES,), False)
    if is_drawn:  # falling, not level
        (line,) = marks(shown.chart(title), "line")
        assert line["y"][0] > 1.3 * line["y"][-1]


def test_the_limit_is_that_of_the_diagnosis(cases: dict[str, Case], tmp_path: Path) -> None:
    case = cases["named"]
    assert case.diagnosis.settings == DiagnosisSettings(worth=1e9)  # what `diagnose` was given
    diagnosis = replace(case.diagnosis, settings=DiagnosisSettings(misfit=4.5))
    write_report(tmp_path / "page.html", diagnosis, case.content, case.segments)
    text = parsed(tmp_path / "page.html").words
    assert "beyond 4.5 standard deviations" in text and "chance up to 4.5." in text


def test_power_is_what_was_measured(cases: dict[str, Case]) -> None:
    segments = cases["none"].segments
    c = compare(cases["none"].diagnosis, segments)
    np.testing.assert_allclose(c.measured.T, 2.0 * (np.abs(segments.values) ** 2).mean(axis=0))


def test_level_dependence_is_shown_for_a_cause_that_has_one_and_follows_it() -> None:
    case = searched((), ("cubic_stiffness:story 2:k3_n_per_m3=1e6",), "named", causes=1)
    assert level_dependence(case.diagnosis) is not None
    hard = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=2e6")
    fit = replace(case.diagnosis.final_fit, effects=(hard,))
    fit = replace(fit, x=np.append(fit.x[:-1], hard.coordinates))
    by = level_dependence(replace(case.diagnosis, final_fit=fit))
    assert (np.diff(by.at) > 0).all() and (np.diff(by.model_frequency_hz, axis=0).max(axis=1) > 0).all()
    assert (np.ptp(by.frequency_hz, axis=0) < 5.0 * by.frequency_std.max(axis=0)).all()


def test_no_level_dependence_without_a_cause_that_has_one(cases: dict[str, Case]) -> None:
    assert level_dependence(cases["named"].diagnosis) is None


def test_the_view_has_every_channel_and_the_verdict(cases: dict[str, Case], tmp_path: Path) -> None:
    case, path = cases["ambiguous"], tmp_path / "diagnosis.rrd"
    write_view(path, case.diagnosis, case.content, case.segments)
    (recording,) = RrdReader(path).recordings()
    entities = {chunk.entity_path for chunk in RrdReader(path).stream()}
    assert recording is not None
    assert {"/verdict", "/misfit/before", "/misfit/after", "/worst/after"} <= entities
    assert sum(bool(re.fullmatch(r"/spectra/.*/(measured|before|after)", e)) for e in entities) == 9


def test_the_page_and_the_view_draw_the_loops_of_every_story(cases: dict[str, Case], tmp_path: Path) -> None:
    case, phase, two = cases["named"], np.linspace(0.0, 20.0, 200), np.array([1.0, 2.0])
    loops: Any = [
        SimpleNamespace(drift_m=1e-3 * np.sin(phase), force_n=k * np.sin(phase + 0.1)) for k in (1.0, 2.0, 3.0)
    ]
    laws = [StoryLaw(j, 1e-3 * two, two, 0.1 * two, two, two, two, two, *loops) for j in (1, 2)]
    shown = page(case.diagnosis, case.content, case.segments, laws)
    assert all(len(marks(shown.chart(f"story {j}: force, N"), "line")) == 3 for j in (1, 2))
    write_view(tmp_path / "diagnosis.rrd", case.diagnosis, case.content, case.segments, laws=laws)
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "diagnosis.rrd").stream()}
    assert {f"/loops/{j}/{part}" for j in (1, 2) for part in ("loop", "axes", "scale")} <= entities


VALUES = {"relative": -0.05, "per_degc": -1e-3, "gain": 1.05, "gap_m": -0.001, "share": 0.3, "damping_ratio": 0.02}


def test_every_effect_has_words_with_its_place_and_its_unit() -> None:
    places = {
        "story": "story 2",
        "floor": "floor 2",
        "channel": "channel a1",
        "channels": "channel a1,a3",
        "base": "base",
        "frame": "frame",
    }
    for name, effect in FORMS.items():
        for kind in effect.places:
            names = ["relative"] if (name, kind) == ("added_mass", "frame") else [p.name for p in effect.parameters]
            values = {n: {"value": VALUES.get(n, 12.0), "std": 0.0001} for n in names}
            words = in_words(name, places[kind], values, REFERENCE)
            if kind in ("story", "floor", "channel"):
                assert places[kind] in words, name
            assert "\n" not in words and not words.endswith(".") and "_" not in words


@pytest.mark.parametrize(
    ("effect", "place", "values", "words"),
    [
        ("stiffness_change", "story 2", {"relative": (-0.082, 0.0005)}, "story 2 is 8.20 ± 0.10 % softer than"),
        ("stiffness_change", "frame", {"relative": (0.02, 0.001)}, "all stories are 2.00 ± 0.20 % stiffer than"),
        ("ambient_forces", "frame", {"common_share": (0.3, 0.01)}, "spectrum, and 30.0 ± 2.0 % of it pushes all floors at once"),
        ("ambient_forces", "frame", {"common_share": (0.001, 0.01)}, "not white, but of a smooth spectrum"),
        ("sensor_gain", "channel a2", {"gain": (0.95, 0.001)}, "channel a2 reads 5.00 ± 0.20 % too little"),
        ("time_offset", "channel a2", {"seconds": (0.002, 1e-5)}, "channel a2 comes 2.000 ± 0.020 ms late"),
        ("time_offset", "channel a2", {"seconds": (-0.002, 1e-5)}, "channel a2 comes 2.000 ± 0.020 ms early"),
        ("added_mass", "floor 1", {"mass_kg": (0.03253, 1e-4)}, "0.03253 ± 0.00020 kg more than the structure file says (10.0 %"),
        ("base_flexibility", "base", {"stiffness_n_per_m": (1897.6986, 1.0)}, "takes 50.0 % from the lowest story"),
        ("gap_contact", "story 1", {"gap_m": (-1e-3, 1e-5), "contact_stiffness_n_per_m": (900.0, 10.0)}, "1.000 ± 0.020 mm"),
    ],
)  # fmt: skip
def test_words_have_the_size_and_the_direction(effect: str, place: str, values: dict, words: str) -> None:
    entries = {name: {"value": v, "std": s} for name, (v, s) in values.items()}
    assert words in in_words(effect, place, entries, REFERENCE)


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (3.9e8, 3.5e6, "(3.900 ± 0.070)·10⁸ N"),
        (21946.0, 600.0, "21900 ± 1200 N"),
        (2.0, 1e200, "about 2 N (hardly determined)"),
        (104.0, 1e200, "about 100 N (hardly determined)"),
        (1.04e6, 1e200, "about 1e+06 N (hardly determined)"),
        (2.0, 0.0, "2 N"),
        (0.0, 0.0, "0 N"),
        (0.0, 1e-5, "(0.0 ± 2.0)·10⁻⁵ N"),
    ],
)
def test_intervals_have_the_digits_that_are_known(value: float, std: float, text: str) -> None:
    assert interval({"value": value, "std": std}, 1.0, "N") == text
