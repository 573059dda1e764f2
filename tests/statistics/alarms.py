"""Run lengths and detection of the alarm, on a twin of the window readings and on raw records.

    .venv/bin/python -m tests.statistics.alarms [YEARS] [TRIALS]

prints the false announcements in so many years of an intact frame and how many trials find a loss in time, and draws
docs/alarms-run-length.png.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, Level, WindowResult
from monitor.damage import AlarmSettings, Baseline
from monitor.pipeline import Pipeline
from tests.damage.alarm_twin import HOP_S, MONTH, SURE_STDS, TWIN, WINDOW, WINDOW_S, Twin, episodes, evidence, limit
from tests.statistics import figures
from tests.statistics.estimates import configuration
from tests.support.campaign import words
from tests.support.simulated import ambient, learned, seeded, windows_of

BASELINE_S = 14400.0
SEED = 20270131


THRESHOLD = limit(AlarmSettings().false_announcements_per_year)


@dataclass(frozen=True)
class Detection:
    """Outcome of detection trials."""

    found: float
    """Share whose warning names the story in time."""
    wrong: float
    """Share in which another story was announced."""
    median_s: float
    """Median delay of the warning, s."""
    told_s: float
    """Median delay of the first announcement, s."""


def false_alarms(
    years: float,
    thresholds: Array,
    *,
    baseline_s: float = BASELINE_S,
    weather: float = 0.0,
    seed: int = SEED,
    twin: Twin = TWIN,
    either_side: bool = False,
) -> NDArray[np.int64]:
    """False alarms of an intact frame at each threshold, and those of them that are confirmed; a new baseline every month.

    Parameters
    ----------
    weather : float
        Amplitude of a daily relative change of stiffness, alike in all stories, of which no channel tells.

    Returns
    -------
    ndarray, shape (2, thresholds)
    """
    count = np.zeros((2, thresholds.size), dtype=np.int64)
    day = np.sin(2.0 * np.pi * HOP_S * np.arange(MONTH) / 86400.0)[:, None]
    for rng in np.random.default_rng(seed).spawn(round(12 * years)):
        ddi, variance, common = twin.readings(MONTH, baseline_s, rng)
        found = evidence(ddi + weather * day, variance, common, float(thresholds.min()), either_side=either_side)
        count += [[episodes(z, threshold) for threshold in thresholds] for z in found]
    return count


def ramp(onset_s: float, hops: int) -> Array:
    """Share of each window that lies after the onset, shape (hops,); the first window ends after `WINDOW_S`."""
    end = WINDOW_S + HOP_S * np.arange(hops)
    return np.clip((end - onset_s) / WINDOW_S, 0.0, 1.0)


def delay(z: Array, lasting: Array, first: int, least_z: float) -> int:
    """Hops from `first` until a story's warning is confirmed, as `alarm.step` does it; the series' length if never."""
    since = None
    for k, (now, of_several) in enumerate(zip(z[first:].tolist(), lasting[first:].tolist(), strict=True)):
        if now < least_z - (0.0 if since is None else SURE_STDS):
            since = None
            continue
        since = k if since is None else since
        if of_several >= least_z or (now >= least_z and k - since >= WINDOW):
            return k
    return len(z)


def detection(
    loss: float,
    story: int,
    within_s: float,
    trials: int,
    *,
    baseline_s: float = BASELINE_S,
    seed: int = SEED,
    least_z: float = THRESHOLD,
) -> Detection:
    """Trials of a loss that begins at any time between two hops, after 1.5 h without; `story` from 0.

    A warning counts when the window that brings it ends within the time.
    """
    quiet_s = 5400.0
    hops = round((quiet_s + within_s - WINDOW_S) / HOP_S) + 1
    first = round((quiet_s - WINDOW_S) / HOP_S)
    delays, wrong = [], 0
    for rng in np.random.default_rng(seed).spawn(trials):
        ddi, variance, common = TWIN.readings(hops, baseline_s, rng)
        onset = quiet_s - rng.uniform(0.0, HOP_S)
        ddi[:, story] += loss * ramp(onset, hops)
        z, lasting = evidence(ddi, variance, common, least_z - SURE_STDS)
        rises = np.flatnonzero(z[first:, story] >= least_z)
        both = (rises[0] if rises.size else hops), delay(z[:, story], lasting[:, story], first, least_z)
        ends = [WINDOW_S + HOP_S * (first + taken) for taken in both]
        delays.append([end - onset if end <= onset + within_s else np.inf for end in ends])
        wrong += bool((np.delete(z, story, axis=1) >= least_z).any())
    told, warned = np.array(delays).T
    return Detection(
        float(np.isfinite(warned).mean()), wrong / trials, float(np.median(warned)), float(np.median(told))
    )


def raw_readings(
    pieces: list[tuple[float, dict[int, float]]], seed: int, healthy: Baseline | None, hop_s: float = HOP_S
) -> list[WindowResult]:
    """Windows of one record simulated piece by piece: (seconds, {story: relative loss})."""
    config = configuration(hop_s)
    floors = [
        ambient(config.model(), seconds, 1000.0, seeded(seed, number), loss=[losses.get(j, 0.0) for j in (1, 2, 3)])
        for number, (seconds, losses) in enumerate(pieces)
    ]
    return windows_of(Pipeline(config, healthy), np.concatenate(floors), 1000.0)


def raw_baseline(seconds: float, seed: int) -> Baseline:
    """Learned from a simulated record of the intact frame."""
    return learned(configuration(HOP_S), raw_readings([(seconds, {})], seed, None, hop_s=WINDOW_S / 2.0))


def raw_detection(loss: float, within_s: float, trials: int, seed: int = SEED) -> list[str]:
    """Raw records with the loss in stories 1, 2, 3 in turn: what was announced and when, one line a trial."""
    lines = []
    for trial in range(trials):
        if trial % 12 == 0:
            healthy = raw_baseline(BASELINE_S, seed + 1000 * trial)
        story, onset_s = 1 + trial % 3, 800.0
        windows = raw_readings([(onset_s, {}), (within_s, {story: loss})], seed + 1000 * trial + story, healthy)
        warned = [r for r in windows if r.alarm.level.rank >= Level.WARNING.rank]
        named = sorted({j for r in windows for j in r.alarm.active})
        when = f"{warned[0].t_end_ns * 1e-9 - onset_s:.0f} s" if warned else "never"
        lines.append(f"{100 * loss:g} % in story {story}: warning after {when}, named {named}")
    return lines


def plot(path: Path, thresholds: Array, counts: dict[str, tuple[float, NDArray[np.int64]]]) -> None:
    """Mean time between false alarms over the threshold; where none was seen, nothing is drawn."""
    with figures.figure(path, size=(8.6, 5.2)) as (axes,):
        for (name, (years, count)), colour in zip(
            counts.items(), (figures.BLUE, figures.GREEN, figures.RED), strict=True
        ):
            seen = count > 0
            axes.plot(thresholds[seen], years / count[seen], "o-", color=colour, label=f"{name}, {years:g} years")
        axes.axvline(THRESHOLD, color=figures.GREY, label="default")
        axes.set(
            yscale="log", ylim=(1e-3, 1e2), xlim=(thresholds[0], thresholds[-1]), ylabel="years between false alarms"
        )
        axes.set_xlabel("limit in standard deviations")


def main() -> None:
    """Everything, with the plot."""
    years, trials = words(30.0, 2000)
    thresholds = np.arange(4.0, 6.76, 0.25)
    print(
        f"false announcements of an intact frame in {years:g} years, a new baseline every month; limit {THRESHOLD:.2f}"
    )
    print(f"{'limit':<44}", *(f"{t:7.2f}" for t in thresholds))
    counts = {}
    for name, share, baseline_s, weather in (
        ("baseline 20 min", 1.0, 1200.0, 0.0),
        ("baseline 4 h", 1.0, 14400.0, 0.0),
        ("4 h, daily +-1.5 % alike", 0.1, 14400.0, 0.015),
    ):
        announced, confirmed = false_alarms(share * years, thresholds, baseline_s=baseline_s, weather=weather)
        counts[name] = share * years, announced
        for what, count in (("", announced), (", confirmed", confirmed)):
            print(f"{name + what + f', {share * years:g} years':<44}", *(f"{c:7d}" for c in count), flush=True)
    plot(Path(__file__).parents[2] / "docs" / "alarms-run-length.png", thresholds, counts)
    for least_z, baseline_s in product((THRESHOLD, 6.5), (1200.0, 3600.0, 14400.0, 86400.0)):
        for loss, within_s in ((0.01, 800.0), (0.005, 3600.0)):
            found = [detection(loss, j, within_s, trials, baseline_s=baseline_s, least_z=least_z) for j in range(3)]
            shares = ", ".join(f"{100 * d.found:.1f} % ({d.told_s:.0f}, {d.median_s:.0f} s)" for d in found)
            wrong = sum(d.wrong for d in found) / 3
            print(
                f"limit {least_z:.2f}, baseline {baseline_s:g} s, {100 * loss:g} % within {within_s:g} s: {shares} "
                f"(median of the announcement, of the warning); wrong {100 * wrong:g} %",
                flush=True,
            )
    print(*raw_detection(0.01, 800.0, 12), *raw_detection(0.005, 3600.0, 3), sep="\n")


if __name__ == "__main__":
    main()
