"""The judge knows only the vector of losses: quantities of a kind that it has never seen are judged as stories are."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from monitor.config import Configuration
from monitor.core import Level, ModalEstimate, Reading, Skipped
from monitor.damage import judge
from monitor.damage.alarm import AlarmState, start
from monitor.damage.parts import Parts
from monitor.damage.presence import Sighting
from monitor.damage.quantities import Found, View
from monitor.identification import SubArray
from tests.support.results import modal_estimate

HEALTHY_HZ, WINDOW_S, STD = np.array([2.0, 3.0, 5.0]), 400.0, 0.002
SETTINGS = Configuration.model_validate(
    {"structure": {"kind": "modal"}, "sensors": [{"channel": "a1"}], "processing": {"window_s": WINDOW_S}}
)


@dataclass(frozen=True, slots=True)
class Springs(Parts):
    part: ClassVar[str] = "spring"

    def name(self, part: int) -> str:
        return f"spring {part}"


class SpringStiffness:
    """Each mode swings on a spring of its own."""

    without_baseline = "no baseline"
    names: tuple[str, ...] = ()
    parts = Springs()

    def __init__(self, *, has_baseline: bool = True) -> None:
        self.baseline: Any = SimpleNamespace(law=None) if has_baseline else None

    def start(self, window_s: float) -> AlarmState:
        return start(HEALTHY_HZ.size, window_s)

    def view(self, channels: tuple[int, ...]) -> View:
        return View(SubArray.plain(channels, (0,), 1), None)

    def identify(self, *_: object) -> ModalEstimate:
        raise NotImplementedError

    def beside(self, sightings: tuple[Sighting, ...], *_: object) -> tuple[tuple[Sighting, ...], None]:
        return sightings, None

    def lacking(self, modes: ModalEstimate, *_: object) -> Skipped | None:
        return None if modes.model_mode.size > 1 else Skipped("one mode alone")

    def read(self, modes: ModalEstimate, *_: object) -> Found:
        loss = np.full(HEALTHY_HZ.size, np.nan)
        loss[modes.model_mode] = 1.0 - (modes.frequencies_hz / HEALTHY_HZ[modes.model_mode]) ** 2
        return Found(modes, Reading(loss, STD**2 * np.eye(loss.size), 0.1 * STD**2 * np.eye(loss.size)))


def modes(loss: tuple[float, float, float], found: tuple[int, ...] = (0, 1, 2)) -> ModalEstimate:
    hz = HEALTHY_HZ * np.sqrt(1.0 - np.array(loss))
    return modal_estimate(hz[list(found)], np.ones((len(found), 1)), model_mode=np.array(found))


def judged(springs: SpringStiffness, windows: list[ModalEstimate]) -> list[judge.Judged | Skipped]:
    memory, out, view = judge.Memory(springs.start(WINDOW_S), None), [], springs.view((0,))
    for k, one in enumerate(windows):
        found = judge.step(springs, memory, one, {}, view, round((k + 1) * WINDOW_S * 1e9), SETTINGS)
        if isinstance(found, Skipped):
            out.append(found)
        else:
            memory, said = found
            out.append(said)
    return out


def test_a_lost_spring_is_announced_by_its_name_and_a_window_without_it_leaves_its_alarm() -> None:
    said = judged(SpringStiffness(), [modes((0, 0, 0))] * 3 + [modes((0, 0.05, 0))] * 3 + [modes((0, 0.05, 0), (0, 2))])
    assert not any(isinstance(s, Skipped) for s in said)
    levels = [s.alarm.level for s in said]  # type: ignore[union-attr]
    assert levels == [Level.NORMAL] * 3 + [Level.ADVISORY] + [Level.WARNING] * 3
    last, gone = said[-2:]
    assert last.alarm.reason.startswith("spring 2 lost 5.0 ± ")  # type: ignore[union-attr]
    assert gone.alarm.active == {2: Level.WARNING}  # type: ignore[union-attr]
    assert np.isfinite(gone.detectable_loss).tolist() == [True, False, True]  # type: ignore[union-attr]


def test_modes_that_are_too_few_are_not_judged_and_without_a_baseline_nothing_is_announced() -> None:
    assert judged(SpringStiffness(), [modes((0, 0, 0), (0,))]) == [Skipped("one mode alone")]
    (said,) = judged(SpringStiffness(has_baseline=False), [modes((0, 0.5, 0))])
    assert not isinstance(said, Skipped)
    assert (said.alarm.level, said.alarm.reason, said.detectable_loss) == (Level.NORMAL, "no baseline", None)


@pytest.mark.parametrize("loss", [0.05, -0.05])
def test_to_either_side_a_rise_is_a_change_as_a_loss_is(loss: float) -> None:
    class EitherSide(Reading):
        either_side: ClassVar[bool] = True

    class Stiffening(SpringStiffness):
        def read(self, modes: ModalEstimate, *_: object) -> Found:
            found = super().read(modes).reading
            assert found is not None
            return Found(modes, EitherSide(found.loss, found.covariance, found.common_covariance))

    for springs, is_announced in ((SpringStiffness(), loss > 0.0), (Stiffening(), True)):
        said = judged(springs, [modes((0, 0, 0))] * 3 + [modes((0, loss, 0))] * 3)[-1]
        assert not isinstance(said, Skipped)
        assert (said.alarm.level is not Level.NORMAL) == is_announced
