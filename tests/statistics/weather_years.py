"""Years of weather and storms over a frame, by a twin of its readings: false announcements, delays of losses.

    .venv/bin/python -m tests.statistics.weather_years FILE.jsonl [YEARS] [SEED]

A year in hourly windows of 400 s: temperature with seasons, days, spells and ten days of frost (slope four times that above
0 degC: some 8 %), gales up to five times the day's level (joints that give by up to 2.4, 7.2, 4.8 %, half of it at three
times), and rain (mass +0.5 %, unmeasured).  The readings scatter as the raw windows of `thirty_days`.  Calibration: the fourteen
days before.  Each year is run intact, and with 2 and with 5 % of a story lost at a random hour.  Cases: level and temperature,
level alone, no compensation.  FILE holds one line a run; what it holds is not run again.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from monitor.core.results import WHOLE, DamageReading, Level
from monitor.damage import AlarmSettings, alarm, slow_learning
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.covariates import Change, CovariateSettings, learn_law
from monitor.signals import LAGS_S

HOUR_NS, CALIBRATION_H, YEAR_H = 3_600_000_000_000, 14 * 24, 365 * 24
STD = np.array([0.0010, 0.0017, 0.0018])
"""Standard deviation of the index of a raw window (docs/temperature.md, thirty days)."""
SLOPES = np.array([1.0e-3, 1.5e-3, 0.8e-3])
FROST = 4.0
SOFT = np.array([0.024, 0.072, 0.048])
RAIN = 0.005
UNITS = {"level": ("level",), "level and temperature": ("level", "temperature"), "none": ()}
SETTINGS, ALARM = CovariateSettings(), AlarmSettings()
LOSSES = (0.0, 0.02, 0.05)
_USELESS = 0.5


def smooth(rng: np.random.Generator, n: int, hours: float) -> np.ndarray:
    """A stationary wander of unit variance."""
    decay, white, out = np.exp(-1.0 / hours), rng.standard_normal(n), np.zeros(n)
    out[0] = white[0]
    for k in range(1, n):
        out[k] = decay * out[k - 1] + np.sqrt(1.0 - decay**2) * white[k]
    return out


def weather(rng: np.random.Generator, n: int, begin_day: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Temperature (degC), level over the day's, and rain (0 or 1), hour by hour."""
    day = begin_day + np.arange(n) / 24.0
    degc = (
        10.0
        - 10.0 * np.cos(2 * np.pi * (day - 20.0) / 365.0)
        + 4.0 * np.sin(2 * np.pi * day)
        + 3.0 * smooth(rng, n, 60.0)
    )
    frost = np.clip(5.0 - np.abs((day - 25.0 + 180.0) % 365.0 - 180.0), 0.0, 1.0)
    degc -= frost * 10.0
    gale = np.clip(smooth(rng, n, 12.0) - 1.5, 0.0, None)  # a fifteenth of the time
    level = np.minimum(np.exp(0.2 * smooth(rng, n, 6.0) + 1.2 * gale), 5.0)
    return degc, level, (smooth(rng, n, 6.0) > 1.6).astype(float)


def change(degc: np.ndarray, level: np.ndarray, rain: np.ndarray) -> np.ndarray:
    """Change of ln stiffness that the weather causes, shape (n, 3)."""
    warm = np.maximum(degc, 0.0) + FROST * np.minimum(degc, 0.0)
    gives = (level**2 / (level**2 + 9.0))[:, None] * SOFT
    return np.asarray(-warm[:, None] * SLOPES + np.log1p(-gives) - RAIN * rain[:, None])


def under(degc: float, level: float, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """What is measured in a window."""
    known = {"level": np.array([20.0 * np.log10(level) - 120.0]), "temperature": np.full(len(LAGS_S), degc)}
    return {name: known[name] for name in names}


def one(year: int, seed: int, names: tuple[str, ...], loss: float) -> dict[str, object]:
    """A year of a case: what was announced, and when the loss was."""
    rng = np.random.default_rng([seed, year])
    n = CALIBRATION_H + YEAR_H
    degc, level, rain = weather(rng, n, float(rng.integers(365)))
    x = change(degc, level, rain)
    y = x + STD * rng.standard_normal((n, 3))
    onset, story = CALIBRATION_H + int(rng.integers(24 * 30, YEAR_H - 24 * 30)), int(rng.integers(3))
    if loss:
        y[onset:, story] += np.log1p(-loss)
    else:
        onset = n
    mean, healthy = y[:CALIBRATION_H].mean(axis=0), range(CALIBRATION_H)
    y -= mean
    changes = [
        Change(
            np.expm1(y[k]),
            np.diag(STD),
            tuple((True, 3 * k + j) for j in range(3)),
            under(degc[k], level[k], names),
        )
        for k in healthy
    ]
    units = {"level": "dB", "temperature": "degC"}
    law = learn_law(changes, 0.0, {name: units[name] for name in names}, SETTINGS) if names else None
    return {"year": year, "names": names, "loss": loss, **watch(law, names, degc, level, y, onset, story)}


def watch(
    law: CovariateLaw | None,
    names: tuple[str, ...],
    degc: np.ndarray,
    level: np.ndarray,
    y: np.ndarray,
    onset: int,
    story: int,
) -> dict[str, object]:
    """The alarm over a year."""
    state, verdicts = alarm.start(3, 400.0), []
    learning = None if law is None else slow_learning.start(law, CALIBRATION_H * HOUR_NS)
    common = np.diag(STD**2) / CALIBRATION_H
    skipped = 0
    for k in range(CALIBRATION_H, len(y)):
        t_ns, seen = k * HOUR_NS, under(degc[k], level[k], names)
        added, relative, beyond = np.zeros((3, 3)), np.zeros(3), ""
        if learning is not None:
            effect = learning.law.expected(seen)
            added, relative = effect.covariance, effect.relative
            hidden = ALARM.significance * float(np.sqrt(added.diagonal().max()))
            if hidden > _USELESS:
                skipped += 1
                continue
            beyond = "beyond calibration" if hidden > ALARM.alarm_loss else ""
        ddi = 1.0 - np.exp(y[k]) / (1.0 + relative)
        shared = common + added
        reading = DamageReading(ddi, np.diag(STD**2) + shared, ddi, ddi, common_covariance=shared, beyond=beyond)
        state, verdict = alarm.step(state, reading, t_ns, ALARM)
        told = {s for s, lv in verdict.active.items() if s != WHOLE and lv.rank >= Level.WARNING.rank}
        verdicts.append((k, told, WHOLE in verdict.active))
        if learning is not None:
            normal = verdict.level is Level.NORMAL
            learning = slow_learning.step(learning, seen, y[k], t_ns, SETTINGS.unevenness, normal=normal)
    before = [told for k, told, _ in verdicts if k < onset]
    begun = sum(bool(now - was) for was, now in zip([set(), *before], before, strict=False))
    found = next((k - onset for k, told, _ in verdicts if k >= onset and story + 1 in told), None)
    already = any(story + 1 in told for k, told, _ in verdicts if onset - 24 <= k < onset)
    return {
        "hours": len(before),
        "false_warnings": begun,
        "false_hours": sum(bool(told) for told in before),
        "whole_hours": sum(whole for k, _, whole in verdicts if k < onset),
        "skipped": skipped,
        "delay_h": None if already else found,
        "already": already,
    }


def report(rows: list[dict[str, object]]) -> str:
    """Figures of each case."""
    lines = []
    for case, names in UNITS.items():
        of = [r for r in rows if tuple(r["names"]) == names]  # type: ignore[arg-type]
        if not of:
            continue
        intact = [r for r in of if r["loss"] == 0.0]
        begun, hours, whole, skipped = (
            sum(int(r[key]) for r in intact)  # type: ignore[call-overload]
            for key in ("false_warnings", "false_hours", "whole_hours", "skipped")
        )
        line = f"{case}: {len(intact)} healthy years, {begun} false warnings ({hours} h), whole structure {whole} h, "
        line += f"{skipped} h skipped"
        for loss in LOSSES[1:]:
            lost = [r for r in of if r["loss"] == loss]
            delays = sorted(float(r["delay_h"]) for r in lost if r["delay_h"] is not None)  # type: ignore[arg-type]
            middle = f"{np.median(delays):.0f} h, longest {delays[-1]:.0f} h" if delays else "-"
            line += f"; {100 * loss:.0f} %: {len(delays)} of {len(lost)} found, median {middle}"
        lines.append(line)
    return "\n".join(lines)


def main() -> None:
    path = Path(sys.argv[1])
    years, seed = (int(a) for a in (*sys.argv[2:4], *("30", "2026")[len(sys.argv[2:4]) :]))
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(r["year"], tuple(r["names"]), r["loss"]) for r in rows}
    for year in range(years):
        for names in UNITS.values():
            for loss in LOSSES:
                if (year, names, loss) not in done:
                    rows.append(one(year, seed, names, loss))
                    with path.open("a") as file:
                        file.write(json.dumps(rows[-1]) + "\n")
        print(f"{year + 1} years\n{report(rows)}", flush=True)


if __name__ == "__main__":
    main()
