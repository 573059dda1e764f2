"""The faults that are put into measured recordings, their judge, and the model identified from a download."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

from monitor.config import Configuration, configuration
from monitor.model import Model, ShearFrame
from tests.measured import f16, sensor_faults, shake_table_axes, shake_table_event, shake_table_laws
from tests.measured.sensor_faults import Fault, cause_text, delayed, fast_clock, faults, outcome, unchanged

RATE_HZ = 120.0
T_S = np.arange(1200) / RATE_HZ


def tone(t: np.ndarray) -> np.ndarray:
    """Two tones that a lag or a clock moves exactly."""
    return np.asarray(np.sin(2.0 * np.pi * 3.3 * t) + 0.5 * np.cos(2.0 * np.pi * 11.7 * t))


@pytest.mark.parametrize(
    ("moved", "read_at"),
    [
        (delayed(np.tile(tone(T_S)[:, None], 3), RATE_HZ, channel=1, seconds=2e-3), T_S - 2e-3),
        (fast_clock(np.tile(tone(T_S)[:, None], 3), RATE_HZ, channel=1, relative=1e-3), T_S / 1.001),
    ],
)
def test_a_lag_and_a_fast_clock_read_the_motion_of_other_times(moved: np.ndarray, read_at: np.ndarray) -> None:
    inside = slice(60, -60)
    np.testing.assert_allclose(moved[inside, 1], tone(read_at)[inside], atol=5e-3)
    np.testing.assert_array_equal(moved[:, [0, 2]], np.tile(tone(T_S)[:, None], 2))


def test_every_fault_changes_its_channels_and_no_other() -> None:
    healthy = np.random.default_rng(1).standard_t(3.0, (1200, 3)) * [1.0, 2.0, 3.0]  # with peaks, as an earthquake
    for fault in faults():
        changed = np.flatnonzero((fault.act(healthy, RATE_HZ) != healthy).any(axis=0))
        assert [sensor_faults.CHANNELS[j] for j in changed] == [c for c in fault.place[8:].split(",") if c]


def gain(value: float, std: float, place: str = "channel a2") -> dict[str, object]:
    return {"effect": "sensor_gain", "location": place, "parameters": {"gain": {"value": value, "std": std}}}


def test_an_answer_is_right_by_effect_place_and_size() -> None:
    fault = Fault("gain", "gain 1.05", "channel a2", unchanged, "sensor_gain", lambda _: 1.05)
    assert outcome(fault, 1.05, "named", [gain(1.053, 0.0001)]) == "right"
    assert outcome(fault, 1.05, "named", [gain(1.08, 0.02)]) == "right"
    assert outcome(fault, 1.05, "named", [gain(1.06, 0.001)]) == "size"
    assert outcome(fault, 1.05, "unexplained", [gain(1.05, 0.001), gain(1.1, 0.1, "channel a1")]) == "right, and more"
    assert outcome(fault, 1.05, "named", [gain(1.05, 0.001, "channel a1")]) == "wrong"
    assert outcome(fault, 1.05, "none", []) == "missed"
    clean = Fault("clean", "no fault", "", unchanged)
    assert [outcome(clean, None, verdict, []) for verdict in ("none", "unexplained")] == ["none", "false"]
    clock = Fault("clock", "clock 0.1 % fast", "channel a2", unchanged)
    assert outcome(clock, None, "unexplained", [], ["clock of channel a2"]) == "right"
    assert outcome(clock, None, "unexplained", [gain(1.05, 0.001)], ["clock of channel a1"]) == "wrong"
    assert cause_text(gain(1.05, 0.001)) == "sensor_gain channel a2 1.05 ± 0.001"


def test_the_model_of_the_wing_has_the_modes_of_its_frequency_responses() -> None:
    hz = np.arange(f16.BAND_HZ[0], f16.BAND_HZ[1], 400.0 / f16.PERIOD_N)
    frequencies = np.array(f16.FIRST_GUESS_HZ) * [0.97, 1.01, 0.99, 1.02, 1.0, 0.99, 1.1]
    shapes = np.array([[0.1, 0.02, 0.02, 0.01, 0.04, 0.02, 0.06], [0.01, 0.04, 0.03, 0.02, 0.08, 0.07, -0.05]])
    shapes = np.vstack([shapes, shapes[1] * [0.8, 0.9, 0.85, 1.1, 0.95, 0.8, 0.2]])
    r = hz[:, None] / frequencies
    response = ((-(r**2) / (1.0 - r**2 + 0.02j * r)) * shapes[0]) @ shapes.T
    found, damping, modes = f16.identify_modes(hz, response)
    np.testing.assert_allclose(found[1:-1], frequencies[1:-1], rtol=1e-3)
    np.testing.assert_allclose(damping[1:-1], 0.01, rtol=0.05)
    content = f16.structure_file(found, damping, modes)
    structure = Configuration.model_validate(content).model().structure
    values, vectors = eigh(structure.stiffness_matrix(), structure.mass_matrix())
    np.testing.assert_allclose(np.sqrt(values) / (2.0 * np.pi), found, rtol=1e-6)
    sign = np.sign(vectors[1] * modes[1])
    np.testing.assert_allclose(vectors[:3] * sign, modes, atol=1e-6)


def test_a_wall_that_shortens_by_its_drift_squared_is_recognized() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(7200) / shake_table_axes.RATE_HZ
    drift = 0.01 * np.interp(t, t[::600], rng.standard_normal(12)) * np.cos(2.0 * np.pi * 3.69 * t)
    shortened = shake_table_axes.integrated(drift**2, -2) / shake_table_axes.HEIGHT_M
    up = shake_table_axes.in_band(-0.6 * shortened + 1e-3 * rng.standard_normal(t.size), 7.38, 0.5)
    by = shake_table_axes.in_band(shortened, 7.38, 0.5)
    k, std = shake_table_axes.factor(up, by)
    assert k == pytest.approx(-0.6, abs=4.0 * std) and std < 0.01
    assert shake_table_axes.unexplained(up, [by]) < 0.01
    other = shake_table_axes.in_band(rng.standard_normal(t.size), 7.38, 0.5)
    assert shake_table_axes.unexplained(up, [other]) > 0.9


def test_walls_whose_ends_turn_shorten_less() -> None:
    frame = ShearFrame(np.ones(1), np.full(1, 1000.0), 0.01, np.full(1, 2.0))
    assert shake_table_axes.shortening(Model(frame)) == pytest.approx([0.6])
    # A free end: the wall bends as a cantilever by 3/2 s^2 - s^3/2, of which half the integral of the slope squared is 0.6 too;
    # in between it is less.
    ends = [shake_table_axes.shortening(Model(replace(frame, column_to_girder=c)))[0] for c in (1.0, 1e9)]
    assert ends[0] < 0.6 - 0.02
    slope = 3.0 * np.linspace(0.0, 1.0, 10001) - 1.5 * np.linspace(0.0, 1.0, 10001) ** 2
    assert ends[1] == pytest.approx(0.5 * np.trapezoid(slope**2, dx=1e-4), rel=1e-4)


def test_all_axes_of_a_frame_become_sensors_of_its_structure_file(tmp_path: Path) -> None:
    path = tmp_path / "frame.toml"
    path.write_text(shake_table_axes.site("stiff"))
    config = configuration.load(path)
    assert config.channels == ("a1", "a2", "a3") and len(config.witnesses) == 20
    assert {(s.quantity, s.axis) for s in config.witnesses if s.floor == 0} == {
        (quantity, axis) for _, quantity, axis in shake_table_axes.AXES.values()
    }


def test_the_event_without_common_clocks_is_put_together_by_the_motion() -> None:
    """Below the first mode the floors follow the table, and the higher a floor the more it moves at the first mode."""
    floors, table = shake_table_event.aligned(*shake_table_event.SET_RIGHT)
    slow = np.corrcoef([shake_table_laws.in_band(x, shake_table_event.SLOW_BAND_HZ) for x in (*floors.T, *table.T)])
    assert slow[3].min() > 0.98
    top, middle, lowest = (shake_table_laws.in_band(x, shake_table_event.FIRST_BAND_HZ).std() for x in floors.T)
    assert (middle / top, lowest / top) == pytest.approx((0.81, 0.43), abs=0.03)  # as in the other recording
    recorded, _ = shake_table_event.aligned(*shake_table_event.AS_RECORDED)
    np.testing.assert_allclose(recorded[:, [0, 2, 1]] * [-1.0, 1.0, 1.0], floors)


def test_slip_and_its_loss_are_read_from_forces_and_drifts(capsys: pytest.CaptureFixture[str]) -> None:
    t = np.arange(6000) / RATE_HZ
    drift = 0.01 * np.exp(-t / 20.0) * np.sin(2.0 * np.pi * 3.7 * t)
    force = 400.0 * drift + 40.0 * shake_table_laws.slip(drift, 1e-3)
    story = np.tile(drift, (3, 1)), np.tile(np.gradient(drift, t), (3, 1))
    shake_table_laws.by_drift(shake_table_laws.Series(np.tile(force, (3, 1)), *story), 1)
    rows = [line.split("|")[1:] for line in capsys.readouterr().out.splitlines()[1:]]
    stiffness, loss = (np.array([float(row[i].split("+-")[0]) for row in rows]) for i in (0, 1))
    assert (np.diff(stiffness) < 0.0).all() and 400.0 < stiffness[-1] < 410.0 and stiffness[0] > 425.0
    assert 0 < loss.argmax() < len(loss) - 1  # largest where the element begins to slip
