"""Events of simulated ground motions: recognized, peak drifts with and without a ground sensor; resumable.

``python -m tests.statistics.shaken N SEED OUT.jsonl`` appends a line for each motion, and prints the table of all lines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from monitor.events import Event
from monitor.pipeline import Pipeline
from tests.events.shaken import RATE, T0_NS, blocks, configuration, kanai_tajimi, shake
from tests.support.campaign import gone_on_with, words

_QUIET_S = 80.0


def trial(seed: int) -> dict[str, Any]:
    """Shake a frame by one ground motion; return the errors of its drifts."""
    rng = np.random.default_rng(seed)
    peak = 9.81 * 10.0 ** rng.uniform(np.log10(0.02), 0.0)
    wave = kanai_tajimi(rng.uniform(8.0, 40.0), peak, rng.uniform(1.0, 6.0), rng)
    ground = np.zeros(round((2.0 * _QUIET_S) * RATE) + wave.size)
    ground[round(_QUIET_S * RATE) :][: wave.size] = wave
    motion, _ = shake(ground, rng)
    line: dict[str, Any] = {"peak_m_s2": peak}
    for with_ground in (True, False):
        pipeline = Pipeline(configuration())
        told = [
            e
            for block in blocks(motion, with_ground=with_ground, n=200)
            for e in pipeline.push(block)
            if isinstance(e, Event) and e.revision == 0
        ]
        name = "with" if with_ground else "without"
        line[f"events_{name}"] = len(told)
        if len(told) != 1:
            continue
        (event,) = told
        begin, end = (round((t - T0_NS) * 1e-9 * RATE) for t in (event.begin_ns, event.end_ns))
        truth = np.abs(motion.drifts[begin:end]).max(axis=0)
        line[f"error_{name}"] = (event.drift_m / truth - 1.0).tolist()
        line[f"z_{name}"] = ((event.drift_m - truth) / event.drift_std_m).tolist()
    return line


def table(lines: list[dict[str, Any]]) -> str:
    """Summarize the trials."""
    names, rows = ("with", "without"), ["| | with ground | without |", "|---|---|---|"]
    counts = [sum(line[f"events_{name}"] == 1 for line in lines) for name in names]
    rows.append(f"| recognized as one event, of {len(lines)} | {counts[0]} | {counts[1]} |")
    errors = {name: np.abs([line[f"error_{name}"] for line in lines if f"error_{name}" in line]) for name in names}
    for story in range(3):
        found = [np.percentile(errors[name][:, story], 95) for name in names]
        rows.append(
            f"| story {story + 1}: error of the peak drift, 95th percentile | {found[0]:.1%} | {found[1]:.1%} |"
        )
    beyond = [(np.abs([line[f"z_{name}"] for line in lines if f"z_{name}" in line]) > 2.0).mean() for name in names]
    rows.append(f"| beyond two of its standard deviations | {beyond[0]:.1%} | {beyond[1]:.1%} |")
    return "\n".join(rows)


def main() -> None:
    """Do the trials that the file lacks, and print the table."""
    n, seed, out = words(int, int, Path)
    print(table(gone_on_with(out, ("seed",), [(1000 * seed + k,) for k in range(n)], trial)))


if __name__ == "__main__":
    main()
