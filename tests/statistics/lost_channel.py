"""A sensor of the paper's frame fails for a day, with and without a loss of stiffness that begins at noon.

    .venv/bin/python -m tests.statistics.lost_channel OUT.jsonl [--seeds 100:105] [--faults nan,still,...] [--losses 0,0.05,0.1]

Each run: one healthy hour for the baseline; then 3 h with all sensors, 24 h in which one of them gives nothing true, 3 h with all
of them again; windows of 400 s each 200 s, 10 % noise.  A loss begins in the middle of the 24 h.  The runs that OUT.jsonl holds
are not made again, and its table is printed at the end.
"""

from __future__ import annotations

import argparse
import itertools
from collections import defaultdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import Array, DamageReading, Level
from monitor.damage import Baseline
from monitor.pipeline import Pipeline
from tests.statistics.estimates import configuration
from tests.support.campaign import gone_on_with
from tests.support.simulated import ambient, learned, seeded, windows_of

HOUR_S, RATE_HZ, BLOCK, T0_NS = 3600, 100.0, 6000, 10**18
BEFORE_H, DURING_H, AFTER_H = 3, 24, 3
FAULTS = ("nan", "still", "noise", "drift", "stuck")
SITE = configuration(200.0, rate_hz=RATE_HZ)
"""The frame, with a hop that spares time."""


@lru_cache(maxsize=6)
def motion(hours: float, seed: tuple[int, int], loss: tuple[float, ...] = (0.0,)) -> Array:
    """Accelerations of the floors, from the frame at rest; all faults of a seed share them."""
    return ambient(SITE.model(), hours * HOUR_S, RATE_HZ, seeded(*seed), loss=loss)


def spoil(x: Array, fault: str, seed: int) -> Array:
    """What a sensor gives instead of its motion `x`, shape (n,)."""
    rng = np.random.default_rng([seed, 7])
    if fault == "drift":  # as much a sample as the motion itself, forty times within a window
        return np.asarray(x + np.cumsum(rng.normal(scale=x.std(), size=x.size)))
    if fault == "noise":
        return rng.normal(scale=0.3 * x.std(), size=x.size)
    return np.full(x.size, {"nan": np.nan, "still": 0.0, "stuck": x[0]}[fault])


@lru_cache(maxsize=1)
def baseline(seed: int) -> Baseline:
    """Learn the healthy state from one hour."""
    pipeline = Pipeline(SITE)
    seen = windows_of(pipeline, motion(1.0, (seed, 0)), RATE_HZ, t0_ns=T0_NS, size=BLOCK)
    return learned(SITE, seen, level_of=pipeline, span_ns=(T0_NS, T0_NS + HOUR_S * 10**9), motion=True)


def one(fault: str, loss: float, seed: int) -> dict[str, Any]:
    """Make one run and count what it told; every channel and every story has its turn."""
    number = seed + FAULTS.index(fault)
    channel, story = number % 3, (number // 3 + FAULTS.index(fault)) % 3 + 1
    name, lost = SITE.channels[channel], tuple(loss if j == story else 0.0 for j in (1, 2, 3))
    lengths, losses = (BEFORE_H, DURING_H / 2, DURING_H / 2, AFTER_H), ((0.0,), (0.0,), lost, lost)
    samples = np.concatenate(
        [motion(hours, (seed, k + 1), of) for k, (hours, of) in enumerate(zip(lengths, losses, strict=True))]
    )
    begin, end = (round(h * HOUR_S * RATE_HZ) for h in (BEFORE_H, BEFORE_H + DURING_H))
    samples[begin:end, channel] = spoil(samples[begin:end, channel], fault, seed)
    results = windows_of(Pipeline(SITE, baseline(seed)), samples, RATE_HZ, t0_ns=T0_NS, size=BLOCK)
    t_h = np.array([(r.t_end_ns - T0_NS) / 3.6e12 for r in results])
    judged = np.array([r.damage is not None for r in results])
    names = [[gone.channel for gone in r.left_out] for r in results]
    out = np.array([left == [name] for left in names])
    window_h = 400.0 / HOUR_S
    onset_h, back_h = BEFORE_H + DURING_H / 2, BEFORE_H + DURING_H
    phases = {
        "before": t_h <= BEFORE_H,
        "during": (t_h >= BEFORE_H + window_h) & (t_h <= back_h),
        "after": t_h >= back_h + window_h + 1e-6,
    }
    told = [(float(t), list(r.alarm.stories), r.alarm.level) for t, r in zip(t_h, results, strict=True)]
    announced = [(t, stories) for t, stories, level in told if level in (Level.WARNING, Level.ALARM)]
    true = [t for t, stories in announced if t > onset_h and story in stories] if loss else []
    false = [
        t
        for t, stories, level in told
        if level is not Level.NORMAL and not (loss and stories == [story] and t > onset_h)
    ]

    def read(begin_h: float, end_h: float) -> list[DamageReading]:
        return [r.damage for r, t in zip(results, t_h, strict=True) if r.damage is not None and begin_h < t <= end_h]

    def mean(rows: list[np.ndarray]) -> list[float] | None:
        return np.mean(rows, axis=0).round(5).tolist() if rows else None

    late, early, whole = read(onset_h + 2.0, back_h), read(BEFORE_H + window_h, onset_h), read(-1.0, BEFORE_H)
    return {
        "channel": name,
        "story": story,
        "judged": {phase: [int(judged[at].sum()), int(at.sum())] for phase, at in phases.items()},
        "left_out": {phase: int(out[at].sum()) for phase, at in phases.items()},
        "others_left_out": sum(bool(set(left) - {name}) for left in names),
        "told": sum(a != b for a, b in itertools.pairwise([[], *names, []])),
        "delay_h": true[0] - onset_h if true else None,
        "false": len(false),
        "false_h": false[:3],
        "read": mean([d.ddi for d in late]),
        "std": mean([d.ddi_std for d in late]),
        "std_all": mean([d.ddi_std for d in whole]),
        "healthy_read": mean([d.ddi for d in early]),
        "unidentified": sorted({j for d in late for j in d.unidentified}),
        "skips": sorted({r.skipped.reason for r in results if r.skipped is not None})[:3],
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Sum the runs up, one line for each fault and loss."""
    groups: dict[tuple[str, float], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["fault"], row["loss"]].append(row)
    lines = [
        "fault  loss  runs  judged before/during/after  changes told  false  found at its story  delay (h)  read (%)"
    ]
    for (fault, loss), group in sorted(groups.items()):
        shares = [
            f"{100 * sum(r['judged'][k][0] for r in group) / sum(r['judged'][k][1] for r in group):.0f}"
            for k in ("before", "during", "after")
        ]
        delays = [r["delay_h"] for r in group if r["delay_h"] is not None]
        read = [100 * r["read"][r["story"] - 1] for r in group if r["read"]]
        told = f"{min(r['told'] for r in group)}-{max(r['told'] for r in group)}"
        false = sum(r["false"] > 0 for r in group)
        delay = f"{np.median(delays):.2f} ({max(delays):.2f})" if delays else "-"
        says = f"{np.mean(read):.2f} ({min(read):.2f} to {max(read):.2f})" if read else "-"
        lines.append(
            f"{fault:6} {100 * loss:3.0f} %  {len(group):3}   {' / '.join(shares):12} {told:>8} {false:6} "
            f"{len(delays):4} of {len(group)}   {delay:14} {says}"
        )
    return "\n".join(lines)


def main() -> None:
    """Make the runs that are missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", default="100:105")
    parser.add_argument("--faults", default=",".join(FAULTS))
    parser.add_argument("--losses", default="0,0.05,0.1")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    tasks = [
        (fault, loss, seed)
        for seed in range(first, last)
        for loss in map(float, options.losses.split(","))
        for fault in options.faults.split(",")
    ]
    print(table(gone_on_with(options.out, ("fault", "loss", "seed"), tasks, one)))


if __name__ == "__main__":
    main()
