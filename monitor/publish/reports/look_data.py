"""What a quick look at recordings without a model found."""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, ComplexArray, ModalEstimate, Skipped
from monitor.identification import SingleMode

G_M_S2 = 9.80665
"""Standard gravity. [m/s^2; definition]"""
_MOST_RATIO = 3.0
"""Ratio of the ends of a damping ratio's interval from which the mode is doubtful. [1; convention]"""


@dataclass(frozen=True, eq=False, slots=True)
class LookedMode:
    """Mode of a recording, identified without a model."""

    frequency_hz: float
    frequency_std_hz: float
    damping_ratio: float
    damping_std: float
    shape: Annotated[ComplexArray, "c"]
    """The largest component is 1."""
    shape_std: Annotated[Array, "c"]
    """Standard deviations of the real parts."""
    refined: bool
    """True for the maximum-likelihood estimate, False for the subspace estimate."""
    second: SingleMode | Skipped
    differs: str = ""
    """In what the two opinions differ beyond chance; empty where they agree."""
    remark: str = ""
    """Why this may be no mode of the structure; empty where nothing speaks for that."""

    @property
    def doubt(self) -> str:
        """Why the mode is doubtful, so that it has no number; empty where it is not."""
        if self.remark:
            return self.remark
        if isinstance(self.second, Skipped):
            return f"no second opinion: {self.second.reason}"
        low, high = (self.damping_ratio + side * 2.0 * self.damping_std for side in (-1.0, 1.0))
        return "" if high < _MOST_RATIO * low else f"damping is not told within a factor of {_MOST_RATIO:g}"

    @property
    def collinearity(self) -> float:
        """Modal phase collinearity: 1 where all channels move in phase or opposite, as a lightly damped structure does."""
        re, im = self.shape.real, self.shape.imag
        a, b, c = float(re @ re), float(im @ im), float(re @ im)
        return float(((a - b) ** 2 + 4.0 * c**2) / (a + b) ** 2)


@dataclass(frozen=True, eq=False, slots=True)
class LookedBand:
    """Identification at one sampling rate."""

    rate_hz: float
    band_hz: tuple[float, float]
    """Lowest and highest frequency of the modes that were looked for."""
    modes: ModalEstimate | Skipped
    second: tuple[SingleMode | Skipped, ...]
    peaks_hz: tuple[float, ...]
    """Peaks of the channels' spectra, whether or not a mode is there."""
    step_hz: float
    """Spacing of these spectra's frequencies."""


@dataclass(frozen=True, eq=False, slots=True)
class LookedRecording:
    """What a quick look found; c channels."""

    files: tuple[str, ...]
    notes: tuple[str, ...]
    """What was taken for granted."""
    t_start_ns: int
    duration_s: float
    """From the first sample to the last, gaps included."""
    rate_hz: float
    channels: tuple[str, ...]
    topics: dict[str, dict[str, Any]]
    """Channels, unit, rate and number of samples of each topic."""
    gaps: tuple[tuple[np.datetime64, float], ...]
    """UTC and length in s."""
    mean_m_s2: Annotated[Array, "c"]
    rms_m_s2: Annotated[Array, "c"]
    """About the mean, as is the peak."""
    peak_m_s2: Annotated[Array, "c"]
    hz: Annotated[Array, "bins"]
    power: Annotated[Array, "c bins"]
    """Power spectral densities, one-sided, (m/s^2)^2/Hz."""
    singular_values: Annotated[Array, "c bins"]
    """Of the spectral matrix, largest first, (m/s^2)^2/Hz."""
    n_segments: int
    """Half-overlapping segments over which the spectra are averaged."""
    spectrogram_s: tuple[float, float]
    """Begin and end of the spectrogram, s since the start."""
    spectrogram: Annotated[Array, "columns bins c"]
    """Power spectral densities over time, (m/s^2)^2/Hz."""
    bands: tuple[LookedBand, ...]
    modes: tuple[LookedMode, ...]
    """By frequency, doubtful ones too."""
    peaks_hz: tuple[float, ...]
    """Peaks of the spectra that no mode, machine or mains explains."""
    doubts: tuple[str, ...]
    """What is doubtful, one sentence each."""

    def numbered(self) -> tuple[tuple[int | None, LookedMode], ...]:
        """List the modes by frequency with their numbers; doubtful ones have none."""
        count = itertools.count(1)
        return tuple((None if mode.doubt else next(count), mode) for mode in self.modes)

    def content(self) -> dict[str, Any]:
        """Form the content of look.json, of plain values."""
        return {
            "files": list(self.files),
            "notes": list(self.notes),
            "start": str(np.datetime64(self.t_start_ns, "ns")),
            "duration_s": self.duration_s,
            "rate_hz": self.rate_hz,
            "topics": self.topics,
            "gaps": [{"at": str(at), "duration_s": length} for at, length in self.gaps],
            "channels": [
                {
                    "channel": name,
                    "mean_m_s2": float(mean),
                    "rms_m_s2": float(rms),
                    "rms_g": float(rms / G_M_S2),
                    "peak_m_s2": float(peak),
                    "peak_g": float(peak / G_M_S2),
                }
                for name, mean, rms, peak in zip(
                    self.channels, self.mean_m_s2, self.rms_m_s2, self.peak_m_s2, strict=True
                )
            ],
            "modes": [self._mode(number, mode) for number, mode in self.numbered()],
            "peaks_hz": list(self.peaks_hz),
            "doubts": list(self.doubts),
            "bands": [
                {
                    "rate_hz": band.rate_hz,
                    "band_hz": list(band.band_hz),
                    "skipped": band.modes.reason if isinstance(band.modes, Skipped) else None,
                }
                for band in self.bands
            ],
            "spectra": {
                "hz_step": float(self.hz[1]),
                "segments": self.n_segments,
                "level_db": [float(10.0 * np.log10(max(rms, 1e-300))) for rms in self.rms_m_s2],
            },
        }

    def _mode(self, number: int | None, mode: LookedMode) -> dict[str, Any]:
        second = mode.second
        return {
            "mode": number,
            "frequency_hz": mode.frequency_hz,
            "frequency_std_hz": mode.frequency_std_hz,
            "damping_ratio": mode.damping_ratio,
            "damping_std": mode.damping_std,
            "shape": {name: [float(x.real), float(x.imag)] for name, x in zip(self.channels, mode.shape, strict=True)},
            "shape_std": dict(zip(self.channels, mode.shape_std.tolist(), strict=True)),
            "collinearity": mode.collinearity,
            "refined": mode.refined,
            "second_opinion": {"skipped": second.reason} if isinstance(second, Skipped) else asdict(second),
            "differs": mode.differs,
            "remark": mode.remark,
            "doubt": mode.doubt,
        }
