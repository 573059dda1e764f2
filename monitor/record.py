"""Simulated recordings: the bridge from the simulator to recording files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from math import isfinite
from pathlib import Path
from typing import cast, get_args

import numpy as np

from drivers.base import ACCELERATION, GROUND, SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.effects import Effect, EffectError, StiffnessChange, parse_effect
from monitor.errors import BadConfigurationError, MissingInputError
from monitor.model import Model
from monitor.results import Array
from monitor.simulate import ExcitationKind, simulate


def blocks_of(
    topic: str, values: Array, channels: tuple[str, ...], rate_hz: float, t0_ns: int, block_n: int, first: int = 0
) -> Iterator[SampleBlock]:
    """Cut samples, shape (n_samples, n_channels), into blocks of `block_n`; `first` is the first one's sequence."""
    for start in range(0, values.shape[0], block_n):
        t_ns = t0_ns + round((first + start) / rate_hz * 1e9)
        yield SampleBlock(
            topic, t_ns, first + start, rate_hz, channels, "m/s^2", values[start : start + block_n].astype(np.float32)
        )


def parse_damage(text: str) -> StiffnessChange:
    """``storyN=LOSS``, LOSS between 0 and 1."""
    match = re.fullmatch(r"story ?(\d+)=([0-9.eE+-]+)", text)
    try:
        loss = float(match[2]) if match else np.nan
    except ValueError:
        loss = np.nan
    if match is None or not 0.0 <= loss < 1.0:
        raise EffectError(f"--damage {text!r}: expected storyN=LOSS with 0 <= LOSS < 1, as story1=0.2")
    return StiffnessChange.create(f"story {match[1]}", {"relative": -loss})


def _nanoseconds(start: datetime) -> int:
    """UTC nanoseconds; a time without zone is UTC."""
    since = (start if start.tzinfo else start.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    if since < timedelta(0):
        raise ValueError(f"--start {start.isoformat()}: before 1970, which a recording cannot say")
    return (since // timedelta(microseconds=1)) * 1000


def simulate_to(
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
    start: str,
    seed: int,
) -> None:
    """Write a simulated recording with the truth in its metadata.

    Raises
    ------
    BadConfigurationError
        If damage, effect, excitation or start cannot be understood.
    MissingInputError
        If the file cannot be written.
    """
    if excitation not in get_args(ExcitationKind):
        raise BadConfigurationError(f"--excitation {excitation!r}: one of {', '.join(get_args(ExcitationKind))}")
    planted: list[Effect] = []
    try:
        t0 = datetime.fromisoformat(start)
        for item in damage:
            planted.append(parse_damage(item))
        for item in effects:
            planted.append(parse_effect(item))
        model = config.model()
        for effect in planted:
            effect.check(model.structure)
        t0_ns = _nanoseconds(t0)
        if not (isfinite(duration_s) and round(duration_s * rate_hz) > 0):
            raise ValueError(f"--duration {duration_s:g}: not even one sample at {rate_hz:g} Hz")
        truth = Model(model.structure, (*model.effects, *planted))
        if np.linalg.eigvalsh(truth.stiffness_matrix()).min() <= 0:
            places = ", ".join(e.location for e in planted)
            raise ValueError(f"a structure that lost so much ({places}) would not stand")
    except ValueError as error:  # EffectError among them
        raise BadConfigurationError(str(error)) from error
    motion = simulate(
        truth,
        duration_s=duration_s,
        rate_hz=rate_hz,
        excitation=cast(ExcitationKind, excitation),
        noise=noise,
        level_spread=level_spread,
        seed=seed,
    )
    floors = motion.floors @ config.sensor_matrix().T
    metadata = {
        "simulated": {
            "structure": config.structure.model_dump_json(),
            "effects": json.dumps([{"effect": e.name, **asdict(e)} for e in planted]),
            "excitation": excitation,
            "noise": repr(noise),
            "level_spread": repr(level_spread),
            "seed": str(seed),
        }
    }
    write(out, [(ACCELERATION, floors, config.channels)], motion.ground, rate_hz, t0_ns, metadata)


def write(
    out: Path,
    streams: list[tuple[str, Array, tuple[str, ...]]],
    ground: Array | None,
    rate_hz: float,
    t0_ns: int,
    metadata: dict[str, dict[str, str]],
) -> None:
    """Write streams as blocks of one second, in time order."""
    if ground is not None:
        streams = [*streams, (GROUND, ground[:, None], ("ground",))]
    block_n = max(1, round(rate_hz))
    cut = [list(blocks_of(topic, v, c, rate_hz, t0_ns, block_n)) for topic, v, c in streams]
    try:
        with McapWriter(out, metadata) as writer:
            for together in zip(*cut, strict=True):
                for block in together:
                    writer.write(block)
    except OSError as error:
        raise MissingInputError(f"{out}: cannot be written: {error.strerror}") from error
