"""A quick look at recordings without a model: level and spectra, modes with a second opinion, and what is doubtful."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np

from drivers.base import ACCELERATION
from monitor.core import (
    Array,
    BadInputError,
    ComplexArray,
    ModalEstimate,
    OnProgress,
    Skipped,
    Step,
    Window,
    demand_place,
    write_atomically,
)
from monitor.identification import (
    LEAST_RECORD_S,
    RefinementSettings,
    SelectionSettings,
    SingleMode,
    SsiSettings,
    fit_single_modes,
    identify_modes,
)
from monitor.publish import (
    G_M_S2,
    LookedBand,
    LookedMode,
    LookedRecording,
    doubtful_rows,
    mode_rows,
    peaks_in_words,
    write_look,
)
from monitor.runs.look_doubts import Facts, distinct_peaks, find_doubts, find_remarks, remark_modes, unexplained_peaks
from monitor.runs.look_structure import propose_structure
from monitor.runs.readers import ImportedChannel, Options, are_recordings, as_recordings, doubt_unit
from monitor.runs.recordings import OnWarning, Progress, file_names, read_topics
from monitor.signals import (
    Conditioner,
    HealthSettings,
    HealthState,
    SegmentDesign,
    WindowGrid,
    alignment,
    each_once,
    find_peaks,
    sensor_health,
    times_held,
    transform,
    windows,
)

_MOST_VALUES = 1 << 27
"""Most samples, of all channels together, that are looked at; a longer recording is cut. [count; cost: 1 GB of memory]"""
_CUTOFF = 0.4
"""Cutoff of the lowpass over the rate. [ratio; as the default of [processing]]"""
_LEAST_CYCLES = 100.0
"""Cycles of the lowest mode that is looked for. [count; judgement: its frequency is then known within 1 %]"""
_LEAST_BLOCKS = 12
"""Blocks from which an uncertainty is estimated. [count; judgement: it is then known within a fifth]"""
LEAST_SAMPLES = 2 * SsiSettings().block_rows * _LEAST_BLOCKS
"""Samples of the longest stretch, at least. [count; definition: the lags of the identification in each block]"""
_SEGMENT_BLOCKS_S = 10.0
"""Length of the blocks from which uncertainties are estimated. [s; as of the pipeline's windows]"""
_SEGMENT_CYCLES = 100.0
"""Cycles of a band's lowest mode in a segment. [count; judgement: bins as wide as a mode of damping 0.5 %]"""
_LEAST_SEGMENTS = 11
"""Half-overlapping segments into which every record is cut. [count; judgement: `RefinementSettings.min_segments` and room]"""
_SPECTRUM_SEGMENTS = 59
"""Half-overlapping segments of the spectra that are shown, at least. [count; judgement: a random error of 13 %]"""
_MOST_SEGMENT_SAMPLES = 1 << 15
"""Longest segment of the spectra that are shown. [samples; cost]"""
_SHOWN_COLUMNS = 240
"""Most columns of a spectrogram. [count; cost]"""
_IDENTIFIES = "identifies the modes"
_FALSE_RATE = 0.05
"""Probability that the two opinions are told to differ by chance on any mode. [1; convention]"""
_SAME_MAC = 0.8
"""Modal assurance criterion from which modes of two bands at one frequency are one. [1; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class _Run:
    """Consecutive samples without a gap."""

    t_ns: int
    values: Annotated[Array, "n c"]
    """In m/s^2."""


def look(
    paths: Sequence[Path],
    options: Options = Options(),  # noqa: B008 - frozen
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> LookedRecording:
    """Look at recordings, or at files that `import` reads, by `options`, without a model.

    Raises BadInputError or MissingInputError if the files cannot be used; the message names them.
    """
    taken: list[ImportedChannel] = []
    if not are_recordings(paths):
        on_progress(Step("reads the tables", then=_IDENTIFIES))
    options = replace(options, unknown_start_ns=0)
    # That no unit is stated is a doubt of the look, and no warning.
    with as_recordings(paths, options, on_warning, ask_unit=lambda _: "m/s^2", on_channel=taken.append) as recordings:
        found = _look(recordings, partial(_note, paths, taken, options.unit), on_warning, on_progress)
    if options.unit is None and any(not one.stated for one in taken):
        found = replace(found, doubts=(doubt_unit(taken), *found.doubts))
    return replace(found, files=tuple(map(str, paths)))


def _note(
    paths: Sequence[Path], taken: Sequence[ImportedChannel], unit: str | None, rate_hz: float, t_start_ns: int
) -> tuple[str, ...]:
    """Say as what tables were taken; nothing of recordings."""
    if not taken:
        return ()
    units = {
        f"unit {one.unit} "
        + (
            ("as the columns' names say" if one.by_name else "as its file states")
            if one.stated
            else ("as --unit says" if unit else "as none is stated")
        )
        for one in taken
    }
    begins = "" if t_start_ns else "; no date is stated, so times count from 1970"
    return (f"taken from {file_names(paths)}: {rate_hz:g} Hz, {'; '.join(sorted(units))}{begins}",)


def _look(
    paths: Sequence[Path],
    notes_of: Callable[[float, int], tuple[str, ...]],
    on_warning: OnWarning,
    on_progress: OnProgress,
) -> LookedRecording:
    """Look at recordings, of whose rate in Hz and begin in ns `notes_of` makes the first notes."""
    read = _Reader(paths, on_warning, on_progress)
    on_progress(Step(_IDENTIFIES))
    notes = notes_of(read.rate_hz, read.runs[0].t_ns)
    runs, rate_hz, held = read.each_once()
    longest = max(runs, key=lambda run: len(run.values))
    if len(longest.values) < LEAST_SAMPLES:
        raise BadInputError(
            f"{file_names(paths)}: the longest stretch without a gap has {len(longest.values)} samples, too few to look at; "
            f"record at least {LEAST_SAMPLES}"
        )
    if reason := too_short(file_names(paths), len(longest.values), rate_hz):
        raise BadInputError(reason + _all_peaks(longest.values, rate_hz))
    duration_s = (runs[-1].t_ns - runs[0].t_ns) * 1e-9 + len(runs[-1].values) / rate_hz
    transforms, design, middles_s = _transforms(runs, rate_hz)
    spectra = np.einsum("ska,skb->kab", transforms, transforms.conj()) / len(transforms)
    looked = (identify_band(longest.values, rate_hz, *band) for band in _bands(longest.values, rate_hz))
    bands = [band for band in looked if band is not None]
    modes = _merge(bands)
    lowest_hz = min((band.band_hz[0] for band in bands), default=rate_hz / 2.0)
    if bands:
        notes = (*notes, f"modes are looked for from {lowest_hz:.3g} to {bands[0].band_hz[1]:.3g} Hz")
    values = np.concatenate([run.values for run in runs]) if len(runs) > 1 else longest.values
    mean = values.mean(axis=0)
    rms, peak = values.std(axis=0), np.abs(values - mean).max(axis=0)
    facts = Facts(
        channels=read.channels,
        rate_hz=rate_hz,
        duration_s=duration_s,
        longest_s=len(longest.values) / rate_hz,
        gaps=tuple(
            (
                np.datetime64(a.t_ns + round(len(a.values) / rate_hz * 1e9), "ns"),
                (b.t_ns - a.t_ns) * 1e-9 - len(a.values) / rate_hz,
            )
            for a, b in pairwise(runs)
        ),
        truncated=read.truncated,
        held=held,
        dropped=read.dropped,
        mean=mean,
        rms=rms,
        health=tuple(read.health),
        transforms=transforms,
        step_hz=design.step_hz,
        middles_s=middles_s,
        modes=tuple(modes),
        lowest_hz=lowest_hz,
    )
    facts = replace(facts, modes=remark_modes(facts))
    facts = replace(facts, peaks_hz=unexplained_peaks(facts, [(band.peaks_hz, band.step_hz) for band in bands]))
    columns = np.array_split(np.abs(transforms) ** 2, min(len(transforms), _SHOWN_COLUMNS))  # of the spectrogram
    return LookedRecording(
        files=tuple(map(str, paths)),
        notes=(*notes, *find_remarks(facts)),
        t_start_ns=runs[0].t_ns,
        duration_s=duration_s,
        rate_hz=rate_hz,
        channels=read.channels,
        topics=read.topics,
        gaps=facts.gaps,
        mean_m_s2=mean,
        rms_m_s2=rms,
        peak_m_s2=peak,
        hz=np.asarray(np.arange(design.n_bins) * design.step_hz, dtype=float),
        power=2.0 * np.einsum("kaa->ak", spectra).real,
        singular_values=2.0 * np.linalg.eigvalsh(spectra)[:, ::-1].T,
        n_segments=len(transforms),
        spectrogram_s=(float(middles_s[0]), float(middles_s[-1])),
        spectrogram=np.array([2.0 * part.mean(axis=0) for part in columns]),
        bands=tuple(bands),
        modes=facts.modes,
        peaks_hz=facts.peaks_hz,
        doubts=find_doubts(facts),
    )


def too_short(name: str, samples: int, rate_hz: float) -> str:
    """Say that the longest stretch of a recording is too short to state modes; nothing where it is not."""
    if samples / rate_hz >= LEAST_RECORD_S * (1.0 - 1e-9):
        return ""
    return (
        f"{name}: the longest stretch without a gap is {samples / rate_hz:.4g} s, too short to state modes; record at least "
        f"{LEAST_RECORD_S:g} s"
    )


@dataclass(frozen=True, eq=False, slots=True)
class Stretches:
    """Samples of recordings in stretches without a gap."""

    channels: tuple[str, ...]
    rate_hz: float
    values: tuple[Annotated[Array, "n c"], ...]
    """In m/s^2."""

    @classmethod
    def of(cls, recordings: Sequence[Path], on_warning: OnWarning, on_progress: OnProgress) -> Stretches:
        """Read them (errors as `look`)."""
        read = _Reader(recordings, on_warning, on_progress)
        runs, rate_hz, _ = read.each_once()
        return cls(read.channels, rate_hz, tuple(run.values for run in runs))


class _Reader:
    """Reads recordings into runs of samples without a gap, and the health of their sensors."""

    def __init__(self, paths: Sequence[Path], on_warning: OnWarning, on_progress: OnProgress) -> None:
        self.channels: tuple[str, ...] = ()
        self.rate_hz = 0.0
        self.runs: list[_Run] = []
        self.health: list[sensor_health.Health] = []
        self.topics: dict[str, dict[str, Any]] = {}
        self.truncated = False
        state, health, parts, size = alignment.start(), HealthState(), list[Array](), 0
        begin_ns, dropped = 0, 0
        progress = Progress(on_progress, paths, step=Step("reads the recordings", then=_IDENTIFIES))
        for block in read_topics(paths, None, on_warning):
            topic = self.topics.setdefault(
                block.topic,
                {"channels": list(block.channels), "unit": block.unit, "rate_hz": block.sample_rate_hz, "samples": 0},
            )
            topic["samples"] += block.n_samples
            if block.topic != ACCELERATION:
                continue
            if progress.first is None:
                self.channels, self.rate_hz = block.channels, block.sample_rate_hz
            progress.add(block)
            if abs(block.sample_rate_hz / self.rate_hz - 1.0) > 1e-3:
                raise BadInputError(
                    f"{file_names(paths)}: the rate changes from {self.rate_hz:g} to {block.sample_rate_hz:g} Hz; "
                    "look at each recording alone"
                )
            size += block.n_samples * len(self.channels)
            if size > _MOST_VALUES:
                self.truncated = True
                break
            try:
                state, pieces = alignment.step(state, block, self.channels)
            except BadInputError as error:
                raise BadInputError(f"{file_names(paths)}: {error}") from error
            for piece in pieces:
                health, spans = sensor_health.step(
                    health, piece, state.dropped, self.channels, HealthSettings(), keep_s=0.0
                )
                self.health += spans
                if piece.gap is not None and parts:
                    self.runs.append(_Run(begin_ns, np.concatenate(parts)))
                    parts = []
                if not parts:
                    begin_ns = piece.t_ns
                parts.append(piece.values)
            dropped = state.dropped
        if parts:
            self.runs.append(_Run(begin_ns, np.concatenate(parts)))
        self.dropped = dropped
        if not self.runs:
            raise BadInputError(f"{file_names(paths)}: {ACCELERATION} holds no samples")

    def each_once(self) -> tuple[list[_Run], float, int]:
        """Give the runs without the repetitions of samples that a converter held, their rate, and how often each was held."""
        held = times_held(max(self.runs, key=lambda run: len(run.values)).values)
        if held == 1:
            return self.runs, self.rate_hz, held
        return [replace(run, values=each_once(run.values, held)) for run in self.runs], self.rate_hz / held, held


def _transforms(runs: Sequence[_Run], rate_hz: float) -> tuple[ComplexArray, SegmentDesign, Array]:
    """Transform half-overlapping segments of all runs; return them, their design, and the middles of the segments, s."""
    total = sum(len(run.values) for run in runs)
    longest = max(len(run.values) for run in runs)
    n = min(_MOST_SEGMENT_SAMPLES, 2 * total // (_SPECTRUM_SEGMENTS + 1), longest) // 2 * 2
    design = SegmentDesign(rate_hz, n, n // 2 + 1)
    transforms, middles = [], []
    for run in runs:
        for begin in range(0, len(run.values) - n + 1, n // 2):
            part = run.values[begin : begin + n]
            transforms.append(transform(design, part - part.mean(axis=0)))
            middles.append((run.t_ns - runs[0].t_ns) * 1e-9 + (begin + n / 2) / rate_hz)
    return np.array(transforms), design, np.array(middles)


def _bands(values: Annotated[Array, "n c"], rate_hz: float) -> Iterator[tuple[float, float]]:
    """List the source's rate and the lower ones, each with the lowest frequency that is looked for at it.

    The lags of the identification span one period of that.  The rates end where less than an octave is left of the band.
    """
    least_hz, rate = _LEAST_CYCLES / (len(values) / rate_hz), rate_hz
    while rate == rate_hz or _CUTOFF * rate > 2.0 * least_hz:
        yield rate, max(rate / (2 * SsiSettings().block_rows), least_hz)
        rate /= 2.0


def identify_band(values: Array, source_hz: float, rate_hz: float, lowest_hz: float) -> LookedBand | None:
    """Identify the modes from `lowest_hz` up at a lower rate; None where the run is too short for it."""
    window, cutoff_hz = _window(values, source_hz, rate_hz, lowest_hz)
    if window is None:
        return None
    # A mode below the band bends the spectra of the lowest one in it, so that it is identified too; it is not told.
    select = SelectionSettings(min_frequency_hz=0.5 * lowest_hz)
    modes = identify_modes(window, SsiSettings(), select, RefinementSettings(), cutoff_hz=cutoff_hz)
    second = () if isinstance(modes, Skipped) else fit_single_modes(window.segments, window.segment_bin_hz, modes)
    peaks_hz = _peaks_hz(window, lowest_hz, cutoff_hz)
    return LookedBand(window.rate_hz, (lowest_hz, cutoff_hz), modes, second, peaks_hz, window.segment_bin_hz)


def _window(values: Array, source_hz: float, rate_hz: float, lowest_hz: float) -> tuple[Window | None, float]:
    """Make one window of a run at a lower rate; return it, None where the run is too short for it, and its cutoff, Hz."""
    conditioner = Conditioner.design(source_hz, rate_hz, _CUTOFF * rate_hz)
    _, x = conditioner.step_block(conditioner.start(values.shape[1]), values - values.mean(axis=0))
    rate, n_lags = conditioner.rate_hz, 2 * SsiSettings().block_rows
    block_n = max(n_lags, min(round(_SEGMENT_BLOCKS_S * rate), len(x) // 40))
    blocks = len(x) // block_n
    if blocks < _LEAST_BLOCKS:
        return None, conditioner.cutoff_hz
    x = x[len(x) - blocks * block_n :]  # the filter starts up in what is left over
    segment_s = max(20.0, min(_SEGMENT_CYCLES / lowest_hz, 2.0 * len(x) / rate / (_LEAST_SEGMENTS + 1)))
    segment_s = min(segment_s, 2.0 * len(x) / rate / (RefinementSettings().min_segments + 1))
    grid = WindowGrid(rate, len(x), block_n, n_lags, segment_s, conditioner.cutoff_hz)
    _, made = windows.step(grid, windows.start(grid, x.shape[1], index=0), x, 0)
    return next(one for one in made if isinstance(one, Window)), conditioner.cutoff_hz


def _peaks_hz(window: Window, lowest_hz: float, highest_hz: float) -> tuple[float, ...]:
    """Find the peaks of a window's spectra in a band."""
    found = (k * window.segment_bin_hz for k in find_peaks(np.array(window.segments)))
    return tuple(hz for hz in found if lowest_hz <= hz <= highest_hz)


def _all_peaks(values: Array, rate_hz: float) -> str:
    """Name the peaks of a run that is too short for modes; empty where there is none."""
    peaks = []
    for rate, lowest_hz in _bands(values, rate_hz):
        window, cutoff_hz = _window(values, rate_hz, rate, lowest_hz)
        if window is not None:
            peaks.append((_peaks_hz(window, lowest_hz, cutoff_hz), window.segment_bin_hz))
    named = ", ".join(f"{hz:.3g}" for hz in distinct_peaks(peaks))
    return f"; its spectra have peaks at {named} Hz" if named else ""


def _merge(bands: Sequence[LookedBand]) -> list[LookedMode]:
    """Collect the modes of all bands by frequency.

    Of a mode that several bands show, a refined estimate is taken rather than one that is not, then one with a second opinion,
    then that whose damping is most certain.
    """
    found = [
        _mode(band.modes, k, band.second[k])
        for band in bands
        if isinstance(band.modes, ModalEstimate)
        for k, f in enumerate(band.modes.frequencies_hz.tolist())
        if f >= band.band_hz[0] and f > 2.0 * band.modes.frequencies_std_hz[k]
    ]
    kept: list[LookedMode] = []
    for mode in sorted(
        found, key=lambda m: (not m.refined, isinstance(m.second, Skipped), m.damping_std / m.damping_ratio)
    ):
        if not any(_is_same(mode, other) for other in kept):
            kept.append(mode)
    kept.sort(key=lambda m: m.frequency_hz)
    limit = NormalDist().inv_cdf(1.0 - _FALSE_RATE / (4.0 * max(1, len(kept))))  # frequency and damping, either way
    return [compared(mode, limit) for mode in kept]


def _is_same(a: LookedMode, b: LookedMode) -> bool:
    """Check whether two estimates are of one mode: their frequencies agree within what poles may differ, and their shapes."""
    near = abs(a.frequency_hz / b.frequency_hz - 1.0) < 2.0 * SelectionSettings().stable_frequency
    return near and mac(a.shape, b.shape) > _SAME_MAC


def mac(a: Annotated[ComplexArray, "c"], b: Annotated[ComplexArray, "c"]) -> float:
    """Compute the modal assurance criterion of two shapes."""
    return float(abs(np.vdot(a, b)) ** 2 / (np.vdot(a, a).real * np.vdot(b, b).real))


def _mode(modes: ModalEstimate, k: int, second: SingleMode | Skipped) -> LookedMode:
    shape = modes.shapes[k]
    c = len(shape)
    deviations = np.sqrt((modes.deviations[:, k, 2:] ** 2).sum(axis=0))
    return LookedMode(
        frequency_hz=float(modes.frequencies_hz[k]),
        frequency_std_hz=float(modes.frequencies_std_hz[k]),
        damping_ratio=float(modes.damping_ratio[k]),
        damping_std=float(modes.damping_std[k]),
        shape=shape,
        shape_std=deviations[:c],
        refined=modes.refined,
        second=second,
        differs="",
    )


def compared(mode: LookedMode, limit: float) -> LookedMode:
    """Say in what the second opinion differs from the first by more than `limit` standard deviations, and widen that interval.

    The variance between the two methods is added (DerSimonian and Laird, Controlled Clinical Trials 7 (1986) 177-188).
    """
    other, said = mode.second, []
    if isinstance(other, Skipped):
        return mode
    f_std, damping_std = mode.frequency_std_hz, mode.damping_std
    apart = abs(other.frequency_hz - mode.frequency_hz)
    if apart > limit * np.hypot(other.frequency_std_hz, f_std):
        said.append("frequency")
        f_std = float(np.sqrt(0.5 * (apart**2 + f_std**2 - other.frequency_std_hz**2)))
    apart = abs(other.damping_ratio - mode.damping_ratio)
    if apart > limit * np.hypot(other.damping_std, damping_std):
        said.append("damping")
        damping_std = float(np.sqrt(0.5 * (apart**2 + damping_std**2 - other.damping_std**2)))
    return replace(mode, frequency_std_hz=f_std, damping_std=damping_std, differs=" and ".join(said))


RESULT_FILES = ("look.html", "look.json", "modes.csv")
"""Files that `write_results` writes. [names; definition]"""


def write_results(found: LookedRecording, out: Path) -> None:
    """Write look.html, look.json and modes.csv into a folder, which is made."""
    out.mkdir(parents=True, exist_ok=True)
    write_look(out / "look.html", found)
    write_atomically(out / "look.json", json.dumps(found.content(), indent=1, allow_nan=False) + "\n")
    write_atomically(out / "modes.csv", _modes_table(found))


def write_structure(found: LookedRecording, path: Path, mass_kg: float | None) -> None:
    """Write a structure file that fits the modes (`propose_structure`)."""
    text = propose_structure(found, mass_kg)
    demand_place(path)
    write_atomically(path, text)


def _modes_table(found: LookedRecording) -> str:
    """Write the modes as a table with one line a mode."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    shape = [f"{part} {name}" for name in found.channels for part in ("re", "im", "std")]
    writer.writerow(
        ["mode", "frequency_hz", "frequency_std_hz", "damping_ratio", "damping_std", "collinearity", *shape, "remark"]
    )
    for number, m in found.numbered():
        parts = [v for x, std in zip(m.shape, m.shape_std, strict=True) for v in (x.real, x.imag, std)]
        numbers = [m.frequency_hz, m.frequency_std_hz, m.damping_ratio, m.damping_std, m.collinearity, *parts]
        writer.writerow([number or "", *(f"{value:.9g}" for value in numbers), m.doubt])
    return text.getvalue()


def in_words(found: LookedRecording) -> str:
    """Write the result for a terminal: the modes first, then level and doubts."""
    head = ["mode", "f, Hz", "damping, %", "second, Hz", "second, %", ""]
    rows, below = mode_rows(found), doubtful_rows(found)
    lines = in_columns([head, *rows, *below])
    if below:
        lines.insert(1 + len(rows), "-- doubtful:")
    if not rows:
        lines = ["no modes found", *(lines if below else [])]
    if found.peaks_hz:
        lines.append(peaks_in_words(found))
    lines += [f"note: {note}" for note in found.notes]
    lines.append(
        f"{found.duration_s:.6g} s at {found.rate_hz:g} Hz from {str(np.datetime64(found.t_start_ns, 'ns'))[:19]} UTC; "
        f"{len(found.gaps)} gaps; topics: {', '.join(sorted(found.topics))}"
    )
    level = [
        [name, f"{rms:.3g} m/s^2 RMS", f"{rms / G_M_S2:.2g} g", f"peak {peak:.3g} m/s^2"]
        for name, rms, peak in zip(found.channels, found.rms_m_s2, found.peak_m_s2, strict=True)
    ]
    lines += in_columns(level)
    lines += [f"doubt: {doubt}" for doubt in found.doubts]
    return "\n".join(lines)


def in_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align the cells of rows in columns."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
