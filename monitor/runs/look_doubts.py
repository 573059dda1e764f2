"""What is doubtful about a recording, as far as its samples tell without a model: each doubt is one sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray, Skipped
from monitor.publish import G_M_S2, LookedMode
from monitor.runs.look_structure import fit_frame, frame_misfit
from monitor.runs.readers.recording import GRAVITY_TOLERANCE
from monitor.signals import FALSE_RATE, MAIN_LOBE_BINS, channel_relations, mains_hum, sensor_drift, sensor_health

_STRONGEST_G = 2.0
"""RMS from which the unit is asked; no structure that is monitored moves so. [g; judgement: strong earthquakes give 0.3]"""
_WEAKEST_M_S2 = 1e-7
"""RMS below which the unit is asked. [m/s^2; below the noise of the best accelerometers in any band above 1 Hz]"""
_LEAST_UNFOLDED = 0.5
"""Density just below half the rate, over that of the upper half of the band, from which no lowpass is seen. [1; judgement]"""
_MOST_FOLDED = 0.1
"""Density just below half the rate, over that at the weakest mode, up to which what folds is no doubt. [1; judgement: it adds
to a mode's peak as sensor noise of a third of its amplitude does]"""
_LEAST_SHARE = 0.001
"""Share of a recording's samples or spans from which a fault is told. [1; judgement]"""
_OPPOSITE = 0.2
"""Size of a component of the lowest mode, over the largest, from which its sign tells something. [1; judgement]"""
_ROOM_BELOW = 4.0
"""Frequency of the lowest mode found, over the lowest that was looked for, from which it counts as the structure's lowest. [1;
judgement: the second mode of a building lies two and a half to six times above the first]"""
_MOST_NAMED = 5
"""Most sinusoids that are named. [count; judgement]"""
_LEAST_CHANNELS = 3
"""Channels from which one can be told to be out of line. [count; definition]"""
_LEAST_MODES = 2
"""Modes from which other frequencies tell the same as the lowest one. [count; definition]"""
_TONE_OFFSET_BINS = 4
"""Bins from a peak where its background begins. [bins; the Hann taper's leakage is then below a thousandth]"""


@dataclass(frozen=True, eq=False, slots=True)
class Facts:
    """What the doubts rest on."""

    channels: tuple[str, ...]
    rate_hz: float
    duration_s: float
    longest_s: float
    """Longest stretch without a gap."""
    gaps: tuple[tuple[np.datetime64, float], ...]
    truncated: bool
    """Whether the recording was too long to be read to its end."""
    held: int
    """How often each reading stands in a row in the recording, of which one is used."""
    dropped: int
    """Samples that were repeated, late or not finite."""
    mean: Annotated[Array, "c"]
    rms: Annotated[Array, "c"]
    health: tuple[sensor_health.Health, ...]
    transforms: Annotated[ComplexArray, "segments bins c"]
    """By the Hann taper."""
    step_hz: float
    middles_s: Annotated[Array, "segments"]
    """Middle of each segment."""
    modes: tuple[LookedMode, ...]
    lowest_hz: float
    """Lowest frequency at which modes were looked for."""
    peaks_hz: tuple[float, ...] = ()
    """Peaks of the spectra that nothing explains."""


def find_doubts(facts: Facts) -> tuple[str, ...]:
    """List what is doubtful, the gravest first; "may be" where a model, or a look at the sensors, must decide."""
    return (*_of_level(facts), *_of_stream(facts), *_of_sensors(facts), *_of_spectra(facts), *_of_channels(facts))


def remark_modes(facts: Facts) -> tuple[LookedMode, ...]:
    """Remark the modes that may be none of the structure: lines of the mains and of machines."""
    hums = mains_hum.find_hum(facts.transforms, facts.step_hz, facts.rate_hz)
    out = []
    for mode in facts.modes:
        hum = next((h for h in hums if h.low_hz <= mode.frequency_hz <= h.high_hz), None)
        if hum is not None:
            mode = replace(mode, remark=f"mains: a line at {hum.hz:.4g} Hz")
        elif _is_tone(facts, mode):
            mode = replace(mode, remark="of constant size, as a machine forces it: may be no mode")
        out.append(mode)
    return tuple(out)


def unexplained_peaks(facts: Facts, peaks: Sequence[tuple[Sequence[float], float]]) -> tuple[float, ...]:
    """List the peaks of the bands' spectra, Hz, that no mode, machine or mains explains; each band's with its resolution."""
    explained = [(hz, MAIN_LOBE_BINS * facts.step_hz) for hz in _tones(facts)]
    explained += [(mode.frequency_hz, 2.0 * mode.damping_ratio * mode.frequency_hz) for mode in facts.modes]
    hums = mains_hum.find_hum(facts.transforms, facts.step_hz, facts.rate_hz)
    explained += [(hum.hz, hum.high_hz - hum.hz) for hum in hums]
    return distinct_peaks(peaks, explained)


def distinct_peaks(
    peaks: Sequence[tuple[Sequence[float], float]], explained: Sequence[tuple[float, float]] = ()
) -> tuple[float, ...]:
    """List the peaks of several bands' spectra once each, as the finest one shows them, without what is explained.

    Each band has its peaks and its resolution, what is explained a frequency and a half-width, all in Hz.
    """
    known, left = list(explained), list[float]()
    for found, step_hz in sorted(peaks, key=lambda band: band[1]):
        reach = MAIN_LOBE_BINS * step_hz
        new = [hz for hz in found if all(abs(hz - at) > reach + width for at, width in known)]
        known += [(hz, reach) for hz in new]
        left += new
    return tuple(sorted(left))


def _is_tone(facts: Facts, mode: LookedMode) -> bool:
    """Test whether the power at a mode's frequency is as constant over time as that of a sinusoid."""
    at = round(mode.frequency_hz / facts.step_hz)
    if not 1 < at < facts.transforms.shape[1] - 2:
        return False
    power = np.abs(facts.transforms @ (mode.shape.conj() / np.linalg.norm(mode.shape))) ** 2
    at += int(power[:, at - 1 : at + 2].mean(axis=0).argmax()) - 1
    return _is_constant(power, at, len(facts.modes))


def _is_constant(power: Annotated[Array, "segments bins"], at: int, tests: int) -> bool:
    """Test whether the power in a bin is as constant over the segments as a sinusoid's."""
    offsets = np.arange(_TONE_OFFSET_BINS, 2 * _TONE_OFFSET_BINS)
    around = np.concatenate([at - offsets, at + offsets])
    around = around[(around > 0) & (around < power.shape[1])]
    background = float(power[:, around].mean()) if around.size else 0.0
    # Half-overlapping segments share data, which makes steady what is random: every other one is independent.
    return background > 0.0 and mains_hum.constancy(power[::2, at], background) > np.log(tests / FALSE_RATE)


def _tones(facts: Facts) -> Iterator[float]:
    """Find the frequencies at which the power of a channel is as constant as that of a sinusoid, Hz."""
    power = np.abs(facts.transforms) ** 2
    mean = power.mean(axis=0)
    n_bins, c = mean.shape
    for at in range(2, n_bins - 2):
        peaks = [k for k in range(c) if mean[at, k] == mean[at - 2 : at + 3, k].max() > 0.0]
        if any(_is_constant(power[:, :, k], at, n_bins * c) for k in peaks):
            yield at * facts.step_hz


def _of_level(facts: Facts) -> Iterator[str]:
    """Ask for the unit where level or mean are implausible for m/s^2."""
    strong = [k for k, rms in enumerate(facts.rms) if rms > _STRONGEST_G * G_M_S2]
    if strong:
        rms = max(facts.rms[k] for k in strong) / G_M_S2
        yield f"{_names(facts, strong)}: {rms:.3g} g RMS: is the unit right?"
    weak = [k for k, rms in enumerate(facts.rms) if 0.0 < rms < _WEAKEST_M_S2]
    if weak:
        rms = min(facts.rms[k] for k in weak)
        yield f"{_names(facts, weak)}: {rms:.2g} m/s² RMS is less than a sensor's noise: is the unit right?"
    still = [k for k, rms in enumerate(facts.rms) if rms == 0.0]
    if still:
        yield f"{_names(facts, still)}: constant, the sensor may be dead"
    unity = [k for k, mean in enumerate(facts.mean) if abs(abs(mean) - 1.0) < GRAVITY_TOLERANCE]
    if unity:
        yield f"{_names(facts, unity)}: the mean is {facts.mean[unity[0]]:.3g} m/s²: if that is gravity, the unit is g"
    down = [k for k, mean in enumerate(facts.mean) if abs(abs(mean) / G_M_S2 - 1.0) < GRAVITY_TOLERANCE]
    if down:
        yield f"{_names(facts, down)}: the mean is gravity: this axis is vertical"


def _of_stream(facts: Facts) -> Iterator[str]:
    """Tell of gaps, and of what was not used."""
    if facts.truncated:
        yield f"the recording is longer than can be looked at in one piece: only its first {facts.duration_s:.0f} s are used"
    if facts.gaps:
        at, length = max(facts.gaps, key=lambda gap: gap[1])
        yield (
            f"{len(facts.gaps)} {'gap' if len(facts.gaps) == 1 else 'gaps'}, the longest {length:.3g} s at {at}: the modes "
            f"are of the longest stretch without one, {facts.longest_s:.0f} of {facts.duration_s:.0f} s"
        )
    if facts.held > 1:
        yield (
            f"each reading stands {facts.held} times in a row: the sensors deliver {facts.rate_hz:g} Hz, and the recording says "
            f"{facts.held * facts.rate_hz:g} Hz; one of each is used, since the others would feign modes above "
            f"{facts.rate_hz / 2.0:g} Hz"
        )
    if facts.dropped:
        yield f"{facts.dropped} samples were repeated, late or no finite numbers, and are left out"


def _of_sensors(facts: Facts) -> Iterator[str]:
    """Tell what the sensors' health shows in the recording's spans."""
    if not facts.health:
        return
    samples = np.array([span.samples for span in facts.health], dtype=float)
    for k, name in enumerate(facts.channels):
        spans = [span.channels[k] for span in facts.health]
        clipped = float(samples @ [s.clipped for s in spans] / samples.sum())
        if clipped > _LEAST_SHARE:
            yield f"{name}: clipped, {100 * clipped:.2g} % of its samples lie at a limit: measure with a wider range"
        spikes = sum(s.spikes for s in spans)
        if spikes:
            yield f"{name}: {spikes} {'spike' if spikes == 1 else 'spikes'} of single samples: a loose contact, or lost bits?"
        held = sum(s.held_s for s in spans)
        if held:
            yield f"{name}: held one value for {held:.3g} s in all: lost samples that were filled in?"
        steps = sum(s.step_m_s2 != 0.0 for s in spans)
        if steps:
            yield f"{name}: the offset steps in {steps} of {len(spans)} spans of 10 s: a loose or touched sensor?"
        coarse = max(s.resolution_m_s2 for s in spans)
        if coarse > facts.rms[k]:
            yield f"{name}: a resolution of {coarse:.2g} m/s² is coarser than the motion of {facts.rms[k]:.2g} m/s² RMS"


def _of_spectra(facts: Facts) -> Iterator[str]:
    """Tell of hum, of drift and of a missing lowpass."""
    hums = mains_hum.find_hum(facts.transforms, facts.step_hz, facts.rate_hz)
    for hum in hums:
        where = "all channels" if hum.channel is None else facts.channels[hum.channel]
        seen = f", folded from {hum.harmonic * hum.mains_hz:g} Hz" if hum.is_aliased else ""
        yield f"{where}: hum of the mains at {hum.hz:.4g} Hz{seen}: earth the cable's screen on one side"
    tones = [hz for hz in _tones(facts) if not any(hum.low_hz <= hz <= hum.high_hz for hum in hums)]
    if tones:
        of_mains = mains_hum.harmonic_bins(facts.rate_hz, facts.step_hz, facts.transforms.shape[1] - 1)
        said = []
        for hz in tones[:_MOST_NAMED]:
            at = round(hz / facts.step_hz)
            said.append(
                f"{hz:.4g} Hz" + (" (the mains?)" if any(low <= at <= high for _, low, high in of_mains) else "")
            )
        more = f" and {len(tones) - _MOST_NAMED} more" if len(tones) > _MOST_NAMED else ""
        yield f"sinusoids at {', '.join(said)}{more}: a machine, a shaker, or hum"
    lowest = min((mode.frequency_hz for mode in facts.modes), default=0.02 * facts.rate_hz)
    drifts = sensor_drift.find_drift(facts.transforms, int(0.5 * lowest / facts.step_hz))
    if len(drifts) < len(facts.channels):  # what all do is the motion's
        yield from (f"{facts.channels[one.channel]}: drifts alone, slower than {0.5 * lowest:.3g} Hz" for one in drifts)
    bare, share = _without_lowpass(facts)
    if bare and share > _MOST_FOLDED:
        of_modes = (
            f" (just below it there is {share:.2g} of the power at the weakest mode)" if np.isfinite(share) else ""
        )
        yield (
            f"{_names(facts, bare)}: no lowpass is seen below half the rate ({facts.rate_hz / 2:g} Hz): motion beyond it, if "
            f"there is any, is folded into the band{of_modes}"
        )


def find_remarks(facts: Facts) -> tuple[str, ...]:
    """List what is worth knowing and changes no result."""
    bare, share = _without_lowpass(facts)
    if not bare or share > _MOST_FOLDED:
        return ()
    return (
        f"{_names(facts, bare)}: no lowpass is seen below half the rate ({facts.rate_hz / 2:g} Hz), but little moves there: "
        f"{share:.2g} of the power at the weakest mode, so that what may fold into the band is no more than noise",
    )


def _without_lowpass(facts: Facts) -> tuple[list[int], float]:
    """Find the channels without a lowpass, and what may fold: their density just below half the rate over that at a mode.

    The mode is that with the least density; the ratio is infinite where there is no mode.
    """
    power = (np.abs(facts.transforms) ** 2).mean(axis=0)
    folded = channel_relations.folded_share(power)
    bare = [k for k, share in enumerate(folded) if share > _LEAST_UNFOLDED and facts.rms[k] > 0.0]
    at = [round(mode.frequency_hz / facts.step_hz) for mode in facts.modes if not mode.remark]
    if not bare or not at:
        return bare, inf
    density = power[:, bare].sum(axis=1)
    weakest = min(float(density[max(0, k - 1) : k + 2].max()) for k in at)
    return bare, float(channel_relations.top_density(density[:, None])[0] / max(weakest, 1e-300))


def _of_channels(facts: Facts) -> Iterator[str]:
    """Tell what coherence and phase say of clocks, cables and signs."""
    moving = [k for k, rms in enumerate(facts.rms) if rms > 0.0]
    transforms = facts.transforms[:, :, moving]
    copies = channel_relations.find_copies(transforms)
    for i, j in copies:
        yield f"{facts.channels[moving[i]]} and {facts.channels[moving[j]]}: alike to the noise: may be one sensor, stored twice"
    for delay in channel_relations.find_delays(transforms, facts.step_hz, facts.rate_hz, facts.middles_s):
        if (min(delay.channel, delay.against), max(delay.channel, delay.against)) in copies:
            continue
        a, b = facts.channels[moving[delay.channel]], facts.channels[moving[delay.against]]
        if delay.drift:
            yield f"{a} and {b}: their clocks differ by {abs(delay.drift) * 1e6:.3g} parts in a million: may be two clocks"
        else:
            late, early = (a, b) if delay.delay_s > 0.0 else (b, a)
            yield f"{late}: may be about {abs(delay.delay_s) * 1e3:.3g} ms later than {early}"
    yield from _of_signs(facts)


def _of_signs(facts: Facts) -> Iterator[str]:
    """Tell of a channel that moves against all others in the lowest mode, and of one out of order.

    In the lowest mode of a building or a mast all of it moves to one side, the more the higher.  That the lowest mode found is
    the structure's, and that the channels and not the structure are odd, other modes must tell: all are those of a shear frame
    with the channel the other way round, and not without, or with the floors in order of their motion.
    """
    moving = np.flatnonzero(facts.rms > 0.0)
    modes = [mode for mode in facts.modes if not mode.remark and not isinstance(mode.second, Skipped)][: len(moving)]
    if len(moving) < _LEAST_CHANNELS or len(modes) < _LEAST_MODES:
        return
    first = modes[0]
    is_lowest = all(hz > first.frequency_hz for hz in facts.peaks_hz)
    if not is_lowest or first.frequency_hz < _ROOM_BELOW * facts.lowest_hz:
        return
    shape, slack = first.shape.real[moving], 2.0 * first.shape_std[moving]
    large = np.flatnonzero(np.abs(shape) > _OPPOSITE)
    signs = np.sign(shape[large])
    against = [int(k) for k in large[signs != np.sign(signs.sum())]]
    by_size = [int(k) for k in moving[np.argsort(-np.abs(shape))]]
    if len(against) == 1 and len(large) >= _LEAST_CHANNELS:
        at = int(moving[against[0]])
        turned = [
            replace(mode, shape=np.where(np.arange(len(mode.shape)) == at, -1.0, 1.0) * mode.shape) for mode in modes
        ]
        if _is_frame(turned, by_size) and not _is_frame(modes, by_size):
            yield (
                f"{facts.channels[at]}: moves against all others in the lowest mode ({first.frequency_hz:.4g} Hz), and the other "
                "way round all modes are those of a frame: may be reversed"
            )
    if against or _is_straight(np.abs(shape)) or not _is_frame(modes, by_size):
        return
    pairs = []
    for a, b in combinations(range(len(shape)), 2):
        swapped = np.abs(shape)
        swapped[[a, b]] = swapped[[b, a]]
        if _is_straight(swapped) and abs(swapped[a] - swapped[b]) > slack[a] + slack[b]:
            pairs.append(f"{facts.channels[moving[a]]} and {facts.channels[moving[b]]}")
    if pairs:
        yield (
            f"{', or '.join(pairs)}: may be swapped, if the channels go up or down the structure one by one: in the lowest mode "
            "they move out of order"
        )


def _is_frame(modes: Sequence[LookedMode], order: Sequence[int]) -> bool:
    """Test whether modes are those of a shear frame whose floors are the channels in this order, the top one first."""
    return frame_misfit(fit_frame(modes, order, 1.0), modes, order) is None


def _is_straight(size: Array) -> bool:
    """Check whether values rise all along, or fall."""
    steps = np.diff(size)
    return bool((steps > 0.0).all() or (steps < 0.0).all())


def _names(facts: Facts, channels: Sequence[int]) -> str:
    """Join the names of channels; all of them in two words."""
    return (
        "all channels" if len(channels) == len(facts.channels) > 1 else ", ".join(facts.channels[k] for k in channels)
    )
