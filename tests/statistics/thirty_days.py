"""Thirty days of weather over the paper's frame, with and without a temperature channel.

    .venv/bin/python -m tests.statistics.thirty_days [DAYS] [SEED] [PLOT.png]

The air swings by +-10 K a day, over a slow wave of +-4 K and a drift of 5 K; the frame follows it after 15 minutes and
its stiffness changes by 1.5e-3 a kelvin.  Raw: 400 s of samples each hour (10 % noise), through the whole pipeline.  Twin:
readings every 10 s, drawn with the covariance that the raw ones state, overlapping as windows do; what the channel
explains and what calibration got wrong are the raw run's own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import TEMPERATURE, SampleBlock
from monitor.core import WHOLE, DamageReading, WindowResult
from monitor.damage import Baseline, CovariateLaw, alarm, damage_index, law_lines
from monitor.pipeline import Pipeline
from monitor.signals import LAGS_S
from tests.statistics import figures
from tests.statistics.estimates import configuration
from tests.support.campaign import words
from tests.support.simulated import ambient, learned, seeded, windows_of

HOUR_S, DAY_S, WINDOW_S, HOP_S = 3600, 86_400, 400, 10
RATE_HZ, BURN_IN_S = 200.0, 5.0
PER_DEGC, LAG_S, MEAN_DEGC = 1.5e-3, 900.0, 15.0
WAVES = ((10.0, 1.0, -0.375), (4.0, 11.0, 0.1))
"""Amplitude (K), period (days), phase (turns)."""
DRIFT_K_PER_DAY = 5.0 / 30.0
CONFIG = configuration(float(WINDOW_S))
NO_LOSS = np.zeros(3)


def weather(t_s: np.ndarray, lag_s: float = 0.0) -> np.ndarray:
    """Temperature in degC, of the air or behind a first-order lag."""
    omega = [2.0 * np.pi / (period * DAY_S) for _, period, _ in WAVES]
    slow = MEAN_DEGC + DRIFT_K_PER_DAY * (t_s - lag_s) / DAY_S
    return slow + sum(
        a * (np.exp(1j * (w * t_s + 2.0 * np.pi * phase)) / (1.0 + 1j * w * lag_s)).imag
        for (a, _, phase), w in zip(WAVES, omega, strict=True)
    )


def healthy_ratio(t_s: np.ndarray) -> np.ndarray:
    """Stiffness over that at `MEAN_DEGC`, at the end of windows."""
    return np.exp(PER_DEGC * (weather(t_s - 0.5 * WINDOW_S, LAG_S) - MEAN_DEGC))


def raw(hours: range, seed: int, loss: np.ndarray = NO_LOSS) -> list[WindowResult]:
    """A window of samples each hour through the pipeline, without a baseline."""
    pipeline = Pipeline(CONFIG)
    results: list[WindowResult] = []
    for hour in hours:
        minutes = hour * HOUR_S + 60 * np.arange(60)
        degc = weather(minutes)[:, None].astype(np.float32)
        pipeline.push(
            SampleBlock(TEMPERATURE, hour * HOUR_S * 10**9, int(minutes[0]) // 60, 1 / 60, ("air",), "degC", degc)
        )
        end_s = hour * HOUR_S + WINDOW_S
        left = healthy_ratio(np.array(end_s)) * (1.0 - loss)
        floors = ambient(CONFIG.model(), WINDOW_S, RATE_HZ, seeded(seed, hour), loss=1.0 - left, lead_s=BURN_IN_S)
        results += windows_of(pipeline, floors, RATE_HZ, first=round(hour * HOUR_S * RATE_HZ))
    return [r for r in results if r.modes is not None]


def calibrated(windows: list[WindowResult], channel: bool) -> Baseline:
    span_ns = (windows[0].t_end_ns - WINDOW_S * 10**9, windows[-1].t_end_ns)
    return learned(CONFIG, windows, units={"temperature": "degC"} if channel else None, span_ns=span_ns)


@dataclass(frozen=True)
class Watch:
    """Readings of a stretch of time and what was announced."""

    t_s: np.ndarray
    ddi: np.ndarray
    std: np.ndarray
    story_alarms: tuple[tuple[float, int], ...]
    """Time and story of every window with an announced story."""
    whole_alarms: int
    covariance: np.ndarray
    """Mean over windows."""


def watch(readings: list[tuple[int, DamageReading]]) -> Watch:
    """The alarm over readings at their times."""
    state, stories, whole = alarm.start(3), [], 0
    for t_ns, reading in readings:
        state, verdict = alarm.step(state, reading, t_ns, CONFIG.alarm)
        stories += [(t_ns * 1e-9, story) for story in verdict.active if story != WHOLE]
        whole += WHOLE in verdict.active
    return Watch(
        np.array([t_ns for t_ns, _ in readings]) * 1e-9,
        np.array([r.ddi for _, r in readings]),
        np.array([r.ddi_std for _, r in readings]),
        tuple(stories),
        whole,
        np.mean([r.covariance for _, r in readings], axis=0),
    )


def readings(windows: list[WindowResult], baseline: Baseline) -> list[tuple[int, DamageReading]]:
    known = baseline.model, baseline, CONFIG.instrumented().sensor_matrix, CONFIG.updating
    felt = [None if baseline.law is None else baseline.law.expected(r.covariates) for r in windows]
    return [
        (r.t_end_ns, damage_index.step(r.modes, *known, effect)[1])
        for r, effect in zip(windows, felt, strict=True)
        if r.modes is not None
    ]


def effects(t_s: np.ndarray, law: CovariateLaw) -> list[Any]:
    """What the law predicts at the end of windows."""
    felt = weather(t_s - 0.5 * WINDOW_S - CONFIG.temperature.patience_s, law.axes[0].lag_s)
    return [law.expected({"temperature": np.full(len(LAGS_S), degc)}) for degc in felt]


def explained(t_s: np.ndarray, baseline: Baseline, onset_s: float, loss: np.ndarray) -> np.ndarray:
    """The index that windows without noise would read, shape (n, 3): what temperature leaves unexplained, and a loss."""
    expected = np.zeros((t_s.size, 3))
    if baseline.law is not None:
        expected = np.array([effect.relative for effect in effects(t_s, baseline.law)])
    ramp = np.clip((t_s - onset_s) / WINDOW_S, 0.0, 1.0)[:, None] * loss
    begin_s, end_s = (t_ns // 10**9 for t_ns in baseline.span_ns)
    at_calibration = healthy_ratio(np.arange(begin_s + WINDOW_S, end_s + 1, HOUR_S)).mean()
    return 1.0 - healthy_ratio(t_s)[:, None] * (1.0 - ramp) / (at_calibration * (1.0 + expected))


def twin(
    days: tuple[float, float], like: DamageReading, baseline: Baseline, seed: int, loss: np.ndarray = NO_LOSS
) -> Watch:
    """Readings every 10 s from one day to another; a loss begins half way."""
    t_s = np.arange(days[0] * DAY_S + WINDOW_S, days[1] * DAY_S, HOP_S)
    mean = explained(t_s, baseline, 0.5 * DAY_S * sum(days), loss)
    own = like.covariance - like.common_covariance
    per_window = WINDOW_S // HOP_S
    rng = np.random.default_rng(seed)
    white = rng.multivariate_normal(np.zeros(3), own / per_window, t_s.size + per_window)
    sums = np.cumsum(white, axis=0)
    noise = sums[per_window:] - sums[:-per_window] + rng.multivariate_normal(np.zeros(3), like.common_covariance)
    made = []
    added = [0.0] * t_s.size if baseline.law is None else [e.covariance for e in effects(t_s, baseline.law)]
    for t, ddi, more in zip(t_s, mean + noise, added, strict=True):
        common = like.common_covariance + more
        made.append((round(t * 1e9), replace(like, loss=ddi, covariance=own + common, common_covariance=common)))
    return watch(made)


LOSS = np.array([0.0, 0.05, 0.0])


@dataclass(frozen=True)
class Case:
    """What thirty days said with or without the channel; `raw` hourly, `twin` every 10 s."""

    baseline: Baseline
    raw: Watch
    twin: Watch
    unexplained: np.ndarray
    """Of the raw windows: (reading - twin's mean) / stated standard deviation, shape (n, 3)."""
    raw_loss: Watch
    twin_loss: Watch
    onset_s: float
    """Of the losses, of `LOSS`."""

    def report(self) -> str:
        """Figures, a line each."""
        r, t, z, loss_percent = self.raw, self.twin, self.unexplained, 100 * LOSS.max()
        beyond = int((np.abs(r.ddi / r.std) > 5.0).any(axis=1).sum())
        return (
            f"{law_lines(self.baseline.law)[0]}\n"
            f"  raw windows {len(r.t_s)}: DDI {_spread(r.ddi)} %, |z| > 5 in {beyond}; "
            f"windows with a story alarm {len(r.story_alarms)}, of the whole structure {r.whole_alarms}\n"
            f"  raw less twin's mean, over stated deviation: RMS {np.round(np.sqrt((z**2).mean(axis=0)), 2)}, "
            f"mean {np.round(z.mean(axis=0), 2)}\n"
            f"  twin windows {len(t.t_s)}: DDI {_spread(t.ddi)} %; with a story alarm {len(t.story_alarms)}, "
            f"of the whole structure {t.whole_alarms}\n"
            f"  loss of {loss_percent:.0f} % in story 2: raw {self._found(self.raw_loss)}, twin {self._found(self.twin_loss)}"
        )

    def _found(self, w: Watch) -> str:
        """When story 2 was announced after the onset, and what else was."""
        after = [t - self.onset_s for t, story in w.story_alarms if story == 2 and t > self.onset_s]
        wrong, first = len(w.story_alarms) - len(after), min(after, default=np.nan)
        return f"announced {first:.0f} s after the onset, {wrong} wrong windows"


def _spread(ddi: np.ndarray) -> str:
    return f"{100 * ddi.min():+.2f} to {100 * ddi.max():+.2f}, deviation {np.round(100 * ddi.std(axis=0), 3)}"


def month(
    days: int, seed: int, calibration_days: int = 2, loss_hours: int = 24, twin_days: float = np.inf
) -> dict[str, Case]:
    """Calibrate on the first days, then watch the rest; a second run loses stiffness in its last third."""
    n_calm = 24 * calibration_days
    onset_hour = n_calm + (24 * days - n_calm) * 2 // 3
    onset_s = float(onset_hour * HOUR_S)
    windows = raw(range(24 * days), seed)
    hurt = windows[n_calm:onset_hour] + raw(range(onset_hour, min(onset_hour + loss_hours, 24 * days)), seed + 1, LOSS)
    out = {}
    for name in ("with the channel", "without it"):
        b = calibrated(windows[:n_calm], name == "with the channel")
        plain = [r for _, r in readings(windows[n_calm : n_calm + 48], replace(b, law=None))]
        ddi, common = (np.mean([getattr(r, of) for r in plain], axis=0) for of in ("covariance", "common_covariance"))
        like = replace(plain[0], covariance=ddi, common_covariance=common)
        seen = watch(readings(windows[n_calm:], b))
        around = onset_s / DAY_S - 0.1, onset_s / DAY_S + 0.1
        out[name] = Case(
            baseline=b,
            raw=seen,
            twin=twin((calibration_days, min(days, calibration_days + twin_days)), like, b, seed + 2),
            unexplained=(seen.ddi - explained(seen.t_s, b, np.inf, NO_LOSS)) / np.sqrt(np.diag(ddi)),
            raw_loss=watch(readings(hurt, b)),
            twin_loss=twin(around, like, b, seed + 3, LOSS),
            onset_s=onset_s,
        )
    return out


def draw(result: dict[str, Case], path: Path) -> None:
    """The index of each story over the days, with and without the channel, under the temperature."""
    with figures.figure(path, 4, (12.0, 8.0)) as panels:
        for row, axes in enumerate(panels):
            for (name, case), colour in zip(result.items(), (figures.BLUE, figures.RED), strict=True):
                w = case.raw
                if row:
                    axes.plot(w.t_s / DAY_S, 100.0 * w.ddi[:, row - 1], color=colour, label=name)
                elif colour == figures.BLUE:
                    axes.plot(w.t_s / DAY_S, weather(w.t_s), color=figures.GREY, label="air")
            axes.set_ylabel(f"DDI story {row}, %" if row else "degC")
        panels[-1].set_xlabel("day")


def main() -> None:
    """Print the figures and draw them where a file is named."""
    days, seed, plot = words(30, 20261201, "")
    with threadpool_limits(limits=1):
        outcome = month(days, seed)
    print("\n".join(f"{name}: {case.report()}" for name, case in outcome.items()))
    if plot:
        draw(outcome, Path(plot))


if __name__ == "__main__":
    main()
