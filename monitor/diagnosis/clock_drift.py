"""Clock drift: a channel whose clock runs faster or slower than that of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.fft import ifft, next_fast_len

from monitor.core import Array, ComplexArray
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.verdict import Diagnosis
from monitor.inference import Drive, Segments, information_weight

_STEPS_A_CYCLE = 4
"""Trial rates by which the latest segment's phase at the highest frequency moves a cycle. [count; definition: two would
alias]"""
_RESOLUTION = 1e-3
"""Resolution of the rate, over the step between the trial rates. [ratio; rounding]"""
_MIN_STREAMS = 3
"""Fewest channels, the inputs included, among which one clock can be told from the others'. [count; definition]"""


@dataclass(frozen=True, slots=True)
class ClockDrift:
    """Drift of one channel's clock against those of the others."""

    channel: int
    """Index of the channel; from the number of channels on, of a measured input."""
    relative: float
    """Rate of the clock over that of the others, less one."""
    std: float
    """Standard deviation of `relative`."""
    log_likelihood_gain: float
    """Gain of the coherent recording, nats."""


@dataclass(frozen=True, eq=False, slots=True)
class _Profile:
    """Log likelihood of a recording as a function of the rate of one channel's clock."""

    others: Annotated[ComplexArray, "bins segments others"]
    """Coherences of that channel with the whitened others by segment."""
    hz: Annotated[Array, "bins"]
    t_s: Annotated[Array, "segments"]
    """Middle of every segment."""
    segment_s: float

    def at(self, relative: float) -> float:
        """Compute the log likelihood, nats, less a constant, with a free covariance of the channels at each frequency."""
        turn = np.exp(2j * np.pi * relative * self.hz[:, None] * self.t_s)
        return float(self._likelihood(np.einsum("fsl,fs->fl", self.others, turn)))

    def over(self, relative: Annotated[Array, "n"]) -> Annotated[Array, "n"]:
        """Compute the log likelihood at many rates, with the phases of an FFT, which are coarser."""
        step_s = 0.5 * self.segment_s
        slot = np.rint((self.t_s - self.t_s[0]) / step_s).astype(int)
        n = next_fast_len(_STEPS_A_CYCLE * (int(slot[-1]) + 1))
        out = np.zeros(relative.size)
        # One after the other: all at once are too large for a day.
        for hz, spectra in zip(self.hz, self.others, strict=True):
            at_times = np.zeros((n, spectra.shape[1]), dtype=complex)
            np.add.at(at_times, slot, spectra)
            phases = np.rint(hz * relative * step_s * n).astype(int)
            out += self._likelihood(n * ifft(at_times, axis=0)[phases, None])
        return out

    def _likelihood(self, coherent: Annotated[ComplexArray, "... bins others"]) -> Array:
        """Sum up the log likelihood from the coherent sums over the segments."""
        incoherent = np.maximum(1.0 - (np.abs(coherent) ** 2).sum(axis=-1), np.finfo(float).eps)
        freedom = self.t_s.size - self.others.shape[2]  # the others' coefficients are fitted
        return np.asarray(-information_weight() * freedom * np.log(incoherent).sum(axis=-1))


def correct_clock_drifts(segments: Segments, settings: DiagnosisSettings) -> tuple[Segments, tuple[ClockDrift, ...]]:
    """Correct the segments for channels whose clocks drift from the others'; return them and the drifts, most significant first.

    The delay of such a channel grows from segment to segment, which turns the phase of its cross-spectra in proportion to
    frequency and time.  The rate that makes the channels most coherent is the most probable one, whatever the structure: the
    likelihood is that of normal segments whose covariance is free at each frequency.  Its gain must exceed the margin of a cause.
    The clocks are taken to agree at the recording's start.  A drift of less than a sample over the recording is none: sensors are
    not synchronized better.

    References
    ----------
    C. Knapp, G. Carter, The generalized correlation method for estimation of time delay, IEEE Transactions on Acoustics,
    Speech, and Signal Processing 24 (1976) 320 (the likelihood of a delay from the coherence).
    """
    drifts: list[ClockDrift] = []
    streams = segments.values.shape[2] + len(segments.drive.inputs)
    n, bins = segments.values.shape[:2]
    least = settings.margin + 0.5 * np.log(n * bins * information_weight())
    while n > streams >= _MIN_STREAMS + len(drifts):
        found = max(_estimate_drifts(segments), key=lambda d: d.log_likelihood_gain)
        moved_s = abs(found.relative) * np.ptp(segments.t_s)
        known = [d.channel for d in drifts]
        if found.log_likelihood_gain < least or moved_s * segments.rate_hz < 1.0 or found.channel in known:
            break
        # A drift also stretches the motion within a segment; what is left of that is no second drift.
        least = max(least, settings.share * found.log_likelihood_gain)
        segments = _turned(segments, found)
        drifts.append(found)
    return segments, tuple(drifts)


def state_clock_drifts(diagnosis: Diagnosis, drifts: tuple[ClockDrift, ...]) -> Diagnosis:
    """Add the drifts to what is wrong beside the causes, which the verdict then says."""
    if not drifts:
        return diagnosis
    channels, drive = diagnosis.posterior.context.channels, diagnosis.posterior.observed.drive
    said = tuple(
        LackOfFit(
            where=f"clock of {_named(d, channels, drive)}",
            size=abs(d.relative) / d.std,
            says=clock_drift_in_words(d, channels, drive),
            changes=True,
            is_explained=True,
        )
        for d in drifts
    )
    return replace(
        diagnosis, verdict="unexplained", misfit=(*said, *diagnosis.misfit), left_over=(*said, *diagnosis.left_over)
    )


def clock_drift_in_words(drift: ClockDrift, channels: Sequence[str], drive: Drive) -> str:
    """State a drift of one of `channels`, or of a measured input's, in words."""
    of = _named(drift, channels, drive)
    grows, fast = ("grows", "fast") if drift.relative > 0.0 else ("falls", "slow")
    size = abs(drift.relative)
    return f"the delay of {of} {grows} by {1e3 * size:.2g} ms a second: its clock runs {100.0 * size:.2g} % {fast}"


def _named(drift: ClockDrift, channels: Sequence[str], drive: Drive) -> str:
    return [
        *(f"channel {name}" for name in channels),
        *("the ground" if one.floor is None else f"force {one.name}" for one in drive.inputs),
    ][drift.channel]


def _estimate_drifts(segments: Segments) -> list[ClockDrift]:
    """Estimate the rate of each channel's clock as if those of the others were right."""
    streams = segments.with_inputs()
    hz, c = segments.band.hz, streams.shape[2]
    step = 1.0 / (_STEPS_A_CYCLE * hz[-1] * np.ptp(segments.t_s))
    # A faster drift would move half a cycle within one segment, which is then incoherent in itself.
    most = int(0.5 * segments.band.bin_hz / (hz[-1] * step))
    trials = step * np.arange(-most, most + 1)
    power = np.einsum("sfa,sfa->fa", streams, streams.conj()).real
    streams = streams / np.sqrt(np.maximum(power, np.finfo(float).tiny))
    out = []
    for j in range(c):
        own, others = streams[:, :, j], np.delete(streams, j, axis=2)
        spectra = np.einsum("sfa,sfb->fab", others, others.conj()) + 1e-12 * np.eye(c - 1)
        whitened = np.einsum("fla,sfa->sfl", np.linalg.inv(np.linalg.cholesky(spectra)), others)
        cross = np.einsum("sfl,sf->fsl", whitened.conj(), own)
        profile = _Profile(cross, hz, segments.t_s, 1.0 / segments.band.bin_hz)
        relative, std = _refine(profile, float(trials[profile.over(trials).argmax()]), step)
        out.append(ClockDrift(j, relative, std, profile.at(relative) - profile.at(0.0)))
    return out


def _refine(profile: _Profile, near: float, step: float) -> tuple[float, float]:
    """Find the maximum of the likelihood within a step of a rate; return that rate and its standard deviation."""
    from scipy.optimize import minimize_scalar  # takes a while to load

    relative = float(
        minimize_scalar(
            lambda rate: -profile.at(rate), bounds=(near - step, near + step), options={"xatol": _RESOLUTION * step}
        ).x
    )
    h = _RESOLUTION * step
    low, middle, high = (profile.at(relative + d) for d in (-h, 0.0, h))
    return relative, float(h / np.sqrt(max(2.0 * middle - low - high, np.finfo(float).tiny)))


def _turned(segments: Segments, drift: ClockDrift) -> Segments:
    """Turn a channel's phase back to the others' clock; for an input, all channels' to the input's."""
    values = segments.values.copy()
    phase = 2.0 * np.pi * segments.band.hz * segments.t_s[:, None] * drift.relative
    if drift.channel < values.shape[2]:
        values[:, :, drift.channel] *= np.exp(1j * phase)
    else:
        values *= np.exp(-1j * phase)[:, :, None]
    return replace(segments, values=values)
