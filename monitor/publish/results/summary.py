"""Summary of a run: its counts, its alarm episodes at their highest level, and the quality of its data."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from monitor.core import WHOLE, Gap, ModalEstimate, WindowResult, storey_of
from monitor.damage import Course, Known, Loss, WindowFacts, follow
from monitor.signals import Health

_SAME_MODE = 0.02
"""Relative difference of two frequencies below which they are one mode without counterpart in the model. [ratio; judgement]"""
_COMMON_MODE = 0.1
"""Least number of windows of a mode in the summary, over that of the mode found most often. [ratio; judgement]"""


@dataclass(slots=True)
class Summary:
    """Count windows, gaps and alarm episodes of a run; `content` is the core of summary.json.

    Examples
    --------
    >>> summary = Summary()
    >>> summary.gap(Gap(t_ns=0, duration_s=2.0, reason="sequence jumped"))
    >>> content = summary.content(realtime_factor=1234.56, model_frequencies_hz=[5.2])
    >>> content["gaps"], content["windows"], content["realtime_factor"]
    (1, 0, 1234.6)
    """

    course: Course = field(default_factory=Course)
    """The windows, as far as the state depends on them, and the alarm episodes."""
    gaps: int = 0
    dropped_samples: int = 0
    modes: dict[int, tuple[int, float]] = field(default_factory=dict)
    """Number of windows and mean natural frequency, Hz, of each of the model's modes, 1 = lowest."""
    other_modes: list[tuple[int, float]] = field(default_factory=list)
    """The same of the modes that the model has no counterpart for."""
    missing_modes: dict[int, str] = field(default_factory=dict)
    """Why a mode of the model, 1 = lowest, was not found when this last happened."""
    temperature_range_degc: tuple[float, float] | None = None
    """Lowest and highest mean temperature of a window, degC."""

    def gap(self, gap: Gap) -> None:
        """Count a gap."""
        self.gaps += 1

    def window(self, result: WindowResult, facts: WindowFacts, known: Known, stated: WindowFacts | None = None) -> None:
        """Count a window by what the state needs of its line.

        What an earlier run `stated` of this window counts where it says otherwise of whether the window was judged, as when
        samples of the window were lost with that run.
        """
        if stated is not None and stated.skipped != facts.skipped:
            facts = stated
        self.course = follow(self.course, facts, known)
        if result.temperature is not None:
            degc = float(result.temperature.lagged_degc[0])
            low, high = self.temperature_range_degc or (degc, degc)
            self.temperature_range_degc = min(low, degc), max(high, degc)
        if result.modes is not None:
            self._average(result.modes)

    def _average(self, found: ModalEstimate) -> None:
        """Update the running means of the natural frequencies."""
        for mode, hz in zip((found.model_mode + 1).tolist(), found.frequencies_hz.tolist(), strict=True):
            self.modes[mode] = _with_value(self.modes.get(mode, (0, 0.0)), hz)
        counted = set[int]()  # two modes of a window are two, however close
        for other in found.others:
            means = enumerate(mean for _, mean in self.other_modes)
            near = {i: abs(other.frequency_hz / mean - 1.0) for i, mean in means if i not in counted}
            nearest = min(near, key=near.__getitem__, default=-1)
            counted.add(nearest if (alike := near.get(nearest, 1.0) < _SAME_MODE) else len(self.other_modes))
            if alike:
                self.other_modes[nearest] = _with_value(self.other_modes[nearest], other.frequency_hz)
            else:
                self.other_modes.append((1, other.frequency_hz))
        self.missing_modes |= {mode + 1: why for mode, why in found.missing}

    def content(
        self, realtime_factor: float, model_frequencies_hz: list[float], names: Sequence[str] = ()
    ) -> dict[str, Any]:
        """Return the counts for summary.json.

        `realtime_factor` is the length of the data over the time of their evaluation; without a model there are no
        frequencies of it.  The `names` are those of the stories.
        """
        most = max((n for n, _ in [*self.modes.values(), *self.other_modes]), default=0)
        means = {mode: hz for mode, (n, hz) in sorted(self.modes.items()) if n >= _COMMON_MODE * most}
        misfit = [hz / model_frequencies_hz[mode - 1] - 1.0 for mode, hz in means.items() if model_frequencies_hz]
        others = sorted((hz, n) for n, hz in self.other_modes if n >= _COMMON_MODE * most)
        return {
            "windows": self.course.windows,
            "skipped": self.course.skipped,
            "skip_reasons": self.course.skip_reasons,
            "alarms": [episode_content(loss, names) for loss in self.course.losses],
            "channels_left_out": [asdict(outage) for outage in self.course.outages],
            "dropped_samples": self.dropped_samples,
            "gaps": self.gaps,
            "realtime_factor": round(realtime_factor, 1),
            "frequencies_hz": list(means.values()) or None,
            "model_modes": list(means) or None,
            "structure_file_frequencies_hz": model_frequencies_hz,
            "frequency_misfit": misfit or None,
            "other_modes": [{"frequency_hz": hz, "windows": n} for hz, n in others],
            "missing_modes": [why for mode, why in sorted(self.missing_modes.items()) if mode not in means],
            "temperature_range_degc": self.temperature_range_degc,
        }


def _with_value(mean: tuple[int, float], value: float) -> tuple[int, float]:
    count, share = mean[0] + 1, 1.0 / (mean[0] + 1)
    return count, mean[1] + share * (value - mean[1])


def episode_content(loss: Loss, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return an alarm episode as it stands in summary.json; `story` is None for the whole structure, and of modes alone.

    In a building, whose stiffnesses have `names`, it is the storey's number, `direction` its direction, and `index` the number of
    its stiffness in the lists of a line, from 1.

    Of modes alone `part` is the number of what changed (`damage.modal_parts`), and `change` its size in place of a loss.
    """
    content = asdict(loss) | {"level": loss.level.value, "story": None if loss.story == WHOLE else loss.story}
    del content["modal"]
    if loss.modal:
        size, std = content.pop("ddi"), content.pop("ddi_std")
        content |= {"story": None, "part": loss.story, "change": size, "change_std": std, "ddi": None, "ddi_std": None}
    elif 0 < loss.story <= len(names) and (place := storey_of(names[loss.story - 1])) is not None:
        content |= {"story": place[0], "direction": place[1], "index": loss.story}
    return content


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
        channels = ((c.channel, c.rms_m_s2, c.spikes, c.repeated, c.clipped) for c in health.channels)
        self.add_span(health.samples, health.rate_hz, channels)
        self.gaps, self.overlaps = self.gaps + health.gaps, self.overlaps + health.overlaps
        self.lost_s += health.lost_s

    def add_span(self, samples: int, rate_hz: float, channels: Iterable[tuple[str, float, int, float, float]]) -> None:
        """Add the samples of a span and, of each channel, its name, RMS, spikes and shares repeated and clipped."""
        seconds = samples / rate_hz
        self.samples, self.seconds = self.samples + samples, self.seconds + seconds
        for name, rms_m_s2, spikes, repeated, clipped in channels:
            total = self.channels.setdefault(name, dict.fromkeys(("power", "spikes", "stuck_s", "clipped"), 0.0))
            total["power"] += rms_m_s2**2 * seconds
            total["spikes"] += spikes
            total["stuck_s"] += seconds if repeated == 1.0 else 0.0
            total["clipped"] += clipped * samples

    def content(self) -> dict[str, Any]:
        """Return the table `quality` of summary.json."""
        channels = {
            name: {
                "rms_m_s2": float(np.sqrt(c["power"] / max(self.seconds, 1e-9))),
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
