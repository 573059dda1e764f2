"""What is compared of a recording or of a folder of results: its blocks, and of any of them the modes and the levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np

from monitor.core import (
    Array,
    BadInputError,
    ComplexArray,
    MissingInputError,
    ModalEstimate,
    OnProgress,
    os_errors_of,
)
from monitor.identification import SelectionSettings, SpectralShape
from monitor.publish import LookedRecording, read_line, read_lines, read_summary
from monitor.runs.look import LEAST_SAMPLES, Stretches, look, mac, too_short
from monitor.runs.readers import Options, as_recordings
from monitor.runs.recordings import OnWarning

_RESULTS = "results.jsonl"
"""File of a folder of results. [name; definition]"""


@dataclass(frozen=True, eq=False, slots=True)
class Mode:
    """Mode of some blocks."""

    frequency_hz: float
    damping_ratio: float
    shape: Annotated[ComplexArray, "c"]

    @property
    def decay_s(self) -> float:
        """Time in which its free motion falls to 1/e, s."""
        return float(1.0 / (2.0 * np.pi * self.frequency_hz * max(self.damping_ratio, 1e-6)))


class Side(Protocol):
    """A recording, or a folder of results."""

    @property
    def name(self) -> str:
        """Its path."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels; none where the results do not name them."""

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Modes of the whole, by frequency."""

    @property
    def without_modes(self) -> str:
        """Why there are none; empty where there are."""

    @property
    def decay_s(self) -> float:
        """Time in which the free motion of the lowest mode falls to 1/e, s; without modes what the spectrum shows of it."""

    @property
    def lengths_s(self) -> tuple[float, ...]:
        """Lengths of its stretches without a gap."""

    def cut(self, block_s: float) -> list[Any]:
        """Cut the stretches into blocks of this length; what is left over is left out."""

    def left_out(self, blocks: Sequence[Any]) -> list[dict[int, Mode]]:
        """Estimate the modes without each of the blocks, by their numbers in the whole."""

    def powers(self, blocks: Sequence[Any]) -> dict[str, Annotated[Array, "blocks"]]:
        """Compute the mean squares that are compared as levels, by name, in (m/s^2)^2."""

    def indices(self, blocks: Sequence[Any]) -> dict[str, Annotated[Array, "blocks"]]:
        """Compute the damage index of each story in each block, by name."""


def match(a: Sequence[Mode], b: Sequence[Mode]) -> dict[int, int]:
    """Match modes by frequency and shape: those of which each is the nearest to the other."""
    if not a or not b:
        return {}
    select = SelectionSettings()
    cost = np.full((len(a), len(b)), np.inf)
    for i, one in enumerate(a):
        for j, other in enumerate(b):
            distance = abs(np.log(other.frequency_hz / one.frequency_hz)) / np.log(select.max_frequency_ratio)
            likeness = mac(one.shape, other.shape)
            if distance <= 1.0 and likeness >= select.min_model_mac:
                cost[i, j] = distance + (1.0 - likeness)
    nearest, back = cost.argmin(axis=1), cost.argmin(axis=0)
    return {i: int(j) for i, j in enumerate(nearest) if back[j] == i and np.isfinite(cost[i, j])}


@dataclass(frozen=True, eq=False, slots=True)
class Recorded:
    """A recording; its blocks are samples."""

    name: str
    channels: tuple[str, ...]
    modes: tuple[Mode, ...]
    influence: tuple[Annotated[Array, "rows 2+2c"], ...]
    """Of each mode: the first-order influence of each stretch of the data (`ModalEstimate.deviations`)."""
    without_modes: str
    rate_hz: float
    values: tuple[Annotated[Array, "n c"], ...]

    @classmethod
    def read(cls, path: Path, options: Options, on_warning: OnWarning, on_progress: OnProgress) -> Recorded:
        """Read it, and look for its modes (errors as `look`)."""
        # That no unit is stated is a doubt of `look`, and no warning.
        options, modes, influence = replace(options, unknown_start_ns=0), list[Mode](), list[Array]()
        with as_recordings([path], options, on_warning, ask_unit=lambda _: "m/s^2") as recordings:
            samples = Stretches.of(recordings, on_warning, lambda _: None)
            longest = max(map(len, samples.values))
            reason = too_short(str(path), longest, samples.rate_hz) if longest >= LEAST_SAMPLES else ""
            if not reason:
                modes, influence = _of_look(look(recordings, on_progress=on_progress))
                reason = "" if modes else f"{path}: no modes found"
        return cls(
            str(path), samples.channels, tuple(modes), tuple(influence), reason, samples.rate_hz, samples.values
        )  # fmt: skip

    @property
    def decay_s(self) -> float:
        """Decay time of the lowest mode; without modes that of one mode whose spectrum would be as narrow."""
        if self.modes:
            return self.modes[0].decay_s
        run = max(self.values, key=len)
        power = np.abs(np.fft.rfft(run - run.mean(axis=0), axis=0)) ** 2
        # The squared correlation of one mode has the integral tau / 2; the periodogram's scatter doubles its mean square.
        narrow = 0.5 * (power**2).sum(axis=0) / np.maximum(power.sum(axis=0) ** 2, np.finfo(float).tiny)
        return float(len(run) / self.rate_hz * narrow.max())

    @property
    def lengths_s(self) -> tuple[float, ...]:
        """Lengths of the stretches."""
        return tuple(len(run) / self.rate_hz for run in self.values)

    def cut(self, block_s: float) -> list[Array]:
        """Cut the stretches into blocks."""
        n = max(1, int(block_s * self.rate_hz + 1e-6))
        return [run[k : k + n] for run in self.values for k in range(0, len(run) - n + 1, n)]

    def left_out(self, blocks: Sequence[Array]) -> list[dict[int, Mode]]:
        """Estimate the modes, which are those of the longest stretch, to the first order without each of its blocks."""
        count = max(map(len, self.values)) // max(1, len(blocks[0])) if blocks else 0
        out = [dict[int, Mode]() for _ in range(count)]
        for number, (mode, rows) in enumerate(zip(self.modes, self.influence, strict=True)):
            groups = min(count, len(rows))
            for left, part in zip(out, np.array_split(rows, groups) if groups > 1 else [], strict=False):
                ln_f, damping, *shape = part.sum(axis=0) * groups / (groups - 1.0)
                re, im = np.split(np.array(shape), 2)
                left[number] = Mode(
                    mode.frequency_hz * np.exp(-ln_f), mode.damping_ratio - damping, mode.shape - re - 1j * im
                )
        return out

    def powers(self, blocks: Sequence[Array]) -> dict[str, Array]:
        """Compute the power of each channel in each octave."""
        n = min(map(len, blocks))
        hz = np.arange(n // 2 + 1) * self.rate_hz / n
        spectra = (
            np.array([np.abs(np.fft.rfft(block - block.mean(axis=0), axis=0)) ** 2 for block in blocks]) * 2.0 / n**2
        )
        out = {}
        for low in 2.0 ** np.arange(np.floor(np.log2(4.0 * hz[1])), np.log2(hz[-1])):
            inside = (hz >= low) & (hz < 2.0 * low)
            if 2.0 * low <= hz[-1] and inside.any():
                power = spectra[:, inside].sum(axis=1)
                names = (f"{name}: level, {low:g} to {2.0 * low:g} Hz" for name in self.channels)
                out.update({name: column for name, column in zip(names, power.T, strict=True) if column.all()})
        return out

    def indices(self, blocks: Sequence[Array]) -> dict[str, Array]:
        """Compute no index: that takes a model."""
        return {}


def _of_look(found: LookedRecording) -> tuple[list[Mode], list[Array]]:
    """Take the modes of a look to which it has no remark, and the influence of the data on each."""
    estimates = [band.modes for band in found.bands if isinstance(band.modes, ModalEstimate)]
    modes, influence = [], []
    for mode in (mode for mode in found.modes if not mode.remark):
        own, k = next(
            (one, k) for one in estimates for k, f in enumerate(one.frequencies_hz) if float(f) == mode.frequency_hz
        )
        modes.append(Mode(mode.frequency_hz, mode.damping_ratio, mode.shape))
        influence.append(own.deviations[:, k])
    return modes, influence


def describe_recordings(sides: Sequence[Recorded], blocks: Sequence[Sequence[Array]]) -> list[Array]:
    """Describe the spectral shape of all blocks, side by side, one array a band, up to half the lowest rate."""
    from scipy.signal import resample  # takes a while to load

    rate_hz = min(side.rate_hz for side in sides)
    alike = []
    for side, own in zip(sides, blocks, strict=True):
        faster = side.rate_hz > rate_hz * (1.0 + 1e-3)
        alike += [resample(x, round(len(x) * rate_hz / side.rate_hz)) if faster else x for x in own]
    shape = SpectralShape.of(alike)
    return [np.array(part) for part in zip(*map(shape.describe_bands, alike), strict=True)]


Line = dict[str, Any]
"""A window of results.jsonl that has modes, or a judged reading of features."""


@dataclass(frozen=True, eq=False, slots=True)
class Results:
    """A folder of results of replay or run; its blocks are windows that share no data with those of other blocks."""

    name: str
    channels: tuple[str, ...]
    modes: tuple[Mode, ...]
    without_modes: str
    lines: tuple[Line, ...]

    @classmethod
    def read(cls, folder: Path) -> Results:
        """Read it; BadInputError or MissingInputError where no window has modes, and no feature was judged."""
        lines = _windows_with_modes(folder / _RESULTS)
        told = read_summary(folder).get("known", {}).get("names", ())
        sigma = lines[0].get("residual_sigma") or ()
        names = tuple(name for name, _ in zip(told or map(str, range(1, len(sigma) + 1)), sigma, strict=False))
        return cls(str(folder), names, _modes_of_lines(lines), "", tuple(lines))

    @property
    def decay_s(self) -> float:
        """Decay time of the lowest mode; 0 for features."""
        return self.modes[0].decay_s if self.modes else 0.0

    @property
    def lengths_s(self) -> tuple[float, ...]:
        """From the first window's begin to the last one's end."""
        first, last = self.lines[0], self.lines[-1]
        return ((last["t_end_ns"] - first["t_end_ns"]) * 1e-9 + first["window_s"],)

    def cut(self, block_s: float) -> list[list[Line]]:
        """Collect the windows that lie in each block; a window and more long."""
        first = self.lines[0]
        block_s = max(block_s, first["window_s"])
        begin_s = first["t_end_ns"] * 1e-9 - first["window_s"]
        blocks = [list[Line]() for _ in range(int(self.lengths_s[0] / block_s + 1e-6))]
        for line in self.lines:
            end_s = line["t_end_ns"] * 1e-9 - begin_s
            k = int((end_s - line["window_s"]) / block_s + 1e-6)
            if k < len(blocks) and end_s <= (k + 1) * block_s * (1.0 + 1e-6):
                blocks[k].append(line)
        return [block for block in blocks if block]

    def left_out(self, blocks: Sequence[list[Line]]) -> list[dict[int, Mode]]:
        """Average the modes of the windows without those of each block."""
        if len(blocks) < 2:
            return []
        rest = ([line for other in blocks if other is not block for line in other] for block in blocks)
        found = [_modes_of_lines(lines) for lines in rest]
        return [{i: modes[j] for i, j in match(self.modes, modes).items()} for modes in found]

    def powers(self, blocks: Sequence[list[Line]]) -> dict[str, Array]:
        """Compute the mean square of each block."""
        squares = [np.array([line.get("rms_m_s2") or np.nan for line in block], dtype=float) ** 2 for block in blocks]
        means = np.array([square.mean() for square in squares])
        return {"level": means} if np.isfinite(means).all() else {}

    def indices(self, blocks: Sequence[list[Line]]) -> dict[str, Array]:
        """Average the damage index of the windows, or what the covariates leave of each feature."""
        if self.channels:
            left = [np.array([line["residual_sigma"] for line in block], dtype=float) for block in blocks]
            of_features = np.array([np.ma.masked_invalid(one).mean(axis=0).filled(np.nan) for one in left])
            return {
                f"{name}: left by the covariates, in healthy standard deviations": column
                for name, column in zip(self.channels, of_features.T, strict=True)
                if np.isfinite(column).all()
            }
        told = [[line["ddi"] for line in block if line.get("ddi")] for block in blocks]
        if not all(told):
            return {}
        means = np.array([np.mean(np.array(one, dtype=float), axis=0) for one in told])
        return {
            f"story {j + 1}: damage index": column for j, column in enumerate(means.T) if np.isfinite(column).all()
        }  # fmt: skip


def describe_results(
    sides: Sequence[Results], blocks: Sequence[Sequence[list[Line]]], places: Sequence[Sequence[int]]
) -> list[Array]:
    """Describe blocks of windows by ln frequency and damping of the modes that all have, and by the damage index.

    `places` are, of each side, the numbers of the modes that are one.
    """
    rows, indices = [], []
    for side, own, chosen in zip(sides, blocks, places, strict=True):
        whole = [side.modes[k] for k in chosen]
        for block in own:
            modes = _modes_of_lines(block)
            found = match(whole, modes)
            of = [modes[found[k]] if k in found else None for k in range(len(whole))]
            rows.append([x for m in of for x in ((np.log(m.frequency_hz), m.damping_ratio) if m else (np.nan, np.nan))])
        indices.append(side.indices(own))
    matrix = np.array(rows)
    names = [name for name in indices[0] if all(name in one for one in indices)]
    second = (
        np.array([np.concatenate([one[name] for one in indices]) for name in names]).reshape(len(names), len(rows)).T
    )
    parts = [part[:, np.isfinite(part).all(axis=0)] for part in (matrix, second)]
    return [part / np.maximum(part.std(axis=0), np.finfo(float).tiny) for part in parts if part.size]


def _modes_of_lines(lines: Sequence[Line]) -> tuple[Mode, ...]:
    """Average the modes of windows, each by its number in the model or in the line."""
    numbers = [line.get("model_modes") or list(range(len(line["frequencies_hz"] or ()))) for line in lines]
    modes = []
    for number in sorted({number for own in numbers for number in own}):
        rows = [(line, own.index(number)) for line, own in zip(lines, numbers, strict=True) if number in own]
        hz, damping = (np.mean([line[key][k] for line, k in rows]) for key in ("frequencies_hz", "damping_ratio"))
        modes.append(Mode(float(hz), float(damping), _mean_shape([line["mode_shapes"][k] for line, k in rows])))
    return tuple(modes)


def _windows_with_modes(path: Path) -> list[Line]:
    """Read the windows of results.jsonl that have modes or judged features, one at least."""
    if not path.is_file():
        raise MissingInputError(f"{path}: does not exist; a folder of results is made by replay or run")
    judged = []
    with os_errors_of(path):
        for number, text in enumerate(read_lines(path), start=1):
            try:
                line = read_line(text)
            except ValueError as error:
                raise BadInputError(f"{path}: line {number}: {error}") from error
            is_feature = line["skipped"] is None and line.get("residual_sigma")
            judged += [line] if line.get("frequencies_hz") or is_feature else []
    if not judged:
        raise BadInputError(f"{path}: no window has modes, and no feature was judged")
    return judged


def _mean_shape(shapes: Sequence[Sequence[Any]]) -> ComplexArray:
    """Average shapes of several windows, [re, im] of each channel; a channel that is left out in any of them counts as 0.

    The largest component is 1.
    """
    parsed = []
    for shape in shapes:
        x = np.array([0j if one is None or None in one else complex(*one) for one in shape])
        parsed.append(x / max(float(np.linalg.norm(x)), 1e-300))
    reference = parsed[0]
    mean = np.mean([x * np.exp(-1j * np.angle(np.vdot(reference, x))) for x in parsed], axis=0)
    return np.asarray(mean / mean[np.abs(mean).argmax()])
