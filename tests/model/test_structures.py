"""Structures of any size and kind, from their file to the damage index."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import mmwrite

from monitor.config import configuration
from monitor.core import BadConfigurationError, MissingInputError
from monitor.damage import load_baseline, save_baseline
from monitor.model.effects import parse_effect
from monitor.model.model import Model
from monitor.model.structures import ShearFrame
from tests.support.frames import configured, shear_frame
from tests.support.learned import learned, results_of
from tests.support.simulated import PAPER_FRAME

SHEAR = PAPER_FRAME


def matrices_table(structure: ShearFrame = SHEAR, **changes: object) -> dict:
    return {
        "kind": "matrices",
        "mass_matrix": structure.mass_matrix().tolist(),
        "stiffness_matrix": structure.stiffness_matrix().tolist(),
        "stiffness_derivatives": structure.stiffness_derivatives().tolist(),
        "stiffness_n_per_m": structure.stiffness_n_per_m.tolist(),
        **changes,
    }


def toml(table: dict, folder: Path, floors: tuple[int, ...] = (1, 2, 3), more: str = "") -> Path:
    path = folder / "structure.toml"
    lines = [f"{key} = {json.dumps(value)}" for key, value in table.items()]
    sensors = [f'[[sensors]]\nchannel = "a{i}"\nfloor = {i}' for i in floors]
    path.write_text("\n".join(["[structure]", *lines, *sensors, more]))
    return path


@pytest.mark.engine
def test_a_frame_given_by_its_matrices_gives_the_frame_s_results(main, frame_text: str, tmp_path: Path) -> None:
    more = "[processing]\nwindow_s = 20.0\nhop_s = 5.0\n[identification]\nblock_rows = 10\n"
    more += "[diagnosis]\nranked = 8\ntried = 3\nfavourites = 2\n"
    (tmp_path / "frame.toml").write_text(frame_text)
    toml(matrices_table(damping_ratio=0.01, story_names=["top", "middle", "foot"]), tmp_path, more=more)
    found = []
    for name in ("frame", "structure"):

        def run(*arguments: object, name: str = name) -> None:
            done = main(*arguments, "--structure", tmp_path / f"{name}.toml")
            assert done.returncode == 0, done.stderr

        run("simulate", "--out", tmp_path / f"{name}.mcap", "--duration", 120, "--rate", 128)
        run("simulate", "--out", tmp_path / f"{name}-worse.mcap", "--duration", 80, "--rate", 128, "--seed", 1,
            "--damage", "story2=0.1")  # fmt: skip
        run("calibrate", tmp_path / f"{name}.mcap", "--out", tmp_path / f"{name}.json")
        worse = (tmp_path / f"{name}-worse.mcap", "--baseline", tmp_path / f"{name}.json", "--out", tmp_path / name)
        run("replay", *worse)
        if name == "structure":  # a frame's diagnosis is others' claim
            run("diagnose", *worse)
            assert json.loads((tmp_path / name / "diagnosis.json").read_text())["cause"]["location"] == "story 2"
        assert main("check", tmp_path / f"{name}.toml").returncode == 0
        found.append([json.loads(line) for line in (tmp_path / name / "results.jsonl").read_text().splitlines()])
    assert len(found[0]) == 13
    for one, other in zip(*found, strict=True):
        for key in ("frequencies_hz", "ddi", "ddi_std", "ddi_sequential", "stiffness_n_per_m"):
            np.testing.assert_allclose(one[key], other[key], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("n", "floors", "story", "refined"),
    [(1, (1,), 1, True), (2, (1, 2), 2, True), (5, (1, 2, 3, 4, 5), 2, False), (10, (1, 3, 5, 8), 3, False)],
)
def test_a_shear_frame_of_any_height(n: int, floors: tuple[int, ...], story: int, refined: bool) -> None:
    stiffness, tables = [2000.0 * max(1, n / 3)] * n, {"processing": {"window_s": 200.0, "hop_s": 50.0}}
    settings = shear_frame([0.32] * n, stiffness, floors, refinement={"enabled": refined}, **tables)
    truth = settings.model()
    healthy = learned(settings, truth, seed=1, duration_s=600.0)
    worse = Model(truth.structure, (parse_effect(f"stiffness_change:story {story}:relative=-0.1"),))
    (reading,) = [r.damage for r in results_of(worse, settings, healthy, seed=2, duration_s=201.0)]
    loss = 0.1 * (np.arange(n) == story - 1)
    assert (np.abs(reading.ddi - loss) < 4.5 * reading.ddi_std + 0.003).all()
    assert reading.ddi_std[story - 1] < 0.02


def test_more_dofs_than_stiffnesses_and_sensors() -> None:
    """Six floors whose stories come in three groups; two sensors, modes above the cutoff left out."""
    frame = ShearFrame(np.full(6, 0.32), np.full(6, 6000.0), 0.01)
    groups = frame.stiffness_derivatives().reshape(3, 2, 6, 6).sum(axis=1)
    table = matrices_table(frame, stiffness_derivatives=groups.tolist(), stiffness_n_per_m=[6000.0] * 3)
    settings = configured(table, (1, 4), processing={"window_s": 200.0, "hop_s": 50.0, "cutoff_hz": 30.0})
    truth = settings.model()
    healthy = learned(settings, truth, seed=3, duration_s=600.0)
    assert healthy.model_mode == (0, 1, 2)
    worse = truth.with_stiffness(truth.structure.stiffness_n_per_m * [1.0, 0.9, 1.0])
    (reading,) = [r.damage for r in results_of(worse, settings, healthy, seed=4, duration_s=201.0)]
    np.testing.assert_allclose(reading.ddi, [0.0, 0.1, 0.0], atol=0.02)
    np.testing.assert_array_equal(reading.ddi_sequential, reading.ddi)


def test_a_baseline_of_matrices_survives_its_file(tmp_path: Path) -> None:
    slopes = SHEAR.stiffness_derivatives()[:2]
    table = matrices_table(stiffness_derivatives=slopes.tolist(), stiffness_n_per_m=[2909.4511, 1514.8507])
    settings = configured(table, (1, 2, 3), processing={"window_s": 50.0, "hop_s": 50.0})
    healthy = learned(settings, settings.model(), seed=5, duration_s=101.0)
    save_baseline(healthy, tmp_path / "b.json")
    again = load_baseline(tmp_path / "b.json", settings.instrumented(), settings.updating)
    np.testing.assert_array_equal(again.model.stiffness_matrix(), healthy.model.stiffness_matrix())
    np.testing.assert_array_equal(again.model.mass_matrix(), healthy.model.mass_matrix())


def test_matrices_may_stand_in_files(tmp_path: Path) -> None:
    table = matrices_table()
    np.savez(tmp_path / "all.npz", mass_matrix=SHEAR.mass_matrix())
    (tmp_path / "k.json").write_text(json.dumps({"stiffness_matrix": table["stiffness_matrix"]}))
    for j, slope in enumerate(SHEAR.stiffness_derivatives()):
        mmwrite(tmp_path / f"dk{j}.mtx", slope)
    names = {"mass_matrix": "all.npz", "stiffness_matrix": "k.json",
             "stiffness_derivatives": [f"dk{j}.mtx" for j in range(3)]}  # fmt: skip
    model = configuration.load(toml(table | names, tmp_path)).model()
    np.testing.assert_array_equal(model.stiffness_matrix(), SHEAR.stiffness_matrix())
    np.testing.assert_array_equal(model.stiffness_derivatives(), SHEAR.stiffness_derivatives())
    np.testing.assert_array_equal(model.mass_matrix(), SHEAR.mass_matrix())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass_matrix": [[1.0, 0.0], [0.0, 1.0, 0.0]]}, "mass_matrix has 2 rows of 2, 3 values"),
        ({"stiffness_matrix": [[1.0]]}, "stiffness_matrix has 1 rows of 1 values, not 3 of 3"),
        ({"stiffness_matrix": [[2.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]}, "not symmetric"),
        ({"mass_matrix": [[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]]}, "mass_matrix is not positive definite"),
        ({"stiffness_n_per_m": [1.0]}, "stiffness_derivatives has 3 values for 1 stiffnesses"),
        ({"stiffness_derivatives": [[[0.0] * 3] * 3] * 3}, "stiffness_derivatives.0 is zero"),
        ({"story_names": ["a"]}, "story_names has 1 values for 3 stiffnesses"),
        ({"masses_range_kg": [[0.1, 0.2]]}, "masses_range_kg has 1 values for 3 degrees of freedom"),
        ({"nonsense": 1}, "structure.nonsense"),
        ({"mass_matrix": "bad.npz"}, "bad.npz: unreadable"),
        ({"mass_matrix": "k.json"}, "k.json: holds no 'mass_matrix'"),
        ({"mass_matrix": "m.csv"}, "m.csv: matrices are read from"),
    ],
)
def test_wrong_matrices_are_told(changes: dict, message: str, tmp_path: Path) -> None:
    (tmp_path / "bad.npz").write_text("no archive")
    (tmp_path / "k.json").write_text("{}")
    with pytest.raises(BadConfigurationError, match=message.replace("[", r"\[")):
        configuration.load(toml(matrices_table(**changes), tmp_path))


def test_a_missing_matrix_file_is_a_missing_input(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"nowhere\.npz"):
        configuration.load(toml(matrices_table(mass_matrix="nowhere.npz"), tmp_path))


def test_ranges_are_priors_of_stiffnesses_then_masses() -> None:
    table = matrices_table(
        stiffness_derivatives=SHEAR.stiffness_derivatives()[:1].tolist(),
        stiffness_n_per_m=[2000.0],
        stiffness_range_n_per_m=[[1800.0, 2200.0]],
    )
    np.testing.assert_allclose(configured(table, (1,)).instrumented().prior_std, [0.05, 0.05, 0.05, 0.05])


def test_a_story_that_the_sensors_do_not_see_is_named_and_its_index_claims_nothing() -> None:
    """One sensor and two modes of eight stories: nearly all stays as uncertain as the drawing was."""
    processing = {"window_s": 200.0, "hop_s": 50.0, "cutoff_hz": 12.0}
    settings = shear_frame([0.32] * 8, [5000.0] * 8, (1,), processing=processing)
    truth = settings.model()
    healthy = learned(settings, truth, seed=6, duration_s=401.0)
    worse = Model(truth.structure, (parse_effect("stiffness_change:story 7:relative=-0.15"),))
    results = results_of(worse, settings, healthy, seed=7, duration_s=301.0)
    for r in results:
        assert 7 in r.damage.unidentified
        assert (r.damage.ddi_std[[j - 1 for j in r.damage.unidentified]] > 0.7 * 0.2).all()
        assert r.alarm.stories == ()


@pytest.mark.parametrize(
    ("tables", "floors", "warning"),
    [
        ("[updating]\nuse_shapes = false\n", (1, 2, 3), "the same frequencies also follow from stiffnesses"),
        ("[processing]\ncutoff_hz = 12.0\n", (1,), "the modes say next to nothing about story"),
        ("", (1, 2, 3), None),
    ],
)
def test_calibrate_tells_what_it_cannot_know(
    main, tables: str, floors: tuple[int, ...], warning: str | None, tmp_path: Path
) -> None:
    stiffness = [2250.0, 2250.0, 1811.0]
    table = {"kind": "shear_frame", "masses_kg": SHEAR.masses_kg.tolist(), "stiffness_n_per_m": stiffness}
    more = tables.removeprefix("[processing]\n")
    structure = toml(table, tmp_path, floors, "[processing]\nwindow_s = 50.0\nhop_s = 50.0\n" + more)
    assert main("simulate", "--structure", structure, "--out", tmp_path / "r.mcap", "--duration", 110, "--rate",
                128).returncode == 0  # fmt: skip
    done = main("calibrate", tmp_path / "r.mcap", "--structure", structure, "--out", tmp_path / "b.json")
    assert done.returncode == 0, done.stderr
    assert warning in done.stderr if warning else "warning" not in done.stderr
