"""Converts CAN frames to samples and back: a DBC compiled once to array operations (classic and FD, either byte order)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cantools
import numpy as np
from numpy.typing import NDArray

from drivers.base import Floats, Ints

Bytes = NDArray[np.uint8]

COUNTER = "counter"
"""Name of the signal that holds the counter."""
_UNITS = {"": 1.0, "m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "m/s/s": 1.0, "g": 9.80665, "mg": 9.80665e-3, "gal": 1e-2}
_WINDOW = 8


class FrameError(ValueError):
    """Error of a DBC that cannot be read or cannot carry the channels; the text names file, message and remedy."""


@dataclass(frozen=True, eq=False, slots=True)
class Field:
    """Place of one number in a frame, and its conversion to a physical value."""

    start: int
    """Index of the first of the eight bytes that hold the number."""
    shift: int
    """Lowest bit of the number within these bytes, read as one integer."""
    length: int
    """Bits."""
    big_endian: bool
    signed: bool
    real: bool
    """True for an IEEE number of 32 or 64 bits."""
    scale: float
    """Factor from raw number to physical value."""
    offset: float
    """Physical value of the raw number 0."""

    def columns(self) -> Annotated[Ints, "8"]:
        """Return the indices of the eight bytes, least significant first."""
        order = np.arange(_WINDOW)
        return self.start + (order[::-1] if self.big_endian else order)

    def unpack(self, padded: Annotated[Bytes, "n bytes+8"]) -> Annotated[NDArray[Any], "n"]:
        """Extract raw numbers from frames padded by eight bytes."""
        window = np.ascontiguousarray(padded[:, self.columns()]).view("<u8")[:, 0]
        top = window << np.uint64(64 - self.shift - self.length)
        if self.signed:
            return top.view(np.int64) >> np.int64(64 - self.length)
        raw = top >> np.uint64(64 - self.length)
        if self.real:
            return raw.view(np.float64) if self.length == 64 else raw.astype(np.uint32).view(np.float32)
        return raw

    def pack(self, padded: Annotated[Bytes, "n bytes+8"], raw: Annotated[NDArray[Any], "n"]) -> None:
        """Write raw numbers into frames of zeros."""
        if self.real:
            kind = np.float64 if self.length == 64 else np.float32
            bits = raw.astype(kind).view(np.uint64 if self.length == 64 else np.uint32).astype(np.uint64)
        else:
            bits = raw.astype(np.int64).view(np.uint64) & np.uint64((1 << self.length) - 1)
        window = (bits << np.uint64(self.shift)).astype("<u8")
        padded[:, self.columns()] |= window.view(np.uint8).reshape(-1, _WINDOW)

    def limits(self) -> tuple[float, float]:
        """Return the least and the greatest raw number."""
        if self.real:
            return -np.inf, np.inf
        low = -(1 << (self.length - 1)) if self.signed else 0
        return float(low), float(low + (1 << self.length) - 1)


@dataclass(frozen=True, eq=False, slots=True)
class Layout:
    """Layout of one CAN message."""

    name: str
    frame_id: int
    extended: bool
    n_bytes: int
    channels: tuple[str, ...]
    n_samples: int
    """Number of samples of each channel in a frame."""
    fields: tuple[Field, ...]
    """Fields sample by sample, and within a sample in the order of `channels`; their values are in m/s^2."""
    counter: Field | None
    """None if the message has no counter."""

    @property
    def counter_bits(self) -> int:
        """Width of the counter; 0 without a counter."""
        return 0 if self.counter is None else self.counter.length

    def decode(
        self, frames: bytes
    ) -> tuple[Annotated[NDArray[np.float32], "frames*n_samples channels"], Annotated[Ints, "frames"]]:
        """Decode concatenated frames, each `n_bytes` long, to samples, m/s^2, and raw counters: zeros without a counter."""
        data = np.frombuffer(frames, dtype=np.uint8).reshape(-1, self.n_bytes)
        padded = np.zeros((len(data), self.n_bytes + _WINDOW), dtype=np.uint8)
        padded[:, : self.n_bytes] = data
        samples = np.empty((len(data), len(self.fields)), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # a real field may hold anything
            for at, field in enumerate(self.fields):
                samples[:, at] = field.unpack(padded) * field.scale + field.offset
        counters = np.zeros(len(data), np.int64) if self.counter is None else self.counter.unpack(padded)
        return samples.reshape(-1, len(self.channels)), counters.astype(np.int64)

    def encode(
        self, samples: Annotated[Floats, "frames*n_samples channels"], counters: Annotated[Ints, "frames"]
    ) -> tuple[Annotated[Bytes, "frames bytes"], int]:
        """Encode samples, m/s^2, and the lowest `counter_bits` bits of the counters.

        A number that does not fit becomes the nearest that fits; also returns how many there were.
        """
        values = np.asarray(samples, dtype=np.float64).reshape(-1, len(self.fields))
        padded = np.zeros((len(values), self.n_bytes + _WINDOW), dtype=np.uint8)
        saturated = 0
        for at, field in enumerate(self.fields):
            raw = (values[:, at] - field.offset) / field.scale
            if not field.real:
                low, high = field.limits()
                whole = np.rint(np.nan_to_num(raw))
                raw = np.clip(whole, low, high)
                saturated += int(np.count_nonzero(raw != whole))
            field.pack(padded, raw)
        if self.counter is not None:
            self.counter.pack(padded, counters)
        return padded[:, : self.n_bytes], saturated


def load(path: Path, channels: tuple[str, ...] = ()) -> tuple[Layout, ...]:
    """Load the layouts of the messages of a DBC that carry `channels`, or all accelerations if no channel is named.

    A channel is the signal of the same name.  In frames with several samples, it is the signals NAME_0, NAME_1, ...
    Raises `FrameError` if the file cannot be read, or does not carry the channels.
    """
    carried = [(message, _carried(message, channels)) for message in _messages(path)]
    places: dict[str, list[str]] = {}
    for message, groups in carried:
        for name in groups:
            places.setdefault(name, []).append(message.name)
    wanted = channels or tuple(places)
    problems = [f"no signal {name!r}" for name in wanted if name not in places]
    problems += [f"{name!r} stands in {', '.join(where)}" for name, where in places.items() if len(where) > 1]
    if problems or not wanted:
        known = ", ".join(signal.name for message, _ in carried for signal in message.signals)
        raise FrameError(f"{path}: {'; '.join(problems) or 'no acceleration'}; the signals are {known or 'none'}")
    layouts = [_layout(path, message, groups) for message, groups in carried if groups]
    return tuple(sorted(layouts, key=lambda layout: wanted.index(layout.channels[0])))


def _messages(path: Path) -> list[Any]:
    """Read the messages of a DBC."""
    try:
        database: Any = cantools.database.load_file(path, database_format="dbc")
        return list(database.messages)
    except OSError as error:
        raise FrameError(f"{path}: {error.strerror or error}") from error
    except (cantools.errors.Error, ValueError) as error:
        raise FrameError(f"{path}: is no DBC: {error}") from error


def _carried(message: Any, channels: tuple[str, ...]) -> dict[str, list[Any]]:
    """Return the signals of those channels, or of all accelerations, that a message carries."""
    names = channels or _accelerations(message)
    return {name: signals for name in names if (signals := _signals(message, name))}


def _accelerations(message: Any) -> tuple[str, ...]:
    """List the channels that a message carries, judged by the units of its signals."""
    names = [s.name for s in message.signals if s.name != COUNTER and s.unit and _unit(s) is not None]
    stems = {name: name.removesuffix("_0") for name in names if name.endswith("_0")}
    several = {stem: len(_signals(message, stem)) for stem in stems.values()}
    parts = {f"{stem}_{at}" for stem, count in several.items() for at in range(count)}
    return tuple(dict.fromkeys(stems.get(name, name) for name in names if name in stems or name not in parts))


def _signals(message: Any, name: str) -> list[Any]:
    """List the signals of a channel, one for each sample in a frame; empty if the message does not carry the channel."""
    signals = {signal.name: signal for signal in message.signals}
    if name in signals:
        return [signals[name]]
    several: list[Any] = []
    while f"{name}_{len(several)}" in signals:
        several.append(signals[f"{name}_{len(several)}"])
    return several


def _unit(signal: Any) -> float | None:
    """Return the factor from the signal's unit to m/s^2; None if it is no unit of acceleration."""
    return _UNITS.get((signal.unit or "").strip().casefold().replace(" ", "").replace("**", "^"))


def _layout(path: Path, message: Any, groups: dict[str, list[Any]]) -> Layout:
    """Build the layout of a DBC message from the signals of each channel; raise FrameError if it cannot be used."""
    place = f"{path}: {message.name}"
    if not 0 < message.length <= 64:
        raise FrameError(f"{place}: {message.length} bytes; a frame has 1 to 64")
    counts = {len(signals) for signals in groups.values()}
    if len(counts) > 1:
        each = ", ".join(f"{name}: {len(signals)}" for name, signals in groups.items())
        raise FrameError(f"{place}: samples of each channel in a frame must be as many ({each})")
    for signals in groups.values():
        for signal in signals:
            if _unit(signal) is None:
                raise FrameError(f"{place}: {signal.name} has unit {signal.unit!r}; known: m/s^2, g, mg, gal")
    counter = next((signal for signal in message.signals if signal.name == COUNTER), None)
    if counter is not None and (counter.is_float or counter.is_signed or not 4 <= counter.length <= 32):
        raise FrameError(f"{place}: {COUNTER} must be unsigned, of 4 to 32 bits; 16 or more are advised")
    n_samples = counts.pop()
    return Layout(
        name=message.name,
        frame_id=message.frame_id,
        extended=bool(message.is_extended_frame),
        n_bytes=message.length,
        channels=tuple(groups),
        n_samples=n_samples,
        fields=tuple(_field(place, signals[at]) for at in range(n_samples) for signals in groups.values()),
        counter=None if counter is None else _field(place, counter),
    )


def _field(place: str, signal: Any) -> Field:
    """Build the field of a DBC signal; errors begin with `place`."""
    if signal.is_multiplexer or signal.multiplexer_ids is not None:
        raise FrameError(f"{place}: {signal.name} is multiplexed; give each sample its own bits")
    big = signal.byte_order == "big_endian"
    if big:  # the DBC names the most significant bit
        start, into = divmod(8 * (signal.start // 8) + 7 - signal.start % 8, 8)
        shift = 64 - into - signal.length
    else:
        start, shift = divmod(signal.start, 8)
    if shift < 0 or shift + signal.length > 64:
        raise FrameError(f"{place}: {signal.name} lies across nine bytes; shorten it or begin it on a whole byte")
    factor = _unit(signal) or 1.0
    if not signal.scale:
        raise FrameError(f"{place}: {signal.name} has factor 0")
    scale, offset = float(signal.scale) * factor, float(signal.offset) * factor
    real = bool(signal.is_float)
    if real and signal.length not in (32, 64):
        raise FrameError(f"{place}: {signal.name} is a real number of {signal.length} bits; 32 or 64 are known")
    return Field(start, shift, signal.length, big, bool(signal.is_signed) and not real, real, scale, offset)
