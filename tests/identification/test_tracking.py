"""Identities of modes: crossings, absences, jumps, spurious poles, close pairs, and three weeks of a real tower."""

from __future__ import annotations

import pickle
from collections.abc import Iterable

import numpy as np
import pytest

from monitor.identification.tracking import Observed, Status, TrackedModes, TrackSettings, TrackState, observed, step
from tests.support.results import modal_estimate
from tests.support.tower import DAY_NS, HOUR_NS, SETTINGS, Tower

WINDOW_S = 400.0
STD = 0.001  # relative, of one window
SHAPES = np.array([[1.0, 0.8, 0.4], [-0.6, 0.5, 1.0], [0.5, -1.0, 0.9]])


class Site:
    """Windows of a structure whose modes have labels; spurious poles have none (-1)."""

    def __init__(self, seed: int = 0, settings: TrackSettings = SETTINGS, hop_s: float = WINDOW_S) -> None:
        self.rng = np.random.default_rng(seed)
        self.settings = settings
        self.hop_ns = round(hop_s * 1e9)
        self.state = TrackState()
        self.t_ns = 0
        self.identities: dict[int, list[int]] = {}
        """Label -> the track it was given at each of its windows."""

    def show(
        self, modes: dict[int, tuple[float, np.ndarray]], spurious: int = 0, shapes: bool = True, noise: bool = True
    ) -> TrackedModes:
        """One window with these modes (frequency in Hz, shape) and some poles anywhere, in random order."""
        rows = [(label, f, np.asarray(shape, complex)) for label, (f, shape) in modes.items()]
        for _ in range(spurious):
            shape = self.rng.normal(size=3) + 1j * self.rng.normal(size=3)
            rows.append((-1, float(self.rng.uniform(2.0, 30.0)), shape))
        rows = [rows[i] for i in self.rng.permutation(len(rows))]
        f = np.array([row[1] for row in rows])
        f = f * (1.0 + noise * STD * self.rng.normal(size=f.size))
        seen = [row[2] + 0.02 * (self.rng.normal(size=3) + 1j * self.rng.normal(size=3)) for row in rows]
        turned = np.array([s * np.exp(2j * np.pi * self.rng.random()) for s in seen]).reshape(-1, 3)
        return self.see(Observed(f, STD * f, turned[:, : 3 * shapes], WINDOW_S), [row[0] for row in rows])

    def see(self, seen: Observed, labels: Iterable[int] = ()) -> TrackedModes:
        self.t_ns += self.hop_ns
        self.state, tracked = step(self.state, seen, self.t_ns, self.settings)
        for label, number in zip(labels, tracked.observed.tolist(), strict=False):
            self.identities.setdefault(label, []).append(number)
        return tracked

    def wait(self, ns: int) -> None:
        self.t_ns += ns

    def of(self, label: int) -> set[int]:
        """The tracks a mode was ever given, but for the time before its confirmation."""
        return set(self.identities[label]) - {-1}


def steady(*frequencies: float) -> dict[int, tuple[float, np.ndarray]]:
    return {i: (f, SHAPES[i]) for i, f in enumerate(frequencies)}


FRAME = steady(5.2, 16.3, 23.0)


def settled(**keywords: object) -> Site:
    site = Site(**keywords)  # type: ignore[arg-type]
    for _ in range(20):
        site.show(FRAME)
    return site


def test_modes_are_confirmed_by_repeated_hits_and_numbered_by_frequency() -> None:
    site = Site()
    births = [site.show(FRAME).births for _ in range(6)]
    assert births == [(), (), (), (0, 1, 2), (), ()]
    last = site.show(FRAME)
    assert last.numbers.tolist() == [0, 1, 2] and last.status == (Status.CONFIRMED,) * 3
    assert last.frequencies_hz == pytest.approx([5.2, 16.3, 23.0], rel=3 * STD)


def test_no_mode_at_all_is_a_look_too() -> None:
    site = settled()
    tracked = site.see(observed(None, WINDOW_S))
    assert tracked.observed.size == 0 and tracked.numbers.tolist() == [0, 1, 2]
    assert [t.misses for t in site.state.tracks] == [1.0, 1.0, 1.0]
    assert step(TrackState(), observed(None, WINDOW_S), 0, SETTINGS)[1].numbers.size == 0


@pytest.mark.parametrize("seed", range(5))
def test_crossing_modes_keep_their_identities_by_shape(seed: int) -> None:
    site = Site(seed)
    for k in range(200):
        site.show(steady(10.0 * (1 + 0.0003 * (k - 100)), 10.0 * (1 - 0.0003 * (k - 100))))
    assert len(site.of(0)) == len(site.of(1)) == 1 and site.of(0) != site.of(1)
    assert -1 not in site.identities[0][4:] + site.identities[1][4:]


def test_crossing_modes_of_kindred_shapes_keep_their_identities() -> None:
    site = Site()
    kin = SHAPES[0] + 0.9 * SHAPES[2]  # MAC 0.53
    for k in range(200):
        site.show({0: (10.0 * (1 + 0.0003 * (k - 100)), SHAPES[0]), 1: (10.0 * (1 - 0.0003 * (k - 100)), kin)})
    assert len(site.of(0)) == len(site.of(1)) == 1 and site.of(0) != site.of(1)


@pytest.mark.parametrize("seed", range(5))
def test_veering_modes_keep_their_branches(seed: int) -> None:
    """Two coupled modes whose frequencies come near and part again, while their shapes change places."""
    site = Site(seed)
    for k in range(-300, 301):
        values, vectors = np.linalg.eigh(np.array([[1 + 4e-4 * k, 0.02], [0.02, 1 - 4e-4 * k]]))
        frame = {i: (10.0 * float(values[i]) ** 0.5, vectors[:, i] @ SHAPES[:2]) for i in range(2)}
        site.show(frame)
    assert len(site.of(0)) == len(site.of(1)) == 1 and site.of(0) != site.of(1)


@pytest.mark.parametrize("seed", range(5))
def test_a_mode_that_is_often_missing_and_spurious_poles_change_nothing(seed: int) -> None:
    site = Site(seed)
    births = []
    for k in range(400):
        modes = {i: mode for i, mode in FRAME.items() if i != 1 or site.rng.random() > 0.3}
        births += site.show(modes, spurious=int(k % 3 == 0)).births
    assert births == [0, 1, 2]
    assert all(len(site.of(i)) == 1 for i in range(3))
    assert len([n for n in site.identities[-1] if n >= 0]) <= 1  # of 134


def test_a_mode_absent_for_days_comes_back_as_itself_and_is_called_lost_meanwhile() -> None:
    site = settled()
    quiet = {i: FRAME[i] for i in (0, 2)}
    early = site.show(quiet)
    for _ in range(30):
        site.wait(3 * HOUR_NS)
        late = site.show(quiet)
    assert late.status == (Status.CONFIRMED, Status.LOST, Status.CONFIRMED)
    assert late.frequencies_std_hz[1] > 5 * early.frequencies_std_hz[1]
    back = site.show(FRAME | {1: (16.3 * 1.02, SHAPES[1])})
    assert back.births == () and site.identities[1][-1] == 1
    assert back.status == (Status.CONFIRMED,) * 3


def test_a_mode_unseen_too_long_dies_and_returns_as_another() -> None:
    site = settled()
    quiet = {i: FRAME[i] for i in (0, 2)}
    deaths = []
    for _ in range(62):
        site.wait(DAY_NS // 2)
        deaths += site.show(quiet).deaths
    assert deaths == [1]
    tracked = [site.show(FRAME) for _ in range(4)][-1]
    assert tracked.births == (3,) and tracked.numbers.tolist() == [0, 2, 3]


def test_a_sudden_drop_is_followed_by_shape() -> None:
    site = settled()
    dropped = steady(5.2, 16.3 * 0.95, 23.0)
    first = site.show(dropped)
    assert first.births == () and first.frequencies_hz[1] == pytest.approx(16.3 * 0.95, rel=0.005)
    for _ in range(20):
        last = site.show(dropped)
    assert last.births == () and last.numbers.tolist() == [0, 1, 2]
    assert [site.of(i) for i in range(3)] == [{0}, {1}, {2}]
    assert last.frequencies_std_hz[1] < 0.001 * 16.3


def test_a_sudden_drop_is_followed_by_the_shape_at_the_channels_that_are_left() -> None:
    site, left = settled(), SHAPES.copy()
    left[:, 2] = np.nan
    seen = site.see(
        Observed(np.array([5.2, 16.3 * 0.95, 23.0]), STD * np.array([5.2, 16.3, 23.0]), left + 0j, WINDOW_S)
    )
    assert seen.observed.tolist() == [0, 1, 2]


def test_a_window_across_the_drop_that_shows_both_frequencies_starts_no_second_track() -> None:
    site = Site(hop_s=10.0)
    for _ in range(200):
        site.show(FRAME)
    after = steady(5.2, 16.3 * 0.95, 23.0)
    births: list[int] = []
    for _ in range(30):
        births += site.show(FRAME | {3: after[1]}).births
    for _ in range(100):
        births += site.show(after).births
    assert births == [] and site.identities[1][-1] == 1


def test_a_drop_too_large_to_be_believed_is_another_mode() -> None:
    site = settled()
    births = [site.show(steady(5.2, 16.3 * 0.8, 23.0)).births for _ in range(4)]
    assert births == [(), (), (), (3,)]
    assert site.identities[1][-1] == 3


def test_a_jump_never_takes_the_observation_of_a_rival() -> None:
    """Two modes alike in shape: when one is missing, the other stays itself."""
    site = Site()
    twins = {0: (10.0, SHAPES[0]), 1: (10.8, SHAPES[0])}
    for k in range(60):
        site.show(twins if k < 20 or k % 2 else {1: twins[1]})
    assert site.of(0) == {0} and site.of(1) == {1}


def test_without_shapes_frequency_alone_identifies() -> None:
    site, births = Site(), []
    for k in range(100):
        births += site.show({i: m for i, m in FRAME.items() if i != 1 or k % 3}, int(k % 5 == 0), shapes=False).births
    assert births == [0, 1, 2]
    assert all(len(site.of(i)) == 1 for i in range(3))
    site.show(steady(5.2, 16.3 * 0.95, 23.0), shapes=False)
    assert site.identities[1][-1] == -1  # nothing says that it is the same mode


def test_by_frequency_alone_a_lost_mode_does_not_take_its_neighbours_observations() -> None:
    site = Site()
    pair = steady(10.0, 10.3)
    for _ in range(20):
        site.show(pair, shapes=False)
    for _ in range(200):  # the other one's prediction soon reaches as far as this one's frequency
        site.wait(DAY_NS // 10)
        site.show({0: pair[0]}, shapes=False)
    assert site.of(0) == {0}


def test_one_mode_found_twice_is_one_track() -> None:
    site = Site()
    for k in range(60):
        tracked = site.show(FRAME | ({3: (16.3 * 1.001, SHAPES[1])} if k < 10 or k % 2 else {}))
    assert tracked.numbers.tolist() == [0, 1, 2]


def test_a_mixture_of_two_close_modes_is_no_third() -> None:
    site = Site()
    pair = {0: (10.0, SHAPES[0]), 1: (10.02, SHAPES[1])}
    for k in range(60):
        tracked = site.show(pair if k % 3 else {2: (10.01, SHAPES[0] / 1.34 + SHAPES[1] / 1.27)})
    assert tracked.numbers.tolist() == [0, 1]


def test_overlapping_windows_count_as_the_new_data_they_bring() -> None:
    site = Site(hop_s=10.0)
    births = [site.show(FRAME, noise=False).births for _ in range(130)]
    assert births.index((0, 1, 2)) == 120  # the first window, and three windows' length more
    assert all(t.hits == pytest.approx(1 + 129 / 40) for t in site.state.tracks)


@pytest.mark.parametrize("hop_s", [10.0, 100.0, 400.0])
@pytest.mark.parametrize("honesty", [0.3, 1.0, 3.0])
def test_the_stated_deviation_of_a_track_is_its_error(hop_s: float, honesty: float) -> None:
    """Whether windows overlap or not, and whatever the observations claim of themselves; the truth is a random walk."""
    rng = np.random.default_rng(1)
    n, overlap = 3000, round(WINDOW_S / hop_s)
    walk = np.cumsum(SETTINGS.drift_per_sqrt_day * np.sqrt(hop_s / 86400) * rng.normal(size=n))
    noise = np.convolve(rng.normal(size=n + overlap - 1), np.full(overlap, overlap**-0.5), mode="valid")
    shape = np.array([SHAPES[0]], complex)
    state, errors, stated = TrackState(), [], []
    for k in range(n):
        f = np.array([10.0 * np.exp(walk[k] + STD * noise[k])])
        t_ns = round((k + 1) * hop_s * 1e9)
        state, tracked = step(state, Observed(f, honesty * STD * f, shape, WINDOW_S), t_ns, SETTINGS)
        assert len(state.tracks) == 1
        if k > 20 * overlap:
            errors.append(tracked.frequencies_hz[0] / 10.0 - np.exp(walk[k]))
            stated.append(tracked.frequencies_std_hz[0] / 10.0)
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stated)))
    assert 0.6 < ratio < 1.6


def test_an_outage_of_the_monitor_kills_no_mode_that_is_there_afterwards() -> None:
    site = settled()
    site.wait(90 * DAY_NS)
    tracked = site.show({i: FRAME[i] for i in (0, 2)})
    assert tracked.numbers.tolist() == [0, 2] and tracked.deaths == (1,) and tracked.births == ()


def test_unusable_observations_belong_to_nobody() -> None:
    site = settled()
    f = np.array([np.nan, 5.2, 16.3, 23.0])
    std = np.array([0.01, np.nan, 0.2 * 16.3, 0.01])
    assert site.see(Observed(f, std, SHAPES[[0, 0, 1, 2]].astype(complex), WINDOW_S)).observed.tolist() == [
        -1,
        -1,
        -1,
        2,
    ]


def test_a_clock_that_is_set_back_costs_no_identity() -> None:
    site = settled()
    site.wait(-40 * 86_400 * 10**9)
    seen = site.show(FRAME)
    assert sorted(seen.observed.tolist()) == [0, 1, 2] and seen.status == (Status.CONFIRMED,) * 3 and not seen.births
    assert np.all(seen.frequencies_std_hz > 0)


def test_a_saved_state_goes_on_as_if_nothing_had_happened() -> None:
    site, again = settled(), settled()
    again.state = pickle.loads(pickle.dumps(site.state))
    for _ in range(5):
        ours, theirs = site.show(FRAME, spurious=1), again.show(FRAME, spurious=1)
        assert np.array_equal(ours.frequencies_hz, theirs.frequencies_hz)
        assert np.array_equal(ours.observed, theirs.observed)


def test_a_modal_estimate_is_observed_as_it_is() -> None:
    deviations = np.zeros((2, 3, 8))
    deviations[:, :, 0] = STD / np.sqrt(2.0)
    estimate = modal_estimate([5.2, 16.3, 23.0], SHAPES, deviations=deviations)
    assert settled().see(observed(estimate, WINDOW_S)).observed.tolist() == [0, 1, 2]
    assert observed(estimate, WINDOW_S).frequencies_std_hz == pytest.approx(estimate.frequencies_hz * STD)


@pytest.fixture(scope="module")
def tower() -> Tower:
    return Tower()


def test_the_tower_has_five_close_pairs_and_one_mode_more(tower: Tower) -> None:
    medians = sorted(np.median(tower.f[tower.track == n]) for n in tower.tracks)
    pairs = [0.352, 0.3546, 0.620, 0.625, 1.31, 1.316, 2.045, 2.050, 3.306, 3.339]
    assert medians == pytest.approx([*pairs, 3.448], rel=0.003)
    assert tower.births == list(range(11)) and tower.deaths == []


@pytest.mark.parametrize(("low", "high"), [(0.34, 0.365), (0.6, 0.64), (1.98, 2.12)])
def test_shapes_found_without_time_are_one_track_each_for_three_weeks(tower: Tower, low: float, high: float) -> None:
    first, second = ({*tower.track[label].tolist()} - {-1} for label in tower.alike(low, high))
    assert len(first) == len(second) == 1 and first != second


def test_pairs_on_the_tower_keep_their_order_in_frequency(tower: Tower) -> None:
    by_frequency = sorted(tower.tracks, key=lambda n: float(np.median(tower.f[tower.track == n])))
    for lower, upper in (by_frequency[0:2], by_frequency[2:4], by_frequency[8:10]):
        seen = [
            {k: f for k, f in zip(tower.look[q], tower.f[q], strict=True)}
            for q in (tower.track == lower, tower.track == upper)
        ]
        both = seen[0].keys() & seen[1].keys()
        assert len(both) > 50
        assert np.mean([seen[0][k] < seen[1][k] for k in both]) > 0.97


def test_strong_modes_of_the_tower_bridge_gaps_and_follow_temperature(tower: Tower) -> None:
    strong = sorted(tower.tracks.values(), key=lambda t: -t.hits)[:4]
    for track in strong:
        q = tower.track == track.number
        times = tower.t_ns[tower.look[q]]
        assert q.sum() > 300  # of 468 looks
        assert np.diff(times).max() >= 8 * HOUR_NS  # unseen so long, and still itself
        assert times[-1] - times[0] > 21 * DAY_NS
        warm = np.isfinite(tower.temperature[tower.look[q]])
        assert np.corrcoef(tower.f[q][warm], tower.temperature[tower.look[q]][warm])[0, 1] < -0.6
