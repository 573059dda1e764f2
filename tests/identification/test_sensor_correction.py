"""Sensor faults that the structure file states are taken out of the modes, online as anywhere."""

from pathlib import Path

import numpy as np

from drivers.mcap_file import read_recordings
from monitor.config import configuration
from monitor.core import WindowResult
from monitor.damage import load_baseline, save_baseline
from monitor.identification import SubArray
from monitor.identification.sensor_correction import correct_modes, seen_by_sensors
from monitor.model import Context, ShearFrame, parse_effect
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, synthetic_recording
from tests.support.frames import shear_frame_text
from tests.support.results import modal_estimate
from tests.support.samples import T0_NS

CONTEXT = Context(ShearFrame(np.ones(3), 1000.0 * np.ones(3), 0.01), ("a1", "a2", "a3"), np.eye(3), 100.0)
FAULTS = tuple(
    parse_effect(text)
    for text in (
        "sensor_gain:channel a2:gain=1.1",
        "time_offset:channel a1:seconds=0.002",
        "channel_swap:channel a1,a3",
        "sensor_polarity:channel a3",
        "clock_rate:frame:relative=0.01",
    )
)


def _seen(shapes: np.ndarray, hz: np.ndarray) -> np.ndarray:
    """True shapes through the faults, written out once more."""
    out = shapes.astype(complex) * [1.0, 1.1, 1.0]
    out[:, 0] *= np.exp(-2j * np.pi * hz * 0.002)
    out = out[:, [2, 1, 0]] * [1.0, 1.0, -1.0]
    return out


def test_true_modes_come_back_with_their_deviations() -> None:
    rng = np.random.default_rng(3)
    hz, true = np.array([5.0, 16.0]), np.array([[1.0, 0.7, 0.3], [0.8, -0.4, 1.0]])
    seen = _seen(true, hz)
    scale = seen[np.arange(2), np.abs(seen).argmax(axis=1)][:, None]
    small = 1e-6 * rng.standard_normal((4, 2, 3))
    moved = [(_seen(true + d, hz) / _seen(true + d, hz)[[0, 1], np.abs(seen).argmax(axis=1)][:, None]) for d in small]
    change = np.array(moved) - seen / scale
    deviations = np.concatenate([np.zeros((4, 2, 2)), change.real, change.imag], axis=2)
    back = correct_modes(modal_estimate(hz / 1.01, seen / scale, deviations=deviations), FAULTS, CONTEXT)
    np.testing.assert_allclose(back.frequencies_hz, hz)
    np.testing.assert_allclose(back.shapes, true, atol=1e-12)
    expected = small - true * small[:, [0, 1], [0, 2]][:, :, None]  # the largest component stays 1
    np.testing.assert_allclose(back.deviations[:, :, 2:5], expected, atol=1e-11)


def test_measured_shapes_are_recognized_through_swap_and_sign() -> None:
    np.testing.assert_allclose(seen_by_sensors(FAULTS[2:4], CONTEXT), [[0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def test_an_accepted_sensor_fault_no_longer_moves_the_index(tmp_path: Path) -> None:
    text = shear_frame_text([0.3253, 0.3514, 0.3129], [2900.0, 1700.0, 1900.0])
    text += "[processing]\nwindow_s = 200.0\nhop_s = 50.0\n"
    plain, extended = tmp_path / "frame.toml", tmp_path / "extended.toml"
    plain.write_text(text)
    config = configuration.load(plain)
    healthy, faulty = tmp_path / "healthy.mcap", tmp_path / "faulty.mcap"
    common = {"excitation": "ambient", "noise": 0.05, "damage": [], "rate_hz": 200.0, "level_spread": 0.0}
    common |= {"t0_ns": T0_NS, "temperature": None}
    write = synthetic_recording.write_simulated_recording
    write(healthy, config, duration_s=600.0, effects=[], seed=1, **common)
    save_baseline(calibrate.calibrate([healthy], config)[0], tmp_path / "b.json")

    def index(path: Path) -> list[WindowResult]:
        settings = configuration.load(path)
        pipeline = Pipeline(settings, load_baseline(tmp_path / "b.json", settings.instrumented(), settings.updating))
        found = (r for block in read_recordings([faulty]) for r in pipeline.push(block))
        return [r for r in found if isinstance(r, WindowResult)]

    for fault in ("sensor_gain:channel a2:gain=1.2", "sensor_polarity:channel a1", "channel_swap:channel a2,a3"):
        effect = parse_effect(fault)
        rows = "".join(f"{k} = {v}\n" for k, v in effect.values().items())
        table = f'[[effects]]\neffect = "{effect.name}"\nlocation = "{effect.location}"\n[effects.parameters]\n{rows}'
        extended.write_text(text + table)
        write(faulty, config, duration_s=250.0, effects=[fault], seed=2, **common)
        corrected = index(extended)
        assert len(corrected) == 2, fault
        for result in corrected:
            assert result.skipped is None and result.damage is not None, fault
            assert np.abs(result.damage.ddi).max() < 0.02, fault
        assert any(r.damage is None or np.abs(r.damage.ddi).max() > 0.04 for r in index(plain)), fault


def test_the_modes_of_fewer_channels_are_corrected_like_those_of_all() -> None:
    """Without the third channel; the cables of a1 and a3 are swapped, so that it is a1's motion that is not known."""
    hz, true = np.array([5.0, 16.0]), np.array([[1.0, 0.7, 0.3], [0.8, -0.4, 1.0]])
    seen = _seen(true, hz)[:, :2]
    scale = seen[np.arange(2), np.abs(seen).argmax(axis=1)][:, None]
    deviations = np.random.default_rng(3).normal(size=(4, 2, 6))
    array = SubArray.of((0, 1), (0, 1, 2), np.eye(3), FAULTS, CONTEXT)
    assert array.places == (2, 1) and array.past == (0, 1)
    np.testing.assert_array_equal(array.sensors, np.eye(3)[[2, 1]])
    back = array.correct(modal_estimate(hz / 1.01, seen / scale, deviations=deviations))
    expected = true[:, [2, 1]] / true[[0, 1], [1, 2]][:, None]
    np.testing.assert_allclose(back.shapes, expected, atol=1e-12)
    spread = array.spread(back)
    assert np.isnan(spread.shapes[:, 0]).all()
    np.testing.assert_allclose(spread.shapes[:, [2, 1]], expected, atol=1e-12)
    np.testing.assert_array_equal(spread.deviations[:, :, [0, 1, 4, 3, 7, 6]], back.deviations)
    assert np.isnan(spread.deviations[:, :, [2, 5]]).all()
