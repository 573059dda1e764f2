"""Summary of a run: its counts, its alarm episodes at their highest level, and the quality of its data."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from monitor.core import WHOLE, DamageReading, Gap, Level, WindowResult
from monitor.signals import Health


@dataclass(slots=True)
class Episode:
    """Alarm of one story from its first to its last window."""

    level: str
    story: int | None
    """None for the whole structure."""
    t_first_ns: int
    t_last_ns: int | None
    """UTC of the end of the last window; None while the alarm lasts."""
    ddi: float
    """Damage index (relative stiffness loss): the latest significant one at the highest level."""
    ddi_std: float
    loss_n_per_m: float
    """Stiffness lost, N/m."""


@dataclass(slots=True)
class Summary:
    """Counts of windows, gaps and alarm episodes of a run; `content` is the core of summary.json.

    Examples
    --------
    >>> summary = Summary()
    >>> summary.gap(Gap(t_ns=0, duration_s=2.0, reason="sequence jumped"))
    >>> content = summary.content(realtime_factor=1234.56, model_frequencies_hz=[5.2])
    >>> content["gaps"], content["windows"], content["realtime_factor"]
    (1, 0, 1234.6)
    """

    windows: int = 0
    skipped: int = 0
    gaps: int = 0
    dropped_samples: int = 0
    skip_reasons: dict[str, int] = field(default_factory=dict)
    """Number of skipped windows for each reason."""
    alarms: list[Episode] = field(default_factory=list)
    frequencies_hz: list[float] | None = None
    """Mean natural frequencies, Hz; mode 0 = lowest."""
    temperature_range_degc: tuple[float, float] | None = None
    """Lowest and highest mean temperature of a window, degC."""
    n_frequencies: int = 0
    """Number of windows in the mean `frequencies_hz`."""
    _open: dict[int, Episode] = field(init=False)

    def __post_init__(self) -> None:
        self._open = {WHOLE if e.story is None else e.story: e for e in self.alarms if e.t_last_ns is None}

    def gap(self, gap: Gap) -> None:
        """Count a gap."""
        self.gaps += 1

    def window(self, result: WindowResult) -> None:
        """Count a window, and begin, raise and end alarm episodes."""
        self.windows += 1
        if result.temperature is not None:
            degc = float(result.temperature.lagged_degc[0])
            low, high = self.temperature_range_degc or (degc, degc)
            self.temperature_range_degc = min(low, degc), max(high, degc)
        if result.skipped is not None:
            self.skipped += 1
            reason = re.sub(r" \(.*", "", result.skipped.reason)  # numbers in brackets differ between windows
            self.skip_reasons[reason] = self.skip_reasons.get(reason, 0) + 1
            return
        if result.modes is not None:
            self._average(result.modes.frequencies_hz.tolist())
        assert result.damage is not None
        active = result.alarm.active
        for story in list(self._open):
            if story not in active:
                self._open.pop(story).t_last_ns = result.t_end_ns
        for story, level in active.items():
            reading = _reading(result.damage, story)
            episode = self._open.get(story)
            if episode is None:
                episode = Episode(level.value, None if story == WHOLE else story, result.t_end_ns, None, *reading)
                self._open[story] = episode
                self.alarms.append(episode)
            elif level.rank >= Level(episode.level).rank and reading[0] > 2.0 * reading[1]:
                episode.level = level.value
                episode.ddi, episode.ddi_std, episode.loss_n_per_m = reading

    def _average(self, frequencies: list[float]) -> None:
        """Update the running mean of the natural frequencies; a different number of modes restarts it."""
        self.n_frequencies += 1
        if self.frequencies_hz is None or len(self.frequencies_hz) != len(frequencies):
            self.frequencies_hz, self.n_frequencies = frequencies, 1
            return
        share = 1.0 / self.n_frequencies
        self.frequencies_hz = [a + share * (b - a) for a, b in zip(self.frequencies_hz, frequencies, strict=True)]

    def content(self, realtime_factor: float, model_frequencies_hz: list[float]) -> dict[str, Any]:
        """Return the counts for summary.json.

        Parameters
        ----------
        realtime_factor : float
            Length of the data over the time that its evaluation took.
        model_frequencies_hz : list of float
            Natural frequencies of the structure file's model, Hz.
        """
        misfit = None
        if self.frequencies_hz is not None:
            misfit = [f / g - 1.0 for f, g in zip(self.frequencies_hz, model_frequencies_hz, strict=False)]
        return {
            "windows": self.windows,
            "skipped": self.skipped,
            "skip_reasons": self.skip_reasons,
            "alarms": [asdict(e) for e in self.alarms],
            "dropped_samples": self.dropped_samples,
            "gaps": self.gaps,
            "realtime_factor": round(realtime_factor, 1),
            "frequencies_hz": self.frequencies_hz,
            "structure_file_frequencies_hz": model_frequencies_hz,
            "frequency_misfit": misfit,
            "temperature_range_degc": self.temperature_range_degc,
        }


def _reading(damage: DamageReading, story: int) -> tuple[float, float, float]:
    """Return a story's damage index, its standard deviation and the stiffness lost in N/m.

    For the whole structure (`WHOLE`) these are the values of the story that lost least.
    """
    j = int(damage.ddi.argmin()) if story == WHOLE else story - 1
    return float(damage.ddi[j]), float(damage.ddi_std[j]), float(damage.loss_n_per_m[j])


@dataclass(slots=True)
class Quality:
    """Totals of the sensors' health over all spans of a run."""

    samples: int = 0
    gaps: int = 0
    overlaps: int = 0
    lost_s: float = 0.0
    seconds: float = 0.0
    channels: dict[str, dict[str, float]] = field(default_factory=dict)

    def add(self, health: Health) -> None:
        """Add the health of a span."""
        self.samples += health.samples
        self.gaps += health.gaps
        self.overlaps += health.overlaps
        self.lost_s += health.lost_s
        seconds = health.samples / health.rate_hz
        self.seconds += seconds
        for c in health.channels:
            total = self.channels.setdefault(c.channel, dict.fromkeys(("power", "spikes", "stuck_s", "clipped"), 0.0))
            total["power"] += c.rms_m_s2**2 * seconds
            total["spikes"] += c.spikes
            total["stuck_s"] += seconds if c.repeated == 1.0 else 0.0
            total["clipped"] += c.clipped * health.samples

    def content(self) -> dict[str, Any]:
        """Return the table `quality` of summary.json."""
        channels = {
            name: {
                "rms_m_s2": float(np.sqrt(c["power"] / self.seconds)),
                "spikes": int(c["spikes"]),
                "stuck_s": c["stuck_s"],
                "clipped_samples": round(c["clipped"]),
            }
            for name, c in self.channels.items()
        }
        wanted_s = self.seconds + self.lost_s
        return {
            "availability": self.seconds / wanted_s if wanted_s else None,
            "samples": self.samples,
            "gaps": self.gaps,
            "lost_s": self.lost_s,
            "overlaps": self.overlaps,
            "channels": channels,
        }
