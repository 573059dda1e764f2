"""Level of motion and named covariates: measured, learned, kept in the baseline's file, and what lies beyond said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import SampleBlock
from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, BadInputError, WindowResult
from monitor.damage import Baseline, HealthyData, learn_baseline, load_baseline, save_baseline
from monitor.damage.common_change import UNMEASURED, CommonChange
from monitor.damage.covariate_law import Axis, learn, stories_prior
from monitor.damage.level import drift_m, drift_weights, drift_weights_of_some, level_db
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.publish import to_json, window_line
from tests.service.checkpoint import restored
from tests.support.frames import settings_of
from tests.support.samples import T0_NS, Cut

WIND = """
[[covariates]]
name = "wind"
topic = "/wind"
channel = "speed"
unit = "m/s"

[temperature]
patience_s = 0.0
"""
Learned = tuple[Baseline, Baseline]
"""As learned, and as read back from its file."""


@pytest.fixture(scope="module")
def site(frame_text: str) -> Configuration:
    return settings_of(frame_text + WIND)


def wind(speed: np.ndarray, unit: str = "m/s", channel: str = "speed") -> SampleBlock:
    samples = np.column_stack([speed, -speed]).astype(np.float32)
    return SampleBlock("/wind", T0_NS, 0, 1.0, (channel, "direction"), unit, samples)


def windows(pipeline: Pipeline, cut: Cut, scale: float, seconds: int, seed: int) -> list[WindowResult]:
    floors = simulate(pipeline.config.model(), duration_s=float(seconds), rate_hz=128.0, noise=0.03, seed=seed).floors
    pipeline.push(wind(5.0 + 3.0 * np.sin(np.arange(seconds) / 20.0)))
    return [r for b in cut(scale * floors, 128.0, [128]) for r in pipeline.push(b) if isinstance(r, WindowResult)]


@pytest.fixture(scope="module")
def healthy(site: Configuration, cut: Cut, tmp_path_factory: pytest.TempPathFactory) -> Learned:
    """Baseline of 200 s."""
    pipeline = Pipeline(site)
    good = [r for r in windows(pipeline, cut, 1.0, 200, 3) if r.modes is not None]
    learned, _ = learn_baseline(
        site.instrumented(),
        HealthyData(
            windows=[r.modes for r in good if r.modes is not None],
            rms_m_s2=np.array([r.rms_m_s2 for r in good]),
            span_ns=(T0_NS, T0_NS + 200 * 10**9),
            covariates=[r.covariates for r in good],
            units={"level": "dB", "wind": "m/s"},
        ),
        updating=site.updating,
        compensation=site.compensation,
        drift_weights=pipeline.level_weights,
    )
    path = tmp_path_factory.mktemp("baseline") / "b.json"
    save_baseline(learned, path)
    return learned, load_baseline(path, site.instrumented(), site.updating)


def test_the_level_is_the_drift_of_the_stories(site: Configuration) -> None:
    """Checked against the displacements: each mode shaken at its own frequency alone."""
    model, sensors = site.model(), site.instrumented().sensor_matrix
    weights, modes = drift_weights(model, sensors, 50.0), model.modes()
    for shape, eigenvalue in zip(modes.shapes.T, modes.eigenvalues, strict=True):
        acceleration = sensors @ (shape * 0.3)
        drift = model.structure.drift_matrix() @ (shape * 0.3) / eigenvalue
        level = drift_m(level_db(weights, np.outer(acceleration, acceleration)))
        assert level == pytest.approx(float(np.sqrt((drift**2).mean())), rel=1e-6)


def test_fewer_channels_measure_the_same_level(site: Configuration, cut: Cut) -> None:
    """In the half hour after the one learned from; without that, the structure file says it roughly."""
    model, sensors, cutoff_hz = site.model(), site.instrumented().sensor_matrix, 40.0
    whole = drift_weights(model, sensors, cutoff_hz)
    apart = site.model_copy(update={"processing": site.processing.model_copy(update={"hop_s": 20.0})})
    seen = [r.motion for r in windows(Pipeline(apart), cut, 1.0, 3600, 5) if r.motion is not None]
    half = len(seen) // 2
    before, after = np.mean(seen[:half], axis=0), np.mean(seen[half:], axis=0)
    level = level_db(whole, after)
    for channels in ((0, 1), (0, 2), (1, 2)):
        of_some = after[np.ix_(channels, channels)]
        learned = drift_weights_of_some(model, sensors, channels, cutoff_hz, whole, before)
        drawn = drift_weights_of_some(model, sensors, channels, cutoff_hz, whole, None)
        assert abs(level_db(learned, of_some) - level) < 0.3
        assert abs(level_db(drawn, of_some) - level) < 2.0
        assert abs(level_db(drift_weights(model, sensors[list(channels)], cutoff_hz), of_some) - level) > 3.0


def test_twice_the_motion_is_six_decibels(site: Configuration, cut: Cut) -> None:
    one, two = (windows(Pipeline(site), cut, scale, 40, 5) for scale in (1.0, 2.0))
    for a, b in zip(one, two, strict=True):
        assert b.covariates["level"][0] - a.covariates["level"][0] == pytest.approx(6.0206, abs=1e-3)


def test_a_named_covariate_is_the_mean_of_its_channel(site: Configuration, cut: Cut) -> None:
    result = windows(Pipeline(site), cut, 1.0, 60, 6)[-1]
    speed = 5.0 + 3.0 * np.sin(np.arange(40, 60) / 20.0)
    assert result.covariates["wind"][0] == pytest.approx(float(speed.mean()), rel=0.01)


@pytest.mark.parametrize(
    ("block", "words"),
    [
        (wind(np.ones(3), unit="km/h"), "unit 'km/h', expected 'm/s'"),
        (wind(np.ones(3), channel="gust"), "no channel 'speed'"),
    ],
)
def test_other_units_and_channels_are_refused(site: Configuration, block: SampleBlock, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        Pipeline(site).push(block)


@pytest.mark.parametrize(
    ("name", "topic", "words"),
    [("level", "/x", "without being named"), ("gust", "/acceleration", "carries m/s"), ("wind", "/w", "stands twice")],
)
def test_a_covariate_that_cannot_be_is_refused(
    frame_text: str, tmp_path: Path, name: str, topic: str, words: str
) -> None:
    path = tmp_path / "s.toml"
    path.write_text(frame_text + WIND + f'\n[[covariates]]\nname = "{name}"\ntopic = "{topic}"\nunit = "m/s"\n')
    with pytest.raises(BadConfigurationError, match=words):
        configuration.load(path)


def test_the_law_survives_the_baselines_file(healthy: Learned) -> None:
    learned, read = healthy
    assert [axis.name for axis in read.law.axes] == ["level", "wind"]
    for under in ({"level": np.array([-90.0])}, {"wind": np.full(14, 9.0)}, {}):
        a, b = learned.law.expected(under), read.law.expected(under)
        np.testing.assert_array_equal(a.covariance, b.covariance)
        np.testing.assert_array_equal(a.relative, b.relative)
    np.testing.assert_array_equal(learned.drift_weights, read.drift_weights)


def test_a_storm_beyond_calibration_is_uncertain_and_said(site: Configuration, healthy: Learned, cut: Cut) -> None:
    same, twice, eight, most = (windows(Pipeline(site, healthy[1]), cut, s, 60, 9) for s in (1.0, 2.0, 8.0, 80.0))
    calm, storm, gale = (np.mean([r.damage.ddi_std for r in x if r.damage], axis=0) for x in (same, twice, eight))
    assert (storm > calm).all() and (gale > 2.0 * calm).all()
    for r in eight:
        assert r.damage.beyond.startswith("stronger than anything at calibration: level")
        assert not r.alarm.active
    assert not any(r.damage.beyond for r in same if r.damage)
    assert all(r.damage is None and r.skipped is not None for r in most)
    assert {r.skipped.reason[:42] for r in most if r.skipped} == {"stronger than anything at calibration: lev"}


def law_of(level: np.ndarray, degc: np.ndarray, slope: np.ndarray, seed: int):
    """Law of three stories that follow level and temperature, from windows without overlap."""
    rng = np.random.default_rng(seed)
    noise = np.diag([1e-6, 2e-6, 2e-6])
    x = np.outer(degc - degc.mean(), slope) + rng.multivariate_normal(np.zeros(3), noise, level.size)
    axes = (
        Axis("level", "dB", np.arange(-108.0, -90.0, 3.0), np.full(8, 2.5e-3)),
        Axis("temperature", "degC", np.arange(-20.0, 40.0, 5.0), np.full(14, 3e-3)),
    )
    return learn(x, noise, stories_prior(3, 0.5), axes, [level[:, None], degc[:, None]], 1.0)


def test_level_and_temperature_that_ran_together_are_said_to_be_confounded() -> None:
    rng, degc = np.random.default_rng(1), np.linspace(0.0, 20.0, 300)
    slope = np.full(3, 1e-3)
    together = law_of(-100.0 + 0.3 * (degc - 10.0), degc, slope, 1)
    apart = law_of(-100.0 + rng.uniform(-3, 3, 300), degc, slope, 1)
    assert [pair[:2] for pair in together.confounded()] == [("level", "temperature")]
    assert not apart.confounded()
    calm = {"level": np.array([-100.0]), "temperature": np.array([10.0])}
    for name, value in (
        ("level", -97.0),
        ("temperature", 20.0),
    ):  # along one covariate alone the first law is less certain
        moved = {**calm, name: np.array([value])}
        assert together.expected(moved).covariance[0, 0] > 4.0 * apart.expected(moved).covariance[0, 0]


def test_a_kink_in_frost_is_learned_within_its_error() -> None:
    degc = np.random.default_rng(2).uniform(-12.0, 25.0, 800)
    rng = np.random.default_rng(3)
    true = np.where(degc < 0.0, -0.008 * degc, -0.001 * degc)
    x = np.outer(true, [1.0, 0.5, 1.5]) + 1e-3 * rng.standard_normal((800, 3))
    axis = Axis("temperature", "degC", np.arange(-25.0, 45.0, 5.0), np.full(16, 5e-3))
    law = learn(x, 1e-6 * np.eye(3), stories_prior(3, 0.5), (axis,), [degc[:, None]], 1.0)
    for at, wanted in ((-10.0, 0.08), (20.0, -0.02)):
        effect = law.expected({"temperature": np.array([at])})
        error = np.log1p(effect.relative) - (wanted - true.mean()) * np.array([1.0, 0.5, 1.5])
        assert (np.abs(error) < 4.0 * np.sqrt(effect.covariance.diagonal()) + 2e-4).all()


def test_a_restart_goes_on_with_what_was_learned(site: Configuration, healthy: Learned, cut: Cut) -> None:
    """The state goes through a checkpoint half way; the law itself is in it."""
    whole, first = Pipeline(site, healthy[1]), Pipeline(site, healthy[1])
    floors = simulate(site.model(), duration_s=80.0, rate_hz=128.0, noise=0.03, seed=12).floors
    blocks = [wind(np.full(80, 5.0)), *cut(floors, 128.0, [128])]
    lines = [r for b in blocks for r in whole.push(b) if isinstance(r, WindowResult)]
    for b in blocks[:40]:
        first.push(b)
    assert first.state.learning is not None
    second = Pipeline(site, healthy[1])
    second.state = restored(first.state)
    rest = [r for b in blocks[40:] for r in second.push(b) if isinstance(r, WindowResult)]
    assert [to_json(window_line(r)) for r in rest] == [to_json(window_line(r)) for r in lines[-len(rest) :]]
    np.testing.assert_array_equal(
        second.state.learning.law.slopes, healthy[1].law.slopes
    )  # nothing has waited for two days yet


def test_what_the_stories_do_together_is_taken_out_of_the_index_live_as_in_replay(
    site: Configuration, healthy: Learned, cut: Cut
) -> None:
    """Simulated samples of a frame that is 2 % softer by the weather in the learned pattern, with 5 % of story 2 lost besides."""
    law = healthy[1].law
    follows = np.array([1.0, 1.5, 0.8])
    white = np.linalg.solve(law.mixing, 0.01 * follows)  # by 1 % in a usual day
    square = 1440.0 * (np.eye(3) + np.outer(white, white))
    learned = CommonChange(square, 1440, np.full((2, 5, 3), -0.05))
    knows = replace(healthy[1], law=replace(law, common=learned))
    model = site.model()
    soft = model.with_stiffness(model.structure.stiffness_n_per_m * (1.0 - 0.02 * follows) * np.array([1.0, 0.95, 1.0]))
    floors = simulate(soft, duration_s=120.0, rate_hz=128.0, noise=0.03, seed=21).floors
    speed = wind(5.0 + 3.0 * np.sin(np.arange(120) / 20.0))

    def run(baseline: Baseline, lengths: list[int], restart: int | None = None) -> list[WindowResult]:
        pipeline, results = Pipeline(site, baseline), []
        for k, block in enumerate([speed, *cut(floors, 128.0, lengths)]):
            if k == restart:
                state, pipeline = restored(pipeline.state), Pipeline(site, baseline)
                pipeline.state = state
            results += [r for r in pipeline.push(block) if isinstance(r, WindowResult)]
        return results

    whole, blind = run(knows, [128]), run(healthy[1], [128])
    assert [to_json(window_line(r)) for r in run(knows, [100], 60)] == [to_json(window_line(r)) for r in whole]
    last, raw = whole[-1].damage, blind[-1].damage
    assert UNMEASURED in last.covariate_effect and UNMEASURED not in raw.covariate_effect
    np.testing.assert_allclose(last.ddi - last.covariate_effect[UNMEASURED], raw.ddi, atol=1e-12)
    assert np.abs(last.ddi[1] - 0.05) < 3.0 * last.ddi_std[1] < 0.15
    assert last.ddi[1] == max(last.ddi)
