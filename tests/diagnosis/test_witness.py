"""Witnesses: gyroscopes and accelerometers of other axes say whether what the floors' accelerations named is so."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base import ACCELERATION, GROUND, ROTATION_RATE, SampleBlock
from monitor.diagnosis.witness import Witness, compare_witnesses, contradictions
from monitor.diagnosis.witness_record import WitnessRecord, WitnessSensor
from monitor.model import FORMS, Condition, Context, MatrixStructure, Model, ShearFrame, simulate
from monitor.signals import FrontEnd, ProcessingSettings

Array = NDArray[np.float64]
RATE, T0_NS = 100.0, 1_767_225_600_000_000_000
FRAME = ShearFrame(np.full(3, 0.3), np.full(3, 2000.0), 0.01, np.full(3, 0.1))
JOINTS = FORMS["joint_flexibility"].create("frame", {"girder_to_column_ratio": 3.0})
TRUTH = Model(FRAME, (JOINTS,))
FRONT_END = FrontEnd(("a1", "a2", "a3"), ProcessingSettings(), segment_s=20.0, n_lags=20)
CONTEXT = Context(FRAME, FRONT_END.channels, np.eye(3), RATE)
STILL = Condition(np.zeros(3), np.zeros(3), np.zeros(3), np.ones(3))
GYRO = WitnessSensor("r2", "rotation_rate", "y", 2)
RNG = np.random.default_rng


def integrated(values: Array) -> Array:
    """Integrate samples along the first axis, of zero mean."""
    hz = np.fft.rfftfreq(len(values), 1.0 / RATE)[1:, None]
    spectrum = np.fft.rfft(values, axis=0)
    spectrum[1:] /= 2j * np.pi * hz
    spectrum[0] = 0.0
    return np.fft.irfft(spectrum, len(values), axis=0)


def blocks(streams: dict[str, tuple[tuple[str, ...], Array, str]], size: int = 100) -> Iterator[SampleBlock]:
    """Cut all streams, channels and samples and unit by topic, into blocks in time order."""
    n = len(next(iter(streams.values()))[1])
    for first in range(0, n, size):
        for topic, (names, values, unit) in streams.items():
            part = values[first : first + size].astype(np.float32)
            yield SampleBlock(topic, T0_NS + round(first / RATE * 1e9), first, RATE, names, unit, part)


def floors(seed: int, ground: bool = False) -> tuple[Array, Array | None]:
    motion = simulate(TRUTH, duration_s=90.0, rate_hz=RATE, excitation="ground" if ground else "ambient", seed=seed)
    return motion.floors, motion.ground


def judge(
    streams: dict[str, tuple[tuple[str, ...], Array, str]],
    *sensors: WitnessSensor,
    extended: Model = TRUTH,
    before: Model | None = None,
    size: int = 100,
) -> list[Witness]:
    record = WitnessRecord(FRONT_END, sensors)
    for block in blocks(streams, size):
        record.add(block)
    return compare_witnesses(record, sensors, before or Model(FRAME), extended, CONTEXT, STILL)


def shaken(turned: float, noise: float = 0.0, ground: bool = False) -> dict[str, tuple[tuple[str, ...], Array, str]]:
    """The frame with flexible joints, whose floor 2 turns `turned` times as much as its model says, beside noise."""
    moved, table = floors(3, ground)
    relative = moved if table is None else moved - table[:, None]
    joints = integrated(relative) @ TRUTH.altered_structure().joint_rotations().T
    rate = turned * joints[:, [1]] + noise * joints[:, [1]].std() * RNG(5).standard_normal((len(moved), 1))
    out = {ACCELERATION: (FRONT_END.channels, moved, "m/s^2"), ROTATION_RATE: (("r2",), rate, "rad/s")}
    if table is not None:
        out[GROUND] = (("ground",), table[:, None], "m/s^2")
    return out


@pytest.mark.parametrize("ground", [False, True])
def test_joints_that_turn_as_named_are_confirmed_in_every_mode(ground: bool) -> None:
    (told,) = judge(shaken(1.0, 0.1, ground), GYRO)
    assert told.verdict == "agrees"
    assert len(told.modes) == 3
    for mode in told.modes:
        assert mode.predicted == pytest.approx(mode.ratio, abs=max(4.0 * mode.std, 0.05 * abs(mode.ratio)))
        assert mode.predicted_before == 0.0
    assert told.modes[0].coherence > 0.95
    assert "the model's joints predict" in told.says and told.says.endswith("r2 agrees")


def test_joints_that_turn_ten_times_less_contradict_what_is_named() -> None:
    (told,) = judge(shaken(0.1, 0.1), GYRO)
    assert told.verdict == "contradicts" and told.against == ("joint_flexibility",)
    assert told.modes[0].ratio == pytest.approx(0.1 * (told.modes[0].predicted or 0.0), rel=0.2)
    said = contradictions([replace(told, verdict="agrees"), told, told])
    assert said == f" A sensor that entered no fit contradicts this: {told.says} (and 1 more)."
    assert contradictions([replace(told, verdict="agrees")]) == ""


def test_noise_alone_cannot_say() -> None:
    (told,) = judge(shaken(0.0, 3000.0), GYRO)
    assert told.verdict == "cannot say"
    assert max(mode.coherence for mode in told.modes) < 0.3


def test_a_joint_that_turns_where_the_model_is_rigid_contradicts_it() -> None:
    rigid = Model(FRAME)
    assert judge(shaken(1.0), GYRO, extended=rigid)[0].verdict == "contradicts"
    quiet = judge(shaken(0.01), GYRO, extended=rigid)[0]
    assert quiet.verdict == "agrees" and "the model has rigid joints" in quiet.says


def test_the_middle_of_a_girder_turns_the_other_way_by_half() -> None:
    (told,) = judge(shaken(-0.5), replace(GYRO, mounted="midspan"))
    assert told.verdict == "agrees" and "in the middle of a girder" in told.says
    assert judge(shaken(-0.5), GYRO)[0].verdict == "contradicts"


def test_floors_without_a_sensor_are_told_by_the_shapes() -> None:
    streams = shaken(1.0)
    context = Context(FRAME, ("a1", "a3"), np.eye(3)[[0, 2]], RATE)
    record = WitnessRecord(replace(FRONT_END, channels=("a1", "a3")), [GYRO])
    for block in blocks(streams):
        record.add(block)
    (told,) = compare_witnesses(record, [GYRO], Model(FRAME), TRUTH, context, STILL)
    assert told.verdict == "agrees"
    assert told.modes[0].ratio == pytest.approx(told.modes[0].predicted, rel=0.05)


@pytest.mark.parametrize("ground", [False, True])
def test_a_reversed_channel_is_corrected_by_the_effect_that_was_named(ground: bool) -> None:
    streams = shaken(1.0, ground=ground)
    moved = streams[ACCELERATION][1] * [1.0, -1.0, 1.0]
    streams[ACCELERATION] = (FRONT_END.channels, moved, "m/s^2")
    turned = FORMS["sensor_polarity"].create("channel a2", {})
    assert judge(streams, GYRO)[0].verdict == "contradicts"
    assert judge(streams, GYRO, extended=Model(FRAME, (JOINTS, turned)))[0].verdict == "agrees"


def test_blocks_of_any_size_and_gaps_give_the_same_numbers_or_fewer_segments() -> None:
    streams = shaken(1.0, 0.3)
    (whole,), (pieces,) = judge(streams, GYRO), judge(streams, GYRO, size=37)
    assert whole == pieces
    record = WitnessRecord(FRONT_END, [GYRO])
    for block in blocks(streams):
        if not (block.topic == ROTATION_RATE and 3000 <= block.sequence < 4000):
            record.add(block)
    (holed,) = compare_witnesses(record, [GYRO], Model(FRAME), TRUTH, CONTEXT, STILL)
    assert holed.verdict == "agrees" and holed.modes[0].std != whole.modes[0].std


def test_what_the_recording_does_not_hold_cannot_say() -> None:
    absent, dead = replace(GYRO, channel="r9"), replace(GYRO, channel="r0")
    streams = shaken(1.0)
    names, values, unit = streams[ROTATION_RATE]
    streams[ROTATION_RATE] = ((*names, "r0"), np.column_stack([values, np.ones(len(values))]), unit)
    first, second = judge(streams, absent, dead)
    assert first.verdict == second.verdict == "cannot say"
    assert "does not have it" in first.says and "does not move" in second.says
    short = {topic: (names, values[:500], unit) for topic, (names, values, unit) in streams.items()}
    assert "too few segments" in judge(short, GYRO)[0].says


@pytest.mark.parametrize("rate_hz", [0.001, 50.0, 9e5])
def test_a_witness_of_another_rate_cannot_say_and_does_no_harm(rate_hz: float) -> None:
    record = WitnessRecord(FRONT_END, [GYRO])
    for block in blocks(shaken(1.0)):
        record.add(replace(block, sample_rate_hz=rate_hz) if block.topic == ROTATION_RATE else block)
    (told,) = compare_witnesses(record, [GYRO], Model(FRAME), TRUTH, CONTEXT, STILL)
    assert told.verdict == "cannot say" and "at another rate" in told.says


def test_a_ground_that_rocks_contradicts_the_model_and_one_that_does_not_agrees() -> None:
    moved, _ = floors(3)
    top = integrated(moved[:, [0]])
    for share, verdict in ((0.2, "contradicts"), (0.01, "agrees")):
        rate = share / 0.3 * top
        streams = {ACCELERATION: (FRONT_END.channels, moved, "m/s^2"), ROTATION_RATE: (("rg",), rate, "rad/s")}
        (told,) = judge(streams, WitnessSensor("rg", "rotation_rate", "y", 0))
        assert told.verdict == verdict, told.says
        assert told.modes[0].ratio == pytest.approx(share / 0.3, rel=0.05)


def beside(hz: float) -> tuple[Array, Array]:
    """Motion of a mode beside the frame's, and how it shows on the floors' channels."""
    oscillator = Model(ShearFrame(np.ones(1), np.array([(2 * np.pi * hz) ** 2]), 0.01))
    own = simulate(oscillator, duration_s=90.0, rate_hz=RATE, seed=8).floors
    moved, _ = floors(3)
    return own, moved + 0.3 * moved.std() / own.std() * own


def test_a_gyroscope_about_the_vertical_tells_torsion_from_a_mode_of_another_kind() -> None:
    own, moved = beside(7.5)
    mode = FORMS["unmodelled_mode"].create("frame", {"frequency_hz": 7.5, "damping_ratio": 0.01})
    extended = Model(FRAME, (JOINTS, mode))
    sensor = WitnessSensor("t1", "rotation_rate", "z", 1)
    noise = RNG(2).standard_normal((len(own), 1))
    pure, frame = integrated(own), integrated(floors(3)[0][:, [0]])
    twisted = 2.0 * pure / pure.std() + 0.01 * frame / frame.std() + 0.01 * noise
    planar = 0.5 * frame / frame.std() + 0.01 * noise
    streams = {ACCELERATION: (FRONT_END.channels, moved, "m/s^2"), ROTATION_RATE: (("t1",), twisted, "rad/s")}
    (told,) = judge(streams, sensor, extended=extended)
    assert told.verdict == "agrees" and "it is a mode of torsion" in told.says
    streams[ROTATION_RATE] = (("t1",), planar, "rad/s")
    (told,) = judge(streams, sensor, extended=extended)
    assert told.verdict == "contradicts" and "it is not a mode of torsion" in told.says
    assert judge(streams, sensor)[0].verdict is None


def test_an_accelerometer_across_tells_a_mode_of_the_other_direction() -> None:
    own, moved = beside(7.5)
    mode = FORMS["unmodelled_mode"].create("frame", {"frequency_hz": 7.5, "damping_ratio": 0.01})
    extended, sensor = Model(FRAME, (JOINTS, mode)), WitnessSensor("b1", "acceleration", "y", 1)
    size = moved.std() / own.std()
    for factor, verdict in ((3.0, "agrees"), (0.05, "contradicts")):
        across = np.column_stack([moved, factor * size * own])
        streams = {ACCELERATION: ((*FRONT_END.channels, "b1"), across, "m/s^2")}
        (told,) = judge(streams, sensor, extended=extended)
        assert told.verdict == verdict, told.says
        assert told.to_plain()["unit"] == "m/m"


def test_noise_or_a_mode_too_near_does_not_tell_what_kind_of_mode_it_is() -> None:
    own, moved = beside(7.5)
    sensor = WitnessSensor("t1", "rotation_rate", "z", 1)
    noise = 1e3 * RNG(2).standard_normal((len(own), 1))
    streams = {ACCELERATION: (FRONT_END.channels, moved, "m/s^2"), ROTATION_RATE: (("t1",), noise, "rad/s")}
    second = float(TRUTH.modes().frequencies_hz[1])
    for hz, words in (
        (7.5, "which does not tell whether it is a mode of torsion"),
        (second, "is too near to mode 2 to be told from it"),
    ):
        mode = FORMS["unmodelled_mode"].create("frame", {"frequency_hz": hz, "damping_ratio": 0.01})
        (told,) = judge(streams, sensor, extended=Model(FRAME, (JOINTS, mode)))
        assert told.verdict == "cannot say" and words in told.says


def test_a_rotation_that_is_a_degree_of_freedom_of_the_matrices_is_predicted_by_the_modes() -> None:
    # A cantilever of one element with a heavy head: sway and rotation.
    bending = 500.0 * np.array([[12.0, -6.0], [-6.0, 4.0]])
    head = MatrixStructure.create(np.diag([2.0, 0.1]), bending, bending[None] / 500.0, np.array([500.0]), 0.01)
    model = Model(head)
    moved = simulate(model, duration_s=90.0, rate_hz=RATE, seed=4).floors
    context = Context(head, ("a1",), np.array([[1.0, 0.0]]), RATE)
    sensor = WitnessSensor("r1", "rotation_rate", "y", 2)
    for factor, verdict in ((1.0, "agrees"), (0.1, "contradicts")):
        turned = (("r1",), factor * integrated(moved[:, [1]]), "rad/s")
        record = WitnessRecord(replace(FRONT_END, channels=("a1",)), [sensor])
        for block in blocks({ACCELERATION: (("a1",), moved[:, [0]], "m/s^2"), ROTATION_RATE: turned}):
            record.add(block)
        (told,) = compare_witnesses(record, [sensor], model, model, context, Condition(*np.zeros((4, 1))))
        assert told.verdict == verdict, told.says
        assert told.modes[0].ratio == pytest.approx(factor * (told.modes[0].predicted or 0.0), rel=0.05)
