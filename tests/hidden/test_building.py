"""The simulator in three dimensions against mechanics: its modes, its motion, what its sensors see, where its forces are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.hidden import building_trials as trials, frame
from tests.hidden.artefacts import ARTEFACTS
from tests.hidden.building import TURN, Band, X, Y, forces, motion, point_answer, with_building, with_oscillator

RATE_HZ = 128.0
WHITE = trials.draw_tower(2, "white")


def _tower(*, eccentric: bool = True, lever_m: float = 0.0) -> trials.Tower:
    b = WHITE.building
    floors = tuple(range(1, b.masses.size + 1))
    centre = b.centre if eccentric else np.zeros_like(b.centre)
    levers = np.full(len(floors), lever_m)
    return replace(
        WHITE,
        building=replace(b, centre=centre, ratio=0.005, rayleigh=False),
        floors=floors,
        levers=levers,
        rate_hz=RATE_HZ,
    )


def _impulse_spectrum(tower: trials.Tower, level: np.ndarray, count: int = 1 << 15) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and amplitudes of the channels after one blow on every floor."""
    act = tower.act(level)
    blow = np.zeros((count, act.strength.size))
    blow[0] = act.strength
    return np.fft.rfftfreq(count, 1.0 / RATE_HZ), np.abs(np.fft.rfft(motion(act, blow), axis=0))


def _peaks(hz: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    inside = amplitude[1:-1]
    top = (inside > amplitude[:-2]) & (inside > amplitude[2:]) & (inside > 1e-2 * amplitude.max())
    return hz[1:-1][top]


def test_the_motion_obeys_the_equation_of_motion() -> None:
    act = with_oscillator(_tower(lever_m=0.1).act(np.ones(3)), X, 0.3, 2.0, 0.02)
    count, n = 256, act.mass.shape[0]
    t, rng = np.arange(count) / RATE_HZ, np.random.default_rng(1)
    size = act.strength * rng.standard_normal(act.strength.size)
    drive = np.exp(-0.5 * ((t - 0.5) / 0.05) ** 2)[:, None] * size
    padded = np.concatenate([drive, np.zeros((40_000, size.size))])  # what is periodic has come to rest

    def slope(at: float, z: np.ndarray) -> np.ndarray:
        force = np.zeros(n)
        force[: size.size] = size * np.exp(-0.5 * ((at - 0.5) / 0.05) ** 2)
        return np.concatenate([z[n:], np.linalg.solve(act.mass, force - act.stiffness @ z[:n] - act.damping @ z[n:])])

    moved = solve_ivp(slope, (0.0, t[-1]), np.zeros(2 * n), t_eval=t, rtol=1e-9, atol=1e-12).y
    accelerated = np.stack([slope(at, z)[n:] for at, z in zip(t, moved.T, strict=True)])
    direct = accelerated[:, : size.size] @ act.seen.T
    assert motion(act, padded)[:count] == pytest.approx(direct, abs=1e-3 * np.abs(direct).max())


def test_peaks_stand_at_the_eigenvalues() -> None:
    tower = _tower(lever_m=0.1)
    hz, amplitude = _impulse_spectrum(tower, np.array([1.0, 0.3, 3.0]))
    true = tower.building.modes()[0]
    for peak in _peaks(hz, amplitude[:, 0]):
        assert np.abs(true / peak - 1.0).min() < 0.005


def test_a_symmetrical_plan_seen_in_its_middle_sways_as_the_planar_frame() -> None:
    tower = _tower(eccentric=False)
    planar = tower.building.planar().hz()

    def off_planar(tower: trials.Tower) -> np.ndarray:
        peaks = _peaks(*(x.T[0] if x.ndim == 2 else x for x in _impulse_spectrum(tower, np.ones(3))))
        assert peaks[0] == pytest.approx(planar[0], rel=0.005)
        return np.abs(planar[:, None] / peaks - 1.0).min(axis=0)

    assert off_planar(tower).max() < 0.005
    assert off_planar(_tower(eccentric=False, lever_m=0.1)).max() > 0.02


def test_a_symmetrical_plan_moves_as_much_as_the_planar_frame() -> None:
    tower = _tower(eccentric=False)
    tower = replace(tower, building=replace(tower.building, rayleigh=True))
    act, variance = tower.act(np.eye(3)[X]), 0.0
    for j in np.flatnonzero(act.strength):
        blow = np.zeros((1 << 14, act.strength.size))
        blow[0, j] = act.strength[j]
        variance = variance + (motion(act, blow) ** 2).sum(axis=0)
    strength2 = act.strength[X::3] ** 2
    planar = frame.motion(tower.building.planar(), strength2 / RATE_HZ, strength2)
    assert np.sqrt(variance) == pytest.approx(planar.channel, rel=0.02)


def test_torsion_is_seen_by_its_lever_arm() -> None:
    turn = np.eye(3)[TURN]
    hz, by_turn = _impulse_spectrum(_tower(eccentric=False, lever_m=0.1), turn)
    _, twice = _impulse_spectrum(_tower(eccentric=False, lever_m=-0.2), turn)
    _, middle = _impulse_spectrum(_tower(eccentric=False), turn)
    assert np.abs(twice - 2.0 * by_turn).max() < 1e-6 * twice.max()
    assert middle.max() < 1e-9 * by_turn.max()
    b = _tower(eccentric=False).building
    distance2 = (b.x_lines.sum() * b.reach[1] ** 2 + b.y_lines.sum() * b.reach[0] ** 2) / b.x_lines.sum()
    assert np.abs(b.modes()[0] / _peaks(hz, by_turn[:, 0])[0] - 1.0).min() < 0.005
    assert _peaks(hz, by_turn[:, 0])[0] == pytest.approx(
        b.planar().hz()[0] * np.sqrt(distance2 / b.gyration()[0]), rel=0.2
    )


def test_the_planar_model_lacks_every_mode_but_its_own() -> None:
    b = _tower(eccentric=False).building
    planar = b.planar().hz()
    beside = b.beside_planar_hz()
    assert beside.size == 2 * planar.size
    assert np.sort(np.concatenate([beside, planar])) == pytest.approx(b.modes()[0])


def test_eccentric_masses_keep_their_inertia() -> None:
    b = _tower().building
    for direction in (X, Y):
        rigid = np.kron(np.ones(b.masses.size), np.eye(3)[direction])
        assert rigid @ b.mass() @ rigid == pytest.approx(b.masses.sum())
    about_centre = b.mass()[TURN, TURN] - b.masses[0] * (b.centre[0] ** 2).sum()
    assert about_centre == pytest.approx(b.masses[0] * b.gyration()[0])


@pytest.mark.parametrize("kind", ["white", "ends", "narrow"])
def test_forces_have_their_energy_in_their_band(kind: str) -> None:
    tower = trials.draw_tower(2, kind)
    act, count = tower.act(np.ones(3)), 1 << 14
    drive = forces(act, count, np.ones(count), np.random.default_rng(3))
    hz, power = np.fft.rfftfreq(count, 1.0 / act.rate_hz), (np.abs(np.fft.rfft(drive, axis=0)) ** 2).sum(axis=1)
    inside = (hz >= act.band.low_hz) & (hz <= act.band.high_hz)
    designed = act.band.gain(hz) ** 2
    assert designed[inside].sum() > 0.8 * designed.sum()
    assert power[inside].sum() / power.sum() == pytest.approx(designed[inside].sum() / designed.sum(), rel=0.02)
    density = power[inside].mean() / count / (act.strength**2).sum()  # in the band as that of white forces
    assert density == pytest.approx(1.0, rel=0.15)
    if kind == "white":
        assert drive.std(axis=0) == pytest.approx(act.strength, rel=0.05)
    else:
        two_octaves_up = hz > 4.0 * act.band.high_hz
        assert power[two_octaves_up].sum() < 1e-4 * power.sum()


def test_forces_end_at_once() -> None:
    hz = np.array([0.0, 0.99, 1.0, 1.99, 2.01, 50.0])
    assert Band(1.0, 2.0, np.inf).gain(hz) == pytest.approx([0.0, 0.0, np.sqrt(0.5), 1.0, 0.0, 0.0])
    assert Band().gain(hz) == pytest.approx(np.ones(hz.size))


def test_a_loss_lowers_what_it_must() -> None:
    tower = _tower()
    b = tower.building
    lines = b.x_lines.copy()
    lines[-1] *= 0.9
    act = tower.act(np.ones(3))
    lost = with_building(act, replace(b, x_lines=lines))
    assert lost.mass is not act.mass
    assert point_answer(lost, X, 0.05) > point_answer(act, X, 0.05)
    assert point_answer(lost, Y, 0.05) == pytest.approx(point_answer(act, Y, 0.05), rel=1e-2)


def test_a_seed_gives_the_same_trial_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials, "RECORD_S", 60.0)
    plans = [trials.draw(WHITE, "spikes_loss3d", 17) for _ in range(2)]
    first, second = (np.concatenate([b.samples for b in plan.recording()]) for plan in plans)
    assert (first == second).all()
    assert plans[0].hidden[0].parameters == {"relative": -0.08}


@pytest.mark.parametrize("name", ARTEFACTS)
def test_artefacts_change_a_record_and_leave_its_motion(name: str) -> None:
    rng = np.random.default_rng(4)
    clean = rng.standard_normal((20_000, 3))
    before = clean.copy()
    faulty, size = ARTEFACTS[name](clean, 100.0, rng)
    assert (clean == before).all()
    assert size
    assert (faulty != clean).any()
    smooth = faulty - np.apply_along_axis(lambda x: np.convolve(x, np.ones(201) / 201.0, "same"), 0, faulty)
    assert np.corrcoef(np.concatenate([smooth.T, clean.T]))[:3, 3:].diagonal().min() > 0.5
