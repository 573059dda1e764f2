"""What stands from the start is no news later, whether or not calibration could name it for certain or at all."""

from __future__ import annotations

import pytest

from drivers.base import ACCELERATION
from monitor.diagnose import diagnose
from monitor.diagnosis_files import content as content_of
from monitor.discrepancy import learn
from monitor.effects import Context, Effect, parse_effect
from monitor.evidence import classify
from monitor.gain import Gain
from monitor.model import Model
from monitor.publish.report import page
from monitor.record import blocks_of
from monitor.segments import Segments, gather
from monitor.simulate import simulate
from tests.test_polish import CONFIG, RATE

COLOUR = "coloured_excitation:frame:corner_hz=12"
GAINS = ("sensor_gain:channel a1:gain=1.015", "sensor_gain:channel a2:gain=0.985")


def forces(share: float, more: float) -> str:
    """Falling ever faster, but for a hump at 8 Hz, and pushing floors together."""
    rises = (f"rise_{i}={(0.3 if i == 10 else -0.3 - 0.3 * (i > 10)) + more}" for i in range(1, 16))
    return f"ambient_forces:frame:common_share={share}," + ",".join(rises)


FORCES, ANOTHER_DAY = forces(0.3, 0.0), forces(0.33, 0.06)
CONTEXT = Context(CONFIG.model().structure, CONFIG.channels, CONFIG.sensor_matrix(), RATE)


def recorded(seed: int, *effects: str) -> Segments:
    """Ten minutes."""
    present: tuple[Effect, ...] = tuple(map(parse_effect, effects))
    motion = simulate(
        Model(CONFIG.model().structure, present),
        duration_s=600.0,
        rate_hz=RATE,
        noise=0.02,
        level_spread=0.0,
        seed=seed,
        context=CONTEXT,
    )
    return gather(blocks_of(ACCELERATION, motion.floors, CONFIG.channels, RATE, 10**18, 128), CONFIG)


@pytest.mark.parametrize("standing", [(COLOUR, *GAINS), (FORCES,)], ids=["colour and gains", "forces of every day"])
def test_what_calibration_cannot_tell_apart_is_no_news_later(standing: tuple[str, ...]) -> None:
    known = learn(recorded(1, *standing), CONFIG)
    assert ("ambient_forces" in [e.name for e in known.model.effects]) == (standing == (FORCES,))
    another_day = tuple(ANOTHER_DAY if e == FORCES else e for e in standing)
    segments = recorded(2, *another_day)
    clean = diagnose(classify(segments), known, CONTEXT, CONFIG.diagnosis)
    assert clean.verdict == "none"
    shown = page(clean, content_of(clean, Gain(), (), {"without": [], "with": []}), segments)
    assert ("forces on the floors at calibration" in shown, "rise_1" in shown) == (standing == (FORCES,), False)
    loss = diagnose(
        classify(recorded(3, *standing, "stiffness_change:story 2:relative=-0.06")), known, CONTEXT, CONFIG.diagnosis
    )
    assert [(c.effect.name, c.effect.location) for c in loss.causes] == [("stiffness_change", "story 2")]
