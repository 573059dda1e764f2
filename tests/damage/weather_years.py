"""Years of weather and storms over a frame, by a twin of its readings: false announcements, delays of losses.

    .venv/bin/python -m tests.damage.weather_years FILE.jsonl [YEARS] [SEED] [CASE ...]

A year in hourly windows of 400 s: temperature with seasons, days, spells and ten days of frost (slope four times that above 0
degC: some 8 %), gales up to five times the day's level (joints that give by up to 2.4, 7.2, 4.8 %, half of it at three
times), rain (mass +0.5 %, unmeasured), and sensors that die and drift.  The readings scatter as the raw windows of
`thirty_days`.  Calibration: the fourteen days before.  Each year is run intact, with 2 and with 5 % of a story lost at a
random hour, with 5 % of two stories, and with 1 % of a story lost in each month from then on.  Cases: what is measured, and
what is done with the rest (`CASES`).  FILE holds one line a run; what it holds is not run again.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from monitor.core import WHOLE, Level
from monitor.damage import AlarmSettings, CovariateLaw, CovariateSettings, alarm, slow_learning
from monitor.damage.covariates import Change, learn_law
from monitor.damage.limits import Scores
from monitor.signals import LAGS_S
from tests.statistics.lag_bound import lagged
from tests.support.campaign import gone_on_with
from tests.support.results import damage_reading

HOUR_NS, CALIBRATION_H, YEAR_H = 3_600_000_000_000, 14 * 24, 365 * 24
STD = np.array([0.0010, 0.0017, 0.0018])
"""Standard deviation of the index of a raw window (docs/temperature.md, thirty days)."""
LESS = np.array([1.6, 2.8, 2.2])
"""Largest scatter of a window without one of the channels, over that of one with all (docs/running.md, fewer sensors)."""
FAILURES, LONGEST_H = 4, 72
SLOPES = np.array([1.0e-3, 1.5e-3, 0.8e-3])
FROST = 4.0
SOFT = np.array([0.024, 0.072, 0.048])
RAIN = 0.005
SETTINGS, ALARM = CovariateSettings(), AlarmSettings()
_USELESS = 0.5


class Case(NamedTuple):
    """What is measured, what is done with the rest, and what the weather does."""

    names: tuple[str, ...]
    separated: bool = True
    """What the stories do together is learned; else only a change of all alike is separated."""
    uneven: bool = False
    """The stories follow the air after 0, 0.5 and 2 h, with 4, 2 and 6 times the slope in frost."""
    looks: int = 1
    """Windows an hour."""
    calibration_h: int = CALIBRATION_H
    failing: bool = False
    """Sensors die or drift: each of the three `FAILURES` times a year, for an hour to three days."""


class Loss(NamedTuple):
    """What is lost from a random hour on."""

    size: float
    stories: int = 1
    monthly: bool = False


CASES = {
    "level and temperature": Case(("level", "temperature")),
    "level and temperature, alike": Case(("level", "temperature"), separated=False),
    "level": Case(("level",)),
    "level, alike": Case(("level",), separated=False),
    "level, uneven": Case(("level",), uneven=True),
    "level, uneven, alike": Case(("level",), separated=False, uneven=True),
    "level and temperature, failing sensors": Case(("level", "temperature"), failing=True),
    "level, failing sensors": Case(("level",), failing=True),
    "none, failing sensors": Case((), separated=False, failing=True),
    "level, 8 looks an hour": Case(("level",), looks=8),
    "level, two days of calibration": Case(("level",), calibration_h=48),
    "level, two days of calibration, alike": Case(("level",), separated=False, calibration_h=48),
    "none": Case((), separated=False),
}
LOSSES = {
    "intact": Loss(0.0),
    "2 %": Loss(0.02),
    "5 %": Loss(0.05),
    "5 % of two": Loss(0.05, 2),
    "1 % a month": Loss(0.01, monthly=True),
}


def smooth(rng: np.random.Generator, n: int, hours: float) -> np.ndarray:
    """A stationary wander of unit variance."""
    decay, white = np.exp(-1.0 / hours), rng.standard_normal(n)
    gain = np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([gain], [1.0, -decay], white, zi=[(1.0 - gain) * white[0]])[0])


def weather(rng: np.random.Generator, n: int, begin_day: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperature (degC), level over the day's, and rain (0 or 1), hour by hour."""
    day = begin_day + np.arange(n) / 24.0
    seasons, days = -10.0 * np.cos(2 * np.pi * (day - 20.0) / 365.0), 4.0 * np.sin(2 * np.pi * day)
    degc = 10.0 + seasons + days + 3.0 * smooth(rng, n, 60.0)
    frost = np.clip(5.0 - np.abs((day - 25.0 + 180.0) % 365.0 - 180.0), 0.0, 1.0)
    degc -= frost * 10.0
    gale = np.clip(smooth(rng, n, 12.0) - 1.5, 0.0, None)  # a fifteenth of the time
    level = np.minimum(np.exp(0.2 * smooth(rng, n, 6.0) + 1.2 * gale), 5.0)
    return degc, level, (smooth(rng, n, 6.0) > 1.6).astype(float)


def change(degc: np.ndarray, level: np.ndarray, rain: np.ndarray, *, uneven: bool) -> np.ndarray:
    """Change of ln stiffness that the weather causes, shape (n, 3)."""
    frost, lags_h = (np.array([4.0, 2.0, 6.0]), (0.0, 0.5, 2.0)) if uneven else (FROST, (0.0,) * 3)
    felt = np.column_stack([lagged(degc, hours) if hours else degc for hours in lags_h])
    warm = np.maximum(felt, 0.0) + frost * np.minimum(felt, 0.0)
    gives = (level**2 / (level**2 + 9.0))[:, None] * SOFT
    return np.asarray(-warm * SLOPES + np.log1p(-gives) - RAIN * rain[:, None])


def scatter(rng: np.random.Generator, n: int, *, failing: bool) -> np.ndarray:
    """Standard deviation of the index hour by hour, shape (n, 3); channels that fail after calibration are left out."""
    out = np.tile(STD, (n, 1))
    if failing:
        for begin in rng.integers(CALIBRATION_H, n, size=3 * FAILURES):
            out[begin : begin + int(LONGEST_H ** rng.random())] = STD * LESS
    return out


def under(degc: float, level: float, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """What is measured in a window."""
    known = {"level": np.array([20.0 * np.log10(level) - 120.0]), "temperature": np.full(len(LAGS_S), degc)}
    return {name: known[name] for name in names}


def one(year: int, seed: int, case: Case, loss: Loss) -> dict[str, object]:
    """A year of a case: what was announced, and when the loss was."""
    rng = np.random.default_rng([seed, year])
    n, names = CALIBRATION_H + YEAR_H, case.names
    degc, level, rain = weather(rng, n, float(rng.integers(365)))
    x = change(degc, level, rain, uneven=case.uneven)
    std = scatter(np.random.default_rng([seed, year, 2]), n, failing=case.failing)
    noise = std * rng.standard_normal((n, 3))
    y = x + noise
    onset, story = CALIBRATION_H + int(rng.integers(24 * 30, YEAR_H - 24 * 30)), int(rng.integers(3))
    lost = tuple((story + k) % 3 for k in range(loss.stories))
    if loss.monthly:
        onset = CALIBRATION_H + 30 * 24
        y[onset:, lost] += np.log1p(-loss.size * np.arange(n - onset) / 720.0)[:, None]
    elif loss.size:
        y[onset:, lost] += np.log1p(-loss.size)
    else:
        onset = n
    healthy = range(CALIBRATION_H - case.calibration_h, CALIBRATION_H)
    y -= y[healthy].mean(axis=0)
    stories = [tuple((True, 3 * k + j) for j in range(3)) for k in range(n)]
    felt = [under(degc[k], level[k], names) for k in range(n)]
    changes = [Change(np.expm1(y[k]), np.diag(STD), stories[k], felt[k], k * HOUR_NS) for k in healthy]
    units = {"level": "dB", "temperature": "degC"}
    law = learn_law(changes, 0.0, {name: units[name] for name in names}, SETTINGS) if names else None
    looked = n if case.looks > 1 else 0
    white = np.random.default_rng([seed, year, 1]).standard_normal((looked, case.looks - 1, 3))
    return watch(law, case, felt, y, std, std[:looked, None] * white - noise[:looked, None], onset, lost)


def watch(
    law: CovariateLaw | None, case: Case, felt: list[dict[str, np.ndarray]], y: np.ndarray, std: np.ndarray,
    more: np.ndarray, onset: int, lost: tuple[int, ...],
) -> dict[str, object]:  # fmt: skip
    """The alarm over a year; `more` is the difference of the noise of further windows of each hour, 400 s apart."""
    state, verdicts = alarm.start(3, 400.0), []
    learning = None if law is None else slow_learning.start(law, CALIBRATION_H * HOUR_NS)
    common, least_z = (
        np.diag(STD**2) / case.calibration_h,
        ALARM.limit(Scores(0, 3), 400.0, 3600.0 if case.looks == 1 else 400.0),
    )
    skipped = 0
    for k in range(CALIBRATION_H, len(y)):
        t_ns, seen = k * HOUR_NS, felt[k]
        added, relative, beyond, together = np.zeros((3, 3)), np.zeros(3), "", None
        if learning is not None:
            together = learning.law.together(SETTINGS.unevenness) if case.separated else None
            effect = learning.law.expected(seen)
            added, relative = effect.covariance, effect.relative
            hidden = least_z * float(np.sqrt(added.diagonal().max()))
            if hidden > _USELESS:
                skipped += 1
                continue
            beyond = "beyond calibration" if hidden > ALARM.alarm_loss else ""
        own, shared = np.diag(std[k] ** 2), common + added
        told: set[int] = set()
        whole, normal = False, True
        for look in range(case.looks):
            row = y[k] if look == 0 else y[k] + more[k, look - 1]
            ddi = 1.0 - np.exp(row) / (1.0 + relative)
            if together is not None and not beyond:
                beside = together.beside_others(ddi, own + shared)
                beyond = beside.beyond_words(ALARM.alarm_loss / least_z)
            reading = damage_reading(ddi, own + shared, common_covariance=shared, beyond=beyond)
            state, verdict = alarm.step(state, reading, t_ns + look * 400_000_000_000, ALARM, together)
            told |= {s for s, lv in verdict.active.items() if s != WHOLE and lv.rank >= Level.WARNING.rank}
            whole, normal = whole or WHOLE in verdict.active, normal and verdict.level is Level.NORMAL
        verdicts.append((k, told, whole))
        if learning is not None:
            learning = slow_learning.step(learning, seen, y[k], t_ns, SETTINGS.unevenness, normal=normal)
    numbers = {story + 1 for story in lost}
    before = [told for k, told, _ in verdicts if k < onset]
    begun = sum(bool(now - was) for was, now in zip([set(), *before], before, strict=False))
    after = [(k - onset, told) for k, told, _ in verdicts if k >= onset]
    return {
        "hours": len(before),
        "false_warnings": begun,
        "false_hours": sum(bool(told) for told in before),
        "whole_hours": sum(whole for k, _, whole in verdicts if k < onset),
        "skipped": skipped,
        "delay_h": next((h for h, told in after if numbers <= told), None),
        "told_share": float(np.mean([numbers <= told for _, told in after])) if after else None,
        "wrong_hours": sum(bool(told - numbers) for _, told in after),
        "already": any(numbers & told for k, told, _ in verdicts if onset - 24 <= k < onset),
    }


def report(rows: list[dict[str, Any]]) -> str:
    """Figures of each case."""
    lines = []
    for case in CASES:
        intact = [r for r in rows if r["case"] == case and r["loss"] == "intact"]
        if not intact:
            continue
        begun, hours, whole, skipped = (
            sum(r[key] for r in intact) for key in ("false_warnings", "false_hours", "whole_hours", "skipped")
        )
        line = f"{case}: {len(intact)} healthy years, {begun} false warnings ({hours} h), whole structure {whole} h, "
        line += f"{skipped} h skipped"
        for loss in (name for name in LOSSES if name != "intact"):
            lost = [r for r in rows if r["case"] == case and r["loss"] == loss]
            sure = [r for r in lost if not r["already"]]
            delays = sorted(r["delay_h"] for r in sure if r["delay_h"] is not None)
            middle = f"{np.median(delays):.0f} h, longest {delays[-1]:.0f} h" if delays else "-"
            line += f"; {loss}: {len(delays)} of {len(lost)} found, median {middle}"
            if lost:
                told, wrong = np.mean([r["told_share"] for r in lost]), sum(r["wrong_hours"] for r in lost)
                line += f", told {100 * told:.0f} % of the time, another story {wrong} h"
        lines.append(line)
    return "\n".join(lines)


def trial(year: int, case: str, loss: str, seed: int) -> dict[str, object]:
    return one(year, seed, CASES[case], LOSSES[loss])


def main() -> None:
    path = Path(sys.argv[1])
    years, seed = (int(a) for a in (*sys.argv[2:4], *("30", "2026")[len(sys.argv[2:4]) :]))
    for year in range(years):
        tasks = [(year, case, loss) for case in sys.argv[4:] or CASES for loss in LOSSES]
        rows = gone_on_with(path, ("year", "case", "loss"), tasks, partial(trial, seed=seed))
        print(f"{year + 1} years\n{report(rows)}", flush=True)


if __name__ == "__main__":
    main()
