"""The band that a recording can judge: found from its power alone, and the same for all that is compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh

from drivers.base import ACCELERATION
from monitor.core import BadInputError
from monitor.diagnosis import healthy_prior
from monitor.inference.cross_spectra import Band
from monitor.inference.exact_simulation import draw_forces
from monitor.inference.judged_band import find_judged_band
from monitor.inference.observed_spectra import classify
from monitor.inference.segments import Segments, gather
from monitor.inference.starting_point import make_posterior
from monitor.model import prior_from_drawing, simulate
from monitor.runs import cut_into_blocks, diagnose
from tests.support import turning_frame
from tests.support.frames import shear_frame

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
WHOLE = Band(40, 681, 0.05, np.ones(681))
HZ = WHOLE.hz
N_SEGMENTS = 118


def chain(n: int, first_hz: float, seed: int) -> tuple[ComplexArray, ComplexArray]:
    """Accelerations of the floors by white forces and by a white ground motion, shapes (n_bins, n, n) and (n_bins, n, 1)."""
    rng = np.random.default_rng(seed)
    mass, drift = np.diag(np.exp(0.2 * rng.standard_normal(n))), np.eye(n) - np.eye(n, k=1)
    stiffness = drift.T @ (np.exp(0.3 * rng.standard_normal(n))[:, None] * drift)
    stiffness *= (2.0 * np.pi * first_hz) ** 2 / eigh(stiffness, mass, eigvals_only=True)[0]
    values, shapes = eigh(stiffness, mass)
    carried = mass @ shapes
    damping = (carried * (0.02 * np.sqrt(values))) @ carried.T
    w = 2.0 * np.pi * HZ[:, None, None]
    answer = -(w**2) * np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)
    shaken = 1.0 - answer @ np.diag(mass)
    return answer * np.exp(rng.uniform(-0.25, 0.25, n)), shaken[:, :, None]


def drawn(root: ComplexArray, noise: float = 1e-3, seed: int = 0) -> ComplexArray:
    """Transforms of a random recording whose level wanders, with a floor of noise; `root` of shape (n_bins, c, sources)."""
    rng = np.random.default_rng(seed)

    def normal(n: int) -> ComplexArray:
        shape = N_SEGMENTS, HZ.size, n
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2.0)

    power = (np.abs(root) ** 2).sum(axis=2)
    level = np.exp(0.35 * rng.standard_normal(N_SEGMENTS))[:, None, None]
    moved = np.einsum("kcj,skj->skc", root, level * normal(root.shape[2]))
    return moved + np.sqrt(noise * np.median(power[power > 0.0])) * normal(root.shape[1])


def is_whole(root: ComplexArray, noise: float = 1e-3) -> bool:
    return find_judged_band(drawn(root, noise), WHOLE).n_bins == HZ.size


def where(condition: NDArray[np.bool_]) -> Array:
    return condition[:, None, None].astype(float)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.parametrize("first_hz", [2.5, 5.0, 9.0])
def test_what_a_structure_answers_to_forces_is_judged_in_the_whole_band(n: int, first_hz: float) -> None:
    forced, shaken = chain(n, first_hz, seed=n)
    assert is_whole(forced)
    assert is_whole(forced / np.sqrt(1.0 + (HZ[:, None, None] / 6.0) ** 2)), (
        "a first-order colour is a cause of its own"
    )
    as_strong = np.sqrt((np.abs(forced) ** 2).mean() / (np.abs(shaken) ** 2).mean())
    assert is_whole(np.concatenate([forced, as_strong * shaken], axis=2)), "and so is a ground motion"


@pytest.mark.parametrize("end_hz", [12.0, 18.0, 25.0])
def test_forces_that_end_are_found_to_end_there(end_hz: float) -> None:
    found = find_judged_band(drawn(chain(3, 3.0, seed=1)[0] * where(end_hz > HZ)), WHOLE)
    assert found.forces_hz == (0.0, pytest.approx(end_hz, rel=0.01))
    assert 0.88 * end_hz < found.hz[-1] < 0.92 * end_hz
    assert found.first == WHOLE.first


def test_the_force_on_one_floor_is_found_to_end() -> None:
    shaken_by_one = chain(3, 3.0, seed=1)[0][:, :, 1:2] * where(HZ < 18.0)
    assert find_judged_band(drawn(shaken_by_one, noise=1e-6), WHOLE).forces_hz[1] == pytest.approx(18.0, rel=0.02)


def test_what_a_nonlinear_law_excites_beyond_does_not_hide_the_end() -> None:
    forced = chain(3, 5.4, seed=3)[0] * where(HZ < 18.0)
    by_law = chain(3, 5.4, seed=3)[0][:, :, 1:2] * where(HZ > 18.0)
    found = find_judged_band(drawn(np.concatenate([forced, by_law], axis=2)), WHOLE)
    assert found.forces_hz[1] == pytest.approx(18.0, rel=0.02)


def test_a_steep_filter_is_judged_where_it_passes_all() -> None:
    passed = 1.0 / (1.0 + (HZ / 18.0) ** 24)
    found = find_judged_band(drawn(chain(3, 3.0, seed=1)[0] * np.sqrt(passed)[:, None, None]), WHOLE)
    assert found.forces_hz[1] == pytest.approx(18.0, rel=0.05)
    assert passed[found.hz[-1] >= HZ].min() > 0.9


def test_forces_of_two_octaves_begin_and_end() -> None:
    inside = where((HZ > 4.0) & (HZ < 16.0))
    found = find_judged_band(drawn(chain(2, 6.0, seed=1)[0] * inside, noise=1e-4), WHOLE)
    assert found.forces_hz == (pytest.approx(4.0, rel=0.05), pytest.approx(16.0, rel=0.01))
    assert 4.0 < found.hz[0] < 4.7
    assert 14.0 < found.hz[-1] < 14.7


def test_a_machine_beyond_the_end_does_not_hide_it() -> None:
    forced = chain(3, 3.0, seed=1)[0]
    root = forced * where(HZ < 18.0)
    root[np.abs(HZ - 30.0) < 0.11] = 10.0 * np.abs(forced).max()
    assert find_judged_band(drawn(root), WHOLE).forces_hz[1] == pytest.approx(18.0, rel=0.01)


def test_a_channel_that_falls_alone_is_no_end_of_the_forces() -> None:
    root = chain(3, 3.0, seed=1)[0]
    root[HZ > 18.0, 1] = 0.0
    assert is_whole(root)


def test_a_dead_channel_is_no_end_of_the_forces() -> None:
    transforms = drawn(chain(3, 3.0, seed=1)[0])
    transforms[:, :, 2] = 0.0
    assert find_judged_band(transforms, WHOLE).n_bins == HZ.size


CONFIG = shear_frame([0.33, 0.35], [900.0, 1100.0])
RATE_HZ, END_HZ = 200.0, 20.0


@pytest.fixture(scope="module")
def ended() -> Segments:
    """Segments of a recording without power beyond 20 Hz but a little noise."""
    floors = simulate(CONFIG.model(), duration_s=200.0, rate_hz=RATE_HZ, seed=4).floors
    spectrum = np.fft.rfft(floors, axis=0)
    spectrum[np.fft.rfftfreq(len(floors), 1.0 / RATE_HZ) > END_HZ] = 0.0
    samples = np.fft.irfft(spectrum, n=len(floors), axis=0)
    samples += 0.01 * samples.std(axis=0) * np.random.default_rng(1).standard_normal(samples.shape)
    return gather(cut_into_blocks(ACCELERATION, samples, CONFIG.channels, RATE_HZ, 10**18, 500), CONFIG.front_end())


def test_segments_hold_the_judged_band_and_the_power_of_the_whole_one(ended: Segments) -> None:
    assert ended.values.shape[1] == ended.band.n_bins == ended.band.gain.size
    assert ended.band.hz[-1] < END_HZ < ended.whole.hz[-1] == pytest.approx(36.0, abs=0.1)
    assert ended.power.shape == (ended.whole.n_bins, 2)
    inside = np.abs(ended.values) ** 2 / ended.band.gain[:, None]
    assert ended.power[: ended.band.n_bins] == pytest.approx(inside.mean(axis=0))


def test_a_band_is_narrowed_to_what_the_baseline_could_judge(ended: Segments) -> None:
    narrow = ended.within((3.0, 12.0))
    assert narrow.band.hz[[0, -1]] == pytest.approx([3.0, 12.0])
    assert narrow.values.shape[1] == narrow.band.n_bins
    lost = (np.abs(ended.values[:, ended.band.hz > 12.01]) ** 2 / ended.band.gain[ended.band.hz > 12.01, None]).sum(
        axis=1
    )
    assert narrow.above - ended.above == pytest.approx(2.0 * ended.band.bin_hz * lost)
    assert ended.within(None) is ended
    with pytest.raises(BadInputError, match="nothing is common to both"):
        ended.within((25.0, 36.0))


@pytest.mark.engine
def test_later_diagnoses_compare_where_the_healthy_recording_could_be_judged(ended: Segments) -> None:
    known = prior_from_drawing(CONFIG.model(), np.full(4, 0.1), 2)
    learnt, _ = healthy_prior.learn_prior(
        classify(ended), known, CONFIG.instrumented().context(RATE_HZ), CONFIG.diagnosis
    )
    assert learnt.judged_hz == pytest.approx(ended.band.hz[[0, -1]])
    floors = simulate(CONFIG.model(), duration_s=200.0, rate_hz=RATE_HZ, seed=5, noise=0.01).floors
    white = gather(cut_into_blocks(ACCELERATION, floors, CONFIG.channels, RATE_HZ, 10**18, 500), CONFIG.front_end())
    assert white.band.n_bins == white.whole.n_bins
    found, _ = diagnose.diagnose_segments(white, learnt, CONFIG)
    assert found.posterior.observed.band.hz[[0, -1]] == pytest.approx(ended.band.hz[[0, -1]])


def test_the_own_forces_of_a_coupled_mode_follow_the_level_of_those_on_the_floors() -> None:
    at = turning_frame.posterior(np.ones(3))
    x = np.zeros(at.layout.n_nuisance)
    x[at.layout.structure] = at.prior.mean
    sizes = []
    for ln_power in (0.0, 6.0):
        x[at.layout.forces] = ln_power
        acting = draw_forces(at, x, (turning_frame.COUPLED,), seed=1)
        sizes.append((acting.own.std(), acting.floors.std()))
    own, floors = np.divide(sizes[1], sizes[0])
    assert sizes[0][0] == pytest.approx(sizes[0][1], rel=0.5) and floors > 3.0
    assert own == pytest.approx(floors, rel=1e-6)


def test_simulated_forces_end_where_the_recordings_do(ended: Segments) -> None:
    def power_beyond(segments: Segments) -> float:
        known = prior_from_drawing(CONFIG.model(), np.full(4, 0.1), 2)
        context = CONFIG.instrumented().context(RATE_HZ)
        posterior = make_posterior(classify(segments), known, context)
        x = np.zeros(posterior.layout.n_nuisance)
        x[posterior.layout.structure] = known.mean
        acting = draw_forces(posterior, x, (), seed=1)
        power = np.abs(np.fft.rfft(acting.floors, axis=0)) ** 2
        hz = np.fft.rfftfreq(len(acting.floors), 1.0 / acting.rate_hz)
        return float(power[hz > 1.05 * END_HZ].mean() / power[(hz > 3.0) & (hz < 0.95 * END_HZ)].mean())

    assert power_beyond(ended) < 1e-9
    white = replace(ended, band=replace(ended.band, forces_hz=(0.0, np.inf)))
    assert power_beyond(white) == pytest.approx(1.0, rel=0.1)
