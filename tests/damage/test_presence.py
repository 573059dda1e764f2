"""Missing modes and modes that were never there are evidence by the rates of calibration, in words that say what they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.damage.presence import Presence, Sighting, either, kept, learn_presence, look

WINDOW_NS, HZ, BAND = 10**10, np.array([2.0, 5.0]), (0.2, 20.0)


def sighting(k: int, missing: tuple[int, ...] = (), others: tuple[float, ...] = ()) -> Sighting:
    return Sighting(WINDOW_NS * k, np.isin(np.arange(2), missing), np.array(others))


def healthy(windows: int, lacking: int = 0) -> Presence:
    """Healthy windows, the first of which lack the second mode."""
    return learn_presence([sighting(k, (1,) * (k < lacking)) for k in range(windows)], [0] * windows, 2, BAND)


def judged(presence: Presence, windows: list[Sighting]) -> tuple[float, str]:
    before: tuple[Sighting, ...] = ()
    for one in windows:
        found = look(presence, before, one, HZ, WINDOW_NS, 0.02)
        before = kept(before, one, WINDOW_NS)
    return found.z, found.says


def test_a_mode_that_is_gone_is_the_surer_the_longer_and_the_more_healthy_windows_had_it() -> None:
    z = [[judged(healthy(n), [sighting(k, (1,)) for k in range(w)])[0] for w in (1, 4, 16)] for n in (6, 200)]
    assert z[1][0] < z[1][1] < z[1][2]
    assert z[1][2] > 6.5
    assert max(z[0]) < 3.0, "six windows do not tell that a mode is hardly ever missing"


def test_it_is_said_which_mode_is_missing_in_how_many_windows_and_never_by_how_much() -> None:
    _, says = judged(healthy(100, lacking=3), [sighting(k, (1,)) for k in range(8)])
    assert (
        says == "mode 2 (5 Hz) is missing in 8 of the latest 8 windows that share no data, in 3 of 100 at calibration"
    )
    _, says = judged(healthy(100), [sighting(k, (), (7.0 + 0.01 * k,)) for k in range(8)])
    assert says == "a mode at 7.07 Hz is in 8 of the latest 8 windows that share no data, in 0 of 100 at calibration"


def test_a_mode_that_healthy_windows_lack_as_often_is_no_news() -> None:
    rng, presence = np.random.default_rng(0), healthy(100, lacking=30)
    scores = [judged(presence, [sighting(k, (1,) * (rng.random() < 0.3)) for k in range(20)])[0] for _ in range(50)]
    assert max(scores) < 4.0


def test_other_modes_that_come_and_go_anywhere_are_no_new_mode() -> None:
    rng = np.random.default_rng(1)
    scores = [
        judged(healthy(100), [sighting(k, (), (float(rng.uniform(0.5, 20.0)),)) for k in range(20)])[0]
        for _ in range(50)
    ]
    assert max(scores) < 4.0


def test_windows_of_one_record_that_lack_the_same_mode_count_as_fewer() -> None:
    """A mode that a whole record does not excite is missing in all of its windows."""
    windows = [sighting(k, (1,) * (k < 8)) for k in range(80)]
    alone, together = (learn_presence(windows, [k // size for k in range(80)], 2, BAND) for size in (1, 8))
    gone = [sighting(k, (1,)) for k in range(8)]
    assert together.alike > 0.9
    assert judged(together, gone)[0] < 3.0 < judged(alone, gone)[0]


@pytest.mark.parametrize("chance", [1e-12, 0.5])
def test_the_spectrums_shape_speaks_where_it_is_the_more_improbable(chance: float) -> None:
    first, second = (replace(sighting(k, (1,)), chance=chance) for k in (1, 2))
    found = look(healthy(100), (), second, HZ, WINDOW_NS, 0.02)
    both = either(found, (first,), second, WINDOW_NS)
    assert ("shape of the spectrum" in both.says) == (chance < 1e-6)
    assert both.z > 6.0 if chance < 1e-6 else both.z <= found.z


def test_a_transient_that_one_window_alone_shows_is_no_change_of_the_spectrum() -> None:
    calm, shaken = sighting(1), replace(sighting(2), chance=1e-20)
    found = look(healthy(100), (calm,), shaken, HZ, WINDOW_NS, 0.02)
    assert either(found, (), shaken, WINDOW_NS).z == 0.0
    assert either(found, (calm,), shaken, WINDOW_NS).z == 0.0


def test_windows_that_share_data_are_counted_once() -> None:
    before: tuple[Sighting, ...] = ()
    for k in range(40):
        one = Sighting(WINDOW_NS * k // 10, np.array([False, True]), np.zeros(0))
        before = kept(before, one, WINDOW_NS)
    assert len(before) == 4
