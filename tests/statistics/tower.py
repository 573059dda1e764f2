"""Three weeks of a real mast: what temperature and level explain of each mode, and what a test for a change says of the rest.

    .venv/bin/python -m tests.statistics.tower [TRAINING_DAYS]

Nothing is known to have happened to the mast: what is announced counts as false.  Modes are those that the tracker follows
through the three weeks (`tests/data/tower-modal`).  So that a loss that is there would be found is shown as well, all
frequencies of the last five days are lowered by 1 %.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass

import numpy as np

from monitor.core import Level, WindowResult
from monitor.damage import FeatureJudge, FeatureTable, judge_features
from tests.support.campaign import words
from tests.support.tower import DAY_NS, TOWER, Tower

LEVEL = TOWER.with_name("level.csv")
LOSS, LOSS_DAYS = 0.01, 5


def table(lowered: float = 0.0, least_share: float = 0.5) -> FeatureTable:
    """Return the frequencies of the modes that were seen in this share of the hours, with temperature and level of motion."""
    tower = Tower()
    t_ns = np.asarray(tower.t_ns, dtype=np.int64)
    with LEVEL.open() as file:
        rms = np.array([float(row["rms_m_s2"] or "nan") for row in csv.DictReader(file)])
    hz = {}
    for number in tower.tracks:
        of = tower.track == number
        values = np.full(t_ns.size, np.nan)
        values[tower.look[of]] = tower.f[of]
        values[t_ns > t_ns[-1] - LOSS_DAYS * DAY_NS] *= 1.0 - lowered
        if np.isfinite(values).mean() >= least_share:
            hz[f"{np.nanmedian(values):.3f} Hz"] = values
    return FeatureTable(t_ns, hz, {"temperature": tower.temperature.astype(float), "level": 20.0 * np.log10(rms)})


@dataclass(frozen=True)
class Weeks:
    """What was learned and said."""

    judge: FeatureJudge
    healthy: list[WindowResult]
    lowered: list[WindowResult]

    def announced(self) -> int:
        """Count the hours at which something was announced falsely."""
        return sum(v.alarm.level is not Level.NORMAL for v in self.healthy)

    def delay_h(self) -> float | None:
        """Time to the first warning after all frequencies fell, h."""
        onset_ns = self.lowered[-1].t_end_ns - LOSS_DAYS * DAY_NS
        return next(
            (
                (v.t_end_ns - onset_ns) / 3.6e12
                for v in self.lowered
                if v.t_end_ns > onset_ns and v.alarm.level is Level.WARNING
            ),
            None,
        )


def weeks(training_days: float = 12.0) -> Weeks:
    """Learn on the first days and judge the rest."""
    whole = table()
    until_ns = int(whole.t_ns[0] + training_days * DAY_NS)
    judge, healthy = judge_features(whole, until_ns)
    return Weeks(judge, healthy, judge_features(table(LOSS), until_ns)[1])


def main() -> None:
    found = weeks(*words(12.0))
    for model in found.judge.models:
        print(
            f"{model.name}: {model.readings} hours learned from, {100 * model.explained:.0f} % of the variance explained, "
            f"{100 * model.std:.3f} % left (one standard deviation)"
        )
    judged = sum(v.skipped is None for v in found.healthy)
    print(f"{judged} of {len(found.healthy)} hours judged, {found.announced()} announced")
    print(f"all frequencies 1 % lower for {LOSS_DAYS} days: first warning after {found.delay_h()} h")


if __name__ == "__main__":
    main()
