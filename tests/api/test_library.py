"""The library: the pipeline's numbers from arrays, one clear message for wrong input, and names that stay."""

from __future__ import annotations

import ast
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shm_monitor as shm

import monitor.api
from drivers.base import GROUND
from monitor.config import configuration
from monitor.core import WindowResult
from monitor.pipeline import Pipeline
from tests.support.commands import ended
from tests.support.samples import FRAME, Cut, write_blocks

NAMES = {
    "Cause", "Condition", "Context", "Diagnosis", "Effect", "FittedSizes", "Modes", "Parameter", "Recording", "Structure",
    "Updated", "UserError", "add_effect", "diagnose", "identify", "read", "simulate", "structure", "update",
}  # fmt: skip
"""What the library has promised to keep: names are added, never taken away (docs/library.md)."""


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> shm.Structure:
    file = tmp_path_factory.mktemp("library") / "frame.toml"
    file.write_text(FRAME)
    return shm.structure(file)


@pytest.fixture(scope="module")
def record(frame: shm.Structure) -> shm.Recording:
    found = shm.simulate(frame, duration_s=20.0, rate_hz=200.0, noise=0.05, seed=3)
    return shm.Recording(found.samples.astype(np.float32).astype(float), 200.0, found.channels, 0)


@pytest.fixture(scope="module")
def modes(frame: shm.Structure, record: shm.Recording) -> shm.Modes:
    return shm.identify(record.samples, record.rate_hz, frame)


def test_modes_and_stiffness_are_the_pipelines_bit_for_bit(
    frame: shm.Structure, record: shm.Recording, modes: shm.Modes, cut: Cut
) -> None:
    pipeline = Pipeline(frame.config)
    results = [result for block in cut(record.samples, 200.0, (170,)) for result in pipeline.push(block)]
    (window,) = (result for result in results if isinstance(result, WindowResult))
    assert window.modes is not None
    for name in ("frequencies_hz", "damping_ratio", "shapes", "frequencies_std_hz", "damping_std"):
        assert np.array_equal(getattr(modes, name), getattr(window.modes, name)), name
    updated = shm.update(modes, frame)
    assert np.array_equal(updated.stiffness_n_per_m, window.stiffness.stiffness_n_per_m)
    assert np.array_equal(updated.covariance, window.stiffness.covariance)
    assert np.array_equal(updated.loss, window.damage.ddi)
    assert updated.converged
    assert not updated.since_baseline
    known = replace(updated, covariance=np.diag([100.0] * 3), loss_covariance=np.diag([0.05**2] * 3))
    assert all(line.count("± 20 N/m") == line.count("± 10.00 %") == 1 for line in str(known).splitlines())


def test_without_a_structure_the_same_modes_are_found(record: shm.Recording, modes: shm.Modes) -> None:
    free = shm.identify(record.samples, record.rate_hz)
    assert free.model_mode is None
    assert len(free) == 3
    std = np.hypot(free.frequencies_std_hz, modes.frequencies_std_hz)
    assert np.all(np.abs(free.frequencies_hz - modes.frequencies_hz) < 3.0 * std)
    assert free.covariance.shape == (3, 8, 3, 8)
    variance = np.einsum("ipip->ip", free.covariance)[:, 0]
    np.testing.assert_allclose(np.sqrt(variance) * free.frequencies_hz, free.frequencies_std_hz)
    with pytest.raises(shm.UserError, match="give the structure to identify"):
        shm.update(free, shm.structure(masses_kg=[1.0] * 3, stiffness_n_per_m=[2e3] * 3))


def test_no_more_modes_are_looked_for_than_asked(frame: shm.Structure, record: shm.Recording, modes: shm.Modes) -> None:
    assert len(modes.frequencies_hz) == 3
    two = shm.identify(record.samples, record.rate_hz, frame, max_modes=2)
    np.testing.assert_allclose(two.frequencies_hz, modes.frequencies_hz[:2], rtol=0.01)
    low = shm.identify(record.samples, record.rate_hz, frame, cutoff_hz=20.0)
    np.testing.assert_allclose(low.frequencies_hz, modes.frequencies_hz[:2], rtol=0.01)


def test_noise_has_no_modes_and_says_so(frame: shm.Structure) -> None:
    noise = np.random.default_rng(5).standard_normal((4000, 3))
    none = shm.identify(noise, 200.0, frame)
    assert len(none) == 0
    assert none.missing
    with pytest.raises(shm.UserError, match="no mode to update to"):
        shm.update(none, frame)


def test_no_mode_is_stated_of_less_than_ten_periods_or_with_a_structure_20_s_and_none_without_an_interval() -> None:
    slow = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[9e3, 9e3])  # 0.295 and 0.773 Hz
    samples = shm.simulate(slow, duration_s=60.0, rate_hz=20.0, noise=0.01, seed=0).samples
    found = shm.identify(samples[:400], 20.0, slow)
    assert found.model_mode == (2,)
    assert any("6.4 periods in 20 s, 10 are the least" in why for why in found.missing)
    for n in (200, 300, 399):
        with pytest.raises(shm.UserError, match="too short to state modes; 20 s are the least"):
            shm.identify(samples[:n], 20.0, slow)
        assert (shm.identify(samples[:n], 20.0).frequencies_hz > 10.0 * 20.0 / n).all()
    with pytest.raises(shm.UserError, match="too short to state modes; 3 s are the least"):
        shm.identify(samples[:59], 20.0)


@pytest.mark.parametrize("seconds", [5.0, 10.0, 15.0])
def test_modes_of_ten_periods_and_more_are_stated_of_seconds_with_intervals_that_hold_them(seconds: float) -> None:
    fast = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[4e6, 4e6])  # 6.2 and 16.3 Hz
    samples = shm.simulate(fast, duration_s=seconds, rate_hz=100.0, noise=0.01, seed=3).samples
    found = shm.identify(samples, 100.0)
    assert found.window_s == seconds
    assert len(found) == 2
    assert (np.abs(found.frequencies_hz - fast.frequencies_hz) < 2.5 * found.frequencies_std_hz).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda x: x[:, :2], "3 (a1, a2, a3)"),
        (lambda x: np.where(np.arange(len(x))[:, None] == 7, np.nan, x), "the first is row 7"),
        (lambda x: x[:900], "4.5 s are too short to state modes; 20 s"),
        (lambda x: x[None], "a column for each channel"),
    ],
)
def test_samples_that_cannot_be_used_are_refused_in_words(frame, record, change, says) -> None:
    with pytest.raises(shm.UserError, match=str(says).replace("(", r"\(").replace(")", r"\)")):
        shm.identify(change(record.samples), record.rate_hz, frame)


def test_a_structure_comes_from_a_file_a_mapping_or_numbers(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(FRAME)
    tables = configuration.read_toml(tmp_path / "s.toml")
    for one in (shm.structure(str(tmp_path / "s.toml")), shm.structure(tables)):
        assert one.channels == ("a1", "a2", "a3")
        assert one.floors == (1, 2, 3)
    two = shm.structure(masses_kg=np.array([2.0, 3.0]), stiffness_n_per_m=[1e3, 2e3], channels=["roof"], floors=[1])
    assert (two.channels, two.floors, two.masses_kg.tolist()) == (("roof",), (1,), [2.0, 3.0])
    assert two.shapes.shape == (2, 2)
    for wrong in ({}, {"file": tables, "masses_kg": [1.0], "stiffness_n_per_m": [1.0]}):
        with pytest.raises(shm.UserError, match="either a file, or"):
            shm.structure(**wrong)
    with pytest.raises(shm.UserError, match="masses_kg"):
        shm.structure(masses_kg=[-1.0], stiffness_n_per_m=[1e3])
    with pytest.raises(shm.UserError, match="one floor for each"):
        shm.structure(masses_kg=[1.0], stiffness_n_per_m=[1e3], channels=["a", "b"])
    with pytest.raises(shm.UserError, match="nowhere"):
        shm.structure("nowhere.toml")


def test_a_recording_is_laid_out_with_its_gaps(tmp_path: Path, cut: Cut) -> None:
    values = np.arange(600.0).reshape(200, 3)
    write_blocks(tmp_path / "r.mcap", cut(values[:100], 100.0, (50,)) + cut(values[150:], 100.0, (50,), first=150))
    found = shm.read(tmp_path / "r.mcap")
    assert (found.rate_hz, found.duration_s, found.channels) == (100.0, 2.0, ("a1", "a2", "a3"))
    assert np.isnan(found.samples[100:150]).all()
    np.testing.assert_array_equal(found.samples[:100], values[:100])
    np.testing.assert_array_equal(found.samples[150:], values[150:])
    ground = [replace(b, topic=GROUND, channels=("x", "y", "z")) for b in cut(-values, 100.0, (50,))]
    write_blocks(tmp_path / "g.mcap", [*cut(values, 100.0, (50,)), *ground])
    np.testing.assert_array_equal(shm.read(tmp_path / "g.mcap").ground, -values[:, 0])
    with pytest.raises(shm.UserError, match="No such file"):
        shm.read(tmp_path / "nothing.mcap")
    (tmp_path / "words.txt").write_text("neither numbers nor columns\n")
    with pytest.raises(shm.UserError, match=r"words\.txt"):
        shm.read(tmp_path / "words.txt")


def test_a_quantity_of_another_rate_is_left_out_with_a_word(tmp_path: Path, cut: Cut) -> None:
    values = np.arange(600.0).reshape(200, 3)
    of = {"topic": "/wind", "channels": ("u", "v", "w"), "unit": "m/s"}
    for rate_hz, beside in ((100.0, ["wind"]), (50.0, [])):
        wind = [replace(b, **of) for b in cut(values, rate_hz, (50,))]
        write_blocks(tmp_path / "w.mcap", [*cut(values, 100.0, (50,)), *wind])
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert list(shm.read(tmp_path / "w.mcap").covariates) == beside
        left = [str(one.message) for one in told if "/wind is left out: it has 50 Hz" in str(one.message)]
        assert len(left) == (not beside)


def test_a_simulation_knows_damage_ground_and_wrong_effects() -> None:
    frame = shm.structure(masses_kg=[1.0, 1.0], stiffness_n_per_m=[2e3, 2e3])
    plain = shm.simulate(frame, duration_s=2.0, rate_hz=100.0, excitation="ground", seed=1)
    assert plain.ground.shape == (200,)
    damaged = shm.simulate(frame, duration_s=2.0, rate_hz=100.0, excitation="ground", damage={2: 0.3}, seed=1)
    assert not np.allclose(plain.samples, damaged.samples)
    for wrong in ({"effects": ["nonsense:story 1"]}, {"damage": {7: 0.1}}):
        with pytest.raises(shm.UserError):
            shm.simulate(frame, duration_s=2.0, rate_hz=100.0, **wrong)


def test_results_are_drawn_on_request(frame: shm.Structure, record: shm.Recording, modes: shm.Modes) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    for result in (record, modes, shm.update(modes, frame)):
        axes = result.plot(Figure().subplots())
        assert axes.get_xlabel()


def test_the_names_stay() -> None:
    assert set(shm.__all__) == set(monitor.api.__all__) >= NAMES
    stub = ast.parse((Path(shm.__file__).parent / "__init__.pyi").read_text(encoding="utf-8"))
    typed = {a.name for node in stub.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert typed == {*shm.__all__, "__version__"} == set(dir(shm))
    assert (Path(shm.__file__).parent / "py.typed").exists()
    with pytest.raises(AttributeError, match="it has Cause"):
        _ = shm.nothing


def test_the_import_loads_no_library_for_computation() -> None:
    code = "import shm_monitor, sys; print(*{'numpy', 'scipy', 'pydantic', 'numba', 'matplotlib'} & set(sys.modules))"
    places = [str(Path(monitor.api.__file__).parents[2]), str(Path(shm.__file__).parents[1])]
    done = ended(sys.executable, "-c", f"import sys; sys.path[:0] = {places!r}; {code}")
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


@pytest.mark.docs
@pytest.mark.parametrize("page", ["README.md", "docs/library.md"])
def test_the_python_of_a_page_runs(
    page: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And prints the modes that the page shows, where it shows them."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    root = Path(monitor.api.__file__).parents[2]
    monkeypatch.chdir(root)
    text = (root / page).read_text(encoding="utf-8")
    known: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        exec(compile(block, page, "exec"), known)
    printed = capsys.readouterr().out
    assert printed.count("Hz") == 3
    for shown in re.findall(r"^```text\n(frequency.*?)^```", text, re.MULTILINE | re.DOTALL):
        assert shown == printed


def test_a_structure_of_modes_alone_is_refused_where_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "modal.toml").write_text('[structure]\nkind = "modal"\n[[sensors]]\nchannel = "a1"\n')
    with pytest.raises(shm.UserError, match=r'modal\.toml: \[structure\] kind = "modal" has no masses and stiffnesses'):
        shm.structure(tmp_path / "modal.toml")


def test_a_table_that_tells_no_time_is_read_without_a_warning_and_others_point_at_the_caller(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,top\n" + "".join(f"{k / 100:.2f},{k % 7}\n" for k in range(300)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert shm.read(tmp_path / "a.csv").start_ns == 0
        assert shm.read(tmp_path / "a.csv", start_ns=5).start_ns == 5
    (tmp_path / "b.csv").write_text("t,top\n" + "".join(f"{k / 100:.2f},{k % 7}\n" for k in range(300) if k != 100))
    with pytest.warns(UserWarning, match="missing") as told:
        shm.read(tmp_path / "b.csv")
    assert {one.filename for one in told} == {__file__}
