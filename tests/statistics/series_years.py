"""False announcements of `features` over years of each simulated series, and the delay of a change at the same limit.

    .venv/bin/python -m tests.statistics.series_years OUT.jsonl [--rate 10] [--years 30] [--change 0.01] [--only TEXT]

Each year is learned and simulated anew (`tests.support.series`), then the first feature falls for sixty days.  An announcement is
an episode at `advisory` or above.  RATE is the limit, false announcements a year; where the judge takes none yet, its constant
holds, which is said.  A year that is in OUT.jsonl is not made again; the table of all is printed at the end.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadInputError, Level, WindowResult
from monitor.damage import judge_features
from tests.support import series

DAYS = 60
"""Time for which a change is there. [days; choice]"""


def year(name: str, seed: int, change: float, rate: float) -> dict[str, Any]:
    """Judge a year and the days after it."""
    made = series.years(name, 1.0, seed, change, DAYS)
    try:
        verdicts = judge_features(made.table, made.learned_until_ns, false_announcements_per_year=rate)[1]
    except BadInputError as error:
        return {"episodes": 0, "confirmed": 0, "readings": 1, "judged": 0, "delay_h": math.inf, "refused": str(error)}
    healthy = [v for v in verdicts if v.t_end_ns < made.changed_from_ns]
    found = (v.t_end_ns for v in verdicts[len(healthy) :] if v.alarm.level.rank >= Level.WARNING.rank)
    return {
        "episodes": episodes(healthy, Level.ADVISORY),
        "confirmed": episodes(healthy, Level.WARNING),
        "readings": len(healthy),
        "judged": sum(v.skipped is None for v in healthy),
        "delay_h": (next(found, math.inf) - made.changed_from_ns) / series.HOUR_NS,
    }


def episodes(verdicts: Sequence[WindowResult], least: Level) -> int:
    """Count the times at which this level is reached from below."""
    high = np.array([v.alarm.level.rank >= least.rank for v in verdicts], dtype=int)
    return int((np.diff(high, prepend=0) == 1).sum())


def table(lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Write a row a simulator."""
    yield "| simulator | years | judged | announcements | a year | with a warning | found | median delay |"
    yield "|---|---|---|---|---|---|---|---|"
    for name, group in groupby(lines, key=lambda line: line["name"]):
        of = list(group)
        total, confirmed = sum(line["episodes"] for line in of), sum(line["confirmed"] for line in of)
        share = sum(line["judged"] for line in of) / sum(line["readings"] for line in of)
        delays = np.array([line["delay_h"] for line in of])
        middle = float(np.sort(delays)[delays.size // 2])
        yield (
            f"| {name} | {len(of)} | {100 * share:.0f} % | {total} | {total / len(of):.1f} | {confirmed} | "
            f"{np.isfinite(delays).sum()}/{len(of)} | {'never' if math.isinf(middle) else f'{middle:.0f} h'} |"
        )


def main() -> None:
    """Make the years that are not there, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--years", type=int, default=30)
    parser.add_argument("--change", type=float, default=0.01)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    keys = [(name, seed) for name in series.NATURES if given.only in name for seed in range(3000, 3000 + given.years)]
    made = {}
    if given.out.exists():
        made = {(line["name"], line["seed"]): line for line in map(json.loads, given.out.read_text().splitlines())}
    with given.out.open("a") as file:
        for name, seed in keys:
            if (name, seed) not in made:
                made[name, seed] = {"name": name, "seed": seed, **year(name, seed, given.change, given.rate)}
                print(json.dumps(made[name, seed]), file=file, flush=True)
    print(f"limit: {given.rate:g} a year")
    print("\n".join(table([made[key] for key in keys])))


if __name__ == "__main__":
    main()
