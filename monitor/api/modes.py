"""Modes of samples: with a structure as the pipeline identifies them, without one by the automatic choice."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np

from monitor.api.samples import checked, longest_window_s, whole_window
from monitor.api.structures import Structure
from monitor.core import Array, ComplexArray, ModalEstimate, Skipped, import_extra, single_blas_thread
from monitor.identification import (
    LEAST_PERIODS,
    LEAST_RECORD_S,
    RefinementSettings,
    SelectionSettings,
    SsiSettings,
    SubArray,
    expected_modes,
    identify as identify_by_model,
    identify_modes,
    refine,
)
from monitor.model import interval
from monitor.signals import FrontEnd, ProcessingSettings

_CUTOFF_SHARE = 0.4
"""Cutoff of the lowpass, over the sampling rate after it, where no structure states them. [ratio; the defaults of
[processing]]"""
_LEAST_BINS = 1.5
"""Half-power bandwidth of a mode from which the default segments are long enough. [bins; simulation: docs/look.md]"""
_WANTED_BINS = 3.0
"""Half-power bandwidth of the narrowest mode in segments made longer for it. [bins; simulation: docs/look.md]"""
_LEAST_SEGMENTS = 11
"""Half-overlapping segments that longer ones leave. [count; as in `look`]"""


@dataclass(frozen=True, eq=False, slots=True)
class Modes:
    """Modes of one stretch of samples, m of them, with their joint covariance."""

    frequencies_hz: Annotated[Array, "m"]
    frequencies_std_hz: Annotated[Array, "m"]
    """Standard deviations; NaN where not known."""
    damping_ratio: Annotated[Array, "m"]
    damping_std: Annotated[Array, "m"]
    shapes: Annotated[ComplexArray, "m c"]
    """Mode shapes; the largest component of the first estimate is 1."""
    covariance: Annotated[Array, "m 2c+2 m 2c+2"]
    """Joint covariance of (ln frequency, damping ratio, Re shape, Im shape) of each mode."""
    channels: tuple[str, ...]
    model_mode: tuple[int, ...] | None
    """Mode of the structure (1 = lowest) that each is the counterpart of; None without a structure."""
    missing: tuple[str, ...]
    """Why modes of the structure were not found, or why there is none at all."""
    poles: Annotated[Array, "poles 4"]
    """Stabilisation diagram: order, frequency in Hz, damping ratio, 1 if stable."""
    window_s: float
    """Length of the data that were used."""
    estimate: ModalEstimate | None
    """The pipeline's own form of the same; not part of the promise of stability."""

    def __len__(self) -> int:
        return len(self.frequencies_hz)

    def __str__(self) -> str:
        rows = zip(self.frequencies_hz, self.frequencies_std_hz, self.damping_ratio, self.damping_std, strict=True)
        lines = [
            f"{interval({'value': f, 'std': s}, 1.0, 'Hz'):>20}   {interval({'value': d, 'std': e}, 100.0, '%'):>14}"
            for f, s, d, e in rows
        ]
        return "\n".join(["frequency and damping ratio, ± two standard deviations", *lines, *self.missing])

    def plot(self, axes: Any = None) -> Any:
        """Draw the stabilisation diagram with the chosen modes; return the axes of matplotlib. Needs the extra ``plot``."""
        axes = import_extra("matplotlib.pyplot", "plot()").gca() if axes is None else axes
        stable = self.poles[:, 3] > 0
        axes.plot(self.poles[~stable, 1], self.poles[~stable, 0], "x", color="0.7", label="pole")
        axes.plot(self.poles[stable, 1], self.poles[stable, 0], ".", color="tab:blue", label="stable pole")
        for frequency in self.frequencies_hz:
            axes.axvline(frequency, color="tab:orange", linewidth=1)
        axes.set(xlabel="frequency, Hz", ylabel="order")
        axes.legend()
        return axes


@single_blas_thread()
def identify(
    samples: Annotated[Any, "samples c"],
    rate_hz: float,
    structure: Structure | None = None,
    *,
    cutoff_hz: float | None = None,
    max_modes: int | None = None,
) -> Modes:
    """Identify the modes of samples, all of them in one window.

    With a structure the modes are those that ``replay`` finds in a window of the same samples, bit for bit, where it leaves no
    channel out: the structure file's settings hold, but for the length of the window.

    Where no mode can be told there is none; `Modes.missing` says why.  A mode is stated of ten of its periods and more; with a
    structure, whose intervals are by the scatter of the record's own blocks, of 20 s and more.

    Parameters
    ----------
    samples : array, m/s^2
        Accelerations without a gap; with a structure its channels in its order.
    structure
        Modes that are its modes' counterparts are identified; without one, whatever is stable and certain.
    cutoff_hz
        Highest frequency of interest; without a structure 40 Hz or 0.4 of `rate_hz` by default.
    max_modes
        Number of modes to expect at most without a structure; more need a higher model order.

    Raises
    ------
    UserError
        The samples have another shape, are too short or are not finite.

    Examples
    --------
    >>> import shm_monitor as shm
    >>> frame = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[2e6, 2e6])
    >>> record = shm.simulate(frame, duration_s=200, rate_hz=100, seed=1)
    >>> modes = shm.identify(record.samples, record.rate_hz)
    >>> bool((abs(modes.frequencies_hz - frame.frequencies_hz) < 3 * modes.frequencies_std_hz).all())
    True
    """
    if structure is not None:
        if cutoff_hz is not None or max_modes is not None:
            structure = _narrowed(structure, cutoff_hz, max_modes)
        return _by_model(checked(samples, rate_hz, structure.channels), rate_hz, structure)
    values = checked(samples, rate_hz)
    names = tuple(f"a{k + 1}" for k in range(values.shape[1]))
    cutoff = min(_CUTOFF_SHARE * rate_hz, ProcessingSettings().cutoff_hz) if cutoff_hz is None else cutoff_hz
    rate_out = min(rate_hz, cutoff / _CUTOFF_SHARE)
    ssi, refinement, select = SsiSettings(), RefinementSettings(), SelectionSettings()
    if max_modes is not None:
        select = select.model_copy(update={"max_modes": max_modes})
    length_s = len(values) / rate_hz + 1e-9  # of short ones nothing is left over
    parts = max(1.0, length_s // ProcessingSettings().hop_s)
    hop_s = max(length_s / parts // 1.0, np.ceil(2 * ssi.block_rows / rate_out))
    window_s = longest_window_s(values, rate_hz, hop_s)
    processing = ProcessingSettings(rate_hz=rate_out, cutoff_hz=cutoff, window_s=window_s, hop_s=hop_s)
    front_end = FrontEnd(names, processing, refinement.segment_s, n_lags=2 * ssi.block_rows)

    def identified(front_end: FrontEnd) -> ModalEstimate | Skipped:
        window, conditioner = whole_window(front_end, values, rate_hz, with_segments=True)
        return identify_modes(window, ssi, select, refinement, cutoff_hz=conditioner.cutoff_hz)

    found = identified(front_end)
    if not isinstance(found, Skipped):
        segment_s = _longer_segment_s(found, front_end.segment_s, window_s)
        if segment_s > front_end.segment_s:
            found = identified(replace(front_end, segment_s=segment_s))
    return _modes(found, names, window_s, by_model=False)


def _longer_segment_s(found: ModalEstimate, segment_s: float, window_s: float) -> float:
    """Return the length of segments that outlasts the motion of the modes found; `segment_s` where that does already.

    The likelihood takes segments for independent.  Where a mode rings on from one into the next, its damping comes out too
    large and its interval too narrow.
    """
    bandwidth_hz = float((2.0 * found.damping_ratio * found.frequencies_hz).min())
    if bandwidth_hz * segment_s >= _LEAST_BINS:
        return segment_s
    return max(segment_s, min(_WANTED_BINS / max(bandwidth_hz, 1e-9), 2.0 * window_s / (_LEAST_SEGMENTS + 1)))


def _narrowed(structure: Structure, cutoff_hz: float | None, max_modes: int | None) -> Structure:
    config = structure.config
    if cutoff_hz is not None:
        config = config.model_copy(update={"processing": config.processing.model_copy(update={"cutoff_hz": cutoff_hz})})
    if max_modes is not None:
        config = config.model_copy(update={"selection": config.selection.model_copy(update={"max_modes": max_modes})})
    return Structure(config, structure.baseline)


def _by_model(samples: Array, rate_hz: float, structure: Structure) -> Modes:
    """Identify the counterparts of a structure's modes, as `monitor.pipeline.Pipeline` does."""
    config, baseline = structure.config, structure.baseline
    window_s = longest_window_s(samples, rate_hz, config.processing.hop_s, LEAST_RECORD_S)
    config = config.model_copy(update={"processing": config.processing.model_copy(update={"window_s": window_s})})
    window, conditioner = whole_window(config.front_end(), samples, rate_hz, with_segments=config.refinement.enabled)
    array, reference = sub_array(structure), structure.instrumented.model.modes()
    wanted = (
        expected_modes(reference, conditioner.cutoff_hz, config.selection) if baseline is None else baseline.model_mode
    )
    found = identify_by_model(
        window,
        array.past,
        reference,
        array.shown,
        config.identification,
        config.selection,
        wanted,
        conditioner.cutoff_hz,
        partial(refine, window, settings=config.refinement),
    )
    found = found if isinstance(found, Skipped) else array.correct(found)
    return _modes(found, structure.channels, window.window_s, by_model=True)


def sub_array(structure: Structure) -> SubArray:
    """Return all channels of a structure as the pipeline sees them: reference channels, sensor matrix, stated sensor effects."""
    config, drawn = structure.config, structure.config.instrumented()
    past = tuple(config.channels.index(name) for name in config.identification.reference_channels)
    effects = tuple(effect for effect in drawn.model.effects if effect.family == "sensor")
    everything = tuple(range(len(config.channels)))
    context = structure.instrumented.context(config.processing.rate_hz)
    return SubArray.of(everything, past, structure.instrumented.sensor_matrix, effects, context)


def _modes(found: ModalEstimate | Skipped, channels: tuple[str, ...], window_s: float, *, by_model: bool) -> Modes:
    """Form the library's result of an estimate, without the modes of which the data hold too few periods."""
    c = len(channels)
    if isinstance(found, Skipped):
        numbers = () if by_model else None
        none, nowhere = np.zeros(0), np.zeros((0, 2 + 2 * c, 0, 2 + 2 * c))
        shapes = np.zeros((0, c), complex)
        poles = np.zeros((0, 4))
        return Modes(none, none, none, none, shapes, nowhere, channels, numbers, (found.reason,), poles, window_s, None)
    periods = found.frequencies_hz * window_s
    short = tuple(
        f"mode at {f:.3g} Hz: {n:.2g} periods in {window_s:g} s, {LEAST_PERIODS:g} are the least: cannot say"
        for f, n in zip(found.frequencies_hz, periods, strict=True)
        if n < LEAST_PERIODS
    )
    found = found.only(frozenset(found.model_mode[periods >= LEAST_PERIODS].tolist())) if short else found
    covariance = np.einsum("bmp,bnq->mpnq", found.deviations, found.deviations)
    if not len(found.deviations):
        covariance = np.full_like(covariance, np.nan)
    return Modes(
        found.frequencies_hz,
        found.frequencies_std_hz,
        found.damping_ratio,
        found.damping_std,
        found.shapes,
        covariance,
        channels,
        tuple(int(k) + 1 for k in found.model_mode) if by_model else None,
        (*(why for _, why in found.missing), *short),
        found.poles,
        window_s,
        found,
    )
