"""Witnesses of a diagnosis: what sensors of another quantity or axis say about the model that the floors' accelerations gave.

They enter no likelihood.  A gyroscope about the horizontal axis across the motion (y) sees whether joints turn as the model's
joints do, and whether the ground rocks; one about the vertical axis, whether a mode twists a floor; an accelerometer of another
axis, whether a mode moves that way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np

from monitor.core import Array, ComplexArray, encode
from monitor.diagnosis.parameter_uncertainty import DIFFERS_STDS
from monitor.diagnosis.story_forces import true_motion
from monitor.diagnosis.witness_record import WitnessRecord, WitnessSensor, WitnessTransforms
from monitor.model import Condition, Context, MatrixStructure, Model, ShearFrame, interval
from monitor.signals import MAIN_LOBE_BINS

_SEGMENT_PERIODS = 20.0
"""Length of a segment, in periods of the lowest mode. [1; judgement: modes a tenth apart are told apart, and short segments
give many]"""
_LEAST_JACKKNIFE = 6
"""Fewest segments that tell a standard deviation. [segments; judgement]"""
_FACTOR = 2.0
"""Factor within which a rotation is as the model says. [ratio; judgement: where on a joint a sensor sits, and how wide joints
are, changes it by some ten percent, and without flexible joints it would be nothing]"""
_RIGID = 0.05
"""Rotation over that of the chord of the columns, up to which joints count as rigid. [ratio; judgement: joints that turn so
much take about as large a share of a story's stiffness]"""
_AGREES_STDS = 2.0
"""Half width of the intervals that are stated, and within which a witness agrees. [standard deviations; convention: 95 %]"""

NOT_DETERMINED = 1e300
"""Standard deviation where none can be told. [1; definition: JSON has no infinity]"""

_SEES = {
    ("acceleration", "x"): ("motion along x", "a mode along x"),
    ("acceleration", "y"): ("motion across (y)", "a mode of the other direction"),
    ("acceleration", "z"): ("motion up and down", "a vertical mode"),
    ("rotation_rate", "x"): ("rocking across (about x)", "a mode that rocks across"),
    ("rotation_rate", "y"): ("rocking (about y)", "a mode that rocks"),
    ("rotation_rate", "z"): ("twist", "a mode of torsion"),
}
"""What a sensor of a quantity and an axis sees: the motion, and the kind of mode."""

Verdict = Literal["agrees", "contradicts", "cannot say"]
Motion = Annotated[ComplexArray, "segments bins"]


@dataclass(frozen=True, slots=True)
class WitnessedMode:
    """Motion of a witness over the motion of the structure in one mode."""

    of: str
    """``mode 1``, or the effect that has a frequency of its own, as ``unmodelled_mode``."""
    frequency_hz: float
    ratio: float
    """rad/m for a rotation, m/m for an acceleration.  With a sign where the model predicts it, else the magnitude."""
    std: float
    coherence: float
    """Coherent share of the witness's power in the mode's bins, 0 to 1."""
    predicted: float | None = None
    """The ratio by the extended model; None where a model says nothing."""
    predicted_before: float | None = None
    """The ratio by the model without the causes."""


@dataclass(frozen=True, slots=True)
class Witness:
    """What one sensor says."""

    sensor: WitnessSensor
    verdict: Verdict | None
    """None where the model claims nothing that the sensor could see."""
    says: str
    modes: tuple[WitnessedMode, ...] = ()
    against: tuple[str, ...] = ()
    """Names of the effects of the model that it contradicts."""

    @classmethod
    def silent(cls, sensor: WitnessSensor, why: str) -> Self:
        """Make a witness that cannot say anything."""
        return cls(sensor, "cannot say", f"{sensor.channel} cannot say: {why}")

    def to_plain(self) -> dict[str, Any]:
        """Return the entry of diagnosis.json."""
        unit, sensor = "rad/m" if self.sensor.turns else "m/m", encode(self.sensor, omit=("mounted",))
        return {**sensor, "verdict": self.verdict, "says": self.says, "unit": unit, "modes": encode(self.modes)}


def compare_witnesses(
    record: WitnessRecord,
    sensors: Sequence[WitnessSensor],
    before: Model,
    extended: Model,
    context: Context,
    condition: Condition,
) -> list[Witness]:
    """Compare what every witness measured with what the models say of it.

    `before` and `extended` are the refitted model without the causes and with them; `condition` is the motion and the temperature
    at which effects of sensors act.
    """
    if not sensors:
        return []
    modes = extended.modes()
    data = record.transforms(_SEGMENT_PERIODS / float(modes.frequencies_hz[0]))
    # Where the rate is so low that no mode lies in the band, there are hardly any bins.
    if data is None or len(data.floors) < _LEAST_JACKKNIFE or len(data.hz) <= 2 * MAIN_LOBE_BINS:
        why = "too few segments of the recording hold the floors, the witnesses and a mode at one rate"
        return [Witness.silent(sensor, why) for sensor in sensors]
    comparison = _Comparison(data, before, extended, context, condition)
    return [comparison.judge(sensor) for sensor in sensors]


class _Comparison:
    """Comparison of witnesses with the floors' motion and the models."""

    def __init__(
        self, data: WitnessTransforms, before: Model, extended: Model, context: Context, condition: Condition
    ) -> None:
        self.data, self.before, self.extended, self.context = data, before, extended, context
        true = true_motion(data.floors, extended.effects, data.hz, context, condition)
        self.floors = true if data.ground is None else true - data.ground[:, :, None]
        self.modes, self.structure = extended.modes(), extended.structure
        last_hz = float(data.hz[-1 - MAIN_LOBE_BINS])
        self.numbers = [k for k, hz in enumerate(self.modes.frequencies_hz.tolist()) if hz < last_hz]
        # Modes and oscillators that effects add.
        own = [(e.name, e.values().get("frequency_hz")) for e in extended.effects if e.family == "structure"]
        self.others = [(name, hz) for name, hz in own if hz is not None and hz < last_hz]

    def judge(self, sensor: WitnessSensor) -> Witness:
        """Compare one witness with the models."""
        if sensor.channel not in self.data.witnesses:
            return Witness.silent(sensor, "the recording does not have it, or at another rate")
        if sensor.channel in self.data.still:
            return Witness.silent(sensor, "it does not move")
        is_frame = isinstance(self.structure, ShearFrame)
        is_dof = isinstance(self.structure, MatrixStructure) and sensor.floor > 0
        if sensor.turns and (sensor.axis == "y" if is_frame else is_dof):
            if is_frame and self.structure.story_heights_m is None:
                return Witness.silent(sensor, "angles of joints and columns need story_heights_m in the structure file")
            return self._judge_rotation_in_modes(sensor)
        return self._judge_motion_in_modes(sensor)

    def _judge_rotation_in_modes(self, sensor: WitnessSensor) -> Witness:
        """Judge a rotation that the model predicts: of a joint, of the ground or of a degree of freedom."""
        measured, chord = [], []
        for k in self.numbers:
            weights, moved, one_chord = self._reference(sensor, k)
            if moved == 0.0:
                continue
            hz = float(self.modes.frequencies_hz[k])
            reference = self.floors @ weights / -(self._omega**2)
            ratio, std, coherence = _transfer(self._motion(sensor), reference, self._bins(hz), signed=True)
            by_model = [self._predicted(model, sensor, hz, weights) for model in (self.extended, self.before)]
            measured.append(WitnessedMode(f"mode {k + 1}", hz, ratio, std, coherence, *by_model))
            chord.append(one_chord)
        if not measured:
            return Witness.silent(sensor, "no mode lies in the band")
        # Of modes in which the structure moves little there, hardly anything is told.
        scales = [max(c or 0.0, abs(m.predicted or 0.0)) or 1.0 for m, c in zip(measured, chord, strict=True)]
        best = int(np.argmin([m.std / scale for m, scale in zip(measured, scales, strict=True)]))
        verdict, words = _judge_rotation(sensor, measured[best], chord[best])
        turning = verdict == "contradicts" and measured[best].predicted != measured[best].predicted_before
        against = tuple(e.name for e in self.extended.effects if turning and e.column_to_girder)
        return Witness(sensor, verdict, words, tuple(measured), against)

    def _reference(self, sensor: WitnessSensor, k: int) -> tuple[Annotated[Array, "c"], float, float | None]:
        """Choose the motion over which the rotation in mode k is stated.

        Return the weights of the channels, exact where they tell the motion, else by the mode's shape; the motion in the model's
        mode of unit modal mass, m; and the rotation of the columns' chord, rad per m of the motion, None without columns.
        """
        shape, sensors = self.modes.shapes[:, k], self.context.sensors
        if not isinstance(self.structure, ShearFrame):
            seen = sensors @ shape
            weights = np.zeros(len(sensors))
            weights[int(np.abs(seen).argmax())] = 1.0
            return weights, float(np.abs(seen).max()), None
        heights = self.structure.story_heights_m
        assert heights is not None, "refused before"
        row = self.structure.drift_matrix()[sensor.floor - 1] if sensor.floor else np.eye(len(shape))[0]
        chord = 1.0 / float(heights[sensor.floor - 1] if sensor.floor else heights.sum())
        weights, *_ = np.linalg.lstsq(sensors.T, row, rcond=None)
        if not np.allclose(sensors.T @ weights, row, atol=1e-9):
            seen = sensors @ shape
            weights = float(row @ shape) * seen / float(seen @ seen)
        return weights, float(row @ shape), chord

    def _predicted(
        self, model: Model, sensor: WitnessSensor, hz: float, weights: Annotated[Array, "c"]
    ) -> float | None:
        """Predict the rotation over the reference motion in the model's mode nearest to a frequency, rad/m."""
        modes = model.modes()
        shape = modes.shapes[:, int(np.abs(np.log(modes.frequencies_hz / hz)).argmin())]
        moved = float(weights @ self.context.sensors @ shape)
        structure = model.altered_structure()
        if sensor.floor == 0:
            return 0.0  # no effect of the catalogue lets the ground turn
        if moved == 0.0:
            return None
        if isinstance(structure, ShearFrame):
            turned = float(structure.girder_rotation(sensor.floor, sensor.mounted) @ shape)
            return turned / moved if turned else 0.0
        return float(shape[sensor.floor - 1]) / moved

    def _judge_motion_in_modes(self, sensor: WitnessSensor) -> Witness:
        """Judge a motion that the model does not describe: which modes are of the sensor's axis."""
        on_floor = np.flatnonzero(self.context.sensors[:, sensor.floor - 1]) if sensor.floor else np.zeros(0)
        own = self.floors[:, :, int(on_floor[0])] if on_floor.size else None
        rows = [(f"mode {k + 1}", float(self.modes.frequencies_hz[k])) for k in self.numbers]
        rows += self.others
        found = []
        for name, hz in rows:
            bins = self._bins(hz)
            largest = int((np.abs(self.floors[:, bins]) ** 2).sum(axis=(0, 1)).argmax())
            moved = self.floors[:, :, largest] if own is None else own
            told = _transfer(self._motion(sensor), moved / -(self._omega**2), bins, signed=False)
            found.append(WitnessedMode(name, hz, *told))
        verdict, words = _judge_other_motion(sensor, found, 3.0 * float(self.data.hz[1]))
        return Witness(sensor, verdict, words, tuple(found))

    @property
    def _omega(self) -> Annotated[Array, "bins"]:
        """Circular frequencies of the bins, rad/s; that of 0 Hz as of the next."""
        return np.asarray(2.0 * np.pi * np.maximum(self.data.hz, self.data.hz[1]))

    def _motion(self, sensor: WitnessSensor) -> Motion:
        """Integrate a witness's readings to rad or m."""
        readings, omega = self.data.witnesses[sensor.channel], self._omega
        return np.asarray(readings / (1j * omega) if sensor.turns else readings / -(omega**2))

    def _bins(self, hz: float) -> slice:
        at = round(hz / float(self.data.hz[1]))
        return slice(max(1, at - MAIN_LOBE_BINS), at + MAIN_LOBE_BINS + 1)


def _transfer(turned: Motion, moved: Motion, bins: slice, *, signed: bool) -> tuple[float, float, float]:
    """Estimate the ratio of two motions in a mode's bins: the part in phase where `signed`, else the magnitude.

    Return it, its standard deviation by the jackknife over the segments, and the coherent share of the first motion's power.

    References
    ----------
    J. S. Bendat, A. G. Piersol, Random Data, 4th edition, section 6.2 (frequency response and coherence).
    """
    a, b = turned[:, bins], moved[:, bins]
    cross = (a * b.conj()).sum(axis=1)
    power, own = (np.abs(b) ** 2).sum(axis=1), (np.abs(a) ** 2).sum(axis=1)
    if not (power.sum() > power.max() and own.any()):  # nothing moves, or in one segment alone
        return 0.0, NOT_DETERMINED, 0.0
    whole = complex(cross.sum() / power.sum())
    left_out = (cross.sum() - cross) / (power.sum() - power)
    n = len(cross)
    parts = left_out.real if signed else np.abs(left_out)
    coherence = float(np.abs(cross.sum()) ** 2 / (power.sum() * own.sum()))
    return whole.real if signed else abs(whole), float(np.sqrt(n - 1.0) * parts.std()), coherence


def _judge_rotation(sensor: WitnessSensor, mode: WitnessedMode, chord: float | None) -> tuple[Verdict, str]:
    """Compare a measured rotation with the predicted one, and with that of rigid joints."""
    predicted, floor = mode.predicted or 0.0, sensor.floor
    seen = f"in {mode.of} ({mode.frequency_hz:.2f} Hz, coherence {mode.coherence:.2f})"
    if floor == 0:
        subject, over = "the ground rocks", "of the top floor's motion"
    elif chord is None:
        subject, over = f"degree of freedom {floor} turns", "of the channel that moves most"
    else:
        subject, over = f"floor {floor} turns", f"of story {floor}'s drift"
    size = interval({"value": mode.ratio, "std": mode.std}, 1.0, "rad per m")
    measured = f"{subject} by {size} {over} {seen}"
    if chord is not None and abs(predicted) <= _RIGID * chord:
        share = abs(mode.ratio) / chord
        verdict = _placed(share, mode.std / chord, -np.inf, _RIGID)
        whole = f"{100.0 * share:.1f} % of the turn of {'the frame' if floor == 0 else 'its columns'}"
        model = "a ground that does not turn" if floor == 0 else "rigid joints"
        return verdict, f"{measured}, {whole}; the model has {model}: {sensor.channel} {verdict}"
    if predicted == 0.0:
        return "cannot say", f"{measured}; the model says nothing of it: {sensor.channel} cannot say"
    verdict = _placed(mode.ratio / predicted, mode.std / abs(predicted), 1.0 / _FACTOR, _FACTOR)
    place = " in the middle of a girder" if sensor.mounted == "midspan" else ""
    cause = "the model's joints" if chord is not None else "the model's shape"
    before = "" if mode.predicted_before is None else f", {mode.predicted_before:.3g} without the causes"
    says = f"{measured}; {cause} predict {predicted:.3g}{place}{before}: {sensor.channel} {verdict}"
    if verdict == "contradicts" and chord is not None and abs(mode.ratio) < abs(predicted):
        says += ": what turns is not the floor, but its columns in their connections, or another cause looks alike"
    return verdict, says.replace("shape predict", "shape predicts")


def _placed(value: float, std: float, low: float, high: float) -> Verdict:
    """Say whether a value lies within bounds, or outside them; to contradict takes more certainty than to agree."""
    if low < value - _AGREES_STDS * std and value + _AGREES_STDS * std < high:
        return "agrees"
    outside = value + DIFFERS_STDS * std < low or value - DIFFERS_STDS * std > high
    return "contradicts" if outside else "cannot say"


def _judge_other_motion(
    sensor: WitnessSensor, found: Sequence[WitnessedMode], apart_hz: float
) -> tuple[Verdict | None, str]:
    """Say which modes move in the sensor's axis, and whether those do that the model does not have."""
    what = f"{_SEES[sensor.quantity, sensor.axis][0]} of {f'floor {sensor.floor}' if sensor.floor else 'the ground'}"
    own = [m for m in found if m.of.startswith("mode ")]
    others = [m for m in found if m not in own]
    largest = max(own, key=lambda m: m.ratio, default=None)
    usual = ""
    if largest is not None:
        usual = f"in the model's modes at most {largest.ratio:.2g} {_unit(sensor)} ({largest.of})"
    if not others:
        rest = f"the model has no mode besides that {sensor.channel} could see"
        return None, f"{what}: {usual or 'no mode lies in the band'}; {rest}"
    # A mode of the other direction moves more that way than this.  What a twist is, only the model's own modes tell, and of
    # them what is certain: where the structure moves little, noise makes any ratio.
    certain = max((m.ratio - DIFFERS_STDS * m.std for m in own), default=0.0)
    least = 1.0 if sensor.quantity == "acceleration" else _FACTOR * max(certain, 0.0)
    told = [_judge_other_mode(sensor, mode, own, apart_hz, least) for mode in others]
    verdicts = [v for v, _ in told]
    whole: Verdict = next((v for v in ("agrees", "contradicts") if v in verdicts), "cannot say")
    return whole, f"{what}: {'; '.join(w for _, w in told)}" + (f"; {usual}" if usual else "")


def _judge_other_mode(
    sensor: WitnessSensor, mode: WitnessedMode, own: Sequence[WitnessedMode], apart_hz: float, least: float
) -> tuple[Verdict, str]:
    """Say whether a mode that is none of the model's `own` is of the sensor's axis, and so moves by `least` that way."""
    name = f"the {mode.of.replace('_', ' ')} at {mode.frequency_hz:.2f} Hz"
    near = next((m for m in own if abs(m.frequency_hz - mode.frequency_hz) < apart_hz), None)
    if near is not None:
        return "cannot say", f"{name} is too near to {near.of} to be told from it"
    verdict = _placed(mode.ratio, mode.std, least, np.inf)
    if verdict == "agrees" and mode.ratio - DIFFERS_STDS * mode.std < least:  # a magnitude of noise is never 0
        verdict = "cannot say"
    ratio = interval({"value": mode.ratio, "std": mode.std}, 1.0, _unit(sensor))
    says = {"agrees": ": it is", "contradicts": ": it is not", "cannot say": ", which does not tell whether it is"}
    return (
        verdict,
        f"in {name} {ratio} (coherence {mode.coherence:.2f}){says[verdict]} {_SEES[sensor.quantity, sensor.axis][1]}",
    )


def _unit(sensor: WitnessSensor) -> str:
    return "rad per m" if sensor.turns else "m per m"


def contradictions(witnesses: Sequence[Witness]) -> str:
    """State which witness contradicts the model, as a sentence to go on with; empty if none does."""
    against = [witness.says for witness in witnesses if witness.verdict == "contradicts"]
    if not against:
        return ""
    others = f" (and {len(against) - 1} more)" if len(against) > 1 else ""
    return f" A sensor that entered no fit contradicts this: {against[0]}{others}."
