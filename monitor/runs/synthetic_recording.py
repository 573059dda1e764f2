"""Writes the motions of the simulator as recordings."""

from __future__ import annotations

import heapq
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Annotated, cast, get_args

import numpy as np

from drivers.base import ACCELERATION, FORCE, GROUND, ROTATION_RATE, TEMPERATURE, SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import Configuration, SensorTable
from monitor.core import Array, BadConfigurationError, OnProgress, Step, os_errors_of
from monitor.model import (
    Building,
    Effect,
    EffectError,
    ExcitationKind,
    Model,
    Motion,
    ShearFrame,
    parse_effect,
    simulate,
    story_damage,
)

_WRITES = "writes the recording"
_TEMPERATURE_HZ = 1.0


@dataclass(frozen=True, slots=True)
class TemperatureCycle:
    """Periodic temperature: mean - swing / 2 cos(2 pi t / period_s)."""

    mean_degc: float
    swing_k: float
    """Difference between the highest and the lowest temperature."""
    period_s: float
    reference_degc: float
    """Temperature at which the stiffness is that of the structure file."""

    @classmethod
    def parse(cls, text: str | None, duration_s: float) -> TemperatureCycle:
        """Parse ``MEAN[,SWING[,PERIOD[,REFERENCE]]]`` (degC, K, s, degC); ValueError for another form.

        The defaults are a mean of 20 degC, a swing of 10 K, one period in `duration_s`, and the mean as reference.

        Examples
        --------
        >>> TemperatureCycle.parse("15,8", duration_s=86400.0)
        TemperatureCycle(mean_degc=15.0, swing_k=8.0, period_s=86400.0, reference_degc=15.0)
        """
        parts = (text or "20").split(",")
        try:
            values = [float(part) for part in parts]
            mean, swing, period, reference = [*values, *[20.0, 10.0, duration_s, values[0]][len(values) :]]
        except ValueError:
            raise ValueError(f"--temperature {text!r}: expected MEAN[,SWING[,PERIOD_S[,REFERENCE]]]") from None
        if not (all(isfinite(value) for value in values) and swing >= 0.0 and period > 0.0):
            raise ValueError(f"--temperature {text!r}: needs finite numbers, SWING >= 0, PERIOD_S > 0")
        return cls(mean, swing, period, reference)

    def degc(self, n: int, rate_hz: float) -> Annotated[Array, "n"]:
        """Compute the temperature of `n` samples at `rate_hz`."""
        turn = 2.0 * np.pi / (rate_hz * self.period_s)
        return np.asarray(self.mean_degc - 0.5 * self.swing_k * np.cos(turn * np.arange(n)))


def cut_into_blocks(
    topic: str,
    values: Annotated[Array, "samples channels"],
    channels: tuple[str, ...],
    rate_hz: float,
    t0_ns: int,
    block_n: int,
    first: int = 0,
    unit: str = "m/s^2",
) -> Iterator[SampleBlock]:
    """Cut samples into blocks of `block_n` samples; the last block may be shorter.

    `t0_ns` is the UTC of the sample with sequence number 0, `first` the sequence number of the first sample.
    """
    for start in range(0, values.shape[0], block_n):
        t_ns = t0_ns + round((first + start) / rate_hz * 1e9)
        yield SampleBlock(
            topic, t_ns, first + start, rate_hz, channels, unit, values[start : start + block_n].astype(np.float32)
        )


def parse_damage(text: str) -> Effect:
    """Parse ``storyN=LOSS``, or a building's ``storeyNx=LOSS``, as an effect (else EffectError).

    LOSS is the relative loss of stiffness, from 0 to below 1; a building's direction is x, y or torsion.

    Examples
    --------
    >>> parse_damage("story2=0.1").location
    'story 2'
    >>> parse_damage("storey2y=0.1").location
    'storey 2 y'
    """
    match = re.fullmatch(r"(?:story ?(\d+)|storey ?(\d+) ?(x|y|torsion))=([0-9.eE+-]+)", text)
    try:
        loss = float(match[4]) if match else np.nan
    except ValueError:
        loss = np.nan
    if match is None or not 0.0 <= loss < 1.0:
        raise EffectError(
            f"--damage {text!r}: expected storyN=LOSS with 0 <= LOSS < 1, as story1=0.2; of a building storeyNx=LOSS, x, y or "
            "torsion, as storey2y=0.1"
        )
    return story_damage(f"story {int(match[1])}" if match[1] else f"storey {int(match[2])} {match[3]}", loss)


def write_simulated_recording(
    out: Path,
    config: Configuration,
    *,
    duration_s: float,
    excitation: str,
    noise: float,
    damage: list[str],
    effects: list[str],
    rate_hz: float,
    level_spread: float,
    t0_ns: int,
    seed: int,
    temperature: str | None = None,
    on_progress: OnProgress = lambda _: None,
) -> None:
    """Write a simulated recording, with the truth in its metadata; noise and level spread are as of `monitor.model.simulate`.

    The kinds of excitation are those of `monitor.model.ExcitationKind`.  Damage, effects and temperature are texts as of
    `parse_damage`, `monitor.model.parse_effect` and `TemperatureCycle.parse`; no temperature is simulated by default, unless an
    effect needs one.  `t0_ns` is the UTC of the first sample.

    Raises BadConfigurationError if one of the texts cannot be understood, MissingInputError if the file cannot be written.
    """
    if excitation not in get_args(ExcitationKind):
        raise BadConfigurationError(f"--excitation {excitation!r}: one of {', '.join(get_args(ExcitationKind))}")
    on_progress(Step("computes the motion", then=_WRITES))
    try:
        model = config.model()
        planted = [*map(parse_damage, damage), *map(parse_effect, effects)]
        truth = require_stable(replace(model, effects=(*model.effects, *planted)), config.channels)
        n_samples = round(duration_s * rate_hz) if isfinite(duration_s) else 0
        if n_samples <= 0:
            raise ValueError(f"--duration {duration_s:g}: not even one sample at {rate_hz:g} Hz")
        weather = None
        if temperature is not None or any(e.temperature_lag_s is not None for e in truth.effects):
            weather = TemperatureCycle.parse(temperature, duration_s)
        motion = simulate(
            truth,
            duration_s=duration_s,
            rate_hz=rate_hz,
            excitation=cast(ExcitationKind, excitation),
            noise=noise,
            level_spread=level_spread,
            seed=seed,
            context=config.instrumented().context(rate_hz),
            excess_degc=None if weather is None else weather.degc(n_samples, rate_hz) - weather.reference_degc,
            forced=config.forced,
            turning=_turning(config, truth),
        )
    except ValueError as error:  # includes EffectError
        raise BadConfigurationError(str(error)) from error
    metadata = {
        "structure": config.structure.model_dump_json(),
        "storeys": json.dumps([s.model_dump(mode="json") for s in config.storeys]),
        "effects": json.dumps([{"effect": e.name, "location": e.location, **e.values()} for e in planted]),
        "excitation": excitation,
        "noise": repr(noise),
        "level_spread": repr(level_spread),
        "seed": str(seed),
    }
    if weather is not None:
        metadata["reference_degc"] = repr(weather.reference_degc)
    with os_errors_of(out, "cannot be written: "), McapWriter(out, {"simulated": metadata}) as writer:
        for block in _sample_blocks(motion, config, weather, t0_ns):
            writer.write(block)
            if block.topic == ACCELERATION:
                done_s = (block.t_ns - t0_ns) * 1e-9 + block.length_s
                on_progress(Step(_WRITES, done_s / 60.0, duration_s / 60.0, "min of data"))


def _turning(config: Configuration, truth: Model) -> Annotated[Array, "g n"] | None:
    """Compute the rotation at each gyroscope by the floors' displacements, rad/m; None where the model tells none.

    Joints of a frame turn about y, by the bending of columns and girders; of another structure a degree of freedom may be a
    rotation.  The model knows no other one, and without the stories' heights no angle.
    """
    gyroscopes, frame = _gyroscopes(config), truth.structure
    if not gyroscopes or (isinstance(frame, ShearFrame) and frame.story_heights_m is None):
        return None
    structure = truth.altered_structure()
    out = np.zeros((len(gyroscopes), structure.n_dofs))
    for row, sensor in zip(out, gyroscopes, strict=True):
        if not sensor.floor:
            continue
        if isinstance(structure, Building):
            if sensor.axis == "z":
                row[:] = structure.turn_row(sensor.floor)
        elif not isinstance(structure, ShearFrame):
            row[sensor.floor - 1] = 1.0
        elif sensor.axis == "y":
            row[:] = structure.girder_rotation(sensor.floor, sensor.mounted)
    return out


def _gyroscopes(config: Configuration) -> list[SensorTable]:
    return [sensor for sensor in config.witnesses if sensor.quantity == "rotation_rate"]


def require_stable(truth: Model, channels: tuple[str, ...]) -> Model:
    """Return the model if its effects fit and its stiffness matrix is positive definite; ValueError otherwise."""
    for effect in truth.effects:
        effect.check(truth.structure, channels)
    if np.linalg.eigvalsh(truth.stiffness_matrix()).min() <= 0:
        places = ", ".join(e.location for e in truth.effects)
        raise ValueError(f"a structure that lost so much ({places}) would not stand")
    return truth


def _sample_blocks(
    motion: Motion, config: Configuration, weather: TemperatureCycle | None, t0_ns: int
) -> Iterator[SampleBlock]:
    """Cut accelerations, inputs, rates of rotation and temperature into blocks of one second, in time order."""
    rate_hz, n_samples = motion.rate_hz, len(motion.floors)
    block_n = max(1, round(rate_hz))
    streams = [cut_into_blocks(ACCELERATION, motion.floors, config.channels, rate_hz, t0_ns, block_n)]
    if motion.ground is not None:
        streams.append(cut_into_blocks(GROUND, motion.ground[:, None], ("ground",), rate_hz, t0_ns, block_n))
    if motion.force is not None:
        names = tuple(i.channel for i in config.inputs)
        streams.append(cut_into_blocks(FORCE, motion.force, names, rate_hz, t0_ns, block_n, unit="N"))
    if motion.rotation_rate is not None:
        names = tuple(sensor.channel for sensor in _gyroscopes(config))
        rates = motion.rotation_rate
        streams.append(cut_into_blocks(ROTATION_RATE, rates, names, rate_hz, t0_ns, block_n, unit="rad/s"))
    if weather is not None:
        degc = weather.degc(int((n_samples - 1) / rate_hz * _TEMPERATURE_HZ) + 1, _TEMPERATURE_HZ)
        streams.append(cut_into_blocks(TEMPERATURE, degc[:, None], ("air",), _TEMPERATURE_HZ, t0_ns, 1, unit="degC"))
    return heapq.merge(*streams, key=lambda block: block.t_ns)
