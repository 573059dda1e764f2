"""A sensor of the paper's frame fails for a day, with and without a loss of stiffness that begins at noon.

    .venv/bin/python -m tests.statistics.lost_channel OUT.jsonl [--seeds 100:105] [--faults nan,still,...] [--losses 0,0.05,0.1]

Each run: one healthy hour for the baseline; then 3 h with all sensors, 24 h in which one of them gives nothing true, 3 h with all
of them again; windows of 400 s each 200 s, 10 % noise.  A loss begins in the middle of the 24 h.  The runs that OUT.jsonl holds
are not made again, and its table is printed at the end.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections import defaultdict
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.core import Level, ModalEstimate, WindowResult
from monitor.damage import Baseline, learn_baseline
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from tests.statistics.estimates import STIFFNESS, configuration

HOUR_S, RATE_HZ, BLOCK = 3600, 100.0, 6000
BEFORE_H, DURING_H, AFTER_H = 3, 24, 3
FAULTS = ("nan", "still", "noise", "drift", "stuck")


@cache
def site() -> Configuration:
    """The frame, with a hop that spares time."""
    c = configuration(400.0)
    return c.model_copy(update={"processing": c.processing.model_copy(update={"hop_s": 200.0, "rate_hz": RATE_HZ})})


@lru_cache(maxsize=6)
def motion(hours: float, seed: tuple[int, int], loss: tuple[float, ...]) -> np.ndarray:
    """Accelerations of the floors, from the frame at rest; all faults of a seed share them."""
    model = site().model().with_stiffness(STIFFNESS * (1.0 - np.array(loss)))
    number = int(np.random.SeedSequence(seed).generate_state(1)[0])
    return simulate(model, duration_s=hours * HOUR_S, rate_hz=RATE_HZ, noise=0.1, seed=number).floors


def spoil(x: np.ndarray, fault: str, seed: int) -> np.ndarray:
    """What a sensor gives instead of its motion `x`, shape (n,)."""
    rng = np.random.default_rng([seed, 7])
    if fault == "nan":
        return np.full(x.size, np.nan)
    if fault == "still":
        return np.zeros(x.size)
    if fault == "stuck":
        return np.full(x.size, x[0])
    if fault == "noise":
        return rng.normal(scale=0.3 * x.std(), size=x.size)
    steps = rng.normal(
        scale=x.std(), size=x.size
    )  # drift: as much a sample as the motion itself, forty times within a window
    return np.asarray(x + np.cumsum(steps))


@lru_cache(maxsize=1)
def baseline(seed: int) -> Baseline:
    """Learn the healthy state from one hour."""
    samples = motion(1.0, (seed, 0), (0.0, 0.0, 0.0))
    blocks = cut_into_blocks(ACCELERATION, samples, site().channels, RATE_HZ, 10**18, BLOCK)
    pipeline = Pipeline(site())
    results = [r for b in blocks for r in pipeline.push(b) if isinstance(r, WindowResult) and r.modes is not None]
    modes = [r.modes for r in results if isinstance(r.modes, ModalEstimate)]
    rms = np.array([r.rms_m_s2 for r in results], dtype=float)
    c = site()
    return learn_baseline(
        c.instrumented(),
        modes,
        rms,
        (),
        (10**18, 10**18 + HOUR_S * 10**9),
        [r.covariates for r in results],
        {"level": "dB"},
        pipeline.level_weights,
        updating=c.updating,
        compensation=c.compensation,
        motion=[r.motion for r in results if r.motion is not None],
    )[0]


def one(fault: str, channel: int, story: int, loss: float, seed: int) -> dict[str, Any]:
    """Make one run and count what it told."""
    none = (0.0, 0.0, 0.0)
    lost = tuple(loss if j == story else 0.0 for j in (1, 2, 3))
    parts = [
        motion(BEFORE_H, (seed, 1), none),
        motion(DURING_H / 2, (seed, 2), none),
        motion(DURING_H / 2, (seed, 3), lost),
        motion(AFTER_H, (seed, 4), lost),
    ]
    samples = np.concatenate(parts)
    begin, end = (round(h * HOUR_S * RATE_HZ) for h in (BEFORE_H, BEFORE_H + DURING_H))
    samples[begin:end, channel] = spoil(samples[begin:end, channel], fault, seed)
    healthy, c = baseline(seed), site()
    pipeline, results = Pipeline(c, healthy), []
    for block in cut_into_blocks(ACCELERATION, samples, c.channels, RATE_HZ, 10**18, BLOCK):
        results += [r for r in pipeline.push(block) if isinstance(r, WindowResult)]
    t_h = np.array([(r.t_end_ns - 10**18) / 3.6e12 for r in results])
    judged = np.array([r.damage is not None for r in results])
    names = [[gone.channel for gone in r.left_out] for r in results]
    out = np.array([name == [c.channels[channel]] for name in names])
    window_h = 400.0 / HOUR_S
    onset_h, back_h = BEFORE_H + DURING_H / 2, BEFORE_H + DURING_H
    phases = {
        "before": t_h <= BEFORE_H,
        "during": (t_h >= BEFORE_H + window_h) & (t_h <= back_h),
        "after": t_h >= back_h + window_h + 1e-6,
    }
    told = [(float(t), list(r.alarm.stories), r.alarm.level.value) for t, r in zip(t_h, results, strict=True)]
    announced = [(t, stories) for t, stories, level in told if level in ("warning", "alarm")]
    true = [t for t, stories in announced if t > onset_h and story in stories] if loss else []
    false = [
        t
        for t, stories, level in told
        if level != Level.NORMAL.value and not (loss and stories == [story] and t > onset_h)
    ]
    late = (t_h > onset_h + 2.0) & (t_h <= back_h) & judged
    read = [r.damage for r, keep in zip(results, late, strict=True) if keep and r.damage is not None]
    early = (t_h > BEFORE_H + window_h) & (t_h <= onset_h) & judged
    healthy_read = [r.damage for r, keep in zip(results, early, strict=True) if keep and r.damage is not None]
    whole_read = [r.damage for r, t in zip(results, t_h, strict=True) if r.damage is not None and t <= BEFORE_H]
    skips = sorted({r.skipped.reason for r in results if r.skipped is not None})
    return {
        "fault": fault,
        "channel": c.channels[channel],
        "story": story,
        "loss": loss,
        "seed": seed,
        "judged": {name: [int(judged[at].sum()), int(at.sum())] for name, at in phases.items()},
        "left_out": {name: int(out[at].sum()) for name, at in phases.items()},
        "others_left_out": sum(bool(set(name) - {c.channels[channel]}) for name in names),
        "told": sum(a != b for a, b in itertools.pairwise([[], *names, []])),
        "delay_h": true[0] - onset_h if true else None,
        "false": len(false),
        "false_h": false[:3],
        "read": np.mean([d.ddi for d in read], axis=0).round(5).tolist() if read else None,
        "std": np.mean([d.ddi_std for d in read], axis=0).round(5).tolist() if read else None,
        "std_all": np.mean([d.ddi_std for d in whole_read], axis=0).round(5).tolist() if whole_read else None,
        "healthy_read": np.mean([d.ddi for d in healthy_read], axis=0).round(5).tolist() if healthy_read else None,
        "unidentified": sorted({j for d in read for j in d.unidentified}),
        "skips": skips[:3],
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
    rows = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    made = {(r["fault"], r["loss"], r["seed"]) for r in rows}
    first, last = map(int, options.seeds.split(":"))
    for seed, loss, fault in itertools.product(
        range(first, last), map(float, options.losses.split(",")), options.faults.split(",")
    ):
        if (fault, loss, seed) in made:
            continue
        number = seed + FAULTS.index(fault)  # every channel and every story in turn
        rows.append(one(fault, number % 3, (number // 3 + FAULTS.index(fault)) % 3 + 1, loss, seed))
        with options.out.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
