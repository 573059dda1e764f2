"""A look at tables and recordings without a model: what is found, what is doubted, the files, and the proposed structure."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.config import configuration
from monitor.core import BadInputError, MissingInputError, ModalEstimate, Skipped
from monitor.model import Model, ShearFrame, simulate
from monitor.publish import LookedRecording, mode_rows
from monitor.runs import Options, compare, look
from monitor.runs.look import identify_band
from tests.support.pages import Page, marks

RATE_HZ, SECONDS = 50.0, 400.0
FRAME = ShearFrame(np.array([1.0, 1.1, 0.9]), np.array([900.0, 1000.0, 1100.0]), damping_ratio=0.01)
MODES = Model(FRAME).modes()


def samples(seed: int = 0, level: float = 0.01, softer: float = 0.0) -> np.ndarray:
    """Acceleration of the three floors by white forces, m/s^2, with sensor noise."""
    rng = np.random.default_rng(seed)
    modes = (
        MODES if not softer else Model(FRAME).with_stiffness(FRAME.stiffness_n_per_m * [1.0, 1.0 - softer, 1.0]).modes()
    )
    forces = rng.standard_normal((int(RATE_HZ * SECONDS), 3)) @ modes.shapes
    poles = np.exp(2.0 * np.pi / RATE_HZ * modes.frequencies_hz * (-0.01 + 1j))
    modal = [
        lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * p.real, abs(p) ** 2], f) for p, f in zip(poles, forces.T, strict=True)
    ]
    clean = np.transpose(modal) @ modes.shapes.T
    return np.asarray(level * (clean / clean.std() + 0.05 * rng.standard_normal(clean.shape)))


def table(path: Path, values: np.ndarray, unit: str = "") -> Path:
    names = ["t", *(f"a{k}{unit}" for k in range(1, values.shape[1] + 1))]
    columns = np.column_stack([np.arange(len(values)) / RATE_HZ, values])
    np.savetxt(path, columns, delimiter=",", header=",".join(names), comments="", fmt="%.8g")
    return path


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> LookedRecording:
    return look.look([table(tmp_path_factory.mktemp("look") / "frame.csv", samples())], Options(unit="m/s^2"))


def doubts(folder: Path, values: np.ndarray, unit: str = "") -> str:
    return "\n".join(look.look([table(folder / "d.csv", values, unit)]).doubts)


def test_a_look_lists_every_covariate_of_a_table(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    wind = np.column_stack([np.arange(3000) / RATE_HZ, samples()[:3000], np.full((3000, 2), 5.0)])
    np.savetxt(
        path, wind, delimiter=",", header="t,a1 [g],a2 [g],a3 [g],wind [m/s],air [degC]", comments="", fmt="%.6g"
    )
    found = look.look([path])
    assert sorted(found.topics) == ["/acceleration", "/temperature", "/wind"] and found.topics["/wind"]["unit"] == "m/s"


def test_a_table_alone_gives_the_modes_with_intervals(found: LookedRecording) -> None:
    assert found.rate_hz == RATE_HZ
    assert found.duration_s == SECONDS
    assert len(found.modes) == 3
    for mode, hz in zip(found.modes, MODES.frequencies_hz, strict=True):
        assert abs(mode.frequency_hz - hz) < 4.0 * mode.frequency_std_hz
        assert not isinstance(mode.second, Skipped)
        assert mode.differs == ""
        assert mode.remark == ""
    assert found.notes
    assert "50 Hz" in found.notes[0]


def test_a_sound_recording_is_doubted_for_nothing_and_its_missing_lowpass_is_a_remark(
    found: LookedRecording, tmp_path: Path
) -> None:
    assert found.doubts == ()
    assert sum("no lowpass is seen" in note and "little moves there" in note for note in found.notes) == 1
    look.write_results(found, tmp_path)
    shown = Page((tmp_path / "look.html").read_text())
    assert (shown.state, "looked at" in shown.head) == ("normal", True)


def test_a_missing_lowpass_is_a_doubt_where_what_folds_is_as_strong_as_a_mode(tmp_path: Path) -> None:
    loud = samples() + 0.03 * np.random.default_rng(1).standard_normal((int(RATE_HZ * SECONDS), 3))
    found = look.look([table(tmp_path / "d.csv", loud)])
    assert any("no lowpass is seen" in doubt and "folded into the band" in doubt for doubt in found.doubts)
    assert not any("no lowpass is seen" in note for note in found.notes)


def test_what_is_wrong_with_a_channel_is_told(tmp_path: Path) -> None:
    sound, t = samples(), np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ
    assert "g RMS: is the unit right?" in doubts(tmp_path, sound / sound.std() * 100.0)
    reversed_ = sound * [1.0, -1.0, 1.0]
    assert "a2: moves against all others" in doubts(tmp_path, reversed_)
    assert "a1 and a2: may be swapped" in doubts(tmp_path, sound[:, [1, 0, 2]])
    assert "a1: clipped" in doubts(tmp_path, np.clip(sound, [-0.02, -1.0, -1.0], [0.02, 1.0, 1.0]))
    hum = sound.copy()
    hum[:, 2] += 0.008 * np.sin(2.0 * np.pi * 60.02 * t)  # seen at 10.02 Hz
    assert "the mains" in doubts(tmp_path, hum)
    gravity = sound / 9.80665
    gravity[:, 0] += 1.0
    assert "if that is gravity, the unit is g" in doubts(tmp_path, gravity)
    copied = sound.copy()
    copied[:, 2] = copied[:, 1]
    assert "a2 and a3: alike to the noise" in doubts(tmp_path, copied)


def test_a_machine_is_told_from_a_mode(tmp_path: Path) -> None:
    t = np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ
    turning = samples() + 0.01 * np.sin(2.0 * np.pi * 12.3 * t)[:, None] * [1.0, 0.6, -0.3]
    found = look.look([table(tmp_path / "m.csv", turning)])
    assert [mode.frequency_hz for mode in found.modes if not mode.remark] == pytest.approx(
        MODES.frequencies_hz, rel=0.01
    )
    assert "sinusoids at 12.3" in "".join(found.doubts)


def test_the_files_hold_what_was_found(found: LookedRecording, tmp_path: Path) -> None:
    look.write_results(found, tmp_path)
    content = json.loads((tmp_path / "look.json").read_text(), parse_constant=pytest.fail)
    assert content == json.loads(json.dumps(found.content()))
    assert [mode["frequency_hz"] for mode in content["modes"]] == [mode.frequency_hz for mode in found.modes]
    rows = list(csv.DictReader((tmp_path / "modes.csv").read_text().splitlines()))
    assert [float(row["frequency_hz"]) for row in rows] == pytest.approx([mode.frequency_hz for mode in found.modes])
    page = Page((tmp_path / "look.html").read_text())
    assert marks(page.chart("singular values"), "line", "chosen")
    assert sum(bool(marks(chart, "grid")) for chart in page.charts.values()) == 3, "spectrograms"
    assert [row[1] for row in page.table("frequency, Hz")] == [row[1] for row in mode_rows(found)]


def test_the_proposed_frame_has_the_true_stiffness_and_is_a_structure_file(
    found: LookedRecording, tmp_path: Path
) -> None:
    path = tmp_path / "frame.toml"
    look.write_structure(found, path, mass_kg=3.0)
    settings = configuration.load(path)
    assert settings.channels == ("a1", "a2", "a3")
    frame = tomllib.loads(path.read_text())["structure"]
    assert frame["kind"] == "shear_frame"
    assert frame["stiffness_n_per_m"] == pytest.approx(FRAME.stiffness_n_per_m, rel=0.05)
    assert settings.model().modes().frequencies_hz == pytest.approx(MODES.frequencies_hz, rel=0.01)


def test_shapes_of_no_frame_become_matrices_with_the_same_frequencies(tmp_path: Path) -> None:
    mixed = samples() @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]) * [1.0, 1.0, -1.0]
    found = look.look([table(tmp_path / "x.csv", mixed)])
    look.write_structure(found, tmp_path / "x.toml", mass_kg=None)
    assert tomllib.loads((tmp_path / "x.toml").read_text())["structure"]["kind"] == "matrices"
    modes = configuration.load(tmp_path / "x.toml").model().modes()
    assert modes.frequencies_hz == pytest.approx([mode.frequency_hz for mode in found.modes], rel=1e-4)


def test_matrices_of_fewer_sensors_than_floors_have_the_measured_shapes_whatever_a_stiffness(tmp_path: Path) -> None:
    """The shapes at two of three floors are not orthogonal: a stiffness must not turn them, or the updating has no solution."""
    found = look.look([table(tmp_path / "x.csv", samples()[:, 1:])])
    look.write_structure(found, tmp_path / "x.toml", mass_kg=2.0)
    config = configuration.load(tmp_path / "x.toml")
    assert config.structure.kind == "matrices"
    assert np.array(config.structure.mass_matrix).sum() == pytest.approx(2.0)
    assert "3 modes for 2 sensors" in (tmp_path / "x.toml").read_text()
    drawn = config.model()
    softer = drawn.with_stiffness(drawn.structure.stiffness_n_per_m * [0.81, 1.0, 1.0])
    for model, factors in ((drawn, [1.0, 1.0, 1.0]), (softer, [0.9, 1.0, 1.0])):
        modes = model.modes()
        measured = [mode.frequency_hz * k for mode, k in zip(found.modes, factors, strict=True)]
        assert modes.frequencies_hz == pytest.approx(measured, rel=1e-6)
        for shape, mode in zip(modes.shapes.T, found.modes, strict=True):
            assert shape[1] / shape[0] == pytest.approx(mode.shape[1].real / mode.shape[0].real, rel=1e-6)


def test_two_directions_are_one_building_or_one_direction_and_never_a_mixture(tmp_path: Path) -> None:
    """Channels of two frames that share their floors, and some along z."""
    stiffer = ShearFrame(FRAME.masses_kg, 1.7 * FRAME.stiffness_n_per_m, 0.01)
    other = simulate(Model(stiffer), duration_s=600.0, rate_hz=100.0, noise=0.05, seed=8).floors
    upright = 0.1 * np.random.default_rng(4).standard_normal(other.shape) * other.std()
    values = np.hstack(
        [simulate(Model(FRAME), duration_s=600.0, rate_hz=100.0, noise=0.05, seed=7).floors, other, upright]
    )
    names = [f"f{3 - j}{axis}" for axis in "xyz" for j in range(3)]
    both = tmp_path / "both.csv"
    np.savetxt(both, values, delimiter=",", header=",".join(names), comments="")
    found = look.look([both], Options(rate_hz=100.0, unit="m/s^2"))
    look.write_structure(found, tmp_path / "both.toml", mass_kg=float(FRAME.masses_kg.sum()))
    config = configuration.load(tmp_path / "both.toml")
    assert config.structure.kind == "building" and len(config.witnesses) == 3
    assert {s.channel: s.floor for s in config.sensors} == {name: int(name[1]) for name in names}
    wanted = np.concatenate([FRAME.stiffness_n_per_m[::-1], 1.7 * FRAME.stiffness_n_per_m[::-1]])
    np.testing.assert_allclose(config.drawn.stiffness_n_per_m[:6], wanted, rtol=0.1)
    fewer = replace(found, modes=tuple(m for m in found.modes if np.abs(m.shape[3:6]).max() < 0.5))
    look.write_structure(fewer, tmp_path / "one.toml", mass_kg=None)
    alone = configuration.load(tmp_path / "one.toml")
    assert alone.channels == ("f3x", "f2x", "f1x") and min(alone.drawn.masses_kg) > 0.0
    assert "Along x alone" in (tmp_path / "one.toml").read_text()


def test_a_mode_without_second_opinion_and_certain_damping_is_no_part_of_a_structure(
    found: LookedRecording, tmp_path: Path
) -> None:
    first = found.modes[0]
    doubtful = replace(first, frequency_hz=0.7, damping_std=first.damping_ratio, second=Skipped("no bell"))
    look.write_structure(replace(found, modes=(doubtful, *found.modes)), tmp_path / "f.toml", mass_kg=None)
    text = (tmp_path / "f.toml").read_text()
    assert "Left out: 0.7 Hz" in text
    assert tomllib.loads(text)["structure"]["kind"] == "shear_frame"


def low_and_high(seconds: float, rate_hz: float) -> np.ndarray:
    """One channel of seven low modes beneath strong ones of plates and cables far above."""
    rng, hz = np.random.default_rng(5), np.array([*LOW_HZ, 310.0, 444.0, 590.0, 835.0])
    forces = rng.standard_normal((round(seconds * rate_hz), hz.size)) * np.where(hz < 100.0, 1.0, 0.3)
    poles = np.exp(2.0 * np.pi / rate_hz * hz * (-0.01 + 1j))
    moved = [
        lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * p.real, abs(p) ** 2], f) for p, f in zip(poles, forces.T, strict=True)
    ]
    return np.asarray(np.sum(moved, axis=0)[:, None] + 0.01 * rng.standard_normal((len(forces), 1)))


LOW_HZ = (12.2, 17.3, 26.0, 36.5, 44.0, 61.0, 76.5)


def test_low_modes_of_a_fast_recording_are_found_or_named_as_peaks(tmp_path: Path) -> None:
    t = np.arange(round(21.0 * 2400.0)) / 2400.0
    columns = np.column_stack([t, low_and_high(21.0, 2400.0)])
    np.savetxt(tmp_path / "fast.csv", columns, delimiter=",", header="t,a1", comments="", fmt="%.9g")
    found = look.look([tmp_path / "fast.csv"], Options(unit="m/s^2"))
    named = np.array([*(mode.frequency_hz for mode in found.modes), *found.peaks_hz])
    assert [hz for hz in LOW_HZ if np.abs(named / hz - 1.0).min() > 0.03] == []
    modes_hz = np.array([mode.frequency_hz for mode in found.modes])
    assert sum(np.abs(modes_hz / hz - 1.0).min() < 0.03 for hz in LOW_HZ) >= 5
    for hz in found.peaks_hz:
        assert np.abs(modes_hz / hz - 1.0).min() > 0.01


def test_a_record_too_short_for_modes_is_refused_with_the_peaks_of_its_spectra(tmp_path: Path) -> None:
    t = np.arange(round(12.0 * 2400.0)) / 2400.0
    columns = np.column_stack([t, low_and_high(12.0, 2400.0)])
    np.savetxt(tmp_path / "brief.csv", columns, delimiter=",", header="t,a1", comments="", fmt="%.9g")
    with pytest.raises(BadInputError, match=r"12 s, too short to state modes.*its spectra have peaks at 12\.\d, 17"):
        look.look([tmp_path / "brief.csv"], Options(unit="m/s^2"))


def test_a_doubtful_mode_stands_below_a_line_without_a_number(found: LookedRecording, tmp_path: Path) -> None:
    first, second, third = found.modes
    unsure = replace(first, damping_std=0.3 * first.damping_ratio)
    doubtful = replace(found, modes=(unsure, second, replace(third, second=Skipped("no bell"))), peaks_hz=(1.25,))
    assert [number for number, _ in doubtful.numbered()] == [None, 1, None]
    lines = look.in_words(doubtful).splitlines()
    assert lines[1].startswith("1 ")
    assert lines[2].startswith("-- doubtful")
    assert "not told within a factor of 3" in lines[3]
    assert "no second opinion" in lines[4]
    assert lines[5] == "peaks of the spectra that no mode explains: 1.25 Hz"
    look.write_results(doubtful, tmp_path)
    content = json.loads((tmp_path / "look.json").read_text())
    assert [mode["mode"] for mode in content["modes"]] == [None, 1, None]
    assert content["peaks_hz"] == [1.25]
    page = Page((tmp_path / "look.html").read_text())
    assert "1 mode in" in page.head
    assert [row[0] for row in page.table("second opinion, Hz")] == ["1"]
    assert "Peaks of the spectra that no mode explains: 1.25 Hz" in page.words


def test_opinions_that_differ_widen_the_interval_over_both(found: LookedRecording) -> None:
    mode = found.modes[0]
    assert not isinstance(mode.second, Skipped)
    apart = replace(mode.second, frequency_hz=1.02 * mode.frequency_hz)
    wider = look.compared(replace(mode, second=apart), 3.0)
    assert wider.differs == "frequency"
    assert abs(apart.frequency_hz - wider.frequency_hz) < 2.0 * wider.frequency_std_hz
    assert wider.damping_std == mode.damping_std
    same = look.compared(mode, 3.0)
    assert (same.differs, same.frequency_std_hz) == ("", mode.frequency_std_hz)


def test_signs_are_doubted_only_where_all_modes_are_those_of_a_frame(found: LookedRecording, tmp_path: Path) -> None:
    """A node of a mode, or a structure that is no frame, looks like a wrong sensor in the lowest mode alone."""
    other = samples() @ np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.6], [0.0, 0.6, 1.0]])
    assert "reversed" not in doubts(tmp_path, other)
    assert "swapped" not in doubts(tmp_path, other)


def test_what_cannot_be_looked_at_is_refused_with_the_mend(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="absent"):
        look.look([tmp_path / "absent.csv"])
    with pytest.raises(BadInputError, match="too few to look at"):
        look.look([table(tmp_path / "short.csv", samples()[:300])])
    (tmp_path / "bare.csv").write_text("a1,a2\n" + "0.1,0.2\n" * 3000)
    with pytest.raises(BadInputError, match="--rate"):
        look.look([tmp_path / "bare.csv"])


def test_a_record_of_less_than_20_s_is_refused_and_a_longer_one_states_no_interval_of_zero(tmp_path: Path) -> None:
    whole = samples()
    with pytest.raises(BadInputError, match=r"is 19 s, too short to state modes; record at least 20 s"):
        look.look([table(tmp_path / "short.csv", whole[: round(19 * RATE_HZ)])])
    text = look.in_words(look.look([table(tmp_path / "long.csv", whole[: round(21 * RATE_HZ)])]))
    assert not re.search(r"± 0\.?0*(\s|$)", text)


def test_a_unit_taken_for_granted_is_doubted_with_what_the_level_would_be(tmp_path: Path) -> None:
    offset = np.array([0.0, 0.0, 1.0])
    said = doubts(tmp_path, samples(level=0.02) + offset)
    assert "no unit is stated of d.csv:a1, d.csv:a2, d.csv:a3; taken as m/s^2" in said
    assert "if they are g, 0." in said
    assert "the mean of a3 is 1, which is gravity in g" in said
    for unit, gravity in (("mg", 1000.0), ("m/s^2", 9.81)):
        assert f"which is gravity in {unit}" in doubts(tmp_path, samples(level=0.02 * gravity) + gravity * offset)
    assert "no unit" not in doubts(tmp_path, samples(level=0.02), " [g]")
    assert "no unit" not in doubts(tmp_path, samples(level=0.02), "_g")


def test_equal_structures_do_not_differ_and_a_softer_story_does(tmp_path: Path) -> None:
    a = table(tmp_path / "a.csv", samples(1))
    same = compare.compare(a, table(tmp_path / "b.csv", samples(2)))
    softer = compare.compare(a, table(tmp_path / "c.csv", samples(3, softer=0.1)))
    assert [test["what"] for test in same["tests"] if test["significant"]] == []
    moved = {test["what"] for test in softer["tests"] if test["significant"]}
    assert {"mode 1: frequency", "mode 3: frequency"} <= moved
    (first,) = (test for test in softer["tests"] if test["what"] == "mode 1: frequency")
    assert first["a"] == pytest.approx(MODES.frequencies_hz[0], rel=0.01)
    assert (first["change"], first["z"]) == (first["b"] - first["a"], first["change"] / first["change_std"])
    text = compare.in_words(softer)
    assert "beyond chance" in text


def test_a_mode_below_the_band_does_not_move_the_lowest_one_in_it() -> None:
    """At 128 Hz the band begins at 2.56 Hz, and the first mode lies at 2.25 Hz."""
    frame = ShearFrame(np.array([900.0, 1000.0, 1000.0, 1100.0]), np.array([1.2e6, 1.5e6, 1.5e6, 1.8e6]), 0.012)
    true_hz = Model(frame).modes().frequencies_hz[1]
    z = []
    for seed in range(6):
        motion = simulate(Model(frame), duration_s=400.0, rate_hz=128.0, noise=0.01, seed=seed)
        band = identify_band(motion.floors[:, [0, 1, 3]], 128.0, 128.0, 2.56)
        assert band is not None and isinstance(band.modes, ModalEstimate)
        modes = band.modes
        k = int(np.abs(modes.frequencies_hz - true_hz).argmin())
        z.append((modes.damping_ratio[k] - 0.012) / modes.damping_std[k])
    assert abs(np.mean(z)) < 1.5, z  # -1.9 with the mode of 2.25 Hz left out
